# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The catalogue of faults: what may go wrong, what then happens, and which tests show it."""

from __future__ import annotations

import ast
import functools
import re
from dataclasses import dataclass
from pathlib import Path

import yaml

TESTS = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Row:
    """One fault; ``tests`` are paths from test/ with the test's name behind ``::``."""

    table: str
    number: int
    fault: str
    answer: str
    tests: tuple[str, ...]


def rows() -> list[Row]:
    """All faults, in the order of the page."""
    tables = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))
    return [
        Row(table, number, fault, answer, tuple(tests.split()))
        for table, faults in tables.items()
        for number, (fault, answer, tests) in faults.items()
    ]


def line(row: Row) -> str:
    """A row on the page, without what stands in parentheses."""
    return re.sub(r" \([^()]*\)(?!`)", "", f"* {row.fault}: {row.answer}")


@functools.cache
def names_in(path: Path) -> set[str]:
    """Names of a file's tests as pytest has them, without its collecting them."""
    found = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}::{n.name}" for n in node.body if isinstance(n, ast.FunctionDef)}
        elif isinstance(node, ast.FunctionDef):
            found.add(node.name)
    return found
