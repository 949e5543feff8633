# SPDX-License-Identifier: Apache-2.0
"""A machine as a graph of bodies, joints and rods at its home pose, every vector in base axes.

May import: numpy, pkm_twin's errors, the standard library.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.errors import ParameterError

Array = NDArray[np.float64]

BASE: Final = "base"
"""Name of the ground."""

FREEDOMS: Final = {
    "fixed": "",
    "revolute": "R",
    "prismatic": "P",
    "cylindrical": "PR",
    "universal": "RR",
    "spherical": "S",
    "translation": "PPP",
}
"""Joint types: the steps from the inner body to the outer one; R turns, P slides, S is a ball."""
AXES: Final = {"revolute": 1, "prismatic": 1, "cylindrical": 1, "universal": 2}
"""How many axes a type has, where it has any."""
POSE: Final = ("x", "y", "z", "roll", "pitch", "yaw")
"""Pose coordinates: the reference point, and R = Rz(yaw) Ry(pitch) Rx(roll) relative to home."""

MIN_LENGTH: Final = 1e-6
"""Least length that may be divided by, m."""
_PARALLEL: Final = 1e-3


def array(values: ArrayLike) -> Array:
    """A read-only array of floats."""
    result = np.array(values, np.float64)
    result.setflags(write=False)
    return result


def unit(vector: ArrayLike) -> Array:
    """The vector at length one."""
    values = np.asarray(vector, np.float64)
    return np.asarray(values / np.linalg.norm(values), np.float64)


def across(axis: Array) -> tuple[Array, Array]:
    """Two unit vectors across an axis and each other, right-handed with it."""
    first = np.zeros(3)
    # Rounded: where two components are equal, the last bit must not choose.
    first[int(np.argmin(np.round(np.abs(axis), 9)))] = 1.0
    first = unit(np.cross(axis, first))
    return first, np.cross(axis, first)


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

    ``axes``: shape (k, 3), see AXES; of a universal joint the first is fixed in the inner body.
    ``home``: the joint's value at home. ``viscous``, ``coulomb``: friction along its freedom;
    ``rotor_inertia``: against its acceleration, kg m2 or kg.
    ``given``: a joint that stands for what other parts hold: it carries no load itself.
    ``directions``: of reactions; without them the joint's own axes. ``normal``: name of a universal
    joint's direction across both axes. ``label``: its name among the reactions, else its own.
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
    given: bool = False
    directions: tuple[Direction, ...] = ()
    label: str = ""
    normal: str = "n"

    @property
    def loaded(self) -> bool:
        """Whether a passive joint has friction or a rotor."""
        return not self.actuated and bool(self.viscous or self.coulomb or self.rotor_inertia)


@dataclass(frozen=True, eq=False)
class Rod:
    """A thin even straight bar with a ball joint at each end, without spin.

    ``pair``: unit vector fixed in the outer body along which the two rods of a parallelogram
    stand side by side; taken as one rod between the middles of its ends, the pair holds a couple
    beside. ``width``: their distance, m. ``body``: name of its body; ``ends``: points at home;
    ``joints``: names of the joints at its ends; ``label``: of the pair's
    couple among the reactions.
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
        return (
            self.joints[0] or f"{self.name} at {self.inner}",
            self.joints[1] or f"{self.name} at {self.outer}",
        )


