# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The motion of the base, measured by an IMU: in the feedforward core and in the live node."""

from types import SimpleNamespace

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from delta_dynamics.feedforward import Feedforward, Settings
from pkm_twin.errors import ParameterError
from pkm_twin.machine import rotations
from pkm_twin.streams.base_motion import BaseImu, ImuSettings
from test.nodes.feedforward_core import NAMES, NOW, ROBOT, STEP, trajectory
from test.nodes.harness import SECOND, Maker, Plain, reject

MOUNT = ImuSettings(xyz=(0.3, -0.2, 0.5), rpy=(0.4, -0.3, 1.2))
AXES = rotations.from_rpy(np.array(MOUNT.rpy))
FILLED = 1000
"""Messages at 1 kHz until the mean acceleration is known."""
Q = np.array([0.1, 0.2, 0.3])
UP = -ROBOT.gravity


def shaking(t):
    """Motion of the base, (9,), whose angular velocity is a polynomial of degree 2 in time."""
    a, b, c = np.array([[0.2, -0.1, 0.3], [1.0, 0.5, -0.8], [-0.6, 0.9, 0.4]])
    shake = UP + np.array([2.0, -1.0, 3.0]) * np.sin(20.0 * t)
    return np.concatenate([a + b * t + c * t**2, b + 2.0 * c * t, shake])


def imu(base, stamp, frame="imu_link", covariance=(0.0, 0.0)):
    """What a sensor at MOUNT measures of a motion of the base, and the covariances' first entry."""
    omega, alpha, change = base[:3], base[3:6], base[6:]
    r = np.array(MOUNT.xyz)
    there = change + np.cross(alpha, r) + np.cross(omega, np.cross(omega, r))
    turning, acceleration = (
        SimpleNamespace(**dict(zip("xyz", (AXES.T @ values).tolist(), strict=True))) for values in (omega, there)
    )
    return SimpleNamespace(
        header=Maker(Plain()).header(stamp, frame),
        angular_velocity=turning,
        linear_acceleration=acceleration,
        angular_velocity_covariance=[covariance[0]] + 8 * [0.0],
        linear_acceleration_covariance=[covariance[1]] + 8 * [0.0],
    )


def core(**changes):
    fields = {"window": 5, "recovery_count": 1} | changes
    return Feedforward(ROBOT, Settings(**fields), base=BaseImu(MOUNT))


def feed(twin, indices, motion=shaking):
    for i in indices:
        twin.base.take(imu(motion(i / 1000), NOW + i * STEP), NOW + i * STEP)


def answer(make, twin, i):
    rate = np.array([0.5, -0.2, 0.1])
    message = make.joint_state(NAMES, Q + rate * i / 1000, rate, stamp=NOW + i * STEP)
    return twin.joint_state(message, NOW + i * STEP)


def fed(make, twin, first, count=10, motion=shaking):
    """The last answer to joint states that come with messages of the IMU."""
    for i in range(first, first + count):
        feed(twin, [i], motion)
        result = answer(make, twin, i)
    return result


def test_efforts_are_those_on_the_base_as_it_moves(make):
    twin = core()
    feed(twin, range(FILLED))
    result = fed(make, twin, FILLED + 1)
    right = inverse_dynamics(ROBOT, *result.motion, base=shaking((FILLED + 10) / 1000))
    np.testing.assert_allclose(result.effort, right, atol=1e-7)
    assert np.abs(inverse_dynamics(ROBOT, *result.motion) - right).max() > 0.1


REJECTED = {
    "frame": {"frame": "base_link"},
    "stamp order": {"stamp": NOW + FILLED * STEP},
    "future stamp": {"stamp": NOW + 5 * SECOND},
    "stale stamp": {"stamp": NOW},
    "zero stamp": {"stamp": 0},
    "not measured": {"covariance": (0.0, -1.0)},
    "not finite": {"base": np.full(9, np.nan)},
    "bounds": {"base": np.full(9, 2e3)},
}


def test_bad_messages_are_counted_and_leave_nothing(make):
    twin, twice = core(), core()
    for one in (twin, twice):
        feed(one, range(FILLED + 1))
    now = NOW + (FILLED + 1) * STEP
    for reason, changes in REJECTED.items():
        message = imu(**({"base": shaking(1.0), "stamp": now} | changes))
        assert reject(twin.base.take, message, now)[0] == reason
    message = imu(shaking(1.0), now, covariance=(-1.0, 0.0))
    assert reject(twin.base.take, message, now)[0] == "not measured"
    assert sum(twin.base.stream.rejected.values()) == len(REJECTED) + 1
    assert (fed(make, twin, FILLED + 1).effort == fed(make, twice, FILLED + 1).effort).all()


