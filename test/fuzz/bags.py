# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Bags with damage, and nonsense in sound frames: never a value that was not recorded."""

from __future__ import annotations

import random
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zstandard
from hypothesis import strategies as st

from pkm_twin.bags.cdr import MessageCodec
from pkm_twin.bags.qos import parse_qos, require_topic
from pkm_twin.bags.reader import BagWriter, inspect, read_messages
from pkm_twin.bags.recover import recover
from pkm_twin.identification.check import check
from pkm_twin.recordings import ReadOptions, read
from test.bags import raw
from test.bags.conftest import DEFINITIONS
from test.bags.folders import write_split
from test.bags.raw import MAGIC, record
from test.fuzz.definitions import definitions
from test.fuzz.tally import Kind, damaged, refusal

STATE = "sensor_msgs/msg/JointState"


def small_bag(path: Path) -> Path:
    with BagWriter(path, chunk_size=400, flush_period=None, overwrite=True) as writer:
        writer.add_topic("/joint_states", STATE, definition=DEFINITIONS[STATE])
        for index in range(8):
            stamp = {"stamp": {"sec": 1, "nanosec": index * 10**6}}
            message = {"name": ["arm_1", "arm_2", "arm_3"], "position": [0.1] * 3, "header": stamp}
            writer.write("/joint_states", message, 10**9 + index * 10**6)
    return path


