# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compute a machine as an engine's tree of joints, with the loops cut and closed here.

Each rod is a body on two hinges perpendicular to it. Positions follow by Newton's method in equal
steps from home. Kinematics and Jacobians of points and directions are the engine's; its inverse
dynamics of the tree is projected on the actuated joints.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable, Sequence

import numpy as np

from pkm_twin.certify.description import (
    BASE,
    Array,
    Body,
    Description,
    Joint,
    Rod,
    UnfitError,
    make_perpendicular_axes,
    read,
)
from pkm_twin.certify.rows import Engine, Rows

Steps = Sequence[tuple[bool, Array]]
"""Freedoms of a joint from parent to child: true for a rotation, and the axis at home."""


class Tree(Engine):
    """The base class of machines as trees with loop constraints.

    :raises UnfitError: the description cannot be read.
    """

    widest: bool
    """True if the tree takes joints with many freedoms first, else actuated joints with few freedoms."""

    def __init__(self, description: Description) -> None:
        self.machine = read(description)
        self._held: list[tuple[Joint, Sequence[str]]] = []
        # Build a spanning tree from the base; the remaining joints become equations.
        joints, bodies = list(self.machine.joints), self.machine.bodies
        attached = {BASE}
        while len(attached) <= len(bodies):
            edges = [j for j in joints if (j.inner in attached) != (j.outer in attached)]
            if not edges:
                # A body that only rods hold gets six freedoms; the tree continues from it.
                name = next(n for n in (self.machine.platform, *bodies) if n not in attached)
                self.add_body(name, BASE, bodies[name].com, None, bodies[name])
                attached.add(name)
                continue
            if self.widest:
                joint = max(edges, key=lambda j: (j.actuated, len(j.steps), joints.index(j)))
            else:
                joint = min(edges, key=lambda j: (not j.actuated, len(j.steps)))
            joints.remove(joint)
            back = joint.outer in attached
            parent, child = (joint.outer, joint.inner) if back else (joint.inner, joint.outer)
            steps = [(turns, -axis) for turns, axis in joint.steps[::-1]] if back else joint.steps
            self.add_body(child, parent, joint.at, steps, bodies[child])
            attached.add(child)
            if joint.type.threaded():
                self._held.append((joint, ("thread",)))
        self._held += [(joint, joint.type.holds) for joint in joints]
        for rod in self.machine.rods:
            unit = (rod.ends[1] - rod.ends[0]) / rod.length
            turning = rod.mass * rod.length**2 / 12 * (np.eye(3) - np.outer(unit, unit))
            body = Body(rod.mass, rod.ends.mean(0), turning)
            hinges = [(True, axis) for axis in make_perpendicular_axes(unit)]
            self.add_body(_rod_body_name(rod), rod.inner, rod.ends[0], hinges, body)
        self.size = self.finish()
        self._assembled: dict[bytes, Array] = {}

    @abstractmethod
    def add_body(self, name: str, parent: str, at: Array, steps: Steps | None, body: Body) -> None:
        """Add a body that moves on its parent by ``steps``: single motions at the point ``at``, home, m.

        Without ``steps`` (None) the body moves freely.
        """

    @abstractmethod
    def finish(self) -> int:
        """Complete the model at home; return its number of velocities."""

    @abstractmethod
    def set_state(self, full: Array, rates: Array) -> None:
        """Set the tree's configuration and velocities, shape (size,)."""

    @abstractmethod
    def step_from(self, full: Array, step: Array) -> Array:
        """Return the configuration after a small motion, shape (size,)."""

    @abstractmethod
    def neutral(self) -> Array:
        """Return the configuration at home."""

    def constraint_joints(self) -> Iterable[tuple[Joint, Sequence[str]]]:
        """List the loop-closing joints with their constraints, and the tree's screws with the thread constraint."""
        return self._held

    def rod_rows(self, rod: Rod) -> Rows:
        """Return the equations that hold a rod's far end at its ball joint."""
        end = rod.ends[1]
        gap = self.point(_rod_body_name(rod), end).minus(self.point(rod.outer, end))
        return Rows(gap.value, gap.columns, gap.bias)

    def assemble(self, q: Array) -> Array:
        """Set the configuration at ``q``, shape (n,), reached from home in equal steps; return it.

        :raises UnfitError: Newton's method does not close the loops on the way.
        """
        q = np.asarray(q, dtype=float)
        if q.tobytes() not in self._assembled:
            # One cached state is enough, because all quantities of a state are computed in a row.
            self._assembled = {q.tobytes(): self._continue_to(q - self.machine.home)}
        full = self._assembled[q.tobytes()]
        self._set_at_rest(full)
        return full

    def set_velocities(self, rates: Array) -> None:
        """Set the velocities of the present assembly, shape (size,)."""
        self.set_state(self._full, rates)

    def _set_at_rest(self, full: Array) -> None:
        self._full = full
        self.set_state(full, np.zeros(self.size))

    def _continue_to(self, goal: Array) -> Array:
        full, steps = self.neutral(), 64
        for number in range(1, steps + 1):
            self._set_at_rest(full)
            full = self.step_from(full, self.tangent() @ goal / steps)
            full = self._close_loops(full, goal * number / steps, f"{number} / {steps}")
        return full

    def _close_loops(self, full: Array, goal: Array, fraction: str) -> Array:
        last = math.inf
        for _ in range(12):
            self._set_at_rest(full)
            step = self.solve(-self.closures().value, self.remaining_motion(goal))
            length = float(np.abs(step).max())
            if length > min(last / 2, 0.3):
                break
            full, last = self.step_from(full, step), length
            if length < 1e-15:
                break
        if last > 1e-12:
            raise UnfitError(f"loops stay open {fraction} of the way from home")
        return full


def _rod_body_name(rod: Rod) -> str:
    """Return the name of the body that represents a rod."""
    return f"rod {rod.name}"
