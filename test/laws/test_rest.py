# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Joints at rest are known as such by the noise of their rates, and rub in no direction there."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from delta_dynamics.feedforward import Feedforward, Settings
from delta_dynamics.torques.stiction import beyond_friction, friction_reach, zero_resting_rates
from pkm_twin import Robot
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import PkmTwinError
from pkm_twin.paths.along import tabulate_torques
from pkm_twin.recordings import ReadOptions, Recording, read
from pkm_twin.streams.differentiator import Differentiator
from pkm_twin.streams.noise import NoiseEstimator, estimate_noise
from pkm_twin.streams.rest import VelocityErrorEstimator, gradient_gain, velocity_error_bound
from test.laws.recordings import smooth_motion
from test.nodes.harness import SECOND, Maker, Plain
from test.support.robots import SHIPPED, joint_range, load, loaded_like, partly_long

MAKE = Maker(Plain())
NOW = 1_000 * SECOND
RUBBING = ["linear_delta", "five_bar"]


def stops_and_goes(rng: np.random.Generator, time: Array, joints: int) -> tuple[Array, Array]:
    """Positions and true rates (k, n): rests between moves of third to fifth order, 0.1 to 1 s."""
    q, qd = np.zeros((2, len(time), joints))
    for j in range(joints):
        at = rng.uniform(0.1, 0.3)
        while at < time[-1]:
            seconds, size = rng.uniform(0.1, 1.0), rng.normal()
            x = np.clip((time - at) / seconds, 0.0, 1.0)
            inside = (x > 0.0) & (x < 1.0)
            power = rng.integers(3, 6)
            # From rest by t^power to rest, its mirror image behind the middle.
            low = 2.0 ** (power - 1) * x**power
            high = 1.0 - 2.0 ** (power - 1) * (1.0 - x) ** power
            q[:, j] += size * np.where(x < 0.5, low, high)
            slope = np.where(x < 0.5, x, 1.0 - x) ** (power - 1)
            qd[:, j] += inside * size * power * 2.0 ** (power - 1) * slope / seconds
            at += seconds + rng.uniform(0.0, 0.3)
    return q, qd


def uneven(rng: np.random.Generator, count: int, period: float, jitter: float) -> Array:
    return period * (np.arange(count) + jitter * rng.uniform(-0.5, 0.5, count))


@pytest.mark.parametrize("jitter", [0.0, 0.5])
def test_the_noise_is_that_which_was_added_whatever_the_motion(jitter: float) -> None:
    rng = np.random.default_rng(1)
    time = uneven(rng, 3000, 2e-3, jitter)
    q = np.stack([np.sin(7.0 * time), time**3, 0.0 * time], -1)
    assert estimate_noise(time, q).max() < 1e-12
    size = np.array([1e-5, 1e-3, 0.1])
    found = estimate_noise(time, q + size * rng.normal(size=q.shape))
    np.testing.assert_allclose(found, size, rtol=0.1)
    assert (estimate_noise(time[:6], q[:6]) == 0.0).all()


