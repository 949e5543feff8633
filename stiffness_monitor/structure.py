# SPDX-License-Identifier: Apache-2.0
"""The structural model of a robot in a pose: elastic beams, joints, rigid bodies, locked actuators.

It follows from the graph: every beam and every body that is no beam hangs on its parent through
the joint between them, whose freedoms let go and whose compliances give; the platform keeps its six
displacements, and what closes a loop between bodies that hang already is a closure.

May import: numpy, pkm_twin's core, the standard library; never rclpy.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.kinematics.motion import reaction_directions
from pkm_twin.machine.graph import BASE, Joint, Rod
from pkm_twin.machine.members import Beam, Section, Structure
from pkm_twin.machine.outline import Posture
from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]


def cross(a: Array, b: Array) -> Array:
    """Vector product of two vectors, shape (3,): numpy's costs ten times as much."""
    ax, ay, az = a.tolist()
    bx, by, bz = b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def size(vector: Array) -> float:
    """Length of a vector, shape (3,)."""
    return math.sqrt(float(vector @ vector))


RIGID: Final = (0.0,) * 6
"""Compliance of a joint that holds all six directions."""
FREE: Final = math.inf


@dataclass(frozen=True, eq=False)
class Support:
    """How one end of a member stands on a body.

    ``joint``: its name; joints of one name are one element of the energy shares. ``body``: the
    base, the platform, a rigid body, or a member, whose nearest end is meant. ``axes``: the
    joint's axes as columns, shape (3, 3). ``compliance``: along them three m/N, about them three
    rad/(N m); 0 rigid, infinite free.
    """

    joint: str
    body: str
    axes: Array
    compliance: tuple[float, ...] = RIGID


@dataclass(frozen=True, eq=False)
class Member:
    """A straight beam from ``start`` to ``end``, shape (3,), m.

    ``body`` is the name that it has in the energy shares: two rods can be one forearm. A member
    whose ``outer`` is None ends free, and others can stand there.
    """

    name: str
    body: str
    section: Section
    start: Array
    end: Array
    inner: Support
    outer: Support | None


@dataclass(frozen=True, eq=False)
class Carried:
    """A rigid body that stands on another at ``at``, m."""

    name: str
    at: Array
    support: Support


@dataclass(frozen=True, eq=False)
class Closure:
    """A joint at ``at`` between two bodies that both hang already."""

    at: Array
    inner: str
    support: Support


@dataclass(frozen=True, eq=False)
class RigidBody:
    """Mass of a body: mass (kg), centre of mass ``at`` (m).

    ``inertia`` about its centre of mass, shape (3, 3), kg m2; both along the base axes. ``body``:
    what it moves with.
    """

    name: str
    mass: float
    at: Array
    inertia: Array
    body: str


@dataclass(frozen=True, eq=False)
class StructuralModel:
    """The elastic machine in one pose; ``origin``: the platform's reference point, shape (3,)."""

    origin: Array
    platform: str
    parts: tuple[Member | Carried, ...]
    closures: tuple[Closure, ...]
    bodies: tuple[RigidBody, ...]


def structural_model(robot: Robot, pose: Array) -> StructuralModel:
    """The model in a pose, shape (m,).

    :raises ParameterError: the robot's file lacks a section that elasticity needs.
    :raises UnreachableError: no pose of the robot.
    """
    return _Builder(robot, robot.elastic, robot.inverse(pose)).build()


