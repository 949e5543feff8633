# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What every judge computes from how its engine moves bodies, and from the engine's forces.

A joint is equations between points and directions of two bodies; each is a row with its change per
coordinate rate, and the part of its second derivative that needs no acceleration:

    A u = 0,  B u = q',   A u' = -a,  B u' = q'' - b,   T = [A; B]^+ [0; 1]
    tau = T' (forces of inertia and weight - wrench) + friction + rotors

by least squares over all rows, redundant ones too.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from pkm_twin.certify.description import (
    BASE,
    Array,
    Joint,
    Machine,
    Rod,
    UnfitError,
    across,
    cross,
    with_laws,
)

SINGULAR: Final = 1e-9
"""Least singular value over the greatest: below it the rows do not determine the motion."""


class Frame(NamedTuple):
    """A frame that moves with a body, parallel to the base's at home."""

    home: Array
    """Its origin at home, shape (3,), m."""
    place: Array
    rotation: Array
    columns: Array
    """Velocity of the origin and angular velocity per coordinate rate, shape (6, size)."""
    rate: Array
    """Both velocities, shape (6,)."""
    bias: Array
    """Both accelerations where the coordinates' accelerations are zero, shape (6,)."""


class Jet(NamedTuple):
    """A vector that moves with the bodies."""

    value: Array
    """Shape (3,)."""
    columns: Array
    """Its velocity per coordinate rate, shape (3, size)."""
    rate: Array
    """Its velocity."""
    bias: Array
    """Its acceleration where the coordinates' accelerations are zero."""

    def minus(self, other: Jet) -> Jet:
        """Difference of two."""
        return Jet(*(a - b for a, b in zip(self, other, strict=True)))

    def plus(self, other: Jet) -> Jet:
        """Sum of two."""
        return Jet(*(a + b for a, b in zip(self, other, strict=True)))


class Rows(NamedTuple):
    """Equations: value = 0, columns u = 0, columns u' + bias = 0."""

    value: Array
    columns: Array
    bias: Array


