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

from pkm_twin.bags.cdr import MessageCodec
from pkm_twin.bags.definitions import message_definition
from pkm_twin.bags.format import (
    TOTAL_CAP,
    Channel,
    FormatError,
    RecordReader,
    Schema,
    message_data,
    utf8,
)
from pkm_twin.bags.recover import RecoverResult, count_salvageable, recover
from pkm_twin.bags.storage import METADATA_FILE, BagFile, Storage, find_storage
from pkm_twin.bags.strict import BagReport, Check, Segment, TopicInfo, join_topic
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
"""Most that is held in memory to put messages into the order of their log times."""
# What a message takes beside its data.
_MESSAGE_COST = 512


class DamagedBagError(BagError):
    """A damaged or truncated bag; ``salvageable`` is the number of intact messages in it."""

    def __init__(
        self, message: str, *, path: Path, reason: str, offset: int | None, salvageable: int
    ) -> None:
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
    path: str | Path,
    topics: Iterable[str] | None = None,
    *,
    order: Literal["log_time", "file"] = "log_time",
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
    parts = []
    for file in storage.files:
        with file.open() as reader:
            check = Check(reader)
            try:
                check.run()
            except FormatError as error:
                damage = error
            else:
                parts.append(_Part(file, check))
                continue
        raise _bag_error(damage, file, storage)
    return Bag(path, parts, storage)


class _Part:
    """One file of a bag, checked."""

    def __init__(self, file: BagFile, check: Check) -> None:
        self.file = file
        self.segments = check.segments
        self.records = check.records
        self.report = check.report(file.path)
        self._decoders = {
            number: partial(_decode, channel, check.records.schemas.get(channel.schema_id))
            for number, channel in check.records.channels.items()
        }

    def parse(
        self, segment: Segment, reader: RecordReader, topics: Container[str]
    ) -> list[BagMessage]:
        """The messages of the topics in a segment, in the order of the file."""
        try:
            data = segment.read(reader)
            return [
                BagMessage(
                    channel.topic,
                    self.records.types[head.channel],
                    head.log_time,
                    head.publish_time,
                    head.sequence,
                    message_data(data, start, end, channel.encoding, segment.offset, reader.budget),
                    self._decoders[head.channel],
                )
                for head, start, end in self.records.messages(data, segment.offset)
                if (channel := self.records.channels[head.channel]).topic in topics
            ]
        except FormatError as error:
            text = f"changed since it was checked: {error.text}"
            raise BagError(
                text, path=self.file.path, reason="changed", offset=error.offset
            ) from None


