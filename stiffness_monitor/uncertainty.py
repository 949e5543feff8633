# SPDX-License-Identifier: Apache-2.0
"""How sure the platform's compliance is, by what the robot's file says of its numbers.

May import: numpy, pkm_twin's core, this package; never rclpy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.machine.robot import Robot
from pkm_twin.machine.uncertainty import deviation
from stiffness_monitor.compliance import compliance

Array = NDArray[np.float64]


def compliance_deviation(robot: Robot, pose: ArrayLike) -> Array:
    """Standard deviation of :func:`compliance`, propagated from ``uncertainty``, (..., 6, 6).

    To first order in the deviations, independent causes. Zero for a file that names none.

    :param pose: shape (..., m), the mechanism's pose coordinates, m and rad.
    :raises ParameterError: a number that cannot vary as the file says.
    """
    return deviation(robot, lambda r: compliance(r, pose))
