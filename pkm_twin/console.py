# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What every command says and reads alike: progress, numbers with commas, JSON, ends of output."""

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
def progress(what: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """Draw a progress bar on stderr, if that is a terminal; yield a function that takes the count.

    The bar has what is left at the first count, so that it knows the time left of resumed work.
    """
    with ExitStack() as stack:
        bar, first = None, 0

        def update(count: int) -> None:
            nonlocal bar, first
            if bar is None and sys.stderr.isatty():
                # Without a length click needs something to iterate over.
                endless = iter(int, 1) if total is None else None
                length, first = None if total is None else total - count, count
                shown = click.progressbar(endless, length, what, show_pos=True, file=sys.stderr)
                bar = stack.enter_context(shown)
            if bar is not None:
                bar.update(count - first - bar.pos)

        yield update


def numbers(text: str, count: int, expected: str = "") -> list[float]:
    """``count`` finite numbers of a command line, with commas between; any count for 0.

    :param expected: what is right, in words; by default that count of numbers.
    """
    values = parse_numbers(text)
    if len(values) != (count or max(len(values), 1)):
        expected = expected or f"{count or ''} numbers separated by commas".strip()
        raise click.UsageError(f"{text.strip()!r} is not {expected}")
    return values


def print_json(data: Any, *, err: bool = False) -> None:
    """JSON proper: a number that is not finite is a mistake here."""
    click.echo(json.dumps(data, indent=2, allow_nan=False), err=err)


def refuse_existing(path: Path, overwrite: bool, source: Path | None = None) -> None:
    """Refuse a target that is there, a dangling link too, unless it may be replaced.

    What is read from is never replaced, nor is a FIFO, a device or a folder; and a folder that is
    not there is told before the work, not after it.

    :raises PkmTwinError: such a target.
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
def writing(path: Path | None) -> Iterator[None]:
    """Convert errors of the system to one line with the file's name.

    :raises PkmTwinError: in place of any ``OSError``.
    """
    try:
        yield
    except OSError as error:
        raise PkmTwinError(f"cannot write {error.filename or path}: {error.strerror}") from None


def tell(text: str) -> None:
    """One line on stderr, whatever names and values are in it."""
    print(f"pkm-twin: {one_line(text, 2000)}", file=sys.stderr)


def system_error(error: OSError) -> str:
    """Return an error of the system as a line."""
    what = error.strerror or str(error)
    return f"{error.filename}: {what}" if error.filename else what


def flush_output() -> OSError | None:
    """Write out what stdout still holds; what then fails is returned, and can fail no more."""
    try:
        sys.stdout.flush()
    except OSError as error:
        silence_output()
        return error
    return None


def silence_output() -> None:
    """Send what stdout still holds nowhere: the interpreter writes it out once more at its end."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, sys.stdout.fileno())
    os.close(nowhere)
