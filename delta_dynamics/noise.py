# SPDX-License-Identifier: Apache-2.0
"""How much what should be zero scatters, learnt while it comes."""

from __future__ import annotations

from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array

AVERAGED: Final = 1.0
"""Time over which the noise is averaged, s."""


class Noise:
    """Variance of errors of mean zero, shape (n,): an average of their squares.

    Once it is settled a square counts up to ``clipped`` times the average: what stands out, and
    lasts, must not become noise.
    """

    def __init__(self, variance: Array, learning: float, clipped: float) -> None:
        """Begin with a variance, shape (n,); it is settled after the time ``learning``, s."""
        self.variance = variance
        self._learning, self._clipped = learning, clipped
        self._time = self._step = 0.0

    @property
    def settled(self) -> bool:
        """Whether there was time to learn."""
        return self._time > self._learning

    def advance(self, step: float) -> None:
        """Time goes on, s, whether the next error counts or not."""
        self._step = step
        self._time += step

    def learn(self, error: Array, least: Array | float) -> None:
        """Take the errors at this time, shape (n,); ``least``: the variance is not below it."""
        square = error**2
        if self.settled:
            square = np.minimum(square, self._clipped * self.variance)
        part = min(1.0, self._step / min(self._time, AVERAGED))
        self.variance = np.maximum(self.variance + part * (square - self.variance), least)
