# SPDX-License-Identifier: Apache-2.0
"""A robot's tree as an MJCF file, byte for byte the same.

The model stands at home as it is: every body's frame is parallel to the base there, ``ref`` of a
joint is its value at home. Loops are ``connect`` and ``weld`` constraints.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.machine.simulated import Hung, hang, sound, split
from pkm_twin.machine.urdf_write import (
    GROUND,
    PLATFORM,
    UrdfCapsule,
    UrdfJoint,
    UrdfTree,
    number_text,
)

TIMESTEP: Final = 1e-3
"""s."""
SOLREF: Final = (2.0 * TIMESTEP, 1.0)
"""Time constant, s, and damping ratio of the constraints: as stiff as the time step allows."""
SOLIMP: Final = (0.9999, 0.9999, 0.001)
"""Impedance of the constraints: how little they give way."""
TYPES: Final = {"revolute": "hinge", "prismatic": "slide"}
HOME: Final = "home"
"""The keyframe's name."""


def write_mjcf(
    tree: UrdfTree,
    gravity: Array,
    efforts: Sequence[float] | None = None,
) -> str:
    """The MJCF of a tree.

    Actuators are motors named as their joints, in the robot's order; the site ``platform`` stands
    on the reference point.

    :param gravity: (3,) m/s2.
    :param efforts: of the actuators at the keyframe ``home``, shape (n,), N m or N.
    """
    tree, welds = split(tree)
    hung = hang(tree)
    top = ET.Element("mujoco", model=tree.name)
    ET.SubElement(top, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    ET.SubElement(
        top, "option", gravity=number_text(gravity), timestep=number_text([TIMESTEP]),
        integrator="RK4",
    )  # fmt: skip
    default = ET.SubElement(top, "default")
    ET.SubElement(default, "geom", contype="0", conaffinity="0", group="1", rgba="0.6 0.65 0.7 1")
    ET.SubElement(default, "equality", solref=number_text(SOLREF), solimp=number_text(SOLIMP))
    world = ET.SubElement(top, "worldbody")
    elements, places = {GROUND: world}, {GROUND: np.zeros(3)}
    home: list[float] = []
    for link in _depth_first(hung):
        element = _body(elements[link.parent], link, places[link.parent])
        elements[link.name], places[link.name] = element, link.place
        home += [joint.home for joint in link.joints]
    for capsule in tree.capsules:
        if capsule.body in elements:
            _capsule(elements[capsule.body], capsule, places[capsule.body])
    at = number_text(tree.origin - places[tree.platform])
    ET.SubElement(elements[tree.platform], "site", name=PLATFORM, pos=at, size="0.005")
    loops = ET.SubElement(top, "equality")
    for closure in tree.closures:
        ends = {"body1": closure.parent, "body2": closure.child}
        ends = {key: "world" if name == GROUND else name for key, name in ends.items()}
        if closure.type == "fixed":
            ET.SubElement(loops, "weld", {"name": closure.name, **ends})
        else:
            at = number_text(closure.point - places[closure.parent])
            ET.SubElement(loops, "connect", {"name": closure.name, **ends, "anchor": at})
    for body, part in welds:
        ET.SubElement(loops, "weld", name=f"{part}_weld", body1=body, body2=part)
    for slide, turn, pitch in tree.screws:
        fit = number_text([-pitch * _home(hung, turn) + _home(hung, slide), pitch, 0.0, 0.0, 0.0])
        ET.SubElement(loops, "joint", name=slide, joint1=slide, joint2=turn, polycoef=fit)
    motors = ET.SubElement(top, "actuator")
    for name in tree.actuated:
        ET.SubElement(motors, "motor", name=name, joint=name)
    key = ET.SubElement(ET.SubElement(top, "keyframe"), "key", name=HOME, qpos=number_text(home))
    if efforts is not None:
        key.set("ctrl", number_text(efforts))
    ET.indent(top)
    return ET.tostring(top, encoding="unicode") + "\n"


def _depth_first(hung: list[Hung]) -> list[Hung]:
    """In the order of the file, which is that of MuJoCo's joint positions."""
    children: dict[str, list[Hung]] = {}
    for link in hung:
        children.setdefault(link.parent, []).append(link)
    result: list[Hung] = []
    todo = children.get(GROUND, [])[::-1]
    while todo:
        result.append(todo.pop())
        todo += children.get(result[-1].name, [])[::-1]
    return result


def _body(parent: ET.Element, link: Hung, place: Array) -> ET.Element:
    element = ET.SubElement(parent, "body", name=link.name, pos=number_text(link.place - place))
    body = sound(link.body)
    order = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    ET.SubElement(
        element, "inertial", pos=number_text(body.com - link.place), mass=f"{body.mass:.15g}",
        fullinertia=" ".join(f"{body.inertia[i, k]:.15g}" for i, k in order),
    )  # fmt: skip
    for joint in link.joints:
        ET.SubElement(element, "joint", _joint(joint, link.place))
    return element


def _joint(joint: UrdfJoint, place: Array) -> dict[str, str]:
    drive = joint.drive
    found = {"name": joint.name, "type": TYPES[joint.type], "axis": number_text(joint.axis)}
    if joint.type == "revolute":
        found["pos"] = number_text(joint.point - place)
    if joint.home:
        found["ref"] = number_text([joint.home])
    if drive.position is not None:
        found["range"] = number_text(drive.position)
    if drive.effort is not None:
        found["actuatorfrcrange"] = number_text([-drive.effort, drive.effort])
    for key, value in (
        ("damping", drive.damping),
        ("frictionloss", drive.friction),
        ("armature", drive.rotor_inertia),
    ):
        if value:
            found[key] = number_text([value])
    return found


def _capsule(body: ET.Element, capsule: UrdfCapsule, place: Array) -> None:
    ends = number_text([*(capsule.start - place), *(capsule.end - place)])
    size = number_text([capsule.radius])
    if np.linalg.norm(capsule.end - capsule.start) > 0.0:
        ET.SubElement(body, "geom", type="capsule", fromto=ends, size=size)
    else:
        at = number_text(capsule.start - place)
        ET.SubElement(body, "geom", type="sphere", pos=at, size=size)


def _home(hung: list[Hung], name: str) -> float:
    return next(joint.home for link in hung for joint in link.joints if joint.name == name)
