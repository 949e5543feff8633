# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A machine as a graph of bodies, joints and rods at its home pose, every vector in base axes."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import norm, plain, reference
from pkm_twin.codegen.operations import cos, maximum, minimum, sin
from pkm_twin.errors import ParameterError
from pkm_twin.machine.joints import TYPES, Constraint, Freedom, JointType

T = TypeVar("T", bound=Hashable)
K = TypeVar("K", bound=Hashable)

BASE: Final = "base"
"""Name of the ground."""
PLATFORM: Final = "platform"
"""Name of the platform of a machine that a formula describes."""

POSE: Final = ("x", "y", "z", "roll", "pitch", "yaw")
"""Pose coordinates: the reference point, and R = Rz(yaw) Ry(pitch) Rx(roll) relative to home."""

MIN_LENGTH: Final = 1e-6
"""Smallest length that may be a divisor, m."""


def array(values: ArrayLike) -> Array:
    """Return a read-only array of floats, or of expressions and floats."""
    result = plain(values).copy()
    result.setflags(write=False)
    return result


UP: Final = array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Direction:
    """A named direction in which a joint's reactions are given: fixed in a body, at home."""

    name: str
    body: str
    vector: Array


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body: mass, kg; centre of mass at home, m; inertia about it at home, kg m2."""

    name: str
    mass: float = 0.0
    com: Array = field(default_factory=lambda: array(np.zeros(3)))
    inertia: Array = field(default_factory=lambda: array(np.zeros((3, 3))))


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint between an inner and an outer body, through the point ``at`` at home.

    ``axes``: unit vectors, shape (k, 3), as many as its type has; the first axis of a universal joint
    is fixed in the inner body. ``pitch``: of a screw, m/rad. ``home``: the joint's value at home.
    ``viscous``, ``coulomb``: friction along its freedom; ``rotor_inertia``: kg m2 or kg. ``virtual``:
    a joint in place of other parts that hold the bodies; it carries no load. ``follows``: an actuated
    joint whose value the others determine, see :attr:`Graph.leads`. ``directions``: of reactions;
    default: the joint's axes. ``normal``: name of the direction normal to both axes of a universal
    joint. ``label``: its name among the reactions; default: its own.
    """

    name: str
    kind: str
    inner: str
    outer: str
    at: Array
    axes: Array = field(default_factory=lambda: array(np.zeros((0, 3))))
    actuated: bool = False
    home: float = 0.0
    viscous: float = 0.0
    coulomb: float = 0.0
    rotor_inertia: float = 0.0
    virtual: bool = False
    directions: tuple[Direction, ...] = ()
    label: str = ""
    normal: str = "n"
    pitch: float = 0.0
    follows: bool = False

    @property
    def leads(self) -> bool:
        """True for an actuated joint whose value the other joints do not determine."""
        return self.actuated and not self.follows

    @property
    def type(self) -> type[JointType]:
        """The joint's type, with its freedoms and constraints."""
        return TYPES[self.kind]

    @cached_property
    def freedoms(self) -> tuple[Freedom, ...]:
        """The elementary freedoms, from the inner body to the outer one."""
        return self.type.freedoms(self.axes, self.pitch)

    @cached_property
    def constraints(self) -> tuple[Constraint, ...]:
        """The constraints of the joint."""
        return self.type.constraints(self.axes, self.pitch)

    @property
    def slides(self) -> bool:
        """True for a joint of one freedom whose value is a length."""
        return [freedom.turns for freedom in self.freedoms] == [False]

    @property
    def loaded(self) -> bool:
        """True for a passive joint with friction or a rotor."""
        return not self.actuated and bool(self.viscous or self.coulomb or self.rotor_inertia)


@dataclass(frozen=True, eq=False)
class Rod:
    """A thin uniform straight bar with a ball joint at each end, without spin.

    ``ends``: points at home. ``pair``: unit vector fixed in the outer body along which the two rods
    of a parallelogram stand side by side; they are modelled as one rod in the middle that also
    transmits a couple. ``width``: their distance, m. ``joints``: names of the joints at the ends.
    ``label``: name of the pair's couple among the reactions.
    """

    name: str
    inner: str
    outer: str
    ends: Array
    mass: float = 0.0
    pair: Array | None = None
    width: float = 0.0
    joints: tuple[str, str] = ("", "")
    label: str = ""

    @property
    def joint_names(self) -> tuple[str, str]:
        """Names of the joints at the inner and the outer end."""
        return (self.joints[0] or f"{self.name} at {self.inner}", self.joints[1] or f"{self.name} at {self.outer}")


