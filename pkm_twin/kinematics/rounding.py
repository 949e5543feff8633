# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Axes and points that a file's rounding has moved off a machine that closes its loops.

An overconstrained machine moves only while its axes and points fit each other exactly: axes that
meet in one point, are parallel or lie in a plane, bars of one length. Rounded numbers break that,
and the machine loses freedoms. Which relation it was need not be known: all loops must close, not
only at home but in other positions too. The numbers are moved by least changes until they do
(Gauss and Newton with the least norm), in positions that the machine reaches with the rank that it
has where singular values below the file's precision count as zero.

Bodies move by six coordinates each; every joint and rod is equations between two of them. Lengths
are parts of the machine's size, angles are in rad.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.machine.graph import BASE, Graph, Joint, Rod, array
from pkm_twin.machine.joints import across
from pkm_twin.machine.rotations import about, skew

CHAIN: Final = 20.0
"""How far rounding may move a body or open a loop, rounding errors: a loop is a chain of places."""
MAX_ROUNDING: Final = 1e-4
"""Deviation of axes and points that no file's rounding exceeds, rad or parts of the size."""
POSITIONS: Final = (8, 24, 72)
"""Positions in which the loops are closed: more conditions than a machine has numbers."""
CHECKED: Final = 3
"""Other positions in which the loops must then close too."""
REACH: Final = 0.4
"""How far from home the positions are: the largest motion of a body, rad or parts of the size."""
STEPS: Final = 4
"""Steps on the way to a position."""
CORRECTIONS: Final = 6
"""Most corrections of a step."""
ROUNDS: Final = 12
"""Most rounds of moving numbers."""
CLOSED: Final = 1e-13
"""Loops that are open by less are closed, rad or parts of the size."""
EXACT: Final = 1e-10
"""Singular values below this are zero but for the computer's own rounding."""
NOISE: Final = 100.0
"""Part of the largest effect of numbers on the loops below which one comes from rounding: this many
times the largest singular value that should be zero."""
MAX_NOISE: Final = 1e-2
"""Most of that part: NOISE times MAX_ROUNDING."""
MAX_DEVIATION: Final = 3e-2
"""Largest deviation of an axis or point that is taken for an error and not for the design, rad or
parts of the machine's size."""
MOST_MOVED: Final = 6
"""Most vectors that are chosen one by one."""

Slot = tuple[str, str, int]
"""A vector of the graph: ``at`` or ``axis`` of a joint, or ``end`` of a rod, and which."""


class _Equation(NamedTuple):
    """Equations between two bodies in all positions, and their derivatives by what moves.

    ``value``: shape (k, m). ``bodies``: by body those by its translation and rotation, shape
    (k, m, 3) each. ``slots``: those by vectors of the graph.
    """

    value: Array
    bodies: dict[int, tuple[Array, Array]]
    slots: dict[Slot, Array]


@dataclass(frozen=True, eq=False)
class Repair:
    """A graph whose loops close in all positions; ``moves``: by joint or rod how far it was moved.

    Moves are in rad or parts of the machine's size.
    """

    graph: Graph
    moves: dict[str, float]

    @property
    def largest(self) -> float:
        """The largest move, rad or parts of the size."""
        return max(self.moves.values(), default=0.0)

    @property
    def text(self) -> str:
        """What was done, in words."""
        return (
            f"axes and points were moved by up to {self.largest:.1g} (rad, or parts of the "
            "machine's size), so that the machine can move: the file is rounded"
        )


def repair_rounded(graph: Graph, rounding: float, least: float = 0.0) -> Repair | None:
    """Repair a graph whose file has rounding errors, rad or m, as :func:`repair` does.

    :param least: deviation that counts as rounding in any file, rad or parts of the size.
    :returns: None where no change within the file's precision gives the freedoms.
    """
    precision = min(MAX_ROUNDING, max(least, CHAIN * rounding / min(1.0, graph.size)))
    found = repair(graph, precision)
    return found if found is not None and found.largest <= precision else None


