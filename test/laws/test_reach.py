# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The box that a platform cannot leave: it holds every place, and follows the shortest chain."""

from __future__ import annotations

import numpy as np
import pytest

from pkm_twin import Robot
from pkm_twin.errors import ParameterError
from pkm_twin.machine.reach import position_box
from pkm_twin.mechanisms.catalogue import robot_of_data
from test.support.robots import every_robot, joint_range, load


def slide(limits: object) -> Robot:
    """One slide along z from its home value 0.1, and the platform's reference point beside it."""
    data = {
        "mechanism": "machine",
        "platform": "table",
        "origin": [0.3, 0.0, 1.0],
        "pose": ["z"],
        "bodies": {"table": {"mass": 1.0, "com": [0, 0, 1.0], "inertia": [0.1, 0.1, 0.1]}},
        "joints": {
            "rail": {
                "type": "prismatic",
                "between": ["base", "table"],
                "at": [0, 0, 1.0],
                "axis": [0, 0, 1],
                "actuated": True,
                "home": 0.1,
                **({} if limits is None else {"limits": {"position": limits}}),
            }
        },
    }
    return robot_of_data(data, "slide")


@pytest.mark.parametrize("limits", [[0.0, 0.6], [-0.4, 0.1]])
def test_a_slide_reaches_as_far_as_its_farther_limit(limits) -> None:
    """Half a metre of travel either way of home, and 0.3 m to the reference point."""
    robot = slide(limits)
    box = position_box(robot.graph, robot.limits.position)
    np.testing.assert_allclose(box, [[-0.8, 0.8], [-0.8, 0.8], [0.2, 1.8]])
    places = robot.platform(np.array(limits)[:, None])[0]
    assert ((places >= box[:, 0]) & (places <= box[:, 1])).all()


def test_a_slide_without_limits_has_no_end() -> None:
    robot = slide(None)
    with pytest.raises(ParameterError) as caught:
        position_box(robot.graph, robot.limits.position)
    assert caught.value.field == "joints.rail.limits.position"


@every_robot
def test_no_platform_leaves_its_box(name: str) -> None:
    robot = load(name)
    box = position_box(robot.graph, robot.limits.position)
    middle, half = joint_range(robot)
    q = middle + half / 0.7 * np.random.default_rng(1).uniform(-1.0, 1.0, (500, len(middle)))
    good = robot.try_forward(q)[1]
    places = robot.platform(q[good])[0]
    assert len(places) > 50
    assert ((places >= box[:, 0]) & (places <= box[:, 1])).all()
