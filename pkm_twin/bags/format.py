# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The records of an MCAP file, by the package ``mcap``, with what it leaves unchecked.

``mcap`` reads short where a file is cut, takes an unknown compression for none, unpacks without a
bound, and overlooks bytes behind a record's fields and keys given twice. Here a record counts only
if ``mcap`` writes it as it stands in the file, and nothing is unpacked before its size is known.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import chain
from typing import IO, Any

import lz4.frame
import zstandard
from mcap import records as mcap
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode as Op
from mcap.writer import MCAP0_MAGIC as MAGIC

MAX_RECORD_BYTES = 256 * 1024**2
"""Largest record that is loaded; attachments and unknown records are passed over in blocks."""
MAX_TOTAL_BYTES = 256 * 1024**3
"""Most that a bag's file may unpack to, and be read, altogether."""
MAX_TOTAL_RATIO = 200
"""Largest ratio of all that is unpacked and read to the file's size, beyond FREE_TOTAL_BYTES."""
FREE_TOTAL_BYTES = 128 * 1024**2
"""Bytes that every file may unpack to, whatever its size."""
MAX_CHUNK_BYTES = 64 * 1024**2
"""Largest unpacked chunk."""
MAX_RATIO = 1000
"""Largest ratio of unpacked to packed size, for chunks that unpack to more than FREE_BYTES."""
FREE_BYTES = 8 * 1024**2
"""A chunk up to this size may have any ratio: a black image packs ten thousand to one."""
ZSTD_MAGIC = zstandard.FRAME_HEADER
METADATA_CRC = "crc32"
EXCEEDS_BUDGET = "total_cap"
"""Reason of a file that is rejected because reading it would exceed the budget."""
FRAME = struct.Struct("<BQ")
FOOTER_BYTES = FRAME.size + 20
CRC_BYTES = 4
_BLOCK_BYTES = 1024**2
_MESSAGE = struct.Struct("<HIQQ")
_INDEX, _INDEX_ENTRY = struct.Struct("<HI"), struct.Struct("<QQ")
OPCODE_NAMES = {int(op): op.name.lower().replace("_", " ") for op in Op}


class FormatError(Exception):
    """A fault at a byte of a file; other modules of this folder add the path and raise BagError."""

    def __init__(self, text: str, offset: int | None, reason: str = "damaged") -> None:
        super().__init__(text)
        self.text = text
        self.offset = offset
        self.reason = reason


class Budget:
    """Bound the bytes that are read and unpacked of one file.

    Otherwise a small file of many chunks, each within its own bounds, could unpack to gigabytes.
    """

    def __init__(self, packed: int) -> None:
        self._packed = packed
        self.limit = min(MAX_TOTAL_BYTES, max(FREE_TOTAL_BYTES, MAX_TOTAL_RATIO * packed))
        self._spent = 0

    def spend(self, count: int, offset: int | None) -> None:
        """Count bytes that are read or unpacked.

        :raises FormatError: the sum exceeds the limit.
        """
        self._spent += count
        if self._spent > self.limit:
            text = f"the file of {self._packed} bytes unpacks to more than {self.limit}"
            most = f"at most {MAX_TOTAL_RATIO} to 1, and {MAX_TOTAL_BYTES} in all"
            raise FormatError(f"{text}: {most}", offset, EXCEEDS_BUDGET)


