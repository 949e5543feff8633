# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Find the files of a bag: one MCAP file, or a rosbag2 folder. Imports no ROS.

rosbag2 writes a folder with ``metadata.yaml`` and one or more MCAP files (splits), each of which it
may have packed with zstd as a whole (``.mcap.zstd``).
"""

from __future__ import annotations

import os
import shlex
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import IO, Final

import zstandard

from pkm_twin.bags.format import ZSTD_MAGIC, Budget, FormatError, RecordReader
from pkm_twin.bags.qos import load_plain
from pkm_twin.errors import BagError
from pkm_twin.files import STANDARD, open_regular

METADATA_FILE: Final = "metadata.yaml"
MAX_METADATA_BYTES: Final = 4 * 1024**2
"""Largest ``metadata.yaml`` that is read; one of a hundred topics has some 60 kB."""
SQLITE_MAGIC: Final = b"SQLite format 3\x00"


class BagFile:
    """An MCAP file; one that is compressed as a whole is decompressed into a temporary file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @contextmanager
    def open(self) -> Iterator[RecordReader]:
        """Open the file for reading.

        :raises BagError: it cannot be opened or read, or is an SQLite bag.
        """
        try:
            with open_regular(self.path) as file:
                size = os.fstat(file.fileno()).st_size
                head = os.pread(file.fileno(), len(SQLITE_MAGIC), 0)
                if head == SQLITE_MAGIC:
                    text = f"is an SQLite bag, not MCAP; {conversion_command(self.path)} converts it"
                    raise BagError(text, path=self.path, reason="not_mcap")
                if not head.startswith(ZSTD_MAGIC):
                    yield RecordReader(file)
                    return
            # Limit the unpacked size by the size on the disk.
            yield RecordReader(self._unpacked, Budget(size))
        except FileNotFoundError as error:
            text = "no such file; expected an MCAP file or a rosbag2 folder"
            raise BagError(text, path=self.path, reason="not_found") from error
        except OSError as error:
            text = f"cannot be read: {error.strerror or error}"
            raise BagError(text, path=self.path, reason="io") from error

    @cached_property
    def _unpacked(self) -> IO[bytes]:
        """The decompressed file, which ends where the data can no longer be decompressed."""
        # The temporary file is deleted when it is closed with its bag.
        target = tempfile.TemporaryFile()  # noqa: SIM115
        with open_regular(self.path) as file:
            budget = Budget(os.fstat(file.fileno()).st_size)
            unpacker = zstandard.ZstdDecompressor()
            with unpacker.stream_reader(file, read_across_frames=True) as source:
                try:
                    while block := source.read(1024**2):
                        budget.spend(len(block), None)
                        target.write(block)
                except zstandard.ZstdError:
                    pass
                except FormatError as error:
                    raise BagError(error.text, path=self.path, reason=error.reason) from None
        target.flush()
        return target


