# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Programs of one machine as C99: math.h only, no heap, no recursion, bounded loops.

A machine's numbers are folded into its programs, so that the code has fewer operations than the
one that all machines of a structure share. Newton's method makes the same tests in the same order
as the other back ends.
"""

from __future__ import annotations

import struct
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from textwrap import indent
from typing import Any, Final

from pkm_twin.codegen.code import STEPS
from pkm_twin.codegen.expressions import Expression, Tape, count, count_uses, list_dependencies
from pkm_twin.codegen.operations import (
    OPERATIONS,
    SAMPLE_LEVEL,
    Operation,
    c_number,
    cos,
    fused,
    mul,
    sin,
    sub,
)
from pkm_twin.codegen.program import (
    LAST,
    MAX_ITERATIONS,
    MAX_SUM,
    STATE,
    STATE_INDEX,
    UNKNOWNS,
    Equations,
    flag_certain,
    flag_solved,
    previous_input_name,
)
from pkm_twin.export.c_functions import C_FUNCTIONS
from pkm_twin.export.schedule import DEFAULT_LATENCY, LATENCY_BY_OPERATION, SINE_COSINE_LATENCY, Work, order_work

STEPS_PER_ATTEMPT: Final = (1, *STEPS)
"""Number of continuation steps of each attempt; Newton's method solves each step."""
MAX_NEWTON_CORRECTIONS: Final = MAX_ITERATIONS * sum(STEPS_PER_ATTEMPT)
"""Largest number of Newton corrections in one call, over all attempts."""


MAX_INLINE_CHARACTERS: Final = 44
"""Largest number of characters of an expression that is written into another one."""


def write_table(name: str, values: Sequence[float]) -> str:
    """Write a constant table, with four numbers per line."""
    texts = [c_number(value).strip("()") for value in values]
    rows = [", ".join(texts[k : k + 4]) for k in range(0, len(texts), 4)]
    return f"static const double {name}[{len(texts)}] = {{\n    " + ",\n    ".join(rows) + "\n};\n"


C_HEAD: Final = """\
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


def strip_brackets(text: str) -> str:
    """Remove the brackets around a whole expression, if it has any."""
    if not (text.startswith("(") and text.endswith(")")):
        return text
    depth = 0
    for k, letter in enumerate(text):
        depth += (letter == "(") - (letter == ")")
        if depth == 0 and k < len(text) - 1:
            return text
    return text[1:-1]


class StraightLineCode:
    """Straight-line C of some expressions, as the body of a function.

    Statements are in an order in which a processor computes several chains of operations in parallel:
    it looks only a few hundred instructions ahead, and compilers move statements no farther.

    :param known: texts of expressions that exist already, by number.
    """

    def __init__(self, results: Sequence[Expression], known: Mapping[int, str]) -> None:
        self.doubles = 0
        self.needed: set[Operation] = set()
        self._known, self._text, self._used = known, dict(known), count_uses(results)
        self._work: dict[int, Work] = {}
        """Work to compute the text of an expression, by the expression's number."""
        self._statements: list[tuple[str, Work]] = []
        for k, angles in enumerate(_group_angles(results, known)):
            self._write_sines_cosines(k, angles)
        self._write_statements(results)
        self.results = [self._text[e.number] for e in results]
        self.lines = [self._statements[k][0] for k in order_work([work for _, work in self._statements])]

    def _write_sines_cosines(self, k: int, angles: Mapping[int, Sequence[Expression]]) -> None:
        """Write one call for the sines and cosines of several angles, which are given by number."""
        size = len(angles)
        self._write_statements([x for turn in angles.values() for x in turn[0].args])
        self.needed.add(sin)
        lines = [f"    double a{k}[{size}], s{k}[{size}], c{k}[{size}];"]
        self.doubles += 3 * size
        work = Work.join([self._work[angle] for angle in angles if angle in self._work], SINE_COSINE_LATENCY)
        for i, (angle, turn) in enumerate(angles.items()):
            lines.append(f"    a{k}[{i}] = {strip_brackets(self._text[angle])};")
            for e in turn:
                self._text[e.number] = f"{'s' if e.op is sin else 'c'}{k}[{i}]"
                self._work[e.number] = Work(frozenset({len(self._statements)}))
        lines.append(f"    @_turn(a{k}, s{k}, c{k}, {size});")
        self._statements.append(("\n".join(lines), work))

    def _write_statements(self, results: Sequence[Expression]) -> None:
        for e in list_dependencies(results, self._text):
            work = Work()
            if e.source is not None:
                text = "{}[{}]".format(*e.source)
            elif e.op is None:
                text = c_number(e.value)
            else:
                text, work = self._write_operation(e, e.op)
                once = self._used.get(e.number, 2) == 1
                # Write a product that is used once in place, where it may become part of a fused operation.
                if not once or (e.op is not mul and len(text) > MAX_INLINE_CHARACTERS):
                    name = f"v{self.doubles}"
                    self._statements.append((f"    const double {name} = {strip_brackets(text)};", work))
                    text, work = name, Work(frozenset({len(self._statements) - 1}))
                    self.doubles += 1
            self._text[e.number], self._work[e.number] = text, work

    def _write_operation(self, e: Expression, op: Operation) -> tuple[str, Work]:
        parts = fused(e, self._used, self._known)
        first, values = True, list(e.args)
        if parts is not None:
            first, product, rest = parts
            values = [*product.args, rest]
        work = Work.join(
            [self._work.get(v.number, Work()) for v in values], LATENCY_BY_OPERATION.get(op, DEFAULT_LATENCY)
        )
        x, *others = (self._text[v.number] for v in values)
        if parts is None:
            self.needed.add(op)
            return op.text([x, *others], in_c=True), work
        y, z = others
        if op is sub:
            x, z = (x, f"-{z}") if first else (f"-{x}", z)
        return f"PKM_FMA({x}, {y}, {z})", work


