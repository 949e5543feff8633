# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Constraint equations of joints and rods between two bodies, from the joint types' constraints.

Every closure of the package is one of these equations, on expressions and on arrays of numbers:
with the tree's coordinates in :mod:`pkm_twin.kinematics.motion`, with six coordinates a body in
:class:`Placement`. Vectors have three components on the last axis; leading axes are the batch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import cross, snapped
from pkm_twin.codegen.operations import sqrt
from pkm_twin.machine.graph import BASE, Graph, Joint
from pkm_twin.machine.joints import UNIT_VECTORS, Constraint, perpendicular_axes
from pkm_twin.machine.rotations import rotation_about

ZERO_VECTOR: Final = np.zeros(3)
Pair = tuple[Any, Any]
"""A quantity of the inner body, and the same quantity of the outer body."""
Rotations = tuple[Callable[[Array], Any], Callable[[Array], Any]]
"""Functions that rotate a vector fixed in the inner (outer) body from home to its present direction."""


class Equation(NamedTuple):
    """Describe one scalar constraint equation between two bodies: ``value`` is zero.

    A multiplier of one is the force ``force`` at ``points[1]`` and the moment ``moment`` on the
    outer body, and the opposite on the inner body with the force at ``points[0]``. By virtual work
    these are the derivatives of the value by the bodies' motions:

        d value = force (v_outer - v_inner) + moment (w_outer - w_inner)

    ``bodies``: names of the inner and of the outer body. ``scale`` makes the value dimensionless.
    """

    part: str
    bodies: tuple[str, str]
    value: Any
    points: Pair
    force: Any
    moment: Any
    scale: Any

    @property
    def is_angular(self) -> bool:
        """True for an equation that constrains the orientation only."""
        return self.force is ZERO_VECTOR


def dot(a: Any, b: Any) -> Any:
    """Return the scalar product over the last axis, always added up in the same order."""
    return a @ b if a.ndim == b.ndim == 1 else (a * b).sum(-1)


def angle_equation(part: str, bodies: tuple[str, str], points: Pair, vectors: Pair, known: Any) -> Equation:
    """Return the equation of a constant angle between a vector of each body.

    :param known: the vectors' constant scalar product.
    """
    inner, outer = vectors
    return Equation(part, bodies, dot(inner, outer) - known, points, ZERO_VECTOR, cross(outer, inner), 1.0)


def distance_equation(part: str, bodies: tuple[str, str], points: Pair, square: Any, size: Any) -> Equation:
    """Return the equation of a rod (Delta-CU paper, equations 1 and 2).

    :param square: of the rod's length, m2. ``size``: of the machine, m.
    """
    apart = points[1] - points[0]
    value = 0.5 * (dot(apart, apart) - square)
    return Equation(part, bodies, value, points, apart, ZERO_VECTOR, 1.0 / (size * sqrt(square)))


def rod_pair_equation(part: str, bodies: tuple[str, str], points: Pair, vectors: Pair, length: Any) -> Equation:
    """Return the equation of two parallel rods of equal length.

    Their middle line is perpendicular to the difference of ``vectors``, the directions from rod to
    rod on both bodies.
    """
    along = (points[1] - points[0]) * (1.0 / length)
    value = dot(along, vectors[1] - vectors[0])
    return Equation(part, bodies, value, points, ZERO_VECTOR, cross(vectors[1], along), 1.0)


def constraint_equations(
    part: str, bodies: tuple[str, str], constraint: Constraint, points: Pair, turns: Rotations, size: Any
) -> list[Equation]:
    """Return the equations of one constraint of a joint.

    :param points: of the joint on both bodies, m. ``size``: of the machine, m.
    """
    apart, scale = points[1] - points[0], 1.0 / size
    if constraint.kind == "point":
        # [()] makes an array of one expression that expression.
        return [
            Equation(part, bodies, apart[..., i][()], points, unit, ZERO_VECTOR, scale)
            for i, unit in enumerate(UNIT_VECTORS)
        ]
    inner = turns[0](constraint.inner)
    if constraint.kind == "angle":
        vectors = inner, turns[1](constraint.outer)
        return [angle_equation(part, bodies, points, vectors, snapped(constraint.inner @ constraint.outer))]
    # The force on the inner body, too, acts at the outer body's point.
    there, along = (points[1], points[1]), dot(inner, apart)
    if constraint.kind == "plane":
        return [Equation(part, bodies, along, there, inner, ZERO_VECTOR, scale)]
    mark = turns[1](constraint.outer)
    sine, cosine = dot(inner, cross(turns[0](constraint.outer), mark)), dot(turns[0](constraint.outer), mark)
    angle = np.arctan2(sine, cosine)
    # The angle is compared modulo a full revolution.
    angle = angle + 2.0 * np.pi * np.round((along / constraint.slide - angle) / (2.0 * np.pi))
    value = along - constraint.slide * angle
    return [Equation(part, bodies, value, there, inner, -constraint.slide * inner, scale)]


