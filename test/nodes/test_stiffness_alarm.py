# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The stiffness alarm of stiffness_monitor over the real middleware, fed with the recorded bag."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy", exc_type=ImportError)

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TransformStamped, WrenchStamped
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from pkm_twin.bags.reader import open_bag
from pkm_twin.errors import MessageError
from pkm_twin.messages.stamps import StampRules
from stiffness_monitor.alarm_node import StiffnessAlarmTopics
from test.bags.test_recordings import FOLDER
from test.nodes.harness import SECOND, counts_of, values_of
from test.support.robots import load

ROBOT = load("upr_rpu")
TOPICS = {
    "/joint_states": JointState,
    "/wrench": WrenchStamped,
    "/measured_deflection": TransformStamped,
}
ALARM = "/stiffness_monitor/stiffness_alarm"
PERIOD = 100_000_000
"""Of what is sent, ns of stamps."""


def recorded():
    """The bag's messages of every tenth of a second, as live ones: topic and message."""
    for m in open_bag(FOLDER / "upr_rpu_soft_joint.mcap").messages(TOPICS):
        message = deserialize_message(bytes(m.data), TOPICS[m.topic])
        if message.header.stamp.nanosec % PERIOD == 0:
            yield m.topic, message


def greet(peer):
    """Wait until the node hears all: it may find a publisher later than that finds the node."""
    first = {topic: message for topic, message in reversed(list(recorded()))}
    for message in first.values():
        message.header.stamp.sec -= 10

    def send():
        for topic, message in first.items():
            stamp = message.header.stamp
            stamp.nanosec += 1_000_000
            stamp.sec, stamp.nanosec = (stamp.sec + stamp.nanosec // SECOND, stamp.nanosec % SECOND)
            peer.send(topic, message)

    told = peer.received("/diagnostics")

    def taken():
        # Before the first one nothing is counted.
        return int(values_of(told[-1]).get("deflections accepted", 0)) if told else 0

    peer.until(taken, repeat=send)


def test_a_joint_three_times_softer_is_found_by_name_live(peer, launch):
    process = launch("stiffness_monitor.node", "max_state_age:=600.0")
    for topic, kind in TOPICS.items():
        peer.talk(kind, topic)
    peer.hear(DiagnosticArray, ALARM)
    peer.hear(DiagnosticArray, "/diagnostics")
    greet(peer)
    for topic, message in recorded():
        peer.send(topic, message)
        peer.spin()
        assert process.alive(), process.output

    def settled():
        """The alarm of nearly all of the bag."""
        heard = peer.received(ALARM)
        return heard[-1] if heard and heard[-1].header.stamp.sec >= 1_700_000_018 else None

    alarm = peer.until(settled)
    (status,) = alarm.status
    assert status.level == DiagnosticStatus.WARN
    assert (status.message, status.hardware_id) == ("3U", "upr_rpu")
    values = values_of(alarm)
    assert set(values) == {"element", "factor", "deviation", "bound"}
    assert values["element"] == "3U"
    assert abs(float(values["factor"]) - 3.0) < 4.0 * float(values["deviation"]) < 1.0
    named = {status.message for array in peer.received(ALARM) for status in array.status}
    assert named <= {"3U", "3U or 3R"}
    told = peer.diagnostics(
        "/stiffness_monitor",
        lambda a: "times the" in a.status[0].message and " of 3U is " in a.status[0].message,
    )
    assert told.status[0].level == DiagnosticStatus.WARN
    assert int(values_of(told)["deflections accepted"]) > 150

    bad = TransformStamped()
    bad.header.frame_id = "tool"
    bad.header.stamp.sec = 1_700_000_021
    peer.send("/measured_deflection", bad)
    peer.diagnostics("/stiffness_monitor", lambda a: counts_of(a, "deflections rejected").get("frame") == 1)
    answer = peer.call(Trigger, "/stiffness_monitor/reset_stiffness", Trigger.Request())
    assert answer.success
    peer.diagnostics("/stiffness_monitor", lambda a: "times the" not in a.status[0].message)


class Quiet:
    """A node for the alarm's topics alone, which nothing comes from."""

    def now(self):
        return SECOND

    def declare(self, _, default, *__, **___):
        return default

    def declare_settings(self, kind, **given):
        return kind(**{name: value for name, value in given.items() if name != "fixed"})

    def nothing(self, *_, **__):
        pass

    create_guarded_publisher = create_guarded_subscription = create_trigger = defer = nothing


def test_rules_and_frames_that_change_hold_for_the_next_deflection():
    """Where the sensor's place is set anew, its frame is no longer the platform's."""
    topics = StiffnessAlarmTopics(Quiet(), ROBOT, StampRules(), ("base_link", "sensor"))
    message = TransformStamped()
    message.header.stamp.sec, message.transform.rotation.w = 1, 1.0

    def refused(frame, ahead=0):
        message.header.frame_id, message.header.stamp.nanosec = frame, ahead
        try:
            topics._on_deflection(message)
        except MessageError as error:
            return error.reason
        return ""

    assert [refused("sensor"), refused("platform")] == ["", "frame"]
    topics.change_rules(StampRules(future_tolerance=0), ("base_link", "platform"))
    assert [refused("sensor"), refused("platform")] == ["frame", ""]
    assert refused("platform", 1_000_000) == "future stamp"
