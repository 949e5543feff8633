# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A sensor that transforms tell of, where tf2 is installed."""

from importlib.util import find_spec

import numpy as np
import pytest

from pkm_twin.machine import rotations
from pkm_twin.streams.wrench import WrenchSettings
from stiffness_monitor.monitor import Monitor
from test.nodes.harness import SECOND, Maker, Plain, Ros, Running, counts_of
from test.support.robots import load

pytest.importorskip("rclpy", exc_type=ImportError)
if find_spec("tf2_ros") is None:
    pytest.skip("tf2_ros is not installed", allow_module_level=True)

from geometry_msgs.msg import TransformStamped, WrenchStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from tf2_msgs.msg import TFMessage

from pkm_twin.state.node import make_transform

ROBOT = load("upr_rpu")
Q = ROBOT.inverse([-0.7, 0.2, -0.15])
WRENCH = [300.0, -200.0, -1000.0, 30.0, -20.0, 10.0]
XYZ, RPY = (0.05, -0.02, 0.11), (0.4, -0.7, 2.1)


def answer(message):
    """What the core says with the sensor's place as parameters."""
    make, now = Maker(Plain()), 1_000 * SECOND
    twin = Monitor(ROBOT, WrenchSettings("ft_sensor", sensor_xyz=XYZ, sensor_rpy=RPY))
    twin.joint_state(make.joint_state(ROBOT.joint_names, Q, stamp=now), now)
    return twin.wrench(make.wrench(message, now, "ft_sensor"), now)


def test_the_transform_is_the_fixed_mount(peer, launch):
    node = Running(
        peer,
        launch,
        "stiffness_monitor.node",
        "found",
        "mechanism:=upr_rpu",
        "wrench_frame:=ft_sensor",
        "use_tf:=true",
        "max_state_age:=1.0",
        remaps={"joint_states": "states", "wrench": "wrench"},
        talk={"states": JointState, "wrench": WrenchStamped},
        hear={"deflection": TransformStamped},
    )
    make, received = Maker(Ros()), node.received("deflection")

    def send():
        stamp = peer.now()
        node.send("states", make.joint_state(ROBOT.joint_names, Q, stamp=stamp))
        node.send("wrench", make.wrench(WRENCH, stamp, "ft_sensor"))

    # Without a transform every wrench is refused, and counted.
    node.until(lambda: counts_of(node.diagnostics(), "wrenches rejected").get("transform"), repeat=send)
    assert not received
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    static = peer.node.create_publisher(TFMessage, "/tf_static", latched)
    turn = rotations.to_quaternion(rotations.from_rpy(np.array(RPY)))
    mount = make_transform(peer.now(), "platform", "ft_sensor", np.array(XYZ), turn)
    static.publish(TFMessage(transforms=[mount]))
    node.until(lambda: received, repeat=send)
    peer.node.destroy_publisher(static)
    message = received[-1]
    assert (message.header.frame_id, message.child_frame_id) == ("platform", "platform_deflected")
    exact = answer(WRENCH)
    moved = message.transform.translation
    assert np.allclose(exact.rotation @ [moved.x, moved.y, moved.z], exact.energy.deflection[:3], rtol=1e-8)
