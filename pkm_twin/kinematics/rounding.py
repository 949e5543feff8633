# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Repair axes and points of overconstrained machines that a file's rounding has displaced.

An overconstrained machine moves only if its axes and points satisfy exact relations: axes that meet
in one point, are parallel or lie in a plane, bars of equal length. Rounded numbers violate them,
and the machine loses degrees of freedom. The relations need not be known: the loops must close at
home and in other positions. Gauss-Newton steps of least norm change the numbers until they do, in
positions that the machine reaches with the rank that remains if singular values below the file's
precision count as zero.

Each body has six coordinates; joints and rods are equations between two bodies. Lengths are relative
to the machine's size, angles in rad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from pkm_twin.codegen.arrays import ROUNDING_NOISE, Array
from pkm_twin.kinematics.constraints import (
    Equation,
    Placement,
    constraint_equations,
    differentiate_by_frame,
    distance_equation,
    rotate,
)
from pkm_twin.kinematics.iterations import newton
from pkm_twin.machine.graph import Graph, Joint, array
from pkm_twin.machine.joints import CONSTRAINTS

MAX_ERROR_GROWTH: Final = 20.0
"""Largest displacement of a body, or gap of a loop, per rounding error of a number: the errors of a
chain of joints add up."""
MAX_ROUNDING: Final = 1e-4
"""Largest deviation of axes and points by rounding in any file, rad or relative to the size."""
POSITION_COUNTS: Final = (8, 24, 72)
"""Numbers of positions in which the loops are closed, tried in order, until the conditions outnumber
the machine's parameters."""
CHECK_COUNT: Final = 3
"""Number of further positions in which the repaired loops must close."""
POSITION_RADIUS: Final = 0.4
"""Distance of the positions from home: the largest motion of a body, rad or relative to the size."""
STEPS: Final = 4
"""Number of steps from home to a position."""
MAX_CORRECTIONS: Final = 6
"""Largest number of Newton corrections per step."""
MAX_ROUNDS: Final = 12
"""Largest number of Gauss-Newton iterations."""
MAX_OPENING: Final = 1e-13
"""Largest gap of a closed loop, rad or relative to the size."""
MAX_ZERO_SINGULAR_VALUE: Final = 1e-10
"""Largest singular value that is zero up to floating-point rounding."""
NOISE_FACTOR: Final = 100.0
"""Effects of numbers on the loops are noise below this multiple of the largest singular value that
should be zero, relative to the largest effect."""
MAX_RELATIVE_NOISE: Final = 1e-2
"""Upper bound of that relative noise: NOISE_FACTOR times MAX_ROUNDING."""
MAX_DEVIATION: Final = 3e-2
"""Largest deviation of an axis or point that is an error and not the design, rad or relative to the
machine's size."""
MAX_CHOSEN_VECTORS: Final = 6
"""Largest number of vectors that are chosen one by one."""

Slot = tuple[str, str, int]
"""Key of a vector of the graph: ``at`` or ``axis`` of a joint, or ``end`` of a rod; name; index."""


class _Frame(NamedTuple):
    """Describe a joint's or rod's frame on one of its bodies by the vectors that define it.

    ``point``: the origin at home, the vector with key ``slot``. ``axis``: the axis that the frame
    is aligned with, if any, the vector with key ``tilt``.
    """

    slot: Slot
    point: Array
    tilt: Slot | None = None
    axis: Array | None = None


@dataclass(frozen=True, eq=False)
class Repair:
    """A repaired graph whose loops close in all positions.

    ``moves``: change of each joint or rod, rad or relative to the machine's size.
    """

    graph: Graph
    moves: dict[str, float]

    @property
    def largest(self) -> float:
        """The largest move, rad or relative to the size."""
        return max(self.moves.values(), default=0.0)

    @property
    def text(self) -> str:
        """A sentence about the largest move."""
        return (
            f"axes and points were moved by up to {self.largest:.1g} (rad, or parts of the "
            "machine's size), so that the machine can move: the file is rounded"
        )


def repair_rounded(graph: Graph, rounding: float, least: float = 0.0) -> Repair | None:
    """Repair a graph by :func:`repair` with a file's rounding errors, rad or m.

    :param least: smallest precision to assume, rad or relative to the size.
    :returns: None if no change within the precision restores the degrees of freedom.
    """
    precision = min(MAX_ROUNDING, max(least, MAX_ERROR_GROWTH * rounding / min(1.0, graph.size)))
    found = repair(graph, precision)
    return found if found is not None and found.largest <= precision else None


