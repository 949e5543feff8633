# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Screws: one whose nut is a carriage on a rail, and one that is driven itself."""

from xml.etree import ElementTree as ET

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics, inverse_dynamics_at_pose, least_norm_reactions, mass_matrix, reactions
from pkm_twin import load, variants
from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.robot.robot_urdf import robot_description, robot_urdf
from pkm_twin.robot.workspace import MIN_SAMPLED_INDEX, random_joints
from stiffness_monitor import platform_response
from test.support.robots import data_of

GRAVITY = 9.81
SCREW, CARRIAGE, ROTOR = 4e-5, 2.5, 1.2e-5
VISCOUS, COULOMB = 1e-4, 0.02


def slide(lead):
    """A motor turns a screw; its nut is a carriage on a rail."""
    return robot_of_data(
        {
            "mechanism": "machine",
            "platform": "carriage",
            "origin": [0.02, 0, 0.4],
            "pose": ["z"],
            "bodies": {
                "screw": {"mass": 0.8, "com": [0, 0, 0.35], "inertia": [0.02, 0.02, SCREW]},
                "carriage": {"mass": CARRIAGE, "com": [0.03, 0.01, 0.42], "inertia": [0.004, 0.005, 0.006]},
            },
            "joints": {
                "motor": {
                    "type": "revolute",
                    "between": ["base", "screw"],
                    "at": [0, 0, 0],
                    "axis": [0, 0, 1],
                    "actuated": True,
                    "rotor_inertia": ROTOR,
                    "friction": {"viscous": VISCOUS, "coulomb": COULOMB},
                },
                "nut": {
                    "type": "helical",
                    "between": ["screw", "carriage"],
                    "at": [0, 0, 0.4],
                    "axis": [0, 0, 1],
                    "lead": lead,
                },
                "rail": {"type": "prismatic", "between": ["base", "carriage"], "axis": [0, 0, 1]},
            },
        },
        "slide",
    )


def driven(lead, at):
    """A drilling quill: the screw joint itself is driven, and its spindle turns off the axis."""
    return robot_of_data(
        {
            "mechanism": "machine",
            "platform": "quill",
            "pose": ["x"],
            "bodies": {"quill": {"mass": 1.5, "com": at, "inertia": [0.01, 0.02, 0.03]}},
            "joints": {
                "feed": {
                    "type": "helical",
                    "between": ["base", "quill"],
                    "at": [0, 0, 0],
                    "axis": [1, 0, 0],
                    "lead": lead,
                    "actuated": True,
                    "home": 0.3,
                },
            },
        },
        "quill",
    )


@pytest.mark.parametrize("lead", [0.01, -0.04])
def test_a_ball_screw_moves_its_carriage_by_its_lead(lead):
    robot, pitch = slide(lead), lead / (2 * np.pi)
    q = np.linspace(-50.0, 50.0, 9)[:, None]
    # The nut does not turn: the screw turns through it, so the carriage goes the other way.
    np.testing.assert_allclose(robot.forward(q), 0.4 - pitch * q, atol=1e-12)
    np.testing.assert_allclose(robot.inverse(robot.forward(q)), q, atol=1e-9)
    assert robot.passive_joints == ("nut", "nut_slide")
    np.testing.assert_allclose(robot.passive(q), np.hstack([-q, -pitch * q]), atol=1e-12)
    np.testing.assert_allclose(robot.passive_rates(q, q), np.hstack([-q, -pitch * q]), atol=1e-12)


def test_its_rail_s_limits_bound_the_workspace():
    robot = slide(0.01)
    with pytest.raises(ParameterError) as caught:
        robot.search_box()
    assert caught.value.field == "joints.rail.limits.position"
    joints = {"rail": {"limits": {"position": [-0.1, 0.3]}}}
    low, high = robot.changed(joints=joints).search_box()[0]
    assert low <= 0.3 and 0.7 <= high <= 1.2


