# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Saving what is whole of a damaged bag. Imports no ROS."""

from __future__ import annotations

import os
import zlib
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Self

from pkm_twin.bags.format import (
    CRC,
    FOOTER_BODY,
    FRAME,
    MAGIC,
    MAX_RECORD_BYTES,
    TOTAL_CAP,
    Chunk,
    FormatError,
    Op,
    RecordReader,
    iterate_records,
    message_data,
    opcode_name,
    unpack,
)
from pkm_twin.bags.storage import BagFile, files_by_name, find_storage
from pkm_twin.bags.strict import Check, Walker
from pkm_twin.bags.writer import McapWriter, refuse_existing, write_error
from pkm_twin.errors import BagError
from pkm_twin.files import replacing


@dataclass(frozen=True)
class RecoverResult:
    """What :func:`recover` saved and what it could not.

    ``bytes_lost`` counts damaged and incomplete records of the source's data section; indexes and
    summary are made again. ``unverified`` messages were whole, but no CRC covered them. ``reason``
    is the first fault found, empty for a sound bag.
    """

    messages: int
    bytes_lost: int
    reason: str
    chunks_lost: int
    unverified: int

    @property
    def lossless(self) -> bool:
        """Whether the source was sound."""
        return not self.reason


ROSBAG2 = "rosbag2"
"""Name of the record in which rosbag2 repeats its ``metadata.yaml``."""


class Salvage(Walker):
    """A forward scan that keeps what is whole and goes on behind what is not.

    Where the summary is there and its CRC holds, its channels stand in for lost ones, and its list
    of chunks says where to go on after a record whose length is damaged.
    """

    def __init__(self, reader: RecordReader) -> None:
        super().__init__(reader)
        self._profile = "ros2"
        # Length of each chunk record by its offset, and the end of the data, as the summary says.
        self._known: dict[int, int] = {}
        self._offsets: list[int] = []
        self._data_end = reader.size
        self._chunked = False
        self._writer: McapWriter | None = None
        # The new numbers of the channels.
        self._numbers: dict[int, int] = {}
        self.reason = ""
        self.messages = self.unverified = self.chunks_lost = self.bytes_lost = 0

    def run(self, writer: McapWriter | None) -> Self:
        """Scan the file; hand what is whole to ``writer``, or only count where that is None.

        :raises FormatError: the scan costs more than such a file may cost.
        """
        self._writer = writer
        with suppress(FormatError):
            self._read_trusted_summary()
        self._reader.seek(min(len(MAGIC), self._reader.size))
        while self._reader.position < self._data_end:
            at = self._reader.position
            end: int | None = None
            opcode = 0
            try:
                opcode, length = self._reader.frame()
                end = self._reader.position + length
                if at in self._known and opcode != Op.CHUNK:
                    raise FormatError("a chunk's record is damaged", at)
                if (opcode, length) in ((Op.DATA_END, CRC.size), (Op.FOOTER, FOOTER_BODY.size)):
                    break
                if writer and opcode != Op.HEADER:
                    writer.start(self._profile)
                self._walk(at, opcode, length)
            except FormatError as error:
                if error.reason == TOTAL_CAP:
                    raise
                self.reason = self.reason or error.text
                self.chunks_lost += opcode == Op.CHUNK or at in self._known
                end = self._resume(at, end)
                self.bytes_lost += end - at
            self._reader.seek(end)
        return self

    def _resume(self, at: int, end: int | None) -> int:
        """Return where to go on after a fault in the record at ``at``, which should stop at end."""
        if at in self._known:
            return at + self._known[at]
        # In order, and one behind the other: the scan never goes back.
        place = bisect_right(self._offsets, at)
        later = self._offsets[place] if place < len(self._offsets) else self._data_end
        return later if end is None or end > later else end

    def _pass_over(self, at: int, opcode: int, length: int) -> None:
        raise FormatError(f"{opcode_name(opcode)} records are not carried over", at)

    def _take_message(self, at: int, record: bytes) -> None:
        # What looks like one beside chunks is a damaged record of another kind.
        if self._chunked:
            raise FormatError("a message record stands outside the chunks", at)
        self._deliver(record, at, verified=False)

    def _take_metadata(
        self, at: int, length: int, name: str, entries: dict[str, str], verified: bool
    ) -> None:
        # rosbag2's record of its own files is not true of the new one.
        if self._writer and name != ROSBAG2:
            # Where it had no CRC of its own it gets none: doubt is not made proof.
            self._writer.add_metadata(name, entries, verified)

    def _take_chunk(self, at: int, chunk: Chunk, length: int) -> None:
        self._chunked = True
        # All of the chunk is looked at before any of it is handed on.
        for _ in self.records.messages(chunk.data, at, self._reader.budget):
            pass
        self._deliver(chunk.data, at, verified=chunk.has_crc)

    def _deliver(self, data: bytes, at: int, *, verified: bool) -> None:
        """Hand on messages, unpacked: the new bag has no metadata to say that they are packed."""
        for head, start, end in self.records.messages(data, at):
            channel = self.records.channels[head.channel]
            try:
                content = message_data(data, start, end, channel.encoding, at, self._reader.budget)
            except FormatError as error:
                if error.reason == TOTAL_CAP:
                    raise
                self.reason = self.reason or error.text
                self.bytes_lost += end - start
                continue
            self.messages += 1
            self.unverified += not verified
            if self._writer:
                if head.channel not in self._numbers:
                    schema = self.records.schemas.get(channel.schema_id)
                    self._numbers[head.channel] = self._writer.channel(schema, channel)
                head = head._replace(channel=self._numbers[head.channel])
                self._writer.add_message(head, content)

    def _read_trusted_summary(self) -> None:
        size = FRAME.size + FOOTER_BODY.size + len(MAGIC)
        at = self._reader.size - size
        if at < len(MAGIC):
            return
        self._reader.seek(at)
        tail = self._reader.read(size, "footer")
        opcode, length = FRAME.unpack_from(tail)
        start, _, crc = FOOTER_BODY.unpack_from(tail, FRAME.size)
        if (opcode, length) != (Op.FOOTER, FOOTER_BODY.size) or not crc:
            return
        if not len(MAGIC) < start <= at or at - start > MAX_RECORD_BYTES:
            return
        self._reader.seek(start)
        summary = self._reader.read(at - start, "summary")
        # The CRC goes as far as the footer's own CRC field.
        if zlib.crc32(summary + tail[: -len(MAGIC) - CRC.size]) != crc:
            return
        for opcode, begin, end in iterate_records(summary, start):
            if opcode in (Op.SCHEMA, Op.CHANNEL):
                self.records.add(opcode, summary[begin:end], start)
            elif opcode == Op.CHUNK_INDEX:
                _, _, offset, length, *_ = unpack(opcode, summary[begin:end], start)
                if FRAME.size < length <= start - offset:
                    self._known[offset] = length
        self._data_end = start
        self._chunked = bool(self._known)
        self._offsets = sorted(self._known)
        if any(one + self._known[one] > other for one, other in pairwise(self._offsets)):
            # Chunks do not overlap: a list in which they do is of no help.
            self._known, self._offsets = {}, []


