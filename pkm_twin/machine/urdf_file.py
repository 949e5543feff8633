# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Read a URDF file: links, joints, and loop closures in the forms that are in use.

``<constraint>`` elements (urdfdom pull request 264), ``<loop>`` elements (Chignoli, Slotine,
Wensing, Kim 2024, URDF+, arXiv:2411.19753), pairs of frames in a YAML file (Batto, De Matteis,
Mansard 2025, Extended URDF, arXiv:2504.04767).
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, UnknownNameError, warn_of_file
from pkm_twin.machine import foreign, sdf_file, urdf_xml
from pkm_twin.machine.joints import TYPES
from pkm_twin.machine.loop_tree import Fault, Joint, Link, LoopTree, make_link, order_from_root
from pkm_twin.machine.precision import rounding_error
from pkm_twin.machine.rotations import Pose
from pkm_twin.machine.urdf_control import (
    UNCOUPLED_JOINTS,
    find_marked,
    limit_commands,
    list_actuated_joints,
    read_companion_yaml,
)

_LOOPS: Final = {name: name for name in ("revolute", "prismatic", "fixed", "spherical")} | {"continuous": "revolute"}
"""Types of ``<loop>`` and ``<loop_joint>`` elements."""
_CONSTRAINTS: Final = {
    **{name: name for name, kind in TYPES.items() if not kind.threaded()},
    "continuous": "revolute",
    "link": "fixed",  # a link that was cut in two
}
"""Types of ``<constraint>`` elements, without ``_joint``."""
_KNOWN: Final = {
    "link": "name type inertial visual collision contact self_collision_checking material",
    "inertial": "origin mass inertia",
    "mass": "value",
    "inertia": "ixx ixy ixz iyy iyz izz",
    "joint": "name type independent dont_collapse parent child origin axis limit dynamics joint_properties mimic "
    "calibration",
    "parent": "link",
    "child": "link",
    "origin": "xyz rpy quat_xyzw",
    "axis": "xyz",
    "limit": "lower upper velocity effort",
    "dynamics": "damping friction",
    "joint_properties": "damping friction",
    "mimic": "joint multiplier offset",
}
"""Attributes and elements in links and joints that are read, or do not change the motion, by element."""


@dataclass(frozen=True, eq=False)
class Visual:
    """A mesh of a body: its name in the file ``urdf``, its ``scale`` (3,), and its frame at home."""

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
        name = urdf_xml.read_name(element, links)
        links[name] = _read_link(element, name, rounding)
    if not links:
        raise ParameterError(str(path), "no <link>", "a robot with links")
    joints: dict[str, Joint] = {}
    for element in robot.findall("joint"):
        name = urdf_xml.read_name(element, joints)
        joints[name] = _read_joint(element, name, links)
    faults: list[Fault] = []
    for element in robot.findall("joint[mimic]"):
        try:
            _take_screw(element, joints, links)
        except ParameterError as error:
            leader = str(element.find("mimic").get("joint"))  # type: ignore[union-attr]
            faults.append(((element.get("name", ""), leader), error))
    root = _find_root(links, joints)
    others = [element for element in robot if element.tag not in ("link", "joint")]
    inside = [part for element in robot if element.tag in ("link", "joint") for part in element if part.tag != "mimic"]
    foreign.check_elements(path, [*others, *inside])
    known = {"constraint", "loop", "loop_joint", "gazebo", "ros2_control", "transmission", "material", "sensor"}
    unknown = {str(element.tag) for element in others} - known - {*foreign.REJECTED}
    for element in robot:
        unknown.update(_find_unread(element))
        if element.tag == "gazebo" and "reference" not in element.attrib and element.find("gravity") is not None:
            unknown.add("gazebo.gravity")
    if unknown:
        warn_of_file(path, f"elements that are not read: {', '.join(sorted(unknown))}")
    beside = read_companion_yaml(path)
    closures = _read_closures(robot, beside, links, joints)
    _warn_of_units(path, robot, joints, closures)
    frames = {root: Pose()}
    for joint, parent, child in order_from_root(root, joints.values()):
        frames[child] = frames[parent] @ joint.frames[0]
    links = {n: link.moved(frames[n]) for n, link in links.items()}
    joints, closures = (
        {n: one.placed(frames[one.inner], frames[one.outer]) for n, one in some.items()} for some in (joints, closures)
    )
    closures |= _read_gazebo(path, robot, frames, {*joints, *closures})
    types = {n: joint.kind for n, joint in joints.items()}
    motors, marked = list_actuated_joints(path, types, faults, actuated, lambda: find_marked(robot, beside))
    limit_commands(path, robot, joints)
    initial = _read_parameter(robot, motors, "initial_value")
    rotors = _read_parameter(robot, motors, "rotor_inertia", 0.0)
    offsets = _read_parameter(robot, motors, "friction_offset")
    for name in {**rotors, **offsets}:
        rotor, offset = rotors.get(name, 0.0), offsets.get(name, 0.0)
        joints[name] = replace(joints[name], rotor_inertia=rotor, offset=offset)
    weight = dict.fromkeys(links, True)
    for element in robot.findall("gazebo"):
        link = element.get("reference", "")
        if link in links:
            off = foreign.read_flag(element, "turnGravityOff", False)
            weight[link] = foreign.read_flag(element, "gravity", not off)
    places = [e for e in robot.iter() if e.tag in ("axis", "parent_axis", "child_axis") or "origin" in e.tag]
    return LoopTree(
        robot.get("name") or path.stem,
        root,
        links,
        joints,
        tuple(closures.values()),
        motors,
        foreign.read_gravity(path, weight, links, root, joints.values(), None),
        initial=initial,
        rounding=rounding_error(word for e in places for key in ("xyz", "rpy") for word in e.get(key, "").split()),
        marked=marked,
        faults=tuple(faults),
    )


