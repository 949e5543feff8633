# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A transmission keeps power, and its derivatives, gains and limits are those of its positions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import linprog

from delta_dynamics import energy
from pkm_twin import load, transmission
from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.mechanisms.catalogue import robot_of_data
from test.machine.random_machines import variant
from test.machine.test_helical import slide
from test.support.robots import parameters_of, partly_long, without

GALLERY = Path(__file__).resolve().parents[2] / "examples/machines"
OWN = ("five_bar", "rps3", "delta", "linear_delta", "stewart", "prru")
RANDOM = ("gantry", "four_bar", "slider_crank", "rrr3_spherical", "rsur", "platform_motor")
REDUNDANT = ("rrr4_planar", "dual_scara")
NAMES = partly_long(
    (*OWN, *RANDOM, *REDUNDANT, "screw"),
    *("screw", "five_bar", "rps3", "rrr3_spherical", "slider_crank", "rrr4_planar", "gantry"),
)
some_machines = pytest.mark.parametrize("name", NAMES)
SAMPLES, STEP = 6, 3e-4


def made(name, *, even=True):
    """A machine with limits and a controller of other signs, ratios and zeros."""
    rng = np.random.default_rng(len(name))
    if name == "screw":
        robot = slide(0.02)
    elif name in RANDOM:
        robot = robot_of_data(variant(name, rng), name)
    else:
        ending = ".urdf" if name == "dual_scara" else ".yaml"
        path = GALLERY / f"{name}{ending}"
        robot = load(path if path.is_file() else name)
    n = robot.joints_count
    entries = {
        joint: {
            "name": f"motor {k}",
            "sign": float(rng.choice([-1, 1])),
            "offset": rng.normal(),
            "ratio": rng.uniform(0.2, 50.0),
            "ratio_change": 0.0 if even else rng.uniform(-0.3, 0.3),
        }
        for k, joint in enumerate(robot.joint_names)
    }
    limits = {"effort": rng.uniform(5.0, 50.0, n).tolist(), "velocity": rng.uniform(1.0, 9.0, n).tolist()}
    return robot.changed(limits=limits).changed(joint_map=entries)


def drawn(robot, seed=0):
    """Poses near home that are reached, velocities and efforts."""
    rng, n = np.random.default_rng(seed), robot.joints_count
    q = robot.inverse(robot.home()) + rng.uniform(-0.08, 0.08, (20 * SAMPLES, n))
    if robot.redundant:
        shift = rng.uniform(-0.03, 0.03, (20 * SAMPLES, len(robot.pose_names)))
        q, good = robot.try_inverse(robot.home() + shift)
        q = q[good]
    poses, good = robot.try_forward(q)
    around = np.vstack([poses[good][:, None] + 3.0 * STEP * s * np.eye(poses.shape[1]) for s in (-1.0, 1.0)])
    reached = robot.try_inverse(around)[1].reshape(2, -1, poses.shape[1]).all((0, 2))
    poses = poses[good][reached][:SAMPLES]
    assert len(poses) == SAMPLES
    return poses, *rng.normal(size=(2, *poses.shape))


def slopes(function, x):
    """Derivatives by central differences of sixth order, last axis."""
    weights = ((1, 3 / 4), (2, -3 / 20), (3, 1 / 60))
    return np.stack(
        [
            sum(c * (function(x + k * STEP * e) - function(x - k * STEP * e)) for k, c in weights) / STEP
            for e in np.eye(x.shape[-1])
        ],
        -1,
    )


@some_machines
def test_positions_rates_and_efforts_come_back_with_the_same_power(name):
    robot = made(name)
    t = transmission(robot)
    x, v, f = drawn(robot)
    there = t.joint_to_actuator(x, v, f)
    back = t.actuator_to_joint(there.position, there.velocity, there.effort)
    for found, right in ((back.position, x), (back.velocity, v), (back.effort, f)):
        np.testing.assert_allclose(found, right, atol=1e-9 * (1.0 + np.abs(right).max()))
    power = np.einsum("ij,ij->i", v, f)
    apart = np.abs(np.einsum("ij,ij->i", there.velocity, there.effort) - power)
    assert apart.max() < 1e-12 * np.abs(there.velocity * there.effort).sum(-1).max()
    np.testing.assert_array_equal(there.position, robot.controller.controller_positions(robot.inverse(x)))
    one = t.joint_to_actuator(x[0], v[0], f[0])
    np.testing.assert_allclose(one.effort, there.effort[0], rtol=1e-12, atol=1e-12)
    assert t.joint_to_actuator(x[:0], v[:0]).velocity.shape == (0, robot.joints_count)


@some_machines
@pytest.mark.parametrize("even", [True, False])
def test_the_ratio_is_the_slope_of_the_positions_and_bends_as_told(name, even):
    robot = made(name, even=even)
    t = transmission(robot)
    x, _, _ = drawn(robot)
    scale = np.abs(t.ratio(x)).max()
    found = slopes(lambda x: t.joint_to_actuator(x).position, x)
    np.testing.assert_allclose(t.ratio(x), found, atol=1e-8 * scale)
    curvature = t.curvature(x)
    found = slopes(t.ratio, x)
    np.testing.assert_allclose(curvature, found, atol=1e-8 * np.abs(curvature).max() + 1e-8 * scale)


