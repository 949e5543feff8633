# SPDX-License-Identifier: Apache-2.0
"""Files and command lines at random, for as long as asked: ``python -m test.bags.fuzz``.

Hypothesis makes the examples, batch by batch, each batch from a seed that the table names. A kind
holds when nothing but the package's own errors comes back, each of them one short printable line,
and no value is handed out that was not recorded.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import random
import resource
import struct
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import hypothesis
import yaml
import zstandard
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st

from pkm_twin import load, robot_names
from pkm_twin.apps import cli
from pkm_twin.bags.cdr import MessageCodec
from pkm_twin.bags.qos import parse_qos, require_topic
from pkm_twin.bags.reader import BagWriter, inspect, read_messages
from pkm_twin.bags.recover import recover
from pkm_twin.errors import PkmTwinError
from pkm_twin.machine.catalogue import config_folder
from test.bags.conftest import DEFINITIONS
from test.bags.folders import make_folder

BATCH = 500
"""Examples from one seed."""
MAGIC = b"\x89MCAP0\r\n"
STATE = "sensor_msgs/msg/JointState"


@dataclass
class Tally:
    """What came of one kind."""

    kind: str
    seeds: list[int] = field(default_factory=list)
    examples: int = 0
    good: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    slowest: float = 0.0
    failures: list[str] = field(default_factory=list)
    spent: float = 0.0


class Kind:
    """Examples of one kind, and what has to hold for each: ``check`` says whether it was taken."""

    name = ""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def examples(self) -> st.SearchStrategy[Any]:
        raise NotImplementedError

    def check(self, example: Any) -> str:
        """Return "good" or why it was refused; anything that is raised is a failure."""
        raise NotImplementedError


def refusal(act: Callable[[], object]) -> str:
    """How a call ended: "good", or the kind of the package's error."""
    try:
        act()
    except PkmTwinError as error:
        text = str(error)
        assert len(text.splitlines()) == 1 and text.isprintable(), ascii(text[:300])
        assert len(text) < 2500, len(text)
        return str(getattr(error, "reason", type(error).__name__))
    return "good"


def damage(draw: Callable[[Any], Any], data: bytes) -> bytes:
    """Flip, zero, cut, repeat or move some bytes."""
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(len(data) - 1, 0)))
        size = draw(st.sampled_from((1, 1, 1, 2, 4, 8, 64)))
        other = draw(st.integers(0, max(len(data) - 1, 0)))
        what = draw(st.sampled_from(("flip", "zero", "fill", "cut", "repeat", "move", "drop")))
        piece = data[at : at + size]
        if what == "flip" and piece:
            bit = draw(st.integers(0, 7))
            data = data[:at] + bytes((piece[0] ^ 1 << bit,)) + data[at + 1 :]
        elif what == "zero":
            data = data[:at] + bytes(len(piece)) + data[at + size :]
        elif what == "fill":
            data = data[:at] + b"\xff" * len(piece) + data[at + size :]
        elif what == "cut":
            data = data[:at]
        elif what == "repeat":
            data = data[:at] + piece + data[at:]
        elif what == "move":
            data = data[:other] + piece + data[other:]
        elif what == "drop":
            data = data[:at] + data[at + size :]
    return data


class DamagedBags(Kind):
    """A sound bag with damage: never a value that was not recorded, in reading or recovery."""

    name = "damaged bags"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.path = folder / "damaged.mcap"
        self.sound = small_bag(folder / "sound.mcap").read_bytes()
        self.path.write_bytes(self.sound)
        self.expected = {(m.topic, m.log_time, m.data) for m in read_messages(self.path)}

    def examples(self) -> st.SearchStrategy[bytes]:
        return st.composite(lambda draw: damage(draw, self.sound))()

    def check(self, example: bytes) -> str:
        self.path.write_bytes(example)

        def read() -> None:
            for message in read_messages(self.path):
                assert (message.topic, message.log_time, message.data) in self.expected
                assert message.message is not None

        def save() -> None:
            saved = self.path.with_name("saved.mcap")
            result = recover(self.path, saved, overwrite=True)
            found = {(m.topic, m.log_time, m.data) for m in read_messages(saved)}
            # Bytes that no CRC covers are saved, and counted as such.
            assert found <= self.expected or result.unverified

        refusal(save)
        return refusal(read)


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value: str) -> bytes:
    raw = value.encode(errors="replace")
    return struct.pack("<I", len(raw)) + raw


