# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Drives that are off or braked: efforts that are zero, or do not change, while nothing moves.

The effort of a drive that is off, or behind a closed brake, does not bear the machine. The effort
of a drive that holds it agrees with the model, or at least changes with the noise of its current.

Pure.
"""

from __future__ import annotations

import math
from operator import sub
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array, Mask

FROZEN: Final = 0.1
"""Time without any change of the efforts after which they are no measurement, s."""
COUNT: Final = 10
"""Samples of it at least."""
SAME: Final = 1e-9
"""Change of an effort that is none, as a share of the greatest effort."""
AGREES: Final = 0.05
"""Share of the expected efforts by which efforts that do not change may be off."""
RELEASE: Final = 0.5
"""How long a brake may take to open or close, s."""
STANDING: Final = 0.02
"""Time over which it is averaged whether a joint moves, s: noise moves one now and then."""


class DriveWatch:
    """Whether the efforts of a stream say nothing of what the drives bear.

    ``idle``: of the last sample. ``changes``: how often that began. ``repeated``: samples since the
    efforts changed: what the first of them have said is to be forgotten where ``idle`` begins.
    """

    def __init__(self) -> None:
        self.changes = 0
        self.reset()

    def reset(self) -> None:
        """Forget the stream."""
        self.idle = False
        self._last: tuple[float, list[float]] | None = None
        self._moving = 0.0
        self._frozen, self.repeated = 0.0, 0
        self._released = -math.inf

    def push(self, time: float, still: Mask, effort: Array, expected: Array) -> bool:
        """Take a sample; whether its efforts are to be left out.

        :param time: s, later than the last one's.
        :param still: which joints stand still, shape (n,).
        :param effort: measured, and ``expected`` by the model at rest, shape (n,), N m or N.
        """
        # In plain numbers: of arrays so small the calls would take most of the time.
        efforts: list[float] = effort.tolist()
        greatest = max(map(abs, efforts))
        moves = 0.0 if still.all() else 1.0
        if self._last is None:
            self._moving = moves
        else:
            step = time - self._last[0]
            self._moving += min(1.0, step / STANDING) * (moves - self._moving)
            change = max(map(abs, map(sub, efforts, self._last[1])))
            same = change <= SAME * greatest
            self._frozen = self._frozen + step if same else 0.0
            self.repeated = self.repeated + 1 if same else 0
        self._last = time, efforts
        before, self.idle = self.idle, self._judge(time, efforts, expected, greatest)
        self.changes += self.idle and not before
        return self.idle

    def _judge(self, time: float, efforts: list[float], expected: Array, greatest: float) -> bool:
        if self._moving > 0.5:
            self._released = -math.inf
            return False
        wanted = expected.tolist()
        missed = max(map(abs, map(sub, efforts, wanted)))
        off = missed > AGREES * max(map(abs, wanted))
        frozen = self._frozen >= FROZEN and self.repeated >= COUNT
        if greatest == 0.0 or (frozen and off):
            if off:
                self._released = time
            return True
        # Where a brake opens, or has just closed, it bears a part of what the drive does.
        return off and time - self._released < RELEASE


def idle_samples(time: Array, still: Mask, effort: Array, expected: Array) -> Mask:
    """The samples of a recording whose efforts are to be left out, shape (k,).

    As :class:`DriveWatch` finds them forwards and backwards in time.

    :param time: rising, shape (k,), s; the others (k, n) as of :meth:`DriveWatch.push`.
    """
    found = np.zeros(len(time), np.bool_)
    for order, sign in ((slice(None), 1.0), (slice(None, None, -1), -1.0)):
        watch = DriveWatch()
        rows = zip(sign * time[order], still[order], effort[order], expected[order], strict=True)
        found[order] |= [watch.push(*row) for row in rows]
    return found
