# SPDX-License-Identifier: Apache-2.0
"""Sparse linear equations as straight-line expressions, pivots chosen beforehand on numbers.

May import: numpy, this package, the standard library.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.expressions import Objects
from pkm_twin.errors import SingularityError

Array = NDArray[np.float64]


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


class SparseLU:
    """Factors of a square matrix of expressions.

    Of the pivots that are large enough in every sample matrix the one with the least fill
    is taken (Markowitz's rule with threshold pivoting; Duff, Erisman and Reid 1986).

    :param matrix: shape (n, n), expressions or numbers.
    :param samples: its values in some states, shape (k, n, n).
    :param share: least part of a row's and a column's largest entry that a pivot may have.
    :raises SingularityError: no pivot is left.
    """

    def __init__(self, matrix: Objects, samples: Array, share: float = 0.1) -> None:
        n = self.size = len(matrix)
        rows: list[dict[int, Any]] = [
            {c: matrix[r][c] for c in range(n) if not is_zero(matrix[r][c])} for r in range(n)
        ]
        numbers = np.array(samples, float)
        open_rows, open_columns = set(range(n)), set(range(n))
        self._pivots: list[tuple[int, int, Any]] = []
        self._lower: list[dict[int, Any]] = []
        self._upper: list[dict[int, Any]] = []
        sign = 1.0
        while open_rows:
            row, column = self._choose(rows, numbers, open_rows, open_columns, share)
            sign *= (
                -1.0
                if (sorted(open_rows).index(row) + sorted(open_columns).index(column)) % 2
                else 1.0
            )
            inverse = 1.0 / rows[row][column]
            open_rows.remove(row)
            upper = {c: rows[row][c] for c in rows[row] if c in open_columns and c != column}
            open_columns.remove(column)
            lower = {}
            for r in sorted(open_rows):
                if column not in rows[r]:
                    continue
                factor = lower[r] = rows[r].pop(column) * inverse
                for c, value in upper.items():
                    product = factor * value
                    rows[r][c] = rows[r][c] - product if c in rows[r] else -product
                ratio = numbers[:, r, column] / numbers[:, row, column]
                numbers[:, r] -= ratio[:, None] * numbers[:, row]
            self._pivots.append((row, column, inverse))
            self._lower.append(lower)
            self._upper.append(upper)
        self.inverse_determinant: Any = sign
        """Reciprocal of the determinant."""
        for _, _, inverse in self._pivots:
            self.inverse_determinant = inverse * self.inverse_determinant

    @staticmethod
    def _choose(
        rows: list[dict[int, Any]],
        numbers: Array,
        open_rows: set[int],
        open_columns: set[int],
        share: float,
    ) -> tuple[int, int]:
        in_column = {c: sum(c in rows[r] for r in open_rows) for c in open_columns}
        size = np.abs(numbers)
        order, columns = sorted(open_rows), sorted(open_columns)
        block = size[:, order][:, :, columns]
        by_row, by_column = block.max(2), block.max(1)
        best: tuple[float, float, int, int] | None = None
        for i, r in enumerate(order):
            entries = [c for c in rows[r] if c in open_columns]
            for j, c in enumerate(columns):
                if c not in rows[r]:
                    continue
                value = block[:, i, j]
                large = np.maximum(by_row[:, i], by_column[:, j])
                if not (value > np.maximum(share * large, 1e-12)).all():
                    continue
                key = (
                    float((len(entries) - 1) * (in_column[c] - 1)),
                    -float((value / large).min()),
                    r,
                    c,
                )
                best = key if best is None or key < best else best
        if best is None:
            raise SingularityError("the sample states", (), float(size.max(initial=0.0)), share)
        return best[2], best[3]

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
