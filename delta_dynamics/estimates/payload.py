# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Estimate the payload from the efforts that the model does not explain, sample by sample."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from delta_dynamics.torques.regressor import PAYLOAD, parameter_names, regressor
from delta_dynamics.torques.stiction import (
    LoadFrictionCompensation,
    beyond_friction,
    friction_reach,
    zero_resting_rates,
)
from delta_dynamics.torques.uncertainty import Noise
from delta_dynamics.torques.virtual_work import inverse_dynamics
from pkm_twin.codegen.arrays import Array, check_later, one_vector
from pkm_twin.messages.stamps import SECOND
from pkm_twin.robot.mechanism import EFFORT_SHARING_NOTE
from pkm_twin.robot.robot import Robot
from pkm_twin.streams.drives import DriveWatch
from pkm_twin.streams.rest import VelocityErrorEstimator

ESTIMATED_PARAMETERS: Final = ("mass", "mx", "my", "mz")
"""Estimated parameters: mass and first moments about the platform's reference point."""
CORRELATION_TIME: Final = 0.02
"""Correlation time of the residual's errors, s."""
DECAY_TIME: Final = 20.0
"""Time after which a sample's weight has decayed to 1/e, s."""
SETTLING_TIME: Final = 0.4
"""Time after the start in which no jump is detected, s."""
JUMP_AVERAGING_TIME: Final = 0.06
"""Averaging time of the residual for detecting a jump, s."""


@dataclass(frozen=True)
class PayloadEstimate:
    """Hold mass, kg, and centre of mass (3,), m from the reference point, platform axes.

    Both have standard deviations. If the motion does not determine the centre of mass, its standard
    deviation is infinite and its value is that of the robot's own payload. ``asked``: the estimate
    of the mass without the bound at zero; if it is negative, the mass is zero and its standard
    deviation covers the difference.
    """

    mass: float
    com: Array
    mass_deviation: float
    com_deviation: Array
    resets: int
    asked: float


