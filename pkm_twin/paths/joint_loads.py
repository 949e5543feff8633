# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compute forces and moments in the joints along a motion, load cycles and bearing life."""

from __future__ import annotations

import csv
import fnmatch
import io
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from delta_dynamics.torques.elastic_reactions import elastic_reactions
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, warn_of_file
from pkm_twin.files import write_atomically
from pkm_twin.machine import schema
from pkm_twin.machine.graph import BASE, Joint
from pkm_twin.machine.rotations import skew
from pkm_twin.paths.sizing import read_entries
from pkm_twin.recordings import Recording, split_by_load
from pkm_twin.recordings.tables import WRENCH as AXES
from pkm_twin.robot.robot import Robot


@dataclass(frozen=True, eq=False)
class Cycles:
    """Hold load cycles in counting order: ``ranges``, ``means``, ``counts`` of 1 or 0.5, (k,)."""

    ranges: Array
    means: Array
    counts: Array

    def equivalent_range(self, exponent: float) -> float:
        """Return the range of one cycle with the damage of all (Miner's sum, Wöhler's exponent)."""
        return float(np.sum(self.counts * self.ranges**exponent) ** (1.0 / exponent))

    def spectrum(self, classes: int) -> tuple[Array, Array]:
        """Return the upper ends of ``classes`` equal classes of range, and their counts."""
        top = float(self.ranges.max(initial=0.0)) or 1.0
        ends = top * np.arange(1, classes + 1) / classes
        place = np.minimum(np.searchsorted(ends, self.ranges * (1.0 - 1e-12)), classes - 1)
        return ends, np.bincount(place, self.counts, classes).astype(np.float64)


def find_reversals(values: ArrayLike) -> Array:
    """Return a load's reversals and its two ends, shape (k,)."""
    y = np.asarray(values, np.float64)
    y = y[np.concatenate([[True], np.diff(y) != 0.0])] if len(y) else y
    inner = np.flatnonzero(np.diff(np.sign(np.diff(y))) != 0.0) + 1
    return y[np.concatenate([[0], inner, [len(y) - 1]])] if len(y) > 1 else y


class Reversals:
    """Collect a load's reversals and its two ends from consecutive blocks."""

    def __init__(self) -> None:
        self._parts: list[Array] = []
        self._tail: Array = np.empty(0)

    def add(self, values: Array) -> None:
        """Add the next block, shape (samples,)."""
        points = find_reversals(np.concatenate([self._tail, values]))
        # The last point is a reversal only if the next block turns; it needs the one before.
        self._parts.append(points[:-2])
        self._tail = points[-2:]

    @property
    def values(self) -> Array:
        """All reversals, shape (k,)."""
        return np.concatenate([*self._parts, self._tail])


def count_rainflow_cycles(values: ArrayLike) -> Cycles:
    """Count cycles by the rainflow method, ASTM E1049-85 (2017), section 5.4.4.

    :param values: a load over time, shape (samples,).
    """
    found: list[tuple[float, float, float]] = []
    stack: list[float] = []

    def count(a: float, b: float, much: float) -> None:
        found.append((abs(b - a), (a + b) / 2.0, much))

    for value in find_reversals(values).tolist():
        stack.append(value)
        while len(stack) >= 3:
            newest, before = abs(stack[-1] - stack[-2]), abs(stack[-2] - stack[-3])
            if newest < before:
                break
            if len(stack) == 3:
                # The range contains the start: count half a cycle and drop the start.
                count(stack[0], stack[1], 0.5)
                del stack[0]
            else:
                count(stack[-3], stack[-2], 1.0)
                del stack[-3:-1]
    for a, b in itertools.pairwise(stack):
        count(a, b, 0.5)
    return Cycles(*np.array(found, np.float64).reshape(-1, 3).T)


@dataclass(frozen=True)
class Life:
    """Hold a bearing's equivalent load, N; motion in turns or m; life in these and in hours.

    Life is infinite without load, NaN under a load at standstill.
    """

    load: float
    moved: float
    life: float
    hours: float


