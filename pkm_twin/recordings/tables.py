# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Tables: files with a header row as other programs write them, as columns in SI units.

What a header row makes certain (separator, decimal comma, units behind names) is found and
reported; the rest is a :class:`Dialect`.
"""

from __future__ import annotations

import array
import csv
import importlib.util
import io
import itertools
import math
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Final, TextIO

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import FileError, ParameterError, UnknownNameError, warn_of_file
from pkm_twin.files import STANDARD, open_regular, parse_decimal, write_atomically
from pkm_twin.robot.robot import Robot

MAX_BYTES: Final = 1024**3
"""Largest table that is read: some millions of samples."""
MAX_LINE: Final = 1024**2
"""Longest line of a table that is read, characters."""
ROWS_PER_BLOCK: Final = 4096
"""Rows written at a time, so that memory stays flat."""
WRITABLE_SUFFIXES: Final = (".csv", ".parquet", ".mat")
"""Suffixes of tables that can be written."""
NOT_READ: Final = {
    ".mat": "CSV or Parquet; in MATLAB: writetable(T, 'FILE.csv')",
    ".gz": "the unpacked table; gunzip -k FILE.csv.gz",
    ".xlsx": "CSV, as the spreadsheet saves it",
}
"""Suffixes of rejected tables, and what to use instead."""
SEPARATORS: Final = {",": ",", ";": ";", "tab": "\t", "\t": "\t"}
UNITS: Final = {
    "rad": ("angle", 1.0),
    "mrad": ("angle", 1e-3),
    "deg": ("angle", math.pi / 180.0),
    "rev": ("angle", math.tau),
    "m": ("length", 1.0),
    "cm": ("length", 1e-2),
    "mm": ("length", 1e-3),
    "µm": ("length", 1e-6),
    "um": ("length", 1e-6),
    "s": ("time", 1.0),
    "ms": ("time", 1e-3),
    "us": ("time", 1e-6),
    "ns": ("time", 1e-9),
    "N": ("force", 1.0),
    "kN": ("force", 1e3),
    "Nm": ("moment", 1.0),
    "Nmm": ("moment", 1e-3),
    "kNm": ("moment", 1e3),
    "kg": ("mass", 1.0),
    "g": ("mass", 1e-3),
    "A": ("current", 1.0),
    "mA": ("current", 1e-3),
    "percent": ("effort", 1e-2),
}
"""Units of a table: for each its quantity and its factor to SI."""
RATES: Final = ("position", "velocity", "acceleration")
EFFORTS: Final = ("effort", "measured", "current")
WRENCH: Final = ("fx", "fy", "fz", "mx", "my", "mz")
DEFLECTION: Final = ("dx", "dy", "dz", "rx", "ry", "rz")
PAYLOAD: Final = ("payload.mass", "payload.x", "payload.y", "payload.z")
"""Columns of the mass (kg) and the centre of mass (m) of the payload on the platform."""
COLUMN_ALIASES: Final = {"payload": PAYLOAD[0]}
"""Other names of columns."""
UNIT_SPELLING: Final = str.maketrans({" ": "", "·": "", "*": "", "°": "deg"})
SWAPPED_MARKS: Final = str.maketrans(",.", ".,")
"""Turns a decimal comma into a point, and a point, which may separate thousands, into what is no number."""
_UNIT: Final = re.compile(rf"(.*?)(?:\s*[\[(]\s*(.*?)(?:/s(?:\^?2|²)?)?\s*[\])]|_({'|'.join(UNITS)}))")
"""A column's name with its unit, in brackets or after an underscore."""


