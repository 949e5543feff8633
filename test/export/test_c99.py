# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A robot in C: the same numbers and verdicts as in Python, and code that compilers accept."""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import subprocess

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin import robot_names
from pkm_twin.codegen.program import MAX_ITERATIONS
from pkm_twin.export.c99 import C_HEAD, MAX_NEWTON_CORRECTIONS
from pkm_twin.export.c_functions import ARCTANGENT_C
from pkm_twin.export.c_package import c_package
from test.machine.random_machines import FILES
from test.support.robots import (
    joint_range,
    load,
    loaded,
    often,
    partly_long,
    random_joints,
    random_motion,
)

from .c_programs import (
    ARM64,
    CLOSE,
    COMPILERS,
    PLAIN,
    SANITIZED,
    Package,
    blocking,
    compile_in,
    functions,
    hooked,
    inputs_of,
    watched,
)

pytestmark = pytest.mark.skipif(not COMPILERS, reason="there is no C compiler: gcc or clang")

# Of the chain rccc every state is near a singularity.
UNSEEN = {name: FILES[name] for name in sorted(FILES) if name != "rccc"}
KEPT = ("delta_cu", "bolted")
"""Rods with members, and bars that hold twice."""
NAMES = [*robot_names(), *(name for name in UNSEEN if name not in robot_names())]
STRICT = (
    "-Wall",
    "-Wextra",
    "-Wpedantic",
    "-Wconversion",
    "-Wshadow",
    "-Wvla",
    "-Wundef",
    "-Wfloat-equal",
    "-Wdouble-promotion",
    "-Wcast-qual",
    "-Werror",
)
FLAGS = [PLAIN, *((f"-O{k}", *more) for k in range(4) for more in ((), ("-mfma",)))]


def robot_of(name):
    return loaded(name) if name in robot_names() else load(UNSEEN[name])


@pytest.fixture(scope="module", params=partly_long(NAMES, *KEPT))
def exported(request, tmp_path_factory):
    robot = robot_of(request.param)
    return robot, Package(tmp_path_factory.mktemp("c"), c_package(robot))


def check_numbers(robot, package, program, count):
    """Results of a program and of Python, and that all states are valid."""
    asked = functions(robot)
    assert set(package.heads) == set(asked)
    motion = random_motion(robot, np.random.default_rng(5), count)
    inputs = inputs_of(robot, motion)
    # Nearer to a singularity rounding grows, in all back ends alike.
    share = np.where(robot.singularity(motion[0]) > 0.2, 1.0, 10.0)[:, None]
    for name, ask in asked.items():
        status, found = package.run(program, name, *inputs[name])
        right = ask(*inputs[name])
        assert not status.any(), name
        error = np.abs(found - right) / share
        assert error.max() <= CLOSE.get(name, 1e-12) * np.abs(right).max(), name


def check_verdicts(robot, package, program, q):
    """Statuses of positions, which are those of Python, and poses where Python has some."""
    right, good = robot.try_forward(q)
    status, found = package.run(program, "forward", q)
    assert set(status) <= {0.0, 1.0}
    np.testing.assert_array_equal(status == 0.0, good)
    assert np.isnan(found[~good]).all()
    # A state beside a singularity magnifies rounding.
    clear = good & (robot.try_singularity(q)[0] > 1e-3)
    np.testing.assert_allclose(found[clear], right[clear], 1e-9, 1e-9 * robot.graph.size)
    return good


@pytest.mark.parametrize("count", often(200, 10_000))
@pytest.mark.parametrize("flags", partly_long(dict.fromkeys(FLAGS), PLAIN), ids=" ".join)
def test_numbers_are_those_of_python(exported, flags, count):
    robot, package = exported
    check_numbers(robot, package, package.build(*flags), count)


@pytest.mark.skipif(not all(map(shutil.which, ARM64)), reason="there is no emulated ARM64")
@pytest.mark.parametrize("name", partly_long(robot_names(), "five_bar"))
@pytest.mark.parametrize("flags", partly_long([PLAIN, ("-O2",)], PLAIN), ids=" ".join)
@pytest.mark.parametrize("count", often(200, 2_000))
def test_numbers_and_verdicts_on_an_emulated_arm64(name, flags, count, tmp_path, rng):
    robot = loaded(name)
    package = Package(tmp_path, c_package(robot))
    program = package.build(*flags, compiler=ARM64[0])
    check_numbers(robot, package, program, count)
    check_verdicts(robot, package, program, wild(robot, rng, count))


