# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The repository's pages: numbers in running text, and parts that programs write."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FAULTS = ROOT / "docs" / "errors.md"


def text_of(page: str) -> str:
    """A page on one line."""
    return " ".join((ROOT / page).read_text(encoding="utf-8").split())


def numbers(page: str, pattern: str) -> list[float]:
    """The numbers of a sentence."""
    return [float(text) for text in _texts(page, pattern)]


def assert_printed(page: str, pattern: str, *found: float) -> None:
    """Values are those of a sentence, within half a unit of each last digit."""
    for text, value in zip(_texts(page, pattern), found, strict=True):
        half = 0.51 * 10.0 ** -len(text.partition(".")[2])
        assert value == pytest.approx(float(text), abs=half)


def _texts(page: str, pattern: str) -> tuple[str, ...]:
    match = re.search(pattern, text_of(page))
    assert match, f"{page} has no {pattern!r}"
    return match.groups()


NUMBER = r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?"


def assert_output(printed: str, found: str) -> None:
    """A program's output is what a page prints, to the precision there.

    ``...`` stands for any text of a line, or alone for any lines. A number with decimals may differ
    by one unit of its last digit.
    """
    lines = [line for line in found.splitlines() if line.strip()]
    skipped = False
    for line in filter(str.strip, printed.splitlines()):
        if line.strip() == "...":
            skipped = True
            continue
        while lines and not _like(line, lines[0]):
            assert skipped, f"{line!r} is on the page, {lines[0]!r} was printed"
            del lines[0]
        assert lines, f"{line!r} was not printed:\n{found}"
        del lines[0]
        skipped = False
    assert skipped or not lines, f"not on the page: {lines}"


def _like(printed: str, found: str) -> bool:
    """Whether two lines have the same words, and numbers that agree."""
    parts = re.split(rf"({NUMBER}|\.\.\.|\s+)", printed.strip())
    pattern, numbers_ = "", []
    for part in filter(None, parts):
        if re.fullmatch(NUMBER, part):
            pattern += f"({NUMBER})"
            numbers_.append(part)
        elif part == "...":
            pattern += ".*?"
        else:
            pattern += r"\s+" if part.isspace() else re.escape(part)
    match = re.fullmatch(pattern, found.strip())
    return match is not None and all(
        abs(float(a) - float(b)) <= 1.01 * _unit(a) for a, b in zip(numbers_, match.groups(), strict=True)
    )


def _unit(number: str) -> float:
    """One unit of the last digit; of a whole number nothing."""
    digits, _, exponent = number.partition("e")
    decimals = len(digits.partition(".")[2])
    return 0.0 if not decimals and not exponent else 10.0 ** (int(exponent or 0) - decimals)


def read_section(name: str, page: Path) -> str:
    """What stands between the marks of a part.

    :raises ValueError: the page has no such part.
    """
    return _parts(name, page)[1].strip()


def write_section(name: str, text: str, page: Path) -> None:
    """Replace what stands between the marks of a part.

    :raises ValueError: the page has no such part.
    """
    before, _, after = _parts(name, page)
    page.write_text(f"{before}\n{text.strip()}\n{after}", encoding="utf-8")


def _parts(name: str, page: Path) -> tuple[str, str, str]:
    """The page before, between and after a part's marks, which stay outside."""
    begin, end = (f"<!-- {name}: {what} -->" for what in ("begin", "end"))
    before, found, rest = page.read_text(encoding="utf-8").partition(begin)
    text, closed, after = rest.partition(end)
    if not (found and closed):
        raise ValueError(f"{page.name} has no part {name!r}")
    return before + begin, text, end + after
