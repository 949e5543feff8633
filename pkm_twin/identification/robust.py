# SPDX-License-Identifier: Apache-2.0
"""Robust weights of measured poses: Huber's, one a pose, so that one wrong pose moves nothing.

A pose's distance is the root mean square of its residual's axes over their noise.

May import: numpy, the standard library.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HUBER: Final = 1.5
"""Distance up to which a pose counts with its square."""
OUTLIER: Final = 6.0
"""Distance from which a pose is an outlier."""
CLEAR: Final = 3.0
"""Distance up to which poses count for the noise: of 100,000 good ones one is farther off."""
TURNS: Final = 5
MEDIAN: Final = 2.366
"""Median of a chi-square variable of three degrees of freedom."""
FINEST: Final = 1e-9
"""Noise that no instrument is below, m or rad."""


@dataclass(frozen=True, eq=False)
class Weighed:
    """Noise of positions and, where measured, rotations, an axis; the poses' weights, (k,)."""

    noise: tuple[float, ...]
    weights: Array

    def over(self, parts: Sequence[Array]) -> Array:
        """Rows (k, 3, ...) of each part in units of their noise and weighted, axes flat."""
        root = np.sqrt(self.weights)
        rows = [
            (part * root.reshape(-1, *[1] * (part.ndim - 1)) / size).reshape(-1, *part.shape[2:])
            for part, size in zip(parts, self.noise, strict=True)
        ]
        return np.concatenate(rows)


def distances(parts: Sequence[Array], noise: Sequence[float]) -> Array:
    """Of poses, from residuals (k, 3) of positions and perhaps rotations, shape (k,)."""
    square = [np.mean((part / size) ** 2, 1) for part, size in zip(parts, noise, strict=True)]
    return np.asarray(np.sqrt(np.mean(square, 0)), np.float64)


def weighed(parts: Sequence[Array], parameters: int) -> Weighed:
    """Noise and weights by residuals (k, 3) that a fit of so many parameters left."""
    noise = [max(float(np.sqrt(np.median(np.sum(part**2, 1)) / MEDIAN)), FINEST) for part in parts]
    taken = parameters // len(parts)
    for _ in range(TURNS):
        good = distances(parts, noise) < CLEAR
        count = max(1.0, 3.0 * float(good.sum()) - taken)
        noise = [max(float(np.sqrt(np.sum(part[good] ** 2) / count)), FINEST) for part in parts]
    weights = np.minimum(1.0, HUBER / np.maximum(distances(parts, noise), HUBER))
    return Weighed(tuple(noise), np.asarray(weights, np.float64))
