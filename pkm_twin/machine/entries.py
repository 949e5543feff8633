# SPDX-License-Identifier: Apache-2.0
"""The numbers of a robot's file by dotted path, and the same robot with some of them changed.

May import: numpy, this package, the standard library.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator, Mapping
from typing import Any, Final, TypeVar

from pkm_twin.errors import ParameterError
from pkm_twin.machine.graph import Graph
from pkm_twin.machine.robot import Robot

R = TypeVar("R", bound=Robot)
_PART: Final = re.compile(r"([^.\[\]]+)|\[(\d+)\]")
Key = str | int


def keys_of(path: str) -> list[Key]:
    """The keys and places of a dotted path: ``joints.arm.at[2]`` has four."""
    return [name or int(place) for name, place in _PART.findall(path)]


def entries(robot: Robot) -> dict[str, tuple[float, str]]:
    """Every number that the robot's file gives, by dotted path, with its unit."""
    data = {k: v for k, v in given(robot.parameter_sections()).items() if k != "uncertainty"}
    return dict(_walk(data, robot.parameter_units(), ""))


def _walk(data: Any, units: Any, path: str) -> Iterator[tuple[str, tuple[float, str]]]:
    if isinstance(data, Mapping):
        for key, value in data.items():
            unit = units.get(key, "") if isinstance(units, Mapping) else ""
            yield from _walk(value, unit, f"{path}.{key}" if path else str(key))
    elif isinstance(data, list | tuple):
        for place, value in enumerate(data):
            yield from _walk(value, units, f"{path}[{place}]")
    elif isinstance(data, int | float) and not isinstance(data, bool):
        yield path, (float(data), units if isinstance(units, str) else "")


def given(data: Any) -> Any:
    """Without what a file would leave out: that is derived."""
    if not isinstance(data, Mapping):
        return data
    return {key: given(value) for key, value in data.items() if value is not None}


def data_of(robot: Robot, values: Mapping[str, float] | None = None) -> dict[str, Any]:
    """What the robot's file gives, as plain data, with other numbers by dotted path.

    :raises ParameterError: a path that there is not.
    """
    data: dict[str, Any] = copy.deepcopy(given(robot.parameter_sections()))
    for path, value in (values or {}).items():
        put(data, path, value)
    return data


def with_entries(robot: R, values: Mapping[str, float]) -> R:
    """The robot of the same file with other numbers.

    :raises ParameterError: a path that there is not, or a value that the file may not have.
    """
    return type(robot).from_data(data_of(robot, values), robot.name)


def put(data: Any, path: str, value: float) -> None:
    """Change one number of plain data in place.

    :raises ParameterError: a path that there is not.
    """
    number_at(data, path)
    *way, last = keys_of(path)
    for key in way:
        data = data[key]
    data[last] = value


def number_at(data: Any, path: str) -> Any:
    """The value of plain data at a dotted path.

    :raises ParameterError: a path that there is not.
    """
    try:
        for key in keys_of(path):
            data = data[key]
    except (KeyError, IndexError, TypeError):
        raise ParameterError(path, None, "a number that the robot's file gives") from None
    return data


def has_entry(data: Any, path: str) -> bool:
    """Whether plain data has a value of that path."""
    for key in keys_of(path):
        if isinstance(data, Mapping):
            data = data.get(key)
        elif isinstance(data, list) and isinstance(key, int) and key < len(data):
            data = data[key]
        else:
            return False
    return data is not None


def changed_graph(robot: Robot, path: str, value: float) -> Graph:
    """The graph with one number changed; nothing is compiled.

    :raises ParameterError: no file has it.
    """
    return type(robot).graph_of(data_of(robot, {path: value}))
