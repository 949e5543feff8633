# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Check parameter files against schemas; every error names the field and its bound.

A schema is a frozen dataclass whose fields are made by the functions below, each with its check.
In units ``{joint}``, ``{effort}`` and ``{rotor}`` stand for those of the actuated joints.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass
from functools import reduce
from typing import Any, Final, TypeVar

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.operations import absolute, maximum, minimum
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.machine.formulas import MAX_SIZE, ExpressionText
from pkm_twin.settings import Setting, map_parameters

MAX_INERTIA: Final = 1e12
"""Largest entry of an inertia matrix, kg m2."""
_INERTIA_TOLERANCE: Final = 1e-9
"""Rounding error allowed in an inertia matrix, relative to its largest entry."""

Check = Callable[[str, Any], Any]
T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Key(Setting):
    """A key of a file.

    ``check``: converts the file's value, at a path, to the field's. ``bound``: description of valid
    values. ``section``: schema of a nested section. ``entries``: schema of each entry of a mapping.
    ``rare``: leave the key out of descriptions if it is zero.
    """

    text: str = ""
    check: Check = lambda _, value: value
    bound: str = ""
    section: type | None = None
    entries: type | None = None
    rare: bool = False


def key(check: Check, bound: str, default: Any = MISSING, **more: Any) -> Any:
    """Make a field with its own check; ``more``: further attributes of :class:`Key`."""
    metadata = {"setting": Key(check=check, bound=bound, **more)}
    if isinstance(default, (list, dict)):
        return dataclasses.field(metadata=metadata, default_factory=lambda: check("", default))
    return dataclasses.field(metadata=metadata, default=default)


def number(*, default: Any = MISSING, **more: Any) -> Any:
    """Make a field of one finite number within bounds; ``more``: attributes of :class:`Key`."""
    return _make_numbers_field((), "number", default, more)


def vector(size: int, *, spread: bool = False, default: Any = MISSING, **more: Any) -> Any:
    """Make a field of ``size`` numbers, a read-only array; with ``spread`` one number sets all.

    Size 0 means any number of entries, but none only if there is a default.
    """
    words = f"{size} numbers" if size else "one number or more"
    return _make_numbers_field((size,), words, default, more, spread)


def matrix(rows: int, columns: int, *, default: Any = MISSING, **more: Any) -> Any:
    """Make a field of ``rows`` lists of ``columns`` numbers, a read-only array."""
    return _make_numbers_field((rows, columns), f"{rows} lists of {columns} numbers", default, more)


def _make_numbers_field(
    shape: tuple[int, ...], words: str, default: Any, more: Mapping[str, Any], spread: bool = False
) -> Any:
    bounds = Key(**more)
    least = int(default is MISSING)

    def check(field: str, value: Any) -> Any:
        if spread and _is_number(value):
            value = [value] * shape[0]
        found = _check_nested(field, value, shape, bounds, least)
        return make_read_only(found) if shape else found

    bound = words + bounds.bounds_text + ("; one stands for all" if spread else "")
    return key(check, bound, default, **more)


def text(*, default: Any = MISSING, **more: Any) -> Any:
    """Make a field of a non-empty text."""

    def check(field: str, value: Any) -> str:
        if not isinstance(value, str) or not value:
            raise ParameterError(field, value, "a non-empty text")
        _check_printable(field, value)
        return str(value)

    return key(check, "a non-empty text", default, **more)


def _check_printable(field: str, name: str) -> None:
    """Reject a name that XML, topics and tables cannot contain.

    :raises ParameterError: the name has control or other characters that cannot be printed.
    """
    if not name.isprintable():
        raise ParameterError(field, name, "a name of printable characters")


def mapping(entry: Any, *, default: Any = MISSING, **more: Any) -> Any:
    """Make a field that maps names to sections of a schema, or to values of another field.

    With a default, a key without a value is an empty mapping.
    """
    section = isinstance(entry, type)
    what = "entries" if section else "numbers"

    def check(field: str, value: Any) -> dict[str, Any]:
        value = {} if value is None and default is not MISSING else value
        named = isinstance(value, Mapping)
        if not named or not all(isinstance(name, str) and name for name in value):
            raise ParameterError(field, value, f"a mapping of names to {what}")
        for name in value:
            _check_printable(field, name)
        paths = {name: _join_path(field, name) for name in value}
        if section:
            return {name: build(entry, item, paths[name]) for name, item in value.items()}
        return {name: check_field(entry, paths[name], item) for name, item in value.items()}

    bound = f"a mapping of names to {what}"
    if not section:
        bound += entry.metadata["setting"].bounds_text
    return key(check, bound, default, entries=entry if section else None, **more)


def flag(*, default: Any = MISSING, **more: Any) -> Any:
    """Make a field that is true or false."""

    def check(field: str, value: Any) -> bool:
        if not isinstance(value, bool):
            raise ParameterError(field, value, "true or false")
        return value

    return key(check, "true or false", default, **more)


