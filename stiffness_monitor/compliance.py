# SPDX-License-Identifier: Apache-2.0
"""Compliance and strain energy of every robot with elastic members.

A mechanism with kernels of its own (upr_rpu) is solved by the strain-energy method in closed form,
any other that declares its elastic frame by finite elements (:mod:`stiffness_monitor.statics`),
actuators locked: the same numbers where a mechanism has both, but in a millisecond a pose.

May import: numpy, pkm_twin's core, the standard library; never rclpy.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.codegen.kernels import NOT_FINITE, Kernel
from pkm_twin.machine.members import framed
from pkm_twin.machine.robot import Robot
from pkm_twin.mechanisms.elements import TIE, WRENCH
from stiffness_monitor.statics import frame_compliance, frame_energies

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
        return frame_compliance(robot, pose)
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

    ``elements``: of upr_rpu nine names, limb number and R joint, bar or U joint; of other machines
    the frame's members and elastic joints. ``factors``: part of the total in each element, shape
    (..., elements), sum 1; all zero, which says absent, where the wrench is zero. ``energies``:
    shape (..., elements), J. ``total``: P' C P / 2,
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
        return _frame_strain_energy(robot, pose, wrench)
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
    """The kernels to warm up before live use.

    :raises ParameterError: a robot without elastic members.
    """
    if robot.elastic_kernel is None or robot.energy_kernel is None:
        framed(robot).frame(robot.home())
        return robot.forward_kernel, robot.inverse_kernel
    return robot.forward_kernel, robot.inverse_kernel, robot.elastic_kernel, robot.energy_kernel


def _frame_strain_energy(robot: Robot, pose: ArrayLike, wrench: ArrayLike) -> StrainEnergy:
    """The same of a frame. Solved for a wrench of size 1, so that no square leaves the numbers."""
    loads = np.asarray(wrench, np.float64)
    size = np.abs(loads).max(-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        unit = loads / np.where(size == 0.0, 1.0, size)
    names, deflection, energies = frame_energies(robot, pose, unit)
    whole = energies.sum(-1, keepdims=True)
    factors = energies / np.where(whole == 0.0, 1.0, whole)
    largest = factors.max(-1, keepdims=True)
    close = (factors > largest * (1.0 - TIE)) & (largest > 0.0)
    first = np.where(close.any(-1), close.argmax(-1), -1)
    tie = close.sum(-1) > 1
    with np.errstate(over="ignore"):
        deflection, energies, whole = deflection * size, energies * size**2, whole * size**2
    if not (np.isfinite(deflection).all() and np.isfinite(whole).all()):
        raise ValueError("wrench, or its energy, is not finite, or leads to a result that is not")
    for array in (deflection, energies, factors):
        array.setflags(write=False)
    total = whole[..., 0].copy()
    if total.ndim == 0:
        dominant = names[int(first)] if first >= 0 else "none"
        return StrainEnergy(names, factors, energies, float(total), deflection, dominant, bool(tie))
    return StrainEnergy(names, factors, energies, total, deflection, _choices(names)[first], tie)


@lru_cache(maxsize=8)
def _choices(names: tuple[str, ...]) -> NDArray[np.str_]:
    return np.array([*names, "none"])


def _raise_fault(robot: Robot, fault: Array) -> None:
    first = fault.reshape(-1, fault.shape[-1])
    code, source, _ = first[np.flatnonzero(first[:, 0])[0]].tolist()
    wrong_wrench = code == NOT_FINITE and source == WRENCH
    robot.raise_fault(fault, "wrench, or its energy," if wrong_wrench else "pose")
