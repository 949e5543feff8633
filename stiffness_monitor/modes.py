# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Natural frequencies and mode shapes of a robot in a pose, its actuators locked.

The robot is linear about the pose: elastic beams, joints with free and elastic directions, a rigid
platform (Delta-CU paper, figure 8). K x = (2 pi f)^2 M x.

A member's inner nodes can be replaced by its lowest modes with held ends, in addition to the static
shapes of its ends (Craig and Bampton 1968): statics stay exact, and a pose costs much less.
Displacements of a node are in the order x y z rx ry rz (m, rad).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, SingularityError
from pkm_twin.machine.members import Section
from pkm_twin.robot.rejection import SINGULARITY_BOUND
from pkm_twin.robot.robot import Robot
from stiffness_monitor.frame import PLANES, Frame, bending_shape, deformations, rigid_offset
from stiffness_monitor.structure import RigidBody, StructuralModel, structural_model


@lru_cache(maxsize=64)
def element_matrices(section: Section, length: float) -> tuple[Array, Array]:
    """Return stiffness and consistent mass of a beam element along x, (12, 12) each.

    Shape functions are the exact static ones of a beam loaded at its ends (Friedman and Kosmatka
    1993); mass of cross sections in translation and in rotation. Read-only.
    """
    ways = deformations(length, *section.rigidities)
    forms = np.zeros((len(ways), 12))
    for row, (form, _) in zip(forms, ways, strict=True):
        row[list(form)] = list(form.values())
    stiffness = (forms.T * [rigidity for _, rigidity in ways]) @ forms
    turning = section.rotary_inertia * np.array([2.0, 1.0, 1.0])
    inertia = length / 2 * np.array([*[section.mass_per_length] * 3, *turning])
    chord = np.hstack((-np.eye(6), np.eye(6))) / length
    mass = np.zeros((12, 12))
    # Four points integrate polynomials of the sixth degree exactly.
    for place, weight in zip(*np.polynomial.legendre.leggauss(4), strict=True):
        share = (1 + place) / 2
        shape = np.hstack(((1 - share) * np.eye(6), share * np.eye(6)))
        across, along = bending_shape(share, length, section.rigidities[3] / length**2)
        for k, (move, turn, side) in enumerate(PLANES, start=1):
            shape[turn] = side * (chord[move] + along @ forms[2 * k : 2 * k + 2])
            shape[move] += across @ forms[2 * k : 2 * k + 2]
        mass += weight * (shape.T * inertia) @ shape
    for matrix in (stiffness, mass):
        matrix.setflags(write=False)
    return stiffness, mass


def member_matrices(section: Section, length: float, elements: int) -> tuple[Array, Array]:
    """Return stiffness and mass of a chain of equal elements, (6 (elements + 1),) * 2."""
    element_stiffness, element_mass = element_matrices(section, length / elements)
    size = 6 * (elements + 1)
    stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
    for k in range(elements):
        at = slice(6 * k, 6 * k + 12)
        stiffness[at, at] += element_stiffness
        mass[at, at] += element_mass
    return stiffness, mass


@lru_cache(maxsize=64)
def _member_basis(section: Section, length: float, elements: int, kept: int | None) -> tuple[Array, Array, Array]:
    """Return basis, stiffness and mass of a member on its own coordinates.

    Coordinates: six displacements of the start, six of the end, then those inside. ``basis``,
    shape (6 (elements + 1), coordinates), gives the nodes' displacements.
    """
    stiffness, mass = member_matrices(section, length, elements)
    size = len(mass)
    ends, inside = np.r_[0:6, size - 6 : size], np.arange(6, size - 6)
    basis = np.zeros((size, 12))
    basis[ends] = np.eye(12)
    inner_modes = np.eye(len(inside))
    if kept is not None and kept < len(inside):
        inner_stiffness = stiffness[np.ix_(inside, inside)]
        # Static deformations by the ends' displacements are not coupled with fixed-end modes in the stiffness.
        basis[inside] = -np.linalg.solve(inner_stiffness, stiffness[np.ix_(inside, ends)])
        root = np.linalg.inv(np.linalg.cholesky(mass[np.ix_(inside, inside)]))
        values, vectors = np.linalg.eigh(root @ inner_stiffness @ root.T)
        # Keep all modes of a repeated eigenvalue: one alone would make a round bar anisotropic.
        while kept < len(values) and values[kept] < values[kept - 1] * (1 + 1e-6):
            kept += 1
        inner_modes = root.T @ vectors[:, :kept]
    modal = np.zeros((size, inner_modes.shape[1]))
    modal[inside] = inner_modes
    basis = np.hstack((basis, modal))
    result = basis, basis.T @ stiffness @ basis, basis.T @ mass @ basis
    for array in result:
        array.setflags(write=False)
    return result


