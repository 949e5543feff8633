# SPDX-License-Identifier: Apache-2.0
"""The map of the platform's position error, by what the robot's file says of its numbers."""

from __future__ import annotations

from typing import Final

import numpy as np

from pkm_twin.atlas.maps.quantity import Array, Found, Quantity, largest_axis, no_wrench
from pkm_twin.errors import ParameterError
from pkm_twin.machine.robot import Robot
from pkm_twin.machine.uncertainty import Factor


def pose_error(robot: Robot, q: Array, wrench: Array | None) -> Found:
    """Standard deviation of the position in the worst direction, joints at their set points.

    To first order, independent causes; the element is the cause with the greatest part in that
    direction.

    :raises ParameterError: a file that says nothing of its geometry's numbers.
    """
    del wrench
    effects = np.stack([cause.effect(lambda r: r.platform(q)[0]) for cause in _causes(robot)], -2)
    value, direction = largest_axis(effects.swapaxes(-1, -2) @ effects)
    along = np.abs((effects * direction[..., None, :]).sum(-1))
    return Found(np.sqrt(np.maximum(value, 0.0)), direction, along.argmax(-1))


def _causes(robot: Robot) -> tuple[Factor, ...]:
    """Causes that move the platform at home."""
    home = robot.graph.home
    found = [f for f in robot.factors if f.effect(lambda r: r.platform(home)[0]).any()]
    if not found:
        raise ParameterError(
            "uncertainty",
            None,
            "the standard deviation of a length or angle that moves the platform",
        )
    return tuple(found)


POSE_ERROR: Final = Quantity(
    "pose-error",
    "standard deviation of the platform's position in the worst direction",
    "where is it least accurate?",
    pose_error,
    lambda robot: tuple(cause.name for cause in _causes(robot)),
    lambda robot, case: "m",
    no_wrench("tolerances"),
    element="cause",
    points=20_000,
    chunk=4096,
    samples=1024,
    population=64,
    rounds=100,
)
