# SPDX-License-Identifier: Apache-2.0
"""Forward kinematics along a stream, and how far a pose is from the edge of the workspace.

May import: numpy, pkm_twin's core, the standard library.
"""

from __future__ import annotations

import operator
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.errors import SingularityError
from pkm_twin.machine.robot import SINGULARITY_BOUND, Robot

Array = NDArray[np.float64]

STEP: Final = 1e-6
"""Step of the central differences, in pose units; Newton corrects what they miss."""
MAX_TURNS: Final = 30
CLOSE: Final = 1e-12
"""Largest change of the last Newton step, in pose units."""
MAX_MOVE: Final = 0.25
"""Largest move between two samples, in platform radii: beyond it, another assembly is likely."""


def follow(robot: Robot, q: ArrayLike, previous: ArrayLike) -> Array:
    """Pose of joint positions q, shape (m,), next to the previous pose, shape (m,).

    Newton on inverse(pose) = q from the previous pose: the assembly mode that the stream is in,
    also where the closed form of :meth:`Robot.forward` would take another one.

    :raises SingularityError: Newton does not settle near the previous pose: the stream has come
        to where assembly modes meet, or it has jumped.
    :raises UnreachableError: the previous pose itself is out of reach.
    """
    goal = np.asarray(q, np.float64)
    start = np.asarray(previous, np.float64)
    m = len(start)
    pose = start.copy()
    shifts = STEP * np.concatenate([np.eye(m), -np.eye(m)])
    error = robot.inverse(pose) - goal
    scale = robot.pose_scales
    for _ in range(MAX_TURNS):
        columns, good = robot.try_inverse(pose + shifts)
        if not good.all():
            break
        slope = ((columns[:m] - columns[m:]) / (2 * STEP)).T
        values = np.linalg.svd(slope / scale, compute_uv=False)
        if not values[-1] > SINGULARITY_BOUND * values[0]:
            break
        step = np.linalg.solve(slope, error)
        for _ in range(MAX_TURNS):
            trial = pose - step
            there, found = robot.try_inverse(trial)
            remaining = there - goal
            if not found.all():
                step /= 2
                continue
            if np.abs(remaining).max() <= np.abs(error).max() or np.abs(step).max() < CLOSE:
                break
            step /= 2
        else:
            break
        pose, error = trial, remaining
        if np.abs((pose - start) * scale).max() > MAX_MOVE * robot.size:
            break
        if np.abs(step).max() < CLOSE:
            return pose
    raise SingularityError("stream of joint states", (), 0.0, SINGULARITY_BOUND)


def track(robot: Robot, q: ArrayLike, start: ArrayLike | None = None) -> Array:
    """Poses along a stream of joint positions, shape (n, m), each next to the one before.

    :param start: pose before the first sample; None takes :meth:`Robot.forward` of the first.
    """
    stream = np.asarray(q, np.float64)
    poses = np.empty_like(stream)
    last = robot.forward(stream[0]) if start is None else np.asarray(start, np.float64)
    for i, sample in enumerate(stream):
        last = poses[i] = follow(robot, sample, last)
    return poses


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
    count = operator.index(count)
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
