# SPDX-License-Identifier: Apache-2.0
"""The feedforward core: torques of trajectories and streams, rejects, stops and limits."""

import contextlib
import math
from itertools import permutations

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, event, example, given, settings
from hypothesis import strategies as st

from delta_dynamics import feedforward, inverse_dynamics
from delta_dynamics.feedforward import SLICE, Feedforward
from delta_dynamics.settings import Settings
from pkm_twin.errors import MessageError, ParameterError, SingularityError
from test.nodes.harness import SECOND, Maker, Plain
from test.support.robots import load

NOW = 1_000 * SECOND
STEP = SECOND // 1000
NAMES = ("arm_1", "arm_2", "arm_3")
ROBOT = load("delta_cu")
ORDERS = list(permutations(range(3)))
UNREACHABLE = (1.3, 0.4, 2.0)
"""No assembly: limb III is too short."""
WINDOW = 5
"""Samples of the stream's differentiator in these tests."""

pytestmark = pytest.mark.filterwarnings("error")


def motion(t):
    """A motion whose velocity is a polynomial of degree 2: q, qd, qdd, shape (..., 3)."""
    t = np.asarray(t, float)[..., None]
    a, b, c, d = np.array([[0.1, 0.3, -0.2], [1.0, -0.5, 0.7], [3.0, 2.0, -4.0], [2.0, -1.0, 1.5]])
    return a + b * t + c * t**2 + d * t**3, b + 2 * c * t + 3 * d * t**2, 2 * c + 6 * d * t


def core(robot=ROBOT, **changes):
    fields = {"window": WINDOW, "recovery_count": 3, "trip_count": 4} | changes
    return Feedforward(robot, Settings(**fields))


