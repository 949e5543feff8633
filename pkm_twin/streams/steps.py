# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Find jumps, repeated samples, interleaved publishers and gaps in recorded joint positions.

From one sample to the next a joint moves by its velocity times the period. A move that exceeds what
the velocities on both sides allow is a jump: a wrong sample of an encoder, or a sample of another
publisher. Without measured velocities those of the steps around are used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.streams.noise import SIGMAS, estimate_deviation, estimate_noise, find_differences

STAMP_ERROR: Final = 5e-3
"""Largest error of stamps, s; a joint may be off by this time at its largest velocity."""
MAX_SPEED_RATIO: Final = 2.0
"""Largest mean velocity between two samples relative to the joint's velocity limit."""
MEDIAN_STEPS: Final = 5
"""Number of steps whose median replaces a measured velocity."""
MAX_GAP_PERIODS: Final = 3.5
"""Over a gap of more periods than this only the velocity limits bound a move."""
MIN_JUMPING_FRACTION: Final = 0.02
"""Two publishers are looked for if more than this fraction of the steps jump."""
MIN_PUBLISHER_FRACTION: Final = 0.05
"""Smallest fraction of the samples that a publisher sends."""
LOOKBACK_SAMPLES: Final = 10
"""Among this number of earlier samples one is from the same publisher."""
MOTION_QUANTILE: Final = 0.85
"""The velocity of the motion is this quantile over the samples; higher ones may be jumps."""
ALTERNATING_BLOCK: Final = 16
"""Alternating publishers are looked for in blocks of this number of samples."""
GAP_TOLERANCE: Final = 0.25
"""Largest difference of a gap due to missing samples from a whole number of periods, in periods."""


Numbers = TypeVar("Numbers", float, Array)


def find_max_move(velocity: Numbers, period: Numbers) -> Numbers:
    """Return the farthest that a joint may move between two samples, rad or m.

    :param velocity: the joint's velocity limit.
    :param period: time between the samples' stamps, s.
    """
    return velocity * (MAX_SPEED_RATIO * period + STAMP_ERROR)


@dataclass(frozen=True)
class Steps:
    """Steps between the samples of a recording that are not motions of the machine.

    ``jumps``: which steps jump, shape (k - 1, n). ``sizes``: move of each step beyond what its
    velocities allow. ``publishers``: number of samples of each of two interleaved publishers; empty
    for a single publisher.
    """

    jumps: Mask
    sizes: Array
    publishers: tuple[int, ...]

    @property
    def jump_indices(self) -> list[tuple[int, int]]:
        """Index of the step, and of the joint that jumped farthest, for each jump."""
        rows = np.flatnonzero(self.jumps.any(1))
        return [(int(k), int(np.argmax(self.jumps[k] * self.sizes[k]))) for k in rows]


