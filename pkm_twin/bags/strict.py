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
    EXCEEDS_BUDGET,
    FOOTER_BYTES,
    FRAME,
    MAX_RECORD_BYTES,
    METADATA_CRC,
    OPCODE_NAMES,
    ZSTD_MAGIC,
    FormatError,
    RecordReader,
    Records,
    iterate_records,
    metadata_crc,
    opcode_name,
    pack_record,
    parse_record,
    unpack_chunk,
)
from pkm_twin.bags.storage import BagFile
from pkm_twin.errors import BagError

_MAX_SEGMENT_BYTES = 1024**2
"""Largest segment of consecutive messages outside chunks, bytes, unless one message is larger."""


@dataclass(slots=True)
class Span:
    """Number of messages, with their first and last log time, ns."""

    count: int = 0
    start: int = 0
    end: int = 0

    def join(self, other: Span) -> None:
        """Add the messages of another span."""
        if other.count:
            self.start = min(self.start, other.start) if self.count else other.start
            self.end = max(self.end, other.end)
            self.count += other.count


@dataclass(frozen=True, slots=True)
class Segment:
    """Part of the file that is loaded at once: a chunk record, or a run of message records.

    ``messages``: the intact ones. ``has_crc``: True if a CRC covers them.
    """

    offset: int
    length: int
    messages: Span
    is_chunk: bool
    has_crc: bool

    def read(self, reader: RecordReader) -> bytes:
        """Read the segment's records again, and check them."""
        data = reader.read_at(self.offset, self.length, "segment")
        if not self.is_chunk:
            return data
        chunk = parse_record(Op.CHUNK, data[FRAME.size :], self.offset)
        return unpack_chunk(chunk, self.offset, reader.budget)


class TrustedSummary(NamedTuple):
    """The content of a summary with a valid CRC, for data that are damaged.

    ``data_end``: offset of the end of the data. ``chunks``: length of each chunk record by its offset,
    in order and without overlap.
    """

    data_end: int
    records: list[mcap.Schema | mcap.Channel]
    chunks: dict[int, int]