def _read_gazebo(path: Path, robot: ET.Element, frames: Mapping[str, Pose], taken: set[str]) -> dict[str, Joint]:
    """Read joints of SDF inside ``<gazebo>``, and links that Gazebo's plugins hold together.

    :param frames: of the links. ``taken``: names of joints and closures, to which these are added.
    """

    def turn(frame: str) -> Array:
        return frames[frame].rotation if frame in frames else np.eye(3)

    found: list[Joint] = []
    for element in robot.findall("gazebo/joint"):
        taken.add(name := urdf_xml.read_name(element, taken))
        where = f"gazebo.joint.{name}"
        first, second = (
            urdf_xml.find_link(f"{where}.{end}", (element.findtext(end) or "").strip(), frames)
            for end in ("parent", "child")
        )
        stated = urdf_xml.find_single_child(element, "pose", where)
        start = second if stated is None else stated.get("relative_to") or second
        start = urdf_xml.find_link(f"{where}.pose", start, frames)
        place = frames[start] @ sdf_file.pose(stated, f"{where}.pose")
        found.append(sdf_file.read_joint_element(element, name, (first, second), place, turn))
    found += sdf_file.read_welds(path, robot, robot.get("name", ""), frames, taken)
    return {joint.name: joint.make_loop_closing() for joint in found}


def _find_unread(element: ET.Element) -> Iterator[str]:
    """Iterate over the attributes and elements of a link or joint that nothing reads, as dotted tags."""
    if element.tag not in _KNOWN:
        return
    tag, known = str(element.tag), _KNOWN[element.tag].split()
    yield from (f"{tag}.{key}" for key in (*element.keys(), *(str(part.tag) for part in element)) if key not in known)
    for part in element:
        yield from (f"{tag}.{key}" for key in _find_unread(part))


def _read_link(element: ET.Element, name: str, rounding: float) -> Link:
    inertial = urdf_xml.find_single_child(element, "inertial", f"link.{name}")
    if inertial is None:
        return Link(name)
    where = f"link.{name}.inertial"
    mass = urdf_xml.find_single_child(inertial, "mass", where)
    value = urdf_xml.parse_number(None if mass is None else mass.get("value"), f"{where}.mass")
    inertia = urdf_xml.find_single_child(inertial, "inertia", where)
    if inertia is None:
        raise ParameterError(f"{where}.inertia", None, "an <inertia> for the mass, kg m2")
    pose = urdf_xml.read_origin(urdf_xml.find_single_child(inertial, "origin", where), where)

    def moment(key: str) -> float:
        stated = inertia.get(key, None if key[1] == key[2] else "0")
        return urdf_xml.parse_number(stated, f"{where}.inertia.{key}")

    return make_link(name, value, pose, moment, rounding)


