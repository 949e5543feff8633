# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Declare joint types by their freedoms and constraints; a new type is a class listed in TYPES.

Everything else follows: the steps of the tree, the closures of a cut joint, the loads that a joint
transmits, what it releases in an elastic frame, units and passive coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import cross, norm, plain, reference, references

UNIT_VECTORS: Final = np.eye(3)


def unit(vector: ArrayLike) -> Array:
    """Scale a vector to length 1."""
    values = plain(vector)
    return np.asarray(values / norm(values))


def perpendicular_axes(axis: Array) -> tuple[Array, Array]:
    """Return two unit vectors that form a right-handed orthogonal triple with an axis."""
    first = np.zeros(3)
    # Rounding keeps the choice the same where two components differ by the last bit only.
    first[int(np.argmin(np.round([abs(reference(value)) for value in axis], 9)))] = 1.0
    first = unit(cross(axis, first))
    return first, plain(cross(axis, first))


@dataclass(frozen=True, eq=False)
class Freedom:
    """One degree of freedom of the outer body relative to the inner body.

    ``axis``: at home, base axes. ``turns``: whether it rotates about the axis. ``slide``:
    translation along the axis per unit of the coordinate: 1 for a slide, m/rad for a screw, else 0.
    ``outer``: whether the axis is fixed in the outer body.
    """

    axis: Array
    turns: bool = True
    slide: float = 0.0
    outer: bool = False

    @property
    def unit(self) -> str:
        """Unit of the coordinate, ``rad`` or ``m``."""
        return "rad" if self.turns else "m"

    def nearest(self, directions: Array) -> int:
        """Return the index of the direction, of (k, 3) in base axes, nearest to the axis."""
        return int(np.abs(references(directions @ self.axis)).argmax())


@dataclass(frozen=True, eq=False)
class Constraint:
    """A constraint of a joint, at home and in base axes; ``kind`` is one of four.

    ``point``: the bodies' points coincide (three equations). ``plane``: the outer body's point
    stays in the plane normal to ``inner``. ``angle``: ``inner`` and ``outer``, each fixed in its
    body, keep their angle. ``screw``: the outer body's point moves by ``slide`` along ``inner`` per
    rad by which ``outer``, normal to it, rotates. ``axes``: index of the joint's axis to which each
    vector belongs.
    """

    kind: str
    inner: Array = field(default_factory=lambda: UNIT_VECTORS[0])
    outer: Array = field(default_factory=lambda: UNIT_VECTORS[0])
    axes: tuple[int, int] = (0, 0)
    slide: float = 0.0


class JointType:
    """The base class of joint types, each declared by its freedoms and constraints.

    ``steps``: freedoms from the inner to the outer body: "turn", "slide" or "screw". ``holds``:
    constraints, keys of CONSTRAINTS. ``count``: number of axes: one for all freedoms; two, of which the
    second is fixed in the outer body; or none, with freedoms along base axes. ``placed``: whether
    the joint's point matters. ``ball``: whether the tree describes it by a quaternion. ``cost``:
    unknowns that it adds to the tree, which takes joints of lower cost first.
    """

    name: ClassVar[str]
    steps: ClassVar[tuple[str, ...]]
    holds: ClassVar[tuple[str, ...]]
    count: ClassVar[int] = 1
    placed: ClassVar[bool] = True
    ball: ClassVar[bool] = False
    cost: ClassVar[int] = 1

    @classmethod
    def threaded(cls) -> bool:
        """Return whether the joint has a pitch."""
        return "screw" in cls.steps

    @classmethod
    def freedoms(cls, axes: Array, pitch: float) -> tuple[Freedom, ...]:
        """Return the joint's freedoms from the inner to the outer body.

        :param axes: unit vectors, shape (count, 3).
        :param pitch: of a screw, m/rad.
        """
        along = {0: UNIT_VECTORS, 1: np.repeat(axes, len(cls.steps), axis=0)}.get(cls.count, axes)
        slides = {"turn": 0.0, "slide": 1.0, "screw": pitch}
        return tuple(
            Freedom(axis, step != "slide", slides[step], cls.count == 2 and k == 1)
            for k, (axis, step) in enumerate(zip(along, cls.steps, strict=False))
        )

    @classmethod
    def directions(cls, axes: Array) -> Array:
        """Return the unit vectors along which loads and compliances are given, shape (3, 3)."""
        if not cls.count:
            return UNIT_VECTORS
        first, other = axes[0], axes[-1]
        if cls.count == 1:
            return np.array([first, *perpendicular_axes(first)])
        second = unit(other - (other @ first) * first)
        return np.array([first, second, np.cross(first, second)])

    @classmethod
    def constraints(cls, axes: Array, pitch: float) -> tuple[Constraint, ...]:
        """Return the joint's constraints; arguments as for :meth:`freedoms`."""
        return tuple(constraint for key in cls.holds for constraint in CONSTRAINTS[key](axes, pitch))


