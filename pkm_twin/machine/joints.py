# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Joint types: what each lets move and what it holds. A new type is a class and a line in TYPES.

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
from pkm_twin.codegen.expressions import norm, plain, reference, references

UNITS: Final = np.eye(3)


def unit(vector: ArrayLike) -> Array:
    """The vector at length one."""
    values = plain(vector)
    return np.asarray(values / norm(values))


def across(axis: Array) -> tuple[Array, Array]:
    """Two unit vectors across an axis and each other, right-handed with it."""
    first = np.zeros(3)
    # Rounded: where two components are equal, the last bit must not choose.
    first[int(np.argmin(np.round([abs(reference(value)) for value in axis], 9)))] = 1.0
    first = unit(np.cross(axis, first))
    return first, np.cross(axis, first)


@dataclass(frozen=True, eq=False)
class Freedom:
    """One elementary freedom, of the outer body against the inner one.

    ``axis``: at home, base axes. ``turns``: whether it turns about the axis. ``slide``: how far it
    goes along the axis per unit of its number: 1 for a slide, m a rad for a screw, else 0.
    ``outer``: whether the axis is fixed in the outer body.
    """

    axis: Array
    turns: bool = True
    slide: float = 0.0
    outer: bool = False

    @property
    def unit(self) -> str:
        """Of its number, ``rad`` or ``m``."""
        return "rad" if self.turns else "m"

    def nearest(self, directions: Array) -> int:
        """The direction, of several (k, 3) in base axes, to which its axis is nearest."""
        return int(np.abs(references(directions @ self.axis)).argmax())


@dataclass(frozen=True, eq=False)
class Constraint:
    """What a joint holds, in one of four ways, at home and in base axes.

    ``point``: the bodies' points are at one place (three equations). ``plane``: the outer body's
    point stays in the plane across ``inner``. ``angle``: ``inner`` and ``outer``, each fixed in its
    body, keep their angle. ``screw``: the outer body's point goes ``slide`` along ``inner`` per rad
    that ``outer``, across it, turns. ``axes``: which of the joint's axes carries each vector.
    """

    kind: str
    inner: Array = field(default_factory=lambda: UNITS[0])
    outer: Array = field(default_factory=lambda: UNITS[0])
    axes: tuple[int, int] = (0, 0)
    slide: float = 0.0


class JointType:
    """A joint type, declared by what it lets move and holds.

    ``steps``: its freedoms from the inner body to the outer one, of "turn", "slide" and "screw".
    ``holds``: keys of HELD. ``count``: how many axes it has: with one, all is about that; with two,
    the second is fixed in the outer body; with none, freedoms are along base axes. ``placed``:
    whether its point matters. ``ball``: whether it is a quaternion in the tree. ``cost``: its
    unknowns in the tree, where joints of the least come first.
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
        """Whether it has a pitch."""
        return "screw" in cls.steps

    @classmethod
    def freedoms(cls, axes: Array, pitch: float) -> tuple[Freedom, ...]:
        """From the inner body to the outer one.

        :param axes: unit vectors, shape (count, 3). ``pitch``: of a screw, m a rad.
        """
        along = {0: UNITS, 1: np.repeat(axes, len(cls.steps), axis=0)}.get(cls.count, axes)
        slides = {"turn": 0.0, "slide": 1.0, "screw": pitch}
        return tuple(
            Freedom(axis, step != "slide", slides[step], cls.count == 2 and k == 1)
            for k, (axis, step) in enumerate(zip(along, cls.steps, strict=False))
        )

    @classmethod
    def directions(cls, axes: Array) -> Array:
        """Unit vectors along which loads and compliances are given, shape (3, 3)."""
        if not cls.count:
            return UNITS
        first, other = axes[0], axes[-1]
        if cls.count == 1:
            return np.array([first, *across(first)])
        second = unit(other - (other @ first) * first)
        return np.array([first, second, np.cross(first, second)])

    @classmethod
    def constraints(cls, axes: Array, pitch: float) -> tuple[Constraint, ...]:
        """What is left of six freedoms; arguments as of :meth:`freedoms`."""
        return tuple(held for key in cls.holds for held in HELD[key](axes, pitch))


HELD: Final[dict[str, Callable[[Array, float], Sequence[Constraint]]]] = {
    "point": lambda _, __: [Constraint("point")],
    "turns": lambda _, __: [
        Constraint("angle", UNITS[i], UNITS[(i + 1) % 3]) for i in range(3)
    ],
    "line": lambda axes, _: [Constraint("plane", e) for e in across(axes[0])],
    "flat": lambda axes, _: [Constraint("plane", axes[0])],
    "direction": lambda axes, _: [Constraint("angle", e, axes[0]) for e in across(axes[0])],
    "crossing": lambda axes, _: [Constraint("angle", axes[0], axes[1], axes=(0, 1))],
    "thread": lambda axes, pitch: [
        Constraint("screw", axes[0], across(axes[0])[0], slide=pitch)
    ],
}  # fmt: skip
"""Constraints of a joint's axes and pitch, by what is kept."""


