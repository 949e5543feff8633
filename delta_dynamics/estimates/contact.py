# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Detect contacts: external efforts beyond the uncertainty of model and noise."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from delta_dynamics.estimates.isolation import ContactLocator, ContactPlace
from delta_dynamics.torques.stiction import LoadFrictionCompensation, friction_reach, zero_resting_rates
from delta_dynamics.torques.uncertainty import NOISE_AVERAGING_TIME, Noise, effort_parts, torque_deviation, usual_effort
from delta_dynamics.torques.virtual_work import inverse_dynamics, mass_matrix
from pkm_twin.codegen.arrays import Array, check_later, common_batch, one_vector, require_finite, vectors
from pkm_twin.messages.stamps import SECOND
from pkm_twin.robot.mechanism import EFFORT_SHARING_NOTE
from pkm_twin.robot.robot import Robot
from pkm_twin.streams.drives import MAX_BRAKE_TIME, DriveWatch
from pkm_twin.streams.rest import VelocityErrorEstimator


class MomentumObserver:
    """Estimate external joint efforts by the generalised momentum, with first-order dynamics.

    With the mass matrix M, the momentum M qd, the inverse dynamics b at qdd = 0 and the measured
    efforts tau, external efforts e obey

        M qdd + b = tau + e,    and the estimate r obeys    r' = bandwidth (e - r)

    Over a sample, the integral of M qdd is the mean of M times the change of qd: this equals the
    change of the momentum less the part due to the change of M. Neither accelerations nor
    derivatives of M are needed, and the error is of second order in the period. The step is implicit, so it is
    stable at every period (the observer of De Luca and Mattone, 2003, in its sampled form).

    ``mass``: the mass matrix of the last sample, (n, n). ``jump``: half the change of tau - b since
    the sample before, (n,): the largest error of its mean over a step.
    """

    def __init__(self, robot: Robot, bandwidth: float = 60.0) -> None:
        """Start without samples.

        :param bandwidth: of the estimate, 1/s: its time constant is the inverse.
        :raises ValueError: a bandwidth that is not positive and finite.
        """
        if not 0.0 < bandwidth < np.inf:
            raise ValueError(f"bandwidth is {bandwidth:g} 1/s; expected more than 0")
        robot.check_independent("contacts of measured efforts", EFFORT_SHARING_NOTE)
        self.robot = robot
        self.bandwidth = bandwidth
        self._still = np.zeros(robot.joints_count)
        self.reset()

    def reset(self) -> None:
        """Discard all samples, for example after a gap."""
        self._last: tuple[float, Array, Array, Array] | None = None
        self._estimate = np.zeros_like(self._still)
        self.jump = np.zeros_like(self._still)

    def push(
        self,
        time: float,
        q: Array,
        qd: Array,
        effort: Array,
        wrench: Array | None = None,
        known: tuple[Array, Array] | None = None,
    ) -> Array | None:
        """Add a sample; return external efforts (n,), N m or N, or None for the first sample.

        :param time: of the sample, s, later than the last one's.
        :param q: joint positions (n,), rad or m, with their rates ``qd`` and measured ``effort``.
        :param wrench: on the platform, known otherwise, base axes at its reference point, (6,).
        :param known: mass matrix (n, n), and the model's efforts at these rates without
            acceleration (n,), where they have been computed.
        :raises UnreachableError: a joint state without an assembly.
        :raises SingularityError: the Jacobian of the closure has no inverse.
        :raises ValueError: a sample that is not later than the last one, has another shape or is
            not finite; it does not change the estimate.
        """
        n, last = self.robot.joints_count, self._last
        time = check_later(time, None if last is None else last[0])
        q, qd, effort = (
            one_vector(values, n, what)
            for values, what in ((q, "joint positions"), (qd, "joint rates"), (effort, "efforts"))
        )
        if known is None:
            model_effort = inverse_dynamics(self.robot, q, qd, self._still, wrench)
            known = mass_matrix(self.robot, q), model_effort
        self.mass, model_effort = known
        mass = self.mass
        net_effort = effort - model_effort
        self._last = (time, qd.copy(), mass, net_effort)
        if last is None:
            return None
        before, qd_before, mass_before, driving_before = last
        step = time - before
        self.jump = 0.5 * np.abs(net_effort - driving_before)
        change = 0.5 * (mass + mass_before) @ (qd - qd_before)
        change -= 0.5 * step * (net_effort + driving_before)
        gain = self.bandwidth
        self._estimate = (self._estimate + gain * change) / (1.0 + gain * step)
        return self._estimate.copy()


