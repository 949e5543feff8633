# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Judge poses that kinematics accepts, of many machines: ``python -m tools.far_poses [SEED]``.

Poses are drawn from the box of all poses in reach to five times this box, of shipped robots,
examples and machines at random. Prints how many the quick inverse kinematics accepts, and of how
many of these ``forward`` gives another pose, or none.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from pkm_twin import Robot, load, robot_names
from pkm_twin.codegen.arrays import Array
from pkm_twin.mechanisms.catalogue import robot_of_data
from test.machine.random_machines import NAMES, variant
from test.support.robots import joint_range

ROOT: Final = Path(__file__).resolve().parents[1]
VARIANTS: Final = 220
POSES: Final = 30_000, 8_000
"""Numbers of poses for a file and for a random machine."""
MAX_POSE_ROUNDING: Final = 1e-6
"""Largest difference of two poses that are one, lengths over the size."""


def draw_machines(rng: np.random.Generator) -> Iterator[tuple[Robot, int]]:
    """Yield machines, and how many poses of each to judge."""
    examples = sorted((ROOT / "examples/machines").glob("*.yaml"))
    for name in (*robot_names(), *examples):
        yield load(name), POSES[0]
    for k in range(VARIANTS):
        yield robot_of_data(variant(NAMES[k % len(NAMES)], rng), "variant"), POSES[1]


def judge_poses(robot: Robot, count: int, rng: np.random.Generator) -> Array:
    """Return numbers of poses: all, accepted, of another pose, rejected by forward."""
    engine, (middle, half) = robot.engine, joint_range(robot)
    pose, good = robot.try_forward(middle + half * rng.uniform(-1.0, 1.0, (2000, len(middle))))
    if engine.posed is None or good.sum() < 20:
        return np.zeros(4, int)
    low, high = pose[good].min(0), pose[good].max(0)
    reach = np.repeat([1.0, 2.0, 3.0, 5.0], count // 4)[:, None]
    places = (low + high) / 2 + reach * (high - low) / 2 * rng.uniform(-1, 1, (count, len(low)))
    q = engine.quick_inverse(np.zeros(0), places)[0][0]
    accepted = np.isfinite(q).all(1)
    back, good = robot.try_forward(q[accepted])
    apart = back - places[accepted]
    turns = np.array([unit == "rad" for unit in robot.pose_units])
    apart[:, turns] = 2.0 * np.sin(apart[:, turns] / 2.0)
    apart[:, ~turns] /= engine.tree.size
    other = good & (np.abs(apart).max(1) > MAX_POSE_ROUNDING)
    return np.array([count, accepted.sum(), other.sum(), (~good).sum()])


if __name__ == "__main__":
    drawn = np.random.default_rng(int(sys.argv[1]) if len(sys.argv) > 1 else 0)
    total = sum((judge_poses(robot, n, drawn) for robot, n in draw_machines(drawn)), np.zeros(4))
    every, accepted, other, rejected = total.astype(int).tolist()
    print(f"{other} of {accepted:,} accepted poses are others, {rejected} are rejected by forward")
    print(f"{every:,} poses were drawn")
