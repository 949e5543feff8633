# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write a robot's file with some of its numbers changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from pkm_twin.errors import ParameterError, PkmTwinError, one_line
from pkm_twin.files import replace_file
from pkm_twin.machine.formulas import PARAMETERS
from pkm_twin.machine.machine_yaml import describe_machine_yaml, edit_yaml
from pkm_twin.machine.places import drop_missing, has_entry, split_path
from pkm_twin.machine.strict_yaml import parse_yaml
from pkm_twin.mechanisms.catalogue import TREE_SUFFIXES, load, robot_of_data, robot_path
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.robot_urdf import robot_description
from pkm_twin.robot.urdf_read import read_urdf


@dataclass(frozen=True)
class Chosen:
    """A new number of a file, and the comment above it."""

    value: float
    comment: str


@dataclass(frozen=True)
class Fitted:
    """A new number of a file, its standard deviation in the same unit, and its source."""

    value: float
    deviation: float
    unit: str
    source: str

    @property
    def comment(self) -> str:
        """The comment above the number."""
        unit = f" {self.unit}" if self.unit else ""
        return f"+- {self.deviation:.2g}{unit} (standard deviation), {self.source}"


def edit_robot_text(robot: Robot, source: str, values: Mapping[str, Fitted | Chosen]) -> str:
    """Write the text of a robot's file with other numbers, each with its comment.

    Where the file writes a number once for several limbs, or is no YAML, the text is a new one with
    every body, joint and rod written out.

    :param source: the name or path that the robot was loaded by.
    :param values: by dotted path, of :meth:`Robot.file_numbers`; of ``joint_map``
        also such as the file does not have yet.
    :raises ParameterError: a path that no such file can have.
    """
    path = robot_path(source)
    text = "" if path.suffix in TREE_SUFFIXES else path.read_text(encoding="utf-8")
    data: Any = yaml.safe_load(text)
    values = robot.resolve_paths(values)
    plain = [name for name in values if not name.startswith("joint_map.")]
    if not all(has_entry(data, name) for name in plain):
        moved = {name: values[name].value for name in plain if name.startswith(f"{PARAMETERS}.")}
        values = {name: fit for name, fit in values.items() if name not in moved}
        sections = drop_missing((robot.numbered(moved) if moved else robot).parameter_sections())
        told = {k: v for k, v in sections.items() if v or not isinstance(v, Mapping)}
        text = describe_machine_yaml({"mechanism": robot.mechanism, **told})
    keys = {name: tuple(split_path(name)) for name in values}
    return edit_yaml(
        text,
        {keys[name]: fit.value for name, fit in values.items()},
        {keys[name]: f"{name}: {fit.comment}" for name, fit in values.items()},
    )


def write_edited(path: Path, head: Sequence[str], text: str, before: Robot) -> list[str]:
    """Write a robot's file with a head comment, atomically; return the lost expressions.

    :param before: the robot of the file that was edited.
    :returns: lines that describe the expressions lost by the edit; the comment has them, too.
    :raises PkmTwinError: the file is not writable, or its numbers are not a valid robot.
    """
    try:
        after = robot_of_data(parse_yaml(text, str(path)), path.stem)
    except ValueError as error:
        raise PkmTwinError(f"the values are not a valid robot, so {path} is not written: {error}") from None
    # Names are untrusted: they may contain line breaks.
    lost = before.book.describe_lost(after.book)
    whole = "".join(f"# {one_line(line, 2000)}\n" for line in (*head, *lost)) + text
    try:
        replace_file(path, whole.encode())
    except OSError as error:
        raise PkmTwinError(f"{path} cannot be written: {error.strerror}") from None
    return lost


def load_with_text(name: str, *, per_copy: bool = False, **part: Any) -> tuple[str, Robot]:
    """Load a robot and the text of its file; a URDF, or with ``per_copy``, as a machine's YAML.

    :param part: options of :func:`load` that cut the robot out of its file.
    :raises ParameterError: the file is refused; or it is to be written out, and would lose what it
        says of elasticity.
    """
    robot = load(name, **part)
    elastic = False
    with suppress(ParameterError):
        elastic = bool(robot.structure())
    if per_copy and elastic and not robot.elastic_entries():
        raise ParameterError(
            "--per-copy",
            robot.name,
            f"a robot whose elastic members can be written out; a {robot.mechanism}'s cannot: take "
            "a file without them, or fit without --per-copy",
        )
    path = robot_path(name)
    if path.suffix in TREE_SUFFIXES:
        data = read_urdf(path, **part)
    elif per_copy:
        data = robot_description(robot)
    else:
        return path.read_text(encoding="utf-8"), robot
    return describe_machine_yaml(data), robot_of_data(data, path.stem)
