# SPDX-License-Identifier: Apache-2.0
"""Programs as plain Python, for machines without a compiler: floats one by one, arrays in batches.

The same expressions, the same order of tests as the vector code; without fused products, so
results agree to rounding, not to the bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.codegen.expressions import GEOMETRY, PARAMETERS, Expression, ordered, uses
from pkm_twin.codegen.operations import OPERATIONS
from pkm_twin.codegen.program import (
    CHANGE,
    CLOSED,
    CONTRACTION,
    LARGE,
    RESIDUAL,
    STEPPED,
    TURNS,
    UNKNOWNS,
    Program,
    ahead,
    progress,
)

_LONGEST: Final = 200
"""Characters of an expression that is written into another one."""


_NUMBERS: Final = {"inf": math.inf, "nan": math.nan}
_ONE: Final = {op.name: op.one or op.numbers for op in OPERATIONS} | _NUMBERS
_MANY: Final = {op.name: op.many or op.numbers for op in OPERATIONS} | _NUMBERS


def source(
    results: Sequence[Expression],
    inputs: Mapping[str, int],
    known: Mapping[int, str] | None = None,
) -> str:
    """A function of the inputs' sequences that returns a tuple of the results.

    :param known: texts of expressions that are given.
    """
    counts = uses(results)
    text: dict[int, str] = dict(known or {})
    order = ordered(results, text)
    lines = [f"def program({', '.join(inputs)}):"]
    read: dict[str, set[int]] = {}
    for e in order:
        if e.source is not None:
            read.setdefault(e.source[0], set()).add(e.source[1])
    for name, size in inputs.items():
        if read.get(name):
            lines.append(f"    {', '.join(f'{name}{k}' for k in range(size))}, = {name}")
    for e in order:
        if e.source is not None:
            text[e.number] = "{}{}".format(*e.source)
        elif e.op is None:
            text[e.number] = f"({e.value!r})"
        else:
            written = e.op.text([text[x.number] for x in e.args])
            if counts[e.number] == 1 and len(written) < _LONGEST:
                text[e.number] = written
            else:
                text[e.number] = f"v{e.number}"
                lines.append(f"    v{e.number} = {written}")
    lines.append(f"    return ({''.join(f'{text[e.number]}, ' for e in results)})")
    return "\n".join(lines)


def functions(
    results: Sequence[Expression],
    inputs: Mapping[str, int],
    known: Mapping[int, str] | None = None,
) -> tuple[Callable[..., tuple[Any, ...]], Callable[..., tuple[Any, ...]]]:
    """The function of :func:`source` on floats, and the same on arrays."""
    code = compile(source(results, inputs, known), "<program>", "exec")
    made = []
    for library in (_ONE, _MANY):
        space: dict[str, Any] = dict(library)
        exec(code, space)  # noqa: S102
        made.append(space["program"])
    return made[0], made[1]


class PlainCode:
    """A program as two functions, one of floats and one of arrays over the samples."""

    def __init__(self, program: Program) -> None:
        self.program = program
        names = {**program.inputs, PARAMETERS: len(program.prepared)}
        equations = program.equations
        if equations is not None:
            names[UNKNOWNS] = len(equations.home)
        self._names = list(names)
        prepared = [*program.prepared, program.missed]
        given = {PARAMETERS: program.parameters, GEOMETRY: program.geometry}
        self._prepare = functions(prepared, given)[0]
        self._known = {e.number: f"{PARAMETERS}[{k}]" for k, e in enumerate(program.prepared)}
        results = [e for row in program.outputs.values() for e in row]
        self._judged = 0
        if equations is not None:
            results += [equations.residual, *equations.branch]
            self._judged = 1 + len(equations.branch)
        self._results = functions(results, names, self._known)
        self._correction = self._begun = self._start = None
        if equations is not None:
            self._correction = functions(equations.results, names, self._known)
            begun = [*equations.home, *equations.origin]
            self._begun = functions(begun, names, self._known)
            if equations.start is not None:
                self._start = functions(equations.start, names, self._known)

    def prepare(self, p: Array) -> Array:
        """What hangs on parameters alone, of machines (k, parameters): shape (k, prepared + 1)."""
        rows = []
        for row in p.tolist():
            try:
                own, geometry = row[: self.program.parameters], row[self.program.parameters :]
                rows.append(self._prepare(**{PARAMETERS: own, GEOMETRY: geometry}))
            except (ZeroDivisionError, ValueError, OverflowError):
                rows.append((math.nan,) * (len(self.program.prepared) + 1))
        return np.array(rows, np.float64).reshape(len(p), -1)

    def run(
        self, p: Array, inputs: Sequence[Array], count: int, steps: int
    ) -> tuple[list[Array], Array]:
        """Outputs (count, size) and status (count, 2), as the vector code gives them.

        :param inputs: shape (count, size), or (1, size) for all samples.
        """
        if count == 1:
            outputs, status = self._one(
                p.tolist(), [value.reshape(-1).tolist() for value in inputs], steps
            )
            return [np.array([row]) for row in outputs], np.array([status])
        with np.errstate(all="ignore"):
            return self._many(p, inputs, count, steps)

    def _split(self, values: Sequence[Any]) -> list[list[Any]]:
        rows, at = [], 0
        for row in self.program.outputs.values():
            rows.append(list(values[at : at + len(row)]))
            at += len(row)
        return rows

    def _one(
        self, p: list[float], inputs: list[list[float]], steps: int
    ) -> tuple[list[list[float]], tuple[float, float]]:
        nothing = [[math.nan] * len(row) for row in self.program.outputs.values()]
        named: dict[str, Any] = dict(zip(self.program.inputs, inputs, strict=True))
        named[PARAMETERS] = p
        reached = 1.0
        q = self.program.equations
        try:
            if q is not None:
                x, reached = self._solve_one(named, steps)
                if x is None:
                    return nothing, (1.0, reached)
                named[UNKNOWNS] = x
            values = list(self._results[0](**named))
        except (ZeroDivisionError, ValueError, OverflowError):
            return nothing, (2.0 if reached == 1.0 else 1.0, reached)
        if q is not None:
            at = len(values) - self._judged
            values, (residual, *branch) = values[:at], values[at:]
            if not (residual <= RESIDUAL**2 and all(value > 0.0 for value in branch)):
                return nothing, (1.0, reached)
        if not sum(map(abs, [*values, *(v for row in inputs for v in row)])) < LARGE:
            return nothing, (2.0, reached)
        return self._split(values), (0.0, reached)

    def _solve_one(self, named: dict[str, Any], steps: int) -> tuple[list[float] | None, float]:
        q = self.program.equations
        assert q is not None and self._correction is not None  # noqa: S101
        correction, goal = self._correction[0], named[q.target]
        assert self._begun is not None  # noqa: S101
        begun = list(self._begun[0](**{**named, UNKNOWNS: [0.0] * len(q.home)}))
        x, origin = begun[: len(q.home)], begun[len(q.home) :]
        if steps == 1 and self._start is not None:
            x = list(self._start[0](**{**named, UNKNOWNS: x}))
        least = q.least if steps == 1 else STEPPED
        for k in range(1, steps + 1):
            target = ahead(origin, goal, k, steps)
            size, before = (q.before if steps == 1 else 1e300), 0.0
            for _ in range(TURNS):
                *x, square, det = correction(**{**named, UNKNOWNS: x, q.target: target})
                steady = before == 0.0 or (before <= CHANGE * det and det <= CHANGE * before)
                if not (square <= CONTRACTION**2 * size and det > least and steady):
                    return None, progress((k - 1) / steps)
                size, before = square, det
                if square <= CLOSED**2:
                    break
            else:
                return None, progress((k - 1) / steps)
        return x, 1.0

    def _many(
        self, p: Array, inputs: Sequence[Array], count: int, steps: int
    ) -> tuple[list[Array], Array]:
        named: dict[str, Any] = {
            name: [np.broadcast_to(column, count) for column in value.T]
            for name, value in zip(self.program.inputs, inputs, strict=True)
        }
        named[PARAMETERS] = p.tolist()
        good, reached = np.ones(count, bool), np.ones(count)
        q = self.program.equations
        if q is not None:
            x, good, reached = self._solve_many(named, count, steps)
            named[UNKNOWNS] = list(x)
        values = [np.broadcast_to(v, count) for v in self._results[1](**named)]
        if q is not None:
            at = len(values) - self._judged
            values, (residual, *branch) = values[:at], values[at:]
            good = good & (residual <= RESIDUAL**2)
            for value in branch:
                good = good & (value > 0.0)
        total = np.zeros(count)
        for value in [*values, *(column for row in inputs for column in row.T)]:
            total = total + np.abs(value)
        finite = total < LARGE
        code = np.where(good, np.where(finite, 0.0, 2.0), 1.0)
        outputs = [
            np.where((good & finite)[:, None], _table(row, count).T, np.nan)
            for row in self._split(values)
        ]
        return outputs, np.stack([code, reached], -1)

    def _solve_many(
        self, named: dict[str, Any], count: int, steps: int
    ) -> tuple[Array, Mask, Array]:
        q = self.program.equations
        assert q is not None and self._correction is not None  # noqa: S101
        correction, goal = self._correction[1], named[q.target]
        assert self._begun is not None  # noqa: S101
        known = self._begun[1](**{**named, UNKNOWNS: [0.0] * len(q.home)})
        x, origin = _table(known[: len(q.home)], count), known[len(q.home) :]
        if steps == 1 and self._start is not None:
            x = _table(self._start[1](**{**named, UNKNOWNS: list(x)}), count)
        least = q.least if steps == 1 else STEPPED
        alive, reached = np.ones(count, bool), np.zeros(count)
        for k in range(1, steps + 1):
            target = ahead(origin, goal, k, steps)
            moving = alive.copy()
            size = np.full(count, q.before if steps == 1 else 1e300)
            before = np.zeros(count)
            for _ in range(TURNS):
                *new, square, det = correction(**{**named, UNKNOWNS: list(x), q.target: target})
                x = np.where(moving, _table(new, count), x)
                steady = (before <= CHANGE * det) & (det <= CHANGE * before)
                sound = (
                    (square <= CONTRACTION**2 * size) & (det > least) & (steady | (before == 0.0))
                )
                alive &= sound | ~moving
                size, before = np.broadcast_to(square, count), np.broadcast_to(det, count)
                moving &= alive & (size > CLOSED**2)
                if not moving.any():
                    break
            alive &= ~moving
            reached[alive] = progress(k / steps)
            if not alive.any():
                break
        return x, alive, reached


def _table(values: Sequence[Any], count: int) -> Array:
    """Numbers or arrays, a row each, shape (len(values), count); there may be none."""
    table: Array = np.empty((len(values), count))
    for row, value in zip(table, values, strict=True):
        row[:] = value
    return table