def trajectory(make, count=6, order=(0, 1, 2), rates=True, accelerations=True, **changes):
    times = [i * SECOND // 20 + i * i * STEP for i in range(count)]
    q, qd, qdd = (values[:, order] for values in motion(np.array(times) / SECOND))
    fields = {
        "names": [NAMES[i] for i in order],
        "times": times,
        "positions": q,
        "velocities": qd if rates else None,
        "accelerations": qdd if accelerations else None,
    }
    return make.trajectory(**(fields | changes))


def sample(make, index, order=(0, 1, 2), rates=True, measured=None, **changes):
    """One joint state of the motion, ``index`` ms after its beginning, and its arrival time."""
    q, qd, _ = (values[list(order)] for values in motion(index / 1000))
    fields = {
        "names": [NAMES[i] for i in order],
        "position": q,
        "velocity": qd if rates else (),
        "effort": () if measured is None else np.array(measured)[list(order)],
        "stamp": NOW + index * STEP,
    }
    return make.joint_state(**(fields | changes)), NOW + index * STEP


def answers(twin, make, indices, **options):
    return [twin.joint_state(*sample(make, i, **options)) for i in indices]


def reject(call, *arguments):
    with pytest.raises(MessageError) as caught:
        call(*arguments)
    return caught.value.reason, str(caught.value)


def running(make, **changes):
    """A core whose stream is answered; the next sample is number 10."""
    twin = core(**changes)
    answers(twin, make, range(10))
    return twin


class TestTrajectories:
    def test_efforts_are_those_of_the_model(self, make):
        message = trajectory(make)
        efforts = core().trajectory(message, NOW)
        rows = [(p.positions, p.velocities, p.accelerations) for p in message.points]
        q, qd, qdd = (np.array(values) for values in zip(*rows, strict=True))
        assert np.abs(efforts - inverse_dynamics(ROBOT, q, qd, qdd)).max() < 1e-12

    @pytest.mark.parametrize("rates", [True, False])
    def test_permuted_joints_have_bit_identical_efforts(self, make, rates):
        options = {"rates": rates, "accelerations": rates}
        expected = core(differentiate=True).trajectory(trajectory(make, **options), NOW)
        for order in ORDERS:
            message = trajectory(make, order=order, **options)
            efforts = core(differentiate=True).trajectory(message, NOW)
            assert (efforts == expected[:, order]).all()

    def test_differentiation_is_exact_for_constant_acceleration(self, make):
        times = np.array([0.0, 0.1, 0.25, 0.3, 0.5])
        q = 0.1 + 0.5 * times[:, None] * [1, -1, 2] + times[:, None] ** 2 * [1, 0.5, -0.5]
        qd = 0.5 * np.array([1, -1, 2]) + 2 * times[:, None] * [1, 0.5, -0.5]
        qdd = np.broadcast_to(2 * np.array([1, 0.5, -0.5]), q.shape)
        stamps = [round(t * SECOND) for t in times]
        message = make.trajectory(NAMES, stamps, q)
        efforts = core(differentiate=True).trajectory(message, NOW)
        # The velocities' second-order ends are exact, so the accelerations are.
        assert np.allclose(efforts, inverse_dynamics(ROBOT, q, qd, qdd), atol=1e-10)

    def test_accelerations_are_exact_for_linear_ones(self, make):
        """At the ends too, which a difference to one side alone would miss."""
        times = np.array([0.0, 0.1, 0.25, 0.3, 0.5])
        slope, t = np.array([1.0, -1.0, 2.0]), times[:, None]
        q = 0.1 + t**3 * slope
        qd, qdd = 3 * t**2 * slope, 6 * t * slope
        message = make.trajectory(NAMES, [round(s * SECOND) for s in times], q, qd)
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
            message = make.trajectory(
                NAMES, [0, 1, 2], [[0.1] * 3] * 3, [[0.0] * 3, [1.0] * 3, [0.0] * 3]
            )
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
        assert "limb III" in text and "sample 1" in text

    def test_the_message_is_left_as_it_came(self, make):
        message = trajectory(make)
        core().trajectory(message, NOW)
        assert [len(point.effort) for point in message.points] == [0] * 6


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

    def test_after_a_reset_no_sample_from_before_is_used(self, make):
        twin = running(make)
        twin.reset()
        results = answers(twin, make, range(WINDOW))  # Stamps begin again, as in a looped bag.
        assert [result is None for result in results] == [True] * (WINDOW - 1) + [False]
        exact = inverse_dynamics(ROBOT, *motion((WINDOW - 1) / 1000))
        assert np.allclose(results[-1].effort, exact, atol=1e-9)

    def test_a_gap_longer_than_stale_after_stops_and_fills_the_window_anew(self, make):
        twin = running(make)
        results = answers(twin, make, range(10 + 101, 10 + 101 + WINDOW + 2))
        # The window is filled, then recovery_count is 3.
        assert [result is None for result in results] == [True] * (WINDOW + 1) + [False]
        assert twin.stream.stops == {"stale input": 1}
        assert running(make).joint_state(*sample(make, 10 + 99)) is not None

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
        assert (reason, "limb III" in text) == ("unreachable", True)

    def test_a_singular_state_is_rejected_and_stops(self, make, monkeypatch):
        def singular(*arguments):
            raise SingularityError("joint state", (), 1e-12, 1e-9)

        twin = running(make)
        monkeypatch.setattr(feedforward, "inverse_dynamics", singular)
        assert reject(twin.joint_state, *sample(make, 10))[0] == "singular"
        assert twin.stream.stops == {"singular": 1}

    def test_a_new_robot_is_used_from_the_next_sample(self, make):
        twin = running(make)
        heavy = ROBOT.changed(payload={"mass": 0.5}, limits={"effort": 5.0})
        twin.change_robot(heavy)
        result = twin.joint_state(*sample(make, 10))
        exact = inverse_dynamics(heavy, *motion(0.010))
        assert np.allclose(result.effort, exact, atol=1e-9)
        assert not np.allclose(exact, inverse_dynamics(ROBOT, *motion(0.010)), atol=0.1)

    def test_a_zero_stamp_is_the_arrival_time_where_allowed(self, make):
        message, now = sample(make, 0, stamp=0)
        assert reject(core().joint_state, message, now)[0] == "zero stamp"
        twin = core(accept_zero_stamp=True)
        for i in range(WINDOW):
            message, now = sample(make, i, stamp=0)
            result = twin.joint_state(message, now)
        assert result.stamp == NOW + (WINDOW - 1) * STEP


def held(make, index, q):
    """A joint state at rest, and its arrival time."""
    return sample(make, index, position=q, velocity=(0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def unreachable(limitless):
    """Joint states without an assembly, shape (n, 3)."""
    q = np.random.default_rng(1).uniform(-3.0, 3.0, (5000, 3))
    return q[~limitless.try_forward(q)[1]]


def edge(robot, inside, outside):
    """How far from one joint state to the other the robot can be assembled."""
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = (low + high) / 2
        good = robot.try_forward(inside + middle * (outside - inside))[1]
        low, high = (middle, high) if good else (low, middle)
    return low


class TestSingularities:
    inside = np.array([0.2, 0.2, 0.2])

    @settings(
        max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
    )
    @given(index=st.integers(0))
    def test_an_edge_of_reach_is_warned_of_then_stopped_before(self, limitless, unreachable, index):
        outside = unreachable[index % len(unreachable)]
        part = edge(limitless, self.inside, outside)
        twin = core(limitless, trip_count=10**6)
        warned = False
        # Slowly, so that the band is not stepped over: the measure falls as the distance's root to
        # the edge, and a surface of constraint singularities may lie anywhere before it.
        way = np.concatenate([np.linspace(1.0, 0.1, 1500), 0.1 * 0.985 ** np.arange(1, 2000)])
        for i, left in enumerate(way):
            q = self.inside + part * (1.0 - left) * (outside - self.inside)
            try:
                twin.joint_state(*held(Maker(Plain()), i, q))
            except MessageError as error:
                # A jump: the way led through another edge, to another assembly mode.
                event(error.reason)
                assert error.reason in ("singular", "jump")
                assert twin.stream.stops == {error.reason: 1}
                assert warned or error.reason == "jump"
                return
            warned = twin.near_singular
        raise AssertionError("the edge was reached without a stop")

    def test_a_state_in_the_band_is_answered_and_counted(self, make):
        q = motion(0.0)[0]
        measure = float(ROBOT.singularity(q))
        for bound, near in ((1.01 * measure, True), (0.99 * measure, False)):
            twin = core(singularity_warn=bound)
            results = [twin.joint_state(*held(make, i, q)) for i in range(WINDOW)]
            assert results[-1] is not None
            assert twin.near_singular is near
            assert twin.near_singularities == (WINDOW if near else 0)
            assert twin.singularity() == measure

    @pytest.mark.parametrize("below", [True, False])
    def test_the_bounds_hold_for_trajectories(self, make, below):
        message = trajectory(make)
        measures = ROBOT.singularity([point.positions for point in message.points])
        bound = float(measures.min()) * (1.001 if below else 0.999)
        twin = core(singularity_stop=bound, singularity_warn=1.0)
        if below:
            reason, text = reject(twin.trajectory, message, NOW)
            assert reason == "singular"
            assert f"point {measures.argmin()}: " in text
            assert not twin.stream.stopped
        else:
            assert twin.trajectory(message, NOW).shape == (6, 3)
            assert twin.near_singularities == 6

    @pytest.mark.parametrize("name", ["delta", "delta_cu", "linear_delta", "prru", "upr_rpu"])
    def test_the_defaults_leave_the_workspace_alone(self, name):
        """The Delta-CU's limits hold a surface of constraint singularities, in a corner."""
        robot = load(name)
        limits = robot.limits.position
        q = np.random.default_rng(1).uniform(limits[:, 0], limits[:, 1], (20_000, 3))
        measures, good = robot.try_singularity(q)
        s = Settings()
        assert (measures[good] < s.singularity_warn).mean() < 0.03
        assert (measures[good] < s.singularity_stop).mean() < 1e-3
        assert robot.singularity(robot.inverse(robot.home())) > 3 * s.singularity_warn

    def test_a_warning_below_the_stop_is_refused(self):
        with pytest.raises(ParameterError, match="singularity_warn"):
            Settings(singularity_warn=0.1, singularity_stop=0.2)


class TestJumps:
    @pytest.mark.parametrize("joint", range(3))
    @pytest.mark.parametrize(("factor", "jumps"), [(1.01, True), (0.99, False)])
    def test_a_joint_that_outruns_its_velocity_limit_stops_the_stream(
        self, make, joint, factor, jumps
    ):
        twin = core(trip_count=10**6)
        q = np.zeros(3)
        for i in range(WINDOW + 3):
            assert (twin.joint_state(*held(make, i, q)) is None) is (i < WINDOW - 1)
        # 1 ms after the last sample: twice what 15 rad/s allow, over 5 ms more.
        q[joint] = factor * 15.0 * (2 * 0.001 + 0.005)
        message = held(make, WINDOW + 3, q)
        if not jumps:
            assert twin.joint_state(*message) is not None
            return
        reason, text = reject(twin.joint_state, *message)
        assert reason == "jump"
        assert f"arm_{joint + 1} moved by 0.106" in text
        assert twin.stream.stops == {"jump": 1}
        # From there on the stream is good again: the window, then recovery_count samples.
        results = [twin.joint_state(*held(make, i, q)) for i in range(20, 20 + WINDOW + 2)]
        assert [result is None for result in results] == [True] * (WINDOW + 1) + [False]
        # Nothing of the jump is in the derivatives.
        assert (results[-1].motion[2] == 0.0).all()

    @pytest.mark.parametrize(("shift", "jumps"), [(0.02, True), (0.01, False)])
    def test_a_jump_to_another_assembly_mode_stops_the_stream(self, make, shift, jumps):
        """The platform is elsewhere by more than a quarter of its radius, the joints are not."""
        twin = core()
        results = [twin.joint_state(*held(make, i, [0.1, 0.2, 0.3])) for i in range(WINDOW)]
        assert results[-1] is not None
        # The row of the last sample: after the joints comes the pose.
        twin._continuity._last.numbers[len(NAMES)] -= shift
        message = held(make, WINDOW, [0.1, 0.2, 0.3])
        if not jumps:
            assert twin.joint_state(*message) is not None
            return
        reason, text = reject(twin.joint_state, *message)
        assert (reason, "the assembly mode changed" in text) == ("jump", True)
        assert text.startswith("x of the platform")
        assert twin.stream.stops == {"jump": 1}

    def test_no_jump_is_seen_across_a_reset(self, make):
        twin = core()
        answers(twin, make, range(WINDOW))
        twin.reset()
        assert twin.joint_state(*held(make, WINDOW, [1.2, 1.2, 1.2])) is None

    @settings(max_examples=50, deadline=None)
    @given(
        speed=st.tuples(*[st.floats(-1.0, 1.0)] * 3),
        rate=st.sampled_from([20, 100, 1000]),
        name=st.sampled_from(["delta", "delta_cu", "prru"]),
    )
    @example(speed=(1.0, 0.875, 1.0), rate=20, name="delta_cu")
    def test_no_motion_within_the_limits_jumps(self, speed, rate, name):
        """At full velocity, to and fro between the position limits, at any sample rate."""
        robot = load(name)
        make = Maker(Plain())
        twin = core(robot, differentiate=True, trip_count=10**6)
        low, high = robot.limits.position.T
        middle, half = (low + high) / 2, 0.9 * (high - low) / 2
        # The sliders' ends are beyond reach when they are far apart.
        half *= 0.5 if name == "prru" else 1.0
        for i in range(60):
            phase = robot.limits.velocity * np.array(speed) * (i / rate) / half
            message = make.joint_state(
                robot.joint_names,
                middle + half * np.sin(phase),
                robot.limits.velocity * np.array(speed) * np.cos(phase),
                stamp=NOW + i * SECOND // rate,
            )
            with contextlib.suppress(MessageError):
                twin.joint_state(message, NOW + i * SECOND // rate)
        assert "jump" not in twin.stream.rejected
        assert "singular" not in twin.stream.rejected


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
        assert [result is None for result in results] == [True] * begins + [False] * (
            len(results) - begins
        )
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
    def test_other_settings_hold_from_the_next_sample_on(self, make):
        twin = running(make)
        twin.change_settings(Settings(window=WINDOW, trip_count=1, singularity_warn=1.0))
        assert twin.joint_state(*sample(make, 10)) is not None
        assert twin.near_singular
        reject(twin.joint_state, *sample(make, 11, position=(math.nan, 0.0, 0.0)))
        assert twin.stream.stopped

    def test_a_new_window_is_filled_anew(self, make):
        twin = running(make)
        twin.change_settings(Settings(window=WINDOW + 1, recovery_count=1))
        results = answers(twin, make, range(10, 20))
        assert [result is None for result in results] == [True] * WINDOW + [False] * (10 - WINDOW)


class TestSlices:
    def test_a_long_trajectory_is_that_of_its_points(self, make):
        count = 2 * SLICE + 7
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
        count = SLICE + 9
        rows = [[0.3] * 3] * count
        rows[SLICE + 4] = UNREACHABLE
        zero = [[0.0] * 3] * count
        message = make.trajectory(NAMES, [i * STEP for i in range(count)], rows, zero, zero)
        reason, text = reject(core(limitless).trajectory, message, NOW)
        assert reason == "unreachable"
        assert f"in the points from point {SLICE} on: " in text and "sample 4" in text


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

    def test_a_clock_that_goes_back_a_little_only_drops_older_stamps(self, make):
        twin = running(make)
        assert reject(twin.joint_state, *sample(make, 5))[0] == "stamp order"
        assert twin.joint_state(*sample(make, 10)) is not None

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
    def test_by_default_nothing_is_sent(self, make):
        assert running(make).stop_effort() is None

    def test_zeros(self, make):
        assert running(make, on_stop="zeros").stop_effort().tolist() == [0, 0, 0]

    def test_gravity_holds_the_last_good_position(self, make):
        twin = running(make, on_stop="gravity")
        reject(twin.joint_state, *sample(make, 10, position=(math.nan, 0, 0)))
        held = inverse_dynamics(ROBOT, motion(0.009)[0], np.zeros(3), np.zeros(3))
        assert (twin.stop_effort() == held).all()

    def test_gravity_without_a_good_position_is_zeros(self):
        assert core(on_stop="gravity").stop_effort().tolist() == [0, 0, 0]


def test_a_window_too_short_for_its_order_is_refused():
    with pytest.raises(ParameterError, match=r"differentiator\.window"):
        Settings(order=3, window=4)
    assert Settings(order=3, window=5)


NUMBERS = st.one_of(
    st.floats(-1.0, 1.0),
    st.floats(),
    st.sampled_from([math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, -0.0, 1e7, 1e18]),
)
GOOD = st.floats(-0.9, 1.3, allow_subnormal=False)


@st.composite
def trajectories(draw):
    """A good trajectory, or one with up to three things changed into anything."""
    make = Maker(Plain())
    count = draw(st.integers(1, 4))
    rows = st.lists(st.tuples(GOOD, GOOD, GOOD), min_size=count, max_size=count)
    steps = draw(st.lists(st.integers(1, 2 * SECOND), min_size=count, max_size=count))
    message = make.trajectory(
        draw(st.permutations(NAMES)),
        [int(time) for time in np.cumsum(steps)],
        draw(rows),
        draw(st.one_of(rows, rows, rows, st.none())),
        draw(st.one_of(rows, rows, rows, st.none())),
    )
    for _ in range(draw(st.sampled_from([0, 1, 1, 2]))):
        what = draw(
            st.sampled_from(["names", "time", "stamp", "points", "length", "value", "value"])
        )
        point = message.points[draw(st.integers(0, count - 1))] if message.points else None
        if what == "names":
            message.joint_names = draw(
                st.lists(st.one_of(st.sampled_from(NAMES), st.text(max_size=4)), max_size=4)
            )
        elif what == "stamp":
            seconds, nanoseconds = draw(
                st.tuples(st.integers(-10, 2**31 - 1), st.integers(0, 2**32))
            )
            message.header.stamp = make.kind.time(sec=seconds, nanosec=nanoseconds)
        elif what == "points":
            message.points = []
        elif point is not None and what == "time":
            seconds = draw(st.integers(-(2**31), 2**31 - 1))
            point.time_from_start = make.kind.duration(
                sec=seconds, nanosec=draw(st.integers(0, 2**32 - 1))
            )
        elif point is not None:
            values = draw(st.sampled_from(["positions", "velocities", "accelerations"]))
            changed = list(getattr(point, values)) or [0.0] * 3
            if what == "length":
                changed = draw(st.lists(NUMBERS, max_size=5))
            else:
                changed[draw(st.integers(0, len(changed) - 1))] = draw(NUMBERS)
            setattr(point, values, changed)
    return message


class TestAnything:
    """Whatever comes: a MessageError, or finite efforts; never another exception, never NaN."""

    relaxed = settings(
        max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
    )

    @relaxed
    @given(
        message=trajectories(),
        differentiate=st.booleans(),
        policy=st.sampled_from(["warn", "reject", "clamp"]),
        limited=st.booleans(),
    )
    def test_trajectories(self, limitless, message, differentiate, policy, limited):
        twin = core(
            ROBOT if limited else limitless, differentiate=differentiate, limit_policy=policy
        )
        try:
            efforts = twin.trajectory(message, NOW)
        except MessageError as error:
            event(error.reason)
            assert sum(twin.trajectories.rejected.values()) == 1
            return
        event("answered")
        assert efforts.shape == (len(message.points), 3)
        assert np.isfinite(efforts).all()

    @relaxed
    @given(
        spoils=st.dictionaries(
            st.integers(0, 4 * WINDOW - 1),
            st.fixed_dictionaries(
                {},
                optional={
                    "position": st.lists(NUMBERS, min_size=3, max_size=3),
                    "velocity": st.lists(NUMBERS, min_size=3, max_size=3),
                    "effort": st.lists(NUMBERS, max_size=4),
                    "stamp": st.integers(NOW - SECOND, NOW + SECOND),
                },
            ),
            max_size=6,
        ),
        steps=st.lists(
            st.one_of(st.just(1), st.just(STEP), st.integers(1, SECOND // 20)),
            min_size=4 * WINDOW,
            max_size=4 * WINDOW,
        ),
        limited=st.booleans(),
        rates=st.booleans(),
    )
    def test_streams(self, limitless, spoils, steps, limited, rates):
        make = Maker(Plain())
        twin = core(ROBOT if limited else limitless, differentiate=True, recovery_count=1)
        now, last = NOW, 0
        for i, step in enumerate(steps):
            now += step
            message, _ = sample(make, i, rates=rates, **({"stamp": now} | spoils.get(i, {})))
            try:
                result = twin.joint_state(message, now)
            except MessageError as error:
                event(error.reason)
                continue
            if result is None:
                continue
            event("answered")
            assert np.isfinite(result.effort).all()
            assert result.residual is None or np.isfinite(result.residual).all()
            assert result.stamp > last
            last = result.stamp

    @relaxed
    @given(
        rows=st.lists(st.tuples(*[GOOD] * 9), min_size=3, max_size=4),
        steps=st.lists(st.integers(SECOND // 2, SECOND), min_size=4, max_size=4),
        present=st.integers(1, 3),
        order=st.sampled_from(ORDERS),
    )
    def test_permuted_trajectories(self, rows, steps, present, order):
        make = Maker(Plain())
        values = np.array(rows).reshape(-1, 3, 3).swapaxes(0, 1)[:present]
        times = [int(time) for time in np.cumsum(steps[: len(rows)])]
        message = make.trajectory(NAMES, times, *values)
        twin = core(differentiate=True)
        try:
            efforts = twin.trajectory(message, NOW)
        except MessageError:
            assume(False)
        names = [NAMES[i] for i in order]
        permuted = make.trajectory(names, times, *values[..., order])
        assert (twin.trajectory(permuted, NOW) == efforts[:, order]).all()
