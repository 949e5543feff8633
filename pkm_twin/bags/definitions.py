# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""ROS 2 message definitions: the fields of a type, from its text or from the message classes."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import re
from collections.abc import Mapping
from typing import Any, Final

from pkm_twin.errors import BagError, shorten_value

JOINT_STATE: Final = "sensor_msgs/msg/JointState"
TRAJECTORY: Final = "trajectory_msgs/msg/JointTrajectory"
WRENCH: Final = "geometry_msgs/msg/WrenchStamped"
TRANSFORM: Final = "geometry_msgs/msg/TransformStamped"
"""Types of messages that nodes and recordings share."""

SEPARATOR = "=" * 80
"""The line between the parts of a concatenated message definition."""

CODES = {
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
"""Struct code of a primitive; ``byte`` and ``char`` are both unsigned 8-bit in ROS 2."""

MAX_DEFINITION_CHARACTERS = 1024**2
"""Longest definition text; the longest of the common interfaces has some 20,000 characters."""
MAX_FIELDS = 5_000
"""Largest number of fields of a message and of all messages that it contains."""
MAX_NESTING = 50
"""Deepest nesting of messages in a message."""
MAX_BOUND = 2**32 - 1
"""Largest array size and bound: lengths are 32-bit numbers in CDR."""

_FIELD_PATTERN = re.compile(
    r"(?P<base>[A-Za-z][\w/]*)(?:<=(?P<chars>\d+))?"
    r"(?P<array>\[(?:(?P<upto><=)?(?P<size>\d+))?\])?\s+(?P<name>[A-Za-z]\w*)\s*(?P<rest>.*)",
    re.ASCII,
)
_TYPE_PATTERN = re.compile(r"(?P<base>[A-Za-z][\w/]*)(?:<(?P<chars>\d+)>)?(?:\[(?P<size>\d+)\])?")


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
    def has_fixed_length(self) -> bool:
        """True if the field is an array of fixed length, which is encoded without its length."""
        return bool(self.size) and not self.upto


Definition = dict[str, tuple[Field, ...]]
"""Fields by ``package/Type``, of the message and of all types that it contains."""


def message_class(type_name: str) -> Any:
    """Return the ROS message class of ``package/msg/Type``.

    :raises BagError: the name is malformed, or its package is not installed here.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]*/msg/[A-Z][A-Za-z0-9]*", type_name):
        text = f"{type_name!r} is not a type name; expected package/msg/Type"
        raise BagError(text, reason="type")
    package, _, name = type_name.split("/")
    # A bag may name any package: import it only if it is a package of messages.
    found = importlib.util.find_spec(package)
    places = (found and found.submodule_search_locations) or ()
    if not any(os.path.isdir(os.path.join(place, "msg")) for place in places):
        text = f"message type {type_name} is not installed: no message package {package!r}"
        raise BagError(text, reason="type")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        text = f"message type {type_name} is not installed: {error}"
        raise BagError(text, reason="type") from error


def message_definition(type_name: str) -> str:
    """Return the ``ros2msg`` text of a type: its fields, then those of every type that it contains.

    It is written from the message classes, because a pip installation of ROS 2 has no .msg files.
    These classes do not list constants and default values, so the text has none.
    """
    sections: dict[str, str] = {}
    waiting = [_short_name(type_name)]
    while waiting:
        name = waiting.pop(0)
        if name in sections:
            continue
        package, short = name.split("/")
        cls = message_class(f"{package}/msg/{short}")
        lines = []
        # Message classes print types such as ``sequence<double, 3>``.
        for field, spec in cls.get_fields_and_field_types().items():
            sequence = re.fullmatch(r"sequence<(?P<item>.+?)(?:,\s*(?P<bound>\d+))?>", spec)
            match = _TYPE_PATTERN.fullmatch(sequence["item"] if sequence else spec)
            if match is None:
                raise BagError(f"field {field} has the unknown type {spec!r}", reason="type")
            base = {"double": "float64", "float": "float32", "boolean": "bool", "octet": "byte"}.get(
                match["base"], match["base"]
            )
            chars = f"<={match['chars']}" if match["chars"] else ""
            size = f"[{match['size']}]" if match["size"] else ""
            if sequence:
                size = f"[<={sequence['bound']}]" if sequence["bound"] else "[]"
            lines.append(f"{base}{chars}{size} {field}")
            waiting += [base] if "/" in base else []
        sections[name] = "\n".join(lines)
    (main, *others) = sections.items()
    parts = [main[1], *(f"MSG: {name}\n{text}" for name, text in others)]
    return f"\n{SEPARATOR}\n".join(parts) + "\n"


def _short_name(type_name: str) -> str:
    parts = type_name.split("/")
    return f"{parts[0]}/{parts[-1]}"


def _check_type_name(type_name: str) -> str:
    # package/Type, or package/msg/Type.
    if not re.fullmatch(r"[A-Za-z]\w*(?:/\w+)*/[A-Za-z]\w*", type_name, re.ASCII):
        text = f"{brief(type_name)} is not a type name; expected package/msg/Type"
        raise BagError(text, reason="schema")
    return _short_name(type_name)


def parse_definition(type_name: str, text: str) -> Definition:
    """Parse a concatenated ``ros2msg`` definition; the first entry is the message itself.

    :raises BagError: a line is not a field, a held type has no definition or contains itself, or
        there is more than MAX_DEFINITION_CHARACTERS, MAX_FIELDS, MAX_NESTING or MAX_BOUND of it.
    """
    if len(text) > MAX_DEFINITION_CHARACTERS:
        error = f"the definition of {type_name} has {len(text)} characters"
        raise BagError(f"{error}; at most {MAX_DEFINITION_CHARACTERS}", reason="schema")
    own = _check_type_name(type_name)
    # Some writers leave out these types, which are in every ROS 2 system.
    texts = {
        "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
        "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
    }
    for index, part in enumerate(re.split(r"^={3,}[ \t]*$", text, flags=re.MULTILINE)):
        name = own
        fields = part
        if index:
            heading, _, fields = part.strip().partition("\n")
            if not heading.startswith("MSG:"):
                error = f"definition of {type_name}: part {index} starts with {brief(heading)}"
                raise BagError(f"{error}, not 'MSG:'", reason="schema")
            name = _check_type_name(heading[4:].strip())
        texts[name] = fields
    definition: Definition = {}
    _add_types(own, texts, definition, ())
    return {own: definition.pop(own), **definition}


def _add_types(name: str, texts: Mapping[str, str], definition: Definition, holders: tuple[str, ...]) -> None:
    """Add ``name`` and the types that it contains to ``definition``; ``holders`` are the types around it."""
    if name in holders:
        raise BagError(f"message type {name} contains itself", reason="schema")
    if name in definition:
        return
    if name not in texts:
        raise BagError(f"no definition of {name}, which {holders[-1]} contains", reason="schema")
    if len(holders) >= MAX_NESTING:
        text = f"{holders[0]} holds types {len(holders)} deep; at most {MAX_NESTING - 1}"
        raise BagError(text, reason="schema")
    fields = []
    for line in texts[name].splitlines():
        # Match the line before cutting comments, because a string constant may contain a '#'.
        match = _FIELD_PATTERN.fullmatch(line.strip())
        if match is None and line.split("#")[0].strip():
            raise BagError(f"definition of {name}: {brief(line)} is not a field", reason="schema")
        if match is None or match["rest"].startswith("="):
            continue
        base = match["base"]
        if base == "wstring":
            raise BagError("wide strings (wstring) are not supported", reason="schema")
        if "/" in base:
            base = _short_name(base)
        elif base not in CODES and base != "string":
            # A bare Header is std_msgs/Header by the rules of .msg files.
            local = f"{name.split('/', 1)[0]}/{base}"
            base = "std_msgs/Header" if base == "Header" and local not in texts else local
        where = f"definition of {name}: field {match['name']}"
        size = None if match["array"] is None else _read_bound(match["size"], where)
        chars = _read_bound(match["chars"], where)
        fields.append(Field(match["name"], base, size, bool(match["upto"]), chars))
    if len(fields) + sum(map(len, definition.values())) > MAX_FIELDS:
        text = f"{(*holders, name)[0]} has more than {MAX_FIELDS} fields with all that it holds"
        raise BagError(text, reason="schema")
    for field in fields:
        if "/" in field.base:
            _add_types(field.base, texts, definition, (*holders, name))
    definition[name] = tuple(fields)


def _read_bound(digits: str | None, where: str) -> int:
    # Check the length first: Python raises an error for thousands of digits.
    if digits and (len(digits) > 20 or int(digits) > MAX_BOUND):
        text = f"{where} has the bound {brief(digits)}; at most {MAX_BOUND}"
        raise BagError(text, reason="schema")
    return int(digits or 0)


def live_type_name(message: object) -> str | None:
    """Return ``package/msg/Type`` of a live ROS message; None for any other object."""
    cls = type(message)
    if not hasattr(cls, "get_fields_and_field_types"):
        return None
    return f"{cls.__module__.split('.')[0]}/msg/{cls.__name__}"


def brief(value: object) -> str:
    """Shorten a value of a file for an error."""
    return shorten_value(value, 60)
