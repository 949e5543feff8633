# SPDX-License-Identifier: Apache-2.0
"""Which combinations of the parameters the efforts distinguish, found on random states.

The base parameters of a closed chain depend on its loops: they are found numerically, by a pivoted
QR factorisation of the regressor (Gautier, Numerical calculation of the base inertial parameters
of robots, 1991, doi:10.1002/rob.4620080405).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from delta_dynamics.torques.regressor import (
    DRIVE,
    PAYLOAD,
    TEN,
    WRENCH,
    parameter_names,
    parameter_values,
    regressor,
)
from pkm_twin.codegen.arrays import Array
from pkm_twin.machine.schema import frozen
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import random_joints

RANK: Final = 1e-8
"""Least pivot, of columns of norm one, that counts."""
ABSENT: Final = 1e-10
"""Part of the largest column's norm below which a column is zero, all of them of unit kg."""
SMALL: Final = 1e-7
"""Coefficients below are zero: rounding's."""


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """Combinations of parameters that the efforts determine: ``matrix`` times the parameters.

    ``names``: of the combinations, in words. ``parameters``: names of all parameters.
    ``columns``: index of the parameter that leads each combination. ``matrix``: shape (b, p), one
    at the leading parameter. ``values``: the robot's own, shape (b,). ``unseen``: names of
    parameters that no motion excites.
    """

    names: tuple[str, ...]
    parameters: tuple[str, ...]
    columns: tuple[int, ...]
    matrix: Array
    values: Array
    unseen: tuple[str, ...]

    @property
    def count(self) -> int:
        """How many there are, b."""
        return len(self.columns)


def base_parameters(robot: Robot, *, seed: int = 0) -> BaseParameters:
    """The identifiable combinations of the robot's parameters, without a wrench.

    With the columns of ``columns`` alone, Y[..., columns] (matrix pi) = inverse_dynamics.

    :param seed: of the random states; the number of combinations does not depend on it.
    """
    names, pi = parameter_names(robot), parameter_values(robot)
    states = random_states(robot, max(60, 3 * len(names) // robot.joints_count), seed)
    table = regressor(robot, *states).reshape(-1, len(names))
    units = natural_units(robot)
    columns, matrix = independent(table / units, [_preference(name) for name in names])
    matrix = matrix * units / units[list(columns)][:, None]
    led = [combination_name(row, k, names) for k, row in zip(columns, matrix, strict=True)]
    unseen = [name for k, name in enumerate(names[:-1]) if not matrix[:, k].any()]
    return BaseParameters(
        tuple(led), names, columns, frozen(matrix), frozen(matrix @ pi), tuple(unseen)
    )


def random_states(robot: Robot, count: int, seed: int) -> tuple[Array, Array, Array]:
    """Positions, rates and accelerations, shape (count, n) each, clear of singularities.

    Of a size at which weight, accelerations and velocities weigh alike.
    """
    rng = np.random.default_rng(seed)
    size, slides = robot.engine.tree.size, np.array([u == "m" for u in robot.joint_units])
    q = random_joints(robot, rng, count)
    unit = np.where(slides, size, 1.0)
    g = 9.81 / size
    return q, unit * np.sqrt(g) * rng.normal(size=q.shape), unit * g * rng.normal(size=q.shape)


def _preference(name: str) -> float:
    """Which parameters lead combinations: drives before bodies, bodies before the payload."""
    owner, _, what = name.rpartition(".")
    if what in DRIVE:
        return 10.0
    return (0.1 if owner == PAYLOAD else 1.0) * (0.3 if what in TEN[7:] else 1.0)


def independent(table: Array, preference: ArrayLike = 1.0) -> tuple[tuple[int, ...], Array]:
    """Columns that are independent of each other, and all columns by those.

    :param table: shape (rows, p), columns of comparable units.
    :param preference: shape (p,): greater ones are taken first.
    :returns: indices, rising, and the matrix B, shape (b, p), with table = table[:, indices] B.
    """
    # Here, as a stream's start would pay for what it does not need.
    from scipy.linalg import qr  # type: ignore[import-untyped]

    norms = np.linalg.norm(table, axis=0)
    seen = np.flatnonzero(norms > ABSENT * norms.max())
    weights = np.broadcast_to(np.asarray(preference, np.float64), norms.shape)
    norms = norms / weights
    r, pivots = qr(table[:, seen] / norms[seen], mode="r", pivoting=True)
    diagonal = np.abs(np.diag(r))
    rank = int((diagonal > RANK * weights.max()).sum())
    rest = np.linalg.solve(r[:rank, :rank], r[:rank])
    matrix = np.zeros((rank, table.shape[1]))
    matrix[:, seen[pivots]] = rest / norms[seen[pivots[:rank]]][:, None] * norms[seen[pivots]]
    matrix[np.abs(matrix) < SMALL] = 0.0
    leading = seen[pivots[:rank]]
    order = np.argsort(leading)
    return tuple(int(k) for k in leading[order]), matrix[order]


def natural_units(robot: Robot) -> Array:
    """What makes kilograms of the parameters by the machine's size and weight, shape (p,)."""
    size = robot.engine.tree.size
    powers = {what: (0, 1, 1, 1, 2, 2, 2, 2, 2, 2)[k] for k, what in enumerate(TEN)}
    result = []
    for name in parameter_names(robot):
        what = name.rpartition(".")[2] if name != WRENCH else ""
        result.append(size ** -powers.get(what, 0))
    return np.array(result)


def combination_name(row: Sequence[float] | Array, leading: int, names: Sequence[str]) -> str:
    """A combination in words, the leading parameter first."""
    text = names[leading]
    for k, value in enumerate(row):
        if k == leading or value == 0.0:
            continue
        size = "" if abs(abs(value) - 1.0) < SMALL else f"{abs(value):.4g} "
        text += f" {'-' if value < 0 else '+'} {size}{names[k]}"
    return text