@pytest.mark.parametrize("jitter", [0.0, 0.5])
def test_a_stream_has_the_noise_of_its_last_samples(jitter: float) -> None:
    rng = np.random.default_rng(7)
    time = np.round(1e9 * uneven(rng, 60, 2e-3, jitter)).astype(int)
    values = np.sin(np.arange(60.0) / 3.0)[:, None] + np.array([1.0, 1e-3, 0.0]) * rng.normal(size=(60, 3))
    stream = NoiseEstimator()
    for k in range(60):
        stream.push(int(time[k]) + 1, [1e6, 0.0, float(k)])
        stream.retract()
        found = stream.push(int(time[k]), values[k].tolist())
        last = slice(max(0, k - 20), k + 1)
        expected = estimate_noise(1e-9 * (time[last] - time[last][0]), values[last])
        np.testing.assert_allclose(found or np.zeros(3), expected, rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize("jitter", [0.0, 0.3])
@pytest.mark.parametrize("size", [0.0, 1e-6, 1e-4])
def test_a_rate_beyond_its_doubt_has_the_true_sign(jitter: float, size: float) -> None:
    """Differentiated offline, as tables and trajectories are."""
    rng = np.random.default_rng(2)
    time = uneven(rng, 1500, 4e-3, jitter)
    q, true = stops_and_goes(rng, time, 6)
    seen = q + size * rng.normal(size=q.shape)
    rate = np.gradient(seen, time, axis=0, edge_order=2)
    rate_error = velocity_error_bound(time, seen, gradient_gain(time))
    beyond = np.abs(rate) > rate_error
    wrong = beyond & (np.sign(rate) != np.sign(true))
    # At rest a few in ten thousand are beyond four standard deviations.
    assert wrong.mean() < (1e-3 if size else 1e-4)
    # What moves is known to move.
    fast = np.abs(true) > 0.05 + 40.0 * size / 4e-3
    assert beyond[fast].mean() > 0.99
    plain = np.sign(rate) != np.sign(true)
    assert size == 0.0 or plain.mean() > 0.1


@pytest.mark.parametrize("measured", [True, False])
@pytest.mark.parametrize("size", [0.0, 1e-5])
def test_a_streams_rate_beyond_its_doubt_has_the_true_sign(measured: bool, size: float) -> None:
    rng = np.random.default_rng(3)
    period, order, window = 2e-3, 2, 15
    time = np.arange(1200) * period
    q, true = stops_and_goes(rng, time, 3)
    seen = q + size * rng.normal(size=q.shape)
    speeds = true + 100.0 * size * rng.normal(size=q.shape)
    differentiator = Differentiator(order, window)
    watch = VelocityErrorEstimator(differentiator.slope_gain())
    wrong, known = [], []
    for k, t in enumerate((SECOND * time).round().astype(int).tolist()):
        qd = speeds[k] if measured else None
        rates = differentiator.push(t, seen[k], qd)
        rate_error = watch.push(t, seen[k], qd, None if rates is None else rates[0])
        if rates is not None and k > 30:
            beyond = np.abs(rates[0]) > rate_error
            wrong.append(beyond & (np.sign(rates[0]) != np.sign(true[k])))
            known.append(beyond[np.abs(true[k]) > 0.1])
    assert np.mean(wrong) < (1e-2 if size else 1e-3)
    assert np.mean(np.concatenate(known)) > 0.97


def test_a_sample_that_is_taken_back_leaves_nothing_behind() -> None:
    rng = np.random.default_rng(4)
    one, other = VelocityErrorEstimator(100.0), VelocityErrorEstimator(100.0)
    for k in range(40):
        q = rng.normal(size=2)
        other.push(1000 * (k * 1000) + 500, 1e3 * q, None, q)
        other.retract()
        a, b = (w.push(1_000_000 * k, q, None, q) for w in (one, other))
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("name", partly_long(sorted(SHIPPED), "five_bar", "linear_delta", "rps3"))
def test_the_reach_of_friction_is_the_files(name: str) -> None:
    robot = load(name)
    np.testing.assert_allclose(friction_reach(robot)[robot.friction.coulomb == 0.0], 0.0, atol=0.0)
    rubbing = loaded_like(robot)
    reach, own = friction_reach(rubbing), rubbing.friction.coulomb
    passive = friction_reach(rubbing.changed(friction={"coulomb": [0.0] * len(own)}))
    np.testing.assert_allclose(reach, own + passive, rtol=1e-6)


def test_friction_at_rest_explains_its_reach_and_no_more() -> None:
    still, reach = np.array([True, True, False]), np.array([1.0, 0.0, 1.0])
    np.testing.assert_array_equal(zero_resting_rates(np.array([0.1, 0.1, 0.1]), still, reach), [0.0, 0.1, 0.1])
    left = beyond_friction(np.array([[0.5, 0.5, 0.5], [-3.0, -3.0, -3.0]]), still, reach)
    np.testing.assert_array_equal(left, [[0.0, 0.5, 0.5], [-2.0, -3.0, -3.0]])


def moves(robot: Robot, time: Array) -> Array:
    """From rest at 0.1 s to rest, each joint its own way, some downwards."""
    middle, half = joint_range(robot)
    home = robot.inverse(robot.home())
    x = np.clip((time - 0.1) / 0.8, 0.0, 1.0)[:, None]
    way = 0.5 * half * np.where(np.arange(len(half)) % 2, 1.0, -1.0)
    return home + np.clip(way, -0.8 * half - home + middle, 0.8 * half - home + middle) * (
        x**3 * (10.0 + x * (6.0 * x - 15.0))
    )


@pytest.mark.parametrize("size", [0.0, 1e-6])
@pytest.mark.parametrize("name", RUBBING)
def test_a_table_of_positions_rubs_in_no_wrong_direction(tmp_path: Path, name: str, size: float) -> None:
    robot = load(name)
    time = np.arange(0.1, 1.1, 0.01)
    true = moves(robot, time)
    q = true + size * np.random.default_rng(5).normal(size=true.shape)
    path = tmp_path / "motion.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time", *(f"{joint}.position" for joint in robot.joint_names)])
        writer.writerows(np.column_stack([time, q]).tolist())
    found = tabulate_torques(read(path, name, ReadOptions(planned=True)).with_rates())
    way, coulomb = np.sign(true[-1] - true[0]), robot.friction.coulomb
    for k, joint in enumerate(robot.joint_names):
        rubs = found[f"{joint}.effort_friction"]
        assert (way[k] * rubs >= 0.0).all()
        # All of the way but for its ends, and nothing behind its end.
        assert (way[k] * rubs[8:72] >= coulomb[k]).all()
        assert (rubs[84:] == 0.0).all()


