# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The nodes' hot paths straight from and to CDR, past the middleware's Python conversion.

What comes out has the attributes of the live message, or is arrays at once; what goes in are
templates with their numbers filled in. Every length is checked before it is used.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.bags.cdr import MessageCodec
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import BagError, MessageError
from pkm_twin.machine.joint_map import ControllerNumbers
from pkm_twin.messages.reading import COLUMNS, Ragged, TrajectoryFields

HEAD: Final = 4
"""Bytes of the encapsulation; everything is aligned from behind it."""
STAMP: Final = slice(4, 12)
"""Where the stamp of a message stands that begins with a header."""
LITTLE: Final = b"\x00\x01"
ENDIANNESS: Final = {b"\x00\x00": ">", LITTLE: "<"}
MAX_JOINT_STATE: Final = 2**18
"""Bytes of a joint state, and of a trajectory at most so many names: far beyond all robots, and
little enough that a stranger's message takes no time of the stream."""
MAX_NAMES: Final = 1000
POINT_ARRAYS: Final = tuple(COLUMNS)
TIME: Final = len(POINT_ARRAYS)
"""Place of a point's time behind its arrays."""


@dataclass(slots=True)
class _Time:
    sec: int
    nanosec: int


@dataclass(slots=True)
class _Header:
    stamp: _Time
    frame_id: str


@dataclass(slots=True)
class JointStateView:
    """What a sensor_msgs/JointState carries, under the same names."""

    header: _Header
    name: tuple[str, ...]
    position: Sequence[float]
    velocity: Sequence[float]
    effort: Sequence[float]


@dataclass(slots=True)
class _Layout:
    """Of a stream's last message: one that differs in numbers only is read in one step."""

    size: int
    names_end: int
    names: bytes
    numbers: struct.Struct
    counts: tuple[int, int, int]
    frame: str
    name: tuple[str, ...]


class JointStateDecoder:
    """Decodes sensor_msgs/JointState, quickly where names and lengths are those of the last.

    :param definition: as :func:`pkm_twin.bags.definitions.message_definition` gives it.
    """

    def __init__(self, definition: str) -> None:
        self._codec = MessageCodec("sensor_msgs/msg/JointState", definition)
        self._layout: _Layout | None = None

    def __call__(self, data: bytes) -> JointStateView:
        """Decode one message.

        :raises MessageError: the bytes are no such message.
        """
        layout = self._layout
        if (
            layout is not None
            and len(data) == layout.size
            and data[:2] == LITTLE
            and data[STAMP.stop : layout.names_end] == layout.names
        ):
            sec, nanosec, *numbers = layout.numbers.unpack_from(data, HEAD)
            p, v, e = layout.counts
            if numbers[0] == p and numbers[p + 1] == v and numbers[p + v + 2] == e:
                return JointStateView(
                    _Header(_Time(sec, nanosec), layout.frame),
                    layout.name,
                    numbers[1 : p + 1],
                    numbers[p + 2 : p + v + 2],
                    numbers[p + v + 3 :],
                )
        return self._decode(data)

    def _decode(self, data: bytes) -> JointStateView:
        if len(data) > MAX_JOINT_STATE:
            raise MessageError("bounds", f"{len(data)} bytes, at most {MAX_JOINT_STATE}")
        try:
            message = self._codec.decode(data)
        except BagError as error:
            raise MessageError("cdr", str(error)) from error
        arrays = (message.position, message.velocity, message.effort)
        if data[:2] == LITTLE:
            self._layout = _layout(data, message, arrays)
        stamp = message.header.stamp
        header = _Header(_Time(stamp.sec, stamp.nanosec), message.header.frame_id)
        return JointStateView(header, tuple(message.name), *arrays)


def _layout(data: bytes, message: Any, arrays: Sequence[Sequence[float]]) -> _Layout:
    end = STAMP.stop
    for text in (message.header.frame_id, None, *message.name):
        end += -(end - HEAD) % 4 + 4
        if text is not None:
            # An empty string may stand without its zero.
            end += struct.unpack_from("<I", data, end - 4)[0]
    code = ["<iI", f"{end - STAMP.stop}x"]
    at = end
    for values in arrays:
        pad = -(at - HEAD) % 4
        at += pad + 4
        code.append(f"{pad}xI")
        if len(values):
            pad = -(at - HEAD) % 8
            at += pad + 8 * len(values)
            code.append(f"{pad}x{len(values)}d")
    return _Layout(
        len(data),
        end,
        data[STAMP.stop : end],
        struct.Struct("".join(code)),
        (len(arrays[0]), len(arrays[1]), len(arrays[2])),
        message.header.frame_id,
        tuple(message.name),
    )


def _doubles(value: Any) -> int:
    """How many numbers a field has, 0 where it holds anything else."""
    if isinstance(value, float):
        return 1
    inner = value.values() if isinstance(value, dict) else value
    counts = [_doubles(v) for v in inner] if isinstance(value, dict | list) else []
    return sum(counts) if all(counts) else 0


