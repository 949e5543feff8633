# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Placement, closures, velocities and accelerations of a tree, numerical or symbolic.

Nothing is differentiated: columns of Jacobians are axes and levers, accelerations follow from the
recursion for rigid bodies in base axes (Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter
2). Rates u belong to the unknowns, qd to the actuated joints.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import Numbers, Objects, cross, snapped_all
from pkm_twin.codegen.operations import cos, sin, sqrt
from pkm_twin.kinematics.constraints import Equation, constraint_equations, distance_equation
from pkm_twin.machine.graph import BASE, Direction, Joint, Rod
from pkm_twin.machine.joints import UNIT_VECTORS, Constraint
from pkm_twin.machine.tree import Step, Tree

Columns = dict[tuple[str, int], Any]
"""Jacobian columns: a vector or number per rate, whose key is ("u" or "q", index)."""


class BaseMotion(NamedTuple):
    """The motion of the base in its own axes, shape (3,) each.

    ``omega``: angular velocity, rad/s. ``alpha``: angular acceleration, rad/s2. ``acceleration``:
    of the origin, less gravity, m/s2. A constant velocity has no effect on forces.
    """

    omega: Any
    alpha: Any
    acceleration: Any

    @classmethod
    def at_rest(cls, gravity: Any) -> BaseMotion:
        """Return the motion of a base at rest, which accelerates against gravity."""
        return cls(_ZERO, _ZERO, -gravity)


_ZERO: Final = np.zeros(3)
FIXED: Final = BaseMotion(_ZERO, _ZERO, _ZERO)
"""A base at rest, without gravity: the motion of all parts is relative to it."""


def to_floats(values: Any) -> Array:
    """Convert an object array of numbers to an array of floats."""
    return np.asarray(np.array(values, dtype=float), np.float64)


def subtract_columns(b: Columns, a: Columns) -> Columns:
    """Subtract the columns of a from the columns of b with the same rate."""
    keys = dict.fromkeys([*b, *a])
    return {k: (b[k] - a[k] if k in a else b[k]) if k in b else -a[k] for k in keys}


def _no_bias() -> Any:
    raise NotImplementedError("the acceleration of this equation is not needed")


@dataclass(frozen=True, eq=False)
class Row:
    """One scalar equation of a closure, in the tree's coordinates: ``value`` is zero.

    ``columns``: its derivatives by the rates. ``bias``: its second derivative in time at zero
    accelerations of the unknowns (Delta-CU paper, equations 4 and 5). ``scale`` makes it
    dimensionless; ``is_angular``: it constrains directions only. ``part``: the joint or rod.
    """

    part: str
    value: Any
    columns: Columns
    scale: Any
    is_angular: bool = False
    bias: Callable[[], Any] = _no_bias


