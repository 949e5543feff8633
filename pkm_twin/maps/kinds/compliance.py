# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Map the compliance of the platform, or its deflection under loads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.maps.kind import Case, Found, Kind, largest_axis, size_and_direction
from pkm_twin.robot.robot import Robot
from stiffness_monitor import platform_response


class Compliance(Kind):
    """Map the compliance and its softest direction, or deflections under loads."""

    name = "compliance"
    question = "where is it softest?"
    answer = "softest"
    what = "compliance in the softest direction"
    unit = "m/N"
    takes_wrench = True

    def loaded(self, robot: Robot, name: str, wrench: Sequence[float]) -> Case:
        """Return a load case, whose value is the deflection."""
        case = super().loaded(robot, name, wrench)
        return replace(case, what="deflection", unit="m", answer="moves most")

    def elements(self, robot: Robot) -> tuple[str, ...]:
        """Return the names of members and elastic joints."""
        return platform_response(robot, robot.graph.home, np.zeros(6)).elements

    def found(self, robot: Robot, q: Array, case: Case) -> Found:
        """Return the largest eigenvalue of the translational compliance, or a load's deflection.

        Without a load the element is the one with most strain energy under a force in the softest
        direction.
        """
        if case.wrench is None:
            block = platform_response(robot, q, np.zeros(6)).compliance[..., :3, :3]
            value, direction = largest_axis(block)
            force = np.concatenate([direction, np.zeros_like(direction)], -1)
            factors = platform_response(robot, q, force).factors
        else:
            response = platform_response(robot, q, np.array(case.wrench))
            value, direction = size_and_direction(response.deflection[..., :3])
            factors = response.factors
        return Found(value, direction, factors.argmax(-1))
