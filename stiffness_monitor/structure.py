# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The structural model of a robot: elastic beams, joints, rigid bodies, locked actuators.

The graph determines it: each beam and each other body is attached to its parent by the joint
between them, which is free along its freedoms and elastic by its compliances. The platform has six
displacements of its own; a joint between two bodies that are already attached is a closure.

The plan states which part is attached to which, once, at home. In it a point or direction is a pair
of its body and its vector at home, a section is its beam's name, and a compliance is 0, infinite or
the joint's name and the entry. :func:`evaluate_plan` replaces these by numbers or expressions. For a
geometry of expressions the plan is that of their known values.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import SNAP, cross, reference, references
from pkm_twin.codegen.operations import maximum, sign, sqrt
from pkm_twin.kinematics.motion import reaction_directions
from pkm_twin.machine.graph import BASE, Graph, Joint
from pkm_twin.machine.members import Beam, Structure
from pkm_twin.robot.outline import Posture
from pkm_twin.robot.robot import Robot

Vector = Any
"""Body and vector at home in a plan; three numbers or expressions in a pose."""
Turn = Callable[[str, Array], Any]

RIGID: Final = (0.0,) * 6
"""Compliance of a joint that holds all six directions."""
FREE: Final = math.inf


def size(vector: Any) -> Any:
    """Return the length of a vector, shape (3,)."""
    return sqrt(vector @ vector)


def local_axes(along: Any) -> Any:
    """Return right-handed axes, columns (3, 3), whose first is the unit vector ``along``.

    No case divides by a small number (Duff et al. 2017).
    """
    x, y, z = along.tolist()
    side = 1.0 - 2.0 * maximum(0.0, -1.0 * sign(z))
    a = -1.0 / (side + z)
    b = x * y * a
    return np.array([[x, 1.0 + side * (x * x * a), b], [y, side * b, side + y * y * a], [z, -side * x, -y]])


@dataclass(frozen=True, eq=False)
class Support:
    """Describe how one end of a member, or a body, is attached to another body.

    ``joint``: its name; joints of one name are one element of the energy shares. ``body``: the
    base, the platform, a rigid body, or a member, then at its start (``end`` 0) or its end (1).
    ``axes``: the joint's axes as columns, shape (3, 3); None in a plan: the member's own.
    ``compliance``: along them three m/N, about them three rad/(N m); 0 rigid, infinite free.
    ``screws``: axes about which it turns freely while it goes so far along them, m a rad. ``at``:
    the joint's position, at a rigid lever from the member's end; None if the joint is at that end.
    """

    joint: str
    body: str
    axes: Any
    compliance: tuple[Any, ...] = RIGID
    end: int = 0
    screws: tuple[tuple[int, float], ...] = ()
    at: Vector | None = None


@dataclass(frozen=True, eq=False)
class Member:
    """Describe a straight beam from ``start`` to ``end``, shape (3,), m.

    ``body`` is the name that it has in the energy shares: two rods can be one forearm. A member
    whose ``outer`` is None ends free; other parts can attach there. ``strut``: held by a ball joint
    at each end, so that a load at its ends goes along it. ``constant``: its length where that is
    the same in every pose.
    """

    name: str
    body: str
    section: Any
    start: Vector
    end: Vector
    inner: Support
    outer: Support | None
    strut: bool = False
    constant: Any = None

    @cached_property
    def length(self) -> Any:
        """Length in a pose, m."""
        return size(self.end - self.start) if self.constant is None else self.constant

    @cached_property
    def axes(self) -> Any:
        """Its own axes in a pose as columns, the first along it."""
        return local_axes((self.end - self.start) * (1.0 / self.length))


@dataclass(frozen=True, eq=False)
class Carried:
    """Describe a rigid body that is attached to another at ``at``, m."""

    name: str
    at: Vector
    support: Support


@dataclass(frozen=True, eq=False)
class Closure:
    """Describe a joint at ``at`` between two bodies that are already attached.

    ``inner``: name and end of the first body, as in a support.
    """

    at: Vector
    inner: tuple[str, int]
    support: Support


