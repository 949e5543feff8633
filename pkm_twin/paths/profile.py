# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Find the fastest profile along a path within limits, by reachability over a grid.

Between two points of the path the acceleration u is constant, so x = v^2 is linear:
x' = x + 2 h u. Limits hold at both ends of every interval. A pass from the end finds the greatest x
from which the end is still reached; a pass from the beginning then accelerates as much as the
limits allow.

Source: Pham, Pham: A new approach to time-optimal path parameterization based on reachability
analysis, IEEE Transactions on Robotics 34 (2018), with the first-order interpolation scheme.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.paths.constraints import Rows
from pkm_twin.paths.joint_path import Index

Numbers = list[float]


@dataclass(frozen=True)
class IntervalPrograms:
    """Hold the intervals' linear programs in x and x', a list of rows per interval.

    x <= ``most``, and low + slope x <= x' <= high + slope x.
    """

    low: list[Numbers]
    high: list[Numbers]
    slope: list[Numbers]
    most: Numbers

    @classmethod
    def from_rows(cls, p: Array, q: Array, least: Array, greatest: Array, most: Array) -> IntervalPrograms:
        """Convert rows least <= p x + q x' <= greatest, (i, r); ``most`` at the ends, (i + 1,)."""
        # A smaller coefficient is rounding: the row does not bound x'.
        level = np.abs(q) <= 1e-12 * np.abs(p)
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other, slope = least / q, greatest / q, -p / q
            cap = np.where(level & (p != 0.0), np.maximum(least / p, greatest / p), np.inf)
        low = np.where(level, -np.inf, np.minimum(one, other))
        high = np.where(level, np.inf, np.maximum(one, other))
        slope = np.where(level, 0.0, slope)
        most = most.copy()
        most[:-1] = np.minimum(most[:-1], cap.min(1, initial=np.inf))
        return cls(low.tolist(), high.tolist(), slope.tolist(), most.tolist())

    def solve(self) -> Array:
        """Return the largest x at the intervals' ends, shape (i + 1,), from rest to rest."""
        count = len(self.low)
        reachable = [0.0] * (count + 1)
        value = 0.0
        for i in range(count - 1, -1, -1):
            value = reachable[i] = _find_largest_start(self.low[i], self.high[i], self.slope[i], self.most[i], value)
        result = [0.0] * (count + 1)
        value = 0.0
        for i in range(count):
            most = reachable[i + 1]
            for c, d in zip(self.high[i], self.slope[i], strict=True):
                after = c + d * value
                if after < most:
                    most = after
            value = result[i + 1] = max(most, 0.0)
        return np.array(result)


def _find_largest_start(low: Numbers, high: Numbers, slopes: Numbers, x: float, after: float) -> float:
    """Return the largest x (squared path speed) at an interval's start that has a feasible end.

    The end's x' is feasible between its lower and upper lines, and up to ``after``.

    The gap between the largest lower and the smallest upper line on x' is convex in x and open at
    0, so Newton's steps from the right converge to where it closes.
    """
    # Newton's method usually converges in two or three steps.
    for _ in range(50):
        least, rise, most, fall = 0.0, 0.0, after, 0.0
        for c, e, d in zip(low, high, slopes, strict=True):
            shift = d * x
            if c + shift > least:
                least, rise = c + shift, d
            if e + shift < most:
                most, fall = e + shift, d
        gap, closing = least - most, rise - fall
        if gap <= 0.0 or closing <= 0.0:
            return x
        new = x - gap / closing
        if new >= x:
            return x
        if new <= 0.0:
            return 0.0
        x = new
    return x


def make_interval_rows(
    rows: Rows, left: Index, steps: Array, x: Array | None, part: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Return limits at both ends of the intervals, as :meth:`IntervalPrograms.from_rows` takes them.

    Viscous friction is linearised in x about a profile.

    :param x: at the intervals' ends, shape (i + 1,); None leaves viscous friction out.
    :param part: of each interval's limits that is used, shape (i,).
    """
    double = (2.0 * steps)[:, None]
    right = left + 1
    bound = part[:, None]
    # A joint that reverses in an interval has dry friction of both signs there.
    dry = rows.dry[left], rows.dry[right]
    least, greatest = np.minimum(*dry), np.maximum(*dry)
    alphas, betas, lows, highs = [], [], [], []
    for k, end in ((left, slice(None, -1)), (right, slice(1, None))):
        beta, fixed = rows.beta[k], rows.fixed[k]
        if x is not None:
            v = np.sqrt(x)
            # The friction's slope is infinite at rest.
            about = np.maximum(v[end], 0.01 * v.max())[:, None]
            beta = beta + rows.viscous[k] / (2.0 * about)
            fixed = fixed + 0.5 * rows.viscous[k] * about
        alphas.append(rows.alpha[k] / double)
        betas.append(beta)
        # Rest stays feasible when limits are reduced.
        lows.append(np.minimum(-bound - fixed - least, 0.0))
        highs.append(np.maximum(bound - fixed - greatest, 0.0))
    most = np.append(rows.most[left], rows.most[right[-1]])
    # Where two pieces meet, the stricter limit applies.
    most[1:] = np.minimum(most[1:], rows.most[right])
    most[:-1] *= part**2
    most[1:] *= part**2
    (a, a2), (b, b2) = alphas, betas
    return (
        np.concatenate([b - a, -a2], 1),
        np.concatenate([a, b2 + a2], 1),
        np.concatenate(lows, 1),
        np.concatenate(highs, 1),
        most,
    )


def find_fastest_profile(rows: Rows, left: Index, steps: Array, part: Array, about: Array | None = None) -> Array:
    """Find the largest x = v^2 at the intervals' ends, (i + 1,), at rest at both ends.

    :param part: of each interval's limits that is used, shape (i,).
    :param about: a profile close to the result, about which viscous friction is linear first.
    """
    viscous = rows.viscous.any()
    x = about if viscous else None
    # With viscous friction until the speeds change by less than 3e-4.
    for _ in range(8 if viscous else 1):
        before, x = x, IntervalPrograms.from_rows(*make_interval_rows(rows, left, steps, x, part)).solve()
        if before is not None and np.abs(np.sqrt(x) - np.sqrt(before)).max() <= 3e-4 * np.sqrt(x.max()):
            break
    assert x is not None  # noqa: S101  one solution at least
    return x
