# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Translate a program to vector code that computes LANES samples at a time.

One sample and a batch have the same bits: every lane computes the same operations, and a lane that
has converged keeps its values. A product that is used once is fused with the sum that uses it where
the processor can (FMA).
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
    integer_constant,
    module,
    real_constant,
    undefined_value,
)
from pkm_twin.codegen.expressions import GEOMETRY, PARAMETERS, Expression, count_uses, list_dependencies
from pkm_twin.codegen.native import CPU, FEATURES, OPTIMISATION, PREPARE, QUICK, SYMBOL
from pkm_twin.codegen.operations import fused, sub
from pkm_twin.codegen.program import (
    MAX_ITERATIONS,
    MAX_SUM,
    STATE,
    STATE_INDEX,
    Equations,
    Program,
    flag_solved,
    previous_input_name,
)

STATUS: Final = " status"
MAX_UNROLLED_STORES: Final = 100
"""Most entries of an output that are stored by straight-line code; more are stored in a loop."""

ZERO: Final = integer_constant(0)
ONE: Final = integer_constant(1)
IDENTITY: Final = f"{llvmlite.__version__} {CPU} {FEATURES} {LANES} {OPTIMISATION} {QUICK}"
"""Everything that the machine code depends on in addition to the program."""


class Emitter(Lanes):
    """Writes the values of expressions at one point of the code, as scalars or in lanes.

    :param used: number of uses of each expression, see :func:`count_uses`.
    :param prepared: index in memory of each expression of parameters alone. It is loaded at every
        use, because keeping it in a register through the whole program would occupy that register.
    :param base: address of the prepared values; None for scalar code.
    """

    def __init__(self, b: Function, used: Mapping[int, int], prepared: Mapping[int, int], base: Value | None) -> None:
        super().__init__(b, wide=base is not None)
        self._used, self._prepared, self._base = used, prepared, base
        self._known: dict[int, Value] = {}

    def known(self, e: Expression) -> Value:
        """Return the value of an expression that was computed before."""
        if self._base is None or e.number not in self._prepared:
            return self._known[e.number]
        place = self.function.gep(self._base, integer_constant(self._prepared[e.number]))
        return self.function.load(place, ALIGN)

    def value(self, e: Expression, inputs: Mapping[str, Sequence[Value]]) -> Value:
        """Write the instructions of one expression whose arguments were computed before."""
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
            x, z = (x, self.function.fneg(z)) if first else (self.function.fneg(x), z)
        return self.fused(x, y, z)

    def run(self, results: Sequence[Expression], inputs: Mapping[str, Sequence[Value]]) -> list[Value]:
        """Compute the results, every shared expression once."""
        for e in list_dependencies(results, {**self._known, **self._prepared}):
            self._known[e.number] = self.value(e, inputs)
        return [self.known(e) for e in results]


class _CountingLoop:
    """A loop whose index counts from zero to ``end``."""

    def __init__(self, b: Function, name: str, end: Value, step: int = 1) -> None:
        self.function, self.end, self.step = b, end, step
        self._place = b.alloca(INT64)
        self.head, self.body, self.after = (b.block(name) for _ in range(3))

    def begin(self) -> Value:
        """Enter the loop; return its index."""
        b = self.function
        b.store(ZERO, self._place)
        b.branch(self.head)
        b.go_to(self.head)
        index = b.load(self._place)
        b.cbranch(b.icmp("slt", index, self.end), self.body, self.after)
        b.go_to(self.body)
        return index

    def close(self, more: Value | None = None) -> None:
        """End the body: repeat (only if ``more`` is true), then continue after the loop."""
        b = self.function
        b.store(b.add(b.load(self._place), integer_constant(self.step)), self._place)
        if more is None:
            b.branch(self.head)
        else:
            b.cbranch(more, self.head, self.after)
        b.go_to(self.after)


def _make_function(name: str) -> Function:
    return Function(name, typed_pointers=binding.llvm_version_info < (17,))


def _load_word(b: Function, k: int) -> Value:
    return b.load(b.gep(b.words, integer_constant(k)))


