# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Messages as bytes: their CDR encoding. Imports the standard library only.

Decoded messages have the attributes of live ones (``msg.header.stamp.sec``, ``msg.position``), so
code that reads attributes takes both. Numeric arrays are ``array.array``, an octet is one byte.

Written here rather than taken from a library because a bag reader must reject a truncated buffer:
a string or byte array cut short has to be an error, never a shorter value.
"""

from __future__ import annotations

import array
import dataclasses
import struct
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from pkm_twin.bags.definitions import CODES, Field, brief, parse_definition
from pkm_twin.errors import BagError

_SIZES = {code: struct.calcsize(f"={code}") for code in CODES.values()}
_UNPACK = {order: {code: struct.Struct(f"{order}{code}").unpack_from for code in _SIZES} for order in "<>"}
_LITTLE_ENDIAN_HEADER = b"\x00\x01\x00\x00"
"""CDR encapsulation header of little-endian data."""


class MessageCodec:
    """Encodes and decodes one message type by its definition."""

    def __init__(self, type_name: str, text: str) -> None:
        self.type_name = type_name
        self.definition = parse_definition(type_name, text)
        self._name = next(iter(self.definition))
        try:
            self._classes: dict[str, Any] = {
                name: dataclasses.make_dataclass(name.split("/")[1], [f.name for f in fields], slots=True)
                for name, fields in self.definition.items()
            }
        except TypeError as error:
            text = f"fields of {type_name} cannot be attributes: {error}"
            raise BagError(text, reason="schema") from error
        self._readers = {
            name: [self._choose_decoder(field) for field in fields] for name, fields in self.definition.items()
        }

    def decode(self, data: bytes) -> Any:
        """Decode one message.

        :raises BagError: the buffer is too short for the type, its encapsulation is not plain CDR,
            or a string in it is not UTF-8 ended by a zero.
        """
        order = {b"\x00\x00": ">", b"\x00\x01": "<"}.get(bytes(data[:2])) if len(data) >= 4 else None
        if order is None:
            head = bytes(data[:4]).hex(" ")
            expected = "plain CDR, 00 00 or 00 01 and two option bytes"
            text = f"{self.type_name} starts with [{head}]; expected {expected}"
            raise BagError(text, reason="cdr")
        source = _Cursor(self.type_name, data, order)
        # Ignore further bytes: rclpy serializes into a buffer of estimated size and returns all of it.
        return self._decode(self._name, source)

    def _decode(self, name: str, source: _Cursor) -> Any:
        readers = self._readers[name]
        if not readers:
            # IDL has no empty structures: ROS 2 writes one byte for them.
            source.read_number("B")
        return self._classes[name](*[read(source) for read in readers])

    def _choose_decoder(self, field: Field) -> Callable[[_Cursor], Any]:
        """Return the function that decodes a field; it is chosen once per type."""
        code, base = CODES.get(field.base), field.base
        if field.size is not None:
            return partial(self._read_items, field, code)
        if base == "byte":
            return lambda source: bytes((source.read_number("B"),))
        if code is not None:
            return lambda source: source.read_number(code)
        return _Cursor.read_text if base == "string" else partial(self._decode, base)

    def _read_items(self, field: Field, code: str | None, source: _Cursor) -> Any:
        size = field.size or 0
        count = size if field.has_fixed_length else source.read_number("I")
        if field.upto and count > size:
            raise source.make_error(f"field {field.name} has {count} items; at most {size}")
        if code is not None:
            # As in live messages, bool and byte are lists; other numbers are arrays.
            values = source.read_numbers(code, count)
            if field.base == "bool":
                return [value != 0 for value in values]
            return [bytes((value,)) for value in values] if field.base == "byte" else values
        # Each item has at least one byte: reject a count that exceeds the data before allocating memory.
        source.require_bytes(count)
        if field.base == "string":
            return [source.read_text() for _ in range(count)]
        return [self._decode(field.base, source) for _ in range(count)]

    def encode(self, message: object) -> bytes:
        """Encode a mapping, or any object with the fields as attributes, such as a live message.

        A mapping may leave fields out, which are then zero or empty: a .msg file's default values
        are not known here, so the w of a quaternion must be given. Equal input gives equal
        bytes, padding included.

        :raises BagError: a field is missing, unknown, out of range or of the wrong length.
        """
        out = bytearray(_LITTLE_ENDIAN_HEADER)
        self._encode(self._name, message, out, self.type_name)
        return bytes(out)

    def _encode(self, name: str, message: object, out: bytearray, where: str) -> None:
        fields = self.definition[name]
        if not fields:
            out.append(0)
        # A field that a mapping leaves out has the value None here.
        get: Callable[[str], Any]
        names = [field.name for field in fields]
        if isinstance(message, Mapping):
            unknown = sorted(str(key) for key in message if key not in names)
            if unknown:
                text = f"{where} has no field {', '.join(unknown)}; fields: {', '.join(names)}"
                raise BagError(text, reason="message")
            get = message.get
        else:
            missing = [name for name in names if not hasattr(message, name)]
            if missing:
                text = f"{where} is {brief(message)}, without {', '.join(missing)}"
                raise BagError(text, reason="message")
            get = partial(getattr, message)
        for field in fields:
            value = get(field.name)
            place = f"{where}.{field.name}"
            if field.size is None:
                self._encode_items(field, [self._default_value(field) if value is None else value], out, place)
            else:
                if value is None:
                    value = [self._default_value(field)] * (field.size if field.has_fixed_length else 0)
                if isinstance(value, str | Mapping) or not hasattr(value, "__len__"):
                    raise BagError(f"{place} is {brief(value)}; expected a sequence", reason="message")
                count = len(value)
                if (field.has_fixed_length and count != field.size) or (field.upto and count > (field.size or 0)):
                    expected = f"{'at most ' * field.upto}{field.size}"
                    raise BagError(f"{place} has {count} items; expected {expected}", reason="message")
                if not field.has_fixed_length:
                    _append_packed(out, "I", [count], place)
                if count:
                    self._encode_items(field, value, out, place)

    def _encode_items(self, field: Field, values: Sequence[Any], out: bytearray, where: str) -> None:
        code = CODES.get(field.base)
        if field.base == "byte":
            values = [item[0] if isinstance(item, bytes) and len(item) == 1 else item for item in values]
        if code is not None:
            _append_packed(out, code, values, where)
        elif field.base == "string":
            for text in values:
                if not isinstance(text, str):
                    raise BagError(f"{where} is {brief(text)}; expected text", reason="message")
                if field.chars and len(text) > field.chars:
                    raise BagError(f"{where} has {len(text)} characters; at most {field.chars}", reason="message")
                raw = text.encode()
                _append_packed(out, "I", [len(raw) + 1], where)
                out.extend(raw)
                out.append(0)
        else:
            for item in values:
                self._encode(field.base, item, out, where)

    @staticmethod
    def _default_value(field: Field) -> Any:
        if field.base in CODES:
            return 0
        return "" if field.base == "string" else {}


class _Cursor:
    """A read position in one encoded message; reading past its end raises an error."""

    def __init__(self, type_name: str, data: bytes, order: str) -> None:
        self._type_name = type_name
        self._data = data
        self._unpack = _UNPACK[order]
        self._swapped = order != ("<" if sys.byteorder == "little" else ">")
        self._end = len(data)
        self.position = len(_LITTLE_ENDIAN_HEADER)

    def make_error(self, text: str) -> BagError:
        return BagError(f"{self._type_name}: {text}", reason="cdr")

    def require_bytes(self, count: int) -> None:
        """Raise an error unless ``count`` bytes are left."""
        left = self._end - self.position
        if count > left:
            raise self.make_error(f"needs {count} bytes at {self.position}, {max(left, 0)} are left")

    def _align(self, size: int) -> None:
        # CDR aligns to the value's own size, counted from the end of the 4-byte header.
        self.position += -(self.position - len(_LITTLE_ENDIAN_HEADER)) % size

    def read_numbers(self, code: str, count: int) -> array.array[Any]:
        # `array` has no bool: read bytes.
        values: array.array[Any] = array.array("B" if code == "?" else code)
        if count:
            self._align(values.itemsize)
            begin = self.position
            self.require_bytes(count * values.itemsize)
            self.position += count * values.itemsize
            values.frombytes(self._data[begin : self.position])
            if self._swapped:
                values.byteswap()
        return values

    def read_number(self, code: str) -> Any:
        size = _SIZES[code]
        self._align(size)
        begin = self.position
        self.require_bytes(size)
        self.position = begin + size
        return self._unpack[code](self._data, begin)[0]

    def read_text(self) -> str:
        count = self.read_number("I")
        if count == 0:
            return ""
        self.require_bytes(count)
        raw = bytes(self._data[self.position : self.position + count])
        if raw[-1] != 0:
            raise self.make_error(f"the string at {self.position} does not end with a zero")
        self.position += count
        try:
            return raw[:-1].decode()
        except UnicodeDecodeError as error:
            raise self.make_error(f"the string at {self.position - count} is not UTF-8") from error


def _append_packed(out: bytearray, code: str, values: Sequence[Any], where: str) -> None:
    size = _SIZES[code]
    out.extend(bytes(-(len(out) - len(_LITTLE_ENDIAN_HEADER)) % size))
    try:
        out.extend(struct.pack(f"<{len(values)}{code}", *values))
    except (struct.error, OverflowError) as error:
        text = f"{where} is {brief(values if len(values) > 1 else values[0])}: {error}"
        raise BagError(text, reason="message") from error