def _read_joint(element: ET.Element, name: str, links: dict[str, Link]) -> Joint:
    where, kind = f"joint.{name}", element.get("type")
    if kind in ("floating", "planar"):
        raise ParameterError(f"{where}.type", kind, "revolute and prismatic joints in its place")
    if kind not in _LOOPS:
        raise UnknownNameError(f"{where}.type", kind, _LOOPS)
    parent, child = (
        urdf_xml.read_link_reference(urdf_xml.find_single_child(element, end, where), f"{where}.{end}", links)
        for end in ("parent", "child")
    )
    origin = urdf_xml.read_origin(urdf_xml.find_single_child(element, "origin", where), where)
    bare = kind in ("fixed", "spherical")
    axes = [] if bare else [urdf_xml.read_axis(element, "axis", where)]
    limit = urdf_xml.find_single_child(element, "limit", where)
    limits = {} if limit is None or bare else urdf_xml.read_limits(limit.attrib, where, kind)
    frames, rows = (origin, Pose()), np.reshape(axes, (-1, 3))
    viscous, coulomb = urdf_xml.read_friction(element, where)
    return Joint(name, _LOOPS[kind], parent, child, frames, rows, 0.0, limits, viscous, coulomb)


def _take_screw(element: ET.Element, joints: dict[str, Joint], links: dict[str, Link]) -> None:
    """Replace a slide and the rotation that it follows, on a link without mass between, by a screw.

    :raises ParameterError: any other joint that follows another one.
    """
    slide = joints[element.get("name", "")]
    where, mimic = f"joint.{slide.name}.mimic", element.find("mimic")
    assert mimic is not None  # noqa: S101
    turn = joints.get(mimic.get("joint", ""), slide)
    numbers = (mimic.get("multiplier", "1"), mimic.get("offset", "0"))
    pitch, offset = (urdf_xml.parse_number(number, where) for number in numbers)
    between = [one.name for one in joints.values() if slide.inner in (one.inner, one.outer)]
    # The axes of a screw's rotation and slide agree but for rounding.
    pose, same = slide.frames[0], partial(np.allclose, atol=1e-9)
    if (
        (turn.kind, turn.outer, slide.kind) != ("revolute", slide.inner, "prismatic")
        or sorted(between) != sorted([turn.name, slide.name])
        or any((links[slide.inner].mass, slide.viscous, slide.coulomb, slide.limits))
        or not (same(turn.axes, slide.axes) and same(pose.rotation, np.eye(3)))
        or not same(np.cross(pose.position, slide.axes[0]), 0.0)
    ):
        raise ParameterError(where, "<mimic>", UNCOUPLED_JOINTS)
    frame = turn.frames[0] @ Pose(position=pose.position + offset * slide.axes[0])
    joints[turn.name] = replace(turn, kind="helical", outer=slide.outer, frames=(frame, Pose()), pitch=pitch)
    del joints[slide.name], links[slide.inner]


def _find_root(links: dict[str, Link], joints: dict[str, Joint]) -> str:
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
    reached = {roots[0], *(one.child for one in order_from_root(roots[0], joints.values()))}
    if circle := sorted(set(links) - reached):
        where = f"joint.{parents[circle[0]].name}"
        raise ParameterError(where, circle, "a tree; these links form a circle or depend on one")
    return roots[0]


