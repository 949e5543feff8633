# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Laws of the split of the actuator efforts by cause."""

from dataclasses import fields

import numpy as np

from delta_dynamics import Terms, dynamics_terms, inverse_dynamics, mass_matrix
from test.support.bodies import bodies, rubs
from test.support.robots import FREE, load, loaded, massive, random_motion

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
