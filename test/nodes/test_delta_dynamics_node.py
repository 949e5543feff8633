# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The node delta_dynamics over the real middleware, as a process of its own."""

import itertools
import math

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from delta_dynamics.feedforward import Feedforward, Settings
from test.nodes.harness import SECOND, counts_of, stamp_of, values_of

pytest.importorskip("rclpy", exc_type=ImportError)

from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from test.nodes.twin import (
    MAKE,
    NAMES,
    ROBOT,
    STEP,
    WINDOW,
    Q,
    launched,
    state,
    trajectory,
)


def wave(index):
    """A smooth motion at 1 kHz: position, velocity and measured effort of a sample."""
    t = index * 1e-3
    rates = np.array([6.0, -5.0, 4.0])
    return (
        0.2 + 0.2 * np.sin(rates * t),
        0.2 * rates * np.cos(rates * t),
        np.array([0.5, -0.25, 1.0]) * np.cos(t),
    )


@pytest.fixture(scope="module")
def running(peer, launch):
    return launched(peer, launch, "warning", "stale_after:=5.0", "on_stop:=zeros").ready()


@pytest.fixture
def twin(running):
    running.settle()
    return running


def test_the_start_line_names_robot_domain_and_range(twin, domain):
    joints = "robot delta_cu (delta), joints arm_1, arm_2, arm_3"
    (line,) = [line for line in twin.process.output.splitlines() if joints in line]
    assert f"domain {domain.number}, discovery LOCALHOST" in line


class TestTrajectories:
    def test_a_trajectory_comes_back_with_effort_and_nothing_else_changed(self, twin):
        order = [2, 0, 1]
        sent = trajectory(order=order, stamp=twin.begin())
        (answer,) = twin.ask(sent)
        rows = [(p.positions, p.velocities, p.accelerations) for p in sent.points]
        q, qd, qdd = (np.array(values)[:, np.argsort(order)] for values in zip(*rows, strict=True))
        efforts = np.array([p.effort for p in answer.points])
        assert np.abs(efforts - inverse_dynamics(ROBOT, q, qd, qdd)[:, order]).max() < 1e-12
        for point in answer.points:
            point.effort = []
        assert answer == sent

    def test_each_bad_trajectory_is_counted_and_the_next_good_one_is_answered(self, twin):
        good = [(0.1, 0.2, 0.3)] * 3
        times = [0, STEP, 2 * STEP]
        bad = [
            ("not finite", {"positions": [(0.1, math.nan, 0.3)] * 3}),
            ("unknown joint", {"names": (*NAMES[:2], "wrist")}),
            ("no accelerations", {"accelerations": None}),
            ("length", {"velocities": [(0.1,), *good[1:]]}),
            ("over", {"stamp": twin.peer.now() - 10 * SECOND}),
        ]
        # A node that starts late rejects what was sent to it before.
        now = twin.peer.now()
        before = twin.diagnostics(lambda array: stamp_of(array) > now)
        expected = counts_of(before, "trajectories rejected")
        already = sum(expected.values())
        for reason, changes in bad:
            fields = dict.fromkeys(("positions", "velocities", "accelerations"), good)
            fields |= {"names": NAMES, "times": times}
            message = MAKE.trajectory(**(fields | changes))
            twin.peer.send("/warning/joint_trajectory", message)
            answers = twin.ask(trajectory(stamp=twin.begin()))
            assert len(answers) == 1, f"{reason}: the bad trajectory was answered"
            expected[reason] = expected.get(reason, 0) + 1
        array = twin.diagnostics(lambda a: sum(counts_of(a, "trajectories rejected").values()) >= already + len(bad))
        assert counts_of(array, "trajectories rejected") == expected
        assert array.status[0].message.startswith("last reject: the trajectory ended 1")
        assert array.status[0].level == b"\x01"


