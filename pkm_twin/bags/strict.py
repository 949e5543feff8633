# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The strict pass over a whole MCAP file. Imports no ROS.

Every statement that the file makes about itself (counts, times, indexes, offsets, CRCs) is compared
with what is there. Memory holds a few numbers for each chunk, never the file.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pkm_twin.bags.definitions import parse_definition
from pkm_twin.bags.format import (
    CRC,
    FIRST_UNKNOWN,
    FRAME,
    INDEX_ENTRY,
    MAGIC,
    MESSAGE_HEAD,
    ZSTD_MAGIC,
    Chunk,
    FormatError,
    Op,
    RecordReader,
    Records,
    Span,
    message_data,
    metadata,
    opcode_name,
    read_attachment,
    read_chunk,
    read_magic,
    unpack,
)
from pkm_twin.errors import BagError


@dataclass(frozen=True)
class TopicInfo:
    """One topic of a bag: log times in ns, 0 without messages; QoS as YAML, as in the file."""

    type: str
    count: int
    start: int
    end: int
    offered_qos: str
    definition: str
    """The message definition in the file; empty where it has none."""
    encoding: str
    """How messages are encoded, ``cdr`` in ROS 2."""
    schema_encoding: str
    """What the definition is written in, ``ros2msg`` or ``ros2idl``; empty where there is none."""


@dataclass(frozen=True)
class BagReport:
    """What a strict pass over a whole bag found. Times are log times in ns, 0 without messages."""

    path: Path
    profile: str
    library: str
    topics: Mapping[str, TopicInfo]
    message_count: int
    start_time: int
    end_time: int
    has_crc: bool
    """Every message is covered by a CRC."""
    has_index: bool
    """Every chunk is listed in the summary."""
    has_summary: bool
    warnings: tuple[str, ...]
    out_of_order: int
    """Messages whose log time is before that of one earlier in the file."""
    metadata: Mapping[str, Mapping[str, str]]
    miscounts: tuple[str, ...] = ()
    """Message counts of the bag's folder that its files contradict; they are warnings too."""

    @property
    def duration(self) -> float:
        """Time from the first message to the last, s."""
        return (self.end_time - self.start_time) * 1e-9


def join_topic(topics: dict[str, TopicInfo], name: str, info: TopicInfo, path: Path) -> None:
    """Add a channel of the topic ``name``: another publisher's, or of another file of the bag.

    :raises BagError: it is not of the type, with the fields, that the topic has so far.
    """
    known = topics.get(name)
    if known is None:
        topics[name] = info
        return
    if known.type != info.type:
        raise BagError(
            f"topic {name} has two types, {known.type} and {info.type}", path=path, reason="type"
        )
    if not _one_form(known, info):
        raise BagError(
            f"topic {name} has two forms of the type {info.type}: definition or encoding differ",
            path=path,
            reason="type",
        )
    if not (known.count and info.count):
        topics[name] = known if known.count or not info.count else info
        return
    start, end = min(known.start, info.start), max(known.end, info.end)
    topics[name] = replace(known, count=known.count + info.count, start=start, end=end)


def _one_form(one: TopicInfo, other: TopicInfo) -> bool:
    """Whether messages of both can be read alike; definitions may differ in comments."""
    if (one.encoding, one.schema_encoding) != (other.encoding, other.schema_encoding):
        return False
    if one.definition == other.definition:
        return True
    if one.schema_encoding != "ros2msg":
        return False
    try:
        fields = [parse_definition(info.type, info.definition) for info in (one, other)]
    except BagError:
        return False
    return fields[0] == fields[1]


# Messages outside chunks are read back in runs of about this size.
_RUN_BYTES = 1024**2


@dataclass(frozen=True, slots=True)
class Segment:
    """Part of the file that is loaded at once: a chunk record, or a run of message records."""

    offset: int
    length: int
    start: int
    end: int
    is_chunk: bool

    def read(self, reader: RecordReader) -> bytes:
        """Return the segment's records, checked once more."""
        reader.seek(self.offset)
        data = reader.read(self.length, "segment")
        if not self.is_chunk:
            return data
        return read_chunk(data[FRAME.size :], self.offset, reader.budget).data