class Fixed(JointType):
    """Holds everything."""

    name, steps, holds = "fixed", (), ("point", "turns")
    count, placed, cost = 0, False, 0


class Revolute(JointType):
    """Turns about its axis."""

    name, steps, holds = "revolute", ("turn",), ("point", "direction")


class Prismatic(JointType):
    """Slides along its axis."""

    name, steps, holds = "prismatic", ("slide",), ("line", "turns")
    placed = False


class Cylindrical(JointType):
    """Slides along its axis and turns about it."""

    name, steps, holds = "cylindrical", ("slide", "turn"), ("line", "direction")
    cost = 2


class Universal(JointType):
    """Turns about two axes that cross: one fixed in the inner body, one in the outer."""

    name, steps, holds = "universal", ("turn", "turn"), ("point", "crossing")
    count, cost = 2, 2


class Spherical(JointType):
    """Turns about every axis."""

    name, steps, holds = "spherical", ("turn", "turn", "turn"), ("point",)
    count, ball, cost = 0, True, 3


class Translation(JointType):
    """Slides along every axis: what parallelograms keep from turning."""

    name, steps, holds = "translation", ("slide", "slide", "slide"), ("turns",)
    count, placed = 0, False


class Helical(JointType):
    """Turns about its axis and slides along it in proportion, as a screw."""

    name, steps, holds = "helical", ("screw",), ("line", "direction", "thread")
    cost = 0


class Planar(JointType):
    """Slides along two axes across its axis and turns about it."""

    name, steps, holds = "planar", ("slide", "slide", "turn"), ("flat", "direction")
    cost = 3

    @classmethod
    def freedoms(cls, axes: Array, pitch: float) -> tuple[Freedom, ...]:
        """Slides first."""
        slides = (Freedom(axis, turns=False, slide=1.0) for axis in across(axes[0]))
        return (*slides, Freedom(axes[0]))


class Free(JointType):
    """Of a body that nothing but the joints after it holds: slides, then turns; no entry of a file.

    A file's joints are those in TYPES.
    """

    name, steps, holds = "free", ("slide",) * 3 + ("turn",) * 3, ()
    count, cost = 0, 6

    @classmethod
    def freedoms(cls, axes: Array, pitch: float) -> tuple[Freedom, ...]:
        """Slides first."""
        slides = (Freedom(axis, turns=False, slide=1.0) for axis in UNITS)
        return (*slides, *(Freedom(axis) for axis in UNITS))


TYPES: Final = {
    kind.name: kind
    for kind in (
        Fixed, Revolute, Prismatic, Cylindrical, Universal, Spherical, Translation, Helical, Planar,
    )
}  # fmt: skip
"""Joint types by name."""

TURN: Final = 2.0 * math.pi
"""A full turn, rad: a screw's lead is its pitch times this."""


def single_names(name: str, freedoms: Sequence[Freedom]) -> list[str]:
    """Names of a joint's freedoms as single turns and slides; a screw is one of each."""
    if len(freedoms) == 1:
        return [name, f"{name}_slide"] if freedoms[0].turns and freedoms[0].slide else [name]
    marks = {3: ("x", "y", "z"), 6: ("px", "py", "pz", "x", "y", "z")}
    own = marks.get(len(freedoms), [str(k + 1) for k in range(len(freedoms))])
    return [f"{name}_{mark}" for mark in own]
