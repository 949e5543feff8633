# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Detect drives that are off or braked: efforts that are zero or constant while nothing moves.

The effort of a drive that is off, or behind a closed brake, does not carry the machine. The effort
of a drive that holds the machine agrees with the model, or at least changes with the noise of its
current.
"""

from __future__ import annotations

import math
from operator import sub
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array, Mask

CONSTANT_SAMPLES: Final = 10
"""Fewest samples without a change."""
MAX_RELATIVE_CHANGE: Final = 1e-9
"""Largest change that counts as none, as a fraction of the largest effort."""
MAX_BRAKE_TIME: Final = 0.5
"""Longest time for which a brake opens or closes, s."""


class DriveWatch:
    """Decides for each sample of a stream whether its efforts carry the machine.

    ``idle``: whether those of the last sample do not. ``changes``: how often ``idle`` began.
    ``repeated``: number of samples since the efforts last changed; when ``idle`` begins, estimates
    from these samples are invalid.
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
        """Take a sample; return whether to leave its efforts out.

        :param time: s, later than that of the last sample.
        :param still: which joints stand still, shape (n,).
        :param effort: measured efforts, and ``expected``: efforts of the model at rest, shape (n,),
            N m or N.
        """
        # Python floats: for arrays this small numpy's calls would take most of the time.
        efforts: list[float] = effort.tolist()
        greatest = max(map(abs, efforts))
        moves = 0.0 if still.all() else 1.0
        if self._last is None:
            self._moving = moves
        else:
            step = time - self._last[0]
            # Averaged over 20 ms, since noise occasionally looks like a motion.
            self._moving += min(1.0, step / 0.02) * (moves - self._moving)
            change = max(map(abs, map(sub, efforts, self._last[1])))
            same = change <= MAX_RELATIVE_CHANGE * greatest
            self._frozen = self._frozen + step if same else 0.0
            self.repeated = self.repeated + 1 if same else 0
        self._last = time, efforts
        before = self.idle
        # If the efforts are within 5 % of the model, the drives hold the machine and no brake does, even if
        # the efforts are constant.
        wanted = expected.tolist()
        off = max(map(abs, map(sub, efforts, wanted))) > 0.05 * max(map(abs, wanted))
        frozen = self._frozen >= 0.1 and self.repeated >= CONSTANT_SAMPLES
        if self._moving > 0.5:
            self._released, self.idle = -math.inf, False
        elif greatest == 0.0 or (frozen and off):
            self._released = time if off else self._released
            self.idle = True
        else:
            # While a brake opens or has just closed, it carries a part of the drive's effort.
            self.idle = off and time - self._released < MAX_BRAKE_TIME
        self.changes += self.idle and not before
        return self.idle


def find_idle_samples(time: Array, still: Mask, effort: Array, expected: Array) -> Mask:
    """Find the samples of a recording whose efforts do not carry the machine.

    :class:`DriveWatch` runs over the recording forwards and backwards in time.

    :param time: rising, shape (k,), s; the other arguments as for :meth:`DriveWatch.push`, (k, n).
    :returns: shape (k,).
    """
    found = np.zeros(len(time), np.bool_)
    for order, sign in ((slice(None), 1.0), (slice(None, None, -1), -1.0)):
        watch = DriveWatch()
        rows = zip(sign * time[order], still[order], effort[order], expected[order], strict=True)
        found[order] |= [watch.push(*row) for row in rows]
    return found