class RecordReader:
    """A file that is read forward, with its position and the CRC of the bytes read."""

    def __init__(self, file: IO[bytes], budget: Budget | None = None) -> None:
        self._descriptor = file.fileno()
        self.size = os.fstat(self._descriptor).st_size
        self.budget = budget or Budget(self.size)
        self.position = 0
        self.crc = 0

    def read_at(self, position: int, count: int, what: str) -> bytes:
        """Read exactly ``count`` bytes at a position, without moving the reader."""
        left = self.size - position
        if count > left:
            text = f"the {what} needs {count} bytes, the file has {left} left: it is cut short"
            raise FormatError(text, position, "truncated")
        self.budget.spend(count, position)
        # Read by position, because several readers may use the same open file.
        data = os.pread(self._descriptor, count, position)
        if len(data) != count:
            raise FormatError("the file shrank while it was read", position, "truncated")
        return data

    def read(self, count: int, what: str) -> bytes:
        """Read exactly the next ``count`` bytes."""
        data = self.read_at(self.position, count, what)
        self.position += count
        self.crc = zlib.crc32(data, self.crc)
        return data

    def read_frame(self) -> tuple[int, int]:
        """Read a record's opcode and length, and check that the record ends within the file."""
        at = self.position
        opcode, length = FRAME.unpack(self.read(FRAME.size, "next record"))
        left = self.size - self.position
        if opcode == 0:
            raise FormatError("a record has the opcode 0", at)
        if length > left:
            text = f"the {opcode_name(opcode)} record has {length} bytes, the file has {left} left"
            raise FormatError(f"{text}: it is cut short", at, "truncated")
        return opcode, length

    def read_body(self, opcode: int, length: int) -> bytes:
        """Read a record's content; skip an unknown record and return no bytes."""
        what = f"{opcode_name(opcode)} record"
        if opcode not in OPCODE_NAMES:
            self.skip(length, what)
            return b""
        if length > MAX_RECORD_BYTES:
            text = f"the {what} has {length} bytes; at most {MAX_RECORD_BYTES}"
            raise FormatError(text, self.position, "size_cap")
        return self.read(length, what)

    def skip(self, length: int, what: str, crc: int = 0) -> int:
        """Skip ``length`` bytes in blocks; return ``crc`` updated with them."""
        while length:
            block = self.read(min(length, _BLOCK_BYTES), what)
            crc = zlib.crc32(block, crc)
            length -= len(block)
        return crc

    def read_attachment(self, at: int, length: int) -> mcap.AttachmentIndex:
        """Check the attachment at ``at`` in blocks; return the index that the summary must have for it."""
        what, end = "attachment record", self.position + length
        head = self.read(max(0, min(length - CRC_BYTES, _BLOCK_BYTES)), what)
        stream = _StrictStream(io.BytesIO(head))
        with _name_record_in_errors(Op.ATTACHMENT, at):
            logged, created = stream.read8(), stream.read8()
            title, media = stream.read_prefixed_string(), stream.read_prefixed_string()
            size = stream.read8()
        if size != length - stream.count - CRC_BYTES:
            raise FormatError(f"the attachment says {size} bytes of data; its record differs", at)
        crc = self.skip(end - CRC_BYTES - self.position, what, zlib.crc32(head))
        stated = int.from_bytes(self.read(CRC_BYTES, what), "little")
        # A CRC of zero means that there is none.
        if stated not in (0, crc):
            text = f"the attachment's CRC is {crc:08x}; the file says {stated:08x}"
            raise FormatError(text, at, "crc")
        return mcap.AttachmentIndex(at, FRAME.size + length, logged, created, size, title, media)

    def read_magic(self) -> None:
        """Read the MCAP signature.

        :raises FormatError: the file has none; the error names its kind if it is a known one.
        """
        head = self.read(min(self.size, 16), "opening mark")
        for magic, text in {
            b"#ROSBAG V2.0": "a ROS 1 bag, not MCAP",
            b"\x1f\x8b": "a gzip-compressed file; unpack it first",
        }.items():
            if head.startswith(magic):
                raise FormatError(f"this is {text}", 0, "not_mcap")
        if not head:
            raise FormatError("the file is empty", 0, "empty")
        if self.size < len(MAGIC) and MAGIC.startswith(head):
            text = f"the file ends after {self.size} bytes: it is cut short"
            raise FormatError(text, 0, "truncated")
        if not head.startswith(MAGIC):
            text = "this is not an MCAP file: its first bytes are not the MCAP signature"
            raise FormatError(text, 0, "not_mcap")
        if self.size == len(MAGIC):
            raise FormatError("the file contains only the MCAP signature", 0, "truncated")
        self.position, self.crc = len(MAGIC), zlib.crc32(MAGIC)


def opcode_name(opcode: int) -> str:
    """Return the name of an opcode, for errors."""
    return OPCODE_NAMES.get(opcode, f"unknown (0x{opcode:02x})")


class _StrictStream(ReadDataStream):
    """Raises an error if a field reaches past its record's end, where ``mcap`` would return fewer bytes."""

    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) != length:
            raise EndOfFile
        return data


