# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compute how the platform's compliance depends on each elastic element's compliance.

Element e's compliance is s_e times the file's. With K = sum of G_e G_e' / s_e over the
elements (columns G of their own stiffness on the frame's coordinates) and the platform's E,

    C(s) = C + A S (I + M S)^-1 A',   S = diag(s - 1),   A = E' K^-1 G,   M = I - G' K^-1 G

(Woodbury), all at s = 1, and dC/ds_e = Z_e' Z_e with the rows e of Z = (I + M S)^-1 A': twice the
element's strain energy at unit loads, which is Castigliano's theorem. A pose is solved once,
whatever the factors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array, Indices, one_vector, vectors
from pkm_twin.robot.robot import Robot
from stiffness_monitor.compliance import platform_response
from stiffness_monitor.frame import PLATFORM
from stiffness_monitor.programs import NO_PARAMETERS, Elastic


@dataclass(frozen=True, eq=False)
class ElementResponse:
    """Hold the platform's compliance as a function of the elements' compliance factors.

    A, M and the columns of G are those of the module's equation. ``names``: of the elements, as in
    ``strain_energy``. ``owner``: index of the element of each column, (r,). ``compliance``: with the
    file's values, (..., 6, 6). ``reach``: A, the effect of the columns' forces on the platform,
    (..., 6, r). ``rest``: M, shape (..., r, r).
    """

    names: tuple[str, ...]
    owner: Indices
    compliance: Array
    reach: Array
    rest: Array

    def columns(self, factors: ArrayLike) -> tuple[Any, Any]:
        """Return S as a vector (r,), and Z' (..., 6, r); factors may be complex.

        :raises ValueError: factors of another shape, or that are not finite.
        """
        size = len(self.names)
        if np.iscomplexobj(factors):
            # Complex factors serve complex-step derivatives.
            given: Any = np.asarray(factors)
            one_vector(given.real, size, "factors")
            one_vector(given.imag, size, "factors")
        else:
            given = one_vector(factors, size, "factors")
        change = (given - 1.0)[self.owner]
        matrix = np.eye(len(self.owner)) + self.rest * change
        columns = np.linalg.solve(matrix, np.swapaxes(self.reach, -1, -2))
        return change, np.swapaxes(columns, -1, -2)

    def compliance_at(self, factors: ArrayLike) -> Any:
        """Return the compliance with factors (elements,), shape (..., 6, 6)."""
        change, columns = self.columns(factors)
        return self.compliance + self.reach @ np.swapaxes(change * columns, -1, -2)

    def derivatives(self, factors: ArrayLike | None = None) -> Array:
        """Return the compliance's derivatives with respect to the factors, (..., elements, 6, 6)."""
        columns = self.reach if factors is None else self.columns(factors)[1]
        return np.stack(
            [
                columns[..., self.owner == k] @ np.swapaxes(columns[..., self.owner == k], -1, -2)
                for k in range(len(self.names))
            ],
            -3,
        )

    def deflection(self, wrench: ArrayLike, factors: ArrayLike) -> tuple[Array, Array]:
        """Return the platform's deflection under wrenches (..., 6): m and rad, base axes.

        :returns: the deflection, and its derivatives by the factors, shape (..., 6, elements).
        """
        loads = vectors(wrench, 6, "the wrench")[..., None]
        change, columns = self.columns(factors)
        amounts = np.swapaxes(columns, -1, -2) @ loads
        moved = self.compliance @ loads + self.reach @ (change[:, None] * amounts)
        each = columns * np.swapaxes(amounts, -1, -2)
        slopes = each @ np.equal.outer(self.owner, np.arange(len(self.names))).astype(float)
        return moved[..., 0], slopes


def element_response(robot: Robot, pose: ArrayLike) -> ElementResponse:
    """Return the platform's compliance in poses (..., m) as a function of element factors.

    :raises ParameterError: a robot without elastic members.
    :raises UnreachableError: a pose that is none of the mechanism's.
    :raises SingularityError: a compliance that is not positive definite.
    """
    q = robot.inverse(pose)
    whole = platform_response(robot, q, np.zeros(6)).compliance
    own, owner = elastic_columns(robot, q)
    root = np.linalg.cholesky(own @ np.swapaxes(own, -1, -2))
    unit = np.broadcast_to(np.eye(own.shape[-2], PLATFORM), (*own.shape[:-1], PLATFORM))
    platform, elements = (np.linalg.solve(root, side) for side in (unit, own))
    turned = np.swapaxes(elements, -1, -2)
    return ElementResponse(
        robot.cached(Elastic).names,
        owner,
        whole,
        np.swapaxes(platform, -1, -2) @ elements,
        np.eye(len(owner)) - turned @ elements,
    )


def elastic_columns(robot: Robot, q: Array) -> tuple[Array, Indices]:
    """Return the frame's columns sqrt(d) b, whose squares sum to its stiffness, and their elements.

    :param q: joint positions, shape (..., n).
    :returns: columns, shape (..., size, r), the platform's six displacements first; and the element
        of each column by index, shape (r,).
    """
    elastic = robot.cached(Elastic)
    (entries, *_), _ = elastic.columns(NO_PARAMETERS, q)
    rows, columns, owner = elastic.column_places
    own = np.zeros((*q.shape[:-1], rows.max() + 1, len(owner)))
    own[..., rows, columns] = entries
    return own, owner
