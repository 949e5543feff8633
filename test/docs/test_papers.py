# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""docs/papers.md: every item of the papers has a row, and every row's functions and tests exist."""

from __future__ import annotations

import ast
import inspect
import re
from functools import cache
from pathlib import Path

import pytest

from test.support.pages import assert_printed
from tools.papers.page import MODULES, find_function, write_page

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def papers():
    return tuple(module.find_rows() for module in MODULES)


@cache
def find_tests(path):
    """Return the names of the test functions of a file."""
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_functions_and_tests_of_each_row_exist(papers):
    for row in (row for paper in papers for row in paper.rows):
        assert row.tests or row.note, f"{row.kind} {row.label} has neither a test nor a reason"
        for name in row.functions:
            assert find_function(name)
        for path, _, name in (test.partition("::") for test in row.tests):
            assert name in find_tests(path), (path, name)
        for file in row.pictures:
            assert (ROOT / "docs/gallery" / file).stat().st_size


def test_every_item_has_a_row(papers):
    for paper in papers:
        for kind, count in paper.counts.items():
            found = [n for row in paper.rows if row.kind == kind for n in row.numbers]
            assert sorted(found) == list(range(1, count + 1)), (paper.name, kind)


def numbers_of(function):
    """Return the equation numbers in the source of a function, and of its class or module's top."""
    try:
        source = inspect.getsource(inspect.unwrap(getattr(function, "fget", function)))
    except TypeError:
        return set()
    text = " ".join(source.split())
    found = set()
    for words in re.findall(r"equations? ((?:\d+(?:, and |, | to | and )?)+)", text):
        for first, last in re.findall(r"(\d+)(?: to (\d+))?", words):
            found |= set(range(int(first), int(last or first) + 1))
    return found | {int(n) for n in re.findall(r"\((\d+)(?= and \d+\)|\))", text)}


def test_a_computed_equation_has_its_number_in_the_source(papers):
    for paper in papers:
        for row in paper.rows:
            if row.kind == "equation" and row.functions:
                stated = set().union(*(numbers_of(find_function(f)) for f in row.functions))
                assert set(row.numbers) <= stated, (paper.name, row.label, sorted(stated))


def test_the_page_is_todays(papers):
    """Else `make papers` writes it."""
    assert (ROOT / "docs/papers.md").read_text(encoding="utf-8") == write_page(papers)


def test_other_pages_have_its_numbers(papers):
    found = {one.title: one for p in papers for row in p.rows for one in row.comparisons}
    page, theory = "docs/validation.md", found["2UPR-RPU, table 1, theory"].largest
    assert_printed(page, r"table 1 within (\d+) units", theory)
    assert_printed("README.md", r"deflections within (\d+) units", theory)
    lines = found["2UPR-RPU, table 2, mean over the volume"].lines
    most = max(abs(n.value - float(n.text)) for name in ("P2", "P3") for n in lines[name])
    assert_printed(page, r"P2 and P3 within ([\d.]+),", most)
