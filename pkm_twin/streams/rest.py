# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Bound the errors of joint velocities, so that joints at rest are recognised.

The sign of a velocity is the direction of dry friction; for a joint at rest it would be the sign of
the noise. So a velocity counts as zero if it is below its error bound: the noise of positions or
velocities, propagated, plus the truncation error of the differentiation. The noise is estimated
from divided differences of order six, in which a smooth motion vanishes.
"""

from __future__ import annotations

import math
from collections import deque
from operator import mul
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import ROUNDING_NOISE, Array
from pkm_twin.messages.stamps import SECOND

SIGMAS: Final = 4.0
"""A velocity below this many standard deviations of its noise counts as zero."""
STENCIL: Final = 7
"""Number of samples in a divided difference of order six."""
MEDIAN_WINDOW: Final = 15
"""Number of divided differences whose median gives a stream's noise."""
MAD_TO_SIGMA: Final = 1.4826
"""Ratio of standard deviation to median absolute deviation for a normal distribution."""
BLOCK_SAMPLES: Final = 4096


def difference_weights(times: Array) -> Array:
    """Return the weights (..., 7) of a divided difference over times (..., 7), scaled to length 1.

    The weighted sum of numbers with independent noise has the same noise as each of them.
    """
    apart = times[..., :, None] - times[..., None, :] + np.eye(STENCIL)
    # Times in units of the mean step keep the products within the range of doubles.
    step = (times[..., -1] - times[..., 0])[..., None, None] / (STENCIL - 1)
    apart = np.where(np.eye(STENCIL, dtype=bool), 1.0, apart / step)
    weights = 1.0 / np.prod(apart, -1)
    return np.asarray(weights / np.linalg.norm(weights, axis=-1, keepdims=True), np.float64)


def noise(time: Array, values: Array) -> Array:
    """Estimate the standard deviation of samples' noise, shape (n,); zero for fewer than seven.

    It is the median of the absolute divided differences of order six, scaled.

    :param time: rising, shape (k,), s.
    :param values: shape (k, n).
    """
    count = len(time) - STENCIL + 1
    if count < 1:
        return np.zeros(values.shape[1])
    left = []
    for first in range(0, count, BLOCK_SAMPLES):
        rows = np.arange(first, min(first + BLOCK_SAMPLES, count))[:, None] + np.arange(STENCIL)
        left.append(np.abs(np.einsum("kp,kpn->kn", difference_weights(time[rows]), values[rows])))
    sizes = np.concatenate(left)
    # Samples of a joint that repeat exactly do not show its noise.
    sizes[sizes <= ROUNDING_NOISE * np.abs(values).max(initial=0.0)] = np.nan
    known = np.isfinite(sizes).any(0)
    found = np.zeros(values.shape[1])
    found[known] = MAD_TO_SIGMA * np.nanmedian(sizes[:, known], 0)
    return found


def velocity_error_bound(time: Array, q: Array, gain: Array | float, stride: int = 2) -> Array:
    """Bound the errors of velocities that were differentiated from positions, shape (k, n).

    The bound is the propagated noise of the positions plus the truncation error: the difference of
    central differences over one step and over ``stride`` steps, for a smooth motion at least twice
    the error of either.

    :param time: rising, shape (k,), s.
    :param q: positions, shape (k, n).
    :param gain: ratio of velocity noise to position noise, 1/s, a number or shape (k, 1).
    :param stride: half-width of the differentiation in steps.
    """
    if len(time) < 3:
        return np.zeros_like(q)
    size = noise(time, q) + ROUNDING_NOISE * np.abs(q).max(0)
    fine = np.gradient(q, time, axis=0, edge_order=2)
    coarse = np.gradient(q, time, axis=0)
    if len(time) >= 3 * stride:
        for k in range(stride):
            part = slice(k, None, stride)
            coarse[part] = np.gradient(q[part], time[part], axis=0, edge_order=2)
    apart = np.abs(fine - coarse)
    seen = apart > SIGMAS * 2.0 * size * gradient_gain(time)
    return np.asarray(SIGMAS * size * gain + np.where(seen, apart, 0.0), np.float64)


