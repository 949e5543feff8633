# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Parse what a design may change: numbers of the file, alone or coupled, between bounds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.machine.formulas import PARAMETERS
from pkm_twin.machine.uncertainty import Tolerance
from pkm_twin.robot.robot import Robot


@dataclass(frozen=True, eq=False)
class Variables:
    """Map variables (d), scaled to 0 to 1, to the numbers (p) of the file.

    ``own``: the file's values, shape (p,). ``slopes``: derivatives of numbers by variables, shape
    (p, d). ``low``, ``high``: of the first number of each, shape (d,). ``start``: variables of the
    file, (d,).
    """

    names: tuple[str, ...]
    paths: tuple[str, ...]
    own: Array
    slopes: Array
    low: Array
    high: Array
    start: Array

    def __len__(self) -> int:
        return len(self.names)

    @classmethod
    def of(cls, robot: Robot, vary: Mapping[str, tuple[float, float]]) -> Variables:
        """Return the variables of names (see :func:`pkm_twin.design.search.design`) and bounds.

        :raises ParameterError: an unknown path, one that is given twice, or bounds that
            are none.
        """
        if not vary:
            raise ParameterError("vary", None, "at least one PATH=LOW:HIGH")
        paths: dict[str, tuple[int, float]] = {}
        names, lows, highs, starts = [], [], [], []
        for column, (text, (low, high)) in enumerate(vary.items()):
            parts = [part.strip() for part in text.split(",")]
            for part in parts:
                path = part.removeprefix("-").strip()
                if path in paths:
                    raise ParameterError("vary", path, "each number once")
                paths[path] = column, -1.0 if part.startswith("-") else 1.0
            if parts[0].startswith("-"):
                raise ParameterError("vary", text, "a first path without a -")
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise ParameterError(f"vary {text}", f"{low:g}:{high:g}", "LOW:HIGH, low first")
            for name in robot.book.unused:
                if f"{PARAMETERS}.{name}" in paths:
                    bound = "a parameter that a number of the file depends on"
                    raise ParameterError("vary", f"{PARAMETERS}.{name}", bound)
            own_value = abs(robot.number(parts[0]))
            unit = robot.file_numbers().get(parts[0], (0.0, ""))[1]
            # The search resolves a millionth of the range: a wider one loses the value.
            widest = 1e4 * max(own_value, robot.graph.size if unit == "m" else 1.0)
            if not high - low <= widest:
                raise ParameterError(
                    f"vary {text}",
                    f"{low:g}:{high:g}",
                    f"a range of at most {widest:.3g} {unit}; the file has {robot.number(parts[0]):g}",
                )
            names.append(parts[0])
            lows.append(low)
            highs.append(high)
            starts.append(robot.number(parts[0]))
        own = np.array([robot.number(path) for path in paths])
        least, greatest = np.array(lows), np.array(highs)
        slopes = np.zeros((len(paths), len(names)))
        for row, (column, side) in enumerate(paths.values()):
            slopes[row, column] = side * (greatest - least)[column]
        return cls(
            tuple(names),
            tuple(paths),
            own,
            slopes,
            least,
            greatest,
            (np.array(starts) - least) / (greatest - least),
        )

    def values(self, y: Array) -> Array:
        """Return the numbers of the file for points (k, d), shape (k, p)."""
        return np.asarray(self.own + (y - self.start) @ self.slopes.T)

    def values_by_name(self, y: Array) -> list[float]:
        """Return the values of the variables at a point (d,)."""
        return [float(v) for v in self.low + y * (self.high - self.low)]


def parse_vary(texts: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Parse ``PATH=LOW:HIGH`` texts to bounds by name.

    :raises ParameterError: another form.
    """
    found = _parse_numbers("vary", texts, "PATH=LOW:HIGH, each path once", 2)
    return {name: (low, high) for name, (low, high) in found.items()}


def parse_tolerances(texts: Sequence[str]) -> dict[str, Tolerance]:
    """Parse ``PATH=SIGMA`` (standard deviation) and ``PATH=+-BOUND`` texts, by path.

    :raises ParameterError: another form, or a path that is given twice.
    """
    form = "PATH=SIGMA or PATH=+-BOUND, each path once, 0 or more"
    plain = _parse_numbers("tolerance", [text.replace("=+-", "=") for text in texts], form, 1)
    found = {}
    for text, (name, (value,)) in zip(texts, plain.items(), strict=True):
        if not 0.0 <= value < math.inf:
            raise ParameterError("tolerance", f"{name}={value:g}", form)
        found[name] = Tolerance(bound=value) if "=+-" in text else Tolerance(deviation=value)
    return found


def _parse_numbers(field: str, texts: Sequence[str], form: str, count: int) -> dict[str, list[float]]:
    """Parse texts ``NAME=NUMBERS``, numbers separated by colons, by name."""
    found: dict[str, list[float]] = {}
    for text in texts:
        name, _, words = text.rpartition("=")
        try:
            values = list(map(float, words.split(":")))
        except ValueError:
            values = []
        if "=" in name:
            raise ParameterError(field, text, f"one of {form}; repeat --{field} for another")
        if not name or name in found or len(values) != count:
            raise ParameterError(field, text, form)
        found[name] = values
    return found
