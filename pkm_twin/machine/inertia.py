# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Lay out the parameters of the dynamics: inertial parameters, rods, gravity, friction, rotors.

They are inputs of the compiled programs, so that a payload or a changed mass needs no compilation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array, Indices
from pkm_twin.codegen.expressions import plain
from pkm_twin.codegen.lu import is_zero
from pkm_twin.machine.friction import list_friction_keys, list_parameters
from pkm_twin.machine.graph import BASE, Graph, Joint
from pkm_twin.machine.tree import Tree

Objects = NDArray[Any]

STANDARD_PARAMETERS: Final = ("mass", "mx", "my", "mz", "ixx", "iyy", "izz", "ixy", "ixz", "iyz")
"""A body's ten standard inertial parameters: mass, kg; first moments, kg m; inertia, kg m2."""
_MATRIX_ENTRIES: Final = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Rows and columns of an inertia matrix in the order of :data:`STANDARD_PARAMETERS`."""
STANDARD_UNITS: Final = ("kg", *["kg m"] * 3, *["kg m2"] * 6)
PARTS: Final = ("bodies", "rods", "gravity", "viscous", "coulomb", "offset", "laws", "rotors", "passive")
"""Parts of the parameter vector, in order."""
GRAVITY_PART: Final = 2
LAWS_PART: Final = 6
ROTORS_PART: Final = 7
"""Indices in :data:`PARTS` of gravity, of the drives' friction laws and of their rotor inertias."""


def standard_parameters(mass: float, com: Array, inertia: Array) -> Array:
    """Return the ten standard inertial parameters about the origin of ``com``.

    :param com: centre of mass, shape (3,), m.
    :param inertia: inertia matrix about the centre of mass, shape (3, 3), kg m2.
    """
    # Symmetrise, so that a derivative by one off-diagonal entry is half of that by both.
    about = 0.5 * (inertia + inertia.T) + mass * (com @ com * np.eye(3) - np.outer(com, com))
    upper = [about[i, k] for i, k in _MATRIX_ENTRIES]
    return plain([mass, *(mass * com), *upper])


def make_frame_change(axes: Array, lever: Array) -> Array:
    """Return the matrix (10, 10) that transforms standard inertial parameters to another frame.

    :param axes: the new axes as columns in the old ones, shape (3, 3).
    :param lever: from the new point to the old one, in the old axes, shape (3,), m.
    """
    # One row per parameter: its mass, first moments and inertia.
    mass, first = np.eye(10)[:, :1], np.eye(10)[:, 1:4]
    crossed = lever[:, None] * first[:, None, :]
    units = np.array([inertia_matrix(ten) for ten in np.eye(10)])
    about = units + 2.0 * (first @ lever)[:, None, None] * np.eye(3)
    about = about - crossed - crossed.swapaxes(-1, -2)
    about = about + mass[..., None] * (lever @ lever * np.eye(3) - np.outer(lever, lever))
    turned = axes.T @ about @ axes
    moved = [mass, (first + mass * lever) @ axes, turned[:, *np.transpose(_MATRIX_ENTRIES)]]
    return plain(np.concatenate(moved, 1).T)


def lump_inertia(tree: Tree, bodies: Objects) -> Objects:
    """Move masses on rotary joints to the bodies that carry them; drop what the ground carries.

    A mass at a joint moves as a point of both bodies, so that no generalised force changes and fewer
    parameters are left: base parameters (Gautier and Khalil 1990). About a fixed axis z the first
    moment mz and an inertia iyy about x and y need no effort of the joint either.

    :param bodies: standard inertial parameters in the links' axes, shape (bodies, 10).
    """
    found = dict(zip(tree.links, np.array(bodies, dtype=object), strict=True))
    for link in reversed(list(tree.links.values())):
        ten, fixed = found[link.body], link.parent == BASE
        if not link.steps or any(step.slide or step.free for step in link.steps):
            continue
        if not fixed and all(is_zero(value) for value in found[link.parent]):
            # The acceleration of a massless body is not needed otherwise.
            continue
        moved = np.zeros(10, dtype=object)
        moved[0] = ten[0]
        if fixed and len(link.steps) == 1 and not link.steps[0].ball:
            moved[3:6] = ten[3], ten[5], ten[5]
        found[link.body] = ten - moved
        if not fixed:
            own = link.steps[0].before.T
            found[link.parent] = found[link.parent] + make_frame_change(own, own @ link.arm) @ moved
    return np.array(list(found.values()), dtype=object)


def inertia_matrix(ten: Array) -> Array:
    """Return the inertia matrix of ten standard inertial parameters, shape (3, 3)."""
    xx, yy, zz, xy, xz, yz = ten[4:]
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def list_loaded_joints(graph: Graph) -> tuple[Joint, ...]:
    """Return the passive joints with friction or a rotor."""
    return tuple(joint for joint in graph.joints.values() if joint.loaded)


