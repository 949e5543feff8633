# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A URDF file: links, joints and what closes loops, in three ways that people write it.

``<constraint>`` elements (urdfdom pull request 264), ``<loop>`` elements (Chignoli, Slotine,
Wensing, Kim 2024, URDF+, arXiv:2411.19753), pairs of frames in a YAML file (Batto, De Matteis,
Mansard 2025, Extended URDF, arXiv:2504.04767).
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections import ChainMap
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, UnknownNameError, warn
from pkm_twin.machine import foreign, sdf_file, urdf_xml
from pkm_twin.machine.joints import TYPES
from pkm_twin.machine.loop_tree import Fault, Joint, Link, LoopTree, hung, link_of
from pkm_twin.machine.precision import rounding_error
from pkm_twin.machine.rotations import Pose
from pkm_twin.machine.urdf_control import UNCOUPLED, actuated_joints, read_beside

_PLACES: Final = ("axis", "parent_axis", "child_axis")
LARGE: Final = 10.0
"""Offsets beyond this, m, look like millimetres."""
ALIKE: Final = 1e-9
"""Greatest difference of the axes of a screw's turn and slide."""

JOINTS: Final = ("revolute", "continuous", "prismatic", "fixed", "spherical")
CONSTRAINTS: Final = {
    **{name: name for name, kind in TYPES.items() if not kind.threaded()},
    "continuous": "revolute",
    "link": "fixed",  # a link that was cut in two
}
READ: Final = (
    "link",
    "joint",
    "constraint",
    "loop",
    "loop_joint",
    "gazebo",
    "ros2_control",
    "transmission",
    "material",
    "sensor",
)
"""Elements of a robot that are read, or do not act on its motion."""
PARTS: Final = ("parent", "parent_origin", "parent_axis", "child", "child_origin", "child_axis", "dynamics")
LOOPS: Final = {name: CONSTRAINTS[name] for name in ("revolute", "continuous", "prismatic", "fixed", "spherical")}


@dataclass(frozen=True, eq=False)
class Visual:
    """A mesh of a body: the name that the URDF ``urdf`` gives it, ``scale`` (3,), and its place.

    ``pose``: of the mesh's frame at home, base axes.
    """

    urdf: Path
    mesh: str
    body: str
    scale: Array
    pose: Pose


