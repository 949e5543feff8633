# SPDX-License-Identifier: Apache-2.0
"""How the platform's compliance hangs on the compliance of each elastic element, exactly.

Element e gives by s_e times what the robot's file says. With K = sum of G_e G_e' / s_e over the
elements (columns G of their own stiffness on the frame's coordinates) and the platform's E,

    C(s) = C + A S (I + M S)^-1 A',   S = diag(s - 1),   A = E' K^-1 G,   M = I - G' K^-1 G

(Woodbury), all at s = 1, and dC/ds_e = Z_e' Z_e with the rows e of Z = (I + M S)^-1 A': twice the
element's strain energy at unit loads, which is Castigliano's theorem. A pose is solved once,
whatever the factors. Where elements stand in series in limbs (2UPR-RPU paper, equation 34), with
their compliances R_e R_e' on a limb's wrench amplitudes, A = C J C_i^-1 R and
M = R' C_i^-1 R - R' C_i^-1 J' C J C_i^-1 R.

May import: numpy, scipy, pkm_twin's core, this package, the standard library; never rclpy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular  # type: ignore[import-untyped]

from pkm_twin.codegen.arrays import doubles, one_vector, vectors
from pkm_twin.machine.robot import Robot
from stiffness_monitor.beams import System, assemble
from stiffness_monitor.compliance import compliance
from stiffness_monitor.elements import limb_kernel
from stiffness_monitor.statics import checked_poses, stiffness_root
from stiffness_monitor.structure import structural_model

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class ElementResponse:
    """The platform's compliance by the elements' factors, which multiply the file's compliances.

    ``names``: of the elements, as ``strain_energy`` has them. ``owner``: shape (r,), which element
    a column is of. ``compliance``: of the file, (..., 6, 6). ``reach``: A, (..., 6, r), and
    ``rest``: M, (..., r, r), of the module's equation.
    """

    names: tuple[str, ...]
    owner: Indices
    compliance: Array
    reach: Array
    rest: Array

    def columns(self, factors: ArrayLike) -> tuple[Any, Any]:
        """S as a vector (r,), and Z as its transpose (..., 6, r); complex factors are allowed."""
        change = (self._checked(factors) - 1.0)[self.owner]
        matrix = np.eye(len(self.owner)) + self.rest * change
        columns = np.linalg.solve(matrix, np.swapaxes(self.reach, -1, -2))
        return change, np.swapaxes(columns, -1, -2)

    def _checked(self, factors: ArrayLike) -> Any:
        """Factors, shape (elements,); complex ones as they are, for derivatives by a complex step.

        :raises ValueError: another shape, or a factor that is not finite.
        """
        size = len(self.names)
        if not np.iscomplexobj(factors):
            return one_vector(factors, size, "factors")
        array = np.asarray(factors, np.complex128)
        for part in (array.real, array.imag):
            one_vector(part, size, "factors")
        return array

    def compliance_at(self, factors: ArrayLike) -> Any:
        """Compliance with factors (elements,), shape (..., 6, 6)."""
        change, columns = self.columns(factors)
        return self.compliance + self.reach @ np.swapaxes(change * columns, -1, -2)

    def derivatives(self, factors: ArrayLike | None = None) -> Array:
        """Of the compliance by each factor, shape (..., elements, 6, 6): positive semidefinite."""
        columns = self.reach if factors is None else self.columns(factors)[1]
        return np.stack(
            [
                columns[..., self.owner == k] @ np.swapaxes(columns[..., self.owner == k], -1, -2)
                for k in range(len(self.names))
            ],
            -3,
        )

    def deflection(self, wrench: ArrayLike, factors: ArrayLike) -> tuple[Array, Array]:
        """Of the platform under wrenches (..., 6): shape (..., 6), m and rad, base axes.

        :returns: and its derivatives by the factors, shape (..., 6, elements).
        """
        loads = vectors(wrench, 6, "the wrench")[..., None]
        change, columns = self.columns(factors)
        amounts = np.swapaxes(columns, -1, -2) @ loads
        moved = self.compliance @ loads + self.reach @ (change[:, None] * amounts)
        each = columns * np.swapaxes(amounts, -1, -2)
        slopes = each @ np.equal.outer(self.owner, np.arange(len(self.names))).astype(float)
        return moved[..., 0], slopes


def element_response(robot: Robot, pose: ArrayLike) -> ElementResponse:
    """The platform's compliance in poses (..., m), by the elements' factors; errors as compliance.

    :raises ParameterError: a robot without elastic members.
    :raises UnreachableError: a pose that is none of the mechanism's.
    :raises SingularityError: a compliance that is not positive definite.
    """
    poses = doubles(pose, "the pose")
    if robot.element_names:
        return _of_limbs(robot, poses)
    poses = checked_poses(robot, poses)
    batch = poses.shape[:-1]
    if not np.prod(batch, dtype=int):
        raise ValueError("elements of no pose")
    found = [
        _of_frame(assemble(structural_model(robot, poses[index]), 1), index)
        for index in np.ndindex(*batch)
    ]
    first = found[0]
    arrays = [
        np.reshape([getattr(one, name) for one in found], (*batch, *getattr(first, name).shape))
        for name in ("compliance", "reach", "rest")
    ]
    return ElementResponse(first.names, first.owner, *arrays)


def _of_limbs(robot: Robot, poses: Array) -> ElementResponse:
    """By the closed form's limbs and elements."""
    whole = compliance(robot, poses)
    (rows,), _ = limb_kernel(robot)(robot.elastic_parameters, poses)
    batch, names = rows.shape[:-1], robot.element_names
    # Of every limb 18 numbers and four an element.
    count = (rows.shape[-1] - 4 * len(names)) // 18
    each = len(names) // count
    limbs = rows.reshape(*batch, count, 18 + 4 * each)
    wrenches = limbs[..., :18].reshape(*batch, count, 3, 6)
    roots = _roots(limbs[..., 18:].reshape(*batch, count, each, 4))
    # Columns of a limb: three an element.
    own = np.moveaxis(roots, -3, -2).reshape(*batch, count, 3, 3 * each)
    held = np.linalg.inv(own @ np.swapaxes(own, -1, -2))
    carried = np.swapaxes(wrenches, -1, -2) @ held @ own
    size = 3 * each * count
    flat = np.moveaxis(carried, -3, -2).reshape(*batch, 6, size)
    rest = -np.swapaxes(flat, -1, -2) @ whole @ flat
    for k in range(count):
        at = slice(3 * each * k, 3 * each * (k + 1))
        rest[..., at, at] += np.swapaxes(own[..., k, :, :], -1, -2) @ (held @ own)[..., k, :, :]
    return ElementResponse(names, np.repeat(np.arange(len(names)), 3), whole, whole @ flat, rest)


