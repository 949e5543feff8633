# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Strict reading: a damaged bag never gives a wrong value, a strange one never a traceback."""

from __future__ import annotations

import io
import random
import resource
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mcap")
pytest.importorskip("zstandard")
import zstandard
from mcap.writer import CompressionType, IndexType, Writer

from pkm_twin.bags import format as mcap_format
from pkm_twin.bags.reader import (
    BagMessage,
    BagWriter,
    DamagedBagError,
    inspect,
    open_bag,
    read_messages,
)
from pkm_twin.errors import BagError
from test.bags.raw import LIMIT, MAGIC, foreign_bag, peak_memory, raw_bag, raw_chunk, record
from test.support.robots import often

FLIPS = 750
Rows = Callable[[Any], list[tuple[Any, ...]]]


def test_report(bag: Path) -> None:
    report = inspect(bag)
    assert (report.profile, report.library) == ("ros2", "pkm_twin")
    assert report.message_count == 72
    assert (report.start_time, report.end_time) == (10**9, 10**9 + 59 * 10**6)
    assert report.duration == pytest.approx(0.059)
    assert report.has_crc and report.has_index and report.has_summary
    assert report.warnings == () and report.out_of_order == 0
    assert report.metadata == {"pkm_twin": {"robot": "x"}}
    note = report.topics["/note"]
    assert (note.type, note.count, note.start) == ("std_msgs/msg/String", 12, 10**9)
    assert note.end == 10**9 + 55 * 10**6
    assert "reliability: reliable" in note.offered_qos


def test_messages_have_the_attributes_of_live_ones(bag: Path) -> None:
    message = next(m for m in read_messages(bag, ["/joint_states"]) if m.log_time > 10**9)
    assert message.message.header.stamp.nanosec == 10**6
    assert list(message.message.position) == [0.1, -1.0]
    assert message.publish_time == message.log_time - 10


def test_topics_are_filtered_and_unknown_ones_named(bag: Path) -> None:
    assert len(list(read_messages(bag, "/note"))) == 12
    with pytest.raises(BagError, match=r"/nope.*/joint_states, /note") as caught:
        read_messages(bag, ["/nope"])
    assert caught.value.reason == "no_topic"