class PayloadEstimator:
    """Estimate a payload by recursive least squares on measured minus computed efforts.

    Efforts are linear in mass and first moments (:func:`.regressor`). A sample is weighted
    by its time span, at most the correlation time of the errors, and its weight decays slowly. A
    jump in the residual means that the load has changed: it resets the estimate, but not the noise.

    A joint with Coulomb friction at rest gives its effort only within the friction, once per stop.
    While the drives are off or braked, efforts contain no information.
    """

    def __init__(self, robot: Robot, *, mass_range: float = 5.0, reach: float = 0.2) -> None:
        """Start with the robot's own payload.

        :param mass_range: standard deviation of a load's mass before anything is known, kg.
        :param reach: standard deviation of its centre of mass, m.
        """
        robot.check_independent("payloads of measured efforts", EFFORT_SHARING_NOTE)
        self._load_friction = LoadFrictionCompensation(robot)
        self.robot = robot = self._load_friction.robot
        names = parameter_names(robot)
        self._columns = [names.index(f"{PAYLOAD}.{what}") for what in ESTIMATED_PARAMETERS]
        load = robot.payload
        self._own = np.array([load.mass, *(load.mass * load.com)])
        self._prior = np.array([mass_range, *(3 * [mass_range * reach])])
        still = np.zeros(robot.joints_count)
        rest = inverse_dynamics(robot, robot.inverse(robot.home()), still, still)
        # Smallest standard deviation of an effort; a balanced machine has no effort at rest.
        limits = robot.limits.effort
        scale = 1.0 if limits is None else float(np.abs(limits).max())
        self._least = 0.01 * max(float(np.abs(rest).max()), 1e-3 * scale)
        self._friction_reach = friction_reach(robot)
        self.drives = DriveWatch()
        self._velocity_error = VelocityErrorEstimator(0.0)
        self.resets = 0
        # Squares are clipped at 4 times the average, so that a jump is not learnt as noise.
        self._noise = Noise(np.full(robot.joints_count, 4.0 * self._least**2), SETTLING_TIME, 4.0)
        self.reset()
        self.resets = 0

    def reset(self) -> None:
        """Reset the estimate of the load, but not that of the noise."""
        self.resets += 1
        self._information = np.diag(self._prior**-2.0)
        self._weighted = self._information @ self._own
        self._average = np.zeros(self.robot.joints_count)
        self._since = 0.0
        self._save_estimate()
        self.begin_anew()

    def _save_estimate(self) -> None:
        """Save the estimate, to restore it if the next efforts turn out to be those of a brake."""
        noise = copy.copy(self._noise)
        self._saved = self._information, self._weighted, self._average, self._since, noise

    def begin_anew(self) -> None:
        """Forget the time of the last sample, after the clock jumped back; keep the estimate."""
        self._last: float | None = None
        self.drives.reset()
        self._velocity_error.reset()

    def push(
        self,
        time: float,
        q: Array,
        qd: Array,
        qdd: Array,
        effort: Array,
        wrench: Array | None = None,
        rate_error: Array | None = None,
    ) -> PayloadEstimate | None:
        """Add a sample; return None for the first one, and while efforts are uninformative.

        :param time: of the sample, s, later than the last one's.
        :param q: joint positions (n,), with rates, accelerations and measured efforts (n,).
        :param wrench: on the platform at its reference point, base axes, (6,), where it is known.
        :param rate_error: error bounds of the rates, (n,); by default from their own noise.
        :raises ValueError: a sample that is not later than the last one, has another shape or is
            not finite; neither it nor a sample without an assembly changes the estimate.
        """
        n, last = self.robot.joints_count, self._last
        time = check_later(time, last)
        q, qd, qdd, effort = (one_vector(v, n, "a sample") for v in (q, qd, qdd, effort))
        held = inverse_dynamics(self.robot, q, 0.0 * q, 0.0 * q, wrench)
        self._last = time
        if rate_error is None:
            rate_error = self._velocity_error.push(round(time * SECOND), q, qd, qd)
        still = np.abs(qd) <= rate_error
        was_idle = self.drives.idle
        idle = self.drives.push(time, still, effort, held)
        if idle and not was_idle:
            self._information, self._weighted, self._average, self._since, self._noise = self._saved
        if idle or last is None:
            return None
        if not self.drives.repeated:
            self._save_estimate()
        step = time - last
        rates_used = zero_resting_rates(qd, still, self._friction_reach + self._load_friction.fraction)
        effort, load_friction = self._load_friction.remove(q, rates_used, effort)
        reach = self._friction_reach + load_friction
        columns = regressor(self.robot, q, rates_used, qdd)[:, self._columns]
        computed = inverse_dynamics(self.robot, q, rates_used, qdd, wrench)
        target = effort - computed + columns @ self._own
        residual = beyond_friction(target - columns @ self._solve(), still, reach)
        self._since += step
        self._average = self._average + min(1.0, step / JUMP_AVERAGING_TIME) * (residual - self._average)
        # Standard deviation of the average of errors with this correlation time; six of them are a jump.
        spread = np.sqrt(self._noise.variance * CORRELATION_TIME / (CORRELATION_TIME + JUMP_AVERAGING_TIME))
        if self._since >= SETTLING_TIME and (np.abs(self._average) > 6.0 * spread).any():
            self.reset()
            self._last = time
            return self.estimate()
        decay = math.exp(-step / DECAY_TIME)
        resting = still & (reach > 0.0)
        weights = np.where(resting, min(1.0, step / DECAY_TIME), min(1.0, step / CORRELATION_TIME))
        variance = self._noise.variance + np.where(resting, reach**2, 0.0)
        rows = columns * (weights / variance)[:, None]
        prior = np.diag(self._prior**-2.0)
        # Faded information is replaced by the prior.
        self._information = decay * self._information + (1 - decay) * prior + rows.T @ columns
        self._weighted = decay * self._weighted + (1 - decay) * prior @ self._own + rows.T @ target
        self._noise.advance(step)
        residual = beyond_friction(target - columns @ self._solve(), still, reach)
        self._noise.learn(residual, self._least**2)
        return self.estimate()

    def _solve(self) -> Array:
        return np.asarray(np.linalg.solve(self._information, self._weighted), np.float64)

    def estimate(self) -> PayloadEstimate:
        """Return the present estimate."""
        values = self._solve()
        covariance = np.linalg.inv(self._information)
        mass = float(values[0])
        deviation = math.sqrt(covariance[0, 0])
        determined = np.diag(covariance)[1:] < (0.5 * self._prior[1:]) ** 2
        divisor = mass if abs(mass) > 3.0 * deviation else math.nan
        com = values[1:] / divisor
        # Standard deviation of a quotient of two correlated numbers, to first order.
        gradient = np.hstack([-com[:, None] / divisor, np.eye(3) / divisor])
        deviations = np.sqrt(np.einsum("ki,ij,kj->k", gradient, covariance, gradient))
        known = determined & np.isfinite(com)
        own = self.robot.payload.com
        if mass < 0.0:
            # A negative mass means that no payload was found; its centre is undefined.
            nowhere = np.full(3, np.inf)
            return PayloadEstimate(0.0, own.copy(), math.hypot(deviation, mass), nowhere, self.resets, mass)
        return PayloadEstimate(
            mass, np.where(known, com, own), deviation, np.where(known, deviations, np.inf), self.resets, mass
        )
