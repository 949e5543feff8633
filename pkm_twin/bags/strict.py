# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The strict pass over a whole MCAP file. Imports no ROS.

Every statement that the file makes about itself (counts, times, indexes, offsets, CRCs) is compared
with what is there: where ``mcap`` would only look up an index, the index that the data call for is
made and must be the one in the file. Memory holds a few numbers for each chunk, never the file.
"""

from __future__ import annotations

import zlib
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple, Self

from mcap import records as mcap
from mcap.opcode import Opcode as Op
from mcap.writer import MCAP0_MAGIC as MAGIC

from pkm_twin.bags.format import (
    CRC_BYTES,
    FOOTER_BYTES,
    FRAME,
    MAX_RECORD_BYTES,
    NAMES,
    TOTAL_CAP,
    ZSTD_MAGIC,
    FormatError,
    RecordReader,
    Records,
    check_metadata,
    iterate_records,
    opcode_name,
    pack_record,
    parse_record,
    unpack_chunk,
)
from pkm_twin.bags.storage import BagFile
from pkm_twin.errors import BagError

# Messages outside chunks are read back in runs of about this size.
_RUN_BYTES = 1024**2


@dataclass(slots=True)
class Span:
    """How many messages, and from when to when by their log times, ns."""

    count: int = 0
    start: int = 0
    end: int = 0

    def join(self, other: Span) -> None:
        """Count all of another's messages."""
        if other.count:
            self.start = min(self.start, other.start) if self.count else other.start
            self.end = max(self.end, other.end)
            self.count += other.count


@dataclass(frozen=True, slots=True)
class Segment:
    """Part of the file that is loaded at once: a chunk record, or a run of message records.

    ``messages`` are those that are whole; ``has_crc``: a CRC covers them.
    """

    offset: int
    length: int
    messages: Span
    is_chunk: bool
    has_crc: bool

    def read(self, reader: RecordReader) -> bytes:
        """Return the segment's records, checked once more."""
        data = reader.read_at(self.offset, self.length, "segment")
        if not self.is_chunk:
            return data
        chunk = parse_record(Op.CHUNK, data[FRAME.size :], self.offset)
        return unpack_chunk(chunk, self.offset, reader.budget)


class TrustedSummary(NamedTuple):
    """The statements of a summary with a valid CRC on damaged data, which end at ``data_end``.

    ``chunks``: the length of each chunk record by its offset, in order and without overlap.
    """

    data_end: int
    records: list[mcap.Schema | mcap.Channel]
    chunks: dict[int, int]