class _Builder:
    def __init__(self, robot: Robot, structure: Structure, q: Array) -> None:
        self.robot, self.structure, self.graph = robot, structure, robot.graph
        posture = Posture(robot, q)
        self.rotations, self.place = posture.rotations, posture.place
        self.beam_of = {part: beam for beam in structure.beams for part in beam.parts}
        self.hanging = {BASE, self.graph.platform}
        self.parts: list[Member | Carried] = []
        self.closures: list[Closure] = []

    def build(self) -> StructuralModel:
        left = [joint for joint in self.graph.joints.values() if not joint.given]
        rods = [
            (b, self.graph.rods[b.parts[0]])
            for b in self.structure.beams
            if b.parts[0] in self.graph.rods
        ]
        while left:
            # Bodies that one joint alone leads to come first, then whatever hangs.
            ready = [j for j in left if (self._hangs(j.inner) != self._hangs(j.outer))]
            if not ready:
                break
            joint = ready[0]
            left.remove(joint)
            self._hang(joint, left)
            for beam, rod in list(rods):
                if self._hangs(rod.inner) and self._hangs(rod.outer):
                    rods.remove((beam, rod))
                    self._rod(beam, rod)
        for joint in left:
            if self._inside(joint):
                continue
            support = Support(self._name(joint), self._part(joint.outer), *self._frame(joint))
            self.closures.append(
                Closure(self.place(joint.outer, joint.at), self._part(joint.inner), support)
            )
        for beam, rod in rods:
            self._rod(beam, rod)
        origin = self.place(self.graph.platform, self.graph.origin)
        return StructuralModel(
            origin, self.graph.platform, tuple(self.parts), tuple(self.closures),
            tuple(self._masses()),
        )  # fmt: skip

    def _inside(self, joint: Joint) -> bool:
        """Whether a joint is within one beam: a telescope's."""
        a, b = self.beam_of.get(joint.inner), self.beam_of.get(joint.outer)
        return a is not None and a is b

    def _hangs(self, body: str) -> bool:
        return body in self.hanging

    def _part(self, body: str) -> str:
        beam = self.beam_of.get(body)
        return body if beam is None else beam.name

    def _name(self, joint: Joint) -> str:
        return joint.label or joint.name

    def _frame(self, joint: Joint) -> tuple[Array, tuple[float, ...]]:
        """Axes of a joint in the pose as columns, and its compliance with its freedoms."""
        directions = reaction_directions(joint)
        axes = np.column_stack([self.rotations[d.body] @ d.vector for d in directions])
        values = list(self.structure.compliances.get(self._name(joint), RIGID))
        values = [0.0 if v == FREE else float(v) for v in values]
        if len(joint.axes) == 2:
            first = self.rotations[joint.inner] @ joint.axes[0]
            second = self.rotations[joint.outer] @ joint.axes[1]
            normal = cross(first, second)
            normal /= size(normal)
            # The freedoms span the plane of both axes, right-angled or not.
            turned = np.column_stack([first, cross(normal, first), normal])
            order = _matching(axes, turned)
            axes = turned
            values = [values[k] for k in order] + [values[3 + k] for k in order]
            values[3] = values[4] = FREE
        elif not joint.actuated:
            for freedom in joint.freedoms:
                k = int(np.argmax([abs(float(d.vector @ freedom.axis)) for d in directions]))
                values[3 * freedom.turns + k] = FREE
        return axes, tuple(values)

    def _hang(self, joint: Joint, left: list[Joint]) -> None:
        known, new = joint.inner, joint.outer
        if not self._hangs(known):
            known, new = new, known
        support = Support(self._name(joint), self._part(known), *self._frame(joint))
        at = self.place(new, joint.at)
        beam = self.beam_of.get(new)
        if beam is None:
            self.hanging.add(new)
            self.parts.append(Carried(new, at, support))
            return
        ends = [self.place(*beam.inner), self.place(*beam.outer)]
        if size(ends[1] - at) < size(ends[0] - at):
            ends.reverse()
        self.hanging.update(beam.parts)
        for part in [j for j in left if self._inside(j)]:
            if self.beam_of[part.inner] is beam:
                left.remove(part)
        outer: Support | None = None
        for other in left:
            for body, there in ((other.inner, other.outer), (other.outer, other.inner)):
                if body in beam.parts and self._hangs(there) and there not in beam.parts:
                    place = self.place(body, other.at)
                    near = size(place - ends[1]) < size(place - ends[0])
                    if outer is None and near:
                        outer = Support(self._name(other), self._part(there), *self._frame(other))
                        closing = other
        if outer is not None:
            left.remove(closing)
        section = self.structure.sections[beam.name]
        start, end = ends
        self.parts.append(Member(beam.name, beam.element, section, start, end, support, outer))

    def _rod(self, beam: Beam, rod: Rod) -> None:
        """On a ball joint at each end; it would spin idly, so the inner one holds that spin."""
        start, end = self.place(*beam.inner), self.place(*beam.outer)
        w = (end - start) / size(end - start)
        t = np.eye(3)[int(np.argmin(np.abs(w)))]
        if rod.pair is not None:
            t = self.rotations[rod.outer] @ rod.pair
        e = cross(t, w)
        e /= size(e)
        axes = np.column_stack([w, e, cross(w, e)])
        supports = []
        for name, body, spin in zip(
            rod.joint_names, (rod.inner, rod.outer), (0.0, FREE), strict=True
        ):
            held = [float(v) for v in self.structure.compliances.get(name, RIGID)[:3]]
            supports.append(Support(name, self._part(body), axes, (*held, spin, FREE, FREE)))
        section = self.structure.sections[beam.name]
        inner, outer = supports
        self.parts.append(Member(beam.name, beam.element, section, start, end, inner, outer))

    def _masses(self) -> Sequence[RigidBody]:
        """Of bodies that are no beams, and of the payload."""
        result = []
        carried = {n for beam in self.structure.beams for n in (*beam.parts, *beam.carries)}
        for name, body in self.graph.bodies.items():
            if name in carried or not body.mass > 0.0:
                continue
            turned = self.rotations[name]
            result.append(
                RigidBody(
                    name,
                    body.mass,
                    self.place(name, body.com),
                    turned @ body.inertia @ turned.T,
                    name,
                )
            )
        load, platform = self.robot.payload, self.graph.platform
        if load.mass > 0.0:
            turned = self.rotations[platform]
            at = self.place(platform, self.graph.origin + load.com)
            inertia = turned @ load.inertia @ turned.T
            result.append(RigidBody("payload", load.mass, at, inertia, platform))
        return result


def _matching(given: Array, turned: Array) -> list[int]:
    """Which given axis is each of other ones nearly along."""
    return [int(k) for k in np.abs(given.T @ turned).argmax(0)]
