# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What every stage of the demonstration needs: child processes, and a recorder of their topics."""

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

PATIENCE = 120.0
"""How long an answer may take, s: where nothing else runs it is less than a thousandth of it; a
node that starts for the first time compiles its programs."""
TICK = 5_000_000
"""Period of the clock of a bag, ns."""
AHEAD = 50_000_000
"""How far a bag goes ahead of its answers, ns. Joint states and wrenches that belong together come
by ways of their own: this is half of what a node allows between them."""
DEPTH = 20_000
"""Of the recorder's queues: more than a stage publishes while nobody takes it."""

STATE = "sensor_msgs/msg/JointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"


class Recorder:
    """Writes the raw messages of some topics into a bag, under a prefix for each stage."""

    def __init__(self, node: Node, writer: BagWriter) -> None:
        self._node = node
        self._writer = writer
        self._subscriptions: list[Any] = []
        self.counts: dict[str, int] = {}
        self.newest = 0
        """Stamp of the last message of the topic that is paced, ns."""

    def listen(self, prefix: str, topics: dict[str, str], paced: str = "") -> None:
        """Record these topics from now on, as ``prefix`` followed by the topic.

        :param paced: of these one with headers, whose stamps ``newest`` follows.
        """
        self.newest = 0
        qos = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.RELIABLE)
        for topic, kind in topics.items():
            name = f"/{prefix}{topic}"
            self._writer.add_topic(name, kind)
            self.counts[name] = 0
            self._subscriptions.append(
                self._node.create_subscription(
                    message_class(kind), topic, self._keep(name, topic == paced), qos, raw=True
                )
            )

    @property
    def total(self) -> int:
        """How many messages have come."""
        return sum(self.counts.values())

    def stop(self) -> None:
        """Forget the current topics."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()

    def _keep(self, name: str, paced: bool) -> Callable[[bytes], None]:
        def callback(data: bytes) -> None:
            self.counts[name] += 1
            if paced:
                self.newest = stamp(data)
            self._writer.write(name, data, time.time_ns())

        return callback


class Lockstep:
    """Plays a bag as fast as it is answered: load makes it slower and changes nothing else.

    It is the nodes' clock, too.

    :param topic: whose messages are answered by stamp on the recorder's paced topic.
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
            DiagnosticArray, "/diagnostics", self._hear, 10
        )

    def close(self) -> None:
        """End the clock."""
        self._node.destroy_publisher(self._clock)
        self._node.destroy_subscription(self._answers)

    def _hear(self, array: DiagnosticArray) -> None:
        self._heard = array.header.stamp.sec

    def begin(self, time: int) -> None:
        """Wait until the node's clock is the bag's, ns: its diagnostics have the stamp."""
        self._now = time
        self._wait(lambda: self._heard >= time // 10**9)

    def pace(self, message: BagMessage) -> None:
        """Wait before a message goes out."""
        if message.log_time >= self._now + TICK:
            self._now = message.log_time
            self._tick()
        if message.topic != self._topic:
            return
        self._last = stamp(message.data)
        self._first = self._first or self._last
        if self._ahead() > AHEAD:
            self._wait(lambda: self._ahead() <= AHEAD // 2)

    def _ahead(self) -> int:
        return self._last - max(self._recorder.newest, self._first)

    @property
    def answered(self) -> bool:
        """Whether the last message has its answer."""
        return self._recorder.newest >= self._last

    def _wait(self, condition: Callable[[], bool]) -> None:
        total = -1

        def holds() -> bool:
            nonlocal total
            if self._recorder.total == total:
                # Nothing came: the clock, which is not delivered reliably, goes out again.
                self._tick()
            total = self._recorder.total
            return condition()

        wait_for(self._executor, holds, self._what, self._child)

    def _tick(self) -> None:
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(self._now, 10**9)
        self._clock.publish(message)


def stamp(data: bytes) -> int:
    """Stamp of an encoded message that begins with a header, ns."""
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return int(seconds) * 10**9 + int(nanoseconds)


@contextmanager
def process(command: Sequence[str]) -> Iterator[subprocess.Popen[bytes]]:
    """A child process in a session of its own, ended with SIGINT and waited for."""
    child = subprocess.Popen(command, start_new_session=True, env=child_environment())  # noqa: S603
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


def child_environment() -> dict[str, str]:
    """The environment, changed so that a child's ROS wheels find their libraries again."""
    environment = dict(os.environ)
    environment.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    return environment


def wait_for(
    executor: SingleThreadedExecutor,
    condition: Callable[[], bool],
    what: str,
    child: subprocess.Popen[bytes],
) -> None:
    """Spin until the condition holds.

    :raises PkmTwinError: it does not for :data:`PATIENCE`, or the child ends before.
    """
    deadline = time.monotonic() + PATIENCE
    while not condition():
        executor.spin_once(timeout_sec=0.1)
        if child.poll() is not None:
            raise PkmTwinError(f"waiting for {what}: it ended with code {child.returncode}")
        if time.monotonic() > deadline:
            raise PkmTwinError(
                f"waiting for {what}: nothing for {PATIENCE:g} s; "
                "this machine is too slow or too busy"
            )


def drain(
    executor: SingleThreadedExecutor,
    recorder: Recorder,
    answered: Callable[[], bool] = lambda: True,
) -> None:
    """Take what is still on its way: until nothing has come for half a second.

    :param answered: whether all is there that is known to come; else it is waited for ten times
        as long.
    """
    last, quiet = recorder.total, time.monotonic()
    while time.monotonic() - quiet < (0.5 if answered() else 5.0):
        executor.spin_once(timeout_sec=0.05)
        if recorder.total != last:
            last, quiet = recorder.total, time.monotonic()
