# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Define a program: its results as expressions, and the equations to solve first."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any, Final, NamedTuple

from pkm_twin.codegen.expressions import (
    GEOMETRY,
    PARAMETERS,
    Expression,
    Tape,
    find_prepared,
    list_dependencies,
)
from pkm_twin.codegen.operations import both, less, select
from pkm_twin.errors import PkmTwinError

UNKNOWNS: Final = "x"
"""Name of the input that holds the unknowns of Newton's method."""

MAX_LAST_CORRECTION: Final = 1e-8
"""Largest dimensionless last correction of Newton's method. Convergence is quadratic, so the
remaining error is its square: half a unit of rounding."""
MAX_ITERATIONS: Final = 12
"""Largest number of Newton corrections per step."""
MAX_CONTRACTION: Final = 0.25
"""Largest ratio of a correction to the previous correction."""
MAX_FIRST_CORRECTION: Final = 0.3
"""Largest dimensionless first correction from a guess; a longer one may lead to another root."""
MAX_EXTRAPOLATED_CORRECTION: Final = 0.1
"""Largest dimensionless first correction of a step that starts at an extrapolated point."""
MAX_STREAM_CORRECTION: Final = 0.01
"""Largest dimensionless first correction of a stream's sample, which starts from the last sample."""
MIN_RELATIVE_DETERMINANT: Final = 1e-8
"""Smallest determinant, relative to the determinant at home."""
MAX_GROWTH: Final = MIN_RELATIVE_DETERMINANT**-2
"""Largest :meth:`.SparseLU.find_growth`: results keep half of their digits."""
MIN_DETERMINANT_RATIO: Final = 5.0
"""Smallest ratio of determinant to correction from a guess in a single step. A longer correction may
cross two singularities, to a determinant of the same sign. It does not apply to several steps, whose
first corrections are short."""
MAX_SUM: Final = 1e300
"""Largest sum of the absolute inputs and results; a larger one counts as infinite."""
MAX_RESIDUAL: Final = 1e-10
"""Largest residual of all equations, including redundant ones; lengths relative to the size."""


STATE: Final = "n"
"""Name of the input with the state of Newton's method, see :class:`StateIndices`."""


LAST: Final = "last"
"""Name of the input with the unknowns of the stream's sample before; zeros for the first one."""


class StateIndices(NamedTuple):
    """Indices into the state of Newton's method.

    ``once``: 1 if the motion has a single step, else 0. ``part``: fraction of the motion from the
    known state to the target at the end of this step. ``onward``: length of the step relative to
    the step before, 0 for the first. ``size``: square of the last correction. ``moving``: 1 while
    corrections continue. ``alive``: 1 unless the sample is refused. ``reached``: fraction of the
    motion that was reached.
    """

    once: int
    part: int
    onward: int
    size: int
    moving: int
    alive: int
    reached: int


STATE_INDEX: Final = StateIndices(*range(7))


def progress(k: int, steps: int) -> tuple[float, float]:
    """Return the fraction of the motion after step k, and the ratio of steps k and k - 1.

    Steps become shorter towards the end: near a singularity only short steps contract.
    """
    a, b, c = (1.0 - (1.0 - j / steps) ** 3 for j in (k - 2, k - 1, k))
    return c, (c - b) / (b - a)


def previous_input_name(unknowns: str) -> str:
    """Return the name of the input with the unknowns of the previous step."""
    return f"{unknowns}_before"


SOLUTION_PARTS: Final = ("home", "goal", "step_target", "begin", "onward", "corrected_state", "flags_after_step")
"""Attributes of :class:`Equations` that are computed while the equations are solved."""


