# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Writing: what was accepted is in the file, also after a signal, a kill or a full disk."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from pkm_twin.bags import writer as writer_module
from pkm_twin.bags.reader import BagWriter, inspect, read_messages
from pkm_twin.bags.recover import recover
from pkm_twin.errors import BagError

TEXT = "std_msgs/msg/String"

# Writes every millisecond and prints the number of each message once it was accepted. Chunks are so
# large that only time ends them.
RECORDER = """
import sys, time, signal
from pkm_twin.bags.reader import BagWriter
def stop(number, frame):
    raise SystemExit(0)
signal.signal(signal.SIGTERM, stop)
try:
    with BagWriter(sys.argv[1], chunk_size=2**20) as writer:
        writer.add_topic("/text", "std_msgs/msg/String", definition="string data")
        index = 0
        while True:
            index += 1
            writer.write("/text", {"data": "x" * 20}, time.monotonic_ns())
            print(index, time.monotonic_ns(), flush=True)
            time.sleep(0.001)
except KeyboardInterrupt:
    pass
"""


def record_until(path: Path, number: signal.Signals) -> tuple[list[list[int]], int]:
    """Let a process record for half a second and send it a signal."""
    log = path.with_suffix(".log")
    with log.open("wb") as output:
        process = subprocess.Popen([sys.executable, "-c", RECORDER, str(path)], stdout=output)
        try:
            while log.stat().st_size < 5000 and process.poll() is None:
                time.sleep(0.01)
            process.send_signal(number)
            code = process.wait()
        finally:
            process.kill()
            process.wait()
    lines = log.read_text().split("\n")[:-1]
    return [[int(item) for item in line.split()] for line in lines], code


def text_writer(path: Path, **options: object) -> BagWriter:
    writer = BagWriter(path, **options)  # type: ignore[arg-type]
    writer.add_topic("/text", TEXT, definition="string data")
    return writer


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_loses_nothing(tmp_path: Path, number: signal.Signals) -> None:
    accepted, code = record_until(tmp_path / "r.mcap", number)
    assert code == 0
    report = inspect(tmp_path / "r.mcap")
    # One more may have been accepted whose line was never printed.
    assert len(accepted) <= report.message_count <= len(accepted) + 1
    assert len(accepted) > 100


def lost_by_kill(folder: Path) -> int:
    """Nanoseconds of accepted messages that a recording which is killed has lost."""
    folder.mkdir()
    accepted, code = record_until(folder / "r.mcap", signal.SIGKILL)
    assert code == -signal.SIGKILL
    result = recover(folder / "r.mcap", folder / "saved.mcap")
    saved = list(read_messages(folder / "saved.mcap"))
    assert result.messages == len(saved) and [m.sequence for m in saved] == list(range(1, len(saved) + 1))
    lost = accepted[len(saved) :]
    return lost[-1][1] - saved[-1].log_time if lost else 0


def test_kill_loses_at_most_100_ms(tmp_path: Path) -> None:
    """A busy machine may keep the process from its file: one of several kills tells."""
    assert any(lost_by_kill(tmp_path / str(k)) <= 100_000_000 for k in range(10))


def test_a_lone_message_reaches_the_file_in_time(tmp_path: Path) -> None:
    """Flushing does not wait for a next message."""
    with text_writer(tmp_path / "r.mcap") as writer:
        writer.write("/text", {"data": "alone"}, 1)
        saved = None
        while saved is None:
            # Until then there is nothing to recover.
            with contextlib.suppress(BagError):
                saved = recover(tmp_path / "r.mcap", tmp_path / "saved.mcap")
        assert saved.messages == 1