def compute_bearing_life(
    load: ArrayLike,
    moved: ArrayLike,
    duration: float,
    rating: float,
    exponent: float = 3.0,
    slides: bool = False,
) -> Life:
    """Compute the L10 life of a rolling bearing under a load that varies with its motion.

    P = (sum F^p dphi / sum dphi)^(1/p), L10 = (C / P)^p million turns (ISO 281), or times 100 km of
    a linear bearing (ISO 14728-1). Motion counts in both directions.

    :param load: equivalent load of the bearing in each interval, shape (k,), N.
    :param moved: angle or travel in each, shape (k,), rad or m.
    :param duration: of all, s.
    :param rating: C, basic dynamic load rating, N; ``exponent``: p, 3 of balls, 10/3 of rollers.
    """
    force, steps = np.asarray(load, np.float64), np.abs(np.asarray(moved, np.float64))
    whole = float(steps.sum())
    # A mean step below 1e-12, rad or m, is rounding.
    still = whole <= 1e-12 * len(steps)
    mean = float(np.mean(force**exponent) if still else np.sum(force**exponent * steps) / whole)
    equivalent, amount = mean ** (1.0 / exponent), whole if slides else whole / math.tau
    if still or not equivalent > 0.0:
        life = math.nan if equivalent > 0.0 else math.inf
        return Life(equivalent, amount, life, life)
    life = (1e5 if slides else 1e6) * (rating / equivalent) ** exponent
    return Life(equivalent, amount, life, life / amount * duration / 3600.0)


SAMPLES_PER_BLOCK: Final = 512
"""Samples computed at a time: each has matrices of all unknowns."""


@dataclass(frozen=True, eq=False)
class BearingSpec:
    """Describe a bearing of a joint: C (N), the life's exponent p, and its load X Fr + Y Fa.

    Without Y the load is the force's magnitude; for a sliding joint always its part perpendicular
    to the axis, because the drive carries the part along it. ``axis`` (base axes, at home): default
    the joint's.
    """

    C: float = schema.number(above=0.0, unit="N")
    p: float = schema.number(low=1.0, high=20.0, default=3.0)
    X: float = schema.number(low=0.0, high=100.0, default=1.0)
    Y: float | None = schema.number(low=0.0, high=100.0, default=None)
    axis: Array | None = schema.vector(3, default=None)


@dataclass(frozen=True, eq=False)
class JointLoad:
    """Hold the load of a joint's inner body on its outer one at the joint's point, per sample.

    ``wrench``: base axes, ``own``: axes that turn with the inner body, (k, 6), N and N m; NaN where
    undetermined. ``turned``: rotation of the outer body relative to the inner one between samples,
    rad, (k - 1,); ``travelled``: translation of a sliding joint, m, else 0.
    """

    name: str
    wrench: Array
    own: Array
    turned: Array
    travelled: Array


