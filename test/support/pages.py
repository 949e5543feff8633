# SPDX-License-Identifier: Apache-2.0
"""Numbers that stand in running text of the repository's pages, to be compared with today's."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


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
