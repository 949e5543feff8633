# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Kinematics of every robot by one engine: placements, closures, derivatives, passive joints."""

from pathlib import Path

import numpy as np
import pytest

from pkm_twin.errors import PkmTwinError
from pkm_twin.kinematics.passive import passive_program
from pkm_twin.machine.graph import BASE
from test.support.bodies import PlainKernel, bodies
from test.support.robots import (
    every_robot,
    finite_difference,
    joint_units_of_size,
    load,
    loaded,
    random_joints,
    some_robots,
)

MACHINES = Path(__file__).parents[1] / "machine" / "machines"
STEP = 2e-3
WEIGHTS = np.array([-1, 9, -45, 0, 45, -9, 1]) / (60 * STEP)
SECOND = np.array([2, -27, 270, -490, 270, -27, 2]) / (180 * STEP * STEP)


def placed(robot, q):
    """Rotation (..., 3, 3) and shift (..., 3) of every body, base included: p = R p_home + s."""
    rotations, origins = robot.placements(q)
    at = robot.engine.tree.at
    shifts = {name: origins[name] - rotations[name] @ at[name] for name in rotations}
    return {BASE: np.eye(3), **rotations}, {BASE: np.zeros(3), **shifts}


def moved(pair, body, point):
    return pair[0][body] @ point + pair[1][body]


def check_closures(robot, q, bound):
    """Joints meet where they have to, axes stay along each other, rods keep their length."""
    pair = placed(robot, q)
    size = robot.engine.tree.size
    for joint in robot.graph.joints.values():
        a, b = joint.inner, joint.outer
        if joint.virtual:
            continue
        apart = moved(pair, b, joint.at) - moved(pair, a, joint.at)
        ra, rb = (np.broadcast_to(pair[0][body], (len(q), 3, 3)) for body in (a, b))
        relative = ra.swapaxes(-1, -2) @ rb
        axis = joint.axes[0] if len(joint.axes) else np.zeros(3)
        axis = axis / max(np.linalg.norm(axis), 1e-300)
        if joint.kind in ("prismatic", "cylindrical"):
            along = np.einsum("...ij,j->...i", ra, axis)
            apart = apart - np.sum(apart * along, -1, keepdims=True) * along
        if joint.kind != "translation":
            assert np.abs(apart).max() < bound * size, joint.name
        if joint.kind in ("prismatic", "translation", "fixed"):
            assert np.abs(relative - np.eye(3)).max() < bound, joint.name
        if joint.kind in ("revolute", "cylindrical"):
            assert np.abs(relative @ axis - axis).max() < bound, joint.name
        if joint.kind == "universal":
            angle = np.einsum("nij,j->ni", rb, joint.axes[1])
            first = np.einsum("nij,j->ni", ra, joint.axes[0])
            between = float(joint.axes[0] @ joint.axes[1])
            assert np.abs(np.sum(angle * first, -1) - between).max() < bound, joint.name
    for rod in robot.graph.rods.values():
        start, end = rod.ends
        length = np.linalg.norm(moved(pair, rod.outer, end) - moved(pair, rod.inner, start), axis=-1)
        assert np.abs(length - np.linalg.norm(end - start)).max() < bound * size, rod.name


@every_robot
def test_every_closure_holds_between_the_placed_bodies(name, rng):
    robot = load(name)
    check_closures(robot, random_joints(robot, rng, 300), 1e-12)


@every_robot
def test_actuated_joints_have_their_values(name, rng):
    """The angle about, or the way along, the joint's axis from its value at home is q's."""
    robot = load(name)
    q = random_joints(robot, rng, 100)
    pair = placed(robot, q)
    for k, joint in enumerate(robot.graph.joints[n] for n in robot.joint_names):
        a, b = joint.inner, joint.outer
        axis = joint.axes[0] / np.linalg.norm(joint.axes[0])
        ra, rb = (np.broadcast_to(pair[0][body], (len(q), 3, 3)) for body in (a, b))
        if robot.joint_units[k] == "m":
            apart = moved(pair, b, joint.at) - moved(pair, a, joint.at)
            value = np.sum(apart * (ra @ axis), -1)
        else:
            across = np.linalg.svd(axis[None])[2][1]
            turned = np.einsum("nji,njk,k->ni", ra, rb, across)
            value = np.arctan2(np.cross(across, turned) @ axis, turned @ across)
        assert value == pytest.approx(q[:, k] - joint.home, abs=1e-12)


@every_robot
def test_forward_undoes_inverse(name, rng):
    robot = load(name)
    q = random_joints(robot, rng, 500)
    pose = robot.forward(q)
    np.testing.assert_allclose(robot.inverse(pose), q, atol=1e-11)
    np.testing.assert_allclose(robot.forward(robot.inverse(pose)), pose, atol=1e-11)


