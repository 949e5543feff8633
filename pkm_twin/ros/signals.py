# SPDX-License-Identifier: Apache-2.0
"""Ending a process on the first signal: the next ones cannot tear its clean-up.

A terminal sends Ctrl-C to every process in it and a launcher sends another, so signals come in
twos and threes.

May import: the standard library.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Final

SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
INTERRUPTED: Final = 130
"""Exit code of a command that was interrupted, as a shell gives it."""
PATIENCE: Final = 2.0
"""How long after a signal others are ignored while the process cleans up, s. Not for ever: an
exception that is raised in a callback of a C library is lost."""


class _Process:
    """Plain values: a lock would stop a handler that interrupts a handler."""

    asked = -float("inf")
    ending = False
    raises = True


def ignore_signals() -> None:
    """From here on the process is ending, and no signal can change that."""
    _Process.ending = True
    # Python ends itself by SIGINT if the last text that it ran was interrupted, caught or not.
    exec("")  # noqa: S102
    if threading.current_thread() is threading.main_thread():
        for number in SIGNALS:
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
        if now - _Process.asked > PATIENCE:
            _Process.asked = now
            if _Process.raises:
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


@contextmanager
def nothing_raised() -> Iterator[None]:
    """Inside :func:`first_signal`: a signal raises nothing here, as something else ends the block.

    An exception in the middle of a library's clean-up is printed there and lost.
    """
    _Process.raises = False
    try:
        yield
    finally:
        _Process.raises = True


@contextmanager
def noted_signals(numbers: Sequence[signal.Signals] = SIGNALS) -> Iterator[Callable[[], bool]]:
    """Signals are noted, and the yielded function says whether one came.

    For loops with something left to do at their end: no exception can come in the middle of a
    library that does not expect one.
    """
    came = False

    def note(*_: object) -> None:
        nonlocal came
        came = True

    before = [signal.signal(number, note) for number in numbers]
    try:
        yield lambda: came
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, signal.SIG_IGN if came else handler)
