# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Programs as vector machine code: LANES samples a turn, one sample is a batch of one.

So one sample and a batch have the same bits: every lane computes the same operations, and a lane
that has converged stands still. Products that are used once are fused with the sum that uses them
where the processor can (FMA); where it cannot, the same program runs unfused.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final

import llvmlite
import llvmlite.binding as binding

from pkm_twin.codegen.assembly import (
    ALIGN,
    BIT,
    DOUBLE,
    INT64,
    LANES,
    TRUE,
    VECTOR,
    Function,
    Lanes,
    Value,
    module,
    real,
    undefined,
    whole,
)
from pkm_twin.codegen.expressions import GEOMETRY, PARAMETERS, Expression, ordered, uses
from pkm_twin.codegen.native import CPU, FEATURES, OPTIMISATION, PREPARE, QUICK, SYMBOL
from pkm_twin.codegen.operations import fused, sub
from pkm_twin.codegen.program import (
    AT,
    LARGE,
    MAX_ITERATIONS,
    STATE,
    Equations,
    Program,
    holding,
    previous,
)

STATUS: Final = " status"
LONG: Final = 100
"""Entries of an output from which on they are stored in a loop."""

ZERO: Final = whole(0)
ONE: Final = whole(1)
IDENTITY: Final = f"{llvmlite.__version__} {CPU} {FEATURES} {LANES} {OPTIMISATION} {QUICK}"
"""What machine code hangs on beside the program."""


class Emitter(Lanes):
    """Values of expressions at one place of the code, scalar or in lanes.

    :param prepared: places of values in memory by expression's number. They are loaded where they
        are used: held from one end of a program to the other, they would only be in the way of the
        registers' allocation. ``base``: where they begin.
    """

    def __init__(
        self, b: Function, used: Mapping[int, int], prepared: Mapping[int, int], base: Value | None
    ) -> None:
        super().__init__(b, wide=base is not None)
        self._used, self._prepared, self._base = used, prepared, base
        self._known: dict[int, Value] = {}

    def known(self, e: Expression) -> Value:
        """The value of an expression that was computed before."""
        if self._base is None or e.number not in self._prepared:
            return self._known[e.number]
        place = self.b.gep(self._base, whole(self._prepared[e.number]))
        return self.b.load(place, ALIGN)

    def value(self, e: Expression, inputs: Mapping[str, Sequence[Value]]) -> Value:
        """The instructions of one expression, its arguments known."""
        if e.source is not None:
            name, index = e.source
            return inputs[name][index]
        if e.op is None:
            return self.number(e.value)
        parts = fused(e, self._used, self._prepared)
        if parts is None:
            return self.operation(e.op.lanes, e, [self.known(x) for x in e.args])
        first, product, rest = parts
        x, y, z = [self.known(v) for v in (*product.args, rest)]
        if e.op is sub:
            x, z = (x, self.b.fneg(z)) if first else (self.b.fneg(x), z)
        return self.fused(x, y, z)

    def run(
        self, results: Sequence[Expression], inputs: Mapping[str, Sequence[Value]]
    ) -> list[Value]:
        """Values of the results; every shared expression once."""
        for e in ordered(results, {**self._known, **self._prepared}):
            self._known[e.number] = self.value(e, inputs)
        return [self.known(e) for e in results]


class _Counter:
    """A loop: its index stands in a variable, from zero on."""

    def __init__(self, b: Function, name: str, end: Value, step: int = 1) -> None:
        self.b, self.end, self.step = b, end, step
        self._place = b.alloca(INT64)
        self.head, self.body, self.after = (b.block(name) for _ in range(3))

    def begin(self) -> Value:
        """Go into the loop; its index."""
        b = self.b
        b.store(ZERO, self._place)
        b.branch(self.head)
        b.go_to(self.head)
        index = b.load(self._place)
        b.cbranch(b.icmp("slt", index, self.end), self.body, self.after)
        b.go_to(self.body)
        return index

    def close(self, more: Value | None = None) -> None:
        """Go round, by default in any case, and on behind it."""
        b = self.b
        b.store(b.add(b.load(self._place), whole(self.step)), self._place)
        if more is None:
            b.branch(self.head)
        else:
            b.cbranch(more, self.head, self.after)
        b.go_to(self.after)


