# SPDX-License-Identifier: Apache-2.0
"""Expressions as vector instructions: arithmetic, sine and cosine, arctangent.

Products that are used once are fused with the sum that uses them where the processor can (FMA).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from pkm_twin.codegen.assembly import (
    BIT,
    DOUBLE,
    INT64,
    Function,
    Value,
    every,
    real,
    vector,
    whole,
)
from pkm_twin.codegen.elementary import ATAN_P, ATAN_Q, COSINE, MAX_ANGLE, MORE, QUARTER, SINE
from pkm_twin.codegen.expressions import SAMPLE, Expression, ordered
from pkm_twin.codegen.native import FUSED

LANES: Final = 4
ALIGN: Final = 8
"""Bytes that rows of what is prepared are aligned to."""
VECTOR: Final = vector(DOUBLE, LANES)
INTEGERS: Final = vector(INT64, LANES)
MASK: Final = vector(BIT, LANES)
TRUE: Final = every(Value(BIT, "true"), LANES)


class Known(dict[int, Value]):
    """Values by expression; what is prepared is loaded where it is used.

    A value that is held from one end of a program to the other would only be in the way of the
    registers' allocation.
    """

    def __init__(self, known: Mapping[int, Value], b: Function, prepared: Prepared | None) -> None:
        super().__init__(known)
        self._b = b
        self.places: Mapping[int, int] = {} if prepared is None else prepared.places
        self._base = None if prepared is None else prepared.base

    def __missing__(self, number: int) -> Value:
        if self._base is None:
            raise KeyError(number)
        return self._b.load(self._b.gep(self._base, whole(self.places[number])), ALIGN)


class Prepared(NamedTuple):
    """Where the vectors of what is prepared stand, by expression's number."""

    base: Value
    places: Mapping[int, int]