def _group_angles(results: Sequence[Expression], known: Mapping[int, str]) -> list[dict[int, list[Expression]]]:
    """Group sines and cosines by depth, each group by angle: depth 0 has angles that depend on no others."""
    depth: dict[int, int] = {}
    groups: dict[int, dict[int, list[Expression]]] = {}
    for e in list_dependencies(results, known):
        here = max((depth.get(x.number, 0) for x in e.args), default=0)
        turns = e.op is sin or e.op is cos
        depth[e.number] = here + turns
        if turns:
            groups.setdefault(here, {}).setdefault(e.args[0].number, []).append(e)
    return [groups[k] for k in sorted(groups)]


SEQUENCE_FIELDS: Final = ("home", "origin", "start", "onward", "corrected", "branch", "certain", "goal", "foreseen")
"""Fields of :class:`Equations` that hold sequences of expressions."""
SCALAR_FIELDS: Final = ("size", "determinant", "residual", "near")
"""Fields of :class:`Equations` that hold single expressions."""


class Substitution:
    """Rewrites programs on one tape, with numbers or expressions in place of some inputs."""

    def __init__(self) -> None:
        self.tape = Tape()

    def __call__(self, results: Iterable[Expression], given: Mapping[str, Sequence[Any]]) -> list[Expression]:
        """Substitute numbers, or expressions of this tape, for the given inputs."""
        results = list(results)
        made: dict[int, Expression] = {}
        for e in list_dependencies(results):
            value: Any = e.value
            if e.source is not None:
                name, k = e.source
                value = given[name][k] if name in given else self.tape.input(name, k)
            elif e.op is not None:
                value = e.op(*(made[x.number] for x in e.args))
            made[e.number] = self.tape.lift(value)
        return [made[e.number] for e in results]

    def equations(self, q: Equations, given: Mapping[str, Sequence[Any]]) -> Equations:
        """Substitute inputs in equations, whose known state then is constant."""
        rows = {name: getattr(q, name) for name in SEQUENCE_FIELDS}
        folded: dict[str, Any] = {name: row and self(row, given) for name, row in rows.items()}
        for name in SCALAR_FIELDS:
            value = getattr(q, name)
            folded[name] = value and self([value], given)[0]
        return replace(q, **folded, lone=True)


