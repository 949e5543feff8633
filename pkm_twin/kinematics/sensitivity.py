# SPDX-License-Identifier: Apache-2.0
"""How the platform moves when the machine's geometry changes and its joints are held.

Every body is free, every joint and rod is a set of equations between two bodies, and each equation
is differentiated by the bodies' twists and by the vectors that the graph gives at home: exact, for
any graph, without a program of its own (maximal coordinates; Everett and Hsu, 1988, count the same
parameters by joint frames).

May import: numpy, pkm_twin's machine, the standard library.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.machine.graph import BASE, FREEDOMS, Array, Graph, Joint, Rod, across
from pkm_twin.machine.robot import Robot
from pkm_twin.machine.rotations import skew

RANK: Final = 1e-10
"""Part of the greatest singular value below which a direction is held by nothing."""
_UNITS: Final = np.eye(3)


@dataclass(frozen=True, eq=False)
class GraphChange:
    """Derivative of a graph's vectors at home by one number, in its unit.

    By joint: of its point (3,), its axes (k, 3) and its value at home; by rod of its ends (2, 3);
    of the reference point (3,).
    """

    points: Mapping[str, Array]
    axes: Mapping[str, Array]
    homes: Mapping[str, float]
    ends: Mapping[str, Array]
    origin: Array

    @classmethod
    def between(cls, low: Graph, high: Graph, step: float) -> GraphChange:
        """Difference quotient of two graphs that differ by ``step`` in one number."""
        pairs = [(low.joints[name], joint) for name, joint in high.joints.items()]
        return cls(
            {b.name: (b.at - a.at) / step for a, b in pairs},
            {b.name: (b.axes - a.axes) / step for a, b in pairs},
            {b.name: (b.home - a.home) / step for a, b in pairs},
            {r.name: (r.ends - low.rods[r.name].ends) / step for r in high.rods.values()},
            (high.origin - low.origin) / step,
        )

    def nothing(self, tolerance: float) -> bool:
        """Whether no vector changes."""
        parts = [*self.points.values(), *self.axes.values(), *self.ends.values(), self.origin]
        largest = max((float(np.abs(part).max(initial=0.0)) for part in parts), default=0.0)
        return max(largest, *(abs(home) for home in self.homes.values())) <= tolerance


class _Equations:
    """The equations of a batch of states: rows by body twists, and by the changes."""

    def __init__(self, robot: Robot, q: Array, changes: Sequence[GraphChange]) -> None:
        self.graph, self.q, self.changes = robot.graph, q, changes
        graph, home = self.graph, robot.engine.tree.at
        self.rotation, self.origin = robot.placements(q)
        # Of the point that was at the base's origin at home.
        for name, rotation in self.rotation.items():
            self.origin[name] = self.origin[name] - rotation @ home[name]
        self.bodies = {name: 6 * k for k, name in enumerate(graph.bodies)}
        batch = q.shape[:-1]
        self.rotation[BASE] = np.broadcast_to(_UNITS, (*batch, 3, 3))
        self.origin[BASE] = np.zeros((*batch, 3))
        self.rows: list[Array] = []
        self.right: list[Array] = []
        for joint in graph.joints.values():
            self._joint(joint)
        for rod in graph.rods.values():
            self._rod(rod)

    def solved(self) -> Array:
        """Body twists by change, shape (..., 6 bodies, changes)."""
        inverse = np.linalg.pinv(np.stack(self.rows, -2), rcond=RANK)
        return np.asarray(inverse @ -np.stack(self.right, -2), np.float64)

    def place(self, body: str, point: Array) -> Array:
        """Where a point of a body, given at home, is."""
        return np.asarray(self.origin[body] + self.rotation[body] @ point, np.float64)

    def _add(self, parts: Sequence[tuple[str, Array, Array, Array]], geometry: Array) -> None:
        """A row: by body the weights of the velocity of a point and of the angular velocity.

        :param parts: body, point, force-like and moment-like weight, shape (..., 3) each.
        :param geometry: derivative of the equation by the changes, shape (..., changes).
        """
        row = np.zeros((*self.q.shape[:-1], 6 * len(self.bodies)))
        for body, point, force, moment in parts:
            if body != BASE:
                k = self.bodies[body]
                row[..., k : k + 3] += force
                row[..., k + 3 : k + 6] += np.cross(point - self.origin[body], force) + moment
        self.rows.append(row)
        self.right.append(geometry)

    def _turned(self, body: str, vectors: Sequence[Array]) -> Array:
        """Vectors of a body, one a change, base axes now, shape (..., 3, changes)."""
        return np.asarray(self.rotation[body] @ np.stack(vectors, -1), np.float64)

    def _joint(self, joint: Joint) -> None:
        kind, axes = joint.kind, joint.axes
        pair = across(axes[0]) if len(axes) == 1 else ()
        if kind in ("revolute", "universal", "spherical", "fixed"):
            for unit in _UNITS:
                self._offset(joint, unit, fixed=True)
        if kind in ("prismatic", "cylindrical"):
            for e in pair:
                self._offset(joint, e)
        if kind in ("revolute", "cylindrical"):
            for e in pair:
                self._angle(joint, (e, 0), (axes[0], 0))
        if kind in ("prismatic", "fixed", "translation"):
            for i in range(3):
                self._angle(joint, (_UNITS[i], 0), (_UNITS[(i + 1) % 3], 0))
        if kind == "universal":
            self._angle(joint, (axes[0], 0), (axes[1], 1))
        if joint.actuated:
            self._drive(joint, pair)

    def _drive(self, joint: Joint, pair: Sequence[Array]) -> None:
        """The actuated joint keeps the value that its sensor shows."""
        homes = np.array([change.homes[joint.name] for change in self.changes])
        value = self.q[..., self.graph.actuated.index(joint.name)] - joint.home
        if FREEDOMS[joint.kind] == "P":
            self._offset(joint, joint.axes[0], extra=homes)
            return
        first, second = pair
        # Across where the outer body's first vector has to be, turned by the value.
        e = np.cos(value)[..., None] * second - np.sin(value)[..., None] * first
        self._angle(joint, (e, 0), (first, 0), extra=homes)

    def _axis_turn(self, joint: Joint, which: int, vector: Array) -> Array:
        """How a vector that an axis carries along changes with it, shape (..., 3, changes)."""
        if not len(joint.axes):
            return np.zeros((*vector.shape, len(self.changes)))
        axis = joint.axes[which]
        turns = [np.cross(axis, change.axes[joint.name][which]) for change in self.changes]
        return np.stack([np.cross(turn, vector) for turn in turns], -1)

    def _angle(
        self, joint: Joint, inner: tuple[Array, int], outer: tuple[Array, int],
        extra: Array | float = 0.0,
    ) -> None:  # fmt: skip
        """A vector of the inner body and one of the outer body keep their angle."""
        a, b = joint.inner, joint.outer
        (e, i), (u, k) = inner, outer
        ea = (self.rotation[a] @ e[..., None])[..., 0]
        ub = (self.rotation[b] @ u[..., None])[..., 0]
        de, du = self._axis_turn(joint, i, e), self._axis_turn(joint, k, u)
        moved = _dot(self.rotation[a] @ de, ub) + _dot(self.rotation[b] @ du, ea)
        at_home = _dot(de, u) + _dot(du, e)
        normal = np.cross(ub, ea)
        here = self.place(b, joint.at)
        none = np.zeros_like(normal)
        # With the drive's own value the angle is the same at home only for what turns both.
        same = 0.0 if e.ndim > 1 else at_home
        self._add([(b, here, none, normal), (a, here, none, -normal)], moved - same + extra)

    def _offset(
        self, joint: Joint, e: Array, *, fixed: bool = False, extra: Array | float = 0.0
    ) -> None:
        """The outer body's point keeps its distance along e, fixed in space or in the inner one."""
        a, b = joint.inner, joint.outer
        ea = e + np.zeros((*self.q.shape[:-1], 3)) if fixed else self.rotation[a] @ e
        xa, xb = self.place(a, joint.at), self.place(b, joint.at)
        points = [change.points[joint.name] for change in self.changes]
        geometry = _dot(self._turned(b, points) - self._turned(a, points), ea)
        turning = np.zeros_like(ea)
        if not fixed:
            geometry = geometry + _dot(self.rotation[a] @ self._axis_turn(joint, 0, e), xb - xa)
            turning = np.cross(ea, xb - xa)
        self._add([(b, xb, ea, 0 * ea), (a, xa, -ea, turning)], geometry + extra)

    def _rod(self, rod: Rod) -> None:
        """The ends keep their distance."""
        a, b = rod.inner, rod.outer
        xa, xb = self.place(a, rod.ends[0]), self.place(b, rod.ends[1])
        apart = xb - xa
        ends = [change.ends[rod.name] for change in self.changes]
        moved = self._turned(b, [end[1] for end in ends]) - self._turned(a, [e[0] for e in ends])
        home = rod.ends[1] - rod.ends[0]
        longer = np.array([(end[1] - end[0]) @ home for end in ends])
        none = np.zeros_like(apart)
        self._add([(b, xb, apart, none), (a, xa, -apart, none)], _dot(moved, apart) - longer)