def _read_closures(
    robot: ET.Element, beside: Mapping[str, Any], links: Collection[str], joints: dict[str, Joint]
) -> dict[str, Joint]:
    """Read all closures of a robot by name, and the types of joints that only a YAML file can state.

    :param beside: the YAML file's entries. ``joints``: those of the tree; their types are replaced.
    :raises ParameterError: an element that is refused, by name.
    """
    names, kinds = beside.get("joint_name", []), beside.get("joint_type", [])
    if len(names) != len(kinds):
        raise ParameterError("joint_type", kinds, f"{len(names)}, one per name in joint_name")
    unit = dict(zip("XYZ", np.eye(3), strict=True))
    types = {f"UJOINT_{a}{b}": ("universal", [unit[a], unit[b]]) for a in "XYZ" for b in "XYZ" if a != b}
    types = {"SPHERICAL": ("spherical", []), "FIXED": ("fixed", []), **types}
    for name, kind in zip(names, kinds, strict=True):
        if name not in joints:
            raise UnknownNameError("joint_name", name, joints)
        if kind not in types:
            raise UnknownNameError("joint_type", kind, types)
        own, axes = types[kind]
        joints[name] = replace(joints[name], kind=own, axes=np.reshape(axes, (-1, 3)), limits={})
    found, taken = dict[str, Joint](), {*joints}
    for tag, read_one in (("constraint", _read_constraint), ("loop", _read_loop), ("loop_joint", _read_loop)):
        for element in robot.findall(tag):
            taken.add(name := urdf_xml.read_name(element, taken))
            found[name] = read_one(element, name, links)
    pairs = beside.get("closed_loop", [])
    kinds = beside.get("type", ["6d"] * len(pairs))
    if len(kinds) != len(pairs):
        raise ParameterError("type", kinds, f"{len(pairs)}, one per pair in closed_loop")
    for i, (pair, kind) in enumerate(zip(pairs, kinds, strict=True)):
        if not isinstance(pair, list) or len(pair) != 2:
            raise ParameterError(f"closed_loop[{i}]", pair, "a pair of frame names")
        # Frames coincide (6d), or their origins do (3d).
        meeting = {"6d": "fixed", "3d": "spherical"}
        if str(kind).lower() not in meeting:
            raise UnknownNameError(f"type[{i}]", kind, meeting)
        known = [urdf_xml.find_link(f"closed_loop[{i}]", name, [*links, *joints]) for name in pair]
        # A joint's frame is its child link's frame.
        ends = [joints[name].outer if name in joints else name for name in known]
        name = "_".join(pair)
        if name in taken:
            raise ParameterError("closed_loop", name, "each pair once")
        taken.add(name)
        found[name] = _make_closure(name, meeting[str(kind).lower()], ends, (Pose(), Pose()), ())
    return found


def _read_constraint(element: ET.Element, name: str, links: Collection[str]) -> Joint:
    where = f"constraint.{name}"
    kind = (element.get("type") or "").removesuffix("_joint")
    if kind not in _CONSTRAINTS:
        raise UnknownNameError(f"{where}.type", element.get("type"), _CONSTRAINTS)
    tags = ("parent", "child")
    urdf_xml.reject_other_children(
        element, where, ["dynamics", *(f"{tag}{part}" for tag in tags for part in ("", "_origin", "_axis"))]
    )
    for tag in tags:
        urdf_xml.reject_other_children(urdf_xml.find_single_child(element, tag, where), f"{where}.{tag}", ())
    ends = [urdf_xml.read_link_reference(element.find(tag), f"{where}.{tag}", links) for tag in tags]
    origins = [f"{tag}_origin" for tag in tags]
    frames = [
        urdf_xml.read_origin(urdf_xml.find_single_child(element, tag, where), f"{where}.{tag}") for tag in origins
    ]
    parent = urdf_xml.read_axis(element, "parent_axis", where)
    # The child's axis is the parent's where the two frames meet, unless it is given.
    alone = kind != "universal" and element.find("child_axis") is None
    child = parent if alone else urdf_xml.read_axis(element, "child_axis", where)
    viscous, coulomb = urdf_xml.read_friction(element, where)
    closure = _make_closure(name, _CONSTRAINTS[kind], ends, frames, (parent, child))
    angle = urdf_xml.parse_number(element.get("angle", repr(math.pi / 2)), f"{where}.angle")
    cosine = math.cos(angle) if "angle" in element.attrib and kind == "universal" else 0.0
    return replace(closure, viscous=viscous, coulomb=coulomb, cosine=cosine)


