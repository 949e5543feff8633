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
from test.nodes.harness import Maker, Ros

ROBOT = load("delta_cu")
PARAMETERS = ("estimate_payload:=true", "observe_wrench:=true", "stale_after:=600.0")
MAKE = Maker(Ros())
OUTPUTS = {
    "/delta_dynamics/payload": InertiaStamped,
    "/delta_dynamics/payload_deviation": InertiaStamped,
    "/delta_dynamics/external_wrench": WrenchStamped,
    "/delta_dynamics/external_effort": JointState,
    "/delta_dynamics/contact": Bool,
}


class Swing:
    """A slow swing at 1 kHz of a machine that carries a load and may be pushed, sent in parts."""

    def __init__(self, peer, mass):
        self.push = 0.0
        self._peer, self._sent = peer, 0
        # No later than the clock, as no more is sent than time goes by.
        self._begin = peer.now() - 10**9
        self._laden = ROBOT.changed(payload={"mass": mass})
        self._middle = ROBOT.inverse(ROBOT.home())
        self._noise = np.random.default_rng(1)

    def send(self):
        """The next 50 ms."""
        ticks = self._sent + np.arange(50)
        time = 1e-3 * ticks
        q = self._middle + 0.05 * np.sin(3.0 * time)[:, None]
        qd = np.broadcast_to(0.15 * np.cos(3.0 * time)[:, None], q.shape)
        qdd = np.broadcast_to(-0.45 * np.sin(3.0 * time)[:, None], q.shape)
        wrench = np.array([self.push, 0.0, 0.0, 0.0, 0.0, 0.0])
        effort = inverse_dynamics(self._laden, q, qd, qdd, wrench)
        effort += 1e-3 * self._noise.normal(size=q.shape)
        for tick, *sample in zip(ticks.tolist(), q, qd, effort, strict=True):
            position, velocity, measured = (values.tolist() for values in sample)
            stamp = self._begin + 1_000_000 * tick
            message = MAKE.joint_state(ROBOT.joint_names, position, velocity, measured, stamp)
            self._peer.send("/joint_states", message)
        self._sent += len(ticks)


def test_a_load_and_a_push_are_told(peer, launch):
    launch("delta_dynamics.node", *PARAMETERS)
    peer.talk(JointState, "/joint_states", 1000)
    for topic, kind in OUTPUTS.items():
        peer.hear(kind, topic)
    peer.until(peer.matched)
    swing = Swing(peer, 0.4)
    loads, deviations, pushed, events = (
        peer.received(f"/delta_dynamics/{name}")
        for name in ("payload", "payload_deviation", "external_wrench", "contact")
    )
    peer.until(lambda: len(loads) >= 150 and deviations, repeat=swing.send)
    assert loads[-1].inertia.m == pytest.approx(0.4, rel=0.03)
    assert loads[-1].header.frame_id == "platform"
    assert 0.0 < deviations[-1].inertia.m < 0.02
    assert np.isinf(deviations[-1].inertia.com.x)
    swing.push = 60.0
    peer.until(lambda: pushed and pushed[-1].wrench.force.x > 50.0, repeat=swing.send)
    assert pushed[-1].header.frame_id == "base_link"
    peer.until(lambda: events and events[-1].data, repeat=swing.send)
