# SPDX-License-Identifier: Apache-2.0
"""Effort limits, results that are not finite, and the effort of a stop."""

import math

import numpy as np
import pytest

from delta_dynamics import feedforward, inverse_dynamics
from test.nodes.feedforward_core import (
    NOW,
    ROBOT,
    WINDOW,
    answers,
    core,
    motion,
    running,
    sample,
    trajectory,
)
from test.support.rejects import reject

pytestmark = pytest.mark.filterwarnings("error")


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
