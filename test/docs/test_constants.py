# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Bounds that the pages tell in running text are those of the code."""

from __future__ import annotations

from pkm_twin.codegen import program
from pkm_twin.codegen.code import STEPS
from pkm_twin.codegen.lu import pivot_order
from test.support.pages import numbers, text_of

ENGINE = "docs/engine.md"
WORDS = {"quarter": 0.25, "tenth": 0.1}


def word(pattern):
    """A number that is written out."""
    (found,) = [w for w in WORDS if pattern.format(w) in text_of(ENGINE)]
    return WORDS[found]


def test_newtons_judgement():
    assert numbers(ENGINE, r"at most (\d+) corrections .*? until one is below (\S+) \(") == [
        program.MAX_ITERATIONS,
        program.MAX_LAST_CORRECTION,
    ]
    assert word("at most a **{}** of the one before it") == program.MAX_CONTRACTION
    pattern = r"stays above (\S+); without a closed form, .*? above (\S+) times each correction"
    assert numbers(ENGINE, pattern) == [program.MIN_RELATIVE_DETERMINANT, program.MIN_DETERMINANT_RATIO]
    assert numbers(ENGINE, r"redundant ones too, is at most (\S+) \(") == [program.MAX_RESIDUAL]
    pattern = r"tried again in (\d+), (\d+), (\d+), (\d+), (\d+) and (\d+) \*\*steps"
    assert numbers(ENGINE, pattern) == list(STEPS)


def test_pivots():
    share = pivot_order.__defaults__[0]
    assert word("at least a {} of the largest entry") == share
