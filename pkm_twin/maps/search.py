# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Find the box of all reachable poses, and the worst pose of a quantity in it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.maps.kind import Case, Kind, Space, Worst, evaluate_kind
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import describe_causes, describe_singularity_bound, reachable, try_forward

GRID_SIDE: Final = 33
"""Poses along each coordinate of the grid that bounds a workspace, or a plane's visible part."""
MAX_GRID_DIMENSIONS: Final = 3
"""Largest number of pose coordinates of a full grid."""
EDGE_WALKERS: Final = 1024
"""Largest number of poses, those of the smallest singularity index, that walk to the border."""
EDGE_STEPS: Final = 24
"""Steps of a walk: three decades of step size, each step 0.74 times the one before."""
EDGE_STARTS: Final = 128
"""Largest number of poses on the border from which the search for the worst pose starts."""


def find_worst(space: Space, case: Case, starts: Array, tell: Callable[[float], object] = abs) -> Worst:
    """Find the worst pose of the workspace.

    Search joint positions between finite limits, otherwise poses in the map's box.

    :param starts: poses that count, shape (k, m). ``tell``: called with the completed fraction.
    :raises ParameterError: no pose counts; the error names what removes most of them.
    """
    robot, kind = space.robot, space.kind
    low, high = space.box.T
    has_joint_limits = space.has_joint_limits
    rng = np.random.default_rng(0)
    first = robot.inverse(starts) if has_joint_limits and len(starts) else starts
    if has_joint_limits:
        # Keep away from the ends, where rounding decides what counts.
        low, high = low + 1e-9 * (high - low), high - 1e-9 * (high - low)

    def inside(x: Array) -> NDArray[np.bool_]:
        return space.is_in_workspace(*space.evaluate_point(x), case)

    def score(x: Array, what: Kind = kind) -> Array:
        q = space.evaluate_point(x)[0]
        counted = inside(x)
        one = case if what is kind else what.cases(robot)[0]
        result = np.full(len(x), -np.inf)
        (found,) = evaluate_kind(what, robot, q[counted], [one])
        result[counted] = score_values(found.value, one.largest)
        return result

    def drawn(count: int) -> Array:
        # Extremes are often at joint limits.
        ends = rng.integers(0, 3, (count // 2, len(low))) / 2.0
        inner = rng.random((count - len(ends), len(low)))
        return np.asarray(low + np.concatenate([ends, inner]) * (high - low))

    tried = np.concatenate([first.reshape(-1, len(low)), drawn(kind.samples)])
    if kind.screen is not None:
        more = drawn(kind.screen.samples)
        order = np.argsort(-score(more, kind.screen), kind="stable")
        tried = np.concatenate([tried, more[order[: kind.samples]]])
    kept = inside if kind.screen is not None else None
    x, best = evolve(score, np.clip(tried, low, high), low, high, kind, rng, kept, tell)
    if len(edge := _edge_states(space, tried, inside, low, high, rng)):
        more, other = evolve(score, edge, low, high, kind, rng, inside)
        x, best = (more, other) if other > best else (x, best)
    if not np.isfinite(best):
        without = replace(space, least=0.0).is_in_workspace(*space.evaluate_point(tried), case)
        if without.any() and not inside(tried).any():
            best = float(robot.try_singularity(space.evaluate_point(tried)[0][without])[0].max())
            raise ParameterError(
                "singularity",
                space.least,
                f"{describe_singularity_bound(best, '')} or less: "
                f"no pose has a singularity index of {space.least:g} or more (best: {best:.3g})",
            )
        why = (
            ""
            if inside(tried).any()
            else describe_causes(robot, *space.evaluate_point(tried), space.least, space.least_clearance)
        )
        bound = "a workspace in which some pose counts"
        raise ParameterError("robot", robot.name, f"{bound}: {why}" if why else bound)
    q, pose, _ = space.evaluate_point(x[None])
    found = evaluate_kind(kind, robot, q, [case])[0]
    # Poses near the worst show whether the bound on the singularity index excludes worse ones.
    near = rng.normal(size=(64, len(x))) * 10.0 ** rng.uniform(-4.0, -2.0, (64, 1))
    state = space.evaluate_point(np.clip(x + near * (high - low), low, high))
    below = replace(space, least=0.0).is_in_workspace(*state, case) & ~space.is_in_workspace(*state, case)
    (beyond,) = evaluate_kind(kind, robot, state[0][below], [case])
    worse = score_values(beyond.value, case.largest) > score_values(found.value, case.largest)
    index = float(robot.try_singularity(q)[0][0])
    return Worst(pose[0], q[0], found, index, bool(worse.any()))


def _edge_states(
    space: Space,
    tried: Array,
    inside: Callable[[Array], NDArray[np.bool_]],
    low: Array,
    high: Array,
    rng: np.random.Generator,
) -> Array:
    """Return points (k, n) all along the border given by the least singularity index.

    Quantities that grow towards a singularity are worst there, and a workspace may end in several
    separate narrow parts there. Places near the border walk to it; of those that arrive the ones
    that are farthest from each other are taken.

    :param tried: places (k, n), some of which count.
    """

    def index_at(x: Array) -> Array:
        return space.robot.try_singularity(space.evaluate_point(x)[0])[0]

    x = tried[inside(tried)]
    index = index_at(x)
    if not len(x) or space.least <= 0.0 or not (index_at(tried) < space.least).any():
        return x[:0]
    order = np.argsort(index, kind="stable")[:EDGE_WALKERS]
    x, index = x[order], index[order]
    for size in np.geomspace(0.1, 1e-4, EDGE_STEPS):
        moved = np.clip(x + size * (high - low) * rng.normal(size=x.shape), low, high)
        moved = _pull_inside(x, moved, inside)
        nearer = index_at(moved) < index
        x = np.where(nearer[:, None], moved, x)
        index = np.where(nearer, index_at(moved), index)
    # Walkers that did not come near the border are dropped.
    x = x[index < 2.0 * space.least]
    chosen: list[int] = [0] if len(x) else []
    apart = np.full(len(x), np.inf)
    while chosen and len(chosen) < min(EDGE_STARTS, len(x)):
        apart = np.minimum(apart, np.linalg.norm((x - x[chosen[-1]]) / (high - low), axis=1))
        chosen.append(int(apart.argmax()))
    return x[chosen]


def score_values(value: Array, largest: bool) -> Array:
    """Return values whose largest is the worst; minus infinity where there is no value."""
    return np.where(np.isfinite(value), value if largest else -value, -np.inf)


def evolve(
    score: Callable[[Array], Array],
    tried: Array,
    low: Array,
    high: Array,
    kind: Kind,
    rng: np.random.Generator,
    inside: Callable[[Array], NDArray[np.bool_]] | None = None,
    tell: Callable[[float], object] = abs,
) -> tuple[Array, float]:
    """Maximise a score in a box, from the best of the points tried; return point (n,) and score.

    Each point of a population climbs on its own, so that several maxima are followed: by steps
    along one or all coordinates, whose size adapts to their success, and by differences of two
    other points (differential evolution, Storn and Price 1997), some of them towards the best.

    :param inside: which points (k, n) count; a step to one that does not count ends at the border.
    """
    scores = np.concatenate([score(part) for part in np.array_split(tried, 1 + len(tried) // 4096)])
    order = np.argsort(-scores, kind="stable")[: kind.population]
    x, f = tried[order], scores[order]
    count, n = x.shape
    step = np.full(count, 0.1)
    for done in range(kind.rounds):
        tell(done / kind.rounds)
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
            moved = _pull_inside(x, moved, inside)
        reached = score(moved)
        better = reached > f
        step = np.clip(np.where(local, step * np.where(better, 1.5, 0.9), step), 1e-6, 0.3)
        x, f = np.where(better[:, None], moved, x), np.where(better, reached, f)
    return x[f.argmax()], float(f.max())


def _pull_inside(x: Array, moved: Array, inside: Callable[[Array], NDArray[np.bool_]]) -> Array:
    """Pull points that do not count back towards x, by bisection, until they count; (k, n).

    Extremes are often where a pose just counts: at a limit or the least singularity index.
    """
    share = inside(moved).astype(float)
    step = np.where(share < 1.0, 0.5, 0.0)
    # 12 halvings find the border to 1/4096 of the step.
    for _ in range(12):
        good = inside(x + (share + step)[:, None] * (moved - x))
        share, step = share + np.where(good, step, 0.0), 0.5 * step
    return np.asarray(x + share[:, None] * (moved - x))


def find_workspace_box(robot: Robot) -> Array:
    """Return bounds of all reachable poses, interference ignored, slightly wider; (m, 2).

    From poses of joint states all over the limits and, for few coordinates, from a grid of poses.
    Lateral coordinates of a cylinder have symmetric bounds about the axis.

    :raises ParameterError: nothing bounds the workspace, or it is empty.
    """
    bounds = np.asarray(robot.search_box(), np.float64)
    # Poses with interference are included: maps show them.
    # Sample joint states between the limits; keep the reachable poses, (k, m).
    limits = robot.limits.position
    count = len(robot.joint_names)
    if limits is None or not np.isfinite(limits).all():
        found = np.empty((0, len(robot.pose_names)))
    else:
        # Imported here, because loading it in every process takes longer than many sweeps.
        from scipy.stats import qmc  # type: ignore[import-untyped]

        # Extremes are mostly where joints are at a limit or in the middle of their range.
        corners = np.stack(np.meshgrid(*[[0.0, 0.5, 1.0]] * count, indexing="ij"), -1)
        inner = qmc.Halton(count, scramble=False).random(2**14)
        share = np.concatenate([corners.reshape(-1, count), inner])
        q = robot.try_project_redundant(limits[:, 0] + share * np.ptp(limits, axis=1))
        poses, good = try_forward(robot, q)
        good[good] = reachable(robot, poses[good], -math.inf)
        poses, q = poses[good], q[good]
        if len(robot.pose_names) > MAX_GRID_DIMENSIONS and len(q):
            # With many joints, so few states are sparse: climb to the ends.
            ends = [
                _climb(robot, limits, q[np.argsort(-sign * poses[:, k])[:32]], k, sign)
                for k in range(poses.shape[1])
                for sign in (-1.0, 1.0)
            ]
            poses = np.concatenate([poses, *ends])
        found = poses
    grid = robot.grid()
    lateral = [robot.pose_names.index(name) for name in grid.lateral]
    box = bounds
    if len(bounds) > MAX_GRID_DIMENSIONS:
        if len(found):
            box = _bounding_box(found, 0.1 * np.ptp(found, axis=0), bounds)
        return box
    # Twice, because a machine may reach a small part of what its lengths allow.
    for _ in range(2):
        ticks = [np.linspace(low, high, GRID_SIDE) for low, high in box]
        poses = np.stack(np.meshgrid(*ticks, indexing="ij"), -1).reshape(-1, len(ticks))
        seen = np.concatenate([found, poses[reachable(robot, poses, -math.inf)]])
        if not len(seen):
            raise ParameterError("limits", robot.name, "limits that leave a workspace")
        box = _bounding_box(seen, np.ptp(box, axis=1) / (GRID_SIDE - 1), bounds)
        if lateral:
            # Keep the axis in the middle and on the grid: workspaces have tips there.
            half = np.abs(box[lateral]).max(1)
            box[lateral] = np.stack([-half, half], -1)
    return box


def _bounding_box(poses: Array, margin: Array, bounds: Array) -> Array:
    low, high = poses.min(0) - margin, poses.max(0) + margin
    return np.stack([np.maximum(low, bounds[:, 0]), np.minimum(high, bounds[:, 1])], -1)


def _climb(robot: Robot, limits: Array, q: Array, k: int, sign: float) -> Array:
    """Climb from joint states (c, n) along ``sign`` times pose coordinate k; return poses.

    :param limits: of the joints, shape (n, 2).
    """
    low, high = limits.T
    best, _ = try_forward(robot, q)
    for step in np.repeat(0.5 ** np.arange(1, 9), 3):
        rates, known = robot.try_jacobian(q)
        uphill = np.where(known[:, None], sign * np.sign(rates[:, k]), 0.0)
        tried = robot.try_project_redundant(np.clip(q + step * (high - low) * uphill, low, high))
        poses, good = try_forward(robot, tried)
        good[good] = reachable(robot, poses[good], -math.inf)
        good &= sign * (poses[:, k] - best[:, k]) > 0.0
        q, best = np.where(good[:, None], tried, q), np.where(good[:, None], poses, best)
    return best
