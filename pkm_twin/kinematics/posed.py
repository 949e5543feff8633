# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A machine whose platform is placed first, by a chain of virtual joints, and then its limbs.

The chain has a prismatic or revolute joint for each coordinate of the platform that the machine's
joints leave free. If the joints of the pose coordinates are actuated, the machine's own joints
follow: solving the closures of this graph is the inverse kinematics, limb by limb, and generalised
forces on the pose coordinates give the machine's efforts. If the machine's own joints are actuated,
it is the forward kinematics.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import SNAP, Numbers, Objects
from pkm_twin.codegen.lu import Order, SparseLU, independent_rows, pivot_order
from pkm_twin.codegen.operations import sqrt
from pkm_twin.kinematics import pose as poses
from pkm_twin.kinematics.diagnosis import mobility_error
from pkm_twin.kinematics.iterations import newton
from pkm_twin.kinematics.limb_pose import Limb, LimbPose, place_in_order, sign_of
from pkm_twin.kinematics.limbs import MAX_CLOSED_FORM_ERROR, order_bodies
from pkm_twin.kinematics.linkage import SAMPLE_RADIUS
from pkm_twin.kinematics.motion import Motion, closure_jacobians, to_floats
from pkm_twin.kinematics.pose import Coordinate
from pkm_twin.kinematics.scheme import Scheme
from pkm_twin.machine.graph import BASE, Body, Graph, Joint, array
from pkm_twin.machine.joints import UNIT_VECTORS
from pkm_twin.machine.tree import Link, Tree

OPEN_STATES: Final = 4
"""Number of random states of an open tree: in a single one a coordinate may be zero by chance."""
MAX_ROUNDING_CHANGE: Final = 1e-8
"""Largest dimensionless change of a coordinate that is attributed to rounding of sampled states."""


@dataclass(frozen=True)
class VirtualJoint:
    """A virtual joint of the chain, along or about a base axis at home.

    ``pose_index``: index of its pose coordinate; None for another coordinate of the platform.
    ``constrained``: the closures keep it at its home value. ``joint``: the machine's joint that it
    replaces, with the same point; empty: none, and its axis passes through the reference point.
    ``end``: the body that it moves; empty: a massless body.
    """

    name: str
    coordinate: Coordinate
    axis: int
    pose_index: int | None
    constrained: bool = False
    joint: str = ""
    end: str = ""

    @property
    def turns(self) -> bool:
        """True for a revolute joint, false for a prismatic one."""
        return self.coordinate.axis is None


