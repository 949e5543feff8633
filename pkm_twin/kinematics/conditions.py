# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Conditions among the axes and points of a machine at home that its mobility may depend on.

Parallel and perpendicular axes, axes and ball joints that meet, bars of one length and direction:
an overconstrained machine moves only while they hold. Found are those that hold within a tolerance,
among joints of one body, and :func:`idealized` makes them hold exactly by least changes.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.machine.graph import BASE, Graph, Joint, Rod, array, groups
from pkm_twin.machine.joints import unit
from pkm_twin.machine.rotations import skew

EXACT: Final = 1e-12
"""What deviates by less holds, rad or parts of the machine's size."""
_ROUNDS: Final = 8
_APART: Final = 0.05
"""Sine of the angle from which on two axes have a point where they meet."""
_POINTS: Final = ("spherical", "universal")
_LINES: Final = ("revolute", "universal", "cylindrical", "helical")

Slot = tuple[str, str, int]
"""A vector of the graph: ``at`` or ``axis`` of a joint, or ``end`` of a rod, and which."""
Sum = tuple[tuple[Slot, float], ...]
"""A sum of vectors with factors."""


@dataclass(frozen=True, eq=False)
class Condition:
    """One condition: ``text`` says how far it is from holding, by ``deviation`` (rad or m).

    ``parts``: the joints and rods. ``form``: ``"zero"``, or the product of the two sums that is
    zero, ``"cross"`` or ``"dot"``; empty where it is of no such form. ``size``: of the deviation,
    angles and parts of the machine's size alike.
    """

    text: str
    parts: tuple[str, ...]
    deviation: float
    size: float
    form: str = ""
    left: Sum = ()
    right: Sum = ()


@dataclass(frozen=True, eq=False)
class _Axis:
    """An axis of a joint, or of the base for a translation, whose direction is never changed."""

    name: str
    label: str
    slot: Slot
    vector: Array
    bodies: frozenset[str]
    line: bool
    fixed: bool = False


@dataclass(frozen=True, eq=False)
class _Bar:
    """What connects two bodies by two joints: a rod, or a body of no other joint."""

    name: str
    ends: tuple[Slot, Slot]
    bodies: tuple[str, str]
    axes: tuple[Slot, ...] = ()


