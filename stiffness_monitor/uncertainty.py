# SPDX-License-Identifier: Apache-2.0
"""How sure the platform's compliance is, by what the robot's file says of its numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array
from pkm_twin.robot.robot import Robot
from stiffness_monitor.derivatives import compliance_effects


def compliance_deviation(robot: Robot, pose: ArrayLike) -> Array:
    """Standard deviation of :func:`compliance`, propagated from ``uncertainty``, (..., 6, 6).

    To first order in the deviations, independent causes. Zero for a file that names none.

    :param pose: shape (..., m), the mechanism's pose coordinates, m and rad.
    """
    effects = compliance_effects(robot, pose)
    return np.asarray(np.sqrt((effects**2).sum(-1)), np.float64)


def deflection_deviation(robot: Robot, pose: ArrayLike, wrench: ArrayLike) -> Array:
    """Standard deviation of the deflection under a wrench by the same, shape (..., 6)."""
    effects = np.einsum("...ijk,...j->...ik", compliance_effects(robot, pose), np.asarray(wrench))
    return np.asarray(np.sqrt((effects**2).sum(-1)), np.float64)
