# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write LLVM assembly as text, one instruction per line.

Only the instructions that :mod:`pkm_twin.codegen.llvm` uses are here. Types are strings; a
:class:`Value` is a constant or the name of a result, with its type.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Any, Final

from pkm_twin.codegen.native import FUSED

DOUBLE: Final = "double"
INT64: Final = "i64"
INT32: Final = "i32"
BIT: Final = "i1"


class Value:
    """A result or a constant; ``target`` is the type that a pointer points to."""

    __slots__ = ("kind", "name", "target")

    def __init__(self, kind: str, name: str, target: str = "") -> None:
        self.kind, self.name, self.target = kind, name, target


def vector(kind: str, lanes: int) -> str:
    """Return the type of a vector of ``lanes`` values."""
    return f"<{lanes} x {kind}>"


def _split_type(kind: str) -> tuple[int, str]:
    """Return the number of lanes of a type (0 for a scalar) and the type of a lane."""
    if not kind.startswith("<"):
        return 0, kind
    lanes, item = kind[1:-1].split(" x ")
    return int(lanes), item


def real_constant(value: float) -> Value:
    """Return a double constant by its exact bits."""
    (bits,) = struct.unpack("<Q", struct.pack("<d", value))
    return Value(DOUBLE, f"0x{bits:016X}")


def integer_constant(value: int, kind: str = INT64) -> Value:
    """Return an integer constant."""
    return Value(kind, str(value))


def fill_lanes(value: Value, lanes: int) -> Value:
    """Return a vector constant with the same value in every lane."""
    return Value(vector(value.kind, lanes), f"<{', '.join([f'{value.kind} {value.name}'] * lanes)}>")


def undefined_value(kind: str) -> Value:
    """Return an undefined value, to be filled lane by lane."""
    return Value(kind, "undef")


class Block:
    """A basic block: instructions that end with a branch or a return."""

    __slots__ = ("lines", "name")

    def __init__(self, name: str) -> None:
        self.name = name
        self.lines: list[str] = []


def _binary_instruction(operation: str) -> Callable[[Function, Value, Value], Value]:
    """Return a method that appends an instruction on two values, whose result has their type."""

    def append_binary(self: Function, x: Value, y: Value) -> Value:
        return self.append(x.kind, f"{operation} {x.kind} {x.name}, {y.name}")

    return append_binary


def _comparison(operation: str) -> Callable[[Function, str, Value, Value], Value]:
    """Return a method that appends a comparison of two values by an LLVM condition (olt, sgt)."""

    def append_comparison(self: Function, condition: str, x: Value, y: Value) -> Value:
        lanes, _ = _split_type(x.kind)
        kind = vector(BIT, lanes) if lanes else BIT
        return self.append(kind, f"{operation} {condition} {x.kind} {x.name}, {y.name}")

    return append_comparison


def _conversion(operation: str) -> Callable[[Function, Value, str], Value]:
    """Return a method that appends a type conversion."""

    def append_conversion(self: Function, x: Value, kind: str) -> Value:
        return self.append(kind, f"{operation} {x.kind} {x.name} to {kind}")

    return append_conversion


