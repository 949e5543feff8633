# SPDX-License-Identifier: Apache-2.0
"""Corrected set points of stiffness_monitor, over the real middleware, beside the core's."""

import numpy as np
import pytest

pytest.importorskip("rclpy", exc_type=ImportError)

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from stiffness_monitor import setpoint_correction, strain_energy
from test.nodes.harness import counts_of, values_of
from test.support.robots import load

ROBOT = load("upr_rpu")
Q = np.array([0.62, 0.6, 0.65])
FORCE = (160.0, 90.0, 120.0)
TOOL = [0.0, 0.0, -0.15]
OFFSET, CORRECTED = "/stiffness_monitor/setpoint_offset", "/stiffness_monitor/corrected_setpoint"

BOTH = "/stiffness_monitor/setpoint_with_torques"


def state(peer, positions):
    message = JointState(name=list(ROBOT.joint_names), position=list(positions))
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(peer.now(), 10**9)
    return message


def test_set_points_are_corrected_by_the_measured_wrench(peer, launch):
    launch(
        "stiffness_monitor.node", "correct_setpoint:=true", "tool.xyz:=[0.0, 0.0, -0.15]",
        "max_state_age:=600.0", "correction_age:=600.0", "future_tolerance:=600.0",
        "pair_torques:=true",
    )  # fmt: skip
    peer.talk(JointState, "/joint_states")
    peer.talk(JointState, "/setpoint")
    peer.talk(WrenchStamped, "/wrench")
    peer.hear(JointState, OFFSET)
    peer.hear(JointState, CORRECTED)
    peer.talk(JointState, "/torques")
    peer.hear(JointState, BOTH)
    peer.until(peer.matched)

    def push():
        peer.send("/joint_states", state(peer, Q))
        load_case = WrenchStamped()
        load_case.header = state(peer, Q).header
        load_case.header.frame_id = "base_link"
        force = load_case.wrench.force
        force.x, force.y, force.z = FORCE
        peer.send("/wrench", load_case)
        load_case.header.frame_id = "platform"
        peer.send("/wrench", load_case)
        peer.send("/setpoint", state(peer, Q + 1e-3))

    peer.until(lambda: peer.received(CORRECTED) and peer.received(OFFSET), repeat=push)
    rotation = ROBOT.platform(Q)[1]
    wrench = np.concatenate([rotation @ FORCE, np.zeros(3)])
    energy = strain_energy(ROBOT, ROBOT.forward(Q), wrench)
    expected = setpoint_correction(ROBOT, Q, energy.deflection, tool=TOOL).offset
    offset = peer.received(OFFSET)[-1]
    assert list(offset.name) == list(ROBOT.joint_names)
    np.testing.assert_allclose(offset.position, expected, rtol=1e-9, atol=1e-15)
    assert np.abs(expected).max() > 1e-5
    found = peer.received(CORRECTED)[-1].position
    np.testing.assert_allclose(found, Q + 1e-3 + expected, rtol=0, atol=1e-12)
    # Torques of the same stamp are in one message with it, whichever comes first.
    for first in (0, 1):
        setpoint = state(peer, Q + 2e-3)
        efforts = JointState(header=setpoint.header, name=setpoint.name, effort=[1.0, -2.0, 3.0])
        sent = [("/setpoint", setpoint), ("/torques", efforts)]
        before = len(peer.received(BOTH))
        for topic, message in sent[first:] + sent[:first]:
            peer.send(topic, message)
        peer.until(lambda before=before: len(peer.received(BOTH)) > before)
        both = peer.received(BOTH)[-1]
        assert both.header.stamp == setpoint.header.stamp and list(both.name) == setpoint.name
        np.testing.assert_allclose(both.position, Q + 2e-3 + expected, rtol=0, atol=1e-12)
        assert list(both.effort) == [1.0, -2.0, 3.0]
    alone = state(peer, Q)
    alone.effort = [1.0, 2.0, 3.0]
    peer.send("/torques", alone)
    # What the stamps of wrenches have to keep to holds for set points, as soon as it is set.
    peer.hear(DiagnosticArray, "/diagnostics")
    request = SetParameters.Request()
    request.parameters = [Parameter("future_tolerance", value=0.1).to_parameter_msg()]
    (result,) = peer.call(SetParameters, "/stiffness_monitor/set_parameters", request).results
    assert result.successful
    late = state(peer, Q)
    late.header.stamp.sec += 300
    for bad in (late, state(peer, [np.nan, 0.6, 0.65])):
        peer.send("/setpoint", bad)
    array = peer.diagnostics(
        "/stiffness_monitor", lambda a: len(counts_of(a, "set points rejected")) >= 2
    )
    told = counts_of(array, "set points rejected")
    assert told["future stamp"] == told["not finite"] == 1
    assert int(values_of(array)["set points corrected"]) >= 1
    assert len(peer.received(BOTH)) == 2


SINGULAR = """
import stiffness_monitor.node as node
from pkm_twin.errors import SingularityError
def singular(self, answer):
    raise SingularityError("correction", (), 0.0, 1e-9)
node.SetpointCorrection.take = node.StiffnessAlarmTopics.take = singular
node.main()
"""


def test_a_wrench_without_a_correction_has_its_compliance(peer, launch):
    remap = ["-r", "__node:=loose"]
    process = launch(None, "correct_setpoint:=true", code=SINGULAR, arguments=remap)
    peer.talk(JointState, "/joint_states")
    peer.talk(WrenchStamped, "/wrench")
    peer.hear(JointState, "/loose/compliance_stamped")
    peer.hear(DiagnosticArray, "/diagnostics")

    def push():
        for _ in range(10):
            load_case = WrenchStamped(header=state(peer, Q).header)
            peer.send("/joint_states", state(peer, Q))
            load_case.header.frame_id = "platform"
            load_case.wrench.force.x = 100.0
            peer.send("/wrench", load_case)

    peer.until(lambda: peer.received("/loose/compliance_stamped"), repeat=push)
    peer.until(lambda: "no correction or alarm: " in process.output)
    assert values_of(peer.diagnostics("/loose"))["exceptions"] == "0"
