# SPDX-License-Identifier: Apache-2.0
"""Parameter files: plain data to frozen dataclasses, each refusal naming field and bound.

A mechanism declares its schema as frozen dataclasses whose fields are made by the functions below.
A field's metadata hold its ``check``, its ``key`` in the file, its ``unit`` (``{joint}``,
``{effort}`` and ``{rotor}`` stand for those of the actuated joints), its ``bound`` in words, its
``default``, of a nested section its ``section``, and of names to sections that of the ``entries``.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import Any, Final, TypeVar

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.operations import absolute, maximum, minimum
from pkm_twin.errors import ParameterError, UnknownNameError

MAX_SIZE: Final = 1e18
"""Beyond every quantity of a machine in SI units; products of such numbers stay finite."""
MAX_INERTIA: Final = 1e12
"""Largest entry of an inertia matrix, kg m2."""
_SLACK: Final = 1e-9
"""Error that an inertia matrix may have, relative to its largest entry."""

Check = Callable[[str, Any], Any]
T = TypeVar("T")


def number(
    *,
    above: float = -math.inf,
    at_least: float = -math.inf,
    at_most: float = math.inf,
    unit: str = "",
    default: Any = dataclasses.MISSING,
) -> Any:
    """Field: one finite number within bounds."""

    def check(field: str, value: Any) -> float:
        return _number(field, value, above, at_least, at_most, unit=unit)

    return _field(check, default, "number" + _bound(above, at_least, at_most), unit)


def vector(
    size: int,
    *,
    above: float = -math.inf,
    at_least: float = -math.inf,
    at_most: float = math.inf,
    infinite: bool = False,
    spread: bool = False,
    key: str | None = None,
    unit: str = "",
    default: Any = dataclasses.MISSING,
) -> Any:
    """Field: ``size`` numbers, read-only array; with ``spread`` one number stands for all.

    Of no size, any number of them, but none only where there is a default. ``key``: its name in the
    file, where that is no name in Python.
    """

    def check(field: str, value: Any) -> Array:
        if spread and isinstance(value, (int, float)) and not isinstance(value, bool):
            value = [value] * size
        items = _sequence(field, value, size, "numbers", least=default is dataclasses.MISSING)
        return frozen(
            [
                _number(f"{field}[{i}]", item, above, at_least, at_most, infinite)
                for i, item in enumerate(items)
            ]
        )

    bound = f"{size} numbers" if size else "one number or more"
    bound += _bound(above, at_least, at_most, infinite)
    if spread:
        bound += "; one stands for all"
    return _field(check, default, bound, unit, key=key)


def matrix(rows: int, columns: int, *, unit: str = "", default: Any = dataclasses.MISSING) -> Any:
    """Field: ``rows`` lists of ``columns`` numbers, read-only array."""

    def check(field: str, value: Any) -> Array:
        return frozen(_table(field, _sequence(field, value, rows), columns))

    return _field(check, default, f"{rows} lists of {columns} numbers", unit)


def text(*, default: Any = dataclasses.MISSING) -> Any:
    """Field: a non-empty text."""

    def check(field: str, value: Any) -> str:
        if not isinstance(value, str) or not value:
            raise ParameterError(field, value, "a non-empty text")
        return value

    return _field(check, default, "a non-empty text")


def mapping(entry: Any, *, default: Any = dataclasses.MISSING) -> Any:
    """Field: names to sections with the schema of a dataclass, or to values of another field."""
    section = isinstance(entry, type)
    what = "entries" if section else "numbers"

    def check(field: str, value: Any) -> dict[str, Any]:
        if not isinstance(value, Mapping) or not all(isinstance(k, str) and k for k in value):
            raise ParameterError(field, value, f"a mapping of names to {what}")
        judge = (
            (lambda path, item: build(entry, item, path)) if section else entry.metadata["check"]
        )
        return {name: judge(_join(field, name), item) for name, item in value.items()}

    bound = f"a mapping of names to {what}"
    if not section:
        bound += entry.metadata["bound"].removeprefix("number")
    return _field(check, default, bound, entries=entry if section else None)


def flag(*, default: Any = dataclasses.MISSING) -> Any:
    """Field: true or false."""

    def check(field: str, value: Any) -> bool:
        if not isinstance(value, bool):
            raise ParameterError(field, value, "true or false")
        return value

    return _field(check, default, "true or false")


def words(
    *allowed: str, size: int = 0, distinct: bool = True, default: Any = dataclasses.MISSING
) -> Any:
    """Field: ``size`` words, by default one or more, each of the allowed where there are any."""

    def check(field: str, value: Any) -> tuple[str, ...]:
        items = _sequence(field, value, size, ", ".join(allowed))
        for i, item in enumerate(items):
            if allowed and item not in allowed:
                raise UnknownNameError(f"{field}[{i}]", item, allowed)
            if not isinstance(item, str) or not item:
                raise ParameterError(f"{field}[{i}]", item, "a non-empty name")
        if distinct and len(set(items)) != len(items):
            raise ParameterError(field, list(value), "different names")
        return tuple(items)

    bound = f"different ones of {', '.join(allowed)}" if allowed else f"{size} different names"
    if not distinct:
        bound = f"{size} words, each {' or '.join(allowed)}"
    return _field(check, default, bound)


def checked(field: Any, path: str, value: Any) -> Any:
    """A value checked as the field of a schema is, by its path."""
    return field.metadata["check"](path, value)


def interval(
    *,
    above: float = -math.inf,
    count: int = 0,
    unit: str = "",
    default: Any = dataclasses.MISSING,
) -> Any:
    """Field: ``[min, max]``; with ``count`` one for all or one each, shape (count, 2)."""

    def pair(field: str, value: Any) -> list[float]:
        low, high = (
            _number(f"{field}[{i}]", v, above) for i, v in enumerate(_sequence(field, value, 2))
        )
        if not low < high:
            raise ParameterError(field, value, "[min, max] with min below max")
        return [low, high]

    def check(field: str, value: Any) -> Array:
        if count and isinstance(value, list) and any(isinstance(v, list) for v in value):
            items = _sequence(field, value, count)
            return frozen([pair(f"{field}[{i}]", v) for i, v in enumerate(items)])
        return frozen([pair(field, value)] * count if count else pair(field, value))

    bound = "[min, max]" + _bound(above)
    return _field(check, default, f"{bound}, or {count} of them" if count else bound, unit)


def inertia(*, positive: bool, default: Any = dataclasses.MISSING) -> Any:
    """Field: an inertia matrix about a centre of mass, 3x3 or its diagonal, kg m2.

    Symmetric, principal moments not negative (``positive``: above zero), triangle rule kept.
    """

    def check(field: str, value: Any) -> Array:
        rows = _sequence(field, value, 3)
        if all(isinstance(row, (int, float)) and not isinstance(row, bool) for row in rows):
            matrix = np.diag([_number(f"{field}[{i}]", v) for i, v in enumerate(rows)])
        else:
            matrix = np.array(_table(field, rows, 3))
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
            raise ParameterError(
                field, value, f"triangle rule: {c:.6g} at most {a:.6g} + {b:.6g} (principal)"
            )
        return frozen((matrix + matrix.T) / 2)

    least = "above zero" if positive else "zero or more"
    bound = f"3 numbers or 3x3, symmetric, principal moments {least}, triangle rule"
    return _field(check, default, bound, "kg m2")


def inertia_margins(matrix: Sequence[Sequence[Any]]) -> tuple[Any, Any, Any, Any]:
    """What a body's inertia matrix, kg m2, keeps to its bounds; each at least zero if it is valid.

    Of its size, its symmetry, its principal moments (at least zero) and the triangle rule (each at
    most the sum of the others). Of expressions, expressions: exported code has the same rule.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = matrix
    entries = [absolute(value) for row in matrix for value in row]
    differences = [absolute(xy - yx), absolute(xz - zx), absolute(yz - zy)]
    scale = reduce(maximum, entries)
    slack = _SLACK * scale
    products = (0.5 * (xy + yx), 0.5 * (xz + zx), 0.5 * (yz + zy))
    # The largest principal moment is at most (1 + slack) / (2 + slack) of the trace.
    most = (1.0 + _SLACK) / (2.0 + _SLACK) * (xx + yy + zz)
    return (
        MAX_INERTIA - scale,
        slack - reduce(maximum, differences),
        _least_pivot((xx + slack, yy + slack, zz + slack), products),
        _least_pivot((most - xx, most - yy, most - zz), [-value for value in products]),
    )


