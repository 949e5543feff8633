# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Folders as rosbag2 writes them, made of a bag with another library than the package's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mcap")
pytest.importorskip("zstandard")
import yaml
import zstandard
from mcap.writer import CompressionType, Writer

from pkm_twin.bags.reader import inspect, read_messages

NANOSECONDS = {"nanoseconds_since_epoch": 0}


def write_split(path: Path, source: Path, rows: list[Any], each: bool = False, **options: Any) -> None:
    """One MCAP file of some messages, without CRCs, as rosbag2 has them by default."""
    settings = {"compression": CompressionType.NONE, "enable_crcs": False} | options
    with path.open("wb") as file:
        writer = Writer(file, **settings)
        writer.start(profile="ros2", library="libmcap 1.3.1")
        channels = {}
        for topic, info in inspect(source).topics.items():
            schema = writer.register_schema(info.type, "ros2msg", info.definition.encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema, {"offered_qos_profiles": info.offered_qos})
        for m in rows:
            data = zstandard.compress(m.data) if each else m.data
            writer.add_message(channels[m.topic], m.log_time, data, m.publish_time, m.sequence)
        writer.add_metadata("rosbag2", {"serialized_metadata": "version: 9"})
        writer.finish()


def make_folder(folder: Path, source: Path, splits: int = 3, mode: str = "", **options: Any) -> Path:
    """A rosbag2 folder; ``mode`` as rosbag2 calls it: MESSAGE, FILE or none."""
    folder.mkdir()
    rows = list(read_messages(source, order="file"))
    length = -(-len(rows) // splits)
    names = []
    for number in range(splits):
        path = folder / f"{folder.name}_{number}.mcap"
        part = rows[number * length : (number + 1) * length]
        write_split(path, source, part, mode == "MESSAGE", **options)
        if mode == "FILE":
            packed = path.with_name(f"{path.name}.zstd")
            packed.write_bytes(zstandard.compress(path.read_bytes()))
            path.unlink()
            path = packed
        names.append(path.name)
    describe(folder, names, len(rows), mode)
    return folder


def describe(folder: Path, names: list[str], count: int, mode: str = "", **changes: Any) -> None:
    """Write ``metadata.yaml``."""
    facts = {
        "version": 9,
        "storage_identifier": "mcap",
        "duration": {"nanoseconds": 0},
        "starting_time": NANOSECONDS,
        "message_count": count,
        "topics_with_message_count": [],
        "compression_format": "zstd" if mode else "",
        "compression_mode": mode,
        "relative_file_paths": names,
        "files": [],
        "custom_data": None,
        "ros_distro": "jazzy",
    }
    facts |= changes
    text = yaml.safe_dump({"rosbag2_bagfile_information": facts})
    (folder / "metadata.yaml").write_text(text)