@contextmanager
def _name_record_in_errors(opcode: int, offset: int) -> Iterator[None]:
    """Convert errors of ``mcap`` in a record's fields to a FormatError with the record's position."""
    try:
        yield
    except (EndOfFile, OverflowError, struct.error):
        text = f"a field of the {opcode_name(opcode)} record reaches past its end"
        raise FormatError(text, offset) from None
    except UnicodeDecodeError:
        text = f"a text of the {opcode_name(opcode)} record is not UTF-8"
        raise FormatError(text, offset) from None


def parse_record(opcode: int, body: bytes, offset: int) -> Any:
    """Parse a record of a known kind.

    :raises FormatError: the record has missing, further or repeated content.
    """
    if opcode == Op.MESSAGE_INDEX and len(body) >= _INDEX.size:
        # Unpack a sound index here, because mcap.MessageIndex.read takes ten times as long.
        number, size = _INDEX.unpack_from(body)
        if size == len(body) - _INDEX.size and size % _INDEX_ENTRY.size == 0:
            return mcap.MessageIndex(number, list(_INDEX_ENTRY.iter_unpack(body[_INDEX.size :])))
    stream = _StrictStream(io.BytesIO(body))
    with _name_record_in_errors(opcode, offset):
        record = getattr(mcap, Op(opcode).name.title().replace("_", "")).read(stream)
    if left := len(body) - stream.count:
        raise FormatError(f"the {opcode_name(opcode)} record has {left} bytes too many", offset)
    # Do not compare chunks, which may be large and have no map.
    if opcode != Op.CHUNK and pack_record(record)[FRAME.size :] != body:
        text = f"a map of the {opcode_name(opcode)} record has a key twice, or another length"
        raise FormatError(text, offset)
    return record


def pack_record(record: mcap.McapRecord) -> bytes:
    """Encode a record, with opcode and length."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


def iterate_records(data: bytes, offset: int, budget: Budget | None = None) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, start and end of each record in unpacked data of the chunk at ``offset``."""
    position, size = 0, len(data)
    while position < size:
        if budget is not None:
            budget.spend(64, offset)
        if size - position < FRAME.size:
            raise FormatError(f"{size - position} stray bytes end the chunk", offset)
        opcode, length = FRAME.unpack_from(data, position)
        start = position + FRAME.size
        if opcode == 0 or length > size - start:
            text = f"record 0x{opcode:02x} with {length} bytes at {position} of the unpacked chunk"
            raise FormatError(f"{text} does not fit its {size} bytes", offset)
        position = start + length
        yield opcode, start, position