@dataclass(frozen=True)
class PoseChain:
    """Prismatic and revolute joints from the base to the platform."""

    virtual_joints: tuple[VirtualJoint, ...]

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints of the chain."""
        return tuple(f"pose {virtual.name}" for virtual in self.virtual_joints)

    def attach(self, graph: Graph, *, by_pose: bool) -> Graph:
        """Return the graph with the chain added; rotations as in the 3-PRRU paper, equation 1.

        :param by_pose: actuate the pose coordinates instead of the machine's joints.
        """
        chain: list[tuple[int, Joint]] = []
        massless: dict[str, Body] = {}
        end, replaced = BASE, {virtual.joint for virtual in self.virtual_joints}
        for virtual, name in zip(self.virtual_joints, self.joints, strict=True):
            start, end = end, virtual.end or f"carrier of {virtual.name}"
            if not virtual.end:
                massless[end] = Body(end)
            given = by_pose and virtual.pose_index is not None
            home = graph.origin[virtual.axis] if given and not virtual.turns else 0.0
            at = graph.joints[virtual.joint].at if virtual.joint else graph.origin
            joint = Joint(
                name,
                "revolute" if virtual.turns else "prismatic",
                start,
                end,
                at,
                array(UNIT_VECTORS[virtual.axis : virtual.axis + 1]),
                actuated=given,
                home=home,
            )
            chain.append((len(self.virtual_joints) if virtual.pose_index is None else virtual.pose_index, joint))
        # Actuated joints have the order of the pose.
        joints = {joint.name: joint for _, joint in sorted(chain, key=lambda pair: pair[0])}
        for name, joint in graph.joints.items():
            if name not in replaced and not by_pose:
                joints[name] = joint
            elif name not in replaced:
                passive = replace(
                    joint,
                    actuated=False,
                    follows=False,
                    viscous=0.0,
                    coulomb=0.0,
                    rotor_inertia=0.0,
                )
                joints[name] = passive if joint.actuated else joint
        graph = replace(graph, bodies={**graph.bodies, **massless}, joints=joints)
        return replace(graph, laws=(), sharing=array([])) if by_pose else graph


def find_pose_chain(scheme: Scheme) -> PoseChain:
    """Find the chain of virtual joints whose coordinates are the machine's pose.

    It replaces joints whose coordinates already are pose coordinates, for example a universal joint
    between base and platform; otherwise it is added to the machine's joints.
    """
    graph, given = scheme.graph, scheme.coordinates
    entries = {c.entries for c in given if c.entries}
    sequence = next(t for t in poses.ANGLE_AXES.values() if entries <= {c.entries for c in t})
    every = [*(poses.COORDINATES[name] for name in "xyz"), *sequence]
    closed = _find_varying(scheme, every, scheme.samples)
    # Coordinates that the tree's joints keep constant, as in a planar machine, need no joint.
    opened = _find_varying(scheme, every, _sample_open_states(scheme))
    virtual_joints = []
    for c, varies, moves in zip(every, closed, opened, strict=True):
        place = next(
            (i for i, own in enumerate(given) if (own.axis, own.entries) == (c.axis, c.entries)),
            None,
        )
        if place is not None:
            virtual_joints.append(VirtualJoint(given[place].name, c, _axis_of(c), place))
        elif moves:
            kind = "slide" if c.axis is not None else "turn"
            name = f"{'xyz'[_axis_of(c)]} {kind}"
            virtual_joints.append(VirtualJoint(name, c, _axis_of(c), None, constrained=not varies))
    own = [virtual for virtual in virtual_joints if virtual.pose_index is not None]
    joints = _replace_joints(scheme, own)
    if joints:
        return PoseChain(joints)
    return PoseChain((*virtual_joints[:-1], replace(virtual_joints[-1], end=graph.platform)))


def _find_varying(
    scheme: Scheme, coordinates: Sequence[Coordinate], states: Sequence[tuple[Array, Array]]
) -> list[bool]:
    """Return which coordinates of the platform vary over states (x, q) of a machine."""
    placed = [tuple(to_floats(part) for part in scheme.evaluate_state(x, q)[0].platform()) for x, q in states]
    table = np.array([poses.evaluate_coordinates(coordinates, *state) for state in placed], float)
    scales = [scheme.tree.size if c.axis is not None else 1.0 for c in coordinates]
    return [len(states) == 1 or bool(change > MAX_ROUNDING_CHANGE) for change in np.ptp(table, axis=0) / scales]


def _sample_open_states(scheme: Scheme) -> list[tuple[Array, Array]]:
    """Draw random states of a machine's tree, whose loops may be open."""
    random, tree, home = np.random.default_rng(0), scheme.tree, scheme.graph.lead_home
    motion = Motion(tree, tree.home, home)
    states = []
    for _ in range(OPEN_STATES):
        move = random.uniform(-SAMPLE_RADIUS, SAMPLE_RADIUS, tree.unknown_rates) / np.array(tree.scales)
        drives = [scheme.drive_scale(name) for name in scheme.graph.leads]
        q = home + random.uniform(-SAMPLE_RADIUS, SAMPLE_RADIUS, len(home)) / np.array(drives)
        states.append((np.array(motion.retract(tree.home, move), float), q))
    return states


