# SPDX-License-Identifier: Apache-2.0
"""Saving what is whole of a damaged bag. Imports no ROS."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

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
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    METADATA,
    METADATA_CRC,
    SCHEMA,
    Channel,
    Fields,
    FormatError,
    RecordReader,
    Records,
    iterate_records,
    message_head,
    metadata,
    metadata_crc,
    opcode_name,
    open_reader,
    read_chunk,
)
from pkm_twin.bags.strict import Check
from pkm_twin.bags.writer import LIBRARY, Sink, mcap_writer, refuse_existing, write_error
from pkm_twin.errors import BagError


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
        self._data_end = reader.size
        self._chunked = False
        self._target: _Target | None = None
        self.reason = ""
        self.messages = self.unverified = self.chunks_lost = self.bytes_lost = 0

    def run(self, target: _Target | None) -> Self:
        """Scan the file; hand what is whole to ``target``, or only count where that is None."""
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
        later = min((offset for offset in self._known if offset > at), default=self._data_end)
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
            self._deliver([self._message(body, 0, len(body), at)], verified=False)
        elif opcode in (SCHEMA, CHANNEL):
            self._records.add(opcode, body, at)
        elif opcode == METADATA:
            name, entries, verified = metadata(body, at)
            if self._target:
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
        chunk = read_chunk(body, at)
        found = []
        for opcode, start, end in iterate_records(chunk.data, at):
            if opcode == MESSAGE:
                found.append(self._message(chunk.data, start, end, at))
            elif opcode in (SCHEMA, CHANNEL):
                self._records.add(opcode, chunk.data[start:end], at)
        self._deliver(found, verified=chunk.has_crc)

    def _message(
        self, data: bytes, start: int, end: int, at: int
    ) -> tuple[tuple[int, int, int, int], bytes]:
        head = message_head(data, start, end, at)
        if head[0] not in self._records.channels:
            raise FormatError(f"messages of the channel {head[0]}, whose record is lost", at)
        return head, data[start + MESSAGE_HEAD.size : end]

    def _deliver(
        self, found: list[tuple[tuple[int, int, int, int], bytes]], *, verified: bool
    ) -> None:
        self.messages += len(found)
        self.unverified += 0 if verified else len(found)
        if self._target:
            for head, data in found:
                self._target.add_message(self._records, head, data)

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


class _Target:
    """The bag that recovery writes: the kept channels, messages and metadata as they were."""

    def __init__(self, sink: Sink) -> None:
        self.profile = "ros2"
        self._open_writer = mcap_writer(sink, 256 * 1024)
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}

    @cached_property
    def _writer(self) -> Any:
        """The writer, its header written at the first use, when the profile is known."""
        self._open_writer.start(profile=self.profile, library=LIBRARY)
        return self._open_writer

    def add_metadata(self, name: str, entries: Mapping[str, str], verified: bool) -> None:
        """Write metadata; a CRC of its own only where it had one, so doubt is not made proof."""
        crc = {METADATA_CRC: metadata_crc(name, entries)} if verified else {}
        self._writer.add_metadata(name, {**entries, **crc})

    def add_message(self, records: Records, head: tuple[int, int, int, int], data: bytes) -> None:
        """Write a message, before the first of a channel also what describes it."""
        number, sequence, log_time, publish_time = head
        if number not in self._channels:
            self._channels[number] = self._add_channel(records, records.channels[number])
        self._writer.add_message(
            self._channels[number], log_time, data, publish_time, sequence=sequence
        )

    def _add_channel(self, records: Records, channel: Channel) -> int:
        if channel.schema_id not in self._schemas:
            schema = records.schemas[channel.schema_id]
            self._schemas[channel.schema_id] = self._writer.register_schema(
                schema.name, schema.encoding, schema.data
            )
        number: int = self._writer.register_channel(
            channel.topic,
            channel.encoding,
            self._schemas[channel.schema_id],
            dict(channel.metadata),
        )
        return number

    def finish(self) -> None:
        self._writer.finish()


def recover(source: str | Path, target: str | Path, *, overwrite: bool = False) -> RecoverResult:
    """Save what is whole in ``source`` as a new, sound bag ``target``.

    A message is saved when its chunk is complete and matches its CRC. Messages that no CRC covers
    are saved too, and counted as unverified. The target appears only once it is complete.
    Attachments and records of unknown kinds are not carried over.

    :raises BagError: the source is not an MCAP bag or no message in it is whole, the target exists
        and ``overwrite`` is false, or it cannot be written.
    """
    source, target = Path(source), Path(target)
    refuse_existing(target, overwrite)
    reason = _first_error(source)
    if target.exists() and target.samefile(source):
        raise BagError("the target is the source itself", path=target, reason="exists")
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        with open_reader(source) as reader, _creating(partial, target):
            salvage = _write_salvage(reader, partial)
            if not salvage.messages:
                text = f"no message can be recovered: {reason or 'there are none in it'}"
                raise BagError(text, path=source, reason="nothing")
            refuse_existing(target, overwrite)
            partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)
    return RecoverResult(
        salvage.messages,
        salvage.bytes_lost,
        reason or salvage.reason,
        salvage.chunks_lost,
        salvage.unverified,
    )


def _first_error(source: Path) -> str:
    """Return what the strict pass finds wrong, empty for a sound bag."""
    with open_reader(source) as reader:
        try:
            Check(reader).run()
        except FormatError as error:
            if error.reason in ("empty", "not_mcap"):
                raise BagError(error.text, path=source, reason=error.reason) from None
            at = "" if error.offset is None else f" (byte {error.offset})"
            return error.text + at
    return ""


def _write_salvage(reader: RecordReader, path: Path) -> Salvage:
    salvage = Salvage(reader)
    with path.open("xb", buffering=0) as file:
        target = _Target(Sink(file))
        salvage.run(target)
        target.finish()
        os.fsync(file.fileno())
    return salvage


@contextmanager
def _creating(partial: Path, target: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise write_error(error, target) from error
    finally:
        partial.unlink(missing_ok=True)
