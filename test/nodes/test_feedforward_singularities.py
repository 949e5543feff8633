# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The feedforward core near singularities and at jumps."""

import contextlib

import numpy as np
import pytest
from hypothesis import HealthCheck, event, example, given, settings
from hypothesis import strategies as st

from delta_dynamics.feedforward import Settings
from pkm_twin.errors import MessageError, ParameterError
from test.nodes.feedforward_core import (
    NAMES,
    NOW,
    ROBOT,
    WINDOW,
    answers,
    core,
    motion,
    sample,
    trajectory,
)
from test.nodes.harness import SECOND, Maker, Plain, reject
from test.support.robots import load

pytestmark = pytest.mark.filterwarnings("error")


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

    @settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
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
    def test_a_joint_that_outruns_its_velocity_limit_stops_the_stream(self, make, joint, factor, jumps):
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
