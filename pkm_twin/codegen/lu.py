# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Solve sparse linear equations of expressions by LU; pivots are chosen beforehand on samples."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import Numbers, Objects
from pkm_twin.errors import SingularityError

RELATIVE_ZERO: Final = 1e-13
"""Entries below this fraction of the largest one, in all samples, are rounding errors of zero."""


def independent_rows(matrices: Array, bound: float = 1e-9) -> list[int]:
    """Select rows that are linearly independent in every one of k matrices.

    QR with column pivoting of the transpose: the next row has the largest component orthogonal to
    the rows chosen before, the earlier row where two are equal.

    :param matrices: shape (k, rows, columns).
    :param bound: smallest orthogonal component of an independent row, relative to the largest row.
    :returns: sorted indices, as many as the smallest rank of the matrices.
    """
    rest = matrices.astype(float).copy()
    # 1e-300 avoids 0 / 0 for a matrix of zeros.
    scale = np.maximum(np.linalg.norm(rest, axis=-1).max(-1, initial=0.0), 1e-300)
    left = list(range(rest.shape[1]))
    chosen: list[int] = []
    while left and len(chosen) < rest.shape[2]:
        norms = (np.linalg.norm(rest[:, left], axis=-1) / scale[:, None]).min(0)
        best = int(np.argmax(norms * (1 + 1e-9 * np.arange(len(left))[::-1])))
        if not norms[best] > bound:
            break
        row = left.pop(best)
        unit = rest[:, row] / np.linalg.norm(rest[:, row], axis=-1, keepdims=True)
        rest = rest - np.einsum("kri,ki->kr", rest, unit)[..., None] * unit[:, None]
        chosen.append(row)
    return sorted(chosen)


STRONG_PIVOT_RATIO: Final = 0.3
"""Pivots above this fraction of their row's and column's largest entry count as equally good."""

Order = tuple[tuple[int, int], ...]
"""Rows and columns of the pivots in order of elimination."""


