# SPDX-License-Identifier: Apache-2.0
"""Laws that the dynamics of every robot with masses keeps."""

import os
import subprocess
import sys

import numpy as np
import pytest

from delta_dynamics import energy, forward_dynamics, inverse_dynamics, mass_matrix
from delta_dynamics.virtual_work import bodies
from pkm_twin import load, robot_names
from pkm_twin.errors import SingularityError, UnreachableError
from test.conftest import finite_difference, random_joints

MASSIVE = [name for name in robot_names() if load(name).dynamics_kernel is not None]
LOADED = {
    "payload": {"mass": 0.3, "com": [0.01, -0.02, -0.04], "inertia": [4e-4, 5e-4, 3e-4]},
    "gravity": [0.5, -1.0, -9.7],
    "friction": {"viscous": [0.1, 0.2, 0.3], "coulomb": [0.05, 0.06, 0.07]},
}
FRICTIONLESS = {"viscous": [0.0] * 3, "coulomb": [0.0] * 3}

pytestmark = pytest.mark.parametrize("name", MASSIVE)


def states(robot, rng, count):
    """Positions, rates and accelerations of a size that suits the joint's unit."""
    scale = 1.0 if robot.joint_unit == "rad" else 0.2
    q = random_joints(robot, rng, count)
    return q, *(scale * rng.normal(0.0, spread, (count, 3)) for spread in (3.0, 30.0))


@pytest.fixture
def robot(name):
    return load(name).changed(**LOADED)


def test_forward_undoes_inverse(name, robot, rng):
    q = random_joints(robot, rng, 500)
    pose = robot.forward(q)
    np.testing.assert_allclose(robot.inverse(pose), q, atol=1e-11)
    np.testing.assert_allclose(robot.forward(robot.inverse(pose)), pose, atol=1e-11)


def test_jacobian_is_the_derivative_of_forward(name, robot, rng):
    q = random_joints(robot, rng, 50)
    np.testing.assert_allclose(
        robot.jacobian(q), finite_difference(robot.forward, q), rtol=1e-6, atol=1e-7
    )


def test_power_is_the_rate_of_energy(name, robot, rng):
    """tau . qd = dE/dt along random motions q(t), by a five-point stencil in t."""
    robot = robot.changed(friction=FRICTIONLESS)
    q, qd, qdd = states(robot, rng, 100)
    jerk = rng.normal(0.0, 10.0, q.shape)

    def total(t):
        return energy(
            robot, q + t * qd + t**2 / 2 * qdd + t**3 / 6 * jerk, qd + t * qdd + t**2 / 2 * jerk
        ).total

    h = 2e-4
    rate = (8 * (total(h) - total(-h)) - (total(2 * h) - total(-2 * h))) / (12 * h)
    power = np.sum(inverse_dynamics(robot, q, qd, qdd) * qd, -1)
    np.testing.assert_allclose(power, rate, rtol=1e-7, atol=1e-8 * np.abs(rate).max())


def test_efforts_are_the_virtual_work_of_all_bodies(name, robot, rng):
    """The kernel against the sum over the rows that reactions and energies are made of."""
    q, qd, qdd = states(robot, rng, 100)
    wrench = rng.normal(0.0, 10.0, (100, 6))
    rows, twist = bodies(robot, q, qd, qdd)
    force = rows[..., 0:1] * (rows[..., 4:7] - robot.gravity)
    linear, angular = (rows[..., k : k + 9].reshape(*rows.shape[:-1], 3, 3) for k in (10, 19))
    expected = np.einsum("nbjk,nbk->nj", linear, force)
    expected += np.einsum("nbjk,nbk->nj", angular, rows[..., 7:10])
    expected -= np.einsum("nkj,nk->nj", twist, wrench)
    expected += robot.friction.viscous * qd + robot.friction.coulomb * np.sign(qd)
    np.testing.assert_allclose(
        inverse_dynamics(robot, q, qd, qdd, wrench), expected, rtol=1e-11, atol=1e-11
    )


def test_external_power_reaches_the_actuators(name, robot, rng):
    """A wrench changes tau . qd by less its power on the platform's twist."""
    q, qd, qdd = states(robot, rng, 100)
    wrench = rng.normal(0.0, 10.0, (100, 6))
    change = inverse_dynamics(robot, q, qd, qdd, wrench) - inverse_dynamics(robot, q, qd, qdd)
    twist = np.einsum("nij,nj->ni", robot.platform_jacobian(q), qd)
    np.testing.assert_allclose(
        np.sum(change * qd, -1), -np.sum(wrench * twist, -1), rtol=1e-10, atol=1e-10
    )


def test_linear_in_acceleration_with_the_mass_matrix(name, robot, rng):
    q, qd, qdd = states(robot, rng, 100)
    at_rest = inverse_dynamics(robot, q, qd, np.zeros(3))
    inertial = np.einsum("nij,nj->ni", mass_matrix(robot, q), qdd)
    np.testing.assert_allclose(
        inverse_dynamics(robot, q, qd, qdd), at_rest + inertial, rtol=1e-11, atol=1e-11
    )


