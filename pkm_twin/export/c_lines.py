# SPDX-License-Identifier: Apache-2.0
"""Expressions as straight-line C99, and the few functions that it calls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from pkm_twin.codegen.expressions import Expression, ordered, uses
from pkm_twin.codegen.operations import Operation, c_number, cos, fused, mul, sin, sub

LONGEST: Final = 44
"""Characters of an expression that is written into another one."""


def table(name: str, values: Sequence[float]) -> str:
    """A constant table, four numbers a line."""
    texts = [c_number(value).strip("()") for value in values]
    rows = [", ".join(texts[k : k + 4]) for k in range(0, len(texts), 4)]
    return f"static const double {name}[{len(texts)}] = {{\n    " + ",\n    ".join(rows) + "\n};\n"


HEAD: Final = """\
#include <math.h>

#if defined(__FINITE_MATH_ONLY__) && (__FINITE_MATH_ONLY__ > 0)
#error "NaN and infinity are tested for: compile without -ffast-math and -ffinite-math-only"
#endif

#ifndef PKM_FMA
#if defined(FP_FAST_FMA) || defined(__FMA__) || defined(__ARM_FEATURE_FMA)
#define PKM_FMA(x, y, z) fma((x), (y), (z))
#else
#define PKM_FMA(x, y, z) ((x) * (y) + (z))
#endif
#endif
"""


def bare(text: str) -> str:
    """Without the brackets around the whole, where it has some."""
    if not (text.startswith("(") and text.endswith(")")):
        return text
    depth = 0
    for k, letter in enumerate(text):
        depth += (letter == "(") - (letter == ")")
        if depth == 0 and k < len(text) - 1:
            return text
    return text[1:-1]


class Lines:
    """Straight-line C of some expressions, as the body of a function.

    :param known: texts of expressions that are given.
    """

    def __init__(self, results: Sequence[Expression], known: Mapping[int, str]) -> None:
        self.lines: list[str] = []
        self.doubles = 0
        self.needed: set[Operation] = set()
        self._known, self._text, self._used = known, dict(known), uses(results)
        self._turns = 0
        for angles in _angles(results, known):
            self._turn(angles)
        self._write(results)
        self.results = [self._text[e.number] for e in results]

    def _turn(self, angles: Mapping[int, Sequence[Expression]]) -> None:
        """Sines and cosines of angles, by the number of the angle, all at once."""
        k, size = self._turns, len(angles)
        self._turns += 1
        self._write([x for turn in angles.values() for x in turn[0].args])
        self.needed.add(sin)
        self.lines.append(f"    double a{k}[{size}], s{k}[{size}], c{k}[{size}];")
        self.doubles += 3 * size
        for i, (angle, turn) in enumerate(angles.items()):
            self.lines.append(f"    a{k}[{i}] = {bare(self._text[angle])};")
            for e in turn:
                self._text[e.number] = f"{'s' if e.op is sin else 'c'}{k}[{i}]"
        self.lines.append(f"    @_turn(a{k}, s{k}, c{k}, {size});")

    def _write(self, results: Sequence[Expression]) -> None:
        for e in ordered(results, self._text):
            if e.source is not None:
                text = "{}[{}]".format(*e.source)
            elif e.op is None:
                text = c_number(e.value)
            else:
                text = self._operation(e, e.op)
                once = self._used.get(e.number, 2) == 1
                # A product that is used once becomes part of a fused operation.
                if not once or (e.op is not mul and len(text) > LONGEST):
                    self.lines.append(f"    const double v{self.doubles} = {bare(text)};")
                    text = f"v{self.doubles}"
                    self.doubles += 1
            self._text[e.number] = text

    def _operation(self, e: Expression, op: Operation) -> str:
        parts = fused(e, self._used, self._known)
        if parts is None:
            self.needed.add(op)
            return op.text([self._text[x.number] for x in e.args], in_c=True)
        first, product, rest = parts
        x, y, z = (self._text[v.number] for v in (*product.args, rest))
        if op is sub:
            x, z = (x, f"-{z}") if first else (f"-{x}", z)
        return f"PKM_FMA({x}, {y}, {z})"


def _angles(
    results: Sequence[Expression], known: Mapping[int, str]
) -> list[dict[int, list[Expression]]]:
    """Sines and cosines by their angle, those first whose angles need no others."""
    depth: dict[int, int] = {}
    groups: dict[int, dict[int, list[Expression]]] = {}
    for e in ordered(results, known):
        here = max((depth.get(x.number, 0) for x in e.args), default=0)
        turns = e.op is sin or e.op is cos
        depth[e.number] = here + turns
        if turns:
            groups.setdefault(here, {}).setdefault(e.args[0].number, []).append(e)
    return [groups[k] for k in sorted(groups)]
