# SPDX-License-Identifier: Apache-2.0
"""Torques of trajectories by the feedforward core, at once and in slices; rejected trajectories."""

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from delta_dynamics.feedforward import SLICE
from test.nodes.feedforward_core import (
    NAMES,
    NOW,
    ROBOT,
    STEP,
    UNREACHABLE,
    core,
    motion,
    running,
    sample,
    trajectory,
)
from test.nodes.harness import SECOND
from test.support.rejects import reject

pytestmark = pytest.mark.filterwarnings("error")


class TestTrajectories:
    def test_efforts_are_those_of_the_model(self, make):
        message = trajectory(make)
        efforts = core().trajectory(message, NOW)
        rows = [(p.positions, p.velocities, p.accelerations) for p in message.points]
        q, qd, qdd = (np.array(values) for values in zip(*rows, strict=True))
        assert np.abs(efforts - inverse_dynamics(ROBOT, q, qd, qdd)).max() < 1e-12

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
