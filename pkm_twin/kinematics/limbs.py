# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Limbs whose passive turns follow in closed form from the bodies at their ends.

Such a limb hangs on the ground by a passive universal joint and ends in a ball joint; between the
two only driven joints move. With the ball's centre known from the body beyond it, the turns are
subproblems 1 and 2 of Paden and Kahan (Murray, Li, Sastry 1994, section 3.2). Newton's method then
has the other unknowns alone, and of each limb the distance of the two centres.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.expressions import Numbers
from pkm_twin.codegen.operations import absolute, sqrt
from pkm_twin.kinematics.motion import Motion, Row
from pkm_twin.machine.graph import BASE
from pkm_twin.machine.tree import Link, Tree

LEVER: Final = 1e-2
"""Part of the distance of its centres that a limb's lever about an axis has at home at least."""


@dataclass(frozen=True)
class Limb:
    """A limb by the names of its parts.

    ``root``: the body beyond the passive turns; ``tip``: the body with the ball's centre, ``ball``:
    its joint, ``beyond``: the other body of this joint. ``bodies``: all that the turns move, in the
    tree's order. ``rows``: the ball's closures, by index.
    """

    root: str
    tip: str
    ball: str
    beyond: str
    bodies: tuple[str, ...]
    rows: tuple[int, ...]


def find_limbs(tree: Tree, parts: Sequence[str], kept: Collection[int]) -> tuple[Limb, ...]:
    """The limbs of a tree whose closures are all among those that determine the unknowns.

    :param parts: the joint or rod of every closure. ``kept``: closures that determine the unknowns.
    """
    graph, links = tree.graph, tree.links
    ends = [(rod.inner, rod.outer) for rod in graph.rods.values()]
    ends += [(graph.joints[name].inner, graph.joints[name].outer) for name in tree.cut]
    found: list[Limb] = []
    for name in tree.cut:
        joint = graph.joints[name]
        rows = tuple(k for k, part in enumerate(parts) if part == name)
        kinds = [held.kind for held in joint.constraints]
        if kinds != ["point"] or not set(rows) <= set(kept):
            continue
        for tip, beyond in ((joint.inner, joint.outer), (joint.outer, joint.inner)):
            root = _root(links, tip)
            if root is None:
                continue
            bodies = tuple(body for body in links if root in _up(links, body))
            inside = set(bodies)
            alone = sum(bool(inside & set(pair)) for pair in ends) == 1
            driven = all(step.actuated for b in bodies if b != root for step in links[b].steps)
            limb = Limb(root, tip, name, beyond, bodies, rows)
            apart = graph.platform not in inside and beyond not in inside
            if alone and driven and apart and _regular(tree, limb):
                found.append(limb)
                break
    return tuple(found)


def _up(links: Mapping[str, Link], body: str) -> list[str]:
    """A body and those between it and the ground."""
    way = []
    while body != BASE:
        way.append(body)
        body = links[body].parent
    return way


def _root(links: Mapping[str, Link], tip: str) -> str | None:
    """The first body from the tip that hangs on a passive joint, where that is a universal's.

    Its centre rests: where drives carried it, Newton's method could step over a singularity.
    """
    for body in _up(links, tip):
        steps = links[body].steps
        if not all(step.actuated for step in steps):
            hangs = links[body].parent == BASE and [step.circle for step in steps] == [True, True]
            return body if hangs else None
    return None


def _regular(tree: Tree, limb: Limb) -> bool:
    """Whether home is far from where the turns do not follow."""
    motion = Motion(tree, tree.home, tree.graph.lead_home)
    pose = LimbPose(motion, limb, tree.graph.lead_home)
    size = float(np.linalg.norm(np.array(pose.lever, float)))
    return bool(abs(float(pose.steepness)) > LEVER * size)


class LimbPose:
    """A limb's turns and equations with both its ends placed, on numbers and expressions alike.

    ``lever``: from the passive joint's centre to the ball's, in axes of the root. ``apart``: the
    same from the bodies at both ends, base axes; the two agree where the closures hold.
    """

    def __init__(self, motion: Motion, limb: Limb, q: Numbers) -> None:
        tree, self.limb, self.motion = motion.tree, limb, motion
        self.link = tree.links[limb.root]
        at = motion.graph.joints[limb.ball].at
        self.lever, self._at_home = (
            Motion(tree, (), values, limb.bodies[1:], limb.root).point(limb.tip, at)
            for values in (q, motion.graph.lead_home)
        )
        self.end = motion.point(limb.beyond, at)
        self.apart = self.end - self.link.arm

    @property
    def steepness(self) -> Any:
        """What the limb's turns have of the closures' determinant, above zero as at home, m.

        The ball's motion along the first axis per turn about the second.
        """
        _, root = self._second(self._towards())
        return root

    def _towards(self) -> Any:
        """``apart`` in axes of the first turn."""
        return self.link.steps[0].before.T @ self.apart

    def _second(self, d: Any) -> tuple[tuple[Any, Any], Any]:
        """Cosine and sine of the second turn, and the root that is zero where it is not unique."""
        x, y, z = self.lever
        m = self.link.steps[1].before[2]
        a, b = m[0] * x + m[1] * y, m[1] * x - m[0] * y
        c = d[2] - m[2] * z
        square = a * a + b * b
        root = sqrt(square - c * c)
        # At home the turn is none, and the root is the size of what stands here for b.
        branch = m[1] * self._at_home[0] - m[0] * self._at_home[1]
        side = -(branch / absolute(branch)) * root
        return ((a * c - b * side) / square, (b * c + a * side) / square), root

    def unknowns(self) -> dict[int, Any]:
        """Cosines and sines of the turns, by their index among the unknowns."""
        d, (first, second) = self._towards(), self.link.steps
        (c, s), _ = self._second(d)
        result = {second.position: c, second.position + 1: second.sign * s}
        x, y, z = self.lever
        x, y, _ = second.before @ np.array([c * x - s * y, s * x + c * y, z], dtype=object)
        square = x * x + y * y
        c, s = (x * d[0] + y * d[1]) / square, (x * d[1] - y * d[0]) / square
        return result | {first.position: c, first.position + 1: first.sign * s}

    def row(self) -> Row:
        """What the turns cannot meet: the distance of the centres is that which the limb has."""
        start, end = (BASE, self.link.arm), (self.limb.beyond, self.end)
        return self.motion.distance(self.limb.ball, start, end, self.lever @ self.lever)