def drive_equation(joint: Joint, goal: Any, points: Pair, turns: Rotations, size: Any) -> Equation:
    """Return the equation that sets the position of a joint of one freedom.

    :param goal: the position relative to home, rad or m, shape (...).
    """
    bodies, (freedom,) = (joint.inner, joint.outer), joint.freedoms
    if freedom.turns:
        first, second = perpendicular_axes(joint.axes[0])
        goal = np.asarray(goal)[..., None]
        inner = turns[0](np.cos(goal) * second - np.sin(goal) * first)
        return angle_equation(joint.name, bodies, points, (inner, turns[1](first)), 0.0)
    along = turns[0](joint.axes[0])
    value = dot(along, points[1] - points[0]) - goal
    return Equation(joint.name, bodies, value, (points[1], points[1]), along, ZERO_VECTOR, 1.0 / size)


def rotate(rotation: Array, vectors: Array) -> Array:
    """Return vectors, (3,) or (..., 3), rotated by rotation matrices, (..., 3, 3)."""
    return np.asarray((rotation @ vectors[..., None])[..., 0], np.float64)


@dataclass(frozen=True, eq=False)
class Placement:
    """Hold the positions of all bodies of a graph, described by six coordinates per body.

    A point of a body, given at home, is at ``rotation`` @ point + ``shift``; shapes (..., bodies +
    1, 3, 3) and (..., bodies + 1, 3), m, the ground first. The coordinates of each body except the
    ground are its displacement at ``middle``, (3,) m, divided by ``size``, m, and its rotation.
    """

    index: Mapping[str, int]
    rotation: Array
    shift: Array
    middle: Array
    size: float

    @classmethod
    def at_home(cls, graph: Graph, shape: tuple[int, ...] = ()) -> Placement:
        """Return the bodies of a graph at home, repeated over batch axes of a shape."""
        index = {name: k for k, name in enumerate((BASE, *graph.bodies))}
        shape = (*shape, len(index))
        return cls(
            index,
            np.tile(np.eye(3), (*shape, 1, 1)),
            np.zeros((*shape, 3)),
            graph.origin,
            graph.size,
        )

    def point(self, body: str, at: Array) -> Array:
        """Return the position, (..., 3), of a body's point given at home, (3,) or (..., 3), m."""
        k = self.index[body]
        return np.asarray(rotate(self.rotation[..., k, :, :], at) + self.shift[..., k, :], np.float64)

    def body_rotation(self, body: str) -> Array:
        """Return a body's rotation from home, shape (..., 3, 3)."""
        return self.rotation[..., self.index[body], :, :]

    def moved(self, step: Array) -> Placement:
        """Return the bodies after a change of the coordinates, shape (..., 6 bodies)."""
        each = step.reshape(*step.shape[:-1], len(self.index) - 1, 6)
        each = np.concatenate([np.zeros_like(each[..., :1, :]), each], -2)
        turn = rotation_about(each[..., 3:])
        shift = rotate(turn, self.shift - self.middle) + self.middle + self.size * each[..., :3]
        return Placement(self.index, turn @ self.rotation, shift, self.middle, self.size)

    def values(self, equations: Sequence[Equation]) -> Array:
        """Return the scaled values of equations, shape (..., rows)."""
        shape = self.shift.shape[:-2]
        found = [np.broadcast_to(one.scale * one.value, shape) for one in equations]
        return np.stack(found, -1) if found else np.zeros((*shape, 0))

    def jacobian(self, equations: Sequence[Equation]) -> Array:
        """Return the derivatives of the values by the coordinates, shape (..., rows, 6 bodies)."""
        shape, rows = self.shift.shape[:-2], np.arange(len(equations))
        table = np.zeros((*shape, len(equations), len(self.index), 6))
        whole = (*shape, len(equations), 6 * len(self.index))
        if not equations:
            return table.reshape(whole)[..., 6:]

        def stack(vectors: Iterable[Array]) -> Array:
            return np.stack([np.broadcast_to(np.asarray(vector, float), (*shape, 3)) for vector in vectors], -2)

        force = stack(one.scale * one.force for one in equations)
        moment = stack(one.scale * one.moment for one in equations)
        for side, sign in ((0, -1.0), (1, 1.0)):
            bodies = [self.index[one.bodies[side]] for one in equations]
            arm = stack(one.points[side] for one in equations) - self.middle
            table[..., rows, bodies, :3] += sign * self.size * force
            table[..., rows, bodies, 3:] += sign * (np.cross(arm, force) + moment)
        return table.reshape(whole)[..., 6:]


def differentiate_by_frame(one: Equation, side: int, point: Array, rotation: Array) -> tuple[Array, Array]:
    """Return an equation's derivatives by an error of the joint's or rod's frame on one body.

    :param side: 0: the frame on the inner body, 1: on the outer body. ``point``: its origin,
        (..., 3) m. ``rotation``: of that body from home, shape (..., 3, 3).
    :returns: scaled, by a displacement of the origin, 1/m, and by a rotation about it, 1/rad, both
        in base axes at home, shape (..., 3).
    """
    sign = (-1.0, 1.0)[side] * one.scale
    moment = np.asarray(one.moment, float) + np.cross(one.points[side] - point, one.force)
    by_shift, by_tilt = ((sign * vector[..., None, :] @ rotation)[..., 0, :] for vector in (one.force, moment))
    return by_shift, by_tilt
