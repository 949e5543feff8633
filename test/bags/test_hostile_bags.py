# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Sound CRCs around nonsense: a typed error in bounded time and memory, never a traceback."""

from __future__ import annotations

import struct
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mcap")
pytest.importorskip("zstandard")
from mcap.writer import Writer

from pkm_twin.bags import format as mcap_format
from pkm_twin.bags import reader as bag_reader
from pkm_twin.bags.cdr import MessageCodec
from pkm_twin.bags.definitions import MAX_FIELDS, MAX_NESTING, message_class
from pkm_twin.bags.reader import BagWriter, inspect, open_bag, read_messages
from pkm_twin.bags.recover import recover
from pkm_twin.errors import BagError, one_line
from test.bags.raw import (
    LIMIT,
    MAGIC,
    chunk,
    foreign_bag,
    peak_memory,
    raw_bag,
    record,
    text,
)
from test.support.robots import partly_long

ACTS = (
    "inspect(path).message_count",
    "sum(1 for _ in read_messages(path))",
    "recover(path, path.with_name('saved.mcap'))",
)


@pytest.mark.parametrize("act", ACTS)
def test_many_chunks_that_unpack_to_gigabytes(tmp_path: Path, act: str) -> None:
    """Each within its own bounds: 8 MB of one unknown record in a few hundred bytes."""
    filler = record(0x80, bytes(8 * 1024**2 - 9))
    one = chunk(filler)
    path = raw_bag(tmp_path / "bomb.mcap", one * 300)
    assert path.stat().st_size < 300_000
    said, grown = peak_memory(path, act)
    assert "unpacks to more than 134217728" in said
    assert grown < LIMIT


