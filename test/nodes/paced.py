# SPDX-License-Identifier: Apache-2.0
"""Nodes with little time or strict settings, and streams to them at a pace."""

import time

from test.nodes.twin import count_of, launched, state

QUICK = 0.015
"""stale_after of a node that has to stop within 20 ms, s."""
STRICT = "qos_overrides./strict/states.subscription.reliability:=reliable"
OFFER = "qos_overrides./late/joint_torques.publisher.deadline:=7000000000"
LATE = """
import os
import signal
import time
import numpy as np
import delta_dynamics.nodes.twin as node
from delta_dynamics import feedforward
solve = feedforward.inverse_dynamics
def late(robot, q, *rest):
    if q.ndim > 1:
        return np.full(q.shape, np.inf)
    if q[0] == 0.125:
        time.sleep(0.02)
    if q[0] == 0.1125:
        os.kill(os.getpid(), signal.SIGSTOP)
    return solve(robot, q, *rest)
feedforward.inverse_dynamics = late
raise SystemExit(node.run(node.NODE))
"""
SETTINGS = {
    "quick": (f"stale_after:={QUICK}", "on_stop:=zeros"),
    "timed": ("use_sim_time:=true", "stale_after:=5.0", "on_stop:=zeros"),
    "late": ("stale_after:=5.0", "on_stop:=zeros", "acceleration:=differentiate", OFFER),
    "strict": ("stale_after:=1.0", "queue_depth:=10", STRICT),
}


def started(peer, launch, *names):
    """Nodes by name, started at once, each with settings of its own."""
    codes = dict.fromkeys(("late", "strict"), LATE)
    return {
        name: launched(peer, launch, name, *SETTINGS[name], code=codes.get(name)) for name in names
    }


def at_pace(twin, count, period=1e-3, **fields):
    """Send joint states one period apart, on time: the stamp of the last, and when it left."""
    begin = time.perf_counter()
    for i in range(count):
        while time.perf_counter() < begin + i * period:
            pass
        stamp = twin.stamp(1)
        twin.send_state(state(stamp, **fields))
    return stamp, time.monotonic()


def is_zeros(message):
    return list(message.effort) == [0.0, 0.0, 0.0]


def running(twin):
    """Wait until a stream of this node is answered."""
    torques = twin.received("joint_torques")
    torques.clear()

    def send():
        assert twin.process.alive(), twin.process.output
        at_pace(twin, 12)

    twin.peer.until(lambda: any(not is_zeros(m) for m in torques), repeat=send)
    return twin


def count_at_rest(quick):
    """The count once the stream has stopped, and nothing more waits."""
    quick.peer.until(lambda: is_zeros(quick.received("joint_torques")[-1]))
    return count_of(quick.at_rest())
