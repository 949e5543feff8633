# SPDX-License-Identifier: Apache-2.0
"""A tree of bodies and single joints as a URDF that every parser reads, byte for byte the same.

All is given at home, in base axes: every link's frame stands on its joint, parallel to the base
at home, and a joint at home has the value ``home``. Loops that the tree cuts are ``<constraint>``
elements (urdfdom pull request 264), which parsers of trees pass over; ``cylindrical_joint``,
``translation_joint``, ``<dynamics>`` and ``angle`` (between a universal joint's axes, rad, where it
is not a right one) are additions to that proposal.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.machine import rotations
from pkm_twin.machine.urdf_control import Control, add_drives
from pkm_twin.machine.urdf_xml import UNLIMITED

GROUND: Final = "base_link"
"""The root link's name."""
MOCK: Final = "mock_components/GenericSystem"
"""The hardware of ros2_control that needs none."""
PLATFORM: Final = "platform"
"""The link that stands on the platform's reference point."""
NAMED: Final = ("link", "joint", "constraint", "ros2_control")
"""Elements whose name is of one machine; those of interfaces and parameters are not."""


@dataclass(frozen=True, eq=False)
class UrdfBody:
    """A link: ``mass`` (kg), ``com`` (3,) m, ``inertia`` (3, 3) about it, base axes at home."""

    name: str
    mass: float
    com: Array
    inertia: Array


@dataclass(frozen=True, eq=False)
class UrdfDrive:
    """Limits of a joint, None where there is none, and its friction per rate and dry.

    ``rotor_inertia``: kg m2 or kg, at the joint; ``offset``: constant friction.
    """

    position: tuple[float, float] | None = None
    velocity: float | None = None
    effort: float | None = None
    damping: float = 0.0
    friction: float = 0.0
    rotor_inertia: float = 0.0
    offset: float = 0.0


@dataclass(frozen=True, eq=False)
class UrdfJoint:
    """A joint of the tree, one axis or none: ``point`` (3,) m and ``axis`` (3,), base axes at home.

    ``type``: revolute, prismatic or fixed. ``home``: its value at home.
    """

    name: str
    type: str
    parent: str
    child: str
    point: Array
    axis: Array
    home: float = 0.0
    drive: UrdfDrive = field(default_factory=UrdfDrive)


@dataclass(frozen=True, eq=False)
class UrdfClosure:
    """A joint between two links that the tree leaves out; ``axes``: (count, 3), base axes.

    A joint of one freedom has its value at home, and what resists it.
    """

    name: str
    type: str
    parent: str
    child: str
    point: Array
    axes: Array
    home: float = 0.0
    drive: UrdfDrive = field(default_factory=UrdfDrive)


@dataclass(frozen=True, eq=False)
class UrdfCapsule:
    """A bar to look at, from ``start`` to ``end``, (3,) m, base axes at home."""

    body: str
    start: Array
    end: Array
    radius: float


@dataclass(frozen=True, eq=False)
class UrdfTree:
    """A machine as a tree of links; joints from the ground outwards, each child once.

    ``actuated``: joints, in the robot's order. ``platform``: the body that carries the tool;
    ``origin``: its reference point at home, (3,). ``screws``: slide, turn and pitch (m a rad) of
    joints of which the slide follows the turn.
    """

    name: str
    bodies: tuple[UrdfBody, ...]
    joints: tuple[UrdfJoint, ...]
    closures: tuple[UrdfClosure, ...]
    capsules: tuple[UrdfCapsule, ...]
    actuated: tuple[str, ...]
    platform: str
    origin: Array
    screws: tuple[tuple[str, str, float], ...] = ()


