# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""How precisely a file's numbers are printed."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable
from decimal import Decimal, InvalidOperation
from typing import Final

MIN_DIGITS: Final = 4
"""Significant digits of a number that is rounded; one with fewer may be meant so."""


def rounding_error(words: Iterable[str]) -> float:
    """Estimate the largest error of rounded numbers: half a unit of their last digit.

    Printed with a number of significant digits or of decimals, whichever is coarser. Numbers of
    most files are printed alike: the median of each stands for all, so that one number with all its
    digits, such as pi, does not make a rounded file exact. Zero where no number is long.
    """
    digits, decimals, powers = [], [], []
    for word in words:
        try:
            number = Decimal(word)
        except InvalidOperation:
            continue  # No number: rejected where it is read, if it is.
        _, own, exponent = number.as_tuple()
        if number.is_finite() and isinstance(exponent, int) and len(own) >= MIN_DIGITS and number:
            digits.append(len(own))
            decimals.append(-exponent)
            powers.append(number.adjusted())
    if not digits:
        return 0.0
    power = max(max(powers) + 1 - math.floor(statistics.median(digits)), -math.floor(statistics.median(decimals)))
    return 0.5 * 10.0**power