@pytest.mark.parametrize("every", often(False, True))
@pytest.mark.timeout(3600)
def test_every_bit_is_covered_by_a_check(bag: Path, tmp_path: Path, rows: Rows, every: bool) -> None:
    """Flip one bit at a time: nothing may be handed out that differs from what was recorded."""
    sound = bag.read_bytes()
    expected = rows(read_messages(bag))
    target = tmp_path / "flipped.mcap"
    bits = range(8 * len(sound))
    unseen = []
    for bit in bits if every else random.Random(20240501).sample(bits, FLIPS):
        damaged = bytearray(sound)
        damaged[bit // 8] ^= 1 << bit % 8
        target.write_bytes(damaged)
        try:
            list(read_messages(target))
        except BagError:
            continue
        unseen.append(bit)
    assert unseen == []
    assert rows(read_messages(bag)) == expected


@pytest.mark.parametrize("step", often(37, 7))
@pytest.mark.parametrize("length", [1, 4, 8, 64])
def test_zeroed_bytes(bag: Path, tmp_path: Path, rows: Rows, length: int, step: int) -> None:
    """Zeroed CRC fields are harmless, everything else is found."""
    sound = bag.read_bytes()
    expected = rows(read_messages(bag))
    target = tmp_path / "zeroed.mcap"
    for start in range(0, len(sound) - length, step):
        damaged = sound[:start] + bytes(length) + sound[start + length :]
        target.write_bytes(damaged)
        try:
            found = rows(read_messages(target))
        except BagError:
            continue
        assert found == expected


def test_foreign_bag_without_crcs_gives_no_wrong_times_or_counts(tmp_path: Path, rows: Rows) -> None:
    """Without CRCs, damage to values goes unseen, but not to what the indexes repeat."""
    times = [10**9 + 7 * i for i in range(40)]
    plain = {"compression": CompressionType.NONE, "enable_crcs": False}
    path = foreign_bag(tmp_path / "plain.mcap", times, **plain)
    assert any("no CRC" in warning for warning in inspect(path).warnings)
    assert not inspect(path).has_crc
    sound = path.read_bytes()
    chance = random.Random(7)
    for _ in range(300):
        damaged = bytearray(sound)
        bit = chance.randrange(8 * len(sound))
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        try:
            found = [m.log_time for m in read_messages(path)]
        except BagError:
            continue
        assert found == times


@pytest.mark.parametrize("step", often(7, 1))
def test_cut_at_every_byte(tmp_path: Path, make_bag: Callable[..., Path], step: int) -> None:
    sound = make_bag(tmp_path / "sound.mcap", 20, chunk_size=600).read_bytes()
    target = tmp_path / "cut.mcap"
    last = 0
    for length in sorted({*range(0, len(sound), step), len(sound) - 1}):
        target.write_bytes(sound[:length])
        with pytest.raises(BagError) as caught:
            inspect(target)
        if length == 0:
            assert caught.value.reason == "empty"
            continue
        assert isinstance(caught.value, DamagedBagError)
        assert caught.value.salvageable >= last
        last = caught.value.salvageable
    assert last == 24


@pytest.mark.parametrize(
    ("content", "reason", "text"),
    [
        (b"", "empty", "is empty"),
        (MAGIC, "truncated", "contains only the MCAP signature"),
        (MAGIC[:5], "truncated", "cut short"),
        (b"SQLite format 3\x00" + bytes(100), "not_mcap", "SQLite"),
        (b"#ROSBAG V2.0\n", "not_mcap", "ROS 1"),
        (b"PK\x03\x04 anything at all", "not_mcap", "not an MCAP file"),
        (MAGIC * 2, "truncated", "cut short"),
        (MAGIC + bytes(200), "damaged", "opcode 0"),
    ],
)
def test_what_is_no_bag(tmp_path: Path, content: bytes, reason: str, text: str) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(BagError, match=text) as caught:
        read_messages(path)
    assert caught.value.reason == reason
    assert caught.value.path == path


def test_missing_file_and_folder(tmp_path: Path, make_bag: Callable[..., Path]) -> None:
    with pytest.raises(BagError, match="no such file"):
        inspect(tmp_path / "nothing.mcap")
    make_bag(tmp_path / "inside.mcap", 1)
    with pytest.raises(BagError, match=r"folder.*inside\.mcap"):
        inspect(tmp_path)


def test_bytes_after_the_end(bag: Path, tmp_path: Path) -> None:
    path = tmp_path / "longer.mcap"
    path.write_bytes(bag.read_bytes() + b"\x00")
    with pytest.raises(DamagedBagError, match="1 bytes follow") as caught:
        inspect(path)
    assert caught.value.salvageable == 72


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("use_chunking", [True, False])
def test_foreign_layouts(tmp_path: Path, compression: CompressionType, use_chunking: bool) -> None:
    times = [5, 6, 7, 8]
    path = foreign_bag(tmp_path / "f.mcap", times, compression=compression, use_chunking=use_chunking)
    assert [m.log_time for m in read_messages(path)] == times
    assert inspect(path).has_crc is use_chunking


def test_no_index_no_summary(tmp_path: Path) -> None:
    path = foreign_bag(
        tmp_path / "f.mcap",
        [1, 2, 3],
        index_types=IndexType.NONE,
        use_statistics=False,
        use_summary_offsets=False,
        repeat_channels=False,
        repeat_schemas=False,
    )
    report = inspect(path)
    assert not report.has_summary and not report.has_index and report.has_crc
    assert any("no summary" in warning for warning in report.warnings)
    assert len(list(read_messages(path))) == 3


def test_private_records_are_passed_over(bag: Path, tmp_path: Path) -> None:
    path = raw_bag(tmp_path / "p.mcap", record(0x81, b"abc"))
    assert any("unknown kinds" in warning for warning in inspect(path).warnings)


@pytest.mark.parametrize("opcode", [1, 2, 8, 11, 14])
def test_records_in_the_wrong_place(tmp_path: Path, opcode: int) -> None:
    path = raw_bag(tmp_path / "p.mcap", record(opcode, bytes(8)))
    with pytest.raises(DamagedBagError, match="stands in the data section"):
        inspect(path)


def test_record_longer_than_the_cap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = raw_bag(tmp_path / "p.mcap", record(5, bytes(5000)))
    monkeypatch.setattr(mcap_format, "MAX_RECORD_BYTES", 4999)
    with pytest.raises(DamagedBagError, match="5000 bytes; at most 4999") as caught:
        inspect(path)
    assert caught.value.reason == "size_cap"


def test_unknown_compression_is_not_read_as_raw_bytes(tmp_path: Path) -> None:
    path = raw_bag(tmp_path / "p.mcap", raw_chunk(b"", size=0, compression=b"zstd2"))
    with pytest.raises(DamagedBagError, match="unknown compression 'zstd2'") as caught:
        inspect(path)
    assert caught.value.reason == "compression"


@pytest.mark.parametrize("declared", [16, 40_000_000, 400_000_000, 2**63])
def test_decompression_bomb(tmp_path: Path, declared: int) -> None:
    """300 MB of zeros in 10 kB: refused with little memory, whatever size the chunk declares."""
    bomb = zstandard.compress(bytes(300_000_000))
    assert len(bomb) < 50_000
    path = raw_bag(tmp_path / "bomb.mcap", raw_chunk(bomb, size=declared))
    text, grown = peak_memory(path)
    assert "unpacks" in text
    assert grown < LIMIT


@pytest.mark.parametrize(
    ("cap", "text"),
    [("MAX_CHUNK_BYTES", "unpacks to 5000 bytes; at most 100"), ("MAX_RATIO", "at most 100 to 1")],
)
def test_each_cap_holds_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cap: str, text: str) -> None:
    monkeypatch.setattr(mcap_format, cap, 100)
    monkeypatch.setattr(mcap_format, "FREE_BYTES", 1000 if cap == "MAX_RATIO" else 10**6)
    packed = zstandard.compress(bytes(5000))
    path = raw_bag(tmp_path / "p.mcap", raw_chunk(packed, size=5000))
    with pytest.raises(DamagedBagError, match=text) as caught:
        inspect(path)
    assert caught.value.reason == "size_cap"


