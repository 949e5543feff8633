# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write a robot's elastic frame as an input deck of CalculiX's beams.

Joints are equations between displacements. CalculiX drops equations between rotations of beams
without a word, so nothing here equates rotations: beams hold points on short stiff levers.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np

from pkm_twin.machine.graph import BASE
from pkm_twin.machine.members import Section
from stiffness_monitor.structure import StructuralModel, local_axes

CCX = shutil.which("ccx")
ABSENT = "no CalculiX (ccx) on this machine"
STIFF = Section(1e14, 5e13, 0.04, 0.03, 1e-6, 1.0)
"""Section of levers: three orders stiffer than the members, nearly massless."""


def run(text: str, folder: Path) -> str:
    """Run CalculiX on a deck, and return what it prints."""
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
    """Return CalculiX's version, such as 2.20."""
    done = subprocess.run([CCX, "-v"], capture_output=True, text=True, timeout=20)
    return re.search(r"[Vv]ersion\s+(\S+)", done.stdout).group(1)


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
        """Add elements along a chain of nodes; every second node is in the middle of an element."""
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
        """Add a node at the end of a stiff, light lever; without a lever return the node itself."""
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
        """Add the equation axis . (displacement of the node - displacement of the body's point) = 0."""
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
        """Add a flat symmetric platform as four point masses with a disc's inertia."""
        radius = np.sqrt(4 * body.inertia[0, 0] / body.mass) / np.sqrt(2)
        assert np.allclose(body.inertia, body.inertia[0, 0] * np.diag([1, 1, 2]))
        assert np.allclose(body.at, origin, rtol=0.0, atol=1e-12)
        for k, place in enumerate(radius * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])):
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
    """Compute the lowest frequencies of a frame's beams by CalculiX, Hz."""
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
    """Compute natural frequencies, frequencies (k,) between them, Hz, and responses there by CalculiX.

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
