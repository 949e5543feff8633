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
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self, cast

from mcap.records import Channel, Schema
from mcap.writer import Writer

from pkm_twin.bags.cdr import MessageCodec
from pkm_twin.bags.definitions import live_type_name, message_definition
from pkm_twin.bags.format import FREE_BYTES, MAX_CHUNK_BYTES, METADATA_CRC, metadata_crc
from pkm_twin.errors import BagError
from pkm_twin.files import require_replaceable, write_atomically

FLUSH_PERIOD = 0.05
"""Period at which a live recording is written to the file, s; a killed process loses up to two periods."""


def reject_existing(path: Path, overwrite: bool) -> None:
    """Reject an existing target, including a dangling link, unless it may be overwritten.

    :raises BagError: the target exists.
    """
    if not overwrite and os.path.lexists(path):
        raise BagError("exists already", path=path, reason="exists")


def convert_write_error(error: OSError, path: Path) -> BagError:
    """Convert the operating system's error on writing ``path`` to a BagError."""
    reason = {
        errno.ENOSPC: "disk_full",
        errno.EDQUOT: "disk_full",
        errno.EFBIG: "disk_full",
        errno.EEXIST: "exists",
        errno.ENOENT: "not_found",
    }.get(error.errno or 0, "io")
    return BagError(f"cannot be written: {error.strerror or error}", path=path, reason=reason)


def offered_qos(reliability: str, durability: str, depth: int) -> str:
    """Return a publisher's QoS as rosbag2 of Jazzy (bag format 9) writes it: a YAML sequence."""
    allowed = {"reliable", "best_effort"}, {"volatile", "transient_local"}
    for what, value, names in zip(("reliability", "durability"), (reliability, durability), allowed, strict=True):
        if value not in names:
            text = f"{what} is {value!r}; expected {' or '.join(sorted(names))}"
            raise BagError(text, reason="qos")
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


class McapWriter(Writer):
    """Writes an MCAP file in which CRCs cover every byte, and each type and topic stands once."""

    def __init__(self, file: io.FileIO, path: Path, chunk_size: int, profile: str) -> None:
        super().__init__(cast("IO[bytes]", _UnbufferedFile(file, path)), chunk_size, enable_data_crcs=True)
        self._numbers: dict[str, Any] = {}
        self.start(profile, "pkm_twin")

    def register(self, schema: Schema | None, channel: Channel) -> int:
        """Write a schema and a channel unless they are in the file; return the channel's number in it."""
        number = 0
        if schema is not None:
            number = self._write_once(self.register_schema, schema.name, schema.encoding, schema.data)
        facts = (channel.topic, channel.message_encoding, number, channel.metadata)
        number = self._write_once(self.register_channel, *facts)
        return int(number)

    def _write_once(self, act: Callable[..., Any], *facts: Any) -> Any:
        key = repr(facts)
        if key not in self._numbers:
            self._numbers[key] = act(*facts)
        return self._numbers[key]

    def put_metadata(self, name: str, entries: Mapping[str, str], verified: bool = True) -> None:
        """Write a metadata record once; with a CRC if the entries are ``verified``."""
        crc = {METADATA_CRC: metadata_crc(name, entries)} if verified else {}
        self._write_once(self.add_metadata, name, {**entries, **crc})


class _UnbufferedFile:
    """An unbuffered file, so that written bytes survive the end of the process.

    :raises BagError: the system cannot write it.
    """

    def __init__(self, file: io.FileIO, path: Path) -> None:
        self._file, self._path = file, path
        self.tell, self.flush = file.tell, file.flush

    def write(self, data: bytes) -> None:
        view = memoryview(data)
        try:
            while view:
                view = view[self._file.write(view) :]
        except OSError as error:
            raise convert_write_error(error, self._path) from error


