# SPDX-License-Identifier: Apache-2.0
"""The box of all poses that a machine reaches.

A robot tells how its poses are laid out (``robot.grid()``) and where they end
(``robot.search_box()``); nothing here knows a mechanism.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import reachable, try_forward

JOINT_STATES: Final = 2**14
"""Joint states, evenly spread between the limits, whose poses bound a workspace."""
CLIMBERS: Final = 32
"""States from which the ends of a workspace of many coordinates are looked for."""
COARSE: Final = 33
"""Poses along each coordinate of the grid that bounds a workspace."""
FULL: Final = 3
"""Most pose coordinates of which a whole grid is made."""


def workspace_box(robot: Robot) -> Array:
    """Bounds of all reachable poses, limb interference aside, a little wider; shape (m, 2).

    From poses of joint states all over the limits and, for few coordinates, from a grid of poses.
    Lateral coordinates of a cylinder are bounded alike on both sides of the axis.

    :raises ParameterError: nothing bounds the workspace, or it is empty.
    """
    bounds = np.asarray(robot.search_box(), np.float64)
    # With what interference takes away, which maps show.
    found = _from_joints(robot)
    grid = robot.grid()
    lateral = [robot.pose_names.index(name) for name in grid.lateral]
    box = bounds
    if len(bounds) > FULL:
        if len(found):
            box = _around(found, 0.1 * np.ptp(found, axis=0), bounds)
        return box
    # Twice: a machine may reach a small part of what its lengths allow.
    for _ in range(2):
        ticks = [np.linspace(low, high, COARSE) for low, high in box]
        poses = np.stack(np.meshgrid(*ticks, indexing="ij"), -1).reshape(-1, len(ticks))
        seen = np.concatenate([found, poses[reachable(robot, poses, -math.inf)]])
        if not len(seen):
            raise ParameterError("limits", robot.name, "limits that leave a workspace")
        box = _around(seen, np.ptp(box, axis=1) / (COARSE - 1), bounds)
        if lateral:
            # The axis stays in the middle, and on the grid: workspaces end in tips there.
            half = np.abs(box[lateral]).max(1)
            box[lateral] = np.stack([-half, half], -1)
    return box


def _around(poses: Array, margin: Array, bounds: Array) -> Array:
    low, high = poses.min(0) - margin, poses.max(0) + margin
    return np.stack([np.maximum(low, bounds[:, 0]), np.minimum(high, bounds[:, 1])], -1)


def _from_joints(robot: Robot) -> Array:
    """Reachable poses of joint states between the limits, shape (k, m); none without limits."""
    limits = robot.limits.position
    count = len(robot.joint_names)
    if limits is None or not np.isfinite(limits).all():
        return np.empty((0, len(robot.pose_names)))
    # Not above: every process of a sweep would load it, which takes longer than many sweeps.
    from scipy.stats import qmc  # type: ignore[import-untyped]

    # Extremes are mostly where joints are at a limit or in the middle.
    corners = np.stack(np.meshgrid(*[[0.0, 0.5, 1.0]] * count, indexing="ij"), -1)
    inner = qmc.Halton(count, scramble=False).random(JOINT_STATES)
    share = np.concatenate([corners.reshape(-1, count), inner])
    q = limits[:, 0] + share * np.ptp(limits, axis=1)
    poses, good = try_forward(robot, q)
    good[good] = reachable(robot, poses[good], -math.inf)
    poses, q = poses[good], q[good]
    if len(robot.pose_names) > FULL and len(q):
        # States so few are far apart where joints are many.
        ends = [
            _farthest(robot, limits, q[np.argsort(-sign * poses[:, k])[:CLIMBERS]], k, sign)
            for k in range(poses.shape[1])
            for sign in (-1.0, 1.0)
        ]
        poses = np.concatenate([poses, *ends])
    return poses


def _farthest(robot: Robot, limits: Array, q: Array, k: int, sign: float) -> Array:
    """Poses uphill of joint states (c, n) in pose coordinate k times a sign.

    :param limits: of the joints, shape (n, 2).
    """
    low, high = limits.T
    best, _ = try_forward(robot, q)
    for step in np.repeat(0.5 ** np.arange(1, 9), 3):
        rates, known = robot.try_jacobian(q)
        uphill = np.where(known[:, None], sign * np.sign(rates[:, k]), 0.0)
        tried = np.clip(q + step * (high - low) * uphill, low, high)
        poses, good = try_forward(robot, tried)
        good[good] = reachable(robot, poses[good], -math.inf)
        good &= sign * (poses[:, k] - best[:, k]) > 0.0
        q, best = np.where(good[:, None], tried, q), np.where(good[:, None], poses, best)
    return best