@pytest.mark.parametrize("act", partly_long(ACTS, ACTS[0]))
def test_many_tiny_records_cost_what_they_take(tmp_path: Path, act: str) -> None:
    """As many records as fit: their number is bounded as well as their bytes."""
    filler = record(0x80, b"") * (8 * 1024**2 // 9)
    path = raw_bag(tmp_path / "bomb.mcap", chunk(filler) * 300)
    said, grown = peak_memory(path, act)
    assert "unpacks to more than" in said
    assert grown < LIMIT


def overlapping(path: Path, count: int = 3000) -> Path:
    """A sound summary that lists chunks inside each other, each reaching to the end."""
    schema = struct.pack("<H", 1) + text(b"std_msgs/msg/String") + text(b"ros2msg")
    channel = struct.pack("<HH", 1, 1) + text(b"/a") + text(b"cdr") + bytes(4)
    head = MAGIC + record(1, bytes(8)) + record(3, schema + text(b"string data"))
    head += record(4, channel)
    size = count * 50
    body = b""
    places = []
    for number in range(count):
        left = size - number * 50
        fields = struct.pack("<QQQI", 0, 0, 8 * 1024**2, 0) + text(b"zstd")
        body += (struct.pack("<BQ", 6, left - 9) + fields).ljust(50, b"\0")
        places.append((len(head) + number * 50, left))
    start = len(head) + len(body)
    summary = b"".join(
        record(
            8,
            struct.pack("<QQQQIQ", 0, 0, at, length, 0, 0) + text(b"zstd") + bytes(16),
        )
        for at, length in places
    )
    footer = struct.pack("<BQQQ", 2, 20, start, 0)
    crc = zlib.crc32(summary + footer)
    path.write_bytes(head + body + summary + footer + struct.pack("<I", crc) + MAGIC)
    return path


def test_overlapping_chunks_in_the_summary_are_of_no_help(tmp_path: Path) -> None:
    path = overlapping(tmp_path / "o.mcap")
    for act in ACTS:
        _, grown = peak_memory(path, act)
        assert grown < LIMIT


def test_salvage_reads_a_file_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bytes read, counted: linear in the file, whatever its summary lists."""
    read = 0
    plain = mcap_format.RecordReader.read

    def count(self: Any, size: int, what: str) -> bytes:
        nonlocal read
        read += size
        return plain(self, size, what)

    monkeypatch.setattr(mcap_format.RecordReader, "read", count)
    path = overlapping(tmp_path / "o.mcap", 1000)
    with pytest.raises(BagError):
        inspect(path)
    assert read < 4 * path.stat().st_size


def test_indexes_are_looked_up_not_searched(tmp_path: Path) -> None:
    """Ten thousand metadata records with their indexes: comparisons stay linear."""
    path = tmp_path / "m.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for number in range(10_000):
            writer.add_metadata(str(number), {})
        writer.finish()
    calls = 0

    def trace(frame: Any, event: str, argument: Any) -> None:
        nonlocal calls
        calls += 1

    sys.setprofile(trace)
    try:
        inspect(path)
    finally:
        sys.setprofile(None)
    assert calls < 600 * 10_000


def test_messages_that_all_overlap_in_time_are_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make_bag: Callable[..., Path]
) -> None:
    path = tmp_path / "t.mcap"
    with BagWriter(path, chunk_size=1000, flush_period=None) as writer:
        writer.add_topic("/a", "std_msgs/msg/String", definition="string data")
        for number in range(400):
            # Every chunk reaches back to the beginning.
            writer.write("/a", {"data": "x" * 100}, 0 if number % 5 == 0 else 10**9 + number)
    monkeypatch.setattr(bag_reader, "MAX_WAITING_BYTES", 100_000)
    with pytest.raises(BagError, match="overlap in time") as caught:
        list(read_messages(path))
    assert caught.value.reason == "overlap"
    assert len(list(read_messages(path, order="file"))) == 400


def test_a_shared_definition_is_read_once(tmp_path: Path) -> None:
    path = tmp_path / "c.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("a/msg/B", "ros2msg", b"float64 x\n" * 50_000)
        for number in range(2000):
            writer.register_channel(f"/t{number}", "cdr", schema)
        writer.finish()
    _, grown = peak_memory(path)
    assert grown < LIMIT


def nested(depth: int) -> bytes:
    parts = [f"T{n + 1} t" if n + 1 < depth else "bool b" for n in range(depth)]
    heads = [f"{'=' * 80}\nMSG: p/T{n}\n{part}" for n, part in enumerate(parts)][1:]
    return "\n".join([parts[0], *heads]).encode()


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("p/msg/M", b"string<=" + b"9" * 5000 + b" x", "field x has the bound"),
        ("p/msg/M", b"float64[" + b"9" * 5000 + b"] x", "field x has the bound"),
        ("p/msg/M", b"float64[<=99999999999] x", "field x has the bound"),
        ("p/msg/T0", nested(400), f"at most {MAX_NESTING - 1}"),
        ("p/msg/M", b"bool b\n" * 3 + b"x" * 2_000_000, "characters; at most"),
        ("p/msg/M", b"\n".join(b"bool b%d" % n for n in range(MAX_FIELDS + 1)), "more than"),
        ("p/msg/M", b"bool b\nbool b", "cannot be attributes"),
        ("p/msg/M", b"bool class", "cannot be attributes"),
        ("p/msg/M", b"nonsense " * 20_000, "is not a field|no definition"),
        ("p/msg/M", b"p/M m", "contains itself"),
        ("", b"bool b", "not a type name"),
        ("M", b"bool b", "not a type name"),
        ("p/msg/M\0", b"bool b", "not a type name"),
        ("p/msg/\xd6", b"bool b", "not a type name"),
        ("p" * 100_000 + "/msg/M", b"bool", "is not a field"),
    ],
)
def test_definitions_that_are_not(tmp_path: Path, name: str, text: bytes, says: str) -> None:
    data = b"\0\1\0\0" + bytes(64)
    path = foreign_bag(tmp_path / "d.mcap", [1], schema=(name, "ros2msg", text), data=data)
    (message,) = read_messages(path)
    with pytest.raises(BagError, match=says) as caught:
        _ = message.message
    assert len(str(caught.value)) < 1000


def test_nesting_within_the_cap_is_read(tmp_path: Path) -> None:
    schema = ("p/msg/T0", "ros2msg", nested(MAX_NESTING))
    path = foreign_bag(tmp_path / "d.mcap", [1], schema=schema, data=b"\0\1\0\0" + bytes(64))
    (message,) = read_messages(path)
    value = message.message
    for _ in range(MAX_NESTING - 1):
        value = value.t
    assert value.b is False


def test_absurd_counts_end_before_memory(tmp_path: Path) -> None:
    text = "E[] a\n" + "=" * 80 + "\nMSG: p/E\n"
    codec = MessageCodec("p/msg/M", text)
    with pytest.raises(BagError, match="needs 4294967295 bytes"):
        codec.decode(b"\0\1\0\0" + b"\xff" * 4 + bytes(100))
    fixed = MessageCodec("p/msg/M", "float64[4294967295] x")
    with pytest.raises(BagError, match="are left"):
        fixed.decode(b"\0\1\0\0" + bytes(100))


def test_two_forms_of_a_topic_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "f.mcap"
    for second, good in ((b"string data  # the same\n", True), (b"string[] data", False)):
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start()
            for text in (b"string data", second):
                schema = writer.register_schema("std_msgs/msg/String", "ros2msg", text)
                channel = writer.register_channel("/t", "cdr", schema)
                writer.add_message(channel, 1, b"\0\1\0\0\0\0\0\0", 1)
            writer.finish()
        if good:
            assert inspect(path).topics["/t"].count == 2
            continue
        with pytest.raises(BagError, match="two forms of the type"):
            open_bag(path)


def test_a_bag_imports_no_package_but_of_messages() -> None:
    for name in ("antigravity/msg/X", "this/msg/X", "os/msg/Path", "json/msg/Decoder"):
        with pytest.raises(BagError, match="not installed"):
            message_class(name)
    assert "antigravity" not in sys.modules and "this" not in sys.modules


def test_what_an_error_repeats_is_one_short_line(tmp_path: Path) -> None:
    path = tmp_path / "n.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        writer.register_channel("/" + "x\n\x1b[31m\u202e" * 100_000, "cdr", schema)
        writer.finish()
    with pytest.raises(BagError) as caught:
        read_messages(path, ["/none"])
    text = str(caught.value)
    assert len(text) < 1000 and text.isprintable() and len(text.splitlines()) == 1
    assert one_line("a\nb") == "a\\nb" and one_line("ordinary") == "ordinary"
    assert len(one_line("\0" * 10_000)) <= 400
    with pytest.raises(BagError):
        recover(path, tmp_path / "new.mcap")