@dataclass(frozen=True, eq=False)
class Equations:
    """Equations of unknowns x for a target q, solved by Newton's method from a known state.

    The target is an input of the program, or ``goal``: expressions of inputs and of the unknowns of
    equations that are solved before. ``stage``: the number of these equations.

    A single step goes from ``start`` (expressions of q; None: from ``home``) to the target. In
    several steps the target moves from ``origin`` to q by :func:`progress`, beginning with the
    unknowns ``home``. Each step starts at the linear extrapolation of the steps before. Beyond a
    configuration where two assemblies cross, extrapolation stays on the same branch, where the
    determinant is negative; Newton's method without it would change to the other branch.

    A sample is rejected if a correction does not contract, the determinant is too small or a
    residual remains: the root found may belong to another assembly.
    """

    target: str
    home: Sequence[Expression]
    origin: Sequence[Expression]
    """Target at the known state ``home``: constants or parameter expressions."""
    start: Sequence[Expression] | None
    onward: Sequence[Expression]
    """Unknowns to begin a further step with, from those of the last two steps."""
    corrected: Sequence[Expression]
    """Unknowns after one correction."""
    size: Expression
    """Square of the dimensionless correction."""
    determinant: Expression
    """Determinant of the equations, relative to that at home."""
    residual: Expression
    """Square of the dimensionless residual of all equations."""
    guessed: bool = False
    """Whether ``start`` is a guess, which may be nearer to another root."""
    branch: Sequence[Expression] = ()
    """Expressions that are positive at the target in the mechanism's own assembly."""

    unknowns: str = UNKNOWNS
    """Name of the input that holds the unknowns."""
    goal: Sequence[Expression] = ()
    stage: int = 0
    near: Expression | None = None
    """Expression: 1 where a single step starts from ``foreseen``, unknowns predicted from another sample."""
    foreseen: Sequence[Expression] = ()
    certain: Sequence[Expression] = ()
    """Expressions that are positive where the assembly needs no further confirmation."""

    lone: bool = False
    """Whether samples are solved one by one, so that ``moving`` and ``alive`` need no selects."""

    @property
    def inputs(self) -> dict[str, int]:
        """Sizes of the inputs that exist while the equations are solved, by name."""
        n = len(self.home)
        own = {self.unknowns: n, previous_input_name(self.unknowns): n}
        return own | {self.target: len(self.origin), STATE: len(STATE_INDEX)}

    @property
    def results(self) -> list[Expression]:
        """All expressions of one correction."""
        return [*self.corrected, self.size, self.determinant]

    @cached_property
    def state(self) -> list[Any]:
        """The state of Newton's method as expressions."""
        state = list(self.size.tape.inputs(STATE, len(STATE_INDEX)))
        if self.lone:
            state[STATE_INDEX.moving] = state[STATE_INDEX.alive] = self.size.tape.constant(1.0)
        return state

    def _lift_all(self, *values: Any) -> list[Expression]:
        return [self.size.tape.lift(value) for value in values]

    @cached_property
    def begin(self) -> list[Expression]:
        """Initial unknowns, and the squared size that the first correction is compared with."""
        once, closed_form = self.state[STATE_INDEX.once], self.start is not None and not self.guessed
        first: Sequence[Any] = self.start or self.home
        if closed_form:
            first = [select(once, a, b) for a, b in zip(first, self.home, strict=True)]
        extrapolated = 1e300 if self.start is None else (MAX_EXTRAPOLATED_CORRECTION / MAX_CONTRACTION) ** 2
        size = 1e300 if closed_form else select(once, (MAX_FIRST_CORRECTION / MAX_CONTRACTION) ** 2, extrapolated)
        if self.near is not None:
            pairs = zip(self.foreseen, first, strict=True)
            first = [select(self.near, a, b) for a, b in pairs]
            size = select(self.near, (MAX_STREAM_CORRECTION / MAX_CONTRACTION) ** 2, size)
        return self._lift_all(*first, size)

    @cached_property
    def is_underway(self) -> Expression:
        """Expression: 1 in a step that ends before the target, else 0."""
        return self._lift_all(less(self.state[STATE_INDEX.part], 1.0))[0]

    @cached_property
    def step_target(self) -> list[Expression]:
        """Input values, for example joint positions, that the present step solves for."""
        part, underway = self.state[STATE_INDEX.part], self.is_underway
        goal = self.size.tape.inputs(self.target, len(self.origin))
        pairs = zip(self.origin, goal, strict=True)
        return self._lift_all(*(select(underway, a + part * (b - a), b) for a, b in pairs))

    @cached_property
    def corrected_state(self) -> list[Expression]:
        """Unknowns after a correction, followed by the entries ``size`` to ``alive`` of the state.

        A sample is rejected if a correction does not contract or the determinant is too small. A
        start in closed form is in the right assembly; a guess may lead to another.
        """
        state, size, determinant = self.state, self.size, self.determinant
        once, moving = state[STATE_INDEX.once], state[STATE_INDEX.moving]
        closed_form = self.start is not None and not self.guessed
        x = self.size.tape.inputs(self.unknowns, len(self.home))
        new = (select(moving, a, b) for a, b in zip(self.corrected, x, strict=True))
        converges = both(
            less(size, MAX_CONTRACTION**2 * state[STATE_INDEX.size]), less(MIN_RELATIVE_DETERMINANT, determinant)
        )
        if not closed_form:
            min_determinant = select(once, MIN_DETERMINANT_RATIO**2 * size, 0.0)
            converges = both(converges, less(min_determinant, determinant * determinant))
        continues = both(moving, both(converges, less(MAX_LAST_CORRECTION**2, size)))
        return self._lift_all(*new, size, continues, select(moving, converges, state[STATE_INDEX.alive]))

    @cached_property
    def flags_after_step(self) -> list[Expression]:
        """``alive`` and ``reached`` after a step; a sample whose corrections have not converged is rejected."""
        n = self.state
        alive = select(n[STATE_INDEX.moving], 0.0, n[STATE_INDEX.alive])
        return self._lift_all(alive, select(alive, n[STATE_INDEX.part] + float(self.stage), n[STATE_INDEX.reached]))

    @cached_property
    def is_solved(self) -> Expression:
        """Expression: 1 where all equations hold and ``branch`` is positive, else 0."""
        solved = less(self.residual, MAX_RESIDUAL**2)
        for value in self.branch:
            solved = both(solved, less(0.0, value))
        return self._lift_all(solved)[0]


