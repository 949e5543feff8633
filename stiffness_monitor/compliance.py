# SPDX-License-Identifier: Apache-2.0
"""Compliance and strain energy of every robot with elastic members.

A mechanism with kernels of its own (upr_rpu) is solved by the strain-energy method in closed form,
any other that declares its elastic frame by finite elements (:mod:`stiffness_monitor.statics`),
actuators locked: the same numbers where a mechanism has both, but in a millisecond a pose.

May import: numpy, pkm_twin's core, the standard library; never rclpy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.codegen.arrays import finite, vectors
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.errors import SingularityError
from pkm_twin.machine.robot import SINGULARITY_BOUND, Robot
from stiffness_monitor.elements import TIE, compliance_kernel, energy_kernel
from stiffness_monitor.statics import frame_compliance, frame_energies

Array = NDArray[np.float64]


def compliance(robot: Robot, pose: ArrayLike) -> Array:
    """Compliance of the platform at its origin o.

    C = K^-1, K = sum over limbs of J_i C_i^-1 J_i' (2UPR-RPU paper, equations 34 and 35). Every
    matrix is exactly symmetric and positive definite.

    :param pose: shape (..., m), the mechanism's pose coordinates, m and rad.
    :returns: shape (..., 6, 6), order x y z rx ry rz in fixed axes: m/N, rad/N, m/(N m),
        rad/(N m).
    :raises ParameterError: a robot without elastic members.
    :raises UnreachableError: a pose that is none of the mechanism's, by limb, sample and miss.
    :raises SingularityError: a compliance that is not symmetric positive definite, by sample.
    :raises ValueError: a wrong last axis, or a value that is not finite, by sample.
    """
    if not robot.element_names:
        return frame_compliance(robot, pose)
    row = _row(robot, "compliance", compliance_kernel, pose)
    return row[..., :36].reshape(*row.shape[:-1], 6, 6)


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

    :param pose: shape (..., m), the mechanism's pose coordinates, m and rad.
    :param wrench: force and moment that the surroundings apply to the platform at its origin,
        fixed axes, shape (..., 6), N and N m; broadcast against the pose.
    :raises ValueError: as :func:`compliance`, also for the wrench.
    """
    if not robot.element_names:
        return _frame_strain_energy(robot, pose, wrench)
    row = _row(robot, "strain energy", energy_kernel, pose, wrench)
    n = len(robot.element_names)
    return _answer(
        robot.element_names, row[..., :n], row[..., n : 2 * n], row[..., 2 * n + 6],
        row[..., 2 * n : 2 * n + 6],
    )  # fmt: skip


def _row(
    robot: Robot, name: str, kernel: Callable[[Robot], Kernel], pose: ArrayLike, *rest: ArrayLike
) -> Array:
    """What a kernel of elements answers, shape (..., size), refused by sample."""
    result = robot.call_one(name, lambda: kernel(robot), robot.elastic_parameters, pose, *rest)
    if result is not None and result[-2] > SINGULARITY_BOUND and result[-1] >= 0.0:
        return result
    (rows,), status = kernel(robot)(robot.elastic_parameters, pose, *rest)
    low = rows[..., -2] > SINGULARITY_BOUND
    if status is None and low.all() and (rows[..., -1] >= 0.0).all():
        return rows
    robot.inverse(pose)
    codes = np.zeros(low.shape) if status is None else status[..., 0]
    for index in np.ndindex(*low.shape):
        if codes[index]:
            what = "wrench, or its energy," if rest else "pose"
            where = f" at sample {index}" if index else ""
            raise ValueError(f"{what}{where} is not finite, or leads to a result that is not")
        if not low[index]:
            raise SingularityError("pose", index, float(rows[index][-2]), SINGULARITY_BOUND)
    return rows


def _answer(
    names: tuple[str, ...], factors: Array, energies: Array, total: Array, deflection: Array
) -> StrainEnergy:
    """With the dominant element: the first of those that tie."""
    for array in (deflection, energies, factors):
        array.setflags(write=False)
    if factors.ndim == 1:
        # One sample, without numpy.
        shares = factors.tolist()
        bound = max(shares) * (1.0 - TIE)
        close = [k for k, share in enumerate(shares) if share > bound]
        dominant = names[close[0]] if close else "none"
        return StrainEnergy(
            names, factors, energies, float(total), deflection, dominant, len(close) > 1
        )
    near = factors > factors.max(-1, keepdims=True) * (1.0 - TIE)
    # Index -1, without load, is the last name.
    first = np.where(near.any(-1), near.argmax(-1), -1)
    return StrainEnergy(
        names, factors, energies, np.ascontiguousarray(total), deflection, _choices(names)[first],
        near.sum(-1) > 1,
    )  # fmt: skip


def kernels(robot: Robot) -> tuple[Kernel, ...]:
    """The kernels to warm up before live use.

    :raises ParameterError: a robot without elastic members.
    """
    if not robot.element_names:
        robot.structure()
        return (robot.engine.forward,)
    return robot.engine.forward, compliance_kernel(robot), energy_kernel(robot)


def _frame_strain_energy(robot: Robot, pose: ArrayLike, wrench: ArrayLike) -> StrainEnergy:
    """The same of a frame. Solved for a wrench of size 1, so that no square leaves the numbers."""
    loads = vectors(wrench, 6, "the wrench")
    size = np.abs(loads).max(-1, keepdims=True)
    unit = loads / np.where(size == 0.0, 1.0, size)
    names, deflection, energies = frame_energies(robot, pose, unit)
    whole = energies.sum(-1, keepdims=True)
    factors = energies / np.where(whole == 0.0, 1.0, whole)
    with np.errstate(over="ignore"):
        deflection, energies, whole = deflection * size, energies * size**2, whole * size**2
    for part in (deflection, whole):
        finite(part, "the wrench")
    return _answer(names, factors, energies, whole[..., 0].copy(), deflection)


@lru_cache(maxsize=8)
def _choices(names: tuple[str, ...]) -> NDArray[np.str_]:
    return np.array([*names, "none"])