@dataclass(frozen=True)
class Dialect:
    """The format of a table: separator, decimal mark, column names and units.

    ``separator``, ``decimal``: found from the header row if None. ``columns``: from our name of a
    column to the table's; ``*`` in both stands for the same text. ``units``: from a quantity of ``UNITS``
    to the unit of columns whose header has none; rates are always per second.
    """

    separator: str | None = None
    decimal: str | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def from_options(
        cls,
        separator: str | None = None,
        decimal: str | None = None,
        columns: str | Sequence[str] | None = None,
        units: str | None = None,
        time: str | None = None,
    ) -> Dialect:
        """Build the dialect from the options of a command.

        :raises ParameterError: an option is invalid; the error names it.
        """
        if separator is not None and separator not in SEPARATORS:
            raise ParameterError("--separator", separator, "one of , ; tab")
        if decimal not in (None, ".", ","):
            raise ParameterError("--decimal", decimal, ". or ,")
        names: dict[str, str] = {}
        text = columns if isinstance(columns, str) else ",".join(columns or ())
        for pair in text.split(",") if text else ():
            ours, sign, theirs = (part.strip() for part in pair.partition("="))
            if not (ours and sign and theirs) or ours.count("*") != theirs.count("*") > 1:
                raise ParameterError("--columns", pair, "NAME=COLUMN, several with commas between")
            names[ours] = theirs
        if time is not None:
            if not time.strip() or names.get("time", time.strip()) != time.strip():
                raise ParameterError("--time", time, "one column's name")
            names["time"] = time.strip()
        chosen: dict[str, str] = {}
        for word in map(str.strip, (units or "").split(",")) if units else ():
            if word not in UNITS:
                raise UnknownNameError("--units", word, tuple(UNITS))
            if UNITS[word][0] in chosen:
                raise ParameterError("--units", units, f"one unit of {UNITS[word][0]}")
            chosen[UNITS[word][0]] = word
        return cls(None if separator is None else SEPARATORS[separator], decimal, names, chosen)

    def size(self, kind: str) -> float:
        """Return the factor to SI of a quantity's numbers in columns without a unit."""
        return math.prod(UNITS[self.units[word]][1] for word in kind.split() if word in self.units)


DEFAULT_DIALECT: Final = Dialect()


class Table(dict[str, Array]):
    """Columns of a file by name, shape (rows,) each, in SI units."""

    def __init__(self, path: Path, columns: Mapping[str, Array], above: int = 0) -> None:
        super().__init__(columns)
        self.path = path
        self.left_out: list[str] = []
        """Columns that are not known and have cells that are not numbers."""
        self._first = 2 + above

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(next(iter(self.values()))) if self else 0

    def line(self, row: int) -> str:
        """Return the file and line of a row, for errors."""
        return f"{self.path}: line {self._first + row}"

    def require(self, names: Iterable[str]) -> None:
        """Reject a table that lacks any of these columns.

        :raises ParameterError: a column is missing; the error names the first.
        """
        for name in names:
            if name not in self:
                raise ParameterError(
                    str(self.path), ", ".join(self), f"a column {name!r}; --columns {name}=HEADER names another"
                )

    def stack(self, names: Sequence[str]) -> Array:
        """Return columns side by side, shape (rows, names).

        :raises ParameterError: a column is missing; the error names the first.
        """
        self.require(names)
        return np.stack([self[name] for name in names], -1)

    def stack_if(self, names: Sequence[str]) -> Array | None:
        """Return columns side by side; None if all are missing.

        :raises ParameterError: some are missing.
        """
        return self.stack(names) if any(name in self for name in names) else None

    def fill(self, names: Sequence[str], missing: float = 0.0) -> Array | None:
        """Stack columns as :meth:`stack_if`, with a number for missing ones."""
        if not any(name in self for name in names):
            return None
        return np.stack([self.get(n, np.full(self.rows, missing)) for n in names], -1)


def map_column_quantities(robot: Robot, side: str = "joint") -> dict[str, str]:
    """Return the quantity of each column of a motion table, of those of ``UNITS`` or other (empty).

    An effort is a force or a moment, or a part of the motor's rated torque.

    :param side: where joint values are measured, one of ``VALUE_SIDES``; those of the motor are angles.
    """
    kinds = {"time": "time"}
    names = robot.joint_names if side == "joint" else robot.controller.names
    joints = ["rad" if side == "motor" else unit for unit in robot.joint_units]
    units = dict(zip((*names, *robot.pose_names), (*joints, *robot.pose_units), strict=True))
    units |= dict(zip(names, joints, strict=True))
    for name, unit in units.items():
        kinds |= dict.fromkeys((f"{name}.{what}" for what in RATES), UNITS[unit][0])
        efforts = "effort force" if unit == "m" else "effort moment"
        kinds |= dict.fromkeys((f"{name}.{what}" for what in EFFORTS[:2]), efforts)
        kinds[f"{name}.{EFFORTS[2]}"] = "current"
    kinds |= dict.fromkeys((*DEFLECTION[:3], *PAYLOAD[1:], "blend"), "length")
    kinds |= dict.fromkeys(DEFLECTION[3:], "angle")
    kinds |= dict.fromkeys(WRENCH[:3], "force") | dict.fromkeys(WRENCH[3:], "moment")
    kinds |= {PAYLOAD[0]: "mass"} | dict.fromkeys(("dwell", "arc"), "")
    # If a joint and a pose coordinate have the same name, rates and efforts are the joint's.
    pose = zip(robot.pose_names, robot.pose_units, strict=True)
    return kinds | {name: UNITS[unit][0] for name, unit in pose}


