# SPDX-License-Identifier: Apache-2.0
"""Which samples of a stream are answered where a rate is the most. Pure: no clock here."""

from __future__ import annotations

SECOND = 10**9


class Pace:
    """At most so many samples a second, by their stamps; 0 is every one.

    A stream that has just this rate is answered whole, however its stamps tremble.
    """

    def __init__(self, rate: float) -> None:
        self._period = round(SECOND / rate) if rate > 0.0 else 0
        self._due = 0

    def reset(self) -> None:
        """The next sample is answered."""
        self._due = 0

    def due(self, stamp: int) -> bool:
        """Whether the sample of a stamp, ns, is to be answered."""
        return stamp >= self._due

    def answered(self, stamp: int) -> None:
        """The sample of this stamp was; later ones are judged by it."""
        if self._period:
            # Behind by less than a period: a silence earns no burst.
            self._due = max(self._due + self._period, stamp + self._period // 4)