def body_mass(body: RigidBody, at: Array) -> Array:
    """Return the mass matrix of a rigid body at a point that moves with it, shape (6, 6)."""
    about_com = np.zeros((6, 6))
    about_com[:3, :3] = body.mass * np.eye(3)
    about_com[3:, 3:] = body.inertia
    offset = rigid_offset(body.at - at)
    return np.asarray(offset.T @ about_com @ offset, np.float64)


@dataclass(frozen=True, eq=False)
class Part:
    """Hold one element of the energy shares: matrices on its own displacements.

    ``own`` (k,) of the system's coordinates move it, by ``map``, shape (rows, k).
    """

    name: str
    own: list[int]
    map: Array
    stiffness: Array
    mass: Array


@dataclass(frozen=True, eq=False)
class System:
    """Hold an assembled frame of n coordinates.

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

    def displacements(self, shape: Array) -> Array:
        """Return the base-axes displacements of the nodes, (nodes, 6), for coordinates (n,)."""
        rows = [shape[None, :6]]
        for index, basis, axes in self.members:
            part = self.parts[index]
            own = (basis @ (part.map @ shape[part.own])).reshape(-1, 2, 3)
            rows.append((own @ axes.T).reshape(-1, 6))
        return np.concatenate(rows)

    def energies(self, shape: Array) -> tuple[tuple[str, ...], Array, Array]:
        """Return the parts' names, twice their strain and twice their kinetic energy at unit rate.

        Parts with the same name are summed.
        """
        strain: dict[str, float] = {}
        kinetic: dict[str, float] = {}
        for part in self.parts:
            own = part.map @ shape[part.own]
            strain[part.name] = strain.get(part.name, 0.0) + float(own @ part.stiffness @ own)
            kinetic[part.name] = kinetic.get(part.name, 0.0) + float(own @ part.mass @ own)
        return tuple(strain), np.array(list(strain.values())), np.array(list(kinetic.values()))


def assemble(model: StructuralModel, elements: int, kept: int | None = None) -> System:
    """Assemble stiffness and mass of a structural model; ``elements`` beams per member.

    :param kept: fixed-end modes that a member keeps; None keeps all its nodes.

    :raises ValueError: a part is attached to an unconnected body, or closures hold the platform.
    """
    frame = Frame(model)
    names, positions = [model.platform], [model.origin[None]]
    parts: list[Part] = []
    for body in model.bodies:
        node = frame.nodes[body.body, 0]
        mass_matrix = body_mass(body, node.at)
        parts.append(Part(body.name, list(node.own), node.map, np.zeros((6, 6)), mass_matrix))
    members: list[tuple[int, Array, Array]] = []
    size = frame.size
    for member, ends in frame.bars:
        # Round the length, so that a member of constant length is in the cache in every pose.
        length = round(float(member.length), 12)
        basis, stiffness, mass = _member_basis(member.section, length, elements, kept)
        # The inner coordinates are displacements in the member's own axes.
        rows = len(mass)
        own = [*dict.fromkeys([*ends[0].own, *ends[1].own]), *range(size, size + rows - 12)]
        size += rows - 12
        end_map = np.zeros((rows, len(own)))
        end_map[12:, len(own) - rows + 12 :] = np.eye(rows - 12)
        for first, node in zip((0, 6), ends, strict=True):
            end_map[first : first + 6, [own.index(k) for k in node.own]] = node.map
        members.append((len(parts), basis, member.axes))
        parts.append(Part(member.body, own, end_map, stiffness, mass))
        shares = np.arange(elements + 1)[:, None] / elements
        positions.append(member.start + shares * (member.end - member.start))
        names += [f"{member.name} {k}/{elements}" for k in range(elements + 1)]
    for spring in frame.springs:
        row = np.array([list(spring.row.values())], np.float64)
        rigidity = np.array([[spring.rigidity]])
        parts.append(Part(spring.element, list(spring.row), row, rigidity, np.zeros((1, 1))))
    if frame.constraints:
        # Basis of the closures' null space, (size, fewer); the first six rows are unit.
        table = np.zeros((len(frame.constraints), size))
        table[:, : frame.size] = frame.build_constraint_matrix()
        dependent, chosen = frame.choose_dependents(table[None, :, : frame.size])
        free = [k for k in range(size) if k not in chosen]
        null = np.eye(size)[:, free]
        null[chosen] = -np.linalg.solve(table[np.ix_(dependent, chosen)], table[np.ix_(dependent, free)])
        basis = null
        size = basis.shape[1]
        all_coordinates = list(range(size))
        parts = [Part(p.name, all_coordinates, p.map @ basis[p.own], p.stiffness, p.mass) for p in parts]
    stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
    for part in parts:
        at = np.ix_(part.own, part.own)
        stiffness[at] += part.map.T @ part.stiffness @ part.map
        mass[at] += part.map.T @ part.mass @ part.map
    node_positions = np.concatenate(positions)
    return System(stiffness, mass, tuple(parts), tuple(names), node_positions, tuple(members))


ELEMENTS: Final = 8
"""Beam elements per member: the first six frequencies of the shipped robots to 0.1 %."""
MEMBER_MODES: Final = 8
"""Fixed-end modes that a member keeps: the same frequencies to 0.01 %."""


@dataclass(frozen=True, eq=False)
class Energies:
    """Hold the distribution of a mode's energy: fractions, (..., count, elements), sum 1.

    ``elements``: names of the bodies and of the joints that have elasticity. ``strain``: parts of
    the strain energy; ``kinetic``: of the kinetic energy. In a mode both totals are the same.
    """

    elements: tuple[str, ...]
    strain: Array
    kinetic: Array


@dataclass(frozen=True, eq=False)
class Modes:
    """Hold natural modes of a robot, lowest first; arrays are read-only.

    ``frequencies``: shape (..., count), Hz. ``nodes``: names of the points whose motion is given,
    the platform's reference point first, then each member's points from its inner to its outer end.
    ``positions``: shape (..., nodes, 3), base axes, m. ``shapes``: displacements and small
    rotations of the nodes along base axes, shape (..., count, nodes, 6), of unit generalised mass
    (1/sqrt(kg) and rad/(m sqrt(kg))), the largest displacement positive.
    """

    frequencies: Array
    nodes: tuple[str, ...]
    positions: Array
    shapes: Array
    energies: Energies


def natural_frequencies(robot: Robot, pose: ArrayLike, count: int = 6, *, elements: int = ELEMENTS) -> Array:
    """Return the lowest natural frequencies with locked actuators, (..., count), Hz.

    :param pose: shape (..., m), the mechanism's pose coordinates, m and rad.
    :param elements: beam elements a member.
    :raises ParameterError: a robot whose file has no data for modes, by the missing section.
    :raises UnreachableError: a pose that the mechanism cannot reach.
    :raises SingularityError: a pose in which the frame is a mechanism, with locked actuators.
    :raises ValueError: a wrong last axis, a value that is not finite, too many modes.
    """
    q = _inverse_kinematics(robot, pose)
    result = np.empty((*q.shape[:-1], count))
    for index in np.ndindex(*q.shape[:-1]):
        system = frame_system(robot, q[index], elements)
        result[index] = solve_modes(system, count, index, vectors=False)[0]
    return result


def modes(robot: Robot, pose: ArrayLike, count: int = 6, *, elements: int = ELEMENTS) -> Modes:
    """Return the lowest natural modes with locked actuators; errors as natural_frequencies.

    Equal frequencies, as of a symmetric robot, have any basis of their subspace as shapes.

    :param pose: shape (..., m), the mechanism's pose coordinates, m and rad.
    :param elements: beam elements a member.
    """
    q = _inverse_kinematics(robot, pose)
    batch = q.shape[:-1]
    if not np.prod(batch, dtype=int):
        raise ValueError("modes: no poses given")
    poses = []
    for index in np.ndindex(*batch):
        system = frame_system(robot, q[index], elements)
        frequencies, vectors = solve_modes(system, count, index, vectors=True)
        shapes, strain, kinetic = [], [], []
        for vector in vectors.T:
            shape = system.displacements(vector)
            largest = np.unravel_index(np.argmax(np.abs(shape[:, :3])), (len(shape), 3))
            shapes.append(shape * (1.0 if shape[largest] > 0.0 else -1.0))
            names, elastic, moving = system.energies(vector)
            strain.append(elastic / elastic.sum())
            kinetic.append(moving / moving.sum())
        poses.append((frequencies, system.positions, shapes, strain, kinetic))
    tables = [np.array(rows).reshape(*batch, *np.shape(rows[0])) for rows in zip(*poses, strict=True)]
    for table in tables:
        table.setflags(write=False)
    values, positions, displacements, strains, kinetics = tables
    return Modes(values, system.nodes, positions, displacements, Energies(names, strains, kinetics))


def has_modes(robot: Robot) -> bool:
    """Return whether the robot's file has all data for natural frequencies."""
    try:
        robot.massive()
        robot.structure()
    except ParameterError:
        return False
    return True


