# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The node machine_state over the real middleware: its messages beside the core's numbers."""

from importlib.util import find_spec

import numpy as np
import pytest

from pkm_twin.machine import rotations
from pkm_twin.robot.robot_urdf import robot_urdf
from pkm_twin.state.scene import Scales, Scene
from pkm_twin.state.state import MachineState
from test.nodes.harness import SECOND, Maker, Ros, Running, counts_of, stamp_of, values_of
from test.nodes.test_machine_state import loaded
from test.support.robots import load

pytest.importorskip("rclpy", exc_type=ImportError)

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from visualization_msgs.msg import Marker, MarkerArray

from pkm_twin.state.node import MARKER_TYPES

MODULE = "pkm_twin.state.node"
MAKE = Maker(Ros())
ROBOT = load("upr_rpu")
POSE = np.array([-0.7, 0.2, -0.15])
Q = ROBOT.inverse(POSE)
QD = np.array([0.1, -0.05, 0.2])
WRENCH = np.array([300.0, -200.0, -1000.0, 30.0, -20.0, 10.0])
XYZ = (0.0, 0.02, 0.1)
OUTPUTS = {
    "joint_states": JointState,
    "pose": PoseStamped,
    "twist": TwistStamped,
    "markers": MarkerArray,
}
TF = find_spec("tf2_msgs") is not None


@pytest.fixture(scope="module")
def node(peer, launch):
    peer.hear(DiagnosticArray, "/diagnostics")
    peer.talk(JointState, "/joint_states")
    peer.talk(WrenchStamped, "/wrench")
    for topic, kind in OUTPUTS.items():
        peer.hear(kind, f"/machine_state/{topic}")
    if TF:
        from tf2_msgs.msg import TFMessage

        peer.hear(TFMessage, "/tf")
    return launch(
        MODULE,
        "mechanism:=upr_rpu",
        "max_state_age:=1.0",
        f"sensor.xyz:={list(XYZ)}",
        "deflection_scale:=500.0",
        "tool.xyz:=[0.0, 0.0, 0.12]",
    )


@pytest.fixture(scope="module")
def answers(node, peer):
    """What the node says of one state and a wrench, by topic."""
    sent = {}

    def ask():
        assert node.alive(), node.output
        stamp = peer.now()
        sent[stamp] = True
        order = [2, 0, 1]
        names = [ROBOT.joint_names[i] for i in order]
        state = MAKE.joint_state(names, Q[order], QD[order], stamp=stamp)
        peer.send("/joint_states", state)
        peer.send("/wrench", MAKE.wrench(WRENCH.tolist(), stamp))

    def received(topic):
        return peer.received(f"/machine_state/{topic}")

    def drawn():
        full = [m for m in received("markers") if any(x.ns == "wrench" for x in m.markers)]
        return full and all(received(topic) for topic in OUTPUTS)

    peer.until(drawn, repeat=ask)
    return {topic: received(topic)[-1] for topic in OUTPUTS} | {
        "markers": next(m for m in reversed(received("markers")) if any(x.ns == "wrench" for x in m.markers)),
        "stamps": sent,
    }


@pytest.fixture(scope="module")
def expected():
    """The core's state and shapes."""
    core = MachineState(ROBOT)
    now = 1_000 * SECOND
    state = core.joint_state(MAKE.joint_state(ROBOT.joint_names, Q, QD, stamp=now), now)
    force = state.rotation @ WRENCH[:3]
    moment = state.rotation @ WRENCH[3:] + np.cross(state.rotation @ XYZ, force)
    wrench = np.concatenate((force, moment))
    load = loaded(ROBOT, state.q, wrench)
    return state, Scene(ROBOT, Scales(deflection=500.0)).shapes(state, load)


def xyz(vector):
    return [vector.x, vector.y, vector.z]


def test_all_joints_by_the_urdfs_names(answers, expected):
    message = answers["joint_states"]
    assert tuple(message.name) == (*ROBOT.joint_names, *ROBOT.passive_joints)
    assert np.allclose(message.position, expected[0].joints, atol=1e-12)
    assert np.allclose(message.velocity, expected[0].rates, atol=1e-12)
    assert message.velocity[0] == pytest.approx(QD[0])
    assert stamp_of(message) in answers["stamps"]


