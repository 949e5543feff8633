# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The YAML of a description: the same numbers again, plain YAML, few long lines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from delta_dynamics import inverse_dynamics
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.machine.machine_yaml import describe_machine_yaml
from pkm_twin.machine.strict_yaml import read_yaml
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.robot.robot_urdf import robot_description
from pkm_twin.robot.urdf_read import read_urdf
from test.support.robots import load, partly_long, random_motion

pytest.importorskip("pinocchio")

from .random_machines import NAMES, plain
from .sketches import SKETCHES


def read_back(data, tmp_path):
    path = tmp_path / "machine.yaml"
    path.write_text(describe_machine_yaml(data))
    return read_yaml(path)


@pytest.mark.parametrize("name", NAMES)
def test_the_same_description_comes_back(name, tmp_path):
    data = plain(name)
    assert read_back(data, tmp_path) == data
    assert yaml.safe_load(describe_machine_yaml(data)) == data


@pytest.mark.parametrize("name", partly_long(sorted(SKETCHES), "four_bar"))
def test_a_urdf_s_description_comes_back(name, tmp_path):
    data = read_urdf(SKETCHES[name]().save(tmp_path))
    assert read_back(data, tmp_path) == data


def test_hard_names_and_numbers(tmp_path):
    values = [1e-5, -0.0, 3.0, 1e300, float("inf"), 0.1 + 0.2, 5e-324, -1e-17]
    data = {
        "mechanism": "machine",
        "platform": "yes",
        "bodies": {"toe_b_1/2": {"mass": 1e-9, "com": values}, "3": {}, "a, b": {"mass": np.pi}},
        "joints": {"on": {"between": ["a, b", "no"], "actuated": True}},
        "rods": {},
        "limbs": [{"azimuths": [0.0, 1.5], "bodies": {"x": {"mass": 1.0}}}],
    }
    assert read_back(data, tmp_path) == data
    assert "-0" not in describe_machine_yaml({"origin": [-0.0]})


def test_one_list_in_two_places_is_written_twice(tmp_path):
    point = [0.1, 0.2, 0.3]
    data = {"mechanism": "machine", "origin": point, "bodies": {"a": {"com": point}}}
    assert read_back(data, tmp_path) == data


@pytest.mark.parametrize("off", [5e-324, 1e-17, 1e-9])
def test_what_rounding_makes_of_one_point_is_no_length(off):
    """A spherical machine's joints all meet in a point: its size is not the distance of two."""
    exact = read_yaml(Path(__file__).parent / "machines" / "rrr3_spherical.yaml")
    robot = robot_of_data(exact | {"origin": [0.0, 0.0, off]}, "near")
    expected = robot_of_data(exact | {"origin": [0.0, 0.0, 0.0]}, "exact")
    assert robot.graph.size == expected.graph.size == 1.0
    assert robot.engine.mobility == expected.engine.mobility


def test_units_and_meanings_are_told():
    data = plain("hinged_platform")
    content = describe_machine_yaml({key: data[key] for key in ("platform", "bodies", "rods")})
    for words in ("kg m2", "the body that carries the tool", "# pose:", "a ball joint"):
        assert words in content
    assert max(map(len, content.splitlines())) <= 120


@pytest.mark.parametrize("name", ["prru", "upr_rpu"])
def test_a_template_written_out_keeps_its_pose_and_torques(name, rng):
    robot = load(name)
    written = robot_of_data(robot_description(robot), "written")
    assert written.pose_names == robot.pose_names
    *motion, wrench = random_motion(robot, rng, 200)
    np.testing.assert_allclose(written.forward(motion[0]), robot.forward(motion[0]), atol=1e-12)
    tau = inverse_dynamics(robot, *motion, wrench)
    found = inverse_dynamics(written, *motion, wrench)
    np.testing.assert_allclose(found, tau, atol=1e-12 * np.abs(tau).max())


@pytest.mark.parametrize(
    ("angles", "pose", "text"),
    [
        ({"alpha": "y", "beta": "x"}, ["z", "alpha", "beta"], "x, y, z or about z, y, x"),
        ({"alpha": "x"}, ["z", "alpha", "beta"], "two or three names"),
        ([1], ["z", "alpha", "beta"], "a mapping"),
        ({"alpha": "x", "beta": "y"}, ["z", "roll", "beta"], r"pose\[1\].*'roll'"),
    ],
)
def test_angles_of_no_rotation_are_refused(angles, pose, text):
    data = robot_description(load("prru")) | {"angles": angles, "pose": pose}
    with pytest.raises((ParameterError, UnknownNameError), match=text):
        robot_of_data(data, "wrong")