@dataclass(frozen=True)
class Storage:
    """The files of a bag in order, and the message counts that its folder states.

    ``message_count``: of all files, None if it is not stated. ``by_topic``, ``by_file``: counts by name.
    """

    files: tuple[BagFile, ...]
    message_count: int | None = None
    by_topic: Mapping[str, int] = field(default_factory=dict)
    by_file: Mapping[str, int] = field(default_factory=dict)


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag: a folder, or a file with the name or the first bytes of one.

    :raises OSError: the file exists, but cannot be opened or is not a regular file.
    """
    if str(path) == STANDARD:
        return False
    suffixes = {suffix.lower() for suffix in path.suffixes}
    if os.path.isdir(path) or suffixes & {".mcap", ".db3"}:
        return True
    with open_regular(path) as file:
        head = file.read(len(SQLITE_MAGIC))
    return head == SQLITE_MAGIC or head.startswith((b"\x89MCAP", ZSTD_MAGIC))


def find_storage(path: Path) -> Storage:
    """Return the files of a bag: the file itself, or those that a folder's metadata name.

    :raises BagError: a folder without ``metadata.yaml``, or one that is not plain, names files
        outside the folder, or has another storage than MCAP.
    """
    # Unlike Path.is_dir these never raise, so that errors are reported when the file is opened.
    if not os.path.isdir(path):
        return Storage((BagFile(path),))
    file = path / METADATA_FILE
    if not os.path.lexists(file):
        inside = ", ".join(p.name for p in list_files(path)) or "no .mcap file"
        text = f"is a folder without {METADATA_FILE}: no rosbag2 bag; name a file in it: {inside}"
        raise BagError(text, path=path, reason="folder")
    facts = _MetadataValue(file, "", _load_metadata(file)).get("rosbag2_bagfile_information")
    storage = facts.get("storage_identifier")
    if storage.text() == "sqlite3":
        text = f"is an SQLite bag, not MCAP; {conversion_command(path)} converts it"
        raise BagError(text, path=path, reason="not_mcap")
    # `ros2 bag reindex` leaves the identifier empty; opening the files then shows their kind.
    if storage.text() != "mcap" and storage.value != "":
        raise storage.error("'mcap'")
    packing = facts.get("compression_format")
    if packing.text().lower() not in ("", "none", "zstd"):
        raise packing.error("'zstd' or ''")
    files = []
    for entry in facts.get("relative_file_paths").items():
        name = entry.text()
        # Accept only names of files in the folder, where rosbag2 writes them; other paths are not safe.
        if not name or name in (".", "..") or "/" in name or "\0" in name:
            raise entry.error("the name of a file in the folder")
        files.append(BagFile(path / name))
    if not files:
        raise facts.get("relative_file_paths").error("the names of the bag's files")
    topics = {
        entry.get("topic_metadata").get("name").text(): entry.get("message_count").count()
        for entry in facts.get("topics_with_message_count").items(optional=True)
    }
    # rosbag2 lists a compressed file by the name of the uncompressed file.
    names = {file.path.name.removesuffix(".zstd"): file.path.name for file in files}
    parts = {
        names.get(name.removesuffix(".zstd"), name): entry.get("message_count").count()
        for entry in facts.get("files").items(optional=True)
        for name in (entry.get("path").text(),)
    }
    return Storage(
        tuple(files),
        facts.get("message_count").count(),
        {name: count for name, count in topics.items() if count is not None},
        {name: count for name, count in parts.items() if count is not None},
    )


def list_files(folder: Path) -> list[Path]:
    """List the MCAP files of a folder in the order of their numbers."""

    def sort_key(path: Path) -> tuple[str, int, str]:
        stem = path.name.split(".")[0]
        digits = stem[len(stem.rstrip("0123456789")) :]
        return stem[: len(stem) - len(digits)], int(digits[-18:] or 0), path.name

    return sorted((*folder.glob("*.mcap"), *folder.glob("*.mcap.zstd")), key=sort_key)


def conversion_command(path: Path) -> str:
    """Return the command line that converts an SQLite bag to MCAP."""
    target = path.with_name(f"{path.stem}_mcap")
    options = f"output_bags: [{{uri: {target}, storage_id: mcap, all_topics: true}}]"
    return (
        f"`echo {shlex.quote(options)} > convert.yaml && "
        f"ros2 bag convert -i {shlex.quote(str(path))} sqlite3 -o convert.yaml`"
    )


class _MetadataValue:
    """A value of ``metadata.yaml`` with its name, which errors state."""

    def __init__(self, path: Path, name: str, value: object) -> None:
        self._path = path
        self.name = name
        self.value = value

    def error(self, expected: str) -> BagError:
        text = f"{self.name or 'the file'} is {self.value!r}; expected {expected}"
        return BagError(text, path=self._path, reason="metadata")

    def get(self, key: str) -> _MetadataValue:
        """Return the entry ``key`` of a mapping; its value is None if it is missing."""
        if not isinstance(self.value, Mapping):
            raise self.error("a mapping")
        name = f"{self.name}.{key}" if self.name else key
        return _MetadataValue(self._path, name, self.value.get(key))

    def text(self, default: str = "") -> str:
        if self.value is not None and not isinstance(self.value, str):
            raise self.error("a text")
        return default if self.value is None else self.value

    def items(self, optional: bool = False) -> list[_MetadataValue]:
        if optional and self.value is None:
            return []
        if not isinstance(self.value, list):
            raise self.error("a list")
        return [_MetadataValue(self._path, f"{self.name}[{i}]", v) for i, v in enumerate(self.value)]

    def count(self) -> int | None:
        if self.value is None:
            return None
        if not isinstance(self.value, int) or isinstance(self.value, bool) or self.value < 0:
            raise self.error("a count, 0 or more")
        return self.value


def _load_metadata(path: Path) -> object:
    try:
        with open_regular(path) as file:
            size = os.fstat(file.fileno()).st_size
            if size > MAX_METADATA_BYTES:
                text = f"has {size} bytes; at most {MAX_METADATA_BYTES}"
                raise BagError(text, path=path, reason="metadata")
            return load_plain(file.read(MAX_METADATA_BYTES).decode())
    except OSError as error:
        text = f"cannot be read: {error.strerror or error}"
        raise BagError(text, path=path, reason="io") from error
    except ValueError as error:
        raise BagError(f"is not plain YAML: {error}", path=path, reason="metadata") from None