class Conditions:
    """The conditions of a graph that hold within a tolerance: radians, and parts of its size."""

    def __init__(self, graph: Graph, tolerance: float) -> None:
        self.graph, self.tolerance = graph, tolerance
        self._root = merged(graph)
        self._vectors = _vectors(graph)
        self._axes = self._find_axes()
        self._length = tolerance * graph.size
        self.found: list[Condition] = []
        self._direction: dict[Slot, Slot] = {}
        self._parallel()
        self._perpendicular()
        self._meeting()
        self._bars()

    def _body(self, name: str) -> str:
        return self._root[name]

    def _find_axes(self) -> list[_Axis]:
        axes = []
        for joint in self.graph.joints.values():
            bodies = frozenset((self._body(joint.inner), self._body(joint.outer)))
            for k, vector in enumerate(joint.axes):
                which = f"axis {k + 1}" if len(joint.axes) > 1 else "axis"
                axes.append(
                    _Axis(
                        joint.name, f"{joint.name}'s {which}", ("axis", joint.name, k),
                        unit(vector), bodies, joint.kind in _LINES,
                    )
                )  # fmt: skip
            if joint.kind == "translation":
                axes += [
                    _Axis(
                        joint.name, f"base {letter}", ("base", letter, k), np.eye(3)[k], bodies,
                        False, True,
                    )
                    for k, letter in enumerate("xyz")
                ]  # fmt: skip
        return axes

    def _add(
        self, text: str, parts: Iterable[str], deviation: float, size: float, form: str,
        left: Sum, right: Sum = (),
    ) -> None:  # fmt: skip
        names = tuple(dict.fromkeys(parts))
        self.found.append(Condition(text, names, deviation, size, form, left, right))

    def _parallel(self) -> None:
        """Axes of one direction, each group by the direction that most of them have."""
        alike = [
            (i, j)
            for (i, a), (j, b) in combinations(enumerate(self._axes), 2)
            if a.bodies & b.bodies and _sine(a.vector, b.vector) < self.tolerance
        ]
        for members in groups(range(len(self._axes)), alike):
            axes = [self._axes[i] for i in members]
            lead = max(
                axes,
                key=lambda a: (
                    a.fixed, sum(_sine(a.vector, b.vector) < EXACT for b in axes)
                ),
            )  # fmt: skip
            for axis in axes:
                self._direction[axis.slot] = lead.slot
                if axis is not lead and not axis.fixed:
                    angle = _sine(axis.vector, lead.vector)
                    self._add(
                        f"{axis.label} is {angle:.2g} rad from parallel to {lead.label}",
                        (axis.name, lead.name), angle, angle, "cross", _one(axis.slot),
                        _one(lead.slot),
                    )  # fmt: skip

    def _perpendicular(self) -> None:
        seen = set()
        for a, b in combinations(self._axes, 2):
            pair = frozenset((self._direction[a.slot], self._direction[b.slot]))
            lean = abs(float(a.vector @ b.vector))
            if not a.bodies & b.bodies or lean >= self.tolerance or pair in seen:
                continue
            seen.add(pair)
            if not (a.fixed and b.fixed):
                self._add(
                    f"{a.label} is {lean:.2g} rad from perpendicular to {b.label}",
                    (a.name, b.name), lean, lean, "dot", _one(a.slot), _one(b.slot),
                )  # fmt: skip

    def _meeting(self) -> None:
        """Axes that are one line, and what goes through one point."""
        graph = self.graph
        lines = [a for a in self._axes if a.line]
        balls = [
            (j.name, ("at", j.name, 0), frozenset((self._body(j.inner), self._body(j.outer))))
            for j in graph.joints.values()
            if j.kind in _POINTS
        ]
        at = {a.slot: self._vectors["at", a.name, 0] for a in lines}
        events: list[tuple[list[int], Array]] = []
        for (i, a), (j, b) in combinations(enumerate(lines), 2):
            if a.name == b.name or not a.bodies & b.bodies:
                continue
            apart = at[b.slot] - at[a.slot]
            if self._direction[a.slot] == self._direction[b.slot]:
                gap = float(np.linalg.norm(np.cross(apart, a.vector)))
                if gap < self._length:
                    self._add(
                        f"{b.label} misses {a.label} by {_millimetres(gap)}",
                        (b.name, a.name), gap, gap / graph.size, "cross",
                        (*_one(("at", b.name, 0)), (("at", a.name, 0), -1.0)), _one(a.slot),
                    )  # fmt: skip
            elif _sine(a.vector, b.vector) > _APART:
                place, gap = _crossing(at[a.slot], a.vector, at[b.slot], b.vector)
                if gap < self._length and np.linalg.norm(place - graph.origin) < 10 * graph.size:
                    events.append(([i, j], place))
        for k, (name, slot, bodies) in enumerate(balls, len(lines)):
            place = self._vectors[slot]
            for i, a in enumerate(lines):
                if a.name != name and a.bodies & bodies:
                    gap = float(np.linalg.norm(np.cross(place - at[a.slot], a.vector)))
                    if gap < self._length:
                        events.append(([k, i], place))
            for m, (_, other, others) in enumerate(balls[: k - len(lines)], len(lines)):
                if bodies & others:
                    gap = float(np.linalg.norm(place - self._vectors[other]))
                    if gap < self._length:
                        events.append(([k, m], place))
        self._add_points(events, lines, balls)

    def _add_points(
        self, events: list[tuple[list[int], Array]], lines: list[_Axis],
        balls: list[tuple[str, Slot, frozenset[str]]],
    ) -> None:  # fmt: skip
        """What goes through one point goes through the place where most of it meets exactly."""
        near = [
            (m, n)
            for (m, (a, x)), (n, (b, y)) in combinations(enumerate(events), 2)
            if set(a) & set(b) and np.linalg.norm(x - y) < 3 * self._length / _APART
        ]
        for number, members in enumerate(groups(range(len(events)), near)):
            elements = list(dict.fromkeys(i for m in members for i in events[m][0]))
            gaps = {
                m: [self._gap(events[m][1], i, lines, balls) for i in elements] for m in members
            }
            exact = EXACT * self.graph.size
            best = max(members, key=lambda m: (sum(g < exact for g in gaps[m]), -sum(gaps[m])))
            point: Slot = ("point", str(number), 0)
            self._vectors[point] = events[best][1]
            names = [
                lines[i].name if i < len(lines) else balls[i - len(lines)][0] for i in elements
            ]
            good = [n for n, g in zip(names, gaps[best], strict=True) if g < exact] or names
            for i, name, gap in zip(elements, names, gaps[best], strict=True):
                # Where two lines nearly touch is less certain than how far another is from there.
                if gap > 3 * self._length:
                    continue
                met = list(dict.fromkeys(n for n in good if n != name)) or [name]
                others = ", ".join(met[:2]) + (f" and {len(met) - 2} more" if len(met) > 2 else "")
                if i < len(lines):
                    line = lines[i]
                    text = f"{line.label} misses the point of {others} by {_millimetres(gap)}"
                    form, right = "cross", _one(line.slot)
                    left: Sum = ((point, 1.0), (("at", line.name, 0), -1.0))
                else:
                    text = f"{name} misses the point of {others} by {_millimetres(gap)}"
                    form, right = "zero", ()
                    left = ((point, 1.0), (balls[i - len(lines)][1], -1.0))
                self._add(text, (name, *met), gap, gap / self.graph.size, form, left, right)

    def _gap(
        self, place: Array, element: int, lines: list[_Axis],
        balls: list[tuple[str, Slot, frozenset[str]]],
    ) -> float:  # fmt: skip
        if element < len(lines):
            line = lines[element]
            apart = place - self._vectors["at", line.name, 0]
            return float(np.linalg.norm(np.cross(apart, line.vector)))
        return float(np.linalg.norm(place - self._vectors[balls[element - len(lines)][1]]))

    def _bars(self) -> None:
        """Bars side by side, of one length and direction; and their ends beside an axis."""
        for a, b in combinations(self._find_bars(), 2):
            if frozenset(a.bodies) != frozenset(b.bodies):
                continue
            other = b if b.bodies == a.bodies else _Bar(b.name, b.ends[::-1], a.bodies, b.axes)
            difference = (*_span(a), *((slot, -f) for slot, f in _span(other)))
            value = self._value(difference)
            directions = {self._direction.get(slot, slot) for slot in (*a.axes, *b.axes)}
            form, right = "zero", Sum(())
            if len(a.axes) == len(b.axes) == 2 and len(directions) == 1:
                # Hinges of one direction: along it a bar may stand where it likes.
                (direction,) = directions
                value = np.cross(value, self._vectors[direction])
                form, right = "cross", _one(direction)
            gap = float(np.linalg.norm(value))
            if gap < self._length:
                self._add(
                    f"the end of {b.name} misses a parallelogram with {a.name} by "
                    f"{_millimetres(gap)}",
                    (b.name, a.name), gap, gap / self.graph.size, form, difference, right,
                )  # fmt: skip
            for slots in zip(a.ends, other.ends, strict=True):
                self._beside(a, other, slots)

    def _beside(self, a: _Bar, b: _Bar, slots: tuple[Slot, Slot]) -> None:
        side: Sum = ((slots[1], 1.0), (slots[0], -1.0))
        across = self._value(side)
        length = float(np.linalg.norm(across))
        if length < 10 * self._length:
            return
        body = a.bodies[a.ends.index(slots[0])]
        for axis in self._axes:
            angle = _sine(axis.vector, across / length)
            if body in axis.bodies and angle < self.tolerance and axis.name not in (a.name, b.name):
                self._add(
                    f"the line from an end of {a.name} to that of {b.name} is {angle:.2g} rad "
                    f"({_millimetres(angle * length)}) from parallel to {axis.label}",
                    (a.name, b.name, axis.name), angle, angle, "cross", side, _one(axis.slot),
                )  # fmt: skip

    def _find_bars(self) -> list[_Bar]:
        graph = self.graph
        bars = [
            _Bar(r.name, (("end", r.name, 0), ("end", r.name, 1)),
                 (self._body(r.inner), self._body(r.outer)))
            for r in graph.rods.values()
        ]  # fmt: skip
        held: dict[str, list[Joint]] = {}
        busy = {body for bar in bars for body in bar.bodies} | {self._body(graph.platform)}
        for joint in graph.joints.values():
            if joint.kind != "fixed":
                for body in (joint.inner, joint.outer):
                    held.setdefault(self._body(body), []).append(joint)
        for body, joints in held.items():
            if body in busy or body == self._body(BASE) or len(joints) != 2:
                continue
            if any(j.kind not in ("revolute", *_POINTS) for j in joints):
                continue
            sides = [
                next(self._body(b) for b in (j.inner, j.outer) if self._body(b) != body)
                for j in joints
            ]
            slots = [("at", j.name, 0) for j in joints]
            axes = tuple(("axis", j.name, 0) for j in joints if j.kind == "revolute")
            bars.append(_Bar(body, (slots[0], slots[1]), (sides[0], sides[1]), axes))
        return bars

    def _value(self, terms: Sum) -> Array:
        return np.asarray(sum(f * self._vectors[slot] for slot, f in terms), np.float64)

    @property
    def missed(self) -> list[Condition]:
        """Those that hold nearly and not exactly."""
        return [c for c in self.found if c.size > EXACT]

    def idealized(self, without: Collection[Condition] = ()) -> Graph | None:
        """The graph with all conditions held exactly, by the least changes of axes and points.

        :param without: conditions that are left as they are.
        :returns: None where they contradict each other.
        """
        kept = [c for c in self.found if not any(c is other for other in without)]
        slots = [s for s in self._vectors if s[0] != "base"]
        index = {slot: 3 * k for k, slot in enumerate(slots)}
        scale = self.graph.size
        # Lengths in parts of the machine's size, as axes are of length one.
        sizes = {slot: 1.0 if slot[0] == "axis" else scale for slot in slots}
        values = {s: v / sizes.get(s, 1.0) for s, v in self._vectors.items()}
        for _ in range(_ROUNDS):
            rows, errors = [], []
            for c in kept:
                x, y = (_total(values, side) for side in (c.left, c.right))
                if c.form == "zero":
                    error, dx, dy = x, np.eye(3), None
                elif c.form == "cross":
                    error, dx, dy = np.cross(x, y), -skew(y), skew(x)
                else:
                    error, dx, dy = np.array([x @ y]), y[None], x[None]
                row = np.zeros((len(error), 3 * len(slots)))
                for side, slope in ((c.left, dx), (c.right, dy)):
                    for slot, factor in side:
                        if slot in index and slope is not None:
                            row[:, index[slot] : index[slot] + 3] += factor * slope
                rows.append(row)
                errors.append(error)
            if not rows:
                return self.graph
            error = np.concatenate(errors)
            if float(np.abs(error).max()) < 1e-15:
                break
            step = -np.linalg.lstsq(np.vstack(rows), error, rcond=1e-8)[0]
            for slot, k in index.items():
                values[slot] = values[slot] + step[k : k + 3]
                if slot[0] == "axis":
                    values[slot] = unit(values[slot])
        if not float(np.abs(error).max()) < EXACT:
            return None
        moved = max(
            float(np.linalg.norm(values[s] - v / sizes.get(s, 1.0)))
            for s, v in self._vectors.items() if s[0] != "point"
        )  # fmt: skip
        if moved > 100 * self.tolerance:
            return None
        return _with_vectors(self.graph, {s: v * sizes.get(s, 1.0) for s, v in values.items()})