def repair(graph: Graph, precision: float) -> Repair | None:
    """Move axes and points by least changes, so that the machine has its freedoms exactly.

    :param precision: singular values of the closures below this come from the file's rounding, rad
        or parts of the machine's size.
    :returns: the graph and its moves, none where no singular value is that small but not zero; None
        where no small change gives the freedoms, or home is a singularity.
    """
    loops = _Loops(graph)
    sizes = np.linalg.svd(loops.equations(*loops.home(1))[1][0], compute_uv=False)
    rank = int((sizes > precision).sum())
    # Rounding may show at home or only beside it.
    if loops.are_exact(rank, loops.walk(rank, 2, 1)) and not (sizes[rank:] > EXACT).any():
        return Repair(graph, {})
    for count in POSITIONS:
        loops = _Loops(graph)
        positions = loops.walk(rank, count, STEPS)
        if (loops.sizes(positions) > precision).sum(1).max() > rank:
            return None
        if not loops.close(rank, positions):
            return None
        # Few positions can close by numbers that fit these alone.
        if loops.are_exact(rank, loops.walk(rank, CHECKED, STEPS, seed=1)):
            return loops.repair()
    return None


def repair_few(graph: Graph, freedoms: int) -> Repair | None:
    """Move as few axes and points as possible, so that a machine that lost freedoms has them.

    Vectors are chosen one by one, each the one whose change leaves the loops least open: orthogonal
    matching pursuit (Pati, Rezaiifar and Krishnaprasad 1993). Where MOST_MOVED do not close the
    loops, all are moved as by :func:`repair`.

    :param freedoms: degrees of freedom that the machine should have.
    :returns: None if the machine has them, or if no change within MAX_DEVIATION gives them.
    """
    loops = _Loops(graph)
    rank = 6 * loops.bodies - freedoms
    sizes = np.linalg.svd(loops.equations(*loops.home(1))[1][0], compute_uv=False)
    if not 0 < rank < len(sizes) or sizes[rank] > MAX_DEVIATION:
        return None
    positions = loops.walk(rank, POSITIONS[1], STEPS)
    gap, effect, noise = loops.openings(rank, positions)
    chosen: list[Slot] = []
    basis = np.zeros((len(gap), 0))
    for _ in range(MOST_MOVED):
        best, least = None, float(np.linalg.norm(gap)) * (1.0 - 1e-6)
        for slot, columns in effect.items():
            apart = columns - basis @ (basis.T @ columns)
            left, strength, _ = np.linalg.svd(apart, full_matrices=False)
            own = left[:, strength > noise]
            rest = gap - own @ (own.T @ gap)
            # Of vectors that do the same the first is taken.
            if float(np.linalg.norm(rest)) < least * (1.0 - 1e-6):
                best, least, remaining, added = slot, float(np.linalg.norm(rest)), rest, own
        if best is None:
            break
        chosen.append(best)
        gap, basis = remaining, np.hstack([basis, added])
        trial = _Loops(graph)
        if trial.close(rank, positions, chosen) and trial.are_exact(
            rank, trial.walk(rank, CHECKED, STEPS, seed=1)
        ):
            found = trial.repair()
            return found if found.largest < MAX_DEVIATION else None
    all_moved = repair(graph, 2.0 * float(sizes[rank]))
    return all_moved if all_moved and all_moved.largest < MAX_DEVIATION else None


def _least(table: Array, value: Array, rank: int) -> Array:
    """Solve table x = value in all positions with the largest ``rank`` singular values alone."""
    left, sizes, rows = np.linalg.svd(table, full_matrices=False)
    parts = np.einsum("kir,ki->kr", left[:, :, :rank], value) / sizes[:, :rank]
    return np.asarray(np.einsum("krj,kr->kj", rows[:, :rank], parts), np.float64)