@every_robot
def test_jacobians_are_the_derivatives_of_forward(name, rng):
    robot = load(name)
    q = random_joints(robot, rng, 50)
    np.testing.assert_allclose(robot.jacobian(q), finite_difference(robot.forward, q), rtol=1e-6, atol=1e-7)
    check_twists(robot.platform_jacobian(q), robot.platform, q)


def check_twists(twist, place, q):
    """Twists (..., 6, n) are the change of a frame; ``place``: q to its origin and rotation."""
    position = finite_difference(lambda at: place(at)[0], q)
    np.testing.assert_allclose(twist[:, :3], position, rtol=1e-6, atol=1e-7)
    rotation = place(q)[1]
    flat = finite_difference(lambda at: place(at)[1].reshape(*at.shape[:-1], 9), q)
    for j in range(q.shape[-1]):
        w = flat[..., j].reshape(-1, 3, 3) @ rotation.swapaxes(-1, -2)
        spin = np.stack([w[:, 2, 1], w[:, 0, 2], w[:, 1, 0]], -1)
        np.testing.assert_allclose(twist[:, 3:, j], spin, rtol=1e-6, atol=1e-7)


@every_robot
def test_body_jacobians_are_the_derivatives_of_placements(name, rng):
    robot = load(name)
    q = random_joints(robot, rng, 20)
    found = robot.body_jacobians(q)
    assert list(found) == list(robot.graph.bodies)
    for body, twist in found.items():
        check_twists(twist, lambda at, body=body: [p[body] for p in robot.placements(at)[::-1]], q)


@every_robot
def test_bodies_move_as_their_places_change(name, rng):
    """Velocities, accelerations, angular momenta: stencils of placements along a motion."""
    robot = loaded(name)
    q = random_joints(robot, rng, 40)
    scale = joint_units_of_size(robot)
    qd, qdd = scale * rng.normal(size=q.shape), scale * rng.normal(size=q.shape)
    found = bodies(robot, q, qd, qdd)
    velocity = np.einsum("nbij,nj->nbi", found.linear, qd)
    spin = np.einsum("nbij,nj->nbi", found.angular, qd)
    times = STEP * np.arange(-3, 4)[:, None, None]
    way = q + times * qd + times**2 / 2 * qdd
    pair = placed(robot, way)
    graph, load_ = robot.graph, robot.payload
    limit = 1e-6 * max(1.0, np.abs(found.acceleration).max())

    def first(values):
        return np.tensordot(WEIGHTS, values, 1)

    def second(values):
        return np.tensordot(SECOND, values, 1)

    own = [(b.name, b.com, b.inertia) for b in graph.bodies.values()]
    own.append((graph.platform, graph.origin + load_.com, load_.inertia))
    numbers = [*range(len(own) - 1), len(found.names) - 1]
    for k, (body, point, inertia) in zip(numbers, own, strict=True):
        places = moved(pair, body, point)
        np.testing.assert_allclose(found.com[:, k], places[3], atol=1e-12)
        np.testing.assert_allclose(velocity[:, k], first(places), atol=1e-8)
        np.testing.assert_allclose(found.acceleration[:, k], second(places), atol=limit)
        turned = np.broadcast_to(pair[0][body], (*way.shape[:-1], 3, 3))
        w = first(turned) @ turned[3].swapaxes(-1, -2)
        w = np.stack([w[:, 2, 1], w[:, 0, 2], w[:, 1, 0]], -1)
        np.testing.assert_allclose(spin[:, k], w, atol=1e-8)
        bent = second(turned) @ turned[3].swapaxes(-1, -2)
        alpha = (
            np.stack([bent[:, 2, 1] - bent[:, 1, 2], bent[:, 0, 2] - bent[:, 2, 0], bent[:, 1, 0] - bent[:, 0, 1]], -1)
            / 2
        )
        matrix = turned[3] @ inertia @ turned[3].swapaxes(-1, -2)
        euler = np.einsum("nij,nj->ni", matrix, alpha)
        euler += np.cross(w, np.einsum("nij,nj->ni", matrix, w))
        np.testing.assert_allclose(found.moment[:, k], euler, atol=limit * max(1, matrix.max()))
    for k, rod in enumerate(graph.rods.values(), len(graph.bodies)):
        a, b = moved(pair, rod.inner, rod.ends[0]), moved(pair, rod.outer, rod.ends[1])
        np.testing.assert_allclose(found.com[:, k], (a[3] + b[3]) / 2, atol=1e-12)
        np.testing.assert_allclose(velocity[:, k], first(a + b) / 2, atol=1e-8)
        np.testing.assert_allclose(found.acceleration[:, k], second(a + b) / 2, atol=limit)
        bar = b - a
        momentum = rod.mass / 12 * np.cross(bar[3], second(bar))
        np.testing.assert_allclose(found.moment[:, k], momentum, atol=limit)
        # A thin bar's angular velocity turns it, and does not spin it.
        np.testing.assert_allclose(np.cross(spin[:, k], bar[3]), first(bar), atol=1e-8)
        assert np.abs(np.sum(spin[:, k] * bar[3], -1)).max() < 1e-10


