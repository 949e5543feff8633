# SPDX-License-Identifier: Apache-2.0
"""ROS 2 message definitions and their CDR encoding. Imports the standard library only.

Decoded messages have the attributes of live ones (``msg.header.stamp.sec``, ``msg.position``), so
code that reads attributes takes both. Numeric arrays are ``array.array``, an octet is one byte.

Written here rather than taken from a library because a bag reader must refuse a truncated buffer:
a string or byte array cut short has to be an error, never a shorter value.
"""

from __future__ import annotations

import array
import dataclasses
import importlib.util
import os
import re
import struct
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from pkm_twin.errors import BagError

SEPARATOR = "=" * 80
"""The line between the parts of a concatenated message definition."""

# .msg name -> struct code. ``byte`` and ``char`` are both unsigned 8-bit in ROS 2.
_CODES = {
    "bool": "?",
    "byte": "B",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
# What the message classes print -> what a .msg file says.
_MSG_NAMES = {"double": "float64", "float": "float32", "boolean": "bool", "octet": "byte"}

MAX_DEFINITION_CHARACTERS = 1024**2
"""Longest definition text; the longest of the common interfaces has some 20,000 characters."""
MAX_FIELDS = 5_000
"""Most fields of a message and of all that it holds."""
MAX_NESTING = 50
"""How deep a message may hold others."""
MAX_BOUND = 2**32 - 1
"""Largest array size and bound: lengths are 32-bit numbers in CDR."""

_TYPE_NAME = re.compile(r"[a-z][a-z0-9_]*/msg/[A-Z][A-Za-z0-9]*")
_FIELD = re.compile(
    r"(?P<base>[A-Za-z][\w/]*)(?:<=(?P<chars>\d+))?"
    r"(?P<array>\[(?:(?P<upto><=)?(?P<size>\d+))?\])?\s+(?P<name>[A-Za-z]\w*)\s*(?P<rest>.*)",
    re.ASCII,
)
# package/Type, or package/msg/Type.
_HELD_NAME = re.compile(r"[A-Za-z]\w*(?:/\w+)*/[A-Za-z]\w*", re.ASCII)
_SPEC = re.compile(r"(?P<base>[A-Za-z][\w/]*)(?:<(?P<chars>\d+)>)?(?:\[(?P<size>\d+)\])?")
_SEQUENCE = re.compile(r"sequence<(?P<item>.+?)(?:,\s*(?P<bound>\d+))?>")

# Present in every ROS 2 system; some writers leave their text out of the definition.
_BUILTIN = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
}

# Encapsulation header of plain CDR: representation identifier; the options that follow are free.
_ENDIANNESS = {b"\x00\x00": ">", b"\x00\x01": "<"}
_NATIVE = "<" if sys.byteorder == "little" else ">"
_SIZES = {code: struct.calcsize(f"={code}") for code in _CODES.values()}
_UNPACK = {
    order: {code: struct.Struct(f"{order}{code}").unpack_from for code in _SIZES} for order in "<>"
}
_ARRAY_CODES = {"?": "B"}
"""Where an array knows no such code, the one of its bytes."""
_LITTLE_HEADER = b"\x00\x01\x00\x00"


@dataclasses.dataclass(frozen=True)
class Field:
    """One field of a message: ``base`` is a .msg primitive, ``string`` or ``package/Type``.

    ``size`` is None for a single value, 0 for an unbounded sequence, else the length or, with
    ``upto``, the bound. ``chars`` bounds a string (0: none).
    """

    name: str
    base: str
    size: int | None = None
    upto: bool = False
    chars: int = 0

    @property
    def fixed(self) -> bool:
        """Whether the field is an array without a length in front."""
        return bool(self.size) and not self.upto


Definition = dict[str, tuple[Field, ...]]
"""Fields by ``package/Type``, the message itself and all that it holds."""


