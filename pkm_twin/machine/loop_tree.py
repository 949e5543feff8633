# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A machine as description files have it: links on a tree of joints, and joints that close loops.

URDF, MJCF, SDF and USD are read into this form, as drawn; files are written from it, at home. Every
point and direction is given in the root's axes as the machine is drawn, so that both links of a joint
share its frame. Only a joint that closes a loop drawn open has two different frames.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, warn_of_file
from pkm_twin.machine.graph import choose_spanning_pairs
from pkm_twin.machine.joints import TYPES, Free, Freedom, JointType, name_single_freedoms
from pkm_twin.machine.names import plain_name
from pkm_twin.machine.rotations import Pose
from pkm_twin.machine.urdf_xml import free_name

KINDS: Final[Mapping[str, type[JointType]]] = {**TYPES, Free.name: Free}
"""Joint types of description files, with that of a body that only closures hold."""
WORLD: Final = "world"
"""Name of the root of a tree read from MJCF, SDF or USD."""
SINGLE_FREEDOM_TYPES: Final = tuple(name for name, kind in TYPES.items() if len(kind.steps) == 1)
"""Joint types of one degree of freedom."""


def _zeros(*shape: int) -> Any:
    return field(default_factory=lambda: np.zeros(shape))


@dataclass(frozen=True, eq=False)
class Link:
    """A link: its ``frame``, ``mass`` (kg), ``com`` (3,) m and ``inertia`` (3, 3) about it."""

    name: str
    frame: Pose = field(default_factory=Pose)
    mass: float = 0.0
    com: Array = _zeros(3)
    inertia: Array = _zeros(3, 3)

    def moved(self, pose: Pose) -> Link:
        """Return the same link in another place."""
        inertia = pose.rotation @ self.inertia @ pose.rotation.T
        return Link(self.name, pose @ self.frame, self.mass, pose.point(self.com), inertia)


