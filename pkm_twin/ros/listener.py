# SPDX-License-Identifier: Apache-2.0
"""A plain node for commands that only listen.

ROS is imported inside the functions, so that a command line can show its help without it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from pkm_twin.bags.definitions import message_class
from pkm_twin.ros.context import own_node


@contextmanager
def listening_node(
    name: str, sim_time: bool = False, namespace: str = ""
) -> Iterator[tuple[Any, Callable[[float], None]]]:
    """A node in a context of its own, and a function that lets it take messages for some time, s.

    Signals are the caller's.

    :raises PkmTwinError: there is no ROS, or the namespace is none.
    """
    needs = name.replace("_", "-")
    with own_node(name, needs, sim_time=sim_time, namespace=namespace) as node:
        from rclpy.executors import SingleThreadedExecutor

        executor = SingleThreadedExecutor(context=node.context)
        executor.add_node(node)

        def spin(seconds: float) -> None:
            until = time.monotonic() + seconds
            while (left := until - time.monotonic()) > 0.0:
                executor.spin_once(timeout_sec=left)

        yield node, spin
        executor.shutdown()


def subscribe_best_effort(node: Any, kind: str, topic: str, take: Callable[[Any], None]) -> None:
    """Hear a topic of a type (``sensor_msgs/msg/JointState``), however it is published.

    A few messages wait at most: who only looks wants the newest.
    """
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    qos = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    node.create_subscription(message_class(kind), topic, take, qos)
