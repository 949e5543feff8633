# SPDX-License-Identifier: Apache-2.0
"""Compliance and strain energy of a robot's elastic frame by finite elements, actuators locked.

For every robot whose file gives elastic members (:mod:`stiffness_monitor.structure`).
One beam element a member is exact, because loads act at members' ends.

May import: numpy, scipy, pkm_twin's core, this package, the standard library; never rclpy.
"""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cholesky, solve_triangular  # type: ignore[import-untyped]

from pkm_twin.codegen.arrays import one_vector, vectors
from pkm_twin.errors import SingularityError
from pkm_twin.machine.robot import SINGULARITY_BOUND, Robot
from stiffness_monitor.beams import System, assemble
from stiffness_monitor.structure import Member, structural_model

Array = NDArray[np.float64]

_Solved = tuple[System, Array, Array]
_LAST: Final[deque[tuple[tuple[int, bytes], Robot, _Solved]]] = deque(maxlen=2)
"""Frames that were solved last, with the robots that they are of."""


def frame_compliance(robot: Robot, pose: ArrayLike, *, elements: int = 1) -> Array:
    """Static compliance of the platform at its origin, shape (..., 6, 6).

    Order x y z rx ry rz in fixed axes, as :func:`stiffness_monitor.compliance`.

    :param pose: shape (..., m), the mechanism's pose coordinates, m and rad.
    :param elements: beam elements a member.
    :raises ParameterError: a robot whose file has no elastic members, by the missing section.
    :raises UnreachableError: a pose that is none of the mechanism's.
    :raises SingularityError: a pose in which the frame is a mechanism, with locked actuators.
    :raises ValueError: a wrong last axis, a value that is not finite.
    """
    poses = checked_poses(robot, pose)
    result = np.empty((*poses.shape[:-1], 6, 6))
    for index in np.ndindex(*poses.shape[:-1]):
        _, _, half = _solved(robot, poses[index], elements, index)
        result[index] = half.T @ half
    return result


def frame_energies(
    robot: Robot, pose: ArrayLike, wrench: ArrayLike
) -> tuple[tuple[str, ...], Array, Array]:
    """Deflection under a wrench, and the strain energy of every elastic element.

    :param pose: shape (..., 3); errors as :func:`frame_compliance`.
    :param wrench: force and moment on the platform at its origin, fixed axes, shape (..., 6), N
        and N m, broadcast against the pose.
    :returns: names of the elements (members, and joints that have elasticity), deflection
        (..., 6), m and rad, energies (..., elements), J.
    """
    poses = checked_poses(robot, pose)
    loads = vectors(wrench, 6, "the wrench")
    batch = np.broadcast_shapes(poses.shape[:-1], loads.shape[:-1])
    poses, loads = (
        np.broadcast_to(poses, (*batch, poses.shape[-1])),
        np.broadcast_to(loads, (*batch, 6)),
    )
    names: tuple[str, ...] = ()
    deflections, energies = np.empty((*batch, 6)), []
    for index in np.ndindex(*batch):
        system, root, half = _solved(robot, poses[index], 1, index)
        shape = _loaded_shape(root, half, loads[index])
        every, strain, _ = system.energies(shape)
        elastic = [every.index(name) for name in system.elastic]
        names = system.elastic
        deflections[index] = shape[:6]
        # What carries no load can round to just below zero.
        energies.append(np.maximum(strain[elastic] / 2, 0.0))
    return names, deflections, np.array(energies).reshape(*batch, len(names))


def frame_deflections(
    robot: Robot, pose: ArrayLike, wrench: ArrayLike, *, elements: int = 4
) -> dict[str, tuple[Array, Array]]:
    """Points along every member and their displacements under a wrench, by member.

    :param pose: shape (m,); errors as :func:`frame_compliance`.
    :param wrench: as in :func:`frame_energies`, shape (6,).
    :param elements: how many parts a member is divided into.
    :returns: points (elements + 1, 3) in the pose, m, and displacements of the same shape, m; base
        axes.
    """
    poses = checked_poses(robot, pose)
    model = structural_model(robot, poses)
    system = assemble(model, elements)
    root = stiffness_root(system, ())
    shape = _loaded_shape(root, _platform_columns(root), one_vector(wrench, 6, "the wrench"))
    # The platform's node comes first, then those of each member.
    moved = system.displacements(shape)[1:, :3]
    points = system.positions[1:]
    names = [part.name for part in model.parts if isinstance(part, Member)]
    rows = [slice(k * (elements + 1), (k + 1) * (elements + 1)) for k in range(len(names))]
    return {name: (points[r], moved[r]) for name, r in zip(names, rows, strict=True)}


def checked_poses(robot: Robot, pose: ArrayLike) -> Array:
    """Poses of a robot with elastic members, refused by sample where they are none."""
    _ = robot.elastic
    poses = vectors(pose, len(robot.pose_names), "the pose")
    robot.inverse(poses)
    return poses


def stiffness_root(system: System, index: tuple[int, ...]) -> Array:
    """Lower Cholesky factor of the stiffness; not positive definite is a mechanism.

    :raises SingularityError: by the sample's index.
    """
    measure = 0.0
    try:
        root: Array = cholesky(system.stiffness, lower=True, check_finite=False)
        measure = float((np.diag(root) ** 2 / np.diag(system.stiffness)).min())
    except np.linalg.LinAlgError:
        pass
    if not measure > SINGULARITY_BOUND:
        raise SingularityError("the elastic frame of the pose", index, measure, SINGULARITY_BOUND)
    return root


def _solved(robot: Robot, pose: Array, elements: int, index: tuple[int, ...]) -> _Solved:
    """A pose's frame, the factor of its stiffness, and its answers L^-1 E to unit wrenches.

    The last ones are kept: what asks for the energy of a wrench asks for the compliance too.
    """
    key = elements, pose.tobytes()
    for known, owner, solved in tuple(_LAST):
        if known == key and owner is robot:
            return solved
    system = assemble(structural_model(robot, pose), elements)
    root = stiffness_root(system, index)
    solved = system, root, _platform_columns(root)
    _LAST.append((key, robot, solved))
    return solved


def _loaded_shape(root: Array, half: Array, wrench: Array) -> Array:
    """Coordinates of the frame under a wrench on the platform, shape (6,)."""
    return np.asarray(
        solve_triangular(root, half @ wrench, lower=True, trans=1, check_finite=False), np.float64
    )


def _platform_columns(root: Array) -> Array:
    """L^-1 E for the unit wrenches E of the platform, whose six coordinates come first."""
    load = np.zeros((len(root), 6))
    load[:6] = np.eye(6)
    return np.asarray(solve_triangular(root, load, lower=True, check_finite=False), np.float64)
