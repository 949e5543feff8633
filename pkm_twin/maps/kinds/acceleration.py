# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Map the acceleration from rest that the drives reach in every direction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from delta_dynamics import inverse_dynamics
from pkm_twin.codegen.arrays import Array
from pkm_twin.maps.kind import (
    Case,
    Found,
    Kind,
    drive_limits,
    tightest_limit,
    unit_motions,
    unit_of_motion,
)
from pkm_twin.robot.robot import Robot


class Acceleration(Kind):
    """Map the acceleration from rest that the drives reach in every direction."""

    name = "acceleration"
    question = "how hard can it accelerate?"
    answer = "accelerates least"
    what = "acceleration in the worst direction"
    largest = False
    element = "drive"
    takes_wrench = True

    def cases(self, robot: Robot) -> tuple[Case, ...]:
        """Return the case, with angular acceleration for a pose of angles alone."""
        return (replace(super().cases(robot)[0], unit=f"{unit_of_motion(robot)}/s2"),)

    def found(self, robot: Robot, q: Array, case: Case) -> Found:
        """Return the smallest acceleration over directions at which a drive reaches its limit.

        The pose's angles stay at rest. The value is 0 if the drives cannot hold the machine.
        """
        limits, still = drive_limits(robot, "effort"), np.zeros_like(q)
        back, axes = unit_motions(robot, q)
        held = inverse_dynamics(robot, q, still, still, case.wrench)
        columns = [inverse_dynamics(robot, q, still, c, case.wrench) - held for c in np.moveaxis(back, -1, 0)]
        each = np.stack(columns, -1)
        size = np.linalg.norm(each, axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(size > 0.0, (limits - np.abs(held)) / size, np.inf)
        sign = np.where(held < 0.0, -1.0, 1.0)[..., None]
        value, direction, drive = tightest_limit(room, sign * (each @ axes))
        return Found(np.maximum(value, 0.0), direction, drive)
