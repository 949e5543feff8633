# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Read an SDF model as links, joints and loop closures, by the SDFormat specification.

Versions 1.4 to 1.12: poses relative to frames, nested models, axes in any frame. The model stands
as drawn where all joints are at zero. SDF has a graph of joints: a spanning tree is chosen, with
fixed and actuated joints first, and the other joints close loops.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, UnknownNameError, warn_of_file
from pkm_twin.machine import foreign, urdf_xml
from pkm_twin.machine.joints import TURN, TYPES
from pkm_twin.machine.loop_tree import WORLD, Joint, Link, LoopTree, hold_in_world, make_link, span_tree
from pkm_twin.machine.precision import rounding_error
from pkm_twin.machine.rotations import Pose, from_rpy
from pkm_twin.machine.urdf_control import find_marked, limit_commands, list_actuated_joints, read_companion_yaml

MODEL: Final = "__model__"
"""Name of a model's own frame."""
VERSIONS: Final = range(4, 13)
"""Versions 1.x that are read."""
KINDS: Final = {
    "fixed": "fixed",
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
    "screw": "helical",
    "universal": "universal",
    "revolute2": "universal",
    "ball": "spherical",
}
"""Joint types by the name that SDF has for them."""


def read(path: Path, top: ET.Element, actuated: Sequence[str] | None = None) -> LoopTree:
    """Read an SDF file.

    :param top: the file's top element; the path is for what stands beside the file.
    :param actuated: the actuated joints, in place of those that the file marks.
    :raises ParameterError: an element that is not supported, or is wrong, by name.
    """
    if any(str(part.tag).startswith("xacro:") for part in top.iter()):
        raise ParameterError(str(path), "xacro elements", "an SDF: run xacro on this file first")
    text = top.get("version", "")
    version = re.fullmatch(r"1\.(\d+)", text)
    if not version or int(version[1]) not in VERSIONS:
        raise ParameterError("sdf.version", text or None, "1.4 to 1.12")
    outside, element, gravity = _find_model(path, top)
    title, world = urdf_xml.read_name(element, ()), Model(outside, int(version[1]))
    model = world.models[title]
    links = {WORLD: Link(WORLD)}
    moments = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    rounding = rounding_error((e.text or "").strip() for e in element.iter() if e.tag in moments)
    faults = foreign.check_elements(path, [element], joints={part: name for name, part in model.all("joint")})
    weight = {name: foreign.read_flag(part, "gravity", True) for name, part in model.all("link")}
    for name, part in model.all("link"):
        links[name] = _read_link(path, part, name, rounding).moved(model.place(name))
    places = {name: link.frame for name, link in links.items()}
    joints: dict[str, Joint] = {}
    for joint in model.joints(path):
        if joint.name in joints:
            raise ParameterError(f"joint.{joint.name}", joint.name, "a unique name")
        joints[joint.name] = joint
    taken = set(joints)
    for part in world.element.findall("joint"):
        # Names are unique within the world only.
        joint = _read_joint(path, part, world)
        own = urdf_xml.free_name(joint.name, taken, "_of_world")
        joints[own] = replace(joint, name=own)
    joints |= {joint.name: joint for joint in read_welds(path, top, title, places, taken)}
    for name, _ in model.all("frame"):
        owner = model.link(name)
        if owner in links and name not in links:
            links[name] = Link(name).moved(model.place(name))
            own = urdf_xml.free_name(f"{name}_frame", taken)
            joints[own] = Joint.fixed(own, owner, name, links[name].frame)
    hold_in_world(path, joints, lambda: links[model.link(MODEL)])
    types = {name: joint.kind for name, joint in joints.items()}
    # Where only some joints have an effort limit, these are motors.
    limited = [name for name, joint in joints.items() if "effort" in joint.limits]
    motors, marked = list_actuated_joints(
        path, types, faults, actuated, lambda: find_marked(top, read_companion_yaml(path), limited)
    )
    limit_commands(path, top, joints)
    tree, closures = span_tree(links, joints, motors)
    positions = [part for part in element.iter() if part.tag in ("pose", "xyz")]
    return LoopTree(
        title,
        WORLD,
        links,
        tree,
        tuple(joint.make_loop_closing() for joint in closures),
        motors,
        foreign.read_gravity(path, weight, links, WORLD, joints.values(), gravity),
        rounding=rounding_error(word for part in positions for word in (part.text or "").split()),
        marked=marked,
        faults=tuple(faults),
    )