def _least_pivot(diagonal: Sequence[Any], products: Sequence[Any]) -> Any:
    """Of a symmetric matrix; negative or NaN where it is not positive semidefinite."""
    (xx, yy, zz), (xy, xz, yz) = diagonal, products
    tiny = 1e-300
    first = 1.0 / maximum(xx, tiny)
    middle = yy - xy * xy * first
    rest = yz - xy * xz * first
    last = zz - xz * xz * first - rest * rest / maximum(middle, tiny)
    return minimum(minimum(xx, middle), last)


def choice(*allowed: str, default: Any = dataclasses.MISSING) -> Any:
    """Field: one of the allowed words."""

    def check(field: str, value: Any) -> str:
        if value not in allowed:
            raise UnknownNameError(field, value, allowed)
        return str(value)

    return _field(check, default, " or ".join(allowed))


def section(kind: type, *, default: Any = dataclasses.MISSING) -> Any:
    """Field: a nested mapping with the schema of the dataclass ``kind``."""

    def check(field: str, value: Any) -> Any:
        return build(kind, value, field)

    return _field(check, default, "a section", kind=kind)


def build(kind: type[T], data: object, path: str = "") -> T:
    """A mapping checked against the schema dataclass ``kind``.

    :raises ParameterError: a key missing, a wrong type, a value out of range.
    :raises UnknownNameError: a key that does not exist, with the closest valid one.
    """
    if not isinstance(data, Mapping):
        raise ParameterError(path or "parameters", data, "a mapping of keys to values")
    # A field without a check is no key of the file.
    fields = {
        f.metadata["key"] or f.name: f
        for f in dataclasses.fields(kind)  # type: ignore[arg-type]
        if "check" in f.metadata
    }
    for key in data:
        if key not in fields:
            raise UnknownNameError(_join(path, str(key)), key, fields)
    values: dict[str, Any] = {}
    for name, field in fields.items():
        dotted = _join(path, name)
        if name in data:
            values[field.name] = field.metadata["check"](dotted, data[name])
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise ParameterError(dotted, None, "a value")
    result = kind(**values)
    verify = getattr(result, "verify", None)
    if verify is not None:
        verify(path)
    return result


