# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Print a report as text: the answer first, then facts, tables, notes and files."""

from __future__ import annotations

import itertools
import re
import textwrap
from collections.abc import Iterator, Sequence
from typing import Final

import click

from pkm_twin.console import print_json, print_message
from pkm_twin.files import STANDARD
from pkm_twin.report.report import Fact, Report, Table, Verdict

WIDTH: Final = 100
"""Widest table, characters."""
NO_BREAK_SPACE: Final = "\u00a0"
COLOURS: Final = {Verdict.GOOD: "green", Verdict.BAD: "red", Verdict.UNKNOWN: "yellow"}


def present(report: Report, as_json: bool, *, piped: bool = False) -> None:
    """Print a report.

    :param piped: print to stderr, as stdout carries the file that the command writes.
    """
    if as_json:
        print_json(report.data, err=piped)
    elif report.raw:
        click.echo(report.raw, nl=False)
    else:
        text = format_report(report)
        if text:
            click.echo(text, err=piped)
    if report.error:
        print_message(report.error)


def format_report(report: Report) -> str:
    """Return the report as the text that the terminal shows."""
    found = [report.answer] if report.answer else []
    for fact in report.facts:
        if fact.text is not None and fact.verdict is None:
            found.append(f"{fact.text}: {fact.formatted}" if fact.text else fact.formatted)
    if judged := [fact for fact in report.facts if fact.verdict is not None]:
        found += ["", *_layout_judged(judged)] if found else _layout_judged(judged)
    for table in report.tables:
        found += ["", *table_lines(table)] if found else table_lines(table)
    written = [str(path) for path in report.files.values() if path is not None]
    last = [*report.notes, *(path for path in written if path != STANDARD)]
    if report.tables and last:
        found.append("")
    found += last
    return "\n".join(found)


def _layout_judged(facts: Sequence[Fact]) -> Iterator[str]:
    # A verdict stays on its row's first line, where it is coloured.
    words = [fact.verdict.words.replace(" ", NO_BREAK_SPACE) if fact.verdict else "" for fact in facts]
    rows = [
        (f.text or f.name, f.formatted, "" if f.bound is None else str(f.bound), word)
        for f, word in zip(facts, words, strict=True)
    ]
    lines = align_rows([("", "value", "limit", "verdict"), *rows], "<<<<")
    yield next(lines)
    for fact, word, line in zip(facts, words, lines, strict=True):
        first, *rest = line.split("\n")
        shown = click.style(word.replace(NO_BREAK_SPACE, " "), fg=COLOURS[fact.verdict or Verdict.UNKNOWN])
        yield "\n".join([first[: -len(word)] + shown, *rest])


def table_lines(table: Table) -> list[str]:
    """Return a table's title, headings and rows; numeric columns are aligned right."""
    head, *rows = table.cells
    shown = [k for k, column in enumerate(table.columns) if column.text is not None]
    words = [any(isinstance(row[k], str) for row in table.rows.values()) for k in shown]
    sides = "<" + "".join("<" if word else ">" for word in words)
    titled = [table.title] if table.title else []
    lines = align_rows([head, *rows] if any(cell.strip() for cell in head) else rows, sides)
    return [*titled, *lines]


def align_rows(rows: Sequence[Sequence[str]], sides: str) -> Iterator[str]:
    """Align rows in columns; ``sides`` has < (left) or > (right) for each column.

    The first row is the headings. In a table wider than :data:`WIDTH` headings are wrapped, and if
    that is not enough other cells, too. A table of two columns is not wrapped.
    """
    if not any(row[0] for row in rows):
        rows, sides = [row[1:] for row in rows], sides[1:]
    # Text in brackets (a unit) is not broken. A blank cell has no width to wrap to.
    rows = [
        [re.sub(r"\([^)]*\)", lambda unit: unit[0].replace(" ", NO_BREAK_SPACE), c) if c.strip() else "" for c in row]
        for row in rows
    ]
    columns = list(zip(*rows, strict=True))
    widths = [max(map(len, column)) for column in columns]
    words = [[max(map(len, cell.split(" "))) for cell in column] for column in columns]
    headings = [max([own[0], *map(len, c[1:])]) for own, c in zip(words, columns, strict=True)]
    for least in (headings, list(map(max, words))):
        while len(widths) > 2 and sum(widths) + 2 * (len(widths) - 1) > WIDTH:
            spare = [width if width > low else 0 for width, low in zip(widths, least, strict=True)]
            if not any(spare):
                break
            widths[spare.index(max(spare))] -= 1
    for row in rows:
        pairs = zip(row, widths, strict=True)
        cells = [[c] if len(c) <= w else textwrap.wrap(c, w) for c, w in pairs]
        lines = itertools.zip_longest(*cells, fillvalue="")
        yield "\n".join(
            "  ".join(f"{c:{s}{w}}" for c, s, w in zip(line, sides, widths, strict=True)).rstrip() for line in lines
        ).replace(NO_BREAK_SPACE, " ")