def _find_model(path: Path, top: ET.Element) -> tuple[ET.Element, ET.Element, list[float] | None]:
    """Find the only model that can move, its parent, and the gravity of a world if it is stated."""
    worlds, gravity = top.findall("world"), None
    if worlds and len(top.findall("model")) + len(worlds) > 1:
        found = [f"{part.tag} {part.get('name')}" for part in top if part.tag in ("world", "model")]
        raise ParameterError(str(path), ", ".join(found), "one <world>, or a <model> without a world")
    for world in worlds:
        stated = urdf_xml.find_single_child(world, "gravity", "world")
        if stated is None:
            stated = world.find("physics/gravity")  # Where SDF had it until 1.5.
        if stated is not None:
            gravity = urdf_xml.parse_vector(stated.text, "world.gravity", 3).tolist()
    models = [(root, one) for root in (top, *worlds) for one in root.findall("model")]
    moving = [(root, one) for root, one in models if not foreign.read_flag(one, "static", False)]
    if not moving:
        _reject_includes(top.iter("include"))
    if len(moving) != 1:
        names = ", ".join(str(one.get("name")) for _, one in moving)
        raise ParameterError(str(path), names or "no <model>", "one <model> that is not static")
    return *moving[0], gravity


def _reject_includes(elements: Iterable[ET.Element]) -> None:
    for element in elements:
        uri = (element.findtext("uri") or "").strip()
        raise ParameterError("include", uri, "one file: `gz sdf -p FILE` writes includes out")


