# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The records of an MCAP file, read with every length and CRC checked. Imports no ROS."""

from __future__ import annotations

import importlib
import io
import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from itertools import chain
from typing import IO, Any, NamedTuple

MAX_RECORD_BYTES = 256 * 1024**2
"""Largest record that is loaded; attachments and unknown records are passed through in blocks."""
MAX_TOTAL_BYTES = 256 * 1024**3
"""Most that a bag's file may unpack to, and be read, altogether."""
MAX_TOTAL_RATIO = 200
"""Largest ratio of all that is unpacked and read to the file's size, beyond FREE_TOTAL_BYTES."""
FREE_TOTAL_BYTES = 128 * 1024**2
"""Every file may unpack to so much."""
RECORD_COST = 64
"""Bytes that a record in a chunk counts for beside its own: the time that it takes."""
MAX_CHUNK_BYTES = 64 * 1024**2
"""Largest unpacked chunk."""
MAX_RATIO = 1000
"""Largest ratio of unpacked to packed size, for chunks that unpack to more than FREE_BYTES."""
FREE_BYTES = 8 * 1024**2
"""A chunk up to this size may have any ratio: a black image packs ten thousand to one."""
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
MAGIC = b"\x89MCAP0\r\n"
_BLOCK_BYTES = 1024**2
METADATA_CRC = "crc32"


class Op(IntEnum):
    """The kinds of records."""

    HEADER = 1
    FOOTER = 2
    SCHEMA = 3
    CHANNEL = 4
    MESSAGE = 5
    CHUNK = 6
    MESSAGE_INDEX = 7
    CHUNK_INDEX = 8
    ATTACHMENT = 9
    ATTACHMENT_INDEX = 10
    STATISTICS = 11
    METADATA = 12
    METADATA_INDEX = 13
    SUMMARY_OFFSET = 14
    DATA_END = 15


FIRST_UNKNOWN = 16
FRAME = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<HIQQ")
INDEX_ENTRY = struct.Struct("<QQ")
FOOTER_BODY = struct.Struct("<QQI")
CRC = struct.Struct("<I")
_PAIR = struct.Struct("<HQ")
LAYOUTS = {
    Op.HEADER: "ss",
    Op.FOOTER: "QQI",
    Op.SCHEMA: "Hssb",
    Op.CHANNEL: "HHsst",
    Op.CHUNK: "QQQIsl",
    Op.MESSAGE_INDEX: "Hb",
    Op.CHUNK_INDEX: "QQQQpQsQQ",
    Op.ATTACHMENT_INDEX: "QQQQQss",
    Op.STATISTICS: "QHIIIIQQp",
    Op.METADATA: "st",
    Op.METADATA_INDEX: "QQs",
    Op.SUMMARY_OFFSET: "BQQ",
    Op.DATA_END: "I",
}
"""Fields of each kind of record: numbers as in struct; s a text, b bytes, l bytes with a 64-bit
length, t a map of texts, p pairs of a channel and a 64-bit number."""

TOTAL_CAP = "total_cap"
"""Reason of a file that is refused whole for what it would cost."""

_FOREIGN = {
    b"#ROSBAG V2.0": "a ROS 1 bag, not MCAP",
    b"\x1f\x8b": "a gzip-compressed file; unpack it first",
}


class FormatError(Exception):
    """What is wrong and where, before the path is known; never leaves this folder's modules."""

    def __init__(self, text: str, offset: int | None, reason: str = "damaged") -> None:
        super().__init__(text)
        self.text = text
        self.offset = offset
        self.reason = reason


@dataclass(slots=True)
class Span:
    """How many messages, and from when to when by their log times."""

    count: int = 0
    start: int = 0
    end: int = 0

    def add(self, log_time: int) -> None:
        """Count a message."""
        self.start = min(self.start, log_time) if self.count else log_time
        self.end = max(self.end, log_time) if self.count else log_time
        self.count += 1


class Budget:
    """What one file may cost, in bytes read and unpacked, whatever it says of itself.

    Without it a small file of many chunks, each within its own bounds, unpacks to gigabytes.
    """

    def __init__(self, packed: int) -> None:
        self._packed = packed
        self.limit = min(MAX_TOTAL_BYTES, max(FREE_TOTAL_BYTES, MAX_TOTAL_RATIO * packed))
        self._spent = 0

    def spend(self, count: int, offset: int | None) -> None:
        """Take ``count`` bytes; once they are used up the file is rejected."""
        self._spent += count
        if self._spent > self.limit:
            raise FormatError(
                f"the file of {self._packed} bytes unpacks to more than {self.limit}: at most "
                f"{MAX_TOTAL_RATIO} to 1, and {MAX_TOTAL_BYTES} in all",
                offset,
                TOTAL_CAP,
            )