def replace(section_value: T, changes: Mapping[str, object], path: str) -> T:
    """A copy of a section with some keys set anew, every one checked; all or none."""
    fields = {f.name: f for f in dataclasses.fields(section_value)}  # type: ignore[arg-type]
    checked = {}
    for key, value in changes.items():
        if key not in fields:
            raise UnknownNameError(_join(path, key), key, fields)
        checked[key] = fields[key].metadata["check"](_join(path, key), value)
    result: T = dataclasses.replace(section_value, **checked)  # type: ignore[type-var]
    verify = getattr(result, "verify", None)
    if verify is not None:
        verify(path)
    return result


def plain(value: Any) -> Any:
    """Dataclasses, arrays and tuples as mappings and lists, in mappings too; keys as in a file."""
    if isinstance(value, Mapping):
        return {name: plain(entry) for name, entry in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            f.metadata.get("key") or f.name: plain(getattr(value, f.name))
            for f in dataclasses.fields(value)
            if not f.metadata.get("rare") or np.any(getattr(value, f.name))
        }
    if isinstance(value, np.ndarray):
        return value.tolist()
    return list(value) if isinstance(value, tuple) else value


def units(kind: type, data: Mapping[str, Any], words: Mapping[str, str]) -> dict[str, Any]:
    """Units of a section's plain data by key, of nested sections as mappings; no unit is empty.

    :param kind: the section's schema.
    :param words: what stands for ``{joint}`` and ``{effort}`` in them.
    """
    fields: dict[str, Mapping[Any, Any]] = {}
    for f in dataclasses.fields(kind):
        fields |= {f.name: f.metadata, f.metadata.get("key") or f.name: f.metadata}
    result: dict[str, Any] = {}
    for key, value in data.items():
        metadata = fields.get(key, {})
        nested, entries = metadata.get("section"), metadata.get("entries")
        if nested is not None and isinstance(value, Mapping):
            result[key] = units(nested, value, words)
        elif entries is not None:
            result[key] = {name: units(entries, entry, words) for name, entry in value.items()}
        else:
            result[key] = metadata.get("unit", "").format_map(words)
    return result


