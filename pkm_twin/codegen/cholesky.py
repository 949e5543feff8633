# SPDX-License-Identifier: Apache-2.0
"""Traces over inverses of sparse symmetric matrices, as straight-line expressions.

May import: numpy, this package, the standard library.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

from pkm_twin.codegen.expressions import Objects, maximum
from pkm_twin.codegen.lu import is_zero

FLOOR: Final = 1e-20
"""Least pivot, over what it is compared with: rounding ends far above it, so all stays finite."""

Entries = dict[tuple[int, int], Any]
"""Lower triangle, by row and column, row >= column."""


def traces_over(numerators: Sequence[Objects], matrix: Objects) -> list[Any]:
    """Trace of matrix^-1 numerator of each: what x' numerator x sums up to at x' matrix x = 1.

    By L D L' without pivoting, which a positive matrix does not need, in the order of least degree;
    of the inverse only the entries in the pattern of L (Takahashi, Fagan, Chen 1973). Where the
    matrix has no inverse the result is large and finite.

    :param numerators: symmetric, not negative, shape (n, n) each, expressions or numbers; the
        diagonal of their sum is positive.
    :param matrix: symmetric, not negative, the same shape and unit.
    """
    n = len(matrix)
    numerator = sum(numerators[1:], numerators[0])
    order = _order(numerator, matrix)
    place = {index: k for k, index in enumerate(order)}
    factors, pivots = _factors(numerator, matrix, order)
    below = [[i for i in range(j + 1, n) if (i, j) in factors] for j in range(n)]
    inverse: Entries = {}

    def entry(i: int, j: int) -> Any:
        return inverse[max(i, j), min(i, j)]

    for j in reversed(range(n)):
        for i in below[j]:
            total: Any = 0.0
            for k in below[j]:
                total = total - entry(i, k) * factors[k, j]
            inverse[i, j] = total
        diagonal = 1.0 / pivots[j]
        for k in below[j]:
            diagonal = diagonal - factors[k, j] * inverse[k, j]
        inverse[j, j] = diagonal
    return [_product(each, entry, place) for each in numerators]


def _product(numerator: Objects, entry: Callable[[int, int], Any], place: dict[int, int]) -> Any:
    """Sum of the products of both matrices' entries."""
    result: Any = 0.0
    for a in range(len(numerator)):
        result = result + numerator[a][a] * entry(place[a], place[a])
        for b in range(a):
            if not is_zero(numerator[a][b]):
                result = result + 2.0 * (numerator[a][b] * entry(place[a], place[b]))
    return result


def _order(numerator: Objects, matrix: Objects) -> list[int]:
    """Least degree first, in the pattern of both."""
    n = len(matrix)
    near = {
        a: {
            b
            for b in range(n)
            if b != a and not (is_zero(matrix[a][b]) and is_zero(numerator[a][b]))
        }
        for a in range(n)
    }
    order = []
    while near:
        best = min(near, key=lambda a: (len(near[a]), a))
        order.append(best)
        around = near.pop(best)
        for a in around:
            near[a] = (near[a] | around) - {a, best}
    return order


def _factors(numerator: Objects, matrix: Objects, order: list[int]) -> tuple[Entries, list[Any]]:
    """L below its diagonal, in the pattern of both matrices, and D."""
    n = len(order)
    left: Entries = {}
    for j, b in enumerate(order):
        for i in range(j, n):
            a = order[i]
            if i == j or not (is_zero(matrix[a][b]) and is_zero(numerator[a][b])):
                left[i, j] = matrix[a][b]
    factors: Entries = {}
    pivots: list[Any] = []
    for j, index in enumerate(order):
        pivots.append(maximum(left[j, j], FLOOR * numerator[index][index]))
        column = [i for i in range(j + 1, n) if (i, j) in left]
        inverse = 1.0 / pivots[j]
        for i in column:
            factors[i, j] = left[i, j] * inverse
        for i in column:
            for k in column:
                if k <= i:
                    left[i, k] = left.get((i, k), 0.0) - factors[i, j] * left[k, j]
    return factors, pivots