@dataclass(frozen=True)
class Routine:
    """One public function of the exported C.

    ``outputs``: expressions by argument. ``equations``: solved one after the other. ``state``: values
    for its next call, which reads them as the input ``last``. ``upon``: a function whose body it
    calls first. ``judge``: a function of the same inputs, whose status decides whether results with
    an uncertain assembly are valid.
    """

    name: str
    inputs: Mapping[str, int]
    outputs: Mapping[str, Sequence[Expression]]
    equations: Sequence[Equations]
    summary: str
    state: Sequence[Expression] = ()
    upon: Routine | None = None
    judge: Routine | None = None

    @property
    def written_arguments(self) -> dict[str, Sequence[Expression]]:
        """Arguments that it writes: the outputs and the state."""
        return {**self.outputs, **({"state": self.state} if self.state else {})}

    @property
    def results(self) -> list[Expression]:
        """Outputs, then the state."""
        return [e for row in self.written_arguments.values() for e in row]

    @property
    def body(self) -> list[Expression]:
        """Results, then flags (1 or 0): closures are satisfied; the assembly mode is certain."""
        return [*self.results, *flag_solved(self.equations, certain=False), *flag_certain(self.equations)]

    @property
    def max_operations(self) -> tuple[int, int]:
        """Largest number of operations of a call, with all attempts and with one.

        A stream's sample has a further attempt, from the sample before.
        """
        solved = [q for q in self.equations if q.home]
        step = sum(
            MAX_ITERATIONS * count(q.corrected_state) + count([*q.begin, *q.onward, *q.step_target]) for q in solved
        )
        rest = count([*self.body, *(e for q in self.equations for e in q.goal)])
        more = len(self.state) > 1
        steps, attempts = (sum(STEPS_PER_ATTEMPT), len(STEPS_PER_ATTEMPT)) if solved else (1, 1)
        further = 0 if self.judge is None else self.judge.max_operations[0]
        first = (1 + more) * (step + rest)
        return (steps + more) * step + (attempts + more) * rest + further, first


CONTROL_LOOP_PREFIX: Final = "PKM_HOT "
"""Prefix of the functions that a control loop calls."""
MAX_SUM_BITS: Final = hex(struct.unpack("<Q", struct.pack("<d", MAX_SUM))[0])
C_RUNTIME: Final = f"""\
/* Where the compiler can, one form for this processor family's vector units, chosen at load. */
#ifdef PKM_CLONES
#define PKM_HOT __attribute__((flatten, target_clones("arch=x86-64-v3", "default")))
#else
#define PKM_HOT
#endif

/* A double and its bits. What is not finite is found in the bits, because compilers may drop
   comparisons with NaN (-fno-honor-nans); volatile, because they may know the bits' origin. */
typedef union {{
    double value;
    unsigned long long bits;
}} @_double;

/* Whether all magnitudes are below {MAX_SUM!r}: magnitudes are in the order of their bits. */
static int @_finite(const double *values, int count)
{{
    @_double one;
    volatile unsigned long long largest;
    unsigned long long most = 0;
    int i;
    for (i = 0; i < count; i++) {{
        one.value = values[i];
        one.bits &= 0x7fffffffffffffffULL;
        most = (one.bits > most) ? one.bits : most;
    }}
    largest = most;
    return (largest < {MAX_SUM_BITS}ULL) ? 1 : 0;
}}

/* Status of results r, behind which stands whether the closures hold. */
static int @_judged(const double *r, int results)
{{
    if (!(r[results] > 0.0)) {{
        return 1;
    }}
    return (@_finite(r, results) != 0) ? 0 : 2;
}}

static void @_give(int status, const double *values, double *out, int count)
{{
    volatile @_double none;
    int i;
    none.bits = 0x7ff8000000000000ULL;
    for (i = 0; i < count; i++) {{
        if (status == 0) {{
            out[i] = values[i];
        }} else {{
            out[i] = none.value;
        }}
    }}
}}
"""


