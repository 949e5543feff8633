# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""No effort leaves the cores beyond its limits, not finite, or computed from an old pose."""

import math
from contextlib import suppress
from dataclasses import replace
from itertools import product
from unittest import mock

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from delta_dynamics.feedforward import Feedforward, Settings
from delta_dynamics.gate import Gate, GateSettings
from delta_dynamics.holding import MeasuredPose, find_holding_effort
from pkm_twin.errors import MessageError, UnreachableError
from pkm_twin.machine.joint_map import ControllerNumbers
from pkm_twin.messages.stamps import SECOND
from pkm_twin.robot.effort_limits import EffortLimits
from pkm_twin.streams.base_motion import BaseImu, ImuSettings
from pkm_twin.streams.matched import WrenchWindow
from pkm_twin.streams.monitor import run_to_end
from pkm_twin.streams.wrench import WrenchReader, WrenchSettings
from test.nodes.efforts import HEAVY, LIMITS, PLACES, ROBOT, Judge
from test.nodes.feedforward_core import NAMES, NOW, STEP, UNREACHABLE, WINDOW, sample, trajectory
from test.nodes.harness import Maker, Plain

MAKE = Maker(Plain())
STALE = 0.1
POLICIES = ("warn", "reject", "clamp")
MAPPED = {"arm_1": {"sign": -1.0, "ratio": 50.0, "offset": 3.0}}


class Chain:
    """A feedforward core and a gate behind it; every effort that leaves one of them is judged."""

    def __init__(self, policy="warn", on_stop="gravity", heavy=False):
        self.robot = HEAVY if heavy else ROBOT
        window = WrenchWindow(WrenchReader(WrenchSettings()), SECOND, "ignore", 2, WINDOW)
        own = Settings(window=WINDOW, recovery_count=2, trip_count=4, limit_policy=policy, on_stop=on_stop)
        self.twin = Feedforward(self.robot, own, window)
        bearing = "gravity" if on_stop == "gravity" else "zeros"
        self.gate = Gate(self.robot, GateSettings(recovery_count=2, on_stop=bearing))
        self.law = Judge()
        self.ros, self.steady, self.place = NOW, 7 * SECOND, 0
        self.accepted = self.steady
        self.late = []
        """Torques on their way to the gate, and when they arrive."""
        self.transit = 0

    def wait(self, milliseconds):
        for _ in range(milliseconds):
            self.ros, self.steady = self.ros + STEP, self.steady + STEP
            if self.steady // STEP % 25 == 0:
                self.watch()

    def sleep(self, milliseconds):
        """Neither process runs."""
        self.ros, self.steady = self.ros + milliseconds * STEP, self.steady + milliseconds * STEP

    def watch(self):
        """As the nodes' timers do."""
        if self.steady - self.accepted > STALE * SECOND:
            with self.twin.stream.reacting(self.stop):
                self.twin.stop("stale input", "no accepted joint state")
        self.pass_on()
        self.gate.close_if_silent(self.steady)
        if self.gate.stream.stopped:
            self.law.judge(self.gate.stop_command(self.steady), self.steady / SECOND, STALE)

    def message(self, age=0, **fields):
        """A state of the machine in its next place, measured so long ago, ms."""
        self.place += 1
        stamp = self.ros - age * STEP
        self.law.state(self.place, (self.steady - age * STEP) / SECOND)
        given = {"names": NAMES, "position": PLACES[self.place], "velocity": (0.0, 0.0, 0.0), "stamp": stamp}
        return MAKE.joint_state(**(given | fields))

    def send(self, message):
        """The message arrives at both."""
        with suppress(MessageError):
            self.gate.joint_state(message, self.ros, self.steady)
        with suppress(MessageError), self.twin.stream.reacting(self.stop):
            torques = self.twin.joint_state(message, self.ros, self.steady)
            if torques is not None:
                self.twin.check_age(torques, self.ros)
            self.accepted = self.steady
            if torques is not None:
                policy = self.twin.settings.limit_policy
                self.law.judge(torques.sent, self.steady / SECOND, STALE, policy)
                self.late.append((self.steady + self.transit, torques.stamp, torques.sent))
        self.pass_on()

    def stop(self):
        """As the node does when the stream stops."""
        effort = self.twin.stop_effort(self.steady)
        assert (effort is None) == (self.twin.settings.on_stop == "nothing")
        if effort is not None:
            self.law.judge(effort, self.steady / SECOND, STALE)
            assert self.twin.settings.on_stop == "gravity" or not effort.any()
            self.late.append((self.steady + self.transit, self.ros, effort))

    def pass_on(self):
        """Torques that are there reach the gate."""
        while self.late and self.late[0][0] <= self.steady:
            _, stamp, effort = self.late.pop(0)
            before = self.gate.stream.stopped
            with suppress(MessageError):
                command = self.gate.torques(MAKE.joint_state(NAMES, (), (), effort, stamp), self.ros, self.steady)
                if command is not None:
                    # A stop's torque is stamped when it is sent; both ways last.
                    policy = "clamp" if self.twin.settings.limit_policy == "clamp" else "reject"
                    self.law.judge(command, self.steady / SECOND, 2.0 * STALE, policy)
            if self.gate.stream.stopped and not before:
                self.law.judge(self.gate.stop_command(self.steady), self.steady / SECOND, STALE)

    def run(self, count=12):
        for _ in range(count):
            self.wait(1)
            self.send(self.message())

    def bad(self, count=4, **fields):
        """As many bad states as stop a stream."""
        for _ in range(count):
            self.wait(1)
            self.send(self.message(**fields))


