# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Laws that the dynamics of every robot with masses keeps."""

import numpy as np
import pytest

from delta_dynamics import energy, forward_dynamics, inverse_dynamics, mass_matrix
from test.support.bodies import bodies, rubs
from test.support.robots import load, loaded, massive, parameters_of, random_motion

pytestmark = massive


def states(robot, rng, count):
    return random_motion(robot, rng, count)[:3]


@pytest.fixture
def robot(name):
    return loaded(name)


def test_efforts_are_the_virtual_work_of_all_bodies(name, robot, rng):
    """The compiled torques against the sum over bodies, Jacobian by Jacobian, on numbers."""
    q, qd, qdd = states(robot, rng, 100)
    wrench = rng.normal(0.0, 10.0, (100, 6))
    all_ = bodies(robot, q, qd, qdd)
    force = all_.mass[:, None] * (all_.acceleration - robot.gravity)
    expected = np.einsum("nbij,nbi->nj", all_.linear, force)
    expected += np.einsum("nbij,nbi->nj", all_.angular, all_.moment)
    expected -= np.einsum("nkj,nk->nj", robot.platform_jacobian(q), wrench)
    expected += robot.friction.viscous * qd + robot.friction.coulomb * np.sign(qd)
    expected += rotors(robot) * qdd + sum(rub.efforts for rub in rubs(robot, all_, q, qd))
    size = np.maximum(1.0, np.abs(expected).max())
    np.testing.assert_allclose(inverse_dynamics(robot, q, qd, qdd, wrench), expected, rtol=1e-11, atol=1e-11 * size)


def rotors(robot):
    """Rotor inertias of the actuated joints, shape (n,)."""
    return np.array([robot.graph.joints[name].rotor_inertia for name in robot.joint_names])


def summed(robot, q, qd, qdd):
    """All bodies, and the mass matrix as their sum, which the compiled one is."""
    all_ = bodies(robot, q, qd, qdd)
    matrix = np.einsum("nbij,b,nbik->njk", all_.linear, all_.mass, all_.linear)
    matrix += np.einsum("nbij,nbil,nblk->njk", all_.angular, all_.inertia, all_.angular)
    matrix += np.diag(rotors(robot))
    found = mass_matrix(robot, q)
    np.testing.assert_allclose(found, matrix, rtol=1e-11, atol=1e-12 * np.abs(matrix).max())
    return all_, found


def test_energy_and_mass_matrix_are_the_sums_over_all_bodies(name, robot, rng):
    q, qd, qdd = states(robot, rng, 100)
    all_, found = summed(robot, q, qd, qdd)
    assert (np.linalg.eigvalsh(found) > 0).all()
    both = energy(robot, q, qd)
    kinetic = np.einsum("ni,nij,nj->n", qd, found, qd) / 2
    np.testing.assert_allclose(both.kinetic, kinetic, rtol=1e-11)
    potential = -np.einsum("b,nbi,i->n", all_.mass, all_.com, robot.gravity)
    np.testing.assert_allclose(both.potential, potential, rtol=1e-11, atol=1e-12)
    np.testing.assert_array_equal(both.total, both.kinetic + both.potential)


def test_forward_dynamics_undoes_inverse(name, robot, rng):
    q, qd, qdd = states(robot, rng, 100)
    wrench = rng.normal(0.0, 10.0, (100, 6))
    tau = inverse_dynamics(robot, q, qd, qdd, wrench)
    np.testing.assert_allclose(forward_dynamics(robot, q, qd, tau, wrench), qdd, rtol=1e-9, atol=1e-9)


def test_a_control_loop_fills_its_arrays_with_the_torques(name, robot, rng):
    loop = robot.torque_loop(samples=3)
    loop.q[:], loop.qd[:], loop.qdd[:] = states(robot, rng, 3)
    loop.wrench[:] = rng.normal(0.0, 10.0, (3, 6))
    assert loop() == 0
    np.testing.assert_array_equal(loop.tau, inverse_dynamics(robot, loop.q, loop.qd, loop.qdd, loop.wrench))
    loop.qd[1] = np.inf
    assert loop() == 2 and np.isnan(loop.tau[1]).all()


def heavier_sections(data, times):
    """Sections of a robot's file with every mass, and the inertia beside it, so many times."""

    def scaled(value):
        if isinstance(value, list):
            return [scaled(v) for v in value]
        return times * value if isinstance(value, float | int) else value

    def walked(place):
        if not isinstance(place, dict):
            return place
        return {
            k: scaled(v) if k.endswith("mass") or k in ("density", "inertia") else walked(v) for k, v in place.items()
        }

    if "inertia" in data:
        masses = ("mass", "density")
        return {"inertia": {k: times * v for k, v in data["inertia"].items() if k.endswith(masses)}}
    return {k: walked(data[k]) for k in ("bodies", "rods", "limbs") if k in data}


def test_machines_of_one_geometry_keep_their_own_masses(name, variant, rng):
    """Two robots share compiled programs; masses, rotors and friction are each its own."""
    robot, (other, _) = load(name), variant(name, **heavier_sections(parameters_of(name), 3.0))
    assert other.engine is robot.engine
    q, qd, qdd = states(robot, rng, 10)
    found = [summed(machine, q, qd, qdd)[1] for machine in (robot, other, robot)]
    traces = [matrix.trace(axis1=1, axis2=2) for matrix in found]
    assert (np.abs(traces[1] / traces[0] - 1.0) > 0.05).all()
