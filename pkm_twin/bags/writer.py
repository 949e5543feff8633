# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Safe writing of MCAP bags, live or from data. Imports no ROS."""

from __future__ import annotations

import errno
import io
import operator
import os
import queue
import threading
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pkm_twin.bags.cdr import MessageCodec
from pkm_twin.bags.definitions import live_type_name, message_definition
from pkm_twin.bags.format import (
    CRC,
    FRAME,
    FREE_BYTES,
    INDEX_ENTRY,
    MAGIC,
    MAX_CHUNK_BYTES,
    MESSAGE_HEAD,
    METADATA_CRC,
    Channel,
    Head,
    Op,
    Schema,
    Span,
    metadata_crc,
    pack,
)
from pkm_twin.errors import BagError
from pkm_twin.files import require_replaceable

zstandard: Any
try:
    import zstandard
except ImportError:
    zstandard = None

LIBRARY = "pkm_twin"
"""What the header of our own bags says wrote them."""
FLUSH_PERIOD = 0.05
"""How often a live recording reaches the operating system, s; half of what a kill may cost."""

# What the writer may hold in memory before it slows its caller down.
_QUEUE_LIMIT = 20_000


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Reject a target that is there, a dangling link too, unless it may be overwritten."""
    if not overwrite and os.path.lexists(path):
        raise BagError("exists already", path=path, reason="exists")


_REASONS = {
    errno.ENOSPC: "disk_full",
    errno.EDQUOT: "disk_full",
    errno.EFBIG: "disk_full",
    errno.EEXIST: "exists",
    errno.ENOENT: "not_found",
}


def write_error(error: OSError, path: Path) -> BagError:
    """Return the caller's error where the system cannot write ``path``."""
    reason = _REASONS.get(error.errno or 0, "io")
    return BagError(f"cannot be written: {error.strerror or error}", path=path, reason=reason)


def offered_qos(reliability: str, durability: str, depth: int) -> str:
    """Return a publisher's QoS as rosbag2 of Jazzy (bag format 9) writes it: a YAML sequence."""
    allowed = {"reliable", "best_effort"}, {"volatile", "transient_local"}
    for what, value, names in zip(
        ("reliability", "durability"), (reliability, durability), allowed, strict=True
    ):
        if value not in names:
            raise BagError(
                f"{what} is {value!r}; expected {' or '.join(sorted(names))}", reason="qos"
            )
    if depth < 1:
        raise BagError(f"depth is {depth}; at least 1", reason="qos")
    # RMW_DURATION_INFINITE: no deadline, no lifespan, no lease.
    infinite = "\n    sec: 9223372036\n    nsec: 854775807"
    return (
        f"- history: keep_last\n  depth: {depth}\n  reliability: {reliability}\n"
        f"  durability: {durability}\n  deadline:{infinite}\n  lifespan:{infinite}\n"
        f"  liveliness: automatic\n  liveliness_lease_duration:{infinite}\n"
        "  avoid_ros_namespace_conventions: false"
    )