def pivot_order(samples: Array, share: float = 0.1) -> Order:
    """Choose the pivots for matrices of one sparsity pattern.

    Among the entries that are large enough in every sample the one with the least fill-in is taken
    (Markowitz's rule with threshold pivoting; Duff, Erisman and Reid 1986). If no entry is large
    enough in all samples, only the first half of the samples is used.

    :param samples: the matrix in k states, shape (k, n, n).
    :param share: threshold: smallest pivot as a fraction of its row's and column's largest entry.
    :raises SingularityError: no pivot is left.
    """
    numbers = np.array(samples, float)
    scale = np.abs(numbers).max(initial=0.0)
    rows, columns = list(range(numbers.shape[1])), list(range(numbers.shape[1]))
    order: list[tuple[int, int]] = []
    while rows:
        block = np.abs(numbers[:, rows][:, :, columns])
        nonzero = (block > RELATIVE_ZERO * scale).any(0)
        large = np.maximum(block.max(2)[:, :, None], block.max(1)[:, None, :])
        candidates = nonzero & (block > np.maximum(share * large, 1e-12)).all(0)
        if not candidates.any():
            if len(samples) > 1:
                return pivot_order(samples[: len(samples) // 2], share)
            raise SingularityError("the sample states", (), float(scale), share)
        fill = np.multiply.outer(nonzero.sum(1) - 1, nonzero.sum(0) - 1)
        # Of equally good pivots take the first: a finer criterion would depend on rounding.
        is_strong = ((block / np.maximum(large, 1e-300)).min(0) > STRONG_PIVOT_RATIO)[candidates]
        # Prefer constant pivots, whose reciprocal is computed once and not per sample.
        is_constant = (np.ptp(numbers[:, rows][:, :, columns], axis=0) < 1e-12 * scale)[candidates]
        best = int((fill[candidates] + 0.5 * ~is_strong + 0.6 * ~is_constant).argmin())
        i, j = (int(index[best]) for index in np.nonzero(candidates))
        row, column = rows.pop(i), columns.pop(j)
        order.append((row, column))
        ratio = numbers[:, rows, column] / numbers[:, row, column][:, None]
        numbers[:, rows] -= ratio[:, :, None] * numbers[:, row][:, None, :]
    return tuple(order)


class SparseLU:
    """The LU factorisation of a square matrix of expressions.

    :param matrix: shape (n, n), expressions or numbers.
    :param order: the pivots, see :func:`pivot_order`.
    """

    def __init__(self, matrix: Objects, order: Order) -> None:
        n = self.size = len(matrix)
        rows: list[dict[int, Any]] = [
            {c: matrix[r][c] for c in range(n) if not is_zero(matrix[r][c])} for r in range(n)
        ]
        open_rows, open_columns = list(range(n)), list(range(n))
        self._pivots: list[tuple[int, int, Any]] = []
        self._lower: list[dict[int, Any]] = []
        self._upper: list[dict[int, Any]] = []
        sign = 1.0
        for row, column in order:
            sign *= -1.0 if (open_rows.index(row) + open_columns.index(column)) % 2 else 1.0
            inverse = 1.0 / rows[row][column]
            open_rows.remove(row)
            open_columns.remove(column)
            upper = {c: rows[row][c] for c in rows[row] if c in open_columns}
            lower = {}
            for r in open_rows:
                if column not in rows[r]:
                    continue
                factor = lower[r] = rows[r].pop(column) * inverse
                for c, value in upper.items():
                    product = factor * value
                    rows[r][c] = rows[r][c] - product if c in rows[r] else -product
            self._pivots.append((row, column, inverse))
            self._lower.append(lower)
            self._upper.append(upper)
        self.inverse_pivots: dict[int, Any] = {row: inverse for row, _, inverse in self._pivots}
        """Reciprocals of the pivots, by their rows."""
        self.used = False
        """True if a system has been solved with the factors."""
        self.inverse_determinant: Any = sign
        """Reciprocal of the determinant."""
        for _, _, inverse in self._pivots:
            self.inverse_determinant = inverse * self.inverse_determinant

    def find_growth(self, rows: Numbers | Mapping[int, Any], columns: Numbers, *, every: bool = False) -> Any:
        """Return a bound of the square of the factor by which elimination magnifies rounding.

        Pivots are fixed, and one may vanish although the matrix is regular: the entries that it
        eliminates then lose their digits (Higham, Accuracy and Stability of Numerical Algorithms, 2002, section
        9.3). The bound is the sum of 1 / pivot^2, dimensionless, of the pivots that eliminate others.

        :param rows: factors that make rows dimensionless, (n,). ``columns``: factors for the unknowns.
        :param every: also count pivots that eliminate nothing, which are small if the matrix is singular.
        """
        growth: Any = 0.0
        for (row, column, inverse), lower, upper in zip(self._pivots, self._lower, self._upper, strict=True):
            if every or (lower and upper):
                unit = inverse * (columns[column] / rows[row])
                growth = growth + unit * unit
        return growth

    def solve(self, right: Any) -> Objects:
        """Solve A x = right, shape (n,)."""
        self.used = True
        b = list(right)
        x: list[Any] = [0.0] * self.size
        for (row, _, _), lower in zip(self._pivots, self._lower, strict=True):
            for r, factor in lower.items():
                b[r] = b[r] - factor * b[row]
        for (row, column, inverse), upper in zip(reversed(self._pivots), reversed(self._upper), strict=True):
            value = b[row]
            for c, factor in upper.items():
                value = value - factor * x[c]
            x[column] = value * inverse
        return _object_array(x)

    def solve_transposed(self, right: Any) -> Objects:
        """Solve A' y = right, shape (n,)."""
        self.used = True
        b = list(right)
        y: list[Any] = [0.0] * self.size
        for (row, column, inverse), upper in zip(self._pivots, self._upper, strict=True):
            value = y[row] = b[column] * inverse
            for c, factor in upper.items():
                b[c] = b[c] - factor * value
        for (row, _, _), lower in zip(reversed(self._pivots), reversed(self._lower), strict=True):
            for r, factor in lower.items():
                y[row] = y[row] - factor * y[r]
        return _object_array(y)


def is_zero(value: Any) -> bool:
    """Return whether an expression or a number is the constant zero."""
    constant = getattr(value, "is_constant", None)
    return bool(constant(0.0)) if constant is not None else value == 0.0


def _object_array(values: list[Any]) -> Objects:
    array = np.empty(len(values), dtype=object)
    array[:] = values
    return array