def message_class(type_name: str) -> Any:
    """Return the ROS message class of ``package/msg/Type``.

    :raises BagError: the name is malformed, or its package is not installed here.
    """
    if not _TYPE_NAME.fullmatch(type_name):
        raise BagError(
            f"{type_name!r} is not a type name; expected package/msg/Type", reason="type"
        )
    package, _, name = type_name.split("/")
    # A bag may name any package: only one of messages is imported.
    found = importlib.util.find_spec(package)
    places = (found and found.submodule_search_locations) or ()
    if not any(os.path.isdir(os.path.join(place, "msg")) for place in places):
        text = f"message type {type_name} is not installed: no message package {package!r}"
        raise BagError(text, reason="type")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise BagError(
            f"message type {type_name} is not installed: {error}", reason="type"
        ) from error


def message_definition(type_name: str) -> str:
    """Return the ``ros2msg`` text of a type: its fields, then those of every type it holds.

    Made from the message classes, since a pip installation of ROS 2 carries no .msg files.
    Constants and default values are not part of the classes' field list, and not of the text.
    """
    sections: dict[str, str] = {}
    waiting = [_short_name(type_name)]
    while waiting:
        name = waiting.pop(0)
        if name in sections:
            continue
        package, short = name.split("/")
        cls = message_class(f"{package}/msg/{short}")
        fields = [_class_field(*item) for item in cls.get_fields_and_field_types().items()]
        sections[name] = "\n".join(_field_text(field) for field in fields)
        waiting += [field.base for field in fields if "/" in field.base]
    (main, *others) = sections.items()
    parts = [main[1], *(f"MSG: {name}\n{text}" for name, text in others)]
    return f"\n{SEPARATOR}\n".join(parts) + "\n"


def _short_name(type_name: str) -> str:
    parts = type_name.split("/")
    return f"{parts[0]}/{parts[-1]}"


def _checked_name(type_name: str) -> str:
    """The short name of a type that a file names."""
    if not _HELD_NAME.fullmatch(type_name):
        raise BagError(
            f"{_brief(type_name)} is no type name; expected package/msg/Type", reason="schema"
        )
    return _short_name(type_name)


def _class_field(name: str, spec: str) -> Field:
    """Turn ``sequence<double, 3>`` and its like, as the classes print them, into a field."""
    sequence = _SEQUENCE.fullmatch(spec)
    match = _SPEC.fullmatch(sequence["item"] if sequence else spec)
    if match is None:
        raise BagError(f"field {name} has the unknown type {spec!r}", reason="type")
    base = _MSG_NAMES.get(match["base"], match["base"])
    size: int | None = int(match["size"]) if match["size"] else None
    if sequence:
        size = int(sequence["bound"] or 0)
    return Field(name, base, size, bool(sequence and sequence["bound"]), int(match["chars"] or 0))


def _field_text(field: Field) -> str:
    chars = f"<={field.chars}" if field.chars else ""
    brackets = "" if field.size is None else f"[{'<=' * field.upto}{field.size or ''}]"
    return f"{field.base}{chars}{brackets} {field.name}"


def parse_definition(type_name: str, text: str) -> Definition:
    """Parse a concatenated ``ros2msg`` definition; the first entry is the message itself.

    :raises BagError: a line is not a field, a held type has no definition or holds itself, or there
        is more than MAX_DEFINITION_CHARACTERS, MAX_FIELDS, MAX_NESTING or MAX_BOUND of it.
    """
    if len(text) > MAX_DEFINITION_CHARACTERS:
        raise BagError(
            f"the definition of {type_name} has {len(text)} characters; "
            f"at most {MAX_DEFINITION_CHARACTERS}",
            reason="schema",
        )
    own = _checked_name(type_name)
    texts = dict(_BUILTIN)
    for index, part in enumerate(re.split(r"^={3,}[ \t]*$", text, flags=re.MULTILINE)):
        name = own
        fields = part
        if index:
            heading, _, fields = part.strip().partition("\n")
            if not heading.startswith("MSG:"):
                raise BagError(
                    f"definition of {type_name}: part {index} starts with {_brief(heading)}, "
                    "not 'MSG:'",
                    reason="schema",
                )
            name = _checked_name(heading[4:].strip())
        texts[name] = fields
    definition: Definition = {}
    _resolve(own, texts, definition, ())
    return {own: definition.pop(own), **definition}


