# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Convert a graph's geometry to a vector, and build the graph from other numbers or expressions.

Masses and friction are in ``machine.inertia``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import Numbers, plain, snapped
from pkm_twin.machine.graph import Graph, array
from pkm_twin.machine.tree import Tree


@dataclass(frozen=True, eq=False)
class SizedGraph(Graph):
    """A graph whose scale lengths (size, platform radius and frames of bodies) are given instead of computed."""

    given: Sequence[Any] = field(default=())
    names: tuple[str, ...] = ()
    """Names of the bodies whose frames are given, in order."""

    @property
    def size(self) -> Any:
        """The given size, m."""
        return self.given[0]

    @property
    def platform_radius(self) -> Any:
        """The given radius of the platform, m."""
        return self.given[1]

    def body_scale(self, body: str) -> tuple[Array, Any]:
        """Return the point, (3,), and length, m, that scale a body's motion, see :class:`Graph`."""
        k = 2 + 4 * self.names.index(body)
        return plain(self.given[k : k + 3]), self.given[k + 3]


def list_geometry(graph: Graph) -> Array:
    """Return all numbers of a graph's geometry, shape (k,); last those that only scale equations."""
    scales = [graph.body_scale(body) for body in graph.bodies]
    return array(
        [*graph.numbers, graph.size, graph.platform_radius, *(v for point, length in scales for v in (*point, length))]
    )


def build_sized_graph(graph: Graph, numbers: Numbers) -> SizedGraph:
    """Build the graph with other numbers or expressions, in the order of :func:`list_geometry`.

    Expressions that are 0, 1 or -1 at the reference geometry become constants, see
    :func:`pkm_twin.codegen.expressions.snapped`, except for scale lengths.
    """
    left = iter(numbers)

    def take(like: Array) -> Array:
        values = np.empty(like.size, dtype=object)
        values[:] = [snapped(next(left)) for _ in range(like.size)]
        return plain(values.reshape(like.shape))

    joints = {}
    for name, joint in graph.joints.items():
        at, axes, home = take(joint.at), take(joint.axes), snapped(next(left))
        pitch = next(left) if joint.type.threaded() else 0.0
        directions = tuple(replace(d, vector=take(d.vector)) for d in joint.directions)
        joints[name] = replace(joint, at=at, axes=axes, home=home, pitch=pitch, directions=directions)
    rods = {}
    for name, rod in graph.rods.items():
        ends = take(rod.ends)
        rods[name] = replace(rod, ends=ends, pair=None if rod.pair is None else take(rod.pair))
    origin = take(graph.origin)
    sharing = take(graph.sharing)
    return SizedGraph(
        graph.bodies, joints, rods, graph.platform, origin, graph.laws, sharing, list(left), tuple(graph.bodies)
    )


def describe_pattern(tree: Tree) -> str:
    """Describe the constants that programs assume, and the choice of the tree's frames.

    Two graphs with equal topology and pattern have the same programs, with their own numbers.
    """
    graph = tree.graph
    parts: list[Any] = [marks(graph.numbers)]
    for body, link in tree.links.items():
        # The signs and zeros of a frame in base axes show how its axes were chosen.
        parts += [link.parent, marks(link.arm), marks(link.axes)]
        parts += [(marks(s.before), marks(s.local), marks([s.offset])) for s in link.steps]
        vectors: list[Array] = []
        for joint in graph.joints.values():
            if body in (joint.inner, joint.outer):
                vectors += [held.inner if body == joint.inner else held.outer for held in joint.constraints]
                vectors += list(joint.axes)
            vectors += [d.vector for d in joint.directions if d.body == body]
        vectors += [rod.pair for rod in graph.rods.values() if rod.pair is not None and rod.outer == body]
        points = graph.joint_points(body) + ([graph.origin] if body == graph.platform else [])
        parts += [marks(link.axes.T @ vector) for vector in (*vectors, *(point - link.at for point in points))]
    for joint in graph.joints.values():
        for held in joint.constraints:
            parts.append(marks([held.inner @ held.outer]))
    return repr(parts)


def marks(values: Any) -> str:
    """Return one character per number: the constant that programs assume for it, or a dot."""
    known = {0.0: "0", 1.0: "1", -1.0: "-"}
    return "".join(known.get(float(snapped(v)), ".") for v in np.ravel(values))
