# SPDX-License-Identifier: Apache-2.0
"""Joint reactions from the node delta_dynamics, over the real middleware."""

import numpy as np
import pytest

from delta_dynamics import reactions
from pkm_twin import load
from test.nodes.harness import Maker, Ros, stamp_of

pytest.importorskip("rclpy", exc_type=ImportError)

from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState

MODULE = "delta_dynamics.node"
ROBOT = load("delta_cu")
Q = np.array([0.2, 0.3, 0.1])
NAME = "reacting"


def test_every_joint_has_its_wrench_where_asked_for(peer, launch):
    """A machine that stands still: the wrenches of statics, under each joint's name."""
    make = Maker(Ros())
    names = reactions(ROBOT, Q, np.zeros(3), np.zeros(3)).names
    topics = {name: f"/{NAME}/reactions/{name.replace(' ', '_')}" for name in names}
    peer.talk(JointState, f"/{NAME}/states")
    for topic in topics.values():
        peer.hear(WrenchStamped, topic)
    launch(
        MODULE,
        "publish_reactions:=true",
        "reactions_rate:=20.0",
        "base_frame:=floor",
        arguments=["-r", f"__node:={NAME}", "-r", f"joint_states:=/{NAME}/states"],
    )

    def send():
        state = make.joint_state(ROBOT.joint_names, Q.tolist(), [0.0] * 3, stamp=peer.now())
        peer.send(f"/{NAME}/states", state)

    peer.until(lambda: all(peer.received(t) for t in topics.values()), repeat=send)
    expected = reactions(ROBOT, Q, np.zeros(3), np.zeros(3))
    stamps = set()
    for k, name in enumerate(names):
        message = peer.received(topics[name])[-1]
        assert message.header.frame_id == "floor"
        stamps.add(stamp_of(message))
        force, torque = message.wrench.force, message.wrench.torque
        got = [force.x, force.y, force.z, torque.x, torque.y, torque.z]
        np.testing.assert_allclose(got, expected.wrenches[k], atol=1e-9)
    assert stamps
