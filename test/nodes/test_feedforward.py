# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The feedforward core: streams, trajectories, limits, stops, settings and clocks."""

import math
import re

import numpy as np
import pytest

from delta_dynamics import feedforward, inverse_dynamics
from delta_dynamics.feedforward import POINTS_PER_SLICE, Feedforward, Settings
from pkm_twin.errors import ParameterError, SingularityError
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.robot.workspace import passive_values
from test.nodes.feedforward_core import (
    NAMES,
    NOW,
    ORDERS,
    ROBOT,
    STEP,
    UNREACHABLE,
    WINDOW,
    answers,
    core,
    motion,
    running,
    sample,
    trajectory,
)
from test.nodes.harness import SECOND, reject
from test.support.robots import load, parameters_of

pytestmark = pytest.mark.filterwarnings("error")


class TestStreams:
    @pytest.mark.parametrize("differentiate", [False, True])
    @pytest.mark.parametrize("rates", [False, True])
    def test_efforts_are_those_of_the_motion(self, make, differentiate, rates):
        twin = core(differentiate=differentiate)
        if not (rates or differentiate):
            assert reject(twin.joint_state, *sample(make, 0, rates=False))[0] == "no velocities"
            return
        results = answers(twin, make, range(20), rates=rates)
        assert results[: WINDOW - 1] == [None] * (WINDOW - 1)
        for i, result in enumerate(results[WINDOW - 1 :], WINDOW - 1):
            assert result.stamp == NOW + i * STEP
            exact = inverse_dynamics(ROBOT, *motion(i / 1000))
            # Positions at 1 kHz lose six digits in a second derivative.
            assert np.abs(result.effort - exact).max() < (1e-9 if rates else 1e-6)

    @pytest.mark.parametrize("rates", [True, False])
    def test_permuted_joints_have_bit_identical_efforts(self, make, rates):
        options = {"rates": rates, "measured": (0.1, 0.2, 0.3)}
        (expected,) = answers(core(differentiate=True), make, range(WINDOW), **options)[-1:]
        for order in ORDERS:
            twin = core(differentiate=True)
            result = answers(twin, make, range(WINDOW), order=order, **options)[-1]
            assert (result.effort == expected.effort).all()
            assert (result.residual == expected.residual).all()

    def test_the_residual_is_measured_less_predicted(self, make):
        measured = np.array([0.5, -0.25, 1.0])
        result = answers(core(), make, range(WINDOW), measured=measured)[-1]
        assert (result.residual == measured - result.effort).all()
        assert answers(core(), make, range(WINDOW))[-1].residual is None

    @pytest.mark.parametrize("index", [9, 5])
    def test_an_older_or_equal_stamp_is_dropped_and_counted(self, make, index):
        twin = running(make)
        message, _ = sample(make, index)
        assert reject(twin.joint_state, message, NOW + 10 * STEP)[0] == "stamp order"
        assert twin.dropped == 1
        assert twin.joint_state(*sample(make, 10)) is not None

    def test_older_stamps_that_go_on_stop_the_stream(self, make):
        twin = running(make)
        for _ in range(4):
            assert not twin.stream.stopped
            reject(twin.joint_state, sample(make, 5)[0], NOW + 10 * STEP)
        assert twin.stream.stopped
        assert twin.stream.stops == {"stamp order": 1}

    def test_bad_samples_in_a_row_stop_until_good_ones_in_a_row(self, make):
        twin = running(make)
        nan = {"position": (math.nan, 0.0, 0.0)}
        for i in range(10, 13):
            reject(twin.joint_state, *sample(make, i, **nan))
        assert not twin.stream.stopped
        assert twin.joint_state(*sample(make, 13)) is not None
        for i in range(14, 18):
            reject(twin.joint_state, *sample(make, i, **nan))
        assert twin.stream.stopped
        # A bad sample begins the count of good ones anew.
        assert answers(twin, make, range(18, 20)) == [None, None]
        reject(twin.joint_state, *sample(make, 20, **nan))
        results = answers(twin, make, range(21, 25))
        assert [result is None for result in results] == [True, True, False, False]
        assert twin.stream.rejected == {"not finite": 8}
        assert twin.stream.stops == {"not finite": 1}

    def test_a_gap_longer_than_stale_after_stops_and_fills_the_window_anew(self, make):
        twin = running(make)
        results = answers(twin, make, range(10 + 101, 10 + 101 + WINDOW + 2))
        # The window is filled, then recovery_count is 3.
        assert [result is None for result in results] == [True] * (WINDOW + 1) + [False]
        assert twin.stream.stops == {"stale input": 1}
        twin = running(make)
        results = answers(twin, make, range(10 + 99, 10 + 99 + WINDOW))
        assert [result is None for result in results] == [True] * (WINDOW - 1) + [False]
        assert not twin.stream.stopped

    def test_differentiated_rates_keep_the_velocity_limit(self, make):
        twin = core(differentiate=True)
        answers(twin, make, range(WINDOW - 1), rates=False)
        q = motion((WINDOW - 2) / 1000)[0]
        leap = sample(make, WINDOW - 1, rates=False, position=q + 0.09)
        assert reject(twin.joint_state, *leap)[0] == "limit"

    def test_an_unreachable_state_names_the_limb(self, make, limitless):
        twin = core(limitless)
        answers(twin, make, range(WINDOW))
        bad = sample(make, 10, position=UNREACHABLE)
        reason, text = reject(twin.joint_state, *bad)
        assert reason == "unreachable" and re.search(r"limb I\b", text)

    def test_a_singular_state_is_rejected_and_stops(self, make, monkeypatch):
        def singular(*arguments):
            raise SingularityError("joint state", (), 1e-12, 1e-9)

        twin = running(make)
        monkeypatch.setattr(feedforward, "inverse_dynamics", singular)
        assert reject(twin.joint_state, *sample(make, 10))[0] == "singular"
        assert twin.stream.stops == {"singular": 1}