class TestStreams:
    def compare(self, twin, differentiate):
        """Every answer of a permuted stream is, to the bit, the core's for the ordered one."""
        core = Feedforward(
            ROBOT,
            Settings(differentiate=differentiate, window=WINDOW, recovery_count=1, stale_after=5.0),
        )
        begin = twin.stamp()
        twin.peer.until(lambda: twin.peer.now() > begin + 31 * STEP)
        orders = list(itertools.permutations(range(3)))
        expected = []
        for i in range(30):
            q, qd, measured = wave(i)
            stamp = begin + (i + 1) * STEP
            twin._last = stamp
            message = {"position": q, "velocity": () if differentiate else qd, "effort": measured}
            twin.send_state(state(stamp, orders[i % 6], **message))
            result = core.joint_state(state(stamp, **message), stamp)
            if result is not None:
                expected.append(result)
                twin.since([stamp])  # In step: the queue holds only the newest ten.
        stamps = [result.stamp for result in expected]
        torques = twin.since(stamps)
        residuals = twin.since(stamps, "torque_residual")
        received = twin.received("commands")
        last = expected[-1].effort.tobytes()
        twin.peer.until(lambda: received and np.array(received[-1].data).tobytes() == last)
        commands = received[-len(expected) :]
        for result, torque, residual, command in zip(expected, torques, residuals, commands, strict=True):
            for message in (torque, residual):
                assert stamp_of(message) == result.stamp
                assert tuple(message.name) == NAMES
                assert len(message.position) == len(message.velocity) == 0
            assert np.array(torque.effort).tobytes() == result.effort.tobytes()
            assert np.array(residual.effort).tobytes() == result.residual.tobytes()
            assert np.array(command.data).tobytes() == result.effort.tobytes()
            measured = np.array(residual.effort) + np.array(torque.effort)
            i = round((result.stamp - begin) / STEP) - 1
            assert np.allclose(measured, wave(i)[2], atol=1e-12)

    def test_velocities_are_differentiated(self, twin):
        self.compare(twin, False)

    def test_positions_are_differentiated_where_declared(self, twin):
        with twin.changed(acceleration="differentiate"):
            self.compare(twin, True)

    def test_no_residual_without_a_measured_effort(self, twin):
        stamps = twin.stream(WINDOW)
        twin.since(stamps)
        last = twin.stream(1, effort=(1.0, 2.0, 3.0))
        assert [stamp_of(m) for m in twin.since(stamps[:1] + last, "torque_residual")] == last

    def test_torques_are_reliable_and_volatile(self, twin):
        for topic in ("joint_torques", "joint_trajectory_ff", "torque_residual", "commands"):
            infos = twin.peer.node.get_publishers_info_by_topic(f"/warning/{topic}")
            (profile,) = [info.qos_profile for info in infos]
            assert profile.durability == DurabilityPolicy.VOLATILE
            assert profile.reliability == ReliabilityPolicy.RELIABLE

    def test_bad_samples_in_a_row_stop_and_good_ones_start_again(self, twin):
        twin.since(twin.stream(WINDOW))
        before = len(twin.received("joint_torques"))
        twin.stream(5, position=(math.nan, 0.0, 0.0))
        array = twin.diagnostics(lambda a: a.status[0].level == b"\x02")
        assert array.status[0].message == "stopped: not finite: position of arm_1 is nan"
        assert counts_of(array, "joint states rejected")["not finite"] == 5
        assert counts_of(array, "stopped") == {"not finite": 1}
        # By the parameter on_stop zeros are sent, once.
        good = twin.stream(WINDOW + 2)
        twin.since(good)
        zeros, *torques = twin.received("joint_torques")[before:]
        assert list(zeros.effort) == [0.0, 0.0, 0.0]
        # recovery_count is 2; where the silence was longer than the window, that fills anew first.
        assert [stamp_of(m) for m in torques] in (good[1:], good[WINDOW:])
        assert twin.diagnostics().status[0].level == b"\x01"


@pytest.mark.parametrize("policy", ["warn", "clamp", "reject"])
def test_a_passed_effort_limit_is_answered_by_the_policy(twin, policy):
    free, weak = twin.effort(), (0.2, 20.0, 20.0)
    assert abs(free[0]) > weak[0]
    before = int(values_of(twin.diagnostics())["effort limit exceeded"])
    zero = [(0.0, 0.0, 0.0)]
    message = MAKE.trajectory(NAMES, [SECOND], [tuple(Q)], zero, zero, twin.begin())
    with twin.changed(effort_limits=weak, limit_policy=policy):
        if policy == "reject":
            twin.peer.send("/warning/joint_trajectory", message)
            twin.diagnostics(lambda a: "effort limit" in counts_of(a, "trajectories rejected"))
            assert "rejected, effort limit: effort of arm_1 is" in twin.process.output
            assert twin.received("joint_trajectory_ff") == []
            return
        (answer,) = twin.ask(message)
        clamped = np.clip(free, -np.array(weak), weak)
        assert (np.array(answer.points[0].effort) == (free if policy == "warn" else clamped)).all()
        twin.diagnostics(lambda a: int(values_of(a)["effort limit exceeded"]) == before + 1)


class TestParameters:
    def test_a_payload_set_at_run_time_shows_in_the_torques(self, twin):
        zero = np.zeros(3)
        light = twin.effort()
        assert np.abs(light - inverse_dynamics(ROBOT, Q, zero, zero)).max() < 1e-12
        with twin.changed(payload__mass=0.4, payload__com=(0.01, 0.0, -0.05)):
            heavy = ROBOT.changed(payload={"mass": 0.4, "com": [0.01, 0.0, -0.05]})
            exact = inverse_dynamics(heavy, Q, zero, zero)
            assert np.abs(twin.effort() - exact).max() < 1e-12
            assert np.abs(exact - light).max() > 0.1
            assert values_of(twin.diagnostics())["payload mass"] == "0.4"
        assert (twin.effort() == light).all()

    @pytest.mark.parametrize(
        ("changes", "reason"),
        [
            ({"payload__mass": 0.4, "gravity": (0.0, 0.0, math.nan)}, "gravity[2]: nan"),
            ({"payload__mass": 0.4, "mechanism": "delta"}, "mechanism"),
            ({"payload__mass": 0.4, "stale_after": 0.0}, "stale_after"),
            ({"payload__mass": 0.4, "singularity_stop": 0.5}, "singularity_warn"),
            ({"payload__mass": 0.4, "on_stop": "zero"}, "did you mean 'zeros'"),
            ({"payload__mass": 0.4, "autostart": False}, "autostart"),
            ({"payload__mass": "heavy", "gravity": (0.0, 0.0, -1.62)}, "expected 'Type.DOUBLE'"),
        ],
    )
    def test_a_half_bad_set_changes_nothing(self, twin, changes, reason):
        before = twin.effort()
        result = twin.set(**changes)
        assert not result.successful
        assert reason in result.reason
        assert (twin.effort() == before).all()
        mass, gravity = twin.get("payload.mass", "gravity")
        assert mass.double_value == 0.0
        assert list(gravity.double_array_value) == [0.0, 0.0, -9.81]
