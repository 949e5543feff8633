# SPDX-License-Identifier: Apache-2.0
"""New numbers in a YAML file that stays otherwise as its author wrote it, comments and all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from pkm_twin.errors import ParameterError, one_line

Path = tuple[str | int, ...]


def edit_yaml(text: str, values: Mapping[Path, Any], notes: Mapping[Path, str]) -> str:
    """A file's text with values set, and a comment above each that has a note.

    :param values: by path (keys, and places in lists) numbers or lists of them; a key that is not
        there is added to the deepest section that is.
    """
    for path, value in values.items():
        text = _set(text, path, value)
    lines = text.splitlines(keepends=True)
    above: dict[int, list[str]] = {}
    for path, note in notes.items():
        node = _find(_root(text), path)
        above.setdefault(_own_line(lines, node.start_mark.line), []).append(note)
    for number in sorted(above, reverse=True):
        line = lines[number]
        indent = line[: len(line) - len(line.lstrip())]
        lines[number:number] = [f"{indent}# {one_line(note, 2000)}\n" for note in above[number]]
    return "".join(lines)


def _own_line(lines: Sequence[str], number: int) -> int:
    """The line that a note may stand above: never inside a number's list."""
    while number and lines[number].lstrip().startswith(("[", "]", ",")):
        number -= 1
    return number


def _root(text: str) -> Any:
    return yaml.compose(text, Loader=yaml.SafeLoader)


def _child(node: Any, key: str | int) -> Any:
    """Value of a key or place, None where it is not there."""
    if isinstance(key, int):
        inside = isinstance(node, yaml.SequenceNode) and key < len(node.value)
        return node.value[key] if inside else None
    if isinstance(node, yaml.MappingNode):
        for name, value in node.value:
            if name.value == key:
                return value
    return None


def _find(node: Any, path: Path) -> Any:
    for key in path:
        node = _child(node, key)
        if node is None:
            raise ParameterError(".".join(map(str, path)), None, "a key of the file")
    return node


def _set(text: str, path: Path, value: Any) -> str:
    node = _root(text)
    for depth, key in enumerate(path):
        below = _child(node, key)
        if below is None:
            return _add(text, node, path[depth:], value)
        node = below
    begin, end = int(node.start_mark.index), int(node.end_mark.index)
    block = isinstance(node, yaml.CollectionNode) and not node.flow_style
    if block:
        # A list of lines, or an empty value: it ends where the next key begins.
        while end > begin and text[end - 1] in " \n":
            end -= 1
        return text[:begin].rstrip(" \n") + " " + flow(value) + text[end:]
    space = "" if begin and text[begin - 1] in " [{," else " "
    return text[:begin] + space + flow(value) + text[end:]


def _add(text: str, node: Any, rest: Path, value: Any) -> str:
    """A key that the mapping ``node`` does not have."""
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
    # Before the second key, which has a line of its own even in a list; a lone one makes room.
    marks = [name.start_mark for name, _ in node.value]
    if len(marks) > 1:
        at = marks[1].index - marks[1].column
    else:
        at = text.find("\n", node.value[0][1].end_mark.index - 1) + 1
        at = at or len(text)
    return "".join((text[:at], " " * int(marks[0].column), entry, "\n", text[at:]))


def flow(value: Any) -> str:
    """A number, a list or a mapping in one line; numbers with twelve digits."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {flow(item)}" for key, item in value.items()) + "}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "[" + ", ".join(flow(item) for item in value) + "]"
    text = f"{float(value):.12g}"
    # YAML 1.1 takes 1e-05 for a word.
    return text.replace("e", ".0e") if "e" in text and "." not in text else text
