# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Create a ROS node for a command."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pkm_twin.bags.definitions import message_class
from pkm_twin.errors import PkmTwinError, write_install_command


def middleware_arguments(arguments: Sequence[str]) -> list[str]:
    """Return arguments for rclpy; turn log files off if no folder for them can be written.

    The middleware would not start without the folder. Log lines still go to the terminal and
    /rosout, and standard error states the reason once.
    """
    given = list(arguments)
    try:
        home = os.environ.get("ROS_HOME") or Path.home() / ".ros"
        folder = Path(os.environ.get("ROS_LOG_DIR") or Path(home) / "log").expanduser()
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(f"{folder} is read-only")
    except (OSError, RuntimeError) as error:
        print(f"no log files: {error}; set ROS_LOG_DIR to a folder", file=sys.stderr)
        given += ["--ros-args", "--disable-external-lib-logs"]
    return given


@contextmanager
def own_node(name: str, needs: str, *, sim_time: bool = False, namespace: str = "") -> Iterator[Any]:
    """Yield a node in its own context, which handles no signals; both end with the block.

    It has no parameter services.

    :param needs: what needs the node, for the error.
    :param sim_time: use the clock of ``/clock``.
    :raises PkmTwinError: ROS is not installed, or the namespace is invalid.
    """
    try:
        import rclpy
        from rclpy.exceptions import InvalidNamespaceException
        from rclpy.node import Node
        from rclpy.parameter import Parameter
        from rclpy.signals import SignalHandlerOptions
    except ImportError as error:
        raise PkmTwinError(
            f"{needs} needs ROS 2: source its setup, or {write_install_command('jazzy')} ({error})"
        ) from error
    context = rclpy.Context()
    rclpy.init(args=middleware_arguments([]), context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = None
    try:
        clock = Parameter("use_sim_time", value=sim_time)
        try:
            node = Node(
                name, context=context, namespace=namespace, parameter_overrides=[clock], start_parameter_services=False
            )
        except InvalidNamespaceException as error:
            first = str(error).splitlines()[0]
            raise PkmTwinError(f"--namespace {namespace!r} is invalid: {first}") from None
        yield node
    finally:
        if node is not None:
            node.destroy_node()
        context.try_shutdown()


@contextmanager
def listening_node(
    name: str, sim_time: bool = False, namespace: str = ""
) -> Iterator[tuple[Any, Callable[[float], None]]]:
    """Yield a node in its own context, and a function that takes its messages for a time, s.

    The caller handles signals.

    :raises PkmTwinError: ROS is not installed, or the namespace is invalid.
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
    """Subscribe to a topic of a type (``sensor_msgs/msg/JointState``), with any publisher QoS.

    Only the newest few messages wait.
    """
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    qos = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    node.create_subscription(message_class(kind), topic, take, qos)
