# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Bags as rosbag2 writes them: folders with splits, packed by message, by chunk or by file."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mcap")
pytest.importorskip("zstandard")
import zstandard
from mcap.writer import CompressionType

from pkm_twin.bags.reader import DamagedBagError, inspect, open_bag, read_messages
from pkm_twin.bags.recover import recover
from pkm_twin.bags.storage import conversion_command
from pkm_twin.errors import BagError
from test.bags.folders import describe, make_folder

Rows = Callable[[Any], list[tuple[Any, ...]]]
MODES = ("", "MESSAGE", "FILE")


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD])
def test_a_folder_is_the_bag_that_it_was_made_of(
    bag: Path, tmp_path: Path, rows: Rows, mode: str, compression: CompressionType
) -> None:
    folder = make_folder(tmp_path / "rec", bag, mode=mode, compression=compression)
    assert rows(read_messages(folder)) == rows(read_messages(bag))
    assert rows(read_messages(folder, order="file")) == rows(read_messages(bag, order="file"))
    assert rows(read_messages(folder, "/note")) == rows(read_messages(bag, "/note"))
    report, single = inspect(folder), inspect(bag)
    assert report.topics == single.topics
    assert (report.message_count, report.duration) == (72, single.duration)
    assert (report.start_time, report.end_time) == (single.start_time, single.end_time)
    # rosbag2's default is one plain note, whatever the number of splits.
    assert not report.has_crc
    (note,) = report.warnings
    assert "no CRC, as rosbag2 writes by default" in note


@pytest.mark.parametrize("mode", ["none", "message", "file"])
def test_folders_of_another_writer(bag: Path, tmp_path: Path, rows: Rows, mode: str) -> None:
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    messages = list(read_messages(bag, order="file"))
    folder = tmp_path / "other"
    writer = rosbag2.Writer(folder, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
    if mode != "none":
        kind = rosbag2.CompressionMode[mode.upper()]
        writer.set_compression(kind, rosbag2.CompressionFormat.ZSTD)
    with writer:
        topics = inspect(bag).topics
        connections = {t: writer.add_connection(t, i.type, typestore=store) for t, i in topics.items()}
        for m in messages:
            writer.write(connections[m.topic], m.log_time, m.data)
    found = list(read_messages(folder, order="file"))
    assert [(m.topic, m.log_time, m.data) for m in found] == [(m.topic, m.log_time, m.data) for m in messages]
    assert [repr(m.message) for m in found] == [repr(m.message) for m in messages]


def test_splits_that_overlap_in_time_come_in_order(bag: Path, tmp_path: Path, rows: Rows) -> None:
    folder = make_folder(tmp_path / "rec", bag)
    names = [path.name for path in sorted(folder.glob("*.mcap"))]
    describe(folder, names[::-1], 72)
    assert sorted(rows(read_messages(folder))) == sorted(rows(read_messages(bag)))
    times = [m.log_time for m in read_messages(folder)]
    assert times == sorted(times)


def test_one_file_of_a_folder_is_a_bag(bag: Path, tmp_path: Path) -> None:
    for mode in MODES:
        folder = make_folder(tmp_path / f"rec{mode}", bag, mode=mode)
        file = min(folder.glob("*_0.mcap*"))
        assert len(list(read_messages(file))) == 24
        assert all(m.message is not None for m in read_messages(file))


def test_two_passes_over_a_packed_file_do_not_disturb_each_other(bag: Path, tmp_path: Path) -> None:
    opened = open_bag(make_folder(tmp_path / "rec", bag, splits=1, mode="FILE"))
    one, other = opened.messages(), opened.messages(order="file")
    pairs = list(zip(one, other, strict=True))
    assert len(pairs) == 72


def test_sqlite_is_refused_with_the_command_that_converts_it(bag: Path, tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "my rec", bag)
    describe(folder, ["rec_0.db3"], 72, storage_identifier="sqlite3")
    file = tmp_path / "rec_0.db3"
    file.write_bytes(b"SQLite format 3\x00" + bytes(100))
    for path in (folder, file):
        for act in (inspect, lambda path: recover(path, tmp_path / "new.mcap")):
            with pytest.raises(BagError, match="ros2 bag convert -i") as caught:
                act(path)
            assert conversion_command(path) in str(caught.value)
            assert caught.value.reason == "not_mcap"
    assert f"'{folder}'" in conversion_command(folder)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"storage_identifier": "my_storage"}, r"storage_identifier is 'my_storage'.*'mcap'"),
        ({"storage_identifier": None}, "storage_identifier is None"),
        ({"storage_identifier": 3}, "storage_identifier is 3"),
        ({"compression_format": "lz4"}, "compression_format is 'lz4'"),
        ({"relative_file_paths": []}, "relative_file_paths is"),
        ({"relative_file_paths": "rec_0.mcap"}, "relative_file_paths is 'rec_0.mcap'"),
        ({"relative_file_paths": [7]}, r"relative_file_paths\[0\] is 7"),
        ({"relative_file_paths": ["../x.mcap"]}, r"relative_file_paths\[0\]"),
        ({"relative_file_paths": ["/etc/passwd"]}, r"relative_file_paths\[0\]"),
        ({"relative_file_paths": ["a\0b"]}, r"relative_file_paths\[0\]"),
        ({"relative_file_paths": [".."]}, r"relative_file_paths\[0\]"),
        ({"relative_file_paths": ["gone.mcap"]}, r"gone\.mcap.*no such file"),
        ({"message_count": "many"}, "message_count is 'many'"),
    ],
)
def test_metadata_are_checked(bag: Path, tmp_path: Path, changes: dict[str, Any], text: str) -> None:
    folder = make_folder(tmp_path / "rec", bag, splits=1)
    describe(folder, ["rec_0.mcap"], 72, **changes)
    with pytest.raises(BagError, match=text) as caught:
        inspect(folder)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xff\xfe",
        b"a: [",
        b"- 1",
        b"rosbag2_bagfile_information: 3",
        b"a: &x [1]\nb: *x\n",
        b"!!python/object/apply:os.system [ls]",
        b"[" * 400,
        b"[" * 3000 + b"]" * 3000,
        b"a: " + b"9" * 6000,
        b"a: 2001-99-99",
        b"x" * (5 * 1024**2),
        b"\x00",
    ],
)
def test_hostile_metadata(bag: Path, tmp_path: Path, content: bytes) -> None:
    folder = make_folder(tmp_path / "rec", bag, splits=1)
    (folder / "metadata.yaml").write_bytes(content)
    with pytest.raises(BagError, match=r"metadata\.yaml") as caught:
        inspect(folder)
    assert len(str(caught.value)) < 1000
    # What the metadata do not tell, the files' names do.
    assert recover(folder, tmp_path / "saved.mcap").messages == 72


