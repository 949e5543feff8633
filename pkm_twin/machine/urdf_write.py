# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write a tree of links and joints as a URDF that every parser reads; the same tree gives the same bytes.

The machine is drawn at home: every link's frame stands on its joint, parallel to the base there. A
joint of several freedoms is written as joints of one axis, with links without mass between. Loops
that the tree cuts are ``<constraint>`` elements (urdfdom pull request 264), which parsers of trees
ignore; ``cylindrical_joint``, ``translation_joint``, ``<dynamics>`` and ``angle`` (between a
universal joint's axes, rad, where it is not a right one) are additions to that proposal.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.machine import rotations, urdf_xml
from pkm_twin.machine.loop_tree import Joint, Link, LoopTree, SingleAxisJoint, list_screws, split_freedoms
from pkm_twin.machine.rotations import Pose
from pkm_twin.machine.urdf_control import Control, tree_names
from pkm_twin.machine.urdf_xml import UNLIMITED

GROUND: Final = "base_link"
"""The root link's name."""
MOCK_HARDWARE: Final = "mock_components/GenericSystem"
"""The ros2_control plugin that simulates ideal hardware."""
PLATFORM: Final = "platform"
"""The link that stands on the platform's reference point."""


def write_urdf(
    tree: LoopTree, hardware: str = MOCK_HARDWARE, prefix: str = "", controls: Iterable[Control] = ()
) -> str:
    """Write the URDF of a tree.

    The root is ``base_link``; ``platform`` is a link without mass on the reference point, fixed
    to the platform's body.

    :param hardware: plugin of the ``<ros2_control>`` element, empty: no such element.
    :param controls: what a controller calls the actuated joints, for the ``<ros2_control>``
        element, see :mod:`pkm_twin.machine.urdf_control`.
    :param prefix: of the names of all links, joints and closures, for several machines in one file.
    """
    robot = ET.Element("robot", name=tree.name)
    parts = list_single_joints(tree)
    places = {name: link.frame.position for name, link in tree.links.items()}
    _write_shapes(ET.SubElement(robot, "link", name=GROUND), tree, GROUND)
    for part in parts:
        at = places.setdefault(part.child, part.joint.at)
        link = ET.SubElement(robot, "link", name=part.child)
        if part.child != PLATFORM:
            _write_inertial(link, tree.links.get(part.child, Link(part.child, com=at)), at)
            _write_shapes(link, tree, part.child)
    drives = {c.joint: c for c in controls} if hardware else {}
    names = tree_names((part.name for part in parts), drives.values())
    elements = {part.name: _write_joint(robot, part, places) for part in parts}
    for name, element in elements.items():
        element.set("name", names[name])
    for slide, turn, *line in list_screws(parts):
        _write_mimic(elements[slide], names[turn], *line)
    for closure in tree.closures:
        _write_closure(robot, closure, places)
    for part in parts:
        if part.name not in drives or drives[part.name].matches_model:
            continue
        # The controller's joint, with a link without mass; the tree's joint follows it.
        control = drives[part.name]
        name = urdf_xml.free_name(f"{control.name}_drive", {PLATFORM, *places})
        places[name] = part.joint.at
        limits = control.limits(part.joint.limits, part.kind)
        joint = replace(part.joint, name=control.name, drawn=0.0, viscous=0.0, coulomb=0.0, limits=limits)
        # A motor rotates; only a controller that counts the metres of a slide has a slide.
        slides = part.kind == "prismatic" and abs(control.factor) == 1.0
        kind = "prismatic" if slides else "revolute"
        _write_joint(robot, SingleAxisJoint(control.name, kind, part.axis, part.parent, name, joint), places)
        ET.SubElement(robot, "link", name=name)
        back = control.inverse()
        _write_mimic(elements[part.name], control.name, back.factor, back.offset)
    if hardware:
        _write_control(robot, tree, hardware, drives)
    if prefix:
        # Names of interfaces and parameters are the same in all machines.
        named = ("link", "joint", "constraint", "ros2_control")
        for element in robot.iter():
            for key in ("name", "link", "joint"):
                if key in element.attrib and (key != "name" or element.tag in named):
                    element.set(key, prefix + element.attrib[key])
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def list_single_joints(tree: LoopTree) -> list[SingleAxisJoint]:
    """List the joints of the URDF, from the ground outwards; the last leads to ``platform``."""
    place, taken = Pose(position=tree.origin), {PLATFORM, *tree.links}
    tool = Joint(f"{PLATFORM}_frame", "fixed", tree.platform, PLATFORM, (place, place))
    hung = (*tree.tree_joints, (tool, tree.platform, PLATFORM))
    return [part for one in hung for part in split_freedoms(*one, taken)]


def _write_inertial(link: ET.Element, body: Link, place: Array) -> None:
    # Written for massless links too: some simulators assume 1 kg for a missing inertia.
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=number_text(body.com - place), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=f"{body.mass:.15g}")
    keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    upper = body.inertia[np.triu_indices(3)]
    # Drop the rounding error of rotated axes.
    upper = np.where(np.abs(upper) > 1e-14 * float(np.abs(upper).max()), upper, 0.0)
    values = {key: f"{value:.12g}" for key, value in zip(keys, upper, strict=True)}
    ET.SubElement(inertial, "inertia", values)