class RecordReader:
    """A file read forward, with its position and the CRC of all that was read."""

    def __init__(self, file: IO[bytes], budget: Budget | None = None) -> None:
        self._descriptor = file.fileno()
        self.size = os.fstat(self._descriptor).st_size
        self.budget = budget or Budget(self.size)
        self.position = 0
        self.crc = 0

    def seek(self, position: int) -> None:
        """Go to a byte; the CRC is then no longer that of the file from its start."""
        self.position = position

    def read(self, count: int, what: str) -> bytes:
        """Read exactly ``count`` bytes."""
        left = self.size - self.position
        if count > left:
            raise FormatError(
                f"the {what} needs {count} bytes, the file has {left} left: it is cut short",
                self.position,
                "truncated",
            )
        self.budget.spend(count, self.position)
        # Others may read the same open file, each at a position of its own.
        data = os.pread(self._descriptor, count, self.position)
        if len(data) != count:
            raise FormatError("the file shrank while it was read", self.position, "truncated")
        self.position += count
        self.crc = zlib.crc32(data, self.crc)
        return data

    def frame(self) -> tuple[int, int]:
        """Read a record's opcode and length; the length is known to lie within the file."""
        at = self.position
        opcode, length = FRAME.unpack(self.read(FRAME.size, "next record"))
        if opcode == 0:
            raise FormatError("a record has the opcode 0", at)
        if length > self.size - self.position:
            raise FormatError(
                f"the {opcode_name(opcode)} record has {length} bytes, the file has "
                f"{self.size - self.position} left: it is cut short",
                at,
                "truncated",
            )
        return opcode, length

    def body(self, opcode: int, length: int) -> bytes:
        """Read a record's content."""
        if length > MAX_RECORD_BYTES:
            raise FormatError(
                f"the {opcode_name(opcode)} record has {length} bytes; at most {MAX_RECORD_BYTES}",
                self.position,
                "size_cap",
            )
        return self.read(length, f"{opcode_name(opcode)} record")

    def skip(self, length: int, what: str, crc: int = 0) -> int:
        """Pass over ``length`` bytes in blocks; return the CRC continued over them."""
        while length:
            block = self.read(min(length, _BLOCK_BYTES), what)
            crc = zlib.crc32(block, crc)
            length -= len(block)
        return crc


@cache
def opcode_name(opcode: int) -> str:
    """Return the name of a kind of record, for error texts."""
    if not 0 < opcode < FIRST_UNKNOWN:
        return f"unknown (0x{opcode:02x})"
    return Op(opcode).name.lower().replace("_", " ")


def utf8(raw: bytes, what: str, offset: int | None) -> str:
    """Decode a text of the record ``what``."""
    try:
        return raw.decode()
    except UnicodeDecodeError:
        raise FormatError(f"a text of the {what} record is not UTF-8", offset) from None


class Fields:
    """The fields of one record, read in turn; nothing is read past its end."""

    def __init__(self, body: bytes, what: str, offset: int) -> None:
        self._body = body
        self._what = what
        self._offset = offset
        self._position = 0

    def take(self, count: int) -> bytes:
        """Read ``count`` bytes."""
        start = self._position
        if count > len(self._body) - start:
            raise FormatError(
                f"a field of the {self._what} record reaches past its end", self._offset
            )
        self._position += count
        return self._body[start : self._position]

    def number(self, code: str) -> int:
        """Read one little-endian number, ``code`` as in struct."""
        value: int = struct.unpack(f"<{code}", self.take(struct.calcsize(f"<{code}")))[0]
        return value

    def blob(self, code: str = "I") -> bytes:
        """Read a length of type ``code`` and as many bytes."""
        return self.take(self.number(code))

    def text(self) -> str:
        """Read a length-prefixed text."""
        return utf8(self.blob(), self._what, self._offset)

    def pairs(self) -> list[tuple[int, int]]:
        """Read a map of 64-bit numbers by channels."""
        raw = self.blob()
        if len(raw) % _PAIR.size:
            raise FormatError(f"a map of the {self._what} record is cut short", self._offset)
        return list(_PAIR.iter_unpack(raw))

    def texts(self) -> dict[str, str]:
        """Read a map of texts; a key given twice is an error."""
        part = Fields(self.blob(), self._what, self._offset)
        result: dict[str, str] = {}
        while part.left:
            key = part.text()
            if key in result:
                raise FormatError(
                    f"the {self._what} record has the key {key!r} twice", self._offset
                )
            result[key] = part.text()
        return result

    @property
    def left(self) -> int:
        """How many bytes have not been read."""
        return len(self._body) - self._position

    def done(self) -> None:
        """Reject bytes after the last field."""
        if self.left:
            raise FormatError(
                f"the {self._what} record has {self.left} bytes too many", self._offset
            )