def _axis_of(coordinate: Coordinate) -> int:
    """Return the base axis that a coordinate slides along or turns about."""
    if coordinate.axis is not None:
        return coordinate.axis
    return next(
        abs(first - k)
        for first, turns in ((2, poses.ANGLE_AXES["zyx"]), (0, poses.ANGLE_AXES["xyz"]))
        for k, turn in enumerate(turns)
        if turn.entries == coordinate.entries
    )


def _replace_joints(
    scheme: Scheme,
    virtual_joints: Sequence[VirtualJoint],
    body: str = BASE,
    passed: frozenset[str] = frozenset(),
) -> tuple[VirtualJoint, ...]:
    """Return virtual joints that replace a chain of joints from a body to the platform.

    The joints' coordinates are the pose coordinates; empty if there is no such chain. Rotation axes
    need not meet in one point, but if there are slides too, they go through the reference point.
    """
    graph = scheme.graph
    if not virtual_joints:
        return ()
    for joint in graph.joints.values():
        if joint.name in passed or body not in (joint.inner, joint.outer):
            continue
        end = joint.outer if body == joint.inner else joint.inner
        freedoms = joint.freedoms if body == joint.inner else joint.freedoms[::-1]
        mine, rest = virtual_joints[: len(freedoms)], virtual_joints[len(freedoms) :]
        if not freedoms or len(mine) < len(freedoms) or joint.actuated or bool(rest) == (end == graph.platform):
            continue
        # Each freedom must be a slide or a rotation along the base axis of its virtual joint.
        if not all(
            c.turns == f.turns and not (f.turns and f.slide) and abs(abs(f.axis[c.axis]) - 1.0) < SNAP
            for f, c in zip(freedoms, mine, strict=True)
        ):
            continue
        slides = any(not c.turns for c in virtual_joints)
        if slides and any(c.turns for c in mine) and np.abs(joint.at - graph.origin).max() > 0.0:
            continue
        own = [replace(c, joint=joint.name) for c in mine]
        own[-1] = replace(own[-1], end=end)
        more = _replace_joints(scheme, rest, end, passed | {joint.name}) if rest else ()
        if more or not rest:
            return (*own, *more)
    return ()


