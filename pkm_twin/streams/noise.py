# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Estimate the noise of samples from divided differences, in which a smooth motion vanishes."""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Sequence
from operator import mul
from typing import Final, TypeVar

import numpy as np

from pkm_twin.codegen.arrays import ROUNDING_NOISE, Array
from pkm_twin.messages.stamps import SECOND

SIGMAS: Final = 4.0
"""A value below this many standard deviations of its noise counts as zero."""
STENCIL: Final = 7
"""Number of samples in a divided difference of order six."""
MEDIAN_WINDOW: Final = 15
"""Number of divided differences whose median gives a stream's noise."""
MAD_TO_SIGMA: Final = 1.4826
"""Ratio of standard deviation to median absolute deviation for a normal distribution."""

Times = TypeVar("Times", float, Array)


def estimate_deviation(residual: Array) -> Array:
    """Return the standard deviation of normal residuals (k, ...) from the median of their sizes."""
    return np.asarray(MAD_TO_SIGMA * np.median(np.abs(residual), axis=0), np.float64)


def difference_weights(times: Sequence[Times]) -> list[Times]:
    """Return the weights of the samples at some times in their divided difference.

    The weighted sum of numbers with independent noise has the same noise as each of them.

    :param times: rising, a float or an array each, s.
    """
    # Times in units of the mean step keep the products within the range of doubles.
    step = (times[-1] - times[0]) / (len(times) - 1)
    weights = [
        1.0 / math.prod((t - other) / step for j, other in enumerate(times) if j != i) for i, t in enumerate(times)
    ]
    length = sum(map(mul, weights, weights)) ** 0.5
    return [weight / length for weight in weights]


def find_differences(time: Array, values: Array, stencil: int) -> Array:
    """Return the sizes of all divided differences of some samples, (k - stencil + 1, n).

    :param time: rising, shape (k,), s; values, shape (k, n).
    """
    count = max(len(time) - stencil + 1, 0)
    weights = difference_weights([time[i : i + count] for i in range(stencil)])
    terms = (weights[i][:, None] * values[i : i + count] for i in range(stencil))
    return np.asarray(np.abs(sum(terms)), np.float64)


def estimate_noise(time: Array, values: Array) -> Array:
    """Estimate the standard deviation of samples' noise, shape (n,); zero for fewer than seven.

    It is the median of the absolute divided differences of order six, scaled.

    :param time: rising, shape (k,), s; values, shape (k, n).
    """
    sizes = find_differences(time, values, STENCIL)
    # Samples of a joint that repeat exactly do not show its noise.
    sizes[sizes <= ROUNDING_NOISE * np.abs(values[STENCIL - 1 :])] = np.nan
    known = np.isfinite(sizes).any(0)
    found = np.zeros(values.shape[1])
    found[known] = MAD_TO_SIGMA * np.nanmedian(sizes[:, known], 0)
    return found


class NoiseEstimator:
    """Estimates the noise of a stream as :func:`estimate_noise` does for its last 21 samples.

    Samples that repeat exactly count, too: a joint that begins to move has the noise of its rest.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the stream."""
        # One more than needed, so that the newest sample can be removed.
        self._samples: deque[tuple[int, list[float]]] = deque(maxlen=STENCIL + 1)
        self._sizes: deque[list[float]] = deque(maxlen=MEDIAN_WINDOW + 1)

    def retract(self) -> None:
        """Remove the newest sample; possible once after a push."""
        if self._samples:
            self._samples.pop()
        if self._sizes:
            self._sizes.pop()

    def recent(self) -> tuple[list[float], list[tuple[float, ...]]]:
        """Return the times of the last seven samples, s from the first, and each joint's values."""
        samples = list(self._samples)[-STENCIL:]
        times = [(sample[0] - samples[0][0]) / SECOND for sample in samples]
        return times, list(zip(*(sample[1] for sample in samples), strict=True))

    def push(self, stamp: int, values: list[float]) -> list[float] | None:
        """Take a sample; return the noise of each value, None for fewer than seven samples.

        :param stamp: ns, later than that of the last sample.
        """
        # Python floats: for arrays this small numpy's calls would take most of the time.
        self._samples.append((stamp, values))
        if len(self._samples) < STENCIL:
            self._sizes.append([])
            return None
        times, columns = self.recent()
        weights = difference_weights(times)
        self._sizes.append([abs(sum(map(mul, weights, column))) for column in columns])
        kept = zip(*(row for row in list(self._sizes)[-MEDIAN_WINDOW:] if row), strict=True)
        return [MAD_TO_SIGMA * statistics.median(own) for own in kept]
