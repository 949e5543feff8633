# SPDX-License-Identifier: Apache-2.0
"""Compliance and strain energy by the strain-energy method, for every robot with elastic members.

May import: numpy, pkm_twin's core, the standard library; never rclpy.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.errors import ParameterError
from pkm_twin.kernels import NOT_FINITE, Kernel
from pkm_twin.mechanisms.elements import WRENCH
from pkm_twin.mechanisms.robot import Robot

Array = NDArray[np.float64]


def compliance(robot: Robot, pose: ArrayLike) -> Array:
    """Compliance of the platform at its origin o.

    C = K^-1, K = sum over limbs of J_i C_i^-1 J_i' (2UPR-RPU paper, equations 34 and 35). Every
    matrix is exactly symmetric and positive definite.

    :param pose: shape (..., 3), the mechanism's pose parameters, m and rad.
    :returns: shape (..., 6, 6), order x y z rx ry rz in fixed axes: m/N, rad/N, m/(N m),
        rad/(N m).
    :raises ParameterError: a robot without elastic members.
    :raises UnreachableError: a pose that is none of the mechanism's, by limb, sample and miss.
    :raises SingularityError: a compliance that is not symmetric positive definite, by sample.
    :raises ValueError: a wrong last axis, or a value that is not finite, by sample.
    """
    kernel = robot.elastic_kernel
    if kernel is None:
        raise _no_members(robot)
    flat, fault = kernel(robot.parameters, pose)
    if fault.ndim > 1 or fault.item(0) != 0.0:
        robot.raise_fault(fault, "pose")
    return flat.reshape(*flat.shape[:-1], 6, 6)


def stiffness(robot: Robot, pose: ArrayLike) -> Array:
    """Stiffness of the platform at its origin, shape (..., 6, 6): the compliance's inverse.

    Exactly symmetric; fixed axes, N/m, N/rad, N m/m, N m/rad. Errors as in :func:`compliance`.
    """
    matrix = np.linalg.inv(compliance(robot, pose))
    return np.asarray((matrix + matrix.swapaxes(-1, -2)) / 2, np.float64)


@dataclass(frozen=True, eq=False)
class StrainEnergy:
    """What a wrench does to the platform, and where its energy goes.

    ``elements``: names of the nine elements, limb number and R joint, bar or U joint.
    ``factors``: part of the total in each element, shape (..., 9), sum 1; all zero, which says
    absent, where the wrench is zero. ``energies``: shape (..., 9), J. ``total``: P' C P / 2,
    shape (...), J. ``deflection``: C P at the platform's origin, fixed axes, shape (..., 6), m and
    rad. ``dominant``: name of the element with the largest factor, ``"none"`` for a zero wrench;
    a string for one sample, an array of strings for a batch. ``tie``: whether the largest two
    factors are within 1e-9 of each other; the dominant one is then the first in ``elements``.
    """

    elements: tuple[str, ...]
    factors: Array
    energies: Array
    total: Array | float
    deflection: Array
    dominant: str | NDArray[np.str_]
    tie: bool | NDArray[np.bool_]


def strain_energy(robot: Robot, pose: ArrayLike, wrench: ArrayLike) -> StrainEnergy:
    """Strain energy of a wrench, element by element (2UPR-RPU paper, equations 36 to 38).

    :param pose: shape (..., 3), the mechanism's pose parameters, m and rad.
    :param wrench: force and moment that the surroundings apply to the platform at its origin,
        fixed axes, shape (..., 6), N and N m; broadcast against the pose.
    :raises ValueError: as :func:`compliance`, also for the wrench.
    """
    kernel = robot.energy_kernel
    if kernel is None:
        raise _no_members(robot)
    deflection, energies, factors, summary, fault = kernel(robot.parameters, pose, wrench)
    for array in (deflection, energies, factors):
        array.setflags(write=False)
    names = robot.element_names
    if fault.ndim == 1:
        if fault.item(0) != 0.0:
            _raise_fault(robot, fault)
        total, first, tie = summary.tolist()
        dominant = names[int(first)] if first >= 0.0 else "none"
        return StrainEnergy(names, factors, energies, total, deflection, dominant, tie != 0.0)
    if fault[..., 0].any():
        _raise_fault(robot, fault)
    return StrainEnergy(
        names,
        factors,
        energies,
        np.ascontiguousarray(summary[..., 0]),
        deflection,
        # Index -1, without load, is the last name.
        _choices(names)[summary[..., 1].astype(np.intp)],
        summary[..., 2] != 0.0,
    )


def kernels(robot: Robot) -> tuple[Kernel, ...]:
    """The kernels to warm up before live use."""
    if robot.elastic_kernel is None or robot.energy_kernel is None:
        raise _no_members(robot)
    return robot.forward_kernel, robot.elastic_kernel, robot.energy_kernel


@lru_cache(maxsize=8)
def _choices(names: tuple[str, ...]) -> NDArray[np.str_]:
    return np.array([*names, "none"])


def _raise_fault(robot: Robot, fault: Array) -> None:
    first = fault.reshape(-1, fault.shape[-1])
    code, source, _ = first[np.flatnonzero(first[:, 0])[0]].tolist()
    wrong_wrench = code == NOT_FINITE and source == WRENCH
    robot.raise_fault(fault, "wrench, or its energy," if wrong_wrench else "pose")


def _no_members(robot: Robot) -> ParameterError:
    return ParameterError(
        "mechanism", robot.mechanism, "a mechanism with elastic members (upr_rpu)"
    )
