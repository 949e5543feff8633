# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Robots that laws are held over, and random states of them.

A law asks the robot what it is, so that a file added to ``config/`` joins all laws by itself.
"""

from __future__ import annotations

import copy
import functools
import json
import os
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import pkm_twin
from pkm_twin import Robot, robot_names
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.machine.places import drop_missing
from pkm_twin.mechanisms.catalogue import config_folder

LIMITED = 0.7
"""Part of the joint range that random states are drawn from."""
CLEAR = 0.1
"""Least singularity measure of random states: nearer to one, no tolerance is the law's own."""
FREE = {"viscous": 0.0, "coulomb": 0.0}
"""Friction section without friction."""


def partly_long(names: Iterable[Any], *kept: Any) -> list[Any]:
    """Parameters of a kind: those that are kept are run by default, the others by `make long`."""
    marks = pytest.mark.long
    return [name if name in kept else pytest.param(name, marks=marks) for name in names]


def data_of(robot: Robot) -> dict[str, Any]:
    """What the robot's file gives, as plain data, written out."""
    data: dict[str, Any] = copy.deepcopy(drop_missing(robot.parameter_sections()))
    return data


def unsure(robot: Robot, uncertainty: Mapping[str, Any]) -> Robot:
    """The robot of a file that says how sure it is of its numbers."""
    return type(robot).from_data(data_of(robot) | {"uncertainty": uncertainty}, robot.name)


def often(some: int, all_of_them: int) -> list[Any]:
    """How many, or how far apart: what is run by default, and what `make long` runs."""
    return [some, pytest.param(all_of_them, marks=pytest.mark.long)]


def has(robot: Robot, ask: str) -> bool:
    """Whether a robot's file gives what a method needs: ``massive`` or ``structure``."""
    try:
        getattr(robot, ask)()
    except ParameterError:
        return False
    return True


SHIPPED = {name: pkm_twin.load(name) for name in robot_names()}


def load(robot: str | Path, **options: Any) -> Robot:
    """As the library's; a shipped robot once, as it does not change."""
    found = SHIPPED.get(str(robot))
    return found if found is not None else pkm_twin.load(robot, **options)


MASSIVE = [name for name, robot in SHIPPED.items() if has(robot, "massive")]
ELASTIC = [name for name, robot in SHIPPED.items() if has(robot, "structure")]

every_robot = pytest.mark.parametrize("name", robot_names())
some_elastic = partly_long(ELASTIC, "delta", "delta_cu", "prru", "upr_rpu")
"""All elastic robots, by default those whose mechanism has a file of its own."""
elastic = pytest.mark.parametrize("name", some_elastic)
KINDS = ("delta_cu", "five_bar", "rps3", "upr_rpu")
"""One of each kind: parallelograms, in a plane, turning platform, overconstrained."""
massive = pytest.mark.parametrize("name", partly_long(MASSIVE, *KINDS))
some_robots = pytest.mark.parametrize("name", partly_long(robot_names(), *KINDS))
"""By default one of each kind."""


@functools.cache
def _read(name: str) -> dict[str, Any]:
    data: dict[str, Any] = yaml.safe_load((config_folder() / f"{name}.yaml").read_text())
    return data


def parameters_of(name: str) -> dict[str, Any]:
    """The plain parameter mapping of a shipped robot, the caller's own."""
    return copy.deepcopy(_read(name))


def without(entry: Any, *keys: str) -> Any:
    """Plain data without these keys, wherever in it they are."""
    if isinstance(entry, dict):
        return {key: without(value, *keys) for key, value in entry.items() if key not in keys}
    return [without(value, *keys) for value in entry] if isinstance(entry, list) else entry


def rigid(name: str, path: Path) -> Path:
    """A shipped robot without members, sections and compliances, written there."""
    data = without(parameters_of(name), "member", "section", "compliance")
    path.write_text(yaml.safe_dump(data))
    return path