def leap(chain):
    chain.ros += 10 * SECOND
    with chain.twin.stream.reacting(chain.stop):
        chain.twin.time_jumped_forward()
    chain.gate.reset()


def step_back(chain):
    """The clock goes back, and stops no stream: it begins anew."""
    chain.ros -= 10 * SECOND
    chain.twin.reset()
    chain.gate.reset()


def suspension(chain):
    """What came meanwhile, of a machine that moves, waits for the processes."""
    waiting = []
    for _ in range(25):
        chain.sleep(20)
        waiting.append(chain.message())
    chain.place += 3000
    for message in waiting:
        chain.send(message)
    chain.watch()


def stop(reason):
    def end(chain):
        with chain.twin.stream.reacting(chain.stop):
            chain.twin.stop(reason, reason)
        chain.gate.stream.stop(reason, reason)
        chain.law.judge(chain.gate.stop_command(chain.steady), chain.steady / SECOND, STALE)

    return end


def late_answer(chain):
    """Four answers of one state, each looked at too late."""
    chain.wait(1)
    message = chain.message()
    with suppress(MessageError), chain.twin.stream.reacting(chain.stop):
        torques = chain.twin.joint_state(message, chain.ros, chain.steady)
        if torques is not None:
            chain.sleep(150)
            for _ in range(4):
                with suppress(MessageError):
                    chain.twin.check_age(torques, chain.ros)


def no_wrench(chain):
    chain.twin.wrenches.missing_wrench_policy = "stop"
    chain.bad()
    chain.twin.wrenches.missing_wrench_policy = "ignore"


def no_base_motion(chain):
    chain.twin.base = BaseImu(ImuSettings())
    chain.bad()
    chain.twin.base = None


def effort_limit(chain):
    before = chain.twin.settings
    chain.twin.change_settings(replace(before, limit_policy="reject"))
    for core in (chain.twin, chain.gate):
        core.change_robot(HEAVY)
    chain.run()
    for core in (chain.twin, chain.gate):
        core.change_robot(chain.robot)
    chain.twin.change_settings(before)


def no_result(chain):
    """The model's numbers are not finite, for a holding effort too."""
    nothing = np.full(3, math.nan)
    with (
        mock.patch("delta_dynamics.feedforward.inverse_dynamics", lambda *_: nothing),
        mock.patch("delta_dynamics.holding.inverse_dynamics", lambda *_, **__: nothing),
    ):
        chain.bad()


def singular(chain):
    with mock.patch.object(chain.twin._continuity, "stop", 0.999):
        chain.bad()


def unreachable(chain):
    """By a model that has no assembly: within its limits this machine has one everywhere."""
    with mock.patch.object(chain.twin._continuity, "step", side_effect=UnreachableError("joints", "arm_1", (), 0.1)):
        chain.bad()


def jump(chain):
    chain.place += 1000
    chain.bad()


