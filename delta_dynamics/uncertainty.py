# SPDX-License-Identifier: Apache-2.0
"""How sure the efforts are, by what the robot's file says of its numbers.

May import: numpy, pkm_twin's core, this package; never rclpy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from delta_dynamics.virtual_work import inverse_dynamics
from pkm_twin.machine.robot import Robot
from pkm_twin.machine.uncertainty import deviation

Array = NDArray[np.float64]


def torque_deviation(
    robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, wrench: ArrayLike | None = None
) -> Array:
    """Standard deviation of :func:`inverse_dynamics` by the file's ``uncertainty``.

    To first order in the deviations, independent causes. Zero for a file that names none.

    :param q: joint positions, shape (..., n), rad or m; rates ``qd``, accelerations ``qdd``.
    :param wrench: as in ``inverse_dynamics``, shape (..., 6); None is none.
    :returns: shape (..., n), N m or N.
    :raises ParameterError: a number that cannot vary as the file says.
    """
    return deviation(robot, lambda r: inverse_dynamics(r, q, qd, qdd, wrench))
