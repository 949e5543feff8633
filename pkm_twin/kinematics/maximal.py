# SPDX-License-Identifier: Apache-2.0
"""A graph in maximal coordinates: every body free, every joint and rod a set of equations.

Nothing is compiled, so a graph with other numbers costs no more than the one before. The equations
are differentiated by the bodies' twists and by the vectors that the graph gives at home: exact, for
any graph (Everett and Hsu, 1988, count the same parameters by joint frames).

May import: numpy, pkm_twin's machine and errors, the standard library.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from pkm_twin.errors import ParameterError
from pkm_twin.machine.graph import BASE, Array, Graph, Joint, Rod
from pkm_twin.machine.joints import TURN, UNITS, Constraint, across
from pkm_twin.machine.robot import Robot
from pkm_twin.machine.rotations import about_vector

RANK: Final = 1e-10
"""Part of the greatest singular value below which a direction is held by nothing."""
SOUND: Final = 1e8
"""Condition number below which equations as many as unknowns are solved as they are."""
TURNS: Final = 20
"""Most corrections of an assembly."""
CLOSED: Final = 1e-9
"""Correction, rad or m, after which the next one is below rounding."""
FAR: Final = 1.0
"""A longer correction leads to another assembly, rad or m."""
MISS: Final = 1e-7
"""Part of the machine's size by which equations may be missed before the last correction."""


Parts = Sequence[tuple[str, Array, Array, Array]]
"""Of a row: body, point, force-like and moment-like weight."""


@dataclass(frozen=True, eq=False)
class Placement:
    """Where all bodies are, the base too, by name.

    ``rotation``: from home, shape (..., 3, 3). ``origin``: of the point that was at the base's
    origin at home, shape (..., 3), m.
    """

    rotation: Mapping[str, Array]
    origin: Mapping[str, Array]

    @classmethod
    def of(cls, robot: Robot, q: Array) -> Placement:
        """Of joint positions (..., n); errors as :meth:`Robot.forward`."""
        home = robot.engine.tree.at
        turned, places = robot.placements(q)
        origin = {name: at - turned[name] @ home[name] for name, at in places.items()}
        batch = q.shape[:-1]
        still = {BASE: np.broadcast_to(UNITS, (*batch, 3, 3))}
        return cls({**turned, **still}, {**origin, BASE: np.zeros((*batch, 3))})

    def point(self, body: str, at: Array) -> Array:
        """Where a point of a body, given at home, is."""
        return np.asarray(self.origin[body] + self.rotation[body] @ at, np.float64)

    def moved(self, twists: Array) -> Placement:
        """By small twists of the bodies in their order, shape (..., 6 bodies)."""
        rotation, origin = dict(self.rotation), dict(self.origin)
        bodies = (name for name in self.rotation if name != BASE)
        for k, name in enumerate(bodies):
            v, w = twists[..., 6 * k : 6 * k + 3], twists[..., 6 * k + 3 : 6 * k + 6]
            rotation[name] = about_vector(w) @ self.rotation[name]
            origin[name] = self.origin[name] + v
        return Placement(rotation, origin)


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
    def of_joint(cls, graph: Graph, name: str) -> GraphChange:
        """One actuated joint goes on by its unit: as if its home were less by one."""
        none = {
            "points": {j: np.zeros(3) for j in graph.joints},
            "axes": {j.name: np.zeros_like(j.axes) for j in graph.joints.values()},
            "ends": {rod: np.zeros((2, 3)) for rod in graph.rods},
        }
        homes = {j: -1.0 if j == name else 0.0 for j in graph.joints}
        return cls(none["points"], none["axes"], homes, none["ends"], np.zeros(3))

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

    def moves(self, name: str) -> bool:
        """Whether anything of a joint or rod changes."""
        if name in self.ends:
            return bool(self.ends[name].any())
        return bool(self.points[name].any() or self.axes[name].any() or self.homes[name])

    def nothing(self, tolerance: float) -> bool:
        """Whether no vector changes."""
        parts = [*self.points.values(), *self.axes.values(), *self.ends.values(), self.origin]
        largest = max((float(np.abs(part).max(initial=0.0)) for part in parts), default=0.0)
        return max(largest, *(abs(home) for home in self.homes.values())) <= tolerance


