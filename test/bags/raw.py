# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Bags of another program, records by hand, and the memory that a process takes for them."""

from __future__ import annotations

import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mcap")
pytest.importorskip("zstandard")
import zstandard
from mcap.writer import Writer

MAGIC = b"\x89MCAP0\r\n"
LIMIT = 60_000
"""How much a process may grow by a hostile file, kB."""


def foreign_bag(
    path: Path,
    times: list[int],
    *,
    schema: tuple[str, str, bytes] = ("std_msgs/msg/String", "ros2msg", b"string data"),
    encoding: str = "cdr",
    data: bytes = b"\x00\x01\x00\x00\x02\x00\x00\x00a\x00",
    **options: Any,
) -> Path:
    """Write a bag as other programs do, with the choices that they have."""
    with path.open("wb") as file:
        writer = Writer(file, **({"chunk_size": 200} | options))
        writer.start(profile="ros2", library="another program")
        number = writer.register_channel("/text", encoding, writer.register_schema(*schema))
        for sequence, now in enumerate(times):
            writer.add_message(number, now, data, now, sequence=sequence)
        writer.finish()
    return path


def record(opcode: int, content: bytes) -> bytes:
    """A record of any kind."""
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value: bytes) -> bytes:
    """A text with its length."""
    return struct.pack("<I", len(value)) + value


def chunk(records: bytes) -> bytes:
    """A sound chunk of any records."""
    packed = zstandard.compress(records, 19)
    return raw_chunk(packed, size=len(records), crc=zlib.crc32(records))


def raw_chunk(body: bytes, *, size: int, compression: bytes = b"zstd", crc: int = 0) -> bytes:
    """A chunk that declares what it likes."""
    head = struct.pack("<QQQI", 0, 0, size, crc) + text(compression)
    return record(6, head + struct.pack("<Q", len(body)) + body)


def raw_bag(path: Path, records: bytes) -> Path:
    """Put records between a header and an end without CRCs or summary."""
    end = record(15, bytes(4)) + record(2, bytes(20))
    path.write_bytes(MAGIC + record(1, bytes(8)) + records + end + MAGIC)
    return path


def peak_memory(path: Path, act: str = "inspect(path).message_count") -> tuple[str, int]:
    """What a process of its own prints, or its error, and by how many kB it grew."""
    program = (
        "import resource, sys\nfrom pathlib import Path\n"
        "from pkm_twin.bags.reader import inspect, read_messages\n"
        "from pkm_twin.bags.recover import recover\nfrom pkm_twin.errors import BagError\n"
        "path = Path(sys.argv[1])\n"
        "resource.setrlimit(resource.RLIMIT_AS, (1_500_000_000,) * 2)\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        f"try:\n    print({act})\nexcept BagError as error:\n    print(error)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(path)],
        capture_output=True,
        text=True,
        check=True,
        env={"PYTHONPATH": ":".join(sys.path)},
    )
    said, grown = done.stdout.splitlines()
    return said, int(grown)
