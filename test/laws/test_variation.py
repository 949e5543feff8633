# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Robots whose parameters are drawn about their file's."""

import numpy as np
import pytest

from pkm_twin.errors import ParameterError
from pkm_twin.robot.variation import KINDS, vary_robot
from test.support.robots import every_robot, load

RIGID = dict.fromkeys(("masses", "inertias", "friction"), 0.05)


@every_robot
def test_the_same_seed_draws_the_same_and_nothing_is_left_out(name):
    robot = load(name)
    one, two, other = (vary_robot(robot, RIGID, seed) for seed in (1, 1, 2))
    assert one.drawn == two.drawn
    assert (one.robot.own_inertial == two.robot.own_inertial).all()
    assert set(one.drawn) == set(other.drawn)
    assert all(one.drawn[key] != other.drawn[key] for key in one.drawn)
    # Every number of the dynamics that is not zero has moved, but gravity.
    changed = one.robot.own_inertial != robot.own_inertial
    gravity = slice(*robot._layout.starts[2:4])
    assert changed[: gravity.start][np.abs(robot.own_inertial[: gravity.start]) > 1e-12].all()
    assert not changed[gravity].any()


@every_robot
def test_no_spread_is_the_robot_itself(name):
    robot = load(name)
    none = vary_robot(robot, dict.fromkeys(KINDS, 0.0), 1)
    assert none.robot is robot and not none.drawn


def test_draws_have_the_stated_spread():
    robot = load("delta_cu")
    for distribution, deviation, bound in (("normal", 1.0, 3.0), ("uniform", 3**-0.5, 1.0)):
        draws = [vary_robot(robot, {"masses": 0.1}, seed, distribution).drawn for seed in range(40)]
        d = np.array([list(draw.values()) for draw in draws]) / 0.1 - 10.0
        assert np.abs(d).max() <= bound
        assert abs(d.std() / deviation - 1.0) < 0.2
        assert abs(d.mean()) < 0.3


def test_one_kind_leaves_the_draws_of_the_others():
    robot = load("delta_cu")
    both, one = (vary_robot(robot, kinds, 3).drawn for kinds in (RIGID, {"masses": 0.05}))
    assert one == {key: value for key, value in both.items() if key in one}


def test_lengths_change_the_machine_and_not_its_closures():
    robot = load("delta_cu")
    made = vary_robot(robot, {"lengths": 0.01}, 1).robot
    pose = made.home()
    assert np.abs(made.forward(made.inverse(pose)) - pose).max() < 1e-12
    assert np.abs(made.inverse(pose) - robot.inverse(pose)).max() > 1e-4


@pytest.mark.parametrize("spread", [{"masses": 0.5}, {"masses": float("nan")}, {"mass": 0.1}])
def test_what_is_no_spread_is_refused(spread):
    with pytest.raises(ParameterError):
        vary_robot(load("delta_cu"), spread, 1)
