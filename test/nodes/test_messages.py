# SPDX-License-Identifier: Apache-2.0
"""Readers of messages: every fault is named, what comes through is finite and in order."""

import math
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pkm_twin.errors import MessageError
from pkm_twin.messages.reading import (
    MAX_ACCELERATION,
    MAX_EFFORT,
    MAX_FORCE,
    MAX_POINTS,
    JointReader,
    read_wrench,
)
from pkm_twin.messages.stamps import MAX_DURATION, StampRules, stamp_of
from test.nodes.harness import SECOND, Maker, Plain
from test.support.rejects import reject
from test.support.robots import load

NOW = 1_000 * SECOND
NAMES = ("arm_1", "arm_2", "arm_3")
Q = (0.1, 0.2, 0.3)
QD = (1.0, -2.0, 3.0)
DAMAGED = [math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, -2e-310]
"""No measurement: not finite, beyond all bounds, or denormal."""
RULES = StampRules(max_age=SECOND // 10)
ROBOT = load("delta_cu")

pytestmark = pytest.mark.filterwarnings("error")


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


def with_entry(values, index, value):
    changed = list(values)
    changed[index] = value
    return changed


class TestJointState:
    def test_values_come_in_the_robots_order(self, make, reader):
        message = state(
            make,
            names=("arm_3", "arm_1", "arm_2"),
            position=(0.3, 0.1, 0.2),
            velocity=(3, 1, 2),
            effort=(30, 10, 20),
        )
        sample = reader.joint_state(message, NOW, RULES)
        assert sample.stamp == NOW
        assert sample.q.tolist() == [0.1, 0.2, 0.3]
        assert sample.qd.tolist() == [1, 2, 3]
        assert sample.effort.tolist() == [10, 20, 30]

    @pytest.mark.parametrize("absent", ["velocity", "effort"])
    def test_absent_values_are_none_and_never_zero(self, make, reader, absent):
        sample = reader.joint_state(state(make, **{absent: ()}), NOW, RULES)
        assert (sample.qd is None) == (absent == "velocity")
        assert (sample.effort is None) == (absent == "effort")

    @pytest.mark.parametrize("absent", ["velocity", "effort"])
    def test_a_field_that_is_nan_for_all_of_the_robots_joints_is_absent(self, make, reader, absent):
        nothing = (math.nan,) * 3
        sample = reader.joint_state(state(make, **{absent: nothing}), NOW, RULES)
        assert (sample.qd is None) == (absent == "velocity")
        assert (sample.effort is None) == (absent == "effort")
        foreign = state(
            make,
            names=("gripper", *NAMES),
            position=(1.0, *Q),
            velocity=(0.5, *nothing),
            effort=(),
        )
        assert reader.joint_state(foreign, NOW, RULES).qd is None

    def test_positions_that_are_nan_for_all_are_none(self, make, reader):
        message = state(make, position=(math.nan,) * 3)
        reason, text = reject(reader.joint_state, message, NOW, RULES)
        assert (reason, "all positions are nan" in text) == ("empty", True)

    def test_positions_alone_are_read_whatever_else_is_there(self, make, reader):
        message = state(make, velocity=(math.nan, 1e300, 0.0), effort=(0.0,))
        sample = reader.positions(message, NOW, RULES)
        assert sample.q.tolist() == list(Q)
        assert (sample.qd, sample.effort) == (None, None)

    def test_a_long_name_is_cut_in_the_refusal(self, make, reader):
        for names in (("x" * 10**6, *NAMES[1:]), tuple("x" * 10**4 for _ in range(3))):
            _, text = reject(reader.joint_state, state(make, names=names), NOW, RULES)
            assert len(text) < 1000
        _, text = reject(reader.trajectory, trajectory(make, names=names), NOW)
        assert len(text) < 1000

    def test_other_joints_are_ignored_whatever_they_carry(self, make, reader):
        message = state(
            make,
            names=("gripper", *NAMES, "gripper"),
            position=(math.nan, *Q, 1e308),
            velocity=(math.inf, *QD, 5e-324),
            effort=(),
        )
        sample = reader.joint_state(message, NOW, RULES)
        assert sample.q.tolist() == list(Q)
        assert sample.qd.tolist() == list(QD)

    @pytest.mark.parametrize("missing", range(3))
    def test_a_missing_joint_is_named(self, make, reader, missing):
        names = with_entry(NAMES, missing, "elbow")
        reason, text = reject(reader.joint_state, state(make, names=names), NOW, RULES)
        assert reason == "missing joint"
        assert repr(NAMES[missing]) in text

    def test_a_duplicated_joint_is_named(self, make, reader):
        message = state(make, names=(*NAMES, "arm_2"), position=(*Q, 0.2), velocity=(), effort=())
        reason, text = reject(reader.joint_state, message, NOW, RULES)
        assert (reason, "'arm_2'" in text) == ("duplicated joint", True)

    @pytest.mark.parametrize(
        "changes", [{"names": (), "position": ()}, {"names": ()}, {"position": ()}]
    )
    def test_empty_is_rejected(self, make, reader, changes):
        reason, _ = reject(reader.joint_state, state(make, **changes), NOW, RULES)
        assert reason == "empty"

    @pytest.mark.parametrize("what", ["position", "velocity", "effort"])
    @pytest.mark.parametrize("values", [(0.1,), (0.1, 0.2), (0.1, 0.2, 0.3, 0.4)])
    def test_a_wrong_length_names_both_lengths(self, make, reader, what, values):
        reason, text = reject(reader.joint_state, state(make, **{what: values}), NOW, RULES)
        assert reason == "length"
        assert what in text and f"{len(values)} values for 3 names" in text

    @pytest.mark.parametrize("what", ["position", "velocity", "effort"])
    @pytest.mark.parametrize("joint", range(3))
    @pytest.mark.parametrize("value", DAMAGED)
    def test_a_damaged_value_is_named(self, make, reader, what, joint, value):
        values = with_entry(Q, joint, value)
        reason, text = reject(reader.joint_state, state(make, **{what: values}), NOW, RULES)
        assert NAMES[joint] in text and what in text
        if not math.isfinite(value):
            assert reason == "not finite"
        else:
            assert reason in ("bounds", "limit")

    @pytest.mark.parametrize(
        ("what", "value", "allowed"),
        [("position", 1.31, "1.3"), ("position", -0.91, "-0.9"), ("velocity", -15.1, "-15")],
    )
    def test_a_passed_joint_limit_names_value_and_bound(self, make, reader, what, value, allowed):
        values = with_entry(Q, 1, value)
        reason, text = reject(reader.joint_state, state(make, **{what: values}), NOW, RULES)
        assert reason == "limit"
        assert "arm_2" in text and f"{value:g}" in text and allowed in text

    def test_values_at_the_limits_are_good(self, make, reader):
        message = state(make, position=(-0.9, 1.3, 0.0), velocity=(15.0, -15.0, 0.0))
        assert reader.joint_state(message, NOW, RULES).q.tolist() == [-0.9, 1.3, 0.0]

    @pytest.mark.parametrize(("what", "value"), [("position", 6300.0), ("velocity", 1.1e4)])
    def test_a_robot_without_limits_still_has_physical_bounds(self, make, limitless, what, value):
        message = state(make, **{what: with_entry(Q, 0, value)})
        assert reject(JointReader(limitless).joint_state, message, NOW, RULES)[0] == "bounds"
        assert JointReader(limitless).joint_state(state(make, position=(3, 3, 3)), NOW, RULES)

    def test_measured_efforts_have_physical_bounds(self, make, reader):
        values = (0.0, MAX_EFFORT * 1.01, 0.0)
        reason, _ = reject(reader.joint_state, state(make, effort=values), NOW, RULES)
        assert reason == "bounds"


class TestStamps:
    @pytest.mark.parametrize(
        ("stamp", "reason"),
        [
            (0, "zero stamp"),
            (NOW + SECOND // 10 + 1, "future stamp"),
            (NOW - SECOND // 10 - 1, "stale stamp"),
        ],
    )
    def test_a_bad_stamp_is_named(self, make, reader, stamp, reason):
        assert reject(reader.joint_state, state(make, stamp=stamp), NOW, RULES)[0] == reason

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

    def test_absent_derivatives_are_none(self, make, reader):
        message = trajectory(make, velocities=None, accelerations=None)
        t = reader.trajectory(message, NOW)
        assert (t.qd, t.qdd) == (None, None)

    @pytest.mark.parametrize(
        ("changes", "reason"),
        [
            ({"names": ()}, "empty"),
            ({"times": [], "positions": []}, "empty"),
            ({"positions": [()] * 3}, "empty"),
            ({"names": ("arm_1", "arm_2")}, "missing joint"),
            ({"names": ("arm_1", "arm_2", "arm_2")}, "duplicated joint"),
            ({"names": (*NAMES, "arm_1")}, "duplicated joint"),
            ({"names": ("arm_1", "arm_2", "wrist")}, "unknown joint"),
            ({"names": (*NAMES, "wrist")}, "unknown joint"),
            ({"names": ("arm_1", "arm_2", "")}, "unknown joint"),
        ],
    )
    def test_wrong_joints_and_empty_arrays_are_named(self, make, reader, changes, reason):
        assert reject(reader.trajectory, trajectory(make, **changes), NOW)[0] == reason

    @pytest.mark.parametrize("what", ["positions", "velocities", "accelerations"])
    @pytest.mark.parametrize("row", [(), (0.1, 0.2), (0.1, 0.2, 0.3, 0.4)])
    @pytest.mark.parametrize("point", range(3))
    def test_a_wrong_length_names_point_and_lengths(self, make, reader, what, row, point):
        message = trajectory(make, **{what: with_entry([Q] * 3, point, row)})
        reason, text = reject(reader.trajectory, message, NOW)
        assert reason == "length"
        assert f"point {point}: {len(row)} {what} for 3" in text

    @pytest.mark.parametrize("what", ["positions", "velocities", "accelerations"])
    @pytest.mark.parametrize("value", DAMAGED)
    def test_a_damaged_value_names_point_and_joint(self, make, reader, what, value):
        message = trajectory(make, **{what: with_entry([Q] * 3, 2, with_entry(Q, 1, value))})
        reason, text = reject(reader.trajectory, message, NOW)
        assert text.startswith("point 2: ") and "arm_2" in text
        assert (reason == "not finite") == (not math.isfinite(value))

    @pytest.mark.parametrize(
        ("what", "value", "reason"),
        [
            ("positions", 1.31, "limit"),
            ("velocities", 15.1, "limit"),
            ("accelerations", 1.01 * MAX_ACCELERATION, "bounds"),
        ],
    )
    def test_a_passed_limit_is_rejected(self, make, reader, what, value, reason):
        message = trajectory(make, **{what: with_entry([Q] * 3, 0, with_entry(Q, 2, value))})
        assert reject(reader.trajectory, message, NOW)[0] == reason

    @pytest.mark.parametrize(
        "times",
        [
            [0, 0, SECOND],
            [0, SECOND, SECOND],
            [0, SECOND, SECOND // 2],
            [-1, SECOND, 2 * SECOND],
            [-SECOND, 0, SECOND],
        ],
    )
    def test_times_that_do_not_rise_from_zero_are_rejected(self, make, reader, times):
        assert reject(reader.trajectory, trajectory(make, times=times), NOW)[0] == "time"

    def test_a_time_of_more_nanoseconds_than_a_second_has_is_rejected(self, make, reader):
        message = trajectory(make, times=[0, SECOND, 2 * SECOND])
        message.points[1].time_from_start = make.kind.duration(sec=0, nanosec=SECOND)
        assert reject(reader.trajectory, message, NOW)[0] == "time"

    def test_a_duration_beyond_the_resolution_of_seconds_is_rejected(self, make, reader):
        end = MAX_DURATION
        times = [end - 2, end - 1, end]
        t = reader.trajectory(trajectory(make, times=times), NOW)
        assert (np.diff(t.times) > 0).all()
        message = trajectory(make, times=[0, 1, end + 1])
        assert reject(reader.trajectory, message, NOW)[0] == "bounds"

    def test_only_a_trajectory_whose_end_has_passed_is_over(self, make, reader):
        assert reader.trajectory(trajectory(make, stamp=NOW - SECOND), NOW).stamp
        assert reader.trajectory(trajectory(make, stamp=NOW + SECOND), NOW).stamp
        over = trajectory(make, stamp=NOW - SECOND - 1)
        assert reject(reader.trajectory, over, NOW)[0] == "over"

    def test_too_many_points_are_rejected_unread(self, reader):
        message = Maker(Plain()).trajectory(NAMES, [], [])
        message.points = [None] * (MAX_POINTS + 1)
        assert reject(reader.trajectory, message, NOW)[0] == "bounds"


class TestWrench:
    VALUES = (1.0, -2.0, 3.0, -0.1, 0.2, -0.3)

    def read(self, message, accept_empty=False):
        return read_wrench(message, NOW, RULES, "platform", accept_empty)

    def test_values_frame_and_stamp_are_kept(self, make):
        sample = self.read(make.wrench(self.VALUES, NOW))
        assert sample.wrench.tolist() == list(self.VALUES)
        assert (sample.frame, sample.stamp) == ("platform", NOW)

    @pytest.mark.parametrize("frame", ["", "tool0", "Platform", "/platform"])
    def test_another_frame_is_rejected(self, make, frame):
        reason, text = reject(self.read, make.wrench(self.VALUES, NOW, frame))
        assert reason == "frame"
        assert repr(frame) in text and "'platform'" in text

    def test_an_empty_frame_is_the_expected_one_where_allowed(self, make):
        assert self.read(make.wrench(self.VALUES, NOW, ""), True).frame == "platform"
        assert reject(self.read, make.wrench(self.VALUES, NOW, "tool0"), True)[0] == "frame"

    @pytest.mark.parametrize("entry", range(6))
    @pytest.mark.parametrize("value", [*DAMAGED, 1.01 * MAX_FORCE])
    def test_a_damaged_value_is_named(self, make, entry, value):
        message = make.wrench(with_entry(self.VALUES, entry, value), NOW)
        reason, text = reject(self.read, message)
        assert reason == ("bounds" if math.isfinite(value) else "not finite")
        assert ("force" if entry < 3 else "torque") + "." + "xyz"[entry % 3] in text

    @pytest.mark.parametrize("stamp", [0, NOW + SECOND, NOW - SECOND])
    def test_a_bad_stamp_is_rejected(self, make, stamp):
        assert "stamp" in reject(self.read, make.wrench(self.VALUES, stamp))[0]


class TestAnything:
    """Whatever comes: a MessageError, or finite data in the right shape and order."""

    anything = st.one_of(
        st.floats(-1.0, 1.0),
        st.floats(allow_nan=True, allow_infinity=True, allow_subnormal=True),
        st.sampled_from([*DAMAGED, 0.0, -0.0]),
    )
    names = st.one_of(
        st.permutations(NAMES),
        st.lists(st.one_of(st.sampled_from(NAMES), st.text(max_size=8)), max_size=5),
    )

    @settings(max_examples=150, deadline=None)
    @given(
        names=names,
        arrays=st.tuples(*[st.lists(anything, max_size=4)] * 3),
        time=st.tuples(st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**32 - 1)),
    )
    def test_joint_states(self, names, arrays, time):
        make = Maker(Plain())
        message = make.joint_state(names, *arrays, stamp=NOW)
        if arrays[0]:
            message.header.stamp = make.kind.time(sec=time[0], nanosec=time[1])
        try:
            sample = JointReader(ROBOT).joint_state(message, NOW, StampRules(True))
        except MessageError as error:
            assert error.reason and str(error)
            return
        for values in (sample.q, sample.qd, sample.effort):
            assert values is None or (values.shape == (3,) and np.isfinite(values).all())

    @settings(max_examples=100, deadline=None)
    @given(
        order=st.permutations(range(3)),
        rows=st.lists(
            st.tuples(*[st.floats(-0.9, 1.3, allow_subnormal=False)] * 3), min_size=1, max_size=4
        ),
    )
    def test_good_trajectories_in_any_order(self, order, rows):
        make = Maker(Plain())
        names = [NAMES[i] for i in order]
        shuffled = [[row[i] for i in order] for row in rows]
        message = make.trajectory(names, [i + 1 for i in range(len(rows))], shuffled)
        t = JointReader(ROBOT).trajectory(message, NOW)
        assert t.q.tolist() == [list(row) for row in rows]
        assert [ROBOT.joint_names[i] for i in t.columns] == names

    @settings(max_examples=100, deadline=None)
    @given(values=st.tuples(*[anything] * 6), frame=st.sampled_from(["platform", "", "x"]))
    def test_wrenches(self, values, frame):
        try:
            sample = read_wrench(
                Maker(Plain()).wrench(values, NOW, frame), NOW, RULES, "platform", True
            )
        except MessageError as error:
            assert error.reason and str(error)
            return
        assert sample.wrench.tolist() == list(values) and np.isfinite(sample.wrench).all()


def test_names_are_remembered_only_for_a_few_orders(make):
    reader = JointReader(ROBOT)
    for order in permutations((*NAMES, "a", "b")):
        message = make.joint_state(order, [0.1] * 5, stamp=NOW)
        assert reader.joint_state(message, NOW, RULES).q.tolist() == [0.1] * 3
    assert len(reader._known) <= 16
