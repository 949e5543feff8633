# SPDX-License-Identifier: Apache-2.0
"""What an MCAP file packs, chunks and single messages, unpacked within limits. Imports no ROS."""

from __future__ import annotations

import importlib
import io
import struct
import zlib
from dataclasses import dataclass
from typing import Any

from pkm_twin.bags.format import MESSAGE_HEAD, Budget, Fields, FormatError

MAX_CHUNK_BYTES = 64 * 1024**2
"""Largest unpacked chunk."""
MAX_RATIO = 1000
"""Largest ratio of unpacked to packed size, for chunks that unpack to more than FREE_BYTES."""
FREE_BYTES = 8 * 1024**2
"""A chunk up to this size may have any ratio: a black image packs ten thousand to one."""
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_CHUNK_HEAD = struct.Struct("<QQQI")


@dataclass(frozen=True, slots=True)
class _Chunk:
    """A chunk record's fields, its data unpacked and checked."""

    start: int
    end: int
    compression: str
    packed_size: int
    data: bytes
    has_crc: bool


def read_chunk(body: bytes, offset: int, budget: Budget) -> _Chunk:
    """Unpack the chunk record at ``offset`` and compare its CRC, if it has one."""
    fields = Fields(body, "chunk", offset)
    start, end, size, crc = _CHUNK_HEAD.unpack(fields.take(_CHUNK_HEAD.size))
    compression = fields.text()
    packed = fields.blob("Q")
    fields.done()
    data = _unpack(compression, packed, size, offset, budget)
    if crc and zlib.crc32(data) != crc:
        raise FormatError(
            f"the chunk's CRC is {zlib.crc32(data):08x}; the file says {crc:08x}", offset, "crc"
        )
    return _Chunk(start, end, compression, len(packed), data, crc != 0)


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

    No plain CDR begins as a zstd frame does, so the bytes tell; rosbag2 says it only beside them.
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