def repair(graph: Graph, precision: float) -> Repair | None:
    """Move axes and points as little as possible, so that the machine's loops close exactly.

    :param precision: nonzero singular values of the closures below this come from the file's
        rounding, rad or relative to the machine's size.
    :returns: the graph and its moves, empty if no such singular value exists; None if no small
        change restores the degrees of freedom, or home is a singularity.
    """
    loops = _Loops(graph)
    sizes = np.linalg.svd(loops.equations(Placement.at_home(graph, (1,)))[1][0], compute_uv=False)
    rank = int((sizes > precision).sum())
    # Rounding may become visible at home or only away from it.
    if loops.are_exact(rank, loops.sample_positions(rank, 2, 1)) and not (sizes[rank:] > MAX_ZERO_SINGULAR_VALUE).any():
        return Repair(graph, {})
    # First align axes: least changes would make a planar linkage's axes meet in a distant point.
    loops.graph = align_axes(graph, precision)
    if loops.are_exact(rank, loops.sample_positions(rank, CHECK_COUNT, STEPS, seed=1)):
        return loops.repair()
    for count in POSITION_COUNTS:
        loops = _Loops(graph)
        positions = loops.sample_positions(rank, count, STEPS)
        if (loops.singular_values(positions) > precision).sum(1).max() > rank:
            return None
        if not loops.close(rank, positions):
            return None
        # Numbers fitted to few positions may close the loops only there: check other positions.
        if loops.are_exact(rank, loops.sample_positions(rank, CHECK_COUNT, STEPS, seed=1)):
            return loops.repair()
    return None


def align_axes(graph: Graph, precision: float) -> Graph:
    """Make axes exactly parallel, and hinges collinear, that are so within a precision.

    :param precision: rad, or relative to the machine's size.
    """
    means: list[Array] = []
    for axis in (axis for joint in graph.joints.values() for axis in joint.axes):
        for mean in means:
            if np.linalg.norm(np.cross(axis, mean)) < precision * np.linalg.norm(mean):
                mean += axis if axis @ mean > 0.0 else -axis
                break
        else:
            means.append(np.array(axis))
    units = [mean / np.linalg.norm(mean) for mean in means]

    def find_direction(axis: Array) -> Array:
        unit = min(units, key=lambda unit: float(np.linalg.norm(np.cross(axis, unit))))
        return unit if axis @ unit > 0.0 else -unit

    joints: dict[str, Joint] = {}
    lines: list[tuple[Array, Array]] = []
    for name, joint in graph.joints.items():
        axes, at = array(np.reshape([find_direction(axis) for axis in joint.axes], (-1, 3))), joint.at
        if joint.type.count == 1 and not joint.slides:
            for unit, point in lines:
                apart = np.cross(unit, at - point)
                if abs(unit @ axes[0]) > 1.0 - ROUNDING_NOISE and np.linalg.norm(apart) < precision * graph.size:
                    at = at + np.cross(unit, apart)
                    break
            else:
                lines.append((axes[0], at))
        joints[name] = replace(joint, at=array(at), axes=axes)
    return replace(graph, joints=joints)


def repair_few(graph: Graph, freedoms: int) -> Repair | None:
    """Move as few axes and points as possible, so that a machine has the required freedoms.

    Vectors are chosen one by one; each choice reduces the loops' gaps most: orthogonal matching
    pursuit (Pati, Rezaiifar and Krishnaprasad 1993). If MAX_CHOSEN_VECTORS do not close the loops,
    all vectors are moved as in :func:`repair`.

    :param freedoms: degrees of freedom that the machine should have.
    :returns: None if the machine has them already, or no change within MAX_DEVIATION restores them.
    """
    loops = _Loops(graph)
    rank = 6 * loops.bodies - freedoms
    sizes = np.linalg.svd(loops.equations(Placement.at_home(graph, (1,)))[1][0], compute_uv=False)
    if not 0 < rank < len(sizes) or sizes[rank] > MAX_DEVIATION:
        return None
    positions = loops.sample_positions(rank, POSITION_COUNTS[1], STEPS)
    gap, effect, noise = loops.measure_openings(rank, positions)
    chosen: list[Slot] = []
    basis = np.zeros((len(gap), 0))
    for _ in range(MAX_CHOSEN_VECTORS):
        best, least = None, float(np.linalg.norm(gap)) * (1.0 - 1e-6)
        for slot, columns in effect.items():
            apart = columns - basis @ (basis.T @ columns)
            left, strength, _ = np.linalg.svd(apart, full_matrices=False)
            own = left[:, strength > noise]
            rest = gap - own @ (own.T @ gap)
            # Take the first of equivalent vectors.
            if float(np.linalg.norm(rest)) < least * (1.0 - 1e-6):
                best, least, remaining, added = slot, float(np.linalg.norm(rest)), rest, own
        if best is None:
            break
        chosen.append(best)
        gap, basis = remaining, np.hstack([basis, added])
        trial = _Loops(graph)
        if trial.close(rank, positions, chosen) and trial.are_exact(
            rank, trial.sample_positions(rank, CHECK_COUNT, STEPS, seed=1)
        ):
            found = trial.repair()
            return found if found.largest < MAX_DEVIATION else None
    all_moved = repair(graph, 2.0 * float(sizes[rank]))
    return all_moved if all_moved and all_moved.largest < MAX_DEVIATION else None