def _moved(rotation: Array, place: Array, change: Array) -> tuple[Array, Array]:
    """Bodies after a small motion of each: of its points, and about the origin, (k, 6 bodies)."""
    each = change.reshape(len(change), -1, 6)
    angle = np.linalg.norm(each[..., 3:], axis=-1)
    new, at = rotation.copy(), place.copy()
    for k, j in np.ndindex(*angle.shape):
        if angle[k, j] > 0.0:
            turn = about(each[k, j, 3:] / angle[k, j], angle[k, j])
            new[k, j + 1] = turn @ rotation[k, j + 1]
            at[k, j + 1] = turn @ place[k, j + 1]
        at[k, j + 1] += each[k, j, :3]
    return new, at


class _Loops:
    """The joints and rods of a graph as equations between its bodies, in parts of its size."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self._number = {name: k for k, name in enumerate((BASE, *graph.bodies))}
        self.bodies = len(graph.bodies)
        self._scale, self._middle = graph.size, graph.origin
        self._vectors: dict[Slot, Array] = {}
        for joint in graph.joints.values():
            self._vectors["at", joint.name, 0] = (joint.at - self._middle) / self._scale
            for k, axis in enumerate(joint.axes):
                self._vectors["axis", joint.name, k] = axis
        for rod in graph.rods.values():
            for k, end in enumerate(rod.ends):
                self._vectors["end", rod.name, k] = (end - self._middle) / self._scale
        self._first = dict(self._vectors)

    def home(self, count: int) -> tuple[Array, Array]:
        """Rotations and places of all bodies at home, the ground too, ``count`` times."""
        shape = (count, self.bodies + 1)
        return np.tile(np.eye(3), (*shape, 1, 1)), np.zeros((*shape, 3))

    def walk(self, rank: int, count: int, steps: int, seed: int = 0) -> tuple[Array, Array]:
        """Rotations and places of all bodies in positions that the machine can move to from home.

        :param rank: of the equations; smaller singular values are no constraints. ``count``: of
            positions. ``steps``: towards each, of REACH in STEPS.
        """
        rotation, place = self.home(count)
        way: Array = np.random.default_rng(seed).normal(size=(count, 6 * self.bodies))
        for _ in range(steps):
            free = np.linalg.svd(self.equations(rotation, place)[1])[2][:, rank:]
            way = np.einsum("kfi,kfj,kj->ki", free, free, way)
            way /= np.abs(way).max(axis=1, keepdims=True, initial=1e-300)
            rotation, place = _moved(rotation, place, REACH / STEPS * way)
            last = np.inf
            for _ in range(CORRECTIONS):
                value, table, _ = self.equations(rotation, place)
                miss = float(np.abs(value).max(initial=0.0))
                if miss < CLOSED or miss > 0.5 * last:
                    break
                rotation, place = _moved(rotation, place, -_least(table, value, rank))
                last = miss
        return rotation, place

    def sizes(self, positions: tuple[Array, Array]) -> Array:
        """Singular values of the equations by the bodies' motions, shape (k, n)."""
        table = self.equations(*positions)[1]
        return np.asarray(np.linalg.svd(table, compute_uv=False), np.float64)

    def are_exact(self, rank: int, positions: tuple[Array, Array]) -> bool:
        """Return whether all loops are closed, and the equations have that rank."""
        miss = np.abs(self.equations(*positions)[0]).max(initial=0.0)
        return bool(miss < CLOSED and (self.sizes(positions)[:, rank:] < EXACT).all())

    def openings(
        self, rank: int, positions: tuple[Array, Array]
    ) -> tuple[Array, dict[Slot, Array], float]:
        """Return how far loops stay open whatever the bodies do, and its change by the vectors.

        :returns: openings, shape (k,); derivatives by each vector, (k, 3); the bound below which
            a singular value of these is noise.
        """
        value, table, by_numbers = self.equations(*positions)
        left, sizes, _ = np.linalg.svd(table)
        left = left[:, :, rank:].transpose(0, 2, 1)
        effect = (left @ by_numbers).reshape(-1, by_numbers.shape[2])
        gap = np.einsum("kfi,ki->kf", left, value).ravel()
        noise = min(MAX_NOISE, NOISE * max(EXACT, float(sizes[:, rank:].max(initial=0.0))))
        return gap, {s: effect[:, 3 * k : 3 * k + 3] for k, s in enumerate(self._vectors)}, noise

    def close(
        self, rank: int, positions: tuple[Array, Array], slots: Sequence[Slot] | None = None
    ) -> bool:
        """Move vectors by least changes until all loops close in all positions, if they can.

        :param slots: the vectors that may move; by default all.
        """
        rotation, place = positions
        last = np.inf
        for _ in range(ROUNDS):
            value, table, by_numbers = self.equations(rotation, place)
            miss = float(np.abs(value).max(initial=0.0))
            if miss < 0.1 * CLOSED or miss > 0.5 * last:
                break
            gap, effect, noise = self.openings(rank, (rotation, place))
            allowed = [effect[s] * (slots is None or s in slots) for s in effect]
            step = np.linalg.lstsq(np.hstack(allowed), gap, rcond=noise)[0]
            change = np.asarray(-step, np.float64)
            self.change(change)
            closing = _least(table, value + by_numbers @ change, rank)
            rotation, place = _moved(rotation, place, -closing)
            last = miss
        return miss < CLOSED

    def change(self, change: Array) -> None:
        """Move all vectors of the graph; axes stay of length one."""
        for k, (slot, vector) in enumerate(self._vectors.items()):
            moved = vector + change[3 * k : 3 * k + 3]
            self._vectors[slot] = moved / np.linalg.norm(moved) if slot[0] == "axis" else moved

    def repair(self) -> Repair:
        """The graph with the vectors as they are, and how far they were moved."""
        moves: dict[str, float] = {}
        for slot, vector in self._vectors.items():
            gone = float(np.linalg.norm(vector - self._first[slot]))
            moves[slot[1]] = max(gone, moves.get(slot[1], 0.0))

        def place(kind: str, name: str, count: int) -> Array:
            found = [self._vectors[kind, name, k] for k in range(count)]
            if kind == "axis":
                return array(np.reshape(found, (-1, 3)))
            return array(np.array(found) * self._scale + self._middle)

        graph = self.graph
        joints = {
            n: replace(j, at=place("at", n, 1)[0], axes=place("axis", n, len(j.axes)))
            for n, j in graph.joints.items()
        }
        rods = {n: replace(r, ends=place("end", n, 2)) for n, r in graph.rods.items()}
        return Repair(replace(graph, joints=joints, rods=rods), moves)

    def equations(self, rotation: Array, place: Array) -> tuple[Array, Array, Array]:
        """Values of all equations, and derivatives by the bodies' motions and by the vectors.

        Shapes (k, rows), (k, rows, 6 bodies) and (k, rows, 3 vectors).
        """
        found = [
            one
            for joint in self.graph.joints.values()
            for one in self._joint(joint, rotation, place)
        ]
        found += [self._rod(rod, rotation, place) for rod in self.graph.rods.values()]
        value = np.concatenate([one.value for one in found], axis=1)
        by_bodies = np.zeros((*value.shape, 6 * (self.bodies + 1)))
        by_numbers = np.zeros((*value.shape, 3 * len(self._vectors)))
        columns = {slot: 3 * k for k, slot in enumerate(self._vectors)}
        row = 0
        for one in found:
            rows = slice(row, row := row + one.value.shape[1])
            for body, (slide, turn) in one.bodies.items():
                by_bodies[:, rows, 6 * body : 6 * body + 3] += slide
                by_bodies[:, rows, 6 * body + 3 : 6 * body + 6] += turn
            for slot, table in one.slots.items():
                by_numbers[:, rows, columns[slot] : columns[slot] + 3] += table
        return value, by_bodies[:, :, 6:], by_numbers

    def _joint(self, joint: Joint, rotation: Array, place: Array) -> Iterator[_Equation]:
        """What a joint holds."""
        a, b = self._number[joint.inner], self._number[joint.outer]
        turned, name = (rotation[:, a], rotation[:, b]), joint.name
        at, slot = self._vectors["at", name, 0], ("at", name, 0)
        xa, xb = turned[0] @ at + place[:, a], turned[1] @ at + place[:, b]
        one = np.broadcast_to(np.eye(3), (len(rotation), 3, 3))
        apart = _Equation(
            xb - xa, {a: (-one, skew(xa)), b: (one, -skew(xb))}, {slot: turned[1] - turned[0]}
        )

        def same(vector: Array, slots: tuple[Slot, ...]) -> _Equation:
            """A vector is the same one in both bodies."""
            va, vb, none = turned[0] @ vector, turned[1] @ vector, 0.0 * one
            by = dict.fromkeys(slots, turned[1] - turned[0])
            return _Equation(vb - va, {a: (none, skew(va)), b: (none, -skew(vb))}, by)

        axes = [self._vectors["axis", name, k] for k in range(len(joint.axes))]
        first = ("axis", name, 0)
        for held in joint.type.holds:
            if held == "point":
                yield apart
            elif held == "turns":
                yield from (same(vector, ()) for vector in np.eye(3)[:2])
            elif held == "direction":
                yield same(axes[0], (first,))
            elif held == "crossing":
                u, v = turned[0] @ axes[0], turned[1] @ axes[1]
                turn, none = np.cross(u, v)[:, None], np.zeros((len(u), 1, 3))
                yield _Equation(
                    np.einsum("ki,ki->k", u, v)[:, None] - axes[0] @ axes[1],
                    {a: (none, turn), b: (none, -turn)},
                    {
                        first: (v[:, None] @ turned[0]) - axes[1],
                        ("axis", name, 1): (u[:, None] @ turned[1]) - axes[0],
                    },
                )  # fmt: skip
            else:
                yield self._along(joint, held, apart, turned, axes[0])

    def _along(
        self, joint: Joint, held: str, apart: _Equation, turned: tuple[Array, Array], axis: Array
    ) -> _Equation:
        """What a joint holds of how far its bodies are apart along or across its axis."""
        a, b = self._number[joint.inner], self._number[joint.outer]
        u, gap = turned[0] @ axis, apart.value
        if held == "line":
            value, by_gap, by_axis = np.cross(gap, u), -skew(u), skew(gap)
        else:  # flat and thread
            value = np.einsum("ki,ki->k", u, gap)[:, None]
            by_gap, by_axis = u[:, None], gap[:, None]
        bodies = {body: (by_gap @ s, by_gap @ w) for body, (s, w) in apart.bodies.items()}
        bodies[a] = bodies[a][0], bodies[a][1] - by_axis @ skew(u)
        slots = {slot: by_gap @ table for slot, table in apart.slots.items()}
        slots["axis", joint.name, 0] = by_axis @ turned[0]
        if held == "thread":
            pitch = joint.pitch / self._scale
            f, g = (part @ across(axis)[0] for part in turned)
            angle = np.arctan2(
                np.einsum("ki,ki->k", u, np.cross(f, g)), np.einsum("ki,ki->k", f, g)
            )
            value = value - pitch * angle[:, None]
            bodies[a] = bodies[a][0], bodies[a][1] + pitch * u[:, None]
            bodies[b] = bodies[b][0], bodies[b][1] - pitch * u[:, None]
        return _Equation(value, bodies, slots)

    def _rod(self, rod: Rod, rotation: Array, place: Array) -> _Equation:
        """The ends keep their distance."""
        a, b = self._number[rod.inner], self._number[rod.outer]
        slots: list[Slot] = [("end", rod.name, k) for k in range(2)]
        start, end = (self._vectors[slot] for slot in slots)
        xa, xb = rotation[:, a] @ start + place[:, a], rotation[:, b] @ end + place[:, b]
        gap, length = xb - xa, float(np.linalg.norm(end - start))
        n, drawn = gap[:, None] / length, (end - start) / length
        value = 0.5 * (np.einsum("ki,ki->k", gap, gap) - length**2)[:, None] / length
        return _Equation(
            value, {a: (-n, n @ skew(xa)), b: (n, -n @ skew(xb))},
            {slots[0]: drawn - n @ rotation[:, a], slots[1]: n @ rotation[:, b] - drawn},
        )  # fmt: skip
