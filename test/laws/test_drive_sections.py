# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The section ``drive`` of every mechanism: a rotor behind a gear, as the joint feels it."""

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin.errors import ParameterError
from pkm_twin.identification.parameters import file_parameters
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.robot.robot_urdf import robot_description
from test.support.robots import load, parameters_of

GEARS = {
    "delta": {"inertia": 1.7e-5, "ratio": 12.0, "efficiency": 0.9},
    "delta_cu": {"inertia": 1.7e-5, "ratio": 7.5},
    "prru": {"inertia": 2.0e-4, "lead": 0.01},
    "upr_rpu": {"inertia": 2.0e-4, "lead": 0.005, "efficiency": 0.8},
}


def with_drive(name, drive, **inertia):
    data = parameters_of(name)
    data["drive"] = drive
    data["inertia"] = {**data["inertia"], **inertia}
    return robot_of_data(data, "geared")


@pytest.mark.parametrize("name", GEARS)
def test_a_drive_is_the_rotor_times_the_square_of_its_gear(name):
    drive = GEARS[name]
    robot, bare = with_drive(name, drive, rotor_inertia=0.0), load(name)
    n = robot.joints_count
    q, qdd = robot.inverse(robot.home()), np.arange(1.0, n + 1)
    turns = drive.get("ratio") or 2 * np.pi / drive["lead"]
    more = inverse_dynamics(robot, q, 0 * q, qdd) - inverse_dynamics(bare, q, 0 * q, qdd)
    np.testing.assert_allclose(more, drive["inertia"] * turns**2 * qdd, rtol=1e-9)
    assert [gear.efficiency for gear in robot.drives] == [drive.get("efficiency", 1.0)] * n


@pytest.mark.parametrize("name", ["delta", "prru"])
def test_a_gear_is_of_its_kind_of_joint_and_alone(name):
    other = {"inertia": 1e-5, "lead" if "ratio" in GEARS[name] else "ratio": 2.0}
    with pytest.raises(ParameterError) as error:
        _ = with_drive(name, other, rotor_inertia=0.0).graph
    assert error.value.field == "drive"
    with pytest.raises(ParameterError) as error:
        _ = with_drive(name, GEARS[name], rotor_inertia=0.1).graph
    assert error.value.field == "inertia.rotor_inertia"


@pytest.mark.parametrize("name", GEARS)
def test_a_drive_is_written_out_as_one(name):
    robot = with_drive(name, GEARS[name], rotor_inertia=0.0)
    joints = robot_description(robot)["joints"]
    for joint in robot.joint_names:
        assert "rotor_inertia" not in joints[joint]
        told = joints[joint]["drive"]
        assert told == {"efficiency": 1.0, **GEARS[name]}


@pytest.mark.parametrize("name", GEARS)
def test_a_fit_writes_the_rotor_before_the_gear(name):
    robot = with_drive(name, GEARS[name], rotor_inertia=0.0)
    (rotor,) = file_parameters(robot, ("rotor",)).groups
    ((path, value),) = rotor.keys(2.0 * rotor.values).items()
    assert path == ("drive", "inertia")
    assert value == pytest.approx(2.0 * GEARS[name]["inertia"])
