# SPDX-License-Identifier: Apache-2.0
"""The map of the first natural frequency, actuators locked."""

from __future__ import annotations

from typing import Final

from pkm_twin.atlas.maps.elastic import COMPLIANCE
from pkm_twin.atlas.maps.quantity import Array, Found, Quantity, no_wrench, size_and_direction
from pkm_twin.robot.robot import Robot
from stiffness_monitor.modes import modes


def first_frequency(robot: Robot, q: Array, wrench: Array | None) -> Found:
    """First frequency, the way that the platform swings, and the part with most strain energy."""
    del wrench
    found = modes(robot, robot.forward(q), 1)
    _, direction = size_and_direction(found.shapes[..., 0, 0, :3])
    strain = found.energies.strain[..., 0, :]
    return Found(found.frequencies[..., 0], direction, strain.argmax(-1))


def _elements(robot: Robot) -> tuple[str, ...]:
    return modes(robot, robot.home(), 1).energies.elements


FREQUENCY: Final = Quantity(
    "frequency",
    "first natural frequency, actuators locked",
    "where does it ring lowest?",
    first_frequency,
    _elements,
    lambda robot, case: "Hz",
    no_wrench("unloaded"),
    largest=False,
    points=1000,
    chunk=256,
    samples=256,
    population=24,
    rounds=40,
    screen=COMPLIANCE,
)