def _resolve(
    name: str, texts: Mapping[str, str], definition: Definition, holders: tuple[str, ...]
) -> None:
    """Add ``name`` and the types it holds to ``definition``; ``holders`` are those above it."""
    if name in holders:
        raise BagError(f"message type {name} holds itself", reason="schema")
    if name in definition:
        return
    if name not in texts:
        raise BagError(f"no definition of {name}, which {holders[-1]} holds", reason="schema")
    if len(holders) >= MAX_NESTING:
        raise BagError(
            f"{holders[0]} holds types {len(holders)} deep; at most {MAX_NESTING - 1}",
            reason="schema",
        )
    fields = tuple(_parse_fields(name, texts))
    if len(fields) + sum(map(len, definition.values())) > MAX_FIELDS:
        raise BagError(
            f"{(*holders, name)[0]} has more than {MAX_FIELDS} fields with all that it holds",
            reason="schema",
        )
    for field in fields:
        if "/" in field.base:
            _resolve(field.base, texts, definition, (*holders, name))
    definition[name] = fields


def _parse_fields(name: str, texts: Mapping[str, str]) -> list[Field]:
    fields = []
    for line in texts[name].splitlines():
        # A string constant may hold a '#', so constants are told apart before comments are cut.
        match = _FIELD.fullmatch(line.strip())
        if match is None or match["rest"].startswith("="):
            if match is None and line.split("#")[0].strip():
                raise BagError(
                    f"definition of {name}: {_brief(line)} is not a field", reason="schema"
                )
            continue
        base = _base_type(match["base"], name.split("/", 1)[0], texts)
        where = f"definition of {name}: field {match['name']}"
        size = None if match["array"] is None else _bound(match["size"], where)
        chars = _bound(match["chars"], where)
        fields.append(Field(match["name"], base, size, bool(match["upto"]), chars))
    return fields


def _bound(digits: str | None, where: str) -> int:
    """A size or bound as a definition writes it, 0 where it writes none."""
    # Python refuses to convert thousands of digits.
    if digits and (len(digits) > 20 or int(digits) > MAX_BOUND):
        raise BagError(
            f"{where} has the bound {_brief(digits)}; at most {MAX_BOUND}", reason="schema"
        )
    return int(digits or 0)


def _base_type(base: str, package: str, texts: Mapping[str, str]) -> str:
    if base in _CODES or base == "string":
        return base
    if base == "wstring":
        raise BagError("wide strings (wstring) are not supported", reason="schema")
    if "/" in base:
        return _short_name(base)
    local = f"{package}/{base}"
    # A bare Header is std_msgs/Header by the rules of .msg files.
    return "std_msgs/Header" if base == "Header" and local not in texts else local


def live_type_name(message: object) -> str | None:
    """Return ``package/msg/Type`` of a live ROS message, None of any other object."""
    cls = type(message)
    if not hasattr(cls, "get_fields_and_field_types"):
        return None
    return f"{cls.__module__.split('.')[0]}/msg/{cls.__name__}"