def massless(path: Path) -> Path:
    """A 2UPR-RPU whose file has no masses, written there."""
    data = parameters_of("upr_rpu")
    del data["inertia"]
    path.write_text(yaml.safe_dump(data))
    return path


@functools.cache
def loaded(name: str) -> Robot:
    """A shipped robot with a payload, gravity in no special direction, and friction."""
    return loaded_like(load(name))


def loaded_like(robot: Robot) -> Robot:
    """The same of any robot."""
    count = np.arange(1, len(robot.joint_names) + 1)
    return robot.changed(
        payload={"mass": 0.3, "com": [0.01, -0.02, -0.04], "inertia": [4e-4, 5e-4, 3e-4]},
        gravity=[0.5, -1.0, -9.7],
        friction={"viscous": (0.1 * count).tolist(), "coulomb": (0.04 + 0.01 * count).tolist()},
    )


def joint_range(robot: Robot) -> tuple[Array, Array]:
    """Middle and half width of what random joints are drawn from, shape (n,) each."""
    if robot.limits.position is not None:
        low, high = robot.limits.position.T
        return (low + high) / 2, LIMITED * (high - low) / 2
    size = robot.engine.tree.size
    half = [0.15 * size if unit == "m" else 0.3 for unit in robot.joint_units]
    return robot.graph.home, np.array(half)


def random_joints(robot: Robot, rng: np.random.Generator, count: int, clear: float = CLEAR) -> Array:
    """Joint positions inside the middle of the limits that can be assembled, shape (count, n).

    Clear of singularities by that measure.
    """
    middle, half = joint_range(robot)
    kept = np.empty((0, len(middle)))
    for _ in range(100):
        drawn = rng.uniform(middle - half, middle + half, (max(count, 1), len(middle)))
        measure, good = robot.try_singularity(drawn)
        kept = np.concatenate([kept, drawn[good & (measure > clear)]])
        if len(kept) >= count:
            return kept[:count]
    raise AssertionError(f"{robot.name}: of 100 draws {len(kept)} joint states can be assembled")


def random_poses(robot: Robot, rng: np.random.Generator, count: int, clear: float = CLEAR) -> Array:
    """Poses of such joint states, shape (count, m)."""
    return robot.forward(random_joints(robot, rng, count, clear))


def joint_units_of_size(robot: Robot) -> Array:
    """What makes rates of a size that suits the joints' units, shape (n,)."""
    return np.array([0.2 if unit == "m" else 1.0 for unit in robot.joint_units])


def random_motion(robot: Robot, rng: np.random.Generator, count: int) -> tuple[Array, ...]:
    """Positions, rates and accelerations, shape (count, n) each, and wrenches, (count, 6)."""
    q = random_joints(robot, rng, count)
    scale = joint_units_of_size(robot)
    qd, qdd = (scale * rng.normal(0.0, size, q.shape) for size in (3.0, 30.0))
    return q, qd, qdd, rng.normal(0.0, 10.0, (count, 6))


def finite_difference(function: Any, x: Array, step: float = 1e-6) -> Array:
    """Central differences of function by the last axis of x: shape (..., outputs, inputs)."""
    columns = []
    for j in range(x.shape[-1]):
        shift = step * np.eye(x.shape[-1])[j]
        columns.append((function(x + shift) - function(x - shift)) / (2 * step))
    return np.stack(columns, -1)


def both_ways(program: str, given: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """What a program prints as JSON, compiled and as plain Python, fed the text on its input."""
    results = []
    for plain in ("0", "1"):
        environment = {k: v for k, v in os.environ.items() if k != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"}
        environment |= {"PKM_TWIN_PLAIN": plain, "PYTHONPATH": os.pathsep.join(sys.path)}
        done = subprocess.run(
            [sys.executable, "-c", program],
            input=given,
            capture_output=True,
            text=True,
            check=True,
            env=environment,
        )
        results.append(json.loads(done.stdout))
    fast, slow = results
    assert (fast.pop("compiled"), slow.pop("compiled")) == (True, False)
    return fast, slow
