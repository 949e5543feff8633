# SPDX-License-Identifier: Apache-2.0
"""Exact derivatives of expressions as expressions, backwards and forwards.

Reverse and forward mode of algorithmic differentiation (Griewank and Walther 2008, chapter 3).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from pkm_twin.codegen.expressions import Expression, ordered


def adjoints(sums: Iterable[tuple[Any, Any]], by: Sequence[Expression]) -> list[Any]:
    """Derivatives of a sum of products by inputs, as expressions.

    :param sums: expressions and what each is multiplied by, which is taken for constant.
    """
    bars: dict[int, Any] = {}
    pairs = [(e, weight) for e, weight in sums if isinstance(e, Expression)]
    for e, weight in pairs:
        bars[e.number] = bars.get(e.number, 0.0) + weight
    wanted = {e.number for e in by}
    order = ordered([e for e, _ in pairs])
    for e in order:
        if any(x.number in wanted for x in e.args):
            wanted.add(e.number)
    for e in reversed(order):
        bar = bars.get(e.number)
        if bar is None or e.op is None or e.number not in wanted:
            continue
        for x, slope in zip(e.args, e.op.slopes(e, *e.args), strict=True):
            if x.number in wanted:
                bars[x.number] = bars.get(x.number, 0.0) + bar * slope
    return [bars.get(e.number, 0.0) for e in by]


def tangents(results: Sequence[Expression], by: Sequence[Expression]) -> list[list[Any]]:
    """Derivatives of expressions by inputs as expressions, a row of them a result."""
    rows: dict[int, dict[int, Any]] = {e.number: {k: 1.0} for k, e in enumerate(by)}
    for e in ordered(results):
        if e.op is None or e.number in rows or not any(rows[x.number] for x in e.args):
            rows.setdefault(e.number, {})
            continue
        total: dict[int, Any] = {}
        for x, slope in zip(e.args, e.op.slopes(e, *e.args), strict=True):
            for k, value in rows[x.number].items():
                total[k] = total.get(k, 0.0) + slope * value
        rows[e.number] = total
    return [[rows[e.number].get(k, 0.0) for k in range(len(by))] for e in results]