_READ: dict[str, Callable[[Fields], Any]] = {
    "s": Fields.text,
    "b": Fields.blob,
    "l": lambda fields: fields.blob("Q"),
    "t": Fields.texts,
    "p": Fields.pairs,
}
_WRITE: dict[str, Callable[[Any], bytes]] = {
    "s": lambda text: packed_texts(text),
    "b": lambda data: packed_texts(data),
    "l": lambda data: struct.pack("<Q", len(data)) + data,
    "t": lambda entries: packed_texts(packed_texts(*chain(*entries.items()))),
    "p": lambda pairs: packed_texts(b"".join(_PAIR.pack(*pair) for pair in pairs)),
}


def unpack(opcode: int, body: bytes, offset: int) -> list[Any]:
    """Return the fields of a record by :data:`LAYOUTS`, which it holds and nothing else."""
    fields = Fields(body, opcode_name(opcode), offset)
    values = [
        _READ[code](fields) if code in _READ else fields.number(code)
        for code in LAYOUTS[Op(opcode)]
    ]
    fields.done()
    return values


def pack(opcode: Op, *values: Any) -> bytes:
    """Return the record of these fields."""
    parts = [
        _WRITE[code](value) if code in _WRITE else struct.pack(f"<{code}", value)
        for code, value in zip(LAYOUTS[opcode], values, strict=True)
    ]
    body = b"".join(parts)
    return FRAME.pack(opcode, len(body)) + body


def iterate_records(
    data: bytes, offset: int, budget: Budget | None = None
) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, start and end of each record in unpacked data of the chunk at ``offset``."""
    position = 0
    size = len(data)
    while position < size:
        if budget is not None:
            budget.spend(RECORD_COST, offset)
        if size - position < FRAME.size:
            raise FormatError(f"{size - position} stray bytes end the chunk", offset)
        opcode, length = FRAME.unpack_from(data, position)
        start = position + FRAME.size
        if opcode == 0 or length > size - start:
            raise FormatError(
                f"record 0x{opcode:02x} with {length} bytes at {position} of the unpacked chunk "
                f"does not fit its {size} bytes",
                offset,
            )
        position = start + length
        yield opcode, start, position


class Head(NamedTuple):
    """The fields of a message record; times in ns."""

    channel: int
    sequence: int
    log_time: int
    publish_time: int


@dataclass(frozen=True, slots=True)
class Schema:
    """What a type is called, and its definition in the language ``encoding``."""

    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Channel:
    """One publisher's topic, its type by number, and how its messages are encoded."""

    schema_id: int
    topic: str
    encoding: str
    metadata: Mapping[str, str]


