# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compute a machine's kinematics and dynamics from an engine's frames, Jacobians and forces.

A joint is a set of equations between points and directions of two bodies. Each equation is a row:
its value, its change per coordinate velocity, and its second derivative at zero acceleration. With
coordinate velocities u, rows A of the closures (bias a) and B of the actuated joints (bias b):

    A u = 0,  B u = q',   A u' = -a,  B u' = q'' - b,   T = [A; B]^+ [0; 1]
    tau = T' (forces of inertia and weight - wrench) + friction + rotors

by least squares over all rows, including redundant ones.
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
    add_friction_laws,
    cross,
    make_perpendicular_axes,
)

MIN_SINGULAR_VALUE_RATIO: Final = 1e-9
"""Smallest ratio of singular values: below it the rows do not determine the motion."""


class Frame(NamedTuple):
    """A frame that moves with a body and is parallel to the base frame at home."""

    home: Array
    """Origin at home, shape (3,), m."""
    place: Array
    rotation: Array
    columns: Array
    """Velocity of the origin and angular velocity per coordinate rate, shape (6, size)."""
    rate: Array
    """Velocity of the origin and angular velocity, shape (6,)."""
    bias: Array
    """Accelerations of both at zero coordinate accelerations, shape (6,)."""


class MovingVector(NamedTuple):
    """A vector that moves with the bodies, with its derivatives by time and coordinates."""

    value: Array
    """Shape (3,)."""
    columns: Array
    """Derivative by time per coordinate velocity, shape (3, size)."""
    rate: Array
    """Derivative by time, shape (3,)."""
    bias: Array
    """Second derivative at zero coordinate accelerations, shape (3,)."""

    def minus(self, other: MovingVector) -> MovingVector:
        """Subtract another vector."""
        return MovingVector(*(a - b for a, b in zip(self, other, strict=True)))

    def plus(self, other: MovingVector) -> MovingVector:
        """Add another vector."""
        return MovingVector(*(a + b for a, b in zip(self, other, strict=True)))


class Rows(NamedTuple):
    """Equations and their derivatives: value = 0, columns u = 0, columns u' + bias = 0."""

    value: Array
    columns: Array
    bias: Array