def _dot(columns: Array, vector: Array) -> Array:
    """Columns (..., 3, k) by a vector (..., 3), shape (..., k)."""
    return np.asarray((vector[..., None, :] @ columns)[..., 0, :], np.float64)


def platform_change(robot: Robot, q: ArrayLike, changes: Sequence[GraphChange]) -> Array:
    """Displacement of the platform by numbers of the geometry, actuated joints held.

    :param q: joint positions, shape (..., n), rad or m.
    :returns: translation of the reference point and rotation, base axes, by number, shape
        (..., 6, changes). Where an overconstrained machine cannot be assembled with a change,
        the displacement that misses least.
    :raises UnreachableError: a joint state without an assembly, by limb, sample and miss.
    """
    equations = _Equations(robot, np.asarray(q, np.float64), changes)
    graph = robot.graph
    k = equations.bodies[graph.platform]
    twist = equations.solved()[..., k : k + 6, :]
    rotation = equations.rotation[graph.platform]
    lever = equations.place(graph.platform, graph.origin) - equations.origin[graph.platform]
    origins = np.stack([change.origin for change in changes], -1)
    linear = twist[..., :3, :] - skew(lever) @ twist[..., 3:, :] + rotation @ origins
    return np.concatenate((linear, twist[..., 3:, :]), -2)
