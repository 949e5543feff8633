# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The spanning tree of a graph, and the coordinates of its joints.

Actuated joints come first, then those of fewest freedoms, so that there are fewest unknowns; a body
that only rods hold is free on the base. A driven rotation or slide and a passive slide have one
coordinate. A passive rotation has its cosine and sine, so that no iteration computes an angle. The
body of a spherical joint and a free body have a unit quaternion of their absolute orientation, whose
rate is the angular velocity in base axes: no chart has a singularity, and no parent's rotation enters.
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
from pkm_twin.machine.graph import BASE, Graph, choose_spanning_pairs, rotation_about_z
from pkm_twin.machine.joints import Freedom, perpendicular_axes, unit

BALL: Final = (1.0, 0.0, 0.0, 0.0)
FREE: Final = (*BALL, 0.0, 0.0, 0.0)
"""Unknowns at home of a ball, and of a body that hangs free: a quaternion, and a place."""
PARALLEL_TOLERANCE: Final = 1e-6
"""Sine of an angle, or length relative to the machine's size, that counts as zero in a choice of axes."""


def axes_with_z(z: Array, hint: Array) -> Array:
    """Return axes, as columns, with the given z; x points towards the hint."""
    x = hint - (hint @ z) * z
    size = norm(x)
    x = x / size if reference(size) > PARALLEL_TOLERANCE else perpendicular_axes(z)[0]
    return np.array([x, np.cross(z, x), z]).T


@dataclass(frozen=True, eq=False)
class Step:
    """One elementary freedom of a tree joint, or a ball, or a free body (``ball``, ``free``).

    ``axis``: at home, base axes; ``turns``: rotates about it; ``slide``: along it per unit. ``sign``:
    -1 if the tree goes from the outer body to the inner one. ``position``, ``rate``: first index among
    the unknowns, or among q for an actuated joint. ``before``: constant rotation from the body frame
    before the step to the step's own frame. ``local``: the axis in the body frame before the step.
    ``beyond``: the axis is fixed in the body beyond it. ``offset``: angle of a driven rotation from
    ``before`` to the body's frame at home, rad. ``circle``: a passive rotation, whose unknowns are its
    cosine and sine, 1 and 0 at home, and which has one rate.
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
    """The joint or the free body of each rate."""
    scales: list[float] = field(default_factory=list)
    """A factor of each rate that makes it dimensionless, 1 or 1/m."""

    def __post_init__(self) -> None:
        graph = self.graph
        self.axes: dict[str, Array] = {BASE: np.eye(3)}
        self.at: dict[str, Array] = {BASE: np.zeros(3)}
        neighbours = self._span_tree()
        todo = [BASE]
        parents: dict[str, str] = {}
        while todo:  # breadth first, so that it stays shallow
            parent = todo.pop(0)
            for body, joint in neighbours[parent]:
                if parents.get(parent) == body:
                    continue
                parents[body] = parent
                self._attach_body(parent, body, joint)
                todo.append(body)
        self.size = graph.size

    @property
    def unknown_rates(self) -> int:
        """Number of unknown rates."""
        return len(self.owners)

    @cached_property
    def drives(self) -> list[Step]:
        """The steps of all actuated joints, including those that follow."""
        return [self.steps[name] for name in self.graph.actuated]

    def drive_rates(self, leads: Any, rest: Any) -> list[Any]:
        """Return rates or accelerations of all drives from the leading ones, shape (m,), and the unknowns."""
        return [(leads if step.actuated else rest)[step.rate] for step in self.drives]

    def drive_positions(self, leads: Any, x: Any) -> list[Any]:
        """Return positions of all drives from the leading ones; rotations within half a turn of home."""
        return [leads[step.position] if step.actuated else self._joint_value(step, x) for step in self.drives]

    def joint_positions(self, names: Sequence[str], x: Any) -> list[Any]:
        """Return positions of passive joints of one freedom; rotations within half a turn of home."""
        return [self._joint_value(self.steps[name], x) for name in names]

    def _joint_value(self, step: Step, x: Any) -> Any:
        k = step.position
        value = atan2(x[k + 1], x[k]) if step.circle else x[k]
        return value + self.graph.joints[step.joint].home

    @cached_property
    def steps(self) -> dict[str, Step]:
        """The step of each joint of the tree, the last one of a joint with several freedoms."""
        return {step.joint: step for link in self.links.values() for step in link.steps}

    def chain_to_base(self, body: str) -> list[str]:
        """Return a body and those between it and the ground."""
        chain = []
        while body != BASE:
            chain.append(body)
            body = self.links[body].parent
        return chain

    def _span_tree(self) -> dict[str, list[tuple[str, str | None]]]:
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
        spanned = choose_spanning_pairs(neighbours, pairs)
        for key in spanned:
            a, b = pairs[key]
            name = key if isinstance(key, str) else None
            neighbours[a].append((b, name))
            neighbours[b].append((a, name))
        self.cut = tuple(name for name in graph.joints if name not in spanned)
        for name in self.cut:
            if graph.joints[name].type.threaded():
                # The rotation is known up to whole turns only.
                raise ParameterError(f"joints.{name}.type", "helical", "a loop that has other joints too")
            if graph.joints[name].actuated:
                raise ParameterError(f"joints.{name}.actuated", True, "actuated joints that close no loop of their own")
        return neighbours

    def _attach_body(self, parent: str, body: str, name: str | None) -> None:
        graph = self.graph
        if name is None:
            # Use a point that is an input of compiled programs; a centre of mass is not one.
            at = graph.origin if body == graph.platform else graph.body_scale(body)[0]
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
            position, rate = self._add_unknowns(start, name or f"free body {body}", len(start) - 1)
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
                hint = turns[0] if turns else None
                if not turns:
                    # With an axis of another joint of the body most constant rotations become simple.
                    others = [j for j in graph.joints.values() if j.name != name and body in (j.inner, j.outer)]
                    hint = next((j.axes[0] for j in others if len(j.axes)), None)
                    if hint is not None and reference(norm(plain(np.cross(axis, hint)))) <= PARALLEL_TOLERANCE:
                        hint = None
                turned = axes_with_z(axis, frame[:, 0] if hint is None else hint)
                if actuated and hint is None:
                    offset = self._find_tilt(body, turned, at)
                before, frame = snapped_all(frame.T @ turned), turned @ rotation_about_z(offset)
            circle = freedom.turns and not freedom.slide and not actuated
            if actuated:
                position = rate = graph.leads.index(str(name))
            else:
                position, rate = self._add_unknowns((1.0, 0.0) if circle else (0.0,), str(name), 1)
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

    def _add_unknowns(self, start: Sequence[float], owner: str, rates: int) -> tuple[int, int]:
        """Add the unknowns and rates of a step; return their first indices."""
        position, rate = len(self.home), len(self.owners)
        self.home += start
        self.owners += [owner] * rates
        return position, rate

    def _find_tilt(self, body: str, frame: Array, at: Array) -> Any:
        """Return the rotation about z, rad, that puts x or y of a frame along the body's first lever.

        As part of the joint's angle it reduces the lever to one number and keeps the frame before simple.
        """
        size = reference(self.graph.size)
        for point in self.graph.joint_points(body):
            x, y, _ = frame.T @ (point - at)
            if math.hypot(reference(x), reference(y)) > PARALLEL_TOLERANCE * size:
                angle = atan2(y, x)
                quarters = round(reference(angle) / (math.pi / 2))
                return snapped(angle - quarters * (math.pi / 2))
        return 0.0