class PlatformFirstScheme(Scheme):
    """Solution scheme of a machine whose platform is placed before its limbs.

    Its inputs are the pose, or the machine's own joint positions: then the unknowns are the
    platform's coordinates, and those of limbs without closed form.
    """

    def __init__(self, machine: Scheme, *, by_pose: bool) -> None:
        """Build the tree in which a chain of virtual joints, or a free joint, places the platform.

        :param by_pose: the pose is the input.
        """
        self.machine, self.by_pose = machine, by_pose
        self.chain = find_pose_chain(machine)
        varying = [c for c in self.chain.virtual_joints if not c.constrained]
        self._free = not by_pose and sum(c.turns for c in varying) == 3
        first = (machine.graph.platform,) if self._free else self.chain.joints
        super().__init__(self.attach_chain(machine.graph), machine.coordinates, first=first)

    def attach_chain(self, graph: Graph) -> Graph:
        """Return the graph with the chain; without it if the platform has a free joint."""
        return graph if self._free else self.chain.attach(graph, by_pose=self.by_pose)

    @cached_property
    def constrained_rates(self) -> list[int]:
        """Indices of the unknown rates of platform coordinates that the closures keep at home."""
        virtual_joints = zip(self.chain.joints, self.chain.virtual_joints, strict=True)
        names = () if self._free else [name for name, virtual in virtual_joints if virtual.constrained]
        return [self.tree.steps[name].rate for name in names]

    @cached_property
    def varying(self) -> list[int]:
        """Indices of the unknown rates that are solved: all but :attr:`constrained_rates`."""
        return [k for k in range(self.tree.unknown_rates) if k not in self.constrained_rates]

    @cached_property
    def _constraining(self) -> tuple[list[int], Order]:
        """:attr:`constraining_closures` and :attr:`constraining_pivots`."""
        ju, _ = self._sampled_jacobians
        first = ju[:, self.independent]
        follow = np.linalg.solve(first[:, :, self.varying], first[:, :, self.constrained_rates])
        table = ju[:, :, self.constrained_rates] - ju[:, :, self.varying] @ follow
        rows = independent_rows(table)
        if len(rows) < len(self.constrained_rates):
            raise mobility_error(self)
        return rows, pivot_order(table[:, rows])

    @property
    def constraining_closures(self) -> list[int]:
        """Indices of the closures that keep platform coordinates at their home values."""
        return self._constraining[0]

    @property
    def constraining_pivots(self) -> Order:
        """Elimination order of :attr:`constraining_closures` by :attr:`constrained_rates`."""
        return self._constraining[1]

    @cached_property
    def samples(self) -> list[tuple[Array, Array]]:
        """The machine's states at home and near it, in the coordinates of this tree."""
        return [self._convert_state(x, q) for x, q in self.machine.samples]

    def _convert_state(self, x: Array, q: Array) -> tuple[Array, Array]:
        """Convert a state (x, q) of the machine to this tree's coordinates."""
        motion, _ = self.machine.evaluate_state(x, q)
        position, rotation = (to_floats(part) for part in motion.platform())
        x = np.array(self.tree.home, float)
        virtual_joints = zip(self.chain.joints, self.chain.virtual_joints, strict=True)
        free = {n: c.coordinate for n, c in virtual_joints if not (self.by_pose and c.pose_index is not None)}
        if self.by_pose:
            q = np.array(poses.evaluate_coordinates(self.coordinates, position, rotation), float)
        for link in self.tree.links.values():
            if link.joint in free:
                c = free[link.joint]
                (value,) = poses.evaluate_coordinates([c], position, rotation)
                (step,) = link.steps
                if step.turns:
                    x[step.position : step.position + 2] = math.cos(value), math.sin(value)
                else:
                    x[step.position] = value - float(self.graph.origin[_axis_of(c)])
            elif link.joint not in self.chain.joints:
                _compute_joint_coordinates(self.tree, link, motion, x)
        return x, q

    @cached_property
    def order(self) -> tuple[str | Limb, ...]:
        """Bodies in the order in which they are placed, limbs in closed form among them."""
        return order_bodies(self)

    @cached_property
    def platform_pivots(self) -> Order | None:
        """Elimination order (equation, slide) of :meth:`close_platform`; None: it does not apply.

        It applies if the limbs in closed form leave only translations and at most one rotation of
        the platform to Newton's method, and if it reproduces the sampled states.
        """
        places, rates = self.newton_unknowns
        steps = [self.tree.steps[name] for name in self.chain.joints] if self.by_pose else []
        left = [step for step in steps if not step.actuated and step.rate in rates]
        slides = [step.rate for step in left if not step.circle]
        if not left or len(left) != len(rates) or len(slides) < len(left) - 1:
            return None
        tables = np.array([to_floats(self._affine_rows(self.tree, q)[1])[:, slides] for _, q in self.samples])
        kept = independent_rows(tables) if slides else []
        if len(kept) < len(slides):
            return None
        order = pivot_order(tables[:, kept]) if slides else ()
        pivots = tuple((kept[row], slides[column]) for row, column in order)
        with np.errstate(all="ignore"):
            apart = [
                to_floats(self.close_platform(self.tree, q, pivots)[0]) - np.array(x, float)[places]
                for x, q in self.samples
            ]
        return pivots if (np.abs(apart) < MAX_CLOSED_FORM_ERROR).all() else None

    def _affine_rows(self, tree: Tree, q: Numbers) -> tuple[Objects, Objects, Objects]:
        """Return the platform's remaining equations: d + G slides + h cos + k sin = 0.

        :returns: residuals with slides and turn at 0, (rows,); their derivatives by all unknown
            rates, (rows, rates); the derivatives after a quarter turn.
        """
        found = []
        for cosine in (1.0, 0.0):
            x = np.array(tree.home, dtype=object)
            for step in (tree.steps[name] for name in self.chain.joints):
                if not step.actuated and step.circle:
                    x[step.position : step.position + 2] = cosine, 1.0 - cosine
            motion, limbs = self.place(tree, x, q)
            rows = self.newton_rows(motion.closures(), limbs)
            found += [np.array([row.value for row in rows], object), closure_jacobians(tree, rows)[0]]
        return found[0], found[1], found[3]

    def close_platform(self, tree: Tree, q: Numbers, pivots: Order) -> tuple[list[Any], Any]:
        """Find the platform's unknowns in closed form, numerically or symbolically.

        Translations are eliminated; of the two solutions of the last equation, a cos + b sin = c,
        the one on the branch of home is taken (for a 3-RPS: Lee and Shah 1988).

        :returns: the unknowns, and the squared growth of rounding errors, which is infinite where a
            pivot or the root vanishes: there any unknowns would satisfy the equations.
        """
        steps = {step.rate: step for step in tree.steps.values() if not step.actuated}
        order, slides = [row for row, _ in pivots], [column for _, column in pivots]
        turn = next((steps[rate] for rate in self.newton_unknowns[1] if rate not in slides), None)

        def eliminate(q: Numbers) -> tuple[Objects, SparseLU, Objects, Objects, list[Any]]:
            values, table, quarter = self._affine_rows(tree, q)
            lu = SparseLU(table[order][:, slides], tuple((k, k) for k in range(len(order))))
            if turn is None:
                return values, lu, values, values, []
            last = next(k for k in range(len(values)) if k not in order)
            weights = lu.solve_transposed(table[last, slides])
            h, k = -quarter[:, turn.rate], table[:, turn.rate]
            return values, lu, h, k, [row[last] - weights @ row[order] for row in (h, k, h - values)]

        (values, lu, h, k, last), (_, lu_home, _, _, last_home) = (eliminate(p) for p in (q, tree.graph.lead_home))
        growth = lu.find_growth(lu_home.inverse_pivots, np.ones(lu.size), every=True)
        x = np.array(tree.home, dtype=object)
        if turn is not None:
            (a, b, c), (_, root_home, _) = last, last_home
            square = a * a + b * b
            left = square - c * c
            side = -sign_of(root_home) * sqrt(left)
            growth = growth + root_home * root_home / left
            cosine, sine = (a * c - b * side) / square, (b * c + a * side) / square
            x[turn.position : turn.position + 2] = cosine, sine
            values = values + h * (cosine - 1.0) + k * sine
        for rate, value in zip(slides, lu.solve(-values[order]), strict=True):
            x[steps[rate].position] = value
        return list(x[self.newton_unknowns[0]]), growth

    @property
    def has_closed_limbs(self) -> bool:
        """True if Newton's method solves for the platform's coordinates only."""
        stem = self.tree.chain_to_base(self.graph.platform)
        opened = [entry for entry in self.order if not isinstance(entry, Limb)]
        passive = (b for b in opened if not all(s.actuated for s in self.tree.links[b].steps))
        return set(passive) <= set(stem)

    @property
    def checked_closures(self) -> list[int]:
        """Indices of the closures that no limb's closed form satisfies by construction."""
        solved = {k for limb in self.limbs for k in limb.rows}
        return [k for k in range(len(self.parts)) if k not in solved]

    def find_shortfall(self, pose: Array) -> tuple[str, float] | None:
        """Return the joint or rod that closes the first limb that is too short, and the gap, m.

        For a machine driven by its pose. None: unknown, because a limb has no closed form. The gap
        is 0 if all closures are satisfied.
        """
        rates = self.newton_unknowns[1]
        inner = {
            step.rate
            for body in self.tree.chain_to_base(self.graph.platform)
            for step in self.tree.links[body].steps
            if not step.actuated
        }
        if not set(rates) <= inner:
            return None
        limbs: list[LimbPose] = []

        def evaluate_closures(x: Array) -> tuple[Array, Array]:
            """Return the dimensionless residuals of Newton's equations at x, and their Jacobian."""
            motion, limbs[:] = place_in_order(self.tree, self.order, np.array(x, dtype=object), pose, closest=True)
            rows = self.newton_rows(motion.closures(), limbs)
            values = [row.scale * float(row.value) for row in rows]
            return np.array(values), self.scaled_jacobians(rows)[0][:, rates]

        def move(x: Array, step: Array) -> Array:
            change = np.zeros(self.tree.unknown_rates)
            change[rates] = step / np.array(self.tree.scales)[rates]
            return np.array(Motion(self.tree, x, pose).retract(x, change), float)

        with np.errstate(all="ignore"):
            if not newton(np.array(self.tree.home, float), evaluate_closures, move)[1]:
                return None
        misses = {limb.part: found.miss for limb, found in zip(self.limbs, limbs, strict=True)}
        return next((short for short in misses.items() if short[1] > 0.0), (self.parts[0], 0.0))

    @cached_property
    def drive_pivots(self) -> Order:
        """Elimination order of the leading drives' rates by the pose's rates, good near home."""
        graph, tree = self.machine.graph, self.tree
        ju, jq = self._sampled_jacobians
        steps = {step.joint: step.rate for link in tree.links.values() for step in link.steps}
        rates = [self.varying.index(steps[name]) for name in graph.leads]
        tables = []
        for u, q in zip(ju[:, self.independent], jq[:, self.independent], strict=True):
            tables.append(-np.linalg.solve(u[:, self.varying], q)[rates])
        return pivot_order(np.array(tables))


