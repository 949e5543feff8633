# SPDX-License-Identifier: Apache-2.0
"""The edge of the workspace is where it is."""

import numpy as np
import pytest

from pkm_twin import robot_names
from pkm_twin.kinematics.tracking import boundary_distance
from test.support.robots import load, partly_long, random_poses


def test_boundary_straight_below_is_the_stretched_limb(variant):
    """Over a tall narrow reach the nearest edge of a low pose is straight down."""
    robot, _ = variant("delta", limits={"position": [-3.1, 3.1]})
    g = robot.geometry
    lowest = -np.sqrt((g.arm_length + g.forearm_length) ** 2 - 0.036**2)
    pose = [0.0, 0.0, lowest + 0.01]
    distance = boundary_distance(robot, pose, singularity=0.0, directions=4000, farthest=0.3)
    assert 0.005 < distance <= 0.0101


@pytest.mark.parametrize(
    "name", partly_long(robot_names(), "delta_cu", "prru", "upr_rpu", "five_bar")
)
def test_boundary_distance_is_kept_inside_and_zero_outside(name, rng):
    robot = load(name)
    poses = random_poses(robot, rng, 5)
    distances = boundary_distance(robot, poses)
    assert (distances > 0).all()
    scale = robot.pose_scales
    for pose, distance in zip(poses, distances, strict=True):
        for direction in rng.normal(size=(20, len(scale))):
            moved = pose + 0.8 * distance * direction / np.linalg.norm(direction) / scale
            q = robot.inverse(moved)
            assert (q >= robot.limits.position[:, 0]).all()
            assert (q <= robot.limits.position[:, 1]).all()
    beyond = robot.limits.position[:, 1] + 0.05
    assert boundary_distance(robot, robot.forward(beyond)) == 0.0
