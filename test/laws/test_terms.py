# SPDX-License-Identifier: Apache-2.0
"""Laws of the split of the actuator efforts by cause."""

from dataclasses import fields

import numpy as np
import pytest

from delta_dynamics import Terms, dynamics_terms, inverse_dynamics, mass_matrix
from pkm_twin.errors import ParameterError, UnreachableError
from test.support.bodies import bodies, rubs
from test.support.robots import FREE, load, loaded, massive, massless, random_motion

NAMES = tuple(field.name for field in fields(Terms))


def close(a, b, tolerance=1e-12):
    size = max(np.abs(a).max(), np.abs(b).max(), 1e-300)
    np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * size)


@massive
def test_the_terms_sum_to_inverse_dynamics(name, rng):
    robot = loaded(name)
    motion = random_motion(robot, rng, 300)
    terms = dynamics_terms(robot, *motion)
    tau = inverse_dynamics(robot, *motion)
    largest = np.max([np.abs(getattr(terms, n)) for n in NAMES], (0, -1))
    assert (np.abs(terms.total - tau).max(-1) <= 1e-12 * largest).all()


@massive
def test_each_term_has_its_own_cause_and_power(name, rng):
    robot = loaded(name)
    q, qd, qdd, wrench = random_motion(robot, rng, 50)
    one = dynamics_terms(robot, q, qd, qdd, wrench)
    two = dynamics_terms(robot, q, 2 * qd, 3 * qdd, 5 * wrench)
    close(two.gravity, one.gravity)
    close(two.inertia, 3 * one.inertia)
    close(two.velocity, 4 * one.velocity)
    close(two.external, 5 * one.external)
    up = robot.changed(gravity=-2 * robot.gravity)
    close(dynamics_terms(up, q, qd, qdd).gravity, -2 * one.gravity)


@massive
def test_terms_against_what_they_stand_for(name, rng):
    robot = loaded(name)
    q, qd, qdd, wrench = random_motion(robot, rng, 50)
    terms = dynamics_terms(robot, q, qd, qdd, wrench)
    bare = robot.changed(payload={"mass": 0.0, "inertia": [0.0] * 3})
    close(terms.inertia, np.einsum("nij,nj->ni", mass_matrix(bare, q), qdd), 1e-11)
    rubbing = robot.friction.viscous * qd + robot.friction.coulomb * np.sign(qd)
    rubbing += sum(rub.efforts for rub in rubs(robot, bodies(robot, q, qd, qdd), q, qd))
    np.testing.assert_allclose(terms.friction, rubbing, atol=1e-12 * np.abs(terms.velocity).max())
    jacobian = robot.platform_jacobian(q)
    close(terms.external, -np.einsum("nij,ni->nj", jacobian, wrench), 1e-11)
    added = inverse_dynamics(robot, q, qd, qdd) - inverse_dynamics(bare, q, qd, qdd)
    close(terms.payload, added, 1e-11)


@massive
def test_absent_causes_give_exact_zeros(name, rng):
    robot = load(name).changed(friction=FREE, payload={"mass": 0.0, "inertia": [0.0] * 3})
    q, qd, qdd, _ = random_motion(robot, rng, 20)
    terms = dynamics_terms(robot, q, qd, qdd)
    for absent in ("payload", "external"):
        assert not getattr(terms, absent).any()
    passive = rubs(robot, bodies(robot, q, qd, qdd), q, qd)
    assert terms.friction.any() == bool(passive)
    still = dynamics_terms(robot.changed(gravity=[0, 0, 0]), q, 0 * qd, 0 * qd)
    assert not still.total.any()


@massive
def test_every_term_has_the_common_batch_shape(name, rng):
    robot = loaded(name)
    q, qd, qdd, wrench = (value[0] for value in random_motion(robot, rng, 1))
    wide = np.tile(wrench, (4, 2, 1))
    terms = dynamics_terms(robot, q, qd[None], qdd, wide)
    single = dynamics_terms(robot, q.tolist(), qd.tolist(), qdd, wrench)
    for n in NAMES:
        assert getattr(terms, n).shape == (4, 2, len(robot.joint_names))
        np.testing.assert_array_equal(getattr(terms, n)[3, 1], getattr(single, n))


@massive
def test_faults_are_those_of_inverse_dynamics(name, rng):
    robot = load(name)
    q, qd, qdd, wrench = (value[0] for value in random_motion(robot, rng, 1))
    with pytest.raises(ValueError, match="last axis"):
        dynamics_terms(robot, q, qd[:-1], qdd)
    with pytest.raises(ValueError, match="last axis"):
        dynamics_terms(robot, q, qd, qdd, wrench[:3])
    for position in range(4):
        values = [q.copy(), qd.copy(), qdd.copy(), wrench.copy()]
        values[position][1] = np.nan
        with pytest.raises(ValueError, match="finite"):
            dynamics_terms(robot, *values)


def test_an_unreachable_state_is_named(variant):
    robot, _ = variant("delta", geometry={"arm_length": 0.6})
    with pytest.raises(UnreachableError) as caught:
        dynamics_terms(robot, [[1.2] * 3, [0.0] * 3], np.zeros(3), np.zeros(3))
    assert caught.value.index == (1,)


def test_a_robot_without_masses_is_refused(tmp_path):
    robot = load(massless(tmp_path / "light.yaml"))
    with pytest.raises(ParameterError, match="inertia"):
        dynamics_terms(robot, *np.ones((3, len(robot.joint_names))))
