# SPDX-License-Identifier: Apache-2.0
"""A robot in words and numbers, for people and for scripts."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from delta_dynamics import reactions
from pkm_twin.errors import ParameterError
from pkm_twin.robot.clearance import clearance, has_clearance
from pkm_twin.robot.plausibility import Finding, findings
from pkm_twin.robot.robot import Robot

MOST_NAMES: Final = 6
"""Most names that a line has."""


def why_no_torques(robot: Robot) -> str:
    """Why the model has no torques for this robot; empty where it has."""
    try:
        robot.massive()
    except ParameterError as error:
        return str(error)
    return ""


def summary(robot: Robot) -> str:
    """One line that tells a robot from its siblings."""
    return robot.description


def describe(robot: Robot) -> dict[str, Any]:
    """Plain data: what it is, every parameter, mobility, overconstraint and the home pose."""
    home = robot.home()
    q = robot.inverse(home)
    return {
        "name": robot.name,
        "mechanism": robot.mechanism,
        "description": summary(robot),
        "joints": list(robot.joint_names),
        "joint_unit": robot.joint_unit,
        "joint_units": list(robot.joint_units),
        "effort_unit": None if why_no_torques(robot) else robot.effort_unit,
        "pose": dict(zip(robot.pose_names, robot.pose_units, strict=True)),
        "mobility": robot.mobility,
        "overconstrained": overconstraint(robot),
        "home_pose": dict(zip(robot.pose_names, home.tolist(), strict=True)),
        "home_joints": dict(zip(robot.joint_names, q.tolist(), strict=True)),
        "bodies": list(robot.body_names[:-1]),
        "joint_count": len(robot.graph.joints),
        "closures": robot.engine.mobility.closures,
        "rank": robot.engine.mobility.rank,
        "redundant_closures": robot.engine.mobility.redundant,
        "assumed_joints": [joint.name for joint in robot.graph.joints.values() if joint.given],
        "home_choice": robot.home_choice or None,
        "singularity_at_home": float(robot.singularity(q)),
        "clearance_at_home": float(clearance(robot, home)) if has_clearance(robot) else None,
        "plausibility": [dataclasses.asdict(finding) for finding in findings(robot)],
        "parameters": robot.parameter_sections(),
        "parameter_units": robot.parameter_units(),
    }


def overconstraint(robot: Robot) -> list[str]:
    """What rigid-body statics cannot determine, by name; empty where it determines all."""
    if not why_no_torques(robot):
        zero = np.zeros(len(robot.joint_names))
        return list(reactions(robot, robot.inverse(robot.home()), zero, zero).indeterminate)
    mobility = robot.engine.mobility
    if not mobility.redundant:
        return []
    count = f"{mobility.redundant} of {mobility.closures} closure equations"
    return [f"{count} are redundant, among {', '.join(mobility.parts)}"]


def grouped_reactions(names: Sequence[str]) -> list[str]:
    """Reactions in few words: of each joint what is not determined, alike joints in one line.

    :param names: as :func:`delta_dynamics.reactions` has them, "JOINT: force along DIRECTION".
    """
    joints: dict[str, dict[str, list[str]]] = {}
    others = []
    for name in names:
        joint, colon, rest = name.rpartition(": ")
        kind, along, direction = rest.partition(" along ")
        if colon and along:
            joints.setdefault(joint, {}).setdefault(kind, []).append(direction)
        else:
            others.append(name)
    alike: dict[str, list[str]] = {}
    for joint, kinds in joints.items():
        words = [f"{kind} {_directions(directions)}".strip() for kind, directions in kinds.items()]
        alike.setdefault(" and ".join(words), []).append(joint)
    return [f"{what} in {_some(names)}" for what, names in alike.items()] + others


def _directions(names: list[str]) -> str:
    """Directions of one joint's forces or moments."""
    if len(names) == 3:
        return "in all directions"
    both = {"across 1", "across 2"} <= set(names)
    words = ["along the axis" if n == "axis" else f"along {n}" for n in names if "across" not in n]
    if both:
        words.append("across the axis")
    elif any("across" in n for n in names):
        words.append("in one direction across the axis")
    return " and ".join(words)


def _some(names: list[str]) -> str:
    """Names, of many the first."""
    if len(names) <= MOST_NAMES:
        return ", ".join(names)
    return f"{', '.join(names[:MOST_NAMES])} and {len(names) - MOST_NAMES} more"


def lines(data: dict[str, Any]) -> list[tuple[str, str]]:
    """The same as pairs of words for a table."""
    pose = ", ".join(f"{name} ({unit})" for name, unit in data["pose"].items())
    joint_units = dict(zip(data["joints"], data["joint_units"], strict=True))
    rows = [
        ("robot", f"{data['name']}: {data['description']}"),
        ("mobility", data["mobility"]),
        ("bodies and rods", ", ".join(data["bodies"])),
        ("loop constraints", _closures(data)),
        ("pose", pose),
        ("actuated joints", ", ".join(f"{name} ({unit})" for name, unit in joint_units.items())),
        ("home pose", _pairs(data["home_pose"], data["pose"])),
        ("home joints", _pairs(data["home_joints"], joint_units)),
        ("singularity index at home", f"{data['singularity_at_home']:.3f} (0 singular, 1 best)"),
    ]
    if (gap := data["clearance_at_home"]) is not None:
        text = f"{1e3 * gap:.3g} mm"
        rows.append(("clearance at home", text if gap > 0.0 else f"{text}: limbs interfere"))
    if data["home_choice"]:
        rows.append(("home", data["home_choice"]))
    grouped = grouped_reactions(data["overconstrained"])
    rows += [("overconstrained", text) for text in grouped] or [
        ("overconstrained", "no: rigid-body equations determine every reaction")
    ]
    found = [Finding(**finding).text for finding in data["plausibility"]]
    rows += [("plausibility", text) for text in found or ["no implausible value"]]
    for section, value in data["parameters"].items():
        if section not in ("mechanism", "name") and not (
            section == "joints" and isinstance(value, list)
        ):
            rows += _rows(section, value, data["parameter_units"].get(section, ""))
    return rows


def _closures(data: dict[str, Any]) -> str:
    """How many equations the loops have, and whether redundant ones are the machine's own.

    A joint that stands for what several limbs hold together repeats what one of them holds alone.
    """
    redundant = data["redundant_closures"]
    text = f"{data['closures']} equations of rank {data['rank']}, {redundant} redundant"
    if redundant and data["assumed_joints"] and not data["overconstrained"]:
        joints = ", ".join(data["assumed_joints"])
        text += f" in the model only, where joint {joints} repeats constraints of the limbs"
    return text


def _rows(name: str, value: Any, unit: Any) -> list[tuple[str, str]]:
    """A parameter, or a section's parameters under its name."""
    if isinstance(value, dict):
        return [row for k, item in value.items() for row in _rows(f"{name}: {k}", item, unit[k])]
    return [(name, "none" if value is None else f"{_number(value)} {unit}".strip())]


def _number(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return "[" + ", ".join(_number(v) for v in value) + "]"
    return str(value)


def _pairs(values: dict[str, float], units: dict[str, str]) -> str:
    # Rounded first, so that nothing reads -0.0000.
    return ", ".join(f"{k} {round(v, 4) + 0.0:.4f} {units[k]}" for k, v in values.items())