class Model:
    """The frames of a model by name, relative to the model's own; ``::`` leads into nested models.

    The outermost model is the world. Names of parts are those in the model that holds them.
    ``version``: the minor one of SDF.
    """

    def __init__(self, element: ET.Element, version: int, outer: Model | None = None):
        self.element, self.version, self.outer = element, version, outer
        own = element.get("name", "")
        self.prefix: str = f"{outer.prefix}{own}::" if outer and outer.outer else ""
        self.static: bool = outer is not None and (
            outer.static or (outer.outer is None and foreign.read_flag(element, "static", False))
        )
        self.parts: dict[str, ET.Element] = {}
        for part in sorted(element, key=lambda part: part.tag == "joint"):
            if part.tag in ("link", "joint", "frame", "model"):
                # Until 1.6 a joint and a link could have one name; it meant the link.
                name = urdf_xml.read_name(part, self.parts if version >= 7 else ())
                self.parts.setdefault(name, part)
        self.models: dict[str, Model] = {}
        for one in element.findall("model"):
            self.models[urdf_xml.read_name(one, self.models)] = Model(one, version, self)
        if outer and not self.static:
            _reject_includes(element.findall("include"))
        self._known: dict[str, Pose | None] = {}

    def all(self, tag: str) -> Iterator[tuple[str, ET.Element]]:
        """Iterate over elements of a tag, also of nested models, with their names."""
        for part in self.element.findall(tag):
            yield self.prefix + str(part.get("name")), part
        for one in self.models.values():
            yield from one.all(tag)

    def joints(self, path: Path) -> Iterator[Joint]:
        """Read the joints, also of nested models; the path is for warnings."""
        for part in self.element.findall("joint"):
            yield _read_joint(path, part, self)
        for one in self.models.values():
            yield from () if one.static else one.joints(path)

    def _find_nested(self, name: str, where: str) -> tuple[Model, str]:
        """Find the nested model that a scoped name leads to, and the rest of the name."""
        first, _, rest = name.partition("::")
        if rest and first in self.models:
            return self.models[first]._find_nested(rest, where)
        if name not in (MODEL, WORLD) and name not in self.parts:
            raise UnknownNameError(where, name, [MODEL, WORLD, *self.parts])
        return self, name

    def place(self, name: str, where: str = "relative_to") -> Pose:
        """Return a frame in the world, as drawn.

        :raises ParameterError: the frame is unknown, or depends on itself.
        """
        return self._express_outside(self.resolve_frame(name, where), None)

    def _express_outside(self, frame: Pose, end: Model | None) -> Pose:
        """Return a frame of this model in an outer model, by default in the world."""
        scope = self
        while scope is not end and scope.outer is not None:
            frame, scope = scope.pose() @ frame, scope.outer
        return frame

    def pose(self) -> Pose:
        """Return the model's frame in the outer model."""
        found = self._read_frame(self.element, MODEL, self.outer)
        placed = self.element.get("placement_frame")
        return found @ self.resolve_frame(placed, "placement_frame").inverse() if placed else found

    def resolve_frame(self, name: str, where: str) -> Pose:
        """Return the pose of a named frame in this model."""
        if name in self._known:
            found = self._known[name]
            if found is None:
                raise ParameterError(f"{self.prefix}{name}.pose", where, "frames that do not lead back to themselves")
            return found
        self._known[name] = None
        model, own = self._find_nested(name, where)
        part = None if own in (MODEL, WORLD) else model.parts[own]
        if model is not self:
            found = model._express_outside(model.resolve_frame(own, where), self)
        elif part is None and name == WORLD and self.outer is not None:
            found = self.pose().inverse() @ self.outer.resolve_frame(WORLD, where)
        elif part is None:
            found = Pose()
        elif part.tag == "model":
            found = self.models[name].pose()
        else:
            default = _read_end(part, "child") if part.tag == "joint" else part.get("attached_to")
            found = self._read_frame(part, MODEL if part.tag == "link" else default or MODEL, self)
        self._known[name] = found
        return found

    def _read_frame(self, part: ET.Element, default: str, scope: Model | None) -> Pose:
        where = f"{part.tag}.{part.get('name')}.pose"
        stated = urdf_xml.find_single_child(part, "pose", where)
        # ``frame`` is what ``relative_to`` was called until 1.6.
        name = default
        if stated is not None:
            name = stated.get("relative_to") or stated.get("frame") or default
        return (Pose() if scope is None else scope.resolve_frame(name, where)) @ pose(stated, where)

    def link(self, name: str, where: str = "attached_to") -> str:
        """Find the link that a frame is attached to.

        :raises ParameterError: none is found.
        """
        model, own = self, name
        for _ in range(urdf_xml.MAX_DEPTH):
            model, own = model._find_nested(own, where)
            held = model.models.get(own, model)
            if own == WORLD or held.static or (held.outer is None and own == MODEL):
                return WORLD
            part = held.element if own == MODEL else model.parts[own]
            if part.tag == "link":
                return model.prefix + own
            if part.tag == "model":
                first = next((key for key, _ in held.all("link")), None)
                named = part.get("canonical_link")
                if named is None and first is None:
                    raise ParameterError(f"model.{part.get('name')}", "no link", "a model of links")
                return str(first) if named is None else held.link(named, "canonical_link")
            end = _read_end(part, "child") if part.tag == "joint" else part.get("attached_to")
            own = end or MODEL
        raise ParameterError(where, name, "frames that do not lead back to themselves")


def _read_end(joint: ET.Element, tag: str) -> str:
    text = (joint.findtext(tag) or "").strip()
    if not text:
        raise ParameterError(f"joint.{joint.get('name')}.{tag}", None, "the name of a link")
    return text