class Bag:
    """A bag that has been checked; ``report`` is what the check found."""

    def __init__(self, path: Path, parts: list[_Part], storage: Storage) -> None:
        self._path = path
        self._parts = parts
        self.report = _joined(path, [part.report for part in parts], storage)

    def messages(
        self,
        topics: Iterable[str] | None = None,
        *,
        order: Literal["log_time", "file"] = "log_time",
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
        wanted = (
            set(known) if topics is None else {topics} if isinstance(topics, str) else set(topics)
        )
        unknown = sorted(wanted - known.keys())
        if unknown:
            raise BagError(
                f"no topic {', '.join(unknown)}; topics: {', '.join(sorted(known))}",
                path=self._path,
                reason="no_topic",
            )
        return self._ordered(wanted) if order == "log_time" else self._in_file(wanted)

    def _in_file(self, wanted: set[str]) -> Iterator[BagMessage]:
        for part in self._parts:
            with part.file.open() as reader:
                for segment in part.segments:
                    yield from part.parse(segment, reader, wanted)

    def _ordered(self, wanted: set[str]) -> Iterator[BagMessage]:
        waiting: list[tuple[int, int, int, int, BagMessage]] = []
        held = 0
        places = [(n, segment) for n, part in enumerate(self._parts) for segment in part.segments]
        places.sort(key=lambda place: (place[1].start, place[0], place[1].offset))
        # Splits follow each other in time, so one is open at once.
        current = -1
        with ExitStack() as opened:
            for number, segment in places:
                if number != current:
                    opened.close()
                    reader = opened.enter_context(self._parts[number].file.open())
                    current = number
                # Nothing from here on is earlier than this segment's start. A message of exactly
                # that time stays, since the segment may stand before it in the file.
                while waiting and waiting[0][0] < segment.start:
                    message = heapq.heappop(waiting)[-1]
                    held -= len(message.data) + _MESSAGE_COST
                    yield message
                found = self._parts[number].parse(segment, reader, wanted)
                for index, message in enumerate(found):
                    entry = (message.log_time, number, segment.offset, index, message)
                    heapq.heappush(waiting, entry)
                    held += len(message.data) + _MESSAGE_COST
                if held > MAX_WAITING_BYTES:
                    raise BagError(
                        f"more than {MAX_WAITING_BYTES} bytes of messages overlap in time: they "
                        "cannot be put in order; read them in the order of the file",
                        path=self._path,
                        reason="overlap",
                        offset=segment.offset,
                    )
            while waiting:
                yield heapq.heappop(waiting)[-1]


def _joined(path: Path, reports: list[BagReport], storage: Storage) -> BagReport:
    """One report of all the files of a bag."""
    topics: dict[str, TopicInfo] = {}
    for report in reports:
        for name, info in report.topics.items():
            join_topic(topics, name, info, report.path)
    filled = [report for report in reports if report.message_count]
    count = sum(report.message_count for report in reports)
    warnings = list(dict.fromkeys(text for report in reports for text in report.warnings))
    stated = {"": storage.message_count} if storage.message_count is not None else {}
    stated |= {f" on {name}": number for name, number in storage.by_topic.items()}
    stated |= {f" in {name}": number for name, number in storage.by_file.items()}
    counts = {"": count} | {f" on {name}": info.count for name, info in topics.items()}
    counts |= {f" in {report.path.name}": report.message_count for report in reports}
    miscounts = tuple(
        f"{METADATA_FILE} states {said} messages{where}, there are {counts.get(where, 0)}"
        for where, said in stated.items()
        if said != counts.get(where, 0)
    )
    return BagReport(
        path=path,
        profile=reports[0].profile,
        library=reports[0].library,
        topics=dict(sorted(topics.items())),
        message_count=count,
        start_time=min((report.start_time for report in filled), default=0),
        end_time=max((report.end_time for report in filled), default=0),
        has_crc=all(report.has_crc for report in reports),
        has_index=all(report.has_index for report in reports),
        has_summary=all(report.has_summary for report in reports),
        warnings=(*warnings, *miscounts),
        miscounts=miscounts,
        out_of_order=sum(report.out_of_order for report in reports),
        metadata={name: entries for r in reports for name, entries in r.metadata.items()},
    )


@lru_cache(maxsize=256)
def _codec(schema: Schema) -> MessageCodec:
    """A type's codec, which may be long in the making."""
    return MessageCodec(schema.name, utf8(schema.data, "schema", None))


def _decode(channel: Channel, schema: Schema | None, data: bytes) -> Any:
    """Decode a message of the channel."""
    try:
        kind = f"type {schema.name if schema else 'no schema'}"
        if channel.encoding != "cdr":
            text = f"{kind} has the message encoding {channel.encoding!r}; expected 'cdr'"
            raise BagError(text, reason="encoding")
        if schema is None or schema.encoding != "ros2msg":
            found = repr(schema.encoding) if schema else "none"
            text = f"{kind} has the schema encoding {found}; expected 'ros2msg'"
            raise BagError(text, reason="encoding")
        return _codec(schema).decode(data)
    except (BagError, FormatError) as error:
        raise BagError(f"topic {channel.topic}: {error}", reason=error.reason) from error


def _bag_error(error: FormatError, file: BagFile, storage: Storage) -> BagError:
    """Turn a format error into the error a caller sees, with what could still be saved."""
    # Of a bag of several files an empty one is damage to the bag.
    alone = len(storage.files) == 1
    if error.reason == TOTAL_CAP or (alone and error.reason in ("empty", "not_mcap")):
        return BagError(error.text, path=file.path, reason=error.reason, offset=error.offset)
    return DamagedBagError(
        error.text,
        path=file.path,
        reason=error.reason,
        offset=error.offset,
        salvageable=count_salvageable(storage.files),
    )