class Check:
    """One pass over a file, in which every statement that it makes about itself is checked.

    ``fault`` is the first thing that is wrong, None in a sound file. The pass goes on behind it:
    ``segments`` are what is whole. Where the summary is there and its CRC holds, its channels stand
    in for lost ones, and its list of chunks says where to go on.
    """

    def __init__(self, reader: RecordReader) -> None:
        self._reader = reader
        self.records = Records()
        self.segments: list[Segment] = []
        self.metadata: list[tuple[str, dict[str, str], bool]] = []
        self.fault: FormatError | None = None
        self.bytes_lost = self.chunks_lost = 0
        self.header = mcap.Header("ros2", "")
        self.spans: dict[int, Span] = {}
        self.total = Span()
        self.out_of_order = 0
        # The last chunk's index as it has to be, and the message indexes that it has to have.
        self._chunk: mcap.ChunkIndex | None = None
        self._entries: dict[int, list[tuple[int, int]]] = {}
        # Digests of the indexes that the summary may hold; those of chunks with their offset.
        self._indexes: set[int] = set()
        self._chunks: dict[int, int] = {}
        self._indexed: set[int] = set()
        self._attachments = 0
        self.has_data_crc = self.has_summary = self.summary_without_crc = False
        self.statistics: mcap.Statistics | None = None
        self._groups: dict[int, tuple[int, int]] = {}
        self._in_data = (0, 0)
        self.notes: list[str] = []

    def run(self) -> Self:
        """Read the file from its first byte to its last."""
        try:
            self._reader.read_magic()
            if self._read_data():
                self._read_summary()
                self._compare_counts()
        except FormatError as error:
            self._note(error)
        if self.fault and (self._trusted.chunks or any(part.is_chunk for part in self.segments)):
            # In a file with chunks, a message outside of them is a damaged record of another kind.
            loose = [part for part in self.segments if not part.is_chunk]
            self.bytes_lost += sum(part.length for part in loose)
            self.segments = [part for part in self.segments if part.is_chunk]
        return self

    @cached_property
    def _trusted(self) -> TrustedSummary:
        nothing = TrustedSummary(self._reader.size, [], {})
        end = self._reader.size - FOOTER_BYTES - len(MAGIC)
        try:
            tail = self._reader.read_at(max(end, 0), FOOTER_BYTES, "footer")
            footer = parse_record(Op.FOOTER, tail[FRAME.size :], end)
            start = footer.summary_start
            if not footer.summary_crc or not len(MAGIC) < start <= end <= start + MAX_RECORD_BYTES:
                return nothing
            summary = self._reader.read_at(start, end - start, "summary")
            # The CRC goes as far as the footer's own CRC field.
            if zlib.crc32(summary + tail[:-CRC_BYTES]) != footer.summary_crc:
                return nothing
            found = TrustedSummary(start, [], {})
            for opcode, begin, stop in iterate_records(summary, start):
                if opcode in (Op.SCHEMA, Op.CHANNEL):
                    found.records.append(parse_record(opcode, summary[begin:stop], start))
                elif opcode == Op.CHUNK_INDEX:
                    index = parse_record(opcode, summary[begin:stop], start)
                    if FRAME.size < index.chunk_length <= start - index.chunk_start_offset:
                        found.chunks[index.chunk_start_offset] = index.chunk_length
        except FormatError:
            return nothing
        chunks = dict(sorted(found.chunks.items()))
        # A list in which chunks overlap is of no help.
        overlap = any(at + chunks[at] > behind for at, behind in pairwise(chunks))
        return found._replace(chunks={} if overlap else chunks)

    @property
    def left_out(self) -> str:
        """Losses of :func:`recover`: the fault with its place, or records that are left out."""
        if self.fault:
            at = self.fault.offset
            return self.fault.text if at is None else f"{self.fault.text} (byte {at})"
        kinds = [Op.ATTACHMENT] if self._attachments else list(self.records.passed_over)
        return f"{opcode_name(kinds[0])} records are not carried over" if kinds else ""

    @property
    def has_crc(self) -> bool:
        """True if a CRC covers every message."""
        return self.has_data_crc or all(part.has_crc for part in self.segments)

    @property
    def has_index(self) -> bool:
        """True if the summary lists every chunk."""
        return bool(self._chunks) and self._indexed == set(self._chunks.values())

    @property
    def message_count(self) -> int:
        """How many messages are whole."""
        return sum(part.messages.count for part in self.segments)

    def _note(self, error: FormatError) -> None:
        """Keep the first fault; from it on, the summary's schemas and channels hold."""
        if self.fault is None:
            self.bytes_lost += self.records.replace(self._trusted.records)
        if self.fault is None or error.reason == TOTAL_CAP:
            self.fault = error

    def _read_data(self) -> bool:
        """Read up to the end of the data; return whether all of it is sound."""
        reader, data_end = self._reader, self._reader.size
        while reader.position < data_end or not self.fault:
            at, crc = reader.position, reader.crc
            end, opcode = at, 0
            try:
                opcode, length = reader.read_frame()
                end = reader.position + length
                doubtful = self.fault or opcode not in NAMES
                if doubtful and opcode != Op.CHUNK and at in self._trusted.chunks:
                    raise FormatError("a chunk's record is damaged", at)
                if at == len(MAGIC) and opcode != Op.HEADER:
                    text = f"the first record is {opcode_name(opcode)}, not the header"
                    self._note(FormatError(text, at))
                if opcode != Op.MESSAGE_INDEX:
                    self._close_chunk(at)
                if (opcode, length) == (Op.FOOTER, FOOTER_BYTES - FRAME.size):
                    self._note(FormatError("a footer record stands in the data section", at))
                    break
                if (opcode, length) == (Op.DATA_END, CRC_BYTES):
                    break
                self._take(at, opcode, length)
            except FormatError as error:
                if error.reason == TOTAL_CAP:
                    raise
                if self.fault:
                    # Continue after the damaged record at ``at``, which should end at ``end``.
                    data_end, _, chunks = self._trusted
                    if at in chunks:
                        end = at + chunks[at]
                    else:
                        # In order, and one behind the other: the scan never goes back.
                        offsets = [*chunks, data_end]
                        later = offsets[min(bisect_right(offsets, at), len(chunks))]
                        end = later if end <= at or end > later else end
                    self.chunks_lost += opcode == Op.CHUNK or at in chunks
                    self.bytes_lost += end - at
                    self._reader.position = end
                else:
                    # Read once more: the summary may have the channel that the record needs.
                    reader.position = at
                self._note(error)
        if self.fault:
            return False
        stated = parse_record(opcode, reader.read_body(opcode, length), at).data_section_crc
        if stated not in (0, crc):
            raise FormatError(f"the data's CRC is {crc:08x}; the file says {stated:08x}", at, "crc")
        self.has_data_crc = stated != 0
        self._in_data = (len(self.records.schemas), len(self.records.channels))
        return True

    def _take(self, at: int, opcode: int, length: int) -> None:
        """Read the record at ``at``, whose frame has been read."""
        reader, whole = self._reader, FRAME.size + length
        if opcode == Op.ATTACHMENT:
            index = reader.read_attachment(at, length)
            self._indexes.add(_digest(index))
            self._attachments += 1
            self.bytes_lost += whole
            return
        header = opcode == Op.HEADER and at == len(MAGIC)
        if (
            opcode in NAMES
            and opcode not in (Op.SCHEMA, Op.CHANNEL, Op.MESSAGE, Op.CHUNK, Op.MESSAGE_INDEX, Op.METADATA)
            and not header
        ):
            raise FormatError(f"a {opcode_name(opcode)} record stands in the data section", at)
        body = reader.read_body(opcode, length)
        if opcode not in NAMES:
            self.records.passed_over[opcode] += 1
            self.bytes_lost += whole
            return
        if opcode == Op.MESSAGE:
            # A run of messages outside chunks is one segment.
            record = FRAME.pack(opcode, length) + body
            span = self._count_messages(record, at)
            last = self.segments[-1] if self.segments else None
            begin, length = at, len(record)
            follows = last and not last.is_chunk and last.offset + last.length == at
            if last and follows and last.length + length <= _RUN_BYTES:
                begin, length = last.offset, last.length + length
                span.join(self.segments.pop().messages)
            self.segments.append(Segment(begin, length, span, is_chunk=False, has_crc=False))
            return
        match record := parse_record(opcode, body, at):
            case mcap.Header():
                self.header = record
            case mcap.Schema() | mcap.Channel():
                self.records.add(record, at)
            case mcap.Chunk():
                data = unpack_chunk(record, at, self._reader.budget)
                span = self._count_messages(data, at)
                for kind in self.records.passed_over:
                    if kind in NAMES:
                        self._note(FormatError(f"a {opcode_name(kind)} record stands in a chunk", at))
                stated = record.message_start_time, record.message_end_time
                if stated != (span.start, span.end):
                    text = f"the chunk's messages span {span.start} to {span.end} ns"
                    self._note(FormatError(f"{text}; the file says {stated[0]} to {stated[1]}", at))
                self.segments.append(Segment(at, whole, span, is_chunk=True, has_crc=record.uncompressed_crc != 0))
                self._chunk = mcap.ChunkIndex(
                    chunk_start_offset=at,
                    chunk_length=whole,
                    compression=record.compression,
                    compressed_size=len(record.data),
                    uncompressed_size=len(data),
                    message_start_time=span.start,
                    message_end_time=span.end,
                    message_index_offsets={},
                    message_index_length=0,
                )
            case mcap.MessageIndex():
                self._take_index(at, record, whole)
            case mcap.Metadata(name=title):
                self.metadata.append((title, *check_metadata(record, at)))
                self._indexes.add(_digest(mcap.MetadataIndex(at, whole, title)))

    def _count_messages(self, data: bytes, at: int) -> Span:
        """Count the messages in ``data`` and note what their indexes must say."""
        spans: dict[int, Span] = {}
        self._entries = {}
        latest, late, lost = self.total.end, 0, 0
        for position, message in self.records.iterate_messages(data, at, self._reader.budget):
            number, time = message.channel_id, message.log_time
            self._entries.setdefault(number, []).append((time, position))
            # A message compressed by itself must decompress; a failure loses that message alone.
            if message.data.startswith(ZSTD_MAGIC):
                try:
                    self.records.unpack_message(message, at, self._reader.budget)
                except FormatError as error:
                    if error.reason == TOTAL_CAP:
                        raise
                    self._note(error)
                    lost += len(pack_record(message)) - FRAME.size
                    continue
            late += time < latest
            latest = max(latest, time)
            spans.setdefault(number, Span()).join(Span(1, time, time))
        # Counted only once all of it is known to be whole.
        whole = Span()
        for number, span in spans.items():
            for each in (whole, self.total, self.spans.setdefault(number, Span())):
                each.join(span)
        self.out_of_order += late
        self.bytes_lost += lost
        return whole

    def _take_index(self, at: int, index: mcap.MessageIndex, length: int) -> None:
        number = index.channel_id
        if self.fault:
            return
        if self._chunk is None or number in self._chunk.message_index_offsets:
            text = f"a message index of channel {number} belongs to no chunk"
            self._note(FormatError(text, at))
            return
        # Writers differ in their order.
        entries = self._entries.get(number, [])
        if index.records != entries and sorted(index.records) != sorted(entries):
            text = f"the message index of channel {number} differs from the chunk"
            self._note(FormatError(text, at))
        self._chunk.message_index_offsets[number] = at
        self._chunk.message_index_length += length

    def _close_chunk(self, at: int) -> None:
        """Note what the index of the last chunk must say; its message indexes end at ``at``."""
        if self._chunk is None or self.fault:
            return
        places = self._chunk.message_index_offsets
        if places and (missing := self._entries.keys() - places.keys()):
            text = f"channels {sorted(missing)} have no message index, others have"
            self._note(FormatError(text, at))
        self._chunks[_digest(self._chunk)] = self._chunk.chunk_start_offset
        self._chunk = None

    def _read_summary(self) -> None:
        reader = self._reader
        begin = reader.position
        reader.crc = 0
        while True:
            at, crc = reader.position, reader.crc
            opcode, length = reader.read_frame()
            body = reader.read_body(opcode, length)
            if opcode == Op.FOOTER:
                break
            if opcode in NAMES:
                if Op.SUMMARY_OFFSET in self._groups and opcode != Op.SUMMARY_OFFSET:
                    text = f"a {opcode_name(opcode)} record stands among the summary offsets"
                    raise FormatError(text, at)
                match record := None if opcode == Op.MESSAGE else parse_record(opcode, body, at):
                    case mcap.Schema() | mcap.Channel():
                        self.records.add(record, at)
                    case mcap.Statistics():
                        if self.statistics:
                            raise FormatError("the summary has two statistics records", at)
                        self.statistics = record
                    case mcap.ChunkIndex():
                        known = self._chunks.get(_digest(record))
                        if known is None or known in self._indexed:
                            where = record.chunk_start_offset
                            raise FormatError(f"a chunk index does not match the chunk at byte {where}", at)
                        self._indexed.add(known)
                    case mcap.MetadataIndex() | mcap.AttachmentIndex():
                        if _digest(record) not in self._indexes:
                            text = f"the {opcode_name(opcode)} does not match the one at byte"
                            raise FormatError(f"{text} {record.offset}", at)
                    case mcap.SummaryOffset(group_opcode=kind, group_start=start, group_length=length):
                        # Writers may list a group that has no records.
                        if length and self._groups.get(kind) != (start, length):
                            text = f"a summary offset does not match the {opcode_name(kind)} records"
                            raise FormatError(text, at)
                    case _:
                        raise FormatError(f"a {opcode_name(opcode)} record stands in the summary", at)
            else:
                self.records.passed_over[opcode] += 1
            start, size = self._groups.get(opcode, (at, 0))
            if start + size != at:
                text = f"the {opcode_name(opcode)} records of the summary are not together"
                raise FormatError(text, at)
            self._groups[opcode] = (start, reader.position - start)
        footer = parse_record(Op.FOOTER, body, at)
        start = footer.summary_start
        self.has_summary = at > begin
        if start != (begin if self.has_summary else 0) and (start, at) != (begin, begin):
            raise FormatError(f"the footer puts the summary at {start}; it is at {begin}", at)
        found, _ = self._groups.get(Op.SUMMARY_OFFSET, (0, 0))
        if footer.summary_offset_start not in (found, found or at):
            text = f"the footer puts the summary offsets at {footer.summary_offset_start}"
            raise FormatError(f"{text}, not {found}", at)
        crc = zlib.crc32(pack_record(footer)[:-CRC_BYTES], crc)
        if footer.summary_crc not in (0, crc):
            text = f"the summary's CRC is {crc:08x}; the file says {footer.summary_crc:08x}"
            raise FormatError(text, at, "crc")
        self.summary_without_crc = not footer.summary_crc and self.has_summary
        at = reader.position
        if reader.read(len(MAGIC), "closing mark") != MAGIC:
            raise FormatError("the file does not end with the MCAP signature", at)
        if left := reader.size - reader.position:
            raise FormatError(f"{left} bytes follow the end of the bag", reader.position)

    def _compare_counts(self) -> None:
        if self._indexed and not self.has_index:
            unlisted = min(set(self._chunks.values()) - self._indexed)
            raise FormatError("the summary does not list the chunk here, though others", unlisted)
        if self.statistics is None:
            return
        counts = {number: span.count for number, span in self.spans.items()}
        stated = self.statistics
        stated.channel_message_counts = {
            number: count for number, count in stated.channel_message_counts.items() if count
        }
        # Writers differ in whether a schema or channel that is only in the summary counts.
        schemas, channels = len(self.records.schemas), len(self.records.channels)
        ranges = [
            ("schema count", stated.schema_count, self._in_data[0], schemas),
            ("channel count", stated.channel_count, self._in_data[1], channels),
        ]
        for what, said, low, high in ranges:
            if not low <= said <= high:
                text = f"the {what} is {low} to {high}; the statistics say {said}"
                raise FormatError(text, None, "statistics")
        expected = replace(
            stated,
            message_count=self.total.count,
            channel_message_counts=counts,
            attachment_count=self._attachments,
            metadata_count=len(self.metadata),
            chunk_count=len(self._chunks),
            message_start_time=self.total.start,
            message_end_time=self.total.end,
        )
        for what, found in vars(expected).items():
            if (said := getattr(stated, what)) == found:
                continue
            text = f"the {what.replace('_', ' ')} is {found}; the statistics say {said}"
            # Some writers take a log time of 0 for none. The messages themselves are all there.
            if not what.endswith("time"):
                raise FormatError(text, None, "statistics")
            self.notes.append(text)


def check_files(files: Sequence[BagFile]) -> dict[BagFile, Check | BagError]:
    """Check the files of a bag; the result of one that cannot be read is the error.

    :raises BagError: the bag's only file cannot be read, is no bag or costs too much.
    """
    found: dict[BagFile, Check | BagError] = {}
    alone = len(files) == 1
    for file in files:
        try:
            with file.open() as reader:
                found[file] = check = Check(reader).run()
            fault = check.fault
            # An empty file among several files of a bag is damage.
            reasons = (TOTAL_CAP, "empty", "not_mcap") if alone else (TOTAL_CAP,)
            if fault and fault.reason in reasons:
                raise BagError(fault.text, path=file.path, reason=fault.reason, offset=fault.offset)
        except BagError as error:
            if alone:
                raise
            found[file] = error
    return found


def _digest(index: mcap.McapRecord) -> int:
    """Return a number for an index record, whatever the order of the channels in it."""
    if isinstance(index, mcap.ChunkIndex):
        places = dict(sorted(index.message_index_offsets.items()))
        index = replace(index, message_index_offsets=places)
    return hash(pack_record(index))
