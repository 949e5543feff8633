# SPDX-License-Identifier: Apache-2.0
"""Exact derivatives of expressions as expressions, backwards and forwards.

Reverse and forward mode of algorithmic differentiation (Griewank and Walther 2008, chapter 3).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

from pkm_twin.codegen.expressions import Expression, cos, maximum, ordered, sign, sin

_LEAST: Final = 1e-150


def _first_of(a: Any, b: Any) -> Any:
    """1 where a is greater than b, 0 where it is less, 1/2 where both are the same."""
    return 0.5 + 0.5 * sign(a - b)


def _angle(y: Any, x: Any) -> tuple[Any, Any]:
    square = y * y + x * x
    return x / square, -y / square


def _root(e: Any) -> Any:
    """Of a length that is zero in the known case, its square has no slope there either."""
    return 0.5 / (maximum(e, _LEAST) if e.value == 0.0 else e)


_SLOPES: Final[dict[str, Callable[[Any, Any, Any], tuple[Any, ...]]]] = {
    "add": lambda a, b, e: (1.0, 1.0),
    "sub": lambda a, b, e: (1.0, -1.0),
    "mul": lambda a, b, e: (b, a),
    "neg": lambda a, b, e: (-1.0,),
    "inv": lambda a, b, e: (-(e * e),),
    # The length of a vector that is zero has none; where it counts, a greater length does.
    "sqrt": lambda a, b, e: (_root(e),),
    "sin": lambda a, b, e: (cos(a),),
    "cos": lambda a, b, e: (-sin(a),),
    "abs": lambda a, b, e: (sign(a),),
    "sign": lambda a, b, e: (0.0,),
    "atan2": lambda a, b, e: _angle(a, b),
    "min": lambda a, b, e: (_first_of(b, a), _first_of(a, b)),
    "max": lambda a, b, e: (_first_of(a, b), _first_of(b, a)),
}
"""Derivatives of each operation by its arguments a and b, ``e`` its value."""


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
        if e.op not in ("const", "in") and any(
            a is not None and a.number in wanted for a in (e.a, e.b)
        ):
            wanted.add(e.number)
    for e in reversed(order):
        bar = bars.get(e.number)
        if bar is None or e.op in ("const", "in") or e.number not in wanted:
            continue
        for argument, slope in zip((e.a, e.b), _SLOPES[e.op](e.a, e.b, e), strict=False):
            if argument is not None and argument.number in wanted:
                bars[argument.number] = bars.get(argument.number, 0.0) + bar * slope
    return [bars.get(e.number, 0.0) for e in by]


def tangents(results: Sequence[Expression], by: Sequence[Expression]) -> list[list[Any]]:
    """Derivatives of expressions by inputs as expressions, a row of them a result."""
    rows: dict[int, dict[int, Any]] = {e.number: {k: 1.0} for k, e in enumerate(by)}
    for e in ordered(results):
        arguments = [] if e.op in ("const", "in") else [a for a in (e.a, e.b) if a is not None]
        if e.number in rows or not any(rows[a.number] for a in arguments):
            rows.setdefault(e.number, {})
            continue
        total: dict[int, Any] = {}
        for a, slope in zip(arguments, _SLOPES[e.op](e.a, e.b, e), strict=False):
            for k, value in rows[a.number].items():
                total[k] = total.get(k, 0.0) + slope * value
        rows[e.number] = total
    return [[rows[e.number].get(k, 0.0) for k in range(len(by))] for e in results]
