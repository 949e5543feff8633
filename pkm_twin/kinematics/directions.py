# SPDX-License-Identifier: Apache-2.0
"""Directions spread over a sphere."""

from __future__ import annotations

import operator

import numpy as np

from pkm_twin.codegen.arrays import Array


def sphere_directions(count: int) -> Array:
    """Unit vectors spread evenly over the sphere (Fibonacci lattice), shape (count, 3)."""
    count = operator.index(count)
    if count < 1:
        raise ValueError(f"count has to be at least 1, not {count}")
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    turn = np.pi * (3 - np.sqrt(5)) * i
    out = np.sqrt(1 - z * z)
    return np.stack([out * np.cos(turn), out * np.sin(turn), z], -1)
