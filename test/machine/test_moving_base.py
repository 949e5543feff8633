# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Efforts on a base that moves, compared with engines whose base hangs on six more joints."""

import copy
import itertools

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin.certify.description import expand
from pkm_twin.certify.maximal import Maximal, random_states, rotation_of
from pkm_twin.errors import ParameterError
from pkm_twin.mechanisms.catalogue import robot_of_data
from test.machine.random_machines import plain, variant
from test.support.robots import load, partly_long

BOUND = 1e-11
"""Largest difference, relative to the largest effort."""
MACHINES = (
    "delta_rcu",
    "delta_translation",
    "hinged_platform",
    "linear_delta",
    "platform_motor",
    "prru3",
    "rcuu",
    "rps3",
    "rsur",
    "upr_rpu",
)
"""Bodies on balls, free bodies, rods, slides and universal joints, of other dimensions."""
STATES = 3
pytestmark = pytest.mark.usefixtures("quickly_compiled")
ENGINES = {"pinocchio": "PinocchioTree", "mujoco": "MujocoTree"}


def engine(name):
    pytest.importorskip(name)
    module = __import__(f"pkm_twin.certify.{name}_tree", fromlist=[ENGINES[name]])
    return getattr(module, ENGINES[name])


def carried(description):
    """A machine whose base is a body ``ground`` on three slides and three turns, all driven."""
    data = expand(copy.deepcopy(description))
    for part in (*data["joints"].values(), *data["rods"].values()):
        part["between"] = ["ground" if end == "base" else end for end in part["between"]]
    chain, joints = ["base", *(f"carrier_{k}" for k in range(5)), "ground"], {}
    for k, (inner, outer) in enumerate(itertools.pairwise(chain)):
        data["bodies"][outer] = {}
        joints[f"move_{k}"] = {
            "type": "prismatic" if k < 3 else "revolute",
            "between": [inner, outer],
            "at": [0.0, 0.0, 0.0],
            "axis": np.eye(3)[k % 3].tolist(),
            "actuated": True,
        }
    data["joints"] = joints | data["joints"]
    return data


def shaken(judge, q, qd, qdd, wrench, rng):
    """Efforts of the machine's drives on a shaken ground, and the ground's motion in its axes."""
    at, rates, changes = (
        np.concatenate([rng.uniform(-size, size, 6), own]) for size, own in ((0.3, q), (2.0, qd), (20.0, qdd))
    )
    judge.assemble(at)
    tangent = judge.tangent()
    judge.set_velocities(tangent @ rates)
    full = judge.solve(-judge.closures().bias, changes - judge.drives().bias)
    turned = judge.frame("ground").rotation
    spin, origin = judge.spin("ground"), judge.point("ground", np.zeros(3))
    change = origin.columns @ full + origin.bias - judge.machine.gravity
    base = [spin.columns @ (tangent @ rates), spin.columns @ full + spin.bias, change]
    world = np.concatenate([turned @ wrench[:3], turned @ wrench[3:]])
    efforts = judge.inverse_dynamics(at, rates, changes, world)[6:]
    return efforts, np.concatenate([turned.T @ part for part in base])


def check(robot, description, judge_of, rng):
    s = random_states(Maximal(description), rng, STATES)
    judge = judge_of(carried(description))
    states = zip(s.q, s.qd, s.qdd, s.wrench, strict=True)
    pairs = zip(*(shaken(judge, *state, rng) for state in states), strict=True)
    efforts, base = (np.array(values) for values in pairs)
    found = inverse_dynamics(robot, s.q, s.qd, s.qdd, s.wrench, base)
    at_rest = inverse_dynamics(robot, s.q, s.qd, s.qdd, s.wrench)
    size = np.abs(efforts).max()
    assert np.abs(at_rest - efforts).max() > 1e-3 * size
    assert np.abs(found - efforts).max() < BOUND * size
    one = inverse_dynamics(robot, s.q[0], s.qd[0], s.qdd[0], s.wrench[0], base[0])
    np.testing.assert_array_equal(one, found[0])


@pytest.mark.parametrize("name", partly_long(ENGINES, "pinocchio"))
def test_a_hexapod_on_a_shaking_base(name):
    robot, rng = load("stewart"), np.random.default_rng(1)
    check(robot, plain("stewart"), engine(name), rng)


@pytest.mark.parametrize("name", partly_long(MACHINES, "rps3"))
def test_random_machines_on_a_moving_base(name):
    rng = np.random.default_rng([20261128, MACHINES.index(name)])
    description = variant(name, rng)
    check(robot_of_data(description, "machine"), description, engine("pinocchio"), rng)


def test_a_tilted_base_at_rest_is_tilted_gravity():
    robot, rng = load("delta_cu"), np.random.default_rng(2)
    turned = rotation_of(rng.normal(size=3))
    q, still = robot.inverse(robot.home()), np.zeros(3)
    base = np.concatenate([np.zeros(6), -turned.T @ robot.gravity])
    tilted = robot.changed(gravity=(turned.T @ robot.gravity).tolist())
    np.testing.assert_array_equal(
        inverse_dynamics(robot, q, still, still, base=base),
        inverse_dynamics(tilted, q, still, still),
    )
    with pytest.raises(ValueError, match="9"):
        inverse_dynamics(robot, q, still, still, base=base[:6])


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_motion_of_the_base_that_is_not_finite_is_rejected_by_name(value):
    robot = load("delta")
    still = np.zeros(3)
    with pytest.raises(ParameterError) as error:
        inverse_dynamics(robot, still, still, still, base=[0.0] * 8 + [value])
    assert error.value.field == "base"
