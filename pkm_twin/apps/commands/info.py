# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin info``: what a robot is, in words and numbers."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final

import numpy as np

from delta_dynamics.torques.reactions import list_undetermined
from pkm_twin.apps.frame import command
from pkm_twin.apps.options import PictureOptions, RobotArgument
from pkm_twin.codegen.code import slowness
from pkm_twin.kinematics.scheme import list_coordinates
from pkm_twin.machine.formulas import PARAMETERS
from pkm_twin.report import Fact, Report, format_number
from pkm_twin.robot.clearance import clearance, has_clearance
from pkm_twin.robot.plausibility import find_implausible_numbers, find_members_fault, why_no_torques

MAX_NAMES: Final = 6
"""Largest number of names in a printed line."""


@dataclass(frozen=True, kw_only=True)
class Info(RobotArgument, PictureOptions):
    """Show a robot's parameters, with units.

    Prints dimensions, masses, limits, home pose and mobility. For an overconstrained mechanism it
    also lists the joint reactions that rigid-body equations do not determine. --picture draws the
    robot at home, with the bodies' centres of mass and the reference point.
    """


@command("Robots")
def info(given: Info) -> Report:
    """Report every parameter, mobility, overconstraint and the home pose."""
    robot = given.machine()
    home = robot.home()
    q = robot.inverse(home)
    engine = robot.engine.mobility
    pose_units = dict(zip(robot.pose_names, robot.pose_units, strict=True))
    joint_units = dict(zip(robot.joint_names, robot.joint_units, strict=True))
    home_pose = dict(zip(robot.pose_names, home.tolist(), strict=True))
    home_joints = dict(zip(robot.joint_names, q.tolist(), strict=True))
    bodies = list(robot.body_names[:-1])
    assumed = [joint.name for joint in robot.graph.joints.values() if joint.virtual]
    undetermined = list_undetermined(robot)
    gap = float(clearance(robot, home)) if has_clearance(robot) else None
    implausible, fault = find_implausible_numbers(robot), find_members_fault(robot)
    equations = f"{engine.closures} loop equations, {engine.rank} independent"
    if engine.redundant and assumed and not undetermined:
        # A joint that replaces equal constraints of several limbs repeats those of one limb.
        equations += f"; in the model joint {', '.join(assumed)} repeats constraints of the limbs"
    sections, units = robot.parameter_sections(), robot.parameter_units()
    if robot.book.values:
        numbers = robot.file_numbers()
        sections[PARAMETERS] = dict(robot.book.values)
        units[PARAMETERS] = {n: numbers[f"{PARAMETERS}.{n}"][1] for n in robot.book.values}
    other_poses = []
    if robot.mechanism == "machine":
        found = [list(names) for names in list_coordinates(robot.graph) if names != robot.pose_names]
        shown = "; ".join(", ".join(names) for names in found[:MAX_NAMES])
        shown += f" and {len(found) - MAX_NAMES} more" if len(found) > MAX_NAMES else ""
        text = "other pose coordinates" if found else None
        other_poses = [Fact("other_poses", found, text=text, shown=f"{shown} (`pose`, --pose)")]
    # Independent drives of a machine with more actuated joints than degrees of freedom.
    leads = list(robot.graph.leads)
    facts = [
        Fact("name", robot.name),
        Fact("mechanism", robot.mechanism),
        Fact("description", robot.description),
        Fact("mobility", robot.mobility, text="mobility"),
        Fact("bodies", bodies, text="bodies and rods"),
        Fact("joint_count", len(robot.graph.joints)),
        Fact("closures", engine.closures, text="loop constraints", shown=equations),
        Fact("rank", engine.rank),
        Fact("redundant_closures", engine.redundant),
        Fact("assumed_joints", assumed),
        Fact("pose", pose_units, text="pose", shown=_list_units(pose_units)),
        *other_poses,
        Fact("joints", list(robot.joint_names), text="actuated joints", shown=_list_units(joint_units)),
        *([Fact("leads", leads, text="joints that lead")] if robot.redundant else []),
        Fact("joint_unit", robot.joint_unit),
        Fact("joint_units", list(robot.joint_units)),
        Fact("effort_unit", None if why_no_torques(robot) else robot.effort_unit),
        Fact("home_pose", home_pose, text="home pose", shown=_write_values(home_pose, pose_units)),
        Fact("home_joints", home_joints, text="home joints", shown=_write_values(home_joints, joint_units)),
        Fact(
            "singularity_at_home",
            value := float(robot.singularity(q)),
            text="singularity index at home",
            shown=f"{value:.3f} (0 singular, 1 best)",
        ),
        Fact(
            "clearance_at_home",
            gap,
            text=None if gap is None else "clearance at home",
            shown="" if gap is None else f"{1e3 * gap:.3g} mm" + ("" if gap > 0.0 else ": limbs interfere"),
        ),
        Fact("home_choice", robot.home_choice or None, text="home" if robot.home_choice else None),
        Fact("overconstrained", undetermined),
        *(
            Fact("", text, text="overconstrained")
            for text in group_reactions(undetermined) or ["no: rigid-body equations determine every reaction"]
        ),
        Fact("plausibility", [dataclasses.asdict(finding) for finding in implausible]),
        *(
            Fact("", text, text="plausibility")
            for text in [*(one.text for one in implausible), *[fault] * bool(fault)] or ["no implausible value"]
        ),
        Fact("members_fault", fault or None),
        Fact("speed", slowness() or None, text="speed" if slowness() else None),
        Fact("parameters", sections),
        Fact("parameter_units", units),
        *(Fact("", text, text="parameter") for text in robot.book.describe(units.get(PARAMETERS))),
    ]
    for section, value in sections.items():
        listed = section == "joints" and isinstance(value, list)
        if section not in ("mechanism", "name", PARAMETERS) and not listed:
            facts += _report_parameters(section, value, units.get(section, ""))
    places = np.array([robot.graph.joints[name].at for name in robot.joint_names])
    notes = []
    # Note drives within 2 % of the machine's size, which the picture shows at one point.
    if given.picture and len(places) > 1 and np.ptp(places, axis=0).max() <= 0.02 * robot.graph.size:
        notes.append(
            f"{', '.join(robot.joint_names)} stand at one point in the picture: give each joint's `at` "
            "a point of its own along its axis, which changes nothing else"
        )
    return Report(
        f"{robot.name}: {robot.description}",
        facts,
        figures={"": lambda: import_module("pkm_twin.view.drawing").draw(robot, marked=True)},
        notes=notes,
    )


