# SPDX-License-Identifier: Apache-2.0
"""The greatest efforts and speeds of drives over the whole workspace.

May import: numpy, delta_dynamics, pkm_twin's core, the standard library; never rclpy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from delta_dynamics import inverse_dynamics
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.directions import sphere_directions
from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]

POSES: Final = 4000
"""Poses of the box around the workspace."""
DIRECTIONS: Final = 32
"""Of the tool point's speed."""
SINGULARITY: Final = 0.05
"""Least singularity index of a pose that counts."""


@dataclass(frozen=True)
class Worst:
    """By actuated joint the greatest effort, effort at rest and speed, shape (n,), N m or N and
    rad/s or m/s, and the pose of each, shape (n, m); ``poses``: how many were looked at.
    """

    effort: Array
    effort_pose: Array
    holding: Array
    holding_pose: Array
    speed: Array
    speed_pose: Array
    poses: int


def workspace_poses(robot: Robot, count: int = POSES, singularity: float = SINGULARITY) -> Array:
    """Poses of a grid in the workspace, shape (k, m): in reach, within limits, regular.

    :raises ParameterError: a workspace without bounds, or none.
    """
    box = robot.search_box()
    side = max(3, round(count ** (1.0 / len(box))))
    axes = [np.linspace(low, high, side + 2)[1:-1] for low, high in box]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(box))
    poses = np.concatenate([robot.home()[None], grid])
    q, good = robot.try_inverse(poses)
    limits = robot.limits.position
    if limits is not None:
        good &= ((q >= limits[:, 0]) & (q <= limits[:, 1])).all(1)
    poses, q = poses[good], q[good]
    clear = robot.singularity(q) >= singularity if len(q) else np.zeros(0, bool)
    if not clear.any():
        raise ParameterError(
            "workspace", "no pose", "poses within the limits, clear of singularities"
        )
    return np.asarray(poses[clear])


def worst_over_workspace(
    robot: Robot, speed: float, acceleration: float, *, count: int = POSES
) -> Worst:
    """The greatest efforts and speeds of the drives, tool point in the worst directions.

    Speed and acceleration are those of the position in the pose; its angles stand still. The
    worst acceleration is exact, the worst direction of the speed one of :data:`DIRECTIONS`.

    :param speed: of the tool point, m/s; ``acceleration``: m/s2.
    :raises ParameterError: a pose without a position, or a workspace without bounds.
    """
    places = [i for i, name in enumerate(robot.pose_names) if name in ("x", "y", "z")]
    if not places:
        raise ParameterError("over-workspace", robot.name, "a robot whose pose has x, y or z")
    poses = workspace_poses(robot, count)
    q = robot.inverse(poses)
    back = np.linalg.inv(robot.jacobian(q))[..., places]
    k, n, size = back.shape
    zero = np.zeros_like(q)
    holding = np.abs(inverse_dynamics(robot, q, zero, zero))
    base = inverse_dynamics(robot, q, zero, zero)
    # Efforts by an acceleration along each axis of the position.
    rows = np.stack(
        [inverse_dynamics(robot, q, zero, back[..., i]) - base for i in range(size)], -1
    )
    swing = acceleration * np.linalg.norm(rows, axis=-1)
    greatest = np.abs(base) + swing
    for direction in _directions(size):
        qd = speed * back @ direction
        qdd = -np.linalg.solve(robot.jacobian(q), robot.pose_acceleration(q, qd, zero)[..., None])[
            ..., 0
        ]
        greatest = np.maximum(greatest, np.abs(inverse_dynamics(robot, q, qd, qdd)) + swing)
    rates = speed * np.linalg.norm(back, axis=-1)

    def pick(values: Array) -> tuple[Array, Array]:
        best = values.argmax(0)
        return values[best, np.arange(n)], poses[best]

    return Worst(*pick(greatest), *pick(holding), *pick(rates), poses=k)


def _directions(size: int) -> Array:
    """Unit vectors of a position of ``size`` coordinates."""
    if size == 1:
        return np.array([[1.0], [-1.0]])
    if size == 2:
        angle = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
        return np.stack([np.cos(angle), np.sin(angle)], -1)
    return np.asarray(sphere_directions(DIRECTIONS), np.float64)