@dataclass(frozen=True, eq=False)
class RigidBody:
    """Describe the mass of a body: mass (kg), centre of mass ``at`` (m).

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
    """Describe the elastic machine; ``origin``: the platform's reference point, shape (3,)."""

    origin: Vector
    platform: str
    parts: tuple[Member | Carried, ...]
    closures: tuple[Closure, ...] = ()
    bodies: tuple[RigidBody, ...] = ()

    @property
    def members(self) -> tuple[Member, ...]:
        """The beams among the parts."""
        return tuple(part for part in self.parts if isinstance(part, Member))

    @property
    def supports(self) -> tuple[Support, ...]:
        """All joints: those of the parts in order, then those of the loop closures."""
        found: list[Support | None] = []
        for part in self.parts:
            found += [part.support] if isinstance(part, Carried) else [part.inner, part.outer]
        return tuple(s for s in (*found, *(c.support for c in self.closures)) if s is not None)

    @property
    def rigid_chain(self) -> tuple[str, ...]:
        """Joints that connect base and platform by rigid bodies alone; empty without a chain."""
        edges = [(p.support.body, p.name, p.support) for p in self.parts if isinstance(p, Carried)]
        edges += [(c.inner[0], c.support.body, c.support) for c in self.closures]
        chains: dict[str, tuple[str, ...]] = {BASE: ()}
        for _ in edges:
            for one, other, support in edges:
                for near, far in ((one, other), (other, one)):
                    if near in chains:
                        chains.setdefault(far, (*chains[near], support.joint))
        return chains.get(self.platform, ())


def structural_model(robot: Robot, q: ArrayLike) -> StructuralModel:
    """Return the structural model at joint positions, shape (n,), on numbers.

    :raises ParameterError: the robot's file lacks a section that elasticity needs.
    :raises UnreachableError: no assembly of the robot; a singularity as ``forward``.
    """
    structure, posture = robot.elastic, Posture(robot, q)
    model = evaluate_plan(
        plan_structure(robot.graph, structure),
        posture.locate_point,
        posture.rotate_vector,
        structure.sections.__getitem__,
        lambda joint, k: float(structure.compliances[joint][k]),
    )
    # Rigid bodies that are not modelled as beams, and the payload, with their inertia in the pose.
    graph, load = robot.graph, robot.payload
    beams = {n for beam in structure.beams for n in (*beam.parts, *beam.carries)}
    lumps = [(name, b.mass, b.com, b.inertia, name) for name, b in graph.bodies.items() if name not in beams]
    lumps.append(("payload", load.mass, graph.origin + load.com, load.inertia, graph.platform))
    bodies = (
        RigidBody(
            name,
            mass,
            posture.locate_point(on, com),
            posture.rotate_vector(on, posture.rotate_vector(on, inertia).T),
            on,
        )
        for name, mass, com, inertia, on in lumps
        if mass > 0.0
    )
    return replace(model, bodies=tuple(bodies))


def evaluate_plan(
    plan: StructuralModel,
    place: Callable[[str, Array], Any],
    turn: Turn,
    section: Callable[[str], Any],
    compliance: Callable[[str, int], Any],
) -> StructuralModel:
    """Evaluate a plan in a pose, on numbers or on expressions.

    :param place: returns the position of a body's point, given at home. ``turn``: rotates a direction of a body.
    :param section: returns a beam's section. ``compliance``: returns an entry of a joint's compliance.
    """

    def evaluate_support(support: Support, member_axes: Any = None) -> Support:
        """Return a support with its axes, compliance and position in the pose."""
        values = (v if isinstance(v, float) else compliance(*v) for v in support.compliance)
        axes = member_axes if support.axes is None else joint_axes_matrix(support.axes, turn)
        at = None if support.at is None else place(*support.at)
        return replace(support, axes=axes, compliance=tuple(values), at=at)

    def evaluate_part(part: Member | Carried) -> Member | Carried:
        if isinstance(part, Carried):
            return replace(part, at=place(*part.at), support=evaluate_support(part.support))
        made = replace(part, start=place(*part.start), end=place(*part.end), section=section(part.section))
        outer = None if made.outer is None else evaluate_support(made.outer, made.axes)
        return replace(made, inner=evaluate_support(made.inner, made.axes), outer=outer)

    return replace(
        plan,
        origin=place(*plan.origin),
        parts=tuple(evaluate_part(part) for part in plan.parts),
        closures=tuple(replace(c, at=place(*c.at), support=evaluate_support(c.support)) for c in plan.closures),
    )


