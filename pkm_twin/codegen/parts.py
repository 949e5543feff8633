# SPDX-License-Identifier: Apache-2.0
"""Large batches on several cores."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Final

from pkm_twin.errors import ParameterError

VARIABLE: Final = "PKM_TWIN_THREADS"
"""How many threads a large batch may use: 1 unless set, 0 for all cores of this process."""
WORTH: Final = 4096
"""Samples for which it pays to start a thread."""


def threads() -> int:
    """What the environment says, read at every large batch.

    :raises ParameterError: it is no number of threads.
    """
    text = os.environ.get(VARIABLE, "").strip() or "1"
    if not text.isascii() or not text.isdigit() or int(text) > 1024:
        raise ParameterError(VARIABLE, text, "a number of threads, 0 for all cores")
    return int(text) or len(os.sched_getaffinity(0))


def in_parts(part: Callable[[int, int], bool], whole: int, samples: int) -> bool:
    """Compute ``part(begin, end)`` of all of ``whole``; whether any of them gives True.

    :param samples: how many samples there are in all.
    """
    count = min(whole, samples // WORTH)
    if count > 1:
        count = min(count, threads())
    if count <= 1:
        return part(0, whole)
    ends = [whole * k // count for k in range(count + 1)]
    # Threads of this call alone: those of a pool would be missing in a process that is forked.
    with ThreadPoolExecutor(count - 1) as others:
        rest = [others.submit(part, *pair) for pair in pairwise(ends[1:])]
        bad = part(0, ends[1])
        return any([one.result() for one in rest]) or bad