class Equations:
    """The equations of a batch of states: their values, rows by body twists, and by the changes."""

    def __init__(
        self, graph: Graph, q: Array, placement: Placement, changes: Sequence[GraphChange] = ()
    ) -> None:
        self.graph, self.q, self._count = graph, q, len(changes)
        self.placement, self.rotation = placement, placement.rotation
        self.bodies = {name: 6 * k for k, name in enumerate(graph.bodies)}
        self._values: list[Array] = []
        self._rows: list[Array] = []
        self._right: list[Array] = []
        for joint in graph.joints.values():
            self._choose(changes, joint.name)
            self._joint(joint)
        for rod in graph.rods.values():
            self._choose(changes, rod.name)
            self._rod(rod)

    @property
    def values(self) -> Array:
        """By how much the equations are missed, shape (..., rows)."""
        batch = self.q.shape[:-1]
        return np.stack([np.broadcast_to(value, batch) for value in self._values], -1)

    @property
    def table(self) -> Array:
        """Their derivatives by the bodies' twists, shape (..., rows, 6 bodies)."""
        return np.stack(self._rows, -2)

    @property
    def by_changes(self) -> Array:
        """Their derivatives by the changes, shape (..., rows, changes)."""
        return np.stack(self._right, -2)

    def _choose(self, changes: Sequence[GraphChange], name: str) -> None:
        """Those that move a joint or rod: most numbers are another's."""
        self._columns = [k for k, change in enumerate(changes) if change.moves(name)]
        self.changes = [changes[k] for k in self._columns]

    def twists(self) -> tuple[Array, Array]:
        """Body twists by change, shape (..., 6 bodies, changes), and what they miss of the rows."""
        table, right = self.table, self.by_changes
        found = _inverse(table) @ -right
        return np.asarray(found, np.float64), np.asarray(table @ found + right, np.float64)

    def correction(self) -> Array:
        """Body twists of one step of Gauss and Newton's method, shape (..., 6 bodies)."""
        table = self.table
        back = np.swapaxes(table, -1, -2)
        right = back @ -self.values[..., None]
        return np.asarray(np.linalg.solve(back @ table, right)[..., 0], np.float64)

    def _add(self, value: Array, parts: Parts, geometry: Array) -> None:
        """A row: by body the weights of the velocity of a point and of the angular velocity.

        :param value: of the equation, zero where it holds, shape (...).
        :param parts: body, point, force-like and moment-like weight, shape (..., 3) each.
        :param geometry: derivative of the equation by the changes, shape (..., changes).
        """
        row = np.zeros((*self.q.shape[:-1], 6 * len(self.bodies)))
        for body, point, force, moment in parts:
            if body != BASE:
                k = self.bodies[body]
                row[..., k : k + 3] += force
                row[..., k + 3 : k + 6] += (
                    np.cross(point - self.placement.origin[body], force) + moment
                )
        self._values.append(value)
        self._rows.append(row)
        right = np.zeros((*self.q.shape[:-1], self._count))
        right[..., self._columns] = geometry
        self._right.append(right)

    def _turned(self, body: str, vectors: Sequence[Array]) -> Array:
        """Vectors of a body, one a change, base axes now, shape (..., 3, changes)."""
        return np.asarray(self.rotation[body] @ np.reshape(vectors, (-1, 3)).T, np.float64)

    def _joint(self, joint: Joint) -> None:
        for held in joint.constraints:
            if held.kind == "point":
                for unit in UNITS:
                    self._add(*self._offset(joint, unit, fixed=True))
            elif held.kind == "plane":
                self._add(*self._offset(joint, held.inner))
            elif held.kind == "screw":
                self._add(*self._thread(joint, held))
            else:
                first, second = held.axes
                self._add(*self._angle(joint, (held.inner, first), (held.outer, second)))
        if joint.actuated:
            self._drive(joint, across(joint.axes[0]))

    def _drive(self, joint: Joint, pair: Sequence[Array]) -> None:
        """The actuated joint keeps the value that its sensor shows."""
        homes = np.array([change.homes[joint.name] for change in self.changes])
        value = self.q[..., self.graph.actuated.index(joint.name)] - joint.home
        if joint.slides:
            self._add(*self._offset(joint, joint.axes[0], goal=value, extra=homes))
        else:
            self._add(*self._turn(joint, pair, value, homes))

    def _turn(
        self, joint: Joint, pair: Sequence[Array], value: Array, extra: Array | float = 0.0
    ) -> tuple[Array, Parts, Array]:
        """The outer body is turned about the axis by a value; its derivatives are the turn's."""
        first, second = pair
        # Across where the outer body's first vector has to be, turned by the value.
        e = np.cos(value)[..., None] * second - np.sin(value)[..., None] * first
        return self._angle(joint, (e, 0), (first, 0), extra=extra)

    def _thread(self, joint: Joint, held: Constraint) -> tuple[Array, Parts, Array]:
        """The outer body goes along the axis in proportion to its turn, whole ones left out."""
        along, parts, geometry = self._offset(joint, held.inner)
        first, second = across(held.inner)
        mark = self.rotation[joint.outer] @ first
        rotation = self.rotation[joint.inner]
        angle = np.arctan2(
            (mark * (rotation @ second)).sum(-1), (mark * (rotation @ first)).sum(-1)
        )
        _, turning, turned = self._turn(joint, (first, second), angle)
        scaled = [(body, at, f, -held.slide * m) for body, at, f, m in turning]
        value = np.remainder(along / held.slide - angle + np.pi, TURN) - np.pi
        return held.slide * value, [*parts, *scaled], geometry - held.slide * turned

    def _axis_turn(self, joint: Joint, which: int, vector: Array) -> Array:
        """How a vector that an axis carries along changes with it, shape (..., 3, changes)."""
        turned = np.zeros((*vector.shape, len(self.changes)))
        if len(joint.axes):
            for k, change in enumerate(self.changes):
                by = change.axes[joint.name][which]
                if by.any():
                    turned[..., k] = np.cross(np.cross(joint.axes[which], by), vector)
        return turned

    def _angle(
        self, joint: Joint, inner: tuple[Array, int], outer: tuple[Array, int],
        extra: Array | float = 0.0,
    ) -> tuple[Array, Parts, Array]:  # fmt: skip
        """A vector of the inner body and one of the outer body keep their angle."""
        a, b = joint.inner, joint.outer
        (e, i), (u, k) = inner, outer
        ea = (self.rotation[a] @ e[..., None])[..., 0]
        ub = (self.rotation[b] @ u[..., None])[..., 0]
        de, du = self._axis_turn(joint, i, e), self._axis_turn(joint, k, u)
        moved = _dot(self.rotation[a] @ de, ub) + _dot(self.rotation[b] @ du, ea)
        at_home = _dot(de, u) + _dot(du, e)
        normal = np.cross(ub, ea)
        here = self.placement.point(b, joint.at)
        none = np.zeros_like(normal)
        # With the drive's own value the angle is the same at home only for what turns both.
        drive = e.ndim > 1
        goal = 0.0 if drive else float(e @ u)
        same = 0.0 if drive else at_home
        parts = [(b, here, none, normal), (a, here, none, -normal)]
        return (ea * ub).sum(-1) - goal, parts, moved - same + extra

    def _offset(
        self, joint: Joint, e: Array, *, fixed: bool = False, goal: Array | float = 0.0,
        extra: Array | float = 0.0,
    ) -> tuple[Array, Parts, Array]:  # fmt: skip
        """The outer body's point is at a distance along e, fixed in space or in the inner body."""
        a, b = joint.inner, joint.outer
        ea = e + np.zeros((*self.q.shape[:-1], 3)) if fixed else self.rotation[a] @ e
        xa, xb = self.placement.point(a, joint.at), self.placement.point(b, joint.at)
        points = [change.points[joint.name] for change in self.changes]
        geometry = _dot(self._turned(b, points) - self._turned(a, points), ea)
        turning = np.zeros_like(ea)
        if not fixed:
            geometry = geometry + _dot(self.rotation[a] @ self._axis_turn(joint, 0, e), xb - xa)
            turning = np.cross(ea, xb - xa)
        value = (ea * (xb - xa)).sum(-1) - goal
        return value, [(b, xb, ea, 0 * ea), (a, xa, -ea, turning)], geometry + extra

    def _rod(self, rod: Rod) -> None:
        """The ends keep their distance."""
        a, b = rod.inner, rod.outer
        xa, xb = self.placement.point(a, rod.ends[0]), self.placement.point(b, rod.ends[1])
        apart = xb - xa
        ends = [change.ends[rod.name] for change in self.changes]
        moved = self._turned(b, [end[1] for end in ends]) - self._turned(a, [e[0] for e in ends])
        home = rod.ends[1] - rod.ends[0]
        longer = np.array([(end[1] - end[0]) @ home for end in ends])
        none = np.zeros_like(apart)
        value = 0.5 * ((apart * apart).sum(-1) - home @ home)
        parts = [(b, xb, apart, none), (a, xa, -apart, none)]
        self._add(value, parts, _dot(moved, apart) - longer)


