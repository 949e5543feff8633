# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Locate a wrench sensor by parameters, or by transforms if tf2 is installed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from rclpy.time import Time

from pkm_twin.errors import MessageError, ParameterError
from pkm_twin.machine import rotations
from pkm_twin.streams.wrench import PLATFORM, Mount, Mounts

if TYPE_CHECKING:
    from pkm_twin.ros.node import TwinNode


def declare_mounts(node: TwinNode, platform_frame: str = PLATFORM) -> Mounts | None:
    """Return the transforms that give a sensor's pose; None if parameters give it.

    :raises ParameterError: transforms are wanted and tf2_ros is not installed.
    """
    wanted = node.declare(
        "use_tf",
        False,
        "take the sensor's pose from /tf in place of sensor.xyz and sensor.rpy, "
        "between wrench_frame and platform_frame at the wrench's stamp; needs tf2_ros",
    )
    if not wanted:
        return None
    return TransformMounts(node, platform_frame)


def declare_vector(node: TwinNode, name: str, text: str, unit: str) -> tuple[float, float, float]:
    """Declare a parameter of three numbers, zeros by default.

    :raises ParameterError: another number of values.
    """
    values = node.declare(name, [0.0, 0.0, 0.0], text, unit=unit)
    if len(values) != 3:
        raise ParameterError(name, list(values), f"3 numbers, {unit}")
    x, y, z = values
    return float(x), float(y), float(z)


class TransformMounts:
    """Find a frame's pose on the platform, from ``/tf`` and ``/tf_static``.

    :raises ParameterError: tf2_ros is not installed.
    """

    def __init__(self, node: TwinNode, platform_frame: str) -> None:
        try:
            tf2 = __import__("tf2_ros")
        except ImportError as error:
            raise ParameterError("use_tf", True, f"false without tf2_ros ({error})") from error
        self._platform = platform_frame
        self._failure = tf2.TransformException
        self._buffer: Any = tf2.Buffer()
        self._listener = tf2.TransformListener(self._buffer, node)

    def __call__(self, frame: str, stamp: int) -> Mount:
        """Return the frame's pose on the platform at a stamp, ns.

        :raises MessageError: no transform between the two is known for that time.
        """
        try:
            found = self._buffer.lookup_transform(self._platform, frame, Time(nanoseconds=stamp))
        except self._failure as error:
            text = f"no transform from {frame!r} to {self._platform!r}: {error}"
            raise MessageError("transform", text) from error
        move, turn = found.transform.translation, found.transform.rotation
        position = np.array([move.x, move.y, move.z])
        return Mount(position, rotations.from_quaternion(turn.x, turn.y, turn.z, turn.w))