def test_full_disk(tmp_path: Path) -> None:
    program = (
        "import resource, sys\nfrom pkm_twin.bags.reader import BagWriter, BagError\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, 40_000))\n"
        "try:\n"
        "    with BagWriter(sys.argv[1], flush_period=None) as writer:\n"
        "        writer.add_topic('/text', 'std_msgs/msg/String', definition='string data')\n"
        "        for index in range(1_000_000):\n"
        "            writer.write('/text', {'data': str(index**9)}, index)\n"
        "except BagError as error:\n    print(error.reason, error)\n    sys.exit(1)\n"
    )
    path = tmp_path / "full.mcap"
    done = subprocess.run([sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, "")
    assert done.stdout.startswith(f"disk_full {path}: cannot be written")
    result = recover(path, tmp_path / "saved.mcap")
    assert result.messages > 1000
    saved = [m.sequence for m in read_messages(tmp_path / "saved.mcap")]
    assert saved == list(range(1, result.messages + 1))


def test_full_disk_is_told_by_close(tmp_path: Path) -> None:
    """A disk that is full from the first byte on: nothing that is written says so before."""
    program = (
        "import resource, sys\nfrom pkm_twin.bags.reader import BagWriter, BagError\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)\n"
        "try:\n    BagWriter(sys.argv[1], overwrite=True).close()\n"
        "except BagError as error:\n    print(error.reason)\n"
    )
    for size in ("0", "100"):
        done = subprocess.run(
            [sys.executable, "-c", program, str(tmp_path / "full.mcap"), size],
            capture_output=True,
            text=True,
            check=False,
        )
        assert (done.returncode, done.stdout, done.stderr) == (0, "disk_full\n", "")


def test_equal_input_gives_equal_bytes(tmp_path: Path, make_bag: Callable[..., Path]) -> None:
    one, two = make_bag(tmp_path / "one.mcap"), make_bag(tmp_path / "two.mcap")
    assert one.read_bytes() == two.read_bytes()


def test_target_that_exists(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(BagError, match="exists") as caught:
        BagWriter(path)
    assert caught.value.reason == "exists" and path.read_bytes() == b"precious"
    link = tmp_path / "link.mcap"
    link.symlink_to(tmp_path / "elsewhere.mcap")
    with pytest.raises(BagError, match="exists"):
        BagWriter(link)
    with text_writer(path, overwrite=True) as writer:
        writer.write("/text", {"data": "new"}, 1)
    assert inspect(path).message_count == 1
    with pytest.raises(BagError, match="cannot be written") as caught:
        BagWriter(tmp_path / "no" / "folder.mcap")
    assert caught.value.reason == "not_found"


def test_offered_qos_is_what_rosbag2_reads(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "q.mcap") as writer:
        writer.add_topic(
            "/a",
            TEXT,
            reliability="best_effort",
            durability="transient_local",
            depth=3,
            definition="string data",
        )
    (profile,) = yaml.safe_load(inspect(tmp_path / "q.mcap").topics["/a"].offered_qos)
    infinite = {"sec": 9223372036, "nsec": 854775807}
    assert profile == {
        "history": "keep_last",
        "depth": 3,
        "reliability": "best_effort",
        "durability": "transient_local",
        "deadline": infinite,
        "lifespan": infinite,
        "liveliness": "automatic",
        "liveliness_lease_duration": infinite,
        "avoid_ros_namespace_conventions": False,
    }


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (
            {"reliability": "RELIABLE"},
            "reliability is 'RELIABLE'; expected best_effort or reliable",
        ),
        ({"durability": "x"}, "transient_local or volatile"),
        ({"depth": 0}, "depth is 0; at least 1"),
    ],
)
def test_wrong_qos(tmp_path: Path, options: dict[str, object], text: str) -> None:
    with BagWriter(tmp_path / "q.mcap") as writer, pytest.raises(BagError, match=text):
        writer.add_topic("/a", TEXT, definition="string data", **options)  # type: ignore[arg-type]