class Emitter:
    """Values of expressions at one place of the code, scalar or in lanes.

    :param prepared: where values that are known stand in memory.
    """

    def __init__(
        self,
        function: Function,
        used: Mapping[int, int],
        known: Mapping[int, Value],
        wide: bool,
        prepared: Prepared | None = None,
    ) -> None:
        self.b, self.used, self.wide = function, used, wide
        self.known = Known(known, function, prepared)
        self.type = VECTOR if wide else DOUBLE
        self.integer = INTEGERS if wide else INT64
        self._turned: dict[int, tuple[Value, Value]] = {}

    def number(self, value: float) -> Value:
        """A constant."""
        return every(real(value), LANES) if self.wide else real(value)

    def whole(self, value: int) -> Value:
        """A constant integer."""
        return every(whole(value), LANES) if self.wide else whole(value)

    def call(self, name: str, *arguments: Value) -> Value:
        """An intrinsic of LLVM."""
        full = f"llvm.{name}.{f'v{LANES}f64' if self.wide else 'f64'}"
        return self.b.call(full, self.type, arguments)

    def fused(self, x: Value, y: Value, z: Value) -> Value:
        """X y + z."""
        return self.call("fma", x, y, z) if FUSED else self.b.fadd(self.b.fmul(x, y), z)

    def polynomial(self, x: Value, coefficients: Sequence[float]) -> Value:
        """By Horner's rule, the highest power first."""
        result = self.number(coefficients[0])
        for c in coefficients[1:]:
            result = self.fused(result, x, self.number(c))
        return result

    def sine_cosine(self, number: int, x: Value) -> tuple[Value, Value]:
        """Both at once, for the expression of that number."""
        if number in self._turned:
            return self._turned[number]
        b, n = self.b, self.number
        quarters = self.call("rint", b.fmul(x, n(2 / math.pi)))
        y = b.select(b.fcmp("olt", self.call("fabs", x), n(MAX_ANGLE)), x, n(math.nan))
        for part in QUARTER:
            y = self.fused(quarters, n(-part), y)
        z = b.fmul(y, y)
        sine = self.fused(b.fmul(z, y), self.polynomial(z, SINE), y)
        cosine = b.fadd(
            self.fused(z, n(-0.5), n(1.0)), b.fmul(b.fmul(z, z), self.polynomial(z, COSINE))
        )
        k = b.fptosi(quarters, self.integer)
        odd = b.icmp("ne", b.and_(k, self.whole(1)), self.whole(0))

        def signed(value: Value, turns: Value) -> Value:
            flip = b.shl(b.and_(turns, self.whole(2)), self.whole(62))
            return b.bitcast(b.xor(b.bitcast(value, self.integer), flip), self.type)

        pair = (
            signed(b.select(odd, cosine, sine), k),
            signed(b.select(odd, sine, cosine), b.add(k, self.whole(1))),
        )
        self._turned[number] = pair
        return pair

    def arctangent(self, y: Value, x: Value) -> Value:
        """The angle of (x, y)."""
        b, n = self.b, self.number
        ay, ax = self.call("fabs", y), self.call("fabs", x)
        steep = b.fcmp("ogt", ay, ax)
        small, large = b.select(steep, ax, ay), b.select(steep, ay, ax)
        zero = b.fcmp("oeq", large, n(0.0))
        t = b.fdiv(small, b.select(zero, n(1.0), large))
        high = b.fcmp("ogt", t, n(0.66))
        u = b.select(high, b.fdiv(b.fsub(t, n(1.0)), b.fadd(t, n(1.0))), t)
        z = b.fmul(u, u)
        ratio = b.fdiv(self.polynomial(z, ATAN_P), self.polynomial(z, ATAN_Q))
        angle = self.fused(b.fmul(u, z), ratio, u)
        angle = b.select(high, b.fadd(b.fadd(angle, n(MORE / 2)), n(math.pi / 4)), angle)
        angle = b.select(steep, b.fadd(b.fsub(n(math.pi / 2), angle), n(MORE)), angle)
        back = b.icmp("slt", b.bitcast(x, self.integer), self.whole(0))
        angle = b.select(back, b.fadd(b.fsub(n(math.pi), angle), n(2 * MORE)), angle)
        sign = b.and_(b.bitcast(y, self.integer), self.whole(-(2**63)))
        return b.bitcast(b.or_(b.bitcast(angle, self.integer), sign), self.type)

    def value(self, e: Expression, inputs: Mapping[str, Sequence[Value]]) -> Value:
        """The instruction of one expression, its operands known."""
        b, op = self.b, e.op
        if op == "const":
            return self.number(e.a)
        if op == "in":
            found: Value = inputs[e.a][e.b]
            return found
        if op in ("add", "sub"):
            for first, product, rest in ((True, e.a, e.b), (False, e.b, e.a)):
                once = product.op == "mul" and self.used.get(product.number, 2) == 1
                if not once or (product.level == SAMPLE) != (e.level == SAMPLE):
                    continue
                x, y = self.known[product.a.number], self.known[product.b.number]
                z = self.known[rest.number]
                if op == "sub":
                    x, z = (x, b.fneg(z)) if first else (b.fneg(x), z)
                return self.fused(x, y, z)
        x = self.known[e.a.number]
        if op == "neg":
            return b.fneg(x)
        if op == "inv":
            return b.fdiv(self.number(1.0), x)
        if op in ("sin", "cos"):
            return self.sine_cosine(e.a.number, x)[op == "cos"]
        if op == "sqrt":
            return self.call("sqrt", x)
        if op == "abs":
            return self.call("fabs", x)
        if op == "sign":
            zero = self.number(0.0)
            down = b.select(b.fcmp("olt", x, zero), self.number(-1.0), b.fmul(x, zero))
            return b.select(b.fcmp("ogt", x, zero), self.number(1.0), down)
        y = self.known[e.b.number]
        if op == "add":
            return b.fadd(x, y)
        if op == "sub":
            return b.fsub(x, y)
        if op == "mul":
            return b.fmul(x, y)
        if op == "atan2":
            return self.arctangent(x, y)
        return b.select(b.fcmp("olt" if op == "min" else "ogt", x, y), x, y)

    def run(
        self, results: Sequence[Expression], inputs: Mapping[str, Sequence[Value]]
    ) -> list[Value]:
        """Values of the results; every shared expression once."""
        for e in ordered(results, [*self.known, *self.known.places]):
            self.known[e.number] = self.value(e, inputs)
        return [self.known[e.number] for e in results]
