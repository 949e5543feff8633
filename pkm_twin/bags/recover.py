# SPDX-License-Identifier: Apache-2.0
"""Saving what is whole of a damaged bag. Imports no ROS."""

from __future__ import annotations

import io
import os
import zlib
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

from pkm_twin.bags.chunks import message_data, read_chunk
from pkm_twin.bags.format import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    CRC,
    DATA_END,
    FIRST_UNKNOWN,
    FOOTER,
    FOOTER_BODY,
    FRAME,
    HEADER,
    MAGIC,
    MAX_RECORD_BYTES,
    MESSAGE,
    MESSAGE_INDEX,
    METADATA,
    METADATA_CRC,
    SCHEMA,
    TOTAL_CAP,
    Channel,
    Fields,
    FormatError,
    RecordReader,
    Records,
    Schema,
    iterate_records,
    message_head,
    metadata,
    metadata_crc,
    opcode_name,
)
from pkm_twin.bags.storage import BagFile, files_by_name, find_storage
from pkm_twin.bags.strict import Check
from pkm_twin.bags.writer import LIBRARY, Sink, mcap_writer, refuse_existing, write_error
from pkm_twin.errors import BagError
from pkm_twin.files import replacing


@dataclass(frozen=True)
class RecoverResult:
    """What :func:`recover` saved and what it could not.

    ``bytes_lost`` counts damaged and incomplete records of the source's data section; indexes and
    summary are made anew. ``unverified`` messages were whole, but no CRC covered them. ``reason``
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


class Salvage:
    """A forward scan that keeps what is whole and goes on behind what is not.

    Where the summary is there and its CRC holds, its channels stand in for lost ones, and its list
    of chunks tells where to go on after a record whose length is damaged.
    """

    def __init__(self, reader: RecordReader) -> None:
        self._reader = reader
        self._records = Records()
        # Length of each chunk record by its offset, and the end of the data, as the summary says.
        self._known: dict[int, int] = {}
        self._offsets: list[int] = []
        self._data_end = reader.size
        self._chunked = False
        self._target: _Target | None = None
        self.reason = ""
        self.messages = self.unverified = self.chunks_lost = self.bytes_lost = 0

    def run(self, target: _Target | None) -> Self:
        """Scan the file; hand what is whole to ``target``, or only count where that is None.

        :raises FormatError: the scan costs more than such a file may cost.
        """
        self._target = target
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
                if at in self._known and opcode != CHUNK:
                    raise FormatError("a chunk's record is damaged", at)
                if (opcode, length) in ((DATA_END, CRC.size), (FOOTER, FOOTER_BODY.size)):
                    break
                self._keep(at, opcode, length)
            except FormatError as error:
                if error.reason == TOTAL_CAP:
                    raise
                self.reason = self.reason or error.text
                self.chunks_lost += opcode == CHUNK or at in self._known
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

    def _keep(self, at: int, opcode: int, length: int) -> None:
        if opcode in (ATTACHMENT, *range(FIRST_UNKNOWN, 256)):
            raise FormatError(f"{opcode_name(opcode)} records are not carried over", at)
        body = self._reader.body(opcode, length)
        if opcode == CHUNK:
            self._chunked = True
            self._keep_chunk(at, body)
        elif opcode == MESSAGE:
            # What looks like one beside chunks is a damaged record of another kind.
            if self._chunked:
                raise FormatError("a message record stands outside the chunks", at)
            self._deliver(body, 0, len(body), at, verified=False)
        elif opcode in (SCHEMA, CHANNEL):
            self._records.add(opcode, body, at)
        elif opcode == METADATA:
            name, entries, verified = metadata(body, at)
            # rosbag2's record of its own files is not true of the new one.
            if self._target and name != ROSBAG2:
                self._target.add_metadata(name, entries, verified)
        elif opcode in (HEADER, MESSAGE_INDEX):
            self._pass_over(opcode, body, at)
        else:
            raise FormatError(f"a {opcode_name(opcode)} record stands in the data section", at)

    def _pass_over(self, opcode: int, body: bytes, at: int) -> None:
        """Read a record that is not kept, to find out whether it is what it says it is."""
        fields = Fields(body, opcode_name(opcode), at)
        if opcode == HEADER:
            profile, _ = fields.text(), fields.text()
            if self._target:
                self._target.profile = profile
        else:
            fields.number("H")
            fields.blob("I")
        fields.done()

    def _keep_chunk(self, at: int, body: bytes) -> None:
        chunk = read_chunk(body, at, self._reader.budget)
        # All of the chunk is looked at before any of it is handed on.
        for opcode, start, end in iterate_records(chunk.data, at, self._reader.budget):
            if opcode == MESSAGE:
                self._require_channel(message_head(chunk.data, start, end, at)[0], at)
            elif opcode in (SCHEMA, CHANNEL):
                self._records.add(opcode, chunk.data[start:end], at)
        for opcode, start, end in iterate_records(chunk.data, at):
            if opcode == MESSAGE:
                self._deliver(chunk.data, start, end, at, verified=chunk.has_crc)

    def _require_channel(self, number: int, at: int) -> None:
        if number not in self._records.channels:
            raise FormatError(f"messages of the channel {number}, whose record is lost", at)

    def _deliver(self, data: bytes, start: int, end: int, at: int, *, verified: bool) -> None:
        """Hand on one message, unpacked: the new bag has no metadata to say that it is packed."""
        head = message_head(data, start, end, at)
        self._require_channel(head[0], at)
        encoding = self._records.channels[head[0]].encoding
        try:
            content = message_data(data, start, end, encoding, at, self._reader.budget)
        except FormatError as error:
            if error.reason == TOTAL_CAP:
                raise
            self.reason = self.reason or error.text
            self.bytes_lost += end - start
            return
        self.messages += 1
        self.unverified += not verified
        if self._target:
            self._target.add_message(self._records, head, content)

    def _read_trusted_summary(self) -> None:
        size = FRAME.size + FOOTER_BODY.size + len(MAGIC)
        at = self._reader.size - size
        if at < len(MAGIC):
            return
        self._reader.seek(at)
        tail = self._reader.read(size, "footer")
        opcode, length = FRAME.unpack_from(tail)
        start, _, crc = FOOTER_BODY.unpack_from(tail, FRAME.size)
        if (opcode, length) != (FOOTER, FOOTER_BODY.size) or not crc:
            return
        if not len(MAGIC) < start <= at or at - start > MAX_RECORD_BYTES:
            return
        self._reader.seek(start)
        summary = self._reader.read(at - start, "summary")
        # The CRC goes as far as the footer's own CRC field.
        if zlib.crc32(summary + tail[: -len(MAGIC) - CRC.size]) != crc:
            return
        for opcode, begin, end in iterate_records(summary, start):
            if opcode in (SCHEMA, CHANNEL):
                self._records.add(opcode, summary[begin:end], start)
            elif opcode == CHUNK_INDEX:
                fields = Fields(summary[begin:end], opcode_name(opcode), start)
                _, _, offset, length = fields.numbers("QQQQ")
                if FRAME.size < length <= start - offset:
                    self._known[offset] = length
        self._data_end = start
        self._chunked = bool(self._known)
        self._offsets = sorted(self._known)
        if any(one + self._known[one] > other for one, other in pairwise(self._offsets)):
            # Chunks do not overlap: a list in which they do is of no help.
            self._known, self._offsets = {}, []


class _Target:
    """The bag that recovery writes: the kept channels, messages and metadata as they were."""

    def __init__(self, sink: Sink) -> None:
        self.profile = "ros2"
        self._open_writer = mcap_writer(sink, 256 * 1024)
        self._schemas: dict[Schema, int] = {}
        self._channels: dict[tuple[object, ...], int] = {}
        # The new numbers of the channels of the file that is being read.
        self._numbers: dict[int, int] = {}
        self._metadata: set[tuple[object, ...]] = set()

    def begin(self) -> None:
        """Begin with another file, whose numbers are its own."""
        self._numbers = {}

    @cached_property
    def _writer(self) -> Any:
        """The writer, its header written at the first use, when the profile is known."""
        self._open_writer.start(profile=self.profile, library=LIBRARY)
        return self._open_writer

    def add_metadata(self, name: str, entries: Mapping[str, str], verified: bool) -> None:
        """Write metadata; a CRC of its own only where it had one, so doubt is not made proof."""
        crc = {METADATA_CRC: metadata_crc(name, entries)} if verified else {}
        # Every file of a bag may repeat it.
        key = (name, *sorted(entries.items()))
        if key not in self._metadata:
            self._metadata.add(key)
            self._writer.add_metadata(name, {**entries, **crc})

    def add_message(self, records: Records, head: tuple[int, int, int, int], data: bytes) -> None:
        """Write a message, before the first of a channel also what describes it."""
        number, sequence, log_time, publish_time = head
        if number not in self._numbers:
            self._numbers[number] = self._channel(records, records.channels[number])
        self._writer.add_message(
            self._numbers[number], log_time, data, publish_time, sequence=sequence
        )

    def _channel(self, records: Records, channel: Channel) -> int:
        schema = records.schemas.get(channel.schema_id)
        schema_number = 0 if schema is None else self._schema(schema)
        metadata = tuple(sorted(channel.metadata.items()))
        key = (schema_number, channel.topic, channel.encoding, metadata)
        if key not in self._channels:
            self._channels[key] = self._writer.register_channel(
                channel.topic, channel.encoding, schema_number, dict(channel.metadata)
            )
        return self._channels[key]

    def _schema(self, schema: Schema) -> int:
        if schema not in self._schemas:
            self._schemas[schema] = self._writer.register_schema(
                schema.name, schema.encoding, schema.data
            )
        return self._schemas[schema]

    def finish(self) -> None:
        self._writer.finish()


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


class _TargetSink(Sink):
    """What the system refuses here is the target's: a source is being read around it."""

    def __init__(self, file: io.FileIO, target: Path) -> None:
        super().__init__(file)
        self._target = target

    def write(self, data: bytes) -> int:
        try:
            return super().write(data)
        except OSError as error:
            raise write_error(error, self._target) from error


def _write_salvage(files: Sequence[BagFile], path: Path, named: Path) -> RecoverResult:
    with path.open("xb", buffering=0) as output:
        target = _Target(_TargetSink(output, named))
        found = []
        for file in files:
            target.begin()
            with file.open() as reader:
                found.append(Salvage(reader).run(target))
        target.finish()
        os.fsync(output.fileno())
    return RecoverResult(
        sum(salvage.messages for salvage in found),
        sum(salvage.bytes_lost for salvage in found),
        next((salvage.reason for salvage in found if salvage.reason), ""),
        sum(salvage.chunks_lost for salvage in found),
        sum(salvage.unverified for salvage in found),
    )
