# SPDX-License-Identifier: Apache-2.0
"""The load and the push that delta_dynamics finds, over the real middleware."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import InertiaStamped, WrenchStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool

from delta_dynamics import inverse_dynamics
from pkm_twin import load

ROBOT = load("delta_cu")
PARAMETERS = ("estimate_payload:=true", "observe_wrench:=true", "stale_after:=600.0")
TORQUES = "/delta_dynamics/joint_torques"
OUTPUTS = {
    TORQUES: JointState,
    "/delta_dynamics/payload": InertiaStamped,
    "/delta_dynamics/payload_deviation": InertiaStamped,
    "/delta_dynamics/external_wrench": WrenchStamped,
    "/delta_dynamics/external_effort": JointState,
    "/delta_dynamics/contact": Bool,
}


def states(count, mass, push, begin):
    """A slow swing at 1 kHz of a machine that carries a load and is pushed."""
    middle = ROBOT.inverse(ROBOT.home())
    time = begin + 1e-3 * np.arange(count)
    q = middle + 0.05 * np.sin(3.0 * time)[:, None]
    qd = np.broadcast_to(0.15 * np.cos(3.0 * time)[:, None], q.shape)
    qdd = np.broadcast_to(-0.45 * np.sin(3.0 * time)[:, None], q.shape)
    laden = ROBOT.changed(payload={"mass": mass})
    wrench = np.array([push, 0.0, 0.0, 0.0, 0.0, 0.0])
    noise = 1e-3 * np.random.default_rng(1).normal(size=q.shape)
    return q, qd, inverse_dynamics(laden, q, qd, qdd, wrench) + noise


def stream(peer, samples, beginning):
    """Send samples stamped a millisecond apart, no more at once than can wait; the stamp after."""
    answers = peer.received(TORQUES)
    for k, (q, qd, effort) in enumerate(zip(*samples, strict=True)):
        if k % 50 == 0:
            seen = len(answers)
        message = JointState(name=list(ROBOT.joint_names))
        message.position, message.velocity = q.tolist(), qd.tolist()
        message.effort = effort.tolist()
        stamp = beginning + 1_000_000 * k
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        peer.send("/joint_states", message)
        if k % 50 == 49:
            peer.until(lambda seen=seen: len(answers) > seen + 20)
    return beginning + 1_000_000 * len(samples[0])


def test_a_load_and_a_push_are_told(peer, launch):
    launch("delta_dynamics.node", *PARAMETERS)
    peer.talk(JointState, "/joint_states", 1000)
    for topic, kind in OUTPUTS.items():
        peer.hear(kind, topic)
    peer.until(peer.matched)
    beginning = peer.now() - 10**9
    for part, push in enumerate((0.0, 60.0)):
        samples = states(700, 0.4, push, 0.7 * part)
        beginning = stream(peer, samples, beginning)
        wanted = 150 * (part + 1)
        peer.until(lambda wanted=wanted: len(peer.received("/delta_dynamics/payload")) >= wanted)
        found = peer.received("/delta_dynamics/payload")[-1]
        if part == 0:
            assert found.inertia.m == pytest.approx(0.4, rel=0.03)
            assert found.header.frame_id == "platform"
            deviation = peer.received("/delta_dynamics/payload_deviation")[-1]
            assert 0.0 < deviation.inertia.m < 0.02
            assert np.isinf(deviation.inertia.com.x)
    pushed = peer.received("/delta_dynamics/external_wrench")
    peer.until(lambda: pushed[-1].wrench.force.x > 50.0)
    assert pushed[-1].header.frame_id == "base_link"
    events = [message.data for message in peer.received("/delta_dynamics/contact")]
    assert events[-1] is True
