# SPDX-License-Identifier: Apache-2.0
"""The wrench of the surroundings from joint states and efforts, without accelerations."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from delta_dynamics.torques.virtual_work import inverse_dynamics, mass_matrix
from pkm_twin.codegen.arrays import Array, finite, later, one_vector, vectors
from pkm_twin.robot.robot import Robot

RANK: Final = 1e-9
"""Singular values below this share of the greatest are directions that the joints do not feel."""


class MomentumObserver:
    """External efforts at the joints by their generalised momentum, a first-order estimate.

    With the mass matrix M, the momentum M qd, the inverse dynamics b at qdd = 0 and the measured
    efforts tau, external efforts e obey

        M qdd + b = tau + e,    and the estimate r obeys    r' = bandwidth (e - r)

    Over a sample, M qdd becomes the mean of M times the change of qd, which is exactly the change
    of the momentum less what the change of M itself brings: no acceleration and no derivative of M
    is needed, and the error is of second order in the period. The step is implicit, so it is
    stable at every period (the observer of De Luca and Mattone, 2003, in its sampled form).

    ``mass``: the mass matrix of the last sample, (n, n). ``jump``: half of what the efforts that
    drive the motion changed by since the sample before, (n,): the greatest error of a step's mean.
    """

    def __init__(self, robot: Robot, bandwidth: float = 60.0) -> None:
        """Begin without a past.

        :param bandwidth: of the estimate, 1/s: its time constant is the inverse.
        :raises ValueError: a bandwidth that is not positive and finite.
        """
        if not 0.0 < bandwidth < np.inf:
            raise ValueError(f"bandwidth is {bandwidth:g} 1/s; expected more than 0")
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
        self, time: float, q: Array, qd: Array, effort: Array, wrench: Array | None = None,
        known: tuple[Array, Array] | None = None,
    ) -> Array | None:  # fmt: skip
        """Take a sample; the external efforts (n,), N m or N, None for the first sample.

        :param time: of the sample, s, later than the last one's.
        :param q: joint positions (n,), rad or m, with their rates ``qd`` and measured ``effort``.
        :param wrench: on the platform, known otherwise, base axes at its reference point, (6,).
        :param known: mass matrix (n, n), and the model's efforts at these rates without
            acceleration (n,), where they have been computed.
        :raises UnreachableError: a joint state without an assembly.
        :raises SingularityError: the Jacobian of the closure has no inverse.
        :raises ValueError: a sample that is not later than the last one, has another shape or is
            not finite; it moves nothing.
        """
        n, last = self.robot.joints_count, self._last
        time = later(time, None if last is None else last[0])
        q, qd, effort = (
            one_vector(values, n, what)
            for values, what in ((q, "joint positions"), (qd, "joint rates"), (effort, "efforts"))
        )
        if known is None:
            needed = inverse_dynamics(self.robot, q, qd, self._still, wrench)
            known = mass_matrix(self.robot, q), needed
        self.mass, needed = known
        mass = self.mass
        driving = effort - needed
        self._last = (time, qd.copy(), mass, driving)
        if last is None:
            return None
        before, qd_before, mass_before, driving_before = last
        step = time - before
        self.jump = 0.5 * np.abs(driving - driving_before)
        change = 0.5 * (mass + mass_before) @ (qd - qd_before)
        change -= 0.5 * step * (driving + driving_before)
        gain = self.bandwidth
        self._estimate = (self._estimate + gain * change) / (1.0 + gain * step)
        return self._estimate.copy()


def platform_wrench(robot: Robot, q: ArrayLike, external: ArrayLike) -> Array:
    """The wrench on the platform that explains external joint efforts, base axes, shape (..., 6).

    A machine with n < 6 actuated joints measures only n directions of the wrench. Of all wrenches
    that explain the efforts this is the smallest one, with moments divided by the platform's size.
    A wrench at the platform cannot be distinguished from a contact with a limb.

    :param q: joint positions, shape (..., n), rad or m.
    :param external: external efforts at the joints, shape (..., n):
        J' wrench with the platform's Jacobian J.
    """
    lever = np.array([1.0, 1.0, 1.0, *(3 * [robot.size])])
    jacobian = robot.platform_jacobian(q) * lever[:, None]
    inverse = np.linalg.pinv(np.swapaxes(jacobian, -1, -2), rcond=RANK)
    efforts = vectors(external, robot.joints_count, "efforts")
    with np.errstate(over="ignore", invalid="ignore"):
        least = (inverse @ efforts[..., None])[..., 0] * lever
    return finite(least, "an effort")
