# SPDX-License-Identifier: Apache-2.0
"""Run what the catalogue names and print it row by row into docs/faults.md: ``make faults``."""

from __future__ import annotations

import os
import sys
from collections import Counter, defaultdict
from typing import Any

import pytest

from test.faults.catalogue import TESTS, Row, rows
from test.faults.page import write_section

INTRODUCTION = """Printed by `make faults`: {passed} of {total} rows passed, {cases:,} cases of
{tests} tests.

**R** the message is refused whole, nothing is published from it, it is counted and told in
`/diagnostics`. **S** as R, and the stream stops until good samples come. **F** the node refuses to
start, the file to load, with the name of the field. **X** the command ends with this exit code and
one line. The tests of a row are in `test/faults/catalogue.yaml`.
"""


class Outcomes:
    """What came of every case, by its test's name."""

    def __init__(self) -> None:
        self.of: dict[str, Counter[str]] = defaultdict(Counter)

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.when == "call" or report.outcome != "passed":
            name = report.nodeid.split("[")[0].removeprefix("test/")
            self.of[name][report.outcome] += 1


def result(row: Row, outcomes: Outcomes) -> str:
    """ "pass", or what else came of a row."""
    found = [outcomes.of[test] for test in row.tests]
    if any(set(one) - {"passed"} for one in found):
        return "**fail**"
    return "pass" if all(found) else "**not run**"


def section(outcomes: Outcomes) -> str:
    """The catalogue as a part of the page."""
    found = rows()
    text, table = [], ""
    for row in found:
        if row.table != table:
            table = row.table
            text += [
                "",
                f"### {table}",
                "",
                "| # | fault | answer | cases | |",
                "|---|---|---|---|---|",
            ]
        cases = sum(outcomes.of[test].total() for test in row.tests)
        how = result(row, outcomes)
        text.append(f"| {row.number} | {row.fault} | {row.answer} | {cases} | {how} |")
        print(f"{row.number:3} {how:8} {row.fault}")
    head = INTRODUCTION.format(
        passed=sum(result(row, outcomes) == "pass" for row in found),
        total=len(found),
        cases=sum(count.total() for count in outcomes.of.values()),
        tests=len(outcomes.of),
    )
    return head + "\n".join(text)


def main() -> int:
    """Run from a command line; 0 where every row passed."""
    os.environ.setdefault("SOAK_MINUTES", "1")
    outcomes = Outcomes()
    tests = sorted({str(TESTS / test) for row in rows() for test in row.tests})
    code = pytest.main(["-q", "-n", "2", "-m", "", *tests], plugins=[outcomes])
    write_section("catalogue", section(outcomes))
    return int(code)


if __name__ == "__main__":
    sys.exit(main())