def make_link(name: str, mass: float, pose: Pose, moment: Callable[[str], float], rounding: float) -> Link:
    """Make a link from its mass, kg, and its inertia in the frame ``pose`` of its centre of mass.

    ``moment``: returns an entry of the inertia, ``ixx`` to ``izz``, kg m2. ``rounding``: the largest
    rounding error of the file's moments of inertia, kg m2.
    """
    if mass < 0.0:
        raise ParameterError(f"link.{name}.inertial.mass", mass, "zero or more, kg")
    xx, xy, xz, yy, yz, zz = (moment(key) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    # A second moment of mass, an eigenvalue of trace(I) / 2 - I, is zero for a thin rod, and rounding
    # makes it negative: by up to four rounding errors in a matrix of three rows. More than a hundredth
    # of the largest moment is no rounding. The nearest possible inertia has zero in its place.
    moments, axes = np.linalg.eigh(np.trace(inertia) / 2.0 * np.eye(3) - inertia)
    if -min(4.0 * rounding, 1e-2 * moments[2]) <= moments[0] < 0.0:
        second = (axes * np.maximum(moments, 0.0)) @ axes.T
        inertia = np.trace(second) * np.eye(3) - second
    return Link(name, pose.inverse(), mass, np.zeros(3), inertia).moved(pose)


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint between two links; its value is the motion of the outer link against the inner one.

    ``frames``: its frames on the inner and on the outer link. ``axes``: unit vectors; the first is
    fixed in the inner link, the last in the outer one. ``drawn``: its value as drawn. ``limits``:
    position, velocity and effort, if the file states them. ``viscous``, ``coulomb``: friction of a
    joint of one freedom. ``rotor_inertia``: kg m2 or kg. ``offset``: constant friction. ``pitch``:
    of a screw, m/rad. ``cosine``: of the angle between the axes of a universal joint that closes a
    loop.
    """

    name: str
    kind: str
    inner: str
    outer: str
    frames: tuple[Pose, Pose]
    axes: Array = _zeros(0, 3)
    drawn: float = 0.0
    limits: dict[str, Any] = field(default_factory=dict)
    viscous: float = 0.0
    coulomb: float = 0.0
    rotor_inertia: float = 0.0
    offset: float = 0.0
    pitch: float = 0.0
    cosine: float = 0.0

    @classmethod
    def fixed(cls, name: str, inner: str, outer: str, frame: Pose) -> Joint:
        """Make a fixed connection of two links at a frame."""
        return cls(name, "fixed", inner, outer, (frame, frame))

    @property
    def type(self) -> type[JointType]:
        """The joint's freedoms and constraints."""
        return KINDS[self.kind]

    @property
    def at(self) -> Array:
        """The joint's point on the inner link, (3,) m."""
        return self.frames[0].position

    def freedoms(self, parent: str) -> tuple[Freedom, ...]:
        """Return the joint's freedoms in order from the link ``parent`` to the other link."""
        found = self.type.freedoms(self.axes, self.pitch)
        if parent == self.inner or self.type.ball:
            return found
        return tuple(replace(one, axis=-one.axis) for one in found[::-1])

    def make_loop_closing(self) -> Joint:
        """Convert the joint to one that closes a loop.

        :raises ParameterError: the joint is a screw.
        """
        if self.type.threaded():
            raise ParameterError(f"joint.{self.name}.type", "screw", "a loop with other joints too")
        return replace(self, cosine=float(self.axes[0] @ self.axes[1]) if self.type.count == 2 else 0.0)

    def placed(self, inner: Pose, outer: Pose) -> Joint:
        """Convert frames in the links' frames, and axes in the joint's frames, to the root's axes."""
        first, second = inner @ self.frames[0], outer @ self.frames[1]
        axes = [f.rotation @ a for f, a in zip((first, second), self.axes, strict=False)]
        return replace(self, frames=(first, second), axes=np.reshape(axes, (-1, 3)))


@dataclass(frozen=True, eq=False)
class Capsule:
    """A bar of a link's picture, from ``start`` to ``end``, (3,) m."""

    link: str
    start: Array
    end: Array
    radius: float


Fault = tuple[tuple[str, ...], ParameterError]
"""Names of joints, and the error of a machine that has one of them; no names: the file marks no motors."""


@dataclass(frozen=True, eq=False)
class LoopTree:
    """A machine; ``root``: the link that is the ground; ``gravity``: m/s2, if the file states it.

    ``initial``: initial joint values of ``<ros2_control>``, by joint. ``rounding``: the largest
    rounding error of the file's positions and directions, m or rad. ``marked``: what marks the
    actuated joints in the file. A machine to be written also has ``capsules``, its ``platform``, a
    link, and the platform's reference point ``origin``.
    """

    name: str
    root: str
    links: dict[str, Link]
    joints: dict[str, Joint]
    closures: tuple[Joint, ...]
    actuated: tuple[str, ...]
    gravity: list[float] | None = None
    initial: Mapping[str, float] = field(default_factory=dict)
    rounding: float = 0.0
    marked: str = ""
    faults: tuple[Fault, ...] = ()
    capsules: tuple[Capsule, ...] = ()
    platform: str = ""
    origin: Array = _zeros(3)

    @property
    def tree_joints(self) -> list[TreeJoint]:
        """The joints of the tree from the root outwards, each level in the order of the file."""
        return order_from_root(self.root, self.joints.values())


class TreeJoint(NamedTuple):
    """A joint of the tree, its link ``parent`` on the root's side, and the link beyond it."""

    joint: Joint
    parent: str
    child: str


class SingleAxisJoint(NamedTuple):
    """A joint of one axis or, fixed, of none, between two links."""

    name: str
    kind: str
    axis: Array
    parent: str
    child: str
    joint: Joint
    """The joint of which this is one freedom."""

    @property
    def is_only_freedom(self) -> bool:
        """True if the joint has this freedom alone, so that its limits and friction belong here."""
        return self.name == self.joint.name

    @property
    def home(self) -> float:
        """The value as drawn."""
        return self.joint.drawn if self.is_only_freedom else 0.0


def order_from_root(root: str, joints: Iterable[Joint]) -> list[TreeJoint]:
    """List joints from the root outwards, breadth first, without those that close a loop."""
    meeting: dict[str, list[Joint]] = {}
    for joint in joints:
        for end in (joint.inner, joint.outer):
            meeting.setdefault(end, []).append(joint)
    order: list[TreeJoint] = []
    reached, level = {root}, [root]
    while level:
        after = []
        for link in level:
            for joint in meeting.get(link, ()):
                child = joint.outer if link == joint.inner else joint.inner
                if child not in reached:
                    reached.add(child)
                    after.append(TreeJoint(joint, link, child))
        order += after
        level = [one.child for one in after]
    return order


def split_freedoms(joint: Joint, parent: str, child: str, taken: set[str]) -> list[SingleAxisJoint]:
    """Replace a joint by joints of one freedom in series, with named links between them.

    :param taken: names of links, to which those of the links between are added.
    """
    freedoms = joint.freedoms(parent)
    if not freedoms:
        return [SingleAxisJoint(joint.name, "fixed", np.zeros(3), parent, child, joint)]
    parts = []
    for one in freedoms:
        kinds = ["revolute"] * one.turns + ["prismatic"] * bool(one.slide)
        parts += [(kind, np.asarray(one.axis, np.float64)) for kind in kinds]
    names = name_single_freedoms(joint.name, freedoms)
    inside = [free_name(f"{plain_name(name)}_link", taken, "_body") for name in names[:-1]]
    ends = [parent, *inside, child]
    return [
        SingleAxisJoint(name, kind, axis, ends[k], ends[k + 1], joint)
        for k, (name, (kind, axis)) in enumerate(zip(names, parts, strict=True))
    ]


def list_screws(parts: Sequence[SingleAxisJoint]) -> list[tuple[str, str, float, float]]:
    """Return slide, turn, factor and offset of each screw: slide = offset + factor turn."""
    return [
        (slide.name, turn.name, turn.joint.pitch, -turn.joint.pitch * turn.home)
        for turn, slide in pairwise(parts)
        if slide.joint.type.threaded() and not slide.is_only_freedom
    ]


def hold_in_world(path: Path, joints: dict[str, Joint], choose_link: Callable[[], Link]) -> None:
    """Fix a link to the world, with a warning, if no joint holds the machine there."""
    if any(WORLD in (joint.inner, joint.outer) for joint in joints.values()):
        return
    ground = choose_link()
    warn_of_file(path, f"no joint holds the machine in the world: link {ground.name} is taken for the ground")
    name = free_name("world_fixed", {*joints})
    joints[name] = Joint.fixed(name, WORLD, ground.name, ground.frame)


def span_tree(
    links: Iterable[str], joints: Mapping[str, Joint], actuated: Sequence[str], excluded: Collection[str] = ()
) -> tuple[dict[str, Joint], list[Joint]]:
    """Choose a spanning tree of a graph of joints; return its joints by name, and those left over.

    Fixed joints come first, then actuated ones, then those of fewest freedoms; ``excluded`` ones last.

    :raises ParameterError: no joints connect a link to the world.
    """

    def rank(joint: Joint) -> tuple[bool, bool, bool, int]:
        return joint.name in excluded, joint.kind != "fixed", joint.name not in actuated, joint.type.cost

    pairs = {joint.name: (joint.inner, joint.outer) for joint in sorted(joints.values(), key=rank)}
    chosen = set(choose_spanning_pairs(links, pairs))
    tree = {name: joint for name, joint in joints.items() if name in chosen}
    reached = {WORLD, *(one.child for one in order_from_root(WORLD, tree.values()))}
    for name in links:
        if name not in reached:
            raise ParameterError(f"link.{name}", None, "a joint that connects it")
    return tree, [joint for name, joint in joints.items() if name not in chosen]
