# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Recordings for fits: smooth motions of a robot, and what engines that are not the twin's need."""

from __future__ import annotations

from typing import Any

import numpy as np

from pkm_twin import Robot
from pkm_twin.codegen.arrays import Array
from test.support.robots import joint_range


def smooth_motion(
    robot: Robot, rng: np.random.Generator, duration: float, rate: float, part: float = 0.6
) -> tuple[Array, Array, Array, Array]:
    """Time (k,), q, qd, qdd (k, n): sums of sines within a part of the joints' range."""
    middle, half = joint_range(robot)
    time = np.arange(round(duration * rate)) / rate
    shape = (len(middle), 5)
    w = 2 * np.pi * np.array([0.2, 0.45, 0.7, 1.1, 1.6])
    while part > 0.05:
        size, phase = rng.normal(size=shape), rng.uniform(0.0, 2 * np.pi, shape)
        angle = w * time[:, None, None] + phase
        unit = part * half / np.abs((size * np.sin(angle)).sum(-1)).max(0)
        q = middle + unit * (size * np.sin(angle)).sum(-1)
        if robot.try_forward(q[::10])[1].all():
            qd = unit * (size * w * np.cos(angle)).sum(-1)
            return time, q, qd, unit * (-size * w**2 * np.sin(angle)).sum(-1)
        part *= 0.9
    raise AssertionError(f"no motion of {robot.name}")


def engine_efforts(engine: Any, q: Array, qd: Array, qdd: Array) -> Array:
    """What another engine needs for a motion, shape (k, n)."""
    return np.array([engine.inverse_dynamics(*state) for state in zip(q, qd, qdd, strict=True)])
