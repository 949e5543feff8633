# SPDX-License-Identifier: Apache-2.0
"""A robot in words and numbers, for people and for scripts."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from delta_dynamics import reactions
from pkm_twin.mechanisms.robot import Robot

UNITS = {
    "base_radius": "m",
    "platform_radius": "m",
    "arm_length": "m",
    "forearm_length": "m",
    "limb_length": "m",
    "azimuths": "rad",
    "mass": "kg",
    "inertia": "kg m2",
    "com": "m",
    "gravity": "m/s2",
    "youngs_modulus": "Pa",
    "shear_modulus": "Pa",
    "diameter": "m",
    "joint_angle": "rad",
}


def describe(robot: Robot) -> dict[str, Any]:
    """Plain data: what it is, every parameter, mobility, overconstraint and the home pose."""
    home = robot.home()
    q = robot.inverse(home)
    return {
        "name": robot.name,
        "mechanism": robot.mechanism,
        "description": robot.description,
        "joints": list(robot.joint_names),
        "joint_unit": robot.joint_unit,
        "effort_unit": robot.effort_unit if robot.dynamics_kernel is not None else None,
        "pose": dict(zip(robot.pose_names, robot.pose_units, strict=True)),
        "mobility": robot.mobility,
        "overconstrained": overconstraint(robot),
        "home_pose": dict(zip(robot.pose_names, home.tolist(), strict=True)),
        "home_joints": dict(zip(robot.joint_names, q.tolist(), strict=True)),
        "singularity_at_home": float(robot.singularity(q)),
        "parameters": _plain(robot),
    }


def overconstraint(robot: Robot) -> list[str]:
    """What rigid-body statics cannot determine, by name; empty where it determines all."""
    if robot.dynamics_kernel is not None:
        zero = np.zeros(3)
        return list(reactions(robot, robot.inverse(robot.home()), zero, zero).indeterminate)
    return list(robot.redundant_constraints)


def lines(data: dict[str, Any]) -> list[tuple[str, str]]:
    """The same as pairs of words for a table."""
    pose = ", ".join(f"{name} ({unit})" for name, unit in data["pose"].items())
    rows = [
        ("robot", f"{data['name']}: {data['description']}"),
        ("mobility", data["mobility"]),
        ("pose", pose),
        ("actuated joints", f"{', '.join(data['joints'])} ({data['joint_unit']})"),
        ("home pose", _pairs(data["home_pose"])),
        ("home joints", _pairs(data["home_joints"])),
        ("distance to singularity at home", f"{data['singularity_at_home']:.3f} (1 is best)"),
        (
            "overconstrained",
            "; ".join(data["overconstrained"]) or "no: rigid bodies determine every reaction",
        ),
    ]
    for section, values in data["parameters"].items():
        if isinstance(values, dict):
            rows += [(f"{section}: {key}", _text(key, value)) for key, value in values.items()]
        elif section not in ("mechanism", "joints"):
            rows.append((section, _text(section, values)))
    return rows


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return list(value) if isinstance(value, tuple) else value


def _text(key: str, value: Any) -> str:
    unit = UNITS.get(key) or next((u for k, u in UNITS.items() if key.endswith(f"_{k}")), "")
    if value is None:
        return "none"
    return f"{_number(value)} {unit}".strip()


def _number(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return "[" + ", ".join(_number(v) for v in value) + "]"
    return str(value)


def _pairs(values: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.4f}" for name, value in values.items())
