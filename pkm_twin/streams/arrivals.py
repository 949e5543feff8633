# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What a controller must notice in a stream of stamped torques. Pure: times are arguments."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from pkm_twin.messages.stamps import SECOND
from pkm_twin.streams.monitor import TopicStatistics


@dataclass
class Arrivals:
    """Ages, silences, losses and faults of a stream, in memory that does not grow.

    ``deadline``, s: a longer silence is an overrun of it, an older message a late one. All other
    times are in ns: ``longest_silence``, ``oldest``, and the sum of the ages, ``ages``.
    """

    deadline: float
    count: int = 0
    longest_silence: int = 0
    silences: int = 0
    """Silences beyond the deadline."""
    ages: int = 0
    oldest: int = 0
    late: int = 0
    """Messages that were older than the deadline when they came."""
    faults: Counter[str] = field(default_factory=Counter)
    topic: TopicStatistics = field(default_factory=TopicStatistics)
    first: int = 0
    last: int = 0
    _last_stamp: int = 0
    _names: frozenset[str] = frozenset()

    def arrived(
        self,
        names: Sequence[str],
        efforts: Sequence[float],
        stamp: int,
        now: int,
        steady: int,
        number: int | None = None,
        sent: int = 0,
    ) -> None:
        """Take one message.

        :param stamp: its own stamp, ns; ``now``: the clock that stamps are by, ns.
        :param steady: the steady clock at its arrival, ns.
        :param number: the publisher's sequence number and ``sent``, its time, by the middleware.
        """
        if self.count:
            self._silence(steady - self.last)
        else:
            self.first = steady
        self.count += 1
        self.last = steady
        age = now - stamp
        self.ages += age
        self.oldest = max(self.oldest, age)
        self.late += age > self.deadline * SECOND
        if self.topic.received(number, sent):
            self.topic.count_missed()
        for fault in self._faults(names, efforts, stamp):
            self.faults[fault] += 1
        self._last_stamp = max(self._last_stamp, stamp)

    def ended(self, steady: int) -> None:
        """The watch is over: what is silent now may have been so for too long."""
        if self.count:
            self._silence(steady - self.last)
            self.last = steady

    def _silence(self, silent: int) -> None:
        self.longest_silence = max(self.longest_silence, silent)
        self.silences += silent > self.deadline * SECOND

    def _faults(self, names: Sequence[str], efforts: Sequence[float], stamp: int) -> list[str]:
        found = []
        if stamp == 0:
            found.append("zero stamp")
        elif stamp <= self._last_stamp:
            found.append("stamp order")
        if not names or len(set(names)) != len(names):
            found.append("names")
        elif len(efforts) != len(names):
            found.append("length")
        if not all(map(math.isfinite, efforts)):
            found.append("not finite")
        if self._names and self._names != frozenset(names):
            found.append("other joints")
        self._names = self._names or frozenset(names)
        return found
