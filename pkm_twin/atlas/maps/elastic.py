# SPDX-License-Identifier: Apache-2.0
"""Maps of elasticity: compliance, and the strain energy of load cases."""

from __future__ import annotations

from typing import Final

import numpy as np

from pkm_twin.atlas.maps.quantity import (
    Array,
    Case,
    Found,
    Quantity,
    largest_axis,
    no_wrench,
    size_and_direction,
)
from pkm_twin.robot.robot import Robot
from stiffness_monitor import platform_response


def _elements(robot: Robot) -> tuple[str, ...]:
    home = robot.graph.home
    return platform_response(robot, home, np.zeros(6)).elements


def softest(robot: Robot, q: Array, wrench: Array | None) -> Found:
    """Largest eigenvalue of the compliance's translational block; or the deflection of a load.

    Without a wrench the element is the one with most strain energy under a force in the softest
    direction.
    """
    if wrench is None:
        block = platform_response(robot, q, np.zeros(6)).compliance[..., :3, :3]
        value, direction = largest_axis(block)
        force = np.concatenate([direction, np.zeros_like(direction)], -1)
        return Found(value, direction, platform_response(robot, q, force).factors.argmax(-1))
    response = platform_response(robot, q, wrench)
    value, direction = size_and_direction(response.deflection[..., :3])
    return Found(value, direction, response.factors.argmax(-1))


def energy(robot: Robot, q: Array, wrench: Array | None) -> Found:
    """Total strain energy of a load, the way that the platform moves, and the elements' parts."""
    response = platform_response(robot, q, np.zeros(6) if wrench is None else wrench)
    _, direction = size_and_direction(response.deflection[..., :3])
    factors = response.factors
    return Found(np.asarray(response.total), direction, factors.argmax(-1), factors)


COMPLIANCE: Final = Quantity(
    "compliance",
    "largest compliance of the platform; of a load case its deflection",
    "where is it softest?",
    softest,
    _elements,
    lambda robot, case: "m/N" if case.wrench is None else "m",
    no_wrench("any direction"),
)
STRAIN_ENERGY: Final = Quantity(
    "strain-energy",
    "total strain energy",
    "which part gives?",
    energy,
    _elements,
    lambda robot, case: "J",
    Case("P1", (0.0, 0.0, 1.0, 0.0, 0.0, 0.0)),
    has_shares=True,
)