@dataclass(frozen=True, eq=False)
class Graph:
    """Bodies, joints and rods by name; ``platform`` carries the tool at ``origin`` (at home).

    ``laws``: friction laws of the drives besides the basic one, see :mod:`~pkm_twin.machine.friction`.
    ``sharing``: of a machine with more drives than freedoms, shape (1 + 2 n,): the tolerance of
    redundant positions, effort limits (only their ratios count), preload; else empty.
    """

    bodies: Mapping[str, Body]
    joints: Mapping[str, Joint]
    rods: Mapping[str, Rod]
    platform: str
    origin: Array
    laws: tuple[str, ...] = ()
    sharing: Array = field(default_factory=lambda: array([]))

    @property
    def actuated(self) -> tuple[str, ...]:
        """Names of the actuated joints, in order."""
        return tuple(name for name, joint in self.joints.items() if joint.actuated)

    @property
    def home(self) -> Array:
        """Values of the actuated joints at home, shape (n,)."""
        return np.array([self.joints[name].home for name in self.actuated])

    @property
    def leads(self) -> tuple[str, ...]:
        """The actuated joints that determine the machine, as many as it has freedoms, in order."""
        return tuple(name for name, joint in self.joints.items() if joint.leads)

    @property
    def leading(self) -> list[int]:
        """Indices of the leading joints among the actuated joints."""
        return [k for k, name in enumerate(self.actuated) if self.joints[name].leads]

    @property
    def lead_home(self) -> Array:
        """Values of the leading joints at home, shape (m,)."""
        return np.array([self.joints[name].home for name in self.leads])

    @property
    def size(self) -> float:
        """Characteristic length, m: the largest extent of joints and rod ends along a base axis.

        1 where they are all one point but for rounding, as in a spherical machine.
        """
        points = [joint.at for joint in self.joints.values()]
        points += [end for rod in self.rods.values() for end in rod.ends]
        points.append(self.origin)
        places = np.array(points).T
        extent = reduce(maximum, [reduce(maximum, row) - reduce(minimum, row) for row in places])
        return extent if reference(extent) >= MIN_LENGTH else 1.0

    @property
    def platform_radius(self) -> float:
        """Largest distance of a joint on the platform from the reference point, m."""
        points = self.joint_points(self.platform)
        far = reduce(maximum, [norm(plain(p - self.origin)) for p in points], 0.0)
        return far if reference(far) > 1e-6 * reference(self.size) else 0.1 * self.size

    def body_scale(self, body: str) -> tuple[Array, float]:
        """Return the point of a body at home and the length, m, that scale its velocity and rotation.

        The point, m, is the middle of the body's joints; the length is the distance of the farthest
        of them, and at least that of the platform. If the platform's joints are one point, its length
        is a tenth of the machine's.
        """
        middle, reach = _extent(self._held_points(body))
        own = reach if body == self.platform else _extent(self._held_points(self.platform))[1]
        whole = _extent([point for name in self.bodies for point in self._held_points(name)])[1]
        own = own if reference(own) > 1e-6 * reference(whole) else 0.1 * whole
        return middle, maximum(maximum(reach, own), MIN_LENGTH)

    def _held_points(self, body: str) -> list[Array]:
        """Return where joints and rods meet a body at home, with all that is welded to it, m.

        Virtual joints hold nothing.
        """
        whole, own = self._welded, map_welded_bodies(self)[body]
        true = {name: joint for name, joint in whole.joints.items() if not joint.virtual}
        return replace(whole, joints=true).joint_points(own) or whole.joint_points(own)

    @cached_property
    def _welded(self) -> Graph:
        return weld(self)

    def joint_points(self, body: str) -> list[Array]:
        """Return the points of a body's joints and rods at home, m."""
        points = [j.at for j in self.joints.values() if body in (j.inner, j.outer)]
        for rod in self.rods.values():
            bodies = (rod.inner, rod.outer)
            points += [e for e, b in zip(rod.ends, bodies, strict=True) if b == body]
        return points

    @property
    def links(self) -> list[tuple[str, str]]:
        """Pairs of bodies and rods that a joint connects, inner one first."""
        pairs = [(joint.inner, joint.outer) for joint in self.joints.values()]
        for rod in self.rods.values():
            pairs += [(rod.inner, rod.name), (rod.name, rod.outer)]
        return pairs

    @property
    def topology(self) -> str:
        """Text of the bodies, joints and rods and of their connections, without numbers."""
        joints = [
            (
                j.name,
                j.kind,
                j.inner,
                j.outer,
                j.actuated,
                j.virtual,
                j.loaded,
                *["follows"] * j.follows,
                [d.body for d in j.directions],
            )
            for j in self.joints.values()
        ]
        rods = [(r.name, r.inner, r.outer, r.pair is not None) for r in self.rods.values()]
        return repr((list(self.bodies), joints, rods, self.platform, *self.laws))

    @property
    def numbers(self) -> list[float]:
        """All numbers of the geometry; inertia and friction are not among them."""
        found: list[float] = []
        for joint in self.joints.values():
            found += (*joint.at, *joint.axes.ravel(), joint.home)
            if joint.type.threaded():
                found.append(joint.pitch)
            for direction in joint.directions:
                found += (*direction.vector,)
        for rod in self.rods.values():
            found += (*rod.ends.ravel(), *(() if rod.pair is None else rod.pair))
        return [*found, *self.origin, *self.sharing]

    @property
    def key(self) -> str:
        """Text of the geometry, on which compiled programs depend."""
        return f"{self.topology} {array(self.numbers).tolist()}"

    def check(self) -> None:
        """Reject a graph of valid entries that cannot be a machine.

        :raises ParameterError: an unknown body, an invalid axis, or a body without connection; the
            error names the field.
        """
        if BASE in self.bodies:
            raise ParameterError(f"bodies.{BASE}", BASE, "another name, because base is the ground")
        for joint in self.joints.values():
            path = f"joints.{joint.name}"
            self._check_ends(path, joint.inner, joint.outer)
            # Below 0.001 rad the direction of the axes' normal is mostly the file's rounding.
            if joint.type.count == 2 and float(np.linalg.norm(np.cross(*joint.axes))) < 1e-3:
                raise ParameterError(f"{path}.axes", joint.axes.tolist(), "two axes that are not parallel")
        for rod in self.rods.values():
            self._check_ends(f"rods.{rod.name}", rod.inner, rod.outer)
            if not float(np.linalg.norm(rod.ends[1] - rod.ends[0])) > 1e-9:
                raise ParameterError(f"rods.{rod.name}.ends", rod.ends.tolist(), "two points apart")
        if not self.actuated:
            raise ParameterError("joints", list(self.joints), "at least one with actuated: true")
        pairs = [(joint.inner, joint.outer) for joint in self.joints.values()]
        pairs += [(rod.inner, rod.outer) for rod in self.rods.values()]
        reached = group_connected([BASE, *self.bodies], pairs)[0]
        for name in self.bodies:
            if name not in reached:
                raise ParameterError(f"bodies.{name}", name, "a body that joints or rods connect to the base")

    def _check_ends(self, path: str, inner: str, outer: str) -> None:
        known = [BASE, *self.bodies]
        for name in (inner, outer):
            if name not in known:
                raise ParameterError(f"{path}.between", name, f"one of {', '.join(known)}")
        if inner == outer:
            raise ParameterError(f"{path}.between", [inner, outer], "two different bodies")


