# SPDX-License-Identifier: Apache-2.0
"""The spanning tree of a graph, and the coordinates of its joints.

Actuated joints come first, then those of fewest freedoms, so that there are fewest unknowns; a body
that only rods hold hangs free on the base. Revolute and prismatic joints have one number a step;
a spherical joint's body and a free one have a unit quaternion of their absolute orientation, with
the angular velocity in base axes as its rate: no chart, and nothing of the parents' turning.

May import: numpy, this package's graph, the standard library.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.errors import ParameterError
from pkm_twin.machine.graph import BASE, FREEDOMS, Graph, across, rotation_about_z, unit

Array = NDArray[np.float64]

RATES: Final = {"R": 1, "P": 1, "S": 3, "F": 6}
"""Rates of a step; S a ball, F a free body."""
_START: Final = {"R": (0.0,), "P": (0.0,), "S": (1.0, 0, 0, 0), "F": (1.0, 0, 0, 0, 0, 0, 0)}
_SNAP: Final = 1e-14
PARALLEL: Final = 1e-6
"""Sine of an angle, or part of the machine's size, that counts as zero for a choice of axes."""


def snapped(values: Array) -> Array:
    """Numbers that rounding left beside 0 and 1 are those: else the programs lose their zeros."""
    result = np.array(values, float)
    for target in (0.0, 1.0, -1.0):
        result[np.abs(result - target) < _SNAP] = target
    return result


def axes_with_z(z: Array, hint: Array) -> Array:
    """Axes whose z is given and whose x points towards a hint, as columns."""
    x = hint - (hint @ z) * z
    size = float(np.linalg.norm(x))
    x = x / size if size > PARALLEL else across(z)[0]
    return np.array([x, np.cross(z, x), z]).T


@dataclass(frozen=True, eq=False)
class Step:
    """One elementary freedom of a tree joint.

    ``axis``: at home, base axes. ``sign``: -1 where the tree goes from the outer body to the inner
    one. ``position``, ``rate``: first index among the unknowns, or of an actuated joint among q.
    ``before``: constant rotation from the body frame before the step to the step's own (R only).
    ``local``: the axis in the body frame before the step. ``offset``: of an actuated turn, its
    angle from ``before`` to the body's frame at home, rad.
    """

    kind: str
    axis: Array
    actuated: bool
    position: int
    rate: int
    sign: float
    before: Array
    local: Array
    joint: str
    offset: float = 0.0


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
    """Links in an order in which parents come first, cut joints, and unknowns."""

    graph: Graph
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

    def _span(self) -> dict[str, list[tuple[str, str | None]]]:
        graph = self.graph
        edges: list[tuple[bool, float, int, str | None, str, str]] = []
        for k, joint in enumerate(graph.joints.values()):
            # Three slides along fixed axes are no dearer than one.
            freedoms = 1 if joint.kind == "translation" else len(FREEDOMS[joint.kind])
            weight = 3 if joint.kind == "spherical" else freedoms
            edges.append((not joint.actuated, weight, k, joint.name, joint.inner, joint.outer))
        edges += [(True, 6, 10**6 + k, None, BASE, body) for k, body in enumerate(graph.bodies)]
        group = {name: name for name in [BASE, *graph.bodies]}
        neighbours: dict[str, list[tuple[str, str | None]]] = {name: [] for name in group}
        cut: list[str] = []

        def root(name: str) -> str:
            while group[name] != name:
                name = group[name]
            return name

        for passive, _, _, name, a, b in sorted(edges, key=lambda edge: edge[:3]):
            if root(a) == root(b):
                if name is not None:
                    if not passive:
                        raise ParameterError(
                            f"joints.{name}.actuated", True, "actuated joints that close no loop "
                            "of their own"
                        )  # fmt: skip
                    cut.append(name)
                continue
            group[root(a)] = root(b)
            neighbours[a].append((b, name))
            neighbours[b].append((a, name))
        self.cut = tuple(name for name in graph.joints if name in cut)
        return neighbours

    def _hang(self, parent: str, body: str, name: str | None) -> None:
        graph = self.graph
        if name is None:
            kinds, axes, backwards, actuated = "F", np.zeros((1, 3)), False, False
            at = graph.bodies[body].com
        else:
            joint = graph.joints[name]
            kinds, backwards, actuated = FREEDOMS[joint.kind], joint.inner != parent, joint.actuated
            axes, at = joint.axes, joint.at
            if joint.kind == "cylindrical":
                axes = np.repeat(axes, 2, axis=0)
            elif joint.kind == "translation":
                axes = np.eye(3)
            if backwards:
                kinds, axes = kinds[::-1], axes[::-1]
        steps: list[Step] = []
        frame = self.axes[parent]
        turns = [k for k, kind in enumerate(kinds) if kind == "R"]
        for k, kind in enumerate(kinds):
            axis = unit(axes[k]) if kind in "RP" else np.zeros(3)
            before, local, offset = np.eye(3), snapped(frame.T @ axis), 0.0
            if kind == "R":
                following = [axes[i] for i in turns if i > k]
                hint = following[0] if following else self._next_axis(body, name, axis)
                turned = axes_with_z(axis, frame[:, 0] if hint is None else hint)
                if actuated and hint is None:
                    offset = self._tilt(body, turned, at)
                before, frame = snapped(frame.T @ turned), turned @ rotation_about_z(offset)
            if actuated:
                position = rate = graph.actuated.index(str(name))
            else:
                position, rate = len(self.home), len(self.owners)
                self.home += _START[kind]
                self.owners += [name or f"free body {body}"] * RATES[kind]
                length = 1.0 / graph.size
                self.scales += {"R": [1.0], "P": [length], "S": [1.0] * 3}.get(
                    kind, [1.0] * 3 + [length] * 3
                )
            sign = -1.0 if backwards else 1.0
            steps.append(
                Step(
                    kind, axis, actuated, position, rate, sign, before, local, name or body, offset
                )
            )
        if kinds in ("S", "F"):
            frame = np.eye(3)
        self.axes[body], self.at[body] = frame, at
        arm = snapped(self.axes[parent].T @ (at - self.at[parent]))
        self.links[body] = Link(body, parent, name, tuple(steps), at, frame, arm)

    def _tilt(self, body: str, frame: Array, at: Array) -> float:
        """Angle about z by which axes x or y of a frame lie along the body's first lever, rad.

        Told by the joint's angle, it leaves a lever one number and the frame before it simple.
        """
        for point in self.graph.joint_points(body):
            x, y, _ = frame.T @ (point - at)
            if math.hypot(x, y) > PARALLEL * self.graph.size:
                tilt = math.remainder(math.atan2(y, x), math.pi / 2)
                return tilt if abs(tilt) > _SNAP else 0.0
        return 0.0

    def _next_axis(self, body: str, name: str | None, axis: Array) -> Array | None:
        """Axis of another joint of the body: with it most constant rotations become simple.

        None where there is none, or the first is parallel to this one.
        """
        for joint in self.graph.joints.values():
            if joint.name != name and body in (joint.inner, joint.outer) and len(joint.axes):
                parallel = np.linalg.norm(np.cross(axis, joint.axes[0])) <= PARALLEL
                return None if parallel else np.asarray(joint.axes[0], np.float64)
        return None