@every_robot
def test_pose_acceleration_is_the_second_derivative(name, rng):
    robot = load(name)
    q = random_joints(robot, rng, 50)
    scale = joint_units_of_size(robot)
    qd, qdd = scale * rng.normal(size=q.shape), scale * rng.normal(size=q.shape)
    times = STEP * np.arange(-3, 4)[:, None, None]
    poses = robot.forward(q + times * qd + times**2 / 2 * qdd)
    found = robot.pose_acceleration(q, qd, qdd)
    size = max(1.0, np.abs(found).max())
    np.testing.assert_allclose(found, np.tensordot(SECOND, poses, 1), atol=1e-6 * size)


@every_robot
def test_passive_rates_are_the_derivative_of_passive_positions(name, rng):
    """A stencil of them along a motion: hinges, balls as three angles, slides, rods."""
    robot = load(name)
    q = random_joints(robot, rng, 12)
    qd = joint_units_of_size(robot) * rng.normal(size=q.shape)
    times = STEP * np.arange(-3, 4)[:, None, None]
    found = robot.passive_rates(q, qd)
    assert found.shape == (len(q), len(robot.passive_joints))
    expected = np.tensordot(WEIGHTS, robot.passive(q + times * qd), 1)
    np.testing.assert_allclose(found, expected, atol=1e-8 * max(1.0, np.abs(found).max()))
    # Linear in the joints' rates.
    np.testing.assert_allclose(robot.passive_rates(q, -2.0 * qd), -2.0 * found, rtol=1e-12)


def test_an_arm_without_loops_has_no_passive_joints():
    """A program without unknowns or results is one, on both back ends."""
    robot = load(MACHINES / "arm_2r.yaml")
    q = np.linspace(0.1, 0.5, 8).reshape(4, 2)
    assert robot.passive(q).shape == (4, 0) and robot.passive(q[0]).shape == (0,)
    assert robot.passive_rates(q, q).shape == (4, 0)
    kernel = robot.engine.kernel("passive", passive_program)
    plain = PlainKernel(kernel.program, kernel.geometry)
    for samples in (q, q[:1]):
        (found,), status = plain.run([samples])
        assert found.shape == (len(samples), 0) and not status[:, 0].any()


@every_robot
def test_home_is_its_own_forward_and_needs_no_motion(name):
    robot = load(name)
    graph = robot.graph
    np.testing.assert_allclose(robot.forward(graph.home), robot.engine.home_pose, atol=1e-12)
    position, rotation = robot.platform(graph.home)
    np.testing.assert_allclose(position, graph.origin, atol=1e-12)
    np.testing.assert_allclose(rotation, np.eye(3), atol=1e-12)
    assert np.abs(robot.passive(graph.home)).max(initial=0.0) < 1e-12


@some_robots
def test_far_joints_are_refused_in_one_line_with_limb_sample_and_miss(name, rng):
    """Whatever the joints are: an assembly whose closures hold, or one of the typed refusals."""
    robot = load(name)
    middle = robot.graph.home
    reach = np.array([3.0 * robot.engine.tree.size if u == "m" else np.pi for u in robot.joint_units])
    q = middle + rng.uniform(-1.0, 1.0, (400, len(middle))) * reach
    poses, good = robot.try_forward(q)
    assert np.isnan(poses[~good]).all()
    if good.any():
        check_closures(robot, q[good], 1e-9)
    for k in np.flatnonzero(~good)[:6]:
        with pytest.raises(PkmTwinError) as caught:
            robot.forward(np.stack([middle, q[k]]))
        error = caught.value
        assert error.index == (1,)
        assert "\n" not in str(error)
        assert getattr(error, "miss", 1.0) > 0.0
        assert getattr(error, "reached", None) is None or 0.0 <= error.reached < 1.0
        if hasattr(error, "limb"):
            parts = {*robot.limb_names, *robot.graph.joints, *robot.graph.rods}
            assert error.limb in parts
