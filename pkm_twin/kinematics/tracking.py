# SPDX-License-Identifier: Apache-2.0
"""How far a pose is from the edge of the workspace, and directions spread over a sphere.

May import: numpy, pkm_twin's core, the standard library.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]


def boundary_distance(
    robot: Robot,
    pose: ArrayLike,
    *,
    directions: int = 200,
    farthest: float = 1.0,
    singularity: float = 1e-3,
) -> Array:
    """How far a pose can move before it leaves the workspace, shape (...), m.

    The least over ``directions`` directions (a Fibonacci sphere, so an upper bound that more of
    them sharpen) of the way to where a limb does not reach, a joint limit is passed or the
    singularity measure falls below ``singularity``. Rotations count as the way of the platform's
    rim. Zero outside the workspace, at most ``farthest``.
    """
    poses = np.asarray(pose, np.float64)
    unit = directions_of(len(robot.pose_names), directions) / robot.pose_scales
    low = np.zeros((*poses.shape[:-1], directions))
    high = np.full_like(low, farthest)
    # March, then bisect: a way out and in again must not be stepped over.
    for part in np.linspace(farthest / 64, farthest, 64):
        open_ends = high == farthest
        inside = _inside(robot, poses[..., None, :] + part * unit, singularity)
        low = np.where(open_ends & inside, part, low)
        high = np.where(open_ends & ~inside & (part < high), part, high)
    for _ in range(30):
        middle = (low + high) / 2
        inside = _inside(robot, poses[..., None, :] + middle[..., None] * unit, singularity)
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return np.where(_inside(robot, poses, singularity), low.min(-1), 0.0)


def directions_of(size: int, count: int) -> Array:
    """Unit vectors spread over the sphere of a dimension, shape (count, size).

    A Fibonacci lattice in three dimensions, even angles in two, else fixed random ones.
    """
    if size == 3:
        return sphere_directions(count)
    if size == 1:
        return np.array([[1.0], [-1.0]])
    if size == 2:
        angle = 2 * np.pi * np.arange(count) / count
        return np.stack([np.cos(angle), np.sin(angle)], -1)
    vectors = np.random.default_rng(0).normal(size=(count, size))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True), np.float64)


def sphere_directions(count: int) -> Array:
    """Unit vectors spread evenly over the sphere (Fibonacci lattice), shape (count, 3)."""
    if count < 1:
        raise ValueError(f"count has to be at least 1, not {count}")
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    turn = np.pi * (3 - np.sqrt(5)) * i
    out = np.sqrt(1 - z * z)
    return np.stack([out * np.cos(turn), out * np.sin(turn), z], -1)


def _inside(robot: Robot, poses: Array, singularity: float) -> NDArray[np.bool_]:
    """Whether poses (..., m) can be assembled within the limits and clear of singularities."""
    q, good = robot.try_inverse(poses)
    limits = robot.limits.position
    if limits is not None:
        with np.errstate(invalid="ignore"):
            good &= ((q >= limits[:, 0]) & (q <= limits[:, 1])).all(-1)
    if good.any():
        measure, usable = robot.try_singularity(q[good])
        good[good] = usable & (measure >= singularity)
    return good
