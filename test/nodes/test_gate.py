# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The gate's core: live torques go through, everything else is zeros or gravity."""

import math
from itertools import permutations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from delta_dynamics import inverse_dynamics
from delta_dynamics.gate import Gate, GateSettings
from pkm_twin import robot_names
from pkm_twin.errors import MessageError
from test.nodes.harness import SECOND, Maker, Plain, reject
from test.support.robots import load

NOW = 1_000 * SECOND
STEP = SECOND // 1000
ROBOT = load("delta_cu")
NAMES = ROBOT.joint_names
DEADLINE = 100 * STEP
EFFORT = (0.5, -0.25, 1.0)
Q = (0.1, 0.2, 0.3)

pytestmark = pytest.mark.filterwarnings("error")


def gate(robot=ROBOT, **changes):
    return Gate(robot, GateSettings(**({"recovery_count": 2} | changes)))


def torques(make, stamp, effort=EFFORT, names=NAMES):
    return make.joint_state(names, (), (), effort, stamp)


def send(core, make, time, **changes):
    """One message that is stamped and arrives at a time, ns after the beginning."""
    stamp = changes.pop("stamp", NOW + time)
    return core.torques(torques(make, stamp, **changes), NOW + time, time)


def opened(make, **changes):
    """An open gate, and the time of its last message."""
    core = gate(**changes)
    for i in (1, 2):
        answer = send(core, make, i * STEP)
    assert answer is not None
    return core, 2 * STEP


def refused(core, make, time, **changes):
    return reject(lambda: send(core, make, time, **changes))[0]


@pytest.mark.parametrize("name", robot_names())
def test_a_gate_is_closed_until_enough_good_torques_have_come(make, name):
    robot = load(name)
    joints = robot.joint_names
    core = gate(robot, recovery_count=3)
    assert core.stream.stopped
    assert core.stream.reason == "waiting"
    assert (core.stop_command(0) == np.zeros(len(joints))).all()
    effort = np.arange(len(joints)) - 0.5
    answers = [send(core, make, i * STEP, effort=effort, names=joints) for i in range(1, 6)]
    assert [answer is None for answer in answers] == [True, True, False, False, False]
    assert all((answer == effort).all() for answer in answers[2:])


def test_permuted_and_foreign_joints_give_the_same_command(make):
    for order in permutations(range(3)):
        core, last = opened(make)
        names = [*(NAMES[i] for i in order), "conveyor"]
        effort = [*(EFFORT[i] for i in order), math.nan]
        answer = send(core, make, last + STEP, effort=effort, names=names)
        assert answer.tobytes() == np.array(EFFORT).tobytes()


@pytest.mark.parametrize(
    ("reason", "changes"),
    [
        ("not finite", {"effort": (0.5, math.nan, 1.0)}),
        ("not finite", {"effort": (0.5, 0.1, -math.inf)}),
        ("effort limit", {"effort": (0.5, 1e6, 1.0)}),
        ("bounds", {"effort": (0.5, 1e300, 1.0)}),
        ("bounds", {"effort": (5e-324, 0.0, 1.0)}),
        ("empty", {"effort": ()}),
        ("length", {"effort": (0.5, 0.1)}),
        ("missing joint", {"names": (*NAMES[:2], "wrist")}),
        ("duplicated joint", {"names": (*NAMES, NAMES[0]), "effort": (*EFFORT, 0.5)}),
        ("empty", {"names": (), "effort": ()}),
        ("zero stamp", {"stamp": 0}),
        ("stale stamp", {"stamp": NOW - DEADLINE}),
        ("future stamp", {"stamp": NOW + 2 * DEADLINE}),
        ("stamp order", {"stamp": NOW + 2 * STEP}),
    ],
)
def test_each_bad_message_closes_the_gate_and_good_ones_open_it(make, reason, changes):
    core, last = opened(make)
    assert refused(core, make, last + STEP, **changes) == reason
    assert core.stream.rejected == {reason: 1}
    assert core.stream.stopped
    answers = [send(core, make, last + i * STEP) for i in (2, 3)]
    assert [answer is None for answer in answers] == [True, False]


def test_a_stop_that_is_stamped_later_than_the_next_torques_closes_the_gate_for_a_few_only(make):
    """Torques carry the stamp of the state they answer, a stop's torque the time it was sent at."""
    core = gate(recovery_count=3)
    for k in range(3):
        send(core, make, k * STEP)
    assert send(core, make, 3 * STEP) is not None
    lag = DEADLINE - 20 * STEP
    forwarded = []
    for k in range(4, 12):
        try:
            forwarded.append(send(core, make, k * STEP, stamp=NOW + k * STEP - lag) is not None)
        except MessageError as error:
            forwarded.append(error.reason)
    assert forwarded == ["stamp order", False, False, *[True] * 5]


def test_of_two_that_take_turns_the_older_one_keeps_the_gate_closed(make):
    core = gate(recovery_count=2)
    for k in range(20):
        send(core, make, 2 * k * STEP)
        with pytest.raises(MessageError, match="stamp"):
            send(core, make, (2 * k + 1) * STEP, stamp=NOW + (2 * k - 1) * STEP)
    assert core.stream.stopped


def test_bad_messages_below_the_trip_count_are_only_left_out(make):
    core, last = opened(make, trip_count=2)
    refused(core, make, last + STEP, effort=(math.nan, 0.0, 0.0))
    assert not core.stream.stopped
    assert send(core, make, last + 2 * STEP) is not None


