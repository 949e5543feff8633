# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""YAML files that people read and edit: a whole description, and new numbers in a file's text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import yaml

from pkm_twin.errors import ParameterError, one_line

Path = tuple[str | int, ...]
MAX_LINE_WIDTH: Final = 100
"""Longest entry on one line, characters; a longer one has one line per key."""
HEAD: Final = """\
# A machine as bodies, joints and rods at its home pose: every vector in base axes at home.
# Units: m, kg, kg m2, rad, s, N, N m. The ground is called base.
"""
NOTES: Final = {
    "gravity": "m/s2",
    "platform": "the body that carries the tool",
    "origin": "m, its reference point at home",
    "pose": "of x y z roll pitch yaw (relative to home): as many as the mobility",
    "payload": "kg; com from the reference point, m; inertia about it, kg m2",
}
"""Comments at the end of a line, by key."""
SECTIONS: Final = {
    "bodies": """\
# mass: kg. com: centre of mass at home, m. inertia: about it, kg m2, three moments or 3x3.
""",
    "joints": """\
# type: revolute, prismatic, cylindrical (axis), universal (axes: first fixed to the inner body,
# second to the outer), spherical, fixed, translation. between: [inner body, outer body], positive
# motion is that of the outer one. at: a point of the joint, m. home: its value at home, rad or m.
# limits: position, velocity, effort. friction: viscous (effort per rate), coulomb,
# offset (effort).
# rotor_inertia: the drive's at the joint, kg m2 or kg.
# The actuated joints' order is that of the robot's joint_names.
""",
    "rods": """\
# Thin even bars with a ball joint at each end. between: bodies. ends: their points, m. mass: kg.
""",
    "limbs": """\
# Copied and turned about base z by each azimuth, rad; names get _1, _2, ...
""",
}
"""Comments above a section, by key."""


def describe_machine_yaml(data: Mapping[str, Any], parameters: Sequence[str] = ()) -> str:
    """Write the description as YAML with units and meanings in comments.

    Reading it gives the same numbers to the last bit.

    :param data: a description, with limbs or with their copies, in any order of keys.
    :param parameters: descriptions of the parameters for which the numbers were computed.
    """
    order = ("mechanism", *NOTES, *SECTIONS)
    keys = sorted(data, key=lambda key: order.index(key) if key in order else len(order))
    lines = [HEAD]
    lines += ["# Written out for these parameters:\n"] if parameters else []
    lines += [f"#   {one}\n" for one in parameters]
    for key in keys:
        if key in SECTIONS and data[key]:
            lines.append(f"\n{SECTIONS[key]}{key}:\n")
            listed = not isinstance(data[key], Mapping)
            for item in data[key] if listed else [data[key]]:
                entries = [_write_entry(name, value, "    " if listed else "  ") for name, value in item.items()]
                lines += ["  - ", "".join(entries)[4:]] if listed else entries
        else:
            line, note = f"{key}: {_write_flow(data[key])}", NOTES.get(key, "")
            if len(line) + len(note) > MAX_LINE_WIDTH and note:
                line, note = f"# {note}\n{line}", ""
            lines.append(f"{line}  # {note}\n" if note else f"{line}\n")
    if "pose" not in data:
        at = 1 + sum(key in ("mechanism", "gravity", "platform", "origin") for key in keys)
        lines.insert(at, f"# pose: [x, y, z]  # for example; {NOTES['pose']}\n")
    return "".join(lines)


def _write_entry(name: object, value: Any, indent: str) -> str:
    """Write an entry in one line if it fits, else one line per key."""
    line = f"{indent}{_write_flow(name)}: {_write_flow(value)}"
    if not isinstance(value, Mapping) or len(line) <= MAX_LINE_WIDTH:
        return line + "\n"
    inner = "".join(_write_entry(key, item, indent + "  ") for key, item in value.items())
    return f"{indent}{_write_flow(name)}:\n{inner}"


def _write_flow(value: Any) -> str:
    # In a list, because names between brackets may need quotes.
    text = yaml.safe_dump([_to_plain(value)], default_flow_style=True, sort_keys=False, width=math.inf)
    return text.strip()[1:-1]


