# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The order of lines of exported C."""

from __future__ import annotations

import numpy as np

from pkm_twin.export.schedule import SCHEDULING_WINDOW, Work, order_work


def test_every_statement_follows_what_it_reads_and_stays_near_its_place(rng):
    """Over random graphs: an order of all statements, in which none overtakes a whole window."""
    for count in (1, 2, 50, 3 * SCHEDULING_WINDOW):
        statements = [
            Work(
                frozenset(rng.integers(0, k, rng.integers(0, 3)).tolist() if k else ()),
                int(rng.integers(1, 20)),
                int(rng.integers(1, 9)),
            )
            for k in range(count)
        ]
        place = np.argsort(order_work(statements))
        assert sorted(place) == list(range(count))
        assert all(place[read] < place[k] for k, work in enumerate(statements) for read in work.reads)
        assert (np.arange(count) - place < SCHEDULING_WINDOW).all()


def test_chains_that_are_independent_begin_side_by_side():
    """Two chains of ten, one after the other as written, end within three statements of each other."""
    statements = [Work(frozenset({k - 1} if k % 10 else ()), 4, 1) for k in range(20)]
    place = np.argsort(order_work(statements))
    assert abs(int(place[9]) - int(place[19])) < 3
