# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""How far the rates of joints may be off, so that a joint at rest is known as one.

The sign of a rate is the direction of dry friction, and of a joint at rest it is that of the noise.
So a rate counts as zero where it is below its doubt: what the noise of the positions or velocities
makes of it, and what the differentiation itself is wrong by. The noise is what a divided difference
of order six leaves; of a smooth motion it leaves nothing.

Pure.
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
"""Standard deviations of its noise below which a rate counts as zero."""
POINTS: Final = 7
"""Samples of a divided difference of order six."""
KEPT: Final = 15
"""Differences of a stream whose median is its noise."""
ROBUST: Final = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
BLOCK: Final = 4096


def difference_weights(times: Array) -> Array:
    """Weights (..., 7) of a divided difference over times (..., 7), of unit length.

    Applied to numbers with independent noise they give numbers with the same noise.
    """
    apart = times[..., :, None] - times[..., None, :] + np.eye(POINTS)
    # In units of the step, so that no product leaves the range of numbers.
    step = (times[..., -1] - times[..., 0])[..., None, None] / (POINTS - 1)
    apart = np.where(np.eye(POINTS, dtype=bool), 1.0, apart / step)
    weights = 1.0 / np.prod(apart, -1)
    return np.asarray(weights / np.linalg.norm(weights, axis=-1, keepdims=True), np.float64)


def noise(time: Array, values: Array) -> Array:
    """Standard deviation of the noise of samples, shape (n,); zero for fewer than seven.

    :param time: rising, shape (k,), s.
    :param values: shape (k, n).
    """
    count = len(time) - POINTS + 1
    if count < 1:
        return np.zeros(values.shape[1])
    left = []
    for first in range(0, count, BLOCK):
        rows = np.arange(first, min(first + BLOCK, count))[:, None] + np.arange(POINTS)
        left.append(np.abs(np.einsum("kp,kpn->kn", difference_weights(time[rows]), values[rows])))
    sizes = np.concatenate(left)
    # A joint that stands exactly still says nothing of its noise.
    sizes[sizes <= ROUNDING_NOISE * np.abs(values).max(initial=0.0)] = np.nan
    known = np.isfinite(sizes).any(0)
    found = np.zeros(values.shape[1])
    found[known] = ROBUST * np.nanmedian(sizes[:, known], 0)
    return found


def rate_doubt(time: Array, q: Array, gain: Array | float, stride: int = 2) -> Array:
    """How far differentiated rates may be from the true ones, shape (k, n).

    What the noise of the positions makes of them, and by how much the mean rates over one step and
    over ``stride`` steps differ: of a smooth motion at least twice the error of either.

    :param time: rising, shape (k,), s.
    :param q: positions, shape (k, n).
    :param gain: noise of the rates over that of the positions, 1/s, a number or shape (k, 1).
    :param stride: steps that the differentiation looks to either side.
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
    """Noise of second-order differences over that of the values, shape (k, 1), 1/s."""
    steps = np.diff(time)
    inner = math.sqrt(2.0) / (steps[1:] + steps[:-1])
    # One-sided at the ends: weights -3, 4, -1 over two steps.
    ends = math.sqrt(26.0) / 2.0 / steps[[0, -1]]
    return np.concatenate([ends[:1], inner, ends[1:]])[:, None]


def fit_gain(degree: int, window: int, at: int) -> float:
    """Noise of the slope of a polynomial fit over that of the values, times the period.

    :param at: the sample of the window where the slope is taken, 0 the oldest.
    """
    powers = np.vander(np.arange(window) - float(at), degree + 1, increasing=True)
    return float(np.linalg.norm(np.linalg.pinv(powers)[1]))


class RestWatch:
    """The same of a stream, sample by sample.

    :param gain: of :func:`fit_gain`, for rates that are differentiated from positions.
    """

    def __init__(self, gain: float) -> None:
        self.gain = gain
        self.reset()

    def reset(self) -> None:
        """Forget the stream."""
        # One more, so that the newest can be taken back.
        self._samples: deque[tuple[int, list[float]]] = deque(maxlen=POINTS + 1)
        self._left: deque[list[float]] = deque(maxlen=KEPT + 1)
        self._differentiated: bool | None = None

    def retract(self) -> None:
        """Take the newest sample back, as if it had not been pushed; once after a push."""
        if self._samples:
            self._samples.pop()
        if self._left:
            self._left.pop()

    def push(self, stamp: int, q: Array, measured: Array | None, rate: Array | None) -> Array:
        """Take a sample; how far its rates may be from the true ones, shape (n,).

        :param stamp: of the sample, ns, later than the last one's.
        :param q: positions (n,); ``measured``: their rates where the stream has them.
        :param rate: the rates that are used, (n,); None where there are none yet.
        """
        differentiated = measured is None
        if differentiated is not self._differentiated:
            self.reset()
            self._differentiated = differentiated
        # In plain numbers: of arrays so small the calls would take most of the time.
        values: list[float] = (q if measured is None else measured).tolist()
        self._samples.append((stamp, values))
        recent = list(self._samples)[-POINTS:]
        if len(recent) < POINTS:
            self._left.append([])
            return np.zeros(len(values))
        first = recent[0][0]
        times = [(sample[0] - first) / SECOND for sample in recent]
        rows = [sample[1] for sample in recent]
        weights = _weights(times)
        columns = list(zip(*rows, strict=True))
        self._left.append([abs(sum(map(mul, weights, column))) for column in columns])
        kept = [left for left in list(self._left)[-KEPT:] if left]
        middle = len(kept) // 2
        sizes = [ROBUST * sorted(left)[middle] for left in zip(*kept, strict=True)]
        if not differentiated or rate is None:
            return SIGMAS * np.array(sizes)
        period = times[-1] / (POINTS - 1)
        slope = _backward(*times[-3:])
        slack = SIGMAS * math.sqrt(sum(map(mul, slope, slope)))
        doubt = []
        for size, column, given in zip(sizes, columns, rate.tolist(), strict=True):
            size += ROUNDING_NOISE * abs(column[-1])
            # The fit lags where a motion begins or ends, the last three positions do not.
            apart = abs(given - sum(map(mul, slope, column[-3:])))
            late = apart if apart > slack * size else 0.0
            doubt.append(SIGMAS * size * self.gain / period + late)
        return np.array(doubt)


def _weights(times: list[float]) -> list[float]:
    """As :func:`difference_weights`, of seven times."""
    step = times[-1] / (POINTS - 1)
    weights = []
    for t in times:
        product = 1.0
        for other in times:
            if other != t:
                product *= (t - other) / step
        weights.append(1.0 / product)
    length = math.sqrt(sum(map(mul, weights, weights)))
    return [weight / length for weight in weights]


def _backward(first: float, second: float, third: float) -> tuple[float, float, float]:
    """Weights of the slope at the third time of the parabola through values at three times."""
    a, b = third - second, third - first
    return a / (b * (b - a)), -b / (a * (b - a)), (a + b) / (a * b)
