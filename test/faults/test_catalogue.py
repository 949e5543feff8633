# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Every fault has its tests, and the page on faults is that of the catalogue."""

import re

import pytest

from test.faults.catalogue import TESTS, line, names_in, rows
from test.support.pages import FAULTS, read_section, write_section

ROWS = rows()


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.number)
def test_a_row_names_tests_that_are_there(row):
    assert row.fault and row.answer and row.tests
    for test in row.tests:
        file, _, name = test.partition("::")
        assert name in names_in(TESTS / file), test


def test_numbers_are_given_once():
    numbers = [row.number for row in ROWS]
    assert len(set(numbers)) == len(numbers)


def test_the_page_has_the_rows_of_the_catalogue():
    """Whether each passes say its tests; `make faults` prints it."""
    text = read_section("catalogue", FAULTS)
    assert re.findall(r"^\* .*$", text, re.MULTILINE) == [line(row) for row in ROWS]


def test_a_part_of_the_page_is_replaced_alone(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("a\n<!-- x: begin -->\nold\n<!-- x: end -->\nb\n")
    write_section("x", "new", page)
    assert page.read_text() == "a\n<!-- x: begin -->\nnew\n<!-- x: end -->\nb\n"
    with pytest.raises(ValueError, match="no part 'y'"):
        write_section("y", "new", page)
