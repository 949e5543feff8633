# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The stiffness core: a wrench and the pose beside it, to compliance and strain energy."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest

from pkm_twin.errors import MessageError, SingularityError
from pkm_twin.messages.reading import MAX_DEFLECTION_M
from stiffness_monitor import compliance, monitor, platform_response
from stiffness_monitor.monitor import Monitor, Settings
from test.nodes.harness import SECOND, reject
from test.support.robots import load

NOW = 1_000 * SECOND
ROBOT = load("upr_rpu")
NAMES = ROBOT.joint_names
POSE = np.array([-0.7, 0.2, -0.15])
Q = ROBOT.inverse(POSE)
WRENCH = np.array([30.0, -20.0, -100.0, 3.0, -2.0, 1.0])

pytestmark = pytest.mark.filterwarnings("error")


def state(make, q=Q, stamp=NOW, names=NAMES):
    return make.joint_state(names, q, stamp=stamp)


def watching(make, **changes):
    """A monitor that has seen one joint state."""
    twin = Monitor(ROBOT, Settings(**changes))
    twin.joint_state(state(make), NOW)
    return twin


class TestAnswers:
    def test_compliance_and_energy_are_those_of_the_pose(self, make):
        answer = watching(make, wrench_frame="base_link").wrench(make.wrench(WRENCH, NOW, "base_link"), NOW)
        assert answer.stamp == NOW
        assert np.allclose(answer.pose, POSE, atol=1e-12)
        assert (answer.wrench == WRENCH).all()
        assert np.allclose(answer.compliance, compliance(ROBOT, POSE), rtol=1e-9)
        expected = platform_response(ROBOT, Q, WRENCH)
        assert (answer.compliance == expected.compliance).all()
        assert (answer.energy.factors == expected.factors).all()
        assert answer.energy.dominant == expected.dominant
        assert np.allclose(answer.energy.deflection, answer.compliance @ WRENCH, rtol=1e-9)

    @pytest.mark.parametrize("frame", ["platform", "tool0"])
    def test_a_wrench_off_the_base_frame_has_the_platforms_axes(self, make, frame):
        answer = watching(make, wrench_frame=frame).wrench(make.wrench(WRENCH, NOW, frame), NOW)
        rotation = ROBOT.rotation(answer.pose)
        fixed = np.concatenate((rotation @ WRENCH[:3], rotation @ WRENCH[3:]))
        assert np.abs(fixed - WRENCH).max() > 1.0
        assert np.allclose(answer.wrench, fixed, atol=1e-12)
        twin = watching(make, wrench_frame="base_link")
        same = twin.wrench(make.wrench(fixed, NOW, "base_link"), NOW)
        assert np.allclose(answer.energy.deflection, same.energy.deflection, rtol=1e-12)

    def test_the_base_frame_may_have_another_name(self, make):
        options = {"wrench_frame": "world", "base_frame": "world"}
        answer = watching(make, **options).wrench(make.wrench(WRENCH, NOW, "world"), NOW)
        assert (answer.wrench == WRENCH).all()


