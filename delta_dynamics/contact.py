# SPDX-License-Identifier: Apache-2.0
"""Whether something pushes: external efforts beyond what model and noise leave open.

May import: numpy, pkm_twin's core, this package; never rclpy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from delta_dynamics.noise import Noise
from delta_dynamics.observer import MomentumObserver, platform_wrench
from delta_dynamics.uncertainty import torque_deviation
from pkm_twin.codegen.arrays import one_vector
from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]

SIGMAS: Final = 6.0
"""Deviations of model and noise together that are a contact."""
LEARNING: Final = 0.2
"""Time after a beginning in which only the noise is learnt, s."""
CLIPPED: Final = 9.0
"""A square counts as noise up to so many times the average: a push is none."""
SHARE: Final = 1e-3
"""Least deviation of an effort, as a share of the greatest that the stream has shown."""


@dataclass(frozen=True)
class Contact:
    """External efforts and their bound, shape (n,), N m or N; the wrench (6,) that explains them.

    ``touching``: whether an effort is beyond its bound.
    """

    external: Array
    bound: Array
    wrench: Array
    touching: bool


class ContactMonitor:
    """The momentum observer with a bound that follows from how sure the model and its input are.

    The bound is ``sigmas`` deviations: those of the efforts by the uncertainty of the robot's file,
    and the noise that the estimate itself shows while nothing pushes.
    """

    def __init__(self, robot: Robot, bandwidth: float = 60.0, sigmas: float = SIGMAS) -> None:
        """Begin without a past.

        :raises ValueError: a bandwidth or a number of deviations that is not positive.
        """
        if not sigmas > 0.0:
            raise ValueError(f"sigmas is {sigmas:g}, allowed above 0")
        self.robot, self.sigmas = robot, sigmas
        self.observer = MomentumObserver(robot, bandwidth)
        self.reset()

    def reset(self) -> None:
        """Forget the stream, as after a gap."""
        n = self.robot.joints_count
        self.observer.reset()
        self._noise = Noise(np.zeros(n), LEARNING, CLIPPED)
        self._greatest, self._last = np.zeros(n), 0.0

    def change_robot(self, robot: Robot) -> None:
        """Take a robot with another payload, gravity or friction."""
        self.robot = self.observer.robot = robot

    def push(
        self, time: float, motion: tuple[Array, Array, Array], effort: Array,
        wrench: Array | None = None,
    ) -> Contact | None:  # fmt: skip
        """Take a sample; None until the noise is known.

        :param time: of the sample, s, later than the last one's.
        :param motion: q, qd and qdd, shape (n,) each; qdd counts for the model's deviation alone.
        :param effort: measured, shape (n,).
        :param wrench: on the platform, known otherwise, base axes at its reference point, (6,).
        :raises ValueError: a sample that is not later than the last one, has another shape or is
            not finite; it moves nothing.
        """
        n = self.robot.joints_count
        q, qd, qdd, effort = (one_vector(v, n, "a sample") for v in (*motion, effort))
        external = self.observer.push(time, q, qd, effort, wrench)
        step, self._last = time - self._last, time
        self._greatest = np.maximum(self._greatest, np.abs(effort))
        if external is None:
            return None
        self._noise.advance(step)
        least = (SHARE * self._greatest) ** 2
        if not self._noise.settled:
            self._noise.learn(external, least)
            return None
        model = torque_deviation(self.robot, q, qd, qdd, wrench)
        bound = self.sigmas * np.sqrt(model**2 + self._noise.variance)
        touching = bool((np.abs(external) > bound).any())
        if not touching:
            self._noise.learn(external, least)
        return Contact(external, bound, platform_wrench(self.robot, q, external), touching)
