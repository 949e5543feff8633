# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Sparse symmetric matrices that are not negative, as straight-line expressions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from pkm_twin.codegen.expressions import Objects
from pkm_twin.codegen.lu import is_zero
from pkm_twin.codegen.operations import maximum

FLOOR: Final = 1e-20
"""Least pivot, over what it is compared with: rounding ends far above it, so all stays finite."""

Entries = dict[tuple[int, int], Any]
"""Lower triangle, by row and column, row >= column."""


class SparseCholesky:
    """L D L' without pivoting, which a positive matrix does not need, in the order of least degree.

    Row and column k of the factors are those of ``order[k]`` of the matrix. ``factors``: L below
    its diagonal; ``below``: by column the rows where it is not zero; ``pivots``: D; ``inverses``:
    their reciprocals.

    :param matrix: lower triangle with its whole diagonal; what is left out is zero.
    :param scale: what pivots are compared with, of the matrix' diagonal.
    :param last: how many of the first ones come last, in their order.
    """

    def __init__(self, matrix: Mapping[tuple[int, int], Any], scale: Sequence[Any], last: int = 0):
        n = len(scale)
        self.order = _order(matrix, n, last)
        self.place = {index: k for k, index in enumerate(self.order)}
        left: Entries = {}
        for (a, b), value in matrix.items():
            i, j = self.place[a], self.place[b]
            left[max(i, j), min(i, j)] = value
        self.factors: Entries = {}
        self.pivots: list[Any] = []
        self.inverses: list[Any] = []
        self.below: list[list[int]] = []
        for j, index in enumerate(self.order):
            self.pivots.append(maximum(left[j, j], FLOOR * scale[index]))
            column = [i for i in range(j + 1, n) if (i, j) in left]
            inverse = 1.0 / self.pivots[j]
            self.inverses.append(inverse)
            for i in column:
                self.factors[i, j] = left[i, j] * inverse
            for i in column:
                for k in column:
                    if k <= i:
                        left[i, k] = left.get((i, k), 0.0) - self.factors[i, j] * left[k, j]
            self.below.append(column)

    def forward(self, right: Sequence[Any]) -> list[Any]:
        """Y of L y = right, shape (n,), in the order of the factors."""
        b = [right[index] for index in self.order]
        for j, rows in enumerate(self.below):
            for i in rows:
                b[i] = b[i] - self.factors[i, j] * b[j]
        return b

    def solve(self, right: Sequence[Any]) -> list[Any]:
        """X of A x = right, shape (n,)."""
        b = self.forward(right)
        for j in reversed(range(len(b))):
            b[j] = b[j] * self.inverses[j]
            for i in self.below[j]:
                b[j] = b[j] - self.factors[i, j] * b[i]
        return [b[self.place[index]] for index in range(len(b))]


def _order(matrix: Mapping[tuple[int, int], Any], n: int, last: int) -> list[int]:
    """Least degree first, but the first ``last`` come last."""
    near: dict[int, set[int]] = {a: set() for a in range(n)}
    for a, b in matrix:
        if a != b:
            near[a].add(b)
            near[b].add(a)
    order = []
    while len(near) > last:
        best = min((a for a in near if a >= last), key=lambda a: (len(near[a]), a))
        order.append(best)
        around = near.pop(best)
        for a in around:
            near[a] = (near[a] | around) - {a, best}
    return [*order, *near]


def traces_over(numerators: Sequence[Objects], matrix: Objects) -> list[Any]:
    """Trace of matrix^-1 numerator of each: what x' numerator x sums up to at x' matrix x = 1.

    Of the inverse only the entries in the pattern of L (Takahashi, Fagan, Chen 1973). Where the
    matrix has no inverse the result is large and finite.

    :param numerators: symmetric, not negative, shape (n, n) each, expressions or numbers; the
        diagonal of their sum is positive.
    :param matrix: symmetric, not negative, the same shape and unit.
    """
    n = len(matrix)
    numerator = sum(numerators[1:], numerators[0])
    lower = {
        (a, b): matrix[a][b]
        for a in range(n)
        for b in range(a + 1)
        if a == b or not (is_zero(matrix[a][b]) and is_zero(numerator[a][b]))
    }
    whole = SparseCholesky(lower, [numerator[a][a] for a in range(n)])
    factors, below = whole.factors, whole.below
    inverse: Entries = {}

    def entry(i: int, j: int) -> Any:
        return inverse[max(i, j), min(i, j)]

    for j in reversed(range(n)):
        for i in below[j]:
            total: Any = 0.0
            for k in below[j]:
                total = total - entry(i, k) * factors[k, j]
            inverse[i, j] = total
        diagonal = whole.inverses[j]
        for k in below[j]:
            diagonal = diagonal - factors[k, j] * inverse[k, j]
        inverse[j, j] = diagonal
    return [_product(each, entry, whole.place) for each in numerators]


def _product(numerator: Objects, entry: Callable[[int, int], Any], place: dict[int, int]) -> Any:
    """Sum of the products of both matrices' entries."""
    result: Any = 0.0
    for a in range(len(numerator)):
        result = result + numerator[a][a] * entry(place[a], place[a])
        for b in range(a):
            if not is_zero(numerator[a][b]):
                result = result + 2.0 * (numerator[a][b] * entry(place[a], place[b]))
    return result
