# SPDX-License-Identifier: Apache-2.0
"""Expressions as straight-line C99, and the few functions that it calls."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

from pkm_twin.codegen.elementary import COSINE, MAX_ANGLE, QUARTER, SINE
from pkm_twin.codegen.expressions import Expression, ordered, uses

LONGEST: Final = 44
"""Characters of an expression that is written into another one."""
QUARTERS: Final = 1048576
"""More quarter turns than that angle has: what is above zero is truncated downwards."""


def number(value: float) -> str:
    """A double as C has it, exactly."""
    if not math.isfinite(value):
        return {math.inf: "HUGE_VAL", -math.inf: "(-HUGE_VAL)"}.get(value, "((double)NAN)")
    text = repr(float(value))
    return f"({text})" if text.startswith("-") else text


_WRITTEN: Final[Mapping[str, str]] = {
    "add": "({a} + {b})", "sub": "({a} - {b})", "mul": "({a} * {b})", "neg": "(-{a})",
    "inv": "(1.0 / {a})", "sqrt": "sqrt({a})", "abs": "fabs({a})", "sign": "@_sign({a})",
    "atan2": "atan2({a}, {b})", "min": "@_min({a}, {b})", "max": "@_max({a}, {b})",
}  # fmt: skip


def table(name: str, values: Sequence[float]) -> str:
    """A constant table, four numbers a line."""
    texts = [number(value).strip("()") for value in values]
    rows = [", ".join(texts[k : k + 4]) for k in range(0, len(texts), 4)]
    return f"static const double {name}[{len(texts)}] = {{\n    " + ",\n    ".join(rows) + "\n};\n"


def _series(coefficients: Sequence[float]) -> str:
    text = number(coefficients[0])
    for c in coefficients[1:]:
        text = f"PKM_FMA({text}, z,\n        {number(c)})"
    return text


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
HELPERS: Final = {
    "sin": f"""\
/* Sines and cosines: polynomials after Cody and Waite's reduction by quarter turns. NaN where
   the angle is so large that the reduction loses digits. */
static void @_turn(const double *x, double *s, double *c, int count)
{{
    int i;
    for (i = 0; i < count; i++) {{
        const double angle = (fabs(x[i]) < {MAX_ANGLE!r}) ? x[i] : 0.0;
        const int k = (int)((angle * {number(2.0 / math.pi)}) + {QUARTERS}.5) - {QUARTERS};
        const double n = -(double)k;
        const double y = PKM_FMA(n, {number(QUARTER[2])},
            PKM_FMA(n, {number(QUARTER[1])}, PKM_FMA(n, {number(QUARTER[0])}, angle)));
        const double z = y * y;
        const double sine = PKM_FMA(z * y, {_series(SINE)}, y);
        const double cosine = PKM_FMA(z, -0.5, 1.0) + (z * z) * {_series(COSINE)};
        const int even = 1 - (k & 1);
        const int side = 1 - (k & 2);
        const double u = (double)(even * side);
        const double v = (double)((1 - even) * side);
        s[i] = PKM_FMA(u, sine, v * cosine);
        c[i] = PKM_FMA(u, cosine, -(v * sine));
    }}
    for (i = 0; i < count; i++) {{
        if (!(fabs(x[i]) < {MAX_ANGLE!r})) {{
            s[i] = c[i] = (double)NAN;
        }}
    }}
}}
""",
    "sign": """\
static double @_sign(double x)
{
    return (x > 0.0) ? 1.0 : ((x < 0.0) ? -1.0 : x * 0.0);
}
""",
    "min": """\
static double @_min(double x, double y)
{
    return (x < y) ? x : y;
}
""",
    "max": """\
static double @_max(double x, double y)
{
    return (x > y) ? x : y;
}
""",
}


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
        self.needed: set[str] = set()
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
        self._write([turn[0].a for turn in angles.values()])
        self.needed.add("sin")
        self.lines.append(f"    double a{k}[{size}], s{k}[{size}], c{k}[{size}];")
        self.doubles += 3 * size
        for i, (angle, turn) in enumerate(angles.items()):
            self.lines.append(f"    a{k}[{i}] = {bare(self._text[angle])};")
            for e in turn:
                self._text[e.number] = f"{e.op[0]}{k}[{i}]"
        self.lines.append(f"    @_turn(a{k}, s{k}, c{k}, {size});")

    def _write(self, results: Sequence[Expression]) -> None:
        for e in ordered(results, self._text):
            if e.op == "const":
                text = number(e.a)
            elif e.op == "in":
                text = f"{e.a}[{e.b}]"
            else:
                text = self._operation(e)
                once = self._used.get(e.number, 2) == 1
                # A product that is used once becomes part of a fused operation.
                if not once or (e.op != "mul" and len(text) > LONGEST):
                    self.lines.append(f"    const double v{self.doubles} = {bare(text)};")
                    text = f"v{self.doubles}"
                    self.doubles += 1
            self._text[e.number] = text

    def _fused(self, e: Expression) -> str | None:
        for first, product, rest in ((True, e.a, e.b), (False, e.b, e.a)):
            once = product.op == "mul" and self._used.get(product.number, 2) == 1
            if once and product.number not in self._known:
                x, y, z = (self._text[v.number] for v in (product.a, product.b, rest))
                if e.op == "sub":
                    x, z = (x, f"-{z}") if first else (f"-{x}", z)
                return f"PKM_FMA({x}, {y}, {z})"
        return None

    def _operation(self, e: Expression) -> str:
        fused = self._fused(e) if e.op in ("add", "sub") else None
        if fused is not None:
            return fused
        a = self._text[e.a.number]
        b = "" if e.b is None else self._text[e.b.number]
        if e.op in HELPERS:
            self.needed.add(e.op)
        return _WRITTEN[e.op].format(a=a, b=b)


def _angles(
    results: Sequence[Expression], known: Mapping[int, str]
) -> list[dict[int, list[Expression]]]:
    """Sines and cosines by their angle, those first whose angles need no others."""
    depth: dict[int, int] = {}
    groups: dict[int, dict[int, list[Expression]]] = {}
    for e in ordered(results, known):
        below = [x.number for x in (e.a, e.b) if isinstance(x, Expression)]
        here = max((depth.get(k, 0) for k in below), default=0)
        turns = e.op in ("sin", "cos")
        depth[e.number] = here + turns
        if turns:
            groups.setdefault(here, {}).setdefault(e.a.number, []).append(e)
    return [groups[k] for k in sorted(groups)]
