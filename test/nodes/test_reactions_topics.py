# SPDX-License-Identifier: Apache-2.0
"""Joint reactions from the node delta_dynamics, over the real middleware."""

import numpy as np
import pytest

from delta_dynamics import reactions
from test.nodes.harness import Maker, Ros, stamp_of, values_of
from test.support.robots import load

pytest.importorskip("rclpy", exc_type=ImportError)

from diagnostic_msgs.msg import DiagnosticArray
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


SINGULAR = """
import delta_dynamics.node as node
from pkm_twin.errors import SingularityError
solve = node.reactions
def singular(robot, q, *rest):
    if q[0] == 0.125:
        raise SingularityError("constraints", (), 0.0, 1e-9)
    return solve(robot, q, *rest)
node.reactions = singular
raise SystemExit(node.run(node.NODE))
"""


def test_a_state_without_reactions_has_its_torque(peer, launch):
    """In a constraint singularity, where the parameters let the stream pass, reactions are none."""
    make, name = Maker(Ros()), "loose"
    peer.talk(JointState, f"/{name}/states")
    peer.hear(JointState, f"/{name}/joint_torques")
    peer.hear(DiagnosticArray, "/diagnostics")
    parameters = ("publish_reactions:=true", "reactions_rate:=1000.0", "recovery_count:=1")
    remap = ["-r", f"__node:={name}", "-r", f"joint_states:=/{name}/states"]
    process = launch(None, *parameters, code=SINGULAR, arguments=remap)
    q = [0.125, 0.3, 0.1]

    def send():
        for _ in range(30):
            state = make.joint_state(ROBOT.joint_names, q, [0.0] * 3, stamp=peer.now())
            peer.send(f"/{name}/states", state)

    peer.until(lambda: len(peer.received(f"/{name}/joint_torques")) > 5, repeat=send)
    peer.until(lambda: "no reactions or estimates: " in process.output)
    values = values_of(peer.diagnostics(f"/{name}"))
    assert values["exceptions"] == "0"
    assert "stopped: exception" not in values
