# SPDX-License-Identifier: Apache-2.0
import json
import os
import subprocess
import sys

import numpy as np
import pytest
import yaml

from pkm_twin import load
from pkm_twin.machine.catalogue import config_folder

LIMITED = 0.7
"""Part of the joint range that random states are drawn from."""


@pytest.fixture
def rng():
    return np.random.default_rng(20240229)


@pytest.fixture
def variant(tmp_path):
    """Load a shipped robot with some of its parameters changed: variant(name, geometry=...)."""

    def make(name, **sections):
        data = parameters_of(name)
        for section, values in sections.items():
            if isinstance(values, dict):
                data.setdefault(section, {}).update(values)
            else:
                data[section] = values
        path = tmp_path / f"{name}_variant.yaml"
        path.write_text(yaml.safe_dump(data))
        return load(path), data

    return make


def parameters_of(name):
    """The plain parameter mapping of a shipped robot."""
    return yaml.safe_load((config_folder() / f"{name}.yaml").read_text())


def random_joints(robot, rng, count):
    """Joint positions inside the middle of the limits, shape (count, 3)."""
    low, high = robot.limits.position.T
    middle, half = (low + high) / 2, LIMITED * (high - low) / 2
    return rng.uniform(middle - half, middle + half, (count, 3))


def random_poses(robot, rng, count):
    """Poses of random joint states that can be assembled, shape (count, 3)."""
    poses, fault = robot.forward_kernel(robot.parameters, random_joints(robot, rng, 20 * count))
    return poses[fault[:, 0] == 0][:count]


def finite_difference(function, x, step=1e-6):
    """Central differences of function by the last axis of x: shape (..., outputs, inputs)."""
    columns = []
    for j in range(x.shape[-1]):
        shift = step * np.eye(x.shape[-1])[j]
        columns.append((function(x + shift) - function(x - shift)) / (2 * step))
    return np.stack(columns, -1)


def both_ways(program, given):
    """What a program prints as JSON, with numba and without, fed the text on its input."""
    results = []
    for off in ("0", "1"):
        done = subprocess.run(
            [sys.executable, "-c", program],
            input=given,
            capture_output=True,
            text=True,
            check=True,
            env=os.environ | {"PKM_TWIN_NO_NUMBA": off, "PYTHONPATH": os.pathsep.join(sys.path)},
        )
        results.append(json.loads(done.stdout))
    fast, slow = results
    assert (fast.pop("compiled"), slow.pop("compiled")) == (True, False)
    return fast, slow
