# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Counts what is rejected, lost or late and latches the stop of a stream. Pure: no clock here."""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Final, TypeVar, cast

from pkm_twin.errors import MessageError, label_reason
from pkm_twin.messages.stamps import SECOND

V = TypeVar("V")

MANY: Final = 5
"""Rejects since a stop from which the status has their reason."""
SMOOTHING: Final = 0.1
"""Weight of the newest period in the mean."""


@dataclass
class StreamMonitor:
    """Whether a stream may be answered.

    ``trip_count`` rejects in a row stop it; a stop holds until ``recovery_count`` good samples in
    a row. Both stop reasons and rejects are counted by reason.
    """

    trip_count: int
    recovery_count: int
    accepted: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    stops: Counter[str] = field(default_factory=Counter)
    stopped: bool = False
    reason: str = ""
    text: str = ""
    """Of the stop that holds; without one, of the last reject."""
    _since: tuple[int, str, str] = (0, "", "")
    """Rejects since the stop: how many, and reason and text of the last."""
    _bad: int = 0
    _good: int = 0

    def reject(self, reason: str, text: str) -> bool:
        """Count a rejected sample; True where it stops the stream now."""
        self.rejected[reason] += 1
        if self.stopped:
            self._since = self._since[0] + 1, reason, text
        else:
            self.reason, self.text = reason, text
        self._good = 0
        self._bad += 1
        return self._bad >= self.trip_count and self.stop(reason, text)

    def stop(self, reason: str, text: str) -> bool:
        """Stop the stream; True where it ran until now. What stopped it stays its reason."""
        self._good = 0
        if self.stopped:
            return False
        self.stopped = True
        self.reason, self.text = reason, text
        self._since = 0, "", ""
        self.stops[reason] += 1
        return True

    @property
    def status(self) -> str:
        """Why the stream is stopped, and why messages are rejected since then, where many are."""
        status, (count, reason, text) = label_reason(self.reason, self.text), self._since
        if count >= MANY:
            status += f"; rejected since then: {count}"
            status += "" if reason == self.reason else f", the last: {label_reason(reason, text)}"
        return status

    def accept(self) -> bool:
        """Count a good sample; True where it may be answered."""
        self._bad = 0
        if self.stopped:
            self._good += 1
            if self._good < self.recovery_count:
                return False
            self.stopped = False
        self.accepted += 1
        return True

    def counts(self, what: str, taken: str = "accepted") -> dict[str, object]:
        """Values of a node's diagnostics: how many were taken, and rejected by reason."""
        rejected = {f"{what} rejected: {k}": v for k, v in self.rejected.items()}
        return {f"{what} {taken}": self.accepted, **rejected}

    def resume(self) -> bool:
        """End a stop by hand, however few good samples came; True where there was one."""
        stopped, self.stopped = self.stopped, False
        self._bad = self._good = 0
        return stopped


def finished(steps: Generator[None, None, V]) -> V:
    """What a generator returns, its steps taken at once."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return cast(V, end.value)


def counting() -> StreamMonitor:
    """Counts messages that each stand for themselves: nothing stops them."""
    return StreamMonitor(trip_count=2**62, recovery_count=1)


class Core:
    """What takes messages for a robot, and counts those that it rejects.

    ``last_reject``: why the last one was rejected, of any stream; empty before the first.
    """

    last_reject = ""

    def refuse(self, counts: StreamMonitor, error: MessageError) -> None:
        """Count a message that is rejected."""
        counts.reject(error.reason, str(error))
        self.last_reject = str(error)

    @contextmanager
    def refusing(self, counts: StreamMonitor) -> Iterator[None]:
        """Count the message that is rejected in here."""
        try:
            yield
        except MessageError as error:
            self.refuse(counts, error)
            raise

    @contextmanager
    def taking(self, counts: StreamMonitor) -> Iterator[None]:
        """Count the message that is read in here, as taken or as rejected."""
        with self.refusing(counts):
            yield
        counts.accept()


@dataclass
class TopicStatistics:
    """Whether a topic's messages come whole, and whether they are answered at their pace.

    ``missed``: messages between two that came, by the middleware's own numbers. ``overruns``:
    answers that took longer than the mean time between messages.
    """

    messages: int = 0
    missed: int = 0
    overruns: int = 0
    longest: float = 0.0
    _number: int = 0
    _sent: int = 0
    _period: float = 0.0
    _periods: int = 0
    _missing: int = 0

    def received(self, number: int | None, sent: int) -> bool:
        """Take the number that the publisher gave (None: it gives none) and its time, ns.

        :returns: True where messages are missing before this one. They are counted by
            :meth:`count_missed`: two publishers on one topic look the same.
        """
        period = (sent - self._sent) / 1e9
        if self._sent and period > 0.0:
            self._periods += 1
            # A silence is no period, but a slower stream has to be learned.
            longest = 2.0 * self._period if self._periods > 1 else period
            weight = max(SMOOTHING, 1.0 / self._periods)
            self._period += (min(period, longest) - self._period) * weight
        self.messages += 1
        self._sent = sent
        last, self._number = self._number, number or 0
        self._missing = self._number - last - 1 if last else 0
        return self._missing > 0

    def count_missed(self) -> None:
        """Count what is missing before the newest message."""
        self.missed += self._missing

    def handled(self, took: float) -> None:
        """The newest message took so long to handle, s."""
        self.longest = max(self.longest, took)
        self.overruns += 0.0 < self._period < took


CAUGHT_UP: Final = 0.5
"""Fraction of the longest wait below which a node has caught up: a busy computer lets every message
wait for some milliseconds, and a bound near these would drop all."""
RELIEF: Final = 1.0
"""Time without a dropped message after which an overload is over, s."""


@dataclass
class Backlog:
    """Decides which of the messages that wait for a node are dropped, so that it answers new ones.

    ``every``: the messages are differentiated, so that gaps cost a window: once caught up, all are
    taken again until one waits too long. Otherwise only new ones are taken while the overload
    lasts. Pure: times are arguments.
    """

    every: bool = False
    dropped: int = 0
    longest: float = 0.0
    """Longest wait since :meth:`take_longest`, s."""
    _behind: bool = False
    _last_drop: float = 0.0

    def drop(self, waited: float, max_wait: float, now: float) -> bool:
        """Return whether a message is dropped.

        :param waited: since the middleware received it, s; ``max_wait``: longest wait of a message
            that is answered, s; ``now``: the steady clock, s.
        """
        self.longest = max(self.longest, waited)
        if waited > (CAUGHT_UP * max_wait if self._behind else max_wait):
            self._behind, self._last_drop = True, now
            self.dropped += 1
            return True
        if self.every or now - self._last_drop > RELIEF:
            self._behind = False
        return False

    def take_longest(self) -> float:
        """Return the longest wait since the last call, s."""
        longest, self.longest = self.longest, 0.0
        return longest


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
