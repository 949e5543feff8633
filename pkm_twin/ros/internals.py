# SPDX-License-Identifier: Apache-2.0
"""What rclpy keeps to itself and nodes need: all of it stands here."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from typing import Any

KNOWN = "7.1"
"""The rclpy in which the names below are as they are here, that of Jazzy."""


def parameter_overrides(node: Any) -> dict[str, Any]:
    """Parameters that the node was started with, by name; a change of it changes the node's.

    rclpy has no public name for them while they are not declared.

    :raises RuntimeError: an rclpy that keeps them elsewhere.
    """
    try:
        overrides: dict[str, Any] = node._parameter_overrides
    except AttributeError:
        try:
            found = version("rclpy")
        except PackageNotFoundError:
            found = "of an unknown version"
        raise RuntimeError(f"rclpy {found} is not supported; use {KNOWN}") from None
    return overrides