@some_machines
def test_gains_give_the_closed_loop_the_stiffness_and_damping(name):
    robot = made(name)
    t = transmission(robot)
    x, _, f = drawn(robot)
    rng, m = np.random.default_rng(5), x.shape[-1]
    root = rng.normal(size=(2, m, m))
    wanted, damping = root @ root.swapaxes(-1, -2) * 100.0
    effort = t.joint_to_actuator(x, None, 20.0 * f).effort
    stiffness, rate_gain = t.gains(x, wanted, damping, effort)
    at_home = t.joint_to_actuator(x).position

    def applied(place, v):
        state = t.joint_to_actuator(place, v)
        away = state.position - at_home
        efforts = effort - (stiffness @ away[..., None])[..., 0]
        efforts = efforts - (rate_gain @ state.velocity[..., None])[..., 0]
        return t.actuator_to_joint(state.position, None, efforts).effort

    still = np.zeros_like(x)
    scale = np.abs(wanted).max() + np.abs(f).max()
    found = -slopes(lambda place: applied(place, still), x)
    np.testing.assert_allclose(found, np.broadcast_to(wanted, found.shape), atol=1e-6 * scale)
    found = -slopes(lambda v: applied(x, v), still)
    np.testing.assert_allclose(found, np.broadcast_to(damping, found.shape), atol=1e-6 * scale)
    plain = t.gains(x, np.diag(wanted), 3.0)
    same = t.gains(x, np.diag(np.diag(wanted)), 3.0 * np.eye(m))
    np.testing.assert_array_equal(plain, same)


@some_machines
def test_limits_are_the_largest_that_the_actuators_allow(name):
    robot = made(name)
    t = transmission(robot)
    x, _, _ = drawn(robot)
    factors = np.abs(robot.controller.factors)
    most, fastest = robot.limits.effort / factors, robot.limits.velocity * factors
    efforts, speeds, corners = t.effort_limits(x), t.velocity_limits(x), t.effort_polytope(x)
    n, m = robot.joints_count, x.shape[-1]
    assert corners.shape == (len(x), 2**n, m)
    for k, ratio in enumerate(t.ratio(x)):
        for j in range(m):
            # The largest effort s along one joint: B' t = s e_j, |t| <= limit.
            columns = np.hstack([ratio.T, -np.eye(m)[:, [j]]])
            bounds = [*((-a, a) for a in most), (None, None)]
            best = linprog([*np.zeros(n), -1.0], A_eq=columns, b_eq=np.zeros(m), bounds=bounds)
            np.testing.assert_allclose(efforts[k, j], [best.fun, -best.fun], rtol=1e-7)
            at_limit = np.abs(ratio[:, j] * speeds[k, j, 1]) / fastest
            assert at_limit.max() == pytest.approx(1.0)
        for way in np.random.default_rng(k).normal(size=(4, m)):
            far = (corners[k] @ way).max()
            assert far == pytest.approx(np.abs(ratio @ way) @ most)


@some_machines
def test_the_inertia_is_that_of_the_kinetic_energy(name):
    robot = made(name)
    t = transmission(robot)
    x, v, _ = drawn(robot)
    q = robot.inverse(x)
    rates = t.joint_to_actuator(x, v).velocity / robot.controller.factors
    right = energy(robot, q, rates).kinetic
    np.testing.assert_allclose(0.5 * np.einsum("ki,kij,kj->k", v, t.inertia(x), v), right, rtol=1e-9)


@pytest.mark.parametrize("even", [True, False])
def test_more_motors_share_the_effort_by_their_limits(even):
    robot = made("rrr4_planar", even=even)
    t = transmission(robot)
    x, _, f = drawn(robot)
    limit = robot.limits.effort / np.abs(robot.controller.slopes(robot.inverse(x)))
    own = t.joint_to_actuator(x, None, f).effort
    for ratio, efforts, most in zip(t.ratio(x), own, limit, strict=True):
        null = np.linalg.svd(ratio.T)[2][len(ratio.T) :]
        np.testing.assert_allclose(null @ (efforts / most**2), 0.0, atol=1e-12)


def test_what_cannot_be_converted_is_rejected_by_name():
    robot = robot_of_data(without(parameters_of("five_bar"), "limits"), "five_bar")
    t = transmission(robot)
    x = robot.home()
    for call in (t.effort_limits, t.velocity_limits, t.effort_polytope):
        with pytest.raises(ParameterError, match=r"limits\.(effort|velocity)"):
            call(x)
    with pytest.raises(ValueError, match=r"positions.*shape"):
        t.ratio([0.0])
    with pytest.raises(ValueError, match=r"velocities.*finite"):
        t.joint_to_actuator(x, [np.nan, 0.0])
    with pytest.raises(ParameterError, match=r"stiffness: .*shape"):
        t.gains(x, np.eye(3), 1.0)
    with pytest.raises(PkmTwinError):
        t.ratio(x + 5.0)
