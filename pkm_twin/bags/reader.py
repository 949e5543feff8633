# SPDX-License-Identifier: Apache-2.0
"""Strict reading and safe writing of MCAP bags. Imports no ROS.

Reading: the whole file is checked before the first message is handed out. Each record is read in
file order; CRCs, lengths, counts, times and indexes must agree with what is there. Bags written
here carry a CRC over every byte; where a foreign bag has none, the report says so in a warning.

Times are log times in integer nanoseconds, as in the file.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from pkm_twin.bags.cdr import MessageCodec, message_definition
from pkm_twin.bags.format import (
    MESSAGE,
    MESSAGE_HEAD,
    Channel,
    FormatError,
    RecordReader,
    Schema,
    iterate_records,
    message_head,
    open_reader,
    utf8,
)
from pkm_twin.bags.recover import RecoverResult, Salvage, recover
from pkm_twin.bags.strict import BagReport, Check, Segment, TopicInfo
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


class DamagedBagError(BagError):
    """A bag that is damaged or cut; ``salvageable`` messages in it are still whole."""

    def __init__(
        self, message: str, *, path: Path, reason: str, offset: int | None, salvageable: int
    ) -> None:
        text = f"{message}; {salvageable} whole messages can be recovered"
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
    path: str | Path,
    topics: Iterable[str] | None = None,
    *,
    order: Literal["log_time", "file"] = "log_time",
) -> Iterator[BagMessage]:
    """Check a whole bag, then yield its messages; see :meth:`Bag.messages`."""
    return open_bag(path).messages(topics, order=order)


def open_bag(path: str | Path) -> Bag:
    """Check a whole bag and return it ready to be read, any number of times.

    :raises BagError: as :func:`inspect`.
    """
    path = Path(path)
    with open_reader(path) as reader:
        check = Check(reader)
        try:
            check.run()
        except FormatError as error:
            raise _bag_error(error, path) from None
    return Bag(path, check)


class Bag:
    """A bag that has been checked; ``report`` is what the check found."""

    def __init__(self, path: Path, check: Check) -> None:
        self._path = path
        self._segments = check.segments
        self._channels = check.records.channels
        self._types = check.records.types
        self._decoders = {
            number: _decoder(channel, check.records.schemas.get(channel.schema_id))
            for number, channel in self._channels.items()
        }
        self.report = check.report(path)

    def messages(
        self,
        topics: Iterable[str] | None = None,
        *,
        order: Literal["log_time", "file"] = "log_time",
    ) -> Iterator[BagMessage]:
        """Yield the messages of ``topics`` (all by default).

        ``log_time``: by log time; messages of one time in the order of the file. Memory holds the
        chunks that overlap in time, which is one or two in a bag recorded in order. ``file``: as
        they stand in the file.

        :raises BagError: a topic is not in the bag, or the file changed since it was checked.
        """
        if order not in ("log_time", "file"):
            raise ValueError(f"order is {order!r}; expected 'log_time' or 'file'")
        wanted = self._wanted(topics)
        return self._ordered(wanted) if order == "log_time" else self._in_file(wanted)

    def _wanted(self, topics: Iterable[str] | None) -> set[int]:
        if topics is None:
            return set(self._channels)
        names = {topics} if isinstance(topics, str) else set(topics)
        unknown = sorted(names - self.report.topics.keys())
        if unknown:
            raise BagError(
                f"no topic {', '.join(unknown)}; topics: {', '.join(sorted(self.report.topics))}",
                path=self._path,
                reason="no_topic",
            )
        return {number for number, channel in self._channels.items() if channel.topic in names}

    def _in_file(self, wanted: set[int]) -> Iterator[BagMessage]:
        with open_reader(self._path) as reader:
            for segment in self._segments:
                yield from self._load(reader, segment, wanted)

    def _ordered(self, wanted: set[int]) -> Iterator[BagMessage]:
        waiting: list[tuple[int, int, int, BagMessage]] = []
        by_start = sorted(self._segments, key=lambda segment: segment.start)
        with open_reader(self._path) as reader:
            for segment in by_start:
                # Nothing from here on is earlier than this segment's start. A message of exactly
                # that time stays, since the segment may stand before it in the file.
                while waiting and waiting[0][0] < segment.start:
                    yield heapq.heappop(waiting)[3]
                for index, message in enumerate(self._load(reader, segment, wanted)):
                    entry = (message.log_time, segment.offset, index, message)
                    heapq.heappush(waiting, entry)
            while waiting:
                yield heapq.heappop(waiting)[3]

    def _load(
        self, reader: RecordReader, segment: Segment, wanted: set[int]
    ) -> Iterator[BagMessage]:
        try:
            yield from self._parse(segment.read(reader), wanted)
        except FormatError as error:
            text = f"changed since it was checked: {error.text}"
            raise BagError(text, path=self._path, reason="changed", offset=error.offset) from None

    def _parse(self, data: bytes, wanted: set[int]) -> Iterator[BagMessage]:
        for opcode, start, end in iterate_records(data, 0):
            if opcode != MESSAGE:
                continue
            number, sequence, log_time, publish_time = message_head(data, start, end, 0)
            if number in wanted:
                yield BagMessage(
                    self._channels[number].topic,
                    self._types[number],
                    log_time,
                    publish_time,
                    sequence,
                    data[start + MESSAGE_HEAD.size : end],
                    self._decoders[number],
                )


def _decoder(channel: Channel, schema: Schema | None) -> Callable[[bytes], Any]:
    """Return a function that decodes the channel's messages; the codec is made at the first."""
    codec: MessageCodec | None = None

    def decode(data: bytes) -> Any:
        nonlocal codec
        try:
            if codec is None:
                codec = _codec(channel, schema)
            return codec.decode(data)
        except (BagError, FormatError) as error:
            raise BagError(f"topic {channel.topic}: {error}", reason=error.reason) from error

    return decode


def _codec(channel: Channel, schema: Schema | None) -> MessageCodec:
    name = schema.name if schema else "no schema"
    if channel.encoding != "cdr":
        raise BagError(
            f"type {name} has the message encoding {channel.encoding!r}; expected 'cdr'",
            reason="encoding",
        )
    if schema is None or schema.encoding != "ros2msg":
        found = repr(schema.encoding) if schema else "none"
        raise BagError(
            f"type {name} has the schema encoding {found}; expected 'ros2msg'", reason="encoding"
        )
    return MessageCodec(schema.name, utf8(schema.data, "schema", None))


def _bag_error(error: FormatError, path: Path) -> BagError:
    """Turn a format error into the error a caller sees, with what could still be saved."""
    if error.reason in ("empty", "not_mcap"):
        return BagError(error.text, path=path, reason=error.reason, offset=error.offset)
    with open_reader(path) as reader:
        count = Salvage(reader).run(None).messages
    return DamagedBagError(
        error.text, path=path, reason=error.reason, offset=error.offset, salvageable=count
    )
