# SPDX-License-Identifier: Apache-2.0
"""The strain-energy method over limbs of elements in series, as compiled programs.

A limb carries wrenches of amplitudes W_i and has elements in series:
K = sum of J_i (sum of C_ie)^-1 J_i' (2UPR-RPU paper, equation 34).

May import: numpy, pkm_twin's core, the standard library; never rclpy.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from pkm_twin.codegen.expressions import PARAMETERS, absolute, maximum, minimum, sqrt
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.program import Program
from pkm_twin.kinematics.engine import Traced
from pkm_twin.machine.robot import Robot

TIE: Final = 1e-9
"""Two energies tie where they differ by less than this part of the larger one."""
_TINY: Final = 1e-300
_FLOOR: Final = 1e-30


def compliance_kernel(robot: Robot) -> Kernel:
    """Pose to one row: the compliance (36, by row), and the two judgements of :class:`_Solved`."""

    def write(t: Traced) -> Program:
        solved = _Solved(robot, t)
        inverse = _inverse_of_lower(solved.root)
        entries: list[list[Any]] = [[0.0] * 6 for _ in range(6)]
        for i in range(6):
            for j in range(i + 1):
                value = sum((inverse[k][i] * inverse[k][j] for k in range(i, 6)), 0.0)
                entries[i][j] = entries[j][i] = value
        flat = [entry for row in entries for entry in row]
        row = t.lift([*flat, *solved.judgements])
        return Program({"pose": 3}, len(robot.elastic_parameters), {"row": row})

    return robot.engine.kernel(f"compliance {robot.closed_key}", write)


def energy_kernel(robot: Robot) -> Kernel:
    """Pose and wrench to one row: factors, energies, deflection (6), total energy, judgements.

    Delta = C P, W_i = C_i^-1 J_i' Delta, U_ie = W_i' C_ie W_i / 2 (2UPR-RPU paper, equations 36
    to 38). Factors are zero where the wrench is.
    """

    def write(t: Traced) -> Program:
        solved = _Solved(robot, t)
        wrench = t.tape.inputs("wrench", 6)
        size: Any = absolute(wrench[0])
        for value in wrench[1:]:
            size = maximum(size, absolute(value))
        # Of unit size, so that squares of tiny and huge loads neither vanish nor overflow.
        unit = wrench / maximum(size, _TINY)
        shift = _back(solved.root, _forth(solved.root, unit))
        energies: list[Any] = []
        for limb, (root, reach) in zip(solved.limbs, solved.solved, strict=True):
            amplitudes = _back(
                root, [sum(r * d for r, d in zip(row, shift, strict=True)) for row in reach]
            )
            f1, f2, m = amplitudes
            for c11, c22, c23, c33 in limb.elements:
                value = f1 * f1 * c11 + f2 * f2 * c22 + m * m * c33 + 2.0 * (f2 * m * c23)
                # An element without load can round to just below zero.
                energies.append(maximum(0.0, 0.5 * value))
        total = sum(energies, 0.0)
        square = size * size
        row = [value / maximum(total, _TINY) for value in energies]
        row += [value * square for value in energies]
        row += [value * size for value in shift]
        row += [total * square, *solved.judgements]
        sizes = {"pose": 3, "wrench": 6}
        return Program(sizes, len(robot.elastic_parameters), {"row": t.lift(row)})

    return robot.engine.kernel(f"strain energy {robot.closed_key}", write)


def limb_kernel(robot: Robot) -> Kernel:
    """Pose to one row: of each limb its three unit wrenches (18), then its elements' compliances.

    Four an element, as :class:`~pkm_twin.machine.robot.LimbElements` has them.
    """

    def write(t: Traced) -> Program:
        p = t.tape.inputs(PARAMETERS, len(robot.elastic_parameters))
        row: list[Any] = []
        for limb in robot.limb_elements(t.tape.inputs("pose", 3), p):
            row += [entry for wrench in limb.wrenches for entry in wrench]
            row += [entry for element in limb.elements for entry in element]
        return Program({"pose": 3}, len(robot.elastic_parameters), {"row": t.lift(row)})

    return robot.engine.kernel(f"limb elements {robot.closed_key}", write)


class _Solved:
    """Cholesky factors of every limb's compliance and of the stiffness.

    ``judgements``: the least pivot of all factors over its diagonal entry, which no choice of
    units changes: 1 for a diagonal matrix, 0 or less for one that is not positive definite; and by
    how much (m) the limb that falls short the most has length left, below 0 where no limb reaches.
    """

    def __init__(self, robot: Robot, t: Traced) -> None:
        p = t.tape.inputs(PARAMETERS, len(robot.elastic_parameters))
        pose = t.tape.inputs("pose", 3)
        self.limbs = robot.limb_elements(pose, p)
        least: Any = 1.0
        self.solved: list[tuple[list[list[Any]], list[list[Any]]]] = []
        stiffness: list[list[Any]] = [[0.0] * 6 for _ in range(6)]
        for limb in self.limbs:
            c11, c22, c23, c33 = (sum(e[k] for e in limb.elements) for k in range(4))
            root, measure = _cholesky([[c11, 0.0, 0.0], [0.0, c22, c23], [0.0, c23, c33]])
            least = minimum(least, measure)
            columns = [_forth(root, [w[row] for w in limb.wrenches]) for row in range(6)]
            reach = [[columns[row][k] for row in range(6)] for k in range(3)]
            self.solved.append((root, reach))
            for row in reach:
                for i in range(6):
                    for j in range(i + 1):
                        stiffness[i][j] = stiffness[i][j] + row[i] * row[j]
        self.root, measure = _cholesky(stiffness)
        missed: Any = -1e300
        for miss in robot.solved(pose).misses:
            missed = maximum(missed, miss)
        self.judgements = [minimum(least, measure), -missed]


def _cholesky(matrix: list[list[Any]]) -> tuple[list[list[Any]], Any]:
    """Lower factor of a symmetric matrix, of which the lower triangle is read; and its measure."""
    n = len(matrix)
    root: list[list[Any]] = [[0.0] * n for _ in range(n)]
    least: Any = 1.0
    for j in range(n):
        pivot = matrix[j][j] - sum((v * v for v in root[j][:j]), 0.0)
        least = minimum(least, pivot / maximum(matrix[j][j], _TINY))
        # A factor of what is refused has to stay finite, for its measure to say why.
        root[j][j] = sqrt(maximum(pivot, maximum(_FLOOR * matrix[j][j], _TINY)))
        for i in range(j + 1, n):
            value = matrix[i][j]
            for k in range(j):
                value = value - root[i][k] * root[j][k]
            root[i][j] = value / root[j][j]
    return root, least


def _forth(root: list[list[Any]], right: Any) -> list[Any]:
    """X of L x = right."""
    x: list[Any] = []
    for i, value in enumerate(right):
        for k in range(i):
            value = value - root[i][k] * x[k]
        x.append(value / root[i][i])
    return x


def _back(root: list[list[Any]], right: Any) -> list[Any]:
    """X of L' x = right."""
    n = len(root)
    x: list[Any] = [0.0] * n
    for i in reversed(range(n)):
        value = right[i]
        for k in range(i + 1, n):
            value = value - root[k][i] * x[k]
        x[i] = value / root[i][i]
    return x


def _inverse_of_lower(root: list[list[Any]]) -> list[list[Any]]:
    columns = [_forth(root, np.eye(len(root))[j].tolist()) for j in range(len(root))]
    return [[columns[j][i] for j in range(len(root))] for i in range(len(root))]