class TestRefusedSamples:
    """What is refused moves nothing that a good sample is judged by."""

    @pytest.mark.parametrize(
        "bad",
        [
            {"position": (math.nan, 0.0, 0.0)},
            {"velocity": ()},
            {"position": UNREACHABLE},
            {"velocity": (1e9, 0.0, 0.0)},
            {"velocity": (14.0, -14.0, 14.0), "ahead": 1},
            # As far as a joint may move, but not there and back.
            {"position": motion(0.009)[0] + 0.09, "velocity": (14.0, -14.0, 14.0), "ahead": 1},
            {"position": (0.4, 0.4, 0.4), "ahead": 1},
        ],
    )
    def test_one_bad_sample_costs_none_but_itself(self, make, limitless, bad):
        # As far ahead as stamps may be, but what is allowed of a move grows with its time.
        bad = {"ahead": 99} | bad
        ahead = bad.pop("ahead")
        robot = ROBOT.changed(limits={"effort": 60.0})
        robot = limitless if bad.get("position") is UNREACHABLE else robot
        twin = core(robot, trip_count=10**6, limit_policy="reject", recovery_count=1)
        answers(twin, make, range(10))
        stamp = NOW + (9 + ahead) * STEP
        for _ in range(3):
            reject(twin.joint_state, sample(make, 9, stamp=stamp, **bad)[0], NOW + 9 * STEP)
        # A jump ends the window, so that nothing is differentiated across it.
        begins = WINDOW - 1 if twin.stream.rejected.keys() & {"jump", "unreachable"} else 0
        results = answers(twin, make, range(10, 10 + WINDOW + 3))
        assert [result is None for result in results] == [True] * begins + [False] * (len(results) - begins)
        exact = inverse_dynamics(robot, *motion((10 + WINDOW + 2) / 1000))
        assert np.abs(results[-1].effort - exact).max() < 1e-9
        assert twin.stream.rejected.total() == 3

    def test_a_reject_during_a_stop_leaves_its_reason(self, make):
        twin = running(make)
        for i in range(10, 14):
            reject(twin.joint_state, *sample(make, i, position=(math.nan, 0.0, 0.0)))
        before = twin.stream.reason, twin.stream.text
        assert before[0] == "not finite"
        reject(twin.joint_state, *sample(make, 14, names=("a", "b", "c")))
        twin.time_jumped_forward()
        assert (twin.stream.reason, twin.stream.text) == before
        assert twin.stream.status == ": ".join(before)
        for i in range(15, 20):
            reject(twin.joint_state, *sample(make, i, names=("a", "b", "c")))
        assert "missing joint" in twin.stream.status
        assert twin.stream.stops == {"not finite": 1}

    def test_a_stop_that_is_ended_by_hand_answers_at_once(self, make):
        twin = running(make)
        for i in range(10, 14):
            reject(twin.joint_state, *sample(make, i, position=(math.nan, 0.0, 0.0)))
        assert twin.stream.resume()
        assert not twin.stream.resume()
        assert twin.joint_state(*sample(make, 14)) is not None

    def test_a_torque_that_is_late_is_refused(self, make):
        twin = running(make)
        result = twin.joint_state(*sample(make, 10))
        twin.check_age(result, result.stamp + SECOND // 10)
        reason, _ = reject(twin.check_age, result, result.stamp + SECOND // 10 + 1)
        assert reason == "late answer"
        assert twin.stream.rejected == {"late answer": 1}


class TestSettings:
    def test_a_new_window_is_filled_anew(self, make):
        twin = running(make)
        twin.change_settings(Settings(window=WINDOW + 1, recovery_count=1))
        results = answers(twin, make, range(10, 20))
        assert [result is None for result in results] == [True] * WINDOW + [False] * (10 - WINDOW)


class TestClocks:
    def test_a_clock_that_goes_back_is_a_new_beginning(self, make):
        twin = running(make)
        for i in range(WINDOW):
            message, now = sample(make, i)
            message.header.stamp.sec -= 100
            result = twin.joint_state(message, now - 100 * SECOND)
            assert (result is None) is (i < WINDOW - 1)
        exact = inverse_dynamics(ROBOT, *motion((WINDOW - 1) / 1000))
        assert np.abs(result.effort - exact).max() < 1e-9
        assert not twin.stream.rejected

    def test_a_clock_that_leaps_stops_a_running_stream(self, make):
        twin = running(make)
        twin.time_jumped_forward()
        assert twin.stream.stops == {"clock jump": 1}
        late = NOW + 10 * SECOND
        assert reject(twin.joint_state, sample(make, 10)[0], late)[0] == "stale stamp"
        results = []
        for i in range(WINDOW + 3):
            message, now = sample(make, i)
            message.header.stamp.sec += 10
            results.append(twin.joint_state(message, now + 10 * SECOND))
        assert [result is None for result in results] == [True] * (WINDOW + 1) + [False] * 2

    def test_a_first_clock_is_no_leap(self):
        twin = core()
        twin.time_jumped_forward()
        assert not twin.stream.stopped


def test_a_window_too_short_for_its_order_is_refused():
    with pytest.raises(ParameterError, match=r"differentiator\.window"):
        Settings(order=3, window=4)
    assert Settings(order=3, window=5)


class TestTrajectories:
    @pytest.mark.parametrize("power", [2, 3])
    def test_differences_are_exact_at_the_ends_too(self, make, power):
        """Positions alone of constant accelerations; positions and velocities of linear ones."""
        times = np.array([0.0, 0.1, 0.25, 0.3, 0.5])
        slope, t = np.array([1.0, -1.0, 2.0]), times[:, None]
        q = 0.1 + 0.5 * t * [1, -1, 2] + t**power * slope
        qd = 0.5 * np.array([1, -1, 2]) + power * t ** (power - 1) * slope
        qdd = power * (power - 1) * t ** (power - 2) * slope
        given = (q, qd) if power == 3 else (q,)
        message = make.trajectory(NAMES, [round(s * SECOND) for s in times], *given)
        efforts = core(differentiate=True).trajectory(message, NOW)
        assert np.allclose(efforts, inverse_dynamics(ROBOT, q, qd, qdd), atol=1e-10)

    @pytest.mark.parametrize(
        ("options", "reason"),
        [
            ({"rates": False}, "no velocities"),
            ({"accelerations": False}, "no accelerations"),
            ({"rates": False, "accelerations": False}, "no velocities"),
        ],
    )
    def test_absent_derivatives_are_rejected_unless_declared(self, make, options, reason):
        message = trajectory(make, **options)
        assert reject(core().trajectory, message, NOW)[0] == reason
        assert core(differentiate=True).trajectory(message, NOW).shape == (6, 3)

    def test_two_points_are_too_few_to_differentiate(self, make):
        twin = core(differentiate=True)
        message = trajectory(make, count=2, accelerations=False)
        assert reject(twin.trajectory, message, NOW)[0] == "too short"
        assert twin.trajectory(trajectory(make, count=2), NOW).shape == (2, 3)

    @pytest.mark.parametrize(
        ("gap", "reason", "what"),
        [(10**6, "limit", "velocity"), (1, "limit", "velocity"), (10**8, "bounds", "")],
    )
    def test_differentiated_values_keep_the_bounds_of_given_ones(self, make, gap, reason, what):
        if gap == 10**8:
            message = make.trajectory(NAMES, [0, 1, 2], [[0.1] * 3] * 3, [[0.0] * 3, [1.0] * 3, [0.0] * 3])
            what = "acceleration"
        else:
            message = make.trajectory(NAMES, [0, gap, 2 * gap], [[0.0] * 3, [1.0] * 3, [0.0] * 3])
        twin = core(differentiate=True)
        assert reject(twin.trajectory, message, NOW)[0] == reason
        assert f"differentiated {what}" in twin.trajectories.text

    def test_a_bad_trajectory_does_not_speak_against_the_next(self, make):
        twin = core()
        for _ in range(20):
            assert reject(twin.trajectory, trajectory(make, names=("a", "b", "c")), NOW)
        assert twin.trajectories.rejected == {"unknown joint": 20}
        assert twin.trajectory(trajectory(make), NOW).shape == (6, 3)
        assert twin.trajectories.accepted == 1
        assert not twin.stream.stopped

    def test_an_unreachable_point_names_limb_and_point(self, make, limitless):
        good, bad = [0.3] * 3, UNREACHABLE
        message = make.trajectory(NAMES, [0, STEP], [good, bad], [[0.0] * 3] * 2, [[0.0] * 3] * 2)
        reason, text = reject(core(limitless).trajectory, message, NOW)
        assert reason == "unreachable"
        assert re.search(r"limb I\b", text) and "sample 1" in text


class TestSlices:
    def test_a_long_trajectory_is_that_of_its_points(self, make):
        count = 2 * POINTS_PER_SLICE + 7
        times = np.arange(count) / 500
        q, qd, qdd = motion(0.1 * times)
        message = make.trajectory(NAMES, [round(t * SECOND) for t in times], q, qd, qdd)
        twin = running(make)
        steps = twin.trajectory_steps(message, NOW)
        turns = 0
        while True:
            try:
                next(steps)
            except StopIteration as end:
                efforts = end.value
                break
            turns += 1
            # The stream goes on between the slices.
            assert twin.joint_state(*sample(make, 10 + turns)) is not None
        assert turns == 4
        assert np.abs(efforts - inverse_dynamics(ROBOT, q, qd, qdd)).max() < 1e-12

    def test_the_robot_is_that_of_the_beginning(self, make):
        message = trajectory(make)
        twin = core()
        expected = core().trajectory(message, NOW)
        steps = twin.trajectory_steps(message, NOW)
        next(steps)
        twin.change_robot(ROBOT.changed(payload={"mass": 2.0}))
        with pytest.raises(StopIteration) as end:
            for _ in range(100):
                next(steps)
        assert (end.value.value == expected).all()

    def test_a_bad_point_is_told_by_its_number(self, make, limitless):
        count = POINTS_PER_SLICE + 9
        rows = [[0.3] * 3] * count
        rows[POINTS_PER_SLICE + 4] = UNREACHABLE
        zero = [[0.0] * 3] * count
        message = make.trajectory(NAMES, [i * STEP for i in range(count)], rows, zero, zero)
        reason, text = reject(core(limitless).trajectory, message, NOW)
        assert reason == "unreachable"
        assert f"in the points from point {POINTS_PER_SLICE} on: " in text and "sample 4" in text

    def test_a_passive_joint_keeps_its_range(self, make):
        data = parameters_of("linear_delta")
        data["limbs"]["rods"]["left"]["swivel"] = 0.22
        free = load("linear_delta")
        count = POINTS_PER_SLICE + 50
        away = np.linspace(0.0, 0.06, count)
        q = free.inverse(free.home() + away[:, None] * [1.0, 0.0, 0.0])
        zero = np.zeros_like(q)
        message = make.trajectory(free.joint_names, [i * STEP for i in range(count)], q, zero, zero)
        Feedforward(free).trajectory(message, NOW)
        tight = robot_of_data(data, "tight")
        turned = passive_values(tight, q)
        first = int((turned > 0.22).any(1).argmax())
        assert first > POINTS_PER_SLICE
        reason, text = reject(Feedforward(tight).trajectory, message, NOW)
        assert reason == "limit"
        value = f"{turned[first].max():g} rad, allowed 0 to 0.22"
        assert text.startswith(f"point {first}: left_") and value in text


class TestLimits:
    weak = ROBOT.changed(limits={"effort": [0.2, 20.0, 20.0]})

    def both(self, make, policy):
        """Efforts of a trajectory and of a stream's sample, and the core."""
        twin = core(self.weak, limit_policy=policy)
        efforts = twin.trajectory(trajectory(make), NOW)
        return efforts, answers(twin, make, range(WINDOW))[-1], twin

    def test_warn_leaves_the_torque_and_flags_it(self, make):
        efforts, result, twin = self.both(make, "warn")
        assert (efforts == core().trajectory(trajectory(make), NOW)).all()
        assert np.abs(efforts[:, 0]).max() > 0.2
        assert result.saturated and abs(result.effort[0]) > 0.2
        assert twin.saturations == 2

    def test_clamp_keeps_the_limit_and_flags_it(self, make):
        efforts, result, twin = self.both(make, "clamp")
        free = core().trajectory(trajectory(make), NOW)
        assert np.abs(efforts[:, 0]).max() == 0.2
        assert (efforts[:, 1:] == free[:, 1:]).all()
        assert result.saturated and abs(result.effort[0]) == 0.2
        assert twin.saturations == 2

    def test_reject_names_joint_value_and_limit(self, make):
        twin = core(self.weak, limit_policy="reject")
        reason, text = reject(twin.trajectory, trajectory(make), NOW)
        assert reason == "effort limit"
        assert "arm_1" in text and "allowed 0.2" in text
        answers(twin, make, range(WINDOW - 1))
        assert reject(twin.joint_state, *sample(make, WINDOW - 1))[0] == "effort limit"

    def test_no_limit_flags_nothing(self, make, limitless):
        twin = core(limitless)
        assert not answers(twin, make, range(WINDOW))[-1].saturated
        twin.change_robot(ROBOT.changed(limits={"effort": math.inf}))
        assert not twin.joint_state(*sample(make, WINDOW)).saturated

    @pytest.mark.parametrize("policy", ["warn", "reject", "clamp"])
    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    def test_a_result_that_is_not_finite_stops_the_stream(self, make, monkeypatch, policy, value):
        twin = running(make, limit_policy=policy)
        monkeypatch.setattr(feedforward, "inverse_dynamics", lambda *a: np.array([0.0, value, 0.0]))
        assert reject(twin.joint_state, *sample(make, 10))[0] == "non-finite result"
        assert twin.stream.stopped
        assert twin.stream.stops == {"non-finite result": 1}

    def test_a_model_that_overflows_stops_the_stream(self, make, monkeypatch):
        def overflow(*arguments):
            raise ValueError("joint state is not finite")

        twin = running(make)
        monkeypatch.setattr(feedforward, "inverse_dynamics", overflow)
        assert reject(twin.joint_state, *sample(make, 10))[0] == "non-finite result"
        assert twin.stream.stopped

    @pytest.mark.parametrize("value", [math.nan, math.inf])
    def test_a_trajectory_that_overflows_the_model_stops_the_stream(self, make, monkeypatch, value):
        twin = running(make)
        monkeypatch.setattr(feedforward, "inverse_dynamics", lambda *a: np.full((6, 3), value))
        assert reject(twin.trajectory, trajectory(make), NOW)[0] == "non-finite result"
        assert twin.stream.stops == {"non-finite result": 1}


class TestStopEffort:
    @pytest.mark.parametrize(("settings", "sent"), [({}, None), ({"on_stop": "zeros"}, [0.0, 0.0, 0.0])])
    def test_nothing_or_zeros(self, make, settings, sent):
        effort = running(make, **settings).stop_effort(NOW + 10 * STEP)
        assert (effort if effort is None else effort.tolist()) == sent

    def test_gravity_holds_the_last_good_position(self, make):
        twin = running(make, on_stop="gravity")
        reject(twin.joint_state, *sample(make, 10, position=(math.nan, 0, 0)))
        held = inverse_dynamics(ROBOT, motion(0.009)[0], np.zeros(3), np.zeros(3))
        assert (twin.stop_effort(NOW + 9 * STEP + SECOND // 10) == held).all()
        # A guess of where the machine has gone since would push.
        assert not twin.stop_effort(NOW + 9 * STEP + SECOND // 10 + 1).any()

    def test_gravity_without_a_good_position_is_zeros(self):
        assert core(on_stop="gravity").stop_effort(NOW).tolist() == [0, 0, 0]
