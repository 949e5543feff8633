# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Elastic machines in the graph form: beside the Delta's own file, and on springs in the drives."""

import numpy as np
import pytest
import yaml

from pkm_twin.certify.description import expand
from pkm_twin.design.variants import variants
from pkm_twin.errors import ParameterError, SingularityError
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.robot.clearance import clearance
from stiffness_monitor import compliance, platform_response, strain_energy
from stiffness_monitor.modes import assemble, natural_frequencies
from stiffness_monitor.structure import structural_model
from test.machine.random_machines import plain
from test.support.robots import load, rigid

pytestmark = pytest.mark.usefixtures("quickly_compiled")
POSES = [[0.02, 0.03, -0.33], [-0.05, 0.0, -0.36]]


def tube(members):
    return {
        "youngs_modulus": members.youngs_modulus,
        "shear_modulus": members.shear_modulus,
        "density": members.density,
        "outer_diameter": members.outer_diameter,
    }


@pytest.fixture
def delta_in_the_graph_form():
    """The shipped Delta with both rods of every parallelogram, arms and rods elastic."""
    delta = load("delta")
    g, m, members = delta.geometry, delta.inertia, delta.members
    q = np.full(3, 0.3)
    origin = delta.forward(q)
    square = m.platform_mass * g.platform_radius**2
    data = {
        "mechanism": "machine",
        "origin": origin.tolist(),
        "pose": ["x", "y", "z"],
        "bodies": {
            "platform": {
                "mass": m.platform_mass,
                "com": origin.tolist(),
                "inertia": [square / 4, square / 4, square / 2],
            }
        },
        "joints": {},
        "rods": {},
    }
    for i, azimuth in enumerate(g.azimuths.tolist()):
        out = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        along = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        pivot = g.base_radius * out
        arm = np.cos(q[i]) * out - np.sin(q[i]) * np.array([0.0, 0.0, 1.0])
        tip = pivot + g.arm_length * arm
        corner = origin + g.platform_radius * out
        about = m.arm_mass * g.arm_length**2 / 12
        data["bodies"][f"arm_{i}"] = {
            "mass": m.arm_mass,
            "com": ((pivot + tip) / 2).tolist(),
            "inertia": (about * (np.eye(3) - np.outer(arm, arm))).tolist(),
            "member": {"from": pivot.tolist(), "to": tip.tolist(), "section": tube(members.arm)},
        }
        data["joints"][f"motor_{i}"] = {
            "type": "revolute",
            "between": ["base", f"arm_{i}"],
            "at": pivot.tolist(),
            "axis": along.tolist(),
            "actuated": True,
            "home": float(q[i]),
        }
        for side in (-0.5, 0.5):
            aside = side * members.parallelogram_width * along
            data["rods"][f"rod_{i}_{'ab'[side > 0]}"] = {
                "between": [f"arm_{i}", "platform"],
                "ends": [(tip + aside).tolist(), (corner + aside).tolist()],
                "mass": m.forearm_mass / 2,
                "section": tube(members.forearm),
            }
    return delta, robot_of_data(data, "elastic")


def test_the_graph_form_of_a_delta_is_as_stiff(delta_in_the_graph_form):
    delta, machine = delta_in_the_graph_form
    wrench = [3.0, -5.0, 20.0, 0.1, 0.2, -0.3]
    for pose in POSES:
        expected = compliance(delta, pose)
        size = np.abs(expected).max()
        np.testing.assert_allclose(compliance(machine, pose), expected, atol=1e-12 * size)
        np.testing.assert_allclose(natural_frequencies(machine, pose), natural_frequencies(delta, pose), rtol=1e-9)
        assert clearance(machine, pose) == pytest.approx(clearance(delta, pose), abs=1e-12)
        own, other = strain_energy(delta, pose, wrench), strain_energy(machine, pose, wrench)
        assert other.total == pytest.approx(own.total, rel=1e-10)


@pytest.mark.parametrize("name", ["stewart", "rps3"])
def test_springs_in_the_drives_alone_give_the_jacobians_compliance(name, tmp_path):
    """Rigid bodies on elastic drives: C = J c J', whatever closes the loops."""
    data = yaml.safe_load(rigid(name, tmp_path / "rigid.yaml").read_text(encoding="utf-8"))
    along = 1e-6
    sections = [data, *(data["limbs"] if isinstance(data["limbs"], list) else [data["limbs"]])]
    for section in sections:
        for joint in section.get("joints", {}).values():
            if joint.get("actuated"):
                joint["compliance"] = [along, 0, 0, 0, 0, 0]
    robot = robot_of_data(data, "elastic")
    q = robot.graph.home + 0.02 * np.sin(np.arange(len(robot.joint_names)) + 1.0)
    pose = robot.forward(q)
    jacobian = robot.platform_jacobian(q)
    expected = along * jacobian @ jacobian.T
    if len(q) == 6:
        found = compliance(robot, pose)
        np.testing.assert_allclose(found, expected, atol=1e-10 * np.abs(expected).max())
        return
    # What the limbs hold rigidly does not give at all: no compliance is positive definite.
    with pytest.raises(ValueError, match=r"compliance|singular|positive"):
        compliance(robot, pose)