def wild(robot, rng, count):
    """Joint positions of which many have no assembly, and not one is near the others."""
    middle, half = joint_range(robot)
    return middle + half * rng.uniform(-4.0, 4.0, (count, len(middle)))


def edges(robot, bad):
    """Joint positions on both sides of where the way from home to bad ones ends.

    Nearer than this, rounding decides.
    """
    home, good, far = robot.graph.home, np.zeros((len(bad), 1)), np.ones((len(bad), 1))
    for _ in range(40):
        half = (good + far) / 2
        fits = robot.try_forward(home + half * (bad - home))[1][:, None]
        good, far = np.where(fits, half, good), np.where(fits, far, half)
    sides = [good * (1.0 + side) for side in (-1e-3, -1e-5, 1e-5, 1e-3)]
    return np.concatenate([home + side * (bad - home) for side in sides])


@pytest.mark.parametrize("count", often(300, 10_000))
def test_verdicts_are_those_of_python(exported, count, rng):
    robot, package = exported
    program = package.build(*PLAIN)
    q = wild(robot, rng, count)
    good = check_verdicts(robot, package, program, q)
    if not good.all():
        at_edge = edges(robot, q[~good][:100])
        status, _ = package.run(program, "forward", at_edge)
        np.testing.assert_array_equal(status == 0.0, robot.try_forward(at_edge)[1])
    for name, rows in inputs_of(robot, (q, *np.zeros((2, *q.shape)), np.zeros((count, 6)))).items():
        if name not in (
            "inverse",
            "torques_at_pose",
            "mass_matrix_at_pose",
            "accelerations_at_pose",
            "joint_to_actuator",
            "gains",
            "compliance",
            "strain_energy",
            "accelerations",
        ):
            status, _ = package.run(program, name, *rows)
            np.testing.assert_array_equal(status == 0.0, good, err_msg=name)


def test_joint_values_far_beyond_every_machine_are_judged_as_in_python(exported, rng):
    """Also those whose sine a library still knows: up to the largest double."""
    robot, package = exported
    n = robot.joints_count
    values = 10.0 ** np.concatenate([np.arange(3.0, 308.1, 2.5), rng.uniform(4.0, 20.0, 30)])
    values = np.concatenate([values, -values, [1e308, np.nextafter(1e6, 0.0), 1e6]])
    q = np.tile(robot.graph.home, (n * len(values), 1))
    q[np.arange(len(q)), np.tile(np.arange(n), len(values))] = np.repeat(values, n)
    status, _ = package.run(package.build(*PLAIN), "forward", q)
    np.testing.assert_array_equal(status == 0.0, robot.try_forward(q)[1])
    turned = np.array([unit == "rad" for unit in robot.joint_units])
    assert status[(np.abs(q[:, turned]) >= 1e6).any(1)].all()


@pytest.mark.parametrize("count", often(300, 10_000))
def test_poses_beyond_reach_or_a_singularity_are_rejected_as_in_python(exported, count, rng):
    robot, package = exported
    near = robot.forward(random_joints(robot, rng, 20))
    center, size = near.mean(0), np.ptp(near, axis=0)
    away = rng.uniform(-1.0, 1.0, (count, len(center))) * rng.uniform(0.0, 4.0, (count, 1))
    poses = center + size * away
    right, good = robot.try_inverse(poses)
    status, found = package.run(package.build(*PLAIN), "inverse", poses)
    assert good.any()
    np.testing.assert_array_equal(status == 0.0, good)
    clear = np.array(good)
    clear[good] = robot.singularity(right[good]) > 1e-3
    np.testing.assert_allclose(found[clear], right[clear], 1e-9, 1e-9)
    assert np.isnan(found[~good]).all()


def test_one_attempt_rejects_more_and_never_errs(exported, rng):
    robot, package = exported
    q = wild(robot, rng, 300)
    right, good = robot.try_forward(q)
    status, found = package.run(package.build(*PLAIN, "-DPKM_ATTEMPTS=1"), "forward", q)
    at_once = status == 0.0
    assert at_once.any() and (good | ~at_once).all()
    near = at_once & (robot.try_singularity(q)[0] > 1e-3)
    np.testing.assert_allclose(found[near], right[near], 1e-9, 1e-9 * robot.graph.size)


