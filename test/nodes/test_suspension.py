# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Live nodes that send efforts: limits at every stop, nothing from a pose before a suspension."""

import math
import signal
import time

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin.robot.effort_limits import effort_limits

pytest.importorskip("rclpy", exc_type=ImportError)

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from test.nodes.test_command_gate_node import DEADLINE, Gated
from test.nodes.twin import ROBOT, Q, launched, state

REST = np.zeros(3)
MOVED = Q + 0.3
"""Where the machine stands after the suspension."""
OLD, NEW = (inverse_dynamics(ROBOT, q, REST, REST) for q in (Q, MOVED))
LIMITS = effort_limits(ROBOT)
STALE = 0.5
BAD = (math.nan, 0.0, 0.0)


@pytest.fixture(scope="module")
def heard(peer):
    peer.hear(DiagnosticArray, "/diagnostics")
    return peer


def at_rest(stamp, q=Q):
    return state(stamp, position=q, velocity=REST)


def sent(messages):
    """Efforts of messages of either type."""
    return [np.array(m.effort if hasattr(m, "effort") else m.data) for m in messages]


def suspended(node, wait, *topics, send=None):
    """The node stands still for longer than any pose is good: what it sends from then on."""
    # The node finishes what it has begun: stopped between its two messages, it would send the second one late.
    begin = time.monotonic() + wait / 15.0
    node.peer.until(lambda: time.monotonic() > begin)
    node.process.process.send_signal(signal.SIGSTOP)
    try:
        end = time.monotonic() + wait
        node.peer.until(lambda: time.monotonic() > end, repeat=send)
        for topic in topics:
            node.received(topic).clear()
    finally:
        node.process.process.send_signal(signal.SIGCONT)
    return [node.received(topic) for topic in topics]


@pytest.mark.parametrize("fed", [False, True])
def test_a_stop_after_a_suspension_sends_nothing_of_the_pose_before(heard, launch_alone, fed):
    """``fed``: joint states of the moved machine come meanwhile, so that they wait for the node."""
    name = f"suspended_{fed}".lower()
    twin = launched(heard, launch_alone, name, f"stale_after:={STALE}", "on_stop:=gravity")
    twin.until(
        lambda: any(np.allclose(effort, OLD) for effort in sent(twin.received("commands"))),
        repeat=lambda: twin.send_state(at_rest(twin.stamp())),
        every=0.005,
    )
    torques, commands = suspended(
        twin,
        3.0 * STALE,
        "joint_torques",
        "commands",
        send=lambda: fed and twin.send_state(at_rest(twin.stamp(), MOVED)),
    )
    twin.diagnostics(lambda a: a.status[0].message.startswith("stopped"))
    heard.until(lambda: torques and commands)
    for effort in sent(torques) + sent(commands):
        assert not effort.any() or np.allclose(effort, NEW), (effort, OLD, NEW)
    assert fed or not any(effort.any() for effort in sent(commands))
    twin.process.stop()


def test_a_suspended_gate_holds_no_pose_from_before(heard, launch_alone):
    gated = Gated(heard, launch_alone, "stood", "on_stop:=gravity")
    heard.talk(JointState, "/stood/states")
    gated.until_last(OLD, lambda: heard.send("/stood/states", at_rest(heard.now())))
    (commands,) = suspended(gated, 2.0 * DEADLINE, "commands")
    heard.until(lambda: len(commands) >= 5)
    assert not any(effort.any() for effort in sent(commands))
    gated.process.stop()


def test_no_stop_sends_more_than_the_limits(heard, launch_alone):
    """A payload that cannot be held: by no policy does a stop's command pass a limit."""
    twin = launched(
        heard,
        launch_alone,
        "heavy",
        "stale_after:=5.0",
        "trip_count:=2",
        "payload.mass:=60.0",
        "on_stop:=gravity",
    )
    torques, commands = (twin.received(topic) for topic in ("joint_torques", "commands"))
    twin.until(lambda: commands, repeat=lambda: twin.send_state(at_rest(twin.stamp())))
    for policy in ("warn", "clamp", "reject"):
        for on_stop in ("gravity", "zeros"):
            assert twin.set(limit_policy=policy, on_stop=on_stop).successful
            twin.call(Trigger, "reset")
            for topic in (torques, commands):
                topic.clear()

            def run():
                twin.send_state(at_rest(twin.stamp()))

            if policy == "reject":
                twin.peer.until(lambda: commands, repeat=run)
            else:
                twin.peer.until(lambda: len(commands) > 3, repeat=run)
                largest = max(np.abs(effort).max() for effort in sent(commands))
                assert largest == pytest.approx(20.0) if policy == "clamp" else largest > 40.0
                twin.peer.until(
                    lambda: not sent(commands)[-1].any(),
                    repeat=lambda: twin.send_state(state(twin.stamp(), position=BAD)),
                )
            twin.peer.until(lambda: torques and not sent(torques)[-1].any())
            if policy != "warn":
                for effort in sent(torques) + sent(commands):
                    assert (np.abs(effort) <= LIMITS).all()
    twin.process.stop()
