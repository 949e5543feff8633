# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Start the nodes of the demonstration, play bags to them and record their topics."""

from __future__ import annotations

import os
import signal
import struct
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

from pkm_twin.bags.definitions import message_class
from pkm_twin.bags.reader import BagMessage, BagWriter
from pkm_twin.errors import PkmTwinError

MAX_WAIT = 120.0
"""Longest wait for an answer, s. On an idle computer answers take less than a thousandth of this,
but a node that starts for the first time compiles its programs."""
CLOCK_PERIOD = 5_000_000
"""Period of the published clock, ns."""
MAX_LEAD_TIME = 50_000_000
"""Longest time by which a bag runs ahead of its answers, ns: half of what a node allows between a
joint state and its wrench, which arrive independently."""
QUEUE_DEPTH = 20_000
"""Depth of the recorder's queues: more messages than a stage publishes before they are taken."""


class Recorder:
    """Writes the raw messages of topics into a bag, with a prefix for each stage."""

    def __init__(self, node: Node, writer: BagWriter) -> None:
        self._node = node
        self._writer = writer
        self._subscriptions: list[Any] = []
        self.counts: dict[str, int] = {}
        self.newest = 0
        """Stamp of the last message of the paced topic, ns."""

    def start_recording(self, prefix: str, topics: dict[str, str], paced: str = "") -> None:
        """Record topics from now on, each under ``prefix`` followed by its name.

        :param topics: types by topic.
        :param paced: the topic (with headers) whose stamps ``newest`` follows.
        """
        self.newest = 0
        qos = QoSProfile(depth=QUEUE_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
        for topic, kind in topics.items():
            name = f"/{prefix}{topic}"
            self._writer.add_topic(name, kind)
            self.counts[name] = 0
            self._subscriptions.append(
                self._node.create_subscription(
                    message_class(kind), topic, self._record_topic(name, topic == paced), qos, raw=True
                )
            )

    @property
    def total(self) -> int:
        """Number of messages received."""
        return sum(self.counts.values())

    def stop_recording(self) -> None:
        """Stop recording the current topics."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()

    def _record_topic(self, name: str, paced: bool) -> Callable[[bytes], None]:
        def write(data: bytes) -> None:
            self.counts[name] += 1
            if paced:
                self.newest = read_stamp(data)
            self._writer.write(name, data, time.time_ns())

        return write


class Lockstep:
    """Paces a bag by the answers to it, and publishes the nodes' clock.

    A busy computer makes the demonstration slower, but does not change its results.

    :param topic: the topic whose messages are answered, by stamp, on the recorder's paced topic.
    :param child: the node's process; ``what``: description of the wait, for errors.
    """

    def __init__(
        self,
        topic: str,
        recorder: Recorder,
        executor: SingleThreadedExecutor,
        child: subprocess.Popen[bytes],
        what: str,
    ) -> None:
        self._topic, self._recorder, self._executor = topic, recorder, executor
        self._child, self._what = child, what
        self._first = self._last = self._now = self._heard = 0
        self._node = executor.get_nodes()[0]
        self._clock = self._node.create_publisher(Clock, "/clock", 10)
        self._answers = self._node.create_subscription(
            DiagnosticArray, "/diagnostics", self._read_diagnostics_stamp, 10
        )

    def close(self) -> None:
        """Stop the clock."""
        self._node.destroy_publisher(self._clock)
        self._node.destroy_subscription(self._answers)

    def _read_diagnostics_stamp(self, array: DiagnosticArray) -> None:
        self._heard = array.header.stamp.sec

    def start(self, time: int) -> None:
        """Wait until the stamps of the node's diagnostics reach ``time``, ns."""
        self._now = time
        self._wait(lambda: self._heard >= time // 10**9)

    def pace(self, message: BagMessage) -> None:
        """Wait until a message may be published."""
        if message.log_time >= self._now + CLOCK_PERIOD:
            self._now = message.log_time
            self._publish_clock()
        if message.topic != self._topic:
            return
        self._last = read_stamp(message.data)
        self._first = self._first or self._last
        if self._lead_time() > MAX_LEAD_TIME:
            self._wait(lambda: self._lead_time() <= MAX_LEAD_TIME // 2)

    def _lead_time(self) -> int:
        return self._last - max(self._recorder.newest, self._first)

    @property
    def answered(self) -> bool:
        """True if the last message is answered."""
        return self._recorder.newest >= self._last

    def _wait(self, condition: Callable[[], bool]) -> None:
        total = -1

        def check() -> bool:
            nonlocal total
            if self._recorder.total == total:
                # Publish the clock again as long as no answer comes, because its delivery is not reliable.
                self._publish_clock()
            total = self._recorder.total
            return condition()

        wait_for(self._executor, check, self._what, self._child)

    def _publish_clock(self) -> None:
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(self._now, 10**9)
        self._clock.publish(message)


def read_stamp(data: bytes) -> int:
    """Read the stamp, ns, of an encoded message whose first field is a header."""
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return int(seconds) * 10**9 + int(nanoseconds)


@contextmanager
def run_process(command: Sequence[str]) -> Iterator[subprocess.Popen[bytes]]:
    """Run a child process in a session of its own; end it with SIGINT and wait for it."""
    # Remove a variable, without which the child's ROS wheels find their libraries again.
    environment = dict(os.environ)
    environment.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    child = subprocess.Popen(command, start_new_session=True, env=environment)  # noqa: S603
    try:
        yield child
    finally:
        if child.poll() is None:
            child.send_signal(signal.SIGINT)
            try:
                child.wait(timeout=5.0)
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()


def wait_for(
    executor: SingleThreadedExecutor, condition: Callable[[], bool], what: str, child: subprocess.Popen[bytes]
) -> None:
    """Spin until the condition holds.

    :raises PkmTwinError: the condition fails for :data:`MAX_WAIT`, or the child ends before.
    """
    deadline = time.monotonic() + MAX_WAIT
    while not condition():
        executor.spin_once(timeout_sec=0.1)
        if child.poll() is not None:
            raise PkmTwinError(f"waiting for {what}: it ended with code {child.returncode}")
        if time.monotonic() > deadline:
            raise PkmTwinError(f"waiting for {what}: nothing for {MAX_WAIT:g} s; this machine is too slow or too busy")


def receive_remaining(
    executor: SingleThreadedExecutor, recorder: Recorder, answered: Callable[[], bool] = lambda: True
) -> None:
    """Receive messages until none has come for half a second.

    :param answered: returns whether all expected messages have come; otherwise the wait is ten
        times as long.
    """
    last, quiet = recorder.total, time.monotonic()
    while time.monotonic() - quiet < (0.5 if answered() else 5.0):
        executor.spin_once(timeout_sec=0.05)
        if recorder.total != last:
            last, quiet = recorder.total, time.monotonic()
