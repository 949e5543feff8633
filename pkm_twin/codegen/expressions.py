# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Record formulas as shared scalar expressions, from which every back end writes its program.

Formulas written for numbers run on expressions, too: numpy's object arrays of expressions add,
multiply and take sines like arrays of floats. Equal expressions of one tape are one object, and
operations on constants are folded while they are recorded.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.operations import (
    CONSTANT_LEVEL,
    PARAMETER_LEVEL,
    SAMPLE_LEVEL,
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
"""A sequence or array of expressions and numbers."""

PARAMETERS: Final = "p"
GEOMETRY: Final = "g"
"""Names of the inputs that are equal for all samples: a program's own parameters and the machine's
geometry."""


_number_of: Final = operator.attrgetter("number")
_level_of: Final = operator.attrgetter("level")


class Tape:
    """The expressions of one program, each recorded once.

    :param reference: reference values of the geometry. Expressions of the geometry alone have a
        value there, and :func:`snapped` may replace them by a constant.
    :param free: keep the geometry symbolic: never replace its expressions by constants. Derivatives
        with respect to the geometry need this.
    """

    def __init__(self, reference: Sequence[float] = (), *, free: bool = False) -> None:
        self._known: dict[tuple[Any, ...], Expression] = {}
        self.reference, self.free = reference, free
        self.assumed: list[tuple[Expression, float]] = []
        """Expressions of parameters that were replaced by a constant, with this constant."""

    def __len__(self) -> int:
        return len(self._known)

    def constant(self, value: float) -> Expression:
        """Return the expression of a constant."""
        # atan2 distinguishes 0.0 from -0.0.
        key = (None, value, math.copysign(1.0, value))
        return self._known.get(key) or self._new(key, None, (), CONSTANT_LEVEL, float(value))

    def input(self, name: str, index: int) -> Expression:
        """Return entry ``index`` of the input ``name``."""
        key = (name, index)
        known = self._known.get(key)
        if known is None:
            level = PARAMETER_LEVEL if name in (PARAMETERS, GEOMETRY) else SAMPLE_LEVEL
            value = float(self.reference[index]) if name == GEOMETRY else math.nan
            known = self._new(key, None, (), level, value)
            known.source = key
        return known

    def inputs(self, name: str, size: int) -> Objects:
        """Return all entries of an input, shape (size,)."""
        array = np.empty(size, dtype=object)
        array[:] = [self.input(name, i) for i in range(size)]
        return array

    def lift(self, value: Any) -> Expression:
        """Convert a number to a constant; return an expression unchanged."""
        return value if isinstance(value, Expression) else self.constant(float(value))

    def make(self, op: Operation, *args: Expression) -> Expression:
        """Record an operation; return the same object for equal expressions."""
        if op.commutes and args[0].number > args[1].number:
            args = args[::-1]
        key = (op, *map(_number_of, args))
        known = self._known.get(key)
        if known is not None:
            return known
        level = max(map(_level_of, args))
        value = math.nan
        if level == PARAMETER_LEVEL:
            value = (op.one or op.numbers)(*[x.value for x in args])
        return self._new(key, op, args, level, value)

    def _new(
        self, key: Any, op: Operation | None, args: tuple[Expression, ...], level: int, value: float
    ) -> Expression:
        result = self._known[key] = Expression(self, op, args, len(self._known), level, value)
        return result


class Expression:
    """A constant, an input or an operation on ``args``.

    ``source``: name and index of an input. ``level``: what the expression depends on:
    CONSTANT_LEVEL, PARAMETER_LEVEL or SAMPLE_LEVEL. ``value``: the constant, or the value at the
    tape's reference geometry; NaN if the expression depends on the sample.
    """

    __slots__ = ("args", "level", "number", "op", "source", "tape", "value")

    def __init__(
        self,
        tape: Tape,
        op: Operation | None,
        args: tuple[Expression, ...],
        number: int,
        level: int,
        value: float,
    ) -> None:
        self.tape, self.op, self.args = tape, op, args
        self.number, self.level, self.value = number, level, value
        self.source: tuple[str, int] | None = None

    def is_constant(self, value: float) -> bool:
        """Return whether the expression is this constant."""
        return self.level == CONSTANT_LEVEL and self.value == value

    def _with(self, op: Operation, other: Any, *, after: bool = False) -> Any:
        """Apply an operation to this and another value, in reverse order with ``after``."""
        if other.__class__ is not Expression:
            if isinstance(other, np.ndarray):
                return NotImplemented
            other = self.tape.lift(other)
        a, b = (other, self) if after else (self, other)
        return op.fold(a, b) if a.level or b.level else self.tape.constant(op.numbers(a.value, b.value))

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

    # numpy calls these methods on the entries of object arrays.

    def sqrt(self) -> Any:
        """Return the square root."""
        return sqrt(self)

    def sin(self) -> Any:
        """Return the sine."""
        return sin(self)

    def cos(self) -> Any:
        """Return the cosine."""
        return cos(self)

    def __repr__(self) -> str:
        return f"<{self.op or self.source or self.value} {self.number}>"


SNAP: Final = 1e-14
"""Largest difference from 0, 1 or -1 that counts as rounding: some fifty units of 2.2e-16."""


def reference(value: Any) -> float:
    """Return a number, or an expression's value at its tape's reference geometry."""
    return value.value if isinstance(value, Expression) else float(value)


def number(value: Any) -> Any:
    """Convert a number to a Python float; return an expression unchanged."""
    return value if isinstance(value, Expression) else float(value)


def references(values: Any) -> NDArray[np.float64]:
    """Return :func:`reference` of every entry of an array."""
    array = np.asarray(values)
    if array.dtype != object:
        return np.asarray(array, np.float64)
    return np.asarray(np.frompyfunc(reference, 1, 1)(array), np.float64)


def plain(values: Any) -> NDArray[Any]:
    """Convert values to an array of floats, or of objects if one is an expression."""
    if isinstance(values, np.ndarray) and values.dtype != object:
        return np.asarray(values, np.float64)
    objects = np.asarray(values, dtype=object)
    if any(isinstance(value, Expression) for value in objects.ravel()):
        return objects
    return np.asarray(values, np.float64)


def cross(a: Any, b: Any) -> NDArray[Any]:
    """Return the vector product over the last axis.

    Of single vectors, whose numbers may be expressions, it is an array of objects.
    """
    a, b = np.asarray(a), np.asarray(b)
    if a.ndim != 1 or b.ndim != 1:
        # As np.cross, which takes three times as long for the few rows that there are.
        (ax, ay, az), (bx, by, bz) = ((v[..., 0], v[..., 1], v[..., 2]) for v in (a, b))
        return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], -1)
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    product = [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]
    return np.array(product, object)


