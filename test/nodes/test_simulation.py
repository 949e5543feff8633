# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Drives and sensors of the simulated machine, without a middleware."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics, mass_matrix
from delta_dynamics.simulation.machine import (
    MachineSettings,
    PayloadEvent,
    Simulation,
    WrenchSignal,
    error_growth,
    tune_position_control,
)
from pkm_twin.errors import MessageError, ParameterError
from pkm_twin.robot.variation import vary_robot
from test.nodes.harness import SECOND, reject
from test.support.robots import load

ROBOT = load("delta_cu")
HOME = ROBOT.inverse(ROBOT.home())
STILL = np.zeros(3)
WEIGHT = inverse_dynamics(ROBOT, HOME, STILL, STILL)
BEGIN = 5 * SECOND


def simulation(robot=ROBOT, **changes):
    stiffness, damping = tune_position_control(robot, 10.0)
    limits = ROBOT.limits.effort
    settings = MachineSettings(HOME, limits, stiffness, damping)
    return Simulation(robot, dataclasses.replace(settings, **changes), BEGIN)


def command(effort):
    return SimpleNamespace(data=list(effort))


def go(machine, periods, effort=None):
    """Measured after each period, with the same command before each."""
    states = []
    for _ in range(periods):
        if effort is not None:
            machine.commands(command(effort))
        machine.advance()
        states.append(machine.read_sensors())
    return states


def path(seconds=0.5, reach=0.25, points=101):
    """A blend away from home: times, positions, rates and accelerations."""
    x = np.linspace(0.0, 1.0, points)
    way = np.array([6.0, -15.0, 10.0, 0.0, 0.0, 0.0])
    rows = [np.polyval(np.polyder(way, k), x) / seconds**k for k in range(3)]
    q, qd, qdd = (np.outer(row, reach * np.array([1.0, -1.2, 0.8])) for row in rows)
    return x * seconds, HOME + q, qd, qdd


def trajectory(make, effort=None, stamp=0, **options):
    times, q, qd, qdd = path(**options)
    nanoseconds = [round(t * SECOND) for t in times]
    message = make.trajectory(ROBOT.joint_names, nanoseconds, q, qd, qdd, stamp)
    if effort is not None:
        for point, row in zip(message.points, effort.tolist(), strict=True):
            point.effort = row
    return message


