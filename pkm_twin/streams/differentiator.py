# SPDX-License-Identifier: Apache-2.0
"""Acceleration of a joint-state stream: a causal least-squares polynomial, read off at its end.

A polynomial of degree ``order`` is fitted to the last ``window`` velocities (or one of degree
``order + 1`` to the positions where the stream carries no velocity) by their own stamps, and
its derivative is taken at the newest sample. A motion whose velocity is a polynomial of that
degree comes out exactly, so the delay is zero for ``order`` 2 and above; ``order`` 1 gives the mean
slope of the window, which is the acceleration half a window ago.

The fit itself is compiled, as the mechanisms' formulas are.

May import: numpy, pkm_twin's core, the standard library.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.kernels import OK, SINGULAR, Kernel
from pkm_twin.errors import MessageError
from pkm_twin.ros.messages import SECOND

Array = NDArray[np.float64]

MAX_INVERSE: Final = 1e8
"""Largest entry of the inverse normal equations; even stamps stay below 1e4."""
SIZE: Final = 6
"""Coefficients of the highest degree."""
NANOSECONDS: Final = float(SECOND)


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
        # Rings; the fit begins at the oldest sample, so that its bits do not hang on where that is.
        self._stamps = np.zeros(self.window, np.int64)
        self._values = np.zeros((self.window, 3))
        self._flat = self._values.reshape(-1)
        self._ages = np.zeros(self.window)
        self._degree = [np.array([degree, MAX_INVERSE]) for degree in (self.order + 1, self.order)]
        self._count = 0

    @property
    def delay(self) -> float:
        """Delay of the acceleration in samples."""
        return (self.window - 1) / 2 if self.order == 1 or self.middle else 0.0

    def reset(self) -> None:
        """Forget all samples."""
        self._count = 0

    def push(self, stamp: int, q: Array, qd: Array | None) -> tuple[Array, Array] | None:
        """Add a sample with a later stamp (ns); rates and accelerations once the window is full.

        :returns: qd and qdd at this stamp (the middle one's, if so set), shape (3,) each, or
            None while samples are missing.
        :raises MessageError: stamps so uneven that they do not tell a polynomial.
        """
        carries = qd is not None
        if carries is not self._carries_velocity:
            self.reset()
            self._carries_velocity = carries
        slot = self._count % self.window
        self._stamps[slot] = stamp
        self._values[slot] = q if qd is None else qd
        self._count += 1
        if self._count < self.window:
            return None
        oldest = self._count % self.window
        half = float(stamp - self._stamps[oldest]) / 2
        np.subtract(self._stamps, stamp, out=self._ages)
        middle = (oldest + self.window // 2) % self.window
        at = 1.0 + float(self._ages[middle]) / half if self.middle else 1.0
        rates, fault = FIT(
            self._degree[carries], np.array([half, at, oldest]), self._ages, self._flat
        )
        if fault.item(0) != OK:
            raise MessageError(
                "uneven stamps", "the stamps of the window are too uneven to differentiate"
            )
        first, second = rates[:3], rates[3:]
        if qd is None:
            return first, second
        return self._values[middle].copy() if self.middle else qd, first


def _fit(p, head, ages, values, rates, scratch, fault):  # type: ignore[no-untyped-def]
    """First and second derivative (1/s, 1/s2) of a least-squares polynomial through samples.

    ``p``: degree, and the largest entry of the inverse normal equations. ``head``: half the window
    (ns), where to read off, from -1 at the oldest sample to 1 at the newest, so that the normal
    equations of a degree up to 5 stay far from rounding, and the place of the oldest sample.
    ``ages``: stamps less the newest (ns); ``values``: three numbers a sample.
    """
    n = int(p[0]) + 1
    half = head[0]
    oldest = int(head[2])
    # Moments of t, then of t with the values; the normal equations and their inverse.
    moments = 0
    loads = 2 * SIZE
    matrix = loads + 3 * SIZE
    inverse = matrix + SIZE * SIZE
    for k in range(inverse + SIZE * SIZE):
        scratch[k] = 0.0
    for sample in range(len(ages)):
        i = (oldest + sample) % len(ages)
        t = 1.0 + ages[i] / half
        power = 1.0
        for k in range(2 * n - 1):
            scratch[moments + k] += power
            if k < n:
                for j in range(3):
                    scratch[loads + 3 * k + j] += power * values[3 * i + j]
            power *= t
    for i in range(n):
        scratch[inverse + SIZE * i + i] = 1.0
        for j in range(n):
            scratch[matrix + SIZE * i + j] = scratch[moments + i + j]
    # Gauss and Jordan: the matrix is positive definite and needs no pivots.
    for i in range(n):
        pivot = scratch[matrix + SIZE * i + i]
        if not pivot > 0.0:
            fault[0] = SINGULAR
            return
        for j in range(n):
            scratch[matrix + SIZE * i + j] /= pivot
            scratch[inverse + SIZE * i + j] /= pivot
        for k in range(n):
            factor = scratch[matrix + SIZE * k + i]
            if k != i and factor != 0.0:
                for j in range(n):
                    scratch[matrix + SIZE * k + j] -= factor * scratch[matrix + SIZE * i + j]
                    scratch[inverse + SIZE * k + j] -= factor * scratch[inverse + SIZE * i + j]
    for i in range(n):
        for j in range(n):
            if not abs(scratch[inverse + SIZE * i + j]) < p[1]:
                fault[0] = SINGULAR
                return
    seconds = half / NANOSECONDS
    for j in range(3):
        first = 0.0
        second = 0.0
        for i in range(n - 1, 0, -1):
            c = 0.0
            for k in range(n):
                c += scratch[inverse + SIZE * i + k] * scratch[loads + 3 * k + j]
            # Horner: c_1 + 2 c_2 t + 3 c_3 t^2 ... and its derivative.
            second = second * head[1] + first
            first = first * head[1] + i * c
        rates[j] = first / seconds
        rates[3 + j] = second / (seconds * seconds)


FIT: Final = Kernel(_fit, (3, None, None), (6,), 5 * SIZE + 2 * SIZE * SIZE, batches=False)
"""The fit as a kernel, to warm up before live use."""
