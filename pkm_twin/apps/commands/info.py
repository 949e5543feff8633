# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin info``: what a robot is, in words and numbers."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from delta_dynamics import reactions
from pkm_twin.apps.frame import command
from pkm_twin.apps.options import Draws, OfRobot
from pkm_twin.codegen.code import slowness
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.scheme import list_coordinates
from pkm_twin.machine.formulas import PARAMETERS
from pkm_twin.machine.members import RigidError
from pkm_twin.report import Fact, Report, number
from pkm_twin.robot.clearance import clearance, has_clearance
from pkm_twin.robot.plausibility import findings, why_no_torques
from pkm_twin.robot.robot import Robot

DRAWN_APART: Final = 0.02
"""Distance of drives, of the machine's size, up to which a picture shows them at one point."""
MOST_NAMES: Final = 6
"""Most names that a line has."""


@dataclass(frozen=True, kw_only=True)
class Info(OfRobot, Draws):
    """Show a robot's parameters, with units.

    Prints dimensions, masses, limits, home pose and mobility. For an overconstrained mechanism it
    also lists the joint reactions that rigid-body equations do not determine. --picture draws the
    robot at home, with the bodies' centres of mass and the reference point.
    """


def _report_leading(robot: Robot) -> list[Fact]:
    """Of more actuated joints than degrees of freedom those that lead."""
    leads = list(robot.graph.leads)
    return [Fact("leads", leads, text="joints that lead")] if robot.redundant else []


def _other_poses(robot: Robot) -> list[Fact]:
    """Return other sets of pose coordinates that a file of bodies and joints may have."""
    if robot.mechanism != "machine":
        return []
    found = [list(names) for names in list_coordinates(robot.graph) if names != robot.pose_names]
    shown = "; ".join(", ".join(names) for names in found[:MOST_NAMES])
    shown += f" and {len(found) - MOST_NAMES} more" if len(found) > MOST_NAMES else ""
    text = "other pose coordinates" if found else None
    return [Fact("other_poses", found, text=text, shown=f"{shown} (`pose`, --pose)")]


def info(given: Info) -> Report:
    """Every parameter, mobility, overconstraint and the home pose."""
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
    undetermined = overconstraint(robot)
    gap = float(clearance(robot, home)) if has_clearance(robot) else None
    odd, fault = findings(robot), members_fault(robot)
    equations = f"{engine.closures} loop equations, {engine.rank} independent"
    if engine.redundant and assumed and not undetermined:
        # A joint that stands for what several limbs hold repeats what one of them holds alone.
        equations += f"; in the model joint {', '.join(assumed)} repeats constraints of the limbs"
    sections, units = robot.parameter_sections(), robot.parameter_units()
    if robot.book.values:
        numbers = robot.file_numbers()
        sections[PARAMETERS] = dict(robot.book.values)
        units[PARAMETERS] = {n: numbers[f"{PARAMETERS}.{n}"][1] for n in robot.book.values}
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
        *_other_poses(robot),
        Fact("joints", list(robot.joint_names), text="actuated joints", shown=_list_units(joint_units)),
        *_report_leading(robot),
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
            for text in grouped_reactions(undetermined) or ["no: rigid-body equations determine every reaction"]
        ),
        Fact("plausibility", [dataclasses.asdict(finding) for finding in odd]),
        *(
            Fact("", text, text="plausibility")
            for text in [*(one.text for one in odd), *[fault] * bool(fault)] or ["no implausible value"]
        ),
        Fact("members_fault", fault or None),
        Fact("speed", slowness() or None, text="speed" if slowness() else None),
        Fact("parameters", sections),
        Fact("parameter_units", units),
        *(Fact("", text, text="parameter") for text in robot.book.told(units.get(PARAMETERS))),
    ]
    for section, value in sections.items():
        listed = section == "joints" and isinstance(value, list)
        if section not in ("mechanism", "name", PARAMETERS) and not listed:
            facts += _report_parameters(section, value, units.get(section, ""))
    return Report(
        f"{robot.name}: {robot.description}",
        facts,
        figures={"": lambda: _draw_robot(robot)},
        notes=_note_joints_at_one_point(robot) if given.picture else [],
    )


def _note_joints_at_one_point(robot: Robot) -> list[str]:
    """Return a note on how to draw a machine apart whose drives' joints stand at one point."""
    places = np.array([robot.graph.joints[name].at for name in robot.joint_names])
    if len(places) < 2 or np.ptp(places, axis=0).max() > DRAWN_APART * robot.graph.size:
        return []
    return [
        f"{', '.join(robot.joint_names)} stand at one point in the picture: give each joint's `at` "
        "a point of its own along its axis, which changes nothing else"
    ]


def members_fault(robot: Robot) -> str:
    """Why maps reject the members that the file gives; empty where they do not, or it has none."""
    try:
        robot.structure()
    except RigidError:
        return ""
    except ParameterError as error:
        return str(error)
    return ""


def _draw_robot(robot: Robot) -> Any:
    from pkm_twin.view.drawing import draw

    return draw(robot, marked=True)


def overconstraint(robot: Robot) -> list[str]:
    """Name what rigid-body statics cannot determine; empty if it determines all."""
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
    return [f"{_shorten(names)}: not determined: {what}" for what, names in alike.items()] + others


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


def _shorten(names: list[str]) -> str:
    """Names, of many the first."""
    if len(names) <= MOST_NAMES:
        return ", ".join(names)
    return f"{', '.join(names[:MOST_NAMES])} and {len(names) - MOST_NAMES} more"


def _report_parameters(name: str, value: Any, unit: Any) -> Iterator[Fact]:
    """Yield a parameter, or a section's parameters under its name."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _report_parameters(f"{name}: {key}", item, unit[key])
    else:
        shown = "none" if value is None else f"{number(value, '.6g')} {unit}".strip()
        yield Fact("", value, text=name, shown=shown)


def _list_units(units: dict[str, str]) -> str:
    return ", ".join(f"{name} ({unit})" for name, unit in units.items())


def _write_values(values: dict[str, float], units: dict[str, str]) -> str:
    # Rounded first, so that nothing reads -0.0000.
    return ", ".join(f"{k} {round(v, 4) + 0.0:.4f} {units[k]}" for k, v in values.items())


COMMAND = command(info, "Robots")
