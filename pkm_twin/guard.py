# SPDX-License-Identifier: Apache-2.0
"""Counts what is rejected and latches the stop of a stream. Pure: time is an argument.

May import: the standard library.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field


@dataclass
class Guard:
    """Whether a stream may be answered.

    ``bad_limit`` rejects in a row stop it; a stop holds until ``good_needed`` good samples in
    a row. Both stop reasons and rejects are counted by reason.
    """

    bad_limit: int = 5
    good_needed: int = 5
    accepted: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    stops: Counter[str] = field(default_factory=Counter)
    stopped: bool = False
    reason: str = ""
    text: str = ""
    _bad: int = 0
    _good: int = 0

    def reject(self, reason: str, text: str) -> bool:
        """Count a rejected sample; True where it stops the stream now."""
        self.rejected[reason] += 1
        self.reason, self.text = reason, text
        self._good = 0
        self._bad += 1
        return self._bad >= self.bad_limit and self.stop(reason, text)

    def stop(self, reason: str, text: str) -> bool:
        """Stop the stream; True where it ran until now."""
        self.reason, self.text = reason, text
        self._good = 0
        entered = not self.stopped
        if entered:
            self.stops[reason] += 1
        self.stopped = True
        return entered

    def accept(self) -> bool:
        """Count a good sample; True where it may be answered."""
        self._bad = 0
        if self.stopped:
            self._good += 1
            if self._good < self.good_needed:
                return False
            self.stopped = False
        self.accepted += 1
        return True