class Engine(ABC):
    """Base class of engines: computes equations, Jacobians and dynamics from frames and forces of bodies."""

    machine: Machine
    size: int
    """Number of the engine's coordinate velocities."""

    @abstractmethod
    def frame(self, body: str) -> Frame:
        """Return a body's frame in the present state."""

    @abstractmethod
    def assemble(self, q: Array) -> Any:
        """Set the assembly at ``q``, shape (n,), rad or m, at rest, connected to home.

        :raises UnfitError: no assembly is found; the text says where the line from home ends.
        """

    @abstractmethod
    def set_velocities(self, rates: Array) -> None:
        """Set the coordinate velocities in the present configuration, shape (size,)."""

    @abstractmethod
    def forces(self, change: Array) -> Array:
        """Compute forces of inertia and weight at coordinate accelerations, shape (size,)."""

    # Motion of points and directions

    def point(self, body: str, at: Array) -> MovingVector:
        """Return a point fixed in a body, given by its position at home, m."""
        if body == BASE:
            return self._make_constant(at)
        frame = self.frame(body)
        origin = MovingVector(frame.place, frame.columns[:3], frame.rate[:3], frame.bias[:3])
        return origin.plus(self._rotate_with(frame, at - frame.home))

    def direction(self, body: str, axis: Array) -> MovingVector:
        """Return a direction fixed in a body, given by its components at home."""
        return self._make_constant(axis) if body == BASE else self._rotate_with(self.frame(body), axis)

    def spin(self, body: str) -> MovingVector:
        """Return a body's angular velocity as the derivative of a vector whose value is zero."""
        if body == BASE:
            return self._make_constant(np.zeros(3))
        frame = self.frame(body)
        return MovingVector(np.zeros(3), frame.columns[3:], frame.rate[3:], frame.bias[3:])

    def _rotate_with(self, frame: Frame, vector: Array) -> MovingVector:
        value, spin = frame.rotation @ vector, frame.rate[3:]
        rate = cross(spin, value)
        bias = cross(frame.bias[3:], value) + cross(spin, rate)
        # The derivative is -[value]x times the angular velocity, with the cross product's matrix.
        x, y, z = value.tolist()
        return MovingVector(
            value, -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ frame.columns[3:], rate, bias
        )

    def _make_constant(self, value: Array) -> MovingVector:
        return MovingVector(value, np.zeros((3, self.size)), np.zeros(3), np.zeros(3))

    # Joints

    def joint_rows(self, joint: Joint, holds: Iterable[str] | None = None) -> list[Rows]:
        """Return the equations of a joint, or of some of its constraints."""
        inner, outer, axes = joint.inner, joint.outer, joint.axes
        gap = self.point(outer, joint.at).minus(self.point(inner, joint.at))

        def cosine_row(one: Array, other: Array) -> Rows:
            row = dot(self.direction(inner, one), self.direction(outer, other))
            return row._replace(value=row.value - one @ other)

        rows: list[Rows] = []
        for constraint in joint.type.holds if holds is None else holds:
            if constraint == "point":
                rows.append(Rows(gap.value, gap.columns, gap.bias))
            elif constraint == "turns":
                rows += [cosine_row(np.eye(3)[k], np.eye(3)[(k + 1) % 3]) for k in range(3)]
            elif constraint == "line":
                rows += [dot(self.direction(inner, side), gap) for side in make_perpendicular_axes(axes[0])]
            elif constraint == "flat":
                rows.append(dot(self.direction(inner, axes[0]), gap))
            elif constraint == "direction":
                rows += [cosine_row(side, axes[0]) for side in make_perpendicular_axes(axes[0])]
            elif constraint == "crossing":
                rows.append(cosine_row(axes[0], axes[1]))
            elif constraint == "thread":
                slide, turn, pitch = self._displacement(joint), self._rotation_angle(joint), joint.pitch
                residual = slide.value - pitch * turn.value
                # The angle is known up to full turns only.
                residual = np.array([math.remainder(residual[0], 2.0 * math.pi * pitch)])
                rows.append(Rows(residual, *(a - pitch * b for a, b in zip(slide[1:], turn[1:], strict=True))))
            else:
                raise UnfitError(f"joints.{joint.name}: no judge knows how to hold {constraint!r}")
        return rows

    def rates(self, joint: Joint) -> Rows:
        """Return the value of a joint with one freedom, as a row with its derivatives."""
        if len(joint.type.steps) != 1:
            raise UnfitError(f"joints.{joint.name}: a {joint.type.name} joint has no rate")
        return self._displacement(joint) if joint.slides else self._rotation_angle(joint)

    def _displacement(self, joint: Joint) -> Rows:
        """Return the displacement along a joint's axis, with its derivatives."""
        gap = self.point(joint.outer, joint.at).minus(self.point(joint.inner, joint.at))
        return dot(self.direction(joint.inner, joint.axes[0]), gap)

    def _rotation_angle(self, joint: Joint) -> Rows:
        """Return the rotation angle about a joint's axis, with its derivatives."""
        axis = self.direction(joint.inner, joint.axes[0])
        relative = self.spin(joint.outer).minus(self.spin(joint.inner))
        side, other = make_perpendicular_axes(joint.axes[0])
        moved = self.direction(joint.outer, side).value
        cosine = self.direction(joint.inner, side).value @ moved
        sine = self.direction(joint.inner, other).value @ moved
        return Rows(
            np.array([math.atan2(sine, cosine)]),
            (axis.value @ relative.columns)[None],
            np.array([axis.rate @ relative.rate + axis.value @ relative.bias]),
        )

    def constraint_joints(self) -> Iterable[tuple[Joint, Sequence[str]]]:
        """List the joints whose constraints are equations, with the names of these constraints."""
        return [(joint, joint.type.holds) for joint in self.machine.joints]

    def closures(self) -> Rows:
        """Return the equations of all joints and rods in the present state."""
        rows = [row for joint, holds in self.constraint_joints() for row in self.joint_rows(joint, holds)]
        rows += [self.rod_rows(rod) for rod in self.machine.rods]
        return stack_rows(rows, self.size)

    def rod_rows(self, rod: Rod) -> Rows:
        """Return the equation of a rod's constant length."""
        gap = self.point(rod.outer, rod.ends[1]).minus(self.point(rod.inner, rod.ends[0]))
        half = dot(gap, gap)
        return Rows(half.value / 2 - rod.length**2 / 2, half.columns / 2, half.bias / 2)

    def drives(self) -> Rows:
        """Return the rows of the actuated joints; values are relative to home, rad or m."""
        return stack_rows([self.rates(joint) for joint in self.machine.actuated], self.size)

    def remaining_motion(self, goal: Array) -> Array:
        """Return ``goal`` minus the actuated joints' motion from home, (n,), rad or m."""
        result: Array = goal - self.drives().value
        for k, joint in enumerate(self.machine.actuated):
            if not joint.slides:
                result[k] = math.remainder(result[k], 2 * math.pi)
        return result

    def solve(self, closed: Array, driven: Array) -> Array:
        """Find coordinate velocities for given rates of the closures and of the actuated joints."""
        columns = np.vstack([self.closures().columns, self.drives().columns])
        right = np.concatenate([closed, driven])
        return np.asarray(np.linalg.lstsq(columns, right, rcond=MIN_SINGULAR_VALUE_RATIO)[0], dtype=np.float64)

    def tangent(self) -> Array:
        """Return coordinate velocities per velocity of the actuated joints, shape (size, n)."""
        n = len(self.machine.actuated)
        return self.solve(np.zeros((len(self.closures().value), n)), np.eye(n))

    def twist_columns(self) -> Array:
        """Return the platform's twist at its reference point per coordinate velocity, (6, size)."""
        machine = self.machine
        point = self.point(machine.platform, machine.origin)
        return np.vstack([point.columns, self.spin(machine.platform).columns])

    # Quantities that are compared

    def platform(self, q: Array) -> tuple[Array, Array]:
        """Compute the reference point's position, (3,), m, and the rotation from home, (3, 3)."""
        self.assemble(q)
        return self._platform_pose()

    def _platform_pose(self) -> tuple[Array, Array]:
        platform = self.machine.platform
        rotation = self.frame(platform).rotation.copy()
        return self.point(platform, self.machine.origin).value, rotation

    def jacobian(self, q: Array) -> Array:
        """Compute the platform's twist at its reference point per joint velocity, shape (6, n)."""
        self.assemble(q)
        return self.twist_columns() @ self.tangent()

    def inverse_dynamics(self, q: Array, qd: Array, qdd: Array, wrench: Array | None = None) -> Array:
        """Compute the efforts of the actuated joints, shape (n,), N m or N.

        :param q: positions, shape (n,), rad or m; ``qd``, ``qdd``: their derivatives.
        :param wrench: force (N) and moment (N m) of the environment on the platform, shape (6,).
        """
        qd, qdd = np.asarray(qd, dtype=float), np.asarray(qdd, dtype=float)
        self.assemble(q)
        tangent = self.tangent()
        rates = tangent @ qd
        self.set_velocities(rates)
        change = self.solve(-self.closures().bias, qdd - self.drives().bias)
        force = self.forces(change)
        if wrench is not None:
            force = force - self.twist_columns().T @ np.asarray(wrench, dtype=float)
        for joint in self.machine.joints:
            if joint.actuated or not (joint.viscous or joint.coulomb or joint.rotor_inertia):
                continue
            row = self.rates(joint)
            own = joint.rotor_inertia * (row.columns @ change + row.bias)
            force = force + row.columns.T @ (own + friction_efforts(joint, row.columns @ rates))
        tau: Array = tangent.T @ force
        for k, joint in enumerate(self.machine.actuated):
            tau[k] += joint.rotor_inertia * qdd[k] + friction_efforts(joint, qd[k : k + 1])[0]
        return add_friction_laws(self.machine.actuated, q, qd, tau)

    def mass_matrix(self, q: Array) -> Array:
        """Compute the mass matrix at the actuated joints, shape (n, n), kg m2, kg or kg m."""
        self.assemble(q)
        tangent = self.tangent()
        # Forces without accelerations are the weight.
        weight = self.forces(np.zeros(self.size))
        result: Array = np.array([self.forces(column) - weight for column in tangent.T]) @ tangent
        for joint in self.machine.joints:
            if joint.rotor_inertia:
                rates = self.rates(joint).columns @ tangent
                result += joint.rotor_inertia * rates.T @ rates
        return result


def dot(a: MovingVector, b: MovingVector) -> Rows:
    """Return the scalar product a . b as a row."""
    return Rows(
        np.array([a.value @ b.value]),
        (a.value @ b.columns + b.value @ a.columns)[None],
        np.array([a.value @ b.bias + 2 * a.rate @ b.rate + b.value @ a.bias]),
    )


def stack_rows(rows: list[Rows], size: int | None = None) -> Rows:
    """Stack rows; without rows return an empty one with ``size`` columns."""
    if not rows:
        return Rows(np.zeros(0), np.zeros((0, size or 0)), np.zeros(0))
    return Rows(
        np.concatenate([row.value for row in rows]),
        np.vstack([row.columns for row in rows]),
        np.concatenate([row.bias for row in rows]),
    )


def friction_efforts(joint: Joint, rates: Array) -> Array:
    """Return viscous friction, Coulomb friction and offset at each velocity, N m or N."""
    return np.asarray(joint.viscous * rates + joint.coulomb * np.sign(rates) + joint.offset)
