# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Open and atomically write files that a user names, and parse numbers."""

from __future__ import annotations

import errno
import io
import math
import os
import stat
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO, Final

from pkm_twin.errors import FileError, ParameterError

STANDARD: Final = "-"
"""Name of standard input and output."""
_FILE_KINDS: Final = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a FIFO"),
    (stat.S_ISCHR, "a character device"),
    (stat.S_ISBLK, "a block device"),
    (stat.S_ISSOCK, "a socket"),
)
_temporary_numbers: Final = count()


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file, or a link to one, for reading.

    A FIFO would wait for a writer and a device may never end, so neither is opened.

    :raises OSError: it cannot be opened or is not a regular file; ``strerror`` names its kind.
    """
    _require_regular(os.stat(path).st_mode, path)
    # The file may have been replaced since the check: open without waiting, and check again.
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    try:
        _require_regular(os.fstat(descriptor).st_mode, path)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_bounded(path: Path, most: int, what: str) -> bytes:
    """Read a regular file of bounded size.

    :param most: largest size, bytes. ``what``: description of the expected file, for errors.
    :raises ParameterError: the file cannot be read, or is larger.
    """
    try:
        with open_regular(path) as file:
            content = file.read(most + 1)
    except (OSError, ValueError) as error:
        raise FileError(path, error, what) from None
    if len(content) > most:
        raise ParameterError(str(path), f"{path.stat().st_size} bytes", f"at most {most} bytes")
    return content


def _require_regular(mode: int, path: Path) -> None:
    if not stat.S_ISREG(mode):
        kind = next((name for test, name in _FILE_KINDS if test(mode)), "something else")
        raise OSError(errno.EINVAL, f"it is {kind}, not a regular file", str(path))


def parse_decimal(text: str) -> float:
    """Parse a decimal number; reject forms that only Python has, ``1_0`` and digits of other scripts.

    :raises ValueError: the text is not a number.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"{text!r} is not a number")
    return float(text)


def parse_numbers(text: str) -> list[float]:
    """Parse finite numbers separated by commas; return an empty list for any other text."""
    try:
        numbers = [parse_decimal(word) for word in text.split(",")]
    except ValueError:
        return []
    return numbers if all(map(math.isfinite, numbers)) else []


def require_replaceable(path: Path) -> None:
    """Reject an existing target that is not a regular file or a link to one.

    Opening a FIFO would wait for a reader, and a device must not be replaced.

    :raises OSError: the target cannot be replaced; ``strerror`` says what it is.
    """
    with suppress(FileNotFoundError):
        _require_regular(os.stat(path).st_mode, path)


@contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """Yield a temporary path next to ``path``; rename it to ``path`` if the block succeeds.

    With :data:`STANDARD` the content is written to stdout instead. The temporary name is short, so
    that it is valid in the file system whenever the target's name is.

    :raises OSError: the target is not a regular file, or cannot be written.
    """
    if os.fspath(path) == STANDARD:
        with TemporaryDirectory() as folder:
            hidden = Path(folder) / "out"
            yield hidden
            sys.stdout.buffer.write(hidden.read_bytes())
            sys.stdout.buffer.flush()
        return
    require_replaceable(path)
    hidden = path.with_name(f".{os.getpid()}.{next(_temporary_numbers)}.tmp")
    try:
        yield hidden
        os.replace(hidden, path)
    except OSError as error:
        # Name the target: a failed write has no name, and users do not know the temporary one.
        if error.filename is None or os.fspath(error.filename) == str(hidden):
            raise OSError(error.errno, error.strerror, str(path)) from None
        raise
    finally:
        with suppress(OSError):
            hidden.unlink(missing_ok=True)


def replace_file(path: Path, data: bytes) -> None:
    """Write a small file atomically.

    :raises OSError: the target is not a regular file, or cannot be written.
    """
    with write_atomically(path) as hidden:
        hidden.write_bytes(data)


def replace_files(files: Mapping[Path, bytes]) -> None:
    """Write several small files, replacing no target before all files are complete.

    :raises OSError: as :func:`replace_file`.
    """
    with ExitStack() as stack:
        for path, data in files.items():
            stack.enter_context(write_atomically(path)).write_bytes(data)


def open_standard_streams() -> None:
    """Open those of stdin, stdout and stderr that the parent process closed on the null device.

    Otherwise the next file or socket would get one of their descriptors, and receive printed text.
    Also escapes characters that the terminal's encoding lacks.
    """
    nowhere = os.open(os.devnull, os.O_RDWR)
    while nowhere <= 2:
        nowhere = os.dup(nowhere)
    os.close(nowhere)
    for name, number in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w", encoding="utf-8", closefd=False))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
