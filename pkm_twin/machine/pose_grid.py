# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Lay out the poses of a machine about an axis, or along its pose coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array


@dataclass(frozen=True)
class PoseGrid:
    """A layout of poses.

    ``kind`` "cylinder": height along an axis, distance from it and azimuth about it. Distance is
    one of places (m) or of tilts (rad). "box": the pose coordinates themselves, of any number.

    ``names``: the pose coordinates. Of a cylinder: ``height``, the coordinate along the axis, and
    ``lateral``, the two across it. ``zero_torsion``: the lateral coordinates are angles of
    Rx Ry, and distance and azimuth are tilt-and-torsion angles without torsion; else they are
    distance times cosine and sine of the azimuth.
    """

    kind: Literal["cylinder", "box"]
    names: tuple[str, ...]
    height: str = ""
    lateral: tuple[str, ...] = ()
    zero_torsion: bool = False

    def polar_pose(self, height: ArrayLike, distance: ArrayLike, azimuth: ArrayLike) -> Array:
        """Convert cylinder coordinates to poses, shape (..., m).

        :param height: m, shape (...).
        :param distance: from the axis, m or rad.
        :param azimuth: rad.
        :raises ValueError: a box has no axis.
        """
        if self.kind != "cylinder":
            raise ValueError("a box of poses has no height, distance and azimuth")
        z, r, a = np.broadcast_arrays(*(np.asarray(v, np.float64) for v in (height, distance, azimuth)))
        across = zero_torsion(r, a) if self.zero_torsion else (r * np.cos(a), r * np.sin(a))
        parts = dict(zip(self.lateral, across, strict=True)) | {self.height: z}
        return np.stack([parts[name] for name in self.names], -1)

    def distance(self, pose: ArrayLike) -> Array:
        """Return the distance from a cylinder's axis, m or rad, of poses (..., m); shape (...)."""
        poses = np.asarray(pose, np.float64)
        first, second = (poses[..., self.names.index(name)] for name in self.lateral)
        if self.zero_torsion:
            # The tilt, without the loss of digits that its cosine has near zero.
            return np.asarray(
                np.arctan2(np.hypot(np.sin(first) * np.cos(second), np.sin(second)), np.cos(first) * np.cos(second))
            )
        return np.asarray(np.hypot(first, second))


def zero_torsion(tilt: ArrayLike, azimuth: ArrayLike) -> tuple[Array, Array]:
    """Return angles (alpha, beta), rad, of Rx(alpha) Ry(beta) whose z axis is tilted, rad.

    The z axis is (sin t cos a, sin t sin a, cos t) for a tilt t towards the azimuth a.
    """
    t, a = np.asarray(tilt, np.float64), np.asarray(azimuth, np.float64)
    x, y = np.sin(t) * np.cos(a), np.sin(t) * np.sin(a)
    return np.arctan2(-y, np.cos(t)), np.arcsin(x)