def words(*allowed: str, size: int = 0, distinct: bool = True, default: Any = MISSING, **more: Any) -> Any:
    """Make a field of ``size`` words (0: one or more), each one of ``allowed`` if there are any."""

    def check(field: str, value: Any) -> tuple[str, ...]:
        items = _check_list(field, value, size, ", ".join(allowed))
        for i, item in enumerate(items):
            if allowed and item not in allowed:
                raise UnknownNameError(f"{field}[{i}]", item, allowed)
            if not isinstance(item, str) or not item:
                raise ParameterError(f"{field}[{i}]", item, "a non-empty name")
        if distinct and len(set(items)) != len(items):
            raise ParameterError(field, list(value), "different names")
        return tuple(map(str, items))

    bound = f"different ones of {', '.join(allowed)}" if allowed else f"{size or ''} different names".strip()
    if not distinct:
        bound = f"{size} words, each {' or '.join(allowed)}"
    return key(check, bound, default, **more)


def check_field(field: Any, path: str, value: Any) -> Any:
    """Check a value like a field of a schema; return the field's value."""
    return field.metadata["setting"].check(path, value)


def interval(*, count: int = 0, default: Any = MISSING, **more: Any) -> Any:
    """Make a field ``[min, max]``; with ``count`` one for all or one each, shape (count, 2)."""
    bounds = Key(**more)

    def pair(field: str, value: Any) -> list[float]:
        if not isinstance(value, (list, tuple, np.ndarray)):
            raise ParameterError(field, value, "[min, max]")
        low, high = _check_nested(field, value, (2,), bounds)
        if not low < high:
            raise ParameterError(field, value, "[min, max] with min below max")
        return [low, high]

    def check(field: str, value: Any) -> Array:
        if count and isinstance(value, list) and any(isinstance(v, list) for v in value):
            items = _check_list(field, value, count)
            return make_read_only([pair(f"{field}[{i}]", v) for i, v in enumerate(items)])
        return make_read_only([pair(field, value)] * count if count else pair(field, value))

    bound = "[min, max]" + bounds.bounds_text
    return key(check, f"{bound}, or {count} of them" if count else bound, default, **more)


def inertia(*, positive: bool, default: Any = MISSING, **more: Any) -> Any:
    """Make a field of an inertia matrix about the centre of mass, 3x3 or its diagonal, kg m2.

    The matrix must be symmetric, its principal moments not negative (``positive``: above zero), and
    none larger than the sum of the others.
    """

    def check(field: str, value: Any) -> Array:
        flat = all(map(_is_number, _check_list(field, value, 3)))
        found = np.array(_check_nested(field, value, (3,) if flat else (3, 3), Key()))
        matrix = np.diag(found) if flat else found
        with np.errstate(all="ignore"):
            size, symmetry, moments, triangle = inertia_margins(matrix.tolist())
        if not size >= 0.0:
            raise ParameterError(field, value, f"at most {MAX_INERTIA:g} kg m2")
        if not symmetry >= 0.0:
            raise ParameterError(field, value, "a symmetric matrix")
        a, b, c = np.linalg.eigvalsh(matrix)
        if not moments >= 0.0 or (positive and not a > 1e-12 * float(np.abs(matrix).max())):
            bound = "above zero" if positive else "zero or more"
            raise ParameterError(field, value, f"principal moments {bound}; the least is {a:.6g}")
        if not triangle >= 0.0:
            raise ParameterError(field, value, f"triangle rule: {c:.6g} at most {a:.6g} + {b:.6g} (principal)")
        return make_read_only((matrix + matrix.T) / 2)

    bound = "3 numbers or 3x3" + (", moments above zero" if positive else "")
    return key(check, bound, default, unit="kg m2", **more)


