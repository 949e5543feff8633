# SPDX-License-Identifier: Apache-2.0
"""Acceleration of a joint-state stream: Savitzky and Golay's fit, causal, for uneven stamps.

A polynomial of degree ``order`` is fitted to the last ``window`` velocities (or one of degree
``order + 1`` to the positions where the stream carries no velocity) by their own stamps, and
its derivative is taken at the newest sample. A motion whose velocity is a polynomial of that
degree comes out exactly, so the delay is zero for ``order`` 2 and above; ``order`` 1 gives the mean
slope of the window, which is the acceleration half a window ago.

A. Savitzky, M. J. E. Golay, Smoothing and differentiation of data by simplified least squares
procedures, Analytical Chemistry 36 (1964), doi:10.1021/ac60214a047.

May import: numpy, scipy, pkm_twin's core, the standard library.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv  # type: ignore[import-untyped]

from pkm_twin.errors import MessageError
from pkm_twin.ros.messages import SECOND

Array = NDArray[np.float64]

LEAST_PIVOT: Final = 1e-4
"""Least diagonal entry of the normal equations' Cholesky factor; even stamps stay above 1e-2."""


@dataclass
class Differentiator:
    """``order``: degree of the velocity's polynomial; ``window``: samples fitted.

    ``middle``: read the polynomial off at the window's middle sample instead of its newest. That
    is less noisy and half a window late: for recordings, not for control.
    """

    order: int = 2
    window: int = 25
    middle: bool = False
    _carries_velocity: bool | None = None

    def __post_init__(self) -> None:
        # One place more than the window has, so that the newest sample can be taken back; every
        # sample stands twice, so that each window is one piece, oldest first.
        self._places = self.window + 1
        # Since the first sample, ns: whole numbers, exact for a hundred days.
        self._stamps = np.zeros(2 * self._places)
        self._begin = 0
        self._values = np.zeros((2 * self._places, 0))
        self._fits = {carries: _Fit(self.order + (not carries), self.window) for carries in (0, 1)}
        self._count = 0

    @property
    def delay(self) -> float:
        """Delay of the acceleration in samples."""
        if self.order == 1:
            return (self.window - 1) / 2
        return float(self.window - 1 - self.window // 2) if self.middle else 0.0

    def reset(self) -> None:
        """Forget all samples."""
        self._count = 0

    def retract(self) -> None:
        """Take the newest sample back, as if it had not been pushed; once after a push."""
        self._count = max(0, self._count - 1)

    def push(self, stamp: int, q: Array, qd: Array | None) -> tuple[Array, Array] | None:
        """Add a sample with a later stamp (ns); rates and accelerations once the window is full.

        :param q: joint positions, ``qd`` their rates or None, shape (n,).
        :returns: qd and qdd at this stamp (the middle one's, if so set), shape (n,) each, or
            None while samples are missing.
        :raises MessageError: stamps so uneven that they do not tell a polynomial.
        """
        carries = qd is not None
        values = q if qd is None else qd
        if carries is not self._carries_velocity or len(values) != self._values.shape[1]:
            self.reset()
            self._carries_velocity = carries
            self._values = np.zeros((2 * self._places, len(values)))
        if self._count == 0:
            self._begin = stamp
        slot = self._count % self._places
        twin = slot + self._places
        self._stamps[slot] = self._stamps[twin] = stamp - self._begin
        self._values[slot] = self._values[twin] = values
        self._count += 1
        if self._count < self.window:
            return None
        # The window ends at the newest sample's second place, or at its first.
        end = (slot if slot + 1 >= self.window else twin) + 1
        window = slice(end - self.window, end)
        rows = self._values[window]
        at = self.window // 2 if self.middle else self.window - 1
        coefficients, weights, seconds = self._fits[carries].solve(self._stamps[window], rows, at)
        first = weights[0] @ coefficients / seconds
        if qd is None:
            return first, weights[1] @ coefficients / (seconds * seconds)
        return (rows[at].copy() if self.middle else qd), first


class _Fit:
    """A least-squares polynomial of one degree through the samples of one window.

    With t from -1 at the oldest sample to 1 at the newest, so that the normal equations
    V V' c = V y of a degree up to 5 stay far from rounding.
    """

    def __init__(self, degree: int, window: int) -> None:
        self._powers = np.ones((degree + 1, window))
        self._transposed = self._powers.T
        self._times = self._powers[1]
        self._steps = [tuple(self._powers[i : i + 2]) for i in range(1, degree)]
        self._newest = _derivatives(degree, 1.0)

    def solve(self, stamps: Array, values: Array, at: int) -> tuple[Array, Array, float]:
        """The polynomials' coefficients (degree + 1, n) in t, and how to derive them at a sample.

        :returns: coefficients, weights (2, degree + 1) of the first and the second derivative by
            t, and the time that t counts in, s.
        """
        powers, times = self._powers, self._times
        newest = stamps.item(-1)
        half = 0.5 * (newest - stamps.item(0))
        np.subtract(stamps, newest - half, out=times)
        np.divide(times, half, out=times)
        for last, power in self._steps:
            np.multiply(last, times, out=power)
        factor, coefficients, fault = dposv(powers @ self._transposed, powers @ values)
        if fault or not min(factor.item(i, i) for i in range(len(powers))) > LEAST_PIVOT:
            raise MessageError(
                "uneven stamps", "the stamps of the window are too uneven to differentiate"
            )
        last_sample = at == len(times) - 1
        weights = self._newest if last_sample else _derivatives(len(powers) - 1, times.item(at))
        return coefficients, weights, half / SECOND


def _derivatives(degree: int, t: float) -> Array:
    """First and second derivative of the powers of t, shape (2, degree + 1)."""
    k = np.arange(degree + 1)
    return np.array(
        [
            k * t ** np.maximum(k - 1, 0),
            k * (k - 1) * t ** np.maximum(k - 2, 0),
        ]
    )
