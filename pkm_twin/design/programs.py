# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""List the programs that are run for many machines, and the numbers that each needs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Final, Literal

from delta_dynamics.torques.at_pose import iterated_pose_torque_kernel
from delta_dynamics.torques.derivatives import motion_gradient_kernel, number_gradient_kernel
from delta_dynamics.torques.reactions import needed_wrench_kernel
from delta_dynamics.torques.virtual_work import mass_matrix_kernel, torque_kernel
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.kinematics.gradients import free_forward, platform_gradient, pose_motion_gradient
from pkm_twin.kinematics.singularity import compile_singularity_gradient
from pkm_twin.robot.derivatives import list_geometry_numbers
from pkm_twin.robot.numbers import FileNumbers, geometry_and_masses
from pkm_twin.robot.robot import Robot
from stiffness_monitor.derivatives import compliance_gradient
from stiffness_monitor.numbers import list_numbers
from stiffness_monitor.programs import Elastic


class NumberFunctions:
    """Compute the programs' inputs of a robot as functions of numbers of its file."""

    def __init__(self, robot: Robot, paths: Sequence[str]) -> None:
        self.robot, self.paths = robot, paths
        self.others: list[Robot] = []
        """Robots with these numbers changed, one per further structure that occurred."""
        self.geometry = FileNumbers(robot, paths, list_geometry_numbers)

    @cached_property
    def rigid(self) -> FileNumbers:
        """Geometry, then masses."""
        return FileNumbers(self.robot, self.paths, geometry_and_masses)

    @cached_property
    def elastic_inputs(self) -> FileNumbers:
        """Inputs of the elastic model's programs that follow the geometry."""
        return FileNumbers(self.robot, self.paths, lambda made: list_numbers(made.elastic))


Numbers = Literal["geometry", "masses", "elasticity"]
Request = tuple[Kernel, tuple[Numbers, ...]]
"""A program, and the attributes of :class:`Variants` that are its inputs, in this order."""
MakeRequest = Callable[[Robot], Request]


def make_request(kernel: Callable[[Robot], Kernel], *numbers: Numbers) -> MakeRequest:
    """Return a program of a robot with its inputs, by default the geometry alone."""
    return lambda robot: (kernel(robot), numbers or ("geometry",))


forward: Final = make_request(lambda robot: robot.engine.generic_forward)
"""From q to pose, position and rotation."""
forward_of_all_structures: Final = make_request(lambda robot: free_forward(robot.engine))
"""The same as :func:`forward`, one program for machines of every structure."""
project_redundant: Final = make_request(lambda robot: robot.projection_kernel)
"""From q, qd, qdd of the leading drives to those of all drives."""
inverse: Final = make_request(lambda robot: robot.engine.generic_inverse)
"""From the pose to q of some assembly."""
jacobian: Final = make_request(lambda robot: robot.engine.jacobian)
"""From q to pose rates per joint rate."""
acceleration: Final = make_request(lambda robot: robot.engine.acceleration)
"""From q, qd, qdd to the pose's second derivative."""
singularity: Final = make_request(lambda robot: robot.singularity_kernel())
"""From q to the singularity index."""
torques: Final = make_request(torque_kernel, "masses", "geometry")
"""From q, qd, qdd and wrench to efforts."""
torques_at_pose: Final = make_request(iterated_pose_torque_kernel, "masses", "geometry")
"""From pose, rate, acceleration and wrench to q, qd, qdd and efforts."""
loads: Final = make_request(needed_wrench_kernel, "masses", "geometry")
"""From q, qd, qdd and wrench to the joints' loads and positions."""
masses: Final = make_request(mass_matrix_kernel, "masses", "geometry")
"""From q to the mass matrix."""
compliance: Final = make_request(lambda robot: robot.cached(Elastic).compliance, "geometry", "elasticity")
"""From q to the compliance and its frame's pivot ratio."""
torque_gradient: Final = make_request(motion_gradient_kernel, "masses", "geometry")
"""Derivatives of the torques by q, qd and qdd."""
torque_numbers: Final = make_request(number_gradient_kernel, "masses", "geometry")
"""Derivatives of the torques by geometry and masses."""
platform_derivatives: Final = make_request(lambda robot: platform_gradient(robot.engine))
"""Derivatives of pose, position and rotation by geometry."""
pose_motion: Final = make_request(lambda robot: pose_motion_gradient(robot.engine))
"""Derivatives of pose, rate and acceleration by q, qd and geometry."""
singularity_derivatives: Final = make_request(lambda robot: compile_singularity_gradient(robot.engine))
"""Derivatives of the index by q and geometry."""
compliance_derivatives: Final = make_request(
    lambda robot: compliance_gradient(robot.cached(Elastic)), "geometry", "elasticity"
)
"""Derivatives of the compliance by q and all numbers."""