def compute_joint_loads(motion: Recording) -> Iterator[list[JointLoad]]:
    """Yield the loads of all joints along a motion in blocks that overlap by one sample.

    Errors as of ``reactions``.
    """
    last: dict[str, tuple[Array, ...]] = {}
    slides = {name: joint for name, joint in joints_by_label(motion.robot).items() if joint.slides}
    for robot, rows in split_by_load(motion.robot, motion.load, motion.time, SAMPLES_PER_BLOCK):
        q, *others = (values[rows] for values in motion.motion)
        found = elastic_reactions(robot, q, *others)
        rotations, origins = motion.robot.placements(q)
        turn = {BASE: np.broadcast_to(np.eye(3), (len(q), 3, 3)), **rotations}
        order = list(found.names)
        for rod in motion.robot.graph.rods.values():
            # A rod's rotation is that of its direction; its spin is idle.
            start, end = (found.points[:, order.index(name)] for name in rod.joint_names)
            home, now = rod.ends[1] - rod.ends[0], end - start
            a, b = home / np.linalg.norm(home), now / np.linalg.norm(now, axis=-1, keepdims=True)
            across = skew(np.cross(a, b))
            turn[rod.name] = np.eye(3) + across + across @ across / (1.0 + b @ a)[:, None, None]
        result = []
        for k, (name, (inner, outer)) in enumerate(zip(found.names, found.bodies, strict=True)):
            back = turn[inner].swapaxes(-1, -2)
            wrench = found.wrenches[:, k]
            own = np.concatenate([_multiply(back, wrench[:, :3]), _multiply(back, wrench[:, 3:])], -1)
            place = np.zeros(len(q))
            if name in slides:
                joint, at = slides[name], motion.robot.engine.tree.at
                # From the points of both bodies, because a loop-closing joint has no coordinate.
                ends = [
                    origins[body] + turn[body] @ (joint.at - at[body]) if body != BASE else joint.at
                    for body in (inner, outer)
                ]
                place = np.sum((turn[inner] @ joint.axes[0]) * (ends[1] - ends[0]), -1)
            parts: tuple[Array, ...] = (wrench, own, back @ turn[outer], place)
            if name in last:
                parts = tuple(map(np.concatenate, zip(last[name], parts, strict=True)))
            last[name] = tuple(part[-1:] for part in parts)
            step = parts[2][:-1].swapaxes(-1, -2) @ parts[2][1:]
            sine = np.linalg.norm([step[:, i, j] - step[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=0)
            angles = np.arctan2(sine, np.trace(step, axis1=-2, axis2=-1) - 1.0)
            result.append(JointLoad(name, parts[0], parts[1], angles, np.abs(np.diff(parts[3]))))
        yield result


class Summary:
    """Accumulate the loads of a joint and its bearing: peaks, sums of squares, reversals.

    ``peaks`` and ``squares``: of force and moment, then of both without the part that an actuated
    joint's drive carries (the moment about its axis, or the force along it). They, and ``sizes`` of
    the latter force, include determined components only. ``known``: whether all components are
    determined in all samples.
    """

    def __init__(self, robot: Robot, name: str, spec: BearingSpec | None) -> None:
        self.name, self.spec = name, spec
        joint = joints_by_label(robot).get(name)
        self.slides = joint is not None and joint.slides
        self.axis = None if spec is None else bearing_axis(joint, name, spec)
        self.across = np.broadcast_to(np.eye(3), (2, 3, 3)).copy()
        if joint is not None and joint.actuated:
            self.across[1 - self.slides] -= np.outer(joint.axes[0], joint.axes[0])
        self.samples, self.turned, self.travelled = 0, 0.0, 0.0
        self.peaks, self.squares = np.zeros(4), np.zeros(4)
        self.determined = np.ones(len(AXES), np.bool_)
        self.known = np.ones(4, np.bool_)
        self.reversals = [Reversals() for _ in AXES]
        self.sizes: list[Array] = []
        self.bearing: list[tuple[Array, Array]] = []

    def add(self, load: JointLoad) -> None:
        """Add the next block."""
        fresh = slice(1 if self.samples else 0, None)
        borne = _multiply(self.across, load.own[fresh].reshape(-1, 2, 3))
        parts = np.concatenate([load.wrench[fresh].reshape(-1, 2, 3), borne], 1)
        self.known &= np.isfinite(parts).all((0, 2))
        size = np.sqrt(np.nansum(parts**2, -1))
        self.samples += len(size)
        self.turned += float(load.turned.sum())
        self.travelled += float(load.travelled.sum())
        self.peaks = np.maximum(self.peaks, size.max(0))
        self.squares += (size**2).sum(0)
        self.sizes.append(size[:, 2].astype(np.float32))
        self.determined &= np.isfinite(load.own).all(0)
        for k in np.flatnonzero(self.determined):
            self.reversals[k].add(load.own[fresh, k])
        if self.spec is not None:
            force = load.own[:, :3]
            amount = np.linalg.norm(force, axis=-1)
            if self.axis is not None:
                along = force @ self.axis
                across = np.sqrt(np.maximum(amount**2 - along**2, 0.0))
                amount = self.spec.X * across + (self.spec.Y or 0.0) * np.abs(along)
            moved = load.travelled if self.slides else load.turned
            self.bearing.append(((amount[1:] + amount[:-1]) / 2.0, moved))

    def cycles(self, axis: int) -> Cycles:
        """Return the rainflow cycles of one component."""
        return count_rainflow_cycles(self.reversals[axis].values)

    def life(self, duration: float) -> Life:
        """Return the L10 life of the joint's bearing; the load is linear between samples."""
        assert self.spec is not None  # noqa: S101  asked for joints with a bearing
        load, moved = (np.concatenate(column) for column in zip(*self.bearing, strict=True))
        return compute_bearing_life(load, moved, duration, self.spec.C, self.spec.p, self.slides)


def _multiply(matrices: Array, vectors: Array) -> Array:
    """Multiply matrices and vectors; NaN components only affect directions they act along.

    A unit vector with a component below 1e-9 is perpendicular to that axis.
    """
    products = np.where(np.abs(matrices) > 1e-9, matrices * vectors[..., None, :], 0.0)
    return np.asarray(products.sum(-1), np.float64)


def read_bearings(path: Path, names: tuple[str, ...], robot: Robot) -> dict[str, BearingSpec]:
    """Read bearings by joint from a YAML mapping ``bearings``; names may contain wildcards.

    A * in a name stands for any text; joints of such a name that the bearing does not fit are left
    out, with a warning that names them.

    :raises ParameterError: names the field; a name that no joint has, or a bearing that fits none.
    """
    found: dict[str, BearingSpec] = {}
    joints = joints_by_label(robot)
    for pattern, entry in read_entries(path, "bearings", "joints").items():
        fitting = fnmatch.filter(names, str(pattern))
        if not fitting:
            raise ParameterError(f"{path}: bearings", pattern, f"a name or pattern of the joints {', '.join(names)}")
        spec = schema.build(BearingSpec, entry, f"{path}: bearings.{pattern}")
        left = {}
        for name in fitting:
            try:
                bearing_axis(joints.get(name), name, spec)
                found[name] = spec
            except ParameterError as error:
                left[name] = error
        if left and (len(left) == len(fitting) or str(pattern) in names):
            raise next(iter(left.values()))
        if left:
            warn_of_file(path, f"{path}: bearings.{pattern} does not fit {', '.join(left)}: no life there")
    return found


def joints_by_label(robot: Robot) -> dict[str, Joint]:
    """Return the joints by their names among the reactions."""
    return {joint.label or joint.name: joint for joint in robot.graph.joints.values()}


def bearing_axis(joint: Joint | None, name: str, spec: BearingSpec) -> Array | None:
    """Return the axis of a joint's bearing, unit, base axes at home; None if not needed.

    :param joint: None for a rod's end.
    :raises ParameterError: Y without an axis, or of a sliding joint; a joint that slides and has
        other freedoms.
    """
    if joint is not None and not joint.slides and not all(f.turns for f in joint.freedoms):
        raise ParameterError(f"bearings.{name}", joint.kind, "a joint that only turns or slides")
    if joint is not None and joint.slides:
        if spec.Y is not None:
            raise ParameterError(
                f"bearings.{name}.Y",
                spec.Y,
                "none: along a sliding joint the drive bears the force",
            )
        return np.asarray(joint.axes[0], np.float64)
    if spec.Y is None:
        return None
    axis = spec.axis
    if axis is None and joint is not None and len(joint.axes) == 1:
        axis = joint.axes[0]
    if axis is None:
        raise ParameterError(f"bearings.{name}.axis", None, "the bearing's axis, for Y")
    return np.asarray(axis / np.linalg.norm(axis), np.float64)


def format_spectra(loads: Sequence[Summary]) -> str:
    """Return rainflow counts by joint, component and class of range, as CSV."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(["joint", "component", "range_up_to", "cycles"])
    for load in loads:
        for k, axis in enumerate(AXES):
            cycles = load.cycles(k)
            if load.determined[k] and len(cycles.ranges):
                for end, count in zip(*cycles.spectrum(32), strict=True):
                    writer.writerow([load.name, axis, float(end), float(count)])
    return text.getvalue()


def summarise_loads(
    motion: Recording,
    bearings: Path | None,
    out: Path | None,
    progress: Callable[[int], None] | None = None,
) -> list[Summary]:
    """Compute the loads of all joints along a motion, and write them block by block.

    :raises ParameterError: fewer than two samples, or by the field of a bearing.
    """
    if len(motion.time) < 2:
        raise ParameterError(motion.source, f"{len(motion.time)} samples", "2 or more")
    result: list[Summary] = []
    begin = 0
    with ExitStack() as files:
        writer: Any = None
        if out is not None:
            hidden = files.enter_context(write_atomically(out))
            text = files.enter_context(hidden.open("w", newline="", encoding="utf-8"))
            writer = csv.writer(text)
        for block in compute_joint_loads(motion):
            if not result:
                names = tuple(load.name for load in block)
                fitted = {} if bearings is None else read_bearings(bearings, names, motion.robot)
                result = [Summary(motion.robot, name, fitted.get(name)) for name in names]
                if writer is not None:
                    writer.writerow(["time", *(f"{n}.{axis}" for n in names for axis in AXES)])
            for summary, load in zip(result, block, strict=True):
                summary.add(load)
            end = result[0].samples
            if writer is not None:
                time = motion.clock[begin:end]
                rows = np.concatenate([time[:, None], *(load.wrench[-len(time) :] for load in block)], -1)
                # Undetermined components stay empty.
                writer.writerows([["" if v != v else v for v in row] for row in rows.tolist()])
            begin = end
            if progress is not None:
                progress(end)
    return result
