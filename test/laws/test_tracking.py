# SPDX-License-Identifier: Apache-2.0
"""Streams keep their assembly mode; the edge of the workspace is where it is."""

import numpy as np
import pytest

from pkm_twin.errors import SingularityError
from pkm_twin.kinematics.tracking import follow, track
from test.support.robots import every_robot, load, random_poses


def stream(robot, rng, count):
    """A smooth path between two random joint states."""
    a, b = robot.inverse(random_poses(robot, rng, 2))
    s = np.sin(np.linspace(0, np.pi / 2, count))[:, None] ** 2
    return a + s * (b - a)


@every_robot
def test_a_stream_agrees_with_the_closed_form(name, rng):
    robot = load(name)
    q = stream(robot, rng, 60)
    np.testing.assert_allclose(track(robot, q), robot.forward(q), atol=1e-11)


@every_robot
def test_a_jump_is_refused(name, rng):
    robot = load(name)
    low, high = robot.limits.position.T
    near = low + 0.15 * (high - low)
    far = high - 0.15 * (high - low)
    with pytest.raises(SingularityError):
        follow(robot, far, robot.forward(near))


def test_the_previous_pose_leads():
    """A Delta whose platform was left above its elbows stays there, forward takes it below."""
    robot = load("delta")
    above = np.array([0.01, 0.005, 0.36])
    q = robot.inverse(above)
    beside = above + np.array([0.002, -0.001, 0.003])
    np.testing.assert_allclose(follow(robot, robot.inverse(beside), above), beside, atol=1e-11)
    assert robot.forward(q)[2] < 0
