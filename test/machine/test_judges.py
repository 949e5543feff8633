# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The judges beside each other: engines that share a description and what joints hold."""

import numpy as np
import pytest

from pkm_twin.certify.certificate import certify_robot
from pkm_twin.certify.description import expand, read
from pkm_twin.certify.maximal import Maximal, random_states
from pkm_twin.machine.joints import TYPES
from test.machine.random_machines import FREE, NAMES, plain
from test.machine.test_helical import driven, slide
from test.machine.test_planar import puck
from test.support.robots import partly_long


@pytest.mark.parametrize("name", partly_long(NAMES, *NAMES[::4]))
def test_efforts_are_the_energy_s_rate(name):
    """Without friction, the efforts' and the wrench's power is the energy's rate."""
    description = expand(plain(name))
    for joint in description["joints"].values():
        joint.pop("friction", None)
    judge, rng = Maximal(description), np.random.default_rng(5)
    state = random_states(judge, rng, 1)
    q, qd, qdd, wrench = state.q[0], state.qd[0], state.qdd[0], state.wrench[0]
    tau = judge.inverse_dynamics(q, qd, qdd, wrench)
    power = tau @ qd + wrench @ judge.jacobian(q) @ qd

    def energy(t):
        return sum(judge.energy(q + t * qd + t * t / 2 * qdd, qd + t * qdd))

    h = 1e-3
    slope = (8 * (energy(h) - energy(-h)) - (energy(2 * h) - energy(-2 * h))) / (12 * h)
    scale = np.abs(tau * qd).sum() + np.abs(wrench @ judge.jacobian(q) @ qd)
    assert abs(power - slope) < 1e-6 * scale


@pytest.mark.parametrize("name", partly_long(NAMES, *NAMES[1::4]))
def test_jacobian_is_the_places_slope(name):
    judge = Maximal(plain(name))
    q = random_states(judge, np.random.default_rng(6), 1).q[0]
    jacobian, (_, rotation) = judge.jacobian(q), judge.platform(q)
    h = 1e-5
    for k, step in enumerate(np.eye(len(q)) * h):
        (after, turned), (before, back) = judge.platform(q + step), judge.platform(q - step)
        slope = (turned - back) / (2 * h) @ rotation.T
        spin = np.array([slope[2, 1], slope[0, 2], slope[1, 0]])
        twist = np.concatenate([(after - before) / (2 * h), spin])
        assert np.abs(twist - jacobian[:, k]).max() < 1e-7 * max(1.0, np.abs(jacobian).max())


def test_screws_and_tables_are_certified_by_all():
    robots = slide(0.02), slide(-0.3), driven(0.5, [0.2, 0.05, 0.0]), puck(table=True)
    for robot in robots:
        result = certify_robot(robot, states=2)
        assert not result.missing and result.good, [i for i in result.items if not i.good]


def test_every_joint_type_is_there_and_every_machine_varies():
    kinds = {joint.type.name for name in NAMES for joint in read(plain(name)).joints}
    assert kinds | {"helical", "planar"} == set(TYPES)
    assert set(FREE) == set(NAMES)


def test_home_is_home():
    for name in NAMES:
        judge = Maximal(plain(name))
        position, rotation = judge.platform(judge.machine.home)
        assert np.abs(rotation - np.eye(3)).max() < 1e-15
        assert np.abs(position - judge.machine.origin).max() < 1e-15
