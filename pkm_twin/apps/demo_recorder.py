# SPDX-License-Identifier: Apache-2.0
"""What every stage of the demonstration needs: child processes, and a recorder of their topics."""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from pkm_twin.bags.reader import BagWriter
from pkm_twin.errors import PkmTwinError

MATCH_SECONDS = 60.0
"""How long a node may take to come up: the first start compiles the kernels."""

STATE = "sensor_msgs/msg/JointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"


class Recorder:
    """Writes the raw messages of some topics into a bag, under a prefix for each stage."""

    def __init__(self, node: Node, writer: BagWriter) -> None:
        self._node = node
        self._writer = writer
        self._subscriptions: list[Any] = []
        self.counts: dict[str, int] = {}

    def listen(self, prefix: str, topics: dict[str, str]) -> None:
        """Record these topics from now on, as ``prefix`` followed by the topic."""
        qos = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE)
        for topic, kind in topics.items():
            name = f"/{prefix}{topic}"
            self._writer.add_topic(name, kind)
            self.counts[name] = 0
            self._subscriptions.append(
                self._node.create_subscription(
                    message_class(kind), topic, self._keep(name), qos, raw=True
                )
            )

    def stop(self) -> None:
        """Forget the current topics."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()

    def _keep(self, name: str) -> Callable[[bytes], None]:
        def callback(data: bytes) -> None:
            self.counts[name] += 1
            self._writer.write(name, data, time.time_ns())

        return callback


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


def message_class(kind: str) -> Any:
    """The class of a type's name."""
    package, _, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def wait_for(
    executor: SingleThreadedExecutor,
    condition: Callable[[], bool],
    seconds: float,
    what: str,
    child: subprocess.Popen[bytes],
) -> None:
    """Spin until the condition holds.

    :raises PkmTwinError: it does not within so many seconds, or the child ends before.
    """
    deadline = time.monotonic() + seconds
    while not condition():
        executor.spin_once(timeout_sec=0.1)
        if child.poll() is not None:
            raise PkmTwinError(f"waiting for {what}: it ended with code {child.returncode}")
        if time.monotonic() > deadline:
            raise PkmTwinError(f"waiting for {what}: nothing after {seconds:g} s")


def drain(executor: SingleThreadedExecutor, recorder: Recorder) -> None:
    """Take what is still on its way: until nothing has come for half a second."""
    last, quiet = sum(recorder.counts.values()), time.monotonic()
    while time.monotonic() - quiet < 0.5:
        executor.spin_once(timeout_sec=0.05)
        count = sum(recorder.counts.values())
        if count != last:
            last, quiet = count, time.monotonic()
