# SPDX-License-Identifier: Apache-2.0
"""Instructions on the lanes of a vector.

Products that are used once are fused with the sum that uses them where the processor can (FMA).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

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
from pkm_twin.codegen.native import FUSED

LANES: Final = 4
ALIGN: Final = 8
"""Bytes that rows of what is prepared are aligned to."""
VECTOR: Final = vector(DOUBLE, LANES)
INTEGERS: Final = vector(INT64, LANES)
MASK: Final = vector(BIT, LANES)
TRUE: Final = every(Value(BIT, "true"), LANES)


class Lanes:
    """Instructions on vectors, or on one double, as operations write them."""

    def __init__(self, function: Function, *, wide: bool) -> None:
        self.b, self.wide = function, wide
        self.type = VECTOR if wide else DOUBLE
        self.integer = INTEGERS if wide else INT64
        self.turned: dict[int, tuple[Value, Value]] = {}
        """Cosines and sines by the number of their angle."""
        self.masks: dict[int, Value] = {}
        """Where expressions are above zero."""
        self.flags: set[int] = set()
        """Expressions that are 1 there and 0 elsewhere."""

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

    def operation(self, lanes: str | Callable[..., Value], e: Any, x: Sequence[Value]) -> Value:
        """The instructions of an operation, ``e``, on its arguments."""
        if isinstance(lanes, str):
            known: Callable[..., Value] | None = getattr(self.b, lanes, None)
            return self.call(lanes, *x) if known is None else known(*x)
        return lanes(self, e, *x)

    def fused(self, x: Value, y: Value, z: Value) -> Value:
        """X y + z."""
        return self.call("fma", x, y, z) if FUSED else self.b.fadd(self.b.fmul(x, y), z)

    def polynomial(self, x: Value, coefficients: Sequence[float]) -> Value:
        """By Horner's rule, the highest power first."""
        result = self.number(coefficients[0])
        for c in coefficients[1:]:
            result = self.fused(result, x, self.number(c))
        return result
