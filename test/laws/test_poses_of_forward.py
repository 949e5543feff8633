# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""`inverse` answers the poses that `forward` gives, and no others; there is one home."""

import numpy as np
import pytest
import yaml

from delta_dynamics import inverse_dynamics, least_norm_reactions
from pkm_twin import robot_names
from pkm_twin.errors import SingularityError, UnreachableError
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.robot.robot_urdf import robot_description
from test.machine.random_machines import FILES
from test.support.robots import every_robot, load, often, partly_long

SIZES = (0.15, 0.5, 1.2)
"""Parts of the machine's size by which poses are away from home; angles as many times 2 rad."""
UNSEEN = (
    "hinged_platform",
    "rrr3_planar",
    "rrr3_spherical",
    "delta_rcu",
    "prru3",
    "rsur",
    "arm_2r",
)
NAMES = [
    *partly_long(robot_names(), "stewart", "rps3", "upr_rpu", "prru", "delta"),
    *partly_long(UNSEEN, "hinged_platform", "rrr3_planar", "rrr3_spherical"),
]


def machine(name):
    return load(name) if name in robot_names() else load(FILES[name])


def apart(robot, one, other):
    """Difference of poses, turns by the shorter way."""
    turns = np.array([len(c.entries) == 2 for c in robot.coordinates])
    difference = one - other
    return np.where(turns, (difference + np.pi) % (2 * np.pi) - np.pi, difference)


def poses_about_home(robot, rng, count):
    home = robot.home()
    step = np.where([u == "rad" for u in robot.pose_units], 2.0, robot.graph.size)
    return np.concatenate([home + part * step * rng.uniform(-1.0, 1.0, (count, len(home))) for part in SIZES])


@pytest.mark.parametrize("count", often(80, 4000))
@pytest.mark.parametrize("name", NAMES)
def test_no_pose_is_answered_with_joints_of_another(name, count, rng):
    robot = machine(name)
    poses = poses_about_home(robot, rng, count)
    q, good = robot.try_inverse(poses)
    assert 0 < good.sum() < len(good)
    assert np.isnan(q[~good]).all()
    assert np.abs(apart(robot, robot.forward(q[good]), poses[good])).max() < 1e-6
    # One pose has the bits and the verdict of its batch.
    for answer, pose in zip(q[good][:20], poses[good], strict=False):
        np.testing.assert_array_equal(robot.inverse(pose), answer)
    for pose in poses[~good][:8]:
        with pytest.raises((SingularityError, UnreachableError)):
            robot.inverse(pose)
        with pytest.raises((SingularityError, UnreachableError)) as caught:
            robot.inverse(np.stack([robot.home(), pose]))
        assert caught.value.index == (1,)
        # What can be met is a singularity's doing, not a limb's.
        assert getattr(caught.value, "miss", 1.0) > 1e-9 * robot.graph.size


def test_limbs_far_longer_than_the_machine(rng):
    """A head tilted to a quarter turn has limbs as long as its height divided by the cosine."""
    robot = load("upr_rpu")
    tilt = (np.pi / 2 - 10.0 ** rng.uniform(-5.0, -1.0, 400)) * rng.choice([-1.0, 1.0], 400)
    poses = np.stack([rng.uniform(-1.0, -0.5, 400), tilt, rng.uniform(-1.0, 1.0, 400)], axis=1)
    q, good = robot.try_inverse(poses)
    assert 40 < good.sum() < 400
    assert np.abs(robot.forward(q[good]) - poses[good]).max() < 1e-6


def test_a_hexapod_tilted_beyond_its_singularity():
    pose = np.array([-0.159, 0.2993, 0.5007, 0.8745, 0.5927, 0.3741])
    robot = load("stewart")
    with pytest.raises(SingularityError) as caught:
        robot.inverse(pose)
    assert caught.value.beyond
    near = robot.home() + 0.3 * (pose - robot.home())
    np.testing.assert_allclose(robot.forward(robot.inverse(near)), near, atol=1e-12)


@every_robot
def test_there_is_one_home(name):
    """That of the graph, of `home()`, and of the machine that the robot is written out as."""
    robot = load(name)
    home = robot.home()
    np.testing.assert_array_equal(home, robot.engine.home_pose)
    np.testing.assert_allclose(robot.inverse(home), robot.graph.home, atol=1e-12)
    limits = robot.limits.position
    assert (limits[:, 0] < robot.graph.home).all() and (robot.graph.home < limits[:, 1]).all()
    # Other limits of a copy are another bound, not another machine.
    if "limits" in robot.changeable and not hasattr(robot, "described"):
        field = "limb_length" if name == "upr_rpu" else "position"
        copy = robot.changed(limits={field: (limits + 0.01).tolist()})
        np.testing.assert_array_equal(copy.graph.home, robot.graph.home)
    written = robot_of_data(robot_description(robot), name)
    np.testing.assert_allclose(written.graph.home, robot.graph.home, atol=1e-12)
    np.testing.assert_allclose(written.graph.origin, robot.graph.origin, atol=1e-12)
    position, _ = robot.platform(robot.graph.home)
    np.testing.assert_allclose(written.platform(written.graph.home)[0], position, atol=1e-12)


def test_tubes_are_half_as_long_as_the_limb_at_home():
    """As the parameters' page says it of the 2UPR-RPU; masses by hand from the file's numbers."""
    robot = load("upr_rpu")
    half = robot.inverse(robot.home()) / 2
    area = np.pi / 4 * robot.members.diameter**2
    for k, limb in enumerate("123"):
        for tube in ("lower tube", "upper tube"):
            mass = robot.graph.bodies[f"{tube} {limb}"].mass
            assert mass == pytest.approx(robot.inertia.density * area[k] * half[k], rel=1e-12)


@pytest.mark.parametrize("shift", [0.0, 0.05])
def test_all_joints_of_a_spherical_machine_in_one_point(shift, rng):
    """Reactions and torques do not hang on a size that there is not; nor where the point is."""
    data = yaml.safe_load(FILES["rrr3_spherical"].read_text())
    data["origin"] = [0.0, 0.0, shift]
    for section in (data["bodies"], data["limbs"]["bodies"]):
        for body in section.values():
            body["com"] = [v + (shift if k == 2 else 0.0) for k, v in enumerate(body["com"])]
    for joint in data["limbs"]["joints"].values():
        joint["at"] = [0.0, 0.0, shift]
    robot = robot_of_data(data, "agile_eye")
    q, qd, qdd = (scale * rng.normal(size=(5, 3)) for scale in (0.1, 1.0, 5.0))
    loads = least_norm_reactions(robot, q, qd, qdd)
    assert all(np.isfinite(w).all() for w in loads.wrenches)
    assert np.isfinite(inverse_dynamics(robot, q, qd, qdd)).all()


@pytest.mark.parametrize(
    ("name", "far", "question"),
    [
        ("delta", [0.0, 0.0, -350.0], "z -350 m cannot be reached. Did you give mm?"),
        ("prru", [0.84, 30.0, 0.0], "30 rad cannot be reached. Did you give degrees?"),
        ("delta", [0.0, 0.0, -2.0], ""),
    ],
)
def test_a_pose_in_another_unit_is_asked_for(name, far, question):
    with pytest.raises((UnreachableError, SingularityError)) as refused:
        load(name).inverse(far)
    assert ("?" in str(refused.value)) == bool(question)
    assert question in str(refused.value)