REASONS = {
    "not finite": lambda chain: chain.bad(position=(math.nan, 0.0, 0.0)),
    "not finite rate": lambda chain: chain.bad(velocity=(0.0, math.inf, 0.0)),
    "missing joint": lambda chain: chain.bad(names=("a", "b", "c")),
    "duplicated joint": lambda chain: chain.bad(names=(*NAMES[:2], NAMES[0])),
    "length": lambda chain: chain.bad(position=(0.1, 0.2)),
    "empty": lambda chain: chain.bad(position=()),
    "limit": lambda chain: chain.bad(position=(3.0, 0.2, 0.3)),
    "limit rate": lambda chain: chain.bad(velocity=(0.0, 0.0, 1e3)),
    "no velocities": lambda chain: chain.bad(velocity=()),
    "zero stamp": lambda chain: chain.bad(stamp=0),
    "stale stamp": lambda chain: chain.bad(age=101),
    "future stamp": lambda chain: chain.bad(stamp=chain.ros + 150 * STEP),
    "stamp order": lambda chain: chain.bad(stamp=chain.ros - STEP),
    "jump": jump,
    "unreachable": unreachable,
    "singular": singular,
    "effort limit": effort_limit,
    "non-finite result": no_result,
    "no wrench": no_wrench,
    "no base motion": no_base_motion,
    "late answer": late_answer,
    "clock jump": leap,
    "stale input": lambda chain: chain.wait(130),
    "stale stamp of a suspension": suspension,
    "exception": stop("exception"),
    "inactive": stop("inactive"),
}
"""Every reason of a stop, and how it comes about; the first words are those of the counter."""


@pytest.mark.parametrize("reason", REASONS)
def test_no_effort_of_a_stream_or_of_its_stop_passes_the_limits_or_is_of_an_old_pose(reason):
    for heavy, policy, on_stop in product((False, True), POLICIES, ("nothing", "zeros", "gravity")):
        chain = Chain(policy, on_stop, heavy)
        chain.run()
        answered = chain.law.judged > 0
        assert answered or (heavy and policy == "reject")
        REASONS[reason](chain)
        stopped = chain.twin.stream.stops
        assert any(reason.startswith(one) for one in stopped) or not answered, stopped
        for pause in (0, 50, 40, 30, 1000):
            chain.wait(pause)
            chain.watch()
        before = chain.law.judged
        chain.run(20)
        assert (chain.law.judged > before) == answered


def change(**fields):
    return lambda chain: chain.twin.change_settings(replace(chain.twin.settings, **fields))


def change_payload(heavy):
    def change(chain):
        chain.robot = HEAVY if heavy else ROBOT
        for core in (chain.twin, chain.gate):
            core.change_robot(chain.robot)

    return change


def slow(milliseconds):
    return lambda chain: setattr(chain, "transit", milliseconds * STEP)


def reset(chain):
    chain.twin.stream.resume()
    chain.gate.stream.resume()


def points(holding):
    """A trajectory of points at rest: its efforts are the weights there."""

    def send(chain):
        rows = PLACES[:3]
        for k in range(3):
            chain.law.state(k, chain.steady / SECOND)
        zero = np.zeros((3, 3))
        message = MAKE.trajectory(NAMES, [0, SECOND, 2 * SECOND], rows, zero, zero)
        with suppress(MessageError), chain.twin.stream.reacting(chain.stop):
            policy = "zeros" if holding else chain.twin.settings.limit_policy
            for effort in run_to_end(chain.twin.trajectory_steps(message, chain.ros, holding=holding)):
                chain.law.judge(effort, chain.steady / SECOND, STALE, policy)

    return send


EVENTS = {
    **REASONS,
    "run": Chain.run,
    "run long": lambda chain: chain.run(40),
    "old but good": lambda chain: chain.bad(age=95),
    "one bad": lambda chain: chain.bad(1, position=(0.0, -math.inf, 0.0)),
    "step back": step_back,
    "short sleep": lambda chain: chain.sleep(60),
    "moved": lambda chain: setattr(chain, "place", chain.place + 500),
    "heavy": change_payload(True),
    "light": change_payload(False),
    "slow": slow(60),
    "slower": slow(99),
    "quick": slow(0),
    "reset": reset,
    "points": points(False),
    "points that hold": points(True),
    **{policy: change(limit_policy=policy) for policy in POLICIES},
    **{on_stop: change(on_stop=on_stop) for on_stop in ("nothing", "zeros", "gravity")},
}


def check_events(events):
    chain = Chain()
    chain.run()
    for event in events:
        if chain.place > len(PLACES) - 5000:
            break
        EVENTS[event](chain)
        chain.wait(1)
    assert chain.law.judged


@settings(max_examples=60)
@given(st.lists(st.sampled_from(list(EVENTS)), min_size=5, max_size=20))
def test_no_order_of_stops_changes_and_recoveries_lets_another_effort_out(events):
    check_events(events)


@pytest.mark.long
@settings(max_examples=2000)
@given(st.lists(st.sampled_from(list(EVENTS)), min_size=5, max_size=60))
def test_no_long_order_of_stops_changes_and_recoveries_lets_another_effort_out(events):
    check_events(events)


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
    efforts = run_to_end(twin.trajectory_steps(message, NOW, holding=True))
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
