# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""No effort leaves the cores beyond its limits, not finite, or computed from an old pose."""

import math
from contextlib import suppress
from itertools import product

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from delta_dynamics import inverse_dynamics
from delta_dynamics.feedforward import Feedforward, Settings
from delta_dynamics.gate import Gate, GateSettings
from delta_dynamics.holding import MeasuredPose, find_holding_effort
from pkm_twin.errors import MessageError
from pkm_twin.machine.joint_map import ControllerNumbers
from pkm_twin.messages.stamps import SECOND
from pkm_twin.robot.effort_limits import EffortLimits, effort_limits
from pkm_twin.streams.matched import WrenchWindow
from pkm_twin.streams.wrench import WrenchReader, WrenchSettings
from test.nodes.feedforward_core import NOW, ROBOT, STEP, UNREACHABLE, WINDOW, sample, trajectory
from test.nodes.harness import Maker, Plain

MAKE = Maker(Plain())
STALE = 0.1
POLICIES = ("warn", "reject", "clamp")
LIMITS = effort_limits(ROBOT)
HEAVY = ROBOT.changed(payload={"mass": 60.0, "com": [0.0, 0.0, 0.0]})
MAPPED = {"arm_1": {"sign": -1.0, "ratio": 50.0, "offset": 3.0}}


def bad_states(twin, at, **fields):
    """As many bad joint states as stop the stream; the time after them."""
    for k in range(twin.settings.trip_count):
        with pytest.raises(MessageError):
            twin.joint_state(*sample(MAKE, at + k, **fields))
    return at + twin.settings.trip_count


def leap(twin, at):
    twin.time_jumped_forward()
    return at


def silence(twin, at):
    """As the node's watch stops a silent stream."""
    twin.stop("stale input", "no accepted joint state")
    return at + 101


def suspension(twin, at):
    """The first joint state after a suspension has been waiting for it."""
    message, _ = sample(MAKE, at)
    for _ in range(twin.settings.trip_count):
        with pytest.raises(MessageError, match="old"):
            twin.joint_state(message, NOW + (at + 5000) * STEP)
    return at + 5000


def stop(reason):
    def end(twin, at):
        twin.stop(reason, reason)
        return at

    return end


def late_answer(twin, at):
    with suppress(MessageError):  # Beyond the limits, say: there is no answer that could be late.
        torques = twin.joint_state(*sample(MAKE, at))
        for _ in range(twin.settings.trip_count):
            with pytest.raises(MessageError, match="ready"):
                twin.check_age(torques, torques.stamp + SECOND)
    return at + 1000


def no_wrench(twin, at):
    twin.wrenches.missing_wrench_policy = "stop"
    with pytest.raises(MessageError, match="no wrench"):
        twin.joint_state(*sample(MAKE, at))
    return at


REASONS = {
    "not finite": lambda twin, at: bad_states(twin, at, position=(math.nan, 0.0, 0.0)),
    "another machine": lambda twin, at: bad_states(twin, at, names=("a", "b", "c")),
    "jump": lambda twin, at: bad_states(twin, at, position=(0.4, 0.4, 0.4)),
    "clock jump": leap,
    "stale input": silence,
    "suspension": suspension,
    "exception": stop("exception"),
    "inactive": stop("inactive"),
    "late answer": late_answer,
    "no wrench": no_wrench,
}


