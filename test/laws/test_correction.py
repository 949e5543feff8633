# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Set points that cancel a deflection: exact to first order, within bounds, and on a recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pkm_twin import Robot
from pkm_twin.bags.reader import read_messages
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import MessageError
from pkm_twin.machine.rotations import skew
from pkm_twin.recordings import read
from stiffness_monitor import setpoint_correction, strain_energy
from stiffness_monitor.correction import SetpointStream
from test.support.robots import elastic, every_robot, joint_range, load

BAGS = Path(__file__).resolve().parents[2] / "bags"
TOOL = np.array([0.02, -0.01, -0.15])


def states(robot: Robot, count: int = 20) -> tuple[Array, Array]:
    """Joint positions and small deflections."""
    rng = np.random.default_rng(3)
    middle, half = joint_range(robot)
    return (
        middle + half * rng.uniform(-0.8, 0.8, (count, len(middle))),
        1e-5 * rng.normal(size=(count, 6)),
    )


def tool_point(robot: Robot, q: Array) -> Array:
    position, rotation = robot.platform(q)
    return np.asarray(position + rotation @ TOOL, np.float64)


@every_robot
def test_the_robot_itself_moves_its_tool_by_what_is_promised(name: str) -> None:
    """By the assembled machine at the corrected joints, not by a Jacobian."""
    robot = load(name)
    q, deflection = states(robot)
    found = setpoint_correction(robot, q, deflection, tool=TOOL)
    shift = tool_point(robot, q + found.offset) - tool_point(robot, q)
    # What an offset of this size does beyond first order.
    second = 20.0 * np.abs(found.offset).max() ** 2
    np.testing.assert_allclose(found.before[:, :3] + shift, found.left[:, :3], rtol=0, atol=second)
    lever = skew(robot.platform(q)[1] @ TOOL)
    moved = deflection[:, :3] - (lever @ deflection[:, 3:, None])[..., 0]
    np.testing.assert_allclose(found.before[:, :3], moved, atol=1e-18)
    assert not found.bounded.any()


@every_robot
def test_no_other_offset_brings_the_tool_point_nearer(name: str) -> None:
    """The residual is across all directions in which the joints move the tool point well."""
    robot = load(name)
    q, deflection = states(robot)
    found = setpoint_correction(robot, q, deflection, tool=TOOL)
    rng = np.random.default_rng(4)
    best = np.linalg.norm(found.left[:, :3], axis=1)
    twist = robot.platform_jacobian(q)
    place = twist[:, :3] - skew(robot.platform(q)[1] @ TOOL) @ twist[:, 3:]
    assert np.linalg.cond(place / robot.joint_scales).max() < 50.0
    for _ in range(20):
        other = found.offset + rng.normal(size=found.offset.shape) * np.abs(found.offset).mean()
        moved = found.before[:, :3] + (place @ other[..., None])[..., 0]
        assert np.all(np.linalg.norm(moved, axis=1) >= best * (1.0 - 1e-9))
    if robot.joints_count == 6:
        np.testing.assert_allclose(found.left, 0.0, atol=1e-16)


@every_robot
def test_a_bound_keeps_the_direction(name: str) -> None:
    robot = load(name)
    q, deflection = states(robot)
    free = setpoint_correction(robot, q, deflection, tool=TOOL).offset
    bound = 0.5 * np.abs(free).max(axis=1).min()
    held = setpoint_correction(robot, q, deflection, tool=TOOL, bound=bound)
    assert held.bounded.all()
    np.testing.assert_allclose(np.abs(held.offset).max(axis=1), bound, rtol=1e-12)
    cosine = (free * held.offset).sum(1) / np.linalg.norm(free, axis=1)
    np.testing.assert_allclose(cosine, np.linalg.norm(held.offset, axis=1), rtol=1e-12)


@elastic
def test_no_load_wants_no_offset(name: str) -> None:
    robot = load(name)
    energy = strain_energy(robot, robot.home(), np.zeros(6))
    q = robot.inverse(robot.home())
    found = setpoint_correction(robot, q, energy.deflection, bound=0.0)
    np.testing.assert_array_equal(found.offset, 0.0)
    assert not found.bounded


