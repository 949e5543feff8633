# SPDX-License-Identifier: Apache-2.0
"""Kinematics of the 2UPR-RPU: inverse, forward, Jacobians, refusals, over random machines."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest

from pkm_twin.errors import ParameterError, SingularityError, UnreachableError
from pkm_twin.machine import schema
from pkm_twin.machine.strict_yaml import read_yaml
from pkm_twin.mechanisms.upr_rpu import UprRpu
from pkm_twin.robot.catalogue import config_folder
from test.support.robots import load

ROBOT = load("upr_rpu")
FILE = read_yaml(config_folder() / "upr_rpu.yaml")
SIZES = [(0.39, 0.26), (0.26, 0.39), (0.3, 0.3), (1.5, 0.2), (0.1, 0.45)]


def machine(base, platform):
    return schema.build(
        UprRpu, FILE | {"geometry": {"base_radius": base, "platform_radius": platform}}
    )


def branch_poses(robot, count, seed, margin=0.05):
    """Random poses of the home branch, clear of its singularities by ``margin``."""
    a, b = robot.geometry.platform_radius, robot.geometry.base_radius
    size = a + b
    rng = np.random.default_rng(seed)
    low, high = (-2.0 * size, -1.5, -1.5), (-0.1 * size, 1.5, 1.5)
    poses = rng.uniform(low, high, (20 * count, 3))
    z, beta, gamma = poses.T
    rho = z / np.cos(beta)
    pair = (rho**2 * np.cos(gamma) - a * b * np.sin(gamma) ** 2) / (rho**2 + a * b)
    slope = -(a * np.sin(beta) + z) / np.hypot(a, rho)
    kept = poses[(pair > margin) & (slope > margin) & (rho > -5 * size)]
    assert len(kept) >= count
    return kept[:count]


def points(robot, pose):
    """Ends A and B of the limbs by plain vector algebra, each (3, 3), one row a limb."""
    z, beta, gamma = pose
    pattern = np.array([[-1.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    cb, sb, cg, sg = math.cos(beta), math.sin(beta), math.cos(gamma), math.sin(gamma)
    rx = np.array([[1, 0, 0], [0, cb, -sb], [0, sb, cb]])
    ry = np.array([[cg, 0, sg], [0, 1, 0], [-sg, 0, cg]])
    o = np.array([0.0, -z * math.tan(beta), z])
    a, b = robot.geometry.platform_radius, robot.geometry.base_radius
    return o, rx @ ry, o + a * pattern @ (rx @ ry).T, b * pattern


def test_inverse_is_the_distance_of_the_ends():
    for pose in branch_poses(ROBOT, 50, 1):
        _, rotation, upper, lower = points(ROBOT, pose)
        lengths = np.linalg.norm(upper - lower, axis=1)
        assert ROBOT.inverse(pose) == pytest.approx(lengths, rel=1e-13)
        assert ROBOT.rotation(pose) == pytest.approx(rotation, abs=3e-14)


def test_constraints_of_the_limbs_hold():
    """Limbs 1 and 2 stay normal to y, limb 3 to X: what makes the pose three parameters."""
    for pose in branch_poses(ROBOT, 50, 2):
        _, rotation, upper, lower = points(ROBOT, pose)
        limb = upper - lower
        assert limb[:2] @ rotation[:, 1] == pytest.approx(0, abs=1e-14)
        assert limb[2, 0] == pytest.approx(0, abs=1e-14)


@pytest.mark.parametrize("size", SIZES)
def test_forward_of_inverse_is_the_pose(size):
    robot = machine(*size)
    poses = branch_poses(robot, 4000, 3)
    back = robot.forward(robot.inverse(poses))
    # The margin of 0.05 from the singularities costs up to 1 / 0.05 in digits.
    assert np.abs(back - poses).max() < 5e-13


def test_inverse_of_forward_is_the_joint_state():
    """Any lengths that assemble, also far from where they were made."""
    q = np.random.default_rng(5).uniform(0.2, 1.2, (4000, 3))
    poses, good = ROBOT.try_forward(q)
    assert 500 < good.sum() < 4000
    assert np.abs(ROBOT.inverse(poses[good]) - q[good]).max() < 1e-12
    a, b = ROBOT.geometry.platform_radius, ROBOT.geometry.base_radius
    z, beta, gamma = poses[good].T
    rho = z / np.cos(beta)
    assert (z < 0).all()
    assert (rho**2 * np.cos(gamma) >= a * b * np.sin(gamma) ** 2 - 1e-9).all()
    assert (z + a * np.sin(beta) <= 1e-9).all()


def test_forward_follows_the_home_pose():
    """Along paths that stay in the branch's middle, small steps in q are small steps in pose."""
    ends = branch_poses(ROBOT, 80, 6, margin=0.2)
    home = np.array([-0.6, 0.0, 0.0])
    path = home + np.linspace(0, 1, 200)[:, None, None] * (ends - home)
    a, b = ROBOT.geometry.platform_radius, ROBOT.geometry.base_radius
    rho = path[..., 0] / np.cos(path[..., 1])
    clear = (rho**2 * np.cos(path[..., 2]) > 1.1 * a * b * np.sin(path[..., 2]) ** 2) & (
        path[..., 0] + a * np.sin(path[..., 1]) < -0.01
    )
    whole = clear.all(axis=0)
    assert whole.sum() > 40
    assert ROBOT.forward(ROBOT.inverse(path[:, whole])) == pytest.approx(path[:, whole], abs=1e-11)