def count_salvageable(files: Iterable[BagFile]) -> int:
    """How many messages :func:`recover` would save of these files."""
    count = 0
    for file in files:
        with suppress(BagError, FormatError), file.open() as reader:
            count += Salvage(reader).run(None).messages
    return count


def recover(source: str | Path, target: str | Path, *, overwrite: bool = False) -> RecoverResult:
    """Save what is whole in ``source``, a file or a rosbag2 folder, as a new, sound bag ``target``.

    A message is saved when its chunk is complete and matches its CRC. Messages that no CRC covers
    are saved too, and counted as unverified. The target appears only once it is complete, as one
    file in which no message is packed by itself. Attachments, records of unknown kinds and what
    rosbag2 says of its files are not carried over.

    :raises BagError: the source is not an MCAP bag or no message in it is whole, the target exists
        and ``overwrite`` is false, or it cannot be written.
    """
    source, target = Path(source), Path(target)
    refuse_existing(target, overwrite)
    files, reason = _files(source)
    files, damage = _sorted_out(files)
    reason = reason or damage
    for file in files:
        if target.exists() and file.path.exists() and target.samefile(file.path):
            raise BagError("target and source are the same file", path=target, reason="exists")
    try:
        with replacing(target) as hidden:
            result = _write_salvage(files, hidden, target)
            if not result.messages:
                text = f"no message can be recovered: {reason or 'there are none in it'}"
                raise BagError(text, path=source, reason="nothing")
            refuse_existing(target, overwrite)
    except OSError as error:
        raise write_error(error, target) from error
    return replace(result, reason=reason or result.reason)


def _files(source: Path) -> tuple[Sequence[BagFile], str]:
    """The files to save, and what is wrong with the folder that should name them."""
    try:
        return find_storage(source).files, ""
    except BagError as error:
        if error.reason not in ("metadata", "io", "folder") or not source.is_dir():
            raise
        found = [BagFile(path) for path in files_by_name(source)]
        if not found:
            raise
        return found, str(error)


def _sorted_out(files: Sequence[BagFile]) -> tuple[list[BagFile], str]:
    """The files that can be read at all, and the first thing that is wrong with any.

    :raises BagError: a bag's only file cannot be read.
    """
    readable, reason = [], ""
    for file in files:
        try:
            error = _first_error(file)
            readable.append(file)
        except BagError as refusal:
            if len(files) == 1:
                raise
            error = str(refusal)
        reason = reason or error
    return readable, reason


def _first_error(file: BagFile) -> str:
    """Return what the strict pass finds wrong, empty for a sound file."""
    try:
        with file.open() as reader:
            Check(reader).run()
    except FormatError as error:
        if error.reason in ("empty", "not_mcap", TOTAL_CAP):
            raise BagError(error.text, path=file.path, reason=error.reason) from None
        at = "" if error.offset is None else f" (byte {error.offset})"
        return error.text + at
    return ""


def _write_salvage(files: Sequence[BagFile], path: Path, named: Path) -> RecoverResult:
    with path.open("xb", buffering=0) as output:
        # What the system refuses here is the target's: a source is being read around it.
        writer = McapWriter(output, named, 256 * 1024)
        found = []
        for file in files:
            with file.open() as reader:
                found.append(Salvage(reader).run(writer))
        writer.finish()
        os.fsync(output.fileno())
    return RecoverResult(
        sum(salvage.messages for salvage in found),
        sum(salvage.bytes_lost for salvage in found),
        next((salvage.reason for salvage in found if salvage.reason), ""),
        sum(salvage.chunks_lost for salvage in found),
        sum(salvage.unverified for salvage in found),
    )