def test_wrong_use(tmp_path: Path) -> None:
    with text_writer(tmp_path / "w.mcap") as writer:
        for topic, text in (("/text", "/text already"), ("text", "full topic name")):
            with pytest.raises(BagError, match=text):
                writer.add_topic(topic, TEXT, definition="string data")
        with pytest.raises(BagError, match=r"/other was not added; topics: /text"):
            writer.write("/other", {}, 1)
        with pytest.raises(BagError, match="outside 0 to"):
            writer.write("/text", {}, -1)
        with pytest.raises(TypeError):
            writer.write("/text", {}, 1.5)  # type: ignore[arg-type]
        with pytest.raises(BagError, match="no field date; fields: data"):
            writer.write("/text", {"date": "x"}, 1)
        with pytest.raises(BagError, match="more than texts"):
            BagWriter(tmp_path / "m.mcap", metadata={"a": {"b": 1}})  # type: ignore[dict-item]
        with pytest.raises(BagError, match=r"at most 33554432"):
            writer.write("/text", bytes(33554433), 1)
    with pytest.raises(BagError, match="is closed"):
        writer.write("/text", {"data": "late"}, 1)
    writer.close()
    assert inspect(tmp_path / "w.mcap").message_count == 0


def test_the_first_error_is_the_one_told(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), text_writer(tmp_path / "w.mcap") as writer:
        writer.write("/text", {"data": "kept"}, 1)
        raise ZeroDivisionError
    assert inspect(tmp_path / "w.mcap").message_count == 1


def test_reader_finds_what_was_written(tmp_path: Path) -> None:
    """Publish times and sequence numbers too, and one schema for all topics of a type."""
    with text_writer(tmp_path / "w.mcap") as writer:
        writer.add_topic("/more", TEXT, definition="string data")
        for index in range(3):
            writer.write("/text", {"data": str(index)}, 10 + index, 5 + index)
        writer.write("/more", {"data": "more"}, 11)
    messages = list(read_messages(tmp_path / "w.mcap", ["/text"]))
    assert [(m.sequence, m.log_time, m.publish_time) for m in messages] == [
        (1, 10, 5),
        (2, 11, 6),
        (3, 12, 7),
    ]
    assert [m.message.data for m in messages] == ["0", "1", "2"]


def test_no_threads_or_descriptors_are_left(tmp_path: Path) -> None:
    def held() -> tuple[int, int]:
        return threading.active_count(), len(os.listdir("/proc/self/fd"))

    before = held()
    for index in range(20):
        with text_writer(tmp_path / f"{index}.mcap") as writer:
            writer.write("/text", {"data": "x"}, 1)
    # Of Python's threads: libraries start and end some of their own when they like.
    after = held()
    assert after[0] <= before[0] and after[1] <= before[1]


def test_a_bag_has_the_bytes_of_the_format_s_own_library(tmp_path: Path, make_bag: Callable[..., Path]) -> None:
    mcap = pytest.importorskip("mcap.writer")
    path = make_bag(tmp_path / "own.mcap")
    report = inspect(path)
    assert not report.warnings and report.has_crc and report.has_index
    with (tmp_path / "other.mcap").open("wb") as file:
        writer = mcap.Writer(file, chunk_size=1024, enable_data_crcs=True)
        writer.start(profile="ros2", library="pkm_twin")
        (entries,) = report.metadata.values()
        crc = writer_module.metadata_crc("pkm_twin", entries)
        writer.add_metadata("pkm_twin", {**entries, "crc32": crc})
        numbers = {}
        for topic, info in report.topics.items():
            schema = writer.register_schema(info.type, "ros2msg", info.definition.encode())
            qos = {"offered_qos_profiles": info.offered_qos}
            numbers[topic] = writer.register_channel(topic, "cdr", schema, qos)
        for m in read_messages(path, order="file"):
            number = numbers[m.topic]
            writer.add_message(number, m.log_time, m.data, m.publish_time, m.sequence)
        writer.finish()
    assert path.read_bytes() == (tmp_path / "other.mcap").read_bytes()
