# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A machine as description files have it: links on a tree of joints, and joints that close loops.

URDF, MJCF and SDF are read into this one form, as drawn, and written from it, at home. Every point
and direction is given in the root's axes as the machine is drawn, so that a joint stands once for
both of its links; only a joint that closes a loop which is drawn open stands elsewhere on the one
than on the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.machine.joints import TYPES, Free, Freedom, JointType, single_names
from pkm_twin.machine.names import plain_name
from pkm_twin.machine.rotations import Pose
from pkm_twin.machine.urdf_xml import free_name

KINDS: Final[Mapping[str, type[JointType]]] = {**TYPES, Free.name: Free}
"""Types of joints, that of a body that closures alone hold among them."""
ROUNDED_INERTIA: Final = 4.0
"""How far rounding of a matrix of three rows may move a principal moment, rounding errors."""
MAX_INERTIA_CHANGE: Final = 1e-2
"""Part of a body's largest moment of which more is no rounding."""
SINGLE: Final = tuple(name for name, kind in TYPES.items() if len(kind.steps) == 1)
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


def link_of(name: str, mass: float, pose: Pose, moment: Callable[[str], float], rounding: float) -> Link:
    """Return a link of a mass, kg, and moments of inertia in the frame of its centre, ``ixx`` on.

    ``rounding``: the largest rounding error of the file's moments of inertia, kg m2.
    """
    if mass < 0.0:
        raise ParameterError(f"link.{name}.inertial.mass", mass, "zero or more, kg")
    xx, xy, xz, yy, yz, zz = (moment(key) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    inertia = _possible(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), rounding)
    return Link(name, pose.inverse(), mass, np.zeros(3), inertia).moved(pose)


def _possible(inertia: Array, rounding: float) -> Array:
    """Return the nearest inertia that a body can have, if rounding made it impossible.

    Of a thin rod a second moment of mass, trace(I) / 2 - I, is zero, or by rounding less.
    """
    moments, axes = np.linalg.eigh(np.trace(inertia) / 2.0 * np.eye(3) - inertia)
    if not -min(ROUNDED_INERTIA * rounding, MAX_INERTIA_CHANGE * moments[2]) <= moments[0] < 0.0:
        return inertia
    kept = (axes * np.maximum(moments, 0.0)) @ axes.T
    return np.asarray(np.trace(kept) * np.eye(3) - kept, np.float64)


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint between two links; its number is the motion of the outer one against the inner one.

    ``frames``: where it stands on the inner and on the outer link. ``axes``: unit vectors; the
    first is fixed in the inner link, the last in the outer one. ``drawn``: its value as drawn.
    ``limits``: those of position, velocity and effort that the file states. ``viscous``,
    ``coulomb``: friction, of one freedom. ``rotor_inertia``: kg m2 or kg. ``offset``: constant
    friction. ``pitch``: of a screw, m a rad. ``cosine``: of the angle between the axes of a
    universal joint that closes a loop.
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

    @property
    def type(self) -> type[JointType]:
        """What it lets move and holds."""
        return KINDS[self.kind]

    @property
    def at(self) -> Array:
        """Its point, (3,) m."""
        return self.frames[0].position

    def freedoms(self, parent: str) -> tuple[Freedom, ...]:
        """Its elementary freedoms from one of its links to the other."""
        found = self.type.freedoms(self.axes, self.pitch)
        if parent == self.inner or self.type.ball:
            return found
        return tuple(replace(one, axis=-one.axis) for one in found[::-1])

    def placed(self, inner: Pose, outer: Pose) -> Joint:
        """Return the joint in the links' frames, from frames in those and axes in its own frame."""
        first, second = inner @ self.frames[0], outer @ self.frames[1]
        axes = [f.rotation @ a for f, a in zip((first, second), self.axes, strict=False)]
        return replace(self, frames=(first, second), axes=np.reshape(axes, (-1, 3)))


@dataclass(frozen=True, eq=False)
class Capsule:
    """A bar of a link to look at, from ``start`` to ``end``, (3,) m."""

    link: str
    start: Array
    end: Array
    radius: float


Fault = tuple[tuple[str, ...], ParameterError]
"""Joints, and the error of a machine that has one of them."""


@dataclass(frozen=True, eq=False)
class LoopTree:
    """A machine; ``root``: the link that is the ground; ``gravity``: m/s2, if the file tells.

    ``initial``: values that ``<ros2_control>`` begins with, of the joints for which it has them.
    ``rounding``: the largest rounding error of a file's places and directions, m or rad.
    ``marked``: what of the file marks the actuated joints. ``faults``: joints that follow others,
    by name, and the error of a machine that has one of them; without names that of a file that
    marks no motors. What is
    written has ``capsules`` too, a ``platform``, the link, and its reference point ``origin``.
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
    def hung(self) -> list[Hung]:
        """The joints of the tree from the root outwards, each level in the order of the file."""
        return hung(self.root, self.joints.values())


class Hung(NamedTuple):
    """A joint of the tree, with its link that is nearer to the root and the one beyond it."""

    joint: Joint
    parent: str
    child: str


class Single(NamedTuple):
    """A joint of one axis or, fixed, of none, between two links."""

    name: str
    kind: str
    axis: Array
    parent: str
    child: str
    joint: Joint
    """What it is a part of."""

    @property
    def whole(self) -> bool:
        """Whether the joint's number, limits and friction are its own."""
        return self.name == self.joint.name

    @property
    def home(self) -> float:
        """Its value as drawn."""
        return self.joint.drawn if self.whole else 0.0


def hung(root: str, joints: Iterable[Joint]) -> list[Hung]:
    """Joints from the root outwards, each level in their order; loops' last ones are left out."""
    meeting: dict[str, list[Joint]] = {}
    for joint in joints:
        for end in (joint.inner, joint.outer):
            meeting.setdefault(end, []).append(joint)
    order: list[Hung] = []
    reached, level = {root}, [root]
    while level:
        after = []
        for link in level:
            for joint in meeting.get(link, ()):
                child = joint.outer if link == joint.inner else joint.inner
                if child not in reached:
                    reached.add(child)
                    after.append(Hung(joint, link, child))
        order += after
        level = [one.child for one in after]
    return order


def singles(joint: Joint, parent: str, child: str, taken: set[str]) -> list[Single]:
    """Replace a joint by single joints in a row outwards, with links between named for them.

    :param taken: names of links; those of these are added.
    """
    freedoms = joint.freedoms(parent)
    if not freedoms:
        return [Single(joint.name, "fixed", np.zeros(3), parent, child, joint)]
    parts = []
    for one in freedoms:
        kinds = ["revolute"] * one.turns + ["prismatic"] * bool(one.slide)
        parts += [(kind, np.asarray(one.axis, np.float64)) for kind in kinds]
    names = single_names(joint.name, freedoms)
    inside = [free_name(f"{plain_name(name)}_link", taken, "_body") for name in names[:-1]]
    ends = [parent, *inside, child]
    return [
        Single(name, kind, axis, ends[k], ends[k + 1], joint)
        for k, (name, (kind, axis)) in enumerate(zip(names, parts, strict=True))
    ]


def screws(parts: Sequence[Single]) -> list[tuple[str, str, float, float]]:
    """Of each screw its slide, its turn, and the line between: slide = offset + factor turn."""
    return [
        (slide.name, turn.name, turn.joint.pitch, -turn.joint.pitch * turn.home)
        for turn, slide in pairwise(parts)
        if slide.joint.type.threaded() and not slide.whole
    ]