def write_urdf(
    tree: UrdfTree, hardware: str = MOCK, prefix: str = "", controls: Iterable[Control] = ()
) -> str:
    """The URDF of a tree.

    The root is ``base_link``; ``platform`` is a link without mass on the reference point, fixed
    to the platform's body.

    :param hardware: plugin of the ``<ros2_control>`` element, empty: no such element.
    :param controls: what a controller calls the actuated joints, for the ``<ros2_control>``
        element, see :mod:`pkm_twin.machine.urdf_control`.
    :param prefix: of the names of all links, joints and closures, for several machines in one file.
    """
    robot = ET.Element("robot", name=tree.name)
    places = {GROUND: np.zeros(3)} | {joint.child: joint.point for joint in tree.joints}
    ground = ET.SubElement(robot, "link", name=GROUND)
    _shapes(ground, places[GROUND], (c for c in tree.capsules if c.body == GROUND))
    for body in tree.bodies:
        link = ET.SubElement(robot, "link", name=body.name)
        _inertial(link, body, places[body.name])
        _shapes(link, places[body.name], (c for c in tree.capsules if c.body == body.name))
    ET.SubElement(robot, "link", name=PLATFORM)
    for joint in tree.joints:
        _joint(robot, joint, places)
    tool = UrdfJoint(
        f"{PLATFORM}_frame", "fixed", tree.platform, PLATFORM, tree.origin, np.zeros(3)
    )
    _joint(robot, tool, places)
    for closure in tree.closures:
        _closure(robot, closure, places)
    if hardware:
        _control(robot, tree, hardware)
        add_drives(robot, controls)
    if prefix:
        for element in robot.iter():
            for key in ("name", "link", "joint"):
                if key in element.attrib and (key != "name" or element.tag in NAMED):
                    element.set(key, prefix + element.attrib[key])
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def _inertial(link: ET.Element, body: UrdfBody, place: Array) -> None:
    # Also where there is no mass: some simulators take a kilogram for what is not said.
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=number_text(body.com - place), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=f"{body.mass:.15g}")
    keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    upper = body.inertia[np.triu_indices(3)]
    # Rounding that turned axes leave behind says nothing.
    upper = np.where(np.abs(upper) > 1e-14 * float(np.abs(upper).max()), upper, 0.0)
    values = {key: f"{value:.12g}" for key, value in zip(keys, upper, strict=True)}
    ET.SubElement(inertial, "inertia", values)


def _shapes(link: ET.Element, place: Array, capsules: Iterable[UrdfCapsule]) -> None:
    """Bars to look at, which are also what must not collide."""
    round_ends: list[Array] = []
    for capsule in capsules:
        along = capsule.end - capsule.start
        length = float(np.linalg.norm(along))
        radius = number_text([capsule.radius])
        shapes = [("sphere", capsule.start, "0 0 0"), ("sphere", capsule.end, "0 0 0")]
        if length > 0.0:
            centre = (capsule.start + capsule.end) / 2
            shapes.insert(0, ("cylinder", centre, rpy_along(along / length)))
        for shape, centre, rpy in shapes:
            if shape == "sphere" and any(np.array_equal(centre, other) for other in round_ends):
                continue
            if shape == "sphere":
                round_ends.append(centre)
            size = {"radius": radius}
            if shape == "cylinder":
                size["length"] = number_text([length])
            for purpose in ("visual", "collision"):
                element = ET.SubElement(link, purpose)
                ET.SubElement(element, "origin", xyz=number_text(centre - place), rpy=rpy)
                ET.SubElement(ET.SubElement(element, "geometry"), shape, size)


def rpy_along(direction: Array) -> str:
    """Roll, pitch and yaw of axes whose z is a unit vector."""
    # Snapped, so that an angle does not hang on the sign of what is nearly zero.
    x, y, z = np.round(direction, 12) + 0.0
    return number_text([0.0, math.atan2(math.hypot(x, y), z), math.atan2(y, x)])