def test_no_call_makes_more_corrections_than_the_header_counts(small, tmp_path, rng):
    robot, package = small
    text = (package.folder / f"{package.prefix}.c").read_text()
    text, found = re.subn(r"(?<= )(\w+_correct\((?!const))", r"turns++, \1", text)
    assert found
    counted = Package(tmp_path, c_package(robot))
    head = """
#include <stdio.h>
static long turns;
__attribute__((destructor)) static void report(void) { fprintf(stderr, "%ld 0", turns); }
"""
    (tmp_path / f"{package.prefix}.c").write_text(head + text)
    number = str(list(counted.heads).index("forward"))
    for flags, most in (((), MAX_NEWTON_CORRECTIONS), (("-DPKM_ATTEMPTS=1",), MAX_ITERATIONS)):
        program = counted.build(*PLAIN, *flags)
        turns = [watched(program, q, number, "1")[0] for q in wild(robot, rng, 40)]
        assert 3 <= max(turns) <= most
        assert flags or max(turns) > 100


def test_what_is_not_finite_has_status_2(exported):
    robot, package = exported
    check_not_finite(robot, package, package.build(*PLAIN))


def check_not_finite(robot, package, program):
    """Check that each function rejects NaN and infinity in each of its inputs."""
    motion = random_motion(robot, np.random.default_rng(6), 1)
    for name, rows in inputs_of(robot, motion).items():
        for k, row in enumerate(rows):
            for bad in (np.nan, np.inf, -np.inf):
                given = [np.repeat(one, row.size, 0) for one in rows]
                np.fill_diagonal(given[k], bad)
                status, found = package.run(program, name, *given)
                assert (status == 2.0).all(), (name, k, bad)
                assert np.isnan(found).all()


WITHOUT_NAN = (
    "-fno-honor-nans",
    "-fno-honor-infinities",
    "-ffinite-math-only",
    "-ffast-math",
    "-Ofast",
    "-ffast-math -fno-finite-math-only",
    "-ffast-math -fhonor-infinities",
    "-funsafe-math-optimizations",
    "-ffp-model=fast",
    "-ffp-model=aggressive",
    "-fp-model=fast=2",
    "-Xclang -menable-no-nans",
)
"""Flags of gcc, clang and icx under which a comparison with NaN may be dropped."""


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("level", partly_long(("-O1", "-O2", "-O3"), "-O1"))
def test_flags_that_ignore_nan_do_not_compile_or_change_no_status(small, compiler, level, rng):
    robot, package = small
    q = wild(robot, rng, 200)
    good = robot.try_forward(q)[1]
    judged = 0
    for flags in WITHOUT_NAN:
        try:
            program = package.build(level, "-w", *flags.split(), compiler=compiler)
        except AssertionError:
            continue
        judged += 1
        check_not_finite(robot, package, program)
        status, found = package.run(program, "forward", q)
        np.testing.assert_array_equal(status == 0.0, good, flags)
        assert np.isnan(found[~good]).all() and np.isfinite(found[good]).all(), flags
    assert judged >= 2


@pytest.mark.parametrize("name", partly_long(NAMES, "five_bar", "bolted"))
def test_nothing_undefined_happens(name, tmp_path):
    """In states of all kinds, under the sanitizers of addresses and undefined behaviour."""
    robot = robot_of(name)
    package = Package(tmp_path, c_package(robot))
    program = package.build(*PLAIN, *SANITIZED)
    rng = np.random.default_rng(7)
    home = robot.graph.home
    far = [size * wild(robot, rng, 5) for size in (1.0, 4.0, 1e3, 1e12, 1e300)]
    q = np.concatenate([random_joints(robot, rng, 5), [home, np.nan * home], *far])
    ones = np.ones_like(q)
    for name, rows in inputs_of(robot, (q, ones, ones, np.ones((len(q), 6)))).items():
        if name == "inverse":
            rows = (np.concatenate([rows[0], 10.0 * np.nan_to_num(rows[0]), q[:, : rows[0].shape[1]]]),)
        status, found = package.run(program, name, *rows)
        assert np.isnan(found[status != 0.0]).all()
        assert np.isfinite(found[status == 0.0]).all()


