# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Exact derivatives of pose and joints: by each other, and by any number of the robot's file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array, vectors
from pkm_twin.kinematics.gradients import platform_gradient
from pkm_twin.machine.geometry import list_geometry
from pkm_twin.robot.numbers import CauseSlopes, FileNumbers
from pkm_twin.robot.robot import Robot


@dataclass(frozen=True, eq=False)
class Derivatives:
    """Derivatives of r results at a state, in SI units.

    ``state``: by the n or m numbers of the state, shape (..., r, n). ``by``: by numbers of the
    file, by path, shape (..., r).
    """

    state: Array
    by: Mapping[str, Array]


def joint_rates(robot: Robot, q: Array, rate: Array, change: Array) -> tuple[Array, Array]:
    """Return first and second derivatives of joints (k, n) from those of the pose, shape (k, m) each."""
    back = robot.inverse_jacobian(q)
    first = (back @ rate[..., None])[..., 0]
    return first, joint_accelerations(robot, q, first, back, change)


def joint_accelerations(robot: Robot, q: Array, qd: Array, back: Array, change: Array | float = 0.0) -> Array:
    """Return second derivatives of joints (k, n) from those of the pose, at joint rates (k, n).

    :param back: of :meth:`Robot.inverse_jacobian`, shape (k, n, m).
    """
    bent = robot.project_redundant(q, qd)[2]
    own = change - robot.pose_acceleration(q, qd, bent)
    return np.asarray(bent + (back @ own[..., None])[..., 0], np.float64)


def nearest_motion(robot: Robot, q: Array, qd: Array, qdd: Array) -> tuple[Array, Array]:
    """Return the possible rates and accelerations of all drives at q nearest to these, (..., n) each.

    Least squares, with slides relative to the machine's size, average out the noise by which redundant
    drives contradict each other. Without redundancy nothing changes.
    """
    if not robot.redundant:
        return qd, qdd
    back = robot.inverse_jacobian(q)
    weighted = (back / robot.joint_scales[:, None] ** 2).swapaxes(-1, -2)
    onto = back @ np.linalg.inv(weighted @ back) @ weighted
    rate = (onto @ qd[..., None])[..., 0]
    bent = robot.project_redundant(q, rate)[2]
    return rate, np.asarray(bent + (onto @ (qdd - bent)[..., None])[..., 0])


def forward_derivatives(robot: Robot, q: ArrayLike, by: Sequence[str] = ()) -> Derivatives:
    """Differentiate :meth:`Robot.forward`: ``state`` by q (..., m, n), ``by[path]`` (..., m).

    Exact to rounding, by the implicit function theorem. Where a number of the file changes, the
    leading actuated joints are held. In an overconstrained machine only the closures that determine
    its state count.

    :param q: joint positions, shape (..., n), rad or m.
    :param by: dotted paths of numbers of the file, as :func:`pkm_twin.variants` takes them.
    :raises ParameterError: an unknown path. Other errors as of ``forward``.
    """
    rows = np.eye(len(robot.pose_names), len(robot.pose_names) + 12)
    return Derivatives(robot.jacobian(q), _differentiate_by_numbers(robot, q, rows, by))


def inverse_derivatives(robot: Robot, pose: ArrayLike, by: Sequence[str] = ()) -> Derivatives:
    """Differentiate :meth:`Robot.inverse`: ``state`` by the pose (..., n, m), ``by`` (..., n).

    The pose is held where a number of the file changes.

    :param pose: shape (..., m), m and rad.
    :raises ParameterError: an unknown path. Other errors as of ``inverse``.
    """
    if by:
        robot.check_independent("derivatives by numbers of the file with the pose held")
    found = forward_derivatives(robot, robot.inverse(pose), by)
    back = robot.inverse_jacobian(robot.inverse(pose))
    return Derivatives(back, {path: -(back @ row[..., None])[..., 0] for path, row in found.by.items()})


def platform_derivatives(robot: Robot, q: ArrayLike, by: Sequence[str] = ()) -> Derivatives:
    """Return twists of the platform: ``state`` per joint rate (..., 6, n), ``by[path]`` (..., 6).

    Translation of the reference point and rotation vector, base axes, per unit change. Arguments and
    errors as in :func:`forward_derivatives`.
    """
    rows = make_twist_rows(len(robot.pose_names), robot.platform(q)[1])
    return Derivatives(robot.platform_jacobian(q), _differentiate_by_numbers(robot, q, rows, by))


def make_twist_rows(m: int, rotation: Array) -> Array:
    """Return the weights of pose, position and rotation that give the six components of a twist.

    :param rotation: of the platform now, shape (..., 3, 3).
    :returns: shape (..., 6, m + 12).
    """
    rows = np.zeros((*rotation.shape[:-2], 6, m + 12))
    rows[..., :3, m : m + 3] = np.eye(3)
    turns = np.zeros((*rotation.shape[:-2], 3, 3, 3))
    # The entry of each axis in R' R^T, which is skew.
    for axis, (i, j) in enumerate(((2, 1), (0, 2), (1, 0))):
        turns[..., axis, i, :] = rotation[..., j, :]
    rows[..., 3:, m + 3 :] = turns.reshape(*rotation.shape[:-2], 3, 9)
    return rows


def _differentiate_by_numbers(robot: Robot, q: ArrayLike, rows: Array, by: Sequence[str]) -> dict[str, Array]:
    """Differentiate weighted sums of pose, position and rotation by numbers of the file."""
    if not by:
        return {}
    slopes = robot.cached(FileNumbers, tuple(by), list_geometry_numbers).slopes
    table = _differentiate_by_geometry(robot, q, rows) @ slopes
    return {path: np.ascontiguousarray(table[..., k]) for k, path in enumerate(by)}


def differentiate_pose(robot: Robot, q: ArrayLike) -> Array:
    """Differentiate the pose by the engine's geometry, joints held, shape (..., m, k)."""
    return _differentiate_by_geometry(robot, q, np.eye(len(robot.pose_names), len(robot.pose_names) + 12))


def position_errors_by_source(robot: Robot, q: ArrayLike) -> Array:
    """Return the platform's displacement by one standard deviation of each uncertainty, joints locked.

    :returns: displacements of the reference point, shape (..., 3, uncertainties), m.
    """
    causes, m = robot.cached(CauseSlopes, list_geometry_numbers), len(robot.pose_names)
    table = _differentiate_by_geometry(robot, q, np.eye(3, m + 12, m))[..., list(causes.chosen)]
    return np.asarray(table @ causes.slopes, np.float64)


def _differentiate_by_geometry(robot: Robot, q: ArrayLike, rows: Array) -> Array:
    states = vectors(q, robot.joints_count, "q")[..., None, :]
    return robot.evaluate(platform_gradient(robot.engine), states, rows)[0]


def list_geometry_numbers(robot: Robot) -> list[Any]:
    """Return the numbers or expressions of ``Engine.geometry``."""
    return list(list_geometry(robot.graph))