def merged(graph: Graph) -> dict[str, str]:
    """By body, the ground too: the first of those that fixed joints make one with it."""
    fixed = ((j.inner, j.outer) for j in graph.joints.values() if j.kind == "fixed")
    return {name: one[0] for one in groups([BASE, *graph.bodies], fixed) for name in one}


def _vectors(graph: Graph) -> dict[Slot, Array]:
    vectors: dict[Slot, Array] = {("base", c, k): np.eye(3)[k] for k, c in enumerate("xyz")}
    for joint in graph.joints.values():
        vectors["at", joint.name, 0] = joint.at
        for k, axis in enumerate(joint.axes):
            vectors["axis", joint.name, k] = unit(axis)
    for rod in graph.rods.values():
        for k, end in enumerate(rod.ends):
            vectors["end", rod.name, k] = end
    return vectors


def _with_vectors(graph: Graph, vectors: dict[Slot, Array]) -> Graph:
    joints = {
        name: replace(
            j,
            at=array(vectors["at", name, 0]),
            axes=array(np.reshape([vectors["axis", name, k] for k in range(len(j.axes))], (-1, 3))),
        )
        for name, j in graph.joints.items()
    }
    rods: dict[str, Rod] = {
        name: replace(r, ends=array([vectors["end", name, 0], vectors["end", name, 1]]))
        for name, r in graph.rods.items()
    }
    return replace(graph, joints=joints, rods=rods)


def _one(slot: Slot) -> Sum:
    return ((slot, 1.0),)


def _span(bar: _Bar) -> Sum:
    return ((bar.ends[1], 1.0), (bar.ends[0], -1.0))


def _total(values: dict[Slot, Array], terms: Sum) -> Array:
    return np.asarray(sum((f * values[s] for s, f in terms), np.zeros(3)), np.float64)


def _sine(a: Array, b: Array) -> float:
    return float(np.linalg.norm(np.cross(a, b)))


def _crossing(a: Array, u: Array, b: Array, v: Array) -> tuple[Array, float]:
    """Middle of the shortest line between two that are not parallel, and its length."""
    table = np.array([u, -v]).T
    (s, t), *_ = np.linalg.lstsq(table, b - a, rcond=None)
    first, second = a + s * u, b + t * v
    return (first + second) / 2.0, float(np.linalg.norm(second - first))


def _millimetres(length: float) -> str:
    return f"{1e3 * length:.3g} mm" if math.isfinite(length) else "far"
