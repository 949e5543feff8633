# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A load found from efforts: on loads that are known, and on the recording of a pick."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from delta_dynamics import PayloadEstimator, inverse_dynamics
from pkm_twin import Robot
from pkm_twin.codegen.arrays import Array
from pkm_twin.recordings import read
from pkm_twin.recordings.recording import differentiate_motion
from test.support.robots import joint_range, load

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
        times,
        middle + reach * np.sin(angle),
        reach * w * np.cos(angle),
        -reach * w**2 * np.sin(angle),
    )


def fed(robot: Robot, *rows: Array, known: Array | None = None) -> PayloadEstimator:
    """An estimator after times, states and efforts."""
    estimator = PayloadEstimator(robot)
    for sample in zip(*rows, strict=True):
        estimator.push(*sample, known)
    return estimator


@pytest.mark.parametrize(("name", "feels"), [("stewart", True), ("rps3", True), ("delta_cu", False)])
def test_a_load_is_found_with_what_the_machine_feels_of_it(name: str, feels: bool) -> None:
    """A platform that tilts feels the centre too, three translations the mass alone."""
    robot = load(name).changed(payload={"mass": 0.0, "inertia": [0.0] * 3})
    mass, com = 1.3, np.array([0.03, -0.02, 0.05])
    laden = robot.changed(payload={"mass": mass, "com": com.tolist()})
    time, q, qd, qdd = moved(robot, 3.0)
    effort = inverse_dynamics(laden, q, qd, qdd)
    rng = np.random.default_rng(5)
    effort = effort + 1e-3 * np.abs(effort).max(0) * rng.normal(size=effort.shape)
    found = fed(robot, time, q, qd, qdd, effort).estimate()
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
    r = read(BAGS / "delta_cu_pick_and_place.mcap")
    assert r.effort is not None
    qd, qdd, used = differentiate_motion(r)
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
    estimator = fed(robot, time, q, qd, qdd, effort)
    assert estimator.estimate().mass == pytest.approx(1.0, rel=0.01)
    estimator.reset()
    found = estimator.estimate()
    assert found.mass == pytest.approx(0.0, abs=1e-9)
    assert found.mass_deviation > 1.0
    assert estimator.push(10.0, q[0], qd[0], qdd[0], effort[0]) is None


def test_a_stream_four_times_as_fast_is_not_surer() -> None:
    """Errors last for a while: samples closer together than that share one and the same."""
    robot = load("stewart").changed(payload={"mass": 0.0, "inertia": [0.0] * 3})
    laden = robot.changed(payload={"mass": 1.3, "com": [0.03, -0.02, 0.05]})
    time, q, qd, qdd = moved(robot, 2.0)
    effort = inverse_dynamics(laden, q, qd, qdd)
    found = []
    for step in (1, 4):
        rows = (array[::step] for array in (time, q, qd, qdd, effort))
        found.append(fed(robot, *rows).estimate().mass_deviation)
    assert found[0] == pytest.approx(found[1], rel=0.1)


def test_what_is_known_of_a_wrench_is_not_taken_for_a_load() -> None:
    robot = load("stewart").changed(payload={"mass": 0.0, "inertia": [0.0] * 3})
    laden = robot.changed(payload={"mass": 1.3})
    time, q, qd, qdd = moved(robot, 1.0)
    wrench = np.array([20.0, -10.0, 30.0, 1.0, 2.0, -1.0])
    effort = inverse_dynamics(laden, q, qd, qdd, wrench)
    rows = (time, q, qd, qdd, effort)
    masses = [fed(robot, *rows, known=known).estimate().mass for known in (wrench, None)]
    assert masses[0] == pytest.approx(1.3, rel=0.01)
    assert abs(masses[1] - 1.3) > 1.0


def test_after_a_long_pause_a_load_is_as_unknown_as_any() -> None:
    """What fades away gives place to what is known of any load: it never is less than that."""
    robot = load("stewart").changed(payload={"mass": 0.0, "inertia": [0.0] * 3})
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