def pose(element: ET.Element | None, where: str) -> Pose:
    """Read a ``<pose>``; an empty one is the identity."""
    text = "" if element is None else (element.text or "").strip()
    if element is None or not text:
        return Pose()
    turn = element.get("rotation_format", "euler_rpy")
    if turn not in ("euler_rpy", "quat_xyzw"):
        raise UnknownNameError(f"{where}.rotation_format", turn, ["euler_rpy", "quat_xyzw"])
    values = urdf_xml.parse_vector(text, where, 7 if turn == "quat_xyzw" else 6)
    if turn == "quat_xyzw":
        return Pose(urdf_xml.rotation_of_quaternion(values[3:], where), values[:3])
    degrees = urdf_xml.parse_boolean(element.get("degrees", "false"), f"{where}.degrees")
    return Pose(from_rpy(np.radians(values[3:]) if degrees else values[3:]), values[:3])


def _read_number(element: ET.Element | None, tag: str, where: str, default: float, low: float = -math.inf) -> float:
    """Read a number that stands in an element of its own."""
    stated = urdf_xml.find_single_child(element, tag, where)
    return default if stated is None else urdf_xml.parse_number((stated.text or "").strip(), f"{where}.{tag}", low)


def _read_link(path: Path, element: ET.Element, name: str, rounding: float) -> Link:
    """Read mass and inertia; SDF has 1 kg and 1 kg m2 where the file leaves them out."""
    where = f"link.{name}.inertial"
    inertial = urdf_xml.find_single_child(element, "inertial", f"link.{name}")
    if inertial is not None and urdf_xml.parse_boolean(inertial.get("auto", "false"), f"{where}.auto"):
        raise ParameterError(f"{where}.auto", "true", "a mass and an inertia as numbers")
    if inertial is not None and inertial.find("fluid_added_mass") is not None:
        raise ParameterError(f"{where}.fluid_added_mass", "given", "a machine in air")
    stated = set() if inertial is None else {part.tag for part in inertial.iter()}
    if missing := [key for key in ("mass", "ixx", "iyy", "izz") if key not in stated]:
        warn_of_file(path, f"link {name} has no {', '.join(missing)}: SDF then has 1 kg and 1 kg m2")
    inertia = urdf_xml.find_single_child(inertial, "inertia", where)
    return make_link(
        name,
        _read_number(inertial, "mass", where, 1.0),
        pose(urdf_xml.find_single_child(inertial, "pose", where), where),
        lambda key: _read_number(inertia, key, f"{where}.inertia", float(key[1] == key[2])),
        rounding,
    )


def _read_joint(path: Path, part: ET.Element, model: Model) -> Joint:
    """Read a joint with its frame in the world."""
    name = model.prefix + urdf_xml.read_name(part, ())
    where = f"joint.{name}"
    place = partial(model.place, where=where)
    ends = [_read_end(part, tag) for tag in ("parent", "child")]
    links = model.link(ends[0], f"{where}.parent"), model.link(ends[1], f"{where}.child")
    if links[0] == links[1]:
        raise ParameterError(where, links[0], "a joint between two links")
    stated = urdf_xml.find_single_child(part, "pose", where)
    named = None if stated is None else stated.get("relative_to") or stated.get("frame")
    at = place(named or ends[1]) @ pose(stated, f"{where}.pose")
    frame = model.parts.get(ends[0])
    if frame is not None and frame.tag == "frame":
        far = float(np.linalg.norm(place(ends[0]).position - at.position))
        if far > 1e-6:  # m; files are written with six decimals or more
            warn_of_file(
                path,
                f"{where}: the frame {ends[0]} is drawn {far:.3g} m from the joint; "
                "a joint of SDF holds its links as they are drawn",
            )
    return read_joint_element(part, name, links, at, lambda frame: place(frame).rotation, model.version)


