# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Scalar expressions with sharing: formulas run once on these give a program for any back end.

Formulas are written for numbers and run on expressions too: numpy's object arrays of expressions
add, multiply and take sines like arrays of floats. Equal expressions of one tape are one object,
and what is zero, one or constant folds away while it is written.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.operations import (
    CONSTANT,
    PARAMETER,
    SAMPLE,
    Operation,
    add,
    cos,
    divide,
    mul,
    neg,
    sin,
    sqrt,
    sub,
)

Objects = NDArray[Any]
"""Array of expressions, of floats, or of both."""

Numbers = Sequence[Any] | NDArray[Any]
"""Some expressions or numbers in a row."""

PARAMETERS: Final = "p"
GEOMETRY: Final = "g"
"""Names of the inputs that are the same for all samples of a machine: those of a program's own, and
the machine's geometry."""


_number_of: Final = operator.attrgetter("number")
_level_of: Final = operator.attrgetter("level")


class Tape:
    """The expressions of one program.

    :param reference: values of the geometry in a known case: what hangs on it alone has a value
        there, and :func:`snapped` may take it for a constant.
    :param free: nothing is taken for a constant, as where the geometry is differentiated by.
    """

    def __init__(self, reference: Sequence[float] = (), *, free: bool = False) -> None:
        self._known: dict[tuple[Any, ...], Expression] = {}
        self.reference, self.free = reference, free
        self.assumed: list[tuple[Expression, float]] = []
        """Expressions of parameters that are taken for a constant."""

    def __len__(self) -> int:
        return len(self._known)

    def constant(self, value: float) -> Expression:
        """A number."""
        # The sign of zero counts: it is a different number to atan2.
        key = (None, value, math.copysign(1.0, value))
        return self._known.get(key) or self._new(key, None, (), CONSTANT, float(value))

    def input(self, name: str, index: int) -> Expression:
        """Entry ``index`` of the input ``name``."""
        key = (name, index)
        known = self._known.get(key)
        if known is None:
            level = PARAMETER if name in (PARAMETERS, GEOMETRY) else SAMPLE
            value = float(self.reference[index]) if name == GEOMETRY else math.nan
            known = self._new(key, None, (), level, value)
            known.source = key
        return known

    def inputs(self, name: str, size: int) -> Objects:
        """All entries of an input, shape (size,)."""
        array = np.empty(size, dtype=object)
        array[:] = [self.input(name, i) for i in range(size)]
        return array

    def lift(self, value: Any) -> Expression:
        """An expression as it is, a number as a constant."""
        return value if isinstance(value, Expression) else self.constant(float(value))

    def make(self, op: Operation, *args: Expression) -> Expression:
        """The operation on expressions, one object for equal ones."""
        if op.commutes and args[0].number > args[1].number:
            args = args[::-1]
        key = (op, *map(_number_of, args))
        known = self._known.get(key)
        if known is not None:
            return known
        level = max(map(_level_of, args))
        value = math.nan
        if level == PARAMETER:
            value = (op.one or op.numbers)(*[x.value for x in args])
        return self._new(key, op, args, level, value)

    def _new(
        self, key: Any, op: Operation | None, args: tuple[Expression, ...], level: int, value: float
    ) -> Expression:
        result = self._known[key] = Expression(self, op, args, len(self._known), level, value)
        return result


class Expression:
    """A constant, an input or an operation on ``args``.

    ``source``: name and index of an input. ``value``: of a constant, else in the tape's known case,
    NaN where it hangs on the sample.
    """

    __slots__ = ("args", "level", "number", "op", "source", "tape", "value")

    def __init__(
        self, tape: Tape, op: Operation | None, args: tuple[Expression, ...], number: int,
        level: int, value: float,
    ) -> None:  # fmt: skip
        self.tape, self.op, self.args = tape, op, args
        self.number, self.level, self.value = number, level, value
        self.source: tuple[str, int] | None = None

    def is_constant(self, value: float) -> bool:
        """Whether it is this number."""
        return self.level == CONSTANT and self.value == value

    def _with(self, op: Operation, other: Any, *, after: bool = False) -> Any:
        """The operation on this and another value, or, ``after``, on that and this."""
        if other.__class__ is not Expression:
            if isinstance(other, np.ndarray):
                return NotImplemented
            other = self.tape.lift(other)
        a, b = (other, self) if after else (self, other)
        return (
            op.fold(a, b)
            if a.level or b.level
            else self.tape.constant(op.numbers(a.value, b.value))
        )

    def __add__(self, other: Any) -> Any:
        return self._with(add, other)

    def __radd__(self, other: Any) -> Any:
        return self._with(add, other, after=True)

    def __sub__(self, other: Any) -> Any:
        return self._with(sub, other)

    def __rsub__(self, other: Any) -> Any:
        return self._with(sub, other, after=True)

    def __mul__(self, other: Any) -> Any:
        return self._with(mul, other)

    def __rmul__(self, other: Any) -> Any:
        return self._with(mul, other, after=True)

    def __truediv__(self, other: Any) -> Any:
        return self._with(divide, other)

    def __rtruediv__(self, other: Any) -> Any:
        return self._with(divide, other, after=True)

    def __neg__(self) -> Any:
        return neg(self)

    def __pow__(self, power: int) -> Any:
        result: Any = self
        for _ in range(power - 1):
            result = result * self
        return result

    # As numpy calls them on arrays of objects.

    def sqrt(self) -> Any:
        """Square root."""
        return sqrt(self)

    def sin(self) -> Any:
        """Sine."""
        return sin(self)

    def cos(self) -> Any:
        """Cosine."""
        return cos(self)

    def __repr__(self) -> str:
        return f"<{self.op or self.source or self.value} {self.number}>"


