# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Rows of a paper: one per numbered equation, table and figure."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal

Kind = Literal["equation", "table", "figure"]
KINDS: Final[tuple[Kind, ...]] = ("equation", "table", "figure")


@dataclass(frozen=True)
class Printed:
    """A number as a paper prints it, and the value of this package in the printed unit."""

    text: str
    value: float

    @property
    def last_digit(self) -> float:
        """One unit of the last printed digit: 0.001 of "0.254", 1e-6 of "1.39e-4"."""
        digits, _, exponent = self.text.partition("e")
        return 10.0 ** (int(exponent or 0) - len(digits.partition(".")[2]))

    @property
    def difference(self) -> float:
        """Computed minus printed value, in units of the last printed digit."""
        return (self.value - float(self.text)) / self.last_digit


@dataclass(frozen=True)
class Comparison:
    """A printed table: ``numbers`` holds one line of numbers for each name of ``lines``."""

    title: str
    columns: tuple[str, ...]
    lines: Mapping[str, Sequence[Printed]]

    @property
    def largest(self) -> float:
        """Largest difference, in units of the last printed digit."""
        return max(abs(number.difference) for line in self.lines.values() for number in line)


@dataclass(frozen=True)
class Row:
    """One numbered item of a paper, or several that one function computes.

    ``functions``: dotted names ("pkm_twin.mechanisms.prru.Prru.make_parts"). ``tests``: a file and
    a function ("test/validation/test_prru_paper.py::test_position"). ``note``: what differs from
    print, or why the item is not computed. ``pictures``: files of docs/gallery that redraw a
    figure. ``drawn_by``: the line of ``pkm-twin`` that draws them, by the name that their files
    begin with; or a function that writes the file of this name.
    """

    kind: Kind
    numbers: tuple[int, ...]
    content: str
    functions: tuple[str, ...] = ()
    tests: tuple[str, ...] = ()
    note: str = ""
    comparisons: tuple[Comparison, ...] = ()
    pictures: tuple[str, ...] = ()
    drawn_by: Mapping[str, str | Callable[[Path], None]] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """The numbers in words: "26 to 31", "17, 28"."""
        runs: list[list[int]] = []
        for number in self.numbers:
            if runs and number == runs[-1][-1] + 1:
                runs[-1].append(number)
            else:
                runs.append([number])
        texts = [f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(map(str, run)) for run in runs]
        return ", ".join(texts)


@dataclass(frozen=True)
class Paper:
    """A paper: ``counts`` of its numbered items, and ``summary``, lines for the page's top."""

    name: str
    title: str
    counts: Mapping[Kind, int]
    summary: tuple[str, ...]
    rows: tuple[Row, ...]


def heading_anchor(title: str) -> str:
    """Return the anchor that MkDocs gives to a heading."""
    return re.sub(r"[^\w]+", "-", title.lower()).strip("-")