def gradient_gain(time: Array) -> Array:
    """Return the noise of second-order differences relative to that of the values, (k, 1), 1/s."""
    steps = np.diff(time)
    inner = math.sqrt(2.0) / (steps[1:] + steps[:-1])
    # One-sided at the ends: weights -3, 4, -1 over two steps.
    ends = math.sqrt(26.0) / 2.0 / steps[[0, -1]]
    return np.concatenate([ends[:1], inner, ends[1:]])[:, None]


def fit_gain(degree: int, window: int, at: int) -> float:
    """Return the noise of a fitted slope relative to that of the values, times the period.

    :param at: sample of the window where the slope is taken, 0 for the oldest.
    """
    powers = np.vander(np.arange(window) - float(at), degree + 1, increasing=True)
    return float(np.linalg.norm(np.linalg.pinv(powers)[1]))


class VelocityErrorEstimator:
    """Bounds the errors of a stream's velocities, sample by sample.

    :param gain: :func:`fit_gain` of the differentiation, for velocities from positions.
    """

    def __init__(self, gain: float) -> None:
        self.gain = gain
        self.reset()

    def reset(self) -> None:
        """Forget the stream."""
        # One more than needed, so that the newest sample can be removed.
        self._samples: deque[tuple[int, list[float]]] = deque(maxlen=STENCIL + 1)
        self._left: deque[list[float]] = deque(maxlen=MEDIAN_WINDOW + 1)
        self._differentiated: bool | None = None

    def retract(self) -> None:
        """Remove the newest sample; possible once after a push."""
        if self._samples:
            self._samples.pop()
        if self._left:
            self._left.pop()

    def push(self, stamp: int, q: Array, measured: Array | None, rate: Array | None) -> Array:
        """Take a sample; return the error bounds of its velocities, shape (n,).

        :param stamp: ns, later than that of the last sample.
        :param q: positions (n,); ``measured``: velocities (n,) if the stream has them.
        :param rate: velocities (n,) that are used; None while there are none.
        """
        differentiated = measured is None
        if differentiated is not self._differentiated:
            self.reset()
            self._differentiated = differentiated
        # Python floats: for arrays this small numpy's calls would take most of the time.
        values: list[float] = (q if measured is None else measured).tolist()
        self._samples.append((stamp, values))
        recent = list(self._samples)[-STENCIL:]
        if len(recent) < STENCIL:
            self._left.append([])
            return np.zeros(len(values))
        first = recent[0][0]
        times = [(sample[0] - first) / SECOND for sample in recent]
        rows = [sample[1] for sample in recent]
        weights = _difference_weights(times)
        columns = list(zip(*rows, strict=True))
        self._left.append([abs(sum(map(mul, weights, column))) for column in columns])
        kept = [left for left in list(self._left)[-MEDIAN_WINDOW:] if left]
        middle = len(kept) // 2
        sizes = [MAD_TO_SIGMA * sorted(left)[middle] for left in zip(*kept, strict=True)]
        if not differentiated or rate is None:
            return SIGMAS * np.array(sizes)
        period = times[-1] / (STENCIL - 1)
        slope = _backward_slope_weights(*times[-3:])
        slack = SIGMAS * math.sqrt(sum(map(mul, slope, slope)))
        doubt = []
        for size, column, given in zip(sizes, columns, rate.tolist(), strict=True):
            size += ROUNDING_NOISE * abs(column[-1])
            # When a motion begins or ends the fit lags behind the slope of three positions.
            apart = abs(given - sum(map(mul, slope, column[-3:])))
            late = apart if apart > slack * size else 0.0
            doubt.append(SIGMAS * size * self.gain / period + late)
        return np.array(doubt)


def _difference_weights(times: list[float]) -> list[float]:
    """Return :func:`difference_weights` of seven times, in Python floats."""
    step = times[-1] / (STENCIL - 1)
    weights = []
    for t in times:
        product = 1.0
        for other in times:
            if other != t:
                product *= (t - other) / step
        weights.append(1.0 / product)
    length = math.sqrt(sum(map(mul, weights, weights)))
    return [weight / length for weight in weights]


def _backward_slope_weights(
    first: float, second: float, third: float
) -> tuple[float, float, float]:
    """Return the weights of a parabola's slope at the third of three times."""
    a, b = third - second, third - first
    return a / (b * (b - a)), -b / (a * (b - a)), (a + b) / (a * b)