def test_the_recorded_tool_deflects_less_by_far() -> None:
    """The frame's own deflection, corrected by the twin's offsets from the measured wrench."""
    bag = BAGS / "upr_rpu_milling.mcap"
    recorded = read(bag)
    assert recorded.wrench is not None
    truth = [m.message for m in read_messages(bag, ["/ground_truth/deflection"])][::8]
    begin = 1_700_000_000
    times = [m.header.stamp.sec - begin + 1e-9 * m.header.stamp.nanosec for m in truth]
    at = np.abs(recorded.time[:, None] - np.array(times)).argmin(axis=0)
    parts = [(m.transform.translation, m.transform.rotation) for m in truth]
    deflection = np.array([[t.x, t.y, t.z, 2 * r.x, 2 * r.y, 2 * r.z] for t, r in parts])
    robot, q = recorded.robot, recorded.q[at]
    energy = strain_energy(robot, robot.forward(q), recorded.wrench[at])
    tip = [0.0, 0.0, -0.15]
    found = setpoint_correction(robot, q, energy.deflection, tool=tip, bound=1e-3)
    true = setpoint_correction(robot, q, deflection, tool=tip).before
    left = true + (found.left - found.before)
    sizes = [float(np.sqrt((part[:, :3] ** 2).sum(1).mean())) for part in (true, left)]
    assert sizes[0] > 5e-6
    assert sizes[1] < sizes[0] / 50.0


@pytest.mark.parametrize(
    "change",
    [
        {"bound": -1.0},
        {"bound": [1.0, 1.0]},
    ],
    ids=str,
)
def test_what_cannot_be_corrected_is_refused(change: dict[str, object]) -> None:
    robot = load("upr_rpu")
    arguments = {"deflection": np.zeros(6), **change}
    with pytest.raises(ValueError, match=next(iter(change))):
        setpoint_correction(robot, robot.inverse(robot.home()), **arguments)  # type: ignore[arg-type]


@given(st.integers(0, 2**32 - 1))
def test_a_corrected_set_point_keeps_the_limits_and_moves_at_most_at_its_rate(seed: int) -> None:
    """Set points at the limits too, offsets that turn around at once, pauses, stamps in any order, clock jumps."""
    rng = np.random.default_rng(seed)
    robot, rate, age = load("upr_rpu"), 0.01, 0.1
    low, high = robot.limits.position.T
    stream = SetpointStream(robot, rate, age)
    stamp, before = 10**9, None
    for _ in range(40):
        elapsed = int(rng.choice([0, 10**6, 10**7, 10**10, -(10**7), -(10**8)]))
        setpoint = np.clip(rng.uniform(low - 0.01, high + 0.01), low, high)
        offset = rng.uniform(-1e-3, 1e-3, 3)
        if elapsed < 0:
            if before is not None and rng.random() < 0.5:
                with pytest.raises(MessageError, match="before the last"):
                    stream.correct(stamp + elapsed, setpoint, offset)
                continue
            stream.reset()
        stamp, elapsed = stamp + elapsed, max(elapsed, 0)
        corrected = stream.correct(stamp, setpoint, offset)
        assert ((corrected >= low) & (corrected <= high)).all()
        wanted = setpoint + offset
        if before is not None:
            own = np.abs(setpoint - before[0]) + rate * min(elapsed / 1e9, age)
            assert (np.abs(corrected - before[1]) <= own + 1e-15).all()
        else:
            assert (corrected == np.clip(wanted, low, high)).all()
        before = setpoint, corrected
    # A wrench that stays is corrected in the end.
    for _ in range(3):
        stamp += 10**8
        corrected = stream.correct(stamp, setpoint, offset)
    assert np.abs(corrected - np.clip(setpoint + offset, low, high)).max() < 1e-15


def test_what_bounds_a_set_point_is_counted() -> None:
    robot = load("upr_rpu")
    assert robot.limits.position is not None
    low = robot.limits.position[:, 0]
    stream, push = SetpointStream(robot, 0.01, 0.1), np.full(3, -7.8e-4)
    assert (stream.correct(10**9, low, push) == low).all()
    assert (stream.at_limit, stream.at_rate) == (1, 0)
    # The wrench turns around: 1.56 mm take 0.156 s.
    turned = stream.correct(10**9 + 10**6, low + 0.1, -push)
    assert np.abs(turned - (low + 0.1 + push)).max() < 1e-5 + 1e-12
    assert (stream.at_limit, stream.at_rate) == (1, 1)
