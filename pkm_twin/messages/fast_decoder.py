# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Decode and encode the nodes' most frequent messages directly as CDR bytes.

This avoids the middleware's slow conversion to Python objects. Decoded messages have the attributes
of live ones, or are arrays; encoded messages are templates with their numbers filled in. Every
length is checked before it is used.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.bags.cdr import MessageCodec
from pkm_twin.bags.definitions import JOINT_STATE
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import BagError, MessageError
from pkm_twin.machine.joint_map import ControllerNumbers
from pkm_twin.messages.reading import COLUMNS, Ragged, TrajectoryFields

ENCAPSULATION_BYTES: Final = 4
"""Length of the encapsulation header, bytes; alignment counts from its end."""
STAMP_BYTES: Final = slice(4, 12)
"""Byte range of the stamp in a message that begins with a header."""
LITTLE_ENDIAN: Final = b"\x00\x01"
MAX_JOINT_STATE_BYTES: Final = 2**18
"""Largest joint state, bytes: larger than that of every robot, and still quick to decode."""
POINT_ARRAYS: Final = tuple(COLUMNS)
TIME_INDEX: Final = len(POINT_ARRAYS)
"""Index of a point's time, which follows its arrays."""


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
    """The fields of a sensor_msgs/JointState, under the same names."""

    header: _Header
    name: tuple[str, ...]
    position: Sequence[float]
    velocity: Sequence[float]
    effort: Sequence[float]


@dataclass(slots=True)
class _Layout:
    """The byte layout of a stream's last message; an equal layout is unpacked in one call."""

    size: int
    names_end: int
    names: bytes
    numbers: struct.Struct
    counts: tuple[int, int, int]
    frame: str
    name: tuple[str, ...]


class JointStateDecoder:
    """Decodes sensor_msgs/JointState, fast if names and lengths equal those of the last message.

    :param definition: as :func:`pkm_twin.bags.definitions.message_definition` gives it.
    """

    def __init__(self, definition: str) -> None:
        self._codec = MessageCodec(JOINT_STATE, definition)
        self._layout: _Layout | None = None

    def __call__(self, data: bytes) -> JointStateView:
        """Decode one message.

        :raises MessageError: the bytes are no such message.
        """
        layout = self._layout
        if (
            layout is not None
            and len(data) == layout.size
            and data[:2] == LITTLE_ENDIAN
            and data[STAMP_BYTES.stop : layout.names_end] == layout.names
        ):
            sec, nanosec, *numbers = layout.numbers.unpack_from(data, ENCAPSULATION_BYTES)
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
        if len(data) > MAX_JOINT_STATE_BYTES:
            raise MessageError("bounds", f"{len(data)} bytes, at most {MAX_JOINT_STATE_BYTES}")
        try:
            message = self._codec.decode(data)
        except BagError as error:
            raise MessageError("cdr", str(error)) from error
        arrays, names = (message.position, message.velocity, message.effort), tuple(message.name)
        stamp, frame = message.header.stamp, message.header.frame_id
        if data[:2] == LITTLE_ENDIAN:
            end = STAMP_BYTES.stop
            for text in (frame, None, *names):
                end += -(end - ENCAPSULATION_BYTES) % 4 + 4
                if text is not None:
                    # An empty string may be sent without its terminating zero.
                    end += struct.unpack_from("<I", data, end - 4)[0]
            code, at = f"<iI{end - STAMP_BYTES.stop}x", end
            for values in arrays:
                pad = -(at - ENCAPSULATION_BYTES) % 4
                at += pad + 4
                code += f"{pad}xI"
                if len(values):
                    pad = -(at - ENCAPSULATION_BYTES) % 8
                    at += pad + 8 * len(values)
                    code += f"{pad}x{len(values)}d"
            counts = (len(arrays[0]), len(arrays[1]), len(arrays[2]))
            mark = data[STAMP_BYTES.stop : end]
            self._layout = _Layout(len(data), end, mark, struct.Struct(code), counts, frame, names)
        return JointStateView(_Header(_Time(stamp.sec, stamp.nanosec), frame), names, *arrays)


def _count_doubles(value: Any) -> int:
    """Count the numbers in a field; 0 if it contains anything else."""
    if isinstance(value, float):
        return 1
    inner = value.values() if isinstance(value, dict) else value
    counts = [_count_doubles(v) for v in inner] if isinstance(value, dict | list) else []
    return sum(counts) if all(counts) else 0


