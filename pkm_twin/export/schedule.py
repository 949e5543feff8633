# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Order straight-line code by list scheduling, as compilers do within a few instructions.

Gibbons and Muchnick, Efficient instruction scheduling for a pipelined architecture, 1986.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from pkm_twin.codegen.operations import Operation, atan2, inv, sqrt

LATENCY: Final = 4
LATENCIES: Final[Mapping[Operation, int]] = {inv: 13, sqrt: 18, atan2: 75}
TURN_LATENCY: Final = 60
"""Cycles until a result is there: of a product or sum, of some operations, and of sines and cosines.
Of x86-64 processors of 2017 to 2023 (Fog, Instruction tables), of functions as measured."""
PER_CYCLE: Final = 3.0
"""Operations that begin in a cycle, with loads and stores beside them: the fastest of 1.5, 3 and 6."""

WINDOW: Final = 120
"""Statements among which the next one is chosen: with more, intermediate results no longer fit into
registers, and programs of a thousand statements take longer than unordered ones."""


@dataclass(frozen=True)
class Work:
    """The cost of an expression that is computed from the results of statements ``reads``.

    ``latency``: cycles from these to the result. ``operations``: how many.
    """

    reads: frozenset[int] = frozenset()
    latency: int = 0
    operations: int = 0

    @classmethod
    def join(cls, parts: Sequence[Work], latency: int) -> Work:
        """Return the cost of an operation on parts."""
        return cls(
            frozenset().union(*(part.reads for part in parts)),
            latency + max((part.latency for part in parts), default=0),
            1 + sum(part.operations for part in parts),
        )


def order_work(statements: Sequence[Work]) -> list[int]:
    """Return the order in which statements begin on a processor that sees ``WINDOW`` of them.

    Of those whose arguments are there, the one begins that the longest chain follows.
    """
    count = len(statements)
    users: list[list[int]] = [[] for _ in range(count)]
    for k, work in enumerate(statements):
        for read in work.reads:
            users[read].append(k)
    chain = [0] * count
    for k in reversed(range(count)):
        chain[k] = statements[k].latency + max((chain[user] for user in users[k]), default=0)
    missing = [len(work.reads) for work in statements]
    since, done = [0.0] * count, [False] * count
    order: list[int] = []
    waiting: list[tuple[float, int]] = []
    ready: list[tuple[int, int]] = []
    now, first, seen = 0.0, 0, 0
    while len(order) < count:
        while first < count and done[first]:
            first += 1
        for k in range(seen, min(first + WINDOW, count)):
            if not missing[k]:
                heapq.heappush(waiting, (since[k], k))
        seen = max(seen, min(first + WINDOW, count))
        while waiting and waiting[0][0] <= now:
            _, k = heapq.heappop(waiting)
            heapq.heappush(ready, (-chain[k], k))
        if not ready:
            now = waiting[0][0]
            continue
        _, k = heapq.heappop(ready)
        order.append(k)
        done[k] = True
        now += statements[k].operations / PER_CYCLE
        for user in users[k]:
            missing[user] -= 1
            since[user] = max(since[user], now + statements[k].latency)
            if not missing[user] and user < seen:
                heapq.heappush(waiting, (since[user], user))
    return order
