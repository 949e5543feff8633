# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Coordinates and elastic columns of a frame in a pose, on numbers and on expressions alike.

The displacement of a member's end is that of the body it is attached to plus the relative
displacement in the joint: u_end = X u_body + A s. So releases and springs need no constraint
equations: a free direction is a coordinate s, an elastic one a coordinate s with a spring.

Stiffness is a sum of columns d b b': of springs, and of a beam's six deformation modes, which are
stretch, twist, and in both planes a bend to a circle and one to an S. Each has the energy
d (b . x)^2 / 2.

Displacements are in the order x y z rx ry rz (m, rad). SI units.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.lu import independent_rows, is_zero
from pkm_twin.errors import ParameterError
from pkm_twin.machine.graph import BASE
from stiffness_monitor.structure import FREE, RIGID, Carried, Member, StructuralModel, Support

Row = dict[int, Any]
"""Entries of a linear form of the coordinates that are not zero."""

DIRECTIONS: Final = ("x", "y", "z", "rx", "ry", "rz")
"""Names of the displacements in their order."""
PLATFORM: Final = 6
"""The platform's displacements are the first six coordinates."""
PLANES: Final = ((1, 5, 1.0), (2, 4, -1.0))
"""Bending planes: index of the deflection, of the rotation, and its sign; in the plane x z a
positive rotation lowers the slope."""


class Node(NamedTuple):
    """Describe a point at ``at`` with displacements (6,) ``map`` times the coordinates ``own``."""

    own: Sequence[int]
    map: Any
    at: Any


class Column(NamedTuple):
    """Describe a deformation mode of an element: its amount by coordinates, and its rigidity."""

    element: str
    row: Row
    rigidity: Any


class Bar(NamedTuple):
    """Hold a member with its ends' displacements along its own axes."""

    member: Member
    ends: tuple[Node, ...]


def rigid_offset(arm: Any) -> Any:
    """Return the matrix (6, 6) from the displacement of a rigid body's point to that of another one.

    ``arm``: from the point whose displacement is known to the other one.
    """
    x, y, z = arm.tolist()
    rows = [[1.0, 0, 0, 0, z, -y], [0, 1.0, 0, -z, 0, x], [0, 0, 1.0, y, -x, 0]]
    return np.array([*rows, *np.eye(6)[3:].tolist()])


def rotate_displacements(axes: Any, displacements: Any) -> Any:
    """Rotate translations and rotations of displacements, shape (6, k), by a matrix (3, 3)."""
    return (axes @ displacements.reshape(2, 3, -1)).reshape(6, -1)


def sum_forms(*terms: tuple[Iterable[int], Iterable[Any]]) -> Row:
    """Add linear forms, each given by coordinates and their factors."""
    row: Row = {}
    for own, values in terms:
        for k, value in zip(own, values, strict=True):
            if not is_zero(value):
                row[k] = row[k] + value if k in row else value
    return row


def deformations(length: Any, stretch: Any, twist: Any, bend: Any, shear: Any) -> list[tuple[dict[int, Any], Any]]:
    """Return the deformation modes of a beam along x: 12 end factors, and rigidity, each.

    The modes are stretch, twist, then in both planes a circle and an S. With phi = 12 E I / (G
    A_shear L^2) these diagonalise Timoshenko's matrix (Friedman and Kosmatka 1993). For a bar
    between joints the energy is that of the section's forces in the 2UPR-RPU paper's equation 2,
    and of its bar compliances C_B (equations 3 and 20).

    :param stretch: EA. ``twist``: GJ. ``bend``: EI. ``shear``: phi L^2.
    """
    inverse_length = 1.0 / length
    found = [({0: -1.0, 6: 1.0}, stretch * inverse_length), ({3: -1.0, 9: 1.0}, twist * inverse_length)]
    bending = 3.0 * bend * inverse_length / (1.0 + shear * inverse_length * inverse_length)
    for v, r, side in PLANES:
        found.append(({r: -side, 6 + r: side}, bend * inverse_length))
        found.append(({v: 2.0 * inverse_length, 6 + v: -2.0 * inverse_length, r: side, 6 + r: side}, bending))
    return found


def bending_shape(share: float, length: Any, phi: Any) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Return a beam's deflection and rotation from its chord, for symmetric and S-shaped bending."""
    arc, bow = 0.5 * share * (1.0 - share), 1.0 / (1.0 + phi)
    across = -arc * length, arc * (1.0 - 2.0 * share) * length * bow
    return across, (share - 0.5, 0.5 - 6.0 * arc * bow)