def read_table(
    path: Path, kinds: Mapping[str, str] | None = None, dialect: Dialect = DEFAULT_DIALECT, *, blank: bool = False
) -> Table:
    """Read the columns of a CSV or, by its ending, Parquet file with a header row, in SI units.

    Lines above the header row that begin with # are comments. Left out are columns without any
    number and, where ``kinds`` are known, other columns with a cell that is no number: a state in
    words, a reaction that is undetermined for a while. A header may end in its unit: ``x [mm]``,
    ``x_mm``.

    :param path: ``-`` is stdin.
    :param kinds: of known columns, what they measure; only these have units and other names.
    :param blank: whether cells may be empty, which are NaN.
    :raises ParameterError: not readable, too large, a value is no finite number, or a name of the
        dialect that is not there.
    """
    if kinds is None and dialect.units:
        raise ParameterError("units", ", ".join(dialect.units.values()), "none for this table")
    if path.suffix in NOT_READ:
        raise ParameterError(str(path), f"a {path.suffix} file", NOT_READ[path.suffix])
    try:
        file: AbstractContextManager[BinaryIO] = nullcontext(sys.stdin.buffer)
        if str(path) != STANDARD:
            file = open_regular(path)
            size = os.fstat(file.fileno()).st_size
            if size > MAX_BYTES:
                raise ParameterError(str(path), f"{size} bytes", f"at most {MAX_BYTES}")
        with file as data:
            read = _read_parquet if path.suffix == ".parquet" else _read_csv
            header, values, above = read(path, data, dialect, kinds)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(path, error, "a table, CSV or Parquet") from None
    names, sizes = _name_columns(header, kinds or {}, dialect)
    if len(set(names)) != len(names):
        raise ParameterError(f"{path}: header row", ", ".join(names), "different names")
    table = Table(path, dict(zip(names, values, strict=True)), above)
    for cell, name, scale in zip(header, names, sizes, strict=True):
        empty = np.isnan(table[name])
        if empty.all() and not blank:
            del table[name]
        elif empty.any() and not blank and kinds and name not in kinds:
            table.left_out.append(name)
            del table[name]
        elif empty.any() and not blank:
            where = f"{table.line(int(empty.argmax()))}, column {cell}"
            raise ParameterError(where, "empty", "a finite number")
        elif scale != 1.0:
            table[name] = scale * table[name]
    return table


