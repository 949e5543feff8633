# SPDX-License-Identifier: Apache-2.0
"""A plain node for commands that only listen.

ROS is imported inside the functions, so that a command line can show its help without it.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from pkm_twin.errors import PkmTwinError


@contextmanager
def listening_node(
    name: str, sim_time: bool = False, namespace: str = ""
) -> Iterator[tuple[Any, Callable[[float], None]]]:
    """A node in a context of its own, and a function that lets it take messages for some time, s.

    Signals are the caller's.

    :raises PkmTwinError: there is no ROS, or the namespace is none.
    """
    try:
        import rclpy
        from rclpy.exceptions import InvalidNamespaceException
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.parameter import Parameter
        from rclpy.signals import SignalHandlerOptions
    except ImportError as error:
        raise PkmTwinError(
            f"{name.replace('_', '-')} needs ROS 2: source its setup, or pip install "
            f"pkm_twin[jazzy] ({error})"
        ) from error
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        clock = Parameter("use_sim_time", value=sim_time)
        try:
            node = rclpy.create_node(
                name, context=context, namespace=namespace, parameter_overrides=[clock]
            )
        except InvalidNamespaceException as error:
            first = str(error).splitlines()[0]
            raise PkmTwinError(f"--namespace {namespace!r} is no namespace: {first}") from None
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)

        def spin(seconds: float) -> None:
            until = time.monotonic() + seconds
            while (left := until - time.monotonic()) > 0.0:
                executor.spin_once(timeout_sec=left)

        yield node, spin
        executor.shutdown()
        node.destroy_node()
    finally:
        context.try_shutdown()


def subscribe_best_effort(node: Any, kind: str, topic: str, take: Callable[[Any], None]) -> None:
    """Hear a topic of a type (``sensor_msgs/msg/JointState``), however it is published.

    A few messages wait at most: who only looks wants the newest.
    """
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    package, _, name = kind.partition("/msg/")
    message = getattr(importlib.import_module(f"{package}.msg"), name)
    qos = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    node.create_subscription(message, topic, take, qos)
