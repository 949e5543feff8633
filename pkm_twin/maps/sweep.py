# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compute a map: a kind's cases over all poses, the worst pose of each, and planes through it.

A pose counts if actuators and passive joints keep their limits, limbs do not interfere, and the
singularity index is not below a bound. Up to three pose coordinates have a grid of poses, more have
a sample of joint positions. The worst pose is searched in the whole workspace, from the worst of
these poses. Planes of every two coordinates then go exactly through it.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np

import pkm_twin
from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import ParameterError
from pkm_twin.maps.kind import (
    FLAG_BOUNDS,
    FORMAT_VERSION,
    NON_NEGATIVE,
    UNIT_INTERVAL,
    Case,
    Field,
    Found,
    Kind,
    Space,
    Values,
    Variable,
    Worst,
    describe,
    evaluate_kind,
    name_labels,
    scalar,
)
from pkm_twin.maps.kinds.workspace import LAYERS, find_circle_radii, make_circle_variables
from pkm_twin.maps.search import GRID_SIDE, MAX_GRID_DIMENSIONS, find_workspace_box, find_worst, score_values
from pkm_twin.robot.clearance import has_clearance, joint_clearance
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import MIN_TILT_RADIUS, satisfies_limits, workspace_radius_unit

STARTS_PER_CHUNK: Final = 16
"""Number of the worst poses of a chunk that the search may start from."""


@dataclass(frozen=True)
class Chunk:
    """Describe rows ``start`` to ``stop`` of the grid, or of a plane; ``case`` None: all cases."""

    start: int
    stop: int
    plane: int | None = None
    case: int | None = None

    @property
    def before(self) -> str:
        """Prefix of the names of the chunk's fields."""
        return "" if self.plane is None else "plane_"

    def place(self, dims: Sequence[str]) -> tuple[Any, ...]:
        """Return the index of the chunk's values in a field with dimensions ``dims``."""
        rows = slice(self.start, self.stop)
        if self.plane is None:
            return (rows,)
        cases = slice(None) if self.case is None else slice(self.case, self.case + 1)
        return (self.plane, rows, slice(None), cases)[: len(dims)]


