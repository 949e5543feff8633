# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Uncertainty of efforts: from the uncertainty of the robot file's numbers, and from learnt noise."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from delta_dynamics.torques.derivatives import torque_effects
from delta_dynamics.torques.virtual_work import inverse_dynamics, mass_matrix
from pkm_twin.codegen.arrays import Array
from pkm_twin.robot.robot import Robot

DEFAULT_MASS_ERROR: Final = 0.015
"""Default standard deviation of efforts due to masses, as a share of those of gravity, inertia and
velocities each: parts from CAD or a scale, cables and screws left out, are within a few percent."""
DEFAULT_FRICTION_ERROR: Final = 0.015
"""Default standard deviation of efforts that are not modelled, such as friction and cables, as a
share of the greatest effort."""


class EffortParts(NamedTuple):
    """Efforts at one sample, shape (n,), N m or N.

    ``static``: at zero velocities and accelerations. ``moving``: at the sample's velocities and zero
    accelerations. ``whole``: of the sample.
    """

    static: Array
    moving: Array
    whole: Array

    def default_deviation(self, greatest: Array) -> Array:
        """Return the default standard deviation of efforts without ``uncertainty``, shape (n,).

        :param greatest: the greatest efforts that the robot's motion needs, shape (n,).
        """
        sizes = np.abs(self.static) + np.abs(self.moving - self.static)
        sizes = sizes + np.abs(self.whole - self.moving)
        return np.asarray(np.hypot(DEFAULT_MASS_ERROR * sizes, DEFAULT_FRICTION_ERROR * greatest), np.float64)


def effort_parts(robot: Robot, q: Array, qd: Array, qdd: Array, wrench: Array | None, mass: Array) -> EffortParts:
    """Compute the efforts of one sample without motion, with its velocities, and with its accelerations too.

    :param robot: without friction that grows with the load, so that efforts are linear in qdd.
    :param mass: its mass matrix at q, shape (n, n).
    """
    still = np.zeros_like(q)
    moving = inverse_dynamics(robot, q, qd, still, wrench)
    static = inverse_dynamics(robot, q, still, still, wrench)
    return EffortParts(static, moving, moving + mass @ qdd)


def usual_effort(robot: Robot) -> Array:
    """Return each joint's effort at home, (n,): the larger one of holding the weight and accelerating by g."""
    q, still = robot.inverse(robot.home()), np.zeros(robot.joints_count)
    lever = np.array([1.0, 1.0, 1.0, *(3 * [robot.size])])
    platform_rate = np.linalg.norm(robot.platform_jacobian(q) * lever[:, None], axis=0)
    inertia = np.diag(mass_matrix(robot, q))
    held = np.abs(inverse_dynamics(robot, q, still, still))
    moves_platform = platform_rate > 1e-6 * platform_rate.max(initial=0.0)
    return np.where(
        moves_platform, np.maximum(held, 9.81 * inertia / np.where(moves_platform, platform_rate, 1.0)), held
    )


def torque_deviation(
    robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, wrench: ArrayLike | None = None
) -> Array:
    """Return the standard deviation of efforts, propagated from the file's ``uncertainty``.

    To first order in the standard deviations, independent causes. Zero for a file that names none.

    :param q: joint positions, shape (..., n), rad or m; rates ``qd``, accelerations ``qdd``.
    :param wrench: as in ``inverse_dynamics``, shape (..., 6); None: no wrench.
    :returns: shape (..., n), N m or N.
    """
    if not robot.uncertainty:
        return np.zeros_like(inverse_dynamics(robot, q, qd, qdd, wrench))
    effects = torque_effects(robot, q, qd, qdd, wrench)
    return np.asarray(np.sqrt((effects * effects).sum(-1)), np.float64)


NOISE_AVERAGING_TIME: Final = 1.0
"""Time over which the noise is averaged, s."""


class Noise:
    """Estimate the variance of errors of mean zero, shape (n,), by the average of their squares.

    After the learning time each square is clipped at ``clipped`` times the average, so that a lasting
    error does not count as noise.
    """

    def __init__(self, variance: Array, learning: float, clipped: float) -> None:
        """Start with a variance, shape (n,); ``learning``: time, s, in which squares are not clipped."""
        self.variance = variance
        self._learning, self._clipped = learning, clipped
        self._time = self._step = 0.0

    @property
    def settled(self) -> bool:
        """True after the learning time."""
        return self._time > self._learning

    def advance(self, step: float) -> None:
        """Advance the time by one step, s; call it at each sample, also where its error is not learnt."""
        self._step = step
        self._time += step

    def learn(self, error: Array, least: Array | float) -> None:
        """Add the errors at this time, shape (n,); ``least``: lower bound of the variance."""
        square = error**2
        if self.settled:
            square = np.minimum(square, self._clipped * self.variance)
        part = min(1.0, self._step / min(self._time, NOISE_AVERAGING_TIME))
        self.variance = np.maximum(self.variance + part * (square - self.variance), least)
