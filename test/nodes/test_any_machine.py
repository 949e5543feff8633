# SPDX-License-Identifier: Apache-2.0
"""The nodes' cores on machines with one to six joints."""

import itertools

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from delta_dynamics.feedforward import Feedforward, Settings
from test.nodes.harness import REPOSITORY, SECOND, Maker, Plain
from test.support.robots import load, partly_long

NOW = 1_000 * SECOND
STEP = SECOND // 1000
WINDOW = 5
MAKE = Maker(Plain())
MACHINES = REPOSITORY / "test" / "machine" / "machines"
JOINTS = {
    MACHINES / "slider_crank.yaml": 1,
    "five_bar": 2,
    "linear_delta": 3,
    REPOSITORY / "examples/machines/rrr3_planar.yaml": 3,
    "upr_rpu": 3,
    "stewart": 6,
}


KEPT = (MACHINES / "slider_crank.yaml", "five_bar", "linear_delta", "stewart")


@pytest.fixture(
    scope="module",
    params=partly_long(JOINTS, *KEPT),
    ids=lambda name: getattr(name, "stem", name),
)
def robot(request):
    robot = load(request.param)
    assert len(robot.joint_names) == JOINTS[request.param]
    return robot


def motion(robot, t):
    """A slow motion about home: q, qd, qdd."""
    n = len(robot.joint_names)
    size = 0.01 * np.arange(1, n + 1) / n
    rates = np.linspace(2.0, 3.0, n)
    home = robot.inverse(robot.home())
    return (
        home + size * np.sin(rates * t),
        size * rates * np.cos(rates * t),
        -size * rates**2 * np.sin(rates * t),
    )


@pytest.mark.parametrize("rates", [True, False])
def test_streams(robot, rates):
    core = Feedforward(robot, Settings(differentiate=True, window=WINDOW, order=3 if rates else 2))
    for i in range(20):
        q, qd, qdd = motion(robot, i / 1000)
        message = MAKE.joint_state(robot.joint_names, q, qd if rates else (), stamp=NOW + i * STEP)
        result = core.joint_state(message, NOW + i * STEP)
        assert (result is None) == (i < WINDOW - 1)
    exact = inverse_dynamics(robot, q, qd, qdd)
    assert result.effort.shape == exact.shape == (len(robot.joint_names),)
    # What a polynomial through milliseconds leaves of a slow wave, and of its rounding.
    scale = np.abs(exact).max() + 1.0
    assert np.abs(result.effort - exact).max() < 1e-3 * scale
    assert core.singularity() == pytest.approx(float(robot.singularity(q)))


def test_trajectories_in_any_order(robot):
    times = np.arange(600) * 0.002
    q, qd, qdd = (np.array(v) for v in zip(*(motion(robot, t) for t in times), strict=True))
    stamps = [round(t * SECOND) for t in times]
    exact = inverse_dynamics(robot, q, qd, qdd)
    orders = itertools.islice(itertools.permutations(range(q.shape[1])), 3)
    for order in map(list, orders):
        names = [robot.joint_names[i] for i in order]
        message = MAKE.trajectory(names, stamps, q[:, order], qd[:, order], qdd[:, order])
        efforts = Feedforward(robot).trajectory(message, NOW)
        assert np.abs(efforts - exact[:, order]).max() <= 1e-12 * (1.0 + np.abs(exact).max())


def test_a_stop_sends_a_value_a_joint(robot):
    core = Feedforward(robot, Settings(on_stop="gravity", window=WINDOW))
    n = len(robot.joint_names)
    assert core.stop_effort().tolist() == [0.0] * n
    for i in range(WINDOW):
        q, qd, _ = motion(robot, i / 1000)
        core.joint_state(
            MAKE.joint_state(robot.joint_names, q, qd, stamp=NOW + i * STEP), NOW + i * STEP
        )
    assert np.allclose(core.stop_effort(), inverse_dynamics(robot, q, np.zeros(n), np.zeros(n)))
