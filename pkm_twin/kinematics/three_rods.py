# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Forward kinematics in closed form: three rods on a platform that only translates.

With the rods' platform ends shifted to one point, the platform is at an intersection of three
spheres about the driven ends. Of the two intersections the one on home's side of the centres' plane
is taken; if that plane has turned over, neither is valid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import Numbers, Objects, cross, snapped, snapped_all
from pkm_twin.codegen.operations import absolute, maximum, sqrt
from pkm_twin.kinematics.limb_pose import sign_of, square_of
from pkm_twin.kinematics.limbs import SolvableLinkage
from pkm_twin.kinematics.motion import Motion
from pkm_twin.machine.graph import UP, Graph
from pkm_twin.machine.tree import Tree


def meet_spheres(centres: Sequence[Any], squares: Sequence[Any], up: Numbers) -> tuple[Objects, Any, Any]:
    """Return the intersection of three spheres.

    :param centres: three points. ``squares``: squared radii. ``up``: direction, (3,), to the side of
        the centres' plane on which the intersection is wanted.
    :returns: the point, (3,), which is in the plane if the spheres do not meet; its squared distance
        from the plane, negative if they do not meet; and the squared distance of the first centre
        from the point's projection onto the plane.
    """
    u, v = centres[1] - centres[0], centres[2] - centres[0]
    n = cross(u, v)
    square = n @ n
    a, b = (w @ w + snapped(squares[0] - other) for w, other in zip((u, v), squares[1:], strict=True))
    middle = cross(a * v - b * u, n) * (0.5 / square)
    apart = middle @ middle
    left = squares[0] - apart
    side = n @ up
    side = side / maximum(absolute(side), 1e-300)
    height = side * sqrt(maximum(left, 0.0) / square)
    return centres[0] + middle + height * n, left, apart


@dataclass(frozen=True)
class ThreeRods:
    """Forward kinematics of three rods, by name, from driven bodies to a translating body."""

    rods: tuple[str, ...]
    body: str

    def _list_ends(self, graph: Graph) -> list[tuple[str, Array, Array]]:
        """Return each rod's driven body, the rod's end there and its end on the platform, at home."""
        rods = [(rod, *rod.ends) for rod in map(graph.rods.__getitem__, self.rods)]
        return [(r.outer, b, a) if r.inner == self.body else (r.inner, a, b) for r, a, b in rods]

    def _spheres(self, tree: Tree, q: Numbers) -> tuple[list[Any], list[Any]]:
        """Return centres and squared radii of the spheres for the body's displacement from home."""
        others = [name for name in tree.links if name != self.body]
        motion = Motion(tree, np.array(tree.home, dtype=object), q, others)
        ends = self._list_ends(tree.graph)
        return [motion.point(near, end) - own for near, end, own in ends], [square_of(b - a) for _, a, b in ends]

    def _find_plane_normal(self, graph: Graph) -> Objects:
        """Return a normal of the centres' plane at home that points to the body's side."""
        c1, c2, c3 = (end - own for _, end, own in self._list_ends(graph))
        n = cross(c2 - c1, c3 - c1)
        return snapped_all(n * sign_of(-(c1 @ n)))

    def solve_unknowns(self, tree: Tree, q: Numbers) -> list[Any]:
        """Return the unknowns of the joint that carries the body, in closed form."""
        point, _, _ = meet_spheres(*self._spheres(tree, q), self._find_plane_normal(tree.graph))
        # Steps of the joint are along the base axes.
        steps = tree.links[self.body].steps
        x: list[Any] = [0.0] * len(steps)
        for step in steps:
            x[step.position] = (step.local @ point) * step.sign / step.slide
        return x

    def find_conditions(self, motion: Motion) -> list[Any]:
        """Return a margin that is positive if the body is on home's side of the centres' plane."""
        ends = self._list_ends(motion.graph)
        c1, c2, c3 = (motion.point(near, end) - motion.point(self.body, own) for near, end, own in ends)
        n = cross(c2 - c1, c3 - c1)
        return [-(c1 @ n) * (n @ self._find_plane_normal(motion.graph))]

    def find_gap(self, tree: Tree, q: Numbers) -> tuple[str, float] | None:
        """Return the rod that does not reach the intersection of the other two spheres, and the gap, m.

        None if the spheres meet, or their centres are on one line.
        """
        centres, squares = self._spheres(tree, q)
        with np.errstate(all="ignore"):
            _, left, apart = meet_spheres([np.array(c, float) for c in centres], squares, UP)
        miss = float(np.sqrt(apart) - np.sqrt(float(squares[0])))
        sides = [float(square_of(centres[k] - centres[(k + 1) % 3])) for k in range(3)]
        far = self.rods[(int(np.argmin(sides)) + 2) % 3]
        return (far, miss) if left < 0.0 and np.isfinite(miss) else None


def find_three_rods(scheme: SolvableLinkage) -> ThreeRods | None:
    """Find three rods that hold a translating body, if its translation is the only unknown motion."""
    tree, rods = scheme.tree, [scheme.parts[k] for k in scheme.independent]
    loose = [link for link in tree.links.values() if not all(s.actuated for s in link.steps)]
    if len(loose) != 1 or len(set(rods)) != 3 or not set(rods) <= set(tree.graph.rods):
        return None
    (link,) = loose
    slides = [step for step in link.steps if step.slide and not step.turns]
    ends = [{tree.graph.rods[name].inner, tree.graph.rods[name].outer} for name in rods]
    if len(slides) != 3 or len(link.steps) != 3 or not all(link.body in pair for pair in ends):
        return None
    return ThreeRods(tuple(rods), link.body)