SNAP: Final = 1e-14
"""How far rounding leaves a number from 0, 1 or -1 that it is."""


def reference(value: Any) -> float:
    """A number, or an expression's value in its tape's known case."""
    return value.value if isinstance(value, Expression) else float(value)


def number(value: Any) -> Any:
    """A number as Python's own, an expression as it is."""
    return value if isinstance(value, Expression) else float(value)


def references(values: Any) -> NDArray[np.float64]:
    """The same of every entry of an array."""
    array = np.asarray(values)
    if array.dtype != object:
        return np.asarray(array, np.float64)
    return np.asarray(np.frompyfunc(reference, 1, 1)(array), np.float64)


def plain(values: Any) -> NDArray[Any]:
    """An array of floats where all are numbers, else of objects."""
    if isinstance(values, np.ndarray) and values.dtype != object:
        return np.asarray(values, np.float64)
    objects = np.asarray(values, dtype=object)
    if any(isinstance(value, Expression) for value in objects.ravel()):
        return objects
    return np.asarray(values, np.float64)


def norm(vector: NDArray[Any]) -> Any:
    """Length of a vector of numbers or expressions."""
    if vector.dtype != object:
        return float(np.linalg.norm(vector))
    return sqrt(vector @ vector)


def snapped_all(values: Any) -> NDArray[Any]:
    """Every entry as :func:`snapped`."""
    array = plain(values)
    if array.dtype != object:
        near = np.rint(array).clip(-1.0, 1.0) + 0.0
        return np.where(np.abs(array - near) < SNAP, near, array)
    return plain(np.frompyfunc(snapped, 1, 1)(array))


def snapped(value: Any) -> Any:
    """A number beside 0, 1 or -1 as that: rounding left it there, and it folds away so.

    An expression of parameters that is so in the known case is taken for the constant; the tape
    notes that it was.
    """
    if isinstance(value, Expression) and value.tape.free:
        return value
    known = reference(value)
    for target in (0.0, 1.0, -1.0):
        if abs(known - target) < SNAP:
            if isinstance(value, Expression) and value.level != CONSTANT:
                value.tape.assumed.append((value, target))
            return target
    return value


def ordered(results: Iterable[Expression], known: Iterable[int] = ()) -> list[Expression]:
    """Everything that the results depend on, arguments first; nothing below what is known."""
    seen: set[int] = set(known)
    order: list[Expression] = []
    for result in results:
        stack = [(result, False)]
        while stack:
            e, done = stack.pop()
            if done:
                order.append(e)
                continue
            if e.number in seen:
                continue
            seen.add(e.number)
            if e.args:
                stack.append((e, True))
                for x in e.args:
                    if x.number not in seen:
                        stack.append((x, False))
            else:
                order.append(e)
    return order


def uses(results: Sequence[Expression]) -> dict[int, int]:
    """How often each operation's value is used, by number; a result counts as used often."""
    counts: dict[int, int] = {}
    for e in ordered(results):
        for x in e.args:
            counts[x.number] = counts.get(x.number, 0) + 1
    for result in results:
        counts[result.number] = counts.get(result.number, 0) + 2
    return counts


def count(results: Iterable[Expression]) -> int:
    """Operations a sample: without inputs, constants and what hangs on parameters alone."""
    return sum(e.level == SAMPLE and e.op is not None for e in ordered(results))


def edge(results: Iterable[Expression]) -> list[Expression]:
    """What hangs on parameters alone and is a result, or read by what hangs on samples."""
    results = list(results)
    found = {e.number: e for e in results if e.level == PARAMETER}
    for e in ordered(results):
        if e.level == SAMPLE:
            found |= {x.number: x for x in e.args if x.level == PARAMETER}
    return list(found.values())


def adjoints(sums: Iterable[tuple[Any, Any]], by: Sequence[Expression]) -> list[Any]:
    """Derivatives of a sum of products by inputs, as expressions, backwards.

    Reverse mode of algorithmic differentiation, as :func:`tangents` is the forward mode (Griewank
    and Walther 2008, chapter 3).

    :param sums: expressions and what each is multiplied by, which is taken for constant.
    """
    bars: dict[int, Any] = {}
    pairs = [(e, weight) for e, weight in sums if isinstance(e, Expression)]
    for e, weight in pairs:
        bars[e.number] = bars.get(e.number, 0.0) + weight
    wanted = {e.number for e in by}
    order = ordered([e for e, _ in pairs])
    for e in order:
        if any(x.number in wanted for x in e.args):
            wanted.add(e.number)
    for e in reversed(order):
        bar = bars.get(e.number)
        if bar is None or e.op is None or e.number not in wanted:
            continue
        for x, slope in zip(e.args, e.op.slopes(e, *e.args), strict=True):
            if x.number in wanted:
                bars[x.number] = bars.get(x.number, 0.0) + bar * slope
    return [bars.get(e.number, 0.0) for e in by]


def tangents(results: Sequence[Expression], by: Sequence[Expression]) -> list[list[Any]]:
    """Derivatives of expressions by inputs as expressions, a row of them a result."""
    rows: dict[int, dict[int, Any]] = {e.number: {k: 1.0} for k, e in enumerate(by)}
    for e in ordered(results):
        if e.op is None or e.number in rows or not any(rows[x.number] for x in e.args):
            rows.setdefault(e.number, {})
            continue
        total: dict[int, Any] = {}
        for x, slope in zip(e.args, e.op.slopes(e, *e.args), strict=True):
            for k, value in rows[x.number].items():
                total[k] = total.get(k, 0.0) + slope * value
        rows[e.number] = total
    return [[rows[e.number].get(k, 0.0) for k in range(len(by))] for e in results]