CONSTRAINTS: Final[dict[str, Callable[[Array, float], Sequence[Constraint]]]] = {
    "point": lambda _, __: [Constraint("point")],
    "turns": lambda _, __: [Constraint("angle", UNIT_VECTORS[i], UNIT_VECTORS[(i + 1) % 3]) for i in range(3)],
    "line": lambda axes, _: [Constraint("plane", e) for e in perpendicular_axes(axes[0])],
    "flat": lambda axes, _: [Constraint("plane", axes[0])],
    "direction": lambda axes, _: [Constraint("angle", e, axes[0]) for e in perpendicular_axes(axes[0])],
    "crossing": lambda axes, _: [Constraint("angle", axes[0], axes[1], axes=(0, 1))],
    "thread": lambda axes, pitch: [Constraint("screw", axes[0], perpendicular_axes(axes[0])[0], slide=pitch)],
}
"""Constraints as functions of a joint's axes and pitch, by name."""


class Fixed(JointType):
    """A fixed connection."""

    name, steps, holds = "fixed", (), ("point", "turns")
    count, placed, cost = 0, False, 0


class Revolute(JointType):
    """A joint that rotates about its axis."""

    name, steps, holds = "revolute", ("turn",), ("point", "direction")


class Prismatic(JointType):
    """A joint that slides along its axis."""

    name, steps, holds = "prismatic", ("slide",), ("line", "turns")
    placed = False


class Cylindrical(JointType):
    """A joint that slides along its axis and rotates about it."""

    name, steps, holds = "cylindrical", ("slide", "turn"), ("line", "direction")
    cost = 2


class Universal(JointType):
    """A joint that rotates about two crossing axes, one fixed in each body."""

    name, steps, holds = "universal", ("turn", "turn"), ("point", "crossing")
    count, cost = 2, 2


class Spherical(JointType):
    """A joint that rotates about every axis."""

    name, steps, holds = "spherical", ("turn", "turn", "turn"), ("point",)
    count, ball, cost = 0, True, 3


class Translation(JointType):
    """A joint that slides along every axis, as a body whose rotation parallelograms prevent."""

    name, steps, holds = "translation", ("slide", "slide", "slide"), ("turns",)
    count, placed = 0, False


class Helical(JointType):
    """A screw: rotates about its axis and slides along it in proportion."""

    name, steps, holds = "helical", ("screw",), ("line", "direction", "thread")
    cost = 0


class Planar(JointType):
    """A joint that slides along two axes normal to its axis and rotates about it."""

    name, steps, holds = "planar", ("slide", "slide", "turn"), ("flat", "direction")
    cost = 3

    @classmethod
    def freedoms(cls, axes: Array, pitch: float) -> tuple[Freedom, ...]:
        """Return two slides, then the rotation."""
        slides = (Freedom(axis, turns=False, slide=1.0) for axis in perpendicular_axes(axes[0]))
        return (*slides, Freedom(axes[0]))


class Free(JointType):
    """The six freedoms of a body without a joint to its parent; not available in files."""

    name, steps, holds = "free", ("slide",) * 3 + ("turn",) * 3, ()
    count, cost = 0, 6

    @classmethod
    def freedoms(cls, axes: Array, pitch: float) -> tuple[Freedom, ...]:
        """Return three slides, then three rotations."""
        slides = (Freedom(axis, turns=False, slide=1.0) for axis in UNIT_VECTORS)
        return (*slides, *(Freedom(axis) for axis in UNIT_VECTORS))


TYPES: Final = {
    kind.name: kind
    for kind in (Fixed, Revolute, Prismatic, Cylindrical, Universal, Spherical, Translation, Helical, Planar)
}
"""Joint types by name."""

TURN: Final = 2.0 * math.pi
"""One revolution, rad: a screw's lead is its pitch times this."""


def name_single_freedoms(name: str, freedoms: Sequence[Freedom]) -> list[str]:
    """Name a joint's freedoms as single rotations and slides; a screw has one of each."""
    if len(freedoms) == 1:
        return [name, f"{name}_slide"] if freedoms[0].turns and freedoms[0].slide else [name]
    marks = {3: ("x", "y", "z"), 6: ("px", "py", "pz", "x", "y", "z")}
    own = marks.get(len(freedoms), [str(k + 1) for k in range(len(freedoms))])
    return [f"{name}_{mark}" for mark in own]
