# SPDX-License-Identifier: Apache-2.0
"""What a strict pass over a bag found."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from pkm_twin.bags.definitions import parse_definition
from pkm_twin.errors import BagError


@dataclass(frozen=True)
class TopicInfo:
    """One topic of a bag: log times in ns, 0 without messages; QoS as YAML, as in the file."""

    type: str
    count: int
    start: int
    end: int
    offered_qos: str
    definition: str
    """The message definition in the file; empty where it has none."""
    encoding: str
    """How messages are encoded, ``cdr`` in ROS 2."""
    schema_encoding: str
    """What the definition is written in, ``ros2msg`` or ``ros2idl``; empty where there is none."""


@dataclass(frozen=True)
class BagReport:
    """What a strict pass over a whole bag found. Times are log times in ns, 0 without messages."""

    path: Path
    profile: str
    library: str
    topics: Mapping[str, TopicInfo]
    message_count: int
    start_time: int
    end_time: int
    has_crc: bool
    """Every message is covered by a CRC."""
    has_index: bool
    """Every chunk is listed in the summary."""
    has_summary: bool
    warnings: tuple[str, ...]
    out_of_order: int
    """Messages whose log time is before that of one earlier in the file."""
    metadata: Mapping[str, Mapping[str, str]]
    miscounts: tuple[str, ...] = ()
    """Message counts of the bag's folder that its files contradict; they are warnings too."""

    @property
    def duration(self) -> float:
        """Time from the first message to the last, s."""
        return (self.end_time - self.start_time) * 1e-9


def join_topic(topics: dict[str, TopicInfo], name: str, info: TopicInfo, path: Path) -> None:
    """Add a channel of the topic ``name``: another publisher's, or of another file of the bag.

    :raises BagError: it is not of the type, with the fields, that the topic has so far.
    """
    known = topics.get(name)
    if known is None:
        topics[name] = info
        return
    if known.type != info.type:
        raise BagError(
            f"topic {name} has two types, {known.type} and {info.type}", path=path, reason="type"
        )
    if not _one_form(known, info):
        raise BagError(
            f"topic {name} has two forms of the type {info.type}: definition or encoding differ",
            path=path,
            reason="type",
        )
    if not (known.count and info.count):
        topics[name] = known if known.count or not info.count else info
        return
    start, end = min(known.start, info.start), max(known.end, info.end)
    topics[name] = replace(known, count=known.count + info.count, start=start, end=end)


def _one_form(one: TopicInfo, other: TopicInfo) -> bool:
    """Whether messages of both can be read alike; definitions may differ in comments."""
    if (one.encoding, one.schema_encoding) != (other.encoding, other.schema_encoding):
        return False
    if one.definition == other.definition:
        return True
    if one.schema_encoding != "ros2msg":
        return False
    try:
        fields = [parse_definition(info.type, info.definition) for info in (one, other)]
    except BagError:
        return False
    return fields[0] == fields[1]
