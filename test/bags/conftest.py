# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Small bags to read, cut and damage."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from pkm_twin.bags.reader import BagMessage, BagWriter

HEADER = "builtin_interfaces/Time stamp\nstring frame_id"
LINE = "=" * 80
DEFINITIONS = {
    "sensor_msgs/msg/JointState": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
        f"float64[] effort\n{LINE}\nMSG: std_msgs/Header\n{HEADER}\n{LINE}\n"
        "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    ),
    "std_msgs/msg/String": "string data\n",
}

Row = tuple[str, str, int, int, int, bytes]


@pytest.fixture(scope="session")
def definitions() -> dict[str, str]:
    """Message definitions, so that these tests run without ROS messages installed."""
    return DEFINITIONS


@pytest.fixture(scope="session")
def rows() -> Callable[[list[BagMessage]], list[Row]]:
    """All that a message says, as something to compare."""
    return lambda messages: [(m.topic, m.type, m.log_time, m.publish_time, m.sequence, m.data) for m in messages]


@pytest.fixture(scope="session")
def make_bag() -> Callable[..., Path]:
    """Write ``count`` joint states, 1 ms apart, and a text with every fifth."""

    def make(path: Path, count: int = 60, **options: object) -> Path:
        settings = {
            "chunk_size": 1024,
            "flush_period": None,
            "metadata": {"pkm_twin": {"robot": "x"}},
        }
        with BagWriter(path, **(settings | options)) as writer:  # type: ignore[arg-type]
            for topic, kind in (
                ("/joint_states", "sensor_msgs/msg/JointState"),
                ("/note", "std_msgs/msg/String"),
            ):
                writer.add_topic(topic, kind, definition=DEFINITIONS[kind])
            for index in range(count):
                now = 10**9 + index * 10**6
                state = {
                    "name": ["a", "b"],
                    "position": [index * 0.1, -float(index)],
                    "header": {"stamp": {"sec": 1, "nanosec": index * 10**6}},
                }
                writer.write("/joint_states", state, now, now - 10)
                if index % 5 == 0:
                    writer.write("/note", {"data": f"note {index}"}, now)
        return path

    return make


@pytest.fixture(scope="session")
def bag(tmp_path_factory: pytest.TempPathFactory, make_bag: Callable[..., Path]) -> Path:
    """A sound bag of 72 messages in several chunks; not to be changed."""
    return make_bag(tmp_path_factory.mktemp("bags") / "sound.mcap")
