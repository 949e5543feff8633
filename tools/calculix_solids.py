# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write a robot's elastic frame as an input deck of CalculiX's solids, with round members.

Joints are equations between weighted means of the displacements of the members' end sections.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.linalg import qr

from pkm_twin.machine.graph import BASE
from stiffness_monitor.structure import StructuralModel, local_axes
from tools.calculix import run


@dataclass(frozen=True)
class Mesh:
    """Quadratic bricks of a round bar: a square of ``square``^2, ``rings`` about it, ``length``."""

    square: int = 2
    rings: int = 1
    length: int = 12

    @property
    def section(self) -> int:
        """Number of bricks in the section."""
        return self.square**2 + 4 * self.square * self.rings

    def __str__(self) -> str:
        return f"{self.section} x {self.length}"


@dataclass(frozen=True, eq=False)
class Disc:
    """Quadratic quadrilaterals of a disc of radius 1.

    ``places``: shape (nodes, 2). ``quads``: four corners, counter-clockwise, then the middles of
    the sides between them, shape (quads, 8). ``weights``: integrals of each node's shape function
    times 1, y and z over the section, shape (3, nodes). ``area`` and the second moments
    ``second`` about y and z (integrals of z^2 and y^2) are the mesh's own.
    """

    places: np.ndarray
    quads: np.ndarray
    weights: np.ndarray
    area: float
    second: np.ndarray


def disc_mesh(square: int, rings: int) -> Disc:
    """Mesh a disc: a square with curved sides, then rings of quadrilaterals to the circle."""
    places: list[tuple[float, float]] = []
    known: dict[tuple[float, float], int] = {}

    def node(y, z):
        key = round(y, 9) + 0.0, round(z, 9) + 0.0
        if key not in known:
            known[key] = len(places)
            places.append((y, z))
        return known[key]

    def core(u, v):
        # Half way between a square and the ellipses that make a disc of it.
        bent = np.array([u * np.sqrt(1 - v * v / 2), v * np.sqrt(1 - u * u / 2)])
        return 0.55 * (np.array([u, v]) / np.sqrt(2) + bent) / 2

    steps = np.linspace(-1, 1, 2 * square + 1)
    around = [(u, -1.0) for u in steps[:-1]] + [(1.0, v) for v in steps[:-1]]
    around += [(u, 1.0) for u in steps[:0:-1]] + [(-1.0, v) for v in steps[:0:-1]]
    count = len(around)

    def ring(k, j):
        start = core(*around[k % count])
        angle = -3 * np.pi / 4 + 2 * np.pi * k / count
        end = np.array([np.cos(angle), np.sin(angle)])
        return start + j / (2 * rings) * (end - start)

    quads = []

    def quad(place, i, j):
        corners = [(i, j), (i + 2, j), (i + 2, j + 2), (i, j + 2)]
        sides = [(i + 1, j), (i + 2, j + 1), (i + 1, j + 2), (i, j + 1)]
        quads.append([node(*place(*at)) for at in corners + sides])

    for i in range(0, 2 * square, 2):
        for j in range(0, 2 * square, 2):
            quad(lambda a, b: core(steps[a], steps[b]), i, j)
    for k in range(0, count, 2):
        for j in range(0, 2 * rings, 2):
            # Outwards and then around is counter-clockwise.
            quad(lambda a, b: ring(b, a), j, k)
    at = np.array(places)
    weights, second = np.zeros((3, len(at))), np.zeros(2)
    points, shares = np.polynomial.legendre.leggauss(4)
    for row in quads:
        for r, one in zip(points, shares, strict=True):
            for s, other in zip(points, shares, strict=True):
                value, slope = _evaluate_shape_functions(r, s)
                jacobian = np.linalg.det(slope @ at[row])
                assert jacobian > 0
                y, z = value @ at[row]
                dA = one * other * jacobian
                weights[:, row] += dA * np.outer([1.0, y, z], value)
                second += dA * np.array([z * z, y * y])
    return Disc(at, np.array(quads), weights, float(weights[0].sum()), second)


