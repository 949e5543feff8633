# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What a back end gets: results as expressions of inputs, and equations to be solved before."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

from pkm_twin.codegen.expressions import (
    GEOMETRY,
    PARAMETERS,
    Expression,
    Tape,
    edge,
    ordered,
)
from pkm_twin.codegen.operations import both, less, select
from pkm_twin.errors import PkmTwinError

UNKNOWNS: Final = "x"
"""Name of the input that Newton's method finds."""

CLOSED: Final = 1e-8
"""Newton's method ends with a correction below this: it converges quadratically, so its square, of
unit one, is left: half a unit of rounding."""
MAX_ITERATIONS: Final = 12
"""Most corrections a step."""
CONTRACTION: Final = 0.25
"""Most that a correction may be of the one before it."""
FIRST: Final = 0.3
"""Most that the first correction of a guess may be, of unit one: a longer one may go elsewhere."""
AHEAD: Final = 0.1
"""The same of each of more steps, which begins where the ones before lead on."""
NEXT: Final = 0.01
"""Most that the first correction of a stream's sample may be, which starts from the one before."""
LEAST: Final = 1e-8
"""Least determinant, over the one at home."""
MARGIN: Final = 5.0
"""Least determinant over a correction of a guess in one step: a longer one may step over two
singularities, to a determinant of the same sign. Of more steps every first correction is short."""
LARGE: Final = 1e300
"""Sum of the sizes of inputs and results from which on they count as infinite."""
RESIDUAL: Final = 1e-10
"""Largest residual of all equations, those that were not solved too, lengths over the size."""


STATE: Final = "n"
"""Name of the input that Newton's method keeps between corrections, see :class:`Places`."""


LAST: Final = "last"
"""Name of the input that one sample of a stream leaves to the next; zeros before the first one."""


class Places(NamedTuple):
    """Places in the state of Newton's method.

    ``once``: 1 in a single step, else 0. ``part``: of the way, to the target of a step. ``onward``:
    length of the step over that of the one before it, 0 for the first one. ``size``: square of the
    last correction. ``moving``, ``alive``: 1 as long as a sample is corrected, and as long as it is
    not refused. ``reached``: part of the way.
    """

    once: int
    part: int
    onward: int
    size: int
    moving: int
    alive: int
    reached: int


AT: Final = Places(*range(7))


def progress(k: int, steps: int) -> tuple[float, float]:
    """Part of the way after step k of so many, and the length of this step over the one before it.

    The steps become short towards the end: next to a singularity only short ones contract.
    """
    a, b, c = (1.0 - (1.0 - j / steps) ** 3 for j in (k - 2, k - 1, k))
    return c, (c - b) / (b - a)


def previous(unknowns: str) -> str:
    """Name of the input that is the unknowns a step before."""
    return f"{unknowns}_before"


PARTS: Final = ("home", "goal", "aim", "begin", "onward", "correct", "arrive")
"""Of equations, what is computed while they are solved."""