def test_a_rigid_machine_says_what_is_missing(tmp_path):
    robot = load(rigid("stewart", tmp_path / "rigid.yaml"))
    with pytest.raises(ParameterError, match="nothing is elastic") as caught:
        compliance(robot, robot.home())
    keys = ("bodies.NAME.member.section", "rods.NAME.section", "joints.NAME.compliance")
    assert all(key in str(caught.value) for key in keys)


@pytest.mark.parametrize("entry", range(6))
def test_a_compliance_is_without_end_where_a_joint_is_free_alone(entry):
    data = plain("five_bar")
    own = robot_of_data(data, "five_bar")
    expected = compliance(own, own.home())
    data["joints"]["tip"]["compliance"][entry] = float("inf")
    if entry == 3:
        free = robot_of_data(data, "five_bar")
        assert (compliance(free, free.home()) == expected).all()
        return
    with pytest.raises(ParameterError) as caught:
        robot_of_data(data, "five_bar")
    assert caught.value.field == f"joints.tip.compliance[{entry}]"


@pytest.mark.parametrize("joint", ["tip", "elbow_left"])
def test_a_joint_beside_its_member_is_on_a_rigid_lever(joint):
    """As with a body of its own that is fixed to the member's end."""
    data = plain("five_bar")
    toe = {"mass": 0.0, "com": [0, 0, 0], "inertia": [0, 0, 0]}
    place = data["joints"][joint]["at"]
    data["joints"][joint]["at"] = np.add(place, (0.03, 0.04, -0.05)).tolist()
    beside = robot_of_data(data, "five_bar")
    pair = data["joints"][joint]["between"]
    data["bodies"]["toe"] = toe
    data["joints"][joint]["between"] = ["toe" if b == "forearm_left" else b for b in pair]
    data["joints"]["weld"] = {"type": "fixed", "between": ["forearm_left", "toe"], "at": place}
    welded = robot_of_data(data, "five_bar")
    pose = beside.forward(beside.graph.home + np.array([0.1, -0.05]))
    expected, size = compliance(welded, pose), np.abs(compliance(welded, pose)).max()
    np.testing.assert_allclose(compliance(beside, pose), expected, atol=1e-10 * size)
    # The program of many machines, whose known case has the joint at the member's end.
    many = variants(load("five_bar"), {f"joints.{joint}.at[0]": [place[0], place[0] + 0.03]})
    home = load("five_bar").home()
    for found, own in zip(many.compliance(home), many, strict=True):
        np.testing.assert_allclose(found, compliance(own, home), atol=1e-10 * size)


def test_factors_of_elements_stand_in_what_is_written_out(delta_in_the_graph_form):
    machine, _ = delta_in_the_graph_form
    softer = machine.changed(element_compliance={"arm I": 2.0})
    again = softer.with_file_values({"element_compliance.arm I": 3.0})
    assert again.element_compliance == {"arm I": 3.0}
    expected = machine.changed(element_compliance={"arm I": 3.0})
    size = np.abs(compliance(expected, POSES[0])).max()
    np.testing.assert_allclose(compliance(again, POSES[0]), compliance(expected, POSES[0]), atol=1e-9 * size)


def test_a_frame_that_is_singular_at_home_is_answered_elsewhere():
    """A four-bar on elastic joints alone, some directions rigid: closures hold more at home."""
    data = expand(plain("four_bar"))
    soft = {
        "motor": [8e-9, 4e-8, 0, 9e-6, 0, 1e-6],
        "crank_pin": [1e-8, 0, 0, 0, 0, 9e-6],
        "rocker_foot": [3e-9, 3e-9, 4e-8, 7e-6, 6e-7, 2e-7],
        "rocker_pin": [2e-8, 8e-8, 0, 4e-7, 9e-7, 0],
    }
    for name, values in soft.items():
        data["joints"][name]["compliance"] = values
    robot = robot_of_data(data, "four_bar")
    home = robot.graph.home
    with pytest.raises(SingularityError) as caught:
        platform_response(robot, np.stack((home + 0.1, home)), np.ones(6))
    assert caught.value.index == (1,)
    near = np.array([[0.1], [-0.2]]) + home
    found = platform_response(robot, near, np.ones(6))
    for q, matrix in zip(near, found.compliance, strict=True):
        whole = assemble(structural_model(robot, q), 1).stiffness
        expected = np.linalg.inv(whole)[:6, :6]
        scale = np.sqrt(np.diag(expected))
        assert np.abs((matrix - expected) / np.outer(scale, scale)).max() < 1e-8
