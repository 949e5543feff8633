# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Describe a path of the platform, and compute how machines with other numbers follow it.

The pose p and its first and second derivatives in time stay the same; joints and efforts follow.

A sum w . tau of efforts has a direct derivative by a number g of the file, less the part that
keeps the pose: with P, V and A the pose, its rate and its acceleration as functions of q, qd, qdd
and g,

    d(w . tau)/dg = tau_g - a . A_g - v . V_g - p . P_g,
    J^T a = tau_qdd,   J^T v = tau_qd - A_qd^T a,   J^T p = tau_q - A_q^T a - V_q^T v

with J the pose's Jacobian (the adjoint of the implicit function theorem, three times).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array, Indices
from pkm_twin.design import programs
from pkm_twin.design.variants import Variants
from pkm_twin.errors import ParameterError
from pkm_twin.robot.robot import Robot


@dataclass(frozen=True, eq=False)
class PosePath:
    """Describe a path of the platform over t samples.

    ``time``, shape (t,), s, rising. ``pose``, ``rate`` and ``acceleration``: the pose and its
    derivatives in time, shape (t, m). ``wrench``: on the platform, shape (t, 6), N and N m, base
    axes at its reference point.
    """

    time: Array
    pose: Array
    rate: Array
    acceleration: Array
    wrench: Array

    @classmethod
    def of_joints(
        cls,
        robot: Robot,
        time: ArrayLike,
        q: ArrayLike,
        qd: ArrayLike,
        qdd: ArrayLike,
        wrench: ArrayLike | None = None,
    ) -> PosePath:
        """Return the path of a robot's platform during a joint motion.

        :param time: shape (t,), s; ``q``, ``qd``, ``qdd``: shape (t, n).
        :param wrench: shape (t, 6) or (6,); None for no wrench.
        :raises ParameterError: fewer than two samples, or times that do not rise.
        :raises UnreachableError: a joint state without an assembly. Others as of ``forward``.
        """
        times = np.asarray(time, np.float64)
        if times.ndim != 1 or len(times) < 2 or not (np.diff(times) > 0.0).all():
            raise ParameterError("time", list(times.shape), "two or more rising times")
        rate = (robot.jacobian(q) @ np.asarray(qd, np.float64)[..., None])[..., 0]
        load = np.zeros(6) if wrench is None else np.asarray(wrench, np.float64)
        return cls(
            times,
            robot.forward(q),
            rate,
            robot.pose_acceleration(q, qd, qdd),
            np.array(np.broadcast_to(load, (len(times), 6))),
        )

    def at(self, rows: Indices) -> PosePath:
        """Return some samples of the path, in any order."""
        parts = (self.time, self.pose, self.rate, self.acceleration, self.wrench)
        return PosePath(*(part[rows] for part in parts))

    @cached_property
    def weights(self) -> Array:
        """Weight of each sample in a trapezoidal integral over time, shape (t,), s."""
        steps = np.diff(self.time)
        return np.asarray(0.5 * (np.append(steps, 0.0) + np.append(0.0, steps)), np.float64)

    @property
    def duration(self) -> float:
        """Time from the first sample to the last, s."""
        return float(self.time[-1] - self.time[0])