def _compute_joint_coordinates(tree: Tree, link: Link, motion: Motion, x: Array) -> None:
    """Write a joint's passive coordinates, from its bodies' poses in ``motion``, into x."""

    def rotation(body: str) -> Array:
        return np.eye(3) if body == BASE else to_floats(motion.rotation_from_home(body))

    inner, outer = rotation(link.parent), rotation(link.body)
    relative = inner.T @ outer
    steps = [step for step in link.steps if not step.actuated]
    for step in steps:
        k = step.position
        if step.ball or step.free:
            w = 0.5 * math.sqrt(max(1.0 + float(np.trace(outer)), 1e-12))
            x[k] = w
            x[k + 1 : k + 4] = [
                (outer[2, 1] - outer[1, 2]) / (4 * w),
                (outer[0, 2] - outer[2, 0]) / (4 * w),
                (outer[1, 0] - outer[0, 1]) / (4 * w),
            ]
            if step.free:
                x[k + 4 : k + 7] = to_floats(motion.point(link.body, link.at)) - link.at
    turns = [step for step in steps if step.turns]
    for step in steps:
        if step.slide and not step.turns:
            apart = to_floats(motion.point(link.body, link.at))
            apart = apart - (to_floats(motion.point(link.parent, link.at)) if link.parent != BASE else link.at)
            x[step.position] = step.sign * ((inner.T @ apart) @ step.axis) / step.slide
    if len(turns) == 1:
        (step,) = turns
        across = np.linalg.svd(step.axis[None])[2][1]
        turned = relative @ across
        angle = math.atan2(np.cross(across, turned) @ step.axis, across @ turned)
        if step.circle:
            x[step.position : step.position + 2] = math.cos(angle), step.sign * math.sin(angle)
        elif step.slide:
            x[step.position] = step.sign * angle
    elif len(turns) == 2:
        # Rotations about a, then b: the first angle follows from b's direction, the second from a's.
        first, second = turns
        a, b = first.axis, second.axis
        angles = _angle(a, b, relative @ b), -_angle(b, a, relative.T @ a)
        for step, angle in zip(turns, angles, strict=True):
            x[step.position : step.position + 2] = math.cos(angle), step.sign * math.sin(angle)


def _angle(axis: Array, start: Array, end: Array) -> float:
    """Return the angle about an axis between the components of two vectors across it."""
    start, end = (v - (v @ axis) * axis for v in (start, end))
    return math.atan2(np.cross(start, end) @ axis, start @ end)