@dataclass(frozen=True, eq=False)
class Map(Space):
    """Describe one map to be computed; small, because workers receive it with every chunk.

    ``extents``: ends of the planes of each case, shape (planes, 2, 2), once the worst poses are
    known.
    """

    extents: tuple[Array, ...] = ()

    @property
    def dims(self) -> tuple[str, ...]:
        """Dimensions of the grid."""
        return self.robot.pose_names if self.ticks else ("sample",)

    @property
    def planes(self) -> list[tuple[int, ...]]:
        """Pose coordinates of the planes, by index, positions first; or the only coordinate."""
        angles = [unit == "rad" for unit in self.robot.pose_units]
        pairs = itertools.combinations(range(len(angles)), 2)
        return sorted(pairs, key=lambda pair: sum(angles[k] for k in pair)) or [(0,)]

    @cached_property
    def elements(self) -> tuple[str, ...]:
        """Names that ``dominant`` indexes."""
        return self.kind.elements(self.robot)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the grid."""
        return tuple(map(len, self.ticks)) or (self.samples,)

    @cached_property
    def fields(self) -> dict[str, Field]:
        """Fields of the grid and of the planes; NaN and -1 where a pose does not count."""
        axes, elements = self.kind.axes(self.robot), self.elements
        turn = {"units": "1", "valid_min": -1.0, "valid_max": 1.0}
        names = {"valid_min": -1, "valid_max": len(elements) - 1}
        value = describe(self.kind.name, "", {} if self.kind.signed else NON_NEGATIVE)
        blame = describe(f"index of the {self.kind.element}", "", names)
        grid, plane = (*self.dims, "case"), ("plane", "row", "column", "case")
        fields = {"value": Field(grid, value)}
        if axes:
            fields["direction"] = Field((*grid, "axis"), describe("of the value", "", turn))
        if elements:
            fields["dominant"] = Field(grid, blame, "i2")
        share = describe("share of an element", "", UNIT_INTERVAL)
        if self.kind.has_shares:
            fields["factor"] = Field((*grid, "element"), share)
        if not self.ticks:
            fields["pose"] = Field(("sample", "coordinate"), describe("pose of a sample, m and rad"))
        fields["plane_value"] = Field(plane, value)
        if elements:
            fields["plane_dominant"] = Field(plane, blame, "i2")
        if self.kind.has_shares:
            fields["plane_factor"] = Field((*plane, "element"), share)
        reach = describe("1 where all limits are kept", "", FLAG_BOUNDS)
        return fields | {"plane_reach": Field(plane, reach, "i1")}

    @property
    def coordinates(self) -> dict[str, Variable]:
        """The grid's axes, the planes, and the cases with their units and words."""
        robot, cases = self.robot, self.cases
        named = list(zip(robot.pose_names, robot.pose_units, strict=True))
        result = {
            name: Variable((name,), ticks, describe(f"pose coordinate {name}", unit))
            for (name, unit), ticks in zip(named, self.ticks, strict=False)
        }
        result |= {
            "coordinate": name_labels("coordinate", robot.pose_names),
            "unit": name_labels("coordinate", robot.pose_units),
            "case": name_labels("case", [case.name for case in cases]),
        }
        for word in ("what", "unit", "answer"):
            result[f"case_{word}"] = name_labels("case", [getattr(case, word) for case in cases])
        for k, dim in enumerate(("row", "column")):
            shown = [robot.pose_names[p[k]] if k < len(p) else "" for p in self.planes]
            result[f"{dim}_name"] = name_labels("plane", shown)
        if axes := self.kind.axes(robot):
            result["axis"] = name_labels("axis", axes)
        if self.elements:
            result["element"] = name_labels("element", self.elements)
        return result

    @property
    def settings(self) -> dict[str, Any]:
        """Settings of this map except the robot, as plain values."""
        return {
            "points": math.prod(self.shape),
            "least_singularity": self.least,
            "least_clearance": self.least_clearance,
            "regular": self.circles is not None,
            "at": None if self.at is None else self.at.tolist(),
            "wrenches": {case.name: case.wrench for case in self.cases},
            "options": self.kind.options,
        }

    @property
    def attributes(self) -> dict[str, str]:
        """Global attributes of the file: all inputs of the map."""
        grid = self.robot.grid()
        return {
            "title": f"{self.kind.name} of {self.robot.name}",
            "Conventions": "CF-1.10",
            "format": FORMAT_VERSION,
            "kind": self.kind.name,
            "question": self.kind.question,
            "element": self.kind.element,
            "robot": self.robot.name,
            "mechanism": self.robot.mechanism,
            "height": grid.height,
            "robot_parameters": json.dumps(self.robot.parameter_sections(), sort_keys=True),
            "settings": json.dumps(self.settings, sort_keys=True),
            "pkm_twin_version": pkm_twin.__version__,
        }

    @property
    def fingerprint(self) -> str:
        """Hash that is equal for two maps exactly if their results are."""
        digest = hashlib.sha256(json.dumps(self.attributes, sort_keys=True).encode())
        digest.update(self.robot.graph.key.encode() + self.robot.own_inertial.tobytes())
        digest.update(f"{self.rows} {self.side} {self.bounds.tolist()}".encode())
        for name, variable in self.coordinates.items():
            digest.update(name.encode() + np.ascontiguousarray(variable.values).tobytes())
        return digest.hexdigest()

    @property
    def sizes(self) -> dict[str, int]:
        """Length of every dimension."""
        columns = self.side if len(self.bounds) > 1 else 1
        sizes = dict(zip(self.dims, self.shape, strict=True))
        sizes |= {"plane": len(self.planes), "row": self.side, "column": columns}
        for variable in self.coordinates.values():
            sizes |= dict(zip(variable.dims, variable.values.shape, strict=True))
        return sizes

    @property
    def rows(self) -> int:
        """Rows of the grid in one chunk."""
        return max(1, self.kind.chunk // math.prod(self.shape[1:]))

    def chunks(self) -> list[Chunk]:
        """Return all chunks: those of the grid, then those of the planes."""

        def split(count: int, rows: int, plane: int | None = None, case: int | None = None) -> list[Chunk]:
            return [Chunk(start, min(start + rows, count), plane, case) for start in range(0, count, rows)]

        chunks = split(self.shape[0], self.rows)
        rows = max(1, self.kind.chunk // self.sizes["column"])
        cases = (None,) if self.kind.together else range(len(self.cases))
        for plane, case in itertools.product(range(len(self.planes)), cases):
            chunks += split(self.side, rows, plane, case)
        return chunks

    def count(self, chunk: Chunk) -> int:
        """Return the number of poses of one chunk."""
        across = math.prod(self.shape[1:]) if chunk.plane is None else self.sizes["column"]
        return (chunk.stop - chunk.start) * across

    @property
    def points(self) -> int:
        """Number of poses to compute; the unit of progress."""
        return sum(self.count(chunk) for chunk in self.chunks())

    def plane_ticks(self, plane: int, case: int) -> list[Array]:
        """Return the coordinates along a plane's sides, which include its pose."""
        sides = zip(self.planes[plane], self.extents[case][plane], strict=False)
        return [_make_ticks(ends, self.planes_pose(case)[k], self.side) for k, ends in sides]

    def _find_extent(self, plane: int, case: int) -> Array:
        """Return the ends of a plane's sides (2, 2), around its reachable part and its pose."""
        shown, pose = list(self.planes[plane]), self.planes_pose(case)
        box = bounds = self.bounds[shown]
        least, most = np.minimum(bounds[:, 0], pose[shown]), np.maximum(bounds[:, 1], pose[shown])
        # Each time on a finer grid.
        for _ in range(3):
            ticks = [_make_ticks(ends, pose[k], GRID_SIDE) for k, ends in zip(shown, box, strict=True)]
            poses = self._plane_poses(plane, case, ticks)
            q, _, known = self.evaluate_poses(poses)
            reach = satisfies_limits(self.robot, q, poses, -math.inf, known)
            seen = np.concatenate([poses[reach], pose[None]])[:, shown]
            # More than a step, so that a tip between the poses appears on the next grid.
            margin = 1.5 * np.array([np.diff(side).max() for side in ticks])
            around = np.maximum(margin, 0.1 * np.ptp(bounds, axis=1))
            low = np.minimum(seen.min(0) - margin, pose[shown] - around)
            high = np.maximum(seen.max(0) + margin, pose[shown] + around)
            box = np.stack([np.maximum(low, least), np.minimum(high, most)], -1)
        return np.concatenate([box, np.zeros((2 - len(box), 2))])

    def _plane_poses(self, plane: int, case: int, ticks: Sequence[Array]) -> Array:
        """Return the poses of a plane, shape (k, m)."""
        grid = np.meshgrid(*ticks, indexing="ij")
        poses = np.broadcast_to(self.planes_pose(case), (*grid[0].shape, len(self.bounds))).copy()
        for k, values in zip(self.planes[plane], grid, strict=True):
            poses[..., k] = values
        return poses.reshape(-1, len(self.bounds))

    def evaluate(self, chunk: Chunk) -> Values:
        """Evaluate the cases on a chunk; for the grid also worst poses and counts."""
        # Joint positions, poses, and which of them are known.
        rows = slice(chunk.start, chunk.stop)
        if chunk.plane is not None:
            case = chunk.case or 0
            first, *rest = self.plane_ticks(chunk.plane, case)
            states = self.evaluate_poses(self._plane_poses(chunk.plane, case, [first[rows], *rest]))
        elif self.ticks:
            grid = np.meshgrid(self.ticks[0][rows], *self.ticks[1:], indexing="ij")
            states = self.evaluate_poses(np.stack(grid, -1).reshape(-1, len(self.bounds)))
        else:
            low, high = self.box.T
            size = (chunk.stop - chunk.start, len(low))
            states = self.evaluate_point(np.random.default_rng(chunk.start).uniform(low, high, size))
        parts = 1 + len(states[0]) // self.kind.chunk
        cases = self.cases if chunk.case is None else (self.cases[chunk.case],)
        batches = zip(*(np.array_split(array, parts) for array in states), strict=True)
        done = [self._evaluate_batch(q, pose, known, cases) for q, pose, known in batches]
        joined = {name: np.concatenate([one[name] for one in done]) for name in done[0]}
        total, starts = joined.pop("counts").sum(0), joined.pop("starts")
        if chunk.plane is None:
            shape = (chunk.stop - chunk.start, *self.shape[1:])
            values = {"counts": total, "starts": starts} | joined
        else:
            shape = (chunk.stop - chunk.start, self.sizes["column"])
            # Store the worst at its pose, which inverse kinematics may put outside by rounding.
            numbers = range(len(self.cases)) if chunk.case is None else [chunk.case]
            for column, number in enumerate(numbers):
                worst = self.worst[number]
                kept = (states[1] == worst.pose).all(-1)
                _store_values(joined, column, kept, worst.found)
                joined["reach"][kept, column] = 1
            values = {chunk.before + name: array for name, array in joined.items()}
        fields = self.fields
        return {
            name: array.reshape(*shape, *array.shape[1:]) if name in fields else array
            for name, array in values.items()
            if name in fields or name in ("counts", "starts")
        }

    def _evaluate_batch(self, q: Array, pose: Array, known: Mask, cases: Sequence[Case]) -> Values:
        robot, count = self.robot, len(q)
        reach = satisfies_limits(robot, q, pose, -math.inf, known)
        inside = reach & self.is_encircled(pose)
        inside[inside] = robot.try_singularity(q[inside])[0] >= self.least
        separate = inside.copy()
        if has_clearance(robot):
            gap = joint_clearance(robot, q[inside], refuse=False)
            separate[inside] = gap > self.least_clearance
        size, ways = len(self.elements), len(self.kind.axes(robot))
        values: Values = {
            "value": np.full((count, len(cases)), np.nan),
            "direction": np.full((count, len(cases), ways), np.nan),
            "dominant": np.full((count, len(cases)), -1, np.int16),
            "factor": np.full((count, len(cases), size), np.nan),
            "reach": np.repeat(reach[:, None], len(cases), 1).astype(np.int8),
            "pose": np.where(known[:, None], pose, np.nan),
            "counts": np.array([[inside.sum(), separate.sum(), count]]),
            "starts": np.full((1, len(cases), STARTS_PER_CHUNK, pose.shape[-1]), np.nan),
        }
        for interfering, kept in ((False, separate), (True, inside)):
            own = [k for k, case in enumerate(cases) if case.interfering == interfering]
            if not own:
                continue
            each = evaluate_kind(self.kind, robot, q[kept], [cases[k] for k in own])
            for k, found in zip(own, each, strict=True):
                _store_values(values, k, kept, found)
                best = np.argsort(-score_values(found.value, cases[k].largest))[:STARTS_PER_CHUNK]
                values["starts"][0, k, : len(best)] = pose[kept][best]
        return values

    def with_worst(self, grid: Iterable[Values]) -> Map:
        """Return the map with the worst pose of each case.

        :param grid: results of all chunks of the grid.
        :raises ParameterError: no pose counts.
        """
        starts = np.concatenate([values["starts"] for values in grid])

        def worst(k: int) -> Worst:
            first = starts[:, k].reshape(-1, starts.shape[-1])
            first = first[np.isfinite(first[:, 0])]
            return find_worst(self, self.cases[k], first)

        count = range(len(self.cases))
        if self.kind.together:
            one = worst(0)
            every = evaluate_kind(self.kind, self.robot, one.q[None], self.cases)
            found = replace(self, worst=tuple(replace(one, found=value) for value in every))
        else:
            found = replace(self, worst=tuple(map(worst, count)))
        planes = range(len(self.planes))
        extents = tuple(np.array([found._find_extent(p, k) for p in planes]) for k in count)
        return replace(found, extents=extents)

    def summaries(self, grid: Iterable[Values]) -> dict[str, Variable]:
        """Return the worst of each case, the planes' axes, and the kind's summaries."""
        counted, separate, every = np.sum([values["counts"] for values in grid], axis=0).tolist()
        result = {"valid": scalar(separate / every, "part of the grid that counts", "", UNIT_INTERVAL)}
        for k, dim in enumerate(("row", "column")):
            sides = [
                [[*self.plane_ticks(p, c), np.zeros(1)][k] for p in range(len(self.planes))]
                for c in range(len(self.cases))
            ]
            result[f"{dim}_value"] = Variable(
                ("case", "plane", dim), np.array(sides), describe(f"pose coordinate along the {dim}s")
            )
        worst, cases, axes = self.worst, ("case",), self.kind.axes(self.robot)
        pose, least = ("case", "coordinate"), "singularity index below which poses are worse"
        result |= {
            "through": Variable(
                pose,
                np.array([self.planes_pose(k) for k in range(len(self.cases))]),
                describe("pose that the planes go through, m and rad"),
            ),
            "worst_value": Variable(
                cases, np.array([one.found.value[0] for one in worst]), describe("the worst value")
            ),
            "worst_singularity": Variable(
                cases,
                np.array([one.index for one in worst]),
                describe("singularity index of the worst value", "", UNIT_INTERVAL),
            ),
            "worst_bound": Variable(
                cases,
                np.array([self.least if one.bounded else np.nan for one in worst]),
                describe(f"{least} than the worst value, if it is there", "", UNIT_INTERVAL),
            ),
            "worst_pose": Variable(pose, np.array([one.pose for one in worst]), describe("of the worst value")),
        }
        if axes:
            none_of = np.full((1, len(axes)), np.nan)
            ways = [none_of if (d := one.found.direction) is None else d for one in worst]
            what = describe("of the worst value")
            result["worst_direction"] = Variable(("case", "axis"), np.concatenate(ways), what)
        if self.elements:
            names = describe(f"index of the {self.kind.element}", "", {"valid_min": -1})
            blame = np.array([-1 if (e := one.found.element) is None else e[0] for one in worst])
            result["worst_element"] = Variable(cases, blame, names)
        if self.circles is not None:
            result |= make_circle_variables(self.robot, *self.circles)
        return result | self.kind.summaries(self, counted, separate)


def _store_values(values: Values, case: int, kept: Mask, found: Found) -> None:
    """Store the values of the kept poses."""
    finite = np.isfinite(found.value)
    values["value"][kept, case] = np.where(finite, found.value, np.nan)
    if found.direction is not None:
        values["direction"][kept, case] = np.where(finite[:, None], found.direction, np.nan)
    if found.element is not None:
        values["dominant"][kept, case] = np.where(finite, found.element, -1)
    if found.shares is not None:
        values["factor"][kept, case] = found.shares


def _make_ticks(ends: Array, value: float, count: int) -> Array:
    """Return even numbers between ends (2,), one of them moved to ``value``; wider if outside."""
    ticks = np.linspace(min(ends[0], value), max(ends[1], value), count)
    ticks[np.abs(ticks - value).argmin()] = value
    return np.asarray(ticks, np.float64)


def plan_map(
    robot: Robot,
    kind: Kind,
    points: int | None = None,
    *,
    cases: Sequence[Case] = (),
    at: Sequence[float] | None = None,
    least_singularity: float | None = None,
    least_clearance: float = 0.0,
    regular: bool = False,
) -> Map:
    """Plan the map of a kind over a robot's workspace.

    :param points: about how many poses; default by the kind.
    :param cases: load cases (:meth:`Kind.loaded`); default the kind's own.
    :param at: the pose that the planes go through; default the worst.
    :param least_singularity: singularity index below which a pose does not count; default by kind.
    :param least_clearance: distance between limbs, m, below which a pose does not count.
    :param regular: count only poses inside the largest circles about the axis, of
        ``MIN_TILT_RADIUS`` or more where they are tilts (2UPR-RPU paper, figure 5).
    :raises ParameterError: the robot's file lacks what the kind needs, or limits that bound the
        workspace; a bound on an unknown clearance; no circle.
    :raises UnreachableError: ``at`` is out of reach.
    """
    cases = tuple(cases) or kind.cases(robot)
    check(robot, kind, cases)
    total = kind.points if points is None else points
    least = kind.least if least_singularity is None else least_singularity
    if total < 50:
        raise ParameterError("--points", total, "50 or more")
    if not 0.0 <= least < 1.0:
        raise ParameterError("singularity", least, "0 to below 1")
    if not 0.0 <= least_clearance < math.inf:
        raise ParameterError("least_clearance", least_clearance, "0 or more, m")
    if least_clearance > 0.0 and not has_clearance(robot):
        what = "0: the file does not give the members' diameters"
        raise ParameterError("least_clearance", least_clearance, what)
    if at is not None:
        robot.inverse(at)
    bounds = robot.cached(find_workspace_box)
    count = len(bounds)
    stack = None
    if regular:
        stack = find_circles(robot, bounds, least, least_clearance)
        # Of the poses inside the circles.
        kept = stack[:, np.isfinite(stack[1])]
        wide = float(kept[1].max())
        grid = robot.grid()
        sides = {name: (-wide, wide) for name in grid.lateral}
        sides[grid.height] = float(kept[0].min()), float(kept[0].max())
        bounds = np.array([sides[name] for name in robot.pose_names])
    ticks: tuple[Array, ...] = ()
    if count <= MAX_GRID_DIMENSIONS:
        length = max(5, min(round(total ** (1 / count)), 2001))
        # An odd number across an axis, so that the axis is on the grid.
        odd = length + 1 - length % 2
        lateral = robot.grid().lateral
        ticks = tuple(
            np.linspace(low, high, odd if name in lateral else length)
            for (low, high), name in zip(bounds, robot.pose_names, strict=True)
        )
    side = round(math.sqrt(total / (3 if count > 2 else 1))) if count > 1 else total
    return Map(
        robot,
        kind,
        cases,
        bounds,
        ticks,
        total,
        min(max(side, 11), 151),
        least,
        least_clearance,
        None if at is None else np.array(at, np.float64),
        circles=stack,
    )


def find_circles(robot: Robot, bounds: Array, least: float, least_clearance: float) -> Array:
    """Return heights and radii, (2, k), of the largest circles about the axis that count.

    Circles of tilts below ``MIN_TILT_RADIUS`` are NaN.

    :param bounds: of the pose coordinates, shape (m, 2).
    :raises ParameterError: a machine whose workspace has no axis, or without a circle.
    """
    grid = robot.grid()
    if grid.kind != "cylinder":
        what = "a machine whose poses lie about an axis (as upr_rpu)"
        raise ParameterError("regular", robot.name, what)
    low, high = bounds[robot.pose_names.index(grid.height)].tolist()
    heights = np.linspace(low, high, LAYERS)
    radius = find_circle_radii(robot, heights, least=least, least_clearance=least_clearance)
    smallest = MIN_TILT_RADIUS if workspace_radius_unit(robot) == "rad" else 0.0
    kept = (radius >= smallest) & (radius > 0.0)
    if not kept.any():
        raise ParameterError("regular", float(radius.max()), f"a circle of {smallest:.4g} or more")
    return np.stack([heights, np.where(kept, radius, np.nan)])


def check(robot: Robot, kind: Kind, cases: Sequence[Case]) -> None:
    """Evaluate a kind once, at home, so that missing data of the robot's file raise early.

    :raises ParameterError: names the missing section.
    """
    kind.elements(robot)
    evaluate_kind(kind, robot, robot.graph.home[None], cases)