def read_joint_element(
    part: ET.Element,
    name: str,
    links: tuple[str, str],
    place: Pose,
    turn: Callable[[str], Array],
    version: int = VERSIONS[-1],
) -> Joint:
    """Read a ``<joint>`` whose frame is known.

    :param turn: returns the rotation of a frame in the world by its name.
    :raises ParameterError: what is not supported, by name.
    """
    where = f"joint.{name}"
    if part.get("type") not in KINDS:
        raise UnknownNameError(f"{where}.type", part.get("type"), KINDS)
    kind = KINDS[str(part.get("type"))]
    count = 0 if kind == "spherical" else TYPES[kind].count
    axes, limits = list[Array](), dict[str, Any]()
    viscous = coulomb = pitch = 0.0
    for k, tag in enumerate(("axis", "axis2")):
        own, element = f"{where}.{tag}", urdf_xml.find_single_child(part, tag, where)
        if k < count:
            stated = urdf_xml.find_single_child(element, "xyz", own)
            local = urdf_xml.parse_direction("0 0 1" if stated is None else stated.text, f"{own}.xyz")
            frame = "" if stated is None else stated.get("expressed_in", "")
            old = None if element is None else element.findtext("use_parent_model_frame")
            if version == VERSIONS[0] or (old and urdf_xml.parse_boolean(old, f"{own}.use_parent_model_frame")):
                frame = frame or MODEL
            axes.append((turn(frame) if frame else place.rotation) @ local)
        dynamics = urdf_xml.find_single_child(element, "dynamics", own)
        viscous = max(viscous, _read_number(dynamics, "damping", f"{own}.dynamics", 0.0, 0.0))
        coulomb = max(coulomb, _read_number(dynamics, "friction", f"{own}.dynamics", 0.0, 0.0))
        limit = urdf_xml.find_single_child(element, "limit", where)
        if limit is not None and tag == "axis" and kind in ("revolute", "prismatic", "helical"):
            given = {child.tag: (child.text or "").strip() for child in limit}
            # -1 is no limit, and one end of a range may stand alone.
            given = {k: v for k, v in given.items() if k in ("lower", "upper") or v[:1] != "-"}
            given = {"lower": "-inf", "upper": "inf", **given}
            limits = urdf_xml.read_limits(given, where, "revolute" if kind == "helical" else kind)
    if kind == "helical" and part.find("screw_thread_pitch") is None and part.find("thread_pitch") is not None:
        # ``thread_pitch`` is in rad/m, positive for a left-handed thread; its successor is in m per turn.
        thread = _read_number(part, "thread_pitch", where, 1.0)
        if thread == 0.0:
            raise ParameterError(f"{where}.thread_pitch", thread, "rad/m, not zero")
        pitch = -1.0 / thread
    elif kind == "helical":
        pitch = _read_number(part, "screw_thread_pitch", where, 1.0) / TURN
    rows = np.reshape(axes, (-1, 3))
    return Joint(name, kind, *links, (place, place), rows, 0.0, limits, viscous, coulomb, pitch=pitch)


def read_welds(path: Path, top: ET.Element, model: str, places: Mapping[str, Pose], taken: set[str]) -> Iterator[Joint]:
    """Read the pairs of links that Gazebo's plugins hold together, as they are drawn.

    :param taken: names of joints and closures; the welds' own are added.
    :raises UnknownNameError: a parent link that is not there.
    """
    for plugin in top.iter("plugin"):
        kind = (plugin.get("name") or "").rpartition("::")[2]
        tags = {"DetachableJoint": ("parent_link", "child_link"), "AttachLinks": ("parent", "child")}.get(kind)
        if tags is None:
            continue
        ends = [(plugin.findtext(tag) or "").strip() for tag in tags]
        other = (plugin.findtext("child_model") or model).strip()
        if other not in (model, MODEL):
            warn_of_file(path, f"{kind} plugin: {ends[1]!r} of model {other!r} is not part of this machine")
            continue
        for tag, end in zip(tags, ends, strict=True):
            if end not in places:
                raise UnknownNameError(f"plugin.{kind}.{tag}", end, places)
        name = urdf_xml.free_name("_".join(ends), taken)
        yield Joint.fixed(name, ends[0], ends[1], places[ends[1]])