class Records:
    """Schemas and channels seen so far; one number may not mean two things."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.types: dict[int, str] = {}
        self.passed_over: Counter[int] = Counter()

    def messages(
        self, data: bytes, offset: int, budget: Budget | None = None
    ) -> Iterator[tuple[Head, int, int]]:
        """Walk the records in a chunk's data: yield head, start and end of each message.

        Schemas and channels are taken in; other records are counted in ``passed_over``.
        """
        for opcode, start, end in iterate_records(data, offset, budget):
            if opcode == Op.MESSAGE:
                if end - start < MESSAGE_HEAD.size:
                    text = f"a message record has {end - start} bytes"
                    raise FormatError(f"{text}; at least {MESSAGE_HEAD.size}", offset)
                head = Head(*MESSAGE_HEAD.unpack_from(data, start))
                if head.channel not in self.channels:
                    raise FormatError(f"a message has the unknown channel {head.channel}", offset)
                yield head, start, end
            elif opcode in (Op.SCHEMA, Op.CHANNEL):
                self.add(opcode, data[start:end], offset)
            else:
                self.passed_over[opcode] += 1

    def add(self, opcode: int, body: bytes, offset: int) -> None:
        """Take in a schema or channel record."""
        number, *values = unpack(opcode, body, offset)
        if opcode == Op.SCHEMA:
            self._add_schema(number, Schema(*values), offset)
        else:
            self._add_channel(number, Channel(*values), offset)

    def _add_schema(self, number: int, schema: Schema, offset: int) -> None:
        if number == 0:
            raise FormatError("a schema has the number 0", offset)
        if self.schemas.setdefault(number, schema) != schema:
            raise FormatError(f"schema {number} is defined twice, differently", offset)

    def _add_channel(self, number: int, channel: Channel, offset: int) -> None:
        schema = self.schemas.get(channel.schema_id)
        if channel.schema_id and schema is None:
            raise FormatError(
                f"channel {number} has the unknown schema {channel.schema_id}", offset
            )
        if self.channels.setdefault(number, channel) != channel:
            raise FormatError(f"channel {number} is defined twice, differently", offset)
        self.types[number] = schema.name if schema else ""


def metadata(body: bytes, offset: int) -> tuple[str, dict[str, str], bool]:
    """Return a metadata record's name and entries, and whether a CRC of its own confirms them."""
    name, entries = unpack(Op.METADATA, body, offset)
    crc = entries.pop(METADATA_CRC, None)
    if crc is not None and crc != metadata_crc(name, entries):
        raise FormatError(f"metadata {name!r} does not match its CRC", offset, "crc")
    return name, entries, crc is not None


def metadata_crc(name: str, entries: Mapping[str, str]) -> str:
    """CRC over a metadata record; MCAP has none there, and recovery needs one."""
    return f"{zlib.crc32(packed_texts(name, *chain(*sorted(entries.items())))):08x}"


def packed_texts(*texts: str | bytes) -> bytes:
    """Return length-prefixed texts, as records have them."""
    raw = [text.encode() if isinstance(text, str) else text for text in texts]
    return b"".join(struct.pack("<I", len(text)) + text for text in raw)


def read_magic(reader: RecordReader) -> None:
    """Read the opening mark; say in plain words what a file without it is."""
    if reader.size == 0:
        raise FormatError("the file is empty", 0, "empty")
    head = reader.read(min(reader.size, 16), "opening mark")
    for magic, text in _FOREIGN.items():
        if head.startswith(magic):
            raise FormatError(f"this is {text}", 0, "not_mcap")
    if reader.size < len(MAGIC) and MAGIC.startswith(head):
        raise FormatError(
            f"the file ends after {reader.size} bytes: it is cut short", 0, "truncated"
        )
    if not head.startswith(MAGIC):
        raise FormatError(
            "this is not an MCAP file: its first bytes are not the MCAP signature", 0, "not_mcap"
        )
    reader.seek(len(MAGIC))
    reader.crc = zlib.crc32(MAGIC)
    if reader.size == len(MAGIC):
        raise FormatError("the file contains only the MCAP signature", 0, "truncated")


def read_attachment(reader: RecordReader, at: int, length: int) -> tuple[object, ...]:
    """Pass over an attachment in blocks; return what its index must say."""
    end = reader.position + length
    if length < 16 + 4 + 4 + 8 + CRC.size:
        raise FormatError(f"the attachment record has {length} bytes, too few for its fields", at)
    head = reader.read(16, "attachment")
    texts = []
    for _ in range(2):
        prefix = reader.read(4, "attachment")
        (count,) = struct.unpack("<I", prefix)
        if count > end - reader.position:
            raise FormatError("a field of the attachment record reaches past its end", at)
        texts.append(reader.body(Op.ATTACHMENT, count))
        head += prefix + texts[-1]
    prefix = reader.read(8, "attachment")
    (size,) = struct.unpack("<Q", prefix)
    if size != end - reader.position - CRC.size:
        raise FormatError(f"the attachment says {size} bytes of data; its record differs", at)
    head += prefix
    log_time, create_time = struct.unpack("<QQ", head[:16])
    crc = reader.skip(size, "attachment", zlib.crc32(head))
    (stated,) = CRC.unpack(reader.read(CRC.size, "attachment"))
    if stated and stated != crc:
        raise FormatError(
            f"the attachment's CRC is {crc:08x}; the file says {stated:08x}", at, "crc"
        )
    name, media = (utf8(text, "attachment", at) for text in texts)
    return (at, FRAME.size + length, log_time, create_time, size, name, media)