class Walker:
    """Reads the records of a file's data section; what each is worth, a subclass decides."""

    def __init__(self, reader: RecordReader) -> None:
        self._reader = reader
        self.records = Records()
        self._profile = self._library = ""

    def _walk(self, at: int, opcode: int, length: int) -> None:
        """Read the record at ``at``, whose frame has been read."""
        if opcode == Op.ATTACHMENT or opcode >= FIRST_UNKNOWN:
            self._pass_over(at, opcode, length)
            return
        body = self._reader.body(opcode, length)
        if opcode == Op.CHUNK:
            self._take_chunk(at, read_chunk(body, at, self._reader.budget), FRAME.size + length)
        elif opcode == Op.MESSAGE:
            self._take_message(at, FRAME.pack(opcode, length) + body)
        elif opcode in (Op.SCHEMA, Op.CHANNEL):
            self.records.add(opcode, body, at)
        elif opcode == Op.METADATA:
            self._take_metadata(at, FRAME.size + length, *metadata(body, at))
        elif opcode == Op.MESSAGE_INDEX:
            self._take_index(at, *unpack(opcode, body, at))
        elif opcode == Op.HEADER and at == len(MAGIC):
            self._profile, self._library = unpack(opcode, body, at)
        else:
            raise FormatError(f"a {opcode_name(opcode)} record stands in the data section", at)

    def _pass_over(self, at: int, opcode: int, length: int) -> None:
        raise NotImplementedError

    def _take_chunk(self, at: int, chunk: Chunk, length: int) -> None:
        raise NotImplementedError

    def _take_message(self, at: int, record: bytes) -> None:
        raise NotImplementedError

    def _take_metadata(
        self, at: int, length: int, name: str, entries: dict[str, str], verified: bool
    ) -> None:
        raise NotImplementedError

    def _take_index(self, at: int, number: int, entries: bytes) -> None:
        """Use a message index, which repeats what is in the chunk before it."""


