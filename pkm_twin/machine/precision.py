# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Estimate the rounding errors of a file's numbers."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable
from decimal import Decimal, InvalidOperation


def rounding_error(words: Iterable[str]) -> float:
    """Estimate the largest error of rounded numbers: half a unit of their last digit.

    Numbers are printed with some significant digits or some decimals, whichever is coarser. The
    medians over a file's numbers are used, so that one number with all its digits, such as pi, does
    not make a rounded file exact. A number of fewer than four digits may be exact; without any longer
    number the error is zero.
    """
    digits, decimals, powers = [], [], []
    for word in words:
        try:
            number = Decimal(word)
        except InvalidOperation:
            continue  # Not a number: rejected where it is read.
        _, own, exponent = number.as_tuple()
        if number.is_finite() and isinstance(exponent, int) and len(own) >= 4 and number:
            digits.append(len(own))
            decimals.append(-exponent)
            powers.append(number.adjusted())
    if not digits:
        return 0.0
    power = max(max(powers) + 1 - math.floor(statistics.median(digits)), -math.floor(statistics.median(decimals)))
    return 0.5 * 10.0**power