def swung(robot: Robot, seconds: float) -> tuple[Array, Array, Array, Array]:
    """The same from home on: no jump where a machine that stood at home begins to move."""
    time, q, qd, qdd = moved(robot, seconds)
    return time, q - q[0] + robot.inverse(robot.home()), qd, qdd


@pytest.mark.parametrize(
    ("name", "braked"),
    [
        ("delta_cu", 0.0),
        ("linear_delta", 0.02),
        pytest.param("delta_cu", 0.02, marks=pytest.mark.long),
        pytest.param("linear_delta", 0.0, marks=pytest.mark.long),
    ],
)
def test_drives_that_are_off_or_braked_weigh_nothing(name: str, braked: float) -> None:
    """Two seconds of zero or constant efforts at standstill, then the drives of a laden machine."""
    robot = load(name)
    laden = robot.changed(payload={"mass": 0.4})
    home, still = robot.inverse(robot.home()), np.zeros(robot.joints_count)
    held = inverse_dynamics(laden, home, still, still)
    estimator = PayloadEstimator(robot)
    for k in range(500):
        found = estimator.push(PERIOD * k, home, still, still, braked * held)
        assert found is None or k < 30
    assert estimator.drives.idle
    known = estimator.estimate()
    assert 0.0 <= known.mass < 3.0 * known.mass_deviation
    time, *motion = swung(robot, 3.0)
    effort = inverse_dynamics(laden, *motion)
    for sample in zip(time + 2.1, *motion, effort, strict=True):
        found = estimator.push(*sample)
    assert found is not None and not estimator.drives.idle
    assert found.mass == pytest.approx(0.4, rel=0.03)


@pytest.mark.parametrize("share", [-0.2, -1.0])
def test_no_load_is_lighter_than_none(share: float) -> None:
    """Efforts that ask for a mass below zero: it is zero, with a deviation that covers theirs."""
    robot = load("delta_cu")
    time, q, qd, qdd = moved(robot, 2.0)
    bare = inverse_dynamics(robot, q, qd, qdd)
    heavy = inverse_dynamics(robot.changed(payload={"mass": 1.0}), q, qd, qdd)
    effort = bare + share * (heavy - bare)
    estimator = PayloadEstimator(robot)
    for sample in zip(time, q, qd, qdd, effort, strict=True):
        found = estimator.push(*sample)
        assert found is None or found.mass >= 0.0
    assert found is not None
    assert found.mass == 0.0
    assert found.asked == pytest.approx(share, rel=0.02)
    assert found.mass_deviation >= abs(found.asked)
    np.testing.assert_array_equal(found.com, robot.payload.com)
    assert np.isinf(found.com_deviation).all()


def test_at_rest_dry_friction_may_bear_a_part_of_the_load() -> None:
    """What it bears stays the same as long as the joint stands, so time makes nothing surer."""
    robot = load("linear_delta")
    load_mass, rng = 0.5, np.random.default_rng(4)
    laden = robot.changed(payload={"mass": load_mass})
    home, still = robot.inverse(robot.home()), np.zeros(3)
    held = inverse_dynamics(laden, home, still, still)
    misses = []
    for _ in range(4):
        stuck = rng.uniform(-1.0, 1.0, 3) * robot.friction.coulomb
        estimator = PayloadEstimator(robot)
        for k in range(400):
            noise = 0.01 * rng.normal(size=3)
            found = estimator.push(PERIOD * k, home, still, still, held + stuck + noise)
        assert found is not None
        misses.append((found.mass - load_mass) / found.mass_deviation)
    assert np.abs(misses).max() < 3.0


def test_friction_that_grows_with_the_load_is_no_load() -> None:
    """An unknown load adds to the friction of the gears, too."""
    laws = {"coulomb": 0.05, "load_dependent": 0.2}
    robot = load("delta_cu").changed(payload={"mass": 0.0, "inertia": [0.0] * 3}, friction=laws)
    time, q, qd, qdd = moved(robot, 1.5)
    effort = inverse_dynamics(robot.changed(payload={"mass": 1.3}), q, qd, qdd)
    found = fed(robot, time, q, qd, qdd, effort).estimate()
    assert found.mass == pytest.approx(1.3, rel=2e-3)
