# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Parameters of the robot that may change while a node runs."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, Final

import numpy as np

from pkm_twin.errors import warn_of_file
from pkm_twin.machine.sections import MAX_MASS
from pkm_twin.robot.plausibility import check_gravity, check_payload_mass
from pkm_twin.robot.robot import Robot
from pkm_twin.ros.node import TwinNode

CHANGEABLE_PARAMETERS: Final = {
    "payload.mass": ("payload", "mass", "kg", "mass of the payload"),
    "payload.com": ("payload", "com", "m", "centre of mass of the payload, from the platform's reference point"),
    "payload.inertia": ("payload", "inertia", "kg m2", "inertia of the payload about its com, 3 or 9 numbers"),
    "friction.viscous": ("friction", "viscous", "N m s or N s/m", "viscous friction, one per joint"),
    "friction.coulomb": ("friction", "coulomb", "N m or N", "Coulomb friction, one per joint"),
    "friction.offset": ("friction", "offset", "N m or N", "constant effort, one per joint"),
    "gravity": ("gravity", "", "m/s2", "gravity in base axes"),
    "effort_limits": (
        "limits",
        "effort",
        "N m or N",
        "largest effort of each joint; efforts beyond it are rejected, or as limit_policy says",
    ),
}
"""Section, key, unit and meaning of each parameter."""


def declare_changes(node: TwinNode, robot: Robot, names: Collection[str] = CHANGEABLE_PARAMETERS) -> dict[str, Any]:
    """Declare parameters of :data:`CHANGEABLE_PARAMETERS`; return the values that were set, by name."""
    changes = {}
    for name in names:
        section, key, unit, text = CHANGEABLE_PARAMETERS[name]
        value = getattr(robot, section)
        value = getattr(value, key) if key else value
        if value is None:
            value = np.full(len(robot.joint_names), np.inf)
        default = value.ravel().tolist() if isinstance(value, np.ndarray) else value
        bounds: dict[str, Any] = {}
        if name == "payload.mass":
            bounds = {"low": 0.0, "high": MAX_MASS}
        given = node.declare(name, default, text, unit=unit, usual="the robot file's", changeable=True, **bounds)
        if name in node.given:
            changes[name] = given
    return changes


def change_robot(robot: Robot, values: dict[str, Any]) -> Robot:
    """Return the robot with new values of :data:`CHANGEABLE_PARAMETERS`; an implausible one gives a warning."""
    sections: dict[str, Any] = {}
    for name, value in values.items():
        section, key, *_ = CHANGEABLE_PARAMETERS[name]
        plain = list(value) if hasattr(value, "__len__") else value
        if name == "payload.inertia" and len(plain) == 9:
            plain = [plain[0:3], plain[3:6], plain[6:9]]
        if key:
            sections.setdefault(section, {})[key] = plain
        else:
            sections[section] = plain
    made = robot.changed(**sections)
    for finding in (*check_gravity(made), *check_payload_mass(made)):
        warn_of_file(f"parameters of {robot.name}", finding.text)
    return made
