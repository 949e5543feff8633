# SPDX-License-Identifier: Apache-2.0
"""Numbers of a robot's file that are best for a path: multi-start, sequential quadratic programs.

The starts of a Sobol sequence are computed as one batch; :mod:`~pkm_twin.design.search` goes on
from the best ones.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.design.pose_path import PosePath
from pkm_twin.design.quantities import Constraint, Quantity, quantity_of
from pkm_twin.design.search import KEPT, DesignPoint, Problem, Search, better
from pkm_twin.design.variables import Variables
from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.robot.entries import with_entries
from pkm_twin.robot.robot import Robot

STARTS: Final = 64
LOCAL: Final = 3
"""Starts from which the search goes on, the file's own beside."""
POINTS: Final = 9
"""Of a Pareto front, its two ends too."""


@dataclass(frozen=True)
class Design:
    """The machine that was found, and what it was found among."""

    robot: Robot
    best: DesignPoint
    before: DesignPoint
    """The file's own numbers; quantities are NaN where that machine cannot follow the path."""
    front: tuple[DesignPoint, ...]
    """Of two aims: from the least of the first to the least of the second."""
    minimise: tuple[str, ...]
    constraints: tuple[Constraint, ...]
    machines: int
    """How many were computed."""
    rejected: int
    """Of the starts, those that cannot follow the path."""


