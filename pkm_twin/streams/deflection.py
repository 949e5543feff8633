# SPDX-License-Identifier: Apache-2.0
"""Measured deflections of a platform out of messages, by attributes only: live or decoded.

Pure: times are arguments.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import MessageError
from pkm_twin.messages.reading import TINY
from pkm_twin.messages.stamps import StampRules, stamp_of

MAX_SHIFT: Final = 0.1
MAX_TURN: Final = 0.1
"""Greatest deflection that is one, m and rad: beyond, nothing is linear, or the pose is another."""
UNIT: Final = 1e-3
"""By how much a quaternion's length may miss one."""


class DeflectionSample(NamedTuple):
    """Displacement and small rotation (6,), m and rad, in the axes of ``frame``."""

    stamp: int
    frame: str
    values: Array


def read_deflection(message: Any, now: int, rules: StampRules) -> DeflectionSample:
    """A geometry_msgs/TransformStamped from the platform without load to the platform under it.

    :raises MessageError: a frame without a name, a bad stamp, a value that is not finite or no
        deflection.
    """
    frame = message.header.frame_id
    if not frame:
        raise MessageError("frame", "frame is '', expected the base's or the platform's")
    stamp = rules.check(stamp_of(message.header), now)
    move, turn = message.transform.translation, message.transform.rotation
    labels = ("translation.x", "translation.y", "translation.z", *"xyzw")
    values = (move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w)
    for label, value in zip(labels, values, strict=True):
        if not math.isfinite(value):
            raise MessageError("not finite", f"{label} is {value}")
        if 0.0 < abs(value) < TINY:
            raise MessageError("bounds", f"{label} is {value:g}, too small for a measurement")
    far = max(abs(value) for value in values[:3])
    if far > MAX_SHIFT:
        raise MessageError("bounds", f"translation is {far:g} m, allowed up to {MAX_SHIFT:g}")
    length = math.hypot(*values[3:])
    if abs(length - 1.0) > UNIT:
        raise MessageError("bounds", f"the rotation's length is {length:g}, not 1")
    # A quaternion and its negative are one rotation.
    sign = math.copysign(1.0, turn.w)
    size = math.hypot(turn.x, turn.y, turn.z)
    angle = 2.0 * math.atan2(size, abs(turn.w))
    if angle > MAX_TURN:
        raise MessageError("bounds", f"rotation is {angle:g} rad, allowed up to {MAX_TURN:g}")
    scale = sign * (2.0 if size < 1e-9 else angle / size)
    rotation = (scale * turn.x, scale * turn.y, scale * turn.z)
    return DeflectionSample(stamp, frame, np.array((*values[:3], *rotation), np.float64))


def in_base_axes(values: Array, rotation: Array) -> Array:
    """A deflection (..., 6) that was measured in platform axes, of rotations (..., 3, 3)."""
    shift, turn = (rotation @ values[..., k : k + 3, None] for k in (0, 3))
    return np.asarray(np.concatenate([shift[..., 0], turn[..., 0]], -1), np.float64)
