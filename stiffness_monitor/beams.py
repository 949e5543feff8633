# SPDX-License-Identifier: Apache-2.0
"""Finite elements of a frame: Timoshenko beams with consistent mass, joints, a rigid platform.

Every displacement of a member's ends is written as that of the body it stands on plus what its
joint lets through: u_end = X u_body + A s. So releases and springs need no constraint equations:
a free direction is a coordinate s, an elastic one a coordinate s with a spring, a rigid one none.

A member's inner nodes can be replaced by its lowest modes with held ends, beside the static shapes
of its ends (Craig and Bampton 1968): statics stay exact, and a pose costs much less.

Displacements of a node are in the order x y z rx ry rz (m, rad). SI units.

May import: numpy, pkm_twin's core, the standard library; never rclpy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.machine.graph import BASE
from pkm_twin.machine.members import Section
from stiffness_monitor.structure import (
    Carried,
    RigidBody,
    StructuralModel,
    Support,
    cross,
)
from stiffness_monitor.structure import (
    size as length_of,
)

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_AXIAL: Final = ((0, 6),)
_TWIST: Final = ((3, 9),)
_PLANES: Final = (((1, 5, 7, 11), 1.0), ((2, 4, 8, 10), -1.0))
"""Deflection and slope at both ends; in the plane x z a positive turn lowers the slope."""


@lru_cache(maxsize=64)
def element_matrices(section: Section, length: float) -> tuple[Array, Array]:
    """Stiffness and consistent mass of one beam element along its own x axis, shape (12, 12) each.

    Shape functions are the exact static ones of a beam loaded at its ends, with the ratio of
    bending to shear phi = 12 E I / (G A_shear L^2) (Friedman and Kosmatka 1993, equations 14, 22
    and 23); mass of cross sections in translation and in rotation. Read-only.
    """
    s, l = section, length  # noqa: E741
    bending = s.youngs_modulus * s.second_moment
    phi = 12 * bending * s.shear_factor / (s.shear_modulus * s.area * l * l)
    stiffness, mass = np.zeros((12, 12)), np.zeros((12, 12))
    rod = np.array([[1.0, -1.0], [-1.0, 1.0]])
    spread = np.array([[2.0, 1.0], [1.0, 2.0]]) / 6
    for dofs, rigidity, inertia in (
        (_AXIAL, s.youngs_modulus * s.area, s.mass_per_length),
        (_TWIST, s.shear_modulus * 2 * s.second_moment, 2 * s.rotary_inertia),
    ):
        at = np.ix_(dofs[0], dofs[0])
        stiffness[at] = rigidity / l * rod
        mass[at] = inertia * l * spread
    bend = (
        bending
        / ((1 + phi) * l**3)
        * np.array(
            [
                [12, 6 * l, -12, 6 * l],
                [6 * l, (4 + phi) * l * l, -6 * l, (2 - phi) * l * l],
                [-12, -6 * l, 12, -6 * l],
                [6 * l, (2 - phi) * l * l, -6 * l, (4 + phi) * l * l],
            ]
        )
    )
    a, b = 70 * phi**2 + 147 * phi + 78, (35 * phi**2 + 77 * phi + 44) * l / 4
    c, d = 35 * phi**2 + 63 * phi + 27, (35 * phi**2 + 63 * phi + 26) * l / 4
    e, f = (7 * phi**2 + 14 * phi + 8) * l * l / 4, (7 * phi**2 + 14 * phi + 6) * l * l / 4
    move = np.array([[a, b, c, -d], [b, e, d, -f], [c, d, a, -b], [-d, -f, -b, e]])
    g, h = (15 * phi - 3) * l, (10 * phi**2 + 5 * phi + 4) * l * l
    k = (5 * phi**2 - 5 * phi - 1) * l * l
    turn = np.array([[36, -g, -36, -g], [-g, h, g, k], [-36, g, 36, g], [-g, k, g, h]])
    consistent = (s.mass_per_length * l / 210 * move + s.rotary_inertia / (30 * l) * turn) / (
        1 + phi
    ) ** 2
    for plane, sign in _PLANES:
        at = np.ix_(plane, plane)
        flip = np.array([1.0, sign, 1.0, sign])
        stiffness[at] = flip[:, None] * bend * flip
        mass[at] = flip[:, None] * consistent * flip
    stiffness.setflags(write=False)
    mass.setflags(write=False)
    return stiffness, mass


def member_matrices(section: Section, length: float, elements: int) -> tuple[Array, Array]:
    """Stiffness and mass of a chain of equal elements, shape (6 (elements + 1),) * 2."""
    one, weight = element_matrices(section, length / elements)
    size = 6 * (elements + 1)
    stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
    for k in range(elements):
        at = slice(6 * k, 6 * k + 12)
        stiffness[at, at] += one
        mass[at, at] += weight
    return stiffness, mass


@lru_cache(maxsize=64)
def _member(
    section: Section, length: float, elements: int, kept: int | None
) -> tuple[Array, Array, Array]:
    """Basis, stiffness and mass of a member on its own coordinates.

    Coordinates: six displacements of the start, six of the end, then those inside. ``basis``,
    shape (6 (elements + 1), coordinates), gives the nodes' displacements.
    """
    stiffness, mass = member_matrices(section, length, elements)
    size = len(mass)
    ends, inside = np.r_[0:6, size - 6 : size], np.arange(6, size - 6)
    basis = np.zeros((size, 12))
    basis[ends] = np.eye(12)
    own = np.eye(len(inside))
    if kept is not None and kept < len(inside):
        held = stiffness[np.ix_(inside, inside)]
        # The static shapes take no share of the modes' stiffness.
        basis[inside] = -np.linalg.solve(held, stiffness[np.ix_(inside, ends)])
        root = np.linalg.inv(np.linalg.cholesky(mass[np.ix_(inside, inside)]))
        values, vectors = np.linalg.eigh(root @ held @ root.T)
        # Equal ones stay together: one of a pair would make a round bar uneven.
        while kept < len(values) and values[kept] < values[kept - 1] * (1 + 1e-6):
            kept += 1
        own = root.T @ vectors[:, :kept]
    modal = np.zeros((size, own.shape[1]))
    modal[inside] = own
    basis = np.hstack((basis, modal))
    result = basis, basis.T @ stiffness @ basis, basis.T @ mass @ basis
    for array in result:
        array.setflags(write=False)
    return result


def local_axes(along: Array) -> Array:
    """Right-handed axes whose first is the unit vector ``along``; columns, shape (3, 3)."""
    side = np.zeros(3)
    side[int(np.argmin(np.abs(along)))] = 1.0
    y = cross(side, along)
    y /= math.sqrt(float(y @ y))
    return np.column_stack((along, y, cross(along, y)))


def rigid_offset(arm: Array) -> Array:
    """Displacement of a point of a rigid body by that of another, ``arm`` away; shape (6, 6)."""
    x, y, z = arm.tolist()
    offset = np.eye(6)
    offset[:3, 3:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    return offset


def body_mass(body: RigidBody, at: Array) -> Array:
    """Mass matrix of a rigid body at a point that moves with it, shape (6, 6)."""
    about_com = np.zeros((6, 6))
    about_com[:3, :3] = body.mass * np.eye(3)
    about_com[3:, 3:] = body.inertia
    offset = rigid_offset(body.at - at)
    return np.asarray(offset.T @ about_com @ offset, np.float64)


@dataclass(frozen=True, eq=False)
class Part:
    """One element of the energy shares: matrices on its own displacements.

    ``own`` (k,) of the system's coordinates move it, by ``map``, shape (rows, k).
    """

    name: str
    own: Indices
    map: Array
    stiffness: Array
    mass: Array


@dataclass(frozen=True, eq=False)
class System:
    """An assembled frame of n coordinates.

    ``stiffness``, ``mass``: shape (n, n). The platform's six displacements are the first six
    coordinates. ``nodes``: names, at ``positions``, shape (nodes, 3), m: the platform, then
    members' nodes in order. ``members``: index of the part, its basis, and its axes.
    """

    stiffness: Array
    mass: Array
    parts: tuple[Part, ...]
    nodes: tuple[str, ...]
    positions: Array
    members: tuple[tuple[int, Array, Array], ...]

    @property
    def elastic(self) -> tuple[str, ...]:
        """Names of the parts that have stiffness, each once, as :meth:`energies` orders them."""
        return tuple(dict.fromkeys(part.name for part in self.parts if part.stiffness.any()))

    def displacements(self, shape: Array) -> Array:
        """World displacements of the named nodes, shape (nodes, 6), of coordinates (n,)."""
        rows = [shape[None, :6]]
        for index, basis, axes in self.members:
            part = self.parts[index]
            own = (basis @ (part.map @ shape[part.own])).reshape(-1, 2, 3)
            rows.append((own @ axes.T).reshape(-1, 6))
        return np.concatenate(rows)

    def energies(self, shape: Array) -> tuple[tuple[str, ...], Array, Array]:
        """Names, then twice the strain energy and twice the kinetic one at unit rate, by part.

        Parts of one name are added up.
        """
        strain: dict[str, float] = {}
        kinetic: dict[str, float] = {}
        for part in self.parts:
            own = part.map @ shape[part.own]
            strain[part.name] = strain.get(part.name, 0.0) + float(own @ part.stiffness @ own)
            kinetic[part.name] = kinetic.get(part.name, 0.0) + float(own @ part.mass @ own)
        return tuple(strain), np.array(list(strain.values())), np.array(list(kinetic.values()))


@dataclass(frozen=True, eq=False)
class _Node:
    """A point whose displacement, shape (6,), is ``map`` times the coordinates ``own``."""

    own: Indices
    map: Array
    at: Array


_Nodes = dict[str, tuple[_Node, ...]]
"""Points that others can stand on, by body: one of a rigid body, both ends of a member."""


def assemble(model: StructuralModel, elements: int, kept: int | None = None) -> System:
    """Stiffness and mass of a structural model, each member divided into ``elements`` beams.

    :param kept: modes with held ends that a member keeps; None keeps all its nodes.

    :raises ValueError: a part stands on a body that hangs nowhere, or has no length.
    """
    parts: list[Part] = []
    names: list[str] = [model.platform]
    positions: list[Array] = [model.origin[None]]
    members: list[tuple[int, Array, Array]] = []
    nodes: _Nodes = {
        BASE: (_Node(np.arange(0), np.zeros((6, 0)), np.zeros(3)),),
        model.platform: (_Node(np.arange(6), np.eye(6), model.origin),),
    }
    size = 6
    springs: list[Part] = []
    for member in model.parts:
        if isinstance(member, Carried):
            node, spring, size = _end(member.support, member.at, nodes, size)
            nodes[member.name] = (node,)
            springs += [] if spring is None else [spring]
            continue
        span = member.end - member.start
        length = math.sqrt(float(span @ span))
        if not length > 0.0:
            raise ValueError(f"{member.name} has no length")
        axes = local_axes(span / length)
        # Rounded: poses of one robot differ by less in a member that keeps its length.
        basis, stiffness, mass = _member(member.section, round(length, 12), elements, kept)
        rows = len(mass)
        inside = np.arange(size, size + rows - 12)
        size += rows - 12
        columns: list[Indices] = [inside]
        # Inside, coordinates are along the member's own axes.
        blocks: list[Array] = [np.eye(rows)[:, 12:]]
        ends: list[_Node] = []
        for support, point, first in (
            (member.inner, member.start, 0),
            (member.outer, member.end, 6),
        ):
            node, spring, size = _end(support, point, nodes, size)
            full = np.zeros((rows, node.map.shape[1]))
            full[first : first + 6] = (axes.T @ node.map.reshape(2, 3, -1)).reshape(6, -1)
            columns.append(node.own)
            blocks.append(full)
            ends.append(node)
            springs += [] if spring is None else [spring]
        nodes[member.name] = tuple(ends)
        members.append((len(parts), basis, axes))
        own, joined = _joined(columns, blocks)
        parts.append(Part(member.body, own, joined, stiffness, mass))
        fractions = np.arange(elements + 1)[:, None] / elements
        positions.append(member.start + fractions * span)
        names += [f"{member.name} {k}/{elements}" for k in range(elements + 1)]
    rigid: list[Part] = []
    for body in model.bodies:
        node = _nearest(nodes, body.body, body.at)
        rigid.append(
            Part(body.name, node.own, node.map, np.zeros((6, 6)), body_mass(body, node.at))
        )
    held: list[tuple[Indices, Array]] = []
    for closure in model.closures:
        inner = _nearest(nodes, closure.inner, closure.at)
        outer = _nearest(nodes, closure.support.body, closure.at)
        own, apart = _joined(
            [inner.own, outer.own],
            [-rigid_offset(closure.at - inner.at) @ inner.map,
             rigid_offset(closure.at - outer.at) @ outer.map],
        )  # fmt: skip
        turned = (closure.support.axes.T @ apart.reshape(2, 3, -1)).reshape(6, -1)
        compliance = np.array(closure.support.compliance)
        held.append((own, turned[compliance == 0.0]))
        soft = (compliance > 0.0) & np.isfinite(compliance)
        if soft.any():
            count = int(soft.sum())
            springs.append(
                Part(
                    closure.support.joint, own, turned[soft], np.diag(1.0 / compliance[soft]),
                    np.zeros((count, count)),
                )
            )  # fmt: skip
    # Rigid bodies first: the order of the energy shares.
    shift = len(rigid)
    whole = (*rigid, *parts, *springs)
    members = [(index + shift, basis, axes) for index, basis, axes in members]
    basis_of = _null_space(held, size)
    if basis_of is not None:
        whole = tuple(_on(part, basis_of) for part in whole)
        size = basis_of.shape[1]
    stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
    for part in whole:
        at = np.ix_(part.own, part.own)
        stiffness[at] += part.map.T @ part.stiffness @ part.map
        mass[at] += part.map.T @ part.mass @ part.map
    return System(stiffness, mass, whole, tuple(names), np.concatenate(positions), tuple(members))


def _null_space(held: list[tuple[Indices, Array]], size: int) -> Array | None:
    """Coordinates that keep what closures hold, shape (size, fewer); the first six are the same.

    Dependent equations, of an overconstrained machine, count once.
    """
    count = sum(len(rows) for _, rows in held)
    if not count:
        return None
    table = np.zeros((count, size))
    at = 0
    for own, rows in held:
        table[at : at + len(rows), own] = rows
        at += len(rows)
    # The platform's six displacements stay coordinates: the others are solved for them.
    left, right = table[:, :6], table[:, 6:]
    u, s, vt = np.linalg.svd(right)
    rank = int((s > 1e-10 * s[0]).sum()) if len(s) else 0
    if np.abs(u[:, rank:].T @ left).max(initial=0.0) > 1e-9:
        raise ValueError("closures hold the platform itself: its compliance is not positive")
    particular = -vt[:rank].T @ ((u[:, :rank].T @ left) / s[:rank, None])
    basis = np.zeros((size, 6 + right.shape[1] - rank))
    basis[:6, :6] = np.eye(6)
    basis[6:, :6] = particular
    basis[6:, 6:] = vt[rank:].T
    return basis


def _on(part: Part, basis: Array) -> Part:
    """A part on other coordinates."""
    return Part(
        part.name, np.arange(basis.shape[1]), part.map @ basis[part.own], part.stiffness, part.mass
    )


def _joined(columns: list[Indices], blocks: list[Array]) -> tuple[Indices, Array]:
    """Coordinates and their block, each coordinate once: a body may hold both ends."""
    index = np.concatenate(columns)
    own, where = np.unique(index, return_inverse=True)
    joined = np.zeros((len(blocks[0]), len(own)))
    np.add.at(joined.T, where, np.hstack(blocks).T)
    return own, joined


def _nearest(nodes: _Nodes, body: str, point: Array) -> _Node:
    """The node of a body that is nearest to a point."""
    if body not in nodes:
        raise ValueError(f"{body} hangs nowhere")
    if len(nodes[body]) == 1:
        return nodes[body][0]
    return min(nodes[body], key=lambda node: length_of(node.at - point))


def _end(
    support: Support | None, point: Array, nodes: _Nodes, size: int
) -> tuple[_Node, Part | None, int]:
    """A point that stands on a body or, without a support, is free; its springs, the new size."""
    if support is None:
        return _Node(np.arange(size, size + 6), np.eye(6), point), None, size + 6
    body = _nearest(nodes, support.body, point)
    compliance = np.array(support.compliance)
    loose = np.flatnonzero(compliance)
    travel = np.zeros((6, len(loose)))
    for column, k in enumerate(loose.tolist()):
        travel[3 * (k // 3) : 3 * (k // 3) + 3, column] = support.axes[:, k % 3]
    own = np.arange(size, size + len(loose))
    rigidity = 1.0 / compliance[loose]
    spring = None
    if rigidity.any():
        count = len(loose)
        spring = Part(
            support.joint, own, np.eye(count), np.diag(rigidity), np.zeros((count, count))
        )
    node = _Node(
        np.concatenate((body.own, own)),
        np.hstack((rigid_offset(point - body.at) @ body.map, travel)),
        point,
    )
    return node, spring, size + len(loose)
