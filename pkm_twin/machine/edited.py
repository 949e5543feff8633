# SPDX-License-Identifier: Apache-2.0
"""A robot's file with some numbers changed in place: its comments and its layout stay.

May import: yaml, numpy, this package, the standard library.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import yaml

from pkm_twin.errors import ParameterError
from pkm_twin.machine.catalogue import TREES, robot_path
from pkm_twin.machine.entries import given, keys_of
from pkm_twin.machine.machine_yaml import describe_machine_yaml
from pkm_twin.machine.robot import Robot

DIGITS: Final = 10
"""Significant digits of a number that is written: far below every deviation."""


@dataclass(frozen=True)
class Fitted:
    """A new number of a file, its standard deviation in the same unit, and where it is from."""

    value: float
    deviation: float
    unit: str
    source: str

    @property
    def comment(self) -> str:
        """What stands behind the number."""
        unit = f" {self.unit}" if self.unit else ""
        return f"+- {self.deviation:.2g}{unit} (standard deviation), {self.source}"


def edited_yaml(robot: Robot, source: str, values: Mapping[str, Fitted]) -> str:
    """The text of a robot's file with other numbers, each with its comment.

    Where the file writes a number once for several limbs, or is no YAML, the text is a new one with
    every body, joint and rod written out.

    :param source: the name or path that the robot was loaded by.
    :param values: by dotted path, of :func:`pkm_twin.machine.entries.entries`; of ``joint_map``
        also such as the file does not have yet.
    :raises ParameterError: a path that no such file has.
    """
    path = robot_path(source)
    text = "" if path.suffix in TREES else path.read_text(encoding="utf-8")
    plain = {name: fit for name, fit in values.items() if not name.startswith("joint_map.")}
    if not text or any(_place(text, name) is None for name in plain):
        sections = given(robot.parameter_sections())
        text = describe_machine_yaml({"mechanism": robot.mechanism, **_filled(sections)})
    text = _put(text, plain)
    mapped = {name: fit for name, fit in values.items() if name not in plain}
    return _mapped(text, robot, mapped) if mapped else text


def _filled(sections: Mapping[str, Any]) -> dict[str, Any]:
    """Without sections that say nothing."""
    return {
        key: value
        for key, value in sections.items()
        if not (isinstance(value, Mapping) and not value)
    }


def _place(text: str, path: str) -> yaml.ScalarNode | None:
    """The node of one number."""
    node: Any = yaml.compose(text, Loader=yaml.SafeLoader)
    for key in keys_of(path):
        if isinstance(node, yaml.MappingNode):
            node = next((value for name, value in node.value if name.value == key), None)
        elif isinstance(node, yaml.SequenceNode) and isinstance(key, int):
            node = node.value[key] if key < len(node.value) else None
        else:
            return None
    return node if isinstance(node, yaml.ScalarNode) else None


def _put(text: str, values: Mapping[str, Fitted]) -> str:
    """Numbers replaced where they stand, comments behind their lines."""
    changes: list[tuple[int, int, str]] = []
    notes: dict[int, list[str]] = {}
    for path, fit in values.items():
        node = _place(text, path)
        if node is None:
            raise ParameterError(path, fit.value, "a number that the robot's file gives")
        changes.append((node.start_mark.index, node.end_mark.index, number_text(fit.value)))
        notes.setdefault(node.start_mark.line, []).append(f"{path}: {fit.comment}")
    for begin, end, new in sorted(changes, reverse=True):
        text = text[:begin] + new + text[end:]
    lines = text.split("\n")
    for line in sorted(notes, reverse=True):
        if len(notes[line]) == 1:
            mark = "; " if "#" in lines[line] else "  # "
            lines[line] += mark + notes[line][0].partition(": ")[2]
        else:
            indent = lines[line][: len(lines[line]) - len(lines[line].lstrip())]
            lines[line:line] = [f"{indent}# {note}" for note in notes[line]]
    return "\n".join(lines)


def _mapped(text: str, robot: Robot, values: Mapping[str, Fitted]) -> str:
    """The same with the section ``joint_map`` written anew."""
    root: Any = yaml.compose(text, Loader=yaml.SafeLoader)
    for name, value in root.value:
        if name.value == "joint_map":
            text = text[: name.start_mark.index] + text[value.end_mark.index :].lstrip("\n")
    lines = [text.rstrip("\n"), "joint_map:"]
    for joint in robot.joint_names:
        entry = robot.joint_map.get(joint)
        fields = {} if entry is None else {
            "name": entry.name, "sign": entry.sign, "offset": entry.offset, "ratio": entry.ratio,
        }  # fmt: skip
        fit = values.get(f"joint_map.{joint}.offset")
        if fit is not None:
            fields["offset"] = fit.value
        if not fields:
            continue
        inner = ", ".join(
            f"{key}: {value if isinstance(value, str) else number_text(value)}"
            for key, value in fields.items()
            if value is not None
        )
        lines.append(f"  {joint}: {{{inner}}}" + (f"  # offset {fit.comment}" if fit else ""))
    return "\n".join(lines) + "\n"


def number_text(value: float) -> str:
    """A number as YAML 1.1 and 1.2 read it alike."""
    text = f"{value:.{DIGITS}g}"
    if "e" in text and "." not in text:
        text = text.replace("e", ".0e")
    return text if math.isfinite(value) else "null"


def write_edited(path: Path, head: Sequence[str], text: str) -> None:
    """Write a file with lines of comment at its head, whole or not at all.

    :raises ParameterError: not writable.
    """
    part = path.with_name(path.name + ".part")
    try:
        part.write_text("".join(f"# {line}\n" for line in head) + text, encoding="utf-8")
        part.replace(path)
    except OSError as error:
        raise ParameterError(str(path), error.strerror, "a file that can be written") from None
