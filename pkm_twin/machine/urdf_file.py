# SPDX-License-Identifier: Apache-2.0
"""A URDF file as it stands: links, joints and loop closures, each in its own frames."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, UnknownNameError, warn
from pkm_twin.machine import sdf_file, urdf_loops, urdf_xml
from pkm_twin.machine.loop_tree import Closure, Joint, Link, LoopTree, drawn
from pkm_twin.machine.motors import actuated_joints, read_beside
from pkm_twin.machine.urdf_xml import Pose

_PLACES: Final = ("axis", "parent_axis", "child_axis")
LARGE: Final = 10.0
"""Offsets beyond this, m, look like millimetres."""

JOINTS: Final = ("revolute", "continuous", "prismatic", "fixed", "spherical")


def read(path: Path, robot: ET.Element) -> LoopTree:
    """The links, joints and closures of a URDF file.

    :param robot: the file's top element; the path is for what stands beside the file.
    :raises ParameterError: not readable, not a URDF, or an element that is refused, by name.
    """
    if robot.tag != "robot":
        raise ParameterError(str(path), f"<{robot.tag}>", "a <robot> element at the top")
    if any(str(child.tag).startswith("xacro:") for child in robot):
        raise ParameterError(str(path), "xacro elements", "a URDF: run xacro on this file first")
    links: dict[str, Link] = {}
    for element in robot.findall("link"):
        name = urdf_xml.name(element, links)
        links[name] = _link(element, name)
    if not links:
        raise ParameterError(str(path), "no <link>", "a robot with links")
    joints: dict[str, Joint] = {}
    for element in robot.findall("joint"):
        name = urdf_xml.name(element, joints)
        joints[name] = _joint(element, name, links)
    root = _root(links, joints)
    for element in robot.findall("coupling"):
        raise ParameterError(
            f"coupling.{element.get('name')}", "a gear", "a machine without coupled joints"
        )
    beside = read_beside(path)
    joints = _retyped(joints, beside)
    closures = urdf_loops.closures(
        robot, beside, links, {name: joint.child for name, joint in joints.items()}
    )
    closures |= _of_gazebo(path, robot, joints, root, {*joints, *closures})
    _warn_of_units(path, robot, joints, closures)
    actuated = actuated_joints(
        path, robot, beside, {name: joint.type for name, joint in joints.items()}
    )
    name = robot.get("name") or path.stem
    initial = _parameters(robot, actuated, "initial_value")
    rotors = _parameters(robot, actuated, "rotor_inertia")
    offsets = _parameters(robot, actuated, "friction_offset")
    for joint in [joints[key] for key in (*rotors, *offsets)]:
        joints[joint.name] = replace(
            joint,
            rotor_inertia=rotors.get(joint.name, 0.0),
            offset=offsets.get(joint.name, 0.0),
        )
    return LoopTree(
        name, root, links, joints, tuple(closures.values()), actuated, initial=initial,
        accuracy=urdf_xml.accuracy(
            word for e in robot.iter() if e.tag in _PLACES or "origin" in e.tag
            for key in ("xyz", "rpy") for word in e.get(key, "").split()
        ),
    )  # fmt: skip


def _of_gazebo(
    path: Path, robot: ET.Element, joints: Mapping[str, Joint], root: str, taken: set[str]
) -> dict[str, Closure]:
    """Joints of SDF inside ``<gazebo>``, and links that its plugins hold together, by name.

    :param taken: names of joints and closures; those of these are added.
    """
    places = drawn(root, joints)

    def turn(frame: str) -> Array:
        return places[frame].rotation if frame in places else np.eye(3)

    edges: list[sdf_file.Edge] = []
    for element in robot.findall("gazebo/joint"):
        taken.add(name := urdf_xml.name(element, taken))
        where = f"gazebo.joint.{name}"
        first, second = (
            urdf_xml.known_link(f"{where}.{end}", (element.findtext(end) or "").strip(), places)
            for end in ("parent", "child")
        )
        stated = urdf_xml.single(element, "pose", where)
        start = second if stated is None else stated.get("relative_to") or second
        start = urdf_xml.known_link(f"{where}.pose", start, places)
        place = places[start] @ sdf_file.pose(stated, f"{where}.pose")
        edge = sdf_file.joint_edge(path, element, name, (first, second), place, turn)
        edges.append(edge)
    edges += sdf_file.welds(path, robot, robot.get("name", ""), places, taken)
    return {edge.name: edge.closure(places) for edge in edges}


def _link(element: ET.Element, name: str) -> Link:
    inertial = urdf_xml.single(element, "inertial", f"link.{name}")
    if inertial is None:
        return Link(name, 0.0, np.zeros(3), np.zeros((3, 3)))
    where = f"link.{name}.inertial"
    mass = urdf_xml.single(inertial, "mass", where)
    value = urdf_xml.number(None if mass is None else mass.get("value"), f"{where}.mass")
    if value < 0.0:
        raise ParameterError(f"{where}.mass", value, "zero or more, kg")
    inertia = urdf_xml.single(inertial, "inertia", where)
    if inertia is None:
        raise ParameterError(f"{where}.inertia", None, "an <inertia> for the mass, kg m2")
    xx, xy, xz, yy, yz, zz = (
        urdf_xml.number(
            inertia.get(key, "0" if key[1] != key[2] else None), f"{where}.inertia.{key}"
        )
        for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    pose = urdf_xml.origin(urdf_xml.single(inertial, "origin", where), where)
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return Link(name, value, pose.position, pose.rotation @ matrix @ pose.rotation.T)


def _joint(element: ET.Element, name: str, links: dict[str, Link]) -> Joint:
    where = f"joint.{name}"
    kind = element.get("type")
    if kind in ("floating", "planar"):
        raise ParameterError(f"{where}.type", kind, "revolute and prismatic joints in its place")
    if kind not in JOINTS:
        raise UnknownNameError(f"{where}.type", kind, JOINTS)
    if element.find("mimic") is not None:
        raise ParameterError(f"{where}.mimic", "<mimic>", "joints without coupling")
    parent, child = (
        urdf_xml.reference(urdf_xml.single(element, end, where), f"{where}.{end}", links)
        for end in ("parent", "child")
    )
    origin = urdf_xml.origin(urdf_xml.single(element, "origin", where), where)
    bare = kind in ("fixed", "spherical")
    axes = [] if bare else [urdf_xml.axis(element, "axis", where)]
    limits: dict[str, Any] = {}
    limit = urdf_xml.single(element, "limit", where)
    if limit is not None and kind in ("revolute", "continuous", "prismatic"):
        limits = urdf_xml.limits(limit.attrib, where, kind)
    viscous, coulomb = urdf_xml.friction(element, where)
    kind = "revolute" if kind == "continuous" else kind
    return Joint(
        name, kind, parent, child, origin, np.reshape(axes, (-1, 3)), limits, viscous, coulomb
    )


def _root(links: dict[str, Link], joints: dict[str, Joint]) -> str:
    parents: dict[str, Joint] = {}
    for joint in joints.values():
        if joint.child in parents:
            raise ParameterError(
                f"joint.{joint.name}.child",
                joint.child,
                f"a tree of links: {joint.child!r} already has the parent joint "
                f"{parents[joint.child].name!r}; close the loop with a <constraint> element",
            )
        parents[joint.child] = joint
    roots = [name for name in links if name not in parents]
    if len(roots) != 1:
        raise ParameterError("robot", roots, "exactly one root link (a link that is not a child)")
    known = {roots[0]}
    for link in links:
        # Up to what is known to hang on the root: every link is passed once.
        way: dict[str, None] = {}
        while link not in known:
            if link in way:
                circle = sorted(way)
                raise ParameterError(
                    f"joint.{parents[link].name}", circle, "a tree; these links form a circle"
                )
            way[link] = None
            link = parents[link].parent
        known.update(way)
    return roots[0]


def _retyped(joints: dict[str, Joint], beside: dict[str, Any]) -> dict[str, Joint]:
    """Joints that the YAML file calls spherical, universal or fixed."""
    names, kinds = beside.get("joint_name", []), beside.get("joint_type", [])
    if len(names) != len(kinds):
        raise ParameterError("joint_type", kinds, f"{len(names)}, one per name in joint_name")
    unit = dict(zip("XYZ", np.eye(3), strict=True))
    universal = {f"UJOINT_{a}{b}": (a, b) for a in "XYZ" for b in "XYZ" if a != b}
    joints = dict(joints)
    for name, kind in zip(names, kinds, strict=True):
        if name not in joints:
            raise UnknownNameError("joint_name", name, joints)
        if kind in universal:
            changed, axes = "universal", [unit[key] for key in universal[kind]]
        elif kind in ("SPHERICAL", "FIXED"):
            changed, axes = str(kind).lower(), []
        else:
            raise UnknownNameError("joint_type", kind, ["SPHERICAL", "FIXED", *universal])
        rows = np.reshape(axes, (-1, 3))
        joints[name] = replace(joints[name], type=changed, axes=rows, limits={})
    return joints


def _parameters(robot: ET.Element, actuated: tuple[str, ...], key: str) -> dict[str, float]:
    """A parameter of the actuated joints, or of their position, in ``<ros2_control>`` elements."""
    found: dict[str, float] = {}
    for joint in robot.findall("ros2_control/joint"):
        name = joint.get("name", "")
        states = [s for s in joint.findall("state_interface") if s.get("name") == "position"]
        for param in [one for part in (joint, *states) for one in part.findall("param")]:
            if param.get("name") == key and name in actuated:
                where = f"ros2_control.{name}.{key}"
                found[name] = urdf_xml.number((param.text or "").strip(), where)
                if key == "rotor_inertia" and found[name] < 0.0:
                    raise ParameterError(where, found[name], "zero or more")
    return found


def _warn_of_units(
    path: Path, robot: ET.Element, joints: dict[str, Joint], closures: dict[str, Closure]
) -> None:
    offsets = {f"joint.{n}.origin": j.origin for n, j in joints.items()}
    offsets |= {f"{n}.{i}": f for n, c in closures.items() for i, f in enumerate(c.frames)}
    where, pose = max(
        offsets.items(),
        key=lambda item: float(np.abs(item[1].position).max()),
        default=("", Pose()),
    )
    size = float(np.abs(pose.position).max())
    if size > LARGE:
        warn(
            path,
            f"{where}: an offset of {size:g} m; a URDF uses metres; are these millimetres?",
        )
    for top in robot:
        angles = [word for e in top.iter() for word in e.get("rpy", "").split()]
        largest = max((abs(urdf_xml.number(word, "rpy")) for word in angles), default=0.0)
        if largest > 2.0 * math.pi + 1e-6:
            warn(
                path,
                f"{top.tag}.{top.get('name')}.rpy: {largest:g} rad; a URDF uses radians; "
                "are these degrees?",
            )