class McapWriter:
    """Writes the records of one MCAP file so that a CRC covers every byte.

    Messages are gathered into chunks of ``chunk_size`` bytes. ``file`` is unbuffered: what has been
    written, the system has. Without the package zstandard chunks are not packed.

    :raises BagError: by each method, where the system cannot write ``path``.
    """

    def __init__(self, file: io.FileIO, path: Path, chunk_size: int) -> None:
        self._file = file
        self._path = path
        self._chunk_size = chunk_size
        self._position = self._crc = 0
        self._numbers: dict[Op, dict[bytes, tuple[int, bytes]]] = {Op.SCHEMA: {}, Op.CHANNEL: {}}
        self._metadata: set[bytes] = set()
        self._counts: Counter[int] = Counter()
        self._total, self._span = Span(), Span()
        self._chunk = bytearray()
        self._entries: dict[int, bytearray] = {}
        self._indexes: dict[Op, list[bytes]] = {Op.CHUNK_INDEX: [], Op.METADATA_INDEX: []}

    def start(self, profile: str) -> None:
        """Write the opening mark and the header, unless they are there."""
        if not self._position:
            self._write(MAGIC + pack(Op.HEADER, profile, LIBRARY))

    def add_metadata(self, name: str, entries: Mapping[str, str], verified: bool = True) -> None:
        """Write texts by name, once, with a CRC of their own where they are ``verified``."""
        crc = {METADATA_CRC: metadata_crc(name, entries)} if verified else {}
        record = pack(Op.METADATA, name, {**entries, **crc})
        if record in self._metadata:
            return
        self._metadata.add(record)
        place = pack(Op.METADATA_INDEX, self._position, len(record), name)
        self._indexes[Op.METADATA_INDEX].append(place)
        self._write(record)

    def channel(self, schema: Schema | None, channel: Channel) -> int:
        """Return the number of a channel, whose own ``schema_id`` does not count."""
        number = 0
        if schema is not None:
            number = self._number(Op.SCHEMA, schema.name, schema.encoding, schema.data)
        own = (channel.topic, channel.encoding, channel.metadata)
        return self._number(Op.CHANNEL, number, *own)

    def _number(self, kind: Op, *fields: Any) -> int:
        """The number of a schema or channel, which is written when it is first asked for."""
        numbers, key = self._numbers[kind], pack(kind, 0, *fields)
        if key not in numbers:
            record = pack(kind, len(numbers) + 1, *fields)
            numbers[key] = len(numbers) + 1, record
            self._gather(record)
        return numbers[key][0]

    def add_message(self, head: Head, data: bytes) -> None:
        """Write a message of a channel that :meth:`channel` has numbered."""
        entry = INDEX_ENTRY.pack(head.log_time, len(self._chunk))
        self._entries.setdefault(head.channel, bytearray()).extend(entry)
        for span in (self._total, self._span):
            span.add(head.log_time)
        self._counts[head.channel] += 1
        frame = FRAME.pack(Op.MESSAGE, MESSAGE_HEAD.size + len(data))
        self._gather(frame + MESSAGE_HEAD.pack(*head) + data)

    def _gather(self, record: bytes) -> None:
        self._chunk += record
        if len(self._chunk) > self._chunk_size:
            self.flush()

    def flush(self) -> None:
        """Write what has been gathered as a chunk with its index, once it has a message."""
        if not self._entries:
            return
        data, at = bytes(self._chunk), self._position
        compression, packed = ("zstd", zstandard.compress(data)) if zstandard else ("", data)
        times = self._span.start, self._span.end
        crc = zlib.crc32(data)
        self._write(pack(Op.CHUNK, *times, len(data), crc, compression, packed))
        begin, places, indexes = self._position, [], b""
        for number, entries in self._entries.items():
            places.append((number, begin + len(indexes)))
            indexes += pack(Op.MESSAGE_INDEX, number, bytes(entries))
        self._write(indexes)
        sizes = (compression, len(packed), len(data))
        self._indexes[Op.CHUNK_INDEX].append(
            pack(Op.CHUNK_INDEX, *times, at, begin - at, places, len(indexes), *sizes)
        )
        self._chunk, self._entries, self._span = bytearray(), {}, Span()

    def finish(self) -> None:
        """Write the open chunk, the summary and the closing mark."""
        self.flush()
        self._write(pack(Op.DATA_END, self._crc))
        start, summary, offsets = self._position, b"", b""
        for kind, records in self._summary():
            group = b"".join(records)
            offsets += pack(Op.SUMMARY_OFFSET, kind, start + len(summary), len(group))
            summary += group
        footer = pack(Op.FOOTER, start, start + len(summary), 0)
        end = summary + offsets + footer[: -CRC.size]
        self._write(end + CRC.pack(zlib.crc32(end)) + MAGIC)

    def _summary(self) -> Iterator[tuple[Op, list[bytes]]]:
        for kind, numbers in self._numbers.items():
            yield kind, [record for _, record in numbers.values()]
        places = [len(self._indexes[kind]) for kind in (Op.METADATA_INDEX, Op.CHUNK_INDEX)]
        kinds = [len(self._numbers[kind]) for kind in (Op.SCHEMA, Op.CHANNEL)]
        times = self._total.start, self._total.end
        facts = (self._total.count, *kinds, 0, *places, *times, self._counts.items())
        yield Op.STATISTICS, [pack(Op.STATISTICS, *facts)]
        yield Op.CHUNK_INDEX, self._indexes[Op.CHUNK_INDEX]
        yield Op.ATTACHMENT_INDEX, []
        yield Op.METADATA_INDEX, self._indexes[Op.METADATA_INDEX]

    def _write(self, data: bytes) -> None:
        view = memoryview(data)
        try:
            while view:
                view = view[self._file.write(view) :]
        except OSError as error:
            raise write_error(error, self._path) from error
        self._crc = zlib.crc32(data, self._crc)
        self._position += len(data)


