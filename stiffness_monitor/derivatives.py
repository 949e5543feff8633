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
from pkm_twin.kinematics.derivatives import Derivatives, geometry_numbers, inverse_derivatives
from pkm_twin.kinematics.gradients import gradient_program
from pkm_twin.kinematics.numbers import FileNumbers
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
    compliance(robot, pose)  # its errors
    q = robot.inverse(pose)
    (by_q, by_numbers), _ = compliance_gradient(elastic_of(robot))(
        NONE, q[..., None, :], np.eye(ENTRIES)
    )
    joints = inverse_derivatives(robot, pose, by)

    def square(table: Array) -> Array:
        return table.reshape(*table.shape[:-2], 6, 6, table.shape[-1])

    found: dict[str, Array] = {}
    if by:
        slopes = FileNumbers(robot, tuple(by), elastic_numbers).slopes
        through = np.stack([joints.by[path] for path in by], -1)
        table = square(by_numbers @ slopes + by_q @ through)
        found = {path: np.ascontiguousarray(table[..., k]) for k, path in enumerate(by)}
    return Derivatives(square(by_q @ joints.state), found)


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
    return gradient_program(t, program, {"q": t.q, "numbers": [*t.geometry, *t.more]})