def _read_csv(
    path: Path, data: BinaryIO, dialect: Dialect, kinds: Mapping[str, str] | None
) -> tuple[list[str], Array, int]:
    """Return header cells, numbers (columns, rows), and how many lines are above the header.

    Empty cells are NaN, and cells without a number in columns that are not in ``kinds``.
    """
    # Spreadsheets put a byte order mark before the header row.
    with io.TextIOWrapper(data, encoding="utf-8-sig", newline="") as text:
        lines, above = _read_lines(text, path), 0
        while (first := next(lines, "")).startswith("#"):
            above += 1
        separator = dialect.separator
        if separator is None:
            # Column names contain no separators, so a single kind of them in the header is certain.
            there = [mark for mark in (";", "\t") if mark in first]
            separator = there[0] if len(there) == 1 and "," not in first else ","
            if separator != ",":
                warn_of_file(
                    path, f"columns are separated by {'tabs' if separator == SEPARATORS['tab'] else separator}"
                )
        rows = csv.reader(itertools.chain([first], lines), delimiter=separator)
        header = [name.strip() for name in next(rows, [])]
        cells, number, read = array.array("d"), above + 1, _find_needed(header, kinds, dialect)
        comma = None if dialect.decimal is None and separator != "," else dialect.decimal == ","
        for number, row in enumerate(itertools.takewhile(bool, rows), above + 2):
            if len(row) != len(header):
                raise ParameterError(f"{path}: line {number}", len(row), f"{len(header)} values")
            for name, cell, needed in zip(header, row, read, strict=True):
                try:
                    # An empty cell is NaN.
                    if not cell.strip():
                        value = math.nan
                    else:
                        if comma is None and needed and ("," in cell or "." in cell):
                            # The first mark decides: a file with both may have thousands separators.
                            comma = "," in cell
                            if comma:
                                warn_of_file(path, "numbers have a decimal comma")
                        value = parse_decimal(cell.translate(SWAPPED_MARKS) if comma else cell)
                        if not math.isfinite(value):
                            raise ValueError(f"{cell!r} is not finite")
                    cells.append(value)
                except ValueError:
                    if not needed:
                        cells.append(math.nan)
                        continue
                    where = f"{path}: line {number}, column {name}"
                    mark = " with a decimal comma" if comma else " with a decimal point" if "," in cell else ""
                    raise ParameterError(where, cell, f"a finite number{mark}") from None
        if any(rows):
            raise ParameterError(f"{path}: line {number + 1}", "empty", f"{len(header)} values")
    if not cells:
        raise ParameterError(str(path), f"{number if header else 0} lines", "a header row and rows")
    table = np.frombuffer(cells, np.float64).reshape(-1, len(header))
    return header, np.ascontiguousarray(table.T), above


def _find_needed(header: list[str], kinds: Mapping[str, str] | None, dialect: Dialect) -> list[bool]:
    """Return which columns must have numbers: all, or those of ``kinds`` if given."""
    return [not kinds or name in kinds for name in _name_columns(header, kinds or {}, dialect)[0]]


def _read_parquet(
    path: Path, data: BinaryIO, dialect: Dialect, kinds: Mapping[str, str] | None
) -> tuple[list[str], Array, int]:
    """Return what :func:`_read_csv` returns; a null is an empty cell."""
    require_pyarrow(path)
    import pyarrow
    from pyarrow import parquet

    try:
        table = parquet.read_table(data)
        header, values = list(table.column_names), []
        for column, needed in zip(table.columns, _find_needed(header, kinds, dialect), strict=True):
            try:
                cells = column.cast("float64").to_numpy()
            except pyarrow.ArrowException:
                if needed:
                    raise
                cells = np.full(len(table), np.nan)
            values.append(cells if needed else np.where(np.isfinite(cells), cells, np.nan))
    except pyarrow.ArrowException as error:
        raise FileError(path, error, "a Parquet file of numbers") from None
    if not len(table):
        raise ParameterError(str(path), "no rows", "rows of numbers")
    numbers = np.array(values, np.float64)
    if np.isinf(numbers).any():
        column, row = np.argwhere(np.isinf(numbers))[0]
        where = f"{path}: row {row + 1}, column {header[column]}"
        raise ParameterError(where, numbers[column, row], "a finite number")
    return header, numbers, 0


def _read_lines(text: TextIO, path: Path) -> Iterator[str]:
    """Yield the lines of a file; reject a line longer than MAX_LINE."""
    while line := text.readline(MAX_LINE):
        if len(line) == MAX_LINE:
            raise ParameterError(f"{path}: a line", f"{line[:40]}...", f"at most {MAX_LINE} characters")
        yield line


