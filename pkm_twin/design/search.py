# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Optimise numbers of a robot's file for a path: a local search from several starts.

The starts of a Sobol sequence are computed as one batch; the search continues from the best ones.
Scipy's SLSQP (Kraft 1988) minimises the largest component of a quantity with exact derivatives, on
the components near the largest; components that exceed it are added, and SLSQP runs again (an
exchange method, Hettich and Kortanek 1993). A machine that cannot follow the path ends a run; the
next run starts in a smaller box around the best machine so far, so that the search stays where
machines can follow the path.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array, Indices
from pkm_twin.design.pose_path import PathMotion, PosePath
from pkm_twin.design.quantities import QUANTITIES, Constraint, Quantity, find_quantity
from pkm_twin.design.variables import Variables
from pkm_twin.design.variants import Variants
from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.robot.robot import Robot

MISS_TOLERANCE: Final = 1e-6
"""Largest excess of a bound, relative to it, at which the bound counts as kept."""
GAIN_TOLERANCE: Final = 1e-7
"""Relative gain below which the search ends."""
DIFFERENCE_STEP: Final = 1e-4
"""Step of central differences, as a fraction of a variable's range."""


@dataclass(frozen=True)
class DesignPoint:
    """Describe one machine: variables, quantities, and its largest excess of a bound."""

    variables: Mapping[str, float]
    numbers: Mapping[str, float]
    """Values by path of the file."""
    quantities: Mapping[str, float]
    miss: float

    @property
    def feasible(self) -> bool:
        """True if the machine follows the path and keeps all bounds."""
        return self.miss <= MISS_TOLERANCE


class _CannotFollowError(Exception):
    """Ends a search step at a machine that cannot follow the path."""