class Check(Walker):
    """One pass over a file, in which every statement that it makes about itself is checked."""

    def __init__(self, reader: RecordReader) -> None:
        super().__init__(reader)
        self.segments: list[Segment] = []
        self._spans: dict[int, Span] = {}
        self._total = Span()
        self._out_of_order = 0
        self._metadata: dict[str, dict[str, str]] = {}
        self._summary_without_crc = False
        # Of the last chunk: log times and positions by channel, packed as its index must have them,
        # and each index record's offset.
        self._entries: dict[int, bytearray] = {}
        self._index_offsets: dict[int, int] = {}
        self._index_start = 0
        self._last_chunk: tuple[int, tuple[object, ...]] | None = None
        # A digest of what each chunk's index must say, by the chunk's offset.
        self._chunks: dict[int, int] = {}
        self._chunks_without_crc = 0
        self._indexed: set[int] = set()
        self._metadata_places: set[tuple[int, int, str]] = set()
        self._attachment_places: set[tuple[object, ...]] = set()
        self._has_data_crc = False
        self._has_summary = False
        self._groups: dict[int, list[int]] = {}
        self._offsets: list[tuple[int, int, int]] = []
        self._statistics: tuple[tuple[int, ...], dict[int, int]] | None = None
        self._in_data: tuple[int, int] = (0, 0)
        self._notes: list[str] = []

    def run(self) -> None:
        """Read the file from its first byte to its last."""
        read_magic(self._reader)
        self._read_data()
        self._read_summary()
        self._read_end()
        self._compare_counts()

    def _read_data(self) -> None:
        while True:
            at, crc = self._reader.position, self._reader.crc
            opcode, length = self._reader.frame()
            if at == len(MAGIC) and opcode != Op.HEADER:
                raise FormatError(f"the first record is {opcode_name(opcode)}, not the header", at)
            if opcode != Op.MESSAGE_INDEX:
                self._close_chunk(at)
            if opcode == Op.DATA_END:
                self._read_data_end(at, length, crc)
                return
            self._walk(at, opcode, length)

    def _pass_over(self, at: int, opcode: int, length: int) -> None:
        if opcode == Op.ATTACHMENT:
            self._attachment_places.add(read_attachment(self._reader, at, length))
        else:
            self.records.passed_over[opcode] += 1
            self._reader.skip(length, "record")

    def _take_message(self, at: int, record: bytes) -> None:
        span, _ = self._messages(record, at)
        length = len(record)
        last = self.segments[-1] if self.segments else None
        if (
            last
            and not last.is_chunk
            and last.offset + last.length == at
            and last.length + length <= _RUN_BYTES
        ):
            start, end = min(last.start, span.start), max(last.end, span.end)
            self.segments[-1] = Segment(last.offset, last.length + length, start, end, False)
            return
        self.segments.append(Segment(at, length, span.start, span.end, False))

    def _messages(self, data: bytes, at: int) -> tuple[Span, dict[int, bytearray]]:
        """Count the messages in ``data``; return their span and what their index must say."""
        span = Span()
        entries: dict[int, bytearray] = {}
        for head, start, end in self.records.messages(data, at, self._reader.budget):
            number, time = head.channel, head.log_time
            self._out_of_order += self._total.count > 0 and time < self._total.end
            for each in (self._total, span, self._spans.setdefault(number, Span())):
                each.add(time)
            # A message that is packed by itself must unpack.
            if data.startswith(ZSTD_MAGIC, start + MESSAGE_HEAD.size):
                encoding = self.records.channels[number].encoding
                message_data(data, start, end, encoding, at, self._reader.budget)
            entry = INDEX_ENTRY.pack(time, start - FRAME.size)
            entries.setdefault(number, bytearray()).extend(entry)
        return span, entries

    def _take_chunk(self, at: int, chunk: Chunk, length: int) -> None:
        span, self._entries = self._messages(chunk.data, at)
        for opcode in self.records.passed_over:
            if opcode < FIRST_UNKNOWN:
                raise FormatError(f"a {opcode_name(opcode)} record stands in a chunk", at)
        if (chunk.start, chunk.end) != (span.start, span.end):
            raise FormatError(
                f"the chunk's messages span {span.start} to {span.end} ns; "
                f"the file says {chunk.start} to {chunk.end}",
                at,
            )
        self._chunks_without_crc += not chunk.has_crc
        self.segments.append(Segment(at, length, span.start, span.end, True))
        self._index_start = self._reader.position
        facts = (chunk.start, chunk.end, length)
        sizes = (chunk.compression, chunk.packed_size, len(chunk.data))
        self._last_chunk = (at, (facts, sizes))

    def _take_index(self, at: int, number: int, raw: bytes) -> None:
        if self._last_chunk is None or number in self._index_offsets:
            raise FormatError(f"a message index of channel {number} belongs to no chunk", at)
        if len(raw) % INDEX_ENTRY.size:
            raise FormatError(f"a message index has {len(raw)} bytes of 16-byte entries", at)
        entries = self._entries.get(number, b"")
        # Writers differ in their order.
        if raw != entries and sorted(INDEX_ENTRY.iter_unpack(raw)) != sorted(
            INDEX_ENTRY.iter_unpack(entries)
        ):
            raise FormatError(f"the message index of channel {number} differs from the chunk", at)
        self._index_offsets[number] = at

    def _close_chunk(self, at: int) -> None:
        """Note what the index of the last chunk must say; its message indexes end at ``at``."""
        if self._last_chunk is None:
            return
        missing = self._entries.keys() - self._index_offsets.keys()
        if self._index_offsets and missing:
            raise FormatError(f"channels {sorted(missing)} have no message index, others have", at)
        offset, facts = self._last_chunk
        places = tuple(sorted(self._index_offsets.items()))
        self._chunks[offset] = hash((*facts, at - self._index_start, places))
        self._last_chunk = None
        self._entries = {}
        self._index_offsets = {}

    def _take_metadata(
        self, at: int, length: int, name: str, entries: dict[str, str], verified: bool
    ) -> None:
        # rosbag2 writes its record anew when it closes a bag: the last one holds.
        self._metadata[name] = entries
        self._metadata_places.add((at, length, name))

    def _read_data_end(self, at: int, length: int, crc: int) -> None:
        (stated,) = unpack(Op.DATA_END, self._reader.body(Op.DATA_END, length), at)
        if stated and stated != crc:
            raise FormatError(f"the data's CRC is {crc:08x}; the file says {stated:08x}", at, "crc")
        self._has_data_crc = stated != 0
        self._in_data = (len(self.records.schemas), len(self.records.channels))

    def _read_summary(self) -> None:
        begin = self._reader.position
        self._reader.crc = 0
        while True:
            at, crc = self._reader.position, self._reader.crc
            opcode, length = self._reader.frame()
            body = b"" if opcode >= FIRST_UNKNOWN else self._reader.body(opcode, length)
            if opcode == Op.FOOTER:
                self._read_footer(begin, at, body, crc)
                return
            if opcode >= FIRST_UNKNOWN:
                self._pass_over(at, opcode, length)
            else:
                self._read_summary_record(opcode, at, body)
            group = self._groups.setdefault(opcode, [at, at])
            if group[1] != at:
                raise FormatError(
                    f"the {opcode_name(opcode)} records of the summary are not together", at
                )
            group[1] = self._reader.position

    def _read_summary_record(self, opcode: int, at: int, body: bytes) -> None:
        if opcode in (Op.SCHEMA, Op.CHANNEL):
            self.records.add(opcode, body, at)
            return
        readers: dict[int, Callable[..., None]] = {
            Op.STATISTICS: self._read_statistics,
            Op.CHUNK_INDEX: self._read_chunk_index,
            Op.METADATA_INDEX: self._read_metadata_index,
            Op.ATTACHMENT_INDEX: self._read_attachment_index,
            Op.SUMMARY_OFFSET: self._read_summary_offset,
        }
        if opcode not in readers:
            raise FormatError(f"a {opcode_name(opcode)} record stands in the summary", at)
        if Op.SUMMARY_OFFSET in self._groups and opcode != Op.SUMMARY_OFFSET:
            raise FormatError(
                f"a {opcode_name(opcode)} record stands among the summary offsets", at
            )
        readers[opcode](at, *unpack(opcode, body, at))

    def _read_statistics(self, at: int, *facts: Any) -> None:
        if self._statistics:
            raise FormatError("the summary has two statistics records", at)
        *numbers, pairs = facts
        counts = dict(pairs)
        if len(counts) < len(pairs):
            raise FormatError("the statistics count a channel twice", at)
        self._statistics = (tuple(numbers), counts)

    def _read_chunk_index(
        self, at: int, start: int, end: int, offset: int, length: int,
        places: list[tuple[int, int]], index_length: int, *sizes: Any,
    ) -> None:  # fmt: skip
        stated = hash(((start, end, length), sizes, index_length, tuple(sorted(places))))
        if self._chunks.get(offset) != stated or offset in self._indexed:
            raise FormatError(f"a chunk index does not match the chunk at byte {offset}", at)
        self._indexed.add(offset)

    def _read_metadata_index(self, at: int, *place: Any) -> None:
        if place not in self._metadata_places:
            raise FormatError(
                f"a metadata index does not match the metadata at byte {place[0]}", at
            )

    def _read_attachment_index(self, at: int, *place: Any) -> None:
        if place not in self._attachment_places:
            raise FormatError(f"an attachment index does not match the one at byte {place[0]}", at)

    def _read_summary_offset(self, at: int, opcode: int, start: int, length: int) -> None:
        # Writers may list a group that has no records.
        if length and self._groups.get(opcode) != [start, start + length]:
            raise FormatError(
                f"a summary offset does not match the {opcode_name(opcode)} records", at
            )

    def _read_footer(self, begin: int, at: int, body: bytes, crc: int) -> None:
        start, offset_start, stated = unpack(Op.FOOTER, body, at)
        self._has_summary = at > begin
        if start != (begin if self._has_summary else 0) and (start, at) != (begin, begin):
            raise FormatError(f"the footer puts the summary at {start}; it is at {begin}", at)
        found = self._groups.get(Op.SUMMARY_OFFSET, [0])[0]
        if offset_start not in (found, found or at):
            raise FormatError(
                f"the footer puts the summary offsets at {offset_start}, not {found}", at
            )
        actual = zlib.crc32(FRAME.pack(Op.FOOTER, len(body)) + body[: -CRC.size], crc)
        if stated and stated != actual:
            raise FormatError(
                f"the summary's CRC is {actual:08x}; the file says {stated:08x}", at, "crc"
            )
        self._summary_without_crc = not stated and self._has_summary

    def _read_end(self) -> None:
        at = self._reader.position
        if self._reader.read(len(MAGIC), "closing mark") != MAGIC:
            raise FormatError("the file does not end with the MCAP signature", at)
        if self._reader.position != self._reader.size:
            left = self._reader.size - self._reader.position
            raise FormatError(f"{left} bytes follow the end of the bag", self._reader.position)

    def _compare_counts(self) -> None:
        if self._indexed and self._indexed != self._chunks.keys():
            missing = min(self._chunks.keys() - self._indexed)
            raise FormatError("the summary does not list the chunk here, though others", missing)
        if self._statistics is None:
            return
        (count, schemas, channels, *places, start, end), counts = self._statistics
        stated = {number: value for number, value in counts.items() if value}
        pairs = [
            ("message count", count, self._total.count),
            ("attachment count", places[0], len(self._attachment_places)),
            ("metadata count", places[1], len(self._metadata_places)),
            ("chunk count", places[2], len(self._chunks)),
            ("counts by channel", stated, {n: span.count for n, span in self._spans.items()}),
        ]
        for what, said, found in pairs:
            if said != found:
                raise FormatError(
                    f"the {what} is {found}; the statistics say {said}", None, "statistics"
                )
        # Some writers take a log time of 0 for none. The messages themselves are all there.
        self._notes += [
            f"the {what} is {found}; the statistics say {said}"
            for what, said, found in (
                ("first log time", start, self._total.start),
                ("last log time", end, self._total.end),
            )
            if said != found
        ]
        # Writers differ in whether a schema or channel that is only in the summary counts.
        ranges = [
            ("schema", schemas, self._in_data[0], len(self.records.schemas)),
            ("channel", channels, self._in_data[1], len(self.records.channels)),
        ]
        for what, said, low, high in ranges:
            if not low <= said <= high:
                raise FormatError(
                    f"the bag has {low} to {high} {what}s; the statistics say {said}",
                    None,
                    "statistics",
                )

    def report(self, path: Path) -> BagReport:
        """Return what was found, once :meth:`run` has passed."""
        covered = self._has_data_crc or (
            not self._chunks_without_crc and all(segment.is_chunk for segment in self.segments)
        )
        return BagReport(
            path=path,
            profile=self._profile,
            library=self._library,
            topics=self._topics(path),
            message_count=self._total.count,
            start_time=self._total.start,
            end_time=self._total.end,
            has_crc=covered,
            has_index=bool(self._chunks) and self._indexed == self._chunks.keys(),
            has_summary=self._has_summary,
            warnings=tuple(self._all_warnings(covered)),
            out_of_order=self._out_of_order,
            metadata=self._metadata,
        )

    def _all_warnings(self, covered: bool) -> Iterator[str]:
        if not covered:
            without = f"{self._chunks_without_crc} of {len(self._chunks)} chunks have no CRC"
            bare = not self._chunks or self._chunks_without_crc == len(self._chunks)
            yield (
                f"{'the messages have no CRC' if bare else without}, as rosbag2 writes by default: "
                "lengths, counts, times and indexes agree, a changed value would go unseen"
            )
        elif not self._has_data_crc:
            yield "the data section has no CRC of its own: metadata and record headers are unproven"
        if covered and self._summary_without_crc:
            yield "the summary has no CRC"
        if not self._has_summary:
            yield "there is no summary: read by a scan, the message count is unproven"
        elif self._statistics is None:
            yield "the summary has no statistics: the message count is unproven"
        yield from self._notes
        if self._out_of_order:
            yield f"{self._out_of_order} messages are out of order by log time"
        if unknown := self.records.passed_over.total():
            yield f"{unknown} records of unknown kinds were passed over"

    def _topics(self, path: Path) -> dict[str, TopicInfo]:
        topics: dict[str, TopicInfo] = {}
        # Many channels may share one long definition.
        definitions = {
            number: schema.data.decode(errors="replace")
            for number, schema in self.records.schemas.items()
        }
        for number, channel in self.records.channels.items():
            kind = self.records.types[number]
            schema = self.records.schemas.get(channel.schema_id)
            span = self._spans.get(number, Span())
            qos = channel.metadata.get("offered_qos_profiles", "")
            info = TopicInfo(
                type=kind,
                count=span.count,
                start=span.start,
                end=span.end,
                offered_qos=qos,
                definition=definitions.get(channel.schema_id, ""),
                encoding=channel.encoding,
                schema_encoding=schema.encoding if schema else "",
            )
            join_topic(topics, channel.topic, info, path)
        return dict(sorted(topics.items()))
