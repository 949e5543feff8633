# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin view --live``: what a running node says reaches the page's model."""

import numpy as np
import pytest

pytest.importorskip("rclpy", exc_type=ImportError)

from sensor_msgs.msg import JointState

from delta_dynamics import inverse_dynamics
from pkm_twin.apps.commands.view import receive_messages
from pkm_twin.errors import PkmTwinError
from pkm_twin.view.live import Live
from test.nodes.harness import Maker, Ros
from test.support.robots import load


def test_a_running_nodes_torques_and_residuals_are_heard(domain, peer, launch, monkeypatch):
    robot = load("delta_cu")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain.number))
    node = launch(
        "delta_dynamics.nodes.twin",
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

    with receive_messages(live, "cell"):
        peer.until(peer.matched)
        # A residual goes with every torque from the first full window on.
        peer.until(lambda: {"state", "torque", "residual"} <= set(live.read_latest().counts), repeat=send)
        heard = live.read_latest()
    np.testing.assert_array_equal(heard.q, q)
    np.testing.assert_allclose(heard.traces["torque"][1][-1], expected, atol=1e-9)
    np.testing.assert_allclose(heard.traces["residual"][1][-1], 0.25, atol=1e-9)
    assert heard.rejected == 0
    assert node.stop() == 0


def test_a_namespace_that_is_none_is_refused(domain, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain.number))
    told = pytest.raises(PkmTwinError, match="--namespace 'a b'")
    with told, receive_messages(Live(load("delta_cu")), "a b"):
        pass