@dataclass(frozen=True, eq=False)
class Graph:
    """Bodies, joints and rods by name; ``platform`` carries the tool at ``origin`` (at home)."""

    bodies: Mapping[str, Body]
    joints: Mapping[str, Joint]
    rods: Mapping[str, Rod]
    platform: str
    origin: Array

    @property
    def actuated(self) -> tuple[str, ...]:
        """Names of the actuated joints, in order."""
        return tuple(name for name, joint in self.joints.items() if joint.actuated)

    @property
    def home(self) -> Array:
        """Values of the actuated joints at home, shape (n,)."""
        return np.array([self.joints[name].home for name in self.actuated])

    @property
    def size(self) -> float:
        """Characteristic length, m: greatest distance of two joints' points, or of a rod's ends.

        1 where all are one point, as in a spherical machine, whatever rounding makes of it.
        """
        points = [joint.at for joint in self.joints.values()]
        points += [end for rod in self.rods.values() for end in rod.ends]
        points.append(self.origin)
        extent = float(np.ptp(np.array(points), axis=0).max())
        return extent if extent >= MIN_LENGTH else 1.0

    @property
    def rim(self) -> float:
        """Greatest distance of a joint on the platform from its reference point, m."""
        points = self.joint_points(self.platform)
        far = max((float(np.linalg.norm(p - self.origin)) for p in points), default=0.0)
        return far if far > 1e-6 * self.size else 0.1 * self.size

    def joint_points(self, body: str) -> list[Array]:
        """Where joints and rods meet a body at home, m."""
        points = [j.at for j in self.joints.values() if body in (j.inner, j.outer)]
        for rod in self.rods.values():
            bodies = (rod.inner, rod.outer)
            points += [e for e, b in zip(rod.ends, bodies, strict=True) if b == body]
        return points

    @property
    def key(self) -> str:
        """Text of the geometry: all that compiled programs hang on, inertia and friction not."""
        joints = [
            (
                j.name, j.kind, j.inner, j.outer, j.at.tolist(), j.axes.tolist(), j.actuated,
                j.home, j.given, j.loaded, [(d.body, d.vector.tolist()) for d in j.directions],
            )
            for j in self.joints.values()
        ]  # fmt: skip
        rods = [
            (r.name, r.inner, r.outer, r.ends.tolist(), None if r.pair is None else r.pair.tolist())
            for r in self.rods.values()
        ]
        return repr((list(self.bodies), joints, rods, self.platform, self.origin.tolist()))

    def check(self) -> None:
        """Refuse what no machine can be, by the name of the field.

        :raises ParameterError: unknown bodies, axes that are none, bodies without connection.
        """
        if self.platform not in self.bodies:
            raise ParameterError("platform", self.platform, f"one of {', '.join(self.bodies)}")
        if BASE in self.bodies:
            raise ParameterError(f"bodies.{BASE}", BASE, "a name that is not the ground's")
        for joint in self.joints.values():
            self._check_ends(f"joints.{joint.name}", joint.inner, joint.outer)
            self._check_axes(joint)
        for rod in self.rods.values():
            self._check_ends(f"rods.{rod.name}", rod.inner, rod.outer)
            if not float(np.linalg.norm(rod.ends[1] - rod.ends[0])) > 1e-9:
                raise ParameterError(f"rods.{rod.name}.ends", rod.ends.tolist(), "two points apart")
        if not self.actuated:
            raise ParameterError("joints", list(self.joints), "at least one with actuated: true")
        self._check_connection()

    def _check_ends(self, path: str, inner: str, outer: str) -> None:
        known = [BASE, *self.bodies]
        for name in (inner, outer):
            if name not in known:
                raise ParameterError(f"{path}.between", name, f"one of {', '.join(known)}")
        if inner == outer:
            raise ParameterError(f"{path}.between", [inner, outer], "two different bodies")

    @staticmethod
    def _check_axes(joint: Joint) -> None:
        path = f"joints.{joint.name}"
        if joint.kind not in FREEDOMS:
            raise ParameterError(f"{path}.type", joint.kind, f"one of {', '.join(FREEDOMS)}")
        count = AXES.get(joint.kind, 0)
        if len(joint.axes) != count:
            name = "axes" if count == 2 else "axis"
            raise ParameterError(f"{path}.{name}", joint.axes.tolist(), f"{count} for {joint.kind}")
        if count == 2 and float(np.linalg.norm(np.cross(*joint.axes))) < _PARALLEL:
            raise ParameterError(
                f"{path}.axes", joint.axes.tolist(), "two axes that are not parallel"
            )
        if joint.actuated and FREEDOMS[joint.kind] not in ("R", "P"):
            raise ParameterError(f"{path}.actuated", joint.kind, "a revolute or prismatic joint")

    def _check_connection(self) -> None:
        reached, todo = {BASE}, [BASE]
        links = [(j.inner, j.outer) for j in self.joints.values()]
        links += [(r.inner, r.outer) for r in self.rods.values()]
        while todo:
            body = todo.pop()
            for a, b in links:
                for here, there in ((a, b), (b, a)):
                    if here == body and there not in reached:
                        reached.add(there)
                        todo.append(there)
        for name in self.bodies:
            if name not in reached:
                raise ParameterError(
                    f"bodies.{name}", name, "a body that joints or rods connect to the base"
                )


def rotation_about_z(angle: float) -> Array:
    """Rotation by an angle (rad) about base z, shape (3, 3)."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
