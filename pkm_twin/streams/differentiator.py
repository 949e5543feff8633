# SPDX-License-Identifier: Apache-2.0
"""Acceleration of a joint-state stream: Savitzky and Golay's fit, causal, for uneven stamps.

A polynomial of degree ``order`` is fitted to the last ``window`` velocities (or one of degree
``order + 1`` to the positions where the stream carries no velocity) by their own stamps, and
its derivative is taken at the newest sample. A motion whose velocity is a polynomial of that
degree comes out exactly, so the delay is zero for ``order`` 2 and above; ``order`` 1 gives the mean
slope of the window, which is the acceleration half a window ago.

A. Savitzky, M. J. E. Golay, Smoothing and differentiation of data by simplified least squares
procedures, Analytical Chemistry 36 (1964), doi:10.1021/ac60214a047.

May import: numpy, pkm_twin's core, the standard library.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.expressions import Tape, sqrt
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.program import Program
from pkm_twin.errors import MessageError
from pkm_twin.ros.messages import SECOND

Array = NDArray[np.float64]

LEAST_PIVOT: Final = 1e-4
"""Least diagonal entry of the normal equations' Cholesky factor; even stamps stay above 1e-2."""
_NONE: Final = np.zeros(0)


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
        self._values = np.zeros((0, 2 * self._places))
        self._fit: _Fit | None = None
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
        if carries is not self._carries_velocity or len(values) != len(self._values):
            self.reset()
            self._carries_velocity = carries
            self._values = np.zeros((len(values), 2 * self._places))
            self._fit = None
        if self._count == 0:
            self._begin = stamp
        slot = self._count % self._places
        twin = slot + self._places
        self._stamps[slot] = self._stamps[twin] = stamp - self._begin
        self._values[:, slot] = self._values[:, twin] = values
        self._count += 1
        if self._count < self.window:
            return None
        if self._fit is None:
            self._fit = _Fit(self.order + (not carries), self.window, len(values))
        # The window ends at the newest sample's second place, or at its first.
        end = (slot if slot + 1 >= self.window else twin) + 1
        window = slice(end - self.window, end)
        at = self.window // 2 if self.middle else self.window - 1
        first, second = self._fit.derivatives(self._stamps[window], self._values[:, window], at)
        if qd is None:
            return first, second
        return (self._values[:, end - self.window + at].copy() if self.middle else qd), first


class _Fit:
    """A least-squares polynomial of one degree through the samples of one window.

    With t from -1 at the oldest sample to 1 at the newest, so that the normal equations
    V V' c = V y of a degree up to 5 stay far from rounding.
    """

    def __init__(self, degree: int, window: int, joints: int) -> None:
        # Powers of time and the samples' values below each other: one product is all it needs.
        size = degree + 1
        table = np.ones((size + joints, window))
        self._powers, self._values = table[:size], table[size:]
        self._transposed = table.T
        self._times = table[1]
        self._steps = [tuple(table[i : i + 2]) for i in range(1, degree)]
        self._inputs = np.zeros(size * len(table) + 2)
        self._sums = self._inputs[:-2].reshape(size, -1)
        self._kernel = _kernel(degree, joints)
        self._call = self._kernel.first_of_one(_NONE)
        self._joints = joints

    def derivatives(self, stamps: Array, values: Array, at: int) -> tuple[Array, Array]:
        """First and second derivative by time at a sample of the window, shape (n,) each.

        :param stamps: shape (window,), ns; ``values`` shape (n, window).
        :raises MessageError: the stamps are too uneven.
        """
        times, inputs = self._times, self._inputs
        oldest, newest = stamps.item(0), stamps.item(-1)
        middle = oldest + 0.5 * (newest - oldest)
        np.subtract(stamps, middle, out=times)
        for last, power in self._steps:
            np.multiply(last, times, out=power)
        self._values[:] = values
        np.dot(self._powers, self._transposed, out=self._sums)
        inputs[-2] = stamps.item(at) - middle
        inputs[-1] = newest - middle
        result: Any = self._call(inputs)
        if result is None:
            (result,), _ = self._kernel(_NONE, inputs)
        n = self._joints
        if not min(result[2 * n :].tolist()) > LEAST_PIVOT:
            raise MessageError(
                "uneven stamps", "the stamps of the window are too uneven to differentiate"
            )
        return result[:n], result[n : 2 * n]


@cache
def _kernel(degree: int, joints: int) -> Kernel:
    """Sums over a window to derivatives.

    In: products of powers of time with each other and with the values, by row; the time to look
    at and half the window, ns. Out: first and second derivative, by s; the pivots of V V'.
    """
    return Kernel(lambda: _program(degree, joints), f"polynomial fit {degree} {joints}")


def _program(degree: int, joints: int) -> Program:
    tape, size = Tape(), degree + 1
    count = size * (size + joints)
    inputs = tape.inputs("sums", count + 2)
    sums = inputs[:count].reshape(size, size + joints)
    inverse = 1.0 / inputs[-1]
    scales, powers = [tape.constant(1.0)], [tape.constant(1.0)]
    for _ in range(degree):
        scales.append(scales[-1] * inverse)
        powers.append(powers[-1] * (inputs[-2] * inverse))
    factor = np.zeros((size, size), dtype=object)
    for j in range(size):
        for i in range(j, size):
            rest = scales[i] * scales[j] * sums[i, j] - factor[i, :j] @ factor[j, :j]
            factor[i, j] = sqrt(rest) if i == j else rest / factor[j, j]
    rows: list[Any] = []
    for derivative in (1, 2):
        # V V' w = d, by both triangles; then w' V y.
        w = np.zeros(size, dtype=object)
        for k in range(size):
            slope = k if derivative == 1 else k * (k - 1)
            d = float(slope) * powers[k - derivative] if slope else tape.constant(0.0)
            w[k] = (d - factor[k, :k] @ w[:k]) / factor[k, k]
        for k in reversed(range(size)):
            w[k] = (w[k] - factor[k + 1 :, k] @ w[k + 1 :]) / factor[k, k]
        rate = float(SECOND) * inverse
        w = w * scales * (rate if derivative == 1 else rate * rate)
        rows += [w @ sums[:, size + j] for j in range(joints)]
    pivots = [factor[k, k] for k in range(size)]
    outputs = {"result": [tape.lift(value) for value in [*rows, *pivots]]}
    return Program({"sums": len(inputs)}, 0, outputs)