class Motion:
    """A tree in one state. Rates, and then accelerations, are set after its construction.

    :param x: unknowns, as ``tree.home``.
    :param q: positions of the actuated joints, shape (n,).
    :param bodies: bodies to place, in the tree's order; default all.
    :param start: the body relative to whose frame they are placed.
    """

    def __init__(
        self,
        tree: Tree,
        x: Numbers,
        q: Numbers,
        bodies: Iterable[str] | None = None,
        start: str = BASE,
    ) -> None:
        self.tree, self.graph = tree, tree.graph
        self.rotation: dict[str, Any] = {start: UNIT_VECTORS}
        self.origin: dict[str, Any] = {start: np.zeros(3)}
        self.lever: dict[str, Any] = {}
        self.axis: dict[int, Any] = {}
        self._circle: dict[int, tuple[Any, Any]] = {}
        self.place(tree.links if bodies is None else bodies, x, q)

    def place(self, bodies: Iterable[str], x: Numbers, q: Numbers) -> None:
        """Place further bodies, in the tree's order."""
        origin = self.graph.lead_home
        for link in map(self.tree.links.__getitem__, bodies):
            turned = self.rotation[link.parent]
            lever = turned @ link.arm
            for step in link.steps:
                if step.ball or step.free:
                    k = step.position
                    turned = _quaternion_matrix(x[k : k + 4])
                    if step.free:
                        lever = link.at + np.array(x[k + 4 : k + 7], dtype=object)
                    continue
                if step.turns:
                    own = turned if (step.before == UNIT_VECTORS).all() else turned @ step.before
                    self.axis[id(step)] = own[:, 2]
                    if step.circle:
                        c, s = x[step.position], step.sign * x[step.position + 1]
                    else:
                        angle = self._step_displacement(step, x, q, origin, step.offset)
                        s, c = sin(angle), cos(angle)
                    self._circle[id(step)] = c, s
                    turned = np.array(
                        [own[:, 0] * c + own[:, 1] * s, own[:, 1] * c - own[:, 0] * s, own[:, 2]],
                        dtype=object,
                    ).T
                else:
                    self.axis[id(step)] = turned @ step.local
                if step.slide:
                    way = step.slide * self._step_displacement(step, x, q, origin)
                    lever = lever + self.axis[id(step)] * way
            self.rotation[link.body] = turned
            self.lever[link.body] = lever
            self.origin[link.body] = self.origin[link.parent] + lever

    @staticmethod
    def _step_displacement(step: Step, x: Numbers, q: Numbers, origin: Array, offset: float = 0.0) -> Any:
        """Return a step's signed displacement from home, from q if it is actuated, else from x."""
        k = step.position
        value = q[k] - (origin[k] - step.sign * offset) if step.actuated else x[k]
        return -value if step.sign < 0.0 else value

    def turn(self, step: Step) -> Any:
        """Return the rotation from the axes beyond a turn to those before it, shape (3, 3)."""
        (c, s), (first, second, third) = self._circle[id(step)], step.before.T
        return np.array([first * c + second * s, second * c - first * s, third], dtype=object).T

    def arm(self, body: str, point: Array) -> Any:
        """Return the vector from a body's origin to a point of the body, given at home."""
        tree = self.tree
        return self.rotation[body] @ snapped_all(tree.axes[body].T @ (point - tree.at[body]))

    def point(self, body: str, point: Array) -> Any:
        """Return the position of a point of a body, given at home."""
        return self.origin[body] + self.arm(body, point)

    def direction(self, body: str, vector: Array) -> Any:
        """Return a vector fixed in a body, given at home, in base axes."""
        return self.rotation[body] @ snapped_all(self.tree.axes[body].T @ vector)

    def rotation_from_home(self, body: str) -> Any:
        """Return the rotation of a body relative to home, shape (3, 3)."""
        return self.rotation[body] @ self.tree.axes[body].T

    def platform(self) -> tuple[Any, Any]:
        """Return the reference point's position, and the platform's rotation relative to home."""
        graph = self.graph
        return self.point(graph.platform, graph.origin), self.rotation_from_home(graph.platform)

    def linear_jacobian(self, body: str, at: Any) -> Columns:
        """Return the velocity, per rate, of the body's point that is at position ``at``.

        Linear rows of the 3-PRRU paper's velocity maps J_M and J_Hij (equations 18 and 26).
        """
        out: Columns = {}
        for link in map(self.tree.links.__getitem__, self.tree.chain_to_base(body)):
            origin, absolute = self.origin[link.body], False
            for step in reversed(link.steps):
                key = ("q" if step.actuated else "u", step.rate)
                if step.ball or step.free:
                    absolute = True
                    for i in range(3):
                        out["u", step.rate + i] = cross(UNIT_VECTORS[i], at - origin)
                        if step.free:
                            out["u", step.rate + 3 + i] = UNIT_VECTORS[i]
                    continue
                axis = self.axis[id(step)]
                column: Any = cross(axis, at - origin) if step.turns else 0.0
                if step.slide:
                    column = column + step.slide * axis
                out[key] = step.sign * column
            if absolute:
                # Rates of a ball are those of the absolute rotation: only the translation is inherited.
                at = origin
        return out

    def angular_jacobian(self, body: str) -> Columns:
        """Return the angular velocity of a body per rate.

        Angular rows of the 3-PRRU paper's J_M and J_Hij (equations 19 to 21, and 27 to 29).
        """
        out: Columns = {}
        for link in map(self.tree.links.__getitem__, self.tree.chain_to_base(body)):
            for step in reversed(link.steps):
                if step.turns:
                    key = ("q" if step.actuated else "u", step.rate)
                    out[key] = step.sign * self.axis[id(step)]
                elif step.ball or step.free:
                    for i in range(3):
                        out["u", step.rate + i] = UNIT_VECTORS[i]
                    return out
        return out

    def closures(self) -> list[Row]:
        """Return the equations of all cut joints and rods."""
        rows: list[Row] = []
        for joint in map(self.graph.joints.__getitem__, self.tree.cut):
            a, b = joint.inner, joint.outer
            points = self.point(a, joint.at), self.point(b, joint.at)
            turns = partial(self.direction, a), partial(self.direction, b)
            for constraint in joint.constraints:
                found = constraint_equations(
                    joint.name, (joint.inner, joint.outer), constraint, points, turns, self.tree.size
                )
                columns = self._relative_columns(found[0])
                rows += [
                    self._make_row(one, columns, partial(self._second_derivative, joint, constraint, one))
                    for one in found
                ]
        return rows + [self._rod_row(rod) for rod in self.graph.rods.values()]

    def _relative_columns(self, one: Equation) -> Columns:
        """Return the relative velocity, linear or angular, of the outer body per rate."""
        if one.is_angular:
            return subtract_columns(*(self.angular_jacobian(body) for body in one.bodies[::-1]))
        return subtract_columns(*map(self.linear_jacobian, one.bodies[::-1], one.points[::-1]))

    def _make_row(self, one: Equation, columns: Columns, bias: Callable[[], Any] = _no_bias) -> Row:
        """Return a constraint equation with its derivatives by the rates."""
        load = one.moment if one.is_angular else one.force
        by_rates = {k: c @ load for k, c in columns.items()}
        return Row(one.part, one.value, by_rates, one.scale, one.is_angular, bias)

    def _second_derivative(self, joint: Joint, constraint: Constraint, one: Equation) -> Any:
        """Return an equation's second time derivative at the bodies' velocities and accelerations."""
        a, b, at = joint.inner, joint.outer, joint.at
        wa, wb = self.omega[a], self.omega[b]
        if constraint.kind == "point":
            return one.force @ (self.acceleration(b, at) - self.acceleration(a, at))
        ea = self.direction(a, constraint.inner)
        va = cross(wa, ea)
        if constraint.kind == "angle":
            ub = self.direction(b, constraint.outer)
            vb = cross(wb, ub)
            turning = (self.alpha[b] - self.alpha[a]) @ one.moment
            return turning + cross(wa, va) @ ub + cross(wb, vb) @ ea + 2.0 * (va @ vb)
        return (
            ea @ (self.acceleration(b, at) - self.acceleration(a, at))
            + 2.0 * (va @ (self.velocity(b, at) - self.velocity(a, at)))
            + (cross(self.alpha[a], ea) + cross(wa, va)) @ (self.point(b, at) - self.point(a, at))
        )

    def _rod_row(self, rod: Rod) -> Row:
        """Return the equation of the constant distance of a rod's ends."""
        a, b, (start, end) = rod.inner, rod.outer, rod.ends
        points = self.point(a, start), self.point(b, end)
        square = (end - start) @ (end - start)
        one = distance_equation(rod.name, (a, b), points, square, self.tree.size)

        def bias() -> Any:
            speed = self.velocity(b, end) - self.velocity(a, start)
            change = self.acceleration(b, end) - self.acceleration(a, start)
            return one.force @ change + speed @ speed

        return self._make_row(one, self._relative_columns(one), bias)

    def set_rates(self, u: Numbers, qd: Numbers, base: BaseMotion = FIXED) -> None:
        """Compute the angular velocity, and the velocity of the origin, of every body.

        Velocities are relative to the velocity of the base's origin. With the pose's rates: 3-PRRU
        paper, equations 22 and 30. Of a Delta: Delta-CU paper, equations 10 to 12.
        """
        self._base, self._u = base, u
        self.omega: dict[str, Any] = {BASE: base.omega}
        self.origin_velocity: dict[str, Any] = {BASE: _ZERO}
        self._before: dict[int, Any] = {}
        self.rate: dict[int, Any] = {}
        for link in self.tree.links.values():
            w = self.omega[link.parent]
            v = self.origin_velocity[link.parent] + cross(w, self.lever[link.body])
            for step in link.steps:
                k = step.rate
                if step.ball or step.free:
                    w = base.omega + np.array(u[k : k + 3], dtype=object)
                    if step.free:
                        v = v + np.array(u[k + 3 : k + 6], dtype=object)
                    continue
                rate = self.rate[id(step)] = step.sign * (qd[k] if step.actuated else u[k])
                axis = self.axis[id(step)]
                if step.slide:
                    v = v + axis * (step.slide * rate)
                if step.turns:
                    self._before[id(step)] = w
                    w = w + axis * rate
            self.omega[link.body], self.origin_velocity[link.body] = w, v

    def set_accelerations(self, du: Numbers, qdd: Numbers) -> None:
        """Compute each body's angular acceleration, and its origin's acceleration less gravity.

        The base moves as given with the rates. Without the Hessians of the 3-PRRU paper's equations
        23 and 31. Of a Delta: Delta-CU paper, equations 13, 14 and 16, without their misprints.
        """
        base = self._base
        self.alpha: dict[str, Any] = {BASE: base.alpha}
        self.second: dict[int, Any] = {}
        self.origin_acceleration: dict[str, Any] = {BASE: base.acceleration}
        self._acceleration_matrix: dict[str, Any] = {BASE: _acceleration_matrix(base.omega, base.alpha)}
        for link in self.tree.links.values():
            parent = link.parent
            w = self.omega[parent]
            al = self.alpha[parent]
            acc = self.origin_acceleration[parent] + self._acceleration_matrix[parent] @ self.lever[link.body]
            for step in link.steps:
                k = step.rate
                if step.ball or step.free:
                    # Rates and accelerations of a ball or free joint are relative to the base.
                    turning = np.array(du[k : k + 3], dtype=object)
                    al = base.alpha + cross(base.omega, self.omega[link.body]) + turning
                    if step.free:
                        slip = cross(base.omega, self._u[k + 3 : k + 6])
                        acc = acc + 2.0 * slip + np.array(du[k + 3 : k + 6], dtype=object)
                    continue
                second = self.second[id(step)] = step.sign * (qdd[k] if step.actuated else du[k])
                axis, rate = self.axis[id(step)], self.rate[id(step)]
                if step.slide:
                    slip, swell = step.slide * rate, step.slide * second
                    acc = acc + axis * swell + 2.0 * slip * cross(w, axis)
                if step.turns:
                    al = al + axis * second + cross(self._before[id(step)], axis) * rate
            self.alpha[link.body], self.origin_acceleration[link.body] = al, acc
            self._acceleration_matrix[link.body] = _acceleration_matrix(self.omega[link.body], al)

    def velocity(self, body: str, point: Array) -> Any:
        """Return the velocity of a point of a body, given at home (Delta-CU paper, equations 7, 8)."""
        return self.origin_velocity[body] + cross(self.omega[body], self.arm(body, point))

    def acceleration(self, body: str, point: Array) -> Any:
        """Return the acceleration, less gravity, of a point of a body (Delta-CU paper, equation 15)."""
        return self.origin_acceleration[body] + self._acceleration_matrix[body] @ self.arm(body, point)

    def acceleration_matrix(self, body: str) -> Any:
        """Return [alpha]x + [omega]x [omega]x of a body, shape (3, 3)."""
        return self._acceleration_matrix[body]

    def retract(self, x: Numbers, du: Numbers) -> list[Any]:
        """Return the unknowns after a small step du; angles and quaternions stay of unit length."""
        new = list(x)
        for link in self.tree.links.values():
            for step in link.steps:
                k, r = step.position, step.rate
                if step.actuated:
                    continue
                if step.circle:
                    c, s = x[k] - x[k + 1] * du[r], x[k + 1] + x[k] * du[r]
                    length = 1.0 / sqrt(c * c + s * s)
                    new[k], new[k + 1] = c * length, s * length
                    continue
                if not (step.ball or step.free):
                    new[k] = x[k] + du[r]
                    continue
                w, v = x[k], np.array(x[k + 1 : k + 4], dtype=object)
                d = np.array(du[r : r + 3], dtype=object) * 0.5
                w, v = w - d @ v, v + d * w + cross(d, v)
                length = 1.0 / sqrt(w * w + v @ v)
                new[k] = w * length
                new[k + 1 : k + 4] = list(v * length)
                if step.free:
                    for i in range(3):
                        new[k + 4 + i] = x[k + 4 + i] + du[r + 3 + i]
        return new


