# SPDX-License-Identifier: Apache-2.0
"""Exact derivatives of the platform's compliance: by the joints, and by numbers of the file.

May import: numpy, pkm_twin's core, this package, the standard library; never rclpy.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.program import Program
from pkm_twin.kinematics.derivatives import Derivatives, geometry_numbers, pose_by_geometry
from pkm_twin.kinematics.gradients import gradient_program
from pkm_twin.kinematics.numbers import cause_slopes, file_numbers
from pkm_twin.machine.robot import Robot
from stiffness_monitor.compliance import compliance
from stiffness_monitor.numbers import numbers_of
from stiffness_monitor.programs import NONE, Elastic, Solved, elastic_of

Array = NDArray[np.float64]

ENTRIES = 36


def compliance_derivatives(robot: Robot, pose: ArrayLike, by: Sequence[str] = ()) -> Derivatives:
    """Derivatives of :func:`stiffness_monitor.compliance`, the pose held for those by numbers.

    Exact to rounding.

    :param pose: shape (..., m), m and rad.
    :param by: dotted paths of numbers of the file, as :func:`pkm_twin.variants` takes them.
    :returns: ``state`` by the pose, shape (..., 6, 6, m), and ``by[path]`` (..., 6, 6).
    :raises ParameterError: a path that there is not. Other errors as of ``compliance``.
    """
    by_q, by_numbers = _tables(robot, pose)
    found: dict[str, Array] = {}
    if by:
        slopes = file_numbers(robot, tuple(by), elastic_numbers).slopes
        table = _square(by_numbers @ slopes)
        found = {path: np.ascontiguousarray(table[..., k]) for k, path in enumerate(by)}
    back = np.linalg.inv(robot.jacobian(robot.inverse(pose)))
    return Derivatives(_square(by_q @ back), found)


def compliance_effects(robot: Robot, pose: ArrayLike) -> Array:
    """What one standard deviation of each of the file's causes changes, (..., 6, 6, causes)."""
    if not robot.causes:
        return np.zeros((*compliance(robot, pose).shape, 0))
    return _square(_tables(robot, pose)[1] @ cause_slopes(robot, elastic_numbers))


def _tables(robot: Robot, pose: ArrayLike) -> tuple[Array, Array]:
    """Of C's entries by q, and by geometry and elasticity with the pose held, (..., 36, k)."""
    compliance(robot, pose)  # its errors
    q = robot.inverse(pose)
    (by_q, by_numbers), _ = compliance_gradient(elastic_of(robot))(
        NONE, q[..., None, :], np.eye(ENTRIES)
    )
    moved = pose_by_geometry(robot, q)
    by_numbers[..., : moved.shape[-1]] -= by_q @ np.linalg.solve(robot.jacobian(q), moved)
    return by_q, by_numbers


def _square(table: Array) -> Array:
    return table.reshape(*table.shape[:-2], 6, 6, table.shape[-1])


def elastic_numbers(robot: Robot) -> list[Any]:
    """Geometry, then what elasticity takes beside it, of numbers or expressions."""
    return [*geometry_numbers(robot), *numbers_of(robot.elastic)]


def compliance_gradient(elastic: Elastic) -> Kernel:
    """Program of sums of C's entries: q and weights (36) to derivatives by q and all numbers."""
    return elastic.kernel("platform compliance gradient", _gradient, free=True)


def _gradient(s: Solved) -> Program:
    s.factorise()
    program = s.program({}, {"compliance": s.compliance.ravel()})
    t = s.t
    return gradient_program(t, program, {"q": list(t.q), "numbers": [*t.geometry, *t.more]})