def inertia_margins(matrix: Sequence[Sequence[Any]]) -> tuple[Any, Any, Any, Any]:
    """Return the margins of an inertia matrix, kg m2, to its bounds; all are >= 0 if it is valid.

    The margins are those of size, symmetry, principal moments (at least zero) and triangle rule
    (each at most the sum of the others). Expressions give expressions, for exported code.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = matrix
    entries = [absolute(value) for row in matrix for value in row]
    differences = [absolute(xy - yx), absolute(xz - zx), absolute(yz - zy)]
    scale = reduce(maximum, entries)
    slack = _INERTIA_TOLERANCE * scale
    products = (0.5 * (xy + yx), 0.5 * (xz + zx), 0.5 * (yz + zy))
    # The largest principal moment is at most (1 + slack) / (2 + slack) of the trace.
    most = (1.0 + _INERTIA_TOLERANCE) / (2.0 + _INERTIA_TOLERANCE) * (xx + yy + zz)
    return (
        MAX_INERTIA - scale,
        slack - reduce(maximum, differences),
        _least_pivot((xx + slack, yy + slack, zz + slack), products),
        _least_pivot((most - xx, most - yy, most - zz), [-value for value in products]),
    )


def _least_pivot(diagonal: Sequence[Any], products: Sequence[Any]) -> Any:
    """Return the least pivot of a symmetric matrix: not >= 0 if it is indefinite or NaN."""
    (xx, yy, zz), (xy, xz, yz) = diagonal, products
    tiny = 1e-300
    first = 1.0 / maximum(xx, tiny)
    middle = yy - xy * xy * first
    rest = yz - xy * xz * first
    last = zz - xz * xz * first - rest * rest / maximum(middle, tiny)
    return minimum(minimum(xx, middle), last)


def choice(*allowed: str, default: Any = MISSING, **more: Any) -> Any:
    """Make a field of one of the allowed words."""

    def check(field: str, value: Any) -> str:
        if value not in allowed:
            raise UnknownNameError(field, value, allowed)
        return str(value)

    return key(check, " or ".join(allowed), default, choices=allowed, **more)


def section(kind: type, *, default: Any = MISSING, **more: Any) -> Any:
    """Make a field of a nested mapping with the schema of the dataclass ``kind``."""

    def check(field: str, value: Any) -> Any:
        return build(kind, value, field)

    return key(check, "a section", default, section=kind, **more)


def build(kind: type[T], data: object, path: str = "") -> T:
    """Check a mapping against the schema ``kind`` and build its dataclass.

    :raises ParameterError: a key is missing, or a value has a wrong type or is out of range.
    :raises UnknownNameError: a key does not exist; the error names the closest valid one.
    """
    if not isinstance(data, Mapping):
        raise ParameterError(path or "parameters", data, "a mapping of keys to values")
    keys = map_parameters(kind)
    for name in data:
        if name not in keys:
            raise UnknownNameError(_join_path(path, str(name)), name, keys)
    fields = {field.name: field for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for name, (field, row) in keys.items():
        if name in data:
            values[field] = row.check(_join_path(path, name), data[name])
        elif fields[field].default is MISSING and fields[field].default_factory is MISSING:
            raise ParameterError(_join_path(path, name), None, "a value")
    result = kind(**values)
    verify = getattr(result, "verify", None)
    if verify is not None:
        verify(path)
    return result


def plain(value: Any) -> Any:
    """Convert dataclasses, arrays and tuples to mappings and lists with the keys of a file."""
    if isinstance(value, Mapping):
        return {name: plain(entry) for name, entry in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            name: plain(getattr(value, field))
            for name, (field, row) in map_parameters(type(value)).items()
            if not row.rare or np.any(getattr(value, field))
        }
    if isinstance(value, np.ndarray):
        return value.tolist()
    return list(value) if isinstance(value, tuple) else value


def units(kind: type, data: Mapping[str, Any], words: Mapping[str, str]) -> dict[str, Any]:
    """Return the units of a section's plain data by key; nested sections are mappings.

    :param kind: the section's schema.
    :param words: units that replace ``{joint}`` and ``{effort}``.
    """
    keys = map_parameters(kind)
    result: dict[str, Any] = {}
    for name, value in data.items():
        row = keys[name][1] if name in keys else Key()
        if row.section is not None and isinstance(value, Mapping):
            result[name] = units(row.section, value, words)
        elif row.entries is not None:
            result[name] = {own: units(row.entries, entry, words) for own, entry in value.items()}
        else:
            result[name] = row.unit.format_map(words)
    return result


def make_read_only(values: object) -> Array:
    """Make a read-only float array."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def _is_number(value: Any) -> bool:
    kinds = int, float, np.integer, np.floating, ExpressionText
    return isinstance(value, kinds) and not isinstance(value, bool)


def _check_nested(field: str, value: Any, shape: Sequence[int], bounds: Key, least: int = 1) -> Any:
    """Check a number, or nested lists of numbers of a shape."""
    if shape:
        items = _check_list(field, value, shape[0], "numbers", least)
        return [_check_nested(f"{field}[{i}]", item, shape[1:], bounds) for i, item in enumerate(items)]
    bound = f"a finite number{bounds.bounds_text}"
    if bounds.high is not None and "{" not in bounds.unit:
        bound += f" {bounds.unit}".rstrip()
    if not _is_number(value):
        raise ParameterError(field, value, bound)
    try:
        result = value.number(field) if isinstance(value, ExpressionText) else float(value)
    except OverflowError:
        raise ParameterError(field, "an integer too large for a float", bound) from None
    if math.isfinite(result) and abs(result) > MAX_SIZE:
        bound += f", at most {MAX_SIZE:g} in size"
    endless = result == math.inf and bounds.high == math.inf
    if not (abs(result) <= MAX_SIZE or endless) or not bounds.is_within_bounds(result):
        told = f"{value} = {result:g}" if isinstance(value, ExpressionText) else value
        raise ParameterError(field, told, bound)
    return result


def _check_list(field: str, value: Any, size: int, what: str = "", least: int = 1) -> Sequence[Any]:
    """Check a list's length: ``size``, or any from ``least`` on if ``size`` is 0."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not isinstance(value, (list, tuple)) or len(value) < least:
        raise ParameterError(field, value, f"a list of {size or what}")
    if size and len(value) != size:
        # YAML splits an expression at its comma.
        split = any(isinstance(item, str) and item.count("(") > item.count(")") for item in value)
        quotes = "; quote an expression with a comma" if split else ""
        raise ParameterError(field, value, f"a list of {size}, not {len(value)}{quotes}")
    return value


def _join_path(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name