def read(path: Path, robot: ET.Element, actuated: Sequence[str] | None = None) -> LoopTree:
    """Read the links, joints and closures of a URDF file.

    :param robot: the file's top element; the path is for what stands beside the file.
    :param actuated: the actuated joints, in place of those that the file marks.
    :raises ParameterError: not readable, not a URDF, or an element that is refused, by name.
    """
    if robot.tag != "robot":
        raise ParameterError(str(path), f"<{robot.tag}>", "a <robot> element at the top")
    if any(str(child.tag).startswith("xacro:") for child in robot):
        raise ParameterError(str(path), "xacro elements", "a URDF: run xacro on this file first")
    links: dict[str, Link] = {}
    rounding = rounding_error(word for e in robot.iter("inertia") for word in e.attrib.values())
    for element in robot.findall("link"):
        name = urdf_xml.name(element, links)
        links[name] = _link(element, name, rounding)
    if not links:
        raise ParameterError(str(path), "no <link>", "a robot with links")
    joints: dict[str, Joint] = {}
    for element in robot.findall("joint"):
        name = urdf_xml.name(element, joints)
        joints[name] = _joint(element, name, links)
    faults: list[Fault] = []
    for element in robot.findall("joint[mimic]"):
        try:
            _take_screw(element, joints, links)
        except ParameterError as error:
            leader = str(element.find("mimic").get("joint"))  # type: ignore[union-attr]
            faults.append(((element.get("name", ""), leader), error))
    root = _root(links, joints)
    others = [element for element in robot if element.tag not in ("link", "joint")]
    foreign.check_elements(path, others)
    unknown = {str(element.tag) for element in others} - {*READ, *foreign.REJECTED}
    if unknown:
        warn(path, f"elements that are not read: {', '.join(sorted(unknown))}")
    beside = read_beside(path)
    joints = _retyped(joints, beside)
    closures = _closures(robot, beside, links, {n: joint.outer for n, joint in joints.items()})
    _warn_of_units(path, robot, joints, closures)
    frames = {root: Pose()}
    for joint, parent, child in hung(root, joints.values()):
        frames[child] = frames[parent] @ joint.frames[0]
    links = {n: link.moved(frames[n]) for n, link in links.items()}
    joints, closures = (
        {n: one.placed(frames[one.inner], frames[one.outer]) for n, one in some.items()} for some in (joints, closures)
    )
    closures |= _of_gazebo(path, robot, frames, {*joints, *closures})
    types = {n: joint.kind for n, joint in joints.items()}
    motors, marked = actuated_joints(path, robot, beside, types, faults, chosen=actuated)
    name = robot.get("name") or path.stem
    initial = _parameters(robot, motors, "initial_value")
    rotors = _parameters(robot, motors, "rotor_inertia")
    offsets = _parameters(robot, motors, "friction_offset")
    for joint in [joints[key] for key in (*rotors, *offsets)]:
        joints[joint.name] = replace(
            joint, rotor_inertia=rotors.get(joint.name, 0.0), offset=offsets.get(joint.name, 0.0)
        )
    weight = dict.fromkeys(links, True)
    for element in robot.findall("gazebo"):
        link = element.get("reference", "")
        if link in links:
            off = foreign.flag(element, "turnGravityOff", False)
            weight[link] = foreign.flag(element, "gravity", not off)
    gravity = foreign.gravity_of(path, weight, links, root, joints.values(), None)
    return LoopTree(
        name,
        root,
        links,
        joints,
        tuple(closures.values()),
        motors,
        gravity,
        initial=initial,
        rounding=rounding_error(
            word
            for e in robot.iter()
            if e.tag in _PLACES or "origin" in e.tag
            for key in ("xyz", "rpy")
            for word in e.get(key, "").split()
        ),
        marked=marked,
        faults=tuple(faults),
    )


def _of_gazebo(path: Path, robot: ET.Element, frames: Mapping[str, Pose], taken: set[str]) -> dict[str, Joint]:
    """Joints of SDF inside ``<gazebo>``, and links that its plugins hold together, by name.

    :param frames: of the links. ``taken``: names of joints and closures; those of these are added.
    """

    def turn(frame: str) -> Array:
        return frames[frame].rotation if frame in frames else np.eye(3)

    found: list[Joint] = []
    for element in robot.findall("gazebo/joint"):
        taken.add(name := urdf_xml.name(element, taken))
        where = f"gazebo.joint.{name}"
        first, second = (
            urdf_xml.known_link(f"{where}.{end}", (element.findtext(end) or "").strip(), frames)
            for end in ("parent", "child")
        )
        stated = urdf_xml.single(element, "pose", where)
        start = second if stated is None else stated.get("relative_to") or second
        start = urdf_xml.known_link(f"{where}.pose", start, frames)
        place = frames[start] @ sdf_file.pose(stated, f"{where}.pose")
        found.append(sdf_file.joint_of(path, element, name, (first, second), place, turn))
    found += sdf_file.welds(path, robot, robot.get("name", ""), frames, taken)
    return {joint.name: sdf_file.closing(joint) for joint in found}


def _link(element: ET.Element, name: str, rounding: float) -> Link:
    inertial = urdf_xml.single(element, "inertial", f"link.{name}")
    if inertial is None:
        return Link(name)
    where = f"link.{name}.inertial"
    mass = urdf_xml.single(inertial, "mass", where)
    value = urdf_xml.number(None if mass is None else mass.get("value"), f"{where}.mass")
    inertia = urdf_xml.single(inertial, "inertia", where)
    if inertia is None:
        raise ParameterError(f"{where}.inertia", None, "an <inertia> for the mass, kg m2")
    pose = urdf_xml.origin(urdf_xml.single(inertial, "origin", where), where)

    def moment(key: str) -> float:
        stated = inertia.get(key, None if key[1] == key[2] else "0")
        return urdf_xml.number(stated, f"{where}.inertia.{key}")

    return link_of(name, value, pose, moment, rounding)


