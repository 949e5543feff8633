# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Input and output that all commands have in common: progress, number lists, JSON, closed output."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import click

from pkm_twin.errors import PkmTwinError, one_line
from pkm_twin.files import STANDARD, parse_numbers, require_replaceable


@contextmanager
def draw_progress(what: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """Draw a progress bar on stderr, if that is a terminal; yield a function that takes the count.

    The bar's length is the work that remains at the first count, so that its estimate of the time is
    also right for resumed work.
    """
    with ExitStack() as stack:
        bar, first = None, 0

        def update_bar(count: int) -> None:
            nonlocal bar, first
            if bar is None and sys.stderr.isatty():
                # Without a length click needs an iterable.
                endless = iter(int, 1) if total is None else None
                length, first = None if total is None else total - count, count
                bar_context = click.progressbar(endless, length, what, show_pos=True, file=sys.stderr)
                bar = stack.enter_context(bar_context)
            if bar is not None:
                bar.update(count - first - bar.pos)

        yield update_bar


def parse_count_of_numbers(text: str, count: int, expected: str = "") -> list[float]:
    """Parse ``count`` finite numbers separated by commas; any count for 0.

    :param expected: description of a valid text, for the error.
    """
    values = parse_numbers(text)
    if len(values) != (count or max(len(values), 1)):
        expected = expected or f"{count or ''} numbers separated by commas".strip()
        raise click.UsageError(f"{text.strip()!r} is not {expected}")
    return values


def print_json(data: Any, *, err: bool = False) -> None:
    """Print data as JSON.

    :raises ValueError: a number is not finite.
    """
    click.echo(json.dumps(data, indent=2, allow_nan=False), err=err)


def reject_existing(path: Path, overwrite: bool, source: Path | None = None) -> None:
    """Reject an existing target, including a dangling link, unless it may be replaced.

    The source, a FIFO, a device or a folder is never replaced. A missing folder is reported here, before the
    computation.

    :raises PkmTwinError: the target cannot or may not be written.
    """
    if str(path) == STANDARD:
        return
    if source is not None and path.exists() and source.exists() and path.samefile(source):
        raise PkmTwinError(f"{path}: target and source are the same file")
    if os.path.lexists(path) and not overwrite:
        raise PkmTwinError(f"{path} exists; use --overwrite to replace it")
    if not path.parent.is_dir():
        raise PkmTwinError(f"{path} cannot be written: there is no folder {path.parent}")
    try:
        require_replaceable(path)
    except OSError as error:
        raise PkmTwinError(f"{path} cannot be written: {error.strerror}") from None


@contextmanager
def convert_write_errors(path: Path | None) -> Iterator[None]:
    """Convert errors of the operating system in the block to one line with the file's name.

    :raises PkmTwinError: in place of any ``OSError``.
    """
    try:
        yield
    except OSError as error:
        raise PkmTwinError(f"cannot write {error.filename or path}: {error.strerror}") from None


def print_message(text: str) -> None:
    """Print a text as one line on stderr, with unprintable characters escaped."""
    print(f"pkm-twin: {one_line(text, 2000)}", file=sys.stderr)


def describe_system_error(error: OSError) -> str:
    """Describe an error of the operating system in one line."""
    what = error.strerror or str(error)
    return f"{error.filename}: {what}" if error.filename else what


def flush_output() -> OSError | None:
    """Flush stdout; in case of an error discard the rest and return the error."""
    try:
        sys.stdout.flush()
    except OSError as error:
        discard_output()
        return error
    return None


def discard_output() -> None:
    """Redirect stdout to the null device, because the interpreter flushes its buffer again at the end."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, sys.stdout.fileno())
    os.close(nowhere)
