# SPDX-License-Identifier: Apache-2.0
"""Tables of numbers: CSV files with a header row."""

from __future__ import annotations

import array
import csv
import io
import math
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from pkm_twin.apps.limits import beyond_limits
from pkm_twin.apps.tables import CHOSEN, UNITS, cells, in_si
from pkm_twin.errors import FileError, ParameterError, warn
from pkm_twin.files import STANDARD, decimal, open_regular
from pkm_twin.robot.robot import Robot

Array = NDArray[np.float64]
MAX_CSV_BYTES = 1024**3
"""Largest CSV that is read: some millions of samples."""
LONGEST_STEP = 0.2
"""Between two samples of a motion, s, from which on the times look like milliseconds."""
SHORTEST_STEP = 1e-9
"""Between two times, s: what a bag's stamps resolve."""
LONGEST = 1e6
"""From the first time to the last, s; of a trajectory it is the same."""
SOME = 500
"""Samples of a motion by which its units are judged."""
MAX_CSV_LINE = 1024**2
"""Longest line of it, characters."""


def read_columns(
    path: Path, robot: Robot | None = None, *, blank: bool = False
) -> dict[str, Array]:
    """Columns of a CSV with a header row, by name, shape (rows,) each, in SI units.

    A column without any number is left out: `torques` writes such reactions.

    :param path: ``-`` is stdin. ``robot``: whose joints and pose the columns may be of. ``blank``:
        whether cells may be empty, which are NaN.

    Lines above the header that begin with # are comments.

    :raises ParameterError: not readable, too large, or a value is no finite number.
    """
    try:
        if str(path) == STANDARD:
            with io.TextIOWrapper(sys.stdin.buffer, encoding="utf-8-sig", newline="") as text:
                return in_si(_parse_columns(path, _rows(text, path), blank), robot)
        with open_regular(path) as file:
            size = os.fstat(file.fileno()).st_size
            if size > MAX_CSV_BYTES:
                raise ParameterError(str(path), f"{size} bytes", f"at most {MAX_CSV_BYTES}")
            # Spreadsheets put a byte order mark before the header row.
            with io.TextIOWrapper(file, encoding="utf-8-sig", newline="") as text:
                return in_si(_parse_columns(path, _rows(text, path), blank), robot)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(path, error, "a CSV file") from None


def times_of(path: Path, values: Array) -> Array:
    """A column of times from its first on, s.

    :raises ParameterError: they do not rise, or farther than a recording lasts.
    """
    # Between the greatest numbers there is none.
    with np.errstate(over="ignore"):
        time: Array = np.asarray(values - values[0], np.float64)
        rising = bool((np.diff(values) >= SHORTEST_STEP).all())
    if not rising or not time[-1] <= LONGEST:
        raise ParameterError(
            f"{path}: time",
            f"{values[0]:g} to {values[-1]:g}" if rising else "not rising",
            f"rising times, {SHORTEST_STEP:g} s or more apart, up to {LONGEST:g} s in all",
        )
    return time


def check_units(path: Path, robot: Robot, time: Array, q: Array, qd: Array | None) -> None:
    """Units of a motion: the steps of its times are short, its velocities those of its positions.

    Positions that may be in degrees give a warning.

    :param time: shape (samples,); q and qd, shape (samples, n), qd where the file tells it.
    :raises ParameterError: velocities are a thousand times those of the positions.
    """
    if _in_degrees(robot, q):
        most = float(np.abs(q).max())
        warn(path, f"positions up to {most:.4g}; expected rad; are these degrees? --units deg")
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if qd is not None and len(time) > 2:
        with np.errstate(all="ignore"):
            moved = float(np.sqrt(np.mean(np.gradient(q, time, axis=0) ** 2)))
            told = float(np.sqrt(np.mean(qd**2)))
        if moved > 0.0 and 300.0 < told / moved < 3000.0:
            raise ParameterError(
                f"{path}: time", f"steps of {step:g} s",
                f"seconds: velocities are {told / moved:.4g} times those of the positions, as with "
                "times in milliseconds",
            )  # fmt: skip
    if step > LONGEST_STEP:
        warn(path, f"time: steps of {step:g} s; expected seconds; are these milliseconds?")


def _in_degrees(robot: Robot, q: Array) -> bool:
    """Whether most joint states are none of the robot, and all are if they are in degrees.

    What is beyond a limit by a little is in rad: most have a joint more than half a turn from zero.
    """
    turns = np.array([unit == "rad" for unit in robot.joint_units])
    if "angle" in CHOSEN.get().units or not turns.any():
        return False
    some = q[:: max(1, len(q) // SOME)]

    def possible(states: Array) -> NDArray[np.bool_]:
        outside, _ = beyond_limits(robot, states)
        return np.asarray(robot.try_forward(states)[1] & ~outside, np.bool_)

    far = np.abs(some[:, turns]).max(1) > np.pi
    if np.mean(far & ~possible(some)) <= 0.5:
        return False
    return bool(possible(np.where(turns, some * UNITS["deg"][1], some)).all())


def _rows(text: TextIO, path: Path) -> Iterator[list[str]]:
    return cells(_lines(text, path), lambda found: warn(path, found))


def _lines(text: TextIO, path: Path) -> Iterator[str]:
    """The lines of a file, none so long that a row takes all the memory."""
    while line := text.readline(MAX_CSV_LINE):
        if len(line) == MAX_CSV_LINE:
            raise ParameterError(
                f"{path}: a line", f"{line[:40]}...", f"at most {MAX_CSV_LINE} characters"
            )
        yield line


def _number(cell: str) -> float:
    """A cell's number; NaN of an empty one.

    :raises ValueError: no finite number.
    """
    if not cell.strip():
        return math.nan
    value = decimal(cell)
    if not math.isfinite(value):
        raise ValueError(f"{cell!r} is not finite")
    return value


def _parse_columns(path: Path, rows: Iterator[list[str]], blank: bool) -> dict[str, Array]:
    first, above = next(rows, []), 0
    while first and first[0].startswith("#"):
        first, above = next(rows, []), above + 1
    header = [name.strip() for name in first]
    if len(set(header)) != len(header):
        raise ParameterError(f"{path}: header row", ", ".join(header), "different names")
    data = array.array("d")
    number = 1 + above
    for number, row in enumerate(rows, 2 + above):
        if len(row) != len(header):
            raise ParameterError(f"{path}: line {number}", len(row), f"{len(header)} values")
        for name, cell in zip(header, row, strict=True):
            try:
                data.append(_number(cell))
            except ValueError:
                where = f"{path}: line {number}, column {name}"
                raise ParameterError(where, cell, "a finite number") from None
    if not data:
        raise ParameterError(str(path), f"{number if header else 0} lines", "a header row and rows")
    table = np.frombuffer(data, np.float64).reshape(-1, len(header))
    columns = dict(zip(header, np.ascontiguousarray(table.T), strict=True))
    if blank:
        return columns
    for name, values in list(columns.items()):
        empty = np.isnan(values)
        if empty.all():
            del columns[name]
        elif empty.any():
            where = f"{path}: line {2 + above + int(empty.argmax())}, column {name}"
            raise ParameterError(where, "empty", "a finite number")
    return columns
