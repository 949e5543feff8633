# SPDX-License-Identifier: Apache-2.0
"""A map: one quantity over the grid of poses, for some load cases, and its worst pose.

Poses count where actuators and passive joints keep their limits, limbs stay apart, and the
singularity index is not below a bound. The worst pose is that of the whole workspace, between the
grid's poses and off its planes too: a search begins at the worst of the grid and of joint states
all over the limits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas.maps.accuracy import POSE_ERROR
from pkm_twin.atlas.maps.drives import ACCELERATION, PAYLOAD
from pkm_twin.atlas.maps.elastic import COMPLIANCE, STRAIN_ENERGY
from pkm_twin.atlas.maps.frequency import FREQUENCY
from pkm_twin.atlas.maps.milling import Process
from pkm_twin.atlas.maps.quantity import Array, Case, Found, Quantity
from pkm_twin.atlas.poses import PoseSweep, pose_axes, texts
from pkm_twin.atlas.sweep import POSITIVE, SHARE, Chunk, Field, Values, Variable, about, number
from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import keeps_limits

QUANTITIES: Final[Mapping[str, Quantity]] = {
    q.name: q for q in (COMPLIANCE, STRAIN_ENERGY, PAYLOAD, ACCELERATION, FREQUENCY, POSE_ERROR)
}
LEAST: Final = 0.05
"""Singularity index below which a pose does not count, by default."""
KEPT: Final = 16
"""Worst poses of a chunk that the search may begin at."""
HALVINGS: Final = 12
"""Of the way to a place that does not count, to find where it still does."""
INSIDE: Final = 1e-9
"""Part of a joint's range that the search stays away from its ends."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MapSweep(PoseSweep):
    """A quantity by its name, and its load cases; ``process``: of the milling that it maps."""

    name: str
    cases: tuple[Case, ...]
    process: Process | None = None

    @property
    def kind(self) -> str:  # type: ignore[override]
        """The quantity's name."""
        return self.name

    @property
    def quantity(self) -> Quantity:
        """What is computed."""
        return QUANTITIES[self.name] if self.process is None else self.process.quantity

    @property
    def elements(self) -> tuple[str, ...]:
        """Names that ``element`` counts."""
        return self.quantity.elements(self.robot)

    @property
    def fields(self) -> Mapping[str, Field]:  # type: ignore[override]
        """Value, direction and element of each case; NaN and -1 where a pose does not count."""
        by_case = (*self.dims, "case")
        what, turn = self.quantity, {"valid_min": -1.0, "valid_max": 1.0}
        least = {"valid_min": -1, "valid_max": len(self.elements) - 1}
        direction = about("direction of the value, base axes", "", turn)
        fields = {
            "value": Field(by_case, about(what.what, "", POSITIVE)),
            "direction": Field((*by_case, "axis"), direction),
            "dominant": Field(by_case, about(f"index of the {what.element}", "", least), "i2"),
        }
        if what.has_shares:
            share = about("part of each element", "", SHARE)
            fields["factor"] = Field((*by_case, "element"), share)
        return fields

    @property
    def coordinates(self) -> dict[str, Variable]:
        """The grid's, the cases with their units, axes and elements."""
        elements = texts("element", self.elements)
        return super().coordinates | worst_coordinates(self) | {"element": elements}

    @property
    def settings(self) -> dict[str, Any]:
        """Also the wrenches of the cases, and the process."""
        wrenches = {case.name: case.wrench for case in self.cases}
        process = {} if self.process is None else {"process": asdict(self.process)}
        return super().settings | {"cases": wrenches, "question": self.quantity.question} | process

    @property
    def attributes(self) -> dict[str, str]:
        """Marked as a map."""
        return super().attributes | {"map": self.name}

    @property
    def poses_a_chunk(self) -> int:
        """Fewer where a pose takes long."""
        return self.quantity.chunk

    def counts(self, q: Array, pose: Array, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which joint positions (k, n) and poses (k, m) count, of those that are known."""
        return counts(self.robot, q, pose, known, self.least, self.least_clearance)

    def evaluate(self, chunk: Chunk) -> Values:
        """The quantity on the chunk, and its worst poses."""
        poses = self.poses(chunk)
        grid = poses.shape[:-1]
        flat = poses.reshape(-1, poses.shape[-1])
        q, known = self.robot.try_inverse(flat)
        inside = self.counts(np.where(known[:, None], q, self.robot.graph.home), flat, known)
        shape = (len(flat), len(self.cases))
        values: Values = {
            "value": np.full(shape, np.nan),
            "direction": np.full((*shape, 3), np.nan),
            "dominant": np.full(shape, -1, np.int16),
        }
        if self.quantity.has_shares:
            values["factor"] = np.full((*shape, len(self.elements)), np.nan)
        starts = np.full((len(self.cases), KEPT, flat.shape[-1]), np.nan)
        for k, case in enumerate(self.cases):
            found = found_of(self.quantity, self.robot, q[inside], case)
            finite = np.isfinite(found.value)
            values["value"][inside, k] = np.where(finite, found.value, np.nan)
            values["direction"][inside, k] = np.where(finite[:, None], found.direction, np.nan)
            values["dominant"][inside, k] = np.where(finite, found.element, -1)
            if found.shares is not None:
                values["factor"][inside, k] = found.shares
            best = np.argsort(-self.score(found.value))[:KEPT]
            starts[k, : len(best)] = flat[inside][best]
        result = {name: array.reshape(*grid, *array.shape[1:]) for name, array in values.items()}
        return result | {"starts": starts, "counts": np.array([inside.sum(), inside.size])}

    def score(self, value: Array) -> Array:
        """How bad values are; minus infinity where there is none."""
        worse = value if self.quantity.largest else -value
        return np.where(np.isfinite(value), worse, -np.inf)

    def summaries(self, partial: Iterable[Values]) -> dict[str, Variable]:
        """The worst pose of each case, and the part of the grid's poses that count."""
        parts = [(p["starts"], p["counts"]) for p in partial]
        counted, every = np.sum([counts for _, counts in parts], axis=0).tolist()
        worst = []
        for k, case in enumerate(self.cases):
            starts = np.concatenate([starts[k] for starts, _ in parts])
            worst.append(worst_of(self, case, starts[np.isfinite(starts[:, 0])]))
        return {
            "valid": number(counted / every, "part of the grid that counts", "", SHARE),
            **worst_variables(self, worst),
        }


def worst_coordinates(sweep: MapSweep) -> dict[str, Variable]:
    """Coordinates that :func:`worst_variables` have, but for the elements."""
    units = [sweep.quantity.unit(sweep.robot, case) for case in sweep.cases]
    return {
        "case": texts("case", [case.name for case in sweep.cases]),
        "case_unit": texts("case", units),
        "axis": texts("axis", "xyz"),
        "coordinate": texts("coordinate", sweep.robot.pose_names),
    }


def worst_variables(sweep: MapSweep, worst: Sequence[Worst]) -> dict[str, Variable]:
    """The worst of each case: value, pose, direction, and index of the element."""
    each = [w.found for w in worst]
    result: dict[str, Variable] = {}

    def stored(name: str, dims: tuple[str, ...], values: Any, what: str, **more: int) -> None:
        result[f"worst_{name}"] = Variable(("case", *dims), np.array(values), about(what, "", more))

    stored("value", (), [f.value[0] for f in each], "worst value of the whole workspace")
    stored("pose", ("coordinate",), [w.pose for w in worst], "pose of the worst value, m and rad")
    stored("direction", ("axis",), [f.direction[0] for f in each], "its direction, base axes")
    most = len(sweep.elements) - 1
    names = f"index of its {sweep.quantity.element}"
    stored("element", (), [f.element[0] for f in each], names, valid_min=0, valid_max=most)
    return result


def counts(
    robot: Robot,
    q: Array,
    pose: Array,
    known: NDArray[np.bool_],
    least: float,
    least_clearance: float,
) -> NDArray[np.bool_]:
    """Which joint positions (k, n) and poses (k, m) count, of those that are known, shape (k,)."""
    inside = keeps_limits(robot, q, pose, least_clearance, known)
    inside[inside] = robot.try_singularity(q[inside])[0] >= least
    return inside


def found_of(quantity: Quantity, robot: Robot, q: Array, case: Case) -> Found:
    """The quantity at joint positions (k, n); NaN in single poses that it has no value in."""
    wrench = None if case.wrench is None else np.array(case.wrench)
    size = len(quantity.elements(robot))
    if not len(q):
        shares = np.empty((0, size)) if quantity.has_shares else None
        return Found(np.empty(0), np.empty((0, 3)), np.empty(0, np.int64), shares)
    try:
        return quantity.evaluate(robot, q, wrench)
    except ParameterError:
        raise
    except PkmTwinError:
        if len(q) == 1:
            nan = np.full(1, np.nan)
            shares = np.full((1, size), np.nan) if quantity.has_shares else None
            return Found(nan, np.full((1, 3), np.nan), np.full(1, -1), shares)
    one, other = (found_of(quantity, robot, part, case) for part in np.array_split(q, 2))
    shares = None
    if one.shares is not None and other.shares is not None:
        shares = np.concatenate([one.shares, other.shares])
    return Found(
        np.concatenate([one.value, other.value]),
        np.concatenate([one.direction, other.direction]),
        np.concatenate([one.element, other.element]),
        shares,
    )


@dataclass(frozen=True, eq=False)
class Worst:
    """A worst pose (m,), its joint positions (n,), and what was found there."""

    pose: Array
    q: Array
    found: Found


def worst_of(sweep: MapSweep, case: Case, starts: Array, quantity: Quantity | None = None) -> Worst:
    """The worst pose of the workspace.

    :param starts: poses that count, shape (k, m).
    :param quantity: the sweep's, with another size of the search.
    :raises ParameterError: no pose counts.
    """
    robot, quantity = sweep.robot, quantity or sweep.quantity
    limits = robot.limits.position
    by_joints = limits is not None and bool(np.isfinite(limits).all())
    rng = np.random.default_rng(0)
    if limits is not None and by_joints:
        low, high = limits.T
        low, high = low + INSIDE * (high - low), high - INSIDE * (high - low)
        first = robot.inverse(starts) if len(starts) else np.empty((0, len(low)))
    else:
        low, high = np.array([[ticks[0], ticks[-1]] for ticks in sweep.axes]).T
        first = starts

    def state(x: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        if by_joints:
            pose, known = robot.try_forward(x)
            return x, np.where(known[:, None], pose, robot.home()), known
        q, known = robot.try_inverse(x)
        return np.where(known[:, None], q, robot.graph.home), x, known

    def score(x: Array, what: Quantity = quantity) -> Array:
        q, pose, known = state(x)
        inside = sweep.counts(q, pose, known)
        result = np.full(len(x), -np.inf)
        load = case if what is quantity else what.default
        value = found_of(what, robot, q[inside], load).value
        result[inside] = np.where(np.isfinite(value), value if what.largest else -value, -np.inf)
        return result

    def drawn(count: int) -> Array:
        # Extremes are often where joints are at their limits.
        ends = rng.integers(0, 3, (count // 2, len(low))) / 2.0
        inner = rng.random((count - len(ends), len(low)))
        return np.asarray(low + np.concatenate([ends, inner]) * (high - low))

    tried = np.concatenate([first, drawn(quantity.samples)])
    if quantity.screen is not None:
        more = drawn(quantity.screen.samples)
        order = np.argsort(-score(more, quantity.screen), kind="stable")
        tried = np.concatenate([tried, more[order[: quantity.samples]]])

    def inside(x: Array) -> NDArray[np.bool_]:
        return sweep.counts(*state(x))

    kept = inside if quantity.screen is not None else None
    x, best = evolved(score, np.clip(tried, low, high), low, high, quantity, rng, kept)
    if not np.isfinite(best):
        raise ParameterError("robot", robot.name, "a workspace in which some pose counts")
    q, pose, _ = state(x[None])
    return Worst(pose[0], q[0], found_of(quantity, robot, q, case))


def evolved(
    score: Callable[[Array], Array],
    tried: Array,
    low: Array,
    high: Array,
    quantity: Quantity,
    rng: np.random.Generator,
    inside: Callable[[Array], NDArray[np.bool_]] | None = None,
) -> tuple[Array, float]:
    """The place (n,) of the highest score in a box, and it, from the best of the places tried.

    Each place of a population climbs for itself, so that many hills are climbed: by steps along one
    coordinate or all, whose size follows their success, and by differences of two others
    (differential evolution, Storn and Price 1997); some go towards the best.

    :param inside: which places (k, n) count; a step to where none does ends at the border between.
    """
    scores = np.concatenate([score(part) for part in np.array_split(tried, 1 + len(tried) // 4096)])
    order = np.argsort(-scores, kind="stable")[: quantity.population]
    x, f = tried[order], scores[order]
    count, n = x.shape
    step = np.full(count, 0.1)
    for _ in range(quantity.rounds):
        a, b = (x[rng.integers(0, count, count)] for _ in range(2))
        alone = np.equal.outer(rng.integers(0, n, count), np.arange(n))
        along = alone | (rng.random((count, 1)) < 0.5)
        near = along * rng.normal(size=(count, n)) * step[:, None] * (high - low)
        pull = np.where(rng.random((count, 1)) < 0.1, x[f.argmax()] - x, 0.0)
        crossed = rng.random((count, n)) < 0.8
        far = rng.uniform(0.4, 0.9, (count, 1)) * (a - b + pull) * crossed
        local = np.asarray(rng.random(count) < 0.7)
        moved = np.clip(x + np.where(local[:, None], near, far), low, high)
        if inside is not None:
            moved = _bordered(x, moved, inside)
        reached = score(moved)
        better = reached > f
        step = np.clip(np.where(local, step * np.where(better, 1.5, 0.9), step), 1e-6, 0.3)
        x, f = np.where(better[:, None], moved, x), np.where(better, reached, f)
    return x[f.argmax()], float(f.max())


def _bordered(x: Array, moved: Array, inside: Callable[[Array], NDArray[np.bool_]]) -> Array:
    """Places moved (k, n), those outside drawn back towards x as far as they have to, by halving.

    Extremes are often where a pose just counts: at a limit or the least singularity index.
    """
    share = inside(moved).astype(float)
    step = np.where(share < 1.0, 0.5, 0.0)
    for _ in range(HALVINGS):
        good = inside(x + (share + step)[:, None] * (moved - x))
        share, step = share + np.where(good, step, 0.0), 0.5 * step
    return np.asarray(x + share[:, None] * (moved - x))


def map_sweep(
    robot: Robot,
    name: str | Process,
    points: int | None = None,
    *,
    cases: Sequence[Case] = (),
    least_singularity: float = LEAST,
    least_clearance: float = 0.0,
) -> MapSweep:
    """The map of a quantity over a robot's workspace.

    :param name: of :data:`QUANTITIES`, or a milling process, for the depth of cut without chatter.
    :param points: poses of the grid, about.
    :param cases: load cases; default the quantity's own.
    :raises ParameterError: the robot's file lacks what the quantity needs; others as
        :func:`~pkm_twin.atlas.poses.pose_axes`.
    """
    quantity = name.quantity if isinstance(name, Process) else QUANTITIES[name]
    # First, as it says what the file lacks.
    quantity.elements(robot)
    check(robot, quantity, cases)
    total = quantity.points if points is None else points
    if total < 50:
        raise ParameterError("points", total, "50 or more")
    axes = pose_axes(robot, total, least_singularity, least_clearance)
    return MapSweep(
        robot, axes, robot.home(), least_singularity, least_clearance, name=quantity.name,
        cases=tuple(cases) or (quantity.default,),
        process=name if isinstance(name, Process) else None,
    )  # fmt: skip


def check(robot: Robot, quantity: Quantity, cases: Sequence[Case]) -> None:
    """Compute the quantity once, at home, for what it says the robot's file lacks.

    :raises ParameterError: by the section.
    """
    for case in cases or (quantity.default,):
        found_of(quantity, robot, robot.graph.home[None], case)
