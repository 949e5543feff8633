# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Sparse linear equations as straight-line expressions, pivots chosen beforehand on numbers."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import Objects
from pkm_twin.errors import SingularityError

ZERO: Final = 1e-13
"""Part of the largest entry below which one is zero in all states: rounding left it."""


def independent_rows(matrices: Array, bound: float = 1e-9) -> list[int]:
    """Rows that are independent in every one of some matrices, shape (k, rows, columns).

    Greedy, by what of a row is left across those chosen before (QR with pivoting of the
    transpose); ties take the earlier row. As many as the least rank of the matrices.
    """
    rest = matrices.astype(float).copy()
    # Of a matrix of zeros no row is independent.
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


STRONG: Final = 0.3
"""Part of a row's and a column's largest entry from which on pivots are as good as others."""

Order = tuple[tuple[int, int], ...]
"""Pivots, by row and column, in the order in which they are taken."""


def pivot_order(samples: Array, share: float = 0.1) -> Order:
    """Pivots of matrices of one pattern.

    Of those that are large enough in every sample the one with the least fill is taken (Markowitz's
    rule with threshold pivoting; Duff, Erisman and Reid 1986). Where none holds in all samples, the
    first half of them decides.

    :param samples: the matrix in some states, shape (k, n, n).
    :param share: least part of a row's and a column's largest entry that a pivot may have.
    :raises SingularityError: no pivot is left.
    """
    numbers = np.array(samples, float)
    scale = np.abs(numbers).max(initial=0.0)
    rows, columns = list(range(numbers.shape[1])), list(range(numbers.shape[1]))
    order: list[tuple[int, int]] = []
    while rows:
        block = np.abs(numbers[:, rows][:, :, columns])
        there = (block > ZERO * scale).any(0)
        large = np.maximum(block.max(2)[:, :, None], block.max(1)[:, None, :])
        good = there & (block > np.maximum(share * large, 1e-12)).all(0)
        if not good.any():
            if len(samples) > 1:
                return pivot_order(samples[: len(samples) // 2], share)
            raise SingularityError("the sample states", (), float(scale), share)
        fill = np.multiply.outer(there.sum(1) - 1, there.sum(0) - 1)
        # The first of the best: a finer choice would differ from machine to machine.
        strong = ((block / np.maximum(large, 1e-300)).min(0) > STRONG)[good]
        # The reciprocal of what is the same in all states is no sample's work.
        steady = (np.ptp(numbers[:, rows][:, :, columns], axis=0) < 1e-12 * scale)[good]
        best = int((fill[good] + 0.5 * ~strong + 0.6 * ~steady).argmin())
        i, j = (int(index[best]) for index in np.nonzero(good))
        row, column = rows.pop(i), columns.pop(j)
        order.append((row, column))
        ratio = numbers[:, rows, column] / numbers[:, row, column][:, None]
        numbers[:, rows] -= ratio[:, :, None] * numbers[:, row][:, None, :]
    return tuple(order)


class SparseLU:
    """Factors of a square matrix of expressions.

    :param matrix: shape (n, n), expressions or numbers.
    :param order: of pivots that are not zero, see :func:`pivot_order`.
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
        self.inverse_determinant: Any = sign
        """Reciprocal of the determinant."""
        for _, _, inverse in self._pivots:
            self.inverse_determinant = inverse * self.inverse_determinant

    def solve(self, right: Any) -> Objects:
        """X of A x = right, shape (n,)."""
        b = list(right)
        x: list[Any] = [0.0] * self.size
        for (row, _, _), lower in zip(self._pivots, self._lower, strict=True):
            for r, factor in lower.items():
                b[r] = b[r] - factor * b[row]
        for (row, column, inverse), upper in zip(
            reversed(self._pivots), reversed(self._upper), strict=True
        ):
            value = b[row]
            for c, factor in upper.items():
                value = value - factor * x[c]
            x[column] = value * inverse
        return _objects(x)

    def solve_transposed(self, right: Any) -> Objects:
        """Y of A' y = right, shape (n,)."""
        b = list(right)
        y: list[Any] = [0.0] * self.size
        for (row, column, inverse), upper in zip(self._pivots, self._upper, strict=True):
            value = y[row] = b[column] * inverse
            for c, factor in upper.items():
                b[c] = b[c] - factor * value
        for (row, _, _), lower in zip(reversed(self._pivots), reversed(self._lower), strict=True):
            for r, factor in lower.items():
                y[row] = y[row] - factor * y[r]
        return _objects(y)


def is_zero(value: Any) -> bool:
    """Whether an expression or a number is zero for all samples."""
    constant = getattr(value, "is_constant", None)
    return bool(constant(0.0)) if constant is not None else value == 0.0


def _objects(values: list[Any]) -> Objects:
    array = np.empty(len(values), dtype=object)
    array[:] = values
    return array