def test_mass_matrix_is_symmetric_and_positive(name, robot, rng):
    still = robot.changed(gravity=[0, 0, 0], friction=FRICTIONLESS)
    q = random_joints(robot, rng, 100)
    raw = inverse_dynamics(still, q[:, None], np.zeros(3), np.eye(3))
    np.testing.assert_allclose(raw, raw.swapaxes(-1, -2), atol=1e-13 * np.abs(raw).max())
    assert (np.linalg.eigvalsh(mass_matrix(robot, q)) > 0).all()


def test_forward_dynamics_undoes_inverse(name, robot, rng):
    q, qd, qdd = states(robot, rng, 100)
    wrench = rng.normal(0.0, 10.0, (100, 6))
    tau = inverse_dynamics(robot, q, qd, qdd, wrench)
    np.testing.assert_allclose(
        forward_dynamics(robot, q, qd, tau, wrench), qdd, rtol=1e-9, atol=1e-9
    )


def test_friction_is_viscous_and_coulomb(name, robot, rng):
    q, qd, qdd = states(robot, rng, 20)
    qd[0] = 0.0
    free = robot.changed(friction=FRICTIONLESS)
    change = inverse_dynamics(robot, q, qd, qdd) - inverse_dynamics(free, q, qd, qdd)
    friction = robot.friction
    np.testing.assert_allclose(
        change, friction.viscous * qd + friction.coulomb * np.sign(qd), atol=1e-11
    )


@pytest.mark.parametrize("batch", [(), (4,), (4, 2), (0,)])
def test_batches_equal_single_samples(name, robot, rng, batch):
    q, qd, qdd = (x[: int(np.prod(batch))].reshape(*batch, 3) for x in states(robot, rng, 8))
    tau = inverse_dynamics(robot, q, qd, qdd)
    assert tau.shape == (*batch, 3)
    for index in np.ndindex(batch):
        np.testing.assert_array_equal(
            tau[index], inverse_dynamics(robot, q[index], qd[index], qdd[index])
        )


def test_broadcasts_and_takes_any_layout(name, robot, rng):
    q, qd, qdd = states(robot, rng, 6)
    full = inverse_dynamics(robot, q, np.tile(qd[0], (6, 1)), qdd)
    np.testing.assert_array_equal(inverse_dynamics(robot, q, qd[0], qdd), full)
    np.testing.assert_array_equal(inverse_dynamics(robot, q.tolist(), qd[0].tolist(), qdd), full)
    strided = np.asfortranarray(q)
    strided.setflags(write=False)
    np.testing.assert_array_equal(inverse_dynamics(robot, strided, qd[0], qdd), full)
    column = np.ascontiguousarray(np.stack([q[1], q[1]], -1))[:, 0]
    np.testing.assert_array_equal(inverse_dynamics(robot, column, qd[0], qdd[1]), full[1])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("which", range(4))
def test_values_that_are_not_finite_are_refused(name, robot, rng, bad, which):
    values = [x[0] for x in states(robot, rng, 1)] + [np.zeros(6)]
    values[which] = values[which].copy()
    values[which][1] = bad
    with pytest.raises(ValueError, match="finite"):
        inverse_dynamics(robot, *values)


def test_unreachable_names_limb_sample_and_miss(name, robot, rng):
    far = np.tile(robot.forward(random_joints(robot, rng, 1)[0]), (2, 3, 1))
    far[1, 2, -1 if robot.pose_names[2] == "z" else 0] = -50.0
    if robot.pose_names[0] == "z":
        far[1, 2] = [0.0, 1.4, 1.4]
    with pytest.raises((UnreachableError, SingularityError)) as caught:
        robot.inverse(far)
    assert caught.value.index == (1, 2)
    if isinstance(caught.value, UnreachableError):
        assert caught.value.limb in robot.limb_names
        assert caught.value.miss > 0


def test_wrong_last_axis_is_refused(name, robot):
    with pytest.raises(ValueError, match="last axis"):
        inverse_dynamics(robot, np.zeros(4), np.zeros(3), np.zeros(3))
    with pytest.raises(ValueError, match="last axis"):
        inverse_dynamics(robot, np.zeros((2, 3)), np.zeros(3), np.zeros(2))


def test_without_numba_the_numbers_are_the_same(name, rng):
    """The same formulas as plain Python, in a process of its own."""
    code = f"""
import numpy as np
from delta_dynamics import inverse_dynamics
from pkm_twin import load
from pkm_twin.codegen import kernels
assert not kernels.COMPILED
robot = load({name!r})
q = np.load("in.npy")
np.save("out.npy", inverse_dynamics(robot, q, 2 * q, 3 * q, np.ones(6)))
"""
    import tempfile

    robot = load(name)
    q = random_joints(robot, rng, 20)
    with tempfile.TemporaryDirectory() as folder:
        np.save(f"{folder}/in.npy", q)
        root = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
        environment = {
            **{k: v for k, v in os.environ.items() if k != "_ROS_WHEELS_BOOTSTRAP_COMPLETE"},
            "PKM_TWIN_NO_NUMBA": "1",
            "PYTHONPATH": root,
        }
        subprocess.run([sys.executable, "-c", code], cwd=folder, env=environment, check=True)
        plain = np.load(f"{folder}/out.npy")
    compiled = inverse_dynamics(robot, q, 2 * q, 3 * q, np.ones(6))
    np.testing.assert_allclose(plain, compiled, rtol=1e-12, atol=1e-12)
