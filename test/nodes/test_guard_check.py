# SPDX-License-Identifier: Apache-2.0
"""Commands that listen to running nodes: guard-check, and the page that shows them live."""

import json
import signal

import numpy as np
import pytest

from test.nodes.harness import ForkedCommand

pytest.importorskip("rclpy", exc_type=ImportError)

from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from delta_dynamics import inverse_dynamics
from pkm_twin.apps.commands.view import listening
from pkm_twin.errors import PkmTwinError
from pkm_twin.view.live import Live
from test.nodes.harness import Maker, Ros
from test.nodes.twin import launched, state
from test.support.robots import load

GENEROUS = 30.0
"""Longer than a loaded machine keeps a process waiting, s."""


@pytest.fixture
def check(domain):
    """Start the command: a process with its output."""
    started = []

    def run(*words):
        started.append(ForkedCommand(domain, "guard-check", *map(str, words)))
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
    process = check(
        "judged/joint_torques", "--deadline", GENEROUS, "--duration", 1, "--wait", 60, "--json"
    )
    code, data, err = stream_until_end(twin, process)
    assert (code, err) == (0, "")
    assert data["good"]
    assert data["messages"] > 1
    assert data["lost_messages"] == 0
    assert {item["verdict"] for item in data["items"]} == {"good"}


def test_a_deadline_that_the_node_does_not_promise_is_bad(twin, check):
    process = check(
        "judged/joint_torques", "--deadline", 1e-6, "--duration", 1, "--wait", 60, "--json"
    )
    code, data, _ = stream_until_end(twin, process)
    assert code == 1
    verdicts = {item["what"]: item["verdict"] for item in data["items"]}
    assert verdicts["longest gap"] == verdicts["age on arrival"] == "bad"
    assert verdicts["deadline offered"] == verdicts["lifespan offered"] == "bad"
    assert verdicts["faults"] == verdicts["lost messages"] == "good"


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


def test_a_running_nodes_torques_and_residuals_are_heard(domain, peer, launch, monkeypatch):
    robot = load("delta_cu")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain.number))
    node = launch(
        "delta_dynamics.node",
        "mechanism:=delta_cu",
        "acceleration:=differentiate",
        "differentiator.window:=4",
        "singularity_warn:=0.02",
        arguments=("-r", "__ns:=/cell"),
    )
    make, live, q = Maker(Ros()), Live(robot), np.array([0.1, 0.2, 0.3])
    peer.talk(JointState, "/cell/joint_states")
    rest = np.zeros(3)
    expected = inverse_dynamics(robot, q, rest, rest)
    measured = expected + 0.25

    def send():
        message = make.joint_state(robot.joint_names, q, rest, measured, stamp=peer.now())
        peer.send("/cell/joint_states", message)

    with listening(live, "cell"):
        peer.until(peer.matched)
        # A residual goes with every torque from the first full window on.
        peer.until(lambda: {"state", "torque", "residual"} <= set(live.heard().counts), repeat=send)
        heard = live.heard()
    np.testing.assert_array_equal(heard.q, q)
    np.testing.assert_allclose(heard.traces["torque"][1][-1], expected, atol=1e-9)
    np.testing.assert_allclose(heard.traces["residual"][1][-1], 0.25, atol=1e-9)
    assert heard.refused == 0
    assert node.stop() == 0


def test_a_namespace_that_is_none_is_refused(domain, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain.number))
    told = pytest.raises(PkmTwinError, match="--namespace 'a b'")
    with told, listening(Live(load("delta_cu")), "a b"):
        pass
