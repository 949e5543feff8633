# SPDX-License-Identifier: Apache-2.0
"""Scalar expressions with sharing: formulas run once on these give a program for any back end.

Formulas are written for numbers and run on expressions too: numpy's object arrays of expressions
add, multiply and take sines like arrays of floats. Equal expressions of one tape are one object,
and what is zero, one or constant folds away while it is written.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Objects = NDArray[Any]
"""Array of expressions, of floats, or of both."""

Numbers = Sequence[Any] | NDArray[Any]
"""Some expressions or numbers in a row."""

CONSTANT: Final = 0
PARAMETER: Final = 1
SAMPLE: Final = 2
"""What an expression hangs on: nothing, the parameters alone, or the sample."""

PARAMETERS: Final = "p"
GEOMETRY: Final = "g"
"""Names of the inputs that are the same for all samples of a machine: those of a program's own, and
the machine's geometry."""

_COMMUTE: Final = frozenset(("add", "mul", "min", "max"))


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
        key = ("const", value, math.copysign(1.0, value))
        known = self._known.get(key)
        return known or self._new(key, "const", float(value), None, CONSTANT, float(value))

    def input(self, name: str, index: int) -> Expression:
        """Entry ``index`` of the input ``name``."""
        key = ("in", name, index)
        level, value = SAMPLE, math.nan
        if name in (PARAMETERS, GEOMETRY):
            level = PARAMETER
            value = float(self.reference[index]) if name == GEOMETRY else math.nan
        return self._known.get(key) or self._new(key, "in", name, index, level, value)

    def inputs(self, name: str, size: int) -> Objects:
        """All entries of an input, shape (size,)."""
        array = np.empty(size, dtype=object)
        array[:] = [self.input(name, i) for i in range(size)]
        return array

    def lift(self, value: Any) -> Expression:
        """An expression as it is, a number as a constant."""
        return value if isinstance(value, Expression) else self.constant(float(value))

    def make(self, op: str, a: Expression, b: Expression | None = None) -> Expression:
        """The operation on one or two expressions, one object for equal ones."""
        if b is not None and op in _COMMUTE and a.number > b.number:
            a, b = b, a
        key = (op, a.number, None if b is None else b.number)
        known = self._known.get(key)
        if known is not None:
            return known
        level = a.level if b is None else max(a.level, b.level)
        value = math.nan
        if level == PARAMETER:
            value = _PLAIN[op](*((a.value,) if b is None else (a.value, b.value)))
        return self._new(key, op, a, b, level, value)

    def _new(
        self, key: tuple[Any, ...], op: str, a: Any, b: Any, level: int, value: float
    ) -> Expression:
        result = self._known[key] = Expression(self, op, a, b, len(self._known), level, value)
        return result


class Expression:
    """One operation. ``a``, ``b``: its arguments; of a constant its value, of an input its name
    and index. ``value``: in the tape's known case, NaN where it hangs on the sample.
    """

    __slots__ = ("a", "b", "level", "number", "op", "tape", "value")

    def __init__(
        self, tape: Tape, op: str, a: Any, b: Any, number: int, level: int, value: float
    ) -> None:
        self.tape, self.op, self.a, self.b = tape, op, a, b
        self.number, self.level, self.value = number, level, value

    def is_constant(self, value: float) -> bool:
        """Whether it is this number."""
        return self.op == "const" and self.a == value

    def __add__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, np.ndarray) else _add(self, other)

    def __radd__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, np.ndarray) else _add(other, self)

    def __sub__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, np.ndarray) else _subtract(self, other)

    def __rsub__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, np.ndarray) else _subtract(other, self)

    def __mul__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, np.ndarray) else _multiply(self, other)

    def __rmul__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, np.ndarray) else _multiply(other, self)

    def __truediv__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, np.ndarray) else _divide(self, other)

    def __rtruediv__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, np.ndarray) else _divide(other, self)

    def __neg__(self) -> Expression:
        return _negate(self)

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
        return f"<{self.op} {self.number}>"


def _pair(a: Any, b: Any) -> tuple[Expression, Expression]:
    tape = a.tape if isinstance(a, Expression) else b.tape
    return tape.lift(a), tape.lift(b)


def _add(x: Any, y: Any) -> Expression:
    a, b = _pair(x, y)
    if a.op == "const" and b.op == "const":
        return a.tape.constant(a.a + b.a)
    if a.is_constant(0.0):
        return b
    if b.is_constant(0.0):
        return a
    if b.op == "neg":
        return _subtract(a, b.a)
    if a.op == "neg":
        return _subtract(b, a.a)
    return a.tape.make("add", a, b)


def _subtract(x: Any, y: Any) -> Expression:
    a, b = _pair(x, y)
    if a.op == "const" and b.op == "const":
        return a.tape.constant(a.a - b.a)
    if a is b:
        return a.tape.constant(0.0)
    if b.is_constant(0.0):
        return a
    if a.is_constant(0.0):
        return _negate(b)
    if b.op == "neg":
        return _add(a, b.a)
    if a.op == "neg":
        return _negate(_add(a.a, b))
    return a.tape.make("sub", a, b)


def _multiply(x: Any, y: Any) -> Expression:
    a, b = _pair(x, y)
    if a.op == "const" and b.op == "const":
        return a.tape.constant(a.a * b.a)
    for u, v in ((a, b), (b, a)):
        if u.is_constant(0.0):
            return u
        if u.is_constant(1.0):
            return v
        if u.is_constant(-1.0):
            return _negate(v)
    if a.op == "neg":
        return _multiply(a.a, b.a) if b.op == "neg" else _negate(_multiply(a.a, b))
    if b.op == "neg":
        return _negate(_multiply(a, b.a))
    return a.tape.make("mul", a, b)


