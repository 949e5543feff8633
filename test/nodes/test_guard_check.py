# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin monitor-torques`` over the real middleware, beside the node that it is for."""

import json
import signal

import pytest

from test.nodes.harness import ForkedCommand

pytest.importorskip("rclpy", exc_type=ImportError)

from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from test.nodes.twin import launched, state

GENEROUS = 30.0
"""Longer than a loaded machine keeps a process waiting, s."""


@pytest.fixture
def check(domain):
    """Start the command: a process with its output."""
    started = []

    def run(*words):
        started.append(ForkedCommand(domain, "monitor-torques", *map(str, words)))
        return started[-1]

    yield run
    for process in started:
        process.close()


@pytest.fixture(scope="module")
def twin(peer, launch):
    return launched(peer, launch, "judged", f"stale_after:={GENEROUS}").ready()


def stream_until_end(twin, process):
    """Joint states until the command has ended: its exit code, its JSON and its errors."""
    twin.peer.until(
        lambda: not process.alive(),
        repeat=lambda: twin.send_state(state(twin.stamp())),
    )
    return process.wait(), json.loads(process.output or "{}"), process.errors


def test_a_running_node_is_good(twin, check):
    process = check("judged/joint_torques", "--deadline", GENEROUS, "--duration", 1, "--wait", 60, "--json")
    code, data, err = stream_until_end(twin, process)
    assert (code, err) == (0, "")
    assert data["good"]
    assert data["messages"] > 1
    assert data["lost_messages"] == 0
    assert {item["verdict"] for item in data["items"]} == {"good"}


def test_a_signal_is_the_end_of_the_watch_with_its_report(twin, check):
    process = check("judged/joint_torques", "--deadline", GENEROUS, "--duration", 600, "--json")
    count = twin.peer.node.count_subscribers
    before = count("/judged/joint_torques")
    twin.peer.until(lambda: count("/judged/joint_torques") > before)
    process.process.send_signal(signal.SIGINT)
    _, data, _ = stream_until_end(twin, process)
    assert {"longest gap", "faults"} <= {item["what"] for item in data["items"]}


def test_where_nothing_comes_it_says_so(peer, check):
    process = check("nobody/joint_torques", "--wait", 0.5)
    assert process.wait() == 1
    assert "0" in process.output
    assert process.errors == ""


def test_plain_commands_cannot_be_judged(peer, check):
    peer.talk(Float64MultiArray, "/plain/commands")
    process = check("plain/commands", "--wait", 60)
    assert process.wait() == 1
    (line,) = process.errors.strip().splitlines()
    assert "std_msgs/msg/Float64MultiArray" in line
    assert "delta_dynamics/joint_torques" in line


def test_it_matches_a_publisher_of_either_reliability(peer, check):
    topic = "/best/torques"
    qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = peer.node.create_publisher(JointState, topic, qos)
    process = check("best/torques", "--duration", 0.2, "--wait", 60, "--json")
    message = JointState(name=["a"], effort=[1.0])

    def repeat():
        message.header.stamp = peer.node.get_clock().now().to_msg()
        publisher.publish(message)

    peer.until(lambda: not process.alive(), repeat=repeat)
    assert json.loads(process.output)["messages"] > 0