def _inverse(table: Array) -> Array:
    """Pseudo-inverses; of a machine that is not overconstrained plain ones, which cost less."""
    if table.shape[-2] == table.shape[-1]:
        try:
            found = np.linalg.inv(table)
        except np.linalg.LinAlgError:
            found = np.full_like(table, np.nan)
        norms = np.abs(table).sum(-1).max(-1) * np.abs(found).sum(-1).max(-1)
        if (norms < SOUND).all():
            return np.asarray(found, np.float64)
    return np.asarray(np.linalg.pinv(table, rcond=RANK), np.float64)


def _dot(columns: Array, vector: Array) -> Array:
    """Columns (..., 3, k) by a vector (..., 3), shape (..., k)."""
    return np.asarray((vector[..., None, :] @ columns)[..., 0, :], np.float64)


def assembled(graph: Graph, q: Array, near: Placement) -> Placement:
    """The assembly of a graph at joint positions (..., n) that is near to another placement.

    :param near: of the same bodies, as of a graph with slightly other numbers.
    :raises ParameterError: none is found.
    """
    placement = near
    for _ in range(TURNS):
        equations = Equations(graph, q, placement)
        try:
            step = equations.correction()
        except np.linalg.LinAlgError:
            break
        size = float(np.abs(step).max(initial=0.0))
        if not size < FAR:
            break
        placement = placement.moved(step)
        if size < CLOSED:
            if float(np.abs(equations.values).max(initial=0.0)) < MISS * graph.size:
                return placement
            break
    raise ParameterError("geometry", None, "numbers with which the machine can be assembled")
