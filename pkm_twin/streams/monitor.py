# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Count rejected, lost and late messages, and stop a stream after too many of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Final, TypeVar, cast

from pkm_twin.errors import MessageError, label_reason
from pkm_twin.messages.stamps import SECOND

V = TypeVar("V")


@dataclass
class StreamMonitor:
    """Decide whether a stream may be answered.

    ``trip_count`` rejects in a row stop the stream; it resumes after ``recovery_count`` good
    samples in a row. ``rejected`` and ``stops`` are counted by reason. ``reason`` and ``text``
    describe the present stop, otherwise the last reject.
    """

    trip_count: int
    recovery_count: int
    accepted: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    stops: Counter[str] = field(default_factory=Counter)
    stopped: bool = False
    reason: str = ""
    text: str = ""
    _since: tuple[int, str, str] = (0, "", "")
    """Number of rejects since the stop, and reason and text of the last of them."""
    _bad: int = 0
    _good: int = 0

    def reject(self, reason: str, text: str) -> bool:
        """Count a rejected sample; return whether it stops the stream now."""
        self.rejected[reason] += 1
        if self.stopped:
            self._since = self._since[0] + 1, reason, text
        else:
            self.reason, self.text = reason, text
        self._good = 0
        self._bad += 1
        return self._bad >= self.trip_count and self.stop(reason, text)

    def stop(self, reason: str, text: str) -> bool:
        """Stop the stream; return whether it was running. The first reason of a stop stays."""
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
        """Reason of the stop, and of rejects since then if there are many."""
        status, (count, reason, text) = label_reason(self.reason, self.text), self._since
        if count >= 5:  # fewer are stray ones
            status += f"; rejected since then: {count}"
            status += "" if reason == self.reason else f", the last: {label_reason(reason, text)}"
        return status

    def accept(self) -> bool:
        """Count a good sample; return whether it may be answered."""
        self._bad = 0
        if self.stopped:
            self._good += 1
            if self._good < self.recovery_count:
                return False
            self.stopped = False
        self.accepted += 1
        return True

    def counts(self, what: str, taken: str = "accepted") -> dict[str, object]:
        """Return values of a node's diagnostics: accepted messages, and rejected ones by reason."""
        rejected = {f"{what} rejected: {k}": v for k, v in self.rejected.items()}
        return {f"{what} {taken}": self.accepted, **rejected}

    def resume(self) -> str:
        """Resume a stopped stream at once; return the stop's description, empty without a stop."""
        ended = self.status if self.stopped else ""
        self.stopped = False
        self._bad = self._good = 0
        return ended

    @contextmanager
    def reacting(self, react: Callable[[], object]) -> Iterator[None]:
        """Call ``react`` at the end of this block if the stream stopped in it."""
        running = not self.stopped
        try:
            yield
        finally:
            if running and self.stopped:
                react()


def run_to_end(steps: Generator[None, None, V]) -> V:
    """Run a generator to its end and return its result."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return cast(V, end.value)


def make_counter() -> StreamMonitor:
    """Return a monitor of independent messages, which only counts and never stops."""
    return StreamMonitor(trip_count=2**62, recovery_count=1)


class Core:
    """The base class of computations that take messages and count rejected ones.

    ``last_reject``: why the last message of any stream was rejected; empty before the first.
    """

    last_reject = ""

    def count_rejection(self, counts: StreamMonitor, error: MessageError) -> None:
        """Count a rejected message."""
        counts.reject(error.reason, str(error))
        self.last_reject = str(error)

    @contextmanager
    def count_rejections(self, counts: StreamMonitor) -> Iterator[None]:
        """Count a message that is rejected in this block."""
        try:
            yield
        except MessageError as error:
            self.count_rejection(counts, error)
            raise

    @contextmanager
    def taking(self, counts: StreamMonitor) -> Iterator[None]:
        """Count the message that is read in this block, as accepted or as rejected."""
        with self.count_rejections(counts):
            yield
        counts.accept()


@dataclass
class TopicStatistics:
    """Count a topic's lost messages and the answers that took too long.

    ``missed``: lost messages by the middleware's sequence numbers. ``overruns``: answers that took
    longer than the mean time between messages. ``longest``: time of the longest answer, s.
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

    def record_message(self, number: int | None, sent: int) -> bool:
        """Take a message's sequence number (None without one) and its time of sending, ns.

        :returns: whether messages are missing before this one. The caller counts them with
            :meth:`count_missed`, as two publishers on one topic look the same.
        """
        period = (sent - self._sent) / 1e9
        if self._sent and period > 0.0:
            self._periods += 1
            # The bound keeps a silence out of the mean, but lets it follow a slower stream.
            longest = 2.0 * self._period if self._periods > 1 else period
            weight = max(0.1, 1.0 / self._periods)
            self._period += (min(period, longest) - self._period) * weight
        self.messages += 1
        self._sent = sent
        last, self._number = self._number, number or 0
        self._missing = self._number - last - 1 if last else 0
        return self._missing > 0

    def count_missed(self) -> None:
        """Count the messages that are missing before the newest one."""
        self.missed += self._missing

    def record_duration(self, took: float) -> None:
        """Record the time that the newest message took, s."""
        self.longest = max(self.longest, took)
        self.overruns += 0.0 < self._period < took


CAUGHT_UP_FRACTION: Final = 0.5
"""Fraction of the longest wait below which a node has caught up: on a busy computer every message
waits for some milliseconds, so that a smaller bound would drop all."""
RELIEF_TIME: Final = 1.0
"""Time without a dropped message that ends an overload, s."""


@dataclass
class Backlog:
    """Decide which of the messages that wait for a node are dropped, so that it answers new ones.

    ``every``: once the node has caught up, answer all messages again until one waits too long, as
    for messages that are differentiated, where each gap empties the window. Otherwise answer only
    new messages while the overload lasts. Times are arguments.
    """

    every: bool = False
    dropped: int = 0
    longest: float = 0.0
    """Longest wait since :meth:`take_longest`, s."""
    _behind: bool = False
    _last_drop: float = 0.0

    def should_drop(self, waited: float, max_wait: float, now: float) -> bool:
        """Return whether a message is dropped.

        :param waited: since the middleware received it, s; ``max_wait``: longest wait of a message
            that is answered, s; ``now``: the steady clock, s.
        """
        self.longest = max(self.longest, waited)
        if waited > (CAUGHT_UP_FRACTION * max_wait if self._behind else max_wait):
            self._behind, self._last_drop = True, now
            self.dropped += 1
            return True
        if self.every or now - self._last_drop > RELIEF_TIME:
            self._behind = False
        return False

    def take_longest(self) -> float:
        """Return the longest wait since the last call, s."""
        longest, self.longest = self.longest, 0.0
        return longest


class Pace:
    """Thin a stream to a largest rate, Hz, by its stamps; rate 0 passes every sample.

    A stream of exactly this rate passes completely in spite of jitter in its stamps.
    """

    def __init__(self, rate: float) -> None:
        self._period = round(SECOND / rate) if rate > 0.0 else 0
        self._due = 0

    def reset(self) -> None:
        """Let the next sample pass."""
        self._due = 0

    def due(self, stamp: int) -> bool:
        """Return whether the sample with this stamp, ns, passes."""
        return stamp >= self._due

    def answered(self, stamp: int) -> None:
        """Record that the sample with this stamp, ns, was answered."""
        if self._period:
            # Making up for less than a period avoids a burst after a silence.
            self._due = max(self._due + self._period, stamp + self._period // 4)
