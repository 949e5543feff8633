# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compute deflection and strain energies of a robot's elastic elements under a wrench.

Finite elements of its frame (:mod:`stiffness_monitor.structure`), actuators locked. One beam per
member is exact, because loads act at members' ends.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.codegen.arrays import Array, Mask, doubles, vectors
from pkm_twin.codegen.code import NOT_FINITE
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.errors import SingularityError
from pkm_twin.robot.rejection import reject_joints
from pkm_twin.robot.robot import Robot
from stiffness_monitor.programs import DEFLECTION_PARTS, NO_PARAMETERS, Elastic

MIN_PIVOT_RATIO: Final = 1e-10
"""Smallest pivot over its diagonal entry at which the frame is stiff, not a mechanism: 0 at a
singularity, growing with the square of the distance from it."""
TIE_TOLERANCE: Final = 1e-9
"""Relative difference below which two energies tie."""


@dataclass(frozen=True, eq=False)
class PlatformResponse:
    """Hold deflection and strain energy under a wrench; arrays are read-only.

    ``compliance``: C of the platform at its reference point, shape (..., 6, 6), exactly symmetric.
    ``deflection``: C P there, shape (..., 6), m and rad; base axes. ``elements``: the frame's
    members and elastic joints, of upr_rpu limb number and R joint, bar or U joint. ``energies``:
    strain energy of each, shape (..., elements), J. ``factors``: its share of the total, sum 1 (the
    2UPR-RPU paper's local strain-energy factors); all zero for a zero wrench.
    ``total``: P' C P / 2, shape (...), J.
    ``dominant``: name of the element with the largest factor, ``"none"`` for a zero wrench; a
    string for one sample, an array of strings for a batch. ``tie``: whether the largest two factors
    are within 1e-9 of each other; the dominant one is then the first in ``elements``.
    """

    elements: tuple[str, ...]
    compliance: Array
    factors: Array
    energies: Array
    total: Array | float
    deflection: Array
    dominant: str | NDArray[np.str_]
    tie: bool | Mask


StrainEnergy = PlatformResponse
"""Result of :func:`strain_energy`."""


def platform_response(robot: Robot, q: ArrayLike, wrench: ArrayLike) -> PlatformResponse:
    """Return compliance, deflection and strain energies at joint positions, from one factorisation.

    2UPR-RPU paper: C (equation 35), the total strain energy U = P' C P / 2 (equation 37), and the
    local strain-energy factors mu_ij = U_ij / U (equation 38); they are computed in
    :meth:`.SymbolicFrame.factorise` and :func:`.write_response`. The mean of mu over even poses of
    a workspace is the global factor (equation 39).

    :param q: joint positions, shape (..., n), rad or m; locked.
    :param wrench: external force and moment on the platform at its reference point, base axes,
        shape (..., 6), N and N m; broadcast against q.
    :raises ParameterError: the robot's file lacks a section that elasticity needs.
    :raises UnreachableError: a joint state without an assembly, by limb, sample and miss.
    :raises SingularityError: a singularity on the way from home, or a frame that is a mechanism.
    :raises ValueError: a wrong last axis, or a value that is not finite.
    """
    names = robot.cached(Elastic).names
    checked = partial(_evaluate_checked, robot)
    row = robot.function(_response_kernel, otherwise=checked)(q, wrench)
    if row.ndim == 1 and not row[-1] > MIN_PIVOT_RATIO:
        row = checked(q, wrench)
    row.setflags(write=False)
    n = len(names)
    factors, energies, deflection = row[..., :n], row[..., n : 2 * n], row[..., 2 * n : 2 * n + 6]
    matrix = row[..., 2 * n + 7 : 2 * n + 43].reshape(*row.shape[:-1], 6, 6)
    if row.ndim == 1:
        # Python floats: for one sample numpy's calls would take most of the time.
        shares = factors.tolist()
        bound = max(shares) * (1.0 - TIE_TOLERANCE)
        close = [k for k, share in enumerate(shares) if share > bound]
        dominant = names[close[0]] if close else "none"
        return PlatformResponse(
            names, matrix, factors, energies, float(row[2 * n + 6]), deflection, dominant, len(close) > 1
        )
    near = factors > factors.max(-1, keepdims=True) * (1.0 - TIE_TOLERANCE)
    # Index -1, without load, is the last name.
    first = np.where(near.any(-1), near.argmax(-1), -1)
    return PlatformResponse(
        names,
        matrix,
        factors,
        energies,
        np.ascontiguousarray(row[..., 2 * n + 6]),
        deflection,
        np.array([*names, "none"])[first],
        near.sum(-1) > 1,
    )


