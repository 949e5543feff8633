# SPDX-License-Identifier: Apache-2.0
"""Robust weights of measured poses: Huber's, one a pose, so that one wrong pose moves nothing.

A pose's distance is the root mean square of its residual's axes over their noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array, Mask

HUBER: Final = 1.5
"""Distance up to which a pose counts with its square."""
OUTLIER: Final = 6.0
"""Distance from which a pose is an outlier."""
CLEAR: Final = 3.0
"""Distance up to which poses count for the noise: of 100,000 good ones one is farther off."""
TURNS: Final = 5
MEDIAN: Final = 2.366
"""Median of a chi-square variable of three degrees of freedom."""
LEAST: Final = -9.0
"""Logarithm of the least part of a variance."""
FINEST: Final = 1e-9
"""Noise that no instrument is below, m or rad."""


@dataclass(frozen=True, eq=False)
class Weighed:
    """Noise of positions and, where measured, rotations, an axis; the poses' weights, (k,).

    ``whitening``, (k, a, a): makes a pose's axes, in units of their noise, independent. Errors of a
    drive move position and rotation together.
    """

    noise: tuple[float, ...]
    weights: Array
    whitening: Array

    def over(self, parts: Sequence[Array]) -> Array:
        """Rows (k, 3, ...) of each part whitened and weighted, axes flat."""
        scaled = [part / size for part, size in zip(parts, self.noise, strict=True)]
        whole = np.concatenate(scaled, 1)
        flat = whole.reshape(*whole.shape[:2], -1)
        rows = np.sqrt(self.weights)[:, None, None] * (self.whitening @ flat)
        return np.asarray(rows.reshape(-1, *whole.shape[2:]), np.float64)


def distances(parts: Sequence[Array], noise: Sequence[float]) -> Array:
    """Of poses, from residuals (k, 3) of positions and perhaps rotations, shape (k,)."""
    square = [np.mean((part / size) ** 2, 1) for part, size in zip(parts, noise, strict=True)]
    return np.asarray(np.sqrt(np.mean(square, 0)), np.float64)


def weighed(parts: Sequence[Array], parameters: int, moved: Array | None = None) -> Weighed:
    """Noise and weights by residuals (k, 3) that a fit of so many parameters left.

    :param moved: derivatives of position and rotation by the drives, (k, 6, n), all of one unit;
        then each pose is weighed by the noise of the instrument and of the drives.
    """
    noise = [max(float(np.sqrt(np.median(np.sum(part**2, 1)) / MEDIAN)), FINEST) for part in parts]
    taken = parameters // len(parts)
    for _ in range(TURNS):
        good = distances(parts, noise) < CLEAR
        count = max(1.0, 3.0 * float(good.sum()) - taken)
        noise = [max(float(np.sqrt(np.sum(part[good] ** 2) / count)), FINEST) for part in parts]
    away = distances(parts, noise)
    weights = np.minimum(1.0, HUBER / np.maximum(away, HUBER))
    axes = 3 * len(parts)
    whitening = np.broadcast_to(np.eye(axes), (len(away), axes, axes))
    if moved is not None and np.sum(good := away < CLEAR) > axes:
        scaled = np.concatenate([p / size for p, size in zip(parts, noise, strict=True)], 1)
        halves = [moved[:, :3], moved[:, 3:]][: len(parts)]
        drives = np.concatenate([h / size for h, size in zip(halves, noise, strict=True)], 1)
        whitening = _whitening(scaled, drives @ np.swapaxes(drives, 1, 2), good)
    return Weighed(tuple(noise), np.asarray(weights, np.float64), whitening)


def _whitening(residual: Array, drives: Array, good: Mask) -> Array:
    """Of poses, (k, a, a), by the variances of the instrument and of the drives that are likeliest.

    :param residual: over the noise, (k, a). ``drives``: covariance by drives of variance one,
        (k, a, a). ``good``: poses that count.
    """
    from scipy.optimize import minimize  # type: ignore[import-untyped]

    axes = residual.shape[1]
    part = np.arange(axes) // 3
    # Drives as large as the instrument, on average.
    drives = drives * axes / np.trace(drives[good].mean(0))

    def covariance(logs: Array) -> Array:
        own = np.exp(np.clip(logs, LEAST, -LEAST))
        return np.asarray(np.diag(own[:-1][part]) + own[-1] * drives, np.float64)

    def unlikely(logs: Array) -> float:
        whole = covariance(logs)[good]
        _, size = np.linalg.slogdet(whole)
        left = np.linalg.solve(whole, residual[good][..., None])[..., 0]
        return float(np.mean(size + np.sum(left * residual[good], 1)))

    start = np.full(part[-1] + 2, np.log(0.5))
    found = minimize(unlikely, start, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-6})
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance(found.x))), np.float64)
