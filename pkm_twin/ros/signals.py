# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""End a process on the first signal, so that later ones do not interrupt its clean-up.

A terminal sends Ctrl-C to every process in it and a launcher sends another, so that several signals
arrive.
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
"""Exit code of an interrupted command, as a shell reports it."""
IGNORE_TIME: Final = 2.0
"""Time after a signal in which others are ignored while the process cleans up, s. It is limited
because an exception that is raised in a callback of a C library is lost."""


class _Process:
    """Hold the process's state without a lock: a handler may interrupt a handler."""

    requested = -float("inf")
    ending = False


def ignore_signals() -> None:
    """Ignore signals from now on: the process is ending."""
    _Process.ending = True
    # Python exits by SIGINT if the last code string that it ran was interrupted, even if caught.
    exec("")  # noqa: S102
    if threading.current_thread() is threading.main_thread():
        for number in (*SIGNALS, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)


@contextmanager
def first_signal(raising: Callable[[], BaseException], numbers: Sequence[signal.Signals] = SIGNALS) -> Iterator[None]:
    """Raise on the first signal and ignore the next ones; restore handlers if none came.

    After a signal the process is ending when the block is left, and signals stay ignored. Only the
    main thread can handle signals.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received = False

    def handle_signal(*_: object) -> None:
        """Record the signal; raise unless another signal was handled less than IGNORE_TIME ago."""
        nonlocal received
        received = True
        now = time.monotonic()
        if now - _Process.requested > IGNORE_TIME:
            _Process.requested = now
            raise raising()

    before = [signal.signal(number, handle_signal) for number in numbers]
    try:
        yield
    finally:
        if received:
            ignore_signals()
        elif not _Process.ending:
            for number, handler in zip(numbers, before, strict=True):
                signal.signal(number, handler)


def leave_at_once() -> None:
    """Exit with 0 on a signal from now on: for imports, which need no clean-up.

    An exception in the middle of an import may be lost, or come out as another one.
    """
    for number in _node_signals():
        signal.signal(number, lambda *_: os._exit(0))


def leave_interrupts_to_launch() -> None:
    """Raise no KeyboardInterrupt in a launch file's function, which a launch service calls.

    A launch service reads SIGINT from a socket that Python always writes to. The exception that
    Python raises as well can interrupt the service between reading the socket and starting the
    shutdown: two signals in a row were lost, and nodes that they had ended were restarted.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, lambda *_: None)


class NodeSignals:
    """Record the signals of a node's process, and raise the first while the node is created.

    The handlers stay the same until the end, so that a signal can never end the process before its
    shutdown. Setting :attr:`raises` changes the phase atomically, because Python delivers signals
    between bytecodes only.
    """

    def __init__(self) -> None:
        self.raises = False
        """True while the first signal raises KeyboardInterrupt, and a later one if that was lost."""
        self.came = False
        for number in _node_signals():
            signal.signal(number, self._handle_signal)

    def _handle_signal(self, *_: object) -> None:
        """Record the signal; raise KeyboardInterrupt while the node is being created."""
        self.came = True
        now = time.monotonic()
        if self.raises and now - _Process.requested > IGNORE_TIME:
            _Process.requested = now
            raise KeyboardInterrupt


def _node_signals() -> list[signal.Signals]:
    """Return the signals that end a node: SIGHUP only if it was not ignored at start."""
    deaf = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [*SIGNALS] if deaf else [*SIGNALS, signal.SIGHUP]