def _evaluate_shape_functions(r: float, s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return values (8,) and slopes (2, 8) of a quadrilateral's shape functions."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    value, slope = np.zeros(8), np.zeros((2, 8))
    for k, (a, b) in enumerate(corners):
        value[k] = (1 + a * r) * (1 + b * s) * (a * r + b * s - 1) / 4
        slope[0, k] = a * (1 + b * s) * (2 * a * r + b * s) / 4
        slope[1, k] = b * (1 + a * r) * (a * r + 2 * b * s) / 4
    for k, b in ((4, -1), (6, 1)):
        value[k] = (1 - r * r) * (1 + b * s) / 2
        slope[:, k] = -r * (1 + b * s), b * (1 - r * r) / 2
    for k, a in ((5, 1), (7, -1)):
        value[k] = (1 - s * s) * (1 + a * r) / 2
        slope[:, k] = a * (1 - s * s) / 2, -s * (1 + a * r)
    return value, slope


class Solids:
    """An input deck of a frame whose members are solid round bars of C3D20R bricks.

    A joint holds the mean displacement and the mean turn of the bar's end section, weighted as
    the displacements of a section that stays plane: so the end can warp and contract, and the
    load enters as an even or linear traction. With ``rigid_ends`` the sections themselves are
    rigid.
    """

    def __init__(self, frame: StructuralModel, mesh: Mesh, *, rigid_ends: bool = False) -> None:
        self.nodes: list[str] = []
        self.elements: list[str] = []
        self.sections: list[str] = []
        self.equations: list[str] = []
        self.rigid_ends = rigid_ends
        self.origin, self.moving = frame.origin, frame.platform
        # The platform: translations of one node, rotations as the translations of another.
        self.platform = self.node(frame.origin), self.node(frame.origin)
        self.mesh = mesh
        self.disc = disc_mesh(mesh.square, mesh.rings)
        self.bricks = 0
        for member in frame.parts:
            self.member(member)

    def node(self, place):
        self.nodes.append(f"{len(self.nodes) + 1}, " + ", ".join(f"{x:.12e}" for x in place))
        return len(self.nodes)

    def member(self, member):
        s, disc, count = member.section, self.disc, self.mesh.length
        assert s.inner_diameter == 0.0
        span = member.end - member.start
        length = np.linalg.norm(span)
        axes = local_axes(span / length)
        section = s.outer_diameter / 2 * disc.places @ axes[:, 1:].T
        corners = np.unique(disc.quads[:, :4])
        layers = []
        for k in range(2 * count + 1):
            wanted = corners if k % 2 else range(len(section))
            centre = member.start + k / (2 * count) * span
            layers.append({i: self.node(centre + section[i]) for i in wanted})
        self.elements.append(f"*ELEMENT, TYPE=C3D20R, ELSET={member.name}")
        for k in range(0, 2 * count, 2):
            low, middle, high = layers[k : k + 3]
            for quad in disc.quads:
                four, sides = quad[:4], quad[4:]
                row = [low[i] for i in four] + [high[i] for i in four]
                row += [low[i] for i in sides] + [high[i] for i in sides]
                row += [middle[i] for i in four]
                self.bricks += 1
                text = [str(i) for i in (self.bricks, *row)]
                self.elements.append(", ".join(text[:11]) + ",\n" + ", ".join(text[11:]))
        poisson = s.youngs_modulus / s.shear_modulus / 2 - 1
        self.sections.append(
            f"*MATERIAL, NAME=M{member.name}\n*ELASTIC\n{s.youngs_modulus:.9e}, {poisson:.9f}\n"
            f"*SOLID SECTION, ELSET={member.name}, MATERIAL=M{member.name}"
        )
        ends = (member.inner, member.start, layers[0]), (member.outer, member.end, layers[-1])
        for support, place, face in ends:
            self.joint(support, place, face, section, axes, s.outer_diameter / 2)

    def joint(self, support, place, face, section, axes, radius):
        """Write the equations of an end between the face's, the joint's and the platform's displacements."""
        ids = [face[i] for i in range(len(section))]
        size = 3 * len(ids)
        dofs = [(i, k) for i in ids for k in (1, 2, 3)]
        rows = []
        if self.rigid_ends:
            own = self.node(place), self.node(place)
            dofs += [(i, k) for i in own for k in (1, 2, 3)]
            motion = np.zeros((6, size + 6))
            motion[:, size:] = np.eye(6)
            for n, arm in enumerate(section):
                for k, axis in enumerate(np.eye(3)):
                    row = np.zeros(size + 12)
                    row[3 * n + k] = 1.0
                    row[size : size + 3] = -axis
                    row[size + 3 : size + 6] = -np.cross(arm, axis)
                    rows.append(row)
        else:
            motion = section_motion(self.disc, axes, radius)
        dofs += [(i, k) for i in self.platform for k in (1, 2, 3)]
        assert support.body in (BASE, self.moving)
        for k, compliance in enumerate(support.compliance):
            if compliance == np.inf:
                continue
            assert compliance == 0.0, f"{support.joint} is elastic"
            axis = support.axes[:, k % 3]
            end, body = axis @ motion[:3], np.r_[axis, np.cross(place - self.origin, axis)]
            if k >= 3:
                end, body = axis @ motion[3:], np.r_[np.zeros(3), axis]
            if support.body == BASE:
                body = np.zeros(6)
            rows.append(np.r_[end, -body])
        self.equate(np.array(rows), dofs)

    def equate(self, rows, dofs):
        """Solve for as many displacements as there are rows, so that each is in one row alone.

        CalculiX reads 20 characters of a number and drops the rest, exponent or not.
        """
        inner = rows[:, :-6]
        *_, order = qr(inner, mode="r", pivoting=True)
        chosen = order[: len(rows)]
        solved = np.linalg.solve(inner[:, chosen], rows)
        for row, first in zip(solved, chosen, strict=True):
            row[np.setdiff1d(chosen, first)] = 0.0
            others = [i for i in np.flatnonzero(np.abs(row) > 1e-12) if i != first]
            lines = [f"{dofs[i][0]}, {dofs[i][1]}, {row[i]:.12e}" for i in (first, *others)]
            self.equations.append("\n".join(["*EQUATION", str(len(lines)), *lines]))

    def text(self) -> str:
        """Write the deck with six steps, each with a unit force or moment on the platform."""
        steps = []
        for node in self.platform:
            for k in (1, 2, 3):
                steps.append(
                    f"*STEP\n*STATIC\n*CLOAD, OP=NEW\n{node}, {k}, 1.0\n*NODE PRINT, NSET=PLATFORM\nU\n*END STEP"
                )
        return "\n".join(
            [
                "*NODE, NSET=ALL",
                *self.nodes,
                "*NSET, NSET=PLATFORM\n" + ", ".join(str(node) for node in self.platform),
                *self.elements,
                *self.sections,
                *self.equations,
                *steps,
                "",
            ]
        )


def section_motion(disc: Disc, axes: np.ndarray, radius: float) -> np.ndarray:
    """Return the mean displacement and rotation of a section by its nodes' displacements, (6, 3 nodes).

    Exact for a section that moves as a rigid body. ``axes``: along the bar, y and z, as columns.
    """
    even, first_y, first_z = disc.weights
    about_y, about_z = disc.second
    motion = np.zeros((6, len(even), 3))
    for k in range(3):
        motion[k, :, k] = even / disc.area
    # About the bar: u_z = turn y, u_y = -turn z; about y: u_x = turn z; about z: u_x = -turn y.
    motion[3, :, 1], motion[3, :, 2] = np.array([-first_z, first_y]) / (about_y + about_z)
    motion[4, :, 0] = first_z / about_y
    motion[5, :, 0] = -first_y / about_z
    motion[3:] /= radius
    # From the section's own axes to the fixed ones.
    world = np.einsum("ij,jnk,lk->inl", axes, motion.reshape(2, 3, -1, 3)[1], axes)
    mean = np.einsum("ij,jnk,lk->inl", axes, motion[:3], axes)
    return np.concatenate((mean, world)).reshape(6, -1)


def solid_compliance(
    frame: StructuralModel, folder: Path, mesh: Mesh | None = None, *, rigid_ends: bool = False
) -> np.ndarray:
    """Compute the compliance of the platform at its origin with bars as solids, shape (6, 6).

    Order x y z rx ry rz in fixed axes, m/N, rad/N, m/(N m), rad/(N m). Every joint is rigid or
    free in each direction.
    """
    deck = Solids(frame, mesh or Mesh(), rigid_ends=rigid_ends)
    output = run(deck.text(), folder)
    rows = re.findall(r"^\s+(\d+)" + 3 * r"\s+([-+.E\d]+)" + r"\s*$", output, re.M)
    assert [int(row[0]) for row in rows] == 6 * list(deck.platform)
    return np.array([[float(x) for x in row[1:]] for row in rows]).reshape(6, 6).T
