# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Strict reading and safe writing of MCAP bags. Imports no ROS.

Reading: the whole file is checked before the first message is handed out. Each record is read in
file order; CRCs, lengths, counts, times and indexes must agree with what is there. Bags written
here carry a CRC over every byte; where a foreign bag has none, the report says so in a warning.
A bag is one MCAP file, or a folder that rosbag2 wrote with its splits, packed by message, by chunk
or by file.

Times are log times in integer nanoseconds, as in the file.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Container, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, Literal

from mcap.records import Channel, Schema

from pkm_twin.bags.cdr import MessageCodec
from pkm_twin.bags.definitions import message_definition
from pkm_twin.bags.format import FormatError, RecordReader
from pkm_twin.bags.recover import RecoverResult, recover
from pkm_twin.bags.report import BagReport, TopicInfo, make_report
from pkm_twin.bags.storage import BagFile, find_storage
from pkm_twin.bags.strict import Check, Segment, check_files
from pkm_twin.bags.writer import BagWriter
from pkm_twin.errors import BagError

__all__ = [
    "Bag",
    "BagMessage",
    "BagReport",
    "BagWriter",
    "DamagedBagError",
    "RecoverResult",
    "TopicInfo",
    "inspect",
    "message_definition",
    "open_bag",
    "read_messages",
    "recover",
]


MAX_WAITING_BYTES = 256 * 1024**2
"""Largest memory for messages that wait to be sorted by log time, bytes."""
# Memory of a message's Python objects in addition to its data, bytes.
_MESSAGE_OVERHEAD_BYTES = 512


class DamagedBagError(BagError):
    """A damaged or truncated bag; ``salvageable`` is the number of intact messages in it."""

    def __init__(self, message: str, *, path: Path, reason: str, offset: int | None, salvageable: int) -> None:
        text = f"{message}; {salvageable} intact messages can be recovered"
        super().__init__(text, path=path, reason=reason, offset=offset)
        self.salvageable = salvageable


@dataclass(frozen=True)
class BagMessage:
    """One recorded message; ``data`` is its CDR encoding, times are in ns."""

    topic: str
    type: str
    log_time: int
    publish_time: int
    sequence: int
    data: bytes
    _decode: Callable[[bytes], Any] = field(repr=False, compare=False)

    @cached_property
    def message(self) -> Any:
        """The decoded message, with the attributes of a live one.

        :raises BagError: the encoding is not supported, or the data does not fit the definition.
        """
        return self._decode(self.data)


def inspect(path: str | Path) -> BagReport:
    """Check a whole bag, without decoding its messages.

    :raises BagError: the file cannot be read, or is not an MCAP bag.
    :raises DamagedBagError: it is damaged or cut.
    """
    return open_bag(path).report


def read_messages(
    path: str | Path, topics: Iterable[str] | None = None, *, order: Literal["log_time", "file"] = "log_time"
) -> Iterator[BagMessage]:
    """Check a whole bag, then yield its messages; see :meth:`Bag.messages`."""
    return open_bag(path).messages(topics, order=order)


def open_bag(path: str | Path) -> Bag:
    """Check a whole bag and return it ready to be read, any number of times.

    A bag is one MCAP file or a folder that rosbag2 wrote, packed or not.

    :raises BagError: as :func:`inspect`.
    """
    path = Path(path)
    storage = find_storage(path)
    found = check_files(storage.files)
    checks = [check for check in found.values() if isinstance(check, Check)]
    for file, check in found.items():
        if isinstance(check, BagError):
            raise check
        if check.fault:
            raise DamagedBagError(
                check.fault.text,
                path=file.path,
                reason=check.fault.reason,
                offset=check.fault.offset,
                salvageable=sum(check.message_count for check in checks),
            )
    return Bag(path, list(map(CheckedFile, storage.files, checks)), make_report(path, storage, checks))


class CheckedFile:
    """A file of a bag after its check, which can be read any number of times."""

    def __init__(self, file: BagFile, check: Check) -> None:
        self.file = file
        self.segments = check.segments
        self.records = check.records
        self._decoders = {
            number: partial(_decode, channel, check.records.schemas.get(channel.schema_id))
            for number, channel in check.records.channels.items()
        }

    def parse(self, segment: Segment, reader: RecordReader, topics: Container[str]) -> Iterator[BagMessage]:
        """Yield the messages of the topics in a segment, in the order of the file."""
        records, at = self.records, segment.offset
        try:
            for _, message in records.iterate_messages(segment.read(reader), at):
                channel = records.channels[message.channel_id]
                if channel.topic not in topics:
                    continue
                schema = records.schemas.get(channel.schema_id)
                yield BagMessage(
                    channel.topic,
                    schema.name if schema else "",
                    message.log_time,
                    message.publish_time,
                    message.sequence,
                    records.unpack_message(message, at, reader.budget),
                    self._decoders[channel.id],
                )
        except FormatError as error:
            path, text = self.file.path, f"changed since it was checked: {error.text}"
            raise BagError(text, path=path, reason="changed", offset=error.offset) from None