@pytest.mark.parametrize("reason", REASONS)
def test_no_effort_of_a_stream_or_of_its_stop_passes_the_limits_or_is_of_an_old_pose(reason):
    for robot, policy, on_stop in product((ROBOT, HEAVY), POLICIES, ("nothing", "zeros", "gravity")):
        window = WrenchWindow(WrenchReader(WrenchSettings()), SECOND, "ignore", 2, WINDOW)
        own = Settings(window=WINDOW, recovery_count=1, trip_count=4, limit_policy=policy, on_stop=on_stop)
        twin = Feedforward(robot, own, window)
        for k in range(10):
            try:
                torques = twin.joint_state(*sample(MAKE, k))
            except MessageError as error:
                assert (error.reason, policy) == ("effort limit", "reject")
                continue
            if torques is None:
                continue
            assert (torques.sent == torques.effort).all()
            if policy != "warn":
                assert (np.abs(torques.sent) <= LIMITS).all()
        end = REASONS[reason](twin, 10)
        for later in (0, 50, 90, 101, 1000, 10**5):
            steady = NOW + (end + later) * STEP
            effort = twin.stop_effort(steady)
            if on_stop == "nothing":
                assert effort is None
                continue
            assert (np.abs(effort) <= LIMITS).all()
            if effort.any():
                assert on_stop == "gravity" and robot is ROBOT
                q = twin.pose.q
                assert (effort == inverse_dynamics(robot, q, 0 * q, 0 * q)).all()
                assert twin.pose.age(steady) <= STALE


def test_a_pose_is_as_old_as_its_stamp_however_late_it_came():
    """It arrives with 0.06 s of age and is used 0.05 s later; the ROS clock may stand meanwhile."""
    twin = Feedforward(ROBOT, Settings(window=WINDOW, recovery_count=1, on_stop="gravity"))
    message, _ = sample(MAKE, 0)
    twin.joint_state(message, NOW + 60 * STEP, 5 * SECOND)
    assert twin.stop_effort(5 * SECOND + 40 * STEP).any()
    assert not twin.stop_effort(5 * SECOND + 41 * STEP).any()
    gate = Gate(ROBOT, GateSettings(on_stop="gravity"))
    gate.joint_state(message, NOW + 60 * STEP, 5 * SECOND)
    assert gate.stop_command(5 * SECOND + 40 * STEP).any()
    assert not gate.stop_command(5 * SECOND + 41 * STEP).any()


@pytest.mark.parametrize("policy", POLICIES)
def test_points_that_stop_the_machine_are_zeros_beyond_the_limits(policy):
    twin = Feedforward(HEAVY, Settings(window=WINDOW, limit_policy=policy))
    rest = {"rates": True, "accelerations": True}
    message = trajectory(MAKE, count=3, **rest)
    steps = twin.trajectory_steps(message, NOW, holding=True)
    while True:
        try:
            next(steps)
        except StopIteration as end:
            efforts = end.value
            break
    assert efforts.shape == (3, 3) and not efforts.any()


numbers = st.floats(-1e9, 1e9)


@settings(max_examples=200)
@example(rows=[[20.0, -20.0, 20.0]], mapped=True)
@given(rows=st.lists(st.lists(numbers, min_size=3, max_size=3), min_size=1, max_size=4), mapped=st.booleans())
def test_every_policy_keeps_the_limits_and_changes_nothing_within_them(rows, mapped):
    robot = ROBOT.changed(joint_map=MAPPED) if mapped else ROBOT
    own = EffortLimits(robot)
    bound = np.abs(robot.controller.controller_efforts(LIMITS))
    batch = ControllerNumbers(np.array(rows))
    for efforts in (batch, *map(ControllerNumbers, batch)):
        beyond = np.abs(efforts) > bound
        for policy in (*POLICIES, "zeros"):
            if policy == "reject" and beyond.any():
                with pytest.raises(MessageError, match="allowed"):
                    own.apply(efforts, policy)
                continue
            limited, exceeded = own.apply(efforts, policy)
            assert exceeded == beyond.any()
            good = ~beyond.any(-1)
            assert (limited[good] == efforts[good]).all()
            if policy != "warn":
                assert (np.abs(limited) <= bound).all()
            if policy == "zeros":
                assert not limited[~good].any()
        for value in (math.nan, math.inf, -math.inf):
            bad = efforts.copy()
            bad.flat[0] = value
            for policy in (*POLICIES, "zeros"):
                with pytest.raises(MessageError, match="not finite"):
                    own.apply(ControllerNumbers(bad), policy)


def test_where_the_model_has_no_answer_the_effort_is_zero():
    far = MeasuredPose(np.array(UNREACHABLE), 0)
    assert not find_holding_effort(EffortLimits(ROBOT), far, 0, STALE).any()
