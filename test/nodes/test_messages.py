# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Readers of messages: every fault is named, what comes through is finite and in order."""

import math
from dataclasses import replace
from itertools import permutations, product

import numpy as np
import pytest

from pkm_twin.messages.reading import (
    MAX_ACCELERATION,
    MAX_EFFORT,
    MAX_FORCE,
    MAX_POINTS,
    JointReader,
    TrajectoryFields,
    read_deflection,
    read_wrench,
)
from pkm_twin.messages.stamps import MAX_DURATION, StampRules, stamp_of
from test.nodes.harness import SECOND, Maker, Plain, Ros, reject
from test.support.robots import load

NOW = 1_000 * SECOND
NAMES = ("arm_1", "arm_2", "arm_3")
Q = (0.1, 0.2, 0.3)
QD = (1.0, -2.0, 3.0)
WRENCH = (1.0, -2.0, 3.0, -0.1, 0.2, -0.3)
DAMAGED = [math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, -2e-310]
"""No measurement: not finite, beyond all bounds, or denormal."""
RULES = StampRules(max_age=SECOND // 10)
ROBOT = load("delta_cu")

pytestmark = pytest.mark.filterwarnings("error")


@pytest.fixture(scope="session", params=["plain", "ros"])
def make(request):
    """Builds messages as plain attribute objects, then as real ROS messages."""
    if request.param == "ros":
        pytest.importorskip("trajectory_msgs.msg", exc_type=ImportError)
        return Maker(Ros())
    return Maker(Plain())


@pytest.fixture
def reader():
    return JointReader(ROBOT)


def state(make, **changes):
    fields = {"names": NAMES, "position": Q, "velocity": QD, "effort": Q, "stamp": NOW}
    return make.joint_state(**(fields | changes))


def trajectory(make, **changes):
    fields = {
        "names": NAMES,
        "times": [0, SECOND // 2, SECOND],
        "positions": [Q] * 3,
        "velocities": [QD] * 3,
        "accelerations": [QD] * 3,
        "stamp": 0,
    }
    return make.trajectory(**(fields | changes))


def at(values, index, value):
    changed = list(values)
    changed[index] = value
    return changed


READ = {
    "state": lambda m: JointReader(ROBOT).joint_state(m, NOW, RULES),
    "trajectory": lambda m: JointReader(ROBOT).trajectory(m, NOW),
    "wrench": lambda m: read_wrench(m, NOW, RULES, "platform", False),
}


def changed(make, kind, changes):
    if kind == "wrench":
        return make.wrench(**({"values": WRENCH, "stamp": NOW} | changes))
    return (state if kind == "state" else trajectory)(make, **changes)


def damaged(value):
    """Each value of each kind of message, damaged: the message, the changes, the reason, words."""
    reason = "" if math.isfinite(value) else "not finite"
    for what, joint in product(("position", "velocity", "effort"), range(3)):
        yield "state", {what: at(Q, joint, value)}, reason, (NAMES[joint], what)
    for what in ("positions", "velocities", "accelerations"):
        row = at(Q, 1, value)
        yield "trajectory", {what: at([Q] * 3, 2, row)}, reason, ("point 2: ", "arm_2")
    for entry in range(6):
        word = ("force" if entry < 3 else "torque") + "." + "xyz"[entry % 3]
        yield "wrench", {"values": at(WRENCH, entry, value)}, reason or "bounds", (word,)


@pytest.mark.parametrize("value", DAMAGED)
def test_a_damaged_value_is_named(make, value):
    for kind, changes, expected, words in damaged(value):
        reason, text = reject(READ[kind], changed(make, kind, changes))
        assert reason == expected if expected else reason in ("bounds", "limit")
        assert all(word in text for word in words)


def wrong_lengths():
    for what, row in product(("position", "velocity", "effort"), ((0.1,), (0.1, 0.2), (*Q, 0.4))):
        yield "state", {what: row}, f"{len(row)} values for 3 names"
    rows = ((), (0.1, 0.2), (*Q, 0.4))
    for what, row, point in product(("positions", "velocities", "accelerations"), rows, range(3)):
        values = {what: at([Q] * 3, point, row)}
        yield "trajectory", values, f"point {point}: {len(row)} {what} for 3"


def test_a_wrong_length_names_both_lengths(make):
    for kind, changes, word in wrong_lengths():
        reason, text = reject(READ[kind], changed(make, kind, changes))
        assert reason == "length" and word in text


@pytest.mark.parametrize(
    ("kind", "changes", "reason", "words"),
    [
        *(("state", {"names": at(NAMES, k, "elbow")}, "missing joint", [repr(NAMES[k])]) for k in range(3)),
        (
            "state",
            {"names": (*NAMES, "arm_2"), "position": (*Q, 0.2), "velocity": (), "effort": ()},
            "duplicated joint",
            ["'arm_2'"],
        ),
        ("state", {"names": (), "position": ()}, "empty", []),
        ("state", {"names": ()}, "empty", []),
        ("state", {"position": ()}, "empty", []),
        ("state", {"position": (math.nan,) * 3}, "empty", ["all positions are nan"]),
        ("state", {"position": at(Q, 1, 1.31)}, "limit", ["arm_2", "1.31", "1.3"]),
        ("state", {"position": at(Q, 1, -0.91)}, "limit", ["arm_2", "-0.91", "-0.9"]),
        ("state", {"velocity": at(Q, 1, -15.1)}, "limit", ["arm_2", "-15.1", "-15"]),
        ("state", {"effort": (0.0, MAX_EFFORT * 1.01, 0.0)}, "bounds", []),
        ("state", {"stamp": 0}, "zero stamp", []),
        ("state", {"stamp": NOW + SECOND // 10 + 1}, "future stamp", []),
        ("state", {"stamp": NOW - SECOND // 10 - 1}, "stale stamp", []),
        ("trajectory", {"names": ()}, "empty", []),
        ("trajectory", {"times": [], "positions": []}, "empty", []),
        ("trajectory", {"positions": [()] * 3}, "empty", []),
        ("trajectory", {"names": ("arm_1", "arm_2")}, "missing joint", []),
        ("trajectory", {"names": ("arm_1", "arm_2", "arm_2")}, "duplicated joint", []),
        ("trajectory", {"names": (*NAMES, "arm_1")}, "duplicated joint", []),
        ("trajectory", {"names": ("arm_1", "arm_2", "wrist")}, "unknown joint", []),
        ("trajectory", {"names": (*NAMES, "wrist")}, "unknown joint", []),
        ("trajectory", {"names": ("arm_1", "arm_2", "")}, "unknown joint", []),
        ("trajectory", {"positions": at([Q] * 3, 0, at(Q, 2, 1.31))}, "limit", []),
        ("trajectory", {"velocities": at([Q] * 3, 0, at(Q, 2, 15.1))}, "limit", []),
        (
            "trajectory",
            {"accelerations": at([Q] * 3, 0, at(Q, 2, 1.01 * MAX_ACCELERATION))},
            "bounds",
            [],
        ),
        ("trajectory", {"times": [0, 0, SECOND]}, "time", []),
        ("trajectory", {"times": [0, SECOND, SECOND]}, "time", []),
        ("trajectory", {"times": [0, SECOND, SECOND // 2]}, "time", []),
        ("trajectory", {"times": [-1, SECOND, 2 * SECOND]}, "time", []),
        ("trajectory", {"times": [-SECOND, 0, SECOND]}, "time", []),
        ("trajectory", {"times": [0, 1, MAX_DURATION + 1]}, "bounds", []),
        ("trajectory", {"stamp": NOW - SECOND - 1}, "over", []),
        *(
            ("wrench", {"frame": frame}, "frame", [f"{frame!r}, expected 'platform'{hint}\n"])
            for frame, hint in (
                ("", "; set accept_empty_frame to allow it"),
                *((other, "") for other in ("tool0", "Platform", "/platform")),
            )
        ),
        *(("wrench", {"values": at(WRENCH, k, 1.01 * MAX_FORCE)}, "bounds", []) for k in range(6)),
        ("wrench", {"stamp": 0}, "zero stamp", []),
        ("wrench", {"stamp": NOW + SECOND}, "future stamp", []),
        ("wrench", {"stamp": NOW - SECOND}, "stale stamp", []),
    ],
)
def test_what_is_wrong_is_named(make, kind, changes, reason, words):
    found, text = reject(READ[kind], changed(make, kind, changes))
    assert found == reason
    assert all(word in f"{text}\n" for word in words)


def deflection(shift, turn=(0.0, 0.0, 0.0, 1.0)):
    made = Maker(Plain())
    fields = made.kind(
        translation=made.kind(**dict(zip("xyz", shift, strict=True))),
        rotation=made.kind(**dict(zip("xyzw", turn, strict=True))),
    )
    message = made.kind(header=made.header(NOW, "tool0"), transform=fields)
    return read_deflection(message, NOW, RULES)


def edges(limitless):
    """Readers of one value, and the greatest and least that they accept."""
    make, own, free = Maker(Plain()), JointReader(ROBOT), JointReader(limitless)
    reach = 2000.0 * math.pi

    def of_state(reader, what):
        return lambda v: reader.joint_state(state(make, **{what: at(Q, 1, v)}), NOW, RULES)

    def of_trajectory(reader, what):
        return lambda v: reader.trajectory(trajectory(make, **{what: at([Q] * 3, 1, at(Q, 2, v))}), NOW)

    for reader, low, high, fast in ((own, -0.9, 1.3, 15.0), (free, -reach, reach, 1e4)):
        for of, end in ((of_state, ""), (of_trajectory, "s")):
            yield of(reader, f"position{end}"), low, high
            yield of(reader, "velocities" if end else "velocity"), -fast, fast
        yield of_state(reader, "effort"), -1e7, 1e7
        yield of_trajectory(reader, "accelerations"), -1e7, 1e7
        yield lambda v, reader=reader: reader.commands(at(Q, 0, v)), -1e7, 1e7
    for k in range(6):
        yield (
            lambda v, k=k: read_wrench(make.wrench(at(WRENCH, k, v), NOW), NOW, RULES, "platform", False),
            -1e7,
            1e7,
        )
    for k in range(3):
        yield lambda v, k=k: deflection(at([0.0] * 3, k, v)), -0.1, 0.1


def test_bounds_are_accepted_and_the_next_number_is_not(limitless):
    """Also those of the smallest numbers that are none of a damaged message."""
    tiny = 2.0**-1022
    for read, low, high in edges(limitless):
        for good in (low, high, tiny, -tiny, 0.0, -0.0):
            read(good)
        below = math.nextafter(tiny, 0.0)
        for bad in (math.nextafter(low, -math.inf), math.nextafter(high, math.inf), below, -below):
            assert reject(read, bad)[0] in ("bounds", "limit")


@pytest.mark.parametrize("joint", range(3))
@pytest.mark.parametrize(
    ("what", "value", "reason"),
    [
        ("velocity", 15.0, ""),
        ("velocity", math.nextafter(15.0, 16.0), "limit"),
        ("velocity", math.nan, "not finite"),
        ("acceleration", 1e7, ""),
        ("acceleration", math.nextafter(1e7, 1e8), "bounds"),
        ("acceleration", math.nan, "not finite"),
    ],
)
def test_derived_rates_have_the_bounds_of_measured_ones(reader, what, value, reason, joint):
    """Of one sample as of many."""
    for sign in (1.0, -1.0):
        both = np.zeros((2, 4, 3))
        both[int(what == "acceleration"), 3, joint] = sign * value
        reader.check_derived(*both[:, 0])
        for qd, qdd in (both, both[:, 3]):
            if reason:
                found, text = reject(reader.check_derived, qd, qdd)
                assert found == reason and text.startswith(f"differentiated {what} of")
                assert NAMES[joint] in text
                most = {"velocity": "15", "acceleration": "1e+07"}[what]
                assert reason == "not finite" or f"allowed -{most} to {most}" in text
            else:
                reader.check_derived(qd, qdd)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-3, -0.05, 0.0999999, 0.1000001, 3.0])
@pytest.mark.parametrize("length", [1.0, 1.00099, 0.99901, 1.00101, 0.99899, -1.0])
def test_a_rotation_is_small_and_its_quaternion_has_length_one(angle, length):
    """A quaternion and its negative are one rotation; of another length it is none."""
    axis = np.array([2.0, -3.0, 6.0]) / 7.0
    turn = length * np.array([*(math.sin(angle / 2.0) * axis), math.cos(angle / 2.0)])
    shift = [0.01, -0.02, 0.1]
    if abs(angle) <= 0.1 and abs(abs(length) - 1.0) <= 1e-3:
        sample = deflection(shift, turn)
        assert (sample.stamp, sample.frame) == (NOW, "tool0")
        np.testing.assert_allclose(sample.values, [*shift, *(angle * axis)], 1e-9, 1e-15)
    else:
        assert reject(deflection, shift, turn)[0] == "bounds"


class TestJointState:
    @pytest.mark.parametrize("absent", ["velocity", "effort"])
    @pytest.mark.parametrize("given", [(), (math.nan,) * 3])
    def test_absent_values_are_none_and_never_zero(self, make, reader, absent, given):
        sample = reader.joint_state(state(make, **{absent: given}), NOW, RULES)
        assert (sample.qd is None) == (absent == "velocity")
        assert (sample.effort is None) == (absent == "effort")

    def test_positions_alone_are_read_whatever_else_is_there(self, make, reader):
        message = state(make, velocity=(math.nan, 1e300, 0.0), effort=(0.0,))
        sample = reader.positions(message, NOW, RULES)
        assert sample.q.tolist() == list(Q)
        assert (sample.qd, sample.effort) == (None, None)

    def test_a_long_name_is_cut_in_the_refusal(self, make):
        for names in (("x" * 10**6, *NAMES[1:]), tuple("x" * 10**4 for _ in range(3))):
            for kind in ("state", "trajectory"):
                _, text = reject(READ[kind], changed(make, kind, {"names": names}))
                assert len(text) < 1000

    def test_other_joints_are_ignored_whatever_they_carry(self, make, reader):
        for own in (QD, (math.nan,) * 3):
            message = state(
                make,
                names=("gripper", *NAMES, "gripper"),
                position=(math.nan, *Q, 1e308),
                velocity=(math.inf, *own, 5e-324),
                effort=(),
            )
            sample = reader.joint_state(message, NOW, RULES)
            assert sample.q.tolist() == list(Q)
            assert sample.qd is None if own != QD else sample.qd.tolist() == list(QD)

    def test_beyond_its_limits_a_machine_may_be_measured_and_no_farther_than_any_can_go(self, make):
        far = state(make, position=(3.0,) * 3, velocity=(20.0,) * 3)
        assert reject(READ["state"], far)[0] == "limit"
        sample = JointReader(ROBOT, limited=False).joint_state(far, NOW, RULES)
        assert (sample.q.tolist(), sample.qd.tolist()) == ([3.0] * 3, [20.0] * 3)
        sliding = load("linear_delta")
        reader = JointReader(sliding, limited=False)
        for most, good in ((100.0, True), (100.1, False)):
            message = make.joint_state(sliding.joint_names, [most, -most, 0.0], stamp=NOW)
            if good:
                assert reader.positions(message, NOW, RULES).q.tolist() == [most, -most, 0.0]
            else:
                assert reject(reader.positions, message, NOW, RULES)[0] == "bounds"


@pytest.mark.parametrize("values", [(), Q[:2], (*Q, 0.4), (math.nan,) * 3])
def test_commands_are_one_for_each_joint(reader, values):
    assert reader.commands(Q).tolist() == list(Q)
    reason = "length" if len(values) != 3 else "not finite"
    assert reject(reader.commands, values)[0] == reason


class TestStamps:
    @pytest.mark.parametrize("stamp", [NOW - SECOND // 10, NOW, NOW + SECOND // 10])
    def test_stamps_at_the_tolerances_are_good(self, make, reader, stamp):
        assert reader.joint_state(state(make, stamp=stamp), NOW, RULES).stamp == stamp

    def test_a_zero_stamp_is_the_arrival_time_where_allowed(self, make, reader):
        rules = StampRules(accept_zero=True)
        assert reader.joint_state(state(make, stamp=0), NOW, rules).stamp == NOW

    def test_a_clock_that_stands_at_zero_is_named(self, make, reader):
        _, text = reject(reader.joint_state, state(make), 0, RULES)
        assert "use_sim_time" in text

    def test_no_age_is_checked_without_a_bound(self):
        assert StampRules(max_age=None).check(1, NOW) == 1

    @pytest.mark.parametrize(("sec", "nanosec"), [(-1, 0), (5, SECOND), (5, 2**32 - 1)])
    def test_a_stamp_that_is_no_time_is_rejected(self, make, sec, nanosec):
        header = make.kind.header(stamp=make.kind.time(sec=sec, nanosec=nanosec), frame_id="")
        assert reject(stamp_of, header)[0] == "time"


class TestTrajectory:
    def test_values_come_in_the_robots_order(self, make, reader):
        names = ("arm_2", "arm_3", "arm_1")
        rows = [(0.2 + i / 10, 0.3, 0.1) for i in range(3)]
        message = trajectory(make, names=names, positions=rows, stamp=NOW)
        t = reader.trajectory(message, NOW)
        assert t.stamp == NOW
        assert t.times.tolist() == [0.0, 0.5, 1.0]
        assert np.allclose(t.q, [(0.1, 0.2, 0.3), (0.1, 0.3, 0.3), (0.1, 0.4, 0.3)])
        assert t.columns == (1, 2, 0)

    def test_joints_that_the_model_lacks_are_left_out_where_allowed(self, make):
        message = trajectory(
            make,
            names=("wrist", *NAMES),
            positions=[(9.0, *Q)] * 3,
            velocities=None,
            accelerations=None,
        )
        t = JointReader(ROBOT, extra_joints="zero").trajectory(message, NOW)
        assert t.columns == (-1, 0, 1, 2)
        assert t.q.tolist() == [list(Q)] * 3

    def test_fields_are_read_as_their_message(self, make, reader):
        for kind, changes, word in wrong_lengths():
            if kind == "trajectory":
                fields = TrajectoryFields.from_message(trajectory(make, **changes))
                reason, text = reject(reader.trajectory, fields, NOW)
                assert reason == "length" and word in text
        fields = TrajectoryFields.from_message(trajectory(make))
        assert reader.trajectory(fields, NOW).q.tolist() == [list(Q)] * 3
        narrow = replace(fields, columns=fields.columns | {"positions": np.zeros((3, 2))})
        assert "point 0: 2 positions for 3" in reject(reader.trajectory, narrow, NOW)[1]

    def test_absent_derivatives_are_none(self, make, reader):
        message = trajectory(make, velocities=None, accelerations=None)
        t = reader.trajectory(message, NOW)
        assert (t.qd, t.qdd) == (None, None)

    def test_a_time_of_more_nanoseconds_than_a_second_has_is_rejected(self, make, reader):
        message = trajectory(make, times=[0, SECOND, 2 * SECOND])
        message.points[1].time_from_start = make.kind.duration(sec=0, nanosec=SECOND)
        assert reject(reader.trajectory, message, NOW)[0] == "time"

    def test_times_up_to_the_resolution_of_seconds_are_told_apart(self, make, reader):
        times = [MAX_DURATION - 2, MAX_DURATION - 1, MAX_DURATION]
        t = reader.trajectory(trajectory(make, times=times), NOW)
        assert (np.diff(t.times) > 0).all()

    def test_only_a_trajectory_whose_end_has_passed_is_over(self, make, reader):
        assert reader.trajectory(trajectory(make, stamp=NOW - SECOND), NOW).stamp
        assert reader.trajectory(trajectory(make, stamp=NOW + SECOND), NOW).stamp

    def test_too_many_points_are_rejected_unread(self, reader):
        message = Maker(Plain()).trajectory(NAMES, [], [])
        message.points = [None] * (MAX_POINTS + 1)
        assert reject(reader.trajectory, message, NOW)[0] == "bounds"


def test_a_wrench_keeps_its_values_frame_and_stamp(make):
    sample = READ["wrench"](make.wrench(WRENCH, NOW))
    assert sample.wrench.tolist() == list(WRENCH)
    assert (sample.frame, sample.stamp) == ("platform", NOW)
    # An empty frame is the expected one where it is allowed.
    allowed = NOW, RULES, "platform", True
    assert read_wrench(make.wrench(WRENCH, NOW, ""), *allowed).frame == "platform"
    assert reject(read_wrench, make.wrench(WRENCH, NOW, "tool0"), *allowed)[0] == "frame"


def test_names_are_remembered_only_for_a_few_orders(make):
    reader = JointReader(ROBOT)
    for order in permutations((*NAMES, "a", "b")):
        message = make.joint_state(order, [0.1] * 5, stamp=NOW)
        assert reader.joint_state(message, NOW, RULES).q.tolist() == [0.1] * 3
    assert len(reader._known) <= 16
