# SPDX-License-Identifier: Apache-2.0
"""How far the platform is from where the file says, by tolerances of the file's numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.errors import ParameterError
from pkm_twin.robot.derivatives import platform_derivatives
from pkm_twin.robot.robot import Robot

Array = NDArray[np.float64]

REGULAR: Final = 0.05
"""Least singularity index of joint states that stand for the workspace."""


@dataclass(frozen=True)
class Budget:
    """Standard deviations of the platform's place in k states, and what each number adds.

    ``parts``: by path, translation (k, 3) and rotation vector (k, 3) by one standard deviation of
    the number, base axes, m and rad. ``position``, ``angle``: of all together, lengths (k,).
    """

    parts: Mapping[str, Array]
    position: Array
    angle: Array

    def share(self, path: str) -> float:
        """Part of the mean square of the position's error that is of this number, 0 to 1."""
        total = float((self.position**2).sum())
        own = float((self.parts[path][..., :3] ** 2).sum())
        return own / total if total > 0.0 else 0.0


def pose_errors(robot: Robot, q: ArrayLike, sigma: Mapping[str, float]) -> Budget:
    """Errors of the platform by independent errors of numbers, to first order, joints held.

    :param q: joint positions, shape (k, n).
    :param sigma: standard deviation by dotted path, in the number's unit.
    :raises ParameterError: a path that there is not, or a deviation that is none.
    """
    for path, value in sigma.items():
        if not (math.isfinite(value) and value >= 0.0):
            raise ParameterError(f"tolerance {path}", value, "a standard deviation, 0 or more")
    states = np.atleast_2d(np.asarray(q, np.float64))
    found = platform_derivatives(robot, states, tuple(sigma)).by
    parts = {path: value * found[path] for path, value in sigma.items()}
    squares = sum((part**2 for part in parts.values()), np.zeros((len(states), 6)))
    return Budget(parts, *(np.sqrt(squares[:, k : k + 3].sum(-1)) for k in (0, 3)))


def workspace_states(robot: Robot, count: int, seed: int = 0) -> Array:
    """Joint states between the limits, away from singularities, shape (k, n), k at most ``count``.

    :raises ParameterError: no limits of positions, or no such state.
    """
    limits = robot.limits.position
    if limits is None or not np.isfinite(limits).all():
        raise ParameterError("limits.position", None, "limits of all joints, or a path")
    rng = np.random.default_rng(seed)
    q = limits[:, 0] + np.ptp(limits, 1) * rng.random((count, robot.joints_count))
    measure, good = robot.try_singularity(q)
    kept = q[good & (measure >= REGULAR)]
    if not len(kept):
        raise ParameterError("limits.position", None, "limits inside which states are regular")
    return np.asarray(kept, np.float64)