def _write_preparation(program: Program) -> Function:
    """Write the function that computes all expressions of parameters alone, for each machine.

    Its words: number of machines; address of the parameters and their stride, doubles; address of
    the results, each repeated in all lanes.
    """
    b = _make_function(PREPARE)
    count, stride = _load_word(b, 0), _load_word(b, 2)
    source, target = b.inttoptr(_load_word(b, 1), DOUBLE), b.inttoptr(_load_word(b, 3), DOUBLE)
    results = [*program.prepared, program.missed]
    machines = _CountingLoop(b, "machine", count)
    index = machines.begin()
    here = b.gep(source, b.mul(index, stride))
    there = b.gep(target, b.mul(index, integer_constant(LANES * len(results))))
    # The geometry follows the program's own parameters.
    first = {PARAMETERS: 0, GEOMETRY: program.parameters}
    inputs: dict[str, dict[int, Value]] = {name: {} for name in first}
    for e in list_dependencies(results):
        if e.source is not None:
            name, k = e.source
            inputs[name][k] = b.load(b.gep(here, integer_constant(first[name] + k)))
    out = Emitter(b, count_uses(results), {}, None)
    for k, value in enumerate(out.run(results, inputs)):  # type: ignore[arg-type]
        for lane in range(LANES):
            b.store(value, b.gep(there, integer_constant(LANES * k + lane)))
    machines.close()
    b.ret(ZERO)
    return b