def test_black_image_is_no_bomb(tmp_path: Path) -> None:
    data = b"\x00\x01\x00\x00" + struct.pack("<I", 6_000_000) + bytes(6_000_000)
    schema = ("sensor_msgs/msg/Raw", "ros2msg", b"uint8[] data")
    path = foreign_bag(tmp_path / "f.mcap", [1], schema=schema, data=data)
    (message,) = read_messages(path)
    assert len(message.message.data) == 6_000_000


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"schema": ("a/msg/B", "ros2idl", b"")}, r"/text.*a/msg/B.*'ros2idl'.*'ros2msg'"),
        ({"encoding": "json"}, r"/text.*std_msgs/msg/String.*'json'.*'cdr'"),
        (
            {"schema": ("a/msg/B", "ros2msg", b"other/Type x")},
            r"/text.*no definition of other/Type",
        ),
        ({"schema": ("a/msg/B", "ros2msg", b"\xff")}, r"/text.*UTF-8"),
        ({"data": b"\x00\x01\x00\x00\x09\x00\x00\x00a\x00"}, r"/text.*needs 9 bytes"),
        ({"data": b"\x00\x01\x00\x00\x02\x00\x00\x00ab"}, r"/text.*end with a zero"),
        ({"data": b"\x00\x01"}, r"/text.*plain CDR"),
        ({"data": b""}, r"/text.*plain CDR"),
        ({"data": b"\x00\x03" + bytes(10)}, r"/text.*plain CDR"),
    ],
)
def test_what_cannot_be_decoded(tmp_path: Path, options: dict[str, Any], text: str) -> None:
    path = foreign_bag(tmp_path / "f.mcap", [1], **options)
    (message,) = read_messages(path)
    with pytest.raises(BagError, match=text):
        _ = message.message


def test_order_by_log_time_is_stable_and_counted(tmp_path: Path) -> None:
    chance = random.Random(3)
    times = [chance.randrange(50) for _ in range(300)]
    path = foreign_bag(tmp_path / "f.mcap", times)
    expected = sorted((now, sequence) for sequence, now in enumerate(times))
    assert [(m.log_time, m.sequence) for m in read_messages(path)] == expected
    assert [m.sequence for m in read_messages(path, order="file")] == list(range(300))
    late = sum(now < max(times[:i]) for i, now in enumerate(times) if i)
    assert inspect(path).out_of_order == late