def group_reactions(names: Sequence[str]) -> list[str]:
    """Describe undetermined reactions: one line for all joints with the same undetermined components.

    :param names: components of :func:`delta_dynamics.reactions`, "JOINT: force along DIRECTION".
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
        words = []
        for kind, directions in kinds.items():
            if len(directions) == 3:
                words.append(f"{kind} in all directions")
                continue
            known = ["along the axis" if n == "axis" else f"along {n}" for n in directions if "across" not in n]
            if {"across 1", "across 2"} <= set(directions):
                known.append("across the axis")
            elif any("across" in n for n in directions):
                known.append("in one direction across the axis")
            words.append(f"{kind} {' and '.join(known)}".strip())
        alike.setdefault(" and ".join(words), []).append(joint)
    lines = []
    for what, joined in alike.items():
        more = f" and {len(joined) - MAX_NAMES} more" if len(joined) > MAX_NAMES else ""
        lines.append(f"{', '.join(joined[:MAX_NAMES])}{more}: not determined: {what}")
    return lines + others


def _report_parameters(name: str, value: Any, unit: Any) -> Iterator[Fact]:
    """Yield a parameter, or a section's parameters under its name."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _report_parameters(f"{name}: {key}", item, unit[key])
    else:
        shown = "none" if value is None else f"{format_number(value, '.6g')} {unit}".strip()
        yield Fact("", value, text=name, shown=shown)


def _list_units(units: dict[str, str]) -> str:
    return ", ".join(f"{name} ({unit})" for name, unit in units.items())


def _write_values(values: dict[str, float], units: dict[str, str]) -> str:
    # Round first and add zero, so that no number is written as -0.0000.
    return ", ".join(f"{k} {round(v, 4) + 0.0:.4f} {units[k]}" for k, v in values.items())