def test_refused_messages_do_not_keep_the_gate_open(make):
    core, last = opened(make, trip_count=10**6)
    for i in range(1, 200):
        refused(core, make, last + i * STEP, effort=(math.nan, 0.0, 0.0))
    assert core.stream.stopped
    assert core.stream.stops["stale torques"] == 1


@example(gaps=[DEADLINE, DEADLINE + 1])
@given(gaps=st.lists(st.integers(1, 3 * DEADLINE), min_size=1, max_size=30))
def test_it_is_open_exactly_where_no_silence_passed_the_deadline(gaps):
    core = gate(recovery_count=1)
    make = Maker(Plain())
    time = 0
    send(core, make, time)
    for gap in gaps:
        core.close_if_silent(time + gap)
        assert core.stream.stopped is (gap > DEADLINE)
        time += gap
        assert send(core, make, time) is not None


@given(st.integers(-3 * DEADLINE, 3 * DEADLINE))
def test_no_torque_older_than_the_deadline_is_forwarded(age):
    core = gate(recovery_count=1, future_tolerance=0.05)
    try:
        answer = send(core, Maker(Plain()), 0, stamp=NOW - age)
    except MessageError:
        answer = None
    assert (answer is not None) is (-DEADLINE // 2 <= age <= DEADLINE)


def test_a_message_that_ends_a_silence_is_held_back(make):
    core, last = opened(make)
    late = last + DEADLINE + STEP
    assert send(core, make, late) is None
    assert core.stream.stops["stale torques"] == 1


class TestGravity:
    def state(self, core, make, time, **changes):
        fields = {"names": NAMES, "position": Q, "stamp": NOW + time} | changes
        core.joint_state(make.joint_state(**fields), NOW + time, time)

    def test_a_measured_state_gives_what_bears_the_weight(self, make):
        core = gate(on_stop="gravity")
        assert (core.stop_command(0) == 0.0).all()
        self.state(core, make, STEP)
        held = inverse_dynamics(ROBOT, np.array(Q), np.zeros(3), np.zeros(3))
        assert np.abs(held).max() > 0.1
        assert (core.stop_command(STEP + DEADLINE) == held).all()
        # A guess of where the robot has gone since would push.
        assert (core.stop_command(STEP + DEADLINE + 1) == 0.0).all()

    def test_the_payload_that_it_is_told_of_has_weight(self, make):
        core = gate(on_stop="gravity")
        self.state(core, make, STEP)
        light = core.stop_command(STEP)
        heavy = ROBOT.changed(payload={"mass": 0.5, "com": [0.0, 0.0, -0.05]})
        core.change_robot(heavy)
        exact = inverse_dynamics(heavy, np.array(Q), np.zeros(3), np.zeros(3))
        assert (core.stop_command(STEP) == exact).all()
        assert np.abs(exact - light).max() > 0.1

    def test_where_the_model_has_no_answer_or_one_beyond_the_limits_it_is_zeros(self, make):
        weak = ROBOT.changed(limits={"effort": [1e-3] * 3})
        core = gate(weak, on_stop="gravity")
        self.state(core, make, STEP)
        assert (core.stop_command(STEP) == 0.0).all()
        core = gate(on_stop="gravity")
        # No assembly: limb I is too short.
        core.change_robot(ROBOT.changed(limits={"position": [[-3.0, 3.0]] * 3}))
        self.state(core, make, STEP, position=(2.0, 1.3, 0.4))
        assert (core.stop_command(STEP) == 0.0).all()

    def test_neither_an_older_state_nor_one_of_another_publisher_replaces_the_pose(self, make):
        core = gate(on_stop="gravity")
        self.state(core, make, 10 * STEP)
        held = core.stop_command(10 * STEP)
        for reason, changes in (
            ("stamp order", {"position": (0.11, 0.2, 0.3), "stamp": NOW + 9 * STEP}),
            ("jump", {"position": (0.4, 0.2, 0.3), "stamp": NOW + 10 * STEP}),
        ):
            assert reject(lambda changes=changes: self.state(core, make, 10 * STEP, **changes))[0] == reason
            assert (core.stop_command(10 * STEP) == held).all()
        # The machine was moved while no state came.
        self.state(core, make, 2 * SECOND, position=(0.4, 0.2, 0.3))
        assert (core.stop_command(2 * SECOND) != held).any()

    def test_a_refused_state_is_not_kept(self, make):
        core = gate(on_stop="gravity")
        with pytest.raises(MessageError):
            self.state(core, make, STEP, position=(math.nan, 0.2, 0.3))
        assert (core.stop_command(STEP) == 0.0).all()
        assert core.states.rejected == {"not finite": 1}
        assert "arm_1 is nan" in core.last_reject


def test_limits_are_those_of_the_robot_of_now(make):
    core, last = opened(make)
    core.change_robot(ROBOT.changed(limits={"effort": [0.6] * 3}))
    assert refused(core, make, last + STEP) == "effort limit"


def test_a_clock_jump_closes_the_gate_and_begins_anew(make):
    core, _ = opened(make)
    core.reset()
    assert core.stream.stops["clock jump"] == 1
    back = NOW - 100 * SECOND
    answers = [core.torques(torques(make, back + i * STEP), back + i * STEP, (3 + i) * STEP) for i in (1, 2)]
    assert [answer is None for answer in answers] == [True, False]