def test_folder_without_metadata_names_what_is_in_it(bag: Path, tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "rec", bag, splits=12)
    (folder / "metadata.yaml").unlink()
    with pytest.raises(BagError, match=r"without metadata\.yaml.*rec_2\.mcap, rec_3"):
        inspect(folder)
    saved = recover(folder, tmp_path / "saved.mcap")
    assert saved.messages == 72 and "metadata" in saved.reason
    times = [m.log_time for m in read_messages(tmp_path / "saved.mcap", order="file")]
    assert times == sorted(times)


def test_a_message_count_that_differs_is_told(bag: Path, tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "rec", bag)
    names = [path.name for path in sorted(folder.glob("*.mcap"))]
    describe(folder, names, 73)
    (text,) = inspect(folder).miscounts
    assert "73" in text and "72" in text
    counts = {path.name: inspect(path).message_count for path in folder.glob("*.mcap")}
    topics = {name: info.count for name, info in inspect(folder).topics.items()}

    def stated(files: dict[str, int], by_topic: dict[str, int]) -> tuple[str, ...]:
        rows = [{"topic_metadata": {"name": k}, "message_count": v} for k, v in by_topic.items()]
        parts = [{"path": name, "message_count": count} for name, count in files.items()]
        describe(folder, names, 72, topics_with_message_count=rows, files=parts)
        return inspect(folder).miscounts

    assert stated(counts, topics) == ()
    (text,) = stated(counts | {names[1]: 99}, topics)
    assert names[1] in text and "99" in text
    (text,) = stated(counts, topics | {"/lost": 5})
    assert "/lost" in text and "5" in text


@pytest.mark.parametrize("mode", MODES)
def test_recovery_of_a_folder(bag: Path, tmp_path: Path, rows: Rows, mode: str) -> None:
    folder = make_folder(tmp_path / "rec", bag, mode=mode)
    whole = recover(folder, tmp_path / "whole.mcap")
    assert (whole.messages, whole.lossless, whole.unverified) == (72, True, 72)
    assert rows(read_messages(tmp_path / "whole.mcap")) == rows(read_messages(bag))
    report = inspect(tmp_path / "whole.mcap")
    assert len(report.topics) == 2 and report.has_crc and not report.metadata
    last = max(folder.glob("*_2.mcap*"))
    data = last.read_bytes()
    last.write_bytes(data[: len(data) * 3 // 4])
    with pytest.raises(DamagedBagError) as caught:
        inspect(folder)
    assert caught.value.salvageable >= 48
    part = recover(folder, tmp_path / "part.mcap")
    assert part.messages == caught.value.salvageable and not part.lossless
    last.write_bytes(b"")
    empty = recover(folder, tmp_path / "empty.mcap")
    assert empty.messages == 48 and not empty.lossless
    last.unlink()
    lost = recover(folder, tmp_path / "lost.mcap")
    assert lost.messages == 48 and "no such file" in lost.reason


def test_a_damaged_packed_message_costs_itself_alone(bag: Path, tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "rec", bag, splits=1, mode="MESSAGE")
    file = folder / "rec_0.mcap"
    data = file.read_bytes()
    at = data.index(b"\x28\xb5\x2f\xfd", len(data) // 2)
    file.write_bytes(data[: at + 4] + b"\xff" + data[at + 5 :])
    with pytest.raises(DamagedBagError, match="unpack") as caught:
        inspect(folder)
    assert caught.value.salvageable == 71
    assert recover(folder, tmp_path / "saved.mcap").messages == 71


def test_other_kinds_of_files_are_refused_by_name(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "x.mcap")
    with pytest.raises(BagError, match="FIFO"):
        inspect(tmp_path / "x.mcap")
    with pytest.raises(BagError, match="character device"):
        inspect("/dev/zero")
    folder = tmp_path / "rec"
    folder.mkdir()
    os.mkfifo(folder / "metadata.yaml")
    with pytest.raises(BagError, match="FIFO"):
        inspect(folder)
    os.remove(folder / "metadata.yaml")
    describe(folder, ["x.mcap"], 1)
    shutil.move(tmp_path / "x.mcap", folder / "x.mcap")
    with pytest.raises(BagError, match="FIFO"):
        inspect(folder)


def test_a_packed_file_has_the_budget_of_its_packed_size(tmp_path: Path) -> None:
    path = tmp_path / "bomb.mcap.zstd"
    path.write_bytes(zstandard.compress(bytes(600_000_000)))
    with pytest.raises(BagError, match="unpacks to more than") as caught:
        inspect(path)
    assert caught.value.reason == "total_cap"
