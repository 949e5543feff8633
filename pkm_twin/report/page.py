# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write a report as one HTML page without external files."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from typing import Final

from pkm_twin.report import plots
from pkm_twin.report.report import Report, Table

PAGE_TEMPLATE: Final = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>{title}</title>
<style>
body {{ font: 15px/1.5 sans-serif; margin: 2em auto; max-width: 70em; padding: 0 1em; }}
table {{ border-collapse: collapse; margin: 1em 0; }}
td, th {{ border-bottom: 1px solid #ccc; padding: 0.2em 0.8em; text-align: right; }}
td:first-child, th:first-child {{ text-align: left; }}
img {{ max-width: 100%; }}
.plot {{ height: min(40em, 85vw); margin: 1em 0; }}
</style>
</head>
<body>
<h1>{title}</h1>
{body}
</body>
</html>
"""


def page(title: str, report: Report, more: Sequence[Table] = (), figures: Sequence[str] = ()) -> str:
    """Return the whole page as HTML.

    :param more: tables that the terminal does not show.
    :param figures: interactive figures as HTML.
    """
    notes = "".join(f"<li>{html.escape(note)}</li>" for note in report.notes)
    parts = [f"<p>{html.escape(report.answer)}</p>", f"<ul>{notes}</ul>"]
    for fact in report.facts:
        if fact.text is not None:
            parts.append(f"<p>{html.escape(f'{fact.text}: {fact.formatted}')}</p>")
    parts += [f'<div class="plot">{figure}</div>' for figure in figures]
    parts += [_write_table(table) for table in (*report.tables, *more) if table.rows]
    for draw in report.figures.values():
        data = base64.b64encode(plots.render(draw(), 100)).decode()
        parts.append(f'<img alt="" src="data:image/png;base64,{data}">')
    return PAGE_TEMPLATE.format(title=html.escape(title), body="\n".join(parts))


def _write_table(table: Table) -> str:
    head, *rows = table.cells
    lines = [_write_row("th", head), *(_write_row("td", row) for row in rows)]
    return f"<h2>{html.escape(table.title)}</h2>\n<table>{''.join(lines)}</table>"


def _write_row(tag: str, cells: Sequence[str]) -> str:
    return f"<tr>{''.join(f'<{tag}>{html.escape(cell)}</{tag}>' for cell in cells)}</tr>"
