# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compiled programs on disk, named by digests. An optimisation: without it all works."""

from __future__ import annotations

import fcntl
import hashlib
import json
import logging
import os
import re
import stat
import struct
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

VARIABLE: Final = "PKM_TWIN_CACHE"
"""Names the folder; empty switches the cache off."""
_MARK: Final = b"pkm_twin compiled program 2\n"
_ELF: Final = struct.Struct("<4s36xQ10xHH2x")
"""Magic bytes, then where the table of sections begins, the size of an entry, their number."""
_LARGEST: Final = 64 * 1024 * 1024
MAX_BYTES: Final = 512 * 1024 * 1024
"""Bytes of all programs above which those that were not used for the longest time are deleted."""
LOCK_TIMEOUT: Final = 60.0
"""Seconds to wait for another process that compiles the same program; it may be suspended."""
_LOCK_PERIOD: Final = 0.01
_NAME: Final = re.compile("[0-9a-f]{32,64}")
_LOG: Final = logging.getLogger("pkm_twin")


class _Said:
    once = False


def folder() -> Path | None:
    """The folder of compiled programs, made if it has to be; None where there can be none."""
    named = os.environ.get(VARIABLE)
    if named == "":
        return None
    try:
        base = os.environ.get("XDG_CACHE_HOME")
        place = Path(named or (Path(base) if base else Path.home() / ".cache") / "pkm_twin")
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        # Code of another user's choice must not run.
        if place.stat().st_uid != os.geteuid() or place.stat().st_mode & 0o022:
            raise PermissionError(f"{place} can be written by others")
        if not os.access(place, os.W_OK):
            raise PermissionError(f"{place} is read-only")
    except (OSError, RuntimeError) as error:
        say_once(error)
        return None
    return place


def say_once(error: BaseException) -> None:
    """One line a process: programs are compiled in memory."""
    if not _Said.once:
        _Said.once = True
        text = str(error) or type(error).__name__
        _LOG.warning("compiled programs are not kept: %s; set %s to a folder", text, VARIABLE)


def digest(*parts: str) -> str:
    """Name of what hangs on these texts."""
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]


def read(name: str) -> tuple[dict[str, Any], bytes] | None:
    """Header and code of a stored program; None if there is none, or it must not be run.

    It must be this user's own, whole, and sealed under this very name.
    """
    place = folder()
    if place is None or not _NAME.fullmatch(name):
        return None
    try:
        # A FIFO in its place would wait for a writer, a device never end.
        with open(os.open(place / name, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            if not _own(os.fstat(file.fileno())):
                return None
            data = file.read(_LARGEST)
            # The time of the last use, by which old programs are deleted.
            with suppress(OSError):
                os.utime(file.fileno())
    except OSError:
        return None
    seal = len(_MARK) + 32
    if (
        not data.startswith(_MARK)
        or hashlib.sha256(data[seal:]).digest() != data[len(_MARK) : seal]
    ):
        return None
    head, _, code = data[seal:].partition(b"\n")
    try:
        header = json.loads(head)
    except (ValueError, RecursionError):
        return None
    if not isinstance(header, dict) or header.pop("name", None) != name:
        return None
    return header, code


def _own(status: os.stat_result) -> bool:
    """Whether a file is a regular one that this user alone can have written."""
    return (
        stat.S_ISREG(status.st_mode)
        and status.st_uid == os.geteuid()
        and not status.st_mode & 0o022
    )


def is_object(code: bytes, symbol: str) -> bool:
    """Whether code is an object file with this symbol, none of it missing.

    LLVM's linker ends the process on anything else. On Linux LLVM writes ELF-64 (System V ABI,
    chapter 4) with the table of sections last; elsewhere the name alone is looked for.
    """
    if symbol.encode() not in code or len(code) < _ELF.size:
        return False
    magic, table, size, count = _ELF.unpack_from(code)
    elf = magic == b"\x7fELF" and table + size * count == len(code)
    return bool(elf or sys.platform != "linux")


def write(name: str, header: Mapping[str, Any], code: bytes) -> None:
    """Store a program whole or not at all."""
    place = folder()
    if place is None:
        return
    body = json.dumps({**header, "name": name}).encode() + b"\n" + code
    temporary: str | None = None
    try:
        handle, temporary = tempfile.mkstemp(dir=place)
        with os.fdopen(handle, "wb") as file:
            file.write(_MARK + hashlib.sha256(body).digest() + body)
        os.replace(temporary, place / name)
        _shrink(place)
    except OSError as error:
        say_once(error)
        if temporary is not None:
            with suppress(OSError):
                os.unlink(temporary)


@contextmanager
def alone(name: str) -> Iterator[None]:
    """Keep other processes from compiling the same program meanwhile.

    Where no lock can be had, or another process holds it for :data:`LOCK_TIMEOUT`, go on without.
    """
    place = folder()
    handle = None
    if place is not None:
        with suppress(OSError):
            path = place / f"{name}.lock"
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            end = time.monotonic() + LOCK_TIMEOUT
            while time.monotonic() < end:
                with suppress(BlockingIOError):
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                time.sleep(_LOCK_PERIOD)
    try:
        yield
    finally:
        if handle is not None:
            # A process that waits for the deleted file finds the stored program, as any later one.
            with suppress(OSError):
                os.unlink(path)
            os.close(handle)


def _shrink(place: Path) -> None:
    """Delete what was not used for the longest time, down to half of :data:`MAX_BYTES`."""
    files = []
    with os.scandir(place) as entries:
        for entry in entries:
            with suppress(OSError):
                status = entry.stat(follow_symlinks=False)
                files.append((status.st_mtime_ns, status.st_size, entry.path))
    left = sum(size for _, size, _ in files)
    if left <= MAX_BYTES:
        return
    for _, size, path in sorted(files):
        if left <= MAX_BYTES // 2:
            return
        # Another process may have been faster.
        with suppress(OSError):
            os.unlink(path)
        left -= size
