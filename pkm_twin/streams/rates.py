# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compare the moves of joints with the integral of their measured velocities.

Positions and velocities of a wrong scale, unit or sign pass every limit, but they do not agree.
Moves are compared over short blocks, so that noise, delayed velocities and lost samples make no
difference.
"""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.messages.stamps import SECOND
from pkm_twin.robot.robot import Robot
from pkm_twin.streams.noise import SIGMAS, estimate_noise
from pkm_twin.streams.steps import MAX_GAP_PERIODS

MIN_BLOCK_NS: Final = SECOND // 20
"""Shortest time over which moves are compared, ns."""
MIN_STEPS: Final = 5
"""Fewest steps between samples in a block."""
STANDSTILL_FRACTION: Final = 0.03
"""Moves below this fraction of the moves by the other signal (position or integrated velocity) count as standstill."""
MAX_MOVE_DIFFERENCE: Final = 0.15
"""Largest RMS difference of a recording's moves by positions and by integrated velocities, relative to the larger."""
MAX_ACCELERATION_ERROR: Final = 0.6
"""Largest relative RMS difference of changes of the velocities. A step of the acceleration between two samples
is up to 0.2 of a block of five steps, and filters delay accelerations; wrong signs, units and zeros leave 1 or more."""
SCALE_TOLERANCE: Final = 0.1
"""Largest relative difference that remains after scaling if a wrong scale is named as the cause."""
MAX_SHORT_RECORDING_SCALE: Final = 2.0
"""Largest ratio of both moves, or of its inverse, in a recording shorter than two blocks. Sampling alone explains
x / tan(x), x half the phase between two samples: 0.6 to 1 if a move over two steps is not below that over one."""


def rms(values: Array) -> Array:
    """Return the root mean square along the first axis."""
    return np.asarray(np.sqrt(np.mean(values**2, 0)), np.float64)


def find_likely_cause(moved: Array, integrated: Array, names: tuple[str, str] = ("position", "velocity")) -> str:
    """Name the likely cause of a difference of both moves, (blocks,); may be empty.

    :param names: of the quantity that moves, and of its rate.
    """
    by_q, by_qd = float(rms(moved)), float(rms(integrated))
    scale = float(np.sum(integrated * moved) / max(np.sum(moved**2), 1e-300))
    if abs(scale + 1.0) < SCALE_TOLERANCE:
        return " (wrong sign?)"
    if rms(integrated - scale * moved) < SCALE_TOLERANCE * by_qd:
        return f" ({scale:.3g} times the rate of the {names[0]}: time stamps, ratio or unit?)"
    if by_qd < STANDSTILL_FRACTION * by_q:
        return f" (the {names[1]} is zero)"
    if by_q < STANDSTILL_FRACTION * by_qd:
        return f" (the {names[0]} stands still: encoder?)"
    return ""


class RateAgreement:
    """Compares the positions of a stream with its velocities.

    ``fault``: description of the joint that disagrees most in the last blocks; empty without one.

    Joints are judged if the root of the sum of their squared moves is at least 0.01 rad, or 0.01 of
    the machine's size; delayed velocities may cause an RMS difference of 0.4 of the moves.

    :param blocks: number of the latest blocks of time that are compared.
    """

    def __init__(self, robot: Robot, blocks: int = 20) -> None:
        self._names, self._count = robot.joint_names, blocks
        sizes = [robot.size if unit == "m" else 1.0 for unit in robot.joint_units]
        # 1 % of the machine's size, or 0.01 rad.
        self._min_move = 0.01 * np.array(sizes)
        self.reset()

    def reset(self) -> None:
        """Forget the stream."""
        self.fault = ""
        self._blocks: deque[tuple[Array, Array]] = deque(maxlen=self._count)
        self._samples: list[tuple[int, Array, Array]] = []
        """Samples of the present block."""

    def push(self, stamp: int, q: Array, qd: Array) -> None:
        """Take a sample, shape (n,) each; its stamp, ns, is later than that of the last sample."""
        self._samples.append((stamp, q, qd))
        if len(self._samples) <= MIN_STEPS or stamp - self._samples[0][0] < MIN_BLOCK_NS:
            return
        stamps, positions, velocities = map(np.array, zip(*self._samples, strict=True))
        self._blocks.extend(zip(*_block_moves(stamps, positions, velocities), strict=True))
        self._samples = self._samples[-1:]
        if len(self._blocks) == self._count:
            self._judge()

    def _judge(self) -> None:
        moved, integrated = np.moveaxis(np.array(self._blocks), 1, 0)
        size = np.maximum(rms(moved), rms(integrated))
        moves = size * np.sqrt(len(moved)) >= self._min_move
        if not moves.any():
            return
        error = np.where(moves, rms(integrated - moved) / np.maximum(size, 1e-300), 0.0)
        j = int(np.argmax(error))
        self.fault = ""
        if error[j] > 0.4:
            cause = find_likely_cause(moved[:, j], integrated[:, j])
            self.fault = (
                f"{self._names[j]}: velocities differ from the rate of the positions by {100 * error[j]:.2g} %{cause}"
            )


