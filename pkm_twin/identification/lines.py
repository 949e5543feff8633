# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""How well distances and angles between poses are known by a calibration or a plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.identification.calibration_state import State, differentiate_poses
from pkm_twin.robot.robot import Robot

MAX_POSES: Final = 24
"""Largest number of poses between which distances and angles are taken."""


class LineSlopes(NamedTuple):
    """Derivatives of distances and angles between poses by parameters.

    Distances of two poses, over their length, (d, p); angles at one pose between the lines to two
    others, rad, (a, p).
    """

    distances: Array
    angles: Array

    @property
    def scale(self) -> Array:
        """Return the derivatives of the uniform scale: the mean of all distances', (p,)."""
        return np.asarray(self.distances.mean(0), np.float64)

    def deviations(self, covariance: Array) -> tuple[float, float]:
        """Return the standard deviations of a distance, over its length, and an angle, rad.

        Root mean square over all lines, so that shear and distortion count, not only the scale.
        """
        variances = (np.sum((rows @ covariance) * rows, -1) for rows in self)
        distance, angle = (float(np.sqrt(max(one.mean(), 0.0))) if one.size else np.nan for one in variances)
        return distance, angle


def line_slopes(robot: Robot, state: State, names: Sequence[str]) -> LineSlopes | None:
    """Differentiate distances of poses and angles between them; None: the platform stays there.

    Lines shorter than 0.3 of the longest, and angles within 30 degrees of 0 or pi, are left out.
    """
    some = np.unique(np.linspace(0, len(state.q) - 1, MAX_POSES).astype(int))
    position = state.instrument.compute_reading(*state.platform)[0][some]
    columns = differentiate_poses(
        robot, replace(state, q=state.q[some], platform=(state.platform[0][some], state.platform[1][some])), names
    )[:, :3]
    ways = position[:, None] - position
    lengths = np.linalg.norm(ways, axis=-1)
    far = lengths > max(0.3 * float(lengths.max(initial=0.0)), 1e-6)
    if not far.any():
        return None
    first, second = np.nonzero(np.triu(far))
    units = ways / np.where(far, lengths, 1.0)[..., None]
    rates = (columns[:, None] - columns) / np.where(far, lengths, 1.0)[..., None, None]
    distances = np.einsum("ma,map->mp", units[first, second], rates[first, second])
    corners = [(k, i, j) for k in range(len(some)) for i, j in combinations(np.flatnonzero(far[k]), 2)]
    k, i, j = np.array(corners, np.intp).reshape(-1, 3).T
    cosine = np.sum(units[k, i] * units[k, j], -1)
    wide = np.sqrt(np.maximum(1.0 - cosine**2, 0.0)) > 0.5
    k, i, j, cosine = k[wide], i[wide], j[wide], cosine[wide, None]
    sine = np.sqrt(1.0 - cosine**2)
    angles = sum(
        -np.einsum("ma,map->mp", (units[k, to] - cosine * units[k, by]) / sine, rates[k, by])
        for by, to in ((i, j), (j, i))
    )
    return LineSlopes(np.asarray(distances, np.float64), np.asarray(angles, np.float64))
