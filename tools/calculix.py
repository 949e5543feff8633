# SPDX-License-Identifier: Apache-2.0
"""A robot's elastic frame as an input deck of CalculiX: as CalculiX's beams, or as round solids.

Joints are equations between displacements. CalculiX drops equations between rotations of beams
without a word, so nothing here equates rotations: beams hold points on short stiff levers, and
solids hold weighted means of their end sections' displacements.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.linalg import qr

from pkm_twin.machine.graph import BASE
from pkm_twin.machine.members import Section
from stiffness_monitor.structure import StructuralModel, local_axes

CCX = shutil.which("ccx")
ABSENT = "no CalculiX (ccx) on this machine"
STIFF = Section(1e14, 5e13, 0.04, 0.03, 1e-6, 1.0)
"""Levers: three orders stiffer than the members, and without weight."""


def run(text: str, folder: Path) -> str:
    """What CalculiX prints of a deck."""
    (folder / "deck.inp").write_text(text)
    result = folder / "deck.dat"
    result.unlink(missing_ok=True)
    done = subprocess.run(
        [CCX, "-i", "deck"],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=280,
        env={"OMP_NUM_THREADS": "1", "PATH": "/usr/bin:/bin"},
    )
    assert done.returncode == 0 and result.exists(), done.stdout[-2000:]
    return result.read_text()


def calculix_version() -> str:
    """Its number, such as 2.20."""
    done = subprocess.run([CCX, "-v"], capture_output=True, text=True, timeout=20)
    return re.search(r"[Vv]ersion\s+(\S+)", done.stdout).group(1)


# As beams


class Deck:
    """An input deck of a frame whose joints are rigid or free in each direction.

    Every joint holds displacements alone, of points on short stiff levers where it has to hold a
    rotation.
    """

    lever = 0.03

    def __init__(self, frame: StructuralModel, divisions: int) -> None:
        self.nodes: list[str] = []
        self.elements: list[str] = []
        self.sections: list[str] = []
        self.boundaries: list[str] = []
        self.equations: list[str] = []
        self.used: set[tuple[int, int]] = set()
        self.idle = 0
        self.count = 0
        self.tips: dict[str, tuple[int, np.ndarray]] = {}
        # The platform: translations of one node, rotations as the translations of another.
        self.origin, self.moving = frame.origin, frame.platform
        self.platform = self.node(frame.origin), self.node(frame.origin)
        for member in frame.parts:
            self.member(member, divisions)
        for body in frame.bodies:
            self.body(frame.origin, body)

    def node(self, place):
        self.nodes.append(f"{len(self.nodes) + 1}, " + ", ".join(f"{x:.12e}" for x in place))
        return len(self.nodes)

    def beam(self, chain, along, section):
        """Elements along a chain of nodes, every second of them in the middle of one."""
        self.count += 1
        name = f"E{self.count}"
        self.elements.append(f"*ELEMENT, TYPE=B32R, ELSET={name}")
        for k in range(0, len(chain) - 1, 2):
            row = ", ".join(str(node) for node in chain[k : k + 3])
            self.elements.append(f"{10000 * self.count + k}, {row}")
        s = section
        wall = (s.outer_diameter - s.inner_diameter) / 2
        side = ", ".join(f"{x:.12e}" for x in local_axes(along)[:, 1])
        poisson = s.youngs_modulus / s.shear_modulus / 2 - 1
        self.sections.append(
            f"*MATERIAL, NAME=M{name}\n*ELASTIC\n{s.youngs_modulus:.9e}, {poisson:.6f}\n"
            f"*DENSITY\n{s.mass_per_length / s.area:.12e}\n"
            f"*BEAM SECTION, ELSET={name}, MATERIAL=M{name}, SECTION=PIPE\n"
            f"{s.outer_diameter / 2:.9e}, {wall:.9e}\n{side}"
        )

    def member(self, member, divisions):
        span = member.end - member.start
        along = span / np.linalg.norm(span)
        fractions = np.arange(2 * divisions + 1) / (2 * divisions)
        chain = [self.node(member.start + f * span) for f in fractions]
        self.beam(chain, along, member.section)
        if member.outer is None:
            self.tips[member.name] = (chain[-1], member.end)
        ends = (member.inner, member.start, chain[0]), (member.outer, member.end, chain[-1])
        for support, place, node in ends:
            if support is not None:
                self.joint(support, place, node, along)

    def arm(self, node, start, end):
        """A node at the end of a stiff, light lever from a node; the node itself for none."""
        span = end - start
        length = np.linalg.norm(span)
        if length < 1e-9:
            return node
        chain = [node, self.node(start + span / 2), self.node(end)]
        self.beam(chain, span / length, STIFF)
        return chain[-1]

    def joint(self, support, place, node, along):
        held = {k for k in range(6) if support.compliance[k] == 0.0}
        assert all(support.compliance[k] == np.inf for k in range(6) if k not in held)
        first, second, third = support.axes.T
        if support.body == BASE and len(held) == 6:
            self.boundaries.append(f"{node}, 1, 6")
        elif held >= {0, 1, 2} and held <= {0, 1, 2, 3}:
            if 3 in held:
                assert abs(first @ along) > 1 - 1e-9, "a spin, which carries no load"
                self.idle += 1
            for axis in np.eye(3):
                self.hold(axis, node, support.body, place)
        elif held == {0, 2, 3, 5}:
            # A cylindrical joint about its second axis: two points that stay on a line.
            for side in (-self.lever, self.lever):
                point = place + side * second
                end = self.arm(node, place, point)
                for axis in (first, third):
                    self.hold(axis, end, support.body, point)
        elif held == {0, 1, 2, 5}:
            # Turned about the third axis, a point on the first would move along the second.
            for axis in np.eye(3):
                self.hold(axis, node, support.body, place)
            point = place + self.lever * first
            self.hold(second, self.arm(node, place, point), support.body, point)
        else:
            raise AssertionError(f"{support.joint} holds {held}")

    def hold(self, axis, node, name, place):
        """Axis . (displacement of the node - that of the body's point at place) = 0."""
        terms = [((node, k + 1), axis[k]) for k in range(3)]
        if name == self.moving:
            centre, turn = self.platform
            # axis . (turn x lever) = turn . (lever x axis)
            lever = np.cross(place - self.origin, axis)
            terms += [((centre, k + 1), -axis[k]) for k in range(3)]
            terms += [((turn, k + 1), -lever[k]) for k in range(3)]
        else:
            other = self.arm(*self.tips[name], place)
            terms += [((other, k + 1), -axis[k]) for k in range(3)]
        terms = [(dof, c) for dof, c in terms if abs(c) > 1e-12]
        own = [t for t in terms if t[0][0] == node and t[0] not in self.used]
        first = max(own, key=lambda term: abs(term[1]))
        self.used.add(first[0])
        lines = [f"{n}, {k}, {c:.12e}" for (n, k), c in [first, *(t for t in terms if t != first)]]
        self.equations.append("\n".join(["*EQUATION", str(len(lines)), *lines]))

    def body(self, origin, body):
        """A flat symmetric platform as four point masses, which have a disc's inertia."""
        radius = np.sqrt(4 * body.inertia[0, 0] / body.mass) / np.sqrt(2)
        assert np.allclose(body.inertia, body.inertia[0, 0] * np.diag([1, 1, 2]))
        assert np.allclose(body.at, origin, rtol=0.0, atol=1e-12)
        for k, place in enumerate(
            radius * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
        ):
            node = self.node(origin + place)
            self.elements.append(f"*ELEMENT, TYPE=MASS, ELSET=P{k}\n{k + 1}, {node}")
            self.sections.append(f"*MASS, ELSET=P{k}\n{body.mass / 4:.12e}")
            for axis in np.eye(3):
                self.hold(axis, node, self.moving, origin + place)

    def text(self, count):
        return "\n".join(
            [
                "*NODE, NSET=ALL",
                *self.nodes,
                *self.elements,
                *self.sections,
                "*BOUNDARY",
                *self.boundaries,
                *self.equations,
                f"*STEP\n*FREQUENCY\n{count}\n*NODE FILE\nU\n*END STEP\n",
            ]
        )


def frequencies(frame: StructuralModel, count: int, folder: Path, divisions: int = 8) -> np.ndarray:
    """Lowest frequencies of a frame's beams by CalculiX, Hz."""
    deck = Deck(frame, divisions)
    output = run(deck.text(count + deck.idle), folder)
    rows = re.findall(r"^\s+\d+" + 4 * r"\s+([-+.E\d]+)" + r"\s*$", output, re.M)
    found = np.array([float(row[2]) for row in rows])[: count + deck.idle]
    assert len(found) == count + deck.idle
    # Rods between ball joints spin at no frequency; nothing else does.
    assert (found[: deck.idle] < 0.1).all()
    assert (found[deck.idle :] > 1.0).all()
    return found[deck.idle :]


def harmonic(frame, damping, highest, folder, *, modes=30, divisions=8):
    """CalculiX's natural frequencies, frequencies (k,) between them, Hz, and its responses there.

    :returns: the platform's complex displacements (k, 3) to a unit force along x.
    """
    deck = Deck(frame, divisions)
    count, node = modes + deck.idle, deck.platform[0]
    text = deck.text(count).replace("*FREQUENCY", "*FREQUENCY, STORAGE=YES")
    text = text.replace("*NODE FILE\nU\n", "").replace("*STEP", f"*NSET, NSET=TOOL\n{node}\n*STEP")
    text += (
        f"*STEP\n*STEADY STATE DYNAMICS\n1., {highest:.9e}, 6, 1.\n"
        f"*MODAL DAMPING\n1, {count}, {damping}\n*CLOAD\n{node}, 1, 1.\n"
        "*NODE PRINT, NSET=TOOL\nU\n*END STEP\n"
    )
    output = run(text, folder)
    rows = re.findall(r"^\s+\d+" + 4 * r"\s+([-+.E\d]+)" + r"\s*$", output, re.M)
    own = np.array([float(row[2]) for row in rows])[deck.idle : count]
    found = re.findall(r"set TOOL and time\s+(\S+)\s+\d+\s+(\S+)\s+(\S+)\s+(\S+)", output)
    table = np.array(found, float)
    # Real parts, then imaginary ones, of each frequency.
    return own, table[::2, 0], table[::2, 1:] + 1j * table[1::2, 1:]


# As solids


@dataclass(frozen=True)
class Mesh:
    """Quadratic bricks of a round bar: a square of ``square``^2, ``rings`` about it, ``length``."""

    square: int = 2
    rings: int = 1
    length: int = 12

    @property
    def section(self) -> int:
        """Bricks in the section."""
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
    """A square with bent sides in the middle, rings of quadrilaterals from there to the circle."""
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
                value, slope = _shape(r, s)
                jacobian = np.linalg.det(slope @ at[row])
                assert jacobian > 0
                y, z = value @ at[row]
                dA = one * other * jacobian
                weights[:, row] += dA * np.outer([1.0, y, z], value)
                second += dA * np.array([z * z, y * y])
    return Disc(at, np.array(quads), weights, float(weights[0].sum()), second)


def _shape(r: float, s: float) -> tuple[np.ndarray, np.ndarray]:
    """Values (8,) and slopes (2, 8) of a quadrilateral's shape functions."""
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
        # As above: translations of one node, rotations as the translations of another.
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
        """Equations of one end, over the face's displacements, own ones, and the platform's."""
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
        """Six steps, each with one unit force or moment on the platform."""
        steps = []
        for node in self.platform:
            for k in (1, 2, 3):
                steps.append(
                    f"*STEP\n*STATIC\n*CLOAD, OP=NEW\n{node}, {k}, 1.0\n"
                    "*NODE PRINT, NSET=PLATFORM\nU\n*END STEP"
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
    """Mean displacement and turn of a section by its nodes' displacements, shape (6, 3 nodes).

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
    """Compliance of the platform at its origin, its bars as solids, shape (6, 6).

    Order x y z rx ry rz in fixed axes, m/N, rad/N, m/(N m), rad/(N m). Every joint is rigid or
    free in each direction.
    """
    deck = Solids(frame, mesh or Mesh(), rigid_ends=rigid_ends)
    output = run(deck.text(), folder)
    rows = re.findall(r"^\s+(\d+)" + 3 * r"\s+([-+.E\d]+)" + r"\s*$", output, re.M)
    assert [int(row[0]) for row in rows] == 6 * list(deck.platform)
    return np.array([[float(x) for x in row[1:]] for row in rows]).reshape(6, 6).T
