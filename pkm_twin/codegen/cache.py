# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Keep compiled programs on disk, named by digests; everything works without the cache, too."""

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

FOLDER_VARIABLE: Final = "PKM_TWIN_CACHE"
"""Environment variable with the cache folder; an empty value turns the cache off."""
MAGIC: Final = b"pkm_twin compiled program 2\n"
_ELF: Final = struct.Struct("<4s36xQ10xHH2x")
"""ELF header: magic bytes, offset of the section table, size of an entry, number of entries."""
MAX_PROGRAM_BYTES: Final = 64 * 1024 * 1024
MAX_BYTES: Final = 512 * 1024 * 1024
"""Size of the cache, bytes, above which the least recently used programs are deleted."""
LOCK_TIMEOUT: Final = 60.0
"""Seconds to wait for another process that compiles the same program; it may be suspended."""
_LOCK_PERIOD: Final = 0.01
_KEY_PATTERN: Final = re.compile("[0-9a-f]{32,64}")
"""File name of a cached program: its hash in hexadecimal."""
_LOG: Final = logging.getLogger("pkm_twin")


class _WarnedOnce:
    once = False


def find_folder() -> Path | None:
    """Return the cache folder, created if needed; None if there is none that is safe and writable."""
    named = os.environ.get(FOLDER_VARIABLE)
    if named == "":
        return None
    try:
        base = os.environ.get("XDG_CACHE_HOME")
        place = Path(named or (Path(base) if base else Path.home() / ".cache") / "pkm_twin")
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        # Do not run code that another user may have stored there.
        if place.stat().st_uid != os.geteuid() or place.stat().st_mode & 0o022:
            raise PermissionError(f"{place} can be written by others")
        if not os.access(place, os.W_OK):
            raise PermissionError(f"{place} is read-only")
    except (OSError, RuntimeError) as error:
        warn_once(error)
        return None
    return place


def warn_once(error: BaseException) -> None:
    """Warn once per process that programs are not cached."""
    if not _WarnedOnce.once:
        _WarnedOnce.once = True
        text = str(error) or type(error).__name__
        _LOG.warning("compiled programs are not kept: %s; set %s to a folder", text, FOLDER_VARIABLE)


def digest(*parts: str) -> str:
    """Return the cache name of an entry that these texts determine."""
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]


def read(name: str) -> tuple[dict[str, Any], bytes] | None:
    """Read the header and code of a stored program; None if there is none that may be run.

    The file must belong to this user, be complete, and carry the checksum of this name.
    """
    place = find_folder()
    if place is None or not _KEY_PATTERN.fullmatch(name):
        return None
    try:
        # Without O_NONBLOCK a FIFO of this name would block until somebody writes to it.
        with open(os.open(place / name, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            if not _is_owned_by_user(os.fstat(file.fileno())):
                return None
            data = file.read(MAX_PROGRAM_BYTES)
            # The modification time is the time of the last use; :func:`_delete_oldest` sorts by it.
            with suppress(OSError):
                os.utime(file.fileno())
    except OSError:
        return None
    seal = len(MAGIC) + 32
    if not data.startswith(MAGIC) or hashlib.sha256(data[seal:]).digest() != data[len(MAGIC) : seal]:
        return None
    head, _, code = data[seal:].partition(b"\n")
    try:
        header = json.loads(head)
    except (ValueError, RecursionError):
        return None
    if not isinstance(header, dict) or header.pop("name", None) != name:
        return None
    return header, code


def _is_owned_by_user(status: os.stat_result) -> bool:
    """Return whether a file is a regular file that only this user can have written."""
    return stat.S_ISREG(status.st_mode) and status.st_uid == os.geteuid() and not status.st_mode & 0o022


def is_object(code: bytes, symbol: str) -> bool:
    """Return whether ``code`` is a complete object file that defines ``symbol``.

    LLVM's linker ends the process on anything else. On Linux LLVM writes ELF-64 (System V ABI,
    chapter 4) with the section table last; elsewhere only the name is looked for.
    """
    if symbol.encode() not in code or len(code) < _ELF.size:
        return False
    magic, table, size, count = _ELF.unpack_from(code)
    elf = magic == b"\x7fELF" and table + size * count == len(code)
    return bool(elf or sys.platform != "linux")


def write(name: str, header: Mapping[str, Any], code: bytes) -> None:
    """Store a program atomically: temporary file, then rename."""
    place = find_folder()
    if place is None:
        return
    body = json.dumps({**header, "name": name}).encode() + b"\n" + code
    temporary: str | None = None
    try:
        handle, temporary = tempfile.mkstemp(dir=place)
        with os.fdopen(handle, "wb") as file:
            file.write(MAGIC + hashlib.sha256(body).digest() + body)
        os.replace(temporary, place / name)
        _delete_oldest(place, len(MAGIC) + 32 + len(body))
    except OSError as error:
        warn_once(error)
        if temporary is not None:
            with suppress(OSError):
                os.unlink(temporary)


@contextmanager
def lock_program(name: str) -> Iterator[None]:
    """Hold the lock of a program, so that no other process compiles it meanwhile.

    Continue without the lock if it cannot be created or is not free within :data:`LOCK_TIMEOUT`.
    """
    place = find_folder()
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
            # A process that waits for this lock, on the deleted file, then finds the stored program.
            with suppress(OSError):
                os.unlink(path)
            os.close(handle)


_known_sizes: Final[dict[Path, int]] = {}
"""Known size of each cache folder, bytes: when this process listed it, plus what it wrote since."""


def _delete_oldest(place: Path, written: int) -> None:
    """Delete the least recently used programs until half of :data:`MAX_BYTES` is left.

    The folder may hold many thousands of files. It is listed at a process's first write, and when the
    size that the process knows is above the limit.
    """
    if place in _known_sizes and _known_sizes[place] + written <= MAX_BYTES:
        _known_sizes[place] += written
        return
    files = []
    with os.scandir(place) as entries:
        for entry in entries:
            with suppress(OSError):
                status = entry.stat(follow_symlinks=False)
                files.append((status.st_mtime_ns, status.st_size, entry.path))
    left = _known_sizes[place] = sum(size for _, size, _ in files)
    if left <= MAX_BYTES:
        return
    for _, size, path in sorted(files):
        if left <= MAX_BYTES // 2:
            return
        # Another process may have deleted the file already.
        with suppress(OSError):
            os.unlink(path)
        left = _known_sizes[place] = left - size
