# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Count delays, silences, losses and faults in a stream of stamped torques; times are arguments."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from pkm_twin.messages.stamps import SECOND
from pkm_twin.streams.monitor import TopicStatistics


@dataclass
class Arrivals:
    """Counts of the ages, silences, losses and faults of a stream.

    ``deadline``, s: longer silences and older messages are counted. All other times are in ns:
    ``longest_silence``, ``oldest`` (the largest age), ``ages`` (the sum of all ages), and ``first``
    and ``last`` arrival by the steady clock.
    """

    deadline: float
    count: int = 0
    longest_silence: int = 0
    silences: int = 0
    """Number of silences longer than the deadline."""
    ages: int = 0
    oldest: int = 0
    late: int = 0
    """Number of messages that were older than the deadline when they arrived."""
    faults: Counter[str] = field(default_factory=Counter)
    topic: TopicStatistics = field(default_factory=TopicStatistics)
    first: int = 0
    last: int = 0
    _last_stamp: int = 0
    _names: frozenset[str] = frozenset()

    def count_message(
        self,
        names: Sequence[str],
        efforts: Sequence[float],
        stamp: int,
        now: int,
        steady: int,
        number: int | None = None,
        sent: int = 0,
    ) -> None:
        """Count one message.

        :param stamp: the message's stamp, ns; ``now``: the clock of the stamps, ns.
        :param steady: the steady clock at the arrival, ns.
        :param number: sequence number, and ``sent``: time of sending, ns, by the middleware.
        """
        if self.count:
            self._count_silence(steady - self.last)
        else:
            self.first = steady
        self.count += 1
        self.last = steady
        age = now - stamp
        self.ages += age
        self.oldest = max(self.oldest, age)
        self.late += age > self.deadline * SECOND
        if self.topic.record_message(number, sent):
            self.topic.count_missed()
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
        for fault in found:
            self.faults[fault] += 1
        self._last_stamp = max(self._last_stamp, stamp)

    def end_count(self, steady: int) -> None:
        """End the count; the silence until ``steady``, ns, counts, too."""
        if self.count:
            self._count_silence(steady - self.last)
            self.last = steady

    def _count_silence(self, silent: int) -> None:
        self.longest_silence = max(self.longest_silence, silent)
        self.silences += silent > self.deadline * SECOND