def _joint(element: ET.Element, name: str, links: dict[str, Link]) -> Joint:
    where = f"joint.{name}"
    kind = element.get("type")
    if kind in ("floating", "planar"):
        raise ParameterError(f"{where}.type", kind, "revolute and prismatic joints in its place")
    if kind not in JOINTS:
        raise UnknownNameError(f"{where}.type", kind, JOINTS)
    parent, child = (
        urdf_xml.reference(urdf_xml.single(element, end, where), f"{where}.{end}", links) for end in ("parent", "child")
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
        name,
        kind,
        parent,
        child,
        (origin, Pose()),
        np.reshape(axes, (-1, 3)),
        limits=limits,
        viscous=viscous,
        coulomb=coulomb,
    )


def _take_screw(element: ET.Element, joints: dict[str, Joint], links: dict[str, Link]) -> None:
    """Make one screw of a slide and the turn that it follows, joined by a link without mass.

    :raises ParameterError: any other joint that follows another one.
    """
    slide = joints[element.get("name", "")]
    where, mimic = f"joint.{slide.name}.mimic", element.find("mimic")
    assert mimic is not None  # noqa: S101
    turn = joints.get(mimic.get("joint", ""), slide)
    numbers = (mimic.get("multiplier", "1"), mimic.get("offset", "0"))
    pitch, offset = (urdf_xml.number(number, where) for number in numbers)
    between = [one.name for one in joints.values() if slide.inner in (one.inner, one.outer)]
    pose, same = slide.frames[0], partial(np.allclose, atol=ALIKE)
    if (
        (turn.kind, turn.outer, slide.kind) != ("revolute", slide.inner, "prismatic")
        or sorted(between) != sorted([turn.name, slide.name])
        or any((links[slide.inner].mass, slide.viscous, slide.coulomb, slide.limits))
        or not (same(turn.axes, slide.axes) and same(pose.rotation, np.eye(3)))
        or not same(np.cross(pose.position, slide.axes[0]), 0.0)
    ):
        raise ParameterError(where, "<mimic>", UNCOUPLED)
    along = Pose(position=pose.position + offset * slide.axes[0])
    joints[turn.name] = replace(
        turn, kind="helical", outer=slide.outer, frames=(turn.frames[0] @ along, Pose()), pitch=pitch
    )
    del joints[slide.name], links[slide.inner]


def _root(links: dict[str, Link], joints: dict[str, Joint]) -> str:
    parents: dict[str, Joint] = {}
    for joint in joints.values():
        if joint.outer in parents:
            raise ParameterError(
                f"joint.{joint.name}.child",
                joint.outer,
                f"a tree of links: {joint.outer!r} already has the parent joint "
                f"{parents[joint.outer].name!r}; close the loop with a <constraint> element",
            )
        parents[joint.outer] = joint
    roots = [name for name in links if name not in parents]
    if len(roots) != 1:
        raise ParameterError("robot", roots, "exactly one root link (a link that is not a child)")
    reached = {roots[0], *(one.child for one in hung(roots[0], joints.values()))}
    if circle := sorted(set(links) - reached):
        where = f"joint.{parents[circle[0]].name}"
        raise ParameterError(where, circle, "a tree; these links form a circle or depend on one")
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
        joints[name] = replace(joints[name], kind=changed, axes=rows, limits={})
    return joints


def _closures(
    robot: ET.Element, beside: Mapping[str, Any], links: Collection[str], joints: Mapping[str, str]
) -> dict[str, Joint]:
    """All closures of a robot by name.

    :param beside: the YAML file's entries.
    :param joints: the joints' names, each with its child link.
    :raises ParameterError: an element that is refused, by name.
    """
    found: dict[str, Joint] = {}
    taken = ChainMap[str, Any](found, dict(joints))
    for element in robot.findall("constraint"):
        name = urdf_xml.name(element, taken)
        found[name] = _constraint(element, name, links)
    for element in robot.findall("loop"):
        name = urdf_xml.name(element, taken)
        found[name] = _loop(element, name, links)
    for element in robot.findall("loop_joint"):
        name = urdf_xml.name(element, taken)
        found[name] = _loop_joint(element, name, links)
    for closure in _pairs(beside, links, joints):
        if closure.name in joints or closure.name in found:
            raise ParameterError("closed_loop", closure.name, "each pair once")
        found[closure.name] = closure
    return found