def _write_shapes(link: ET.Element, tree: LoopTree, name: str) -> None:
    """Write bars, which are both the picture and the collision geometry."""
    round_ends: list[Array] = []
    for capsule in [one for one in tree.capsules if one.link == name]:
        place = tree.links[name].frame.position
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
    """Return roll, pitch and yaw, as text, of axes whose z is a unit vector."""
    # Rounded, so that an angle does not depend on the sign of a rounding error.
    x, y, z = np.round(direction, 12) + 0.0
    return number_text([0.0, math.atan2(math.hypot(x, y), z), math.atan2(y, x)])


def _write_joint(robot: ET.Element, part: SingleAxisJoint, places: Mapping[str, Array]) -> ET.Element:
    element = ET.SubElement(robot, "joint", name=part.name, type=part.kind)
    xyz, rpy = part.joint.at - places[part.parent], np.zeros(3)
    # The joint's frame is where the child stands at the value zero.
    if part.kind == "prismatic":
        xyz = xyz - part.axis * part.home
    elif part.kind == "revolute":
        rpy = rotations.to_rpy(rotations.axis_rotation(part.axis, -part.home))
    ET.SubElement(element, "origin", xyz=number_text(xyz), rpy=number_text(rpy))
    ET.SubElement(element, "parent", link=part.parent)
    ET.SubElement(element, "child", link=part.child)
    if part.kind == "fixed":
        return element
    ET.SubElement(element, "axis", xyz=number_text(part.axis))
    limits = part.joint.limits if part.is_only_freedom else {}
    free = UNLIMITED[part.kind]
    low, high = limits.get("position", (-free, free))
    bounds = {"lower": low, "upper": high}
    bounds |= {key: limits.get(key, UNLIMITED[key]) for key in ("velocity", "effort")}
    ET.SubElement(element, "limit", {key: number_text([v]) for key, v in bounds.items()})
    if part.is_only_freedom:
        _write_dynamics(element, part.joint)
    return element


def _write_mimic(follower: ET.Element, joint: str, factor: float, offset: float) -> None:
    numbers = {"multiplier": repr(factor), "offset": repr(offset + 0.0)}
    ET.SubElement(follower, "mimic", {"joint": joint, **numbers})


def _write_dynamics(element: ET.Element, joint: Joint) -> None:
    if joint.viscous or joint.coulomb:
        damping, friction = number_text([joint.viscous]), number_text([joint.coulomb])
        ET.SubElement(element, "dynamics", damping=damping, friction=friction)


def _write_closure(robot: ET.Element, closure: Joint, places: Mapping[str, Array]) -> None:
    kind = "link" if closure.kind == "fixed" else f"{closure.kind}_joint"
    element = ET.SubElement(robot, "constraint", name=closure.name, type=kind)
    for i, (end, link) in enumerate((("parent", closure.inner), ("child", closure.outer))):
        ET.SubElement(element, end, link=link)
        at = number_text(closure.at - places[link])
        ET.SubElement(element, f"{end}_origin", xyz=at, rpy="0 0 0")
        if len(closure.axes):
            axis = closure.axes[min(i, len(closure.axes) - 1)]
            ET.SubElement(element, f"{end}_axis", xyz=number_text(axis))
    _write_dynamics(element, closure)
    if len(closure.axes) == 2:
        cosine = float(np.clip(closure.axes[0] @ closure.axes[1], -1.0, 1.0))
        if abs(cosine) > 1e-12:
            element.set("angle", number_text([math.acos(cosine)]))


def _write_control(robot: ET.Element, tree: LoopTree, plugin: str, drives: Mapping[str, Control]) -> None:
    system = ET.SubElement(robot, "ros2_control", name=tree.name, type="system")
    hardware = ET.SubElement(system, "hardware")
    ET.SubElement(hardware, "plugin").text = plugin
    for name in tree.actuated:
        joint, control = tree.joints[name], drives.get(name, Control(name, name, 1.0, 0.0))
        element = ET.SubElement(system, "joint", name=control.name)
        for interface in ("position", "effort"):
            ET.SubElement(element, "command_interface", name=interface)
        position = ET.SubElement(element, "state_interface", name="position")
        # Mock hardware begins at home, or in the middle of limits that exclude home.
        low, high = joint.limits.get("position", (-math.inf, math.inf))
        start = joint.drawn if low <= joint.drawn <= high else float(low + high) / 2
        ET.SubElement(position, "param", name="initial_value").text = number_text([control.value("", start)])
        for interface in ("velocity", "effort"):
            ET.SubElement(element, "state_interface", name=interface)
        for key, value in (("rotor_inertia", joint.rotor_inertia), ("friction_offset", joint.offset)):
            if value:
                text = number_text([control.value(key, value)])
                ET.SubElement(element, "param", name=key).text = text


def number_text(values: Iterable[float], least: float = 1e-13) -> str:
    """Write numbers with 14 digits, which are the same on every computer.

    Vectors have 14 decimals at most: a short component may be a difference of longer ones.
    """
    row = [float(value) for value in values]
    if len(row) > 1:
        row = [round(value, 14) for value in row]
    return " ".join(f"{value:.14g}" if abs(value) > least else "0" for value in row)