class Records:
    """Schemas and channels that were read so far, by number; each number has one meaning."""

    def __init__(self) -> None:
        self.schemas: dict[int, mcap.Schema] = {}
        self.channels: dict[int, mcap.Channel] = {}
        self.unread: Counter[int] = Counter()

    def iterate_messages(
        self, data: bytes, offset: int, budget: Budget | None = None
    ) -> Iterator[tuple[int, mcap.Message]]:
        """Yield each message of a chunk's data with its position.

        Adds the chunk's schemas and channels; counts other records in ``unread``.
        """
        for opcode, start, end in iterate_records(data, offset, budget):
            if opcode == Op.MESSAGE:
                if end - start < _MESSAGE.size:
                    text = f"a message record has {end - start} bytes; at least {_MESSAGE.size}"
                    raise FormatError(text, offset)
                # Unpack here, because mcap.Message.read takes five times as long.
                number, sequence, logged, published = _MESSAGE.unpack_from(data, start)
                if number not in self.channels:
                    raise FormatError(f"a message has the unknown channel {number}", offset)
                content = data[start + _MESSAGE.size : end]
                yield start - FRAME.size, mcap.Message(number, logged, content, published, sequence)
            elif opcode in (Op.SCHEMA, Op.CHANNEL):
                self.add(parse_record(opcode, data[start:end], offset), offset)
            else:
                self.unread[opcode] += 1

    def add(self, record: mcap.Schema | mcap.Channel, offset: int) -> None:
        """Add a schema or channel.

        :raises FormatError: its number is invalid or has another meaning already.
        """
        known: mcap.McapRecord
        if isinstance(record, mcap.Schema):
            what, known = "schema", self.schemas.setdefault(record.id, record)
            if record.id == 0:
                raise FormatError("a schema has the number 0", offset)
        else:
            what, number = "channel", record.schema_id
            if number and number not in self.schemas:
                text = f"channel {record.id} has the unknown schema {number}"
                raise FormatError(text, offset)
            known = self.channels.setdefault(record.id, record)
        if known != record:
            raise FormatError(f"{what} {record.id} is defined twice, differently", offset)

    def replace(self, records: Iterable[mcap.Schema | mcap.Channel]) -> int:
        """Replace damaged schemas and channels by intact ones; return the damaged bytes."""
        wrong = 0
        for record in records:
            numbers: dict[int, Any] = self.schemas if type(record) is mcap.Schema else self.channels
            known = numbers.get(record.id, record)
            wrong += len(pack_record(known)) if known != record else 0
            numbers[record.id] = record
        return wrong

    def unpack_message(self, message: mcap.Message, offset: int, budget: Budget) -> bytes:
        """Return a message's data, decompressed if rosbag2 compressed each message.

        The first bytes show it, because no plain CDR begins like a zstd frame; rosbag2 states it in
        the folder's metadata only.
        """
        packed = message.data
        cdr = self.channels[message.channel_id].message_encoding == "cdr"
        if not cdr or not packed.startswith(ZSTD_MAGIC):
            return packed
        limit = min(MAX_CHUNK_BYTES, max(FREE_BYTES, MAX_RATIO * len(packed)))
        data = _decompress("zstd", packed, limit + 1, offset)
        budget.spend(len(data), offset)
        _check_size("message", len(packed), len(data), offset)
        return data


def metadata_crc(title: str, entries: Mapping[str, str]) -> str:
    """Return the CRC of a metadata record, which MCAP lacks and recovery needs."""
    texts = [text.encode() for text in (title, *chain(*sorted(entries.items())))]
    raw = b"".join(struct.pack("<I", len(text)) + text for text in texts)
    return f"{zlib.crc32(raw):08x}"


def unpack_chunk(chunk: mcap.Chunk, offset: int, budget: Budget) -> bytes:
    """Decompress a chunk after checking its size, and check its CRC if it has one."""
    compression, size, data = chunk.compression, chunk.uncompressed_size, chunk.data
    if compression not in ("", "zstd", "lz4"):
        text = f"unknown compression {compression!r}; known: zstd, lz4, none"
        raise FormatError(text, offset, "compression")
    _check_size("chunk", len(data), size, offset)
    if compression:
        budget.spend(size, offset)
        # Ask for one byte more than declared, to detect longer content.
        data = _decompress(compression, data, size + 1, offset)
    if len(data) != size:
        more = "more" if len(data) > size else str(len(data))
        raise FormatError(f"the chunk unpacks to {more} bytes; the file says {size}", offset)
    crc, stated = zlib.crc32(data), chunk.uncompressed_crc
    if stated not in (0, crc):
        text = f"the chunk's CRC is {crc:08x}; the file says {stated:08x}"
        raise FormatError(text, offset, "crc")
    return data


def _check_size(what: str, packed: int, size: int, offset: int) -> None:
    if size > MAX_CHUNK_BYTES:
        text = f"the {what} unpacks to {size} bytes; at most {MAX_CHUNK_BYTES}"
        raise FormatError(text, offset, "size_cap")
    if size > FREE_BYTES and size > MAX_RATIO * packed:
        text = f"the {what} unpacks from {packed} to {size} bytes; at most {MAX_RATIO} to 1"
        raise FormatError(text, offset, "size_cap")


def _decompress(compression: str, data: bytes, limit: int, offset: int) -> bytes:
    """Decompress at most ``limit`` bytes, which the libraries' one-shot functions cannot bound."""
    try:
        if compression == "lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=limit))
        window = zstandard.ZstdDecompressor(max_window_size=2 * MAX_CHUNK_BYTES)
        with window.stream_reader(io.BytesIO(data)) as reader:
            return bytes(reader.read(limit))
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise FormatError(f"the data do not unpack: {error}", offset) from None