def flag_solved(equations: Iterable[Equations], *, certain: bool = True) -> list[Expression]:
    """Return a list of one expression, 1 where all equations hold; an empty list without equations.

    :param certain: also require :func:`flag_certain`.
    """
    equations = list(equations)
    flags = [q.is_solved for q in equations] + (flag_certain(equations) if certain else [])
    return [reduce(both, flags)] if flags else []


def flag_certain(equations: Iterable[Equations]) -> list[Expression]:
    """Return a list of one expression, 1 where the assembly is certain; empty if it always is."""
    flags = [q.size.tape.lift(less(0.0, value)) for q in equations for value in q.certain]
    return [reduce(both, flags)] if flags else []


@dataclass(frozen=True, eq=False)
class Program:
    """Named outputs as expressions of the inputs, the parameters and the solved unknowns.

    ``inputs``: sizes by name in the order of the call, without parameters and unknowns.
    ``parameters``: number of the program's own parameters. ``equations``: solved in this order.
    ``quick``: compile without optimisation, in a tenth of the time; the code takes 1.5 times as
    long.
    """

    inputs: Mapping[str, int]
    parameters: int
    outputs: Mapping[str, Sequence[Expression]]
    equations: Sequence[Equations] = ()
    quick: bool = False
    single: bool = False
    """Whether a sample that one step does not reach is rejected, and not tried in more steps."""

    def __post_init__(self) -> None:
        known = {**self.inputs, PARAMETERS: self.parameters, GEOMETRY: self.geometry_count}
        for q in self.equations:
            known |= q.inputs
        for e in list_dependencies(self.results):
            name, index = e.source or ("", -1)
            if not index < known.get(name, 0):
                raise PkmTwinError(f"the program reads {name}[{index}], which is no input")

    @property
    def geometry_count(self) -> int:
        """Number of geometry values that follow the program's own parameters in the input."""
        return len(self.results[0].tape.reference) if self.results else 0

    @property
    def results(self) -> list[Expression]:
        """All expressions that are computed."""
        rows = [e for row in self.outputs.values() for e in row]
        for q in self.equations:
            rows += [e for name in SOLUTION_PARTS for e in getattr(q, name)]
        return rows + flag_solved(self.equations)

    @cached_property
    def prepared(self) -> list[Expression]:
        """Expressions of parameters alone that samples use: computed once per machine."""
        return find_prepared(self.results)

    @property
    def missed(self) -> Expression:
        """Sum of squared differences between parameters and the constants assumed for them."""
        tape = self.results[0].tape if self.results else Tape()
        total: Any = 0.0
        for e, target in tape.assumed:
            total = total + (e - target) * (e - target)
        return tape.lift(total)