@pytest.mark.parametrize("size", SIZES)
def test_twists_move_the_limbs_and_nothing_else(size):
    """Each joint rate lengthens its own limb; no twist works on the limbs' constraints."""
    robot = machine(*size)
    for pose in branch_poses(robot, 50, 8):
        o, rotation, upper, lower = points(robot, pose)
        twist = robot.platform_jacobian(robot.inverse(pose))
        x, y = np.array([1.0, 0, 0]), rotation[:, 1]
        scale = np.abs(twist).max()
        for i in range(3):
            arm = upper[i] - o
            along = (upper[i] - lower[i]) / np.linalg.norm(upper[i] - lower[i])
            rate = along @ twist[:3] + np.cross(arm, along) @ twist[3:]
            assert rate == pytest.approx(np.eye(3)[i], abs=1e-12 * scale)
            at, line = (lower[i], y) if i < 2 else (upper[i], x)
            held = line @ twist[:3] + np.cross(at - o, line) @ twist[3:]
            assert held == pytest.approx(0, abs=1e-13 * scale)
        assert np.cross(x, y) @ twist[3:] == pytest.approx(0, abs=1e-13 * scale)


@pytest.mark.parametrize(
    "pose",
    [
        (0.0, 0, 0),
        (0.3, 0, 0),
        (-0.6, math.pi / 2, 0),
        (-0.6, -2.0, 0),
        (-0.6, 7.0, 0),
        (-1e9, 0, 0),
    ],
)
def test_inverse_refuses_what_is_no_pose(pose):
    with pytest.raises(UnreachableError) as caught:
        ROBOT.inverse(pose)
    assert caught.value.limb == "limb 3"
    with pytest.raises(UnreachableError) as caught:
        ROBOT.inverse([[-0.6, 0, 0], pose])
    assert caught.value.index == (1,)


def first_to_fail(q):
    """The limb that a joint state is refused by, None where it is not."""
    try:
        ROBOT.forward(q)
    except UnreachableError as error:
        return error.limb
    return None


@pytest.mark.parametrize(
    ("q", "limb"),
    [
        ((0.9, 0.3, 0.6), None),
        ((0.3, 0.9, 0.6), None),
        ((0.1, 0.6, 0.6), "limb 1"),
        ((0.6, 0.1, 0.6), "limb 2"),
        ((0.614, 0.614, 2.0), "limb 3"),
        ((0.614, 0.614, 0.05), "limb 3"),
    ],
)
def test_miss_is_what_the_named_limb_lacks(q, limb):
    """Moved by the miss and a hair more, the limb assembles; by a hair less, it does not."""
    with pytest.raises(UnreachableError) as caught:
        ROBOT.forward(q)
    i = ROBOT.limb_names.index(caught.value.limb)
    assert limb in (None, caught.value.limb)
    assert caught.value.miss > 0
    states = [
        [length + (sign * part * caught.value.miss if k == i else 0) for k, length in enumerate(q)]
        for sign in (-1, 1)
        for part in (0.999, 1.001)
    ]
    # Limb 3 may be what fails next, once limbs 1 and 2 fit.
    mended = [first_to_fail(state) in (None, *("limb 3",) * (i != 2)) for state in states]
    assert mended in ([False, True, False, False], [False, False, False, True])