def _name_columns(header: Sequence[str], kinds: Mapping[str, str], dialect: Dialect) -> tuple[list[str], list[float]]:
    """Return the columns' names in this package, and their units in SI.

    :raises ParameterError: a unit of another kind.
    :raises UnknownNameError: a name that no column has, a header that is not there, or a column that differs
        from a known one in upper and lower case alone.
    """
    ours = {cell: (COLUMN_ALIASES[cell], "") for cell in header if COLUMN_ALIASES.get(cell) in kinds}
    for cell in header:
        match = _UNIT.fullmatch(cell)
        if match is not None and match[1] in kinds and cell not in kinds:
            ours[cell] = match[1], (match[2] or match[3]).translate(UNIT_SPELLING)
    for given, text in dialect.columns.items():
        name = COLUMN_ALIASES.get(given, given)
        match = _UNIT.fullmatch(text) if text not in header else None
        stem, unit = (match[1], match[2] or match[3]) if match else (text, "")
        pattern = re.compile(re.escape(stem).replace(r"\*", "(.+)"))
        fits = [(cell, m) for cell in header if (m := pattern.fullmatch(cell))]
        if not fits and name not in header:
            raise UnknownNameError("--columns", stem, header)
        for cell, m in fits:
            whole = name.replace("*", m[1]) if "*" in stem else name
            if kinds and whole not in kinds:
                raise UnknownNameError("--columns", whole, kinds)
            ours[cell] = whole, unit
    names: list[str] = []
    sizes: list[float] = []
    folded = {name.casefold(): name for name in kinds if name not in {ours.get(c, (c, ""))[0] for c in header}}
    for cell in header:
        name, unit = ours.get(cell, (cell, ""))
        kind = kinds.get(name, "")
        if name not in kinds and name.casefold() in folded:
            raise UnknownNameError("column", name, [folded[name.casefold()]])
        if unit and (unit not in UNITS or UNITS[unit][0] not in kind.split()):
            fit = [word for word, (of, _) in UNITS.items() if of in kind.split()]
            raise ParameterError(f"{cell}: unit", unit, f"one of {', '.join(fit) or 'none'}")
        names.append(name)
        sizes.append(UNITS[unit][1] if unit else dialect.size(kind))
    return names, sizes


def require_pyarrow(path: Path) -> None:
    """Reject a Parquet file early if pyarrow is missing.

    :raises ParameterError: pyarrow is missing.
    """
    if path.suffix == ".parquet" and importlib.util.find_spec("pyarrow") is None:
        raise ParameterError(str(path), "Parquet", "CSV; Parquet needs the Python package pyarrow")


def check_target(path: Path) -> None:
    """Reject a table's name that cannot be written, before the computation.

    :raises ParameterError: the ending is none of :data:`WRITABLE_SUFFIXES`, or pyarrow is missing for it.
    """
    if path.suffix not in WRITABLE_SUFFIXES and str(path) != STANDARD:
        raise ParameterError("out", str(path), f"a name that ends in {' or '.join(WRITABLE_SUFFIXES)}")
    require_pyarrow(path)


def write_table(columns: Mapping[str, Array], path: Path) -> None:
    """Write CSV, or where the name ends so Parquet (needs pyarrow) or a MATLAB file.

    The file appears only once it is complete. In MATLAB a name's points and spaces are underscores.

    :raises ParameterError: another ending, or pyarrow is missing.
    """
    check_target(path)
    if path.suffix == ".mat":
        from scipy.io import savemat  # type: ignore[import-untyped]

        named = {re.sub(r"^(?=[\d_])", "x", re.sub(r"\W", "_", name)): v for name, v in columns.items()}
        if len(named) < len(columns):
            raise ParameterError("out", str(path), "CSV: names of columns are the same in MATLAB")
    with write_atomically(path) as hidden:
        if path.suffix == ".parquet":
            import pyarrow
            from pyarrow import parquet

            parquet.write_table(pyarrow.table(dict(columns)), hidden)
        elif path.suffix == ".mat":
            with hidden.open("wb") as file:
                savemat(file, named, oned_as="column")
        else:
            with hidden.open("w", newline="", encoding="utf-8") as text:
                csv.writer(text).writerow(columns)
                size = len(next(iter(columns.values())))
                for begin in range(0, size, ROWS_PER_BLOCK):
                    cells = []
                    for values in columns.values():
                        numbers = np.asarray(values[begin : begin + ROWS_PER_BLOCK], np.float64)
                        # An undetermined reaction is an empty cell; repr keeps every digit.
                        cells.append(["" if value != value else repr(value) for value in numbers.tolist()])
                    text.writelines([f"{','.join(row)}\r\n" for row in zip(*cells, strict=True)])
