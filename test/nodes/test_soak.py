# SPDX-License-Identifier: Apache-2.0
"""Both nodes at full rate for minutes: memory, descriptors and threads stay as they are.

``SOAK_SECONDS`` sets how long; the first fifth is warm-up.
"""

import os
import time
from pathlib import Path

import numpy as np
import pytest

from pkm_twin import load
from test.nodes.harness import Maker, Ros, values_of

pytest.importorskip("rclpy", exc_type=ImportError)

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import String

pytestmark = pytest.mark.long

SECONDS = float(os.environ.get("SOAK_SECONDS", "180"))
GROWTH = 2 * 2**20
"""Bytes by which the memory's median may differ between the first and the last part."""
MAKE = Maker(Ros())


class Watched:
    """A process's memory (bytes), open descriptors and threads over time."""

    def __init__(self, process):
        self.folder = Path(f"/proc/{process.process.pid}")
        self.memory, self.descriptors, self.threads = [], [], []

    def look(self):
        pages = int((self.folder / "statm").read_text().split()[1])
        self.memory.append(pages * os.sysconf("SC_PAGE_SIZE"))
        self.descriptors.append(len(list((self.folder / "fd").iterdir())))
        self.threads.append(len(list((self.folder / "task").iterdir())))

    def check(self):
        """Medians: a single look may see a buffer in use."""
        third = len(self.memory) // 3
        for values, allowed in ((self.memory, GROWTH), (self.descriptors, 0), (self.threads, 0)):
            first, last = np.median(values[:third]), np.median(values[-third:])
            assert last - first <= allowed, values


@pytest.mark.timeout(60 + 2 * SECONDS)
def test_nodes_do_not_grow(peer, launch):
    delta, head = load("delta_cu"), load("upr_rpu")
    runs = {
        "feeding": launch(
            "delta_dynamics.node",
            "stale_after:=1.0",
            arguments=("-r", "__node:=feeding", "-r", "joint_states:=/feeding/states"),
        ),
        "watching": launch(
            "stiffness_monitor.node",
            "max_state_age:=1.0",
            arguments=(
                *("-r", "__node:=watching", "-r", "joint_states:=/watching/states"),
                *("-r", "wrench:=/watching/wrench"),
            ),
        ),
    }
    peer.talk(JointState, "/feeding/states")
    peer.talk(JointState, "/watching/states")
    peer.talk(WrenchStamped, "/watching/wrench")
    peer.hear(JointState, "/feeding/joint_torques")
    peer.hear(String, "/watching/dominant_element")
    peer.hear(DiagnosticArray, "/diagnostics")
    legs = head.inverse([-0.7, 0.2, -0.15]).tolist()
    begin = time.perf_counter()

    def send(i):
        """1 kHz of joint states, one in a hundred of them bad; 200 Hz of wrenches."""
        t = i * 1e-3
        q = 0.2 + 0.2 * np.sin(t * np.array([6.0, 5.0, 4.0]))
        qd = 0.2 * np.array([6.0, 5.0, 4.0]) * np.cos(t * np.array([6.0, 5.0, 4.0]))
        if i % 100 == 50:
            q[0] = np.nan
        now = peer.now()
        peer.send("/feeding/states", MAKE.joint_state(delta.joint_names, q, qd, stamp=now))
        if i % 5 == 0:
            peer.send("/watching/states", MAKE.joint_state(head.joint_names, legs, stamp=now))
            load_now = [10.0 * np.sin(t), 5.0, -20.0, 1.0, 0.0, 0.0]
            peer.send("/watching/wrench", MAKE.wrench(load_now, now))

    def run(seconds, look=lambda: None):
        nonlocal sent
        end = time.perf_counter() + seconds
        due = 0.0
        while (now := time.perf_counter()) < end:
            # What this side missed is left out, not caught up.
            sent = max(sent + 1, int((now - begin) * 1e3))
            send(sent)
            if now >= due:
                look()
                due = now + 0.5
            peer.spin()

    sent = 0
    answers = ("/feeding/joint_torques", "/watching/dominant_element")
    peer.until(peer.matched, 90.0)
    run(SECONDS / 5)
    assert all(peer.received(topic) for topic in answers)
    peer.clear()
    watched = {name: Watched(process) for name, process in runs.items()}
    run(SECONDS * 4 / 5, lambda: [w.look() for w in watched.values()])
    for name, process in runs.items():
        assert process.alive(), process.output
        watched[name].check()
        array = peer.diagnostics(f"/{name}")
        assert values_of(array)["exceptions"] == "0"
    assert min(len(peer.received(topic)) for topic in answers) > 20 * SECONDS
