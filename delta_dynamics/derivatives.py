# SPDX-License-Identifier: Apache-2.0
"""Exact derivatives of the torques: by the motion, and by any number of the robot's file.

May import: numpy, pkm_twin's core, this package, the standard library; never rclpy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from delta_dynamics.virtual_work import torque_program
from pkm_twin.codegen.arrays import doubles, vectors
from pkm_twin.codegen.expressions import PARAMETERS
from pkm_twin.codegen.program import Program
from pkm_twin.kinematics.engine import Traced
from pkm_twin.kinematics.numbers import FileNumbers, geometry_and_masses
from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]

MOTION: Final = ("q", "qd", "qdd")


@dataclass(frozen=True, eq=False)
class TorqueDerivatives:
    """Derivatives of efforts; rows are efforts, as of Pinocchio's computeRNEADerivatives.

    ``q``, ``qd``, ``qdd``: by positions, rates and accelerations, shape (..., n, n). ``by``: by
    numbers of the file, by path, shape (..., n). In SI units. Of a gradient (one sum of efforts)
    the axis of efforts is left out.
    """

    q: Array
    qd: Array
    qdd: Array
    by: Mapping[str, Array]


def torque_derivatives(
    robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, wrench: ArrayLike | None = None,
    by: Sequence[str] = (),
) -> TorqueDerivatives:  # fmt: skip
    """Derivatives of :func:`delta_dynamics.inverse_dynamics`, loops closed, wrench held.

    Exact to rounding, by differentiation of the program and the implicit function theorem. Dry
    friction counts with its direction held: its jump at rest has no derivative.

    :param q: joint positions, shape (..., n), with rates ``qd`` and accelerations ``qdd``.
    :param wrench: as of :func:`delta_dynamics.inverse_dynamics`.
    :param by: dotted paths of numbers of the file, as :func:`pkm_twin.variants` takes them.
    :raises ParameterError: a path that there is not. Other errors as of ``inverse_dynamics``.
    """
    return _derivatives(robot, (q, qd, qdd), wrench, np.eye(robot.joints_count), by, rows=True)


def torque_gradient(
    robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, weights: ArrayLike,
    wrench: ArrayLike | None = None, by: Sequence[str] = (),
) -> TorqueDerivatives:  # fmt: skip
    """Derivatives of the sum of weights times efforts; costs little more than the efforts.

    :param weights: shape (..., n). Others and errors as of :func:`torque_derivatives`.
    :returns: ``q``, ``qd``, ``qdd`` of shape (..., n), and ``by`` of shape (...).
    """
    return _derivatives(robot, (q, qd, qdd), wrench, weights, by, rows=False)


def _derivatives(
    robot: Robot, motion: Sequence[ArrayLike], wrench: ArrayLike | None, weights: ArrayLike,
    by: Sequence[str], *, rows: bool,
) -> TorqueDerivatives:  # fmt: skip
    n = robot.joints_count
    load = np.zeros(6) if wrench is None else wrench
    inputs = [doubles(value) for value in (*motion, load)]
    if rows:
        inputs = [array[..., None, :] for array in inputs]
    inputs.append(vectors(weights, n, "weights"))
    engine = robot.massive()
    kernel = engine.kernel("torque gradient", _by_motion)
    outputs, status = kernel(robot.inertial, *inputs)
    if status is not None:
        robot.refuse_joints(status, inputs[0], inputs)
    found: dict[str, Array] = {}
    if by:
        table = _of_numbers(robot, inputs) @ numbers_slopes(robot, by)
        found = {path: np.ascontiguousarray(table[..., k]) for k, path in enumerate(by)}
    by_q, by_qd, by_qdd = outputs
    return TorqueDerivatives(by_q, by_qd, by_qdd, found)


def numbers_slopes(robot: Robot, by: Sequence[str]) -> Array:
    """Derivatives of geometry and masses by numbers of the file, shape (numbers, paths)."""
    return FileNumbers(robot, tuple(by), geometry_and_masses).slopes


def torques_by_numbers(
    robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, wrench: ArrayLike, slopes: Array
) -> Array:
    """Derivatives of the efforts by numbers of the file alone, shape (..., n, paths).

    :param robot: also one of :meth:`Robot.numbered`; with ``slopes`` of :func:`numbers_slopes`.
        Others as of :func:`torque_derivatives`.
    """
    inputs = [doubles(value)[..., None, :] for value in (q, qd, qdd, wrench)]
    return _of_numbers(robot, [*inputs, np.eye(robot.joints_count)]) @ slopes


def _of_numbers(robot: Robot, inputs: Sequence[Array]) -> Array:
    """Of a motion, a wrench and weights: by geometry and masses, shape (..., numbers)."""
    kernel = robot.massive().kernel("torque gradient by numbers", _by_numbers, free=True)
    (of_geometry, of_masses), status = kernel(robot.inertial, *inputs)
    if status is not None:
        robot.refuse_joints(status, inputs[0], inputs)
    return np.concatenate([of_geometry, of_masses], -1)


def _by_motion(t: Traced) -> Program:
    program, weighted = _weighted(t)
    inputs = [t.tape.inputs(name, t.joints) for name in MOTION]
    found = t.gradient(weighted, [value for row in inputs for value in row])
    n = t.joints
    outputs = {name: t.lift(found[k * n : (k + 1) * n]) for k, name in enumerate(MOTION)}
    return Program(program.inputs, program.parameters, outputs, program.equations)


def _by_numbers(t: Traced) -> Program:
    program, weighted = _weighted(t)
    masses = t.tape.inputs(PARAMETERS, program.parameters)
    found = t.gradient(weighted, [*t.geometry, *masses])
    split = len(t.geometry)
    outputs = {"geometry": t.lift(found[:split]), "masses": t.lift(found[split:])}
    return Program(program.inputs, program.parameters, outputs, program.equations)


def _weighted(t: Traced) -> tuple[Program, list[tuple[Any, Any]]]:
    """The program of the torques with weights as inputs beside, and the efforts with theirs."""
    program = torque_program(t)
    weights = t.tape.inputs("weights", t.joints)
    inputs = {**program.inputs, "weights": t.joints}
    pairs = list(zip(program.outputs["efforts"], weights, strict=True))
    return Program(inputs, program.parameters, program.outputs, program.equations), pairs
