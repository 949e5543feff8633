# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Run what the catalogue names and print it row by row into docs/errors.md: ``make faults``.

``python -m test.faults --again`` runs only the rows that did not pass the last time.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections import Counter, defaultdict
from itertools import groupby
from pathlib import Path
from typing import Any

import pytest

from test.faults.catalogue import TESTS, Row, line, rows
from test.support.pages import FAULTS, write_section

RESULTS = Path("out/faults.json")
"""Of every row, by its number, how many cases ran and what came of them."""
PASS, NOT_RUN = "pass", "**not run**"
INTRODUCTION = """Printed by `make faults`: {passed} of {total} rows passed.

**R**: the message is rejected whole and counted in `/diagnostics`. **S**: as R, and the stream
stops until accepted samples arrive. **F**: the node does not start, or the file does not load.
**X**: the command ends with this exit code. `test/faults/catalogue.yaml` lists the tests of each.
"""


class Outcomes:
    """What came of every case, by its test's name."""

    def __init__(self) -> None:
        self.of: dict[str, Counter[str]] = defaultdict(Counter)

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.when == "call" or report.outcome != "passed":
            name = report.nodeid.split("[")[0].removeprefix("test/")
            self.of[name][report.outcome] += 1


def result(row: Row, outcomes: Outcomes) -> tuple[int, str]:
    """How many cases of a row ran, and what came of them."""
    found = [outcomes.of[test] for test in row.tests]
    cases = sum(count.total() for count in found)
    if any(set(count) - {"passed"} for count in found):
        return cases, "**fail**"
    return cases, PASS if all(found) else NOT_RUN


def section(results: dict[str, Any]) -> str:
    """The catalogue as a part of the page."""
    found = rows()
    text, table = [], ""
    for row in found:
        if row.table != table:
            table = row.table
            text += ["", f"### {table}", ""]
        how = results[str(row.number)][1]
        text.append(line(row) + ("" if how == PASS else f" {how}"))
        print(f"{row.number:3} {how:12} {row.fault}")
    passed = sum(results[str(row.number)][1] == PASS for row in found)
    return INTRODUCTION.format(passed=passed, total=len(found)) + "\n".join(text)


def main() -> int:
    """Run from a command line; 0 where every row passed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--again", action="store_true", help="rows that did not pass")
    again = parser.parse_args().again
    results: dict[str, Any] = {str(row.number): (0, NOT_RUN) for row in rows()}
    results |= json.loads(RESULTS.read_text()) if again else {}
    asked = [row for row in rows() if results[str(row.number)][1] != PASS]
    os.environ.setdefault("SOAK_MINUTES", "1")
    outcomes = Outcomes()
    RESULTS.parent.mkdir(exist_ok=True)
    tests = sorted({test for row in asked for test in row.tests})
    # A folder after the other, each kept: an interrupted run goes on with --again.
    for _, folder in groupby(tests, key=lambda test: Path(test).parts[0]):
        paths = [str(TESTS / test) for test in folder]
        # A file's nodes are started once, for all of its tests in their order.
        options = ["-q", "-n", "2", "--dist", "loadfile", "-m", ""]
        ended = pytest.main([*options, *paths], plugins=[outcomes])
        if ended == pytest.ExitCode.INTERRUPTED:
            break
        results |= {str(row.number): result(row, outcomes) for row in asked}
        RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    write_section("catalogue", section(results), FAULTS)
    return int(any(how != PASS for _, how in results.values()))


if __name__ == "__main__":
    sys.exit(main())
