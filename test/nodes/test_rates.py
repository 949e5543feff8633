# SPDX-License-Identifier: Apache-2.0
"""Positions and velocities of a stream that agree, and such that do not."""

import numpy as np
import pytest

from delta_dynamics.feedforward import Feedforward
from delta_dynamics.settings import Settings
from pkm_twin.streams.rates import RateAgreement
from test.nodes.harness import SECOND
from test.support.robots import load

ROBOTS = ("delta_cu", "five_bar", "stewart")


def motion(rng, robot, t):
    """A random smooth motion of all joints about zero: positions and rates, shape (k, n) each."""
    units = np.array([1.0 if unit == "rad" else robot.size for unit in robot.joint_units])
    turns = 2.0 * np.pi * rng.uniform(0.3, 2.0, (4, 1, robot.joints_count))
    phase, reach = rng.uniform(0.0, 2.0 * np.pi, turns.shape), 0.05 * units
    angle = turns * t[:, None] + phase
    return (reach * np.sin(angle)).sum(0), (reach * turns * np.cos(angle)).sum(0)


def faults(robot, stamps, q, qd):
    """What is said after each sample."""
    agreement, found = RateAgreement(robot), []
    for stamp, place, rate in zip(stamps.tolist(), q, qd, strict=True):
        agreement.push(stamp, place, rate)
        found.append(agreement.fault)
    return found


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("rate", [50.0, 200.0, 1000.0])
def test_a_true_motion_agrees_and_one_of_a_wrong_scale_does_not(rng, name, rate):
    """With jitter, lost samples, noise and velocities that are 10 ms late."""
    robot = load(name)
    t = np.arange(0.0, 4.0, 1.0 / rate)
    t = (t + rng.uniform(0.0, 0.5 / rate, len(t)))[rng.uniform(size=len(t)) > 0.05]
    stamps = np.round(1e9 * t).astype(np.int64) + SECOND
    seed = int(rng.integers(2**31))
    q, _ = motion(np.random.default_rng(seed), robot, t)
    _, late = motion(np.random.default_rng(seed), robot, t - 0.01)
    q = q + 1e-5 * rng.normal(size=q.shape)
    qd = late + 1e-2 * np.abs(late).max(0) * rng.normal(size=q.shape)
    assert set(faults(robot, stamps, q, qd)) == {""}
    for j in range(robot.joints_count):
        for factor in (0.05, 0.0, -1.0, 57.3):
            wrong = np.where(np.arange(robot.joints_count) == j, factor, 1.0)
            for found in (
                faults(robot, stamps, wrong * q, qd),
                faults(robot, stamps, q, wrong * qd),
            ):
                assert all(text.startswith(robot.joint_names[j]) for text in found[-len(t) // 4 :])


def test_noise_at_rest_says_nothing(rng):
    robot = load("delta_cu")
    stamps = SECOND + np.arange(3000) * SECOND // 1000
    noise = rng.normal(size=(3000, 3))
    assert set(faults(robot, stamps, 1e-5 * noise, 0.05 * noise)) == {""}


def test_the_stream_of_the_node_is_judged(make):
    """Positions scaled by 0.05 with true velocities pass every limit."""
    robot = load("delta_cu")
    for factor in (1.0, 0.05):
        core = Feedforward(robot, Settings())
        for i in range(2000):
            t, stamp = 1e-3 * i, SECOND + i * SECOND // 1000
            q = factor * 0.2 * np.sin(5.0 * t) * np.ones(3)
            qd = np.cos(5.0 * t) * np.ones(3)
            core.joint_state(make.joint_state(robot.joint_names, q, qd, stamp=stamp), stamp)
        assert core.stream.rejected.total() == 0
        assert bool(core.rates.fault) == (factor != 1.0)
