# SPDX-License-Identifier: Apache-2.0
"""A load found from efforts: on loads that are known, and on the recording of a pick."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from delta_dynamics import PayloadEstimator, inverse_dynamics
from pkm_twin import Robot
from pkm_twin.apps.check import motion
from pkm_twin.apps.recorded import read_recording
from test.support.robots import joint_range, load

Array = NDArray[np.float64]

BAGS = Path(__file__).resolve().parents[2] / "bags"
PERIOD = 4e-3


def moved(robot: Robot, seconds: float) -> tuple[Array, Array, Array, Array]:
    """Times and a motion that excites every axis."""
    middle, half = joint_range(robot)
    times = np.arange(0.0, seconds, PERIOD)
    w = 4.0 + 0.9 * np.arange(len(middle))
    angle = w * times[:, None] + np.arange(len(middle))
    reach = 0.4 * half
    return (
        times, middle + reach * np.sin(angle), reach * w * np.cos(angle),
        -reach * w**2 * np.sin(angle),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "feels"), [("stewart", True), ("rps3", True), ("delta_cu", False)]
)
def test_a_load_is_found_with_what_the_machine_feels_of_it(name: str, feels: bool) -> None:
    """A platform that tilts feels the centre too, three translations the mass alone."""
    robot = load(name).changed(payload={"mass": 0.0})
    mass, com = 1.3, np.array([0.03, -0.02, 0.05])
    laden = robot.changed(payload={"mass": mass, "com": com.tolist()})
    time, q, qd, qdd = moved(robot, 3.0)
    effort = inverse_dynamics(laden, q, qd, qdd)
    rng = np.random.default_rng(5)
    effort = effort + 1e-3 * np.abs(effort).max(0) * rng.normal(size=effort.shape)
    estimator = PayloadEstimator(robot)
    for sample in zip(time, q, qd, qdd, effort, strict=True):
        found = estimator.push(*sample)
    assert found is not None
    assert abs(found.mass - mass) < max(0.01 * mass, 4.0 * found.mass_deviation)
    assert found.mass_deviation < 0.05 * mass
    assert (np.isfinite(found.com_deviation) == feels).all()
    error = np.abs(found.com - com)
    if feels:
        assert np.all(error < np.maximum(2e-3, 4.0 * found.com_deviation))
        assert np.all(found.com_deviation < 0.01)
    else:
        # What is not felt is the robot's own.
        np.testing.assert_array_equal(found.com, robot.payload.com)


def test_a_pick_is_seen_and_weighed_within_a_second() -> None:
    """The recorded load of 0.15 kg comes at 8.275 s and goes at 14.875 s."""
    r = read_recording(BAGS / "delta_cu_pick_and_place.mcap")
    assert r.effort is not None
    qd, qdd, used = motion(r)
    near = used & (r.time > 6.5) & (r.time < 9.3)
    estimator = PayloadEstimator(r.robot)
    told = []
    for k in np.flatnonzero(near)[::4]:
        found = estimator.push(float(r.time[k]), r.q[k], qd[k], qdd[k], r.effort[k])
        if found is not None:
            told.append((r.time[k], found.mass, found.resets))
    time, mass, resets = np.array(told).T
    # Nothing jumps before the pick, and nothing but the pick.
    assert resets[time < 8.275].max() == 0
    assert resets[-1] == 1
    assert np.abs(mass[(time > 7.2) & (time < 8.275)]).max() < 0.005
    later = (time > 8.275 + 0.6) & (time < 9.3)
    np.testing.assert_allclose(mass[later], 0.15, rtol=0.03)


def test_a_reset_forgets_the_load_alone() -> None:
    robot = load("delta_cu")
    time, q, qd, qdd = moved(robot, 0.5)
    effort = inverse_dynamics(robot.changed(payload={"mass": 1.0}), q, qd, qdd)
    estimator = PayloadEstimator(robot)
    for sample in zip(time, q, qd, qdd, effort, strict=True):
        estimator.push(*sample)
    assert estimator.estimate().mass == pytest.approx(1.0, rel=0.01)
    estimator.reset()
    found = estimator.estimate()
    assert found.mass == pytest.approx(0.0, abs=1e-9)
    assert found.mass_deviation > 1.0
    assert estimator.push(10.0, q[0], qd[0], qdd[0], effort[0]) is None


def test_a_stream_four_times_as_fast_is_not_surer() -> None:
    """Errors last for a while: samples closer together than that share one and the same."""
    robot = load("stewart").changed(payload={"mass": 0.0})
    laden = robot.changed(payload={"mass": 1.3, "com": [0.03, -0.02, 0.05]})
    time, q, qd, qdd = moved(robot, 2.0)
    effort = inverse_dynamics(laden, q, qd, qdd)
    found = []
    for step in (1, 4):
        estimator = PayloadEstimator(robot)
        rows = (array[::step] for array in (time, q, qd, qdd, effort))
        for sample in zip(*rows, strict=True):
            estimator.push(*sample)
        found.append(estimator.estimate().mass_deviation)
    assert found[0] == pytest.approx(found[1], rel=0.1)


def test_what_is_known_of_a_wrench_is_not_taken_for_a_load() -> None:
    robot = load("stewart").changed(payload={"mass": 0.0})
    laden = robot.changed(payload={"mass": 1.3})
    time, q, qd, qdd = moved(robot, 1.0)
    wrench = np.array([20.0, -10.0, 30.0, 1.0, 2.0, -1.0])
    effort = inverse_dynamics(laden, q, qd, qdd, wrench)
    masses = []
    for known in (wrench, None):
        estimator = PayloadEstimator(robot)
        for sample in zip(time, q, qd, qdd, effort, strict=True):
            estimator.push(*sample, known)
        masses.append(estimator.estimate().mass)
    assert masses[0] == pytest.approx(1.3, rel=0.01)
    assert abs(masses[1] - 1.3) > 1.0


def test_after_a_long_pause_a_load_is_as_unknown_as_any() -> None:
    """What fades away gives place to what is known of any load: it never is less than that."""
    robot = load("stewart").changed(payload={"mass": 0.0})
    time, q, qd, qdd = moved(robot, 0.5)
    effort = inverse_dynamics(robot, q, qd, qdd)
    estimator = PayloadEstimator(robot, mass_range=5.0, reach=0.2)
    for sample in zip(time, q, qd, qdd, effort, strict=True):
        estimator.push(*sample)
    surer = estimator.estimate()
    found = estimator.push(time[-1] + 1e4, q[-1], qd[-1], qdd[-1], effort[-1])
    assert found is not None
    assert surer.mass_deviation < found.mass_deviation <= 5.0
    assert abs(found.mass) < 0.1
