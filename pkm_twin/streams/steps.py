# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Whether joints can have moved as their positions say: jumps, repeats, two publishers, gaps.

From one sample to the next a joint moves by its rate times the period. What it moves farther than
its rates on both sides allow is a jump: a wrong sample of an encoder, or another publisher's. Where
no rates are measured they are those of the steps around.

Pure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.streams.rest import ROBUST, SIGMAS, noise

SLACK: Final = 5e-3
"""By how much stamps may be off, s: at the highest rate a joint may be so far from where it should
be."""
FACTOR: Final = 2.0
"""How many times a joint's velocity limit its mean rate between two samples may be."""
LATE: Final = 0.01
"""By how much measured rates may be late, s."""
AROUND: Final = 5
"""Steps whose median is a rate, where none is measured."""
GAP: Final = 3.5
"""Periods between two samples whose move only the limits bound."""
OFTEN: Final = 0.02
"""Part of the steps that jump from which there may be two publishers."""
PUBLISHER: Final = 0.05
"""Part of the samples that is one publisher's at least."""
BEFORE: Final = 10
"""Samples before, of which one is of the same publisher."""
FEW: Final = 0.85
"""Part of the samples of which the largest rate is the motion's, not that of jumps."""
NEARLY: Final = 0.95
"""Part of the steps whose moves beyond the rates of steps around are the motion's."""
LEAST: Final = 0.1
"""Part of the second differences that are of one publisher's samples and no jump of its own,"""
OF_NOISE: Final = 0.1257 * 6.0**0.5
"""and their quantile of it, over the noise's standard deviation."""
ALTERNATING: Final = 16
"""Samples in a row that alternate between two publishers,"""
ALTERNATING_PART: Final = 0.75
"""and part of them that must."""
AGAIN: Final = 3
"""Samples in a row that may repeat the one before: more are an encoder that stands still."""
MIN_CROSSINGS: Final = 4
"""Crossings of a joint's play that show it: so many equal steps in turn are no chance,"""
CROSSING_SIGMAS: Final = 8.0
"""from so many standard deviations of the other samples on, beyond all of 1e9 normal numbers,"""
CROSSING_TICKS: Final = 10.0
"""and so many steps of the encoder, whose rounding also goes up and down in turn."""
CROSSING_SPREAD: Final = 0.15
"""Median deviation of the crossings' sizes, as a share of their median,"""
CROSSING_TURNS: Final = 0.75
"""and share of them that are against the one before: two within three samples are not seen."""
APART: Final = 0.25
"""By how much of a period a gap may miss a whole number of periods, where samples are missing."""


Numbers = TypeVar("Numbers", float, Array)


def farthest(velocity: Numbers, period: Numbers) -> Numbers:
    """How far a joint may move between two samples by its velocity limit, rad or m.

    :param velocity: the limit; ``period``: between their stamps, s.
    """
    return velocity * (FACTOR * period + SLACK)


@dataclass(frozen=True)
class Steps:
    """Steps between the samples of a recording that are no motion of the machine.

    ``jumps``: shape (k - 1, n). ``sizes``: how much farther each moved than its rates allow.
    ``publishers``: how many samples each of two interleaved publishers sent; empty for one.
    """

    jumps: Mask
    sizes: Array
    publishers: tuple[int, ...]

    @property
    def first(self) -> list[tuple[int, int]]:
        """Step and joint of each jump, the first of every run of steps."""
        rows = np.flatnonzero(self.jumps.any(1))
        return [(int(k), int(np.argmax(self.jumps[k] * self.sizes[k]))) for k in rows]