def platform_wrench(robot: Robot, q: ArrayLike, external: ArrayLike) -> Array:
    """Return the platform wrench that explains external joint efforts, base axes, (..., 6).

    A machine with n < 6 actuated joints measures only n directions of the wrench. Of all wrenches
    that explain the efforts this is the smallest one, with moments divided by the platform's size.
    A wrench at the platform cannot be distinguished from a contact with a limb.

    :param q: joint positions, shape (..., n), rad or m.
    :param external: external efforts at the joints, shape (..., n):
        J' wrench with the platform's Jacobian J.
    """
    robot.check_independent("wrenches of measured efforts", EFFORT_SHARING_NOTE)
    lever = np.array([1.0, 1.0, 1.0, *(3 * [robot.size])])
    jacobian = robot.platform_jacobian(q) * lever[:, None]
    # The joints do not measure directions whose singular value is below 1e-9 of the largest.
    inverse = np.linalg.pinv(np.swapaxes(jacobian, -1, -2), rcond=1e-9)
    efforts = vectors(external, robot.joints_count, "efforts")
    common_batch(jacobian.shape[:-2], efforts.shape[:-1])
    with np.errstate(over="ignore", invalid="ignore"):
        least = (inverse @ efforts[..., None])[..., 0] * lever
    return require_finite(least, "an effort")


CONTACT_SIGMAS: Final = 6.0
"""Standard deviations of model and noise together that indicate a contact."""
LEARNING_TIME: Final = 0.2
"""Time after the start in which only the noise is estimated, s."""
MIN_NOISE_FRACTION: Final = 1e-3
"""Smallest standard deviation of an effort, relative to the largest effort of the stream."""


@dataclass(frozen=True)
class Contact:
    """Hold external efforts and their bound, (n,), N m or N, and the wrench (6,) of them.

    ``touching``: an effort exceeds its bound. ``idle``: the drives are off or braked, so the efforts
    contain no information; ``touching`` then keeps its last value. ``place``: the body and the
    position on it while ``touching``.
    """

    external: Array
    bound: Array
    wrench: Array
    touching: bool
    idle: bool = False
    place: ContactPlace | None = None


class FrictionLearner:
    """Estimate friction that the model lacks: effort that opposes a joint in both directions.

    A contact opposes motion in one direction only. Therefore friction is estimated at all times, also
    while a contact is detected.

    Until a joint has moved in both directions, friction is estimated from one of them, without
    contact; it is unknown for a joint that has just begun to move for the first time.
    """

    def __init__(self, joints: int) -> None:
        # By joint: the mean opposing effort and the time of motion, [backwards, forwards] each.
        self._means = [[[0.0, 0.0], [0.0, 0.0]] for _ in range(joints)]
        # The mean opposing efforts of _means at the last sample without contact.
        self._means_without_contact = [[0.0, 0.0] for _ in range(joints)]

    def learn(self, step: float, external: Array, qd: Array, *, touching: bool = False) -> Array:
        """Add external efforts and velocities, zero at rest, shape (n,).

        :returns: the friction known by now, (n,); infinite where it is unknown.
        """
        known = []
        for (means, times), alone, effort, rate in zip(
            self._means, self._means_without_contact, external.tolist(), qd.tolist(), strict=True
        ):
            if rate != 0.0:
                k = int(rate > 0.0)
                times[k] += step
                opposing = -effort if k else effort
                means[k] += min(1.0, step / min(times[k], NOISE_AVERAGING_TIME)) * (opposing - means[k])
                if not touching:
                    alone[k] = means[k]
            if min(times) > LEARNING_TIME:
                known.append(max(0.0, min(means)))
            elif max(times) > 0.1:  # s of motion: a shorter one is an onset
                known.append(max(0.0, alone[int(times[1] > times[0])]))
            else:
                known.append(math.inf if rate != 0.0 else 0.0)
        return np.array(known)


