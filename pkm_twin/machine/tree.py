# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The spanning tree of a graph, and the coordinates of its joints.

Actuated joints come first, then those of fewest freedoms, so that there are fewest unknowns; a body
that only rods hold hangs free on the base. A driven turn or slide, and a passive slide, is one
number; a passive turn is its cosine and sine, so nothing that iterates computes an angle;
a spherical joint's body and a free one have a unit quaternion of their absolute orientation, with
the angular velocity in base axes as its rate: no chart, and nothing of the parents' turning.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import norm, plain, reference, snapped, snapped_all
from pkm_twin.codegen.operations import atan2
from pkm_twin.errors import ParameterError
from pkm_twin.machine.graph import BASE, Graph, rotation_about_z, spanning
from pkm_twin.machine.joints import Freedom, across, unit

BALL: Final = (1.0, 0.0, 0.0, 0.0)
FREE: Final = (*BALL, 0.0, 0.0, 0.0)
"""Unknowns at home of a ball, and of a body that hangs free: a quaternion, and a place."""
CIRCLE: Final = (1.0, 0.0)
"""Unknowns at home of a passive turn."""
PARALLEL: Final = 1e-6
"""Sine of an angle, or part of the machine's size, that counts as zero for a choice of axes."""


def is_parallel(first: Array, second: Array) -> bool:
    """Whether two unit vectors are, for a choice of axes."""
    return reference(norm(plain(np.cross(first, second)))) <= PARALLEL


def axes_with_z(z: Array, hint: Array) -> Array:
    """Axes whose z is given and whose x points towards a hint, as columns."""
    x = hint - (hint @ z) * z
    size = norm(x)
    x = x / size if reference(size) > PARALLEL else across(z)[0]
    return np.array([x, np.cross(z, x), z]).T


@dataclass(frozen=True, eq=False)
class Step:
    """One elementary freedom of a tree joint, or a ball, or a free body (``ball``, ``free``).

    ``axis``: at home, base axes; ``turns`` about it, ``slide`` along it per unit. ``sign``: -1
    where the tree goes from the outer body to the inner one. ``position``, ``rate``: first index
    among the unknowns, or of an actuated joint among q. ``before``: constant rotation from the body
    frame before the step to the step's own, of a turn. ``local``: the axis in the body frame before
    the step. ``beyond``: whether the axis is fixed in the body beyond it. ``offset``: of a driven
    turn, its angle from ``before`` to the body's frame at home, rad.
    """

    axis: Array
    turns: bool
    slide: float
    actuated: bool
    position: int
    rate: int
    sign: float
    before: Array
    local: Array
    joint: str
    beyond: bool = False
    offset: float = 0.0
    ball: bool = False
    free: bool = False
    circle: bool = False
    """A passive turn: its cosine and sine are unknowns, from 1 and 0 at home; its rate is one."""


@dataclass(frozen=True, eq=False)
class Link:
    """A body of the tree: its parent, the steps to it, and its frame at home.

    ``arm``: from the parent's origin to its own, in the parent's frame. ``axes``: the frame at
    home as columns; ``at``: its origin at home.
    """

    body: str
    parent: str
    joint: str | None
    steps: tuple[Step, ...]
    at: Array
    axes: Array
    arm: Array