class MessageCodec:
    """Encodes and decodes one message type by its definition."""

    def __init__(self, type_name: str, text: str) -> None:
        self.type_name = type_name
        self.definition = parse_definition(type_name, text)
        self._name = next(iter(self.definition))
        self._classes = {
            name: _value_class(name.split("/")[1], fields)
            for name, fields in self.definition.items()
        }
        self._readers = {
            name: [self._reader(field) for field in fields]
            for name, fields in self.definition.items()
        }

    def decode(self, data: bytes) -> Any:
        """Decode one message.

        :raises BagError: the buffer is too short for the type, its encapsulation is not plain CDR,
            or a string in it is not UTF-8 ended by a zero.
        """
        order = _ENDIANNESS.get(bytes(data[:2])) if len(data) >= 4 else None
        if order is None:
            head = bytes(data[:4]).hex(" ")
            raise BagError(
                f"{self.type_name} starts with [{head}]; expected plain CDR, 00 00 or 00 01 and "
                "two option bytes",
                reason="cdr",
            )
        source = _Source(self.type_name, data, order)
        # Bytes may be left: rclpy serializes into a buffer of estimated size and keeps it all.
        return self._decode(self._name, source)

    def _decode(self, name: str, source: _Source) -> Any:
        readers = self._readers[name]
        if not readers:
            # IDL knows no empty structure: ROS 2 puts one byte into it.
            source.number("B")
        return self._classes[name](*[read(source) for read in readers])

    def _reader(self, field: Field) -> Callable[[_Source], Any]:
        """What reads a field: decided once a type, not once a message."""
        code, base = _CODES.get(field.base), field.base
        if field.size is not None:
            return partial(self._read_items, field, code)
        if base == "byte":
            return lambda source: bytes((source.number("B"),))
        if code is not None:
            return lambda source: source.number(code)
        return _Source.text if base == "string" else partial(self._decode, base)

    def _read_items(self, field: Field, code: str | None, source: _Source) -> Any:
        size = field.size or 0
        count = size if field.fixed else source.number("I")
        if field.upto and count > size:
            raise source.error(f"field {field.name} has {count} items; at most {size}")
        if code is not None:
            return _sequence_value(field.base, source.numbers(code, count))
        # Each item takes a byte at least: an absurd count ends here, not in memory.
        source.require(count)
        if field.base == "string":
            return [source.text() for _ in range(count)]
        return [self._decode(field.base, source) for _ in range(count)]

    def encode(self, message: object) -> bytes:
        """Encode a mapping, or any object with the fields as attributes (a live message too).

        A mapping may leave fields out, which are then zero or empty: a .msg file's default values
        are not known here, so the w of a quaternion must be given. Equal input gives equal
        bytes, padding included.

        :raises BagError: a field is missing, unknown, out of range or of the wrong length.
        """
        out = bytearray(_LITTLE_HEADER)
        self._encode(self._name, message, out, self.type_name)
        return bytes(out)

    def _encode(self, name: str, message: object, out: bytearray, where: str) -> None:
        fields = self.definition[name]
        if not fields:
            out.append(0)
        get = _getter(message, fields, where)
        for field in fields:
            self._encode_field(field, get(field.name), out, f"{where}.{field.name}")

    def _encode_field(self, field: Field, value: Any, out: bytearray, where: str) -> None:
        if field.size is None:
            self._encode_items(
                field, [self._default(field) if value is None else value], out, where
            )
            return
        if value is None:
            value = [self._default(field)] * (field.size if field.fixed else 0)
        if isinstance(value, str | Mapping) or not hasattr(value, "__len__"):
            raise BagError(f"{where} is {_brief(value)}; expected a sequence", reason="message")
        count = len(value)
        if (field.fixed and count != field.size) or (field.upto and count > (field.size or 0)):
            expected = f"{'at most ' * field.upto}{field.size}"
            raise BagError(f"{where} has {count} items; expected {expected}", reason="message")
        if not field.fixed:
            _put(out, "I", [count], where)
        if count:
            self._encode_items(field, value, out, where)

    def _encode_items(
        self, field: Field, values: Sequence[Any], out: bytearray, where: str
    ) -> None:
        code = _CODES.get(field.base)
        if field.base == "byte":
            values = [
                item[0] if isinstance(item, bytes) and len(item) == 1 else item for item in values
            ]
        if code is not None:
            _put(out, code, values, where)
        elif field.base == "string":
            for text in values:
                _put_text(out, text, field.chars, where)
        else:
            for item in values:
                self._encode(field.base, item, out, where)

    @staticmethod
    def _default(field: Field) -> Any:
        if field.base in _CODES:
            return 0
        return "" if field.base == "string" else {}