def _to_plain(value: Any) -> Any:
    """Convert to plain YAML data: no point in whole numbers, no minus before zero, no shared objects."""
    if isinstance(value, Mapping):
        return {str(key): _to_plain(item) for key, item in value.items()}
    if isinstance(value, str | bool) or value is None:
        return value
    if isinstance(value, int | float):
        whole = math.isfinite(value) and float(value).is_integer() and abs(value) < 1e15
        return int(value) if whole else float(value)
    return [_to_plain(item) for item in value]


def edit_yaml(text: str, values: Mapping[Path, Any], notes: Mapping[Path, str]) -> str:
    """Set values in a file's text, and write a comment above each that has a note.

    :param values: numbers or lists of them by path (keys and list indices); a missing key is added to
        the deepest section that exists.
    """
    for path, value in values.items():
        text = _set_value(text, path, value)
    lines = text.splitlines(keepends=True)
    above: dict[int, list[str]] = {}
    for path, note in notes.items():
        node = _parse_root(text)
        for key in path:
            node = _find_child(node, key)
            if node is None:
                raise ParameterError(".".join(map(str, path)), None, "a key of the file")
        number = node.start_mark.line
        # A comment cannot stand inside the list that a number belongs to.
        while number and lines[number].lstrip().startswith(("[", "]", ",")):
            number -= 1
        above.setdefault(number, []).append(note)
    for number in sorted(above, reverse=True):
        line = lines[number]
        indent = line[: len(line) - len(line.lstrip())]
        lines[number:number] = [f"{indent}# {one_line(note, 2000)}\n" for note in above[number]]
    return "".join(lines)


def _parse_root(text: str) -> Any:
    return yaml.compose(text, Loader=yaml.SafeLoader)


def _find_child(node: Any, key: str | int) -> Any:
    """Return the value of a key or index; None if there is none."""
    if isinstance(key, int):
        inside = isinstance(node, yaml.SequenceNode) and key < len(node.value)
        return node.value[key] if inside else None
    if isinstance(node, yaml.MappingNode):
        for name, value in node.value:
            if name.value == key:
                return value
    return None


def _set_value(text: str, path: Path, value: Any) -> str:
    node = _parse_root(text)
    for depth, key in enumerate(path):
        below = _find_child(node, key)
        if below is None:
            return _add_key(text, node, path[depth:], value)
        node = below
    begin, end = int(node.start_mark.index), int(node.end_mark.index)
    block = isinstance(node, yaml.CollectionNode) and not node.flow_style
    if block:
        # A list over several lines, or an empty value, ends where the next key begins.
        while end > begin and text[end - 1] in " \n":
            end -= 1
        return text[:begin].rstrip(" \n") + " " + flow(value) + text[end:]
    space = "" if begin and text[begin - 1] in " [{," else " "
    return text[:begin] + space + flow(value) + text[end:]


def _add_key(text: str, node: Any, rest: Path, value: Any) -> str:
    """Add a key that the mapping ``node`` does not have."""
    for key in reversed(rest[1:]):
        value = {str(key): value}
    entry = f"{rest[0]}: {flow(value)}"
    if not isinstance(node, yaml.MappingNode):
        raise ParameterError(str(rest[0]), None, "a section of the file")
    if node.flow_style:
        end = int(node.end_mark.index) - 1
        before = text[:end].rstrip()
        comma = "" if before.endswith(("{", ",")) else ","
        return f"{before}{comma}{' ' if comma or before.endswith(',') else ''}{entry}{text[end:]}"
    first = node.value[0][0]
    if first.start_mark.column == 0:
        return text + ("" if text.endswith("\n") else "\n") + entry + "\n"
    # Insert before the second key, which has its own line even in a list, or after a single key.
    marks = [name.start_mark for name, _ in node.value]
    if len(marks) > 1:
        at = marks[1].index - marks[1].column
    else:
        at = text.find("\n", node.value[0][1].end_mark.index - 1) + 1
        at = at or len(text)
    return "".join((text[:at], " " * int(marks[0].column), entry, "\n", text[at:]))


def flow(value: Any) -> str:
    """Write a number, a list or a mapping in one line; numbers with twelve digits."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {flow(item)}" for key, item in value.items()) + "}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "[" + ", ".join(flow(item) for item in value) + "]"
    text = f"{float(value):.12g}"
    # YAML 1.1 takes 1e-05 for a word.
    return text.replace("e", ".0e") if "e" in text and "." not in text else text
