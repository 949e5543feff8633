# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The report of a checked bag. Imports no ROS."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pkm_twin.bags.definitions import parse_definition
from pkm_twin.bags.storage import METADATA_FILE, Storage
from pkm_twin.bags.strict import Check, Span
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
    """Language of the definition, ``ros2msg`` or ``ros2idl``; empty if there is none."""


@dataclass(frozen=True)
class BagReport:
    """The findings of a strict pass over a bag. Times are log times in ns, 0 without messages."""

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


def make_report(path: Path, storage: Storage, checks: Sequence[Check]) -> BagReport:
    """Return the report of a sound bag by the checks of its files.

    :raises BagError: a topic has two types, or forms of one.
    """
    topics: dict[str, TopicInfo] = {}
    counts, whole = dict[str, int](), Span()
    for file, check in zip(storage.files, checks, strict=True):
        schemas = check.records.schemas
        # Many channels may share one long definition.
        texts = {number: schema.data.decode(errors="replace") for number, schema in schemas.items()}
        for number, channel in check.records.channels.items():
            schema, span, name = schemas.get(channel.schema_id), check.spans.get(number, Span()), channel.topic
            info = TopicInfo(
                type=schema.name if schema else "",
                count=span.count,
                start=span.start,
                end=span.end,
                offered_qos=channel.metadata.get("offered_qos_profiles", ""),
                definition=texts.get(channel.schema_id, ""),
                encoding=channel.message_encoding,
                schema_encoding=schema.encoding if schema else "",
            )
            known = topics.get(name, info)
            fault = ""
            if known.type != info.type:
                fault = f"two types, {known.type} and {info.type}"
            elif not _have_same_format(known, info):
                fault = f"two forms of the type {info.type}: definition or encoding differ"
            if fault:
                raise BagError(f"topic {name} has {fault}", path=file.path, reason="type")
            # The topic is known from another publisher or another file of the bag: join counts and times.
            if name in topics and known.count and info.count:
                start, end = min(known.start, info.start), max(known.end, info.end)
                info = replace(known, count=known.count + info.count, start=start, end=end)
            topics[name] = info if info.count else known
        counts[f" in {file.path.name}"] = check.message_count
        whole.join(check.total)
    stated = {"": storage.message_count} if storage.message_count is not None else {}
    stated |= {f" on {name}": number for name, number in storage.by_topic.items()}
    stated |= {f" in {name}": number for name, number in storage.by_file.items()}
    counts |= {"": whole.count} | {f" on {name}": info.count for name, info in topics.items()}
    miscounts = tuple(
        f"{METADATA_FILE} states {said} messages{where}, there are {counts.get(where, 0)}"
        for where, said in stated.items()
        if said != counts.get(where, 0)
    )
    warnings = dict.fromkeys(text for check in checks for text in _find_warnings(check))
    return BagReport(
        path=path,
        profile=checks[0].header.profile,
        library=checks[0].header.library,
        topics=dict(sorted(topics.items())),
        message_count=whole.count,
        start_time=whole.start,
        end_time=whole.end,
        has_crc=all(check.has_crc for check in checks),
        has_index=all(check.has_index for check in checks),
        has_summary=all(check.has_summary for check in checks),
        warnings=(*warnings, *miscounts),
        miscounts=miscounts,
        out_of_order=sum(check.out_of_order for check in checks),
        # rosbag2 writes its record again when it closes a bag: the last one is valid.
        metadata={title: entries for check in checks for title, entries, _ in check.metadata},
    )


def _find_warnings(check: Check) -> Iterator[str]:
    if not check.has_crc:
        chunks = [part.has_crc for part in check.segments if part.is_chunk]
        some = f"{chunks.count(False)} of {len(chunks)} chunks have no CRC"
        yield (
            f"{some if any(chunks) else 'the messages have no CRC'}, as rosbag2 writes by default: "
            "lengths, counts, times and indexes agree, a changed value would go unseen"
        )
    elif not check.has_data_crc:
        yield "the data section has no CRC of its own: metadata and record headers are unproven"
    if check.has_crc and check.summary_without_crc:
        yield "the summary has no CRC"
    if not check.has_summary:
        yield "there is no summary: read by a scan, the message count is unproven"
    elif check.statistics is None:
        yield "the summary has no statistics: the message count is unproven"
    yield from check.notes
    if check.out_of_order:
        yield f"{check.out_of_order} messages are out of order by log time"
    if unknown := check.records.unread.total():
        yield f"{unknown} records of unknown kinds were passed over"


def _have_same_format(one: TopicInfo, other: TopicInfo) -> bool:
    """Return whether messages of both topics can be read alike; comments of definitions may differ."""
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
