# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""External wrenches from momentum: against the filter that the observer says it is."""

from __future__ import annotations

import numpy as np
import pytest

from delta_dynamics import MomentumObserver, inverse_dynamics, platform_wrench
from pkm_twin import Robot
from pkm_twin.codegen.arrays import Array
from test.support.robots import FREE, joint_range, load, loaded, massive

BANDWIDTH = 40.0
DURATION = 0.4


def motion(robot: Robot, times: Array) -> tuple[Array, Array, Array]:
    """A smooth motion through the middle of the joints' range, and its derivatives."""
    middle, half = joint_range(robot)
    phase = np.arange(len(middle)) * 0.7
    w = 5.0
    angle = w * times[:, None] + phase
    return (
        middle + 0.3 * half * np.sin(angle),
        0.3 * half * w * np.cos(angle),
        -0.3 * half * w**2 * np.sin(angle),
    )


def wrenches(times: Array) -> Array:
    """A push that comes and turns."""
    base = np.array([10.0, -6.0, 8.0, 0.3, 0.2, -0.4])
    return base * np.sin(7.0 * times[:, None] + np.arange(6))


def observed(robot: Robot, period: float, bandwidth: float) -> tuple[Array, Array, Array]:
    """Estimate, the joints' part of the true wrench, and the states."""
    times = np.arange(0.0, DURATION, period)
    q, qd, qdd = motion(robot, times)
    wrench = wrenches(times)
    effort = inverse_dynamics(robot, q, qd, qdd, wrench)
    observer = MomentumObserver(robot, bandwidth)
    found = [observer.push(*sample) for sample in zip(times, q, qd, effort, strict=True)]
    assert found[0] is None
    estimate = np.array([np.zeros(robot.joints_count), *found[1:]])
    true = np.einsum("tji,tj->ti", robot.platform_jacobian(q), wrench)
    return estimate, true, q


def filtered(true: Array, period: float, bandwidth: float) -> Array:
    """The filter r' = bandwidth (e - r), driven and stepped as the observer is."""
    r = np.zeros_like(true)
    for k in range(1, len(true)):
        mean = 0.5 * (true[k] + true[k - 1])
        r[k] = (r[k - 1] + bandwidth * period * mean) / (1.0 + bandwidth * period)
    return r


@massive
def test_the_estimate_is_the_filtered_truth(name: str) -> None:
    """The error is of second order in the period: a half of it leaves a quarter."""
    robot = loaded(name).changed(friction=FREE)
    errors = []
    for period in (2e-3, 1e-3):
        estimate, true, _ = observed(robot, period, BANDWIDTH)
        errors.append(np.abs(estimate - filtered(true, period, BANDWIDTH)).max())
    assert errors[1] < 2e-3 * np.abs(true).max()
    assert errors[1] < 0.3 * errors[0]


@massive
def test_nothing_pushes_where_nothing_pushes(name: str) -> None:
    """A payload's weight, friction and the motion's own forces are no wrench of others."""
    robot = loaded(name)
    times = np.arange(0.0, DURATION, 1e-3)
    q, qd, qdd = motion(robot, times)
    effort = inverse_dynamics(robot, q, qd, qdd)
    observer = MomentumObserver(robot, BANDWIDTH)
    found = [observer.push(*sample) for sample in zip(times, q, qd, effort, strict=True)]
    # A joint that turns around between two samples has half a sample of the other friction.
    assert np.abs(np.array(found[1:])).max() < 0.02 * np.abs(effort).max()


@massive
def test_the_wrench_explains_the_efforts_and_is_the_least_that_does(name: str) -> None:
    """Back through the Jacobian; with six joints it is the wrench itself."""
    robot = load(name)
    q, _, _ = motion(robot, np.linspace(0.0, DURATION, 7))
    wrench = wrenches(np.linspace(0.0, DURATION, 7))
    external = np.einsum("tji,tj->ti", robot.platform_jacobian(q), wrench)
    found = platform_wrench(robot, q, external)
    back = np.einsum("tji,tj->ti", robot.platform_jacobian(q), found)
    np.testing.assert_allclose(back, external, rtol=1e-9, atol=1e-9)
    lever = np.array([1.0, 1.0, 1.0, *(3 * [robot.size])])
    sizes = [np.linalg.norm(loads / lever, axis=1) for loads in (found, wrench)]
    assert np.all(sizes[0] <= sizes[1] * (1.0 + 1e-9))
    if robot.joints_count == 6:
        np.testing.assert_allclose(found, wrench, rtol=1e-8, atol=1e-8)


def test_a_bandwidth_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="bandwidth is 0 1/s"):
        MomentumObserver(load("delta"), 0.0)