@pytest.mark.parametrize("lead", [0.01, -0.04])
def test_its_torque_is_that_of_a_screw(lead, rng):
    robot, pitch = slide(lead), lead / (2 * np.pi)
    q, qd, qdd, push = rng.normal(size=(4, 20, 1))
    wrench = np.hstack([np.zeros((20, 2)), push, np.zeros((20, 3))])
    inertia = SCREW + ROTOR + CARRIAGE * pitch**2
    axial = CARRIAGE * (GRAVITY - pitch * qdd) - push
    expected = (SCREW + ROTOR) * qdd - pitch * axial + VISCOUS * qd + COULOMB * np.sign(qd)
    np.testing.assert_allclose(inverse_dynamics(robot, q, qd, qdd, wrench), expected, rtol=1e-11)
    np.testing.assert_allclose(mass_matrix(robot, q)[:, 0, 0], inertia, rtol=1e-12)
    found = least_norm_reactions(robot, q, qd, qdd, wrench)
    np.testing.assert_allclose(found.wrench("nut")[:, 2:3], axial, rtol=1e-11)
    # The thread: its moment about the axis is the axial force's.
    np.testing.assert_allclose(found.wrench("nut")[:, 5:6], -pitch * axial, rtol=1e-11)


def test_a_fine_thread_has_random_states_though_its_index_is_small(rng):
    robot = slide(0.001)
    assert robot.singularity(robot.graph.home) < MIN_SAMPLED_INDEX
    assert random_joints(robot, rng, 5).shape == (5, 1)


def test_a_driven_screw_goes_its_lead_a_turn(rng):
    q = rng.normal(size=(12, 1))
    found = driven(0.5, [0.2, 0, 0]).forward(q)
    np.testing.assert_allclose(found, 0.2 + 0.5 / (2 * np.pi) * (q - 0.3), atol=1e-12)


@pytest.mark.parametrize("lead", [0.01, -0.6])
def test_its_frame_gives_along_the_axis_as_a_screw_that_twists(lead):
    """Push at the carriage: screw and nut are stretched, and twisted by the thread's moment."""
    data = robot_description(slide(lead))
    data["origin"] = [0, 0, 0.4]
    modulus, shear, outer = 200e9, 80e9, 0.02
    tube = {"youngs_modulus": modulus, "shear_modulus": shear, "outer_diameter": outer}
    data["bodies"]["screw"]["member"] = {
        "from": [0, 0, 0],
        "to": [0, 0, 0.4],
        "section": tube | {"inner_diameter": 0.0},
    }
    joints = data["joints"]
    joints["motor"]["compliance"] = [0, 0, 0, 3e-4, 0, 0]
    joints["nut"]["compliance"] = [2e-9, 1e-9, 1e-9, 5e-5, 0, 0]
    joints["rail"]["compliance"] = [0, 1e-9, 1e-9, 4e-5, 1e-6, 1e-6]
    robot = robot_of_data(data, "elastic slide")
    area, polar, pitch = np.pi / 4 * outer**2, np.pi / 32 * outer**4, lead / (2 * np.pi)
    expected = 0.4 / (modulus * area) + 2e-9
    expected += pitch**2 * (0.4 / (shear * polar) + 3e-4 + 5e-5 + 4e-5)
    found = platform_response(robot, [[0.0], [7.0]], [0, 0, 10.0, 0, 0, 0])
    np.testing.assert_allclose(found.compliance[:, 2, 2], expected, rtol=1e-9)
    shares = dict(zip(found.elements, found.energies[0] / found.total[0], strict=True))
    np.testing.assert_allclose(shares["rail"], pitch**2 * 4e-5 / expected, rtol=1e-9)
    np.testing.assert_allclose(shares["motor"], pitch**2 * 3e-4 / expected, rtol=1e-9)


def test_it_is_written_out_and_read_again(rng):
    robot = slide(0.012)
    again = robot_of_data(robot_description(robot), "again")
    motion = rng.normal(size=(3, 5, 1))
    np.testing.assert_array_equal(inverse_dynamics(again, *motion), inverse_dynamics(robot, *motion))


def test_its_slide_follows_its_turn_in_a_urdf(rng):
    robot = slide(0.012)
    line = ET.fromstring(robot_urdf(robot)).find("joint[@name='nut_slide']/mimic").attrib
    turn, slid = robot.passive(rng.normal(size=(5, 1))).T
    assert line["joint"] == "nut"
    along = float(line["offset"]) + float(line["multiplier"]) * turn
    np.testing.assert_allclose(along, slid, atol=1e-15)


