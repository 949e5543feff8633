# SPDX-License-Identifier: Apache-2.0
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
