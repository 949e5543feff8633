# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Friction laws of drives, against formulas that share nothing with them."""

import numpy as np
import pytest

from delta_dynamics import (
    dynamics_terms,
    forward_dynamics,
    inverse_dynamics,
    parameter_values,
    regressor,
    torque_derivatives,
)
from delta_dynamics.simulation.plant import Plant
from pkm_twin.certify.maximal import Maximal
from pkm_twin.errors import ParameterError
from pkm_twin.export.fmu import Fmu
from pkm_twin.machine.friction import BASIC, LAWS, list_friction_keys
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.robot.robot_urdf import robot_description
from test.machine.random_machines import variant
from test.support.robots import (
    finite_difference,
    joint_units_of_size,
    load,
    partly_long,
    random_motion,
)

NAMES = partly_long(["delta_cu", "prru", "upr_rpu", "random five_bar", "random rps3"], "prru", "random five_bar")
ROBOTS = pytest.mark.parametrize("name", NAMES)
PERIOD = 0.05


def robot_of(name):
    if not name.startswith("random "):
        return load(name)
    what = name.split()[1]
    return robot_of_data(variant(what, np.random.default_rng(len(name))), what)


def rubbing(name, rng, *keys):
    """The robot with friction of random size in the laws of some keys, by default of all."""
    robot = robot_of(name)
    n = robot.joints_count
    none = {key: [0.0] * n for key in list_friction_keys()}
    q = robot.inverse(robot.home())
    plain = robot.changed(friction=none)
    size = np.abs(inverse_dynamics(plain, q, 0.0 * q, 0.0 * q)).max() + 0.5
    unit = joint_units_of_size(robot)
    scales = {
        "viscous": 0.2 * size / unit,
        "coulomb": 0.1 * size,
        "offset": 0.05 * size,
        "stribeck": 0.1 * size,
        "stribeck_speed": 0.3 * unit,
        "load_dependent": 0.3,
        "cogging_cos": 0.03 * size,
        "cogging_sin": 0.03 * size,
        "cogging_period": PERIOD * unit,
        "presliding": 0.01 * unit,
    }
    drawn = {key: scale * rng.uniform(0.3, 1.0, n) for key, scale in scales.items()}
    chosen = {key: drawn[key].tolist() for key in keys or scales}
    return plain.changed(friction=chosen)


def by_hand(robot, q, qd, load):
    """Friction by the formulas of the field."""
    f = robot.friction
    rate = qd / f.stribeck_speed
    way = np.where(qd > 0.0, 1.0, np.where(qd < 0.0, -1.0, 0.0))
    angle = 2.0 * np.pi * q / f.cogging_period
    dry = f.coulomb + f.stribeck * np.exp(-(rate**2)) + f.load_dependent * np.abs(load)
    cogging = f.cogging_cos * np.cos(angle) + f.cogging_sin * np.sin(angle)
    return f.viscous * qd + dry * way + f.offset + cogging


@ROBOTS
def test_efforts_and_all_that_follows_from_them_have_the_laws(name, rng):
    robot = rubbing(name, rng)
    assert robot.laws == tuple(LAWS)
    plain = robot.changed(friction=dict.fromkeys(list_friction_keys(), 0.0))
    q, qd, qdd, wrench = random_motion(robot, rng, 20)
    load_of = inverse_dynamics(plain, q, qd, qdd, wrench)
    tau = inverse_dynamics(robot, q, qd, qdd, wrench)
    size = np.abs(tau).max()
    assert np.abs(tau - load_of - by_hand(robot, q, qd, load_of)).max() < 1e-11 * size
    assert (inverse_dynamics(robot, q[0], qd[0], qdd[0], wrench[0]) == tau[0]).all()
    judge = Maximal(robot_description(robot))
    judged = judge.inverse_dynamics(q[0], qd[0], qdd[0], wrench[0])
    assert np.abs(judged - tau[0]).max() < 1e-9 * size
    again = forward_dynamics(robot, q, qd, tau, wrench)
    assert np.abs(again - qdd).max() < 1e-8 * np.abs(qdd).max()
    table = regressor(robot, q, qd, qdd, wrench)
    assert np.abs(table @ parameter_values(robot) - tau).max() < 1e-11 * size
    assert np.abs(dynamics_terms(robot, q, qd, qdd, wrench).total - tau).max() < 1e-12 * size
    found = torque_derivatives(robot, q[0], qd[0], qdd[0], wrench[0])
    by_q = finite_difference(lambda x: inverse_dynamics(robot, x, qd[0], qdd[0], wrench[0]), q[0])
    by_qd = finite_difference(lambda x: inverse_dynamics(robot, q[0], x, qdd[0], wrench[0]), qd[0])
    assert np.abs(found.q - by_q).max() < 1e-5 * np.abs(by_q).max()
    assert np.abs(found.qd - by_qd).max() < 1e-5 * np.abs(by_qd).max()


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_drive_breaks_away_at_static_friction_and_its_share_of_the_load(way, rng):
    robot = rubbing("delta_cu", rng, "coulomb", "stribeck", "stribeck_speed", "load_dependent")
    f = robot.friction
    q = robot.inverse(robot.home())
    weight = inverse_dynamics(robot, q, 0.0 * q, 0.0 * q)
    bound = f.coulomb + f.stribeck + f.load_dependent * np.abs(weight)
    for share, moves in ((0.999, False), (1.001, True)):
        plant = Plant(robot, q.copy())
        effort = weight.copy()
        effort[0] += way * share * bound[0]
        for _ in range(20):
            plant.advance(effort, np.zeros(6), 1e-3)
        assert (way * (plant.q - q)[0] > 0.0) == moves
        assert moves or (plant.q == q).all()


def test_files_state_the_laws_and_keep_them():
    robot = rubbing("five_bar", np.random.default_rng(1))
    again = robot_of_data(robot_description(robot), "again")
    for key in list_friction_keys():
        assert (getattr(again.friction, key) == getattr(robot.friction, key)).all()
    plain = load("delta_cu").parameter_sections()["friction"]
    assert set(plain) == set(BASIC.parameters)
    with pytest.raises(ParameterError, match="stribeck_speed"):
        load("five_bar").changed(friction={"stribeck": 0.1})
    with pytest.raises(ParameterError, match="load_dependent"):
        load("five_bar").changed(friction={"load_dependent": 1.0})
    with pytest.raises(ParameterError, match="stribeck"):
        Fmu(rubbing("five_bar", np.random.default_rng(1)))