class ContactMonitor:
    """Detect contacts by a momentum observer with a bound from model and input uncertainty.

    The bound is ``sigmas`` standard deviations: those of the model's efforts, from the robot's file
    or :meth:`.EffortParts.default_deviation`, and the noise of the estimate without contact.
    Friction at rest (:class:`FrictionLearner`) and the effect of the rates' uncertainty on the momentum are
    added. All parts except the noise pass the observer's low-pass filter, so that the bound has the
    same delay as the estimate.
    """

    def __init__(self, robot: Robot, bandwidth: float = 60.0, sigmas: float = CONTACT_SIGMAS) -> None:
        """Start without samples.

        :raises ValueError: a bandwidth or a number of standard deviations that is not positive.
        """
        if not sigmas > 0.0:
            raise ValueError(f"sigmas is {sigmas:g}; expected more than 0")
        self.sigmas = sigmas
        self.observer = MomentumObserver(robot, bandwidth)
        self._locator: ContactLocator | None = None
        self.change_robot(robot)
        self.reset()

    def reset(self) -> None:
        """Discard all samples, for example after a gap."""
        n = self.robot.joints_count
        self.observer.reset()
        self.drives = DriveWatch()
        self._velocity_error = VelocityErrorEstimator(0.0)
        # Squares are clipped at 9 times the average, so that a contact is not learnt as noise.
        self._noise = self._saved_noise = Noise(np.zeros(n), LEARNING_TIME, 9.0)
        self._filtered_deviation, self._filtered_slack, self._impulse, self._friction = np.zeros((4, n))
        self._greatest = usual_effort(self.robot)
        self._last: float | None = None
        self._touching, self._since = False, 0.0
        self._place: ContactPlace | None = None
        self._placed = 0.0
        self._learner = FrictionLearner(n)

    def change_robot(self, robot: Robot) -> None:
        """Use a robot with another payload, gravity or friction."""
        self._load_friction = LoadFrictionCompensation(robot)
        self.robot = self.observer.robot = robot = self._load_friction.robot
        q, ones = robot.inverse(robot.home()), np.ones(robot.joints_count)
        self.stated = bool(robot.uncertainty) and bool(torque_deviation(robot, q, ones, ones).any())
        """True if the robot's file has uncertainties that efforts depend on."""
        self._friction_reach = friction_reach(robot)

    def push(
        self,
        time: float,
        motion: tuple[Array, Array, Array],
        effort: Array,
        wrench: Array | None = None,
        rate_error: Array | None = None,
    ) -> Contact | None:
        """Add a sample; return the contact state, or None until the noise is known.

        :param time: of the sample, s, later than the last one's.
        :param motion: q, qd and qdd, shape (n,) each; qdd is used for the standard deviation of the
            model alone.
        :param effort: measured, shape (n,).
        :param wrench: on the platform, known otherwise, base axes at its reference point, (6,).
        :param rate_error: error bounds of the rates, (n,); by default from their own noise.
        :raises ValueError: a sample that is not later than the last one, has another shape or is
            not finite; neither it nor a sample without an assembly changes the estimate.
        """
        n, last = self.robot.joints_count, self._last
        time = check_later(time, last)
        q, qd, qdd, effort = (one_vector(v, n, "a sample") for v in (*motion, effort))
        mass = mass_matrix(self.robot, q)
        if rate_error is None:
            rate_error = self._velocity_error.push(round(time * SECOND), q, qd, qd)
        still = np.abs(qd) <= rate_error
        rates_used = zero_resting_rates(qd, still, self._friction_reach + self._load_friction.fraction)
        effort, load_friction = self._load_friction.remove(q, rates_used, effort)
        parts = effort_parts(self.robot, q, rates_used, qdd, wrench, mass)
        self._last = time
        self._greatest = np.maximum(self._greatest, np.abs(parts.whole))
        was_idle = self.drives.idle
        idle = self.drives.push(time, still, effort, parts.static)
        if idle and not was_idle:
            self._noise = self._saved_noise
        elif was_idle and not idle:
            self.observer.reset()
        if not self.drives.repeated:
            # Save the noise, because later efforts may be those of a brake.
            self._saved_noise = copy.copy(self._noise)
        external = self.observer.push(time, q, qd, effort, wrench, (mass, parts.moving))
        if external is None or last is None:
            return None
        step = time - last
        if idle:
            if not was_idle and time - self._since < MAX_BRAKE_TIME:
                # The brake took over the weight, which looked like a contact.
                self._touching = False
            return self._make_contact(q, external, idle)
        learned = self._learner.learn(step, external, np.where(still, 0.0, qd), touching=self._touching)
        # The learnt friction is bounded: a larger opposing effort is a contact.
        friction = np.minimum(learned, 0.2 * self._greatest) + np.where(
            still, self._friction_reach + load_friction, 0.0
        )
        # Filter the uncertainties as the observer filters the estimate.
        deviation = parts.default_deviation(self._greatest)
        if self.stated:
            deviation = torque_deviation(self.robot, q, rates_used, qdd, wrench)
        gain, self._friction = self.observer.bandwidth * step, friction
        self._impulse = self.observer.bandwidth * np.abs(mass) @ rate_error
        slack = friction + self.observer.jump + self._impulse
        self._filtered_deviation = (self._filtered_deviation + gain * deviation) / (1.0 + gain)
        self._filtered_slack = (self._filtered_slack + gain * slack) / (1.0 + gain)
        self._noise.advance(step)
        residual = np.maximum(np.abs(external) - self._filtered_slack - self._impulse, 0.0)
        if self._noise.settled:
            touching = bool((np.abs(external) > self._effort_bound()).any())
            if touching:
                starts, since = not self._touching, time - self._placed
                if starts:
                    self._since = time
                    self.prepare().reset()
                # Locate the contact every 4 ms for its first 40 ms, later every 10 ms: errors are correlated longer.
                if starts or since >= (0.004 if time - self._since < 0.04 else 0.01) - 0.5 * step:
                    locator = self.prepare()
                    deviations = np.hypot(self._standard_deviation(), 0.5 * (self._friction + self._impulse))
                    locator.push(step if starts else since, q, qd, external, deviations)
                    self._place, self._placed = locator.place(), time
            self._touching = touching
            verdict = self._make_contact(q, external, idle)
        else:
            verdict = None
        if not self._touching:
            self._noise.learn(residual, (MIN_NOISE_FRACTION * self._greatest) ** 2)
        return verdict

    def prepare(self) -> ContactLocator:
        """Compile the programs that locate a contact, before the first contact."""
        if self._locator is None:
            self._locator = ContactLocator(self.robot)
            n = self.robot.joints_count
            ones = np.ones(n)
            q = self.robot.inverse(self.robot.home())
            self._locator.push(1e-3, q, 0.0 * ones, ones, ones)
            self._locator.place()
        return self._locator

    def _standard_deviation(self) -> Array:
        return np.asarray(np.sqrt(self._filtered_deviation**2 + self._noise.variance), np.float64)

    def _effort_bound(self) -> Array:
        return np.asarray(self.sigmas * self._standard_deviation() + self._filtered_slack + self._impulse, np.float64)

    def _make_contact(self, q: Array, external: Array, idle: bool) -> Contact:
        wrench = platform_wrench(self.robot, q, external)
        place = self._place if self._touching and not idle else None
        return Contact(external, self._effort_bound(), wrench, self._touching, idle, place)
