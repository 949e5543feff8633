# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Find and replace the numbers of a file by dotted paths."""

from __future__ import annotations

import copy
import dataclasses
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from pkm_twin.codegen.expressions import Expression, plain
from pkm_twin.errors import ParameterError, unknown_number_error
from pkm_twin.machine import schema
from pkm_twin.settings import map_parameters

T = TypeVar("T")
Key = str | int
Keys = tuple[Key, ...]
"""Location of a number in a file: keys of mappings and indices of lists."""


def split_path(path: str) -> list[Key]:
    """Split a dotted path into keys and indices: ``joints.arm.at[2]`` has four.

    :raises ParameterError: the path is not a text or has no key.
    """
    text = path if isinstance(path, str) else ""
    keys = [name or int(place) for name, place in re.findall(r"([^.\[\]]+)|\[(\d+)\]", text)]
    if not keys:
        raise ParameterError("path", path, "a dotted path of a number of the robot's file")
    return keys


def join_path(keys: Iterable[Key]) -> str:
    """Join keys and indices to a dotted path."""
    parts = (f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys)
    return "".join(parts).removeprefix(".")


def full_keys(path: str) -> list[Key]:
    """Split a path; a principal moment ``inertia[0]`` becomes ``inertia[0][0]``."""
    keys = split_path(path)
    moment = keys[-2:-1] == ["inertia"] and isinstance(keys[-1], int)
    return [*keys, keys[-1]] if moment else keys


def list_file_numbers(sections: Mapping[str, Any], units: Mapping[str, Any]) -> dict[str, tuple[float, str]]:
    """Return every number in sections of a file, by dotted path, with its unit."""
    data = {k: v for k, v in drop_missing(sections).items() if k not in ("uncertainty", "tolerances")}
    return dict(_iterate_numbers(data, units, ""))


def _iterate_numbers(data: Any, units: Any, path: str) -> Iterator[tuple[str, tuple[float, str]]]:
    if isinstance(data, Mapping):
        for key, value in data.items():
            unit = units.get(key, "") if isinstance(units, Mapping) else ""
            yield from _iterate_numbers(value, unit, f"{path}.{key}" if path else str(key))
    elif isinstance(data, list | tuple):
        for place, value in enumerate(data):
            yield from _iterate_numbers(value, units, f"{path}[{place}]")
    elif isinstance(data, int | float) and not isinstance(data, bool):
        yield path, (float(data), units if isinstance(units, str) else "")


def drop_missing(data: Any) -> Any:
    """Drop entries without a value, which a file leaves out and which are derived."""
    if not isinstance(data, Mapping):
        return data
    return {key: drop_missing(value) for key, value in data.items() if value is not None}


def replace_numbers(section: T, changes: Mapping[tuple[Key, ...], Any], path: str = "") -> T:
    """Return a section with other numbers or expressions at some locations, without any check.

    :param section: a dataclass, mapping, sequence or array.
    :param changes: new values by keys and indices, as in a file.
    :param path: of the section, for errors.
    :raises ParameterError: there is no number at a location.
    """
    below: dict[Key, dict[tuple[Key, ...], Any]] = {}
    for (key, *rest), value in changes.items():
        below.setdefault(key, {})[tuple(rest)] = value
    held: Any = section
    names: dict[Any, Any] = {}
    whole = dataclasses.is_dataclass(section)
    if dataclasses.is_dataclass(section):
        names = {name: field for name, (field, _) in map_parameters(type(section)).items()}
        held = {f.name: getattr(section, f.name) for f in dataclasses.fields(section)}
    result: Any = list(held) if isinstance(held, tuple) else copy.copy(held)
    result = held.astype(object) if isinstance(held, np.ndarray) else result
    for key, deeper in below.items():
        here = f"{path}[{key}]" if isinstance(key, int) else f"{path}.{key}" if path else key
        name = names.get(key, key)
        try:
            old = held[name]
        except (KeyError, IndexError, TypeError):
            old = None
        leaf = () in deeper
        single = np.isscalar(old) or isinstance(old, Expression)
        if isinstance(old, bool | str | None) or leaf != single:
            raise unknown_number_error(here, [])
        result[name] = deeper[()] if leaf else replace_numbers(old, deeper, here)
    if whole:
        made = object.__new__(type(section))
        vars(made).update(result)
        return made
    if isinstance(held, np.ndarray):
        result = plain(result)
        result.setflags(write=False)
    return result  # type: ignore[no-any-return]


def check_number(section: Any, keys: Sequence[Key], path: str) -> None:
    """Check a number of a section like one of a file, including its section's own checks.

    :raises ParameterError: the number is invalid; the error names its path.
    """
    inner, left = section, list(keys)
    while left:
        if dataclasses.is_dataclass(inner):
            field, row = map_parameters(type(inner))[str(left[0])]
            value = getattr(inner, field)
            if not dataclasses.is_dataclass(value) and not isinstance(value, Mapping):
                row.check(path, schema.plain(value))
                verify = getattr(inner, "verify", None)
                if verify is not None:
                    verify(path)
                return
            inner = value
        else:
            inner = inner[left[0]]
        left.pop(0)


def merge_data(data: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Merge changes into plain data, recursively for mappings."""
    result = dict(data)
    for key, value in changes.items():
        old = result.get(key)
        both = isinstance(value, Mapping) and isinstance(old, Mapping)
        result[key] = merge_data(dict(old or {}), value) if both else schema.plain(value)
    return result


def find_number(data: Any, keys: Iterable[Key], path: str) -> float:
    """Return a number of plain data.

    :raises ParameterError: there is no number at this location.
    """
    keys, there = list(keys), data
    for i, key in enumerate(keys):
        try:
            there = there[key]
        except (KeyError, IndexError, TypeError):
            whole = split_path(path)
            before = whole[: len(whole) - len(keys) + i]
            names: list[Key] = list(there) if isinstance(there, Mapping) else []
            names += range(len(there)) if isinstance(there, list | tuple) else ()
            near = [join_path([*before, name, *keys[i + 1 :]]) for name in names]
            raise unknown_number_error(path, near) from None
    if isinstance(there, bool) or not isinstance(there, int | float):
        raise unknown_number_error(path, [])
    return float(there)


def has_entry(data: Any, path: str) -> bool:
    """Return whether plain data has a value at a path."""
    for key in split_path(path):
        if isinstance(data, Mapping):
            data = data.get(key)
        elif isinstance(data, list) and isinstance(key, int) and key < len(data):
            data = data[key]
        else:
            return False
    return data is not None
