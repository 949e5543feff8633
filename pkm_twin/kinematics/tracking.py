# SPDX-License-Identifier: Apache-2.0
"""Forward kinematics along a stream, and directions spread over a sphere.

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