def _constraint(element: ET.Element, name: str, links: Collection[str]) -> Joint:
    where = f"constraint.{name}"
    kind = (element.get("type") or "").removesuffix("_joint")
    if kind not in CONSTRAINTS:
        raise UnknownNameError(f"{where}.type", element.get("type"), CONSTRAINTS)
    urdf_xml.only(element, where, PARTS)
    for end in ("parent", "child"):
        urdf_xml.only(urdf_xml.single(element, end, where), f"{where}.{end}", ())
    ends = tuple(urdf_xml.reference(element.find(e), f"{where}.{e}", links) for e in ("parent", "child"))
    frames = tuple(
        urdf_xml.origin(urdf_xml.single(element, f"{e}_origin", where), f"{where}.{e}_origin")
        for e in ("parent", "child")
    )
    parent = urdf_xml.axis(element, "parent_axis", where)
    # The child's axis is the parent's where the two frames meet, unless it is given.
    alone = kind != "universal" and element.find("child_axis") is None
    child = parent if alone else urdf_xml.axis(element, "child_axis", where)
    viscous, coulomb = urdf_xml.friction(element, where)
    closure = _closure(name, CONSTRAINTS[kind], ends, frames, (parent, child))
    angle = urdf_xml.number(element.get("angle", repr(math.pi / 2)), f"{where}.angle")
    cosine = math.cos(angle) if "angle" in element.attrib and kind == "universal" else 0.0
    return replace(closure, viscous=viscous, coulomb=coulomb, cosine=cosine)


def _loop(element: ET.Element, name: str, links: Collection[str]) -> Joint:
    where = f"loop.{name}"
    kind = element.get("type")
    if kind not in LOOPS:
        raise UnknownNameError(f"{where}.type", kind, LOOPS)
    urdf_xml.only(element, where, ("predecessor", "successor", "sucessor", "axis"))
    ends, frames = [], []
    for tags in (("predecessor",), ("successor", "sucessor")):
        stated = [e for tag in tags if (e := urdf_xml.single(element, tag, where)) is not None]
        if len(stated) > 1:
            raise ParameterError(f"{where}.{tags[0]}", f"{len(stated)} elements", "one")
        end = stated[0] if stated else None
        urdf_xml.only(end, f"{where}.{tags[0]}", ("origin",))
        ends.append(urdf_xml.reference(end, f"{where}.{tags[0]}", links))
        origin = None if end is None else urdf_xml.single(end, "origin", f"{where}.{tags[0]}")
        frames.append(urdf_xml.origin(origin, f"{where}.{tags[0]}"))
    axis = urdf_xml.axis(element, "axis", where)
    return _closure(name, LOOPS[kind], ends, frames, (axis, axis))


def _loop_joint(element: ET.Element, name: str, links: Collection[str]) -> Joint:
    """Read a closure between two frames, as Isaac Sim and Drake write it."""
    where, kind = f"loop_joint.{name}", element.get("type")
    if kind not in LOOPS:
        raise UnknownNameError(f"{where}.type", kind, LOOPS)
    tags = ("link1", "link2")
    urdf_xml.only(element, where, (*tags, "axis"))
    parts = [urdf_xml.single(element, tag, where) for tag in tags]
    ends = [urdf_xml.reference(p, f"{where}.{t}", links) for p, t in zip(parts, tags, strict=True)]
    frames = [urdf_xml.origin(p, f"{where}.{t}") for p, t in zip(parts, tags, strict=True)]
    axis = urdf_xml.axis(element, "axis", where)
    return _closure(name, LOOPS[kind], ends, frames, (axis, axis))