def _function(name: str) -> Function:
    return Function(name, typed_pointers=binding.llvm_version_info < (17,))


def _word(b: Function, k: int) -> Value:
    return b.load(b.gep(b.words, whole(k)))


def _preparation(program: Program) -> Function:
    """What hangs on parameters alone, machine by machine; the words are machines, a pointer to
    parameters and what they go on by, and a pointer to results, each in all lanes.
    """
    b = _function(PREPARE)
    count, stride = _word(b, 0), _word(b, 2)
    source, target = b.inttoptr(_word(b, 1), DOUBLE), b.inttoptr(_word(b, 3), DOUBLE)
    results = [*program.prepared, program.missed]
    machines = _Counter(b, "machine", count)
    index = machines.begin()
    here = b.gep(source, b.mul(index, stride))
    there = b.gep(target, b.mul(index, whole(LANES * len(results))))
    # The geometry stands behind the program's own parameters.
    first = {PARAMETERS: 0, GEOMETRY: program.parameters}
    inputs: dict[str, dict[int, Value]] = {name: {} for name in first}
    for e in ordered(results):
        if e.source is not None:
            name, k = e.source
            inputs[name][k] = b.load(b.gep(here, whole(first[name] + k)))
    out = Emitter(b, uses(results), {}, None)
    for k, value in enumerate(out.run(results, inputs)):  # type: ignore[arg-type]
        for lane in range(LANES):
            b.store(value, b.gep(there, whole(LANES * k + lane)))
    machines.close()
    b.ret(ZERO)
    return b


