# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Exact derivatives of the torques: by the motion, and by any number of the robot's file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from delta_dynamics.torques.virtual_work import torque_program
from pkm_twin.codegen.arrays import Array, doubles, vectors
from pkm_twin.codegen.expressions import PARAMETERS
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.program import Program
from pkm_twin.kinematics.gradients import gradient_program
from pkm_twin.kinematics.traced import Traced
from pkm_twin.robot.numbers import CauseSlopes, FileNumbers, geometry_and_masses
from pkm_twin.robot.robot import Robot


@dataclass(frozen=True, eq=False)
class TorqueDerivatives:
    """Derivatives of efforts; rows are efforts, as of Pinocchio's computeRNEADerivatives.

    ``q``, ``qd``, ``qdd``: by positions, rates and accelerations, shape (..., n, n). ``by``: by
    numbers of the file, by path, shape (..., n). In SI units. The gradient of a sum of efforts has
    no axis of efforts.
    """

    q: Array
    qd: Array
    qdd: Array
    by: Mapping[str, Array]


def torque_derivatives(
    robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, wrench: ArrayLike | None = None, by: Sequence[str] = ()
) -> TorqueDerivatives:
    """Compute the derivatives of :func:`delta_dynamics.inverse_dynamics`, wrench constant.

    Exact to rounding, by differentiation of the program and the implicit function theorem. Dry
    friction counts with its direction held: its jump at rest has no derivative.

    :param q: joint positions, shape (..., n), with rates ``qd`` and accelerations ``qdd``.
    :param wrench: as in :func:`delta_dynamics.inverse_dynamics`.
    :param by: dotted paths of numbers of the file, as :func:`pkm_twin.variants` takes them.
    :raises ParameterError: an unknown path. Other errors as of ``inverse_dynamics``.
    """
    return _compute_derivatives(robot, (q, qd, qdd), wrench, np.eye(robot.joints_count), by, rows=True)


def torque_gradient(
    robot: Robot,
    q: ArrayLike,
    qd: ArrayLike,
    qdd: ArrayLike,
    weights: ArrayLike,
    wrench: ArrayLike | None = None,
    by: Sequence[str] = (),
) -> TorqueDerivatives:
    """Compute the derivatives of the sum of weights times efforts, in reverse mode.

    :param weights: shape (..., n). Others and errors as in :func:`torque_derivatives`.
    :returns: ``q``, ``qd``, ``qdd`` of shape (..., n), and ``by`` of shape (...).
    """
    chosen = vectors(weights, robot.joints_count, "weights")
    return _compute_derivatives(robot, (q, qd, qdd), wrench, chosen, by, rows=False)


def _compute_derivatives(
    robot: Robot,
    motion: Sequence[ArrayLike],
    wrench: ArrayLike | None,
    weights: Array,
    by: Sequence[str],
    *,
    rows: bool,
) -> TorqueDerivatives:
    """Differentiate the sum of weights times efforts.

    :param rows: differentiate one such sum for each row of ``weights``, on a further axis.
    """
    inputs = _stack_inputs(motion, wrench, weights, rows=rows)
    by_q, by_qd, by_qdd = robot.evaluate(motion_gradient_kernel(robot), *inputs, p=robot.inertial)
    found: dict[str, Array] = {}
    if by:
        table = _evaluate_number_gradient(robot, inputs) @ differentiate_numbers(robot, by)
        found = {path: np.ascontiguousarray(table[..., k]) for k, path in enumerate(by)}
    return TorqueDerivatives(by_q, by_qd, by_qdd, found)


def torque_effects(robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, wrench: ArrayLike | None) -> Array:
    """Return the change of efforts per standard deviation of each cause, (..., n, causes)."""
    causes = robot.cached(CauseSlopes, geometry_and_masses)
    kernel = robot.cached(_cause_gradient_kernel)
    inputs = _stack_inputs((q, qd, qdd), wrench, np.eye(robot.joints_count), rows=True)
    (table,) = robot.evaluate(kernel, *inputs, p=robot.inertial)
    return np.asarray(table @ causes.slopes, np.float64)


def _cause_gradient_kernel(robot: Robot) -> Kernel:
    chosen = robot.cached(CauseSlopes, geometry_and_masses).chosen

    def write_effort_gradient(t: Traced) -> Program:
        """Write the gradient of the efforts with respect to the numbers that the causes change."""
        program = torque_program(t)
        numbers = [*t.geometry, *t.tape.inputs(PARAMETERS, program.parameters)]
        return gradient_program(t, program, {"numbers": [numbers[k] for k in chosen]})

    return robot.massive().kernel(f"torque gradient by {chosen}", write_effort_gradient, free=True)


def _stack_inputs(motion: Sequence[ArrayLike], wrench: ArrayLike | None, weights: Array, *, rows: bool) -> list[Array]:
    load = np.zeros(6) if wrench is None else wrench
    inputs = [doubles(value) for value in (*motion, load)]
    if rows:
        # Add an axis for the rows; single samples do without it and take the fast path.
        inputs = [array if array.ndim == 1 else array[..., None, :] for array in inputs]
    return [*inputs, weights]


def differentiate_numbers(robot: Robot, by: Sequence[str]) -> Array:
    """Return the derivatives of geometry and masses with respect to numbers of the file, (values, paths)."""
    return robot.cached(FileNumbers, tuple(by), geometry_and_masses).slopes


def torques_by_numbers(
    robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, wrench: ArrayLike, slopes: Array
) -> Array:
    """Compute the derivatives of the efforts with respect to numbers of the file, (..., n, paths).

    :param robot: also one of :meth:`Robot.numbered`; with ``slopes`` of :func:`differentiate_numbers`.
        Others as in :func:`torque_derivatives`.
    """
    inputs = _stack_inputs((q, qd, qdd), wrench, np.eye(robot.joints_count), rows=True)
    return _evaluate_number_gradient(robot, inputs) @ slopes


def _evaluate_number_gradient(robot: Robot, inputs: Sequence[Array]) -> Array:
    """Return the efforts' derivatives with respect to geometry, then masses, on the last axis."""
    return np.concatenate(robot.evaluate(number_gradient_kernel(robot), *inputs, p=robot.inertial), -1)


def motion_gradient_kernel(robot: Robot) -> Kernel:
    """Build the kernel that computes the efforts' derivatives with respect to q, qd and qdd.

    Inputs: q, qd, qdd, wrench, and one weight per effort: the gradient is of the weighted sum.
    """

    def write(t: Traced) -> Program:
        program = torque_program(t)
        return gradient_program(t, program, {name: t.drives.variables(name) for name in ("q", "qd", "qdd")})

    return robot.massive().kernel("torque gradient", write)


def number_gradient_kernel(robot: Robot) -> Kernel:
    """Build the kernel that computes the efforts' derivatives with respect to geometry and masses.

    Its inputs are those of :func:`motion_gradient_kernel`.
    """

    def write(t: Traced) -> Program:
        program = torque_program(t)
        masses = t.tape.inputs(PARAMETERS, program.parameters)
        return gradient_program(t, program, {"geometry": t.geometry, "masses": masses})

    return robot.massive().kernel("torque gradient by numbers", write, free=True)