@dataclass(frozen=True, slots=True)
class Chunk:
    """A chunk record's fields, its data unpacked and checked."""

    start: int
    end: int
    compression: str
    packed_size: int
    data: bytes
    has_crc: bool


def read_chunk(body: bytes, offset: int, budget: Budget) -> Chunk:
    """Unpack the chunk record at ``offset`` and compare its CRC, if it has one."""
    start, end, size, crc, compression, packed = unpack(Op.CHUNK, body, offset)
    data = _unpack(compression, packed, size, offset, budget)
    if crc and zlib.crc32(data) != crc:
        raise FormatError(
            f"the chunk's CRC is {zlib.crc32(data):08x}; the file says {crc:08x}", offset, "crc"
        )
    return Chunk(start, end, compression, len(packed), data, crc != 0)


def _unpack(compression: str, packed: bytes, size: int, offset: int, budget: Budget) -> bytes:
    """Unpack a chunk to exactly ``size`` bytes, having checked the size first."""
    if compression not in ("", "zstd", "lz4"):
        raise FormatError(
            f"unknown compression {compression!r}; known: zstd, lz4, none", offset, "compression"
        )
    _check_size("chunk", len(packed), size, offset)
    if not compression:
        if len(packed) != size:
            raise FormatError(f"the chunk has {len(packed)} bytes; the file says {size}", offset)
        return packed
    budget.spend(size, offset)
    # One byte more than declared is let out, to tell a longer content from an exact one.
    data = _decompress(compression, packed, size + 1, offset)
    if len(data) != size:
        more = "more" if len(data) > size else str(len(data))
        raise FormatError(f"the chunk unpacks to {more} bytes; the file says {size}", offset)
    return data


def _check_size(what: str, packed: int, size: int, offset: int) -> None:
    if size > MAX_CHUNK_BYTES:
        raise FormatError(
            f"the {what} unpacks to {size} bytes; at most {MAX_CHUNK_BYTES}", offset, "size_cap"
        )
    if size > FREE_BYTES and size > MAX_RATIO * packed:
        raise FormatError(
            f"the {what} unpacks from {packed} to {size} bytes; at most {MAX_RATIO} to 1",
            offset,
            "size_cap",
        )


def _decompress(compression: str, packed: bytes, limit: int, offset: int) -> bytes:
    """Unpack at most ``limit`` bytes."""
    name = "zstandard" if compression == "zstd" else "lz4.frame"
    try:
        library: Any = importlib.import_module(name)
    except ImportError:
        text = f"the data are packed with {compression}; the Python package {name} is missing"
        raise FormatError(text, offset, "compression") from None
    failures = (library.ZstdError,) if compression == "zstd" else (RuntimeError, EOFError)
    try:
        if compression == "lz4":
            unpacked: bytes = library.LZ4FrameDecompressor().decompress(packed, max_length=limit)
            return unpacked
        window = library.ZstdDecompressor(max_window_size=2 * MAX_CHUNK_BYTES)
        with window.stream_reader(io.BytesIO(packed)) as reader:
            return bytes(reader.read(limit))
    except failures as error:
        raise FormatError(f"the data do not unpack: {error}", offset) from None


def message_data(
    data: bytes, start: int, end: int, encoding: str, offset: int, budget: Budget
) -> bytes:
    """Return a message record's payload, unpacked where rosbag2 has packed each message.

    No plain CDR begins as a zstd frame does, so the bytes decide; rosbag2 says it only outside
    them.
    """
    start += MESSAGE_HEAD.size
    if data[start : start + len(ZSTD_MAGIC)] != ZSTD_MAGIC or encoding != "cdr":
        return data[start:end]
    packed = data[start:end]
    limit = min(MAX_CHUNK_BYTES, max(FREE_BYTES, MAX_RATIO * len(packed)))
    unpacked = _decompress("zstd", packed, limit + 1, offset)
    budget.spend(len(unpacked), offset)
    _check_size("message", len(packed), len(unpacked), offset)
    return unpacked