def _pairs(beside: Mapping[str, Any], links: Collection[str], joints: Mapping[str, str]) -> list[Joint]:
    """Read closures of the YAML file: two frames that meet whole (6d) or in their origins (3d)."""
    pairs = beside.get("closed_loop", [])
    kinds = beside.get("type", ["6d"] * len(pairs))
    if len(kinds) != len(pairs):
        raise ParameterError("type", kinds, f"{len(pairs)}, one per pair in closed_loop")
    closures = []
    for i, (pair, kind) in enumerate(zip(pairs, kinds, strict=True)):
        if not isinstance(pair, list) or len(pair) != 2:
            raise ParameterError(f"closed_loop[{i}]", pair, "a pair of frame names")
        types = {"6d": "fixed", "3d": "spherical"}
        if str(kind).lower() not in types:
            raise UnknownNameError(f"type[{i}]", kind, types)
        # A joint's frame moves with its child, so that the child link's frame is the same.
        known = [*links, *joints]
        found = [urdf_xml.known_link(f"closed_loop[{i}]", name, known) for name in pair]
        ends = [joints.get(name, name) for name in found]
        closures.append(_closure("_".join(pair), types[str(kind).lower()], ends, (Pose(), Pose()), ()))
    return closures


def _closure(name: str, kind: str, links: Sequence[str], frames: Sequence[Pose], axes: Sequence[Array]) -> Joint:
    if links[0] == links[1]:
        raise ParameterError(name, links[0], "a closure between two links")
    rows = np.reshape(axes if TYPES[kind].count else (), (-1, 3))
    return Joint(name, kind, links[0], links[1], (frames[0], frames[1]), rows)


def _parameters(robot: ET.Element, actuated: tuple[str, ...], key: str) -> dict[str, float]:
    """Read a parameter of the actuated joints, or of their position, in ``<ros2_control>``."""
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


def _warn_of_units(path: Path, robot: ET.Element, joints: dict[str, Joint], closures: dict[str, Joint]) -> None:
    offsets = {f"joint.{n}.origin": j.frames[0] for n, j in joints.items()}
    offsets |= {f"{n}.{i}": f for n, c in closures.items() for i, f in enumerate(c.frames)}
    where, pose = max(offsets.items(), key=lambda item: float(np.abs(item[1].position).max()), default=("", Pose()))
    size = float(np.abs(pose.position).max())
    if size > LARGE:
        warn(path, f"{where}: an offset of {size:g} m; a URDF uses metres; are these millimetres?")
    for top in robot:
        angles = [word for e in top.iter() for word in e.get("rpy", "").split()]
        largest = max((abs(urdf_xml.number(word, "rpy")) for word in angles), default=0.0)
        if largest > 2.0 * math.pi + 1e-6:
            warn(path, f"{top.tag}.{top.get('name')}.rpy: {largest:g} rad; a URDF uses radians; are these degrees?")


def visuals(path: Path, robot: ET.Element, places: Mapping[str, Pose], bodies: Mapping[str, str]) -> Iterator[Visual]:
    """Meshes of a machine's links; an invalid one is left out with a warning.

    :param places: of the links at home, base axes; ``bodies``: the body of each link.
    """
    for link in robot.findall("link"):
        name = link.get("name", "")
        if name not in bodies:
            continue  # It is no part of the linkage that is cut out.
        for number, visual in enumerate(link.findall("visual")):
            mesh = visual.find("geometry/mesh")
            if mesh is None:
                continue
            where = f"link.{name}.visual.{number}"
            try:
                pose = urdf_xml.origin(urdf_xml.single(visual, "origin", where), where)
                scale = urdf_xml.vector(mesh.get("scale", "1 1 1"), f"{where}.scale", 3)
                if not mesh.get("filename"):
                    raise ParameterError(f"{where}.filename", None, "the file of the mesh")
            except ParameterError as error:
                warn(path, f"{error}; this mesh is not shown")
                continue
            file = str(mesh.get("filename"))
            yield Visual(path, file, bodies[name], scale, places[name] @ pose)
