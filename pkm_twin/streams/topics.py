# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Topics and services of a node as rows: what makes, documents and permits them. Needs no ROS."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final, Literal


@dataclass(frozen=True)
class Topic:
    """A row of a node's table.

    ``name``: ``<joint>`` in it stands for a joint's. ``kind``: package and type. ``when``: what has
    to be asked for. ``latched``: late joiners get the last message. ``whole``: no message may be
    lost for a newer one.
    """

    way: Literal["in", "out", "service"]
    name: str
    kind: str
    text: str
    when: str = ""
    latched: bool = False
    whole: bool = False

    @property
    def message(self) -> Any:
        """The class of its messages."""
        package, kind = self.kind.split("/")
        return getattr(import_module(f"{package}.msg"), kind)


def table(*rows: Topic) -> dict[str, Topic]:
    """Rows by name."""
    return {row.name: row for row in rows}


JOINTS: Final = "sensor_msgs/JointState"
TRAJECTORY: Final = "trajectory_msgs/JointTrajectory"
NUMBERS: Final = "std_msgs/Float64MultiArray"
WRENCH: Final = "geometry_msgs/WrenchStamped"
STATUSES: Final = "diagnostic_msgs/DiagnosticArray"
TEXT: Final = "std_msgs/String"
TRIGGER: Final = "std_srvs/Trigger"
"""Types of messages and services."""
