# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Factor sparse symmetric positive semidefinite matrices of expressions (L D L')."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from pkm_twin.codegen.expressions import Objects
from pkm_twin.codegen.lu import is_zero
from pkm_twin.codegen.operations import maximum

MIN_PIVOT_RATIO: Final = 1e-20
"""Smallest pivot relative to its scale: far below rounding errors, it only avoids division by 0."""

Entries = dict[tuple[int, int], Any]
"""Entries of the lower triangle by (row, column), row >= column."""


class SparseCholesky:
    """The factorisation L D L' of a positive definite matrix, eliminated in minimum-degree order.

    Row and column k of the factors belong to row ``order[k]`` of the matrix. ``factors``: entries
    of L below the diagonal; ``below``: rows of these entries by column; ``pivots``: D;
    ``inverses``: the reciprocals of D.

    :param matrix: lower triangle including the whole diagonal; missing entries are zero.
    :param scale: scales of the pivots, in the order of the matrix' diagonal.
    :param last: number of leading rows that are eliminated last, in their own order.
    """

    def __init__(self, matrix: Mapping[tuple[int, int], Any], scale: Sequence[Any], last: int = 0):
        n = len(scale)
        self.order = _minimum_degree_order(matrix, n, last)
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
            self.pivots.append(maximum(left[j, j], MIN_PIVOT_RATIO * scale[index]))
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
        """Solve L y = right, shape (n,); y is in the order of the factors."""
        b = [right[index] for index in self.order]
        for j, rows in enumerate(self.below):
            for i in rows:
                b[i] = b[i] - self.factors[i, j] * b[j]
        return b

    def solve(self, right: Sequence[Any]) -> list[Any]:
        """Solve A x = right, shape (n,)."""
        b = self.forward(right)
        for j in reversed(range(len(b))):
            b[j] = b[j] * self.inverses[j]
            for i in self.below[j]:
                b[j] = b[j] - self.factors[i, j] * b[i]
        return [b[self.place[index]] for index in range(len(b))]


def _minimum_degree_order(matrix: Mapping[tuple[int, int], Any], n: int, last: int) -> list[int]:
    """Return the elimination order: least degree first; the first ``last`` rows at the end."""
    neighbours: dict[int, set[int]] = {a: set() for a in range(n)}
    for a, b in matrix:
        if a != b:
            neighbours[a].add(b)
            neighbours[b].add(a)
    order = []
    while len(neighbours) > last:
        best = min((a for a in neighbours if a >= last), key=lambda a: (len(neighbours[a]), a))
        order.append(best)
        adjacent = neighbours.pop(best)
        for a in adjacent:
            neighbours[a] = (neighbours[a] | adjacent) - {a, best}
    return [*order, *neighbours]


def trace_over(numerator: Objects, matrix: Objects) -> Any:
    """Return the trace of matrix^-1 numerator.

    With matrix = L D L' the trace is the sum of the diagonal of L^-1 numerator L^-T over D, so the
    numerator is eliminated along with the matrix. For a singular matrix the result is large and
    finite.

    :param numerator: symmetric positive semidefinite with a positive diagonal, shape (n, n),
        expressions or numbers.
    :param matrix: symmetric positive semidefinite, of the same shape and unit.
    """
    n = len(matrix)
    lower = {
        (a, b): matrix[a][b]
        for a in range(n)
        for b in range(a + 1)
        if a == b or not (is_zero(matrix[a][b]) and is_zero(numerator[a][b]))
    }
    whole = SparseCholesky(lower, [numerator[a][a] for a in range(n)])
    left: Entries = {}
    for a, b in lower:
        if not is_zero(numerator[a][b]):
            i, j = whole.place[a], whole.place[b]
            left[max(i, j), min(i, j)] = numerator[a][b]
    total: Any = 0.0
    for j, rows in enumerate(whole.below):
        total = total + left[j, j] * whole.inverses[j]
        for k in rows:
            far = whole.factors[k, j]
            change = far * left[j, j] - left.get((k, j), 0.0)
            for i in rows:
                if i >= k:
                    step = whole.factors[i, j] * change
                    step = step - left[i, j] * far if (i, j) in left else step
                    left[i, k] = left[i, k] + step if (i, k) in left else step
    return total
