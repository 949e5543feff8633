# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A machine as an engine's tree of joints with loops cut open: no closure is the engine's.

A spanning tree, a rod as a body of its own on two hinges across it, positions by Newton's method in
many equal steps from home. Points and directions move by the engine's kinematics and Jacobians; its
inverse dynamics of the tree is projected on the actuated joints.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from pkm_twin.certify.description import (
    BASE,
    Array,
    Body,
    Description,
    Joint,
    Rod,
    UnfitError,
    across,
    read,
)
from pkm_twin.certify.rows import Moving, Rows

STEPS: Final = 64
"""Steps from home to a state."""
Steps = Sequence[tuple[bool, Array]]
"""Freedoms of a joint from the parent outwards: whether each turns, and its axis at home."""


class Tree(Moving):
    """A machine as a tree with loop constraints.

    :raises UnfitError: a description that cannot be read.
    """

    widest: bool
    """Whether the joints of most freedoms make the tree, else the actuated and the narrowest."""

    def __init__(self, description: Description) -> None:
        self.machine = read(description)
        self._held: list[tuple[Joint, Sequence[str]]] = []
        self._grow()
        for rod in self.machine.rods:
            unit = (rod.ends[1] - rod.ends[0]) / rod.length
            turning = rod.mass * rod.length**2 / 12 * (np.eye(3) - np.outer(unit, unit))
            body = Body(rod.mass, rod.ends.mean(0), turning)
            hinges = [(True, axis) for axis in across(unit)]
            self.hang(_name(rod), rod.inner, rod.ends[0], hinges, body)
        self.size = self.finish()
        self._assembled: dict[bytes, Array] = {}

    def _grow(self) -> None:
        """A spanning tree from the base outwards; the other joints are equations."""
        joints, bodies = list(self.machine.joints), self.machine.bodies
        hung = {BASE}
        while len(hung) <= len(bodies):
            edges = [j for j in joints if (j.inner in hung) != (j.outer in hung)]
            if not edges:
                # Held by rods alone: it hangs free, with what joints carry on from it.
                name = next(n for n in (self.machine.platform, *bodies) if n not in hung)
                self.hang(name, BASE, bodies[name].com, None, bodies[name])
                hung.add(name)
                continue
            if self.widest:
                joint = max(edges, key=lambda j: (j.actuated, len(j.steps), joints.index(j)))
            else:
                joint = min(edges, key=lambda j: (not j.actuated, len(j.steps)))
            joints.remove(joint)
            back = joint.outer in hung
            parent, child = (joint.outer, joint.inner) if back else (joint.inner, joint.outer)
            steps = [(turns, -axis) for turns, axis in joint.steps[::-1]] if back else joint.steps
            self.hang(child, parent, joint.at, steps, bodies[child])
            hung.add(child)
            if joint.type.threaded():
                self._held.append((joint, ("thread",)))
        self._held += [(joint, joint.type.holds) for joint in joints]

    @abstractmethod
    def hang(self, name: str, parent: str, at: Array, steps: Steps | None, body: Body) -> None:
        """Add a body on its parent, by joints through a point at home; None: it is free."""

    @abstractmethod
    def finish(self) -> int:
        """Make the model, place it at home, and say how many rates it has."""

    @abstractmethod
    def place(self, full: Array, rates: Array) -> None:
        """Put the tree's configuration and rates, shape (size,)."""

    @abstractmethod
    def stepped(self, full: Array, step: Array) -> Array:
        """The configuration that a small motion leads to, shape (size,)."""

    @abstractmethod
    def neutral(self) -> Array:
        """The configuration at home."""

    def held(self) -> Iterable[tuple[Joint, Sequence[str]]]:
        """The joints that the tree leaves out, and threads."""
        return self._held

    def rod_rows(self, rod: Rod) -> Rows:
        """A rod's far end stays on its ball."""
        end = rod.ends[1]
        gap = self.point(_name(rod), end).minus(self.point(rod.outer, end))
        return Rows(gap.value, gap.columns, gap.bias)

    def assemble(self, q: Array) -> Array:
        """The configuration at ``q``, shape (n,), reached from home in equal steps.

        :raises UnfitError: Newton's method does not close the loops on the way.
        """
        q = np.asarray(q, dtype=float)
        if q.tobytes() not in self._assembled:
            # One is enough: torques, place and masses are asked for one state after another.
            self._assembled = {q.tobytes(): self._follow(q - self.machine.home)}
        full = self._assembled[q.tobytes()]
        self._at(full)
        return full

    def move(self, rates: Array) -> None:
        """Let the present assembly have rates, shape (size,)."""
        self.place(self._full, rates)

    def _at(self, full: Array) -> None:
        self._full = full
        self.place(full, np.zeros(self.size))

    def _follow(self, way: Array) -> Array:
        full = self.neutral()
        for number in range(1, STEPS + 1):
            self._at(full)
            full = self.stepped(full, self.tangent() @ way / STEPS)
            full = self._close(full, way * number / STEPS, number)
        return full

    def _close(self, full: Array, way: Array, number: int) -> Array:
        last = math.inf
        for _ in range(12):
            self._at(full)
            step = self.solve(-self.closures().value, self.missing(way))
            length = float(np.abs(step).max())
            if length > min(last / 2, 0.3):
                break
            full, last = self.stepped(full, step), length
            if length < 1e-15:
                break
        if last > 1e-12:
            raise UnfitError(f"loops stay open {number} / {STEPS} of the way from home")
        return full


def _name(rod: Rod) -> str:
    """Of the body that stands for a rod."""
    return f"rod {rod.name}"
