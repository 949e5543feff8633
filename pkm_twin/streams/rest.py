# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Bound the errors of joint velocities, so that joints at rest are recognised.

The sign of a velocity is the direction of dry friction; for a joint at rest it would be the sign of
the noise. So a velocity counts as zero if it is below its error bound: the noise of positions or
velocities, propagated, plus the truncation error of the differentiation.
"""

from __future__ import annotations

import math
from operator import mul

import numpy as np

from pkm_twin.codegen.arrays import ROUNDING_NOISE, Array
from pkm_twin.streams.noise import SIGMAS, NoiseEstimator, estimate_noise


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
    size = estimate_noise(time, q) + ROUNDING_NOISE * np.abs(q).max(0)
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


class VelocityErrorEstimator:
    """Bounds the errors of a stream's velocities, sample by sample.

    :param gain: :meth:`Differentiator.slope_gain`, for velocities from positions.
    """

    def __init__(self, gain: float) -> None:
        self.gain = gain
        self._noise = NoiseEstimator()
        self._differentiated: bool | None = None

    def reset(self) -> None:
        """Forget the stream."""
        self._noise.reset()

    def retract(self) -> None:
        """Remove the newest sample; possible once after a push."""
        self._noise.retract()

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
        sizes = self._noise.push(stamp, (q if measured is None else measured).tolist())
        if sizes is None:
            return np.zeros(len(q))
        if not differentiated or rate is None:
            return SIGMAS * np.array(sizes)
        times, columns = self._noise.recent()
        period = times[-1] / (len(times) - 1)
        # Weights of a parabola's slope at the last of three times.
        a, b = times[-1] - times[-2], times[-1] - times[-3]
        slope = a / (b * (b - a)), -b / (a * (b - a)), (a + b) / (a * b)
        slack = SIGMAS * math.sqrt(sum(map(mul, slope, slope)))
        bounds = []
        for size, column, given in zip(sizes, columns, rate.tolist(), strict=True):
            size += ROUNDING_NOISE * abs(column[-1])
            # When a motion begins or ends the fit lags behind the slope of three positions.
            apart = abs(given - sum(map(mul, slope, column[-3:])))
            late = apart if apart > slack * size else 0.0
            bounds.append(SIGMAS * size * self.gain / period + late)
        return np.array(bounds)
