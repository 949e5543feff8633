# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write the functions of a transmission, see :mod:`delta_dynamics.torques.transmission`.

The joint side has the pose coordinates, the actuator side q. With the ratio B = dq/dx and P B = 1:

    qd = B v        tau = P' f        v = P qd        f = B' tau
    Ka = P' (K + sum_i tau_i d2q_i/dx2) P             Da = P' D P
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pkm_twin.codegen.cholesky import SparseCholesky
from pkm_twin.codegen.expressions import Expression, Objects
from pkm_twin.codegen.lu import SparseLU, pivot_order
from pkm_twin.codegen.program import MAX_GROWTH, Equations
from pkm_twin.export.c99 import Substitution
from pkm_twin.robot.robot import Robot


class TransmissionTerms:
    """The ratio B of a transmission as expressions, with rates, efforts and gains by it.

    :param fold: gives the tape of the expressions. ``ratio``: B, row by row.
    """

    def __init__(self, robot: Robot, fold: Substitution, ratio: Sequence[Expression]) -> None:
        self.robot, self.tape = robot, fold.tape
        self.m = len(robot.pose_names)
        self.ratio: Objects = np.array(ratio, dtype=object).reshape(-1, self.m)
        if robot.redundant:
            # P = (B' W B)^-1 B' W gives the efforts with the smallest sum of (effort / limit)^2.
            self._weighted = self.ratio * (robot.effort_scale**2)[:, None]
            square = self.ratio.T @ self._weighted
            lower = {(i, j): square[i, j] for i in range(self.m) for j in range(i + 1)}
            self._root = SparseCholesky(lower, list(np.diag(square)))
        else:
            near = np.array([q for _, q in robot.engine.samples])
            self._lu = SparseLU(self.ratio, pivot_order(robot.inverse_jacobian(near)))
            sizes = [[1.0 / robot.size if u == "m" else 1.0 for u in v] for v in (robot.joint_units, robot.pose_units)]
            self._growth = self._lu.find_growth(*sizes)

    def actuator_side(self) -> dict[str, list[Expression]]:
        """Return rates and efforts of the actuators by the inputs ``velocity`` and ``effort``."""
        velocity, effort = (self.tape.inputs(name, self.m) for name in ("velocity", "effort"))
        return {"qd": self._lift_all(self.ratio @ velocity), "tau": self._lift_all(self._actuator_efforts(effort))}

    def reject_singular_poses(self, equations: Sequence[Equations]) -> list[Equations]:
        """Return the equations with a condition that rejects poses where a pivot of B vanishes."""
        *first, last = equations
        if self.robot.redundant or not isinstance(self._growth, Expression):
            return [*equations]
        return [*first, replace(last, branch=[*last.branch, self.tape.lift(MAX_GROWTH - self._growth)])]

    def gains(self, changes: Sequence[Sequence[Expression]]) -> dict[str, list[Expression]]:
        """Return Ka and Da by the inputs ``stiffness``, ``damping`` and ``tau``.

        :param changes: second derivatives of q along each of :func:`second_derivative_directions`, shape (n,) each.
        """
        m = self.m
        stiffness, damping = (self.tape.inputs(name, m * m).reshape(m, m) for name in ("stiffness", "damping"))
        # The sum of w_i d2q_i/dx2, shape (m, m).
        weights = self.tape.inputs("tau", len(self.ratio))
        second_derivatives = [np.array(change, dtype=object) @ weights for change in changes]
        result = np.empty((self.m, self.m), dtype=object)
        for value, (j, k) in zip(second_derivatives, _list_index_pairs(self.m), strict=True):
            # The mixed derivative is half of the second derivative along a + b less those along a and b.
            result[j, k] = result[k, j] = value if j == k else 0.5 * (value - result[j, j] - result[k, k])
        curvature = result
        return {
            "ka": self._lift_all(self._transform_to_actuators(stiffness + curvature)),
            "da": self._lift_all(self._transform_to_actuators(damping)),
        }

    def _lift_all(self, values: Any) -> list[Expression]:
        return [self.tape.lift(value) for value in np.ravel(values)]

    def _actuator_efforts(self, joint: Objects) -> Objects:
        """Return the actuators' efforts P' f for efforts f on the pose."""
        if not self.robot.redundant:
            return self._lu.solve_transposed(joint)
        return np.asarray(self._weighted @ np.array(self._root.solve(list(joint)), dtype=object))

    def _transform_to_actuators(self, matrix: Objects) -> Objects:
        """Return P' A P, the gains of the actuators for gains A of the pose, shape (n, n)."""
        half = np.array([self._actuator_efforts(column) for column in matrix.T], dtype=object)
        return np.array([self._actuator_efforts(column) for column in half.T], dtype=object)


def _list_index_pairs(m: int) -> list[tuple[int, int]]:
    return [(j, j) for j in range(m)] + [(j, k) for j in range(m) for k in range(j)]


def second_derivative_directions(m: int) -> list[list[float]]:
    """Return the pose rates along which :meth:`TransmissionTerms.gains` needs second derivatives."""
    return [np.maximum(*np.eye(m)[[j, k]]).tolist() for j, k in _list_index_pairs(m)]