NUMBERS = st.one_of(
    st.integers(0, 3), st.sampled_from((2**16 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1))
)
NAMES = st.one_of(
    st.sampled_from(
        ("", "/a", "/joint_states", "cdr", "ros2msg", STATE, "zstd", "lz4", "json", "a b\n", "\0")
    ),
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
            data = damage(draw, data)
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

    def examples(self) -> st.SearchStrategy[bytes]:
        return mcap_files()

    def check(self, example: bytes) -> str:
        path = self.folder / "nonsense.mcap"
        path.write_bytes(example)

        def decode() -> None:
            for topic, info in inspect(path).topics.items():
                refusal(lambda topic=topic: require_topic(topic))
                refusal(lambda topic=topic, info=info: parse_qos(topic, info.offered_qos))
            for message in read_messages(path):
                refusal(lambda message=message: message.message)

        refusal(lambda: recover(path, self.folder / "saved.mcap", overwrite=True))
        refusal(lambda: cli_check(path))
        return refusal(decode)


def cli_check(path: Path) -> None:
    from pkm_twin.apps.check import check_bag

    check_bag(path, "delta_cu")


WORDS = st.sampled_from(
    ("float64", "int8", "bool", "string", "wstring", "byte", "p/E", "E", "Header", "p/msg/M", "x",
     "[]", "[3]", "[<=3]", "<=5", "[99999999999]", "=", "# c", "=" * 80, "MSG: p/E", "MSG:", "\n",
     "\n", " ", " ", "a", "b", "class", "é", "9" * 30)
)  # fmt: skip


def definitions() -> st.SearchStrategy[str]:
    return st.lists(WORDS, max_size=25).map("".join)


class Cdr(Kind):
    """Definitions and encodings: decoded, or refused; what is encoded decodes to the same."""

    name = "definitions and CDR"

    def examples(self) -> st.SearchStrategy[tuple[str, bytes]]:
        known = st.sampled_from([f"{d}" for d in DEFINITIONS.values()])
        fields = st.lists(
            st.tuples(WORDS, st.sampled_from(("", "[]", "[2]", "[<=2]")), st.integers(0, 9)),
            max_size=6,
        ).map(lambda rows: "\n".join(f"{base}{size} f{n}" for base, size, n in rows))
        data = st.one_of(
            st.binary(max_size=60),
            st.binary(max_size=200).map(lambda tail: b"\0\1\0\0" + tail),
            st.lists(st.sampled_from((b"\0\0\0\0", b"\1\0\0\0", b"\xff\xff\xff\xff")), max_size=40)
            .map(b"".join).map(lambda tail: b"\0\1\0\0" + tail),
        )  # fmt: skip
        return st.tuples(st.one_of(known, definitions(), fields), data)

    def check(self, example: tuple[str, bytes]) -> str:
        definition, data = example

        def decode() -> None:
            codec = MessageCodec("p/msg/M", definition)
            value = codec.decode(data)
            again = codec.encode(value)
            assert codec.encode(codec.decode(again)) == again

        return refusal(decode)


class Tables(Kind):
    """CSV motions through the command: a table, or one line."""

    name = "CSV motions"

    def examples(self) -> st.SearchStrategy[bytes]:
        robot = load("delta")
        columns = ["time", *(f"{j}.position" for j in robot.joint_names), "fx", "arm_1.velocity"]
        columns += ["arm_1.velocty", "x", "", "time"]
        cell = st.one_of(
            st.sampled_from(("0", "0.1", "-0.2", "1e300", "nan", "inf", "", "x", "1,5", '"', "\0")),
            st.floats(-1, 1).map(repr),
            st.text(max_size=3),
        )
        header = st.one_of(
            st.just(",".join(columns[:4])),
            st.lists(st.sampled_from(columns), max_size=7).map(",".join),
        )
        row = st.one_of(
            st.integers(0, 99).map(lambda n: f"{n},0.1,0.1,0.1"),
            st.lists(cell, max_size=7).map(",".join),
        )
        end = st.sampled_from(("\n", "\n", "\r\n", "\r", ""))
        whole = st.builds(
            lambda h, rows, e: e.join([h, *rows]).encode(errors="replace"),
            header,
            st.lists(row, max_size=8),
            end,
        )
        small = st.floats(-0.4, 0.4).map(lambda value: f"{value:.4f}")

        @st.composite
        def motion(draw: Callable[[Any], Any]) -> bytes:
            names = [*columns[:4], *draw(st.lists(st.sampled_from(columns[4:6]), unique=True))]
            count = draw(st.integers(1, 8))
            rows = [
                [str(n), *(draw(st.one_of(small, small, small, cell)) for _ in names[1:])]
                if draw(st.integers(0, 9)) == 0
                else [str(n), *(draw(small) for _ in names[1:])]
                for n in range(count)
            ]
            lines = [names, *rows]
            return "\n".join(map(",".join, lines)).encode(errors="replace")

        return st.one_of(motion(), motion(), whole, st.binary(max_size=60))

    def check(self, example: bytes) -> str:
        from pkm_twin.apps.limits import beyond_limits
        from pkm_twin.apps.torques import motion_of_csv, table

        path = self.folder / "motion.csv"
        path.write_bytes(example)

        def compute() -> None:
            motion = motion_of_csv(path, "delta")
            beyond_limits(motion.robot, motion.q, motion.qd)
            columns = table(motion)
            assert {len(values) for values in columns.values()} == {len(motion.time)}

        return refusal(compute)


class Yaml(Kind):
    """Parameter files and rosbag2's metadata with changes: taken, or refused by the field."""

    name = "YAML"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.robots = [(config_folder() / f"{n}.yaml").read_text() for n in robot_names()]
        bag = small_bag(folder / "for_folder.mcap")
        self.rosbag = make_folder(folder / "rec", bag, splits=2)
        self.metadata = (self.rosbag / "metadata.yaml").read_text()

    def examples(self) -> st.SearchStrategy[tuple[bool, bytes]]:
        value = st.one_of(
            st.none(),
            st.booleans(),
            st.integers(-(2**70), 2**70),
            st.floats(),
            st.sampled_from(
                (1e-300, 1e300, "x", "mcap", "zstd", [], {}, [[1]], "../x", "rec_0.mcap")
            ),
            st.lists(st.floats(), max_size=4),
        )

        @st.composite
        def changed(draw: Callable[[Any], Any]) -> tuple[bool, bytes]:
            robot = draw(st.booleans())
            source = draw(st.sampled_from(self.robots)) if robot else self.metadata
            if draw(st.integers(0, 3)) == 0:
                return robot, damage(draw, source.encode())
            data = yaml.safe_load(source)
            for _ in range(draw(st.integers(1, 2))):
                at = data
                while True:
                    key = draw(st.sampled_from(list(at))) if at else "x"
                    if isinstance(at.get(key), dict) and at[key] and draw(st.integers(0, 5)):
                        at = at[key]
                        continue
                    break
                if draw(st.integers(0, 4)) == 0:
                    at.pop(key, None)
                elif draw(st.integers(0, 5)) == 0:
                    at[draw(st.text(max_size=5))] = draw(value)
                else:
                    at[key] = draw(value)
            return robot, yaml.safe_dump(data, allow_unicode=False).encode()

        return changed()

    def check(self, example: tuple[bool, bytes]) -> str:
        robot, content = example
        if robot:
            path = self.folder / "robot.yaml"
            path.write_bytes(content)
            return refusal(lambda: load(path))
        (self.rosbag / "metadata.yaml").write_bytes(content)
        return refusal(lambda: inspect(self.rosbag))


class Commands(Kind):
    """Words of the command line in any order: an exit code of the list, one line where refused."""

    name = "command lines"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        small_bag(folder / "a.mcap")
        (folder / "cut.mcap").write_bytes((folder / "a.mcap").read_bytes()[:900])
        rows = "".join(f"{n / 100},0.1,{0.1 + n / 1000},0.1\n" for n in range(20))
        (folder / "m.csv").write_text("time,arm_1.position,arm_2.position,arm_3.position\n" + rows)
        with contextlib.suppress(FileExistsError):
            os.mkfifo(folder / "fifo.mcap")
        self.words = [
            *("delta", "delta_cu", "prru", "upr_rpu", "delt", "a.mcap", "cut.mcap", "m.csv", "."),
            *("fifo.mcap", "absent", "/dev/zero", "/dev/null", "", "-", "--", "0", "-0.6", "nan"),
            *("1e400", "0.1", "x" * 300, "\udcff", "a\nb", "o.mcap"),
        ]
        payload = [["--payload", "0.1,0,0,0"], ["--payload", "1e300"], ["--load-times", "0,0.001"]]
        payload += [["--payload", "0.2", "--load-times", "0.001,9"]]
        topic = [["--topic", "/joint_states"], ["--topic", "/none"]]
        table = [["--out", "o.csv"], ["--out", "o.txt"], ["--overwrite"], ["--overwrite"]]
        beyond = [["--beyond-limits"]]
        loads = ("1,2,3,4,5,6", "0,0,0,0,0,0", "1", "1e300,0,0,0,0,0")
        load_case = [["--wrench", text] for text in loads]
        elastic = [["--json"], *beyond, *load_case]
        judged = [["--json"], *payload, *topic, ["--robot", "upr_rpu"]]
        judged += [["--residual", text] for text in ("0.5", "5", "nan")]
        self.lines: list[tuple[list[str], list[list[str]]]] = [
            (["robots"], []),
            (["--version"], []),
            (["info", "delta_cu"], [["--json"]]),
            (["info", "upr_rpu"], [["--json"]]),
            (["compliance", "upr_rpu", "-0.6", "0", "0"], elastic),
            (["compliance", "upr_rpu", "-0.25", "0.1", "0"], elastic),
            (["compliance", "prru", "0.5", "0.1", "0"], elastic),
            (["check", "a.mcap", "--robot", "delta_cu"], judged),
            (["check", "cut.mcap"], judged),
            (["recover", "cut.mcap", "o.mcap"], [["--json"], ["--overwrite"]]),
            (["recover", "a.mcap", "o.mcap"], [["--json"], ["--overwrite"]]),
            (["torques", "delta", "m.csv", "--no-picture"], [*table, *payload, *topic, *beyond]),
            (["torques", "delta_cu", "a.mcap", "--no-picture"], [*table, *payload, *topic]),
        ]

    def examples(self) -> st.SearchStrategy[list[str]]:
        @st.composite
        def typed(draw: Callable[[Any], Any]) -> list[str]:
            start, options = draw(st.sampled_from(self.lines))
            line = list(start)
            for part in draw(st.lists(st.sampled_from(options), max_size=3)) if options else []:
                line += part
            # Now and then a word too much, too few, or in the place of another.
            if draw(st.integers(0, 2)) == 0:
                at = draw(st.integers(0, len(line)))
                words = st.lists(st.sampled_from([*self.words, "--help", "--x"]), max_size=2)
                line[at : at + draw(st.integers(0, 2))] = draw(words)
            return line

        return typed()

    def check(self, example: list[str]) -> str:
        out, err = io.StringIO(), io.StringIO()
        before = Path.cwd()
        os.chdir(self.folder)
        try:
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                try:
                    cli.main(example)
                    code: object = 0
                except SystemExit as end:
                    code = end.code or 0
        finally:
            os.chdir(before)
        assert code in (0, 1, 2, 3), code
        said = err.getvalue()
        assert "Traceback" not in said
        if code == 1 and said:
            assert len(said.splitlines()) == 1 and said.startswith("pkm-twin: "), said
        if "--json" in example and code == 0 and out.getvalue().lstrip().startswith("{"):
            json.loads(out.getvalue(), parse_constant=lambda token: 1 / 0)
        return "good" if code == 0 else f"exit code {code}"


def small_bag(path: Path) -> Path:
    with BagWriter(path, chunk_size=400, flush_period=None, overwrite=True) as writer:
        writer.add_topic("/joint_states", STATE, definition=DEFINITIONS[STATE])
        for index in range(8):
            stamp = {"stamp": {"sec": 1, "nanosec": index * 10**6}}
            message = {"name": ["arm_1", "arm_2", "arm_3"], "position": [0.1] * 3, "header": stamp}
            writer.write("/joint_states", message, 10**9 + index * 10**6)
    return path


KINDS = (DamagedBags, NonsenseBags, Cdr, Tables, Yaml, Commands)


def batch(kind: Kind, tally: Tally, seed: int) -> None:
    """Examples of one seed; a failure is made small by Hypothesis and noted."""
    failing: list[Any] = []

    def one(example: Any) -> None:
        begin = time.perf_counter()
        failing[:] = [example]
        ended = kind.check(example)
        tally.slowest = max(tally.slowest, time.perf_counter() - begin)
        tally.examples += 1
        if ended == "good":
            tally.good += 1
        else:
            tally.refused[ended] += 1

    run = hypothesis.seed(seed)(
        settings(
            max_examples=BATCH,
            deadline=None,
            database=None,
            phases=(Phase.generate, Phase.shrink),
            suppress_health_check=list(HealthCheck),
        )(hypothesis.given(kind.examples())(one))
    )
    tally.seeds.append(seed)
    try:
        run()
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        lines = str(error).splitlines()
        what = f"{type(error).__name__}: {lines[0] if lines else ''}"
        tally.failures.append(f"seed {seed}: {what}: {failing[0]!r}"[:2000])


def run(seconds: float, seed: int, folder: Path, only: str = "") -> list[Tally]:
    """Each kind in turn for its share of the time."""
    kinds = [kind for kind in KINDS if only in kind.name]
    tallies = []
    for kind in kinds:
        place = folder / kind.__name__
        place.mkdir()
        subject, tally = kind(place), Tally(kind.name)
        chance = random.Random(f"{seed} {kind.name}")
        begin = time.monotonic()
        while time.monotonic() - begin < seconds / len(kinds):
            batch(subject, tally, chance.randrange(2**32))
        tally.spent = time.monotonic() - begin
        tallies.append(tally)
        print(line(tally), flush=True)
        for failure in tally.failures:
            print(f"  FAILED {failure}", flush=True)
    return tallies


def line(tally: Tally) -> str:
    """A row of the table."""
    common = ", ".join(f"{why} {n:,}" for why, n in tally.refused.most_common(4))
    return (
        f"| {tally.kind} | {tally.examples:,} | {tally.good:,} | {common} | "
        f"{tally.slowest:.2f} | {tally.spent:.0f} | {len(tally.failures)} |"
    )


def page(tallies: list[Tally], seed: int) -> str:
    """The table as a page."""
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    rows = "\n".join(map(line, tallies))
    return f"""# Files and command lines at random

Printed by `make fuzz`: Hypothesis makes the files and the words, {BATCH} from a seed, the seeds
from seed {seed}. A kind holds when nothing but the package's own errors comes back, each of them
one short line, and nothing is read that was not written. Times are those of a shared machine.

| kind | examples | taken | refused, most often for | slowest (s) | time (s) | failed |
|---|---|---|---|---|---|---|
{rows}

Largest memory of the process: {memory:.0f} MB. What an earlier search found stands in
`test/bags/test_hostile_bags.py`, `test/bags/test_rosbag2_folders.py` and `test/commands/`.
"""


def main() -> int:
    """Run from a command line; 0 where everything held."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0, help="time for all kinds together")
    parser.add_argument("--seed", type=int, default=1, help="another seed, other examples")
    parser.add_argument("--only", default="", help="only kinds with this text in their name")
    parser.add_argument("--page", type=Path, help="Markdown file to write")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        tallies = run(options.seconds, options.seed, Path(folder), options.only)
    if options.page:
        options.page.write_text(page(tallies, options.seed), encoding="utf-8")
    return int(any(tally.failures for tally in tallies))


if __name__ == "__main__":
    sys.exit(main())
