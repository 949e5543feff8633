# SPDX-License-Identifier: Apache-2.0
"""A judged property: what the commands that judge bags and live topics have in common."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from rich.table import Table
from rich.text import Text

from pkm_twin.report import Verdict as Verdict


@dataclass(frozen=True)
class Item:
    """One judged property: its value against its bound, in words."""

    what: str
    value: str
    bound: str
    verdict: Verdict


def judged_item(what: str, value: str, bound: str, good: bool) -> Item:
    """A property that is good or bad."""
    return Item(what, value, bound, Verdict.GOOD if good else Verdict.BAD)


def items_table(title: str, bound: str, items: Iterable[Item]) -> Table:
    """Judged properties as a table; ``bound`` is the heading of their bounds."""
    table = Table(title=Text(title))
    for column in ("what", "value", bound, "verdict"):
        table.add_column(column)
    colours = {Verdict.GOOD: "green", Verdict.BAD: "red", Verdict.UNKNOWN: "yellow"}
    for item in items:
        verdict = Text(item.verdict, style=colours[item.verdict])
        table.add_row(item.what, Text(item.value), Text(item.bound), verdict)
    return table