class Function:
    """An LLVM function that takes a pointer to 64-bit words and returns a 64-bit integer.

    Instructions are appended to the block that :meth:`go_to` selected.
    """

    def __init__(self, name: str, *, typed_pointers: bool) -> None:
        self._name, self._typed = name, typed_pointers
        self._names = 0
        self.declared: dict[str, str] = {}
        """Declarations of the intrinsic functions that are called, by name."""
        self._blocks: list[Block] = []
        self._stack: list[str] = []
        self.words = Value(self.pointer(INT64), "%words", INT64)
        self.go_to(self.block("entry"))

    def __str__(self) -> str:
        first, *others = self._blocks
        lines = [f"define {INT64} @{self._name}({self.words.kind} {self.words.name}) {{"]
        lines += [f"{first.name}:", *self._stack, *first.lines]
        for block in others:
            lines += [f"{block.name}:", *block.lines]
        return "\n".join([*lines, "}", ""])

    def pointer(self, target: str) -> str:
        """Return the type of a pointer to ``target``."""
        return f"{target}*" if self._typed else "ptr"

    def block(self, name: str) -> Block:
        """Add a block; its number makes its name unique."""
        self._blocks.append(Block(f"{name}{len(self._blocks)}"))
        return self._blocks[-1]

    def go_to(self, block: Block) -> None:
        """Append all further instructions to this block."""
        self._append_line = block.lines.append

    def _new_name(self) -> str:
        self._names += 1
        return f"%v{self._names}"

    def append(self, kind: str, text: str, target: str = "") -> Value:
        """Append an instruction and return its result."""
        name = self._new_name()
        self._append_line(f"{name} = {text}")
        return Value(kind, name, target)

    fadd, fsub, fmul, fdiv, add, sub, mul, shl, and_, or_, xor = (
        _binary_instruction(name)
        for name in ("fadd", "fsub", "fmul", "fdiv", "add", "sub", "mul", "shl", "and", "or", "xor")
    )
    fcmp, icmp = _comparison("fcmp"), _comparison("icmp")
    bitcast, zext, fptosi, sitofp = (_conversion(name) for name in ("bitcast", "zext", "fptosi", "sitofp"))

    def fneg(self, x: Value) -> Value:
        """Negate x."""
        return self.append(x.kind, f"fneg {x.kind} {x.name}")

    def select(self, condition: Value, x: Value, y: Value) -> Value:
        """Select x where the condition is true, else y."""
        return self.append(
            x.kind,
            f"select {condition.kind} {condition.name}, {x.kind} {x.name}, {y.kind} {y.name}",
            x.target,
        )

    def call(self, name: str, kind: str, arguments: Sequence[Value]) -> Value:
        """Call an intrinsic function."""
        if name not in self.declared:
            kinds = ", ".join(x.kind for x in arguments)
            self.declared[name] = f"declare {kind} @{name}({kinds})"
        given = ", ".join([f"{x.kind} {x.name}" for x in arguments])
        return self.append(kind, f"call {kind} @{name}({given})")

    def inttoptr(self, word: Value, target: str) -> Value:
        """Convert a 64-bit word to a pointer."""
        kind = self.pointer(target)
        return self.append(kind, f"inttoptr {word.kind} {word.name} to {kind}", target)

    def alloca(self, kind: str, count: int = 1) -> Value:
        """Reserve stack memory for ``count`` values, in the function's first block."""
        name = self._new_name()
        self._stack.append(f"{name} = alloca {kind}, {INT64} {count}")
        return Value(self.pointer(kind), name, kind)

    def gep(self, place: Value, index: Value) -> Value:
        """Advance a pointer by ``index`` values."""
        return self.append(
            place.kind,
            f"getelementptr {place.target}, {place.kind} {place.name}, {index.kind} {index.name}",
            place.target,
        )

    def load(self, place: Value, align: int = 0) -> Value:
        """Load a value; its address is a multiple of ``align`` bytes (0: of the type's size)."""
        side = f", align {align}" if align else ""
        return self.append(place.target, f"load {place.target}, {place.kind} {place.name}{side}")

    def store(self, x: Value, place: Value) -> None:
        """Store x at an address."""
        self._append_line(f"store {x.kind} {x.name}, {place.kind} {place.name}")

    def extract_element(self, x: Value, lane: int) -> Value:
        """Extract one lane of a vector."""
        _, kind = _split_type(x.kind)
        return self.append(kind, f"extractelement {x.kind} {x.name}, {INT32} {lane}")

    def insert_element(self, x: Value, value: Value, lane: int) -> Value:
        """Replace one lane of a vector."""
        return self.append(x.kind, f"insertelement {x.kind} {x.name}, {value.kind} {value.name}, {INT32} {lane}")

    def splat(self, value: Value, lanes: int) -> Value:
        """Copy a value into every lane of a vector."""
        kind, order = vector(value.kind, lanes), vector(INT32, lanes)
        first = self.insert_element(undefined_value(kind), value, 0)
        return self.append(
            kind,
            f"shufflevector {kind} {first.name}, {kind} undef, {order} zeroinitializer",
        )

    def branch(self, block: Block) -> None:
        """Branch to a block."""
        self._append_line(f"br label %{block.name}")

    def cbranch(self, condition: Value, yes: Block, no: Block) -> None:
        """Branch to ``yes`` if the condition is true, else to ``no``."""
        self._append_line(f"br {BIT} {condition.name}, label %{yes.name}, label %{no.name}")

    def ret(self, x: Value) -> None:
        """Return from the function with this result."""
        self._append_line(f"ret {x.kind} {x.name}")


