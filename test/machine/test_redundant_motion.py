# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Machines with more motors than freedoms in motion: tables, plants and simulations."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from delta_dynamics import (
    inverse_dynamics,
    null_efforts,
)
from delta_dynamics.simulation.machine import MachineSettings, Simulation, tune_position_control
from delta_dynamics.simulation.plant import Plant
from pkm_twin.errors import (
    MessageError,
    UnreachableError,
)
from pkm_twin.paths.along import compute_model_efforts, tabulate_torques
from pkm_twin.recordings import Recording
from pkm_twin.robot.derivatives import joint_rates
from test.nodes.harness import SECOND, Maker, Plain


def swung(robot, t):
    """A motion about home at times t: pose, and joints with their derivatives."""
    size, rate = np.array([0.02, 0.015, 0.1]), np.array([7.0, 5.0, 6.0])
    turn = np.outer(t, rate)
    pose, speed = size * np.sin(turn), size * rate * np.cos(turn)
    q = robot.inverse(pose)
    return pose, q, *joint_rates(robot, q, speed, -size * rate**2 * np.sin(turn))


def test_a_table_of_encoders_that_differ_has_efforts(planar, rng):
    """Its differences are noisy; joints at rest are no reason to reject it, a slip is."""
    t = np.arange(0.0, 1.0, 2e-3)
    _, q, qd, qdd = swung(planar, t)
    seen = q + 1e-4 * rng.uniform(-1, 1, q.shape)
    moved = Recording(planar, t, seen).with_rates()
    right = inverse_dynamics(planar, q, qd, qdd)
    # Dry friction turns over within the noise.
    apart = (compute_model_efforts(moved) - right)[(np.abs(qd) > 0.2).all(1)]
    assert np.sqrt(np.mean(apart**2)) < 0.2 * np.abs(right).max()
    seen[300, 3] += 5e-3
    with pytest.raises(UnreachableError, match=r"sample 300.*motor_4 .*redundancy\.tolerance"):
        tabulate_torques(Recording(planar, t, seen).with_rates())


def test_a_plant_under_computed_efforts_follows_the_path(planar):
    """To the second order of its steps; efforts that move nothing change nothing."""
    rough = {"offset": [0.1, -0.2, 0.3, 0.4]}
    robot, missed, load = planar.changed(friction=rough), [], np.array([1.0, -2.0, 0, 0, 0, 0.1])
    for steps in (50, 100):
        step = 0.3 / steps
        pose, q, qd, qdd = swung(robot, step * np.arange(2 * steps + 1) / 2)
        efforts = inverse_dynamics(robot, q, qd, qdd, load)
        plant = Plant(robot, q[0])
        plant.qd = qd[0].copy()
        for k in range(1, 2 * steps, 2):
            plant.advance(efforts[k], load, step)
        np.testing.assert_allclose(robot.project_redundant(plant.q)[0], plant.q, atol=1e-12)
        missed.append(np.abs(robot.forward(plant.q) - pose[-1]).max())
    assert missed[1] < 0.3 * missed[0] < 0.3 * 2e-3
    step, inner = 1e-4, null_efforts(robot, q[0])[0]
    rates = []
    for more in (0.0 * inner, inner, inner * [1, 1, 1, 0]):
        plant = Plant(robot, q[0])
        plant.qd = qd[0].copy()
        plant.advance(efforts[0] + more, load, step)
        rates.append(plant.qd - qd[0])
    np.testing.assert_allclose(rates[0], step * qdd[0], atol=1e-2 * step * np.abs(qdd[0]).max())
    assert np.abs(rates[1] - rates[0]).max() < 1e-3 * np.abs(rates[2] - rates[0]).max()


def test_a_simulated_machine_follows_a_trajectory_with_all_drives(planar):
    n, free = 4, np.full(4, np.inf)
    machine = Simulation(planar, MachineSettings(planar.graph.home, free, *tune_position_control(planar, 8.0)), SECOND)
    assert machine.stable_fraction == 1.0
    t = np.linspace(0.0, 0.4, 81)
    share, slope = 1 - np.cos(np.pi * t / 0.4), np.pi / 0.4
    size = np.array([0.01, 0.008, 0.05])
    pose, speed = size * share[:, None], size * slope * np.sin(np.pi * t / 0.4)[:, None]
    q = planar.inverse(pose)
    qd, qdd = joint_rates(planar, q, speed, size * slope**2 * np.cos(np.pi * t / 0.4)[:, None])
    message = Maker(Plain()).trajectory(planar.joint_names, [round(s * SECOND) for s in t], q, qd, qdd)
    efforts = inverse_dynamics(planar, q, qd, qdd)
    for point, effort in zip(message.points, efforts, strict=True):
        point.effort = effort.tolist()
    machine.trajectory(message)
    for k in range(1, 401):
        machine.advance()
        if k % 50 == 0:
            seen = machine.read_sensors()
            np.testing.assert_allclose(seen.q, q[k // 5], atol=1e-3)
            np.testing.assert_allclose(seen.effort, efforts[k // 5], atol=0.15 * np.abs(efforts).max())
    # A drive that follows has no stop: the machine stops there and says so.
    machine = Simulation(
        planar.changed(limits={"position": [[0, 3], [0, 3], [0, 3], [1.89, 1.91]]}),
        MachineSettings(planar.graph.home, free, np.zeros(n), np.zeros(n)),
        SECOND,
    )
    machine.commands(SimpleNamespace(data=[0.0, 0.0, 0.0, 2.0]))
    with pytest.raises(MessageError, match=r"motor_4 is at .*1\.89 to 1\.91"):
        for _ in range(400):
            machine.advance()
