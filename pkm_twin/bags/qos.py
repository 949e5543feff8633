# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Check the QoS and topic names that a bag records. Imports no ROS."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Final

import yaml

from pkm_twin.errors import BagError

MAX_QOS_CHARACTERS: Final = 100_000
"""Longest recorded offer that is read; one of a publisher has some 400 characters."""
MAX_DEPTH: Final = 100_000
"""Largest queue that a recorded offer may ask for."""
MAX_TOPIC_CHARACTERS: Final = 247
"""Longest topic name that ROS takes: 255 of DDS less its own prefix."""

MAX_NESTING: Final = 50
"""Deepest nesting; rosbag2 writes eight."""
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True)
class OfferedQos:
    """The recorded QoS of a publisher, as far as a replay uses it."""

    reliable: bool = True
    transient_local: bool = False
    depth: int = 0
    """Number of samples in the queue; 0 if the recording does not state it."""


def load_plain(text: str) -> object:
    """Parse YAML of unknown origin in bounded time, without tags, aliases and deep nesting.

    :raises ValueError: the text is not such YAML; the error says why in one line.
    """
    depth = 0
    try:
        # Check the events before building objects, because a few aliases may stand for gigabytes.
        for event in yaml.parse(text, Loader=_LOADER):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            line = event.start_mark.line + 1 if event.start_mark else 0
            if isinstance(event, yaml.AliasEvent):
                raise ValueError(f"an alias in line {line}")
            if depth > MAX_NESTING:
                raise ValueError(f"nested deeper than {MAX_NESTING} in line {line}")
        return yaml.load(text, Loader=_LOADER)  # noqa: S506  a safe loader
    except (yaml.YAMLError, OverflowError, RecursionError) as error:
        raise ValueError(" ".join(str(error).split()) or type(error).__name__) from None


def parse_qos(topic: str, text: str) -> OfferedQos:
    """Parse the recorded QoS offer of a topic; reliable and volatile if there is none.

    Of several publishers the first counts. Policies that are "system default" or unknown are those
    of the default.

    :raises BagError: it is not the YAML that rosbag2 writes, naming the field.
    """

    def refuse(field: str, value: object, expected: str) -> BagError:
        error = f"topic {topic}: offered_qos_profiles: {field} is {value!r}; expected {expected}"
        return BagError(error, reason="qos")

    if not text.strip():
        return OfferedQos()
    if len(text) > MAX_QOS_CHARACTERS:
        raise refuse("length", len(text), f"at most {MAX_QOS_CHARACTERS} characters")
    try:
        offers: Any = load_plain(text)
    except ValueError as error:
        raise refuse("the text", text, f"plain YAML ({error})") from None
    if offers in (None, []):
        return OfferedQos()
    if not isinstance(offers, list) or not isinstance(offers[0], dict):
        raise refuse("the text", text, "a list of mappings")
    offer = offers[0]
    depth = offer.get("depth", 0)
    if isinstance(depth, bool) or not isinstance(depth, int) or not 0 <= depth <= MAX_DEPTH:
        raise refuse("depth", depth, f"0 to {MAX_DEPTH}")
    # rosbag2 writes names since Jazzy, numbers before.
    reliable = str(offer.get("reliability")) not in ("2", "best_effort")
    return OfferedQos(reliable, str(offer.get("durability")) in ("1", "transient_local"), depth)


def require_topic(name: str) -> str:
    """Return a topic's name if it is a full name that ROS accepts.

    :raises BagError: it is another text.
    """
    if len(name) > MAX_TOPIC_CHARACTERS or not re.fullmatch(r"(?:/[A-Za-z_][A-Za-z0-9_]*)+", name):
        names = "/names of letters, digits and _, none beginning with a digit"
        text = f"{name!r} is no topic name; expected {names}"
        raise BagError(f"{text}, at most {MAX_TOPIC_CHARACTERS} characters", reason="topic")
    return name