@pytest.mark.parametrize("q", [(0, 0.6, 0.6), (-0.6, 0.6, 0.6), (0.6, 0.6, -1), (1e9, 0.6, 0.6)])
def test_lengths_that_are_none(q):
    with pytest.raises(UnreachableError):
        ROBOT.forward(q)


def test_jacobian_at_a_singularity():
    """A3 in the base plane: limb 3 cannot turn the platform."""
    beta = 0.5
    a, b = ROBOT.geometry.platform_radius, ROBOT.geometry.base_radius
    z = -a * math.sin(beta)
    with pytest.raises(SingularityError):
        ROBOT.inverse([z, beta, 0.0])
    rho = z / math.cos(beta)
    limbs = math.hypot(a - b, rho)
    third = math.hypot(b * math.cos(beta) - a, b * math.sin(beta) + rho)
    with pytest.raises((SingularityError, UnreachableError)):
        ROBOT.jacobian([limbs, limbs, third])


def test_passive_angles():
    for pose in branch_poses(ROBOT, 50, 10):
        _, rotation, upper, lower = points(ROBOT, pose)
        limb = lower - upper
        unit = limb / np.linalg.norm(limb, axis=1)[:, None]
        expected = np.arccos(np.stack((unit[:, 2], unit @ rotation[:, 2]), axis=1))
        angles = ROBOT.limit_angles(pose)
        assert angles.reshape(3, 2) == pytest.approx(expected, abs=1e-7)


def test_limits_have_the_common_shape():
    assert ROBOT.limits.position.tolist() == [[0.3, 1.0]] * 3
    assert ROBOT.limits.velocity is None
    assert ROBOT.limits.effort is None
    assert ROBOT.joint_names == ("limb_1", "limb_2", "limb_3")
    bare = schema.build(UprRpu, {k: v for k, v in FILE.items() if k != "limits"})
    assert bare.limits.position is None
    assert bare.limits.joint_angle is None


def changed_file(dotted, value):
    data = copy.deepcopy(FILE)
    *path, last = dotted.split(".")
    section = data
    for key in path:
        section = section[key]
    if isinstance(last, str) and last.isdigit():
        section[int(last)] = value
    else:
        section[last] = value
    return data


@pytest.mark.parametrize(
    ("dotted", "value", "field"),
    [
        ("geometry.base_radius", 0.0, "geometry.base_radius"),
        ("geometry.platform_radius", math.nan, "geometry.platform_radius"),
        ("members.youngs_modulus", -1.0, "members.youngs_modulus"),
        ("members.shear_modulus", 0.0, "members.shear_modulus"),
        ("members.diameter", [0.1, -0.1, 0.1], "members.diameter[1]"),
        ("members.diameter", 1e-90, "members.diameter[0]"),
        ("members.diameter", [0.1, 0.1], "members.diameter"),
        ("members.shear_factor", -0.1, "members.shear_factor"),
        ("joints_compliance.upr_revolute", [1e-10] * 5, "joints_compliance.upr_revolute"),
        (
            "joints_compliance.upr_revolute",
            [1e-10, math.inf, 1e-10, 1e-11, math.inf, 1e-11],
            "joints_compliance.upr_revolute[1]",
        ),
        (
            "joints_compliance.upr_revolute",
            [1e-10, 1e-10, 1e-10, 1e-11, 1e-11, 1e-11],
            "joints_compliance.upr_revolute[4]",
        ),
        (
            "joints_compliance.upr_universal",
            [1e-10, 1e-10, 1e-10, math.inf, math.inf, math.inf],
            "joints_compliance.upr_universal[5]",
        ),
        (
            "joints_compliance.rpu_universal",
            [1e-10, 1e-10, -1e-10, math.inf, math.inf, 1e-11],
            "joints_compliance.rpu_universal[2]",
        ),
        (
            "joints_compliance.rpu_revolute",
            [1e-10, 1e-10, math.nan, math.inf, 1e-11, 1e-11],
            "joints_compliance.rpu_revolute[2]",
        ),
        ("limits.limb_length", [1.0, 0.3], "limits.limb_length"),
        ("limits.limb_length", [0.0, 0.3], "limits.limb_length[0]"),
        ("limits.joint_angle", 0.0, "limits.joint_angle"),
        ("joints", ["a", "a", "b"], "joints"),
    ],
)
def test_refused_values_are_named(dotted, value, field):
    with pytest.raises(ParameterError) as caught:
        schema.build(UprRpu, changed_file(dotted, value))
    assert caught.value.field == field
