# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Run programs in plain Python where llvmlite is missing: one sample as floats, many as arrays.

Expressions and the order of tests are those of the compiled code; products are not fused, so
results agree to rounding, not bit by bit.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import GEOMETRY, PARAMETERS, Expression, count_uses, list_dependencies
from pkm_twin.codegen.operations import OPERATIONS
from pkm_twin.codegen.program import (
    MAX_ITERATIONS,
    MAX_SUM,
    SOLUTION_PARTS,
    STATE,
    STATE_INDEX,
    Equations,
    Program,
    flag_solved,
    previous_input_name,
    progress,
)

_MAX_INLINE: Final = 200
"""Most characters of an expression that is written inline instead of as a variable."""


_NUMBERS: Final = {"inf": math.inf, "nan": math.nan}
_SCALAR_FUNCTIONS: Final[dict[str, Any]] = {op.name: op.one or op.numbers for op in OPERATIONS} | _NUMBERS
_ARRAY_FUNCTIONS: Final[dict[str, Any]] = {op.name: op.many or op.numbers for op in OPERATIONS} | _NUMBERS


def write_function(
    results: Sequence[Expression],
    inputs: Mapping[str, int],
    known: Mapping[int, str] | None = None,
) -> str:
    """Write a Python function of the inputs' sequences that returns the results as a tuple.

    :param known: Python expressions, by number, of values that exist already.
    """
    counts = count_uses(results)
    text: dict[int, str] = dict(known or {})
    order = list_dependencies(results, text)
    lines = [f"def program({', '.join(f'{name}=()' for name in inputs)}):"]
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
            if counts[e.number] == 1 and len(written) < _MAX_INLINE:
                text[e.number] = written
            else:
                text[e.number] = f"v{e.number}"
                lines.append(f"    v{e.number} = {written}")
    lines.append(f"    return ({''.join(f'{text[e.number]}, ' for e in results)})")
    return "\n".join(lines)


def compile_functions(
    results: Sequence[Expression],
    inputs: Mapping[str, int],
    known: Mapping[int, str] | None = None,
) -> tuple[Callable[..., tuple[Any, ...]], Callable[..., tuple[Any, ...]]]:
    """Compile the function of :func:`write_function` twice: for floats and for arrays."""
    code = compile(write_function(results, inputs, known), "<program>", "exec")
    compiled = []
    for library in (_SCALAR_FUNCTIONS, _ARRAY_FUNCTIONS):
        space: dict[str, Any] = dict(library)
        exec(code, space)  # noqa: S102
        compiled.append(space["program"])
    return compiled[0], compiled[1]


class PlainCode:
    """A program as Python functions: of floats for one sample, of arrays for many."""

    def __init__(self, program: Program) -> None:
        self.program = program
        names = {**program.inputs, PARAMETERS: len(program.prepared)}
        results = [e for row in program.outputs.values() for e in row]
        results += flag_solved(program.equations)
        parts: dict[Any, Sequence[Expression]] = {"results": results}
        for q in program.equations:
            names |= q.inputs
            parts |= {(q, name): getattr(q, name) for name in SOLUTION_PARTS}
        known = {e.number: f"{PARAMETERS}[{k}]" for k, e in enumerate(program.prepared)}
        self._parts = {name: compile_functions(part, names, known) for name, part in parts.items()}
        given = {PARAMETERS: program.parameters, GEOMETRY: program.geometry_count}
        self._prepare = compile_functions([*program.prepared, program.missed], given)[0]

    def prepare(self, p: Array) -> Array:
        """Compute the expressions of parameters alone, (k, parameters) to (k, prepared + 1)."""
        own = self.program.parameters
        rows = [self._prepare(**{PARAMETERS: row[:own], GEOMETRY: row[own:]}) for row in p.tolist()]
        return np.array(rows, np.float64).reshape(len(p), -1)

    def run(self, p: Array, inputs: Sequence[Array], count: int, steps: int) -> tuple[list[Array], Array]:
        """Return outputs (count, size) and status (count, 2), as the compiled code gives them.

        :param inputs: shape (count, size), or (1, size) for all samples.
        """
        many = count > 1
        columns = [list(value.T) if many else value.ravel().tolist() for value in inputs]
        named: dict[str, Any] = dict(zip(self.program.inputs, columns, strict=True))
        named[PARAMETERS] = p.tolist()
        n: list[Any] = [0.0] * len(STATE_INDEX)
        n[STATE_INDEX.once], n[STATE_INDEX.alive], n[STATE_INDEX.reached] = float(steps == 1), 1.0, 0.0
        if not self.program.equations:
            n[STATE_INDEX.reached] = 1.0
        with np.errstate(all="ignore"):
            for q in self.program.equations:
                self._solve(q, named, n, steps, many=many)
            values = self._evaluate("results", named, many=many)
            good: Any = n[STATE_INDEX.alive] * (values.pop() if self.program.equations else 1.0)
            total = sum(map(abs, [*values, *(x for column in columns for x in column)]))
            own = _ARRAY_FUNCTIONS if many else _SCALAR_FUNCTIONS
            finite = own["select"](own["less"](total, MAX_SUM), 0.0, 2.0)
            code = own["select"](good, finite, 1.0)
        table = np.empty((count, len(values)))
        for k, value in enumerate(values):
            table[:, k] = value
        status = np.empty((count, 2))
        status[:, 0], status[:, 1] = code, n[STATE_INDEX.reached]
        table[status[:, 0] != 0.0] = np.nan
        ends = itertools.accumulate(map(len, self.program.outputs.values()), initial=0)
        return [table[:, a:b].copy() for a, b in itertools.pairwise(ends)], status

    def _evaluate(self, part: Any, named: dict[str, Any], *, many: bool) -> list[Any]:
        return list(self._parts[part][many](**named))

    def _solve(self, q: Equations, named: dict[str, Any], n: list[Any], steps: int, *, many: bool) -> None:
        """Solve equations by Newton's method from state n; store the unknowns in ``named``."""
        named[STATE] = n
        any_of: Callable[[Any], Any] = np.any if many else bool

        def evaluate(part: str, inputs: dict[str, Any] = named) -> list[Any]:
            return self._evaluate((q, part), inputs, many=many)

        if q.goal:
            named[q.target] = evaluate("goal")
        before = x = evaluate("home")
        for k in range(1, steps + 1):
            n[STATE_INDEX.part], n[STATE_INDEX.onward], n[STATE_INDEX.moving] = (
                *progress(k, steps),
                n[STATE_INDEX.alive],
            )
            guesses = {q.unknowns: x, previous_input_name(q.unknowns): before}
            step_inputs = named | guesses | {q.target: evaluate("step_target")}
            before = x
            if k == 1:
                *x, size = evaluate("begin", step_inputs)
            else:
                x = evaluate("onward", step_inputs)
            n[STATE_INDEX.size], step_inputs[q.unknowns] = size, x
            for _ in range(MAX_ITERATIONS):
                after = evaluate("corrected_state", step_inputs)
                x, n[STATE_INDEX.size : STATE_INDEX.reached] = after[: len(q.home)], after[len(q.home) :]
                step_inputs[q.unknowns] = x
                if not any_of(n[STATE_INDEX.moving]):
                    break
            n[STATE_INDEX.alive], n[STATE_INDEX.reached] = evaluate("flags_after_step")
            if not any_of(n[STATE_INDEX.alive]):
                break
        named[q.unknowns] = x