@pytest.mark.parametrize("name", RUBBING)
def test_a_trajectory_of_positions_likewise(name: str) -> None:
    robot = load(name)
    time = np.arange(0.1, 1.1, 0.01)
    q = moves(robot, time)
    message = MAKE.trajectory(robot.joint_names, [round(t * SECOND) for t in time], q.tolist(), stamp=NOW)
    efforts = Feedforward(robot, Settings(differentiate=True)).trajectory(message, NOW)
    qd = np.gradient(q, time, axis=0, edge_order=2)
    smooth = robot.changed(friction={"coulomb": [0.0] * robot.joints_count})
    rubs = efforts - inverse_dynamics(smooth, q, qd, np.gradient(qd, time, axis=0, edge_order=2))
    assert (np.sign(q[-1] - q[0]) * rubs >= -0.2 * robot.friction.coulomb).all()


@pytest.mark.parametrize("measured", [True, False])
@pytest.mark.parametrize("name", RUBBING)
def test_the_noise_of_a_machine_at_rest_makes_no_friction(name: str, measured: bool) -> None:
    robot, rng = load(name), np.random.default_rng(6)
    core = Feedforward(robot, Settings(differentiate=True, window=9))
    home, efforts = robot.inverse(robot.home()), []
    for k in range(400):
        q = home + 1e-6 * rng.normal(size=len(home))
        qd = 1e-3 * rng.normal(size=len(home)) if measured else ()
        now = NOW + 2_000_000 * k
        found = core.joint_state(MAKE.joint_state(robot.joint_names, q, qd, stamp=now), now)
        if found is not None:
            efforts.append(found.effort)
    still = np.zeros(len(home))
    held = inverse_dynamics(robot, home, still, still)
    rubs = np.abs(np.array(efforts)[20:] - held) > 0.8 * robot.friction.coulomb
    # Four standard deviations, of an estimate of some samples.
    assert rubs.mean() < 0.02


def test_velocities_that_contradict_the_positions_are_rejected():
    robot = load("delta")
    time, q, qd, qdd = smooth_motion(robot, np.random.default_rng(1), 4.0, 100.0)
    for change in (None, qdd):
        for scale in (1.0, 1.1):
            motion = Recording(robot, time, q, scale * qd, change).with_rates()
            np.testing.assert_array_equal(motion.qd, scale * qd)
        for scale in (-1.0, 0.0, 57.3):
            with pytest.raises(PkmTwinError, match=r"\d %"):
                Recording(robot, time, q, scale * qd, change).with_rates()
    for scale in (1.2, 0.7):
        motion = Recording(robot, time, q, qd, scale * qdd).with_rates()
        np.testing.assert_array_equal(motion.qdd, scale * qdd)
    for scale in (-1.0, 0.0, 57.3, 1e3, 1e-3):
        with pytest.raises(PkmTwinError, match=r"accelerations .*\d %"):
            Recording(robot, time, q, qd, scale * qdd).with_rates()


@pytest.mark.parametrize("factor", [1e-6, 1e-3, 1 / 60, 60.0, 1e3, 1e6])
@pytest.mark.parametrize("count", [4, 5, 9, 12, 100])
@pytest.mark.parametrize("rate", [20.0, 1000.0])
def test_times_in_another_unit_than_the_velocities_are_rejected_with_the_factor(factor, count, rate):
    robot = load("delta")
    time, q, qd, qdd = (values[:count] for values in smooth_motion(robot, np.random.default_rng(1), 6.0, rate))
    Recording(robot, time, q, qd, qdd).check_rates()
    for change in (None, qdd):
        with pytest.raises(PkmTwinError) as error:
            Recording(robot, factor * time, q, qd, change).with_rates()
        found = re.search(r"\(([\d.e+-]+) times the rate of the position", str(error.value))
        assert found is not None and abs(float(found[1]) / factor - 1.0) < 0.05


@pytest.mark.parametrize("rates", [True, False])
def test_a_gap_while_joints_move_is_noted(rates):
    robot = load("delta")
    time, q, qd, qdd = smooth_motion(robot, np.random.default_rng(1), 4.0, 100.0)
    known = (qd, qdd) if rates else (None, None)
    assert not Recording(robot, time, q, *known).with_rates().notes
    later = time + 10.0 * (np.arange(len(time)) >= 200)
    (note,) = Recording(robot, later, q, *known).with_rates().notes
    assert f"from {time[199]:.6g} to {later[200]:.6g} s" in note


@pytest.mark.parametrize("turn", [0.1, 0.5, 1.0, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("count", [12, 30, 200])
def test_what_few_samples_a_turn_explain_is_no_contradiction(turn, count):
    """Exact velocities of sines, sampled down to twice a period; states in no order."""
    robot, time = load("delta"), 0.02 * np.arange(count)
    angle = turn * np.arange(count)[:, None] + np.arange(3.0)
    q, qd = 0.3 * np.sin(angle), 0.3 * turn / 0.02 * np.cos(angle)
    some = np.random.default_rng(count).permutation(count)
    for rows in (np.arange(count), some):
        motion = Recording(robot, time, q[rows], qd[rows]).with_rates()
        np.testing.assert_array_equal(motion.qd, qd[rows])
