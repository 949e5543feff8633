# SPDX-License-Identifier: Apache-2.0
"""The map of the platform's position error, by what the robot's file says of its numbers."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas.maps.quantity import Array, Found, Quantity, largest_axis, no_wrench
from pkm_twin.errors import ParameterError
from pkm_twin.robot.derivatives import position_effects
from pkm_twin.robot.robot import Robot


def pose_error(robot: Robot, q: Array, wrench: Array | None) -> Found:
    """Standard deviation of the position in the worst direction, joints at their set points.

    To first order, independent causes; the element is the cause with the greatest part in that
    direction.

    :raises ParameterError: a file that says nothing of its geometry's numbers.
    """
    del wrench
    moving = _moving(robot)
    effects = position_effects(robot, q)[..., moving].swapaxes(-1, -2)
    value, direction = largest_axis(effects.swapaxes(-1, -2) @ effects)
    along = np.abs((effects * direction[..., None, :]).sum(-1))
    return Found(np.sqrt(np.maximum(value, 0.0)), direction, along.argmax(-1))


def _moving(robot: Robot) -> NDArray[np.intp]:
    """Places of the causes that move the platform at home."""
    found = np.flatnonzero(position_effects(robot, robot.graph.home).any(0))
    if not len(found):
        raise ParameterError(
            "uncertainty",
            None,
            "the standard deviation of a length or angle that moves the platform",
        )
    return found


POSE_ERROR: Final = Quantity(
    "pose-error",
    "standard deviation of the platform's position in the worst direction",
    "where is it least accurate?",
    pose_error,
    lambda robot: tuple(list(robot.causes)[k] for k in _moving(robot)),
    lambda robot, case: "m",
    no_wrench("tolerances"),
    element="cause",
    points=20_000,
    chunk=4096,
    samples=1024,
    population=64,
    rounds=100,
)
