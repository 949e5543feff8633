# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Poses all over a regular workspace, for means over it."""

from __future__ import annotations

import math

import numpy as np

from pkm_twin.codegen.arrays import Array
from stiffness_monitor import RegularWorkspace


def polar_samples(workspace: RegularWorkspace, step: float = math.radians(1.0)) -> Array:
    """Poses on 72 rays from the axis, shape (m, 3): denser towards the axis.

    The 2UPR-RPU paper's global factors (equation 39: a mean over N points) come out with these.

    :param step: distance of neighbouring points on a ray, rad; the axis stands once a ray.
    """
    turn = np.arange(72) * (2 * np.pi / 72)
    layers = []
    for z, radius in zip(workspace.z.tolist(), workspace.radius.tolist(), strict=True):
        rungs = step * np.arange(_count(radius, step) + 1)[:, None]
        layers.append(_layer(z, rungs * np.cos(turn), rungs * np.sin(turn)))
    return np.concatenate(layers)


def even_samples(workspace: RegularWorkspace, step: float = math.radians(1.0)) -> Array:
    """Poses on a square grid of tilts (rad), shape (m, 3): a mean over the volume."""
    layers = []
    for z, radius in zip(workspace.z.tolist(), workspace.radius.tolist(), strict=True):
        n = _count(radius, step)
        ticks = step * np.arange(-n, n + 1)
        first, second = np.meshgrid(ticks, ticks, indexing="ij")
        inside = first**2 + second**2 <= radius**2 * (1 + 1e-12)
        layers.append(_layer(z, first[inside], second[inside]))
    return np.concatenate(layers)


def _count(radius: float, step: float) -> int:
    return math.floor(radius / step * (1 + 1e-12))


def _layer(z: float, first: Array, second: Array) -> Array:
    return np.column_stack((np.full(first.size, z), first.ravel(), second.ravel()))
