# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Derivatives of torques against differences of sixth order, by the motion and by file numbers."""

from __future__ import annotations

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics, torque_derivatives, torque_gradient
from pkm_twin import (
    Robot,
    forward_derivatives,
    inverse_derivatives,
    platform_derivatives,
    robot_names,
    variants,
)
from pkm_twin.errors import ParameterError
from stiffness_monitor import compliance, compliance_derivatives
from test.support.robots import every_robot, has, load, often, partly_long, some_robots

POINTS = np.arange(-3.0, 4.0)
WEIGHTS = np.array([-1.0, 9.0, -45.0, 0.0, 45.0, -9.0, 1.0]) / 60.0
STEP = 1e-3
ASIDE = ("limits", "joint_map", "uncertainty", "member", "section", "compliance", "radius", "ax")
"""Words in paths of numbers that torques do not depend on, or that are scaled to one."""
NOT_GEOMETRY = (
    "limits",
    "joint_map",
    "uncertainty",
    "payload",
    "friction",
    "mass",
    "inertia",
    "com",
)
"""The same of poses and compliance."""


def motion(robot: Robot, rng):
    """A state near home in motion, and a wrench."""
    units = np.array([robot.graph.size if u == "m" else 1.0 for u in robot.joint_units])
    q = robot.graph.home + 0.05 * rng.uniform(-1.0, 1.0, robot.joints_count) * units
    return [q, *rng.normal(size=(2, robot.joints_count))], rng.normal(size=6)


def close(found, expected, efforts):
    """Equal but for what differences lose."""
    size = max(np.abs(expected).max(), 1e-3 * np.abs(efforts).max())
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8 * size)


@every_robot
def test_by_the_motion(name, rng):
    robot = load(name)
    # Dry friction has a jump where a passive joint's rate changes its sign.
    given, wrench = motion(robot, np.random.default_rng(5))
    found = torque_derivatives(robot, *given, wrench)
    efforts = inverse_dynamics(robot, *given, wrench)
    for k, table in enumerate((found.q, found.qd, found.qdd)):
        columns = []
        for j in range(robot.joints_count):
            moved = [np.tile(value, (len(POINTS), 1)) for value in given]
            moved[k][:, j] += STEP * POINTS
            columns.append(WEIGHTS @ inverse_dynamics(robot, *moved, wrench) / STEP)
        close(table, np.transpose(columns), efforts)
    assert found.by == {}


@pytest.mark.parametrize("count", often(3, 8))
@some_robots
def test_by_numbers_of_the_file(name, count, rng):
    robot = load(name)
    given, wrench = motion(robot, rng)
    known = {p: v for p, (v, _) in robot.file_numbers().items() if v != 0.0}
    paths = [p for p in known if not any(word in p for word in ASIDE) and "inertia[" not in p]
    paths = rng.permutation(paths)[:count].tolist()
    found = torque_derivatives(robot, *given, wrench, by=paths)
    efforts = inverse_dynamics(robot, *given, wrench)
    assert list(found.by) == paths
    for path in paths:
        step = STEP * abs(known[path])
        many = variants(robot, {path: known[path] + step * POINTS})
        if not many.valid.all():
            # A closure that only this number's own value meets.
            continue
        expected = WEIGHTS @ many.inverse_dynamics(*given, wrench) / step
        size = max(np.abs(expected).max(), 1e-4 * np.abs(efforts).max() / abs(known[path]))
        np.testing.assert_allclose(found.by[path], expected, rtol=0, atol=1e-7 * size)


@pytest.mark.parametrize("name", ["delta_cu", "stewart"])
def test_a_gradient_is_the_weighted_sum_of_the_rows(name, rng):
    robot = load(name)
    (q, qd, qdd), wrench = motion(robot, rng)
    batch = q + 1e-3 * rng.normal(size=(4, len(q)))
    weights = rng.normal(size=(4, len(q)))
    path = "payload.mass"
    rows = torque_derivatives(robot, batch, qd, qdd, wrench, by=[path])
    one = torque_gradient(robot, batch, qd, qdd, weights, wrench, by=[path])
    assert rows.q.shape == (4, len(q), len(q)) and one.by[path].shape == (4,)
    for what in ("q", "qd", "qdd"):
        expected = np.einsum("kn,knj->kj", weights, getattr(rows, what))
        np.testing.assert_allclose(getattr(one, what), expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(one.by[path], np.sum(weights * rows.by[path], -1), rtol=1e-9)


def test_a_path_that_there_is_not_is_rejected(rng):
    robot = load("delta")
    given, _ = motion(robot, rng)
    with pytest.raises(ParameterError):
        torque_derivatives(robot, *given, by=["geometry.leg"])


@pytest.mark.parametrize("name", partly_long(robot_names(), "five_bar", "upr_rpu"))
def test_of_pose_joints_and_compliance(name):
    robot, rng = load(name), np.random.default_rng(2)
    q = motion(robot, rng)[0][0]
    pose = robot.forward(q)
    known = {p: v for p, (v, _) in robot.file_numbers().items() if v != 0.0}
    paths = [p for p in known if not any(word in p for word in ("ax", *NOT_GEOMETRY))]
    paths = rng.permutation(paths)[:6].tolist()
    elastic = has(robot, "structure")
    forward, inverse = forward_derivatives(robot, q, paths), inverse_derivatives(robot, pose, paths)
    platform = platform_derivatives(robot, q, paths)
    found = [forward, inverse, *([compliance_derivatives(robot, pose, paths)] if elastic else [])]
    asked = [lambda r: r.forward(q), lambda r: r.inverse(pose), lambda r: r.compliance(pose)]
    for path in paths:
        step = 4.0 * STEP * abs(known[path])
        many = variants(robot, {path: known[path] + step * POINTS})
        if not many.valid.all():
            continue
        for one, ask in zip(found, asked, strict=False):
            values = ask(many)
            expected = np.tensordot(WEIGHTS, values, 1) / step
            # Differences lose rounding over the step.
            lost = 1e-14 * np.abs(values).max() / step
            bound = 1e-8 * np.abs(expected).max() + lost
            np.testing.assert_allclose(one.by[path], expected, rtol=0, atol=bound)
        places, turns = many.platform(q)
        linear = np.tensordot(WEIGHTS, places, 1) / step
        skew = np.tensordot(WEIGHTS, turns, 1) / step @ turns[len(POINTS) // 2].T
        twist = [*linear, skew[2, 1], skew[0, 2], skew[1, 0]]
        np.testing.assert_allclose(platform.by[path], twist, rtol=0, atol=1e-8)
    # By the state: along a line of poses.
    way = rng.normal(size=len(pose)) * np.where(np.array(robot.pose_units) == "m", robot.size, 1.0)
    line = pose + 1e-3 * POINTS[:, None] * way
    expected = np.tensordot(WEIGHTS, robot.inverse(line), 1) / 1e-3
    np.testing.assert_allclose(inverse.state @ way, expected, rtol=1e-8, atol=1e-8)
    if elastic:
        values = compliance(robot, line)
        expected = np.tensordot(WEIGHTS, values, 1) / 1e-3
        size = max(np.abs(expected).max(), 1e-4 * np.abs(values).max())
        np.testing.assert_allclose(found[2].state @ way, expected, rtol=0, atol=1e-8 * size)
    batch = forward_derivatives(robot, np.stack([q, q]), paths)
    np.testing.assert_array_equal(batch.by[paths[0]][1], forward.by[paths[0]])
