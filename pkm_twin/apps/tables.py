# SPDX-License-Identifier: Apache-2.0
"""Tables as other programs write them: separator, decimal comma, names and units of columns.

What a file's header row makes certain is found by itself, and reported; the rest is options.
"""

from __future__ import annotations

import csv
import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Annotated, Final

import numpy as np
import typer
from numpy.typing import NDArray

from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.options import OptionalText, shared_options
from pkm_twin.robot.robot import Robot

Array = NDArray[np.float64]

SEPARATORS: Final = {",": ",", ";": ";", "tab": "\t", "\t": "\t"}
UNITS: Final = {
    "rad": ("angle", 1.0), "deg": ("angle", math.pi / 180.0), "m": ("length", 1.0),
    "mm": ("length", 1e-3), "s": ("time", 1.0), "ms": ("time", 1e-3), "us": ("time", 1e-6),
}  # fmt: skip
"""Units of a table: what they are of, and their size in SI."""
RATES: Final = ("position", "velocity", "acceleration")


@dataclass(frozen=True)
class Dialect:
    """How a table is written; None: as its header row says.

    ``columns``: the table's name by ours. ``units``: size in SI of its angles, lengths and times;
    velocities and accelerations are per second all the same.
    """

    separator: str | None = None
    decimal: str | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, float] = field(default_factory=dict)


PLAIN: Final = Dialect()
CHOSEN: ContextVar[Dialect] = ContextVar("dialect", default=PLAIN)
"""The dialect of the command that runs."""


def cells(lines: Iterator[str], told: Callable[[str], None]) -> Iterator[list[str]]:
    """Rows of a table with decimal points and our names in its header row.

    :param told: called with what was found by itself.
    """
    dialect = CHOSEN.get()
    first = next(lines, "")
    separator = dialect.separator
    if separator is None:
        # Names hold no separators: one that is there, and no other, is certain.
        there = [mark for mark in (";", "\t") if mark in first]
        separator = there[0] if len(there) == 1 and "," not in first else ","
        if separator != ",":
            told(f"columns are separated by {'tabs' if separator == chr(9) else ';'}")
    rows = csv.reader(itertools.chain([first], lines), delimiter=separator)
    header = [name.strip() for name in next(rows, [])]
    ours = {theirs: name for name, theirs in dialect.columns.items()}
    yield [ours.get(name, name) for name in header]
    comma = dialect.decimal == ","
    for row in rows:
        if dialect.decimal is None and separator != "," and not comma:
            comma = any("," in cell for cell in row)
            if comma:
                told("numbers have a decimal comma")
        yield [cell.replace(",", ".") for cell in row] if comma else row


def in_si(columns: Mapping[str, Array], robot: Robot | None) -> dict[str, Array]:
    """Columns of time, joints and pose in SI units.

    :raises ParameterError: units of joints in a table of no robot.
    """
    units = CHOSEN.get().units
    result = dict(columns)
    if not units:
        return result
    if robot is None:
        raise ParameterError("units", ", ".join(units), "none for this table")
    kinds = {"time": "time"}
    of_joints = zip(robot.joint_names, robot.joint_units, strict=True)
    of_pose = zip(robot.pose_names, robot.pose_units, strict=True)
    for name, unit in (*of_joints, *of_pose):
        kinds |= dict.fromkeys((f"{name}.{what}" for what in RATES), UNITS[unit][0])
    for name, unit in zip(robot.pose_names, robot.pose_units, strict=True):
        kinds[name] = UNITS[unit][0]
    for name, kind in kinds.items():
        if name in result and kind in units:
            result[name] = result[name] * units[kind]
    return result


def dialect_of(
    separator: str | None, decimal: str | None, columns: str | None, units: str | None,
    time: str | None,
) -> Dialect:  # fmt: skip
    """The dialect of a command line.

    :raises ParameterError: an option that is none.
    """
    if separator is not None and separator not in SEPARATORS:
        raise ParameterError("--separator", separator, "one of , ; tab")
    if decimal is not None and decimal not in (".", ","):
        raise ParameterError("--decimal", decimal, ". or ,")
    names: dict[str, str] = {}
    for pair in (columns or "").split(",") if columns else []:
        ours, sign, theirs = pair.partition("=")
        if not (ours.strip() and sign and theirs.strip()):
            raise ParameterError("--columns", pair, "NAME=COLUMN, several with commas between")
        names[ours.strip()] = theirs.strip()
    if time is not None:
        if not time.strip() or names.get("time", time.strip()) != time.strip():
            raise ParameterError("--time", time, "one column's name")
        names["time"] = time.strip()
    sizes: dict[str, float] = {}
    for word in (units or "").split(",") if units else []:
        if word.strip() not in UNITS:
            raise UnknownNameError("--units", word.strip(), tuple(UNITS))
        kind, size = UNITS[word.strip()]
        if kind in sizes:
            raise ParameterError("--units", units, f"one unit of {kind}")
        sizes[kind] = size
    mark = None if separator is None else SEPARATORS[separator]
    return Dialect(mark, decimal, names, sizes)


def _options(
    separator: Annotated[
        OptionalText, typer.Option(help="of a table's columns: , ; or tab; default: found")
    ] = None,
    decimal: Annotated[OptionalText, typer.Option(help="of a table's numbers: . or ,")] = None,
    columns: Annotated[
        OptionalText,
        typer.Option(help="names of a table's columns, OURS=THEIRS,...: time=t,arm_1.position=q1"),
    ] = None,
    units: Annotated[
        OptionalText, typer.Option(help="of a table: of rad, deg, m, mm, s, ms, us; default SI")
    ] = None,
    time: Annotated[OptionalText, typer.Option(help="name of a table's column of times")] = None,
) -> None:
    del separator, decimal, columns, units, time


tables = shared_options(_options, CHOSEN, dialect_of)
"""Gives a command that reads tables the options of their dialect."""