class Problem:
    """Evaluate machines of a box of variables (each 0 to 1) on a path."""

    def __init__(self, robot: Robot, variables: Variables, path: PosePath) -> None:
        self.robot, self.variables, self.path = robot, variables, path
        corners = variables.values(np.array([np.zeros(len(variables)), np.ones(len(variables))]))
        self._many = Variants(robot, dict(zip(variables.paths, corners.T, strict=True)))
        self._checked = self._many.whole_box_fits
        self.count = 0

    def machines(self, y: Array) -> Variants:
        """Return the machines of points (k, d)."""
        self.count += len(y)
        return self._many.with_values(self.variables.values(y), checked=self._checked)

    def component_values(self, y: Array, quantities: Sequence[Quantity]) -> list[Array]:
        """Return the components of each quantity, (k, components), for points (k, d), in batches.

        Machines that cannot follow the path have NaN.
        """
        # Number of machines whose samples are computed together.
        size = max(1, 200_000 // len(self.path.time))
        parts = []
        for k in range(0, len(y), size):
            followed = PathMotion(self.machines(y[k : k + size]), self.path)
            lost = np.asarray(~np.isfinite(followed.q).all((1, 2)))
            found = [quantity.component_values(followed) for quantity in quantities]
            parts.append([np.where(lost[:, None], np.nan, rows) for rows in found])
        return [np.concatenate(rows) for rows in zip(*parts, strict=True)]

    def point(self, y: Array, constraints: Sequence[Constraint]) -> DesignPoint:
        """Describe a machine by all quantities for which its file has data."""
        followed = PathMotion(self.machines(y[None]), self.path)
        found: dict[str, float] = {}
        for name, quantity in QUANTITIES.items():
            wanted = any(c.quantity is quantity for c in constraints)
            if name == "deflection" and not (wanted or self.path.wrench.any()):
                continue
            try:
                found[name] = float(quantity.worst(quantity.component_values(followed))[0])
            except ParameterError:
                if wanted:
                    raise
        misses = [c.excess(np.array(found[c.quantity.name])) for c in constraints]
        values = self.variables.values(y[None])[0]
        follows = bool(np.isfinite(followed.q).all())
        return DesignPoint(
            dict(zip(self.variables.names, self.variables.values_by_name(y), strict=True)),
            dict(zip(self.variables.paths, values.tolist(), strict=True)),
            found,
            max([0.0, *map(float, misses)]) if follows else np.inf,
        )


class Search:
    """Minimise one quantity under constraints."""

    def __init__(self, problem: Problem, aim: Quantity, constraints: Sequence[Constraint]) -> None:
        self.problem, self.aim, self.constraints = problem, aim, tuple(constraints)
        self._all = [aim, *(c.quantity for c in constraints)]

    def evaluate(self, y: Array) -> tuple[Array, Array, list[Array]]:
        """Return aims, largest excesses and components of points (k, d); infinite for machines off the path."""
        components = self.problem.component_values(y, self._all)
        misses = np.zeros(len(y))
        for constraint, found in zip(self.constraints, components[1:], strict=True):
            misses = np.maximum(misses, constraint.excess(constraint.quantity.worst(found)))
        aims = self.aim.worst(components[0])
        lost = ~(np.isfinite(aims) & np.isfinite(misses))
        return np.where(lost, np.inf, aims), np.where(lost, np.inf, misses), components

    def descend(self, y: Array) -> tuple[Array, float, float]:
        """Search from a machine that follows the path; return the best machine, its aim and its excess."""
        aims, misses, components = self.evaluate(y[None])
        best, aim, miss = y, float(aims[0]), float(misses[0])
        scale = max(abs(aim), 1e-300)
        chosen = [np.zeros(0, np.intp) for _ in self._all]
        radius, shrinks = 1.0, 0
        for _ in range(20):
            chosen = [
                np.union1d(old, self._components_near_worst(k, found[0]))
                for k, (old, found) in enumerate(zip(chosen, components, strict=True))
            ]
            run = _BoxSearch(self, chosen, scale, best, aim, radius)
            found, outside = run.solve()
            aims, misses, new = self.evaluate(found[None])
            if is_better(float(aims[0]), float(misses[0]), aim, miss):
                gain = abs(aim - float(aims[0])) / scale + max(0.0, miss - float(misses[0]))
                bound = radius < 1.0 and np.abs(found - best).max() > 0.9 * radius
                best, aim, miss, components = found, float(aims[0]), float(misses[0]), new
                if bound:
                    radius = min(1.0, 2.0 * radius)
                elif gain < GAIN_TOLERANCE and not outside:
                    break
                continue
            passed = np.isfinite(aims[0]) and np.isfinite(misses[0])
            fresh = passed and any(
                len(np.setdiff1d(self._components_near_worst(k, p[0]), old))
                for k, (p, old) in enumerate(zip(new, chosen, strict=True))
            )
            step = float(np.abs(found - best).max())
            if step < 1e-9 and not outside:
                break
            if fresh:
                # Other components became the largest: include them.
                chosen = [
                    np.union1d(old, self._components_near_worst(k, p[0]))
                    for k, (old, p) in enumerate(zip(chosen, new, strict=True))
                ]
            radius = 0.5 * max(min(radius, step if step > 0.0 else radius), 1e-9)
            shrinks += 1
            if shrinks > 12:
                break
        return best, aim, miss

    def _components_near_worst(self, k: int, components: Array) -> Indices:
        """Return components that may become the largest: peaks in time near the worst."""
        quantity = self._all[k]
        if not quantity.sampled:
            return np.arange(len(components))
        count = len(self.problem.path.time)
        table = (-components if quantity.least else components).reshape(count, -1)
        padded = np.pad(table, ((1, 1), (0, 0)), constant_values=-np.inf)
        peaks = (table >= padded[:-2]) & (table >= padded[2:])
        worst = float(table.max())
        # Take components above seven tenths of the largest.
        reach = worst - 0.3 * max(abs(worst), 0.3 if quantity.least else 0.0)
        flat = table.ravel()
        order = np.flatnonzero(peaks.ravel() & (flat >= reach))
        return order[np.argsort(-flat[order], kind="stable")][:40]


def is_better(aim: float, miss: float, old_aim: float, old_miss: float) -> bool:
    """Return whether a machine is better: smaller excess, or smaller aim if both keep all bounds."""
    if miss > MISS_TOLERANCE or old_miss > MISS_TOLERANCE:
        return miss < old_miss or (miss <= MISS_TOLERANCE and old_miss > MISS_TOLERANCE)
    return aim < old_aim


class _BoxSearch:
    """Minimise a bound s of the aim by SLSQP, for chosen components and machines y in a box around a machine."""

    def __init__(
        self,
        search: Search,
        chosen: Sequence[Indices],
        scale: float,
        centre: Array,
        aim: float,
        radius: float,
    ) -> None:
        self.search, self.chosen, self.scale = search, chosen, scale
        self.centre, self.aim, self.radius = centre, aim, radius
        self._known: dict[bytes, tuple[Array, Array]] = {}
        self._best: tuple[float, float, Array] = (np.inf, np.inf, centre)

    def solve(self) -> tuple[Array, bool]:
        """Return the best machine, and whether the run ended at one that cannot follow the path."""
        from scipy.optimize import minimize  # type: ignore[import-untyped]

        low = np.maximum(0.0, self.centre - self.radius)
        high = np.minimum(1.0, self.centre + self.radius)
        d = len(self.centre)
        unit = np.append(np.zeros(d), 1.0)
        try:
            result = minimize(
                lambda z: z[-1],
                np.append(self.centre, self.aim / self.scale),
                method="SLSQP",
                jac=lambda z: unit,
                bounds=[*zip(low, high, strict=True), (None, None)],
                constraints={
                    "type": "ineq",
                    "fun": lambda z: self._margins(z)[0],
                    "jac": lambda z: self._margins(z)[1],
                },
                options={"maxiter": 60, "ftol": 0.1 * GAIN_TOLERANCE},
            )
        except _CannotFollowError:
            return self._best[2], True
        y = np.clip(result.x[:d], low, high)
        self._margins(np.append(y, result.x[-1]))
        return self._best[2], False

    def _margins(self, z: Array) -> tuple[Array, Array]:
        """Return the constraints of SLSQP and their derivatives: bound s minus aim, and minus excesses; z = (y, s)."""
        y, s = np.clip(z[:-1], 0.0, 1.0), z[-1]
        key = y.tobytes()
        if key not in self._known:
            self._known[key] = self._evaluate(y)
        values, slopes = self._known[key]
        first = len(self.chosen[0])
        margins, table = -values, np.hstack([-slopes, np.zeros((len(values), 1))])
        margins[:first] += s
        table[:first, -1] = 1.0
        return margins, table

    def _evaluate(self, y: Array) -> tuple[Array, Array]:
        search, problem = self.search, self.search.problem
        values, slopes = [], []
        many = problem.machines(y[None])
        for k, (quantity, chosen) in enumerate(zip(search._all, self.chosen, strict=True)):
            found, by = _evaluate_components(problem, quantity, chosen, many, y)
            if not (np.isfinite(found).all() and np.isfinite(by).all()):
                raise _CannotFollowError
            if k == 0:
                values.append(found / self.scale)
                slopes.append(by / self.scale)
            else:
                constraint = search.constraints[k - 1]
                side = (-1.0 if quantity.least else 1.0) / constraint.scale
                values.append(constraint.excess(found))
                slopes.append(side * by)
        aim = float(values[0].max())
        miss = max([0.0, *(float(row.max()) for row in values[1:])])
        if is_better(aim, miss, self._best[0], self._best[1]):
            self._best = aim, miss, y
        return np.concatenate(values), np.concatenate(slopes)


def _evaluate_components(
    problem: Problem, quantity: Quantity, chosen: Indices, one: Variants, y: Array
) -> tuple[Array, Array]:
    """Return chosen components of one machine at y, and their derivatives, shape (components, d)."""
    # Components per sample: peak efforts have one per joint.
    width = (problem.robot.joints_count if quantity.name == "peak-effort" else 1) if quantity.sampled else 0
    path = problem.path.at(chosen // width) if width else problem.path
    places = chosen % width if width else chosen

    def evaluate(many: Variants) -> tuple[PathMotion, Array]:
        followed = PathMotion(many, path)
        if width:
            return followed, quantity.evaluate(followed)[:, np.arange(len(chosen)), places]
        return followed, quantity.component_values(followed)[:, chosen]

    followed, (found,) = evaluate(one)
    if not np.isfinite(found).all():
        raise _CannotFollowError
    if not problem.robot.redundant:
        return found, quantity.differentiate(followed, places) @ problem.variables.slopes
    # Redundant drives have no exact derivatives: take differences.
    steps = DIFFERENCE_STEP * np.eye(len(y))
    ahead, behind = (evaluate(problem.machines(y + side * steps))[1] for side in (1.0, -1.0))
    return found, (ahead - behind).T / (2.0 * DIFFERENCE_STEP)


DEFAULT_STARTS: Final = 64
"""Default number of starts of a Sobol sequence."""
LOCAL_SEARCHES: Final = 3
"""Number of starts from which the search continues, in addition to the file's own."""
DEFAULT_FRONT_POINTS: Final = 9
"""Default number of points of a Pareto front, including its ends."""


@dataclass(frozen=True)
class Design:
    """Hold the best machine of a search, the machine before it, and the Pareto front, if any."""

    robot: Robot
    best: DesignPoint
    before: DesignPoint
    """Machine of the file; its quantities are NaN if it cannot follow the path."""
    front: tuple[DesignPoint, ...]
    """For two aims: from the smallest first aim to the smallest second aim."""
    minimise: tuple[str, ...]
    constraints: tuple[Constraint, ...]
    machines: int
    """Number of machines computed."""
    rejected: int
    """Number of starts that cannot follow the path."""

    def peak_efforts(self, path: PosePath) -> Array:
        """Return the largest magnitude of each joint's effort on the path, shape (n,), N m or N."""
        return np.asarray(np.abs(PathMotion(Variants(self.robot, {}), path).efforts[0]).max(0), np.float64)

    def least_singularity(self, path: PosePath) -> float:
        """Return the smallest singularity index on the path."""
        return float(PathMotion(Variants(self.robot, {}), path).singularity.min())


def design(
    robot: Robot,
    vary: Mapping[str, tuple[float, float]],
    path: PosePath,
    minimise: str | Sequence[str],
    subject_to: Sequence[str] = (),
    *,
    starts: int = DEFAULT_STARTS,
    points: int = DEFAULT_FRONT_POINTS,
    seed: int = 0,
    progress: Callable[[int], None] = lambda _: None,
) -> Design:
    """Optimise numbers of a robot's file, for the least value of a quantity on a path.

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
    :param starts: of the Sobol sequence, in addition to the file's own numbers.
    :param points: of the front, 3 or more.
    :param progress: called with the number of searches done, of at most :func:`searches`.
    :raises ParameterError: an unknown path or quantity, or an invalid bound.
    :raises PkmTwinError: no machine that was tried can follow the path, or none keeps the bounds.
    """
    names = [minimise] if isinstance(minimise, str) else list(minimise)
    if len(names) not in (1, 2) or len(set(names)) < len(names):
        raise ParameterError("minimise", names, "one quantity, or two different ones")
    aims = [find_quantity(name, "minimise") for name in names]
    if any(aim.least for aim in aims):
        raise ParameterError("minimise", names, "a quantity that is better when it is less")
    constraints = tuple(Constraint.parse(text) for text in subject_to)
    deflects = any(q.name == "deflection" for q in (*aims, *(c.quantity for c in constraints)))
    if deflects and not path.wrench.any():
        raise ParameterError("wrench", None, "a wrench that deflects the platform")
    problem = Problem(robot, Variables.of(robot, vary), path)
    own = problem.variables.start
    first = sobol(len(own), starts, seed)
    if ((own >= 0.0) & (own <= 1.0)).all():
        first = np.vstack([own, first])
    done, rejected = 0, 0

    def search_from(aim: Quantity, bounds: Sequence[Constraint], tries: Array) -> Array | None:
        """Return the best machine; None if none keeps the bounds."""
        nonlocal done, rejected
        search = Search(problem, aim, bounds)
        values, misses, _ = search.evaluate(tries)
        rejected = max(rejected, int(np.isinf(misses).sum()))
        # Sort machines that keep the bounds by their aims, then the others by their excess.
        ranks = np.where(misses <= MISS_TOLERANCE, -np.inf, misses), values
        order = [k for k in np.lexsort(ranks[::-1]).tolist() if np.isfinite(misses[k])]
        found: tuple[Array, float, float] | None = None
        for k in order[: LOCAL_SEARCHES + 1]:
            result = search.descend(tries[k])
            done += 1
            progress(done)
            if found is None or is_better(*result[1:], *found[1:]):
                found = result
        return None if found is None or found[2] > MISS_TOLERANCE else found[0]

    least = search_from(aims[0], constraints, first)
    if least is None:
        if rejected >= len(first):
            raise PkmTwinError(f"{robot.name}: none of {len(first)} machines tried can follow the path")
        bounds_text = ", ".join(map(str, constraints))
        raise PkmTwinError(f"{robot.name}: no machine found that follows the path and keeps {bounds_text}")
    front: list[Array] = [least]
    if len(aims) > 1:
        other = search_from(aims[1], constraints, np.vstack([first, least]))
        assert other is not None  # noqa: S101  the first end of the front keeps the bounds
        front = _trace_front(problem, aims, constraints, (least, other), points, search_from)
    points_found = [problem.point(y, constraints) for y in front]
    # Choose the machine that is nearest to both smallest aims, relative to their ranges.
    table = np.array([[point.quantities[name] for name in names] for point in points_found])
    span = np.ptp(table, 0)
    distances = (table - table.min(0)) / np.where(span > 0.0, span, 1.0)
    best = points_found[int(np.argmin((distances**2).sum(1)))]
    before = problem.point(problem.variables.start, constraints)
    return Design(
        robot.with_file_values(best.numbers),
        best,
        before,
        tuple(points_found) if len(aims) > 1 else (),
        tuple(names),
        constraints,
        problem.count,
        rejected,
    )


def searches(aims: int, points: int = DEFAULT_FRONT_POINTS) -> int:
    """Return the largest number of searches that :func:`design` runs."""
    return (LOCAL_SEARCHES + 1) * (1 if aims == 1 else points)


def sobol(dimensions: int, count: int, seed: int) -> Array:
    """Return the first points of a scrambled Sobol sequence, shape (count, dimensions)."""
    from scipy.stats import qmc  # type: ignore[import-untyped]

    power = max(0, int(np.ceil(np.log2(max(count, 1)))))
    points = qmc.Sobol(dimensions, seed=seed).random_base2(power)
    return np.asarray(points[:count], np.float64)


def _trace_front(
    problem: Problem,
    aims: Sequence[Quantity],
    constraints: Sequence[Constraint],
    ends: tuple[Array, Array],
    points: int,
    search_from: Callable[[Quantity, Sequence[Constraint], Array], Array | None],
) -> list[Array]:
    """Trace a Pareto front: minimise the first aim for evenly spaced bounds of the second."""
    first, second = aims
    rows = problem.component_values(np.array(ends), [second])[0]
    high, low = second.worst(rows)
    front = [ends[0]]
    for share in np.linspace(0.0, 1.0, max(3, points))[1:-1]:
        bound = Constraint(second, float(high + share * (low - high)))
        tries = np.array([front[-1], ends[1]])
        found = search_from(first, [*constraints, bound], tries)
        if found is not None:
            front.append(found)
    return [*front, ends[1]]