def _roots(entries: Array) -> Array:
    """R of R R' = [[c11, 0, 0], [0, c22, c23], [0, c23, c33]], shape (..., 3, 3)."""
    c11, c22, c23, c33 = np.moveaxis(entries, -1, 0)
    result = np.zeros((*entries.shape[:-1], 3, 3))
    result[..., 0, 0], result[..., 1, 1] = np.sqrt(c11), np.sqrt(c22)
    result[..., 2, 1] = np.divide(c23, result[..., 1, 1], out=np.zeros_like(c23), where=c22 > 0.0)
    result[..., 2, 2] = np.sqrt(np.maximum(c33 - result[..., 2, 1] ** 2, 0.0))
    return result


def _of_frame(system: System, index: tuple[int, ...]) -> ElementResponse:
    """By the finite elements of one pose."""
    root = stiffness_root(system, index)
    names = system.elastic
    blocks, owner = [], []
    for part in system.parts:
        if part.name not in names:
            continue
        values, vectors = np.linalg.eigh(part.stiffness)
        kept = values > 1e-12 * values[-1]
        block = np.zeros((len(root), int(kept.sum())))
        block[part.own] = part.map.T @ (vectors[:, kept] * np.sqrt(values[kept]))
        blocks.append(block)
        owner += [names.index(part.name)] * block.shape[1]
    load = np.zeros((len(root), 6))
    load[:6] = np.eye(6)
    solved = solve_triangular(root, np.hstack([load, *blocks]), lower=True, check_finite=False)
    platform, elements = solved[:, :6], solved[:, 6:]
    return ElementResponse(
        names, np.array(owner, np.intp), platform.T @ platform, platform.T @ elements,
        np.eye(elements.shape[1]) - elements.T @ elements,
    )  # fmt: skip