def norm(vector: NDArray[Any]) -> Any:
    """Return the Euclidean norm of a vector of numbers or expressions."""
    if vector.dtype != object:
        return float(np.linalg.norm(vector))
    return sqrt(vector @ vector)


def snapped_all(values: Any) -> NDArray[Any]:
    """Apply :func:`snapped` to every entry."""
    array = plain(values)
    if array.dtype != object:
        near = np.rint(array).clip(-1.0, 1.0) + 0.0
        return np.where(np.abs(array - near) < SNAP, near, array)
    return plain(np.frompyfunc(snapped, 1, 1)(array))


def snapped(value: Any) -> Any:
    """Replace a number within rounding of 0, 1 or -1 by that constant, so that it is folded.

    An expression of parameters with such a value at the reference geometry is replaced, too; the
    tape records it as assumed.
    """
    if isinstance(value, Expression) and value.tape.free:
        return value
    known = reference(value)
    for target in (0.0, 1.0, -1.0):
        if abs(known - target) < SNAP:
            if isinstance(value, Expression) and value.level != CONSTANT_LEVEL:
                value.tape.assumed.append((value, target))
            return target
    return value


def list_dependencies(results: Iterable[Expression], known: Iterable[int] = ()) -> list[Expression]:
    """List all expressions that the results depend on, arguments first; stop at known numbers."""
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


def count_uses(results: Sequence[Expression]) -> dict[int, int]:
    """Count the uses of each expression, by number; being a result counts as two uses."""
    counts: dict[int, int] = {}
    for e in list_dependencies(results):
        for x in e.args:
            counts[x.number] = counts.get(x.number, 0) + 1
    for result in results:
        counts[result.number] = counts.get(result.number, 0) + 2
    return counts


def count(results: Iterable[Expression]) -> int:
    """Count the operations per sample, without those of expressions of parameters."""
    return sum(e.level == SAMPLE_LEVEL and e.op is not None for e in list_dependencies(results))


def find_prepared(results: Iterable[Expression]) -> list[Expression]:
    """Find the expressions that are computed once per machine: of parameters, used by samples or as results."""
    results = list(results)
    found = {e.number: e for e in results if e.level == PARAMETER_LEVEL}
    for e in list_dependencies(results):
        if e.level == SAMPLE_LEVEL:
            found |= {x.number: x for x in e.args if x.level == PARAMETER_LEVEL}
    return list(found.values())


def adjoints(sums: Iterable[tuple[Any, Any]], by: Sequence[Expression]) -> list[Any]:
    """Differentiate a weighted sum of expressions by reverse-mode algorithmic differentiation.

    :func:`tangents` is the forward mode (Griewank and Walther 2008, chapter 3).

    :param sums: pairs of an expression and its weight; weights count as constant.
    :param by: the inputs to differentiate with respect to.
    :returns: one derivative per input.
    """
    bars: dict[int, Any] = {}
    pairs = [(e, weight) for e, weight in sums if isinstance(e, Expression)]
    for e, weight in pairs:
        bars[e.number] = bars.get(e.number, 0.0) + weight
    wanted = {e.number for e in by}
    order = list_dependencies([e for e, _ in pairs])
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


def tangents(results: Sequence[Expression], by: Sequence[Expression], *, at_reference: bool = False) -> list[list[Any]]:
    """Differentiate expressions by forward mode; return one row per result, one entry per input.

    :param at_reference: return the derivatives' values at the tape's reference geometry, which takes
        a tenth of the time of their expressions.
    """
    rows: dict[int, dict[int, Any]] = {e.number: {k: 1.0} for k, e in enumerate(by)}
    for e in list_dependencies(results):
        if e.op is None or e.number in rows or not any(rows[x.number] for x in e.args):
            rows.setdefault(e.number, {})
            continue
        total: dict[int, Any] = {}
        slopes: Iterable[Any] = e.op.slopes(e, *e.args)
        for x, slope in zip(e.args, map(reference, slopes) if at_reference else slopes, strict=True):
            for k, value in rows[x.number].items():
                total[k] = total.get(k, 0.0) + slope * value
        rows[e.number] = total
    return [[rows[e.number].get(k, 0.0) for k in range(len(by))] for e in results]
