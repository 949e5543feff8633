# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Declare a node's topics and services as rows, from which they are created and documented."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final, Literal


@dataclass(frozen=True)
class Topic:
    """A topic or service of a node.

    ``direction``: as seen by the node. ``name``: ``<joint>`` stands for a joint's name. ``kind``: package and type.
    ``when``: the setting that creates the topic. ``latched``: late subscribers get the last
    message. ``whole``: a newer message must not replace an older one in the queue.
    """

    direction: Literal["in", "out", "service"]
    name: str
    kind: str
    text: str
    when: str = ""
    latched: bool = False
    whole: bool = False

    @property
    def message(self) -> Any:
        """The class of the messages."""
        package, kind = self.kind.split("/")
        return getattr(import_module(f"{package}.msg"), kind)


def make_topic_tokens(names: Sequence[str]) -> dict[str, str]:
    """Return for each name a different token of a ROS topic name.

    ROS allows ASCII letters, digits and single underscores, and no leading digit. Accents are
    dropped, any other character becomes an underscore, and a repeated token gets a number.
    """
    tokens: dict[str, str] = {}
    for name in names:
        plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
        token = re.sub(r"[^A-Za-z0-9]+", "_", plain).strip("_")
        if not token[:1].isalpha():
            token = f"joint_{token}".rstrip("_")
        taken, first, count = set(tokens.values()), token, 1
        while token in taken:
            count += 1
            token = f"{first}_{count}"
        tokens[name] = token
    return tokens


def table(*rows: Topic) -> dict[str, Topic]:
    """Return topics by name."""
    return {row.name: row for row in rows}


JOINTS: Final = "sensor_msgs/JointState"
TRAJECTORY: Final = "trajectory_msgs/JointTrajectory"
NUMBER_ARRAY: Final = "std_msgs/Float64MultiArray"
WRENCH: Final = "geometry_msgs/WrenchStamped"
STATUSES: Final = "diagnostic_msgs/DiagnosticArray"
TEXT: Final = "std_msgs/String"
TRIGGER: Final = "std_srvs/Trigger"
"""Types of messages and services."""
