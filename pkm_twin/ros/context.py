# SPDX-License-Identifier: Apache-2.0
"""A node for a command, where there is ROS.

May import: pkm_twin's errors, the standard library; rclpy only when it is asked for.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pkm_twin.errors import PkmTwinError


@contextmanager
def own_node(
    name: str, needs: str, *, sim_time: bool = False, namespace: str = ""
) -> Iterator[Any]:
    """A node in a context of its own, which leaves signals alone; both end with the block.

    It has no parameter services.

    :param needs: what needs it, for the refusal.
    :param sim_time: its clock is that of ``/clock``.
    :raises PkmTwinError: there is no ROS here, or the namespace is none.
    """
    try:
        import rclpy
        from rclpy.exceptions import InvalidNamespaceException
        from rclpy.node import Node
        from rclpy.parameter import Parameter
        from rclpy.signals import SignalHandlerOptions
    except ImportError as error:
        raise PkmTwinError(
            f"{needs} needs ROS 2: source its setup, or pip install pkm_twin[jazzy] ({error})"
        ) from error
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = None
    try:
        clock = Parameter("use_sim_time", value=sim_time)
        try:
            node = Node(
                name, context=context, namespace=namespace, parameter_overrides=[clock],
                start_parameter_services=False,
            )  # fmt: skip
        except InvalidNamespaceException as error:
            first = str(error).splitlines()[0]
            raise PkmTwinError(f"--namespace {namespace!r} is no namespace: {first}") from None
        yield node
    finally:
        if node is not None:
            node.destroy_node()
        context.try_shutdown()
