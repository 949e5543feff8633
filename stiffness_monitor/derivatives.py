# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Exact derivatives of the platform's compliance: by the joints, and by numbers of the file."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.program import Program
from pkm_twin.kinematics.gradients import gradient_program
from pkm_twin.robot.derivatives import Derivatives, differentiate_pose, list_geometry_numbers
from pkm_twin.robot.numbers import CauseSlopes, FileNumbers
from pkm_twin.robot.robot import Robot
from stiffness_monitor.compliance import compliance
from stiffness_monitor.numbers import list_numbers
from stiffness_monitor.programs import NO_PARAMETERS, Elastic, SymbolicFrame

Write = Callable[[SymbolicFrame], Program]
Chosen = tuple[int, ...] | None


def compliance_derivatives(robot: Robot, pose: ArrayLike, by: Sequence[str] = ()) -> Derivatives:
    """Return derivatives of the compliance by the pose, and by numbers of the file at constant pose.

    They are exact to rounding.

    :param pose: shape (..., m), m and rad.
    :param by: dotted paths of numbers of the file, as :func:`pkm_twin.variants` takes them.
    :returns: ``state`` by the pose, shape (..., 6, 6, m), and ``by[path]`` (..., 6, 6).
    :raises ParameterError: an unknown path. Other errors as of ``compliance``.
    """
    by_q, by_numbers = _evaluate_gradients(robot, pose, _write_compliance)
    found: dict[str, Array] = {}
    if by:
        slopes = robot.cached(FileNumbers, tuple(by), elastic_numbers).slopes
        table = _unravel_square(by_numbers @ slopes)
        found = {path: np.ascontiguousarray(table[..., k]) for k, path in enumerate(by)}
    back = robot.inverse_jacobian(robot.inverse(pose))
    return Derivatives(_unravel_square(by_q @ back), found)


def compliance_effects(robot: Robot, pose: ArrayLike) -> Array:
    """Return the change of C per standard deviation of each cause, (..., 6, 6, causes)."""
    if not robot.uncertainty_changes:
        return np.zeros((*compliance(robot, pose).shape, 0))
    return _unravel_square(_cause_effects(robot, pose, _write_compliance))


def energy_effects(robot: Robot, pose: ArrayLike, wrench: ArrayLike) -> Array:
    """Return the energies' change per standard deviation of causes, (..., elements, causes).

    :param wrench: shape (..., 6).
    """
    return _cause_effects(robot, pose, _write_energies, np.asarray(wrench, np.float64)[..., None, :])


def _cause_effects(robot: Robot, pose: ArrayLike, write: Write, *loads: Array) -> Array:
    """Return the change of a program's outputs per standard deviation of each cause."""
    causes = robot.cached(CauseSlopes, elastic_numbers)
    table = _evaluate_gradients(robot, pose, write, causes.chosen, *loads)[1] @ causes.slopes
    return np.asarray(table, np.float64)


def _evaluate_gradients(
    robot: Robot, pose: ArrayLike, write: Write, chosen: Chosen = None, *loads: Array
) -> tuple[Array, Array]:
    """Return a program's derivatives by q, and by geometry and elasticity at constant pose.

    :param chosen: indices of the numbers to differentiate by; None for all. Derivatives by q are
        computed only if a number of the geometry is among them.
    :returns: shape (..., outputs, k) each.
    """
    compliance(robot, pose)  # its errors
    q = robot.inverse(pose)
    kernel = _gradient_kernel(robot.cached(Elastic), write, chosen)
    weights = np.eye(kernel.sizes[0][-1])
    (by_q, by_numbers), _ = kernel(NO_PARAMETERS, q[..., None, :], *loads, weights)
    if by_q.shape[-1]:
        moved = differentiate_pose(robot, q)
        geometry = np.arange(moved.shape[-1])
        if chosen is not None:
            geometry = np.array([k for k in chosen if k < len(geometry)], int)
        changes = np.linalg.solve(robot.jacobian(q), moved[..., geometry])
        by_numbers[..., : len(geometry)] -= by_q @ changes
    return by_q, by_numbers


def _unravel_square(table: Array) -> Array:
    """Reshape (..., 36, k) to (..., 6, 6, k)."""
    return table.reshape(*table.shape[:-2], 6, 6, table.shape[-1])


def elastic_numbers(robot: Robot) -> list[Any]:
    """Return the geometry, then the further inputs of elasticity: numbers or expressions."""
    return [*list_geometry_numbers(robot), *list_numbers(robot.elastic)]


def compliance_gradient(elastic: Elastic) -> Kernel:
    """Return the program of derivatives of a weighted sum of C's entries.

    Inputs: q and 36 weights; outputs: derivatives by q and by all numbers.
    """
    return _gradient_kernel(elastic, _write_compliance, None)


def _gradient_kernel(elastic: Elastic, write: Write, chosen: Chosen) -> Kernel:
    """Return the compiled gradient of the program that ``write`` writes."""

    def write_gradient(s: SymbolicFrame) -> Program:
        program, t = write(s), s.t
        numbers, q = [*t.geometry, *t.more], list(t.q)
        if chosen is not None:
            numbers = [numbers[k] for k in chosen]
            q = q if min(chosen, default=math.inf) < len(t.geometry) else []
        return gradient_program(t, program, {"q": q, "numbers": numbers})

    return elastic.kernel(f"gradient{write.__name__} by {chosen}", write_gradient, free=True)


def _write_compliance(s: SymbolicFrame) -> Program:
    s.factorise()
    return s.program({}, {"compliance": s.compliance.ravel()})


def _write_energies(s: SymbolicFrame) -> Program:
    s.factorise()
    s.apply_wrench(s.t.tape.inputs("wrench", 6))
    return s.program({"wrench": 6}, {"energies": s.energies()})


def compliance_deviation(robot: Robot, pose: ArrayLike) -> Array:
    """Return the standard deviation of the compliance by ``uncertainty``, (..., 6, 6).

    To first order in the standard deviations, independent causes. Zero for a file without causes.

    :param pose: shape (..., m), the mechanism's pose coordinates, m and rad.
    """
    effects = compliance_effects(robot, pose)
    return np.asarray(np.sqrt((effects**2).sum(-1)), np.float64)


def deflection_deviation(robot: Robot, pose: ArrayLike, wrench: ArrayLike) -> Array:
    """Return the standard deviation of the deflection under a wrench, shape (..., 6)."""
    effects = np.einsum("...ijk,...j->...ik", compliance_effects(robot, pose), np.asarray(wrench))
    return np.asarray(np.sqrt((effects**2).sum(-1)), np.float64)
