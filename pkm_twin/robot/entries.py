# SPDX-License-Identifier: Apache-2.0
"""The numbers of a robot's file, and the same robot with some of them changed."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, TypeVar

from pkm_twin.machine.places import given, numbers_of
from pkm_twin.robot.robot import Robot

R = TypeVar("R", bound=Robot)


def entries(robot: Robot) -> dict[str, tuple[float, str]]:
    """Every number that the robot's file gives, by dotted path, with its unit."""
    return numbers_of(robot.parameter_sections(), robot.parameter_units())


def data_of(robot: Robot, values: Mapping[str, float] | None = None) -> dict[str, Any]:
    """What the robot's file gives, as plain data, with other numbers by dotted path.

    :raises ParameterError: a path that there is not.
    """
    made = robot.numbered(values) if values else robot
    data: dict[str, Any] = copy.deepcopy(given(made.parameter_sections()))
    return data


def with_entries(robot: R, values: Mapping[str, float]) -> R:
    """The robot of the same file with other numbers.

    :raises ParameterError: a path that there is not, or a value that the file may not have.
    """
    return type(robot).from_data(data_of(robot, values), robot.name)