class Check:
    """One pass over a file that checks its structure, CRCs, indexes and statistics.

    ``fault``: the first fault, None in a sound file. The pass continues after it; ``segments`` are the
    intact parts. A summary with a valid CRC then supplies lost channels and the positions of later
    chunks.
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
        # Expected index of the last chunk, and the entries that its message indexes must have.
        self._last_chunk_index: mcap.ChunkIndex | None = None
        self._last_chunk_entries: dict[int, list[tuple[int, int]]] = {}
        # Hashes of the indexes that the summary may contain; those of chunks with the chunk's offset.
        self._expected_indexes: set[int] = set()
        self._expected_chunk_indexes: dict[int, int] = {}
        self._chunks_listed: set[int] = set()
        self._attachments = 0
        self.has_data_crc = self.has_summary = self.summary_without_crc = False
        self.statistics: mcap.Statistics | None = None
        self._summary_groups: dict[int, tuple[int, int]] = {}
        self._counts_in_data = (0, 0)
        self.notes: list[str] = []

    def run(self) -> Self:
        """Read the file from its first byte to its last."""
        try:
            self._reader.read_magic()
            if self._read_data():
                self._read_summary()
                self._compare_counts()
        except FormatError as error:
            self._note_fault(error)
        if self.fault and (self._trusted_summary.chunks or any(part.is_chunk for part in self.segments)):
            # In a file with chunks, a message outside a chunk is a damaged record of another kind.
            loose = [part for part in self.segments if not part.is_chunk]
            self.bytes_lost += sum(part.length for part in loose)
            self.segments = [part for part in self.segments if part.is_chunk]
        return self

    @cached_property
    def _trusted_summary(self) -> TrustedSummary:
        nothing = TrustedSummary(self._reader.size, [], {})
        end = self._reader.size - FOOTER_BYTES - len(MAGIC)
        try:
            tail = self._reader.read_at(max(end, 0), FOOTER_BYTES, "footer")
            footer = parse_record(Op.FOOTER, tail[FRAME.size :], end)
            start = footer.summary_start
            if not footer.summary_crc or not len(MAGIC) < start <= end <= start + MAX_RECORD_BYTES:
                return nothing
            summary = self._reader.read_at(start, end - start, "summary")
            # The CRC covers the summary and the footer up to its CRC field.
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
        # Do not trust a list with overlapping chunks.
        overlap = any(at + chunks[at] > behind for at, behind in pairwise(chunks))
        return found._replace(chunks={} if overlap else chunks)

    @property
    def left_out(self) -> str:
        """Data that :func:`recover` loses, in words: the fault with its position, or records left out; else empty."""
        if self.fault:
            at = self.fault.offset
            return self.fault.text if at is None else f"{self.fault.text} (byte {at})"
        kinds = [Op.ATTACHMENT] if self._attachments else list(self.records.unread)
        return f"{opcode_name(kinds[0])} records are not carried over" if kinds else ""

    @property
    def has_crc(self) -> bool:
        """True if a CRC covers every message."""
        return self.has_data_crc or all(part.has_crc for part in self.segments)

    @property
    def has_index(self) -> bool:
        """True if the summary lists every chunk."""
        return bool(self._expected_chunk_indexes) and self._chunks_listed == set(self._expected_chunk_indexes.values())

    @property
    def message_count(self) -> int:
        """Number of intact messages."""
        return sum(part.messages.count for part in self.segments)

    def _note_fault(self, error: FormatError) -> None:
        """Store the first fault, and use the summary's schemas and channels from then on."""
        if self.fault is None:
            self.bytes_lost += self.records.replace(self._trusted_summary.records)
        if self.fault is None or error.reason == EXCEEDS_BUDGET:
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
                uncertain = self.fault or opcode not in OPCODE_NAMES
                if uncertain and opcode != Op.CHUNK and at in self._trusted_summary.chunks:
                    raise FormatError("a chunk's record is damaged", at)
                if at == len(MAGIC) and opcode != Op.HEADER:
                    text = f"the first record is {opcode_name(opcode)}, not the header"
                    self._note_fault(FormatError(text, at))
                if opcode != Op.MESSAGE_INDEX:
                    self._close_chunk(at)
                if (opcode, length) == (Op.FOOTER, FOOTER_BYTES - FRAME.size):
                    self._note_fault(FormatError("a footer record stands in the data section", at))
                    break
                if (opcode, length) == (Op.DATA_END, CRC_BYTES):
                    break
                self._read_record(at, opcode, length)
            except FormatError as error:
                if error.reason == EXCEEDS_BUDGET:
                    raise
                if self.fault:
                    # Continue after the damaged record at ``at``, which should end at ``end``.
                    data_end, _, chunks = self._trusted_summary
                    if at in chunks:
                        end = at + chunks[at]
                    else:
                        # Continue at the next known chunk at the latest: chunks are in order.
                        offsets = [*chunks, data_end]
                        next_known = offsets[min(bisect_right(offsets, at), len(chunks))]
                        end = next_known if end <= at or end > next_known else end
                    self.chunks_lost += opcode == Op.CHUNK or at in chunks
                    self.bytes_lost += end - at
                    self._reader.position = end
                else:
                    # Read the record again, because the summary may have the channel that it needs.
                    reader.position = at
                self._note_fault(error)
        if self.fault:
            return False
        stated = parse_record(opcode, reader.read_body(opcode, length), at).data_section_crc
        if stated not in (0, crc):
            raise FormatError(f"the data's CRC is {crc:08x}; the file says {stated:08x}", at, "crc")
        self.has_data_crc = stated != 0
        self._counts_in_data = (len(self.records.schemas), len(self.records.channels))
        return True

    def _read_record(self, at: int, opcode: int, length: int) -> None:
        """Read and check the record at ``at``, after its opcode and length."""
        reader, record_bytes = self._reader, FRAME.size + length
        if opcode == Op.ATTACHMENT:
            index = reader.read_attachment(at, length)
            self._expected_indexes.add(_hash_index(index))
            self._attachments += 1
            self.bytes_lost += record_bytes
            return
        header = opcode == Op.HEADER and at == len(MAGIC)
        if (
            opcode in OPCODE_NAMES
            and opcode not in (Op.SCHEMA, Op.CHANNEL, Op.MESSAGE, Op.CHUNK, Op.MESSAGE_INDEX, Op.METADATA)
            and not header
        ):
            raise FormatError(f"a {opcode_name(opcode)} record stands in the data section", at)
        body = reader.read_body(opcode, length)
        if opcode not in OPCODE_NAMES:
            self.records.unread[opcode] += 1
            self.bytes_lost += record_bytes
            return
        if opcode == Op.MESSAGE:
            # Join consecutive messages outside chunks to one segment.
            record = FRAME.pack(opcode, length) + body
            span = self._count_messages(record, at)
            last = self.segments[-1] if self.segments else None
            begin, length = at, len(record)
            continues = last and not last.is_chunk and last.offset + last.length == at
            if last and continues and last.length + length <= _MAX_SEGMENT_BYTES:
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
                for kind in self.records.unread:
                    if kind in OPCODE_NAMES:
                        self._note_fault(FormatError(f"a {opcode_name(kind)} record stands in a chunk", at))
                stated = record.message_start_time, record.message_end_time
                if stated != (span.start, span.end):
                    text = f"the chunk's messages span {span.start} to {span.end} ns"
                    self._note_fault(FormatError(f"{text}; the file says {stated[0]} to {stated[1]}", at))
                self.segments.append(
                    Segment(at, record_bytes, span, is_chunk=True, has_crc=record.uncompressed_crc != 0)
                )
                self._last_chunk_index = mcap.ChunkIndex(
                    chunk_start_offset=at,
                    chunk_length=record_bytes,
                    compression=record.compression,
                    compressed_size=len(record.data),
                    uncompressed_size=len(data),
                    message_start_time=span.start,
                    message_end_time=span.end,
                    message_index_offsets={},
                    message_index_length=0,
                )
            case mcap.MessageIndex():
                self._check_message_index(at, record, record_bytes)
            case mcap.Metadata(name=title):
                entries = dict(record.metadata)
                crc = entries.pop(METADATA_CRC, None)
                if crc is not None and crc != metadata_crc(title, entries):
                    raise FormatError(f"metadata {title!r} does not match its CRC", at, "crc")
                self.metadata.append((title, entries, crc is not None))
                self._expected_indexes.add(_hash_index(mcap.MetadataIndex(at, record_bytes, title)))

    def _count_messages(self, data: bytes, at: int) -> Span:
        """Count the messages in ``data``, and store the index entries that they must have."""
        spans: dict[int, Span] = {}
        self._last_chunk_entries = {}
        latest, out_of_order, lost = self.total.end, 0, 0
        for position, message in self.records.iterate_messages(data, at, self._reader.budget):
            number, time = message.channel_id, message.log_time
            self._last_chunk_entries.setdefault(number, []).append((time, position))
            # A compressed message that cannot be decompressed is lost, but the others are not.
            if message.data.startswith(ZSTD_MAGIC):
                try:
                    self.records.unpack_message(message, at, self._reader.budget)
                except FormatError as error:
                    if error.reason == EXCEEDS_BUDGET:
                        raise
                    self._note_fault(error)
                    lost += len(pack_record(message)) - FRAME.size
                    continue
            out_of_order += time < latest
            latest = max(latest, time)
            spans.setdefault(number, Span()).join(Span(1, time, time))
        # Add the counts only now, after all records were read without a fault.
        counted = Span()
        for number, span in spans.items():
            for each in (counted, self.total, self.spans.setdefault(number, Span())):
                each.join(span)
        self.out_of_order += out_of_order
        self.bytes_lost += lost
        return counted

    def _check_message_index(self, at: int, index: mcap.MessageIndex, length: int) -> None:
        number = index.channel_id
        if self.fault:
            return
        if self._last_chunk_index is None or number in self._last_chunk_index.message_index_offsets:
            text = f"a message index of channel {number} belongs to no chunk"
            self._note_fault(FormatError(text, at))
            return
        # The order of the entries differs between writers.
        entries = self._last_chunk_entries.get(number, [])
        if index.records != entries and sorted(index.records) != sorted(entries):
            text = f"the message index of channel {number} differs from the chunk"
            self._note_fault(FormatError(text, at))
        self._last_chunk_index.message_index_offsets[number] = at
        self._last_chunk_index.message_index_length += length

    def _close_chunk(self, at: int) -> None:
        """Store the hash of the last chunk's index, whose message indexes end at ``at``."""
        if self._last_chunk_index is None or self.fault:
            return
        places = self._last_chunk_index.message_index_offsets
        if places and (missing := self._last_chunk_entries.keys() - places.keys()):
            text = f"channels {sorted(missing)} have no message index, others have"
            self._note_fault(FormatError(text, at))
        self._expected_chunk_indexes[_hash_index(self._last_chunk_index)] = self._last_chunk_index.chunk_start_offset
        self._last_chunk_index = None

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
            if opcode in OPCODE_NAMES:
                if Op.SUMMARY_OFFSET in self._summary_groups and opcode != Op.SUMMARY_OFFSET:
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
                        known = self._expected_chunk_indexes.get(_hash_index(record))
                        if known is None or known in self._chunks_listed:
                            where = record.chunk_start_offset
                            raise FormatError(f"a chunk index does not match the chunk at byte {where}", at)
                        self._chunks_listed.add(known)
                    case mcap.MetadataIndex() | mcap.AttachmentIndex():
                        if _hash_index(record) not in self._expected_indexes:
                            text = f"the {opcode_name(opcode)} does not match the one at byte"
                            raise FormatError(f"{text} {record.offset}", at)
                    case mcap.SummaryOffset(group_opcode=kind, group_start=start, group_length=length):
                        # Some writers list groups without records.
                        if length and self._summary_groups.get(kind) != (start, length):
                            text = f"a summary offset does not match the {opcode_name(kind)} records"
                            raise FormatError(text, at)
                    case _:
                        raise FormatError(f"a {opcode_name(opcode)} record stands in the summary", at)
            else:
                self.records.unread[opcode] += 1
            start, size = self._summary_groups.get(opcode, (at, 0))
            if start + size != at:
                text = f"the {opcode_name(opcode)} records of the summary are not together"
                raise FormatError(text, at)
            self._summary_groups[opcode] = (start, reader.position - start)
        footer = parse_record(Op.FOOTER, body, at)
        start = footer.summary_start
        self.has_summary = at > begin
        if start != (begin if self.has_summary else 0) and (start, at) != (begin, begin):
            raise FormatError(f"the footer puts the summary at {start}; it is at {begin}", at)
        found, _ = self._summary_groups.get(Op.SUMMARY_OFFSET, (0, 0))
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
        if self._chunks_listed and not self.has_index:
            unlisted = min(set(self._expected_chunk_indexes.values()) - self._chunks_listed)
            raise FormatError("the summary does not list the chunk here, though others", unlisted)
        if self.statistics is None:
            return
        counts = {number: span.count for number, span in self.spans.items()}
        stated = self.statistics
        stated.channel_message_counts = {
            number: count for number, count in stated.channel_message_counts.items() if count
        }
        # Some writers count schemas and channels that are only in the summary, others do not.
        schemas, channels = len(self.records.schemas), len(self.records.channels)
        ranges = [
            ("schema count", stated.schema_count, self._counts_in_data[0], schemas),
            ("channel count", stated.channel_count, self._counts_in_data[1], channels),
        ]
        for what, stated_count, low, high in ranges:
            if not low <= stated_count <= high:
                text = f"the {what} is {low} to {high}; the statistics say {stated_count}"
                raise FormatError(text, None, "statistics")
        expected = replace(
            stated,
            message_count=self.total.count,
            channel_message_counts=counts,
            attachment_count=self._attachments,
            metadata_count=len(self.metadata),
            chunk_count=len(self._expected_chunk_indexes),
            message_start_time=self.total.start,
            message_end_time=self.total.end,
        )
        for what, found in vars(expected).items():
            if (stated_count := getattr(stated, what)) == found:
                continue
            text = f"the {what.replace('_', ' ')} is {found}; the statistics say {stated_count}"
            # Some writers leave out log times of 0: note a different time, but do not reject the bag.
            if not what.endswith("time"):
                raise FormatError(text, None, "statistics")
            self.notes.append(text)


def check_files(files: Sequence[BagFile]) -> dict[BagFile, Check | BagError]:
    """Check the files of a bag; for a file that cannot be read, return the error.

    :raises BagError: the bag's only file cannot be read, is no bag or costs too much.
    """
    found: dict[BagFile, Check | BagError] = {}
    alone = len(files) == 1
    for file in files:
        try:
            with file.open() as reader:
                found[file] = check = Check(reader).run()
            fault = check.fault
            # An empty file is damage if the bag has further files, otherwise it is no bag.
            reasons = (EXCEEDS_BUDGET, "empty", "not_mcap") if alone else (EXCEEDS_BUDGET,)
            if fault and fault.reason in reasons:
                raise BagError(fault.text, path=file.path, reason=fault.reason, offset=fault.offset)
        except BagError as error:
            if alone:
                raise
            found[file] = error
    return found


def _hash_index(index: mcap.McapRecord) -> int:
    """Hash an index record independently of the order of its channels."""
    if isinstance(index, mcap.ChunkIndex):
        places = dict(sorted(index.message_index_offsets.items()))
        index = replace(index, message_index_offsets=places)
    return hash(pack_record(index))