def joint_axes_matrix(given: Sequence[tuple[str, Array]], turn: Turn) -> Any:
    """Return a joint's axes as columns, shape (3, 3).

    For two rotation axes, at any angle: the first axis, the one perpendicular to it in the plane of
    both, and that plane's normal.
    """
    columns = [turn(*one) for one in given]
    if len(columns) == 2:
        normal = cross(*columns)
        normal = normal * (1.0 / size(normal))
        columns = [columns[0], cross(normal, columns[0]), normal]
    return np.array([[*column] for column in columns]).T


def plan_structure(graph: Graph, structure: Structure) -> StructuralModel:
    """Decide which part is attached to which, from the graph at home."""
    return _StructurePlanner(graph, structure).plan()


class _StructurePlanner:
    """Attach bodies, beams and rods to each other, beginning at base and platform."""

    def __init__(self, graph: Graph, structure: Structure) -> None:
        self.graph, self.structure = graph, structure
        self.beam_of = {part: beam for beam in structure.beams for part in beam.parts}
        self.beam_of.pop(graph.platform, None)
        self.points: dict[str, list[Array]] = {BASE: [np.zeros(3)], graph.platform: [graph.origin]}
        """Points at home at which others can attach, by attached part."""
        self.parts: list[Member | Carried] = []

    def plan(self) -> StructuralModel:
        remaining = [joint for joint in self.graph.joints.values() if not joint.virtual]
        rods = [beam for beam in self.structure.beams if beam.parts[0] in self.graph.rods]
        while True:
            # Joints between an attached and an unattached body, in order.
            attachable = [j for j in remaining if self._is_attached(j.inner) != self._is_attached(j.outer)]
            if not attachable:
                break
            remaining.remove(attachable[0])
            self._attach(attachable[0], remaining)
            for beam in list(rods):
                if self._is_attached(beam.inner[0]) and self._is_attached(beam.outer[0]):
                    rods.remove(beam)
                    self._add_rod(beam)
        closures = tuple(
            Closure(
                (joint.outer, joint.at),
                self._find_support(joint.inner, joint.at),
                self._joint_support(joint, joint.outer, joint.at),
            )
            for joint in remaining
            if not self._is_inside_beam(joint)
        )
        for beam in rods:
            self._add_rod(beam)
        graph = self.graph
        origin = (graph.platform, graph.origin)
        return StructuralModel(origin, graph.platform, tuple(self.parts), closures)

    def _is_inside_beam(self, joint: Joint) -> bool:
        """Return whether a joint connects two bodies of one beam, as in a telescope."""
        a, b = self.beam_of.get(joint.inner), self.beam_of.get(joint.outer)
        return a is not None and a is b

    def _part_name(self, body: str) -> str:
        beam = self.beam_of.get(body)
        return body if beam is None else beam.name

    def _is_attached(self, body: str) -> bool:
        return self._part_name(body) in self.points

    def _find_support(self, body: str, at: Array) -> tuple[str, int]:
        """Return the attached part of a body, and the end nearest to a position."""
        part = self._part_name(body)
        if part not in self.points:
            raise ValueError(f"{part} is not connected to the base")
        distances = [reference(size(point - at)) for point in self.points[part]]
        return part, int(np.argmin(distances))

    def _joint_support(self, joint: Joint, body: str, at: Array) -> Support:
        part, end = self._find_support(body, at)
        name = joint.label or joint.name
        directions = reaction_directions(joint)
        vectors = np.array([d.vector for d in directions])
        axes: tuple[tuple[str, Array], ...] = tuple((d.body, d.vector) for d in directions)
        values, screws = self._joint_compliance(name), []
        if joint.type.count == 2:
            axes = (joint.inner, joint.axes[0]), (joint.outer, joint.axes[1])
            # Match each axis with the given direction that is nearly parallel.
            along = references(vectors @ joint_axes_matrix(axes, lambda _, vector: vector))
            order = np.abs(along).argmax(0).tolist()
            values = [values[k] for k in order] + [values[3 + k] for k in order]
            values[3] = values[4] = FREE
        elif not joint.actuated:
            for freedom in joint.freedoms:
                k = freedom.nearest(vectors)
                if freedom.turns and freedom.slide:
                    screws.append((k, freedom.slide))
                else:
                    values[3 * freedom.turns + k] = FREE
        return Support(name, part, axes, tuple(values), end, tuple(screws))

    def _member_support(self, joint: Joint, body: str, end: tuple[str, Array]) -> Support:
        """Return the support of a member's end by a joint, which may be away from that end."""
        lever = joint.at - end[1]
        # If geometry stays symbolic, keep the lever even at zero length: its derivatives are not zero.
        is_symbolic = getattr(getattr(lever[0], "tape", None), "free", False)
        if not joint.type.placed or not (is_symbolic or np.abs(references(lever)).max() >= SNAP):
            return self._joint_support(joint, body, end[1])
        own = joint.outer if body == joint.inner else joint.inner
        return replace(self._joint_support(joint, body, joint.at), at=(own, joint.at))

    def _joint_compliance(self, name: str) -> list[Any]:
        """Return a joint's compliance for the plan: infinite entries of the file are 0 here, and set free later."""
        values = enumerate(self.structure.compliances.get(name, RIGID))
        return [(name, k) if 0.0 < reference(value) < FREE else 0.0 for k, value in values]

    def _attach(self, joint: Joint, remaining: list[Joint]) -> None:
        known, new = joint.inner, joint.outer
        if not self._is_attached(known):
            known, new = new, known
        beam = self.beam_of.get(new)
        if beam is None:
            self.parts.append(Carried(new, (new, joint.at), self._joint_support(joint, known, joint.at)))
            self.points[new] = [joint.at]
            return
        ends = [beam.inner, beam.outer]
        if _is_nearer(joint.at, ends[1][1], ends[0][1]):
            ends.reverse()
        support = self._member_support(joint, known, ends[0])
        for part in [j for j in remaining if self._is_inside_beam(j)]:
            if self.beam_of[part.inner] is beam:
                remaining.remove(part)
        closing = None
        for other in remaining:
            for body, other_body in ((other.inner, other.outer), (other.outer, other.inner)):
                if body in beam.parts and self._is_attached(other_body) and other_body not in beam.parts:
                    near = _is_nearer(other.at, ends[1][1], ends[0][1])
                    if closing is None and near:
                        closing = other, other_body
        outer = None
        if closing is not None:
            remaining.remove(closing[0])
            outer = self._member_support(*closing, ends[1])
        self._add_member(beam, ends, support, outer)

    def _add_member(self, beam: Beam, ends: list[Any], inner: Support, outer: Support | None) -> None:
        is_rod = beam.parts[0] in self.graph.rods
        length = size(ends[1][1] - ends[0][1])
        if not reference(length) > 0.0:
            raise ValueError(f"{beam.name} has no length")
        self.points[beam.name] = [point for _, point in ends]
        constant_length = is_rod or ends[0][0] == ends[1][0]
        self.parts.append(
            Member(
                beam.name,
                beam.element,
                beam.name,
                ends[0],
                ends[1],
                inner,
                outer,
                is_rod,
                length if constant_length else None,
            )
        )

    def _add_rod(self, beam: Beam) -> None:
        """Add a rod with a ball joint at each end; the inner joint blocks rotation about the rod's own axis."""
        rod = self.graph.rods[beam.parts[0]]
        supports = []
        for name, (body, at), spin in zip(rod.joint_names, (beam.inner, beam.outer), (0.0, FREE), strict=True):
            values = (*self._joint_compliance(name)[:3], spin, FREE, FREE)
            part, end = self._find_support(body, at)
            supports.append(Support(name, part, None, values, end))
        self._add_member(beam, [beam.inner, beam.outer], *supports)


def _is_nearer(at: Array, first: Array, second: Array) -> bool:
    return reference(size(at - first)) < reference(size(at - second))