def find_steps(time: Array, q: Array, qd: Array | None, limit: Sequence[float] | Array | None) -> Steps:
    """Find the steps of a recording that are not motions of the machine.

    :param time: rising, shape (k,), s; q and qd (None if not measured), shape (k, n).
    :param limit: velocity limits, (n,), if known.
    """
    k, n = q.shape
    if k < 2:
        return Steps(np.zeros((0, n), np.bool_), np.zeros((0, n)), ())
    span, move = np.diff(time)[:, None], np.diff(q, axis=0)
    period = float(np.median(span))
    rates = move / span
    low, high = _bound_velocities(qd, rates, period)
    steps = np.abs(move)
    tick = _find_resolution(steps)
    # Each sample's distance to the nearest of those before it: with two publishers one is of the same.
    nearest = steps.copy()
    for lag in range(2, min(LOOKBACK_SAMPLES, k - 1) + 1):
        nearest[lag - 1 :] = np.minimum(nearest[lag - 1 :], np.abs(q[lag:] - q[:-lag]))
    speed = np.quantile(nearest, MOTION_QUANTILE, axis=0) / period
    if qd is not None:
        speed = np.maximum(speed, np.quantile(np.abs(qd), MOTION_QUANTILE, axis=0))
    # The noise of the positions, also with two publishers: the 0.1 quantile of second differences lies
    # within one publisher, without jumps; of |N(0, 1)| it is 0.1257.
    noise = np.full(n, np.inf)
    for lag in (1, 2, 3):
        if k > 2 * lag:
            parts = [find_differences(time[i::lag], q[i::lag], 3) for i in range(lag)]
            noise = np.minimum(noise, np.quantile(np.concatenate(parts), 0.1, axis=0) / 0.1257)
    floor = 2.0 * SIGMAS * np.where(np.isfinite(noise), noise, 0.0) + 2.0 * tick
    off = SIGMAS * float(estimate_deviation(span - period)[0])
    slack = max(min(STAMP_ERROR, period), off) * speed + floor
    near = span[:, 0] <= (MAX_GAP_PERIODS if qd is not None else 1.5) * period
    sizes = np.maximum(np.maximum(move - high * span, low * span - move), 0.0)
    if qd is None and near.any():
        # Also allow the 95 % quantile of these moves: medians over several samples lag behind fast changes
        # of the velocity.
        slack = slack + SIGMAS * np.quantile(sizes[near], 0.95, axis=0)
    sizes = np.where(near[:, None] & (sizes > slack), sizes, 0.0)
    if limit is not None:
        bound = find_max_move(np.asarray(limit, np.float64), span)
        sizes = np.where(steps > bound, np.maximum(sizes, steps), sizes)
    jumps = sizes > 0.0
    publishers: tuple[int, ...] = ()
    if np.mean(jumps.any(1)) > MIN_JUMPING_FRACTION:
        publishers = _count_publisher_samples(q, floor + LOOKBACK_SAMPLES * period * speed)
    if not publishers:
        distance = _find_alternating_tracks(time, q)
        rows = distance.any(1)
        if np.mean(rows) > 2.0 * MIN_PUBLISHER_FRACTION:
            sizes = np.maximum(sizes, distance[1:])
            jumps, publishers = sizes > 0.0, (k - k // 2, k // 2)
    return Steps(jumps, sizes, publishers)


def find_repeats(time: Array, q: Array) -> Mask:
    """Find samples that repeat the sample before although a joint is moving, shape (k,).

    Such samples differ from the cubic through two samples on each side, as the encoder was not read
    at their time. The bound on this difference excludes slow joints of a coarse encoder. More than
    three repeated samples are an encoder that stands still.

    :param time: rising, shape (k,), s; q, shape (k, n).
    """
    found, move = np.zeros(len(q), np.bool_), np.diff(q, axis=0)
    changed = np.concatenate([np.ones_like(q[:1], np.bool_), move != 0.0])
    if changed.all():
        return found
    own = [estimate_noise(time[new], one[new, None])[0] for one, new in zip(q.T, changed.T, strict=True)]
    floor = 2.0 * SIGMAS * np.array(own) + 2.0 * _find_resolution(np.abs(move))
    period = np.median(np.diff(time))
    for count in range(1, min(3, len(move) - 3) + 1):
        around = np.array([0, 1, count + 2, count + 3])
        # Lagrange weights of the cubic at the first repeated sample.
        products = np.prod(count + 1 - around) / (count + 1 - around)
        weights = products / [np.prod([x - y for y in around if y != x]) for x in around]
        same = ~sliding_window_view(changed[2:-2], count, axis=0).any(-1) & changed[1 : -count - 2]
        # The cubic assumes even times: skip samples next to a gap.
        span = time[count + 3 :] - time[: -count - 3]
        rows = np.flatnonzero(same.any(1) & (span < (count + MAX_GAP_PERIODS) * period))
        away = np.abs(np.einsum("p,kpn->kn", weights, q[rows[:, None] + around]) - q[rows + 1])
        for k in rows[(same[rows] & (away > floor)).any(1)]:
            found[k + 2 : k + count + 2] = True
    return found


def find_backlash(q: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return the backlash that shows in each joint's positions, and how often, shape (n,) each; zero without.

    When the load of a joint reverses, backlash between joint and encoder makes the position step by the
    same amount from one sample to the next, up and down in turn. A step b has third differences (halved)
    of b, and -b / 2 on both sides; a motion has none. Backlash has at least four steps, three quarters
    of them opposite to the one before, of sizes within 15 %, above 8 standard deviations of the noise
    (beyond all of 1e9 normal numbers), and above 10 steps of the encoder, whose rounding also alternates.

    :param q: positions at even times, shape (k, n).
    """
    size, count = np.zeros(q.shape[1]), np.zeros(q.shape[1], np.int64)
    if len(q) < 6:
        return size, count
    bent = np.diff(q, 3, axis=0) / -2.0
    floor = 8.0 * estimate_deviation(bent)
    floor = np.maximum(floor, 10.0 * _find_resolution(np.abs(np.diff(q, axis=0))))
    middle, before, after = bent[1:-1], bent[:-2], bent[2:]
    against = np.maximum(np.sign(middle) * before, np.sign(middle) * after)
    sharp = (np.abs(middle) > floor) & (against < -0.25 * np.abs(middle))
    for j in range(q.shape[1]):
        steps = middle[sharp[:, j], j]
        if len(steps) < 4:
            continue
        usual = float(np.median(np.abs(steps)))
        alike = float(np.median(np.abs(np.abs(steps) - usual))) <= 0.15 * usual
        if alike and np.mean(steps[1:] * steps[:-1] < 0.0) >= 0.75:
            size[j], count[j] = usual, len(steps)
    return size, count


def _find_resolution(steps: Array) -> Array:
    """Return the smallest step of each column (the encoder's resolution), (n,); zero without."""
    least = np.where(steps > 0.0, steps, np.inf).min(0)
    return np.where(np.isfinite(least), least, 0.0)


def _bound_velocities(qd: Array | None, rates: Array, period: float) -> tuple[Array, Array]:
    """Return the smallest and the largest velocity around each step, shape (k - 1, n) each."""
    if qd is None:
        # Medians before and after the step exclude the step itself, which may be a jump.
        wide = np.pad(rates, ((MEDIAN_STEPS, MEDIAN_STEPS), (0, 0)), mode="edge")
        around = np.median(sliding_window_view(wide, MEDIAN_STEPS, axis=0), -1)
        before, after = around[: len(rates)], around[MEDIAN_STEPS + 1 :]
        return np.minimum(before, after), np.maximum(before, after)
    # Measured velocities may be 10 ms late.
    reach = min(max(1, round(0.01 / period)), len(qd) - 1)
    wide = np.pad(qd, ((reach - 1, reach - 1), (0, 0)), mode="edge")
    windows = sliding_window_view(wide, 2 * reach, axis=0)
    return windows.min(-1), windows.max(-1)


def _find_alternating_tracks(time: Array, q: Array) -> Array:
    """Return the distance of two tracks between which samples alternate, (k, n); zero elsewhere.

    The difference of each sample from the line through its neighbours, with the sign reversed at
    every other sample, averages to zero for a motion with noise, and to the distance for two
    tracks. Each track contributes up to half of its own move over two samples.
    """
    found = np.zeros_like(q)
    blocks = (len(q) - 2) // ALTERNATING_BLOCK
    if blocks < 1:
        return found
    size = np.max([estimate_noise(time[k::2], q[k::2]) for k in (0, 1)], 0)
    span = np.diff(time)[:, None]
    line = (q[:-2] * span[1:] + q[2:] * span[:-1]) / (span[1:] + span[:-1])
    signs = np.where(np.arange(len(line)) % 2, -1.0, 1.0)[:, None]
    shape = (blocks, ALTERNATING_BLOCK, q.shape[1])
    bent = (signs * (q[1:-1] - line))[: blocks * ALTERNATING_BLOCK].reshape(shape)
    twice = np.abs(q[2:] - q[:-2])
    moved = twice[: blocks * ALTERNATING_BLOCK].reshape(shape).mean(1)
    bent *= np.sign(bent.sum(1, keepdims=True))
    clear = bent > np.maximum(moved + SIGMAS * size, 2.0 * _find_resolution(twice))[:, None]
    # At least three quarters of a block alternate.
    distance = np.where(clear.mean(1) > 0.75, bent.mean(1), 0.0)
    found[1 : blocks * ALTERNATING_BLOCK + 1] = np.repeat(distance, ALTERNATING_BLOCK, 0)
    return found


def _count_publisher_samples(q: Array, slack: Array) -> tuple[int, ...]:
    """Count the samples of two smooth tracks; return nothing if there is only one."""
    scale = 1.0 / np.maximum(slack, 1e-300)
    rows = (q * scale).tolist()
    last, counts, seen, jumps, turns, current = [rows[0]], [1], [0], 0, 0, 0
    for k, row in enumerate(rows[1:], 1):
        far = [max(abs(a - b) for a, b in zip(row, other, strict=True)) for other in last]
        nearest = far.index(min(far))
        if far[nearest] > max(1.0, (k - seen[nearest]) / LOOKBACK_SAMPLES):
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
    if len(counts) < 2 or min(counts) < MIN_PUBLISHER_FRACTION * len(rows) or jumps > MIN_JUMPING_FRACTION * len(rows):
        return ()
    # A publisher with a temporary offset rarely switches between the two sequences of positions; two
    # publishers alternate often.
    if turns < min(counts) / LOOKBACK_SAMPLES:
        return ()
    return tuple(counts)


@dataclass(frozen=True)
class Sampling:
    """Period of a recording, s, its expected and its missing number of samples.

    ``missing`` is None if the samples have no common period.
    """

    period: float
    expected: int
    missing: int | None


def find_sampling(time: Array) -> Sampling:
    """Find the period of the samples and count missing samples.

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
    odd = np.abs(long - np.round(long)) > GAP_TOLERANCE
    if len(long) > 0.1 * len(spans) and odd.mean() > GAP_TOLERANCE:
        return Sampling(float(np.median(spans)), len(time), None)
    expected = int(whole.sum()) + 1
    return Sampling(period, expected, expected - len(time))
