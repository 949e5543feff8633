# SPDX-License-Identifier: Apache-2.0
"""The judges beside each other: engines that share a description and what joints hold."""

import importlib

import numpy as np
import pytest

from pkm_twin.certify.certificate import ENGINES, certificate_of, effort_differences, relative
from pkm_twin.certify.description import expand, read
from pkm_twin.certify.maximal import Maximal
from pkm_twin.certify.states import random_states
from pkm_twin.machine.joints import TYPES
from test.machine.random_machines import FREE, NAMES, plain, variant
from test.machine.test_helical import driven, slide
from test.machine.test_planar import puck
from test.support.robots import partly_long

BOUNDS = {"pinocchio": 1e-11, "mujoco": 1e-8}
"""Two routes in double precision; MuJoCo's bodies all have some inertia."""


def judge_of(engine, description):
    pytest.importorskip(engine, reason=f"{engine} is not installed")
    module, kind = ENGINES[engine][0].split(":")
    return getattr(importlib.import_module(module), kind)(description)


# Each machine by default to one judge, as it is or in other dimensions.
ROUTES = [(name, engine, number) for name in NAMES for engine in BOUNDS for number in (0, 1)]
BY_DEFAULT = [
    (name, list(BOUNDS)[k % len(BOUNDS)], k // len(BOUNDS) % 2) for k, name in enumerate(NAMES)
]


@pytest.mark.parametrize("route", partly_long(ROUTES, *BY_DEFAULT), ids=str)
def test_routes_agree(route):
    name, engine, number = route
    bound = BOUNDS[engine]
    rng = np.random.default_rng([11, NAMES.index(name), number])
    description = variant(name, rng) if number else plain(name)
    one, other = Maximal(description), judge_of(engine, description)
    states = random_states(one, rng, 1)
    samples = list(zip(states.q, states.qd, states.qdd, states.wrench, strict=True))
    got = np.array([one.inverse_dynamics(*sample) for sample in samples])
    expected = np.array([other.inverse_dynamics(*sample) for sample in samples])
    assert effort_differences(got, expected).max() < bound
    for q in states.q:
        for mine, theirs in zip(one.platform(q), other.platform(q), strict=True):
            assert np.abs(mine - theirs).max() < 1e-11
        assert relative(one.jacobian(q), other.jacobian(q)) < 1e-11
        assert relative(one.mass_matrix(q), other.mass_matrix(q)) < bound


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
        result = certificate_of(robot, states=2)
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