def _joint(robot: ET.Element, joint: UrdfJoint, places: dict[str, Array]) -> None:
    element = ET.SubElement(robot, "joint", name=joint.name, type=joint.type)
    xyz, rpy = joint.point - places[joint.parent], np.zeros(3)
    # The joint's frame is where the child stands at the value zero.
    if joint.type == "prismatic":
        xyz = xyz - joint.axis * joint.home
    elif joint.type == "revolute":
        rpy = rotations.to_rpy(rotations.about(joint.axis, -joint.home))
    ET.SubElement(element, "origin", xyz=number_text(xyz), rpy=number_text(rpy))
    ET.SubElement(element, "parent", link=joint.parent)
    ET.SubElement(element, "child", link=joint.child)
    if joint.type == "fixed":
        return
    ET.SubElement(element, "axis", xyz=number_text(joint.axis))
    free, drive = UNLIMITED[joint.type], joint.drive
    low, high = drive.position or (-free, free)
    ET.SubElement(
        element,
        "limit",
        lower=number_text([low]),
        upper=number_text([high]),
        velocity=number_text([UNLIMITED["velocity"] if drive.velocity is None else drive.velocity]),
        effort=number_text([UNLIMITED["effort"] if drive.effort is None else drive.effort]),
    )
    _dynamics(element, drive)


def _dynamics(element: ET.Element, drive: UrdfDrive) -> None:
    if drive.damping or drive.friction:
        damping, friction = number_text([drive.damping]), number_text([drive.friction])
        ET.SubElement(element, "dynamics", damping=damping, friction=friction)


def _closure(robot: ET.Element, closure: UrdfClosure, places: dict[str, Array]) -> None:
    kind = "link" if closure.type == "fixed" else f"{closure.type}_joint"
    element = ET.SubElement(robot, "constraint", name=closure.name, type=kind)
    for i, (end, link) in enumerate((("parent", closure.parent), ("child", closure.child))):
        ET.SubElement(element, end, link=link)
        at = number_text(closure.point - places[link])
        ET.SubElement(element, f"{end}_origin", xyz=at, rpy="0 0 0")
        if len(closure.axes):
            axis = closure.axes[min(i, len(closure.axes) - 1)]
            ET.SubElement(element, f"{end}_axis", xyz=number_text(axis))
    _dynamics(element, closure.drive)
    if len(closure.axes) == 2:
        cosine = float(np.clip(closure.axes[0] @ closure.axes[1], -1.0, 1.0))
        if abs(cosine) > 1e-12:
            element.set("angle", number_text([math.acos(cosine)]))


def _control(robot: ET.Element, tree: UrdfTree, plugin: str) -> None:
    control = ET.SubElement(robot, "ros2_control", name=tree.name, type="system")
    hardware = ET.SubElement(control, "hardware")
    ET.SubElement(hardware, "plugin").text = plugin
    joints = {joint.name: joint for joint in tree.joints}
    for name in tree.actuated:
        element = ET.SubElement(control, "joint", name=name)
        for interface in ("position", "effort"):
            ET.SubElement(element, "command_interface", name=interface)
        position = ET.SubElement(element, "state_interface", name="position")
        start = _start(joints[name].home, joints[name].drive)
        ET.SubElement(position, "param", name="initial_value").text = number_text([start])
        for interface in ("velocity", "effort"):
            ET.SubElement(element, "state_interface", name=interface)
        drive = joints[name].drive
        for key, value in (
            ("rotor_inertia", drive.rotor_inertia),
            ("friction_offset", drive.offset),
        ):
            if value:
                ET.SubElement(element, "param", name=key).text = number_text([value])


def _start(home: float, drive: UrdfDrive) -> float:
    """Where mock hardware begins: at home, or amid the limits where these leave home out."""
    limits = drive.position
    if limits is None or limits[0] <= home <= limits[1]:
        return home
    return (limits[0] + limits[1]) / 2


def number_text(values: Iterable[float], least: float = 1e-13) -> str:
    """Numbers to 14 digits, so that the last bits of another machine's arithmetic do not show.

    Vectors to 14 decimals too: a short component may be a difference of longer ones.
    """
    row = [float(value) for value in values]
    if len(row) > 1:
        row = [round(value, 14) for value in row]
    return " ".join(f"{value:.14g}" if abs(value) > least else "0" for value in row)
