# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write docs/papers.md from the rows of the papers' modules."""

from __future__ import annotations

import importlib
import inspect
from pathlib import Path
from typing import Any, Final

from tools.papers import delta_cu, prru, upr_rpu
from tools.papers.rows import KINDS, Comparison, Paper, Printed, Row, heading_anchor

ROOT: Final = Path(__file__).resolve().parents[2]
MODULES: Final = (delta_cu, prru, upr_rpu)
"""Each has ``find_rows``, which computes the paper's values and returns a ``Paper``."""
HEAD: Final = """# The three papers, compared

`make papers` writes this page. Each item has its content, what differs from print, and links to the
source, in which the equation's number stands, and to the test. Tables of numbers have the printed and
the computed value in each cell; a unit is one of the last printed digit.

"""


def find_function(name: str) -> Any:
    """Return the function, method or class of a dotted name.

    :raises AttributeError: the module has no such name.
    """
    parts = name.split(".")
    for split in range(len(parts) - 1, 0, -1):
        try:
            found: Any = importlib.import_module(".".join(parts[:split]))
        except ModuleNotFoundError:
            continue
        for part in parts[split:]:
            found = getattr(found, part)
        return found
    raise AttributeError(name)


def write_page(papers: tuple[Paper, ...]) -> str:
    """Return the page's text."""
    text = HEAD + "".join(f"- {line}\n" for paper in papers for line in paper.summary)
    return text + "".join(map(_write_paper, papers))


def _write_paper(paper: Paper) -> str:
    parts = [f"\n## {paper.title}\n"]
    for kind in KINDS:
        rows = [row for row in paper.rows if row.kind == kind]
        if not rows:
            continue
        parts.append(f"\n**{kind.capitalize()}s**\n\n")
        parts += map(_write_row, rows)
        for row in rows:
            parts += [_write_comparison(one) for one in row.comparisons]
            parts += [f"\n![{kind} {row.label}](gallery/{file})\n" for file in row.pictures]
    return "".join(parts)


def _write_row(row: Row) -> str:
    content = "; ".join(filter(None, (row.content, row.note, *map(_link_comparison, row.comparisons))))
    links = (*map(_link_function, row.functions), *map(_link_test, row.tests))
    return f"* {row.label}: {'<br>'.join((content, *links))}\n"


def _link_function(name: str) -> str:
    found = inspect.unwrap(find_function(name))
    if isinstance(found, property):
        found = found.fget
    source = Path(inspect.getsourcefile(found) or "").resolve().relative_to(ROOT)
    short = name.removeprefix(source.with_suffix("").as_posix().replace("/", ".") + ".")
    return f"[`{short.rpartition('.')[2] if short == name else short}`](../{source})"


def _link_test(name: str) -> str:
    path, _, function = name.partition("::")
    return f"[`{function}`](../{path})"


def _link_comparison(one: Comparison) -> str:
    anchor = heading_anchor(one.title)
    return f"[{one.title.rpartition(', ')[2]}](#{anchor}): within {one.largest:.0f} units"


def _write_comparison(one: Comparison) -> str:
    """Write the printed numbers and this package's as one table."""
    parts = [f"\n### {one.title}\n\n", f"| | {' | '.join(one.columns)} |\n"]
    parts.append("|---" * (1 + len(one.columns)) + "|\n")
    for name, numbers in one.lines.items():
        cells = " | ".join(f"{number.text}, {_write_value(number)}" for number in numbers)
        parts.append(f"| {name} | {cells} |\n")
    return "".join(parts)


def _write_value(number: Printed) -> str:
    """Write this package's value with one digit more than is printed."""
    digits, letter, exponent = number.text.partition("e")
    decimals = len(digits.partition(".")[2]) + 1
    scaled = number.value / 10.0 ** int(exponent or 0)
    return f"{scaled:.{decimals}f}{letter}{exponent}"