def _value_class(name: str, fields: Sequence[Field]) -> Any:
    try:
        return dataclasses.make_dataclass(name, [(f.name, Any) for f in fields], slots=True)
    except TypeError as error:
        raise BagError(
            f"fields of {name} cannot be attributes: {error}", reason="schema"
        ) from error


def _sequence_value(base: str, values: array.array[Any]) -> Any:
    """Give a primitive array the form it has in a live message."""
    if base == "bool":
        return [value != 0 for value in values]
    if base == "byte":
        return [bytes((value,)) for value in values]
    return values


class _Source:
    """A read position in one encoded message; nothing is read past its end."""

    def __init__(self, type_name: str, data: bytes, order: str) -> None:
        self._type_name = type_name
        self._data = data
        self._unpack = _UNPACK[order]
        self._swapped = order != _NATIVE
        self._end = len(data)
        self.position = len(_LITTLE_HEADER)

    def error(self, text: str) -> BagError:
        return BagError(f"{self._type_name}: {text}", reason="cdr")

    def require(self, count: int) -> None:
        """Refuse to go on unless ``count`` bytes are left."""
        left = self._end - self.position
        if count > left:
            raise self.error(f"needs {count} bytes at {self.position}, {max(left, 0)} are left")

    def _align(self, size: int) -> None:
        # CDR aligns to the value's own size, counted from the end of the 4-byte header.
        self.position += -(self.position - len(_LITTLE_HEADER)) % size

    def numbers(self, code: str, count: int) -> array.array[Any]:
        values: array.array[Any] = array.array(_ARRAY_CODES.get(code, code))
        if count:
            self._align(values.itemsize)
            begin = self.position
            self.require(count * values.itemsize)
            self.position += count * values.itemsize
            values.frombytes(self._data[begin : self.position])
            if self._swapped:
                values.byteswap()
        return values

    def number(self, code: str) -> Any:
        size = _SIZES[code]
        self._align(size)
        begin = self.position
        self.require(size)
        self.position = begin + size
        return self._unpack[code](self._data, begin)[0]

    def text(self) -> str:
        count = self.number("I")
        if count == 0:
            return ""
        self.require(count)
        raw = bytes(self._data[self.position : self.position + count])
        if raw[-1] != 0:
            raise self.error(f"the string at {self.position} does not end with a zero")
        self.position += count
        try:
            return raw[:-1].decode()
        except UnicodeDecodeError as error:
            raise self.error(f"the string at {self.position - count} is not UTF-8") from error


def _put(out: bytearray, code: str, values: Sequence[Any], where: str) -> None:
    size = _SIZES[code]
    out.extend(bytes(-(len(out) - len(_LITTLE_HEADER)) % size))
    try:
        out.extend(struct.pack(f"<{len(values)}{code}", *values))
    except (struct.error, OverflowError) as error:
        text = f"{where} is {_brief(values if len(values) > 1 else values[0])}: {error}"
        raise BagError(text, reason="message") from error


def _put_text(out: bytearray, text: object, limit: int, where: str) -> None:
    if not isinstance(text, str):
        raise BagError(f"{where} is {_brief(text)}; expected text", reason="message")
    if limit and len(text) > limit:
        raise BagError(f"{where} has {len(text)} characters; at most {limit}", reason="message")
    raw = text.encode()
    _put(out, "I", [len(raw) + 1], where)
    out.extend(raw)
    out.append(0)


def _getter(message: object, fields: Sequence[Field], where: str) -> Callable[[str], Any]:
    """Return a function from field name to value, None where a mapping leaves the field out."""
    names = [field.name for field in fields]
    if isinstance(message, Mapping):
        unknown = sorted(str(key) for key in message if key not in names)
        if unknown:
            raise BagError(
                f"{where} has no field {', '.join(unknown)}; fields: {', '.join(names)}",
                reason="message",
            )
        return message.get
    missing = [name for name in names if not hasattr(message, name)]
    if missing:
        raise BagError(
            f"{where} is {_brief(message)}, without {', '.join(missing)}", reason="message"
        )
    return lambda name: getattr(message, name)


def _brief(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