def steps_of(
    time: Array, q: Array, qd: Array | None, limit: Sequence[float] | Array | None
) -> Steps:
    """Judge the steps of a recording.

    :param time: rising, shape (k,), s; q and qd, where it is measured, shape (k, n).
    :param limit: largest rates, (n,), where they are known.
    """
    k, n = q.shape
    if k < 2:
        return Steps(np.zeros((0, n), np.bool_), np.zeros((0, n)), ())
    span, move = np.diff(time)[:, None], np.diff(q, axis=0)
    period = float(np.median(span))
    rates = move / span
    low, high = _bracket(qd, rates, period)
    steps = np.abs(move)
    tick = _tick(steps)
    speed = np.quantile(_nearest(q), FEW, axis=0) / period
    if qd is not None:
        speed = np.maximum(speed, np.quantile(np.abs(qd), FEW, axis=0))
    floor = 2.0 * SIGMAS * _noise(q) + 2.0 * tick
    off = SIGMAS * ROBUST * float(np.median(np.abs(span - period)))
    slack = max(min(SLACK, period), off) * speed + floor
    near = span[:, 0] <= (GAP if qd is not None else 1.5) * period
    sizes = np.maximum(np.maximum(move - high * span, low * span - move), 0.0)
    if qd is None and near.any():
        # Rates of steps miss what happens within a few steps.
        slack = slack + SIGMAS * np.quantile(sizes[near], NEARLY, axis=0)
    sizes = np.where(near[:, None] & (sizes > slack), sizes, 0.0)
    if limit is not None:
        bound = farthest(np.asarray(limit, np.float64), span)
        sizes = np.where(steps > bound, np.maximum(sizes, steps), sizes)
    jumps = sizes > 0.0
    publishers: tuple[int, ...] = ()
    if np.mean(jumps.any(1)) > OFTEN:
        publishers = _publishers(q, floor + BEFORE * period * speed)
    if not publishers:
        apart = _alternating(time, q)
        rows = apart.any(1)
        if np.mean(rows) > 2.0 * PUBLISHER:
            sizes = np.maximum(sizes, apart[1:])
            jumps, publishers = sizes > 0.0, (k - k // 2, k // 2)
    return Steps(jumps, sizes, publishers)


def repeats_of(time: Array, q: Array) -> Mask:
    """Samples that repeat the one before although a joint moves on, shape (k,).

    Nothing was read at their time: they are off the cubic through two samples on each side. Slow
    joints repeat the numbers of a coarse encoder.

    :param time: rising, shape (k,), s; q, shape (k, n).
    """
    found, move = np.zeros(len(q), np.bool_), np.diff(q, axis=0)
    apart = np.concatenate([np.ones_like(q[:1], np.bool_), move != 0.0])
    if apart.all():
        return found
    own = [noise(time[new], one[new, None])[0] for one, new in zip(q.T, apart.T, strict=True)]
    floor = 2.0 * SIGMAS * np.array(own) + 2.0 * _tick(np.abs(move))
    period = np.median(np.diff(time))
    for count in range(1, min(AGAIN, len(move) - 3) + 1):
        around = np.array([0, 1, count + 2, count + 3])
        apart_from = np.prod(count + 1 - around) / (count + 1 - around)
        weights = apart_from / [np.prod([x - y for y in around if y != x]) for x in around]
        same = ~sliding_window_view(apart[2:-2], count, axis=0).any(-1) & apart[1 : -count - 2]
        # The cubic is through samples at even times: none across a gap.
        span = time[count + 3 :] - time[: -count - 3]
        rows = np.flatnonzero(same.any(1) & (span < (count + GAP) * period))
        away = np.abs(np.einsum("p,kpn->kn", weights, q[rows[:, None] + around]) - q[rows + 1])
        for k in rows[(same[rows] & (away > floor)).any(1)]:
            found[k + 2 : k + count + 2] = True
    return found


def find_play(q: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return the play that a joint crosses in its positions, and how often, shape (n,) each.

    Where the load of a joint turns, play between it and its encoder is a step from one sample to
    the next, up and down in turn, always by the same. A step b has third differences of b, and of
    -b / 2 on both sides of it; a motion has none of both. Zero where there is no play.

    :param q: positions at even times, shape (k, n).
    """
    size, count = np.zeros(q.shape[1]), np.zeros(q.shape[1], np.int64)
    if len(q) < 6:
        return size, count
    bent = np.diff(q, 3, axis=0) / -2.0
    floor = CROSSING_SIGMAS * ROBUST * np.median(np.abs(bent), axis=0)
    floor = np.maximum(floor, CROSSING_TICKS * _tick(np.abs(np.diff(q, axis=0))))
    middle, before, after = bent[1:-1], bent[:-2], bent[2:]
    against = np.maximum(np.sign(middle) * before, np.sign(middle) * after)
    sharp = (np.abs(middle) > floor) & (against < -0.25 * np.abs(middle))
    for j in range(q.shape[1]):
        steps = middle[sharp[:, j], j]
        if len(steps) < MIN_CROSSINGS:
            continue
        usual = float(np.median(np.abs(steps)))
        alike = float(np.median(np.abs(np.abs(steps) - usual))) <= CROSSING_SPREAD * usual
        if alike and np.mean(steps[1:] * steps[:-1] < 0.0) >= CROSSING_TURNS:
            size[j], count[j] = usual, len(steps)
    return size, count


def _tick(steps: Array) -> Array:
    """The least step of each column that is one, (n,); zero where there is none."""
    least = np.where(steps > 0.0, steps, np.inf).min(0)
    return np.where(np.isfinite(least), least, 0.0)


def _nearest(q: Array) -> Array:
    """By how much each sample is apart from the nearest of those before, shape (k - 1, n).

    Of two publishers one of them is the same one's.
    """
    lags = [np.abs(q[lag:] - q[:-lag]) for lag in range(1, min(BEFORE, len(q) - 1) + 1)]
    least = lags[0].copy()
    for lag, apart in enumerate(lags[1:], 1):
        least[lag:] = np.minimum(least[lag:], apart)
    return least


def _noise(q: Array) -> Array:
    """Standard deviation of the positions' noise, (n,), of one publisher or of each of two."""
    found = np.full(q.shape[1], np.inf)
    for lag in (1, 2, 3):
        if len(q) > 2 * lag:
            bent = np.abs(q[2 * lag :] - 2.0 * q[lag:-lag] + q[: -2 * lag])
            found = np.minimum(found, np.quantile(bent, LEAST, axis=0) / OF_NOISE)
    return np.where(np.isfinite(found), found, 0.0)


def _bracket(qd: Array | None, rates: Array, period: float) -> tuple[Array, Array]:
    """Least and greatest rates around each step, shape (k - 1, n) each."""
    if qd is None:
        # Of the steps before and of those after, so that one that jumps is in neither.
        wide = np.pad(rates, ((AROUND, AROUND), (0, 0)), mode="edge")
        around = np.median(sliding_window_view(wide, AROUND, axis=0), -1)
        before, after = around[: len(rates)], around[AROUND + 1 :]
        return np.minimum(before, after), np.maximum(before, after)
    reach = min(max(1, round(LATE / period)), len(qd) - 1)
    wide = np.pad(qd, ((reach - 1, reach - 1), (0, 0)), mode="edge")
    windows = sliding_window_view(wide, 2 * reach, axis=0)
    return windows.min(-1), windows.max(-1)


def _alternating(time: Array, q: Array) -> Array:
    """How far apart two tracks are between which the samples alternate, shape (k, n); else zero.

    Of the difference of each sample from its neighbours' line, with its sign turned at every other
    sample, a motion and its noise leave nothing that lasts. A track that is sampled half as often
    leaves half of its move over two samples.
    """
    found = np.zeros_like(q)
    blocks = (len(q) - 2) // ALTERNATING
    if blocks < 1:
        return found
    size = np.maximum(noise(time[::2], q[::2]), noise(time[1::2], q[1::2]))
    span = np.diff(time)[:, None]
    line = (q[:-2] * span[1:] + q[2:] * span[:-1]) / (span[1:] + span[:-1])
    signs = np.where(np.arange(len(line)) % 2, -1.0, 1.0)[:, None]
    shape = (blocks, ALTERNATING, q.shape[1])
    bent = (signs * (q[1:-1] - line))[: blocks * ALTERNATING].reshape(shape)
    twice = np.abs(q[2:] - q[:-2])
    moved = twice[: blocks * ALTERNATING].reshape(shape).mean(1)
    bent *= np.sign(bent.sum(1, keepdims=True))
    clear = bent > np.maximum(moved + SIGMAS * size, 2.0 * _tick(twice))[:, None]
    apart = np.where(clear.mean(1) > ALTERNATING_PART, bent.mean(1), 0.0)
    found[1 : blocks * ALTERNATING + 1] = np.repeat(apart, ALTERNATING, 0)
    return found


def _publishers(q: Array, slack: Array) -> tuple[int, ...]:
    """Samples of two tracks that are each smooth, where the samples are from two; else nothing."""
    scale = 1.0 / np.maximum(slack, 1e-300)
    rows = (q * scale).tolist()
    last, counts, seen, jumps, turns, current = [rows[0]], [1], [0], 0, 0, 0
    for k, row in enumerate(rows[1:], 1):
        far = [max(abs(a - b) for a, b in zip(row, other, strict=True)) for other in last]
        nearest = far.index(min(far))
        if far[nearest] > max(1.0, (k - seen[nearest]) / BEFORE):
            if len(last) == 1:
                last.append(row)
                counts.append(1)
                seen.append(k)
                continue
            jumps += 1
        turns += nearest != current
        current = nearest
        last[nearest], seen[nearest] = row, k
        counts[nearest] += 1
    if len(counts) < 2 or min(counts) < PUBLISHER * len(rows) or jumps > OFTEN * len(rows):
        return ()
    # A stretch that is off is one publisher's.
    if turns < min(counts) / BEFORE:
        return ()
    return tuple(counts)


@dataclass(frozen=True)
class Sampling:
    """Period of a recording, s, and how many samples are missing of how many that there should be.

    ``missing`` is None where the samples have no common period.
    """

    period: float
    expected: int
    missing: int | None


def sampling_of(time: Array) -> Sampling:
    """The period of the samples and how many are missing.

    :param time: rising, shape (k,), s.
    """
    if len(time) < 2:
        return Sampling(0.0, len(time), 0)
    spans = np.diff(time)
    short = spans[spans <= 1.5 * np.quantile(spans, 0.1)]
    period = float(np.median(short))
    for _ in range(3):
        whole = np.maximum(np.round(spans / period), 1.0)
        period = float(spans.sum() / whole.sum())
    long = spans / period
    long = long[long > 1.5]
    odd = np.abs(long - np.round(long)) > APART
    if len(long) > 0.1 * len(spans) and odd.mean() > APART:
        return Sampling(float(np.median(spans)), len(time), None)
    expected = int(whole.sum()) + 1
    return Sampling(period, expected, expected - len(time))
