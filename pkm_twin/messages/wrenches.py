# SPDX-License-Identifier: Apache-2.0
"""Wrench messages to checked arrays, as :mod:`~pkm_twin.messages.reading` reads joints."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import MessageError
from pkm_twin.messages.reading import TINY, shown
from pkm_twin.messages.stamps import StampRules, stamp_of

MAX_FORCE: Final = 1e7
MAX_MOMENT: Final = 1e7


@dataclass(frozen=True)
class WrenchSample:
    """A wrench as it came: force and moment, shape (6,), N and N m, in ``frame``'s axes."""

    stamp: int
    frame: str
    wrench: Array


def read_wrench(
    message: Any, now: int, rules: StampRules, frame: str, accept_empty: bool
) -> WrenchSample:
    """A geometry_msgs/WrenchStamped in the expected frame; an empty frame only where allowed."""
    given = message.header.frame_id
    if given != frame and not (given == "" and accept_empty):
        hint = "; set accept_empty_frame to allow it" if given == "" else ""
        raise MessageError("frame", f"frame is {shown(given)}, expected {frame!r}{hint}")
    stamp = rules.check(stamp_of(message.header), now)
    force, torque = message.wrench.force, message.wrench.torque
    values = [force.x, force.y, force.z, torque.x, torque.y, torque.z]
    labels = ("force.x", "force.y", "force.z", "torque.x", "torque.y", "torque.z")
    for i, (label, value) in enumerate(zip(labels, values, strict=True)):
        bound = MAX_FORCE if i < 3 else MAX_MOMENT
        if not math.isfinite(value):
            raise MessageError("not finite", f"{label} is {value}")
        if abs(value) > bound or 0.0 < abs(value) < TINY:
            raise MessageError("bounds", f"{label} is {value:g}, allowed up to {bound:g}")
    return WrenchSample(stamp, given or frame, np.array(values, np.float64))