def _with(value: Any, number: float) -> Any:
    """A field whose numbers are all this one."""
    if isinstance(value, dict):
        return {name: _with(v, number) for name, v in value.items()}
    return [_with(v, number) for v in value] if isinstance(value, list) else number


class DoublesTemplate:
    """Messages that differ in their stamp and in the doubles of some fields.

    :param message: fields of the message; those of nothing but doubles, in lists or in messages,
        are filled. ``stamped``: it begins with a header.
    """

    def __init__(
        self, type_name: str, definition: str, message: dict[str, Any], *, stamped: bool
    ) -> None:
        codec = MessageCodec(type_name, definition)
        arrays = {name: count for name, v in message.items() if (count := _doubles(v))}
        # Eight bytes that no text in UTF-8 has.
        marks = [bytes([0x80 + k] * 8) for k in range(len(arrays))]
        filled = {
            name: _with(message[name], struct.unpack("<d", mark)[0])
            for name, mark in zip(arrays, marks, strict=True)
        }
        data = codec.encode({**message, **filled})
        self._head = data[:HEAD]
        rest, self._pieces = data[STAMP.stop if stamped else HEAD :], list[bytes]()
        self._sizes = [8 * count for count in arrays.values()]
        for mark, size in zip(marks, self._sizes, strict=True):
            piece, rest = rest.split(mark * (size // 8))
            self._pieces.append(piece)
        self._tail = rest

    def fill(self, values: Array, stamp: tuple[int, int] | None = None) -> bytes:
        """The message with these values, and the stamp (sec, nanosec) where it has one.

        :param values: of all fields to fill, one after the other.
        """
        numbers = values.astype("<f8", copy=False).tobytes()
        parts, at = [self._head, b"" if stamp is None else struct.pack("<iI", *stamp)], 0
        for piece, size in zip(self._pieces, self._sizes, strict=True):
            parts += (piece, numbers[at : at + size])
            at += size
        parts.append(self._tail)
        return b"".join(parts)


@dataclass(frozen=True)
class RawTrajectory:
    """A trajectory_msgs/JointTrajectory in its bytes, with the fields that are read here."""

    data: bytes
    order: str
    begin: int
    """Where the first point stands."""
    fields: TrajectoryFields
    lengths: tuple[int, ...] = ()
    """Of a point's arrays, by :data:`POINT_ARRAYS`."""

    @classmethod
    def of(cls, data: bytes) -> RawTrajectory:
        """Decode a message whose points are alike, as those of every good one are.

        :raises MessageError: the bytes are no such message.
        """
        order = ENDIANNESS.get(data[:2])
        if order is None or len(data) < STAMP.stop:
            raise MessageError("cdr", f"{len(data)} bytes that are not plain CDR")
        sec, nanosec = struct.unpack_from(f"{order}iI", data, HEAD)
        frame, at = _text(data, STAMP.stop, order)
        count, at = _number(data, at, order)
        if count > MAX_NAMES:
            raise MessageError("bounds", f"{count} joint names, at most {MAX_NAMES}")
        names = []
        for _ in range(count):
            name, at = _text(data, at, order)
            names.append(name)
        points, begin = _number(data, at, order)
        header = _Header(_Time(sec, nanosec), frame)
        if points == 0:
            nothing = np.zeros((2, 0), np.int64)
            none = TrajectoryFields(header, tuple(names), nothing, dict.fromkeys(COLUMNS))
            return cls(data, order, begin, none)
        lengths = []
        at = begin
        for _ in POINT_ARRAYS:
            length, at = _number(data, at, order)
            at += (-(at - HEAD) % 8 + 8 * length) if length else 0
            lengths.append(length)
        table = _Points(begin, points, tuple(lengths))
        if points * 8 > len(data) or at > len(data):
            raise MessageError("cdr", f"{points} points in {len(data)} bytes")
        table.check_lengths(data, order)
        times = table.read(data, TIME, f"{order}u4", 2)
        columns: dict[str, Array | Ragged | None] = {
            what: table.read(data, i, f"{order}f8", lengths[i]) if lengths[i] else None
            for i, what in enumerate(POINT_ARRAYS)
        }
        seconds = np.stack([times[:, 0].astype(np.int32), times[:, 1]]).astype(np.int64)
        fields = TrajectoryFields(header, tuple(names), seconds, columns)
        return cls(data, order, begin, fields, tuple(lengths))

    def with_effort(self, efforts: ControllerNumbers) -> bytes:
        """The message with these efforts, shape (points, n), and nothing else changed."""
        points, joints = efforts.shape
        before = _Points(self.begin, points, self.lengths)
        after = _Points(self.begin, points, (*self.lengths[:-1], joints))
        data = bytearray(after.end)
        data[: self.begin] = self.data[: self.begin]
        order = self.order
        for i, length in enumerate(after.lengths):
            after.write(data, i, np.full((points, 1), length), f"{order}u4", of_length=True)
            if POINT_ARRAYS[i] == "effort":
                after.write(data, i, efforts, f"{order}f8")
            elif length:
                # As they are, bit by bit.
                kept = before.read(self.data, i, "u8", length)
                after.write(data, i, kept, "u8")
        after.write(data, TIME, before.read(self.data, TIME, "u4", 2), "u4")
        return bytes(data)


class _Points:
    """Where the numbers of a trajectory's points stand, all of whose arrays are equally long.

    How a point is padded depends on where it begins: at a multiple of eight, or four behind one.
    So either all points but the first are padded alike, or every second one is.
    """

    def __init__(self, begin: int, points: int, lengths: tuple[int, ...]) -> None:
        self.points, self.lengths = points, lengths
        first = _end(begin, lengths)
        second = _end(first, lengths)
        if (second - first) % 8 == 0:
            groups = [
                (slice(0, 1), begin, first - begin),
                (slice(1, points), first, second - first),
            ]
        else:
            stride = second - begin
            groups = [(slice(0, points, 2), begin, stride), (slice(1, points, 2), first, stride)]
            if (first - begin) % 8 == 0:
                groups = [(slice(0, points), begin, first - begin)]
        self._groups = [g for g in groups if len(range(*g[0].indices(points)))]
        which, start, stride = max(self._groups, key=lambda g: range(*g[0].indices(points))[-1])
        last = start + stride * (len(range(*which.indices(points))) - 1)
        self.end = _end(last, lengths)

    def read(
        self, data: Any, array: int, kind: str, columns: int, *, of_length: bool = False
    ) -> NDArray[Any]:
        """All points' numbers of an array (or of :data:`TIME`), shape (points, columns)."""
        values = np.empty((self.points, columns), np.dtype(kind).newbyteorder("="))
        for which, view in self._views(data, array, kind, columns, of_length):
            values[which] = view
        return values

    def write(
        self,
        data: bytearray,
        array: int,
        values: NDArray[Any],
        kind: str,
        *,
        of_length: bool = False,
    ) -> None:
        """Put all points' numbers of an array there."""
        for which, view in self._views(data, array, kind, values.shape[1], of_length):
            view[...] = values[which]

    def check_lengths(self, data: bytes, order: str) -> None:
        """Reject points whose arrays are not as long as the first one's."""
        fitting = self
        while fitting.end > len(data) and fitting.points > 1:
            fitting = _Points(self._groups[0][1], (fitting.points + 1) // 2, self.lengths)
        odd = []
        for i, length in enumerate(self.lengths):
            given = fitting.read(data, i, f"{order}u4", 1, of_length=True)[:, 0]
            other = given != length
            if other.any():
                point = int(other.argmax())
                odd.append((point, i, int(given[point])))
        if odd:
            point, i, length = min(odd)
            raise MessageError(
                "length",
                f"point {point}: {length} {POINT_ARRAYS[i]}, the first point has {self.lengths[i]}",
            )
        if self.end > len(data):
            raise MessageError(
                "cdr", f"{self.points} points take {self.end} bytes, {len(data)} are given"
            )

    def _views(
        self, data: Any, array: int, kind: str, columns: int, of_length: bool
    ) -> Iterator[tuple[slice, NDArray[Any]]]:
        for which, start, stride in self._groups:
            at = _places(start, self.lengths)[array][0 if of_length else 1]
            count = len(range(*which.indices(self.points)))
            size = np.dtype(kind).itemsize
            yield which, np.ndarray((count, columns), kind, data, at, (stride, size))


def _places(begin: int, lengths: Sequence[int]) -> list[tuple[int, int]]:
    """Where a point's arrays have their length and their first number; at last its time."""
    places = []
    at = begin
    for length in lengths:
        first = at + 4
        if length:
            first += -(first - HEAD) % 8
        places.append((at, first))
        at = first + 8 * length
    return [*places, (at, at)]


def _end(begin: int, lengths: Sequence[int]) -> int:
    return _places(begin, lengths)[-1][0] + 8


def _number(data: bytes, at: int, order: str) -> tuple[int, int]:
    """An unsigned number of four bytes at the next multiple of four, and where it ends."""
    at += -(at - HEAD) % 4
    if at + 4 > len(data):
        raise MessageError("cdr", f"cut at byte {len(data)}")
    return struct.unpack_from(f"{order}I", data, at)[0], at + 4


def _text(data: bytes, at: int, order: str) -> tuple[str, int]:
    length, at = _number(data, at, order)
    if at + length > len(data):
        raise MessageError("cdr", f"a text of {length} bytes at byte {at} of {len(data)}")
    return data[at : at + length].rstrip(b"\0").decode(errors="replace"), at + length