def compare_rates(
    robot: Robot,
    stamps: NDArray[np.int64],
    q: Array,
    qd: Array,
    jumps: Mask | None = None,
    most: float = MAX_MOVE_DIFFERENCE,
    names: tuple[str, str] = ("position", "velocity"),
) -> tuple[Array, list[str]]:
    """Compare the velocities of a recording with its positions, or its accelerations with its velocities.

    :param stamps: rising, ns, shape (k,); q and qd, shape (k, n).
    :param jumps: steps that are not motions of the machine, (k - 1, n).
    :param most: largest relative RMS difference. ``names``: of ``q`` and ``qd``, for the descriptions.
    :returns: relative RMS difference of the moves, (n,), empty if the recording is too short; and
        descriptions of the joints that disagree. A recording without two blocks disagrees only by a factor.
    """
    time = 1e-9 * (stamps - stamps[0])
    span = np.diff(time)
    period = float(np.median(span)) if len(span) else 0.0
    gaps, units, step = span > MAX_GAP_PERIODS * period, np.array(robot.joint_units), MIN_STEPS
    breaks = gaps if jumps is None else gaps | jumps.any(1)
    moved, integrated = _block_moves(stamps, q, qd, breaks)
    short = len(moved) < 2
    if short:
        # All steps jump where the times are far too short.
        step = min(MIN_STEPS, max(1, len(span) // 4))
        moved, integrated = _block_moves(stamps, q, qd, gaps, step, 0)
        if len(moved) < 2 or moved.size < 3:
            return np.zeros(0), []
        weights = np.where(units == "m", 1.0 / robot.size, 1.0)
        ours, theirs = moved * weights, integrated * weights
        scale = float(np.sum(theirs * ours) / max(np.sum(ours**2), 1e-300))
        twice = ours[1:] + ours[:-1]
        if (
            not (scale > MAX_SHORT_RECORDING_SCALE or 0.0 < scale < 1.0 / MAX_SHORT_RECORDING_SCALE)
            or np.sum((theirs - scale * ours) ** 2) > SCALE_TOLERANCE**2 * np.sum(theirs**2)
            or np.mean(twice**2) < np.mean(ours**2)
        ):
            return np.zeros(0), []
    # The moves of a joint that hardly moves are noise.
    sizes = np.maximum(rms(moved), rms(integrated))
    floor = np.array([STANDSTILL_FRACTION * sizes[units == unit].max() for unit in units])
    size, width = rms(integrated - moved), step if short else max(MIN_STEPS, 1e-9 * MIN_BLOCK_NS / period)
    q_noise = 2.0 * estimate_noise(time, q)
    noisy = q_noise + np.sqrt(width) * period * estimate_noise(time, qd)
    part = size / np.maximum(np.maximum(sizes, floor), 1e-300)
    bad = (part > most) & (size > SIGMAS * noisy)
    # Velocities of other joints or of several sources look like noise, but noise averages out over the blocks:
    # the factor between both is then 1 within its standard deviation.
    length = np.sqrt(np.sum(moved**2, 0))
    excess = np.abs(np.sum((integrated - moved) * moved, 0)) / np.maximum(length, 1e-300)
    bad |= (excess > np.maximum(most * length, SIGMAS * noisy)) & (rms(moved) > np.maximum(floor, SIGMAS * q_noise))
    return part, [
        f"{robot.joint_names[j]} {100 * part[j]:.3g} %{find_likely_cause(moved[:, j], integrated[:, j], names)}"
        for j in np.flatnonzero(bad)
    ]


def _block_moves(
    stamps: NDArray[np.int64],
    q: Array,
    qd: Array,
    breaks: Mask | None = None,
    steps: int = MIN_STEPS,
    duration: int = MIN_BLOCK_NS,
) -> tuple[Array, Array]:
    """Return the moves of consecutive blocks by positions and by integrated velocities, (blocks, n) each.

    :param breaks: steps over which no block extends, shape (k - 1,); None: none.
    :param steps: fewest steps of a block; ``duration``: shortest duration, ns.
    """
    last = np.append([] if breaks is None else np.flatnonzero(breaks), len(stamps) - 1).astype(int)
    blocks, begin, after = list[tuple[int, int]](), 0, np.searchsorted(stamps, stamps + duration)
    for end in last.tolist():
        while (stop := max(begin + steps, int(after[begin]))) <= end:
            blocks.append((begin, stop))
            begin = stop
        begin = end + 1
    edges = np.array(blocks, np.int64).reshape(-1, 2)
    half = 0.5 * (qd[1:] + qd[:-1]) * (np.diff(stamps) / SECOND)[:, None]
    sums = np.add.reduceat(np.concatenate([half, 0.0 * q[:1]]), edges.ravel())[::2] if blocks else q[:0]
    return q[edges[:, 1]] - q[edges[:, 0]], sums