@dataclass(eq=False)
class Tree:
    """Links in an order in which parents come first, cut joints, and unknowns.

    ``carriers``: joints that the tree may have, by default all. ``first``: joints that come before
    all but the leading ones, if they make no loop; or the platform, which is free then.
    """

    graph: Graph
    carriers: frozenset[str] | None = None
    first: tuple[str, ...] = ()
    links: dict[str, Link] = field(default_factory=dict)
    cut: tuple[str, ...] = ()
    home: list[float] = field(default_factory=list)
    """The unknowns at home."""
    owners: list[str] = field(default_factory=list)
    """By rate: the joint it belongs to, or the free body."""
    scales: list[float] = field(default_factory=list)
    """By rate: what makes it of unit one, 1 or 1 / m."""

    def __post_init__(self) -> None:
        graph = self.graph
        self.axes: dict[str, Array] = {BASE: np.eye(3)}
        self.at: dict[str, Array] = {BASE: np.zeros(3)}
        neighbours = self._span()
        todo = [BASE]
        parents: dict[str, str] = {}
        while todo:  # breadth first, so that it stays shallow
            parent = todo.pop(0)
            for body, joint in neighbours[parent]:
                if parents.get(parent) == body:
                    continue
                parents[body] = parent
                self._hang(parent, body, joint)
                todo.append(body)
        self.size = graph.size

    @property
    def unknown_rates(self) -> int:
        """How many rates are unknown."""
        return len(self.owners)

    @cached_property
    def drives(self) -> list[Step]:
        """The step of every actuated joint, those that follow too."""
        return [self.steps[name] for name in self.graph.actuated]

    def of_drives(self, leads: Any, rest: Any) -> list[Any]:
        """Rates or accelerations of all drives, of those that lead, shape (m,), and the unknown."""
        return [(leads if step.actuated else rest)[step.rate] for step in self.drives]

    def values_of_drives(self, leads: Any, x: Any) -> list[Any]:
        """Positions of all drives of those that lead; turns within half a turn of home."""
        return [leads[step.position] if step.actuated else self._value(step, x) for step in self.drives]

    def values_of_joints(self, names: Sequence[str], x: Any) -> list[Any]:
        """Positions of passive joints of one freedom; turns within half a turn of home."""
        return [self._value(self.steps[name], x) for name in names]

    def _value(self, step: Step, x: Any) -> Any:
        k = step.position
        value = atan2(x[k + 1], x[k]) if step.circle else x[k]
        return value + self.graph.joints[step.joint].home

    @cached_property
    def steps(self) -> dict[str, Step]:
        """The step of every joint of the tree, of several freedoms the last one."""
        return {step.joint: step for link in self.links.values() for step in link.steps}

    def chain_to_base(self, body: str) -> list[str]:
        """Return a body and those between it and the ground."""
        chain = []
        while body != BASE:
            chain.append(body)
            body = self.links[body].parent
        return chain

    def _span(self) -> dict[str, list[tuple[str, str | None]]]:
        graph = self.graph
        able = self.carriers
        order = sorted(
            (j for j in graph.joints.values() if able is None or j.name in able),
            key=lambda j: (not j.leads, j.name not in self.first, not j.actuated, j.type.cost),
        )
        pairs: dict[str | tuple[str], tuple[str, str]]
        pairs = {(body,): (BASE, body) for body in graph.bodies if body in self.first}
        pairs |= {joint.name: (joint.inner, joint.outer) for joint in order}
        pairs |= {(body,): (BASE, body) for body in graph.bodies}
        neighbours: dict[str, list[tuple[str, str | None]]] = {n: [] for n in (BASE, *graph.bodies)}
        spanned = spanning(neighbours, pairs)
        for key in spanned:
            a, b = pairs[key]
            name = key if isinstance(key, str) else None
            neighbours[a].append((b, name))
            neighbours[b].append((a, name))
        self.cut = tuple(name for name in graph.joints if name not in spanned)
        for name in self.cut:
            if graph.joints[name].type.threaded():
                # Its turn is known but for whole ones.
                raise ParameterError(f"joints.{name}.type", "helical", "a loop that has other joints too")
            if graph.joints[name].actuated:
                raise ParameterError(f"joints.{name}.actuated", True, "actuated joints that close no loop of their own")
        return neighbours

    def _hang(self, parent: str, body: str, name: str | None) -> None:
        graph = self.graph
        if name is None:
            # A point of the geometry, which programs have at run time; a centre of mass is none.
            at = graph.origin if body == graph.platform else graph.frame(body)[0]
            backwards, actuated = False, False
            freedoms: tuple[Freedom, ...] = ()
            start: tuple[float, ...] = FREE
        else:
            joint = graph.joints[name]
            freedoms, at = joint.freedoms, joint.at
            backwards, actuated = joint.inner != parent, joint.leads
            start = BALL if joint.type.ball else ()
            freedoms = freedoms[::-1] if backwards else freedoms
        sign, frame = -1.0 if backwards else 1.0, self.axes[parent]
        steps: list[Step] = []
        if start:
            position, rate = self._claim(start, name or f"free body {body}", len(start) - 1)
            self.scales += [1.0] * 3 + [1.0 / graph.size] * (len(start) - 4)
            none = np.zeros(3)
            steps.append(
                Step(
                    none,
                    False,
                    0.0,
                    False,
                    position,
                    rate,
                    sign,
                    np.eye(3),
                    none,
                    name or body,
                    ball=start == BALL,
                    free=start == FREE,
                )
            )
            freedoms, frame = (), np.eye(3)
        turns = [freedom.axis for freedom in freedoms if freedom.turns]
        for freedom in freedoms:
            axis = unit(freedom.axis)
            before, local, offset = np.eye(3), snapped_all(frame.T @ axis), 0.0
            if freedom.turns:
                turns = turns[1:]
                hint = turns[0] if turns else self._next_axis(body, name, axis)
                turned = axes_with_z(axis, frame[:, 0] if hint is None else hint)
                if actuated and hint is None:
                    offset = self._tilt(body, turned, at)
                before, frame = snapped_all(frame.T @ turned), turned @ rotation_about_z(offset)
            circle = freedom.turns and not freedom.slide and not actuated
            if actuated:
                position = rate = graph.leads.index(str(name))
            else:
                position, rate = self._claim(CIRCLE if circle else (0.0,), str(name), 1)
                self.scales.append(1.0 if freedom.turns else 1.0 / graph.size)
            steps.append(
                Step(
                    axis,
                    freedom.turns,
                    freedom.slide,
                    actuated,
                    position,
                    rate,
                    sign,
                    before,
                    local,
                    str(name),
                    freedom.outer != backwards,
                    offset,
                    circle=circle,
                )
            )
        self.axes[body], self.at[body] = frame, at
        arm = snapped_all(self.axes[parent].T @ (at - self.at[parent]))
        self.links[body] = Link(body, parent, name, tuple(steps), at, frame, arm)

    def _claim(self, start: Sequence[float], owner: str, rates: int) -> tuple[int, int]:
        """Unknowns and rates of a step; their first indices."""
        position, rate = len(self.home), len(self.owners)
        self.home += start
        self.owners += [owner] * rates
        return position, rate

    def _tilt(self, body: str, frame: Array, at: Array) -> Any:
        """Angle about z by which axes x or y of a frame lie along the body's first lever, rad.

        Told by the joint's angle, it leaves a lever one number and the frame before it simple.
        """
        size = reference(self.graph.size)
        for point in self.graph.joint_points(body):
            x, y, _ = frame.T @ (point - at)
            if math.hypot(reference(x), reference(y)) > PARALLEL * size:
                angle = atan2(y, x)
                quarters = round(reference(angle) / (math.pi / 2))
                return snapped(angle - quarters * (math.pi / 2))
        return 0.0

    def _next_axis(self, body: str, name: str | None, axis: Array) -> Array | None:
        """Axis of another joint of the body: with it most constant rotations become simple.

        None where there is none, or the first is parallel to this one.
        """
        for joint in self.graph.joints.values():
            if joint.name != name and body in (joint.inner, joint.outer) and len(joint.axes):
                return None if is_parallel(axis, joint.axes[0]) else joint.axes[0]
        return None
