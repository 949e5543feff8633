# SPDX-License-Identifier: Apache-2.0
"""Ending a process on the first signal: later ones cannot tear its clean-up.

A terminal sends Ctrl-C to every process in it and a launcher sends another, so signals come in
twos and threes.

May import: the standard library.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Final

SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
INTERRUPTED: Final = 130
"""Exit code of a command that was interrupted, as a shell gives it."""


class _Process:
    """A plain flag: a lock would stop a handler that interrupts a handler."""

    ending = False


def ignore_signals() -> None:
    """From here on the process is ending, and no signal can change that."""
    _Process.ending = True
    if threading.current_thread() is threading.main_thread():
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)


@contextmanager
def first_signal(
    raising: Callable[[], BaseException], numbers: Sequence[signal.Signals] = SIGNALS
) -> Iterator[None]:
    """The first signal raises, later ones are ignored; handlers come back where none came.

    Only the main thread can have it so.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(*_: object) -> None:
        ignore_signals()
        raise raising()

    before = [signal.signal(number, end) for number in numbers]
    try:
        yield
    finally:
        if not _Process.ending:
            for number, handler in zip(numbers, before, strict=True):
                signal.signal(number, handler)