def _fill_numbers(value: Any, number: float) -> Any:
    """Return a copy of a field with every number replaced by ``number``."""
    if isinstance(value, dict):
        return {name: _fill_numbers(v, number) for name, v in value.items()}
    return [_fill_numbers(v, number) for v in value] if isinstance(value, list) else number


class DoublesTemplate:
    """An encoded message whose stamp and double-valued fields are filled in for each sending.

    :param message: fields of the message; fields of doubles only, also in lists or submessages,
        are filled in.
    :param stamped: whether the message begins with a header.
    """

    def __init__(self, type_name: str, definition: str, message: dict[str, Any], *, stamped: bool) -> None:
        codec = MessageCodec(type_name, definition)
        arrays = {name: count for name, v in message.items() if (count := _count_doubles(v))}
        # Each field is filled with eight equal bytes that never occur in UTF-8 text, to find it.
        marks = [bytes([0x80 + k] * 8) for k in range(len(arrays))]
        filled = {
            name: _fill_numbers(message[name], struct.unpack("<d", mark)[0])
            for name, mark in zip(arrays, marks, strict=True)
        }
        data = codec.encode({**message, **filled})
        self._head = data[:ENCAPSULATION_BYTES]
        rest, self._pieces = (data[STAMP_BYTES.stop if stamped else ENCAPSULATION_BYTES :], list[bytes]())
        self._sizes = [8 * count for count in arrays.values()]
        for mark, size in zip(marks, self._sizes, strict=True):
            piece, rest = rest.split(mark * (size // 8))
            self._pieces.append(piece)
        self._tail = rest

    def fill(self, values: Array, stamp: tuple[int, int] | None = None) -> bytes:
        """Encode the message with these values.

        :param values: values of all filled fields, one field after the other.
        :param stamp: seconds and nanoseconds, for a stamped message.
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
    """A trajectory_msgs/JointTrajectory as bytes, with its decoded fields."""

    data: bytes
    order: str
    begin: int
    """Offset of the first point, bytes."""
    fields: TrajectoryFields
    lengths: tuple[int, ...] = ()
    """Lengths of a point's arrays, in the order of :data:`POINT_ARRAYS`."""

    @classmethod
    def decode(cls, data: bytes) -> RawTrajectory:
        """Decode a message whose points all have arrays of the same lengths.

        :raises MessageError: the bytes are not such a message.
        """
        order = ({b"\x00\x00": ">", LITTLE_ENDIAN: "<"}).get(data[:2])
        if order is None or len(data) < STAMP_BYTES.stop:
            raise MessageError("cdr", f"{len(data)} bytes that are not plain CDR")
        sec, nanosec = struct.unpack_from(f"{order}iI", data, ENCAPSULATION_BYTES)
        frame, at = _read_text(data, STAMP_BYTES.stop, order)
        count, at = _read_number(data, at, order)
        if count > 1000:
            raise MessageError("bounds", f"{count} joint names, at most 1000")
        names = []
        for _ in range(count):
            name, at = _read_text(data, at, order)
            names.append(name)
        points, begin = _read_number(data, at, order)
        header = _Header(_Time(sec, nanosec), frame)
        if points == 0:
            nothing = np.zeros((2, 0), np.int64)
            none = TrajectoryFields(header, tuple(names), nothing, dict.fromkeys(COLUMNS))
            return cls(data, order, begin, none)
        lengths = []
        at = begin
        for _ in POINT_ARRAYS:
            length, at = _read_number(data, at, order)
            at += (-(at - ENCAPSULATION_BYTES) % 8 + 8 * length) if length else 0
            lengths.append(length)
        table = _Points(begin, points, tuple(lengths))
        if points * 8 > len(data) or at > len(data):
            raise MessageError("cdr", f"{points} points in {len(data)} bytes")
        # A point with arrays of another length shifts all later ones: read only points that fit.
        fitting = table
        while fitting.end > len(data) and fitting.points > 1:
            fitting = _Points(begin, (fitting.points + 1) // 2, table.lengths)
        odd = []
        for i, length in enumerate(table.lengths):
            given = fitting.read(data, i, f"{order}u4", 1, of_length=True)[:, 0]
            other = given != length
            if other.any():
                point = int(other.argmax())
                odd.append((point, i, int(given[point])))
        if odd:
            point, i, length = min(odd)
            raise MessageError(
                "length", f"point {point}: {length} {POINT_ARRAYS[i]}, the first point has {table.lengths[i]}"
            )
        if table.end > len(data):
            raise MessageError("cdr", f"{points} points take {table.end} bytes, {len(data)} are given")
        times = table.read(data, TIME_INDEX, f"{order}u4", 2)
        columns: dict[str, Array | Ragged | None] = {
            what: table.read(data, i, f"{order}f8", lengths[i]) if lengths[i] else None
            for i, what in enumerate(POINT_ARRAYS)
        }
        seconds = np.stack([times[:, 0].astype(np.int32), times[:, 1]]).astype(np.int64)
        fields = TrajectoryFields(header, tuple(names), seconds, columns)
        return cls(data, order, begin, fields, tuple(lengths))

    def with_effort(self, efforts: ControllerNumbers) -> bytes:
        """Encode the message with these efforts, shape (points, n), otherwise unchanged."""
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
                # Copied as integers, so that no bit changes.
                kept = before.read(self.data, i, "u8", length)
                after.write(data, i, kept, "u8")
        after.write(data, TIME_INDEX, before.read(self.data, TIME_INDEX, "u4", 2), "u4")
        return bytes(data)


class _Points:
    """Strided views of a trajectory's points in CDR; all points have arrays of the same lengths.

    A point's padding depends on its offset modulo eight, 0 or 4. So either all points but the first
    have the same padding, or every second point has. Each group of points with the same padding has
    a constant stride.
    """

    def __init__(self, begin: int, points: int, lengths: tuple[int, ...]) -> None:
        """Compute the offset and stride of each group of points."""
        self.points, self.lengths = points, lengths
        first = _find_point_end(begin, lengths)
        second = _find_point_end(first, lengths)
        if (second - first) % 8 == 0:
            groups = [(slice(0, 1), begin, first - begin), (slice(1, points), first, second - first)]
        else:
            stride = second - begin
            groups = [(slice(0, points, 2), begin, stride), (slice(1, points, 2), first, stride)]
            if (first - begin) % 8 == 0:
                groups = [(slice(0, points), begin, first - begin)]
        self._groups = [g for g in groups if len(range(*g[0].indices(points)))]
        which, start, stride = max(self._groups, key=lambda g: range(*g[0].indices(points))[-1])
        last = start + stride * (len(range(*which.indices(points))) - 1)
        self.end = _find_point_end(last, lengths)

    def read(self, data: Any, array: int, kind: str, columns: int, *, of_length: bool = False) -> NDArray[Any]:
        """Read an array (or :data:`TIME_INDEX`) of all points, shape (points, columns)."""
        values = np.empty((self.points, columns), np.dtype(kind).newbyteorder("="))
        for which, view in self._iterate_views(data, array, kind, columns, of_length):
            values[which] = view
        return values

    def write(self, data: bytearray, array: int, values: NDArray[Any], kind: str, *, of_length: bool = False) -> None:
        """Write an array of all points."""
        for which, view in self._iterate_views(data, array, kind, values.shape[1], of_length):
            view[...] = values[which]

    def _iterate_views(
        self, data: Any, array: int, kind: str, columns: int, of_length: bool
    ) -> Iterator[tuple[slice, NDArray[Any]]]:
        for which, start, stride in self._groups:
            at = _find_offsets(start, self.lengths)[array][0 if of_length else 1]
            count = len(range(*which.indices(self.points)))
            size = np.dtype(kind).itemsize
            yield which, np.ndarray((count, columns), kind, data, at, (stride, size))


def _find_offsets(begin: int, lengths: Sequence[int]) -> list[tuple[int, int]]:
    """List the offsets of the length and first number of a point's arrays, then of its time."""
    places, at = [], begin
    for length in lengths:
        first = at + 4
        if length:
            first += -(first - ENCAPSULATION_BYTES) % 8
        places.append((at, first))
        at = first + 8 * length
    return [*places, (at, at)]


def _find_point_end(begin: int, lengths: Sequence[int]) -> int:
    """Return the offset after a point's arrays and its duration of 8 bytes."""
    return _find_offsets(begin, lengths)[-1][0] + 8


def _read_number(data: bytes, at: int, order: str) -> tuple[int, int]:
    """Read the unsigned 32-bit number at the next multiple of four; return it and its end."""
    at += -(at - ENCAPSULATION_BYTES) % 4
    if at + 4 > len(data):
        raise MessageError("cdr", f"cut at byte {len(data)}")
    return struct.unpack_from(f"{order}I", data, at)[0], at + 4


def _read_text(data: bytes, at: int, order: str) -> tuple[str, int]:
    length, at = _read_number(data, at, order)
    if at + length > len(data):
        raise MessageError("cdr", f"a text of {length} bytes at byte {at} of {len(data)}")
    return data[at : at + length].rstrip(b"\0").decode(errors="replace"), at + length