def test_brakes_hold_until_the_first_command():
    machine = simulation()
    states = go(machine, 20)
    assert (states[-1].q == HOME).all() and (states[-1].qd == 0.0).all()
    assert [s.stamp for s in states[:3]] == [BEGIN + k * SECOND // 1000 for k in (1, 2, 3)]
    assert (go(machine, 20, STILL)[-1].qd > 0.0).all()


def test_efforts_move_it_as_the_model_says():
    push = np.array([0.3, -0.2, 0.1])
    (state,) = go(simulation(), 1, WEIGHT + push)
    assert (state.effort == WEIGHT + push).all()
    back = inverse_dynamics(ROBOT, HOME, STILL, state.qd / 1e-3)
    assert np.abs(back - WEIGHT - push).max() < 1e-3 * np.abs(push).max()


def test_a_command_that_is_no_effort_is_refused_and_changes_nothing():
    machine = simulation()
    go(machine, 1, WEIGHT)
    for bad, reason in (
        ([np.nan, 0.0, 0.0], "not finite"),
        ([np.inf, 0.0, 0.0], "not finite"),
        ([1e9, 0.0, 0.0], "bounds"),
        ([0.0, 0.0], "length"),
        ([], "length"),
    ):
        assert reject(machine.commands, command(bad))[0] == reason
        assert machine.stream.rejected[reason]
        assert (go(machine, 1)[0].effort == WEIGHT).all()


@pytest.mark.parametrize("timeout_action", ["zeros", "hold"])
def test_silence(timeout_action):
    machine = simulation(deadline=0.01, timeout_action=timeout_action)
    go(machine, 1, WEIGHT)
    efforts = np.array([s.effort for s in go(machine, 20)])
    held = int((efforts == WEIGHT).all(1).sum())
    assert held == (20 if timeout_action == "hold" else 10)
    assert (efforts[held:] == 0.0).all()


def test_saturation_delay_and_encoder_steps():
    machine = simulation(effort_limits=np.full(3, 2.0), delay=0.003)
    states = go(machine, 5, np.array([50.0, 0.0, -50.0]))
    assert [s.effort[0] for s in states] == [0.0, 0.0, 0.0, 2.0, 2.0]
    assert (states[-1].effort == [2.0, 0.0, -2.0]).all()
    assert machine.saturations
    coarse = go(simulation(resolution=np.full(3, 1e-4)), 30, WEIGHT + 0.5)
    fine = go(simulation(), 30, WEIGHT + 0.5)
    for a, b, c in zip(coarse[1:], coarse, fine[1:], strict=False):
        assert np.abs(a.q / 1e-4 - np.round(a.q / 1e-4)).max() < 1e-9
        assert np.abs(a.q - c.q).max() <= 0.5e-4 + 1e-12
        assert np.abs(a.qd - (a.q - b.q) / 1e-3).max() < 1e-12


def test_a_payload_comes_when_it_is_due():
    event = PayloadEvent(0.01, 0.5, (0.0, 0.0, -0.02))
    machine = simulation(payloads=(event,))
    states = go(machine, 20, WEIGHT)
    moved = [bool((s.qd != 0.0).any() and np.abs(s.qd).max() > 1e-9) for s in states]
    assert moved == [False] * 10 + [True] * 10
    carrying = ROBOT.changed(payload={"mass": 0.5, "com": [0.0, 0.0, -0.02]})
    held = inverse_dynamics(carrying, states[9].q, STILL, states[10].qd / 1e-3)
    assert np.abs(held - WEIGHT).max() < 1e-3 * np.abs(WEIGHT).max()


def test_a_wrench_pushes_and_the_sensor_shows_it_in_the_platform_s_axes(make):
    head = load("prru")
    q = head.inverse(head.home() + np.array([0.0, 0.1, -0.05]))
    rest = np.zeros(3)
    wrench = np.array([30.0, -20.0, -50.0, 1.0, 2.0, 0.5])
    settings = MachineSettings(
        q, np.full(3, np.inf), *tune_position_control(head, 10.0), wrench=WrenchSignal(0.5 * wrench)
    )
    machine = Simulation(head, settings, BEGIN)
    machine.push(make.wrench(0.5 * wrench, frame="base_link"), "base_link")
    balance = inverse_dynamics(head, q, rest, rest, wrench)
    states = go(machine, 10, balance)
    assert np.abs(states[-1].q - q).max() < 1e-12
    rotation = head.platform(q)[1]
    assert np.abs(rotation - np.eye(3)).max() > 0.05
    shown = np.concatenate([rotation @ states[-1].wrench[:3], rotation @ states[-1].wrench[3:]])
    assert np.abs(shown - wrench).max() < 1e-9
    with pytest.raises(MessageError, match="frame"):
        machine.push(make.wrench(wrench, frame="tool"), "base_link")
    sine = WrenchSignal(np.ones(6), np.arange(6.0), 2.0)
    assert np.abs(sine.at(0.125) - 1.0 - np.arange(6.0)).max() < 1e-12


def follow(robot, message, periods=500, **changes):
    """Root mean square and greatest tracking error at the points, rad."""
    machine = simulation(robot, **changes)
    machine.trajectory(message)
    states = go(machine, periods)
    errors = np.array([s.q for s in states[4::5]]) - path()[1][1:]
    return float(np.sqrt(np.mean(errors**2))), float(np.abs(errors).max())


def test_feedforward_follows_where_feedback_lags(make):
    efforts = inverse_dynamics(ROBOT, *path()[1:])
    plain, ahead = trajectory(make), trajectory(make, efforts)
    exact = follow(ROBOT, ahead)
    assert exact[1] < 2e-5
    kinds = ("masses", "inertias", "friction", "lengths")
    other = vary_robot(ROBOT, dict.fromkeys(kinds, 0.01), 1).robot
    lags, follows = follow(other, plain), follow(other, ahead)
    print(f"PD {lags[0]:.3e}, with feedforward {follows[0]:.3e} rad rms at 1 %")
    assert lags[0] > 5.0 * follows[0]


def test_a_trajectory_of_the_future_waits_and_the_newest_command_is_obeyed(make):
    machine = simulation()
    machine.trajectory(trajectory(make, stamp=BEGIN + SECOND // 50))
    states = go(machine, 40)
    assert (states[19].q == HOME).all() and np.abs(states[39].q - HOME).max() > 1e-6
    (state,) = go(machine, 1, WEIGHT)
    assert (state.effort == WEIGHT).all()
    machine.trajectory(trajectory(make))
    assert (go(machine, 1)[0].effort != WEIGHT).any()
    with pytest.raises(MessageError):
        machine.trajectory(trajectory(make, np.full((101, 3), np.nan)))
    with pytest.raises(MessageError):
        machine.trajectory(trajectory(make, stamp=1))
    assert machine.trajectories.rejected.total() == 2


def test_points_between_are_the_polynomials_of_their_derivatives(make):
    from pkm_twin.messages.reading import JointReader
    from pkm_twin.streams.path import JointPath

    times, q, qd, qdd = path(points=11)
    fine = path(points=101)
    nanoseconds = [round(t * SECOND) for t in times]
    reader = JointReader(ROBOT)
    bounds = ((None, None, 3e-2), (qd, None, 1e-3), (qd, qdd, 1e-12))
    for rates, seconds, bound in bounds:
        message = make.trajectory(ROBOT.joint_names, nanoseconds, q, rates, seconds)
        way = JointPath(reader.trajectory(message, 0))
        wanted = [way.at(t) for t in fine[0]]
        assert np.abs(np.array([w.q for w in wanted]) - fine[1]).max() < bound
        # Every way goes through its points.
        assert np.abs(np.array([way.at(t).q for t in times]) - q).max() < 1e-12
    assert np.abs(np.array([w.qd for w in wanted]) - fine[2]).max() < 1e-10


def test_where_the_model_ends_the_machine_stands_until_it_is_put_back():
    loose = ROBOT.changed(limits={"position": [[-3.0, 3.0]] * 3})
    machine = simulation(loose)
    with pytest.raises(MessageError):
        go(machine, 2000, np.array([3.0, 3.0, -3.0]))
    (state,) = go(machine, 1)
    assert machine.failure and (state.qd == 0.0).all()
    machine.restart()
    assert not machine.failure
    assert (go(machine, 1)[0].q == HOME).all()


def test_a_start_beyond_the_limits_is_refused():
    with pytest.raises(ParameterError, match="start, arm_2"):
        simulation(start=np.array([0.0, 2.0, 0.0]))


def home_of(robot):
    return robot.inverse(robot.home())


def controlled(robot, bandwidth, **changes):
    """A machine whose drives have no limits, under position control."""
    free = np.full(robot.joints_count, np.inf)
    settings = MachineSettings(home_of(robot), free, *tune_position_control(robot, bandwidth), **changes)
    return Simulation(robot, settings, BEGIN)


def growth_in_time(robot, machine):
    """Factor by which a small error grows in a period, simulated."""
    rng = np.random.default_rng(2)
    q, n = machine.settings.start, robot.joints_count
    point = SimpleNamespace(
        positions=q,
        velocities=0 * q,
        accelerations=0 * q,
        effort=0 * q,
        time_from_start=SimpleNamespace(sec=0, nanosec=0),
    )
    machine.__dict__["stable_fraction"] = 1.0
    machine.trajectory(
        SimpleNamespace(
            header=SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0)),
            joint_names=robot.joint_names,
            points=[point],
        )
    )
    machine.plant.qd = 1e-9 * rng.normal(size=n)
    sizes = [0.0]
    while len(sizes) < 60 and sizes[-1] < 1e-4:
        machine.advance()
        sizes.append(np.linalg.norm(machine.plant.qd) + np.linalg.norm(machine.plant.q - q))
    half = len(sizes) // 2
    return (sizes[-1] / sizes[half]) ** (1.0 / (len(sizes) - 1 - half))


@pytest.mark.parametrize("name", ["delta_cu", "prru"])
@pytest.mark.parametrize("changes", [{}, {"delay": 0.02}])
@pytest.mark.parametrize("bandwidth", [2.0, 20.0])
def test_errors_of_the_position_control_grow_by_the_spectral_radius(name, changes, bandwidth):
    """Of the linear loop, against the simulated machine; friction and weight left out."""
    robot = load(name).changed(friction={"viscous": 0.0, "coulomb": 0.0}, gravity=[0.0, 0.0, 0.0])
    machine = controlled(robot, bandwidth, period=0.01, **changes)
    want = error_growth(mass_matrix(robot, machine.settings.start), machine.settings)
    assert growth_in_time(robot, machine) == pytest.approx(want, rel=0.1)


@pytest.mark.parametrize("name", ["delta_cu", "five_bar", "prru"])
def test_every_pair_of_period_and_bandwidth_follows_a_trajectory_or_rejects_it(make, name):
    """And a bandwidth that is stable is not rejected by far."""
    robot = load(name)
    home, turn = home_of(robot), np.array([1.0, -1.0, 1.0])[: robot.joints_count]
    x = np.linspace(0.0, 1.0, 41)
    way = np.array([6.0, -15.0, 10.0, 0.0, 0.0, 0.0])
    reach = 0.05 * np.where(np.array(robot.joint_units) == "m", robot.size, 1.0) * turn
    followed = 0
    for period in (1e-3, 1e-2, 4e-2):
        seconds = 20.0 * period
        rows = [np.outer(np.polyval(np.polyder(way, k), x) / seconds**k, reach) for k in range(3)]
        q, qd, qdd = home + rows[0], rows[1], rows[2]
        times = [round(t * SECOND) for t in x * seconds]
        message = make.trajectory(robot.joint_names, times, q, qd, qdd)
        for point, effort in zip(message.points, inverse_dynamics(robot, q, qd, qdd), strict=True):
            point.effort = effort.tolist()
        for turns in (0.003, 0.03, 0.3, 3.0):
            machine = controlled(robot, turns / period / (2.0 * np.pi), period=period)
            try:
                machine.trajectory(message)
            except MessageError as error:
                assert error.reason == "unstable control"
                assert machine.trajectories.rejected[error.reason] == 1
                assert machine.stable_fraction * turns < 1.0
                continue
            followed += 1
            rates = np.array([np.abs(s.qd) for s in go(machine, 40)]).max(0)
            assert (rates < 1.5 * np.abs(qd).max(0)).all(), (period, turns)
    assert followed >= 6