def test_order_holds_without_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pkm_twin.bags.strict._MAX_SEGMENT_BYTES", 100)
    times = [9, 1, 5, 5, 2, 8, 3, 3, 7]
    path = foreign_bag(tmp_path / "f.mcap", times, use_chunking=False)
    assert [m.log_time for m in read_messages(path)] == sorted(times)


def test_memory_stays_flat(tmp_path: Path) -> None:
    """A bag of 60 MB is read with a few MB."""
    path = tmp_path / "long.mcap"
    chance = random.Random(0)
    with BagWriter(path, flush_period=None, chunk_size=1024**2) as writer:
        writer.add_topic("/noise", "std_msgs/msg/UInt8MultiArray", definition="uint8[] data")
        for index in range(300):
            data = b"\x00\x01\x00\x00" + struct.pack("<I", 200_000) + chance.randbytes(200_000)
            writer.write("/noise", data, index)
    count, grown = peak_memory(path, "sum(1 for _ in read_messages(path))")
    assert count == "300"
    assert grown < 25_000


def test_a_bag_is_read_again_without_a_second_check(bag: Path) -> None:
    opened = open_bag(bag)
    first = list(opened.messages())
    assert [m.data for m in opened.messages()] == [m.data for m in first]


def test_change_after_the_check_is_seen(bag: Path, tmp_path: Path, make_bag: Callable[..., Path]) -> None:
    path = tmp_path / "changed.mcap"
    path.write_bytes(bag.read_bytes())
    messages = read_messages(path)
    damaged = bytearray(bag.read_bytes())
    damaged[600] ^= 1
    path.write_bytes(damaged)
    with pytest.raises(BagError, match="changed since") as caught:
        list(messages)
    assert caught.value.reason == "changed"


def test_lying_statistics(tmp_path: Path) -> None:
    """A bag whose CRCs are right but whose statistics count one message more."""
    path = foreign_bag(tmp_path / "f.mcap", [1, 2, 3], enable_crcs=False)
    data = path.read_bytes()
    at = data.rindex(struct.pack("<QHI", 3, 1, 1))
    path.write_bytes(data[:at] + struct.pack("<Q", 4) + data[at + 8 :])
    with pytest.raises(DamagedBagError, match="message count is 3; the statistics say 4") as caught:
        inspect(path)
    assert caught.value.reason == "statistics"


def test_a_first_log_time_of_zero_is_noted(tmp_path: Path) -> None:
    """Some writers take it for none: their statistics begin with the next one."""
    path = foreign_bag(tmp_path / "f.mcap", [0, 2, 3], enable_crcs=False)
    data = path.read_bytes()
    at = data.rindex(struct.pack("<IIIQQ", 0, 0, 1, 0, 3)) + 12
    path.write_bytes(data[:at] + struct.pack("<QQ", 2, 3) + data[at + 16 :])
    report = inspect(path)
    assert (report.message_count, report.start_time) == (3, 0)
    assert any("statistics" in text for text in report.warnings)
    assert [m.log_time for m in read_messages(path)] == [0, 2, 3]


def test_attachments_are_checked(tmp_path: Path) -> None:
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    writer.add_attachment(1, 2, "notes.txt", "text/plain", b"hello world")
    writer.finish()
    path = tmp_path / "a.mcap"
    path.write_bytes(stream.getvalue())
    assert inspect(path).message_count == 0
    path.write_bytes(stream.getvalue().replace(b"hello", b"hallo"))
    with pytest.raises(DamagedBagError, match="attachment's CRC"):
        inspect(path)


def test_bag_message_compares_by_content(bag: Path) -> None:
    first, again = (next(iter(read_messages(bag))) for _ in range(2))
    assert first == again and isinstance(first, BagMessage)
    assert zlib.crc32(first.data) == zlib.crc32(again.data)


def test_descriptors_are_closed(bag: Path) -> None:
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    for _ in range(min(limit, 300)):
        next(read_messages(bag))
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(50):
        list(read_messages(bag, "/note"))
    assert len(list(Path("/proc/self/fd").iterdir())) <= before
