# SPDX-License-Identifier: Apache-2.0
"""Natural frequencies and mode shapes of a robot in a pose, its actuators locked.

The robot is linear about the pose: elastic beams, joints with free and elastic directions, a rigid
platform (Delta-CU paper, modal analysis). K x = (2 pi f)^2 M x.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, SingularityError
from pkm_twin.robot.robot import SINGULARITY_BOUND, Robot
from stiffness_monitor.beams import System, assemble
from stiffness_monitor.structure import structural_model

ELEMENTS: Final = 8
"""Beam elements a member: the first six frequencies of the shipped robots to 0.1 %."""
KEPT: Final = 8
"""Modes with held ends that a member keeps, of more: the same frequencies to 0.01 %."""


@dataclass(frozen=True, eq=False)
class Energies:
    """Where a mode's energy is: parts of the whole, shape (..., count, elements), sum 1.

    ``elements``: names of the bodies and of the joints that have elasticity. ``strain``: parts of
    the strain energy; ``kinetic``: of the kinetic energy. In a mode both totals are the same.
    """

    elements: tuple[str, ...]
    strain: Array
    kinetic: Array


@dataclass(frozen=True, eq=False)
class Modes:
    """Natural modes of a robot, lowest first; arrays are read-only.

    ``frequencies``: shape (..., count), Hz. ``nodes``: names of the points whose motion is given,
    the platform's origin first, then each member's points from its inner to its outer end.
    ``positions``: shape (..., nodes, 3), fixed axes, m. ``shapes``: displacements and small
    rotations of the nodes along fixed axes, shape (..., count, nodes, 6), of unit generalised mass
    (1/sqrt(kg) and rad/(m sqrt(kg))), the largest displacement positive.
    """

    frequencies: Array
    nodes: tuple[str, ...]
    positions: Array
    shapes: Array
    energies: Energies


def natural_frequencies(
    robot: Robot, pose: ArrayLike, count: int = 6, *, elements: int = ELEMENTS
) -> Array:
    """Lowest natural frequencies with locked actuators, shape (..., count), Hz, lowest first.

    :param pose: shape (..., m), the mechanism's pose coordinates, m and rad.
    :param elements: beam elements a member.
    :raises ParameterError: a robot whose file has no data for modes, by the missing section.
    :raises UnreachableError: a pose that is none of the mechanism's.
    :raises SingularityError: a pose in which the frame is a mechanism, with locked actuators.
    :raises ValueError: a wrong last axis, a value that is not finite, too many modes.
    """
    q = _joints(robot, pose)
    result = np.empty((*q.shape[:-1], count))
    for index in np.ndindex(*q.shape[:-1]):
        system = frame_system(robot, q[index], elements)
        result[index] = solve_modes(system, count, index, vectors=False)[0]
    return result


def modes(robot: Robot, pose: ArrayLike, count: int = 6, *, elements: int = ELEMENTS) -> Modes:
    """Lowest natural modes with locked actuators; errors as :func:`natural_frequencies`.

    Frequencies that are equal, as a symmetric robot's, have shapes that are any basis of theirs.

    :param pose: shape (..., m), the mechanism's pose coordinates, m and rad.
    :param elements: beam elements a member.
    """
    q = _joints(robot, pose)
    batch = q.shape[:-1]
    frequencies: list[Array] = []
    positions: list[Array] = []
    shapes: list[Array] = []
    strain: list[Array] = []
    kinetic: list[Array] = []
    if not np.prod(batch, dtype=int):
        raise ValueError("modes: no poses given")
    for index in np.ndindex(*batch):
        system = frame_system(robot, q[index], elements)
        values, vectors = solve_modes(system, count, index, vectors=True)
        frequencies.append(values)
        positions.append(system.positions)
        for vector in vectors.T:
            shape = system.displacements(vector)
            largest = np.unravel_index(np.argmax(np.abs(shape[:, :3])), (len(shape), 3))
            shapes.append(shape * (1.0 if shape[largest] > 0.0 else -1.0))
            names, elastic, moving = system.energies(vector)
            strain.append(elastic / elastic.sum())
            kinetic.append(moving / moving.sum())

    def stack(rows: list[Array], *shape: int) -> Array:
        array = np.array(rows).reshape(*batch, *shape)
        array.setflags(write=False)
        return array

    size = len(system.nodes)
    return Modes(
        stack(frequencies, count),
        system.nodes,
        stack(positions, size, 3),
        stack(shapes, count, size, 6),
        Energies(names, stack(strain, count, len(names)), stack(kinetic, count, len(names))),
    )


def has_modes(robot: Robot) -> bool:
    """Whether the robot's file has what natural frequencies need."""
    try:
        robot.massive()
        robot.structure()
    except ParameterError:
        return False
    return True


def _joints(robot: Robot, pose: ArrayLike) -> Array:
    """Joint positions of poses, of a robot with masses and elastic members."""
    robot.massive()
    _ = robot.elastic
    return robot.inverse(pose)


def frame_system(robot: Robot, q: Array, elements: int) -> System:
    """The frame in a pose by its joint positions (n,).

    :raises ParameterError: a robot without masses or elastic members, or no elements.
    """
    robot.massive()
    if elements < 1:
        raise ParameterError("elements", elements, "1 or more")
    return assemble(structural_model(robot, q), elements, KEPT)


def stiffness_root(system: System, index: tuple[int, ...]) -> Array:
    """Lower Cholesky factor of the stiffness; not positive definite is a mechanism.

    :raises SingularityError: by the sample's index.
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


def solve_modes(
    system: System, count: int, index: tuple[int, ...], *, vectors: bool
) -> tuple[Array, Array]:
    """Frequencies (count,), Hz, and vectors (n, count) of unit generalised mass.

    Of the inverse problem L^-1 M L^-T y = y / omega^2 with K = L L': its largest values are
    the lowest frequencies, so these have all digits beside stiff joints.
    """
    size = len(system.mass)
    if not 1 <= count <= size:
        raise ValueError(f"count is {count}; the frame has {size} modes")
    root = stiffness_root(system, index)
    half = scipy.linalg.solve_triangular(root, system.mass, lower=True, check_finite=False)
    matrix = scipy.linalg.solve_triangular(root, half.T, lower=True, check_finite=False)
    chosen = (size - count, size - 1)
    if not vectors:
        values = scipy.linalg.eigh(
            matrix, eigvals_only=True, subset_by_index=chosen, check_finite=False, driver="evr"
        )
        return _frequencies(values), np.empty((size, 0))
    values, own = scipy.linalg.eigh(
        matrix, subset_by_index=chosen, check_finite=False, driver="evr"
    )
    found = scipy.linalg.solve_triangular(root, own, lower=True, trans=1, check_finite=False)
    return _frequencies(values), (found / np.sqrt(np.maximum(values, 1e-300)))[:, ::-1]


def _frequencies(values: Array) -> Array:
    """Of values 1 / omega^2, rising, to Hz, rising."""
    return np.asarray(1.0 / (2 * np.pi * np.sqrt(values[::-1])), np.float64)
