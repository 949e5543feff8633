# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A robot as a Python file for array libraries: the same numbers, masks and derivatives."""

from __future__ import annotations

import contextlib
import importlib.util

import numpy as np
import pytest

from pkm_twin.codegen import cache
from pkm_twin.export.python_file import FUNCTION_NAMES, python_file
from test.export.c_programs import functions, inputs_of
from test.machine.random_machines import FILES
from test.support.robots import load, partly_long, random_motion

LIBRARIES = ("numpy", "jax", "torch")
COUNT = 300
LIBRARY = pytest.mark.parametrize("library", LIBRARIES)
ROBOT = pytest.mark.parametrize(
    "name", partly_long(("five_bar", "delta_cu", "prru", "rps3", "rsur", "gantry"), "five_bar")
)


class Made:
    """An exported file, imported, and how its library makes arrays."""

    def __init__(self, robot, library, folder):
        self.xp = pytest.importorskip("jax.numpy" if library == "jax" else library)
        self.uncompiled = contextlib.nullcontext
        if library == "jax":
            import jax

            jax.config.update("jax_enable_x64", True)
            # What is compiled stays from run to run: each operation is a program of a moment.
            if (kept := cache.find_folder()) is not None:
                jax.config.update("jax_compilation_cache_dir", str(kept / "jax"))
                jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
            self.uncompiled = jax.disable_jit
        path = folder / "machine.py"
        path.write_text(python_file(robot, library))
        spec = importlib.util.spec_from_file_location(f"machine_{library}", path)
        self.module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(self.module)
        if library == "jax":
            # Nine steps take ten times as long to trace; torch makes them.
            self.module.MORE_STEPS = ()

    def call(self, name, *inputs, kind=np.float64):
        """Results side by side, and the mask, as arrays of numpy; nothing is compiled."""
        given = [self.xp.asarray(np.asarray(value, kind)) for value in inputs]
        with self.uncompiled():
            *rows, valid = getattr(self.module, name)(*given)
        assert all(np.asarray(row).dtype == kind for row in rows)
        return np.concatenate([np.asarray(row) for row in rows], -1), np.asarray(valid)


def robot_of(name):
    return load(FILES.get(name, name))


def cases(robot):
    """Names, inputs and right results of all functions in random states."""
    given = inputs_of(robot, random_motion(robot, np.random.default_rng(8), COUNT))
    for name, ask in functions(robot).items():
        if name in FUNCTION_NAMES:
            yield name, given[name], ask(*given[name])


@LIBRARY
@ROBOT
def test_results_are_those_of_python(name, library, tmp_path):
    robot = robot_of(name)
    made = Made(robot, library, tmp_path)
    for function, inputs, right in cases(robot):
        found, valid = made.call(function, *inputs)
        assert valid.all(), function
        assert np.abs(found - right).max() < 1e-12 * np.abs(right).max(), function


@LIBRARY
def test_single_precision_is_kept(library, tmp_path):
    robot = robot_of("five_bar")
    made = Made(robot, library, tmp_path)
    for function, inputs, right in cases(robot):
        if function not in ("inverse", "torques"):
            continue
        found, valid = made.call(function, *inputs, kind=np.float32)
        assert valid.all(), function
        assert np.abs(found - right).max() < 1e-4 * np.abs(right).max(), function


def test_single_precision_confirms_the_poses_of_double_precision(tmp_path):
    robot = load("examples/humanoid.xml", base="shank", platform="foot")
    made = Made(robot, "numpy", tmp_path)
    rng = np.random.default_rng(3)
    poses = rng.uniform([-0.8, -1.0], [0.8, 1.0], (1000, 2)).astype(np.float32)
    right, reached = made.call("inverse", poses)
    found, valid = made.call("inverse", poses, kind=np.float32)
    assert np.sum(~reached) > 0
    assert np.mean(valid[reached]) > 0.995
    assert np.mean(valid[~reached]) < 0.005
    both = valid & reached
    assert np.median(np.abs(found - right)[both]) < 1e-5


@LIBRARY
def test_what_is_out_of_reach_or_not_finite_is_masked(library, tmp_path):
    robot = robot_of("five_bar")
    made = Made(robot, library, tmp_path)
    home = robot.inverse(robot.home())
    # As many as the other tests have: jax compiles each operation by its shape.
    q = np.tile([home, [3.0, -3.0], [np.nan, 0.0], [0.0, np.inf]], (COUNT // 4, 1))
    assert not robot.try_forward(q[1:2])[1].any()
    pose, valid = made.call("forward", q)
    assert valid.tolist() == [True, False, False, False] * (COUNT // 4)
    assert np.isfinite(pose[valid]).all() and np.isnan(pose[~valid]).all()
    far, valid = made.call("inverse", robot.home() + np.tile([[0.0, 0.0], [9.0, 0.0]], (COUNT // 2, 1)))
    assert valid.tolist() == [True, False] * (COUNT // 2) and np.isnan(far[~valid]).all()


def test_jax_compiles_vectorises_and_differentiates(tmp_path):
    jax = pytest.importorskip("jax")
    robot = robot_of("five_bar")
    made = Made(robot, "jax", tmp_path)
    q = random_motion(robot, np.random.default_rng(9), 20)[0]
    poses, valid = made.module.jit(jax.vmap(made.module.forward))(q)
    assert np.asarray(valid).all()
    np.testing.assert_allclose(poses, robot.forward(q), atol=1e-12)
    slope = jax.jacrev(lambda one: made.module.forward(one)[0])
    slopes = made.module.jit(jax.vmap(slope))(q)
    np.testing.assert_allclose(slopes, robot.jacobian(q), atol=1e-10)


def test_torch_differentiates(tmp_path):
    torch = pytest.importorskip("torch")
    robot = robot_of("five_bar")
    made = Made(robot, "torch", tmp_path)
    q = torch.tensor(robot.inverse(robot.home()), dtype=torch.float64, requires_grad=True)
    made.module.forward(q)[0][1].backward()
    np.testing.assert_allclose(q.grad, robot.jacobian(q.detach().numpy())[1], atol=1e-10)


def test_the_command_writes_a_file_that_needs_numpy_alone(twin, tmp_path):
    out = tmp_path / "five_bar.py"
    twin.good("export", "python", "five_bar", "--out", out, "--array", "numpy")
    text = out.read_text()
    assert [line for line in text.splitlines() if "import" in line] == ["import numpy as xp"]
    assert "pkm_twin" not in text
    assert twin("export", "python", "five_bar", "--out", out, "--array", "cupy").code == 2
