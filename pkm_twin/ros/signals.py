# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Ending a process on the first signal: the next ones cannot tear its clean-up.

A terminal sends Ctrl-C to every process in it and a launcher sends another, so signals come in
twos and threes.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Final

SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
INTERRUPTED: Final = 130
"""Exit code of a command that was interrupted, as a shell gives it."""
IGNORE_TIME: Final = 2.0
"""How long after a signal others are ignored while the process cleans up, s. Not for ever: an
exception that is raised in a callback of a C library is lost."""


class _Process:
    """Plain values: a lock would stop a handler that interrupts a handler."""

    asked = -float("inf")
    ending = False


def ignore_signals() -> None:
    """From here on the process is ending, and no signal can change that."""
    _Process.ending = True
    # Python ends itself by SIGINT if the last text that it ran was interrupted, caught or not.
    exec("")  # noqa: S102
    if threading.current_thread() is threading.main_thread():
        for number in (*SIGNALS, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)


@contextmanager
def first_signal(
    raising: Callable[[], BaseException], numbers: Sequence[signal.Signals] = SIGNALS
) -> Iterator[None]:
    """The first signal raises, the next ones are ignored; handlers come back where none came.

    Where one came, the process is ending when the block is left: signals are ignored from there.
    Only the main thread can have it so.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came = False

    def end(*_: object) -> None:
        nonlocal came
        came = True
        now = time.monotonic()
        if now - _Process.requested > IGNORE_TIME:
            _Process.requested = now
            raise raising()

    before = [signal.signal(number, end) for number in numbers]
    try:
        yield
    finally:
        if came:
            ignore_signals()
        elif not _Process.ending:
            for number, handler in zip(numbers, before, strict=True):
                signal.signal(number, handler)


def leave_at_once() -> None:
    """From here on a signal ends the process with 0: for imports, after which nothing is left.

    An exception in the middle of an import may be lost, or come out as another one.
    """
    for number in _node_signals():
        signal.signal(number, lambda *_: os._exit(0))


def leave_interrupts_to_launch() -> None:
    """For a launch file's function, which a running launch service calls: no KeyboardInterrupt.

    A launch service takes SIGINT from a socket that Python writes to in any case. The exception
    that Python raises as well, and that the service ignores, can end the taking between reading
    the socket and beginning the shutdown: of two signals in a row both were lost, and nodes that
    had ended by them were started again.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, lambda *_: None)


class NodeSignals:
    """The signals of a node's process: noted from here to its end, and raised while it is made.

    The handlers stay the same and are never the default ones again: there is no moment at which a
    signal could end the process without its last words. Once one has come, a change of phase is
    the assignment to :attr:`raises`, before which Python delivers none.
    """

    def __init__(self) -> None:
        self.raises = False
        """Whether the first signal raises KeyboardInterrupt; and a later one, if that was lost."""
        self.came = False
        for number in _node_signals():
            signal.signal(number, self._take)

    def _take(self, *_: object) -> None:
        self.came = True
        now = time.monotonic()
        if self.raises and now - _Process.requested > IGNORE_TIME:
            _Process.requested = now
            raise KeyboardInterrupt


def _node_signals() -> list[signal.Signals]:
    """A closed terminal ends a node too, but not one that was started to outlive it."""
    deaf = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [*SIGNALS] if deaf else [*SIGNALS, signal.SIGHUP]