class Bag:
    """A bag that has been checked; ``report`` is what the check found."""

    def __init__(self, path: Path, parts: list[CheckedFile], report: BagReport) -> None:
        self._path = path
        self._parts = parts
        self.report = report

    def messages(
        self, topics: Iterable[str] | None = None, *, order: Literal["log_time", "file"] = "log_time"
    ) -> Iterator[BagMessage]:
        """Yield the messages of ``topics`` (all by default).

        ``log_time``: by log time; messages of one time in the order of the file. Memory holds the
        chunks that overlap in time, which is one or two in a bag recorded in order. ``file``: as
        they stand in the files.

        :raises BagError: a topic is not in the bag, the file changed since it was checked, or more
            than MAX_WAITING_BYTES overlap in time.
        """
        if order not in ("log_time", "file"):
            raise ValueError(f"order is {order!r}; expected 'log_time' or 'file'")
        known = self.report.topics
        wanted = set(known) if topics is None else {topics} if isinstance(topics, str) else set(topics)
        unknown = sorted(wanted - known.keys())
        if unknown:
            text = f"no topic {', '.join(unknown)}; topics: {', '.join(sorted(known))}"
            raise BagError(text, path=self._path, reason="no_topic")
        return self._iterate(wanted, order == "log_time")

    def _iterate(self, wanted: set[str], sort: bool) -> Iterator[BagMessage]:
        waiting: list[tuple[int, int, int, int, BagMessage]] = []
        held = 0
        places = [(n, segment) for n, part in enumerate(self._parts) for segment in part.segments]
        if sort:
            places.sort(key=lambda place: (place[1].messages.start, place[0], place[1].offset))
        # Splits follow each other in time, so one is open at once.
        current = -1
        with ExitStack() as opened:
            for number, segment in places:
                if number != current:
                    opened.close()
                    reader = opened.enter_context(self._parts[number].file.open())
                    current = number
                if not sort:
                    yield from self._parts[number].parse(segment, reader, wanted)
                    continue
                # No later message is earlier than this segment's start. A message of exactly that time has to
                # wait, because the segment may precede it in the file.
                while waiting and waiting[0][0] < segment.messages.start:
                    message = heapq.heappop(waiting)[-1]
                    held -= len(message.data) + _MESSAGE_OVERHEAD_BYTES
                    yield message
                for index, message in enumerate(self._parts[number].parse(segment, reader, wanted)):
                    entry = (message.log_time, number, segment.offset, index, message)
                    heapq.heappush(waiting, entry)
                    held += len(message.data) + _MESSAGE_OVERHEAD_BYTES
                if held > MAX_WAITING_BYTES:
                    text = f"more than {MAX_WAITING_BYTES} bytes of messages overlap in time"
                    text += ": they cannot be put in order; read them in the order of the file"
                    at = segment.offset
                    raise BagError(text, path=self._path, reason="overlap", offset=at)
            while waiting:
                yield heapq.heappop(waiting)[-1]


@lru_cache(maxsize=256)
def _make_codec(name: str, text: bytes) -> MessageCodec:
    try:
        return MessageCodec(name, text.decode())
    except UnicodeDecodeError:
        raise BagError("the schema is not UTF-8", reason="schema") from None


def _decode(channel: Channel, schema: Schema | None, data: bytes) -> Any:
    try:
        kind = f"type {schema.name if schema else 'no schema'}"
        if channel.message_encoding != "cdr":
            text = f"{kind} has the message encoding {channel.message_encoding!r}; expected 'cdr'"
            raise BagError(text, reason="encoding")
        if schema is None or schema.encoding != "ros2msg":
            found = repr(schema.encoding) if schema else "none"
            text = f"{kind} has the schema encoding {found}; expected 'ros2msg'"
            raise BagError(text, reason="encoding")
        return _make_codec(schema.name, schema.data).decode(data)
    except BagError as error:
        raise BagError(f"topic {channel.topic}: {error}", reason=error.reason) from error
