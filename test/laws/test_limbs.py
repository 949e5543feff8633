# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Limbs in closed form: their joints are those of all closures, and nothing else is accepted."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from delta_dynamics import (
    forward_dynamics,
    forward_dynamics_at_pose,
    inverse_dynamics,
    inverse_dynamics_at_pose,
    mass_matrix,
    mass_matrix_at_pose,
)
from pkm_twin.errors import PkmTwinError
from pkm_twin.kinematics.iterations import newton
from pkm_twin.kinematics.motion import Motion, closure_jacobians, to_floats
from pkm_twin.mechanisms.catalogue import robot_of_data
from test.machine.random_machines import NAMES as MACHINES
from test.machine.random_machines import variant
from test.machine.test_helical import slide
from test.support.robots import load, partly_long

NAMES = ("delta", "delta_cu", "five_bar", "linear_delta", "prru", "rps3", "stewart", "upr_rpu")
TEMPLATES = ("agile_eye", "exechon", "par4", "rrs3", "rss6", "tricept", "rrr3_planar")
ROBOTS = [*NAMES, *(f"examples/machines/{name}.yaml" for name in TEMPLATES)]
EVERY = partly_long(ROBOTS, "delta_cu", "five_bar", "rps3", "stewart", ROBOTS[9], ROBOTS[-1])


def hexapod(seed):
    """Of other dimensions than the shipped one's; every second one has legs off the feet."""
    rng = np.random.default_rng(seed)
    data = variant("stewart", rng)
    for name, joint in data["joints"].items():
        if name.startswith("leg") and seed % 2:
            joint["at"] = (np.array(joint["at"]) + 0.03 * rng.normal(size=3)).tolist()
    return robot_of_data(data, "hexapod")


def followed(engine, q, steps=128):
    """The unknowns at q by small steps of all closures; None where they end."""
    x, home = np.array(engine.tree.home, float), engine.graph.home
    for k in range(1, steps + 1):
        there = home + k / steps * (q - home)
        x, closed = newton(x, partial(engine._evaluate_closures, there), partial(engine._retract, there))
        if not closed:
            return None
    return x


def reached(robot, rng, count, reach=0.3):
    """Poses of joint positions at random about home."""
    scales = robot.joint_scales
    q = robot.graph.home + rng.uniform(-reach, reach, (count, robot.joints_count)) * scales
    return robot.try_forward(robot.try_project_redundant(q))[0]


@pytest.mark.parametrize("seed", partly_long([1, 2], 1))
def test_the_platform_is_that_of_all_closures(seed):
    robot = hexapod(seed)
    engine = robot.engine
    assert len(engine.limbs) == 5
    assert len(engine.reduced.limbs) == 6
    rng = np.random.default_rng(seed)
    q = engine.graph.home + rng.uniform(-0.15, 0.15, (400, 6)) * engine.tree.size
    pose, known = robot.try_forward(q)
    assert 20 < known.sum() < 400
    for k in np.flatnonzero(known)[:20]:
        x = followed(engine, q[k])
        position, _ = Motion(engine.tree, x, q[k]).platform()
        np.testing.assert_allclose(pose[k, :3], to_floats(position), atol=1e-10)


@pytest.mark.parametrize("seed", [1, 2])
def test_limbs_and_their_determinant_are_those_of_all_closures(seed):
    engine = hexapod(seed).engine
    ratios = []
    for x, q in engine.samples:
        found = np.array(x, dtype=object)
        motion, limbs = engine.place(engine.tree, found, q)
        np.testing.assert_allclose(found.astype(float), x, atol=1e-10)
        rows = motion.closures()
        solved = to_floats(closure_jacobians(engine.tree, engine.newton_rows(rows, limbs))[0])
        whole = to_floats(closure_jacobians(engine.tree, rows)[0])[engine.independent]
        turns = np.prod([float(slope) for limb in limbs for slope, _ in limb.slopes])
        part = np.linalg.det(solved[:, engine.newton_unknowns[1]]) * turns
        ratios.append(np.linalg.det(whole) / part)
    assert len(ratios) > 3
    np.testing.assert_allclose(ratios, ratios[0], rtol=1e-9)
    assert abs(ratios[0]) == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize("name", EVERY)
def test_forward_of_the_inverse_is_the_pose_or_it_is_rejected(name, rng):
    """Far poses have other assemblies of the same joints: none of these is accepted."""
    robot = load(name)
    near = reached(robot, rng, 400)
    near = near[np.isfinite(near).all(1)]
    middle, span = near.mean(0), np.ptp(near, axis=0)
    far = [middle + k * span * rng.uniform(-0.5, 0.5, (1500, len(span))) for k in (1, 2, 4)]
    poses = np.concatenate([near, *far])
    q, good = robot.try_inverse(poses)
    assert good[: len(near)].mean() > 0.9
    back, known = robot.try_forward(q[good])
    assert known.all()
    apart = back - poses[good]
    turns = [unit == "rad" for unit in robot.pose_units]
    apart[:, turns] = 2.0 * np.sin(apart[:, turns] / 2.0)
    assert np.abs(apart).max() < 1e-6


