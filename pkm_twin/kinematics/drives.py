# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""All drives of a machine, which may be more than its degrees of freedom.

As many drives as there are degrees of freedom lead (are independent): the closures are solved at
their m positions, and the positions of the other drives follow. With the rates qd of the leading
drives, the rates of all n drives are B qd, and efforts tau of all drives are equivalent to efforts
B' tau of the leading drives alone. Rows of N are efforts that cause no motion, N B = 0; along them
the sum of (effort / limit)^2 is minimised. If all drives lead, B is the identity and N is empty.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.cholesky import SparseCholesky
from pkm_twin.codegen.expressions import Numbers, Objects
from pkm_twin.codegen.operations import absolute, cos, sin, sqrt

LEADS: Final = "leads"
"""Name of the input with the leading drives' positions, in programs whose ``q`` is of all drives."""
TOLERANCE_TIME: Final = 0.01
"""Divisor that converts the tolerance of positions to a tolerance of velocities, s."""


class Drives:
    """The drives of a symbolic machine; before its closures are solved, only inputs are available.

    :param t: the machine, a :class:`~pkm_twin.kinematics.traced.Traced`.
    """

    def __init__(self, t: Any) -> None:
        self.t, self.graph = t, t.graph
        self.count = len(self.graph.actuated)
        self.leading = self.graph.leading
        self.others = [k for k in range(self.count) if k not in self.leading]
        self._inputs: dict[str, tuple[Objects, Objects]] = {}
        self._margins: list[Any] = []

    def leading_inputs(self, name: str) -> Objects:
        """Return the leading drives' inputs, shape (m,); the other drives' inputs are checked later."""
        values = self.t.tape.inputs(name, self.count)
        _, leads = self._inputs.setdefault(name, (values, values[self.leading]))
        return leads

    def variables(self, name: str) -> list[Any]:
        """Return the inputs of all drives as variables of differentiation, shape (n,)."""
        values = list(self.t.tape.inputs(name, self.count))
        for k, lead in zip(self.leading, self.t.q, strict=True):
            values[k] = lead if name == "q" else values[k]
        return values

    def check_dependent(self, name: str, leads: Numbers, rest: Numbers, time: float) -> None:
        """Compare the other drives' inputs with the rates or accelerations that the leading cause."""
        values, own = self._inputs.get(name, ((), ()))
        if own is leads:
            for k in self.others:
                apart = rest[self.t.tree.drives[k].rate] - values[k]
                self._margins.append(self._tolerance(k) / time - absolute(apart))

    def tolerance_margins(self) -> list[Any]:
        """Return margins that are all positive if no drive contradicts the leading drives."""
        q, found = self.t.tape.inputs("q", self.count), list(self._margins)
        for k in self.others:
            x, step = self.t.x, self.t.tree.drives[k]
            away = q[k] - self.graph.joints[step.joint].home
            if step.circle:
                # Closures do not count turns: the drive must be within half a turn of home.
                found.append(np.pi + self._tolerance(k) - absolute(away))
                c, s = x[step.position], x[step.position + 1]
                away, facing = s * cos(away) - c * sin(away), c * cos(away) + s * sin(away)
                found.append(facing)
            else:
                away = x[step.position] - away
            found.append(self._tolerance(k) - absolute(away))
        return found

    def _tolerance(self, k: int) -> Any:
        slides = self.graph.joints[self.graph.actuated[k]].slides
        tolerance = self.graph.sharing[0]
        return tolerance * self.t.tree.size if slides else tolerance

    @cached_property
    def null_rows(self) -> list[list[Any]]:
        """N: for each redundant drive, efforts without motion in which its own effort is one."""
        t = self.t
        steps = [t.tree.drives[k] for k in self.others]
        kept = t.jq[t.scheme.independent] if steps else np.zeros((0, 0))
        units = np.eye(t.tree.unknown_rates)
        self.set_null_rows([-(kept.T @ t.lu.solve_transposed(units[s.rate])) for s in steps])
        return self.null_rows

    def set_null_rows(self, rates: Sequence[Objects]) -> None:
        """Set N from the rate of each redundant drive per rate of the leading drives."""
        self.null_rows = []
        for k, own in zip(self.others, rates, strict=True):
            row: list[Any] = [0.0] * self.count
            row[k] = 1.0
            for j, value in zip(self.leading, own, strict=True):
                row[j] = -value
            self.null_rows.append(row)

    @cached_property
    def _weights(self) -> list[Any]:
        limits = self.graph.sharing[1 : 1 + self.count]
        return [1.0 / (limit * limit) for limit in limits]

    @cached_property
    def _null_factors(self) -> SparseCholesky:
        """Factors of N W N'."""
        rows, lower = self.null_rows, {}
        for i, a in enumerate(rows):
            for j, b in enumerate(rows[: i + 1]):
                parts = zip(a, self._weights, b, strict=True)
                lower[i, j] = sum((x * w * y for x, w, y in parts), 0.0)
        return SparseCholesky(lower, [lower[i, i] for i in range(len(rows))])

    def distribute(self, leads: Sequence[Any], *, preload: bool = False) -> list[Any]:
        """Return efforts of all drives equivalent to efforts ``leads`` of the leading, shape (n,).

        Of all such efforts, divided by their limits, these are nearest to the preload or to zero.
        """
        if not self.others:
            return list(leads)
        efforts: list[Any] = [0.0] * self.count
        for k, value in zip(self.leading, leads, strict=True):
            efforts[k] = value
        wanted = self.graph.sharing[1 + self.count :] if preload else np.zeros(self.count)
        apart = [(a - p) * w for a, p, w in zip(efforts, wanted, self._weights, strict=True)]
        rows = self.null_rows
        sums = [sum((a * b for a, b in zip(row, apart, strict=True)), 0.0) for row in rows]
        for amount, row in zip(self._null_factors.solve(sums), rows, strict=True):
            efforts = [effort - amount * value for effort, value in zip(efforts, row, strict=True)]
        return efforts

    def distribute_matrix(self, matrix: Objects) -> list[Any]:
        """Distribute a mass matrix of the leading drives to all drives, (n n,) by row."""
        rows: Any = matrix.tolist()
        for _ in range(2):
            rows = [self.distribute(row) for row in zip(*rows, strict=True)]
        return [value for row in rows for value in row]

    def leading_efforts(self, efforts: Sequence[Any]) -> list[Any]:
        """Return B' tau: the leading drives' efforts equivalent to those of all, shape (m,)."""
        result = [efforts[k] for k in self.leading]
        for k, row in zip(self.others, self.null_rows, strict=True):
            result = [a - row[j] * efforts[k] for a, j in zip(result, self.leading, strict=True)]
        return result

    def drive_accelerations(self, leads: Sequence[Any], bias: Numbers) -> list[Any]:
        """Return the accelerations of all drives.

        :param leads: accelerations of the leading drives. ``bias``: accelerations of the unknowns
            while the leading drives have none.
        """
        result: list[Any] = [0.0] * self.count
        for k, value in zip(self.leading, leads, strict=True):
            result[k] = value
        for k, row in zip(self.others, self.null_rows, strict=True):
            result[k] = bias[self.t.tree.drives[k].rate]
            for j, value in zip(self.leading, leads, strict=True):
                result[k] = result[k] - row[j] * value
        return result

    def null_efforts(self) -> list[list[Any]]:
        """Return N with rows that are orthonormal for efforts divided by their limits."""
        if not self.others:
            return []
        columns = [self._null_factors.forward(list(column)) for column in zip(*self.null_rows, strict=True)]
        return [
            [column[i] * sqrt(inverse) for column in columns] for i, inverse in enumerate(self._null_factors.inverses)
        ]
