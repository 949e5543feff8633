# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Map the first natural frequency, actuators locked."""

from __future__ import annotations

from collections.abc import Sequence

from pkm_twin.codegen.arrays import Array
from pkm_twin.maps.kind import Case, Found, Kind, size_and_direction
from pkm_twin.maps.kinds.compliance import Compliance
from pkm_twin.robot.robot import Robot
from stiffness_monitor.modes import modes


class Frequency(Kind):
    """Map the first natural frequency, actuators locked."""

    name = "frequency"
    question = "where does it ring lowest?"
    answer = "lowest frequency"
    what = "first natural frequency"
    unit = "Hz"
    largest = False
    together = True
    points = 1000
    chunk = 256
    samples = 256
    population = 24
    rounds = 40
    screen = Compliance()

    def elements(self, robot: Robot) -> tuple[str, ...]:
        """Return the names of bodies and elastic joints."""
        return modes(robot, robot.home(), 1).energies.elements

    def each(self, robot: Robot, q: Array, cases: Sequence[Case]) -> list[Found]:
        """Return frequencies, the platform's direction, and the element with most strain energy."""
        found = modes(robot, robot.forward(q), len(cases))
        _, direction = size_and_direction(found.shapes[..., 0, :3])
        strain = found.energies.strain.argmax(-1)
        return [Found(found.frequencies[:, k], direction[:, k], strain[:, k]) for k in range(len(cases))]