@pytest.mark.parametrize("name", EVERY)
def test_torques_of_a_motion_of_the_pose_are_those_of_its_joints(name, rng):
    robot = load(name)
    pose = reached(robot, rng, 60, 0.15)
    pose = pose[np.isfinite(pose).all(1)]
    rate, change = rng.normal(size=(2, *pose.shape))
    wrench = 10.0 * rng.normal(size=(len(pose), 6))
    found = inverse_dynamics_at_pose(robot, pose, rate, 10.0 * change, wrench)
    tau = inverse_dynamics(robot, found.q, found.qd, found.qdd, wrench)
    np.testing.assert_allclose(found.tau, tau, atol=1e-11 * np.abs(tau).max())
    np.testing.assert_allclose(robot.forward(found.q), pose, atol=1e-9)
    rates = np.einsum("kij,kj->ki", robot.jacobian(found.q), found.qd)
    np.testing.assert_allclose(rates, rate, atol=1e-9)
    second = robot.pose_acceleration(found.q, found.qd, found.qdd)
    np.testing.assert_allclose(second, 10.0 * change, atol=1e-7)
    one = inverse_dynamics_at_pose(robot, pose[0], rate[0], 10.0 * change[0], wrench[0])
    np.testing.assert_array_equal(one.tau, found.tau[0])


@pytest.mark.parametrize("name", partly_long(MACHINES, "upr_rpu"))
def test_torques_and_mass_matrix_at_a_pose_of_random_machines_are_those_of_their_joints(name, rng):
    """Their limbs do not stay in the planes that they turn in."""
    robot = robot_of_data(variant(name, rng), "variant")
    pose = reached(robot, rng, 40, 0.15)
    pose = pose[np.isfinite(pose).all(1)]
    pose = pose[robot.try_inverse(pose)[1]]
    rate, change = rng.normal(size=(2, *pose.shape))
    found = inverse_dynamics_at_pose(robot, pose, rate, 10.0 * change)
    tau, mass = inverse_dynamics(robot, found.q, found.qd, found.qdd), mass_matrix(robot, found.q)
    np.testing.assert_allclose(found.tau, tau, atol=1e-11 * np.abs(tau).max())
    np.testing.assert_allclose(mass_matrix_at_pose(robot, pose), mass, atol=1e-11 * np.abs(mass).max())


def test_a_machine_that_is_followed_has_no_torques_of_another_assembly(rng):
    """As machines with screws are: its pose is found with its own tree, far from home too."""
    robot = load("rps3").with_file_values({"joints.hinge_1.at[0]": load("rps3").number("joints.hinge_1.at[0]") + 1e-3})
    vars(robot.engine)["posed"] = vars(robot.massive())["posed"] = None
    far = np.where([unit == "m" for unit in robot.pose_units], 0.8 * robot.size, 1.2)
    poses = robot.home() + rng.uniform(-1.0, 1.0, (300, 3)) * far
    good = robot.try_inverse(poses)[1]
    assert 0 < good.sum() < len(poses)
    found = inverse_dynamics_at_pose(robot, poses[good], np.zeros(3), np.zeros(3))
    np.testing.assert_allclose(robot.forward(found.q), poses[good], atol=1e-9)
    for pose in poses[~good][:20]:
        with pytest.raises(PkmTwinError):
            inverse_dynamics_at_pose(robot, pose, np.zeros(3), np.zeros(3))


MORE = ("screw", "load_dependent", "examples/machines/rrr4_planar.yaml")
"""A machine that is followed, friction by load, and more drives than freedoms."""


@pytest.mark.parametrize("name", partly_long([*ROBOTS, *MORE], "five_bar", *MORE))
def test_mass_matrix_and_accelerations_at_a_pose_are_those_of_its_joints(name, rng):
    robot = slide(0.02) if name == "screw" else load("five_bar" if name == MORE[1] else name)
    if name == MORE[1]:
        robot = robot.changed(friction={"coulomb": [0.5, 0.3], "load_dependent": [0.2, 0.1]})
    pose = reached(robot, rng, 60, 0.15)
    pose = pose[np.isfinite(pose).all(1)]
    q = robot.inverse(pose)
    mass = mass_matrix(robot, q)
    np.testing.assert_allclose(mass_matrix_at_pose(robot, pose), mass, atol=1e-12 * np.abs(mass).max())
    rate = rng.normal(size=pose.shape)
    tau, wrench = 10.0 * rng.normal(size=q.shape), rng.normal(size=(len(pose), 6))
    found = forward_dynamics_at_pose(robot, pose, rate, tau, wrench)
    qdd = forward_dynamics(robot, q, found.qd, tau, wrench)
    np.testing.assert_allclose(found.qdd, qdd, atol=1e-12 * np.abs(qdd).max())
    back = inverse_dynamics_at_pose(robot, pose, rate, found.acceleration, wrench)
    np.testing.assert_allclose(back.qdd, qdd, atol=1e-12 * np.abs(qdd).max())
    one = forward_dynamics_at_pose(robot, pose[0], rate[0], tau[0], wrench[0])
    np.testing.assert_array_equal(one.acceleration, found.acceleration[0])


@pytest.mark.parametrize("name", ["prru", "rps3", "upr_rpu"])
def test_slides_and_a_turn_of_the_platform_are_those_of_all_closures(name, rng):
    posed = load(name).engine.posed
    assert posed.platform_pivots
    for x, q in posed.samples:
        at = q + rng.uniform(-0.05, 0.05, len(q))
        found = np.array(x, dtype=object)
        found[posed.newton_unknowns[0]] = posed.close_platform(posed.tree, at, posed.platform_pivots)[0]
        motion, _ = posed.place(posed.tree, found, at)
        assert max(abs(row.value * row.scale) for row in motion.closures()) < 1e-12


def test_a_pose_that_is_not_reached_has_no_torques():
    robot = load("delta")
    pose, still = robot.home(), np.zeros(3)
    deep = pose + np.array([0.0, 0.0, -2.0])
    with pytest.raises(PkmTwinError):
        inverse_dynamics_at_pose(robot, [pose, deep], still, still)
    with pytest.raises(ValueError, match="finite"):
        inverse_dynamics_at_pose(robot, pose, still, np.full(3, np.nan))
