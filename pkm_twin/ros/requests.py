# SPDX-License-Identifier: Apache-2.0
"""Requests to a node: those that are too long are refused, and none ends the node."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any, Final

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically

from pkm_twin.errors import ParameterError
from pkm_twin.ros.health import Health, cut

MAX_ASKED: Final = 1000
"""Entries of a request that only asks; one that sets has at most as many as the node has
parameters. More take the stream's time."""


def guarded_service(
    kind: Any, callback: Callable[[Any, Any], Any], health: Health, parameters: Callable[[], int]
) -> Any:
    """A service callback, rclpy's own ones too, that refuses what it cannot take.

    :param parameters: how many the node has.
    """

    def guarded(request: Any, response: Any) -> Any:
        try:
            _check_size(request, parameters())
            if kind is SetParameters and len(request.parameters) > 1:
                # Each for itself, as rclpy does: what is refused does not hide what was set.
                for parameter in request.parameters:
                    one = guarded(kind.Request(parameters=[parameter]), kind.Response())
                    response.results.extend(one.results)
                return response
            return callback(request, response)
        except Exception as error:
            health.seen["requests rejected"] += 1
            text = cut(f"{type(error).__name__}: {error}")
            health.log_throttled("request", f"{kind.__name__}: rejected, {text}")
        response = kind.Response()
        refusal = SetParametersResult(successful=False, reason=text)
        if kind is SetParameters:
            response.results = [refusal]
        elif kind is SetParametersAtomically:
            response.result = refusal
        return response

    return guarded


def _check_size(request: Any, parameters: int) -> None:
    """Refuse a request that would hold up the stream by its length.

    :raises ParameterError: it has too many entries.
    """
    for field in ("parameters", "names", "prefixes"):
        entries = len(getattr(request, field, ()))
        most = parameters if field == "parameters" else MAX_ASKED
        if entries > most:
            raise ParameterError(field, entries, f"at most {most} in a request")
    named = Counter(parameter.name for parameter in getattr(request, "parameters", ()))
    for name, times in named.items():
        if times > 1:
            raise ParameterError(name, times, "once in a request")