def frozen(values: object) -> Array:
    """A read-only float array."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def _field(
    check: Check,
    default: Any,
    bound: str,
    unit: str = "",
    *,
    key: str | None = None,
    kind: type | None = None,
    entries: type | None = None,
) -> Any:
    metadata = {
        "check": check, "key": key, "unit": unit, "bound": bound, "default": default,
        "section": kind, "entries": entries,
    }  # fmt: skip
    if default is dataclasses.MISSING:
        return dataclasses.field(metadata=metadata)
    if isinstance(default, (list, dict)):
        return dataclasses.field(metadata=metadata, default_factory=lambda: check("", default))
    return dataclasses.field(metadata=metadata, default=default)


def _bound(
    above: float = -math.inf,
    at_least: float = -math.inf,
    at_most: float = math.inf,
    infinite: bool = False,
) -> str:
    """Bounds in words, to stand behind what they bound."""
    words = f" above {above:g}" if above > -math.inf else ""
    if at_least > -math.inf:
        words += f", at least {at_least:g}"
    if at_most < math.inf:
        words += f", at most {at_most:g}"
    return words + (", or .inf" if infinite else "")


def _number(
    field: str,
    value: Any,
    above: float = -math.inf,
    at_least: float = -math.inf,
    at_most: float = math.inf,
    infinite: bool = False,
    unit: str = "",
) -> float:
    bound = "a finite number" + _bound(above, at_least, at_most, infinite)
    if at_most < math.inf and "{" not in unit:
        bound += f" {unit}".rstrip()
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise ParameterError(field, value, bound)
    try:
        result = float(value)
    except OverflowError:
        raise ParameterError(field, "an integer too large for a float", bound) from None
    if math.isfinite(result) and abs(result) > MAX_SIZE:
        bound += f", at most {MAX_SIZE:g} in size"
    finite = abs(result) <= MAX_SIZE or (infinite and result == math.inf)
    if not finite or not result > above or result < at_least or result > at_most:
        raise ParameterError(field, value, bound)
    return result


def _table(field: str, rows: Sequence[Any], columns: int) -> list[list[float]]:
    return [
        [
            _number(f"{field}[{i}][{j}]", v)
            for j, v in enumerate(_sequence(f"{field}[{i}]", row, columns))
        ]
        for i, row in enumerate(rows)
    ]


def _sequence(field: str, value: Any, size: int, what: str = "", least: int = 1) -> Sequence[Any]:
    """A list of that size, or of any from the least on."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not isinstance(value, (list, tuple)) or len(value) < least:
        raise ParameterError(field, value, f"a list of {size or what}")
    if size and len(value) != size:
        raise ParameterError(field, value, f"a list of {size}, not {len(value)}")
    return value


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name
