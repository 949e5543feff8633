# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Waiting for conditions: the condition decides, the clock only ends what never comes."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

V = TypeVar("V")


def wait_until(condition: Callable[[], V], pause: Callable[[], object], seconds: float, missing: str) -> V:
    """What a condition gives, as soon as it is true.

    The clock is read before the condition is asked: however long the machine held this process up,
    what is true by then is true.

    :param pause: called between two looks; ``missing``: what is not so after the time, for the
        failure.
    """
    end = time.monotonic() + seconds
    while True:
        last = time.monotonic() > end
        value = condition()
        if value:
            return value
        if last:
            raise AssertionError(f"not within {seconds:g} s: {missing}")
        pause()
