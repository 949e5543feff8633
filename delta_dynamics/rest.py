# SPDX-License-Identifier: Apache-2.0
"""Dry friction of joints that stand still: its direction is not known, its size is a bound.

At rest friction is whatever holds the joint, up to the joint's dry friction either way. The model
gives none there, and what it is compared with may differ by the reach of friction.

May import: numpy, pkm_twin's core, this package; never rclpy.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from delta_dynamics.virtual_work import inverse_dynamics
from pkm_twin.errors import ParameterError
from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

SLOW: Final = 1e-6
"""A rate that is of one sign and nothing else, rad/s or m/s."""
SEEN: Final = 1e-9
"""Share of the efforts at rest below which there is no friction."""


def friction_reach(robot: Robot) -> Array:
    """Effort that dry friction takes of each joint where it moves alone, shape (n,), N m or N.

    At home, passive joints' friction included; zero for a robot without masses.
    """
    n = robot.joints_count
    try:
        robot.massive()
    except ParameterError:
        return np.zeros(n)
    q, still = robot.inverse(robot.home()), np.zeros(n)
    size = np.abs(inverse_dynamics(robot, q, still, still)).max()

    def odd(rate: float) -> Array:
        """The part of each joint's own effort that turns over with its rate."""
        rows = rate * np.eye(n)
        ahead = np.array([inverse_dynamics(robot, q, row, still) for row in rows])
        back = np.array([inverse_dynamics(robot, q, -row, still) for row in rows])
        return np.asarray(np.diag(ahead - back) / 2.0, np.float64)

    # Viscous friction doubles with the rates.
    reach = 2.0 * odd(SLOW) - odd(2.0 * SLOW)
    return np.where(reach > SEEN * (1.0 + size), reach, 0.0)


def moving_rates(qd: Array, still: Flags, reach: Array) -> Array:
    """Rates (..., n) with those of joints at rest zero where the joint has dry friction."""
    return np.where(still & (reach > 0.0), 0.0, qd)


def beyond_friction(residual: Array, still: Flags, reach: Array) -> Array:
    """What friction of joints at rest does not explain of residuals (..., n), N m or N."""
    slack = np.where(still, reach, 0.0)
    return np.asarray(np.sign(residual) * np.maximum(np.abs(residual) - slack, 0.0), np.float64)
