# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Joint states at 1 kHz to a node in a process of its own, and its answers back."""

import math
import subprocess
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from pkm_twin import load
from test.nodes.harness import end_with_parent
from test.support.waiting import wait_until

PERIOD = 1e-3
PATIENCE = 0.02
"""How long an answer is waited for, s: the node's window fills, or the machine is elsewhere."""
DEPTH = 1000
"""Of the client's subscriptions: what is lost is not lost here."""
TWIN = ["-m", "delta_dynamics.nodes.twin", "--ros-args", "-p", "mechanism:=delta_cu"]


def start(domain, name, command):
    """A process in a namespace of its own, so that the client speaks to one at a time."""
    remap = ["-r", f"__ns:=/{name}"]
    if "--ros-args" not in command:
        remap = ["--ros-args", *remap]
    return subprocess.Popen(
        [sys.executable, *command, *remap],
        env=domain.environment(),
        start_new_session=True,
        preexec_fn=end_with_parent,
    )


def stop(*children):
    for child in children:
        child.terminate()
    for child in children:
        child.wait(30)


def cpu_of(process):
    """CPU time of all threads of a process so far, s."""
    total = 0
    for thread in Path(f"/proc/{process}/task").iterdir():
        try:
            total += int((thread / "schedstat").read_text().split()[0])
        except OSError:  # it ended
            continue
    return total * 1e-9


@dataclass
class Measurement:
    """Times to the answer, s, and what else a slice told."""

    times: list[float]
    sent: int
    answered: int
    cpu: float


class Client:
    """Publishes joint states and takes the time until the answer with the same stamp."""

    def __init__(self, rclpy, context, names):
        from rclpy.executors import SingleThreadedExecutor
        from sensor_msgs.msg import JointState

        self.kind = JointState
        self.node = rclpy.create_node("bench_client", context=context)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.publishers = {}
        self.sent, self.count = dict.fromkeys(names, 0), dict.fromkeys(names, 0)
        self.answered = dict.fromkeys(names)
        self.names = list(load("delta_cu").joint_names)
        for name in names:
            topic = f"/{name}/joint_states"
            self.publishers[name] = self.node.create_publisher(JointState, topic, 10)
            answer = partial(self._answer, name)
            self.node.create_subscription(JointState, self._topic(name), answer, DEPTH)

    @staticmethod
    def _topic(name):
        node = "echo" if name.startswith("echo") else "delta_dynamics"
        return f"/{name}/{node}/joint_torques"

    def _answer(self, name, message):
        self.count[name] += 1
        self.answered[name] = message.header.stamp.sec, message.header.stamp.nanosec

    def matched(self, name):
        return self.publishers[name].get_subscription_count() and self.node.count_publishers(self._topic(name))

    def wait_for(self, name):
        wait_until(lambda: self.matched(name), lambda: self.executor.spin_once(timeout_sec=0.1), 60.0, name)

    def send(self, name):
        """The next joint state of an even motion, now; its stamp."""
        phase = 2.0 * self.sent[name] * PERIOD
        self.sent[name] += 1
        now = self.node.get_clock().now().to_msg()
        message = self.kind(name=self.names)
        message.header.stamp = now
        message.position = [0.3 * math.sin(phase)] * 3
        message.velocity = [0.6 * math.cos(phase)] * 3
        self.publishers[name].publish(message)
        return now.sec, now.nanosec

    def measure(self, name, seconds, process):
        """One slice: each sample waits for the answer to the one before."""
        times = []
        count = round(seconds / PERIOD)
        used = cpu_of(process)
        begin = time.perf_counter()
        for i in range(count):
            time.sleep(max(0.0, begin + i * PERIOD - time.perf_counter()))
            sent = time.perf_counter()
            stamp = self.send(name)
            while self.answered[name] != stamp and time.perf_counter() - sent < PATIENCE:
                self.executor.spin_once(timeout_sec=PATIENCE / 4)
            if self.answered[name] == stamp:
                times.append(time.perf_counter() - sent)
        used = cpu_of(process) - used
        return Measurement(times[200:], count, len(times), used)

    def stream(self, name, seconds):
        """Samples at their pace, whatever is answered: how many were sent and answered."""
        before = self.count[name]
        count = round(seconds / PERIOD)
        begin = time.perf_counter()
        for i in range(count):
            due = begin + i * PERIOD
            while (left := due - time.perf_counter()) > 0:
                self.executor.spin_once(timeout_sec=left)
            stamp = self.send(name)
        end = time.perf_counter() + 10.0
        while self.answered[name] != stamp and time.perf_counter() < end:
            self.executor.spin_once(timeout_sec=0.1)
        return count, self.count[name] - before

    def first_answer(self, name, begin):
        """Seconds from ``begin`` (perf_counter) to the first answer of a stream that runs."""

        def ask():
            self.send(name)
            self.executor.spin_once(timeout_sec=PERIOD)

        wait_until(lambda: self.answered[name], ask, 120.0, f"an answer of {name}")
        return time.perf_counter() - begin
