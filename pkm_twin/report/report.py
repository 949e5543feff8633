# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Define the parts of a report and convert it to plain data."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROUNDING: Final = 1e-9
"""Numbers below this fraction of a column's largest number are shown as 0 (columns with a unit)."""


class Verdict(StrEnum):
    """The judgement of a property: good, bad, or unknown for lack of evidence."""

    GOOD = "good"
    BAD = "bad"
    UNKNOWN = "unknown"

    @property
    def words(self) -> str:
        """The verdict as the terminal shows it."""
        return "not judged" if self is Verdict.UNKNOWN else str(self)


@dataclass(frozen=True)
class Fact:
    """A named value.

    ``name``: key in JSON; empty if JSON has the value elsewhere. ``value``: a number, word, list or
    mapping, in SI units. ``text``: label in the terminal; None for JSON alone. ``shown``: the value
    as text, by default its number. ``bound``, ``verdict`` and ``numbers`` (for JSON) belong to a
    judged property.
    """

    name: str
    value: Any
    unit: str = ""
    text: str | None = None
    shown: str = ""
    bound: Any = None
    verdict: Verdict | None = None
    numbers: Mapping[str, Any] = field(default_factory=dict)

    @property
    def formatted(self) -> str:
        """The value with its unit, as printed in the terminal."""
        return self.shown or f"{format_number(self.value)} {self.unit}".strip()


def make_judged_fact(what: str, value: str, bound: str, good: bool | None, **numbers: Any) -> Fact:
    """Make a fact with its value, its bound and the verdict.

    :param good: whether the property keeps the bound; None if this cannot be decided.
    :param numbers: ``number``, ``limit`` and ``unit`` for JSON.
    """
    verdict = Verdict.UNKNOWN if good is None else Verdict.GOOD if good else Verdict.BAD
    return Fact("", value, text=what, bound=bound, verdict=verdict, numbers=numbers)


@dataclass(frozen=True)
class Column:
    """A column of a table.

    ``name``: key in JSON; empty if the column is only shown. ``text``: heading, by default the
    name, a blank for none; None for JSON alone. ``scale``: factor from ``unit`` to the unit
    ``shown`` in the terminal. ``form``: format of numbers.
    """

    name: str
    unit: str = ""
    text: str | None = ""
    scale: float = 1.0
    shown: str = ""
    form: str = ".4g"

    @property
    def heading(self) -> str:
        """The heading with the unit, as the terminal prints it."""
        unit = self.shown or self.unit
        return f"{self.text or self.name}{f' ({unit})' if unit else ''}"

    def cell(self, value: Any, least: float = 0.0) -> str:
        """Format a value for the terminal; show 0 if it is smaller than ``least``."""
        if isinstance(value, float) and abs(value) < least:
            value = 0.0
        scales = self.scale != 1.0 and isinstance(value, int | float)
        return format_number(value * self.scale if scales else value, self.form)


@dataclass(frozen=True)
class Table:
    """Rows by name, each with a value per column; in JSON ``{name: {row: {column: value}}}``.

    ``name``: key in JSON; empty for the terminal alone. ``head``: heading of the rows' names.
    ``title``: the line above the table.
    """

    name: str
    columns: Sequence[Column]
    rows: Mapping[str, Sequence[Any]]
    title: str = ""
    head: str = ""

    @property
    def cells(self) -> list[tuple[str, ...]]:
        """Headings and formatted rows of the columns that are shown as text."""
        shown = [(k, column) for k, column in enumerate(self.columns) if column.text is not None]
        rows = self.rows.items()
        # Rounding to 0 is relative to the column's largest number, which needs the same unit in all rows.
        least = []
        for k, column in shown:
            values = [row[k] for row in self.rows.values() if column.unit]
            sizes = [abs(v) for v in values if isinstance(v, int | float) and math.isfinite(v)]
            least.append(ROUNDING * float(max(sizes, default=0.0)))
        return [
            (self.head, *(column.heading for _, column in shown)),
            *(
                (name, *(c.cell(values[k], low) for (k, c), low in zip(shown, least, strict=True)))
                for name, values in rows
            ),
        ]

    @property
    def data(self) -> dict[str, dict[str, Any]]:
        """The table as JSON data."""
        return {
            row: {c.name: v for c, v in zip(self.columns, values, strict=True) if c.name}
            for row, values in self.rows.items()
        }


@dataclass(frozen=True)
class Report:
    """The results of a command.

    ``answer``: one sentence with units, the first line of the output. ``files``: written files by
    their keys in JSON, None where none was written. ``figures``: functions that draw a picture each
    with matplotlib, by the suffix of the picture's name. ``verdict``: bad ends the command with
    exit code 1; ``code``: any other exit code. ``error``: a line on stderr. ``raw``: text that the
    command prints instead of everything else.
    """

    answer: str = ""
    facts: Sequence[Fact] = ()
    tables: Sequence[Table] = ()
    figures: Mapping[str, Callable[[], Figure]] = field(default_factory=dict)
    notes: Sequence[str] = ()
    files: Mapping[str, Path | None] = field(default_factory=dict)
    verdict: Verdict | None = None
    code: int = 0
    error: str = ""
    raw: str = ""

    @property
    def exit_code(self) -> int:
        """The command's exit code: 0 good, 1 bad."""
        return self.code or int(self.verdict is Verdict.BAD)

    @property
    def data(self) -> dict[str, Any]:
        """Facts and tables as JSON data, in SI units; None for numbers that are not finite.

        ``units``: units of facts, and of columns as TABLE.COLUMN; ``items``: the judged facts.
        """
        found = {fact.name: fact.value for fact in self.facts if fact.name}
        items = [
            {"what": f.text, "value": f.formatted, "bound": f.bound, "verdict": f.verdict, **f.numbers}
            for f in self.facts
            if f.verdict is not None
        ]
        found |= {"items": items} if items else {}
        found |= {table.name: table.data for table in self.tables if table.name}
        found |= {name: None if path is None else str(path) for name, path in self.files.items()}
        units = {fact.name: fact.unit for fact in self.facts if fact.name and fact.unit}
        for table in filter(lambda one: one.name, self.tables):
            units |= {f"{table.name}.{c.name}": c.unit for c in table.columns if c.name and c.unit}
        found |= {"units": units} if units and "units" not in found else {}
        found |= {"verdict": self.verdict} if self.verdict is not None else {}
        found |= {"error": self.error} if self.error else {}
        return dict(to_json_data(found))


def to_json_data(value: Any) -> Any:
    """Convert values for JSON: arrays become lists, NaN and infinity become None."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): to_json_data(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json_data(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path | StrEnum) else value


def format_number(value: Any, form: str = ".4g") -> str:
    """Format a value as text; None and NaN become a dash."""
    value = value.tolist() if hasattr(value, "tolist") else value
    if value is None or value != value:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value + 0.0:{form}}"
    if isinstance(value, list | tuple):
        return ", ".join(format_number(item, form) for item in value)
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {format_number(item, form)}" for key, item in value.items())
    return str(value)