@dataclass(frozen=True, eq=False)
class Equations:
    """Unknowns x of the target q, found by Newton's method from a known state.

    The target is an input of the program, or ``goal``: expressions of inputs and of the unknowns of
    equations before these. ``stage``: how many those are.

    One step goes from ``start`` (expressions of q; None: from home) to the target at once. In more
    steps the target moves from ``origin`` to q by :func:`progress`, from the unknowns ``home``.
    Every step begins where the one before it leads on straight: beyond a place where two assemblies
    cross, the determinant there is below zero, while Newton's method from the side of the other one
    would turn to that.

    A sample is refused where a correction does not contract, where the determinant is too small, or
    where a residual stays: then it may be another root that was found.
    """

    target: str
    home: Sequence[Expression]
    origin: Sequence[Expression]
    """Unknowns and target of the known state: constants, or of parameters alone."""
    start: Sequence[Expression] | None
    onward: Sequence[Expression]
    """Unknowns to begin a further step with: of the last ones, and of those a step before."""
    corrected: Sequence[Expression]
    """The unknowns after one correction."""
    size: Expression
    """Square of the correction, of unit one."""
    determinant: Expression
    """Of the equations, over that at home."""
    residual: Expression
    """Square of the residual of all equations, of unit one."""
    guessed: bool = False
    """Whether the start is a guess, that may be nearer to another root."""
    branch: Sequence[Expression] = ()
    """Above zero in the mechanism's own branch, at the target."""

    unknowns: str = UNKNOWNS
    """Name of the input that the method finds."""
    goal: Sequence[Expression] = ()
    stage: int = 0
    near: Expression | None = None
    """1 where a single step starts from ``foreseen``: of another sample's unknowns."""
    foreseen: Sequence[Expression] = ()

    lone: bool = False
    """Whether a sample is solved alone: its state says nothing of whether it moves."""

    @property
    def inputs(self) -> dict[str, int]:
        """Sizes of the inputs that exist while it is solved, by name."""
        n = len(self.home)
        own = {self.unknowns: n, previous(self.unknowns): n}
        return own | {self.target: len(self.origin), STATE: len(AT)}

    @property
    def results(self) -> list[Expression]:
        """All expressions of one correction."""
        return [*self.corrected, self.size, self.determinant]

    @cached_property
    def state(self) -> list[Any]:
        """:data:`STATE` as expressions."""
        state = list(self.size.tape.inputs(STATE, len(AT)))
        if self.lone:
            state[AT.moving] = state[AT.alive] = self.size.tape.constant(1.0)
        return state

    def _lift(self, *values: Any) -> list[Expression]:
        return [self.size.tape.lift(value) for value in values]

    @cached_property
    def begin(self) -> list[Expression]:
        """Unknowns to begin with, and the size that the first correction contracts from."""
        once, known = self.state[AT.once], self.start is not None and not self.guessed
        first: Sequence[Any] = self.start or self.home
        if known:
            first = [select(once, a, b) for a, b in zip(first, self.home, strict=True)]
        ahead = 1e300 if self.start is None else (AHEAD / CONTRACTION) ** 2
        size = 1e300 if known else select(once, (FIRST / CONTRACTION) ** 2, ahead)
        if self.near is not None:
            pairs = zip(self.foreseen, first, strict=True)
            first = [select(self.near, a, b) for a, b in pairs]
            size = select(self.near, (NEXT / CONTRACTION) ** 2, size)
        return self._lift(*first, size)

    @cached_property
    def underway(self) -> Expression:
        """1 in a step that does not lead to the target, else 0."""
        return self._lift(less(self.state[AT.part], 1.0))[0]

    @cached_property
    def aim(self) -> list[Expression]:
        """The target of a step."""
        part, more = self.state[AT.part], self.underway
        goal = self.size.tape.inputs(self.target, len(self.origin))
        ways = zip(self.origin, goal, strict=True)
        return self._lift(*(select(more, a + part * (b - a), b) for a, b in ways))

    @cached_property
    def correct(self) -> list[Expression]:
        """After a correction: the unknowns, then the state from size to alive.

        A sample stays refused where a correction does not contract, or where the determinant is
        too small. A closed form of the start is in the right assembly; a guess may lead to another.
        """
        state, size, determinant = self.state, self.size, self.determinant
        once, moving = state[AT.once], state[AT.moving]
        known = self.start is not None and not self.guessed
        x = self.size.tape.inputs(self.unknowns, len(self.home))
        new = (select(moving, a, b) for a, b in zip(self.corrected, x, strict=True))
        sound = both(less(size, CONTRACTION**2 * state[AT.size]), less(LEAST, determinant))
        if not known:
            longest = select(once, MARGIN**2 * size, 0.0)
            sound = both(sound, less(longest, determinant * determinant))
        moves = both(moving, both(sound, less(CLOSED**2, size)))
        return self._lift(*new, size, moves, select(moving, sound, state[AT.alive]))

    @cached_property
    def arrive(self) -> list[Expression]:
        """After a step: the state's alive and reached. What still moves is refused."""
        n = self.state
        alive = select(n[AT.moving], 0.0, n[AT.alive])
        return self._lift(alive, select(alive, n[AT.part] + float(self.stage), n[AT.reached]))

    @cached_property
    def held(self) -> Expression:
        """1 where all equations hold, in the mechanism's own branch, else 0."""
        held = less(self.residual, RESIDUAL**2)
        for value in self.branch:
            held = both(held, less(0.0, value))
        return self._lift(held)[0]


def holding(equations: Iterable[Equations]) -> list[Expression]:
    """1 where all of these equations hold, else 0: in a list, empty where there are none."""
    result: list[Expression] = []
    for q in equations:
        result = [both(result[0], q.held) if result else q.held]
    return result


@dataclass(frozen=True, eq=False)
class Program:
    """Outputs by name as expressions of the inputs, of the parameters and of solved unknowns.

    ``inputs``: sizes by name, in the order of the call, without parameters and unknowns.
    ``equations``: are solved one after the other.
    ``quick``: better compiled in a tenth of the time than run in two thirds of it.
    """

    inputs: Mapping[str, int]
    parameters: int
    outputs: Mapping[str, Sequence[Expression]]
    equations: Sequence[Equations] = ()
    quick: bool = False

    def __post_init__(self) -> None:
        known = {**self.inputs, PARAMETERS: self.parameters, GEOMETRY: self.geometry}
        for q in self.equations:
            known |= q.inputs
        for e in ordered(self.results):
            name, index = e.source or ("", -1)
            if not index < known.get(name, 0):
                raise PkmTwinError(f"the program reads {name}[{index}], which is no input")

    @property
    def geometry(self) -> int:
        """How many numbers of the geometry it reads, behind its own parameters."""
        return len(self.results[0].tape.reference) if self.results else 0

    @property
    def results(self) -> list[Expression]:
        """Every expression that is computed."""
        rows = [e for row in self.outputs.values() for e in row]
        for q in self.equations:
            rows += [e for name in PARTS for e in getattr(q, name)]
        return rows + holding(self.equations)

    @cached_property
    def prepared(self) -> list[Expression]:
        """What hangs on parameters alone and samples read: computed once a machine, by
        :attr:`Program.preparation`, and given to every call.
        """
        return edge(self.results)

    @property
    def missed(self) -> Expression:
        """By how much the parameters miss what the program takes for constant, squared."""
        tape = self.results[0].tape if self.results else Tape()
        total: Any = 0.0
        for e, target in tape.assumed:
            total = total + (e - target) * (e - target)
        return tape.lift(total)
