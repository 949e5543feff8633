# SPDX-License-Identifier: Apache-2.0
"""What the node delta_dynamics does about publishers, subscribers and nodes that do not fit."""

from types import SimpleNamespace

import pytest

from test.nodes.harness import Domain, Peer, text_of, values_of

pytest.importorskip("rclpy", exc_type=ImportError)

import rclpy
from rclpy.duration import Duration
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool
from trajectory_msgs.msg import JointTrajectory

from pkm_twin.ros.health import Health
from test.nodes.paced import QUICK, at_pace, count_at_rest, is_zeros, running, started
from test.nodes.twin import MODULE, state, trajectory

SENDER = """
import rclpy
from test.nodes.harness import Maker, Ros
from test.nodes.twin import Q, state
from sensor_msgs.msg import JointState
rclpy.init()
node = rclpy.create_node("sender")
publisher = node.create_publisher(JointState, "/quick/states", 10)
node.create_timer(1e-3, lambda: publisher.publish(state(node.get_clock().now().nanoseconds)))
rclpy.spin(node)
"""


@pytest.fixture(scope="module")
def fleet(peer, launch):
    return started(peer, launch, "quick", "late", "strict")


@pytest.fixture
def quick(fleet):
    return running(fleet["quick"])


class TestNeighbours:
    def told(self, quick, condition):
        """Wait until the diagnostics' message is so."""
        quick.diagnostics(lambda a: condition(text_of(a)))

    @pytest.mark.parametrize("reliability", ["BEST_EFFORT", "RELIABLE"])
    def test_publishers_of_both_kinds_are_answered(self, fleet, reliability):
        twin = fleet["late"]
        topic = "/late/states"
        before = twin.peer._publishers[topic]
        qos = QoSProfile(depth=10, reliability=ReliabilityPolicy[reliability])
        twin.peer.talk(JointState, topic, qos)
        try:
            running(twin)
        finally:
            twin.peer.node.destroy_publisher(twin.peer._publishers[topic])
            twin.peer._publishers[topic] = before

    def test_trajectories_of_a_best_effort_publisher_are_answered(self, fleet):
        twin = fleet["quick"]
        topic = "/quick/joint_trajectory"
        before = twin.peer._publishers[topic]
        qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        twin.peer.talk(JointTrajectory, topic, qos)
        answers = twin.received("joint_trajectory_ff")
        answers.clear()
        try:
            twin.peer.until(
                lambda: answers,
                repeat=lambda: twin.peer.send(topic, trajectory(stamp=twin.begin())),
            )
            twin.peer.node.destroy_publisher(twin.peer._publishers[topic])
            twin.peer._publishers[topic] = before
            # The reliable one as before.
            assert twin.ask(trajectory(stamp=twin.begin()))
        finally:
            twin.peer._publishers[topic] = before

    def test_a_publisher_that_does_not_fit_is_told_while_it_is_there(self, fleet):
        strict = fleet["strict"]
        node = strict.peer.node
        worst = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        publisher = node.create_publisher(JointState, "/strict/states", worst)
        line = "another node on joint_states has an incompatible QoS: reliability"
        self.told(strict, lambda text: line in text)
        node.destroy_publisher(publisher)
        self.told(strict, lambda text: line not in text)
        assert int(values_of(strict.diagnostics())["incompatible QoS"]) == 1

    def test_a_publisher_of_another_type_is_told(self, fleet):
        strict = fleet["strict"]
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=strict.peer.context.get_domain_id())
        stranger = rclpy.create_node("stranger", context=context)
        try:
            # One participant has one type a topic.
            stranger.create_publisher(Bool, "/strict/states", QoSProfile(depth=1))
            line = (
                "another node on joint_states has an incompatible message type: std_msgs/msg/Bool"
            )
            self.told(strict, lambda text: line in text)
        finally:
            stranger.destroy_node()
            rclpy.try_shutdown(context=context)
        self.told(strict, lambda text: line not in text)

    def test_the_graph_is_asked_once_however_many_are_there(self):
        """And of the others' only what concerns this node is compared."""
        asked, told = [], []
        fits, unfit = (
            QoSProfile(depth=1, reliability=ReliabilityPolicy[kind])
            for kind in ("RELIABLE", "BEST_EFFORT")
        )

        def end(number, name, qos, kind="a/msg/A"):
            return TopicEndpointInfo(
                node_name=name, node_namespace="/", topic_type=kind, qos_profile=qos,
                endpoint_gid=[number],
            )  # fmt: skip

        speakers = [end(k, "other", fits) for k in range(200)]
        speakers += [end(200, "other", unfit), end(201, "other", unfit, "a/msg/B")]
        listeners = [end(k, "third", fits) for k in range(202, 255)] + [end(255, "own", fits)]

        def ask(topic, ends):
            asked.append(topic)
            return ends

        node = SimpleNamespace(
            get_name=lambda: "own",
            get_namespace=lambda: "/",
            get_publishers_info_by_topic=lambda topic: ask(topic, speakers),
            get_subscriptions_info_by_topic=lambda topic: ask(topic, listeners),
            get_logger=lambda: SimpleNamespace(warning=lambda text: None),
        )
        own = Health(node, lambda: 0)
        own.watch("~/x", told.append)
        # A publisher on the same topic takes nothing from the subscription.
        own.watch("~/x")
        for _ in range(2):
            own._look()
        # The graph's calls expand and remap a name: one that has been would be twice.
        assert asked == ["~/x"] * 4
        assert sorted(told) == [("QoS", "reliability"), ("message type", "a/msg/B for a/msg/A")]

    def test_a_subscriber_that_does_not_fit_is_told(self, quick):
        node = quick.peer.node
        hasty = QoSProfile(depth=10, deadline=Duration(seconds=QUICK / 2))
        listener = node.create_subscription(
            JointState, "/quick/joint_torques", lambda message: None, hasty
        )
        line = "another node on ~/joint_torques has an incompatible QoS: deadline"
        self.told(quick, lambda text: line in text)
        node.destroy_subscription(listener)
        self.told(quick, lambda text: line not in text)

    def test_a_node_of_the_same_name_is_told(self, quick, launch):
        remap = ("-r", "__node:=quick", "-r", "joint_states:=/elsewhere")
        namesake = launch(MODULE, arguments=remap)
        try:
            line = "2 nodes have this name"
            quick.peer.until(lambda: line in text_of(quick.diagnostics()))
        finally:
            namesake.close()
        self.told(quick, lambda text: line not in text)

    def test_another_domain_is_another_world(self, quick):
        other = Domain()
        peers = [Peer(other), Peer(other)]
        stranger, control = peers
        try:
            stranger.talk(JointState, "/quick/states")
            control.hear(JointState, "/quick/states")
            stranger.hear(JointState, "/quick/joint_torques")

            def send():
                stranger.send("/quick/states", state(stranger.now()))

            # The same messages do come through within the other domain ...
            control.until(lambda: len(control.received("/quick/states")) >= 20, repeat=send)
            # ... while this one is alive.
            before = count_at_rest(quick)
            for _ in range(20):
                send()
            names = {name for name, _ in stranger.node.get_node_names_and_namespaces()}
            assert names == {"peer"}
            assert stranger.received("/quick/joint_torques") == []
            assert stranger._publishers["/quick/states"].get_subscription_count() == 1
            at_pace(quick, 10)
            quick.balance(before + 10)
        finally:
            for peer in peers:
                peer.close()
            other.close()

    def test_a_killed_publisher_stops_the_stream(self, quick, launch):
        torques = quick.received("joint_torques")
        sender = launch(None, code=SENDER)
        torques.clear()
        quick.peer.until(lambda: sum(not is_zeros(m) for m in torques) > 20)
        sender.process.kill()
        sender.wait()
        quick.peer.until(lambda: is_zeros(torques[-1]))
        array = quick.diagnostics(lambda a: a.status[0].message.startswith("stopped: stale"))
        assert array.status[0].level == b"\x02"