def _response_kernel(robot: Robot) -> Kernel:
    return robot.cached(Elastic).response


def _evaluate_checked(robot: Robot, q: ArrayLike, wrench: ArrayLike) -> Array:
    q, wrench = doubles(q, "joint positions"), vectors(wrench, 6, "the wrench")
    (rows,), status = robot.cached(Elastic).response(NO_PARAMETERS, q, wrench)
    raise_first_rejection(robot, q, wrench, rows[..., -1], status)
    return rows


def raise_first_rejection(
    robot: Robot, q: ArrayLike, wrench: ArrayLike, pivot_ratio: Array, status: Array | None
) -> None:
    """Raise the error of the first rejected sample, if any.

    :param pivot_ratio: smallest pivot ratio of the frame, 0 if it is a mechanism. ``status``: the
    program's status.
    """
    if status is None and (pivot_ratio > MIN_PIVOT_RATIO).all():
        return
    codes = np.zeros(pivot_ratio.shape) if status is None else status[..., 0]
    for index in np.ndindex(*pivot_ratio.shape):
        if status is not None and codes[index]:
            place = np.broadcast_to(np.asarray(q, float), (*codes.shape, robot.joints_count))
            load = np.broadcast_to(np.asarray(wrench, float), (*codes.shape, 6))[index]
            if codes[index] != NOT_FINITE or not np.isfinite(place[index]).all():
                reject_joints(robot, robot.engine, status, q)
            if not math.isfinite(sum(x * x for x in load.tolist())):
                where = f" at sample {index}" if index else ""
                raise ValueError(f"wrench, or its energy,{where} is not finite, or leads to a result that is not")
        found = 0.0 if codes[index] else float(pivot_ratio[index])
        if not found > MIN_PIVOT_RATIO:
            frame = "the elastic frame of the pose"
            raise SingularityError(frame, index, found, MIN_PIVOT_RATIO)


def compliance(robot: Robot, pose: ArrayLike) -> Array:
    """Return the platform's compliance at its reference point, symmetric positive definite.

    :param pose: shape (..., m), the mechanism's pose coordinates, m and rad.
    :returns: shape (..., 6, 6), order x y z rx ry rz in base axes: m/N, rad/N, m/(N m),
        rad/(N m).
    :raises UnreachableError: a pose that is none of the mechanism's, by limb, sample and miss.
        Other errors as :func:`platform_response`.
    """
    _ = robot.cached(Elastic)
    return platform_response(robot, robot.inverse(pose), np.zeros(6)).compliance.copy()


def stiffness(robot: Robot, pose: ArrayLike) -> Array:
    """Return the stiffness at the platform's reference point, (..., 6, 6): inverse compliance.

    K of the 2UPR-RPU paper (equation 34).
    Exactly symmetric; base axes, N/m, N/rad, N m/m, N m/rad. Errors as in :func:`compliance`.
    """
    matrix = np.linalg.inv(compliance(robot, pose))
    return np.asarray((matrix + matrix.swapaxes(-1, -2)) / 2, np.float64)


def strain_energy(robot: Robot, pose: ArrayLike, wrench: ArrayLike) -> PlatformResponse:
    """Return :func:`platform_response` for poses (..., m); errors also as :func:`compliance`."""
    _ = robot.cached(Elastic)
    return platform_response(robot, robot.inverse(pose), wrench)


def member_deflections(robot: Robot, q: ArrayLike, wrench: ArrayLike) -> dict[str, tuple[Array, Array]]:
    """Return points along every member and their displacements under a wrench, by member.

    :param q, wrench: as in :func:`platform_response`; so are errors.
    :returns: points, shape (..., 5, 3), from start to end, and displacements of the same shape, m;
        base axes.
    """
    elastic = robot.cached(Elastic)
    (rows, measure), status = elastic.deflections(NO_PARAMETERS, q, wrench)
    raise_first_rejection(robot, q, wrench, measure[..., 0], status)
    names = [member.name for member in elastic.plan.members]
    table = rows.reshape(*rows.shape[:-1], len(names), 2, DEFLECTION_PARTS + 1, 3)
    return {name: (table[..., k, 0, :, :], table[..., k, 1, :, :]) for k, name in enumerate(names)}


def kernels(robot: Robot) -> tuple[Kernel, ...]:
    """Return the kernels to warm up before live use.

    :raises ParameterError: a robot without elastic members.
    """
    return robot.engine.forward, robot.cached(Elastic).response
