# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Recovery: whole chunks are saved, wherever the damage is, and the result is a sound bag."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mcap")
from mcap.writer import CompressionType, Writer

from pkm_twin.bags.reader import inspect, read_messages
from pkm_twin.bags.recover import recover
from pkm_twin.errors import BagError
from test.bags import raw
from test.support.robots import often

Rows = Callable[[Any], list[tuple[Any, ...]]]


def chunks(data: bytes) -> list[tuple[int, int]]:
    """Offset and length of each chunk record."""
    found, position = [], 8
    while position < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, position)
        if opcode == 6:
            found.append((position, 9 + length))
        position += 9 + length
    return found


def test_sound_bag_is_copied(bag: Path, tmp_path: Path, rows: Rows) -> None:
    result = recover(bag, tmp_path / "copy.mcap")
    assert result.lossless
    assert (result.messages, result.bytes_lost, result.chunks_lost) == (72, 0, 0)
    assert rows(read_messages(tmp_path / "copy.mcap")) == rows(read_messages(bag))
    before, after = inspect(bag), inspect(tmp_path / "copy.mcap")
    assert after.topics == before.topics and after.metadata == before.metadata
    assert after.has_crc and not after.warnings


@pytest.mark.parametrize("step", often(29, 3))
def test_cut_at_every_byte_keeps_the_whole_prefix(bag: Path, tmp_path: Path, rows: Rows, step: int) -> None:
    sound = bag.read_bytes()
    everything = rows(read_messages(bag, order="file"))
    ends = [offset + length for offset, length in chunks(sound)]
    cut, target = tmp_path / "cut.mcap", tmp_path / "saved.mcap"
    saved = 0
    # Every byte near the end of a record matters; elsewhere some are enough.
    near = {end + shift for end in ends for shift in range(-12, 13, 1 + step // 8)}
    for length in sorted(set(range(9, len(sound), step)) | near):
        cut.write_bytes(sound[:length])
        try:
            result = recover(cut, target, overwrite=True)
        except BagError as error:
            assert error.reason == "nothing" and length < ends[0]
            continue
        assert not result.lossless
        assert result.messages >= saved
        saved = result.messages
        assert rows(read_messages(target, order="file")) == everything[:saved]
        if length in ends:
            assert result.bytes_lost == 0
    assert saved == len(everything)


def test_flips_cost_no_more_than_their_chunk(bag: Path, tmp_path: Path, rows: Rows) -> None:
    """Recovered messages are ever the recorded ones, and at most one chunk is missing."""
    sound = bag.read_bytes()
    expected = set(rows(read_messages(bag)))
    # A chunk with the indexes behind it.
    starts = [offset for offset, _ in chunks(sound)]
    largest = max(after - start for start, after in pairwise([*starts, len(sound)]))
    damaged, target = tmp_path / "flipped.mcap", tmp_path / "saved.mcap"
    chance = random.Random(11)
    most_lost = 0
    for _ in range(75):
        data = bytearray(sound)
        bit = chance.randrange(8 * len(sound))
        data[bit // 8] ^= 1 << bit % 8
        damaged.write_bytes(data)
        try:
            result = recover(damaged, target, overwrite=True)
        except BagError as error:
            assert bit // 8 < 8 and error.reason == "not_mcap"
            continue
        found = rows(read_messages(target))
        assert set(found) <= expected
        assert result.reason and result.messages == len(found)
        assert result.bytes_lost <= largest
        most_lost = max(most_lost, len(expected) - len(found))
        assert inspect(target).metadata in ({"pkm_twin": {"robot": "x"}}, {})
    assert 0 < most_lost <= 12


def test_damaged_chunk_is_skipped(bag: Path, tmp_path: Path, rows: Rows) -> None:
    data = bytearray(bag.read_bytes())
    offset, length = chunks(bytes(data))[1]
    data[offset + length - 5] ^= 0xFF
    damaged, target = tmp_path / "d.mcap", tmp_path / "saved.mcap"
    damaged.write_bytes(data)
    result = recover(damaged, target)
    assert (result.chunks_lost, result.bytes_lost) == (1, length)
    assert 0 < result.messages < 72 and "byte" in result.reason
    assert set(rows(read_messages(target))) < set(rows(read_messages(bag)))


def test_channels_of_a_lost_first_chunk_come_from_the_summary(bag: Path, tmp_path: Path) -> None:
    data = bytearray(bag.read_bytes())
    offset, length = chunks(bytes(data))[0]
    data[offset + 1] ^= 0x40  # the record's length: the framing is gone as well
    (tmp_path / "d.mcap").write_bytes(data)
    result = recover(tmp_path / "d.mcap", tmp_path / "saved.mcap")
    assert (result.chunks_lost, result.bytes_lost) == (1, length)
    assert result.messages > 40


def test_damaged_metadata_is_not_carried_over(bag: Path, tmp_path: Path) -> None:
    data = bag.read_bytes().replace(b"robot\x01\x00\x00\x00x", b"robot\x01\x00\x00\x00y", 1)
    assert data != bag.read_bytes()
    (tmp_path / "d.mcap").write_bytes(data)
    result = recover(tmp_path / "d.mcap", tmp_path / "saved.mcap")
    assert result.messages == 72 and result.bytes_lost > 0
    assert inspect(tmp_path / "saved.mcap").metadata == {}


def test_messages_without_crc_are_told(tmp_path: Path) -> None:
    source = tmp_path / "f.mcap"
    with source.open("wb") as file:
        writer = Writer(file, enable_crcs=False, compression=CompressionType.NONE)
        writer.start(profile="other")
        channel = writer.register_channel("/a", "json", 0)
        writer.add_metadata("plain", {"key": "value"})
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    result = recover(source, tmp_path / "saved.mcap")
    assert (result.messages, result.unverified) == (1, 1)
    report = inspect(tmp_path / "saved.mcap")
    assert report.profile == "other" and report.metadata == {"plain": {"key": "value"}}


@pytest.mark.parametrize("extra", ["attachment", "unknown", "unknown in a chunk"])
def test_records_that_are_left_out_are_told(tmp_path: Path, extra: str) -> None:
    source = raw.foreign_bag(tmp_path / "f.mcap", [1, 2], enable_crcs=False)
    assert recover(source, tmp_path / "all.mcap").lossless
    data = source.read_bytes()
    if extra == "attachment":
        record = raw.record(9, bytes(16) + raw.text(b"n") + raw.text(b"t") + bytes(8 + 4))
    else:
        record = raw.record(0x90, b"private")
        record = record if extra == "unknown" else raw.chunk(record)
    end = raw.record(15, bytes(4)) + raw.record(2, bytes(20)) + raw.MAGIC
    source.write_bytes(data[: sum(chunks(data)[0])] + record + end)
    assert inspect(source).message_count == 2
    result = recover(source, tmp_path / "saved.mcap")
    assert result.messages == 2 and not result.lossless
    assert result.bytes_lost == (0 if "chunk" in extra else len(record))


def test_an_index_that_looks_like_a_message_is_not_saved(bag: Path, tmp_path: Path) -> None:
    """One bit makes a message of a message index, with a known channel and any content."""
    data = bytearray(bag.read_bytes())
    at = sum(chunks(bytes(data))[0])
    assert data[at] == 7
    data[at] = 5
    (tmp_path / "d.mcap").write_bytes(data)
    result = recover(tmp_path / "d.mcap", tmp_path / "saved.mcap")
    assert (result.messages, result.unverified, result.lossless) == (72, 0, False)
    assert result.bytes_lost == 9 + struct.unpack_from("<Q", data, at + 1)[0]


def test_the_summary_s_types_replace_damaged_ones(bag: Path, tmp_path: Path) -> None:
    source = raw.foreign_bag(tmp_path / "f.mcap", [1, 2, 3], use_chunking=False)
    data = source.read_bytes()
    source.write_bytes(data.replace(b"string data", b"string dama", 1))
    result = recover(source, tmp_path / "saved.mcap")
    assert (result.messages, result.lossless) == (3, False) and result.bytes_lost > 0
    assert inspect(tmp_path / "saved.mcap").topics["/text"].definition == "string data"


def test_refusals(bag: Path, tmp_path: Path) -> None:
    taken = tmp_path / "taken.mcap"
    taken.write_bytes(b"precious")
    with pytest.raises(BagError, match="exists") as caught:
        recover(bag, taken)
    assert caught.value.reason == "exists" and taken.read_bytes() == b"precious"
    (tmp_path / "own.mcap").write_bytes(bag.read_bytes())
    with pytest.raises(BagError, match="the same file"):
        recover(tmp_path / "own.mcap", tmp_path / "own.mcap", overwrite=True)
    (tmp_path / "text.mcap").write_text("no bag at all")
    with pytest.raises(BagError, match="not an MCAP"):
        recover(tmp_path / "text.mcap", tmp_path / "new.mcap")
    with pytest.raises(BagError, match="cannot be written"):
        recover(bag, tmp_path / "no" / "folder.mcap")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["own.mcap", "taken.mcap", "text.mcap"]