def design(
    robot: Robot, vary: Mapping[str, tuple[float, float]], path: PosePath,
    minimise: str | Sequence[str], subject_to: Sequence[str] = (), *, starts: int = STARTS,
    points: int = POINTS, seed: int = 0, progress: Callable[[int], None] = lambda _: None,
) -> Design:  # fmt: skip
    """Numbers of a robot's file that make a quantity on a path least.

    The platform's path stays the same; the joints follow it. Machines that cannot follow it are
    rejected. The search is local from several starts: an optimum that none of them leads to is not
    found.

    :param vary: least and greatest value by path of a number (``geometry.arm_length``). Several
        paths with commas between change by the same amount, with a ``-`` before one the other way;
        the bounds are those of the first.
    :param path: see :meth:`PosePath.of_joints`.
    :param minimise: one of :data:`QUANTITIES`, or two: then the Pareto front is found, and the
        machine in its middle is the one returned.
    :param subject_to: bounds, as ``singularity>=0.1`` or ``mass<=3``.
    :param starts: of the Sobol sequence; the file's own numbers beside.
    :param points: of the front, 3 or more.
    :param progress: called with the number of searches done, of at most :func:`searches`.
    :raises ParameterError: a path, a quantity or a bound that there is not.
    :raises PkmTwinError: no machine that was tried can follow the path, or none keeps the bounds.
    """
    names = [minimise] if isinstance(minimise, str) else list(minimise)
    if len(names) not in (1, 2) or len(set(names)) < len(names):
        raise ParameterError("minimise", names, "one quantity, or two different ones")
    aims = [quantity_of(name, "minimise") for name in names]
    if any(aim.least for aim in aims):
        raise ParameterError("minimise", names, "a quantity that is better when it is less")
    constraints = tuple(Constraint.of(text) for text in subject_to)
    deflects = any(q.name == "deflection" for q in (*aims, *(c.quantity for c in constraints)))
    if deflects and not path.wrench.any():
        raise ParameterError("wrench", None, "a wrench that deflects the platform")
    problem = Problem(robot, Variables.of(robot, vary), path)
    first = _starts(problem, starts, seed)
    done, rejected = 0, 0

    def searched(aim: Quantity, bounds: Sequence[Constraint], tries: Array) -> Array | None:
        """The best machine; None where no try keeps the bounds in the end."""
        nonlocal done, rejected
        search = Search(problem, aim, bounds)
        values, misses, _ = search.judged(tries)
        rejected = max(rejected, int(np.isinf(misses).sum()))
        order = sorted(
            np.flatnonzero(np.isfinite(misses)).tolist(), key=lambda k: _rank(values, misses, k)
        )
        found: tuple[Array, float, float] | None = None
        for k in order[: LOCAL + 1]:
            result = search.descend(tries[k])
            done += 1
            progress(done)
            if found is None or better(*result[1:], *found[1:]):
                found = result
        return None if found is None or found[2] > KEPT else found[0]

    least = searched(aims[0], constraints, first)
    if least is None:
        raise _none_found(problem, constraints, first, rejected)
    front: list[Array] = [least]
    if len(aims) > 1:
        other = searched(aims[1], constraints, np.vstack([first, least]))
        assert other is not None  # noqa: S101  the first end of the front keeps the bounds
        front = _front(problem, aims, constraints, (least, other), points, searched)
    told = [problem.point(y, constraints) for y in front]
    best = told[len(told) // 2 if len(told) > 1 else 0]
    if len(told) > 1:
        best = _middle(told, names)
    before = problem.point(problem.variables.start, constraints)
    return Design(
        with_entries(robot, best.numbers), best, before, tuple(told) if len(aims) > 1 else (),
        tuple(names), constraints, problem.count, rejected,
    )  # fmt: skip


def searches(aims: int, points: int = POINTS) -> int:
    """How many searches :func:`design` makes at most."""
    return (LOCAL + 1) * (1 if aims == 1 else points)


def _rank(aims: Array, misses: Array, k: int) -> tuple[float, float]:
    kept = misses[k] <= KEPT
    return (0.0, float(aims[k])) if kept else (float(misses[k]), 0.0)


def _starts(problem: Problem, count: int, seed: int) -> Array:
    """Sobol's points in the box, and the file's own numbers where they are in it, (k, d)."""
    points = sobol(len(problem.variables), count, seed)
    own = problem.variables.start
    inside = bool(((own >= 0.0) & (own <= 1.0)).all())
    return np.vstack([own, points]) if inside else points


def sobol(dimensions: int, count: int, seed: int) -> Array:
    """The first points of a scrambled Sobol sequence, shape (count, dimensions)."""
    from scipy.stats import qmc  # type: ignore[import-untyped]

    power = max(0, int(np.ceil(np.log2(max(count, 1)))))
    points = qmc.Sobol(dimensions, seed=seed).random_base2(power)
    return np.asarray(points[:count], np.float64)


def _front(
    problem: Problem, aims: Sequence[Quantity], constraints: Sequence[Constraint],
    ends: tuple[Array, Array], points: int,
    searched: Callable[[Quantity, Sequence[Constraint], Array], Array | None],
) -> list[Array]:  # fmt: skip
    """Machines between the ends: the least first aim for bounds of the second."""
    first, second = aims
    rows = problem.pieces(np.array(ends), [second])[0]
    high, low = second.worst(rows)
    front = [ends[0]]
    for share in np.linspace(0.0, 1.0, max(3, points))[1:-1]:
        bound = Constraint(second, float(high + share * (low - high)))
        tries = np.array([front[-1], ends[1]])
        found = searched(first, [*constraints, bound], tries)
        if found is not None:
            front.append(found)
    return [*front, ends[1]]


def _middle(front: Sequence[DesignPoint], names: Sequence[str]) -> DesignPoint:
    """The machine of the front nearest to the least of both aims, over their ranges."""
    table = np.array([[point.quantities[name] for name in names] for point in front])
    span = np.ptp(table, 0)
    near = (table - table.min(0)) / np.where(span > 0.0, span, 1.0)
    return front[int(np.argmin((near**2).sum(1)))]


def _none_found(
    problem: Problem, constraints: Sequence[Constraint], starts: Array, rejected: int
) -> PkmTwinError:
    name = problem.robot.name
    if rejected >= len(starts):
        return PkmTwinError(f"{name}: none of {len(starts)} machines tried can follow the path")
    bounds = ", ".join(map(str, constraints))
    return PkmTwinError(f"{name}: no machine found that follows the path and keeps {bounds}")