def reaction_directions(joint: Joint) -> tuple[Direction, ...]:
    """Return the three directions, fixed in bodies, along which a joint's reactions are given."""
    if joint.directions:
        return joint.directions
    names = ("axis", "across 1", "across 2") if joint.type.count else "xyz"
    vectors = joint.type.directions(joint.axes)
    return tuple(Direction(n, joint.inner, v) for n, v in zip(names, vectors, strict=True))


def closure_jacobians(tree: Tree, rows: Sequence[Row]) -> tuple[Objects, Objects]:
    """Return the derivatives of closures by u, shape (rows, unknown rates), and qd, (rows, n)."""
    n = len(tree.graph.leads)

    def block(letter: str, size: int) -> NDArray[Any]:
        table = np.zeros((len(rows), size), dtype=object)
        for i, row in enumerate(rows):
            for (kind, k), value in row.columns.items():
                if kind == letter:
                    table[i, k] = value
        return table

    return block("u", tree.unknown_rates), block("q", n)


def _quaternion_matrix(parts: Numbers) -> Objects:
    w, i, j, k = parts
    return np.array(
        [
            [1.0 - 2.0 * (j * j + k * k), 2.0 * (i * j - k * w), 2.0 * (i * k + j * w)],
            [2.0 * (i * j + k * w), 1.0 - 2.0 * (i * i + k * k), 2.0 * (j * k - i * w)],
            [2.0 * (i * k - j * w), 2.0 * (j * k + i * w), 1.0 - 2.0 * (i * i + j * j)],
        ],
        dtype=object,
    )


def _acceleration_matrix(w: Any, al: Any) -> Objects:
    """Return [al]x + [w]x [w]x, which maps a lever arm to the acceleration of its end."""
    x, y, z = w
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    return np.array(
        [
            [-(yy + zz), xy - al[2], xz + al[1]],
            [xy + al[2], -(xx + zz), yz - al[0]],
            [xz - al[1], yz + al[0], -(xx + yy)],
        ],
        dtype=object,
    )
