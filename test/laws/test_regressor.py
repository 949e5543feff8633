# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Laws of the regressor: the efforts themselves, for every robot; as many base parameters."""

from __future__ import annotations

import numpy as np
import pytest

from delta_dynamics import (
    base_parameters,
    inverse_dynamics,
    parameter_names,
    parameter_units,
    parameter_values,
    regressor,
)
from delta_dynamics.torques.regressor import random_states
from pkm_twin import Robot
from pkm_twin.identification.estimation import find_violations
from pkm_twin.identification.parameters import file_parameters
from pkm_twin.machine.places import join_path
from pkm_twin.mechanisms.catalogue import robot_of_data
from test.machine.random_machines import NAMES, variant
from test.support.robots import load, loaded, massive, random_motion


def complete(name: str) -> Robot:
    """A loaded robot with offsets and rotors."""
    robot = loaded(name)
    return robot.changed(friction={"offset": [0.1, -0.2, 0.3, 0.1, -0.2, 0.3][: robot.joints_count]})


@massive
def test_regressor_times_parameters_is_inverse_dynamics(name):
    robot = complete(name)
    q, qd, qdd, wrench = random_motion(robot, np.random.default_rng(1), 30)
    table, pi = regressor(robot, q, qd, qdd, wrench), parameter_values(robot)
    assert table.shape == (30, robot.joints_count, len(pi))
    assert len(pi) == len(set(parameter_names(robot))) == len(parameter_units(robot))
    efforts = inverse_dynamics(robot, q, qd, qdd, wrench)
    error = np.abs(table @ pi - efforts) / np.abs(efforts).max(-1, keepdims=True)
    assert error.max() < 1e-12
    # Without a wrench its column is nothing.
    assert not regressor(robot, q[0], qd[0], qdd[0])[:, -1].any()


@massive
def test_numbers_of_a_file_are_linear_parameters(name):
    """A file with other masses, centres and inertias needs the efforts that are linear in them."""
    robot, rng = complete(name), np.random.default_rng(2)
    parameters = file_parameters(robot)
    assert len(set(parameters.names)) == len(parameters.names) == len(parameters.values)
    assert not find_violations(parameters.values, parameters.cones)
    values, numbers = parameters.values.copy(), {}
    for where, group in zip(parameters.slices, parameters.groups, strict=True):
        step = 0.3 * np.nan_to_num(group.scales) * rng.normal(size=len(group.names))
        new = 1.2 * group.values + step
        while find_violations(new, [(slice(None), cone) for cone in group.cones]):
            step *= 0.5
            new = 1.2 * group.values + step
        if group.kind in ("payload", "inertia"):
            values[where] = new
            for key, value in group.keys(new).items():
                numbers[join_path(key)] = value
                if isinstance(key[-2], int):
                    numbers[join_path((*key[:-2], key[-1], key[-2]))] = value
    q, qd, qdd, _ = random_motion(robot, rng, 10)
    table = regressor(robot, q, qd, qdd) @ parameters.mixing
    for other, own in ((robot, parameters.values), (robot.with_default_inertia.numbered(numbers), values)):
        efforts = inverse_dynamics(other, q, qd, qdd)
        assert np.abs(table @ own - efforts).max() < 1e-12 * np.abs(efforts).max()


@pytest.mark.parametrize(
    "name",
    ["five_bar", *(pytest.param(n, marks=pytest.mark.long) for n in NAMES if n != "five_bar")],
)
def test_the_same_of_random_machines(name):
    rng = np.random.default_rng([7, NAMES.index(name)])
    robot = robot_of_data(variant(name, rng), name)
    q, qd, qdd = random_states(robot, 3, seed=4)
    wrench = rng.normal(0.0, 10.0, (3, 6))
    efforts = inverse_dynamics(robot, q, qd, qdd, wrench)
    error = regressor(robot, q, qd, qdd, wrench) @ parameter_values(robot) - efforts
    assert np.abs(error).max() < 1e-12 * np.abs(efforts).max()


@massive
def test_a_column_hangs_on_no_parameter(name):
    robot = complete(name)
    q, qd, qdd, _ = random_motion(robot, np.random.default_rng(2), 5)
    other = robot.changed(payload={"mass": 1.0, "com": [0.1, 0.2, 0.3]}, friction={"coulomb": 3.0})
    assert (regressor(robot, q, qd, qdd) == regressor(other, q, qd, qdd)).all()
    efforts = inverse_dynamics(other, q, qd, qdd)
    again = regressor(robot, q, qd, qdd) @ parameter_values(other)
    np.testing.assert_allclose(again, efforts, atol=1e-12 * np.abs(efforts).max())


@massive
def test_base_parameters_are_as_many_from_other_states_and_say_the_same(name):
    robot = complete(name)
    first, second = base_parameters(robot, seed=1), base_parameters(robot, seed=2)
    assert first.count == second.count == len(first.names) == len(set(first.names))
    states = random_states(robot, 20, seed=3)
    efforts = inverse_dynamics(robot, *states)
    for base in (first, second):
        table = regressor(robot, *states)[..., list(base.columns)]
        assert np.abs(table @ base.values - efforts).max() < 1e-9 * np.abs(efforts).max()
        assert "wrench" not in base.unseen


def test_a_delta_cannot_tell_its_platform_from_a_payload_nor_where_it_is_held():
    base = base_parameters(load("delta"))
    (told,) = [name for name in base.names if "platform.mass" in name]
    assert "payload.mass" in told
    assert {"platform.mx", "payload.mx", "payload.izz", "platform.iyy"} <= set(base.unseen)
    # Each drive's friction stands for itself.
    assert {"arm_1.viscous", "arm_2.coulomb", "arm_3.viscous"} <= set(base.names)


@pytest.mark.parametrize("what", ["mass", "izz"])
def test_units_say_what_a_parameter_is(what):
    robot = load("linear_delta")
    units = dict(zip(parameter_names(robot), parameter_units(robot), strict=True))
    assert units[f"platform.{what}"] == {"mass": "kg", "izz": "kg m2"}[what]
    assert units["rail_1.viscous"] == "N s/m"
    assert units["rail_1.rotor_inertia"] == "kg"
