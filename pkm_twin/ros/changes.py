# SPDX-License-Identifier: Apache-2.0
"""What follows a change of parameters while a node runs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter

from pkm_twin.errors import PkmTwinError

if TYPE_CHECKING:
    from pkm_twin.ros.node import TwinNode

V = TypeVar("V")


def follow_changes(
    node: TwinNode,
    names: Iterable[str],
    prepare: Callable[[dict[str, Any]], V],
    take: Callable[[V], object],
) -> None:
    """A set of parameters is taken or refused whole, between two messages.

    :param names: of all parameters that ``prepare`` knows.
    :param prepare: makes what the new values, by name, come to; nothing else hangs on it yet. A
        PkmTwinError refuses the set.
    :param take: goes on with that, once the parameters have their values.
    """
    prepared: list[V] = []

    def judge(changes: Sequence[Parameter]) -> SetParametersResult:
        # What another callback has refused after this one is never taken.
        prepared.clear()
        values = {change.name: change.value for change in changes}
        try:
            for name, value in values.items():
                if node.has_parameter(name):
                    node.check_parameter(name, value)
            prepared.append(prepare(values))
        except PkmTwinError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def follow(changes: Sequence[Parameter]) -> None:
        while prepared:
            take(prepared.pop())

    node.followed.update(names)
    node.add_on_set_parameters_callback(judge)
    node.add_post_set_parameters_callback(follow)
