# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Map the speed that the drives reach in every direction."""

from dataclasses import replace

import numpy as np

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


class Speeds(Kind):
    """Map the speed that the drives reach in every direction."""

    name, what, answer = "speeds", "speed in the slowest direction", "slowest"
    question, element, largest = "how fast can it move?", "drive", False

    def cases(self, robot: Robot) -> tuple[Case, ...]:
        """Return the case, with angular velocity for a pose of angles alone."""
        return (replace(super().cases(robot)[0], unit=f"{unit_of_motion(robot)}/s"),)

    def found(self, robot: Robot, q: Array, case: Case) -> Found:
        """Return the platform's speed limit in the slowest direction; ``element``: the joint at its limit.

        A joint allows its velocity limit over its largest rate per unit of motion.
        """
        back, axes = unit_motions(robot, q)
        with np.errstate(divide="ignore"):
            room = drive_limits(robot, "velocity") / np.linalg.norm(back, axis=-1)
        return Found(*tightest_limit(room, back @ axes))
