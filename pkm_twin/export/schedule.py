# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Order straight-line code by list scheduling, as compilers do within a few instructions.

Gibbons and Muchnick, Efficient instruction scheduling for a pipelined architecture, 1986.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from pkm_twin.codegen.operations import Operation, atan2, inv, sqrt

DEFAULT_LATENCY: Final = 4
"""Cycles until the result of a product or sum is available, on x86-64 processors of 2017 to 2023
(Fog, Instruction tables)."""
LATENCY_BY_OPERATION: Final[Mapping[Operation, int]] = {inv: 13, sqrt: 18, atan2: 75}
SINE_COSINE_LATENCY: Final = 60
"""Cycles until cosine and sine of an angle are available, as measured."""
OPERATIONS_PER_CYCLE: Final = 2.0
"""Operations that begin per cycle, in addition to loads and stores, as measured."""

SCHEDULING_WINDOW: Final = 120
"""Number of statements among which the next one is chosen: with more, intermediate results no longer
fit into registers, and programs of a thousand statements take longer than in their first order."""
LOOK_AHEAD_CYCLES: Final = 16
"""Cycles by which a statement may begin before its arguments are available, as processors look ahead."""


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
    """Return the order in which statements begin on a processor that sees ``SCHEDULING_WINDOW`` of them.

    The one begins after which the fewest results are kept, so that they stay in registers; or, while
    the longest chain takes longer than all operations that are left, the one of that chain (Goodman
    and Hsu, Code scheduling and register allocation in large basic blocks, 1988).
    """
    count = len(statements)
    users: list[list[int]] = [[] for _ in range(count)]
    for k, work in enumerate(statements):
        for read in work.reads:
            users[read].append(k)
    chain = [0] * count
    for k in reversed(range(count)):
        chain[k] = statements[k].latency + max((chain[user] for user in users[k]), default=0)
    missing, unread = [len(work.reads) for work in statements], [len(own) for own in users]
    since, done = [0.0] * count, [False] * count
    order: list[int] = []
    ready: set[int] = set()
    now, first, seen = 0.0, 0, 0
    left = sum(work.operations for work in statements)

    def count_freed(k: int) -> int:
        """Return how many results are no longer kept after a statement, less its own."""
        return sum(unread[read] == 1 for read in statements[k].reads) - bool(users[k])

    while len(order) < count:
        while first < count and done[first]:
            first += 1
        ready.update(k for k in range(seen, min(first + SCHEDULING_WINDOW, count)) if not missing[k])
        seen = max(seen, min(first + SCHEDULING_WINDOW, count))
        hurry = max(chain[k] for k in ready) * OPERATIONS_PER_CYCLE > left
        now = max(now, min(since[k] for k in ready) - (0 if hurry else LOOK_AHEAD_CYCLES))
        able = [k for k in ready if since[k] <= now + (0 if hurry else LOOK_AHEAD_CYCLES)]
        best = max(able, key=lambda k: (0 if hurry else count_freed(k), chain[k], -k))
        order.append(best)
        ready.remove(best)
        done[best] = True
        work = statements[best]
        begun, busy = max(now, since[best]), work.operations / OPERATIONS_PER_CYCLE
        now += busy
        left -= work.operations
        for read in work.reads:
            unread[read] -= 1
        for user in users[best]:
            missing[user] -= 1
            since[user] = max(since[user], begun + busy + work.latency)
            if not missing[user] and user < seen:
                ready.add(user)
    return order
