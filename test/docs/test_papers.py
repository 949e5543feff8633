# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""docs/papers.md: every item of the papers has a row, and every row's functions and tests exist."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest

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


def test_functions_and_find_tests_each_row_exist(papers):
    for row in (row for paper in papers for row in paper.rows):
        assert row.tests or row.note, f"{row.kind} {row.label} has neither a test nor a reason"
        for name in row.functions:
            assert find_function(name)
        for path, _, name in (test.partition("::") for test in row.tests):
            assert name in find_tests(path), (path, name)
        for file in row.pictures:
            assert (ROOT / "docs/gallery" / file).stat().st_size


def test_the_page_is_todays(papers):
    """Else `make papers` writes it."""
    assert (ROOT / "docs/papers.md").read_text(encoding="utf-8") == write_page(papers)