def _solve_truncated(rank: int, table: Array, value: Array) -> Array:
    """Solve table x = -value in each position, using only the largest ``rank`` singular values."""
    left, sizes, rows = np.linalg.svd(table, full_matrices=False)
    parts = np.einsum("kir,ki->kr", left[:, :, :rank], -value) / sizes[:, :rank]
    return np.asarray(np.einsum("krj,kr->kj", rows[:, :rank], parts), np.float64)


class _Loops:
    """A graph whose axes and points may be moved, with the equations of its joints and rods."""

    def __init__(self, graph: Graph) -> None:
        self.first = self.graph = graph
        self.bodies = len(graph.bodies)

    @property
    def slots(self) -> list[Slot]:
        """Keys of all points and directions of the graph."""
        graph = self.graph
        found: list[Slot] = []
        for joint in graph.joints.values():
            found.append(("at", joint.name, 0))
            found += [("axis", joint.name, k) for k in range(len(joint.axes))]
        return found + [("end", name, k) for name in graph.rods for k in range(2)]

    def sample_positions(self, rank: int, count: int, steps: int, seed: int = 0) -> Placement:
        """Draw positions that the machine can reach from home.

        :param rank: of the equations; smaller singular values constrain nothing. ``count``: number
            of positions. ``steps``: number of steps to each, of POSITION_RADIUS / STEPS.
        """
        placed = Placement.at_home(self.graph, (count,))
        way: Array = np.random.default_rng(seed).normal(size=(count, 6 * self.bodies))
        for _ in range(steps):
            free = np.linalg.svd(self.equations(placed)[1])[2][:, rank:]
            way = np.einsum("kfi,kfj,kj->ki", free, free, way)
            way /= np.abs(way).max(axis=1, keepdims=True, initial=1e-300)
            placed = placed.moved(POSITION_RADIUS / STEPS * way)
            solve = partial(_solve_truncated, rank)
            placed, _ = newton(
                placed, self.equations, Placement.moved, solve, iterations=MAX_CORRECTIONS, tolerance=MAX_OPENING
            )
        return placed

    def singular_values(self, positions: Placement) -> Array:
        """Return the singular values of the equations' Jacobian in each position, shape (k, n)."""
        table = self.equations(positions)[1]
        return np.asarray(np.linalg.svd(table, compute_uv=False), np.float64)

    def are_exact(self, rank: int, positions: Placement) -> bool:
        """Return whether all loops are closed, and the Jacobian has this rank, in all positions."""
        miss = np.abs(self.equations(positions)[0]).max(initial=0.0)
        return bool(miss < MAX_OPENING and (self.singular_values(positions)[:, rank:] < MAX_ZERO_SINGULAR_VALUE).all())

    def measure_openings(self, rank: int, positions: Placement) -> tuple[Array, dict[Slot, Array], float]:
        """Return the gaps that no motion of the bodies can close, with derivatives by the vectors.

        :returns: gaps, shape (k,); derivatives by each vector, (k, 3); the relative bound below
            which their singular values are noise.
        """
        value, table = self.equations(positions)
        left, sizes, _ = np.linalg.svd(table)
        left = left[:, :, rank:].transpose(0, 2, 1)
        effect = (left @ self.vector_derivatives(positions)).reshape(-1, 3 * len(self.slots))
        gap = np.einsum("kfi,ki->kf", left, value).ravel()
        noise = min(
            MAX_RELATIVE_NOISE, NOISE_FACTOR * max(MAX_ZERO_SINGULAR_VALUE, float(sizes[:, rank:].max(initial=0.0)))
        )
        return gap, {s: effect[:, 3 * k : 3 * k + 3] for k, s in enumerate(self.slots)}, noise

    def close(self, rank: int, positions: Placement, slots: Sequence[Slot] | None = None) -> bool:
        """Move vectors as little as possible until all loops close; return whether they do.

        :param slots: keys of the vectors that may move; by default all.
        """
        placed, last = positions, np.inf
        for _ in range(MAX_ROUNDS):
            value, table = self.equations(placed)
            miss = float(np.abs(value).max(initial=0.0))
            if miss < 0.1 * MAX_OPENING or miss > 0.5 * last:
                break
            vector_derivatives = self.vector_derivatives(placed)
            gap, effect, noise = self.measure_openings(rank, placed)
            allowed = [effect[s] * (slots is None or s in slots) for s in effect]
            step = np.linalg.lstsq(np.hstack(allowed), gap, rcond=noise)[0]
            change = np.asarray(-step, np.float64)
            self.move_vectors(change)
            placed = placed.moved(_solve_truncated(rank, table, value + vector_derivatives @ change))
            last = miss
        return miss < MAX_OPENING

    def move_vectors(self, change: Array) -> None:
        """Add changes (3 vectors,) to the vectors of the graph; axes stay of length one."""
        parts = dict(zip(self.slots, change.reshape(-1, 3), strict=True))
        graph = self.graph

        def move(kind: str, name: str, vectors: Array) -> Array:
            moves = [parts[kind, name, k] for k in range(len(vectors))]
            moved = vectors + np.reshape(moves, vectors.shape) * (1.0 if kind == "axis" else self.first.size)
            lengths = np.linalg.norm(moved, axis=-1, keepdims=True) if kind == "axis" else 1.0
            return array(moved / lengths)

        joints = {
            n: replace(j, at=move("at", n, j.at[None])[0], axes=move("axis", n, j.axes))
            for n, j in graph.joints.items()
        }
        rods = {n: replace(r, ends=move("end", n, r.ends)) for n, r in graph.rods.items()}
        self.graph = replace(graph, joints=joints, rods=rods)

    def repair(self) -> Repair:
        """Return the present graph, and how far its vectors were moved."""
        first, size = self.first, self.first.size
        moves: dict[str, float] = {}
        for name, joint in self.graph.joints.items():
            old = first.joints[name]
            gone = np.array([*(joint.axes - old.axes), (joint.at - old.at) / size])
            moves[name] = float(np.linalg.norm(gone, axis=-1).max())
        for name, rod in self.graph.rods.items():
            gone = (rod.ends - first.rods[name].ends) / size
            moves[name] = max(float(np.linalg.norm(gone, axis=-1).max()), moves.get(name, 0.0))
        return Repair(self.graph, moves)

    def equations(self, placed: Placement) -> tuple[Array, Array]:
        """Return the values of all equations, (k, rows), and their derivatives by the coordinates."""
        found = [one for _, one in self._equations(placed)]
        return placed.values(found), placed.jacobian(found)

    def _equations(self, placed: Placement) -> list[tuple[list[_Frame], Equation]]:
        """Return the dimensionless equations, each with its frames on both bodies."""
        found: list[tuple[list[_Frame], Equation]] = []
        size = placed.size
        for joint in self.graph.joints.values():
            a, b, name = joint.inner, joint.outer, joint.name
            points = placed.point(a, joint.at), placed.point(b, joint.at)
            turns = partial(rotate, placed.body_rotation(a)), partial(rotate, placed.body_rotation(b))
            for key in joint.type.holds:
                for constraint in CONSTRAINTS[key](joint.axes, joint.pitch):
                    frames = [_Frame(("at", name, 0), joint.at)] * 2
                    if key not in ("point", "turns"):
                        frames = [
                            frame._replace(tilt=("axis", name, k), axis=joint.axes[k])
                            for frame, k in zip(frames, constraint.axes, strict=True)
                        ]
                    for one in constraint_equations(
                        joint.name, (joint.inner, joint.outer), constraint, points, turns, size
                    ):
                        found.append((frames, one))
        for rod in self.graph.rods.values():
            start, end = rod.ends
            points = placed.point(rod.inner, start), placed.point(rod.outer, end)
            square = float((end - start) @ (end - start))
            frames = [_Frame(("end", rod.name, k), point) for k, point in enumerate(rod.ends)]
            one = distance_equation(rod.name, (rod.inner, rod.outer), points, square, size)
            found.append((frames, one))
        return found

    def vector_derivatives(self, placed: Placement) -> Array:
        """Return derivatives of the equations' values by the vectors, (k, rows, 3 vectors).

        A vector moves the frames on both bodies. The equations are satisfied at home with every
        vector, so the derivative there is subtracted.
        """
        columns = {slot: 3 * k for k, slot in enumerate(self.slots)}
        home = Placement.at_home(self.graph, (1,))
        equations = self._equations(placed), self._equations(home)
        total = np.zeros((len(placed.shift), len(equations[0]), 3 * len(columns)))
        for where, found, sign in zip((placed, home), equations, (1.0, -1.0), strict=True):
            for i, (frames, one) in enumerate(found):
                for side, frame in enumerate(frames):
                    turn, point = (
                        where.body_rotation(one.bodies[side]),
                        where.point(one.bodies[side], frame.point),
                    )
                    shift, tilt = differentiate_by_frame(one, side, point, turn)
                    k = columns[frame.slot]
                    total[:, i, k : k + 3] += sign * where.size * shift
                    if frame.tilt is not None and frame.axis is not None:
                        # A change d of an axis rotates the frame by axis x d.
                        k = columns[frame.tilt]
                        total[:, i, k : k + 3] += sign * np.cross(tilt, frame.axis)
        return total