def _inverse_kinematics(robot: Robot, pose: ArrayLike) -> Array:
    """Return joint positions of poses, for a robot with masses and elastic members."""
    robot.massive()
    _ = robot.elastic
    return robot.inverse(pose)


def frame_system(robot: Robot, q: Array, elements: int) -> System:
    """Assemble the frame at joint positions (n,).

    :raises ParameterError: a robot without masses or elastic members, or no elements.
    """
    robot.massive()
    if elements < 1:
        raise ParameterError("elements", elements, "1 or more")
    return assemble(structural_model(robot, q), elements, MEMBER_MODES)


def stiffness_root(system: System, index: tuple[int, ...]) -> Array:
    """Return the lower Cholesky factor of the stiffness.

    :raises SingularityError: the stiffness is not positive definite, so the frame is a mechanism.
    """
    measure = 0.0
    try:
        root: Array = scipy.linalg.cholesky(system.stiffness, lower=True, check_finite=False)
        measure = float((np.diag(root) ** 2 / np.diag(system.stiffness)).min())
    except np.linalg.LinAlgError:
        pass
    if not measure > SINGULARITY_BOUND:
        raise SingularityError("the elastic frame of the pose", index, measure, SINGULARITY_BOUND)
    return root


def solve_modes(system: System, count: int, index: tuple[int, ...], *, vectors: bool) -> tuple[Array, Array]:
    """Return frequencies (count,), Hz, and vectors (n, count) of unit generalised mass.

    Solves the inverse problem L^-1 M L^-T y = y / omega^2 with K = L L': its largest values are the
    lowest frequencies, so these are accurate even with stiff joints.
    """
    size = len(system.mass)
    if not 1 <= count <= size:
        raise ValueError(f"count is {count}; the frame has {size} modes")
    root = stiffness_root(system, index)
    half = scipy.linalg.solve_triangular(root, system.mass, lower=True, check_finite=False)
    matrix = scipy.linalg.solve_triangular(root, half.T, lower=True, check_finite=False)
    chosen = (size - count, size - 1)
    if not vectors:
        values = scipy.linalg.eigh(matrix, eigvals_only=True, subset_by_index=chosen, check_finite=False, driver="evr")
        return _to_frequencies(values), np.empty((size, 0))
    values, eigenvectors = scipy.linalg.eigh(matrix, subset_by_index=chosen, check_finite=False, driver="evr")
    vectors_found = scipy.linalg.solve_triangular(root, eigenvectors, lower=True, trans=1, check_finite=False)
    return _to_frequencies(values), (vectors_found / np.sqrt(np.maximum(values, 1e-300)))[:, ::-1]


def _to_frequencies(values: Array) -> Array:
    """Convert rising values 1 / omega^2 to rising frequencies, Hz."""
    return np.asarray(1.0 / (2 * np.pi * np.sqrt(values[::-1])), np.float64)
