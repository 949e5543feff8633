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

from collections import deque
from dataclasses import dataclass, field
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
    _stamps: deque[int] = field(init=False)
    _values: deque[Array] = field(init=False)
    _carries_velocity: bool | None = None

    def __post_init__(self) -> None:
        self._stamps = deque(maxlen=self.window)
        self._values = deque(maxlen=self.window)

    @property
    def delay(self) -> float:
        """Delay of the acceleration in samples."""
        return (self.window - 1) / 2 if self.order == 1 or self.middle else 0.0

    def reset(self) -> None:
        """Forget all samples."""
        self._stamps.clear()
        self._values.clear()

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
        self._stamps.append(stamp)
        self._values.append(q if qd is None else qd)
        if len(self._stamps) < self.window:
            return None
        # From -1 at the oldest sample to 1 at the newest, so that the normal equations of a
        # degree up to 5 stay far from rounding.
        half = (stamp - self._stamps[0]) / (2 * SECOND)
        t = 1.0 - (stamp - np.array(self._stamps, np.int64)) / (half * SECOND)
        degree = self.order if carries else self.order + 1
        powers = t[:, None] ** np.arange(degree + 1)
        try:
            inverse = np.linalg.inv(powers.T @ powers)
        except np.linalg.LinAlgError:
            inverse = np.full((1, 1), np.inf)
        if not np.abs(inverse).max() < MAX_INVERSE:
            raise MessageError(
                "uneven stamps", "the stamps of the window are too uneven to differentiate"
            )
        c = inverse @ (powers.T @ np.array(self._values))
        at = t[self.window // 2] if self.middle else 1.0
        k = np.arange(degree + 1)
        first = k * at ** np.maximum(k - 1, 0)
        if qd is not None:
            return self._values[self.window // 2] if self.middle else qd, (first @ c) / half
        second = k * (k - 1) * at ** np.maximum(k - 2, 0)
        return (first @ c) / half, (second @ c) / half**2