class Moving(ABC):
    """A machine whose bodies some engine moves."""

    machine: Machine
    size: int
    """How many rates the engine's coordinates have."""

    @abstractmethod
    def frame(self, body: str) -> Frame:
        """A body's frame at the present state."""

    @abstractmethod
    def assemble(self, q: Array) -> Any:
        """Put the assembly at ``q``, shape (n,), rad or m, at rest; connected to home.

        :raises UnfitError: none is found, with where the way from home ends.
        """

    @abstractmethod
    def move(self, rates: Array) -> None:
        """Let the present assembly have coordinate rates, shape (size,)."""

    @abstractmethod
    def forces(self, change: Array) -> Array:
        """What the coordinates' accelerations and rates and the weight ask for, shape (size,)."""

    # Motion of points and directions

    def point(self, body: str, at: Array) -> Jet:
        """A point fixed in a body, by its place at home (m)."""
        if body == BASE:
            return self._still(at)
        frame = self.frame(body)
        origin = Jet(frame.place, frame.columns[:3], frame.rate[:3], frame.bias[:3])
        return origin.plus(self._swung(frame, at - frame.home))

    def direction(self, body: str, axis: Array) -> Jet:
        """A direction fixed in a body, by its components at home."""
        return self._still(axis) if body == BASE else self._swung(self.frame(body), axis)

    def spin(self, body: str) -> Jet:
        """A body's angular velocity; as a vector it is nothing, its value is zero."""
        if body == BASE:
            return self._still(np.zeros(3))
        frame = self.frame(body)
        return Jet(np.zeros(3), frame.columns[3:], frame.rate[3:], frame.bias[3:])

    def _swung(self, frame: Frame, vector: Array) -> Jet:
        value, spin = frame.rotation @ vector, frame.rate[3:]
        rate = cross(spin, value)
        bias = cross(frame.bias[3:], value) + cross(spin, rate)
        return Jet(value, -skewed(value) @ frame.columns[3:], rate, bias)

    def _still(self, value: Array) -> Jet:
        return Jet(value, np.zeros((3, self.size)), np.zeros(3), np.zeros(3))

    # Joints

    def joint_rows(self, joint: Joint, holds: Iterable[str] | None = None) -> list[Rows]:
        """What a joint holds, or only some of it."""
        inner, outer, axes = joint.inner, joint.outer, joint.axes
        gap = self.point(outer, joint.at).minus(self.point(inner, joint.at))

        def angle(one: Array, other: Array) -> Rows:
            row = dot(self.direction(inner, one), self.direction(outer, other))
            return row._replace(value=row.value - one @ other)

        rows: list[Rows] = []
        for held in joint.type.holds if holds is None else holds:
            if held == "point":
                rows.append(Rows(gap.value, gap.columns, gap.bias))
            elif held == "turns":
                rows += [angle(np.eye(3)[k], np.eye(3)[(k + 1) % 3]) for k in range(3)]
            elif held == "line":
                rows += [dot(self.direction(inner, side), gap) for side in across(axes[0])]
            elif held == "flat":
                rows.append(dot(self.direction(inner, axes[0]), gap))
            elif held == "direction":
                rows += [angle(side, axes[0]) for side in across(axes[0])]
            elif held == "crossing":
                rows.append(angle(axes[0], axes[1]))
            elif held == "thread":
                slide, turn, turned = self._slide(joint), self._turn(joint), joint.pitch
                gone = slide.value - turned * turn.value
                # The turn is known but for whole ones.
                gone = np.array([math.remainder(gone[0], 2.0 * math.pi * turned)])
                rows.append(
                    Rows(gone, *(a - turned * b for a, b in zip(slide[1:], turn[1:], strict=True)))
                )
            else:
                raise UnfitError(f"joints.{joint.name}: no judge knows how to hold {held!r}")
        return rows

    def rates(self, joint: Joint) -> Rows:
        """Rate of a joint of one freedom: columns u are it, columns u' + bias change it."""
        if len(joint.type.steps) != 1:
            raise UnfitError(f"joints.{joint.name}: a {joint.type.name} joint has no rate")
        return self._slide(joint) if joint.slides else self._turn(joint)

    def _slide(self, joint: Joint) -> Rows:
        gap = self.point(joint.outer, joint.at).minus(self.point(joint.inner, joint.at))
        return dot(self.direction(joint.inner, joint.axes[0]), gap)

    def _turn(self, joint: Joint) -> Rows:
        axis = self.direction(joint.inner, joint.axes[0])
        relative = self.spin(joint.outer).minus(self.spin(joint.inner))
        side, other = across(joint.axes[0])
        moved = self.direction(joint.outer, side).value
        cosine = self.direction(joint.inner, side).value @ moved
        sine = self.direction(joint.inner, other).value @ moved
        return Rows(
            np.array([math.atan2(sine, cosine)]),
            (axis.value @ relative.columns)[None],
            np.array([axis.rate @ relative.rate + axis.value @ relative.bias]),
        )

    def held(self) -> Iterable[tuple[Joint, Sequence[str]]]:
        """The joints that are equations, and what of them; a tree's own are left out."""
        return [(joint, joint.type.holds) for joint in self.machine.joints]

    def closures(self) -> Rows:
        """All joints' and rods' rows at the present state."""
        rows = [row for joint, holds in self.held() for row in self.joint_rows(joint, holds)]
        rows += [self.rod_rows(rod) for rod in self.machine.rods]
        return stacked(rows, self.size)

    def rod_rows(self, rod: Rod) -> Rows:
        """A rod keeps its length."""
        gap = self.point(rod.outer, rod.ends[1]).minus(self.point(rod.inner, rod.ends[0]))
        half = dot(gap, gap)
        return Rows(half.value / 2 - rod.length**2 / 2, half.columns / 2, half.bias / 2)

    def drives(self) -> Rows:
        """The actuated joints' rows; the value is the way from home, rad or m."""
        return stacked([self.rates(joint) for joint in self.machine.actuated], self.size)

    def missing(self, way: Array) -> Array:
        """How far the actuated joints are from their way from home, shape (n,), rad or m."""
        result: Array = way - self.drives().value
        for k, joint in enumerate(self.machine.actuated):
            if not joint.slides:
                result[k] = math.remainder(result[k], 2 * math.pi)
        return result

    def solve(self, closed: Array, driven: Array) -> Array:
        """Coordinate rates that give the closures' and the drives' rows these rates."""
        columns = np.vstack([self.closures().columns, self.drives().columns])
        right = np.concatenate([closed, driven])
        return np.asarray(np.linalg.lstsq(columns, right, rcond=SINGULAR)[0], dtype=np.float64)

    def tangent(self) -> Array:
        """Coordinate rates per joint rate, shape (size, n)."""
        n = len(self.machine.actuated)
        return self.solve(np.zeros((len(self.closures().value), n)), np.eye(n))

    def twist_columns(self) -> Array:
        """The platform's twist at its reference point per coordinate rate, shape (6, size)."""
        machine = self.machine
        point = self.point(machine.platform, machine.origin)
        return np.vstack([point.columns, self.spin(machine.platform).columns])

    # What is asked for

    def platform(self, q: Array) -> tuple[Array, Array]:
        """Position of the reference point, shape (3,), m, and rotation from home, (3, 3)."""
        self.assemble(q)
        return self._placed()

    def _placed(self) -> tuple[Array, Array]:
        platform = self.machine.platform
        rotation = self.frame(platform).rotation.copy()
        return self.point(platform, self.machine.origin).value, rotation

    def jacobian(self, q: Array) -> Array:
        """The platform's twist at its reference point per joint rate, shape (6, n)."""
        self.assemble(q)
        return self.twist_columns() @ self.tangent()

    def inverse_dynamics(
        self, q: Array, qd: Array, qdd: Array, wrench: Array | None = None
    ) -> Array:
        """Efforts of the actuated joints, shape (n,), N m or N.

        :param q: positions, shape (n,), rad or m; ``qd``, ``qdd`` their derivatives.
        :param wrench: force (N) and moment (N m) of the surroundings on the platform, shape (6,).
        """
        qd, qdd = np.asarray(qd, dtype=float), np.asarray(qdd, dtype=float)
        self.assemble(q)
        tangent = self.tangent()
        rates = tangent @ qd
        self.move(rates)
        change = self.solve(-self.closures().bias, qdd - self.drives().bias)
        force = self.forces(change)
        if wrench is not None:
            force = force - self.twist_columns().T @ np.asarray(wrench, dtype=float)
        for joint in self.machine.joints:
            if joint.actuated or not (joint.viscous or joint.coulomb or joint.rotor_inertia):
                continue
            row = self.rates(joint)
            own = joint.rotor_inertia * (row.columns @ change + row.bias)
            force = force + row.columns.T @ (own + drag(joint, row.columns @ rates))
        tau: Array = tangent.T @ force
        for k, joint in enumerate(self.machine.actuated):
            tau[k] += joint.rotor_inertia * qdd[k] + drag(joint, qd[k : k + 1])[0]
        return with_laws(self.machine.actuated, q, qd, tau)

    def mass_matrix(self, q: Array) -> Array:
        """Inertia felt at the actuated joints, shape (n, n), kg m2, kg or kg m."""
        self.assemble(q)
        tangent = self.tangent()
        # The weight is the force where nothing moves.
        weight = self.forces(np.zeros(self.size))
        result: Array = np.array([self.forces(column) - weight for column in tangent.T]) @ tangent
        for joint in self.machine.joints:
            if joint.rotor_inertia:
                rates = self.rates(joint).columns @ tangent
                result += joint.rotor_inertia * rates.T @ rates
        return result


def dot(a: Jet, b: Jet) -> Rows:
    """The row a . b."""
    return Rows(
        np.array([a.value @ b.value]),
        (a.value @ b.columns + b.value @ a.columns)[None],
        np.array([a.value @ b.bias + 2 * a.rate @ b.rate + b.value @ a.bias]),
    )


def stacked(rows: list[Rows], size: int | None = None) -> Rows:
    """Rows one under another; ``size`` columns where there are none."""
    if not rows:
        return Rows(np.zeros(0), np.zeros((0, size or 0)), np.zeros(0))
    return Rows(
        np.concatenate([row.value for row in rows]),
        np.vstack([row.columns for row in rows]),
        np.concatenate([row.bias for row in rows]),
    )


def drag(joint: Joint, rates: Array) -> Array:
    """Friction's share of the effort at these rates, one a rate, N m or N."""
    result: Array = joint.viscous * rates + joint.coulomb * np.sign(rates) + joint.offset
    return result


def skewed(v: Array) -> Array:
    """The matrix of v x, shape (3, 3)."""
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