@blocking
@pytest.mark.parametrize("name", partly_long(NAMES, "bolted"))
def test_no_call_allocates_or_locks(name, watcher, tmp_path, rng):
    """In 200,000 calls with valid, impossible and infinite inputs; one that is spoilt is seen."""
    robot = robot_of(name)
    package = Package(tmp_path, c_package(robot))
    asked = functions(robot)
    count = 200_000 // len(asked) + 1
    q = np.concatenate([random_joints(robot, rng, count // 2), wild(robot, rng, count)])[:count]
    q[::97] = np.inf
    given = inputs_of(robot, (q, q, q, np.ones((count, 6))))
    call, source = r"status = \(double\)[^;]*", f"{package.prefix}.c"
    program = hooked(tmp_path, call, "driver.c", source, watcher=watcher)
    total = 0
    for name in asked:
        rows = np.ascontiguousarray(np.concatenate(given[name], 1))
        number = str(list(package.heads).index(name))
        calls, seen = watched(program, rows, number, str(count))
        assert seen == 0, name
        total += calls
    assert total >= 200_000
    driver = (tmp_path / "driver.c").read_text().replace("status =", "free(malloc(8)), status =")
    (tmp_path / "driver.c").write_text(driver)
    spoilt = hooked(tmp_path, rf"free.*{call}", "driver.c", source, watcher=watcher)
    words = str(list(package.heads).index("forward")), "9"
    if watcher:
        with pytest.raises(subprocess.CalledProcessError):
            watched(spoilt, q, *words)
    else:
        assert watched(spoilt, q, *words) == (9, 18)


ANALYSED = """
#include <float.h>
#include "__fc_builtin.h"
#include "PREFIX.h"
#define FILL(x) for (i = 0; i < (int)(sizeof(x) / sizeof(double)); i++) \\
    { x[i] = Frama_C_double_interval(-DBL_MAX, DBL_MAX); }
int main(void)
{
    double q[JOINTS], qd[JOINTS], qdd[JOINTS], wrench[6], tau[JOINTS];
    int i;
    FILL(q) FILL(qd) FILL(qdd) FILL(wrench)
    return PREFIX_torques(q, qd, qdd, wrench, tau);
}
"""


@pytest.mark.long
@pytest.mark.skipif(not shutil.which("frama-c"), reason="there is no frama-c")
def test_torques_of_any_finite_input_do_nothing_undefined(small):
    """By abstract interpretation, over every number of Newton's corrections."""
    robot, package = small
    text = (package.folder / f"{package.prefix}.c").read_text()
    # The analysis bounds what is compared, not what fabs is asked for: the same in other words.
    text, found = re.subn(r"fabs\((x\[i\])\) < ([\d.]+)\)", r"\1 > -\2 && \1 < \2)", text)
    assert found == 2
    main = ANALYSED.replace("PREFIX", package.prefix).replace("JOINTS", str(robot.joints_count))
    (package.folder / "main.c").write_text(main)
    (spoilt, found) = re.subn(r"(i = 0; i <) 4;", r"\1= 4;", text)
    assert found
    for number, source in enumerate((text, spoilt)):
        (package.folder / "analysed.c").write_text(source)
        command = ["frama-c", "-eva", "-eva-precision", "1", "-warn-special-float", "none"]
        command += [f"-cpp-extra-args=-I{package.folder}"]
        command += [package.folder / "main.c", package.folder / "analysed.c"]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        assert "100% of the logical properties" in done.stdout
        assert ("\n  0 alarms generated" in done.stdout) == (number == 0), done.stdout


STREAM = r"""
#include <stdio.h>
#include "@.h"
int main(void)
{
    double row[3 * JOINTS + 6 + STATE], state[STATE] = {0.0}, tau[JOINTS], status;
    double *const last = row + 3 * JOINTS + 6;
    while (fread(row, sizeof row, 1, stdin) == 1) {
        int k;
        /* What a caller has spoilt. */
        for (k = 0; k < STATE; k++) { state[k] += last[k]; }
        status = @_torques_next(state, row, row + JOINTS, row + 2 * JOINTS, row + 3 * JOINTS, tau);
        fwrite(&status, sizeof status, 1, stdout);
        fwrite(tau, sizeof tau, 1, stdout);
        fwrite(state, sizeof state, 1, stdout);
    }
    return 0;
}
"""


def state_size(package):
    return int(re.search(r"_STATE (\d+)", package.header).group(1))


def write_stream(package, joints):
    text = STREAM.replace("@", package.prefix).replace("STATE", str(state_size(package)))
    (package.folder / "stream.c").write_text(text.replace("JOINTS", str(joints)))


def test_a_stream_has_the_results_of_its_samples(exported, rng):
    """Smooth, then with jumps, without an assembly, not finite, and with a spoilt state."""
    robot, package = exported
    n = robot.joints_count
    size = state_size(package)
    write_stream(package, n)
    sources = f"{package.prefix}.c", "stream.c"
    compile_in(package.folder, COMPILERS[0], "-std=c99", *PLAIN, *sources, "-o", "stream", "-lm")
    middle, half = joint_range(robot)
    time, pace = np.arange(0.0, 0.6, 1e-3)[:, None], rng.uniform(1.0, 4.0, n)
    q = middle + 0.3 * half * np.sin(pace * time)
    qd = 0.3 * half * pace * np.cos(pace * time)
    rows = np.hstack([q, qd, -(pace**2) * (q - middle), rng.normal(size=(len(q), 6))])
    rows = np.hstack([rows, np.zeros((len(q), size))])
    rows[200:400:3, :n] = wild(robot, rng, 67)
    rows[410, rng.integers(0, 3 * n + 6)] = np.nan
    rows[430:600:7, 3 * n + 6 :] = rng.normal(size=(25, size)) * 10.0 ** rng.integers(-9, 9, (25, 1))
    done = subprocess.run(["./stream"], cwd=package.folder, input=rows.tobytes(), capture_output=True, check=True)
    found = np.frombuffer(done.stdout).reshape(len(rows), 1 + n + size)
    status, tau, state = found[:, 0], found[:, 1 : 1 + n], found[:, 1 + n :]
    good = robot.try_forward(rows[:, :n])[1] & np.isfinite(rows).all(1)
    np.testing.assert_array_equal(status == 0.0, good)
    assert np.isnan(found[~good, 1:]).all() and np.isfinite(found[good]).all()
    given = np.split(rows[good, : 3 * n + 6], (n, 2 * n, 3 * n), 1)
    right = inverse_dynamics(robot, *given)
    clear = robot.singularity(given[0]) > 0.1
    assert np.abs(tau[good] - right)[clear].max() <= 1e-12 * np.abs(right[clear]).max()
    if size > 1:
        # Where the closures were solved from home last.
        assert (state[1:200, 1 : 1 + n] == state[:199, 1 : 1 + n]).all(1).mean() > 0.5


@blocking
def test_a_stream_allocates_and_locks_nothing(small, watcher, rng):
    robot, package = small
    write_stream(package, robot.joints_count)
    program = hooked(package.folder, r"status = [^;]*", "stream.c", f"{package.prefix}.c", watcher=watcher)
    rows = rng.normal(0.0, 0.3, (200_000, 3 * robot.joints_count + 6 + state_size(package)))
    assert watched(program, rows) == (len(rows), 0)


LANGUAGES = (
    "-std=c99 -fsyntax-only",
    "-x c++ -std=c++17 -fsyntax-only",
    "-std=c99 -O1",
    "-std=c99 -O2 -mfma",
)


@pytest.mark.parametrize("compiler", COMPILERS)
def test_arctangents_are_those_of_numpy(compiler, tmp_path, rng):
    """Within two units of rounding in all quadrants, on the axes, and on both sides of a zero."""
    pairs = 10.0 ** rng.uniform(-150, 150, (4000, 2)) * rng.choice([-1.0, 1.0], (4000, 2))
    pairs[:2000] = rng.normal(size=(2000, 2))
    special = [-1e300, -1.0, -0.0, 0.0, 5e-324, 1.0]
    pairs = np.concatenate([pairs, [[y, x] for y in special for x in special]])
    call = "double at(double y, double x) { return pkm_atan2(y, x); }\n"
    (tmp_path / "at.c").write_text(C_HEAD + ARCTANGENT_C.replace("@", "pkm") + call)
    compile_in(tmp_path, compiler, "-O3", *STRICT, "-shared", "-fPIC", "at.c", "-o", "at.so", "-lm")
    at = ctypes.CDLL(str(tmp_path / "at.so")).at
    at.restype, at.argtypes = ctypes.c_double, [ctypes.c_double] * 2
    found, expected = np.array([at(*pair) for pair in pairs]), np.arctan2(*pairs.T)
    np.testing.assert_allclose(found, expected, rtol=5e-16, atol=0.0)
    assert (np.signbit(found) == np.signbit(expected)).all()
    assert np.isnan([at(np.nan, 1.0), at(1.0, np.nan)]).all()


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("language", partly_long(LANGUAGES, *LANGUAGES[:2]))
def test_compilers_warn_of_nothing(exported, compiler, language):
    """Optimisation finds more: what is not initialised, or never read."""
    _, package = exported
    for name in (f"{package.prefix}.c", "example.c"):
        compile_in(package.folder, compiler, *language.split(), *STRICT, "-c", name, "-o", os.devnull)