class TestPairing:
    def test_no_pose_before_a_joint_state(self, make):
        twin = Monitor(ROBOT)
        reason, text = reject(twin.wrench, make.wrench(WRENCH, NOW), NOW)
        assert (reason, "no pose" in text) == ("no pose", True)
        assert twin.wrenches.rejected == {"no pose": 1}

    @pytest.mark.parametrize(("apart", "good"), [(-1.0, False), (-0.1, True), (0.1, True)])
    def test_stamps_too_far_apart_are_no_pose(self, make, apart, good):
        twin = watching(make, max_state_age=0.1)
        stamp = NOW + round(apart * SECOND)
        message = make.wrench(WRENCH, stamp)
        if good:
            assert twin.wrench(message, max(NOW, stamp)).stamp == stamp
        else:
            reason, text = reject(twin.wrench, message, NOW)
            assert reason == "no pose" and "1.000 s" in text and "0.1 s" in text

    def test_the_nearest_of_many_states_is_used(self, make):
        twin = Monitor(ROBOT)
        poses = [POSE - [0.0001 * i, 0.0, 0.0] for i in range(400)]
        for i, pose in enumerate(poses):
            stamp = NOW + i * SECOND // 1000
            twin.joint_state(state(make, ROBOT.inverse(pose), stamp), stamp)
        arrival = NOW + SECOND // 2
        for i in (250, 300, 399):
            message = make.wrench(WRENCH, NOW + i * SECOND // 1000 + SECOND // 3000)
            assert np.allclose(twin.wrench(message, arrival).pose, poses[i], atol=1e-12)

    def test_an_older_state_is_dropped_and_counted(self, make):
        twin = watching(make)
        reason, _ = reject(twin.joint_state, state(make, stamp=NOW - 1), NOW)
        assert (reason, twin.dropped) == ("stamp order", 1)
        twin.joint_state(state(make, stamp=NOW), NOW)
        assert twin.states.accepted == 2

    @pytest.mark.parametrize("name", ["delta_cu", "prru"])
    def test_of_two_publishers_only_one_is_believed(self, make, name):
        """In any interleaving and order of names; the other one is as soon as the first one ends."""
        robot, rng, stamp = load(name), np.random.default_rng(1), NOW
        names, q = robot.joint_names, robot.inverse(robot.home())
        places = [q, q + 0.03 * robot.limits.velocity]
        twin = Monitor(robot)
        for k in range(150):
            second = k >= 100 or (k > 0 and bool(rng.integers(2)))
            stamp += int(rng.integers(10**4, 5 * 10**5)) if k < 100 else SECOND // 100
            turn = -1 if second else 1
            with contextlib.suppress(MessageError) if second and k < 120 else contextlib.nullcontext():
                twin.joint_state(state(make, places[second][::turn], stamp, names[::turn]), stamp)
            if k < 100 or k >= 120:
                assert (twin.wrench(make.wrench(WRENCH, stamp), stamp).q == places[k >= 100]).all(), k
        assert set(twin.states.rejected) == {"jump"}

    def test_an_older_wrench_is_not_answered_after_a_newer_one(self, make):
        twin = watching(make)
        twin.wrench(make.wrench(WRENCH, NOW), NOW)
        assert reject(twin.wrench, make.wrench(WRENCH, NOW - 1), NOW)[0] == "stamp order"
        assert twin.wrench(make.wrench(WRENCH, NOW), NOW).stamp == NOW
        twin.reset()
        twin.joint_state(state(make, stamp=NOW - SECOND), NOW)
        assert twin.wrench(make.wrench(WRENCH, NOW - SECOND), NOW).stamp == NOW - SECOND

    def test_after_a_reset_there_is_no_pose(self, make):
        twin = watching(make)
        twin.reset()
        assert reject(twin.wrench, make.wrench(WRENCH, NOW), NOW)[0] == "no pose"
        twin.joint_state(state(make, stamp=NOW - SECOND), NOW - SECOND)

    def test_zero_stamps_are_arrival_times_where_allowed(self, make):
        assert reject(Monitor(ROBOT).joint_state, state(make, stamp=0), NOW)[0] == "zero stamp"
        assert reject(watching(make).wrench, make.wrench(WRENCH, 0), NOW)[0] == "zero stamp"
        twin = Monitor(ROBOT, Settings(accept_zero_stamp=True))
        twin.joint_state(state(make, stamp=0), NOW)
        assert twin.wrench(make.wrench(WRENCH, 0), NOW + 1).stamp == NOW + 1


class TestRejects:
    @pytest.mark.parametrize("name", ["upr_rpu", "delta_cu", "prru"])
    @pytest.mark.parametrize("force", [True, False])
    def test_no_deflection_beyond_linear_elasticity_is_answered(self, make, name, force):
        robot = load(name)
        q = robot.inverse(robot.home())
        load_ = np.where(np.arange(6) < 3, float(force), float(not force))
        moved = platform_response(robot, q, load_).deflection
        size = max(np.abs(moved[:3]).max(), np.linalg.norm(moved[3:]))
        for share in (0.99, 1.01, 1e3):
            twin = Monitor(robot, Settings(wrench_frame="base_link"))
            twin.joint_state(state(make, q, names=robot.joint_names), NOW)
            message = make.wrench(load_ * share * MAX_DEFLECTION_M / size, NOW, "base_link")
            if share < 1.0:
                assert np.abs(twin.wrench(message, NOW).energy.deflection).max() > 0.01
            else:
                assert reject(twin.wrench, message, NOW)[0] == "bounds"
                assert twin.wrench(make.wrench(0.5 * load_, NOW, "base_link"), NOW) is not None

    @pytest.mark.parametrize("frame", ["", "tool0", "base_link"])
    def test_an_empty_or_other_frame(self, make, frame):
        twin = watching(make)
        assert reject(twin.wrench, make.wrench(WRENCH, NOW, frame), NOW)[0] == "frame"
        assert twin.wrenches.rejected == {"frame": 1}

    def test_lengths_without_an_assembly_name_the_limb(self, make):
        twin = Monitor(ROBOT)
        twin.joint_state(state(make, [0.3, 1.0, 0.5]), NOW)
        reason, text = reject(twin.wrench, make.wrench(WRENCH, NOW), NOW)
        assert reason == "unreachable"
        assert "limb" in text

    @pytest.mark.parametrize(
        ("error", "reason"),
        [
            (SingularityError("pose", (), 1e-12, 1e-9), "singular"),
            (ValueError("pose is not finite"), "non-finite result"),
        ],
    )
    def test_a_model_that_fails(self, make, monkeypatch, error, reason):
        def fail(*arguments):
            raise error

        twin = watching(make)
        monkeypatch.setattr(monitor, "platform_response", fail)
        assert reject(twin.wrench, make.wrench(WRENCH, NOW), NOW)[0] == reason

    def test_a_compliance_that_is_not_finite(self, make, monkeypatch):
        twin = watching(make)
        found = replace(platform_response(ROBOT, Q, WRENCH), compliance=np.full((6, 6), np.nan))
        monkeypatch.setattr(monitor, "platform_response", lambda *a: found)
        assert reject(twin.wrench, make.wrench(WRENCH, NOW), NOW)[0] == "non-finite result"