def _divide(x: Any, y: Any) -> Expression:
    a, b = _pair(x, y)
    if a.is_constant(0.0):
        return a
    if b.op == "const":
        return _multiply(a, a.tape.constant(1.0 / b.a))
    if a.op == "neg":
        return _negate(_divide(a.a, b))
    if b.op == "neg":
        return _negate(_divide(a, b.a))
    # One reciprocal, shared.
    inverse = a.tape.make("inv", b)
    return inverse if a.is_constant(1.0) else _multiply(a, inverse)


def _negate(e: Expression) -> Expression:
    if e.op == "const":
        return e.tape.constant(-e.a)
    if e.op == "neg":
        inner: Expression = e.a
        return inner
    if e.op == "sub":
        return e.tape.make("sub", e.b, e.a)
    return e.tape.make("neg", e)


def _unary(op: str, plain: Callable[[Any], Any]) -> Callable[[Any], Any]:
    def apply(x: Any) -> Any:
        if not isinstance(x, Expression):
            return plain(x)
        return x.tape.constant(float(plain(x.a))) if x.op == "const" else x.tape.make(op, x)

    return apply


def _binary(op: str, plain: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    def apply(x: Any, y: Any) -> Any:
        if not (isinstance(x, Expression) or isinstance(y, Expression)):
            return plain(x, y)
        a, b = _pair(x, y)
        if a.op == "const" and b.op == "const":
            return a.tape.constant(float(plain(a.a, b.a)))
        return a.tape.make(op, a, b)

    return apply


def _circle(e: Expression) -> tuple[Any, Any] | None:
    """Cosine and sine of an arctangent, or of a sum of arctangents, without computing an angle."""
    if e.op == "atan2":
        over = 1.0 / sqrt(e.b * e.b + e.a * e.a)
        return e.b * over, e.a * over
    if e.op == "neg":
        inner = _circle(e.a)
        return inner and (inner[0], -inner[1])
    if e.op not in ("add", "sub"):
        return None
    first, second = _circle(e.a), _circle(e.b)
    if first is None or second is None:
        return None
    (c, s), (d, t) = first, second
    t = t if e.op == "add" else -t
    return c * d - s * t, s * d + c * t


def _of_circle(op: str, plain: Callable[[Any], Any], index: int) -> Callable[[Any], Any]:
    compute = _unary(op, plain)

    def apply(x: Any) -> Any:
        circle = _circle(x) if isinstance(x, Expression) else None
        return compute(x) if circle is None else circle[index]

    return apply


sqrt: Final = _unary("sqrt", np.sqrt)
sin: Final = _of_circle("sin", np.sin, 1)
cos: Final = _of_circle("cos", np.cos, 0)
absolute: Final = _unary("abs", np.abs)
sign: Final = _unary("sign", np.sign)
"""-1, 0 or 1."""
atan2: Final = _binary("atan2", np.arctan2)
minimum: Final = _binary("min", np.minimum)
maximum: Final = _binary("max", np.maximum)

_PLAIN: Final[Mapping[str, Callable[..., float]]] = {
    "add": operator.add, "sub": operator.sub, "mul": operator.mul, "neg": operator.neg,
    "inv": lambda x: 1.0 / x if x else math.inf,
    "sqrt": lambda x: math.sqrt(x) if x >= 0.0 else math.nan,
    "sin": math.sin, "cos": math.cos, "abs": abs, "sign": lambda x: (x > 0.0) - (x < 0.0),
    "atan2": math.atan2, "min": min, "max": max,
}  # fmt: skip
"""Every operation on two floats or one."""


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
        result = array.copy()
        for target in (0.0, 1.0, -1.0):
            result[np.abs(result - target) < SNAP] = target
        return result
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
            if isinstance(value, Expression) and value.op != "const":
                value.tape.assumed.append((value, target))
            return target
    return value


OPERATIONS: Final[Mapping[str, str]] = {
    "add": "{a} + {b}",
    "sub": "{a} - {b}",
    "mul": "{a} * {b}",
    "neg": "-{a}",
    "inv": "1.0 / {a}",
    "sqrt": "sqrt({a})",
    "sin": "sin({a})",
    "cos": "cos({a})",
    "abs": "fabs({a})",
    "sign": "sign({a})",
    "atan2": "atan2({a}, {b})",
    "min": "fmin({a}, {b})",
    "max": "fmax({a}, {b})",
}
"""Every operation, as the plain back end writes it."""


def ordered(results: Iterable[Expression], known: Iterable[int] = ()) -> list[Expression]:
    """Everything that the results hang on, arguments first; nothing below what is known."""
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
            stack.append((e, True))
            if e.op not in ("const", "in"):
                stack.append((e.a, False))
                if e.b is not None:
                    stack.append((e.b, False))
    return order


def uses(results: Sequence[Expression]) -> dict[int, int]:
    """How often each operation's value is used, by number; a result counts as used often."""
    counts: dict[int, int] = {}
    for e in ordered(results):
        if e.op not in ("const", "in"):
            for argument in (e.a, e.b):
                if argument is not None:
                    counts[argument.number] = counts.get(argument.number, 0) + 1
    for result in results:
        counts[result.number] = counts.get(result.number, 0) + 2
    return counts


def count(results: Iterable[Expression]) -> int:
    """Operations a sample: without inputs, constants and what hangs on parameters alone."""
    return sum(e.level == SAMPLE and e.op != "in" for e in ordered(results))