def _read_loop(element: ET.Element, name: str, links: Collection[str]) -> Joint:
    """Read a ``<loop>``, or a ``<loop_joint>`` between two frames, as Isaac Sim and Drake write it."""
    where, kind = f"{element.tag}.{name}", element.get("type")
    if kind not in _LOOPS:
        raise UnknownNameError(f"{where}.type", kind, _LOOPS)
    # URDF+ has the spelling sucessor too.
    nested = element.tag == "loop"
    tags = (("predecessor",), ("successor", "sucessor")) if nested else (("link1",), ("link2",))
    urdf_xml.reject_other_children(element, where, ("axis", *tags[0], *tags[1]))
    ends, frames = [], []
    for spellings in tags:
        own = f"{where}.{spellings[0]}"
        stated = [e for tag in spellings if (e := urdf_xml.find_single_child(element, tag, where)) is not None]
        if len(stated) > 1:
            raise ParameterError(own, f"{len(stated)} elements", "one")
        end = stated[0] if stated else None
        ends.append(urdf_xml.read_link_reference(end, own, links))
        if nested:
            urdf_xml.reject_other_children(end, own, ("origin",))
            end = urdf_xml.find_single_child(end, "origin", own)
        frames.append(urdf_xml.read_origin(end, own))
    axis = urdf_xml.read_axis(element, "axis", where)
    return _make_closure(name, _LOOPS[kind], ends, frames, (axis, axis))


def _make_closure(name: str, kind: str, links: Sequence[str], frames: Sequence[Pose], axes: Sequence[Array]) -> Joint:
    if links[0] == links[1]:
        raise ParameterError(name, links[0], "a closure between two links")
    rows = np.reshape(axes if TYPES[kind].count else (), (-1, 3))
    return Joint(name, kind, links[0], links[1], (frames[0], frames[1]), rows)


def _read_parameter(robot: ET.Element, actuated: tuple[str, ...], key: str, low: float = -math.inf) -> dict[str, float]:
    """Read a parameter of the actuated joints, or of their position, in ``<ros2_control>``."""
    found: dict[str, float] = {}
    for joint in robot.findall("ros2_control/joint"):
        name = joint.get("name", "")
        states = [s for s in joint.findall("state_interface") if s.get("name") == "position"]
        for param in [one for part in (joint, *states) for one in part.findall("param")]:
            if param.get("name") == key and name in actuated:
                found[name] = urdf_xml.parse_number((param.text or "").strip(), f"ros2_control.{name}.{key}", low)
    return found


def _warn_of_units(path: Path, robot: ET.Element, joints: dict[str, Joint], closures: dict[str, Joint]) -> None:
    offsets = {f"joint.{n}.origin": j.frames[0] for n, j in joints.items()}
    offsets |= {f"{n}.{i}": f for n, c in closures.items() for i, f in enumerate(c.frames)}
    sizes = {where: float(np.abs(pose.position).max()) for where, pose in offsets.items()}
    where = max(sizes, key=sizes.__getitem__, default="")
    # No parallel machine is drawn in offsets of more than 10 m.
    if where and sizes[where] > 10.0:
        warn_of_file(path, f"{where}: an offset of {sizes[where]:g} m; a URDF uses metres; are these millimetres?")
    for top in robot:
        angles = [word for e in top.iter() for word in e.get("rpy", "").split()]
        largest = max((abs(urdf_xml.parse_number(word, "rpy")) for word in angles), default=0.0)
        if largest > 2.0 * math.pi + 1e-6:
            name = f"{top.tag}.{top.get('name')}.rpy"
            warn_of_file(path, f"{name}: {largest:g} rad; a URDF uses radians; are these degrees?")


def read_visuals(
    path: Path, robot: ET.Element, places: Mapping[str, Pose], bodies: Mapping[str, str]
) -> Iterator[Visual]:
    """Read the meshes of a machine's links; leave out invalid ones with a warning.

    :param places: frames of the links at home, base axes. ``bodies``: the body of each link.
    """
    for link in robot.findall("link"):
        name = link.get("name", "")
        if name not in bodies:
            continue  # The mesh's link is not in the linkage that is cut out.
        for number, visual in enumerate(link.findall("visual")):
            mesh = visual.find("geometry/mesh")
            if mesh is None:
                continue
            where = f"link.{name}.visual.{number}"
            try:
                pose = urdf_xml.read_origin(urdf_xml.find_single_child(visual, "origin", where), where)
                scale = urdf_xml.parse_vector(mesh.get("scale", "1 1 1"), f"{where}.scale", 3)
                if not mesh.get("filename"):
                    raise ParameterError(f"{where}.filename", None, "the file of the mesh")
            except ParameterError as error:
                warn_of_file(path, f"{error}; this mesh is not shown")
                continue
            file = str(mesh.get("filename"))
            yield Visual(path, file, bodies[name], scale, places[name] @ pose)
