# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Pivots of the compiled equations that vanish in regular states: results are right or rejected."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics, inverse_dynamics_at_pose
from pkm_twin.codegen.lu import SparseLU
from pkm_twin.codegen.program import Program
from pkm_twin.errors import SingularityError, UnreachableError
from pkm_twin.kinematics.programs import solve_pose
from pkm_twin.mechanisms.catalogue import robot_of_data
from test.machine.random_machines import NAMES, variant
from test.support.robots import SHIPPED, joint_range, load, partly_long

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted(str(path) for path in ROOT.glob("examples/machines/*.yaml"))
ANKLE, PAR4 = str(ROOT / "test/benchmarks/ankle.yaml"), str(ROOT / "examples/machines/par4.yaml")
MACHINES = [*SHIPPED, *FILES, ANKLE, *(f"variant {name}" for name in NAMES)]
OFFSETS = 10.0 ** np.arange(-14, -3)
"""Distances from where a pivot vanishes, as fractions of the way between two states."""
STATES = 1500


def write_pivots(t, scheme=None):
    """Write the program of all pivots, from q or, of a machine driven by its pose, from the pose."""
    if scheme is None:
        t.solve()
        found, equations, inputs = [t.lu], t.equations(), t.inputs("q")
    else:
        t, _ = solve_pose(t, scheme)
        leads = scheme.machine.graph.leads
        drives = SparseLU(t.fast_rates_of_joints(leads), scheme.drive_pivots)
        found, equations, inputs = [t.lu, t.newton, drives], t.equations(), {"pose": len(t.q)}
    pivots = [1.0 / pivot for lu in found for pivot in lu.inverse_pivots.values()]
    return Program(inputs, 0, {"pivots": t.lift(pivots)}, equations)


def find_vanishing(evaluate, states, rng):
    """Yield states on both sides of a zero of each pivot that changes its sign: (2, n)."""
    values = evaluate(states)
    good = np.isfinite(values).all(1)
    states, values = states[good], values[good]
    for k, column in enumerate(values.T):
        sides = [np.flatnonzero(column < 0.0), np.flatnonzero(column > 0.0)]
        for _ in range(20 if all(map(len, sides)) else 0):
            pair = np.array([states[rng.choice(side)] for side in sides])
            for _ in range(60):
                middle = pair.mean(0)
                value = evaluate(middle[None])[0, k]
                pair[int(value > 0.0)] = middle
                if not np.isfinite(value):
                    break
            # Beyond another vanishing pivot the sign changes at a pole.
            if np.isfinite(value) and abs(value) < 1e-9 * np.median(np.abs(column)):
                yield pair.mean(0)
                break


def judge(robot, state, by_pose, rng):
    """Compare two ways to the torques near a state; return the largest difference, and rejections.

    Their equations have other unknowns, hence other pivots.
    """
    away = OFFSETS[:, None] * rng.normal(size=len(state))
    rate, change = rng.normal(size=(2, len(robot.pose_names)))
    worst, rejected = 0.0, 0
    for place in [state, *(state + away)]:
        try:
            pose = place if by_pose else robot.forward(place)
            q = robot.inverse(pose)
            found = inverse_dynamics_at_pose(robot, pose, rate, change)
            tau = inverse_dynamics(robot, q, found.qd, found.qdd)
        except SingularityError as error:
            assert "pivot" in str(error)
            rejected += 1
            continue
        except UnreachableError:
            continue
        worst = max(worst, float(np.abs(found.tau - tau).max() / np.abs(tau).max()))
    return worst, rejected


@pytest.mark.parametrize("name", partly_long(MACHINES, ANKLE))
def test_a_state_where_a_pivot_vanishes_is_right_or_rejected(name, rng):
    drawn = name.startswith("variant ")
    robot = robot_of_data(variant(name.split()[1], rng), "variant") if drawn else load(name)
    if robot.redundant or not robot.has_masses:
        pytest.skip("its states are not drawn joint by joint")
    engine, (middle, half) = robot.engine, joint_range(robot)
    q = middle + half * rng.uniform(-1.0, 1.0, (STATES, len(middle)))
    pose, good = robot.try_forward(q)
    kernels = [(engine.kernel("pivots", write_pivots), q[good], False)]
    if engine.posed is not None:
        kernels.append((engine.posed_kernel("pivots at pose", write_pivots), pose[good], True))
    found = np.zeros(2, int)
    for kernel, states, by_pose in kernels:
        for state in find_vanishing(lambda x, kernel=kernel: kernel(np.zeros(0), x)[0][0], states, rng):
            if by_pose and not robot.try_inverse(state)[1]:
                continue
            worst, rejected = judge(robot, state, by_pose, rng)
            assert worst < 1e-6
            found[int(by_pose)] += rejected
    assert found[1] > 0 or name not in (PAR4, ANKLE)
    assert found[0] > 0 or name != PAR4


@pytest.mark.parametrize("apart", [-1e-9, 1e-12, 1e-8, 1e-7])
def test_a_pose_at_a_singularity_is_that_of_forward_or_rejected(apart, rng):
    """Of the 2UPR-RPU, whose third limb's end is in the base there: the slide of its platform loses its pivot."""
    robot = load("upr_rpu")
    a, b = robot.geometry.platform_radius, robot.geometry.base_radius
    beta, gamma = rng.uniform(0.1, 1.4, 4000), rng.uniform(-0.3, 0.3, 4000)
    pose = np.stack([-a * np.sin(beta) - apart, beta, gamma], -1)
    q, good = robot.try_inverse(pose)
    back, known = robot.try_forward(q[good])
    assert known.all()
    np.testing.assert_allclose(back, pose[good], atol=1e-7)
    rate = rng.normal(size=3)
    for place, found in zip(pose[good][:20], q[good][:20], strict=True):
        z, beta, _ = place
        rho, along = z / np.cos(beta), b * np.cos(beta) - a
        across = b * np.sin(beta) + rho
        change = b * np.cos(beta) * rate[1] + rate[0] / np.cos(beta) + rho * np.tan(beta) * rate[1]
        wanted = (across * change - along * b * np.sin(beta) * rate[1]) / found[2]
        try:
            given = inverse_dynamics_at_pose(robot, place, rate, rate).qd[2]
        except SingularityError:
            continue
        assert given == pytest.approx(wanted, abs=1e-6)
