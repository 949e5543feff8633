# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Stiffness of each limb on the wrenches that it applies to the platform (2UPR-RPU paper)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array, vectors
from pkm_twin.errors import ParameterError
from pkm_twin.robot.robot import Robot
from stiffness_monitor.compliance import compliance
from stiffness_monitor.frame import PLATFORM
from stiffness_monitor.programs import Elastic
from stiffness_monitor.response import elastic_columns


@dataclass(frozen=True, eq=False)
class LimbStiffness:
    """Hold the stiffness of the limbs in poses (...), limb by limb; base axes, SI units.

    ``wrenches``: the paper's J_i, shape (..., limbs, 6, 3): unit actuation force, constraint force
    and constraint couple at the platform's reference point. ``stiffness``: K_i on the amplitudes of
    these wrenches, (..., limbs, 3, 3); the platform's stiffness is K = sum of J_i K_i J_i'
    (equation 34). ``factors``: K_i J_i' C, (..., limbs, 3, 6): W_i = factors @ P are the amplitudes
    (N, N, N m) under the external wrench P (equation 36).
    """

    wrenches: Array
    stiffness: Array
    factors: Array

    def amplitudes(self, wrench: ArrayLike) -> Array:
        """Return W_i under external wrenches P (..., 6), shape (..., limbs, 3) (equation 36)."""
        load = vectors(wrench, 6, "the wrench")[..., None, :, None]
        return np.asarray((self.factors @ load)[..., 0], np.float64)


def limb_stiffness(robot: Robot, pose: ArrayLike) -> LimbStiffness:
    """Return K_i (equations 17 and 28), J_i (30) and the factor matrices of W_i (36) of the limbs.

    With the limb's deformation delta_i = C_i W_i (equation 18) and its energy W_i' C_i W_i / 2,
    C_i of equations 16 and 27, K_i is the inverse of C_i.

    The elastic frame's columns of one limb give its stiffness on the platform by condensation; on
    the limb's own wrenches J_i that is K_i = (C_B + D_1' C_1 D_1 + D_2' C_2 D_2)^-1 of the paper.

    :param pose: shape (..., 3), m and rad.
    :raises ParameterError: a mechanism other than ``upr_rpu``.
    :raises UnreachableError: a pose that the mechanism cannot reach.
    """
    q = robot.inverse(pose)
    wrenches = robot.limb_wrenches(pose)
    if wrenches is None:
        what = "a mechanism whose limbs' wrenches are known (upr_rpu)"
        raise ParameterError("mechanism", robot.mechanism, what)
    whole = compliance(robot, pose)
    columns, owner = elastic_columns(robot, q)
    count = wrenches.shape[-3]
    limb = owner // (len(robot.cached(Elastic).names) // count)
    found = []
    for number in range(count):
        # Static condensation of the limb's columns on the platform's displacements.
        own = columns[..., limb == number]
        touched = (own[..., PLATFORM:, :] != 0.0).any(-1)
        inside = PLATFORM + np.flatnonzero(touched.reshape(-1, touched.shape[-1]).any(0))
        rows = own[..., [*range(PLATFORM), *inside], :]
        matrix = rows @ np.swapaxes(rows, -1, -2)
        side = matrix[..., :PLATFORM, PLATFORM:]
        inner = np.linalg.solve(matrix[..., PLATFORM:, PLATFORM:], np.swapaxes(side, -1, -2))
        found.append(matrix[..., :PLATFORM, :PLATFORM] - side @ inner)
    # K_i on the limb's own wrenches, and W_i = K_i J_i' C P (equations 17, 28 and 36).
    back = np.linalg.pinv(wrenches)
    stiffness = back @ np.stack(found, -3) @ np.swapaxes(back, -1, -2)
    stiffness = (stiffness + np.swapaxes(stiffness, -1, -2)) / 2
    factors = stiffness @ np.swapaxes(wrenches, -1, -2) @ whole[..., None, :, :]
    return LimbStiffness(wrenches, stiffness, factors)
