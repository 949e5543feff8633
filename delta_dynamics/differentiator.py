# SPDX-License-Identifier: Apache-2.0
"""Acceleration of a joint-state stream: a causal least-squares polynomial, read off at its end.

A polynomial of degree ``order`` is fitted to the last ``window`` velocities (or one of degree
``order + 1`` to the positions where the stream carries no velocity) by their own stamps, and
its derivative is taken at the newest sample. A motion whose velocity is a polynomial of that
degree comes out exactly, so the delay is zero for ``order`` 2 and above; ``order`` 1 gives the mean
slope of the window, which is the acceleration half a window ago.

May import: numpy, pkm_twin's core, the standard library.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.errors import MessageError
from pkm_twin.messages import SECOND

Array = NDArray[np.float64]

MAX_INVERSE: Final = 1e8
"""Largest entry of the inverse normal equations; even stamps stay below 1e4."""


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
        # Rings: a fit does not ask for the order of its samples.
        self._stamps = np.zeros(self.window, np.int64)
        self._values = np.zeros((self.window, 3))
        self._powers = np.ones((self.window, self.order + 2))
        self._count = 0
        self._ends = [_derivatives(degree, 1.0) for degree in range(self.order + 2)]

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
        # From -1 at the oldest sample to 1 at the newest, so that the normal equations of a
        # degree up to 5 stay far from rounding.
        oldest = self._count % self.window
        half = float(stamp - self._stamps[oldest]) / 2
        degree = self.order if carries else self.order + 1
        powers = self._powers[:, : degree + 1]
        t = powers[:, 1]
        np.divide(self._stamps - stamp, half, out=t)
        t += 1.0
        for k in range(2, degree + 1):
            np.multiply(powers[:, k - 1], t, out=powers[:, k])
        try:
            inverse = np.linalg.inv(powers.T @ powers)
        except np.linalg.LinAlgError:
            inverse = np.full((1, 1), np.inf)
        if not np.abs(inverse).max() < MAX_INVERSE:
            raise MessageError(
                "uneven stamps", "the stamps of the window are too uneven to differentiate"
            )
        c = inverse @ (powers.T @ self._values)
        half /= SECOND
        middle = (oldest + self.window // 2) % self.window
        first, second = self._ends[degree]
        if self.middle:
            first, second = _derivatives(degree, float(t[middle]))
        if qd is None:
            return (first @ c) / half, (second @ c) / half**2
        return self._values[middle].copy() if self.middle else qd, (first @ c) / half


def _derivatives(degree: int, at: float) -> tuple[Array, Array]:
    """What 1, t, t^2 ... contribute to the first and second derivative at ``at``."""
    first = np.array([k * at ** max(k - 1, 0) for k in range(degree + 1)])
    second = np.array([k * (k - 1) * at ** max(k - 2, 0) for k in range(degree + 1)])
    return first, second