class BagWriter:
    """Records messages into a new bag that ``ros2 bag play`` takes as it is.

    A thread writes, so that the caller does not wait for the disk and Ctrl-C in the caller does not
    interrupt a record. Every ``flush_period`` seconds of wall time the messages since the last flush
    are written as a complete chunk: a killed process loses only later messages, and :func:`recover`
    saves the others. With ``flush_period=None`` chunks end by size alone, and equal input gives equal
    bytes, for files that are not recorded live.

    Use it as a context manager, or call :meth:`close` in a ``finally``. To keep all messages after
    SIGTERM, a process must convert the signal to an exception or a return, as rclpy does.

    ``metadata``: records of texts by name, such as the robot's name.

    :raises BagError: the file exists and ``overwrite`` is false, or it cannot be written. The call
        after a full disk raises; messages flushed before can be recovered.
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
            text = f"chunk_size is {chunk_size}; expected 1 to {FREE_BYTES}"
            raise BagError(text, reason="parameter")
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
        reject_existing(self._path, overwrite)
        try:
            if overwrite:
                # Unlink instead of truncating: a process that still writes the old file keeps it, without a name.
                require_replaceable(self._path)
                self._path.unlink(missing_ok=True)
            self._file = self._path.open("xb", buffering=0)
        except OSError as error:
            raise convert_write_error(error, self._path) from error
        try:
            self._writer = McapWriter(self._file, self._path, chunk_size, "ros2")
            for name, entries in (metadata or {}).items():
                self._writer.put_metadata(name, entries)
        except BagError:
            self._file.close()
            raise
        self._thread = threading.Thread(target=self._run_thread, name="bag writer", daemon=True)
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
        classes. The QoS is stored for players.
        """
        self._require_open()
        if topic in self._codecs:
            text = f"topic {topic} already exists in this bag"
            raise BagError(text, path=self._path, reason="topic")
        if not topic.startswith("/") or topic.endswith("/"):
            text = f"{topic!r} is not a full topic name, such as /joint_states"
            raise BagError(text, path=self._path, reason="topic")
        text = message_definition(type_name) if definition is None else definition
        qos = offered_qos(reliability, durability, depth)
        self._codecs[topic] = MessageCodec(type_name, text)
        self._sequences[topic] = 0
        self._queue.put(lambda: self._write_channel(topic, type_name, text, qos))

    def write(self, topic: str, message: object, log_time_ns: int, publish_time_ns: int | None = None) -> None:
        """Record one message at its log time; its publish time is the same unless given.

        ``message``: CDR bytes, which are stored unchanged, a live ROS message, a mapping, or an object
        with the fields as attributes. It is encoded before the call returns.
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
        if isinstance(message, bytes | bytearray | memoryview):
            data = bytes(message)
        else:
            live = live_type_name(message)
            if live not in (None, codec.type_name):
                text = f"the message is a {live}; the topic has {codec.type_name}"
                raise BagError(text, reason="type")
            data = codec.encode(message)
        if len(data) > MAX_CHUNK_BYTES // 2:
            limit = MAX_CHUNK_BYTES // 2
            raise BagError(f"the message has {len(data)} bytes; at most {limit}", reason="size_cap")
        self._sequences[topic] += 1
        sequence = self._sequences[topic]
        self._queue.put(lambda: self._write_message(topic, logged, data, published, sequence))
        # Bound the memory: wait while more than 20,000 messages are in the queue.
        while self._queue.qsize() > 20_000 and self._error is None:
            time.sleep(0.001)

    def close(self) -> None:
        """Write the remaining messages, the index and the summary; further calls do nothing.

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
                # Finish first, which takes milliseconds: without it the file would have no summary.
                interrupted = interrupt
        if interrupted:
            raise interrupted
        if self._error:
            error, self._error = self._error, None
            raise error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # Do not replace the error of the block by one of closing.
        with suppress(*([BagError] if error else [])):
            self.close()

    def _require_open(self) -> None:
        if self._error:
            raise self._error
        if self._closed:
            raise BagError("is closed", path=self._path, reason="closed")

    # The following methods run in the writer's thread.

    def _write_channel(self, topic: str, type_name: str, text: str, qos: str) -> None:
        schema = Schema(0, text.encode(), "ros2msg", type_name)
        channel = Channel(0, topic, "cdr", {"offered_qos_profiles": qos}, 0)
        self._numbers[topic] = self._writer.register(schema, channel)

    def _write_message(self, topic: str, log_time: int, data: bytes, published: int, sequence: int) -> None:
        number = self._numbers[topic]
        self._writer.add_message(number, log_time, data, published, sequence)

    def _run_thread(self) -> None:
        try:
            # Process the queue until it is closed; flush at the interval.
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
                    break
                job()
                if due is None and self._period is not None:
                    due = time.monotonic() + self._period
            self._writer.finish()
        except BagError as error:
            self._error = error
        except Exception as error:
            # Pass the error to the caller's thread, which would otherwise continue without a file.
            self._error = BagError(f"cannot be written: {error}", path=self._path, reason="io")
        finally:
            self._file.close()


@contextmanager
def write_whole_bag(path: Path, overwrite: bool, metadata: Mapping[str, Mapping[str, str]]) -> Iterator[BagWriter]:
    """Write a bag under a temporary name, and rename it when it is complete.

    :raises BagError: the file exists and ``overwrite`` is false, or it cannot be written.
    """
    reject_existing(path, overwrite)
    try:
        with write_atomically(path) as hidden, BagWriter(hidden, metadata=metadata, flush_period=None) as writer:
            yield writer
    except OSError as error:
        raise convert_write_error(error, path) from error
    except BagError as error:
        # Users do not know the temporary name.
        if error.path is None or error.path == path:
            raise
        text = str(error).removeprefix(f"{error.path}: ")
        raise BagError(text, path=path, reason=error.reason) from error