class PathMotion:
    """Compute motion and efforts of machines (k) on a path; NaN if a machine cannot follow it.

    Derivatives are those of one machine, by its numbers (d).
    """

    def __init__(self, machines: Variants, path: PosePath) -> None:
        self.machines, self.path = machines, path

    def _for_machines(self, values: Array) -> Array:
        """Repeat samples for every machine, so that the first axis is the machine."""
        return np.broadcast_to(values, (len(self.machines), *values.shape))

    @cached_property
    def _motion(self) -> list[Array]:
        """Joint positions, velocities, accelerations and efforts, shape (k, t, n) each."""
        path = self.path
        samples = path.pose, path.rate, path.acceleration, path.wrench
        return self.machines.run_program(programs.torques_at_pose, *map(self._for_machines, samples))[0]

    @cached_property
    def q(self) -> Array:
        """Joint positions, shape (k, t, n)."""
        if self.machines.robot.has_masses:
            return self._motion[0]
        return self.machines.inverse(self._for_machines(self.path.pose))

    @property
    def qd(self) -> Array:
        """Joint velocities, shape (k, t, n)."""
        return self._motion[1]

    @property
    def qdd(self) -> Array:
        """Joint accelerations, shape (k, t, n)."""
        return self._motion[2]

    @property
    def efforts(self) -> Array:
        """Efforts, shape (k, t, n), N m or N."""
        return self._motion[3]

    @cached_property
    def jacobian(self) -> Array:
        """Pose rates per joint rate, shape (k, t, m, n); the unit matrix if undefined."""
        found = self.machines.jacobian(self.q)
        good = np.isfinite(found).all((-1, -2), keepdims=True)
        return np.where(good, found, np.eye(*found.shape[-2:]))

    @cached_property
    def singularity(self) -> Array:
        """Singularity index of every sample, shape (k, t)."""
        return self.machines.singularity(self.q)

    @cached_property
    def compliance(self) -> Array:
        """Compliance of every sample, shape (k, t, 6, 6)."""
        return self.machines.compliance(self._for_machines(self.path.pose))

    @cached_property
    def deflection(self) -> Array:
        """Deflection of the platform under the path's wrench, shape (k, t, 6), m and rad."""
        return np.asarray((self.compliance @ self.path.wrench[..., None])[..., 0])

    # Derivatives by the numbers, of one machine.

    def effort_derivatives(self, weights: Array, rates: Array | None = None, changes: Array | None = None) -> Array:
        """Return the derivatives of each sample's w . tau + r . qd + c . qdd, shape (t, d).

        :param weights: w, shape (t, n); ``rates``: r, ``changes``: c, shape (t, n), None for zero.
        """
        state = (self.q, self.qd, self.qdd, self._for_machines(self.path.wrench), weights[None])
        (by_q, by_qd, by_qdd), _ = self.machines.run_program(programs.torque_gradient, *state)
        (of_geometry, of_masses), _ = self.machines.run_program(programs.torque_numbers, *state)
        if rates is not None:
            by_qd = by_qd + rates
        if changes is not None:
            by_qdd = by_qdd + changes
        held = self._add_constant_poses(by_q, (by_qd, by_qdd))
        rows = np.concatenate([of_geometry + held, of_masses], -1)
        return np.asarray(rows[0] @ self.machines.functions.rigid.slopes_at(self.machines.values[:1])[0])

    def singularity_derivatives(self) -> Array:
        """Return the derivatives of each sample's index, shape (t, d)."""
        ones = np.ones((1, len(self.path.time), 1))
        (by_q, by_geometry), _ = self.machines.run_program(programs.singularity_derivatives, self.q, ones)
        return self._by_numbers_of_geometry(by_geometry + self._add_constant_poses(by_q))

    def compliance_derivatives(self, weights: Array) -> Array:
        """Return the derivatives of each sample's weighted sum of C's entries, (t, d).

        :param weights: shape (t, 6, 6).
        """
        flat = weights.reshape(1, len(weights), 36)
        (by_q, numbers), _ = self.machines.run_program(programs.compliance_derivatives, self.q, flat)
        count = len(self.machines.robot.engine.geometry)
        by_geometry = self._by_numbers_of_geometry(numbers[..., :count] + self._add_constant_poses(by_q))
        elastic = self.machines.functions.elastic_inputs.slopes_at(self.machines.values)[0]
        return np.asarray(by_geometry + numbers[0, :, count:] @ elastic)

    def _by_numbers_of_geometry(self, rows: Array) -> Array:
        return np.asarray(rows[0] @ self.machines.geometry_jacobian)

    def _add_constant_poses(self, by_q: Array, by_rates: tuple[Array, Array] | None = None) -> Array:
        """Return the part of derivatives by the geometry through q, qd and qdd at constant poses, (1, t, g).

        :param by_rates: derivatives by qd and qdd; None for zero.
        """
        jacobian_transposed = np.swapaxes(self.jacobian, -1, -2)
        weights = np.zeros((*by_q.shape[:-1], 3, by_q.shape[-1]))
        qd, qdd = np.zeros_like(self.q), np.zeros_like(self.q)

        def pose_derivatives() -> list[Array]:
            flat = weights.reshape(*weights.shape[:-2], -1)
            return self.machines.run_program(programs.pose_motion, self.q, qd, qdd, flat)[0]

        if by_rates is not None:
            qd, qdd = self.qd, self.qdd
            weights[..., 2, :] = _solve(jacobian_transposed, by_rates[1])
            weights[..., 1, :] = _solve(jacobian_transposed, by_rates[0] - pose_derivatives()[1])
            by_q = by_q - pose_derivatives()[0]
        weights[..., 0, :] = _solve(jacobian_transposed, by_q)
        return -pose_derivatives()[2]


def _solve(matrix: Array, right: Array) -> Array:
    """Solve for vectors; NaN for a singular matrix."""
    try:
        return np.asarray(np.linalg.solve(matrix, right[..., None])[..., 0], np.float64)
    except np.linalg.LinAlgError:
        # A machine is in a singularity: solve for the others.
        good = np.abs(np.linalg.det(matrix)) > 0.0
        sound = np.where(good[..., None, None], matrix, np.eye(matrix.shape[-1]))
        found = np.linalg.solve(sound, right[..., None])[..., 0]
        return np.where(good[..., None], found, np.nan)