class BagWriter:
    """Records messages into a new bag that ``ros2 bag play`` takes as it is.

    A thread of its own writes, so a caller is not held up by the disk, and a Ctrl-C in the caller
    cannot strike in the middle of a record. Every ``flush_period`` seconds of wall time what has
    come in goes to the operating system as a complete chunk: a killed process loses no more than
    that, and :func:`recover` saves the rest. With ``flush_period=None`` chunks end by size alone,
    and equal input gives equal bytes; that is for files that are made, not recorded.

    Use it as a context manager, or call :meth:`close` in a ``finally``. A process that is to
    survive SIGTERM with all its messages must turn the signal into an exception or a return, as
    rclpy does.

    ``metadata`` holds records of texts by name, such as the robot's name.

    :raises BagError: the file exists and ``overwrite`` is false, or it cannot be written. A full
        disk is told by the next call; what was flushed before stays recoverable.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        overwrite: bool = False,
        chunk_size: int = 16 * 1024,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        flush_period: float | None = FLUSH_PERIOD,
    ) -> None:
        if not 1 <= chunk_size <= FREE_BYTES:
            raise BagError(
                f"chunk_size is {chunk_size}; expected 1 to {FREE_BYTES}", reason="parameter"
            )
        if flush_period is not None and not flush_period > 0:
            raise BagError(f"flush_period is {flush_period}; expected above 0", reason="parameter")
        for name, entries in (metadata or {}).items():
            if not all(isinstance(text, str) for item in entries.items() for text in item):
                raise BagError(f"metadata {name!r} holds more than texts", reason="parameter")
        self._path = Path(path)
        self._period = flush_period
        self._codecs: dict[str, MessageCodec] = {}
        self._sequences: dict[str, int] = {}
        self._queue: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._error: BagError | None = None
        self._closed = False
        self._numbers: dict[str, int] = {}
        refuse_existing(self._path, overwrite)
        try:
            if overwrite:
                # Another process that writes there now keeps its own, nameless file: never two in
                # one.
                require_replaceable(self._path)
                self._path.unlink(missing_ok=True)
            self._file = self._path.open("xb", buffering=0)
        except OSError as error:
            raise write_error(error, self._path) from error
        self._writer = McapWriter(self._file, self._path, chunk_size)
        try:
            self._writer.start("ros2")
            for name, entries in (metadata or {}).items():
                self._writer.add_metadata(name, entries)
        except BagError:
            self._file.close()
            raise
        self._thread = threading.Thread(target=self._work, name="bag writer", daemon=True)
        self._thread.start()

    def add_topic(
        self,
        topic: str,
        type_name: str,
        *,
        reliability: str = "reliable",
        durability: str = "volatile",
        depth: int = 10,
        definition: str | None = None,
    ) -> None:
        """Add a topic of a type such as ``sensor_msgs/msg/JointState``.

        ``definition`` is the type's ros2msg text; by default it is made from the installed message
        classes. QoS is what a player shall offer.
        """
        self._require_open()
        if topic in self._codecs:
            raise BagError(
                f"topic {topic} already exists in this bag", path=self._path, reason="topic"
            )
        if not topic.startswith("/") or topic.endswith("/"):
            text = f"{topic!r} is not a full topic name, such as /joint_states"
            raise BagError(text, path=self._path, reason="topic")
        text = message_definition(type_name) if definition is None else definition
        qos = offered_qos(reliability, durability, depth)
        self._codecs[topic] = MessageCodec(type_name, text)
        self._sequences[topic] = 0
        self._queue.put(lambda: self._register(topic, type_name, text, qos))

    def write(
        self,
        topic: str,
        message: object,
        log_time_ns: int,
        publish_time_ns: int | None = None,
    ) -> None:
        """Record one message at its log time; its publish time is the same unless given.

        ``message`` is CDR bytes, which are taken as they are, a live ROS message, a mapping, or an
        object with the fields as attributes. It is encoded before this returns.
        """
        self._require_open()
        codec = self._codecs.get(topic)
        if codec is None:
            known = ", ".join(sorted(self._codecs)) or "none"
            text = f"topic {topic} was not added; topics: {known}"
            raise BagError(text, path=self._path, reason="no_topic")
        logged = operator.index(log_time_ns)
        published = logged if publish_time_ns is None else operator.index(publish_time_ns)
        for value in (logged, published):
            if not 0 <= value < 2**64:
                raise BagError(f"time {value} ns is outside 0 to 2^64", reason="time")
        data = _encoded(codec, message)
        if len(data) > MAX_CHUNK_BYTES // 2:
            limit = MAX_CHUNK_BYTES // 2
            raise BagError(f"the message has {len(data)} bytes; at most {limit}", reason="size_cap")
        self._sequences[topic] += 1
        sequence = self._sequences[topic]
        self._queue.put(lambda: self._add(topic, logged, data, published, sequence))
        while self._queue.qsize() > _QUEUE_LIMIT and self._error is None:
            time.sleep(0.001)

    def close(self) -> None:
        """Write what is left, the index and the summary. Further calls do nothing.

        :raises BagError: the bag could not be completed.
        """
        if not self._closed:
            self._closed = True
            self._queue.put(None)
        interrupted = None
        while self._thread.is_alive():
            try:
                self._thread.join()
            except KeyboardInterrupt as interrupt:
                # Finishing takes milliseconds; leaving now would cost the summary.
                interrupted = interrupt
        if interrupted:
            raise interrupted
        if self._error:
            error, self._error = self._error, None
            raise error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # The first error is the one to tell.
        with suppress(*([BagError] if error else [])):
            self.close()

    def _require_open(self) -> None:
        if self._error:
            raise self._error
        if self._closed:
            raise BagError("is closed", path=self._path, reason="closed")

    # From here on: the writer's thread.

    def _register(self, topic: str, type_name: str, text: str, qos: str) -> None:
        schema = Schema(type_name, "ros2msg", text.encode())
        channel = Channel(0, topic, "cdr", {"offered_qos_profiles": qos})
        self._numbers[topic] = self._writer.channel(schema, channel)

    def _add(self, topic: str, log_time: int, data: bytes, published: int, sequence: int) -> None:
        self._writer.add_message(Head(self._numbers[topic], sequence, log_time, published), data)

    def _work(self) -> None:
        try:
            self._take_in()
            self._writer.finish()
        except BagError as error:
            self._error = error
        except Exception as error:
            # The caller is in another thread: without this it would record into nothing.
            self._error = BagError(f"cannot be written: {error}", path=self._path, reason="io")
        finally:
            self._file.close()

    def _take_in(self) -> None:
        """Do what is in the queue until it is closed, flushing in time."""
        due: float | None = None
        while True:
            if due is not None and time.monotonic() >= due:
                self._writer.flush()
                due = None
            wait = None if due is None else max(0.0, due - time.monotonic())
            try:
                job = self._queue.get(timeout=wait)
            except queue.Empty:
                continue
            if job is None:
                return
            job()
            if due is None and self._period is not None:
                due = time.monotonic() + self._period


def _encoded(codec: MessageCodec, message: object) -> bytes:
    if isinstance(message, bytes | bytearray | memoryview):
        return bytes(message)
    live = live_type_name(message)
    if live not in (None, codec.type_name):
        raise BagError(f"the message is a {live}; the topic has {codec.type_name}", reason="type")
    return codec.encode(message)
