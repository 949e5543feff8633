# SPDX-License-Identifier: Apache-2.0
"""Parameters of the node ``delta_dynamics``: of its robot and its work, and their changes."""

from __future__ import annotations

import dataclasses
from typing import Any, Final

import numpy as np

from delta_dynamics.feedforward import Settings
from pkm_twin.machine.sections import MAX_MASS
from pkm_twin.robot.robot import Robot
from pkm_twin.ros.node import TwinNode

CHANGES: Final = {
    "payload.mass": ("payload", "mass"),
    "payload.com": ("payload", "com"),
    "payload.inertia": ("payload", "inertia"),
    "friction.viscous": ("friction", "viscous"),
    "friction.coulomb": ("friction", "coulomb"),
    "friction.offset": ("friction", "offset"),
    "gravity": ("gravity", ""),
    "effort_limits": ("limits", "effort"),
}
"""Parameters of the robot that may change while the node runs, and its section and key."""
UNITS: Final = {
    "payload.mass": "kg",
    "payload.com": "m, from the platform's reference point",
    "payload.inertia": "kg m2 about the com, 3 or 9 numbers",
    "friction.viscous": "N m s or N s/m, one per joint",
    "friction.coulomb": "N m or N, one per joint",
    "friction.offset": "N m or N, one per joint",
    "gravity": "m/s2",
    "effort_limits": "N m or N, one per joint",
}
SETTINGS: Final = {
    "acceleration": "differentiate",
    "differentiator.order": "order",
    "differentiator.window": "window",
    "limit_policy": "limit_policy",
    "stale_after": "stale_after",
    "future_tolerance": "future_tolerance",
    "accept_zero_stamp": "accept_zero_stamp",
    "trip_count": "trip_count",
    "recovery_count": "recovery_count",
    "extra_joints": "extra_joints",
    "on_stop": "on_stop",
    "singularity_warn": "singularity_warn",
    "singularity_stop": "singularity_stop",
}
"""Parameters of the node that may, and their settings."""


def declare_changes(node: TwinNode, robot: Robot) -> dict[str, Any]:
    """What is given beside the robot's file."""
    changes = {}
    for name, (section, key) in CHANGES.items():
        value = getattr(robot, section)
        value = getattr(value, key) if key else value
        if value is None:
            value = np.full(len(robot.joint_names), np.inf)
        default = value.ravel().tolist() if isinstance(value, np.ndarray) else value
        bounds: dict[str, Any] = {}
        if name == "payload.mass":
            bounds = {"low": 0.0, "high": MAX_MASS}
        given = node.declare(
            name,
            default,
            f"{name} of the robot; default: the robot file's",
            unit=UNITS[name],
            **bounds,
        )
        if name in node.given:
            changes[name] = given
    return changes


def declare_settings(node: TwinNode) -> Settings:
    """Declare what the node may be told of its work; defaults are those of :class:`Settings`."""
    d = Settings()
    acceleration = node.declare(
        "acceleration",
        "trajectory",
        "for messages without velocities or accelerations: trajectory rejects them, "
        "differentiate computes them",
        choices=("trajectory", "differentiate"),
    )
    counts: dict[str, Any] = {"low": 1, "high": 10**6}
    measure: dict[str, Any] = {"low": 0.0, "high": 1.0}
    seconds: dict[str, Any] = {"unit": "s", "high": 3600.0}
    return Settings(
        differentiate=acceleration == "differentiate",
        order=node.declare(
            "differentiator.order", d.order, "polynomial degree of the velocity",
            low=1, high=4,
        ),
        window=node.declare(
            "differentiator.window", d.window, "samples in the window", low=3, high=1000
        ),
        limit_policy=node.declare(
            "limit_policy", d.limit_policy, "efforts beyond effort_limits: warn publishes, "
            "reject rejects, clamp limits them",
            choices=("warn", "reject", "clamp"),
        ),
        stale_after=node.declare(
            "stale_after", d.stale_after, "largest age of a joint state, and longest gap "
            "before "
            "the stream stops", low=1e-3, **seconds,
        ),
        future_tolerance=node.declare(
            "future_tolerance", d.future_tolerance, "how far time stamps may be ahead of the "
            "clock",
            low=0.0, **seconds,
        ),
        accept_zero_stamp=node.declare(
            "accept_zero_stamp", d.accept_zero_stamp, "accept a zero stamp, as the arrival time"
        ),
        trip_count=node.declare(
            "trip_count", d.trip_count, "rejected joint states in a row that stop the "
            "stream", **counts
        ),
        recovery_count=node.declare(
            "recovery_count", d.recovery_count, "accepted joint states in a row that restart "
            "it", **counts
        ),
        extra_joints=node.declare(
            "extra_joints", d.extra_joints, "joints of a trajectory that the model does not "
            "have: reject the trajectory, or give them zero effort",
            choices=("refuse", "zero"),
        ),
        on_stop=node.declare(
            "on_stop", d.on_stop, "command sent once when the stream stops",
            choices=("nothing", "zeros", "gravity"),
        ),
        singularity_warn=node.declare(
            "singularity_warn", d.singularity_warn, "warn below this singularity "
            "index", **measure
        ),
        singularity_stop=node.declare(
            "singularity_stop", d.singularity_stop, "stop below this singularity "
            "index", **measure
        ),
    )  # fmt: skip


def prepared(values: dict[str, Any], robot: Robot, settings: Settings) -> tuple[Robot, Settings]:
    """The robot and the settings with new values of parameters.

    :raises ParameterError: a value that the robot cannot have.
    """
    changes = {k: v for k, v in values.items() if k in CHANGES}
    chosen = {SETTINGS[k]: v for k, v in values.items() if k in SETTINGS}
    if "differentiate" in chosen:
        chosen["differentiate"] = chosen["differentiate"] == "differentiate"
    return (
        changed(robot, changes) if changes else robot,
        dataclasses.replace(settings, **chosen),
    )


def changed(robot: Robot, values: dict[str, Any]) -> Robot:
    """The robot with new values of :data:`CHANGES`."""
    sections: dict[str, Any] = {}
    for name, value in values.items():
        section, key = CHANGES[name]
        plain = list(value) if hasattr(value, "__len__") else value
        if name == "payload.inertia" and len(plain) == 9:
            plain = [plain[0:3], plain[3:6], plain[6:9]]
        if key:
            sections.setdefault(section, {})[key] = plain
        else:
            sections[section] = plain
    return robot.changed(**sections)