def test_pose_and_twist_of_the_platform(answers, expected):
    state = expected[0]
    pose, twist = answers["pose"], answers["twist"]
    assert pose.header.frame_id == twist.header.frame_id == "base_link"
    assert {stamp_of(pose), stamp_of(twist)} <= set(answers["stamps"])
    assert np.allclose(xyz(pose.pose.position), state.position, atol=1e-12)
    turn = pose.pose.orientation
    assert np.allclose(rotations.from_quaternion(*xyz(turn), turn.w), state.rotation, atol=1e-12)
    values = [*xyz(twist.twist.linear), *xyz(twist.twist.angular)]
    assert np.allclose(values, state.twist, atol=1e-9)


def test_markers_are_the_cores_shapes(answers, expected):
    markers, shapes = answers["markers"].markers, expected[1]
    assert len(markers) == len(shapes) > 10
    assert len({(m.ns, m.id) for m in markers}) == len(markers)
    for marker, shape in zip(markers, shapes, strict=True):
        assert (marker.ns, marker.id, marker.text) == (shape.group, shape.number, shape.text)
        assert (marker.type, marker.action) == (MARKER_TYPES[shape.kind], Marker.ADD)
        assert marker.header.frame_id == "base_link"
        assert stamp_of(marker) in answers["stamps"]
        colour = marker.color
        assert np.allclose([colour.r, colour.g, colour.b, colour.a], shape.colour, atol=1e-6)
        assert np.allclose(xyz(marker.pose.position), shape.position, atol=1e-9)
        assert np.allclose(xyz(marker.scale), shape.size, rtol=1e-9, atol=1e-9)
        points = np.array([xyz(point) for point in marker.points]).reshape(-1, 3)
        assert np.allclose(points, shape.points, atol=1e-9)
        turn = marker.pose.orientation
        assert abs(np.dot([*xyz(turn), turn.w], shape.quaternion)) == pytest.approx(1.0)
        assert (marker.lifetime.sec > 0) != shape.lasting
    kinds = {marker.ns: marker.type for marker in markers}
    assert kinds["wrench"] == Marker.ARROW and kinds["dominant"] == Marker.TEXT_VIEW_FACING


def test_a_late_joiner_gets_the_description(answers, peer):
    received = []
    qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    late = peer.node.create_subscription(String, "/robot_description", received.append, qos)
    peer.until(lambda: received)
    peer.node.destroy_subscription(late)
    assert received[0].data == robot_urdf(ROBOT, hardware="")


def test_transforms_where_tf2_is_installed(answers, expected, node, peer):
    if not TF:
        assert node.output.count("tf2_msgs is missing") == 1
        return
    from tf2_msgs.msg import TFMessage

    found = []
    qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    late = peer.node.create_subscription(TFMessage, "/tf_static", found.append, qos)
    peer.until(lambda: found)
    peer.node.destroy_subscription(late)
    (tool,) = found[0].transforms
    assert (tool.header.frame_id, tool.child_frame_id) == ("platform", "tool0")
    assert xyz(tool.transform.translation) == [0.0, 0.0, 0.12]
    (platform,) = peer.received("/tf")[-1].transforms
    assert (platform.header.frame_id, platform.child_frame_id) == ("base_link", "platform")
    assert np.allclose(xyz(platform.transform.translation), expected[0].position, atol=1e-12)


def test_bad_messages_are_counted_and_publish_nothing(answers, node, peer):
    bad = set()

    def send():
        stamp = peer.now()
        bad.add(stamp)
        peer.send("/joint_states", MAKE.joint_state(ROBOT.joint_names, [np.nan, 0.5, 0.5], stamp=stamp))

    def counted():
        array = peer.diagnostics("/machine_state")
        return counts_of(array, "joint states rejected").get("not finite") and array

    array = peer.until(counted, repeat=send)
    assert values_of(array)["exceptions"] == "0"
    # Answers of good ones may come late.
    assert not bad & {stamp_of(m) for m in peer.received("/machine_state/pose")}


def test_a_rigid_robot(launch, peer):
    """Geometry alone where nothing is elastic."""
    robot = load("five_bar")
    q = robot.inverse(robot.home())
    node = Running(
        peer,
        launch,
        MODULE,
        "rigid",
        "mechanism:=five_bar",
        talk={"states": JointState},
        remaps={"joint_states": "states", "wrench": "w"},
        hear={"markers": MarkerArray, "twist": TwistStamped, "joint_states": JointState},
    )

    def ask():
        node.send("states", MAKE.joint_state(robot.joint_names, q, stamp=peer.now()))

    markers = node.until(lambda: node.received("markers"), repeat=ask)[-1].markers
    assert {marker.ns for marker in markers} == {"bars"}
    # Without velocities there are none, never zeros.
    assert not node.received("twist")
    joints = node.until(lambda: node.received("joint_states"), repeat=ask)[-1]
    assert len(joints.position) == len(joints.name) and not joints.velocity