class _Writer:
    """The function of one program, see :func:`emit`."""

    def __init__(self, program: Program) -> None:
        self.program = program
        b = self.b = _function(SYMBOL)
        self.used = uses(program.results)
        names = list(program.inputs)
        self.count, self.steps = _word(b, 1), _word(b, 2)
        self.flags = b.alloca(INT64)
        b.store(ZERO, self.flags)
        self.strides = {name: _word(b, 6 + 3 * k) for k, name in enumerate(names)}
        # Pointers, and what each goes on by from one machine to the next.
        at = 5 + 3 * len(names)
        leaps = {"": (3, _word(b, 4))}
        leaps |= {name: (5 + 3 * k, _word(b, 7 + 3 * k)) for k, name in enumerate(names)}
        sizes = {**{name: len(row) for name, row in program.outputs.items()}, STATUS: 2}
        for k, (name, size) in enumerate(sizes.items()):
            leaps[f"to {name}"] = at + k, b.mul(self.count, whole(size))
        places = {name: b.alloca(INT64) for name in leaps}
        for name, (k, _) in leaps.items():
            b.store(_word(b, k), places[name])
        machines = _Counter(b, "machine", _word(b, 0))
        machines.begin()
        self.pointers = {name: b.inttoptr(b.load(at), DOUBLE) for name, at in places.items()}
        self.base = b.inttoptr(b.load(places[""]), VECTOR)
        self.prepared = {e.number: k for k, e in enumerate(program.prepared)}
        self._write()
        for name, (_, leap) in leaps.items():
            # Pointers are bytes, leaps are doubles.
            b.store(b.add(b.load(places[name]), b.mul(leap, whole(8))), places[name])
        machines.close()
        b.ret(b.load(self.flags))

    def emitter(self) -> Emitter:
        return Emitter(self.b, self.used, self.prepared, self.base)

    def _any(self, mask: Value) -> Value:
        return self.b.call(f"llvm.vector.reduce.or.v{LANES}i1", BIT, [mask])

    def _above(self, value: Value) -> Value:
        return self.b.fcmp("ogt", value, self.emitter().number(0.0))

    def _load(self, name: str, size: int) -> list[Value]:
        """An input's entries, a vector each."""
        base, stride = self.pointers[name], self.strides[name]
        b = self.b
        rows = [b.mul(place, stride) for place in self.places]
        values = []
        for j in range(size):
            vector = undefined(VECTOR)
            for lane, row in enumerate(rows):
                at = b.gep(base, b.add(row, whole(j)))
                vector = b.insert_element(vector, b.load(at), lane)
            values.append(vector)
        return values

    def _save(self, base: Value, values: Sequence[Value]) -> None:
        b = self.b
        if len(values) > LONG:
            self._save_long(base, values)
            return
        size = whole(len(values))
        rows = [b.mul(place, size) for place in self.places]
        for j, value in enumerate(values):
            for lane, row in enumerate(rows):
                at = b.gep(base, b.add(row, whole(j)))
                b.store(b.extract_element(value, lane), at)

    def _save_long(self, base: Value, values: Sequence[Value]) -> None:
        """The same in a loop: thousands of stores in a row take minutes to compile."""
        b = self.b
        size = whole(len(values))
        scratch = b.alloca(VECTOR, len(values))
        for j, value in enumerate(values):
            b.store(value, b.gep(scratch, whole(j)))
        rows = [b.mul(place, size) for place in self.places]
        entries = _Counter(b, "save", size)
        k = entries.begin()
        value = b.load(b.gep(scratch, k))
        for lane, row in enumerate(rows):
            b.store(b.extract_element(value, lane), b.gep(base, b.add(row, k)))
        entries.close()

    def _write(self) -> None:
        """All samples of a machine."""
        b, program = self.b, self.program
        samples = _Counter(b, "samples", self.count, LANES)
        i = samples.begin()
        # Lanes beyond the last sample compute it once more, and store the same again.
        last = b.sub(self.count, ONE)
        self.places = []
        for lane in range(LANES):
            place = b.add(i, whole(lane))
            self.places.append(b.select(b.icmp("slt", place, last), place, last))
        values = {name: self._load(name, size) for name, size in program.inputs.items()}
        good, reached = TRUE, self.emitter().number(1.0)
        state: list[Value] = []
        for q in program.equations:
            values[q.unknowns] = self._solve(q, values, state)
        if state:
            good, reached = self._above(b.load(state[AT.alive])), b.load(state[AT.reached])
        out = self.emitter()
        names = list(program.outputs)
        rows = {name: out.run(list(program.outputs[name]), values) for name in names}
        for value in out.run(holding(program.equations), values):
            good = b.and_(good, self._above(value))
        total = out.number(0.0)
        for row in rows.values():
            for value in row:
                total = b.fadd(total, out.call("fabs", value))
        # Inputs that no output hangs on have to be numbers, too.
        for name in program.inputs:
            for value in values[name]:
                total = b.fadd(total, out.call("fabs", value))
        finite = b.fcmp("olt", total, out.number(LARGE))
        code = b.select(good, b.select(finite, out.number(0.0), out.number(2.0)), out.number(1.0))
        good = b.and_(good, finite)
        nothing = out.number(math.nan)
        for name in names:
            target = self.pointers[f"to {name}"]
            self._save(target, [b.select(good, v, nothing) for v in rows[name]])
        self._save(self.pointers[f"to {STATUS}"], [code, reached])
        bad = b.zext(self._any(b.xor(good, TRUE)), INT64)
        b.store(b.or_(b.load(self.flags), bad), self.flags)
        samples.close()

    def _store_progress(self, k: Value, n: Sequence[Value]) -> None:
        """As :func:`.program.progress`, of step k + 1."""
        b, parts = self.b, []
        for more in (-1, 0, 1):
            share = b.fdiv(b.sitofp(b.add(k, whole(more)), DOUBLE), b.sitofp(self.steps, DOUBLE))
            left = b.fsub(real(1.0), share)
            parts.append(b.fsub(real(1.0), b.fmul(b.fmul(left, left), left)))
        b.store(b.splat(parts[2], LANES), n[AT.part])
        onward = b.fdiv(b.fsub(parts[2], parts[1]), b.fsub(parts[1], parts[0]))
        b.store(b.splat(onward, LANES), n[AT.onward])

    def _solve(self, q: Equations, values: dict[str, list[Value]], n: list[Value]) -> list[Value]:
        """Newton's method in steps; the unknowns. The state is made by the first equations."""
        b, number = self.b, self.emitter().number
        first = not n
        x, last, aim = ([b.alloca(VECTOR) for _ in row] for row in (q.home, q.home, q.origin))
        n += [b.alloca(VECTOR) for _ in (AT if first else ())]
        size = b.alloca(VECTOR)
        if q.goal:
            values[q.target] = self.emitter().run(q.goal, values)

        def run(
            results: Sequence[Expression],
            to: Sequence[Value],
            moved: Mapping[str, Sequence[Value]] = MappingProxyType({}),
            first: Sequence[Expression] = (),
        ) -> None:
            """Results of the state and of what has moved."""
            here = {name: [b.load(place) for place in row] for name, row in moved.items()}
            here[STATE] = [b.load(place) for place in n]
            out, given = self.emitter(), {**values, **here}
            out.masks |= uniform
            # All of a correction before what is kept of it: fewer values wait in registers.
            out.run(first, given)
            for place, e in zip(to, results, strict=True):
                b.store(out.run([e], given)[0], place)

        once = b.icmp("eq", self.steps, ONE)
        if first:
            b.store(b.select(once, number(1.0), number(0.0)), n[AT.once])
            b.store(number(1.0), n[AT.alive])
            b.store(number(0.0), n[AT.reached])
        # The same for all lanes: a jump, which is foreseen, instead of a choice by lane.
        uniform = {q.state[AT.once].number: once}
        run(q.home, last)
        steps = _Counter(b, "step", self.steps)
        k = steps.begin()
        uniform[q.underway.number] = b.icmp("slt", b.add(k, ONE), self.steps)
        self._store_progress(k, n)
        b.store(b.load(n[AT.alive]), n[AT.moving])
        run(q.aim, aim)
        begin, onward, both = (b.block(name) for name in ("begin", "onward", "turns"))
        b.cbranch(b.icmp("eq", k, ZERO), begin, onward)
        b.go_to(begin)
        run(q.begin, [*x, size], {q.target: aim})
        b.branch(both)
        b.go_to(onward)
        here = [b.load(place) for place in x]
        run(q.onward, x, {q.unknowns: x, previous(q.unknowns): last})
        for value, place in zip(here, last, strict=True):
            b.store(value, place)
        b.branch(both)
        b.go_to(both)
        b.store(b.load(size), n[AT.size])
        turns = _Counter(b, "turn", whole(MAX_ITERATIONS))
        turns.begin()
        kept = [*x, *n[AT.size : AT.reached]]
        run(q.correct, kept, {q.unknowns: x, q.target: aim}, q.results)
        turns.close(self._any(self._above(b.load(n[AT.moving]))))
        run(q.arrive, n[AT.alive : AT.reached + 1])
        steps.close(self._any(self._above(b.load(n[AT.alive]))))
        return [b.load(place) for place in x]


def emit(program: Program) -> str:
    """The program as text of LLVM's intermediate language: two functions of one argument.

    ``prepare``: see :func:`_preparation`. ``kernel``: the argument points at words: number of
    machines, of samples of each, steps; pointer to what was prepared, and what it goes on by from a
    machine to the next (doubles); of each input pointer, stride (0: one for all samples, else its
    size) and what it goes on by; pointers to the outputs, row after row; pointer to the status, two
    numbers a sample: 0 good, 1 refused, 2 not finite; and the part of the way that was reached. It
    returns 0 if all samples are good.
    """
    return module(binding.get_default_triple(), [_preparation(program), _Writer(program).b])
