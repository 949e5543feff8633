# SPDX-License-Identifier: Apache-2.0
"""Programs that are asked of many machines, and what each takes of a machine's numbers.

May import: numpy, pkm_twin's core, delta_dynamics, stiffness_monitor, the standard library.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from delta_dynamics.derivatives import motion_gradient, numbers_gradient
from delta_dynamics.virtual_work import masses_kernel
from delta_dynamics.virtual_work import torques as torques_kernel
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.kinematics.gradients import pose_motion_gradient
from pkm_twin.kinematics.numbers import FileNumbers, geometry_and_masses
from pkm_twin.kinematics.singularity import singularity_gradient
from pkm_twin.machine.robot import Robot
from stiffness_monitor.derivatives import compliance_gradient
from stiffness_monitor.numbers import numbers_of
from stiffness_monitor.programs import elastic_of

if TYPE_CHECKING:
    from pkm_twin.design.variants import Variants

Array = NDArray[np.float64]


class NumberFunctions:
    """What programs take of a robot, as functions of numbers of its file."""

    def __init__(self, robot: Robot, paths: Sequence[str]) -> None:
        self.robot, self.paths = robot, paths
        self.others: list[Robot] = []
        """Robots with these numbers changed, one for each other structure that was needed."""
        self.rigid = FileNumbers(robot, paths, geometry_and_masses)
        """Geometry, then masses."""

    @cached_property
    def elastic(self) -> FileNumbers:
        """What elasticity takes beside the geometry."""
        return FileNumbers(self.robot, self.paths, lambda made: numbers_of(made.elastic))


Asked = tuple[Kernel, Callable[["Variants"], Array]]
"""A program, and what it takes of the machines, shape (k, size)."""
Ask = Callable[[Robot], Asked]


def of_geometry(many: Variants) -> Array:
    return many._numbers[0]


def of_masses(many: Variants) -> Array:
    return np.concatenate(many._numbers[::-1], 1)


def of_elasticity(many: Variants) -> Array:
    return np.concatenate([many._numbers[0], many._elastic], 1)


def forward(robot: Robot) -> Asked:
    return robot.engine.forward, of_geometry


def inverse(robot: Robot) -> Asked:
    return robot.inverse_kernel, of_geometry


def jacobian(robot: Robot) -> Asked:
    return robot.engine.jacobian, of_geometry


def acceleration(robot: Robot) -> Asked:
    return robot.engine.acceleration, of_geometry


def singularity(robot: Robot) -> Asked:
    return robot.singularity_kernel(), of_geometry


def torques(robot: Robot) -> Asked:
    return torques_kernel(robot), of_masses


def masses(robot: Robot) -> Asked:
    return masses_kernel(robot), of_masses


def compliance(robot: Robot) -> Asked:
    return elastic_of(robot).compliance, of_elasticity


def torque_gradient(robot: Robot) -> Asked:
    return motion_gradient(robot), of_masses


def torque_numbers(robot: Robot) -> Asked:
    return numbers_gradient(robot), of_masses


def pose_motion(robot: Robot) -> Asked:
    return pose_motion_gradient(robot.engine), of_geometry


def singularity_slopes(robot: Robot) -> Asked:
    return singularity_gradient(robot.engine), of_geometry


def compliance_slopes(robot: Robot) -> Asked:
    return compliance_gradient(elastic_of(robot)), of_elasticity