@pytest.mark.parametrize("lead", [0.012, -0.03, None])
def test_a_urdf_is_read_again(rng, lead, tmp_path):
    """Where the slide follows the turn that bears it; any other follower is rejected."""
    robot = driven(0.02, [0.1, 0.02, 0.03]) if lead is None else slide(lead)
    file, text = tmp_path / "screw.urdf", robot_urdf(robot)
    file.write_text(text)
    again, motion = load(file, platform="platform"), rng.normal(size=(3, 5, 1))
    assert again.joint_names == robot.joint_names
    np.testing.assert_allclose(again.platform(motion[0])[0], robot.platform(motion[0])[0])
    np.testing.assert_allclose(inverse_dynamics(again, *motion), inverse_dynamics(robot, *motion))
    for old, new in (
        ("<mimic joint=", "<mimic other="),
        ('slide" type="prismatic', 'slide" type="revolute'),
    ):
        file.write_text(text.replace(old, new))
        with pytest.raises(ParameterError, match="mimic"):
            load(file, platform="platform")


def test_a_lead_stands_where_there_is_a_thread():
    for lead, joint in ((None, "nut"), (0.0, "nut"), (0.01, "rail")):
        data = robot_description(slide(0.01))
        data["joints"]["nut"].pop("lead")
        data["joints"]["nut"]["lead"] = 0.01
        data["joints"][joint]["lead"] = lead
        with pytest.raises(ParameterError) as caught:
            robot_of_data(data, "bad")
        assert caught.value.field == f"joints.{joint}.lead"


def test_screws_of_other_leads_have_their_own_reactions(rng):
    robot, leads = slide(0.01), np.array([0.008, 0.01, -0.02])
    q, qd, qdd, wrench = *rng.normal(size=(3, 5, 1)), rng.normal(size=(5, 6))
    found = variants(robot, {"joints.nut.lead": leads}).reactions(q, qd, qdd, wrench)
    for k, lead in enumerate(leads):
        own = reactions(slide(lead), q, qd, qdd, wrench)
        np.testing.assert_allclose(found.wrenches[k], own.wrenches, atol=1e-12 * 40)


def test_a_pose_of_another_assembly_of_a_machine_with_a_screw_is_rejected(rng):
    """A screw lifts a carriage, whose link pushes a table: its place on the other side has the same joint position."""
    right, high = 0.3, 0.4
    data = data_of(slide(0.02))
    data |= {"platform": "table", "origin": [right, 0, 0], "pose": ["x"]}
    data["bodies"] |= {
        "link": {"mass": 0.3, "com": [right / 2, 0, high / 2], "inertia": [0.006, 0.006, 0.001]},
        "table": {"mass": 1.0, "com": [right, 0, 0], "inertia": [0.01, 0.01, 0.01]},
    }
    pin = {"type": "revolute", "axis": [0, 1, 0]}
    data["joints"] |= {
        "upper": pin | {"between": ["carriage", "link"], "at": [0, 0, high]},
        "lower": pin | {"between": ["link", "table"], "at": [right, 0, 0]},
        "bed": {"type": "prismatic", "between": ["base", "table"], "axis": [1, 0, 0]},
    }
    robot = robot_of_data(data, "toggle")
    x = rng.uniform(-0.49, 0.49, (400, 1))
    good = robot.try_inverse(x)[1]
    assert not good[x[:, 0] < 0.0].any()
    assert good[x[:, 0] > 0.02].all()
    still = np.zeros(1)
    found = inverse_dynamics_at_pose(robot, x[good], still, still)
    np.testing.assert_allclose(robot.forward(found.q), x[good], atol=1e-9)
    np.testing.assert_allclose(found.tau, inverse_dynamics(robot, found.q, still, still), rtol=1e-9)
    for pose in x[~good][:10]:
        with pytest.raises(PkmTwinError):
            inverse_dynamics_at_pose(robot, pose, still, still)