def drive_units(graph: Graph, joint: str) -> dict[str, str]:
    """Return the units of a joint's friction parameters and rotor inertia."""
    slides = graph.joints[joint].slides
    units = {key: one.unit_of_drive(slides=slides) for key, one in list_friction_keys().items()}
    return units | {"rotor_inertia": "kg" if slides else "kg m2"}


class Coefficients(Protocol):
    """The friction coefficients of the actuated joints, shape (n,) each.

    ``viscous``: N m s/rad or N s/m. ``coulomb``: N m or N. ``offset``: constant effort of the drive,
    N m or N. ``presliding``: distance over which Coulomb friction builds up, rad or m; 0 if at once.
    """

    viscous: Array
    coulomb: Array
    offset: Array
    presliding: Array


@dataclass(frozen=True)
class Layout:
    """The positions of all parameters in the parameter vector of the dynamics.

    A body's ten standard inertial parameters are about its link's origin (``tree.at``), in base
    axes at home.
    """

    tree: Tree

    @property
    def starts(self) -> Array:
        """Start index of each part, and the end."""
        graph = self.tree.graph
        n = len(graph.actuated)
        sizes = [
            10 * len(self.tree.links),
            len(graph.rods),
            3,
            n,
            n,
            n,
            n * len(list_parameters(graph.laws)),
            n,
            3 * len(list_loaded_joints(graph)),
        ]
        return np.cumsum([0, *sizes])

    @property
    def size(self) -> int:
        """Number of parameters."""
        return int(self.starts[-1])

    def part(self, k: int) -> slice:
        """Return the slice of part k of :data:`PARTS`."""
        a, b = self.starts[k : k + 2]
        return slice(int(a), int(b))

    @property
    def friction(self) -> Indices:
        """Indices of all friction parameters that efforts are linear in, also of passive joints."""
        starts, keys = self.starts, list_parameters(self.tree.graph.laws).values()
        passive = np.arange(starts[8], starts[9])
        friction_entries = passive[np.arange(len(passive)) % 3 < 2]
        linear = np.repeat([one.linear for one in keys], len(self.tree.graph.actuated))
        laws = np.arange(starts[6], starts[7])[linear.astype(bool)]
        return np.concatenate([np.arange(starts[3], starts[6]), laws, friction_entries]).astype(np.intp)

    def laws(self, part: Objects) -> dict[str, Objects]:
        """Split part ``laws`` into the friction laws' parameters by key, shape (n,) each."""
        keys = list_parameters(self.tree.graph.laws)
        return dict(zip(keys, part.reshape(len(keys), -1) if keys else [], strict=True))

    def body(self, name: str) -> slice:
        """Return the slice of a body's ten standard inertial parameters."""
        k = 10 * list(self.tree.links).index(name)
        return slice(k, k + 10)

    def split(self, p: Objects) -> list[Objects]:
        """Split a parameter vector into its parts; bodies (bodies, 10) in their links' axes."""
        parts = [p[self.part(k)] for k in range(len(PARTS))]
        bodies = zip(parts[0].reshape(-1, 10), self.tree.links.values(), strict=True)
        turned = []
        for ten, link in bodies:
            about = link.axes.T @ inertia_matrix(ten) @ link.axes
            turned.append([ten[0], *(link.axes.T @ ten[1:4]), *(about[i][k] for i, k in _MATRIX_ENTRIES)])
        parts[0] = np.array(turned)
        return parts

    def pack(self, graph: Graph, gravity: Array, friction: Coefficients) -> Array:
        """Return the parameter vector of a graph, without a payload.

        :param graph: of this tree's geometry, but possibly with other masses.
        :param friction: of the actuated joints; the graph has that of the passive joints.
        """
        bodies = []
        for link in self.tree.links.values():
            body = graph.bodies[link.body]
            bodies.append(standard_parameters(body.mass, body.com - link.at, body.inertia))
        drives = [graph.joints[name] for name in graph.actuated]
        return plain(
            np.concatenate(
                [
                    *bodies,
                    [rod.mass for rod in graph.rods.values()],
                    gravity,
                    friction.viscous,
                    friction.coulomb,
                    friction.offset,
                    *(getattr(friction, key) for key in list_parameters(self.tree.graph.laws)),
                    [j.rotor_inertia for j in drives],
                    [value for j in list_loaded_joints(graph) for value in (j.viscous, j.coulomb, j.rotor_inertia)],
                ]
            )
        )

    def payload(self, mass: float, com: Array, inertia: Array) -> Array:
        """Return what a payload adds to the parameters; com from the reference point, home axes."""
        graph = self.tree.graph
        link = self.tree.links[graph.platform]
        result = np.zeros(self.size, dtype=object)
        lever = graph.origin + com - link.at
        result[self.body(graph.platform)] = standard_parameters(mass, lever, inertia)
        return plain(result)