class CSource:
    """The C source of one machine's functions, to which functions are appended.

    :param prefix: beginning of all names.
    :param parameters: expressions that a caller gives as a table of numbers.
    """

    def __init__(self, prefix: str, parameters: Sequence[Expression], routines: Sequence[Routine]) -> None:
        self.prefix = prefix
        self._known = {e.number: f"p[{k}]" for k, e in enumerate(parameters)}
        self._needed: set[Operation] = set()
        self._parts: list[str] = []
        self._solvers: dict[tuple[int, ...], tuple[str, dict[int, int]]] = {}
        """Name of a solver and indices into its table, by the numbers of its expressions."""
        self._functions: dict[str, str] = {}
        self._routines = routines
        self._bodies: dict[str, tuple[str, list[Expression]]] = {}
        """Call of a routine's body and its results, by the routine's name."""
        self.doubles: dict[str, int] = {}
        """Number of local doubles of each static function, by name."""
        self.max_local_doubles = 0
        """Largest number of local doubles of a public function."""

    def text(self) -> str:
        """Return the source: helpers and all functions."""
        needed = (C_FUNCTIONS.get(op, op.helper) for op in OPERATIONS if op in self._needed)
        steps = ", ".join(map(str, STEPS_PER_ATTEMPT))
        ladder = f"""\
/* Attempts of Newton's method; fewer shorten the worst case, and reject some valid states. */
#ifndef PKM_ATTEMPTS
#define PKM_ATTEMPTS {len(STEPS_PER_ATTEMPT)}
#endif
#if (PKM_ATTEMPTS < 1) || (PKM_ATTEMPTS > {len(STEPS_PER_ATTEMPT)})
#error "PKM_ATTEMPTS: 1 to {len(STEPS_PER_ATTEMPT)}"
#endif
static const int @_steps[{len(STEPS_PER_ATTEMPT)}] = {{{steps}}};
"""
        parts = [*dict.fromkeys(filter(None, needed)), C_RUNTIME, ladder, *self._parts]
        return "\n".join(parts).replace("@", self.prefix)

    def append(self, text: str) -> None:
        """Append a text; ``@`` stands for the prefix."""
        self._parts.append(text)

    def write_function(
        self,
        name: str,
        results: Sequence[Expression],
        known: Mapping[int, str],
        called: Mapping[str, str] | None = None,
    ) -> str:
        """Write a static function that computes the results; return its call, with ``%s`` for the target.

        Functions with the same text are written once.

        :param known: texts of expressions that stand in tables of its arguments.
        :param called: arguments of the call, where their names differ from the function's.
        """
        order = list_dependencies(results, known)
        arguments_of_order = [x for e in order for x in e.args]
        tables = {known[e.number] for e in (*results, *arguments_of_order) if e.number in known}
        arguments = sorted({text.partition("[")[0] for text in tables})
        arguments += sorted({e.source[0] for e in order if e.source is not None})
        code = StraightLineCode(results, known)
        self._needed |= code.needed
        lines = code.lines + [f"    r[{k}] = {strip_brackets(text)};" for k, text in enumerate(code.results)]
        head = ", ".join([*(f"const double *{a}" for a in arguments), "double *r"])
        text = f"({head})\n{{\n" + "\n".join(lines) + "\n}\n"
        if self._functions.setdefault(text, name) == name:
            self._parts.append(f"static void @_{name}{text}")
        name = self._functions[text]
        self.doubles[name] = code.doubles
        return f"@_{name}({', '.join([*((called or {}).get(a, a) for a in arguments), '%s'])})"

    def write_solver(self, q: Equations) -> tuple[str, dict[int, int]]:
        """Write Newton's method for the unknowns with a given number of steps, once per program.

        :returns: the function's name, and indices into its table ``h`` by the expression's number.
        """
        work = [*q.begin, *q.onward, *q.corrected_state, *q.step_target]
        key = tuple(e.number for e in work)
        if key not in self._solvers:
            name = "reach" if q.unknowns != UNKNOWNS else "assembly" if q.near is None else "beside"
            others = sum(known.startswith(name) for known, _ in self._solvers.values())
            name += str(others + 1) if others else ""
            # Compute values that are constant in a step once per step; results reuse those of the last step.
            step_constants = _find_independent_values((q.unknowns, STATE), q.corrected_state)
            self._solvers[key] = name, {e.number: k for k, e in enumerate(step_constants)}
            self._write_solver(name, q, step_constants)
        return self._solvers[key]

    def _write_solver(self, name: str, q: Equations, ahead: Sequence[Expression]) -> None:
        n, m = len(q.home), len(q.origin)
        known = {e.number: f"h[{k}]" for k, e in enumerate(ahead)}
        aim = {q.target: "aim"}
        prepare = self.write_function(f"{name}_ahead", ahead, {}, aim) % "h" if ahead else "(void)h"
        begin = self.write_function(f"{name}_begin", q.begin, known, aim) % "next"
        onward = self.write_function(f"{name}_onward", q.onward, {}) % "next"
        correct = self.write_function(f"{name}_correct", q.corrected_state, known, aim) % "next"
        target = self.write_function(f"{name}_aim", q.step_target, {}) % "aim"
        more = "" if q.near is None else "const double *qd, const double *last, "
        x, x_before = q.unknowns, previous_input_name(q.unknowns)
        self.append(write_table(f"@_{name}_home", [e.value for e in q.home]))
        self.append(f"""\
/* Newton's method from the known assembly in so many steps; 0 where it does not get there. */
static int @_{name}({more}const double *{q.target}, int steps, double *h, double *{x})
{{
    double {STATE}[{STATE_INDEX.moving}], aim[{m}], {x_before}[{n}] = {{0.0}}, next[{n + 3}], first = 0.0;
    double part = 0.0, way = 1.0;
    int i, k;
    {STATE}[{STATE_INDEX.once}] = (steps == 1) ? 1.0 : 0.0;
    for (i = 0; i < {n}; i++) {{
        {x}[i] = @_{name}_home[i];
    }}
    for (k = 1; k <= steps; k++) {{
        const double left = 1.0 - ((double)k / (double)steps);
        int turn, moving = 1;
        {STATE}[{STATE_INDEX.part}] = 1.0 - ((left * left) * left);
        {STATE}[{STATE_INDEX.onward}] = ({STATE}[{STATE_INDEX.part}] - part) / way;
        way = {STATE}[{STATE_INDEX.part}] - part;
        part = {STATE}[{STATE_INDEX.part}];
        {target};
        {prepare};
        if (k == 1) {{
            {begin};
            first = next[{n}];
        }} else {{
            {onward};
        }}
        for (i = 0; i < {n}; i++) {{
            {x_before}[i] = {x}[i];
            {x}[i] = next[i];
        }}
        {STATE}[{STATE_INDEX.size}] = first;
        for (turn = 0; (turn < {MAX_ITERATIONS}) && (moving != 0); turn++) {{
            {correct};
            for (i = 0; i < {n}; i++) {{
                {q.unknowns}[i] = next[i];
            }}
            {STATE}[{STATE_INDEX.size}] = next[{n}];
            moving = (next[{n + 1}] > 0.0) ? 1 : 0;
            if (!(next[{n + 2}] > 0.0)) {{
                return 0;
            }}
        }}
        if (moving != 0) {{
            return 0;
        }}
    }}
    return @_finite({x}, {n});
}}
""")

    def write_signature(self, routine: Routine, *, given: bool) -> str:
        """Write the head of a public function, or of its form with parameters."""
        arguments = [f"const double *{name}" for name in routine.inputs]
        arguments += [f"double *{name}" for name in routine.outputs]
        first = ["const double *parameters"] if given else []
        first += ["double *state"] if routine.state else []
        return f"int @_{routine.name}{'_with' if given else ''}({', '.join(first + arguments)})"

    def write_routine(self, routine: Routine, kind: str = "") -> None:
        """Write a function with parameters.

        :param kind: prefix: ``static`` or :data:`CONTROL_LOOP_PREFIX`.
        """
        known, given = dict(self._known), {"p": "parameters"}
        # Initialise local arrays, because compilers cannot see that they are written before they are read.
        rooms: dict[str, int] = {}
        solving: list[str] = []
        for k, q in enumerate(routine.equations):
            if q.goal:
                rooms["goal"], given[q.target] = len(q.goal), "goal"
                goal = self.write_function(f"{routine.name}_goal", q.goal, {}, given) % "goal"
                solving.append(f"{goal};")
            if q.home:
                name, ahead = self.write_solver(q)
                known |= {number: f"h{k}[{at}]" for number, at in ahead.items()}
                rooms |= {f"h{k}": len(ahead) or 1, q.unknowns: len(q.home)}
                to = f"{given.get(q.target, q.target)}, @_steps[rung], h{k}, {q.unknowns}"
                if q.near is not None:
                    to = f"qd, {LAST}, {to.replace('[rung]', '[(rung < 0) ? 0 : rung]')}"
                    rooms["none"] = len(routine.state)
                    solving.append(f"const double *{LAST} = (rung < 0) ? state : none;")
                solving += [f"if (@_{name}({to}) == 0) {{", "    continue;", "}"]
        if routine.upon is not None:
            call, found = self._bodies[routine.upon.name]
            rooms["b"] = len(found)
            solving.append(f"{call % 'b'};")
            known |= {e.number: f"b[{k}]" for k, e in enumerate(found) if e.op is not None}
        above = [other.body for other in self._routines if other.upon is routine]
        body = [*routine.body, *_find_shared_values(routine.body, above)]
        call = self.write_function(f"{routine.name}_of", body, known, given)
        self._bodies[routine.name] = call, body
        rooms["r"] = len(body)
        work = "\n".join([*solving, f"{call % 'r'};", f"status = @_judged(r, {len(routine.results)});"])
        lines = [f"    double {name}[{size}] = {{0.0}};" for name, size in rooms.items()]
        if any(q.home for q in routine.equations):
            lines.append("    int rung = 0;")
            first = "(state[0] > 0.0) ? -1 : 0" if "none" in rooms else "0"
            loop = f"for (rung = {first}; (rung < PKM_ATTEMPTS) && (status == 1); rung++) {{"
            work = f"status = 1;\n{loop}\n{indent(work, '    ')}\n}}"
        finite = [f"(@_finite({name}, {size}) != 0)" for name, size in routine.inputs.items()]
        lines.append("    int status = 2;")
        if "parameters" not in call:
            lines.append("    (void)parameters;")
        lines += [f"    if ({' && '.join(finite)}) {{", indent(work, "        "), "    }"]
        if routine.judge is not None:
            certain = f"(r[{len(body) - 1}] > 0.0)"
            if any(q.home for q in routine.equations):
                # Only the first attempt can be certain.
                certain = f"((rung == 1) && {certain})"
            (size,) = map(len, routine.judge.outputs.values())
            names = ", ".join(["parameters", *routine.judge.inputs, "other"])
            lines += [f"    if ((status == 0) && !{certain}) {{", f"        double other[{size}];"]
            lines += [f"        status = @_{routine.judge.name}_with({names});", "    }"]
        at = 0
        for name, row in routine.written_arguments.items():
            source = f"&r[{at}]" if at else "r"
            lines.append(f"    @_give(status, {source}, {name}, {len(row)});")
            at += len(row)
        lines.append("    return status;")
        self.max_local_doubles = max(self.max_local_doubles, sum(rooms.values()))
        self.append(f"{kind}{self.write_signature(routine, given=True)}\n{{\n" + "\n".join(lines) + "\n}\n")

    def write_own(self, routine: Routine) -> None:
        """Write the function that calls a routine with this machine's own parameters."""
        first = ["@_own", "state"] if routine.state else ["@_own"]
        names = ", ".join([*first, *routine.inputs, *routine.outputs])
        self.append(
            f"{self.write_signature(routine, given=False)}\n{{\n    return @_{routine.name}_with({names});\n}}\n"
        )


def _find_shared_values(body: Sequence[Expression], others: Iterable[Sequence[Expression]]) -> list[Expression]:
    """Find the intermediate values of a body that functions that call it read, too."""
    inner = {e.number for e in list_dependencies(body) if e.op is not None and e.level == SAMPLE_LEVEL}
    known = {e.number for e in body}
    found: dict[int, Expression] = {}
    for results in others:
        outside = [e for e in list_dependencies(results, known) if e.number not in inner]
        read = [*results, *(x for e in outside for x in e.args)]
        found |= {e.number: e for e in read if e.number in inner - known}
    return list(found.values())


def _find_independent_values(names: Container[str], results: Sequence[Expression]) -> list[Expression]:
    """Find the values that do not depend on the named inputs, but are arguments of values that do."""
    dependent: set[int] = set()
    found: dict[int, Expression] = {}
    for e in list_dependencies(results):
        if (e.source or ("",))[0] in names or any(x.number in dependent for x in e.args):
            dependent.add(e.number)
            independent = (x for x in e.args if x.number not in dependent and x.op is not None)
            found |= {x.number: x for x in independent}
    return list(found.values())
