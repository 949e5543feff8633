# SPDX-License-Identifier: Apache-2.0
"""Whether passive joints stay within their ranges: swivels of ball joints, turns and slides."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.robot.outline import Posture
from pkm_twin.robot.robot import Robot


def passive_values(robot: Robot, q: ArrayLike) -> Array:
    """What ``robot.passive_limits`` bound, shape (..., k), rad or m.

    :param q: joint positions, shape (..., n); errors as ``robot.forward``.
    """
    posture, values = Posture(robot, q), []
    turned, placed = posture.turn, posture.place
    for limit in robot.passive_limits:
        axis = turned(limit.inner, limit.axis)
        if limit.kind == "slide":
            way = placed(limit.outer, limit.at) - placed(limit.inner, limit.at)
            values.append(limit.home + (way * axis).sum(-1))
            continue
        if limit.kind in ("swivel", "rod"):
            other = turned(limit.outer, limit.axis)
            if limit.far is not None:
                other = placed(limit.outer, limit.far) - placed(limit.inner, limit.at)
            sine = np.linalg.norm(np.cross(axis, other), axis=-1)
            values.append(np.arctan2(sine, (axis * other).sum(-1)))
            continue
        across = np.eye(3)[np.abs(limit.axis).argmin()]
        across = np.cross(limit.axis, across)
        one, other = turned(limit.inner, across), turned(limit.outer, across)
        sine = (np.cross(one, other) * axis).sum(-1)
        values.append(limit.home + np.arctan2(sine, (one * other).sum(-1)))
    return np.stack(values, -1)


def within_passive_limits(robot: Robot, q: ArrayLike) -> Mask:
    """Whether passive joints keep their limits, shape (...); a robot without any keeps them.

    :param q: joint positions with an assembly, shape (..., n).
    """
    if not robot.passive_limits:
        return np.ones(np.shape(q)[:-1], bool)
    values = passive_values(robot, q)
    low, high = np.array([[one.low, one.high] for one in robot.passive_limits]).T
    return np.asarray(((values >= low) & (values <= high)).all(-1))