def test_no_effort_without_a_recent_and_sound_base_motion(make):
    twin = core()
    assert reject(answer, make, twin, 0)[0] == "no base motion"
    assert twin.stream.stopped and twin.stream.reason == "no base motion"
    feed(twin, range(1, FILLED // 2))
    assert "1 s are needed" in reject(answer, make, twin, FILLED // 2)[1]
    feed(twin, range(FILLED // 2, FILLED + 2))
    assert fed(make, twin, FILLED + 2) is not None and not twin.stream.stopped
    assert "0.021 s away" in reject(answer, make, twin, FILLED + 11 + 21)[1]
    removed = core()
    feed(removed, range(FILLED + 1), lambda t: shaking(t) - np.append(np.zeros(6), UP))
    assert "does its driver remove gravity?" in reject(answer, make, removed, FILLED + 1)[1]
    twin.reset()
    assert "none has arrived" in reject(answer, make, twin, FILLED + 40)[1]


def test_a_trajectory_is_rejected_and_a_stop_holds_the_tilted_machine(make):
    twin = core(on_stop="gravity")
    tilted = np.concatenate([np.zeros(6), rotations.from_rpy(np.array([0.5, 0.2, 0.0])) @ UP])
    feed(twin, range(FILLED), lambda t: tilted)
    assert reject(twin.trajectory, trajectory(make), NOW)[0] == "base motion"
    result = fed(make, twin, FILLED, motion=lambda t: tilted)
    twin.stop("test", "a stop")
    rest = np.zeros(3)
    held = inverse_dynamics(ROBOT, result.motion[0], rest, rest, base=tilted)
    now = NOW + (FILLED + 9) * STEP
    np.testing.assert_allclose(twin.stop_effort(now), ROBOT.controller.controller_efforts(held))


@pytest.mark.parametrize("entry", [{"xyz": (1.0, 2.0)}, {"rpy": (0.0, 0.0, 99.0)}])
def test_an_impossible_mount_is_rejected(entry):
    with pytest.raises(ParameterError, match=f"imu.{next(iter(entry))}"):
        ImuSettings(**entry)


def test_the_live_node_answers_with_the_tilt_that_the_imu_measures(peer, launch):
    from sensor_msgs.msg import Imu, JointState

    from test.nodes.twin import HEAR, MODULE, Running, state

    tilted = np.concatenate([np.zeros(6), rotations.from_rpy(np.array([0.5, 0.2, 0.0])) @ UP])
    twin = Running(
        peer,
        launch,
        MODULE,
        "on_ship",
        "base_imu:=true",
        "stale_after:=60.0",
        "imu.max_age:=60.0",
        f"imu.xyz:={list(MOUNT.xyz)}",
        f"imu.rpy:={list(MOUNT.rpy)}",
        "differentiator.window:=4",
        "recovery_count:=1",
        remaps={"joint_states": "states", "base_imu": "imu"},
        talk={"states": JointState, "imu": Imu},
        hear={"joint_torques": HEAR["joint_torques"]},
    )
    received = twin.received("joint_torques")

    def send():
        stamp = twin.stamp()
        given = imu(tilted, stamp)
        message = Imu()
        message.header = state(stamp).header
        message.header.frame_id = given.header.frame_id
        for name in ("angular_velocity", "linear_acceleration"):
            for axis in "xyz":
                setattr(getattr(message, name), axis, getattr(getattr(given, name), axis))
        twin.send("imu", message)
        twin.send("states", state(stamp, position=Q, velocity=np.zeros(3)))

    twin.until(lambda: len(received) > 3, repeat=send, every=0.01)
    right = inverse_dynamics(ROBOT, Q, np.zeros(3), np.zeros(3), base=tilted)
    np.testing.assert_allclose(received[-1].effort, right, atol=1e-9)
    for other in ("observe_wrench", "estimate_payload", "publish_reactions"):
        refused = launch(MODULE, "base_imu:=true", f"{other}:=true")
        assert refused.wait() == 1
        assert f"cannot start: {other}: True; expected false with base_imu" in refused.output