LANES: Final = 4
"""Samples per vector: four doubles fill an AVX2 register."""
ALIGN: Final = 8
"""Alignment of the prepared parameters' rows, bytes: that of one double."""
VECTOR: Final = vector(DOUBLE, LANES)
INTEGERS: Final = vector(INT64, LANES)
TRUE: Final = fill_lanes(Value(BIT, "true"), LANES)


class Lanes:
    """Writes operations as instructions on vectors (``wide``) or on single doubles."""

    def __init__(self, function: Function, *, wide: bool) -> None:
        self.function, self.wide = function, wide
        self.type = VECTOR if wide else DOUBLE
        self.integer = INTEGERS if wide else INT64
        self.cosine_sine: dict[int, tuple[Value, Value]] = {}
        """Cosine and sine by the angle's expression number."""
        self.masks: dict[int, Value] = {}
        """Masks of the lanes where an expression is positive, by expression number."""
        self.flags: set[int] = set()
        """Numbers of the expressions that equal 1.0 in their mask's lanes and 0.0 elsewhere."""

    def number(self, value: float) -> Value:
        """Return a floating-point constant in every lane."""
        return fill_lanes(real_constant(value), LANES) if self.wide else real_constant(value)

    def integer_constant(self, value: int) -> Value:
        """Return an integer constant in every lane."""
        return fill_lanes(integer_constant(value), LANES) if self.wide else integer_constant(value)

    def call(self, name: str, *arguments: Value) -> Value:
        """Call LLVM's intrinsic function of this name for the lanes' type."""
        full = f"llvm.{name}.{f'v{LANES}f64' if self.wide else 'f64'}"
        return self.function.call(full, self.type, arguments)

    def operation(self, lanes: str | Callable[..., Value], e: Any, x: Sequence[Value]) -> Value:
        """Write the instructions of expression ``e``'s operation on its arguments."""
        if isinstance(lanes, str):
            known: Callable[..., Value] | None = getattr(self.function, lanes, None)
            return self.call(lanes, *x) if known is None else known(*x)
        return lanes(self, e, *x)

    def fused(self, x: Value, y: Value, z: Value) -> Value:
        """Compute x y + z, in one instruction where the processor has one."""
        return self.call("fma", x, y, z) if FUSED else self.function.fadd(self.function.fmul(x, y), z)

    def polynomial(self, x: Value, coefficients: Sequence[float]) -> Value:
        """Evaluate a polynomial by Horner's rule, coefficients from the highest power down."""
        result = self.number(coefficients[0])
        for c in coefficients[1:]:
            result = self.fused(result, x, self.number(c))
        return result


def module(triple: str, functions: Sequence[Function]) -> str:
    """Write a module of functions."""
    declared = {name: line for each in functions for name, line in each.declared.items()}
    head = [f'target triple = "{triple}"', *declared.values()]
    return "\n".join([*head, *(str(each) for each in functions)])