class DamagedBags(Kind):
    """A sound bag with damage: never a value that was not recorded, in reading or recovery."""

    name = "damaged bags"
    covered = True
    """By CRCs."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.path = folder / "damaged.mcap"
        sound = small_bag(folder / "sound.mcap")
        rows = list(read_messages(sound))
        self.expected = {(m.topic, m.log_time, m.data) for m in rows}
        self.sound = self.sources(sound, rows)
        self.turn = 0

    def sources(self, sound: Path, rows: list[Any]) -> list[bytes]:
        """Files to be damaged."""
        return [sound.read_bytes()]

    def draw(self, rng: random.Random) -> bytes:
        return damaged(rng, rng.choice(self.sound))

    def check(self, example: bytes) -> str:
        self.path.write_bytes(example)

        def read() -> None:
            for message in read_messages(self.path):
                if self.covered:
                    assert (message.topic, message.log_time, message.data) in self.expected
                refusal(lambda message=message: message.message)

        def save() -> None:
            saved = self.path.with_name("saved.mcap")
            result = recover(self.path, saved, overwrite=True)
            found = {(m.topic, m.log_time, m.data) for m in read_messages(saved)}
            # Bytes that no CRC covers are saved, and counted as such.
            assert not self.covered or found <= self.expected or result.unverified

        self.turn += 1
        if self.turn % 4 == 0:
            refusal(save)
        return refusal(read)


class DamagedSplits(DamagedBags):
    """As rosbag2 writes them by default, without CRCs: a damaged value may be read, no more."""

    name = "damaged bags without CRCs"
    covered = False

    def sources(self, sound: Path, rows: list[Any]) -> list[bytes]:
        write_split(self.folder / "split.mcap", sound, rows)
        write_split(self.folder / "packed.mcap", sound, rows, each=True)
        return [(self.folder / f"{name}.mcap").read_bytes() for name in ("split", "packed")]


def text(value: str) -> bytes:
    return raw.text(value.encode(errors="replace"))


NUMBERS = st.one_of(st.integers(0, 3), st.sampled_from((2**16 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1)))
NAMES = st.one_of(
    st.sampled_from(("", "/a", "/joint_states", "cdr", "ros2msg", STATE, "zstd", "lz4", "json", "a b\n", "\0")),
    st.text(max_size=12),
)
NONSENSE_YAML = st.one_of(
    st.sampled_from(("- {depth: .inf}", "[]", "- {depth: -1}", "&a [*a]", "- [", "{depth: 3}")),
    st.text(alphabet="-[]{}:,&*!#|>'\" \nadepth019.einf", max_size=30),
)


@st.composite
def records(draw: Callable[[Any], Any], chunked: bool = False) -> bytes:
    """One MCAP record with sound framing and any content."""
    opcode = draw(st.sampled_from((3, 4, 5, 5, 3, 4, 12, 9, 7, 0x80) if not chunked else (3, 4, 5)))
    if opcode == 3:
        definition = draw(st.one_of(st.sampled_from(list(DEFINITIONS.values())), definitions()))
        content = struct.pack("<H", draw(NUMBERS) % 2**16) + text(draw(NAMES)) + text(draw(NAMES))
        content += text(definition)
    elif opcode == 4:
        content = struct.pack("<HH", draw(NUMBERS) % 2**16, draw(NUMBERS) % 2**16)
        content += text(draw(NAMES)) + text(draw(NAMES))
        pairs = text("offered_qos_profiles") + text(draw(NONSENSE_YAML))
        content += struct.pack("<I", len(pairs)) + pairs
    elif opcode == 5:
        content = struct.pack("<HIQQ", draw(NUMBERS) % 2**16, 0, draw(NUMBERS), draw(NUMBERS))
        content += draw(st.binary(max_size=40))
    elif opcode == 12:
        pairs = text(draw(NAMES)) + text(draw(NAMES))
        content = text("pkm_twin") + struct.pack("<I", len(pairs)) + pairs
    else:
        content = draw(st.binary(max_size=60))
    return record(opcode, content)


@st.composite
def channels(draw: Callable[[Any], Any]) -> bytes:
    """A schema and a channel, both number 1, that can be read, or nearly."""
    kind = draw(st.sampled_from((STATE, STATE, "std_msgs/msg/String", "p/msg/M")))
    known = DEFINITIONS.get(kind, "float64 x")
    definition = draw(st.one_of(st.just(known), st.just(known), definitions()))
    schema = struct.pack("<H", 1) + text(kind) + text("ros2msg") + text(definition)
    pairs = text("offered_qos_profiles") + text(draw(NONSENSE_YAML))
    topic = draw(st.one_of(st.sampled_from(("/joint_states", "/note")), NAMES))
    channel = struct.pack("<HH", 1, 1) + text(topic) + text("cdr")
    return record(3, schema) + record(4, channel + struct.pack("<I", len(pairs)) + pairs)


@st.composite
def messages(draw: Callable[[Any], Any]) -> tuple[bytes, list[int]]:
    """Messages of channel 1, whole, damaged or anything, and their log times."""
    codec = MessageCodec(STATE, DEFINITIONS[STATE])
    body, times = b"", []
    for _ in range(draw(st.integers(0, 12))):
        stamp = {"stamp": {"sec": draw(st.integers(-2, 2)), "nanosec": draw(NUMBERS) % 2**32}}
        position = draw(st.lists(st.floats(-1, 1), min_size=3, max_size=3))
        names = draw(st.sampled_from((["arm_1", "arm_2", "arm_3"], ["arm_1"], [], ["x"] * 3)))
        data = codec.encode({"name": names, "position": position, "header": stamp})
        how = draw(st.integers(0, 6))
        if how == 0:
            data = damaged(draw(st.randoms(use_true_random=False)), data)
        elif how == 1:
            data = draw(st.binary(max_size=20))
        elif how == 2:
            data = zstandard.compress(data)
        times.append(draw(st.one_of(st.integers(0, 9), NUMBERS)))
        body += record(5, struct.pack("<HIQQ", 1, 0, times[-1], 0) + data)
    return body, times


@st.composite
def mcap_files(draw: Callable[[Any], Any]) -> bytes:
    """A file with a sound frame and sound CRCs around anything."""
    body = draw(channels()) if draw(st.integers(0, 4)) else b""
    for _ in range(draw(st.integers(0, 4))):
        if draw(st.integers(0, 4)) == 0:
            body += draw(records())
            continue
        inside, times = draw(messages())
        if draw(st.integers(0, 5)) == 0:
            inside += b"".join(draw(st.lists(records(chunked=True), max_size=3)))
        packing = draw(st.sampled_from(("zstd", "zstd", "", "lz4")))
        packed = zstandard.compress(inside) if packing == "zstd" else inside
        span = (min(times, default=0), max(times, default=0))
        if draw(st.integers(0, 9)) == 0:
            span = draw(st.tuples(NUMBERS, NUMBERS))
        size = draw(st.sampled_from((len(inside),) * 9 + (2**40,)))
        head = struct.pack("<QQQI", *span, size, zlib.crc32(inside)) + text(packing)
        body += record(6, head + struct.pack("<Q", len(packed)) + packed)
    if draw(st.integers(0, 3)) == 0:
        names = st.sampled_from(("robot", "payload_mass_kg", "payload_picked_s", "x"))
        pairs = text(draw(names)) + text(draw(NAMES))
        body += record(12, text("pkm_twin") + struct.pack("<I", len(pairs)) + pairs)
    end = record(15, struct.pack("<I", 0)) + record(2, struct.pack("<QQI", 0, 0, 0))
    return MAGIC + record(1, text("ros2") + text("x")) + body + end + MAGIC


class NonsenseBags(Kind):
    """Sound framing around nonsense: refused by name, or read."""

    name = "nonsense in sound bags"
    turn = 0

    def strategy(self) -> st.SearchStrategy[bytes]:
        return mcap_files()

    def check(self, example: bytes) -> str:
        path = self.folder / "nonsense.mcap"
        path.write_bytes(example)

        parts = []

        def decode() -> None:
            for topic, info in inspect(path).topics.items():
                parts.append(refusal(lambda topic=topic: require_topic(topic)))
                parts.append(refusal(lambda t=topic, i=info: parse_qos(t, i.offered_qos)))
            for message in read_messages(path):
                parts.append(refusal(lambda message=message: message.message))

        self.turn += 1
        if self.turn % 2:
            refusal(lambda: recover(path, self.folder / "saved.mcap", overwrite=True))
        elif self.turn % 10 == 0:
            refusal(lambda: check(read(path, "prru", ReadOptions(limited=True))))
        return next((part for part in [refusal(decode), *parts] if part != "good"), "good")