def _extent(points: Sequence[Array]) -> tuple[Array, Any]:
    """Return the middle of points, and the distance of the farthest of them from it."""
    middle = plain(np.array(points).sum(0) / len(points))
    return middle, reduce(maximum, [norm(plain(p - middle)) for p in points])


def rotation_about_z(angle: Any) -> Array:
    """Return the rotation by an angle (rad) about base z, shape (3, 3)."""
    c, s = cos(angle), sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def group_connected(things: Iterable[T], pairs: Iterable[tuple[T, T]]) -> list[list[T]]:
    """Group the things that pairs connect, in the order of the things; ignore other pairs."""
    own = {thing: [thing] for thing in things}
    place = {thing: k for k, thing in enumerate(own)}
    for pair in pairs:
        _join(own, *pair)
    found = {id(group): group for group in own.values()}
    return [sorted(group, key=place.__getitem__) for group in found.values()]


def map_welded_bodies(graph: Graph) -> dict[str, str]:
    """Return for each body, the ground too, the first of those that fixed joints unite with it."""
    fixed = [(j.inner, j.outer) for j in graph.joints.values() if j.kind == "fixed"]
    if not fixed:
        return {name: name for name in (BASE, *graph.bodies)}
    return {name: one[0] for one in group_connected([BASE, *graph.bodies], fixed) for name in one}


def weld(graph: Graph) -> Graph:
    """Return the graph with the bodies that fixed joints unite as one body, by the first one's name."""
    own = map_welded_bodies(graph)
    if all(name == first for name, first in own.items()):
        return graph
    joints = {n: replace(j, inner=own[j.inner], outer=own[j.outer]) for n, j in graph.joints.items()}
    return replace(
        graph,
        bodies={name: body for name, body in graph.bodies.items() if own[name] == name},
        joints={name: joint for name, joint in joints.items() if joint.inner != joint.outer},
        rods={n: replace(r, inner=own[r.inner], outer=own[r.outer]) for n, r in graph.rods.items()},
        platform=own[graph.platform],
    )


def choose_spanning_pairs(things: Iterable[T], pairs: Mapping[K, tuple[T, T]]) -> list[K]:
    """Choose the pairs of a spanning forest: each joins what no earlier pair does."""
    own = {thing: [thing] for thing in things}
    return [key for key, pair in pairs.items() if _join(own, *pair)]


def _join(own: dict[T, list[T]], a: T, b: T) -> bool:
    """Unite the groups of two things; return whether both are known and were in different groups."""
    if a not in own or b not in own or own[a] is own[b]:
        return False
    small, large = sorted((own[a], own[b]), key=len)
    large.extend(small)
    own |= dict.fromkeys(small, large)
    return True


def list_limbs(graph: Graph) -> list[list[str]]:
    """Return the bodies and rods of each limb: those connected without the base and the platform."""
    parts = [name for name in (*graph.bodies, *graph.rods) if name not in (BASE, graph.platform)]
    return group_connected(parts, graph.links)


def number_limbs(graph: Graph) -> dict[str, int]:
    """Return the number of the limb of each body and rod; -1 for the platform."""
    number = {name: k for k, limb in enumerate(list_limbs(graph)) for name in limb}
    return number | {graph.platform: -1}