class Frame:
    """Set up the coordinates of a structural model in a pose.

    ``nodes``: points that other parts attach to, by name and end. ``bars``: members. ``springs``:
    columns of joints. ``constraints``: linear forms that are zero in a closed loop; coordinates from
    ``first_closure_coordinate`` on belong to closures.

    :param static: loads act on the platform alone, so that a strut only stretches.
    """

    def __init__(self, model: StructuralModel, *, static: bool = False) -> None:
        self.size, self.static, self.rigid_chain = PLATFORM, static, model.rigid_chain
        self.nodes: dict[tuple[str, int], Node] = {
            (BASE, 0): Node((), np.zeros((6, 0)), np.zeros(3)),
            (model.platform, 0): Node(range(PLATFORM), np.eye(6), model.origin),
        }
        self.bars: list[Bar] = []
        self.springs: list[Column] = []
        self.constraints: list[Row] = []
        for part in model.parts:
            if isinstance(part, Carried):
                self.nodes[part.name, 0] = self._point_by_joint(part.support, part.at)
            else:
                self._add_member(part)
        self.first_closure_coordinate = self.size
        for closure in model.closures:
            # The joint's free directions become coordinates; the other directions are constrained.
            support = closure.support
            first = self._point_on_body(*closure.inner, closure.at)
            second = self._point_on_body(support.body, support.end, closure.at)
            own, free_directions = self._add_joint(support)
            minus, plus = (rotate_displacements(support.axes.T, node.map) for node in (first, second))
            self.constraints += [
                sum_forms((first.own, -minus[k]), (second.own, plus[k]), (own, -free_directions[k])) for k in range(6)
            ]

    def _add_coordinates(self, count: int) -> range:
        self.size += count
        return range(self.size - count, self.size)

    def _point_on_body(self, body: str, end: int, at: Any) -> Node:
        if (body, end) not in self.nodes:
            raise ValueError(f"{body} is not connected to the base")
        node = self.nodes[body, end]
        return Node(node.own, rigid_offset(at - node.at) @ node.map, at)

    def _add_joint(self, support: Support) -> tuple[range, Array]:
        """Add coordinates for the directions that a joint does not hold; return their map.

        The map has shape (6, count). A joint is elastic in its own axes: the 2UPR-RPU paper's D_i1
        and D_i2, which project limb wrenches to a joint's axes (equations 5 to 7, 11 to 13, 21 to
        24), are columns here.
        """
        kinds = [k for k, compliance in enumerate(support.compliance) if not is_zero(compliance)]
        free_directions = [np.eye(6)[k] for k in kinds]
        free_directions += [pitch * np.eye(6)[k] + np.eye(6)[3 + k] for k, pitch in support.screws]
        own = self._add_coordinates(len(free_directions))
        self.springs += [
            Column(support.joint, {index: 1.0}, 1.0 / support.compliance[k])
            for index, k in zip(own, kinds, strict=False)
            if support.compliance[k] != FREE
        ]
        return own, np.array(free_directions).reshape(-1, 6).T

    def _point_by_joint(self, support: Support, at: Any) -> Node:
        """Return a point that is attached to a body by a joint."""
        node = self._point_on_body(support.body, support.end, at)
        own, free_directions = self._add_joint(support)
        return Node((*node.own, *own), np.hstack((node.map, rotate_displacements(support.axes, free_directions))), at)

    def _add_member(self, member: Member) -> None:
        ends = []
        pairs = (member.inner, member.start), (member.outer, member.end)
        for k, (support, at) in enumerate(pairs):
            if support is None:
                node = Node(self._add_coordinates(6), rotate_displacements(member.axes, np.eye(6)), at)
                ends.append(node._replace(map=np.eye(6)))
            else:
                if self.static and member.strut:
                    support = replace(support, compliance=(support.compliance[0], *RIGID[1:]))
                node = self._point_by_joint(support, at if support.at is None else support.at)
                if support.at is not None:
                    node = Node(node.own, rigid_offset(at - node.at) @ node.map, at)
                ends.append(node._replace(map=rotate_displacements(member.axes.T, node.map)))
            self.nodes[member.name, k] = node
        self.bars.append(Bar(member, tuple(ends)))

    def columns(self, bar: Bar) -> list[Column]:
        """Return a member's stiffness columns, with rigidities of :func:`deformations`."""
        member, ends = bar
        modes = deformations(member.length, *member.section)
        return [
            Column(
                member.body,
                sum_forms(*((ends[k // 6].own, f * ends[k // 6].map[k % 6]) for k, f in form.items())),
                rigidity,
            )
            for form, rigidity in (modes[:1] if self.static and member.strut else modes)
        ]

    def build_constraint_matrix(self) -> Any:
        """Return the closures' constraint matrix, shape (rows, size)."""
        table = np.zeros((len(self.constraints), self.size), dtype=object)
        for line, row in zip(table, self.constraints, strict=True):
            line[list(row)] = list(row.values())
        return table

    def choose_dependents(self, tables: Array) -> tuple[list[int], list[int]]:
        """Choose independent constraint rows, and as many coordinates that depend on the others.

        Redundant equations of an overconstrained machine are left out.

        :param tables: constraint matrices of k poses, shape (k, rows, size).
        :raises ParameterError: the constraints hold the platform itself.
        """
        rows = independent_rows(tables[..., PLATFORM:])
        if len(independent_rows(tables)) > len(rows):
            chain = self.rigid_chain
            raise ParameterError(
                f"joints.{chain[0]}.compliance" if chain else "joints",
                None,
                f"a compliance of {', '.join(chain) or 'what closes the loops'}, because these "
                "hold the platform rigidly in some directions; in a direction that a joint holds, "
                "for example 1e-9 m/N or 1e-7 rad/(N m)",
            )
        # Prefer the coordinates of closures, because each is in one or two equations only.
        weight = np.where(np.arange(PLATFORM, self.size) < self.first_closure_coordinate, 1.0, 10.0)
        chosen = independent_rows((tables[:, rows, PLATFORM:] * weight).swapaxes(-1, -2))
        return rows, [PLATFORM + k for k in chosen]