class _Writer:
    """Writes the function ``kernel`` of a program, see :func:`emit`."""

    def __init__(self, program: Program) -> None:
        self.program = program
        b = self.function = _make_function(SYMBOL)
        self.used = count_uses(program.results)
        names = list(program.inputs)
        self.count, self.steps = _load_word(b, 1), _load_word(b, 2)
        self.flags = b.alloca(INT64)
        b.store(ZERO, self.flags)
        self.strides = {name: _load_word(b, 6 + 3 * k) for k, name in enumerate(names)}
        # Addresses and their strides from one machine to the next, doubles.
        at = 5 + 3 * len(names)
        leaps = {"": (3, _load_word(b, 4))}
        leaps |= {name: (5 + 3 * k, _load_word(b, 7 + 3 * k)) for k, name in enumerate(names)}
        sizes = {**{name: len(row) for name, row in program.outputs.items()}, STATUS: 2}
        for k, (name, size) in enumerate(sizes.items()):
            leaps[f"to {name}"] = at + k, b.mul(self.count, integer_constant(size))
        places = {name: b.alloca(INT64) for name in leaps}
        for name, (k, _) in leaps.items():
            b.store(_load_word(b, k), places[name])
        machines = _CountingLoop(b, "machine", _load_word(b, 0))
        machines.begin()
        self.pointers = {name: b.inttoptr(b.load(at), DOUBLE) for name, at in places.items()}
        self.base = b.inttoptr(b.load(places[""]), VECTOR)
        self.prepared = {e.number: k for k, e in enumerate(program.prepared)}
        self._write_samples()
        for name, (_, leap) in leaps.items():
            # Addresses count bytes, strides count doubles.
            b.store(b.add(b.load(places[name]), b.mul(leap, integer_constant(8))), places[name])
        machines.close()
        b.ret(b.load(self.flags))

    def emitter(self) -> Emitter:
        return Emitter(self.function, self.used, self.prepared, self.base)

    def _any_lane(self, mask: Value) -> Value:
        return self.function.call(f"llvm.vector.reduce.or.v{LANES}i1", BIT, [mask])

    def _is_positive(self, value: Value) -> Value:
        return self.function.fcmp("ogt", value, self.emitter().number(0.0))

    def _load(self, name: str, size: int) -> list[Value]:
        """Load an input's entries, each as a vector over the samples."""
        base, stride = self.pointers[name], self.strides[name]
        b = self.function
        rows = [b.mul(place, stride) for place in self.places]
        values = []
        for j in range(size):
            vector = undefined_value(VECTOR)
            for lane, row in enumerate(rows):
                at = b.gep(base, b.add(row, integer_constant(j)))
                vector = b.insert_element(vector, b.load(at), lane)
            values.append(vector)
        return values

    def _save(self, base: Value, values: Sequence[Value]) -> None:
        b = self.function
        if len(values) > MAX_UNROLLED_STORES:
            self._save_in_loop(base, values)
            return
        size = integer_constant(len(values))
        rows = [b.mul(place, size) for place in self.places]
        for j, value in enumerate(values):
            for lane, row in enumerate(rows):
                at = b.gep(base, b.add(row, integer_constant(j)))
                b.store(b.extract_element(value, lane), at)

    def _save_in_loop(self, base: Value, values: Sequence[Value]) -> None:
        """Store an output in a loop: thousands of straight-line stores take minutes to compile."""
        b = self.function
        size = integer_constant(len(values))
        scratch = b.alloca(VECTOR, len(values))
        for j, value in enumerate(values):
            b.store(value, b.gep(scratch, integer_constant(j)))
        rows = [b.mul(place, size) for place in self.places]
        entries = _CountingLoop(b, "save", size)
        k = entries.begin()
        value = b.load(b.gep(scratch, k))
        for lane, row in enumerate(rows):
            b.store(b.extract_element(value, lane), b.gep(base, b.add(row, k)))
        entries.close()

    def _write_samples(self) -> None:
        """Write the loop over the samples of a machine."""
        b, program = self.function, self.program
        samples = _CountingLoop(b, "samples", self.count, LANES)
        i = samples.begin()
        # Lanes beyond the last sample compute the last sample again.
        last = b.sub(self.count, ONE)
        self.places = []
        for lane in range(LANES):
            place = b.add(i, integer_constant(lane))
            self.places.append(b.select(b.icmp("slt", place, last), place, last))
        values = {name: self._load(name, size) for name, size in program.inputs.items()}
        good, reached = TRUE, self.emitter().number(1.0)
        state: list[Value] = []
        for q in program.equations:
            values[q.unknowns] = self._solve(q, values, state)
        if state:
            good, reached = self._is_positive(b.load(state[STATE_INDEX.alive])), b.load(state[STATE_INDEX.reached])
        out = self.emitter()
        names = list(program.outputs)
        rows = {name: out.run(list(program.outputs[name]), values) for name in names}
        for value in out.run(flag_solved(program.equations), values):
            good = b.and_(good, self._is_positive(value))
        total = out.number(0.0)
        for row in rows.values():
            for value in row:
                total = b.fadd(total, out.call("fabs", value))
        # An input that is not finite is an error even if no output depends on it.
        for name in program.inputs:
            for value in values[name]:
                total = b.fadd(total, out.call("fabs", value))
        finite = b.fcmp("olt", total, out.number(MAX_SUM))
        code = b.select(good, b.select(finite, out.number(0.0), out.number(2.0)), out.number(1.0))
        good = b.and_(good, finite)
        nothing = out.number(math.nan)
        for name in names:
            target = self.pointers[f"to {name}"]
            self._save(target, [b.select(good, v, nothing) for v in rows[name]])
        self._save(self.pointers[f"to {STATUS}"], [code, reached])
        bad = b.zext(self._any_lane(b.xor(good, TRUE)), INT64)
        b.store(b.or_(b.load(self.flags), bad), self.flags)
        samples.close()

    def _store_continuation_fraction(self, k: Value, n: Sequence[Value]) -> None:
        """Compute and store how far step k + 1 goes to the target, see :func:`.program.progress`."""
        b, parts = self.function, []
        for more in (-1, 0, 1):
            share = b.fdiv(b.sitofp(b.add(k, integer_constant(more)), DOUBLE), b.sitofp(self.steps, DOUBLE))
            left = b.fsub(real_constant(1.0), share)
            parts.append(b.fsub(real_constant(1.0), b.fmul(b.fmul(left, left), left)))
        b.store(b.splat(parts[2], LANES), n[STATE_INDEX.part])
        onward = b.fdiv(b.fsub(parts[2], parts[1]), b.fsub(parts[1], parts[0]))
        b.store(b.splat(onward, LANES), n[STATE_INDEX.onward])

    def _solve(self, q: Equations, values: dict[str, list[Value]], n: list[Value]) -> list[Value]:
        """Write Newton's method in steps, with the state n; return the unknowns."""
        b, number = self.function, self.emitter().number
        first = not n
        x, last, aim = ([b.alloca(VECTOR) for _ in row] for row in (q.home, q.home, q.origin))
        n += [b.alloca(VECTOR) for _ in (STATE_INDEX if first else ())]
        size = b.alloca(VECTOR)
        if q.goal:
            values[q.target] = self.emitter().run(q.goal, values)

        def compute(
            results: Sequence[Expression],
            targets: Sequence[Value],
            variables: Mapping[str, Sequence[Value]] = MappingProxyType({}),
            first: Sequence[Expression] = (),
        ) -> None:
            """Compute results from the state and the inputs in ``variables``; store them in ``targets``."""
            here = {name: [b.load(place) for place in row] for name, row in variables.items()}
            here[STATE] = [b.load(place) for place in n]
            out, given = self.emitter(), {**values, **here}
            out.masks |= masks
            # Compute the whole correction before its selects, so that fewer values occupy registers.
            out.run(first, given)
            for place, e in zip(targets, results, strict=True):
                b.store(out.run([e], given)[0], place)

        once = b.icmp("eq", self.steps, ONE)
        if first:
            b.store(b.select(once, number(1.0), number(0.0)), n[STATE_INDEX.once])
            b.store(number(1.0), n[STATE_INDEX.alive])
            b.store(number(0.0), n[STATE_INDEX.reached])
        # Use branches instead of selects for conditions that are equal in all lanes: they are predictable.
        masks = {q.state[STATE_INDEX.once].number: once}
        compute(q.home, last)
        steps = _CountingLoop(b, "step", self.steps)
        k = steps.begin()
        masks[q.is_underway.number] = b.icmp("slt", b.add(k, ONE), self.steps)
        self._store_continuation_fraction(k, n)
        b.store(b.load(n[STATE_INDEX.alive]), n[STATE_INDEX.moving])
        compute(q.step_target, aim)
        begin, onward, joined = (b.block(name) for name in ("begin", "onward", "turns"))
        b.cbranch(b.icmp("eq", k, ZERO), begin, onward)
        b.go_to(begin)
        compute(q.begin, [*x, size], {q.target: aim})
        b.branch(joined)
        b.go_to(onward)
        here = [b.load(place) for place in x]
        compute(q.onward, x, {q.unknowns: x, previous_input_name(q.unknowns): last})
        for value, place in zip(here, last, strict=True):
            b.store(value, place)
        b.branch(joined)
        b.go_to(joined)
        b.store(b.load(size), n[STATE_INDEX.size])
        corrections = _CountingLoop(b, "turn", integer_constant(MAX_ITERATIONS))
        corrections.begin()
        kept = [*x, *n[STATE_INDEX.size : STATE_INDEX.reached]]
        compute(q.corrected_state, kept, {q.unknowns: x, q.target: aim}, q.results)
        corrections.close(self._any_lane(self._is_positive(b.load(n[STATE_INDEX.moving]))))
        compute(q.flags_after_step, n[STATE_INDEX.alive : STATE_INDEX.reached + 1])
        steps.close(self._any_lane(self._is_positive(b.load(n[STATE_INDEX.alive]))))
        return [b.load(place) for place in x]


def emit(program: Program) -> str:
    """Write a program as LLVM assembly: two functions that take the address of 64-bit words.

    ``prepare``: see :func:`_write_preparation`. ``kernel``: 0 if all samples are good; its words:

    - number of machines, samples per machine, steps;
    - address of the prepared parameters and their stride from one machine to the next, doubles;
    - for each input its address, its stride from sample to sample (0: one for all samples) and from
      machine to machine, doubles;
    - the address of each output, rows one after the other;
    - the address of the status, two numbers per sample: 0 good, 1 refused, 2 not finite; and the
      fraction of the motion from home that was reached.
    """
    return module(binding.get_default_triple(), [_write_preparation(program), _Writer(program).function])
