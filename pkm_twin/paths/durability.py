# SPDX-License-Identifier: Apache-2.0
"""What a load over time does to a part: rainflow cycles, equivalent range, and a bearing's life."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array

MILLION = 1e6


@dataclass(frozen=True, eq=False)
class Cycles:
    """Cycles in the order of counting: ``ranges``, ``means``, ``counts`` of 1 or 0.5, (k,)."""

    ranges: Array
    means: Array
    counts: Array

    def equivalent_range(self, exponent: float) -> float:
        """Range of the one cycle that does the damage of all (Miner's sum, Wöhler's exponent)."""
        return float(np.sum(self.counts * self.ranges**exponent) ** (1.0 / exponent))

    def spectrum(self, classes: int) -> tuple[Array, Array]:
        """Upper ends of so many equal classes of range, and the counts in each."""
        top = float(self.ranges.max(initial=0.0)) or 1.0
        ends = top * np.arange(1, classes + 1) / classes
        place = np.minimum(np.searchsorted(ends, self.ranges * (1.0 - 1e-12)), classes - 1)
        return ends, np.bincount(place, self.counts, classes).astype(np.float64)


def turning_points(values: ArrayLike) -> Array:
    """A load's reversals and its two ends, shape (k,)."""
    y = np.asarray(values, np.float64)
    y = y[np.concatenate([[True], np.diff(y) != 0.0])] if len(y) else y
    inner = np.flatnonzero(np.diff(np.sign(np.diff(y))) != 0.0) + 1
    return y[np.concatenate([[0], inner, [len(y) - 1]])] if len(y) > 1 else y


class Reversals:
    """A load's reversals and its two ends, of blocks one after the other."""

    def __init__(self) -> None:
        self._parts: list[Array] = []
        self._tail: Array = np.empty(0)

    def add(self, values: Array) -> None:
        """The next block, shape (samples,)."""
        points = turning_points(np.concatenate([self._tail, values]))
        # The last point may go on; the one before it is where it comes from.
        self._parts.append(points[:-2])
        self._tail = points[-2:]

    @property
    def values(self) -> Array:
        """All of them, shape (k,)."""
        return np.concatenate([*self._parts, self._tail])


def rainflow(values: ArrayLike) -> Cycles:
    """Rainflow counting, ASTM E1049-85 (2017), section 5.4.4.

    :param values: a load over time, shape (samples,).
    """
    found: list[tuple[float, float, float]] = []
    stack: list[float] = []

    def count(a: float, b: float, much: float) -> None:
        found.append((abs(b - a), (a + b) / 2.0, much))

    for value in turning_points(values).tolist():
        stack.append(value)
        while len(stack) >= 3:
            newest, before = abs(stack[-1] - stack[-2]), abs(stack[-2] - stack[-3])
            if newest < before:
                break
            if len(stack) == 3:
                # The range holds the start: half a cycle, and the start goes on.
                count(stack[0], stack[1], 0.5)
                del stack[0]
            else:
                count(stack[-3], stack[-2], 1.0)
                del stack[-3:-1]
    for a, b in itertools.pairwise(stack):
        count(a, b, 0.5)
    return Cycles(*np.array(found, np.float64).reshape(-1, 3).T)


@dataclass(frozen=True)
class Life:
    """Of a bearing: equivalent load, N; turns of the recording; life in turns and hours.

    Infinite where nothing turns or loads it.
    """

    load: float
    turns: float
    life_turns: float
    life_hours: float


def bearing_life(
    load: ArrayLike, turned: ArrayLike, duration: float, rating: float, exponent: float = 3.0
) -> Life:
    """L10 of a rolling bearing (ISO 281) under a load that varies with how it turns.

    P = (sum F^p dphi / sum dphi)^(1/p), L10 = (C / P)^p million turns. To and fro is turning.

    :param load: equivalent load of the bearing in each interval, shape (k,), N.
    :param turned: angle that it turns in each, shape (k,), rad.
    :param duration: of all, s.
    :param rating: C, basic dynamic load rating, N; ``exponent``: p, 3 of balls, 10/3 of rollers.
    """
    force, angle = np.asarray(load, np.float64), np.abs(np.asarray(turned, np.float64))
    whole = float(angle.sum())
    turns = whole / math.tau
    mean = float(np.sum(force**exponent * angle) / whole) if whole > 0.0 else 0.0
    equivalent = mean ** (1.0 / exponent)
    if not equivalent > 0.0:
        return Life(equivalent, turns, math.inf, math.inf)
    life = MILLION * (rating / equivalent) ** exponent
    return Life(equivalent, turns, life, life / turns * duration / 3600.0)
