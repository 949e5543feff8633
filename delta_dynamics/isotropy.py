# SPDX-License-Identifier: Apache-2.0
"""Dynamic isotropy: how energy and driving force depend on the direction of the platform's motion.

Two indices of the 3-PRRU paper, for every robot with masses, over the pose rates Xdot:

- eta_KE = E_M / E_all (equation 44), the platform's part of the kinetic energy;
- F_max = max |F_d| at a given E_M and Xddot (equations 47 and 48).

A payload counts as part of the platform. Directions are unit vectors of pose rates in SI
units (m/s beside rad/s for the 3-PRRU), as in the paper; eta's extremes do not depend on
that choice. Xddot = 0 is meant in the pose's own coordinates, so F_max does depend on them:
turned by a third of a turn, the same motion has another Xddot in alpha and beta.

May import: numpy, pkm_twin's core, the standard library; never rclpy.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from delta_dynamics.virtual_work import body_mass_matrix, inverse_dynamics, mass_matrix
from pkm_twin.errors import ParameterError, SingularityError
from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]

ENERGY: Final = 100.0
"""The platform's kinetic energy in the paper's equation 48, J."""
STRETCHED: Final = 1e-6
"""Least singular value of the pose's Jacobian, of its greatest or of one, that is inverted."""

_NONE: Final = np.zeros(3)
_FREE: Final = {"viscous": 0.0, "coulomb": 0.0}
_PROBES: Final = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 1], [1, 0, 1], [1, 1, 0]], float)
_GRID: Final = 14
_SPLITS: Final = 12
_PATCHES: Final = 2000
_PROVEN: Final = 1e-6
_ROUNDS: Final = 60
_LENGTHS: Final = 0.5 ** np.arange(12)


class JointMotion(NamedTuple):
    """Joint positions, rates and accelerations, shape (..., 3) each."""

    q: Array
    qd: Array
    qdd: Array


class Extremes(NamedTuple):
    """Least and greatest value over all directions, shape (...), and where they are reached.

    ``directions``: unit vectors of pose rates, shape (..., 2, 3), least then greatest.
    """

    least: Array
    greatest: Array
    directions: Array

    @property
    def spread(self) -> Array:
        """Greatest less least, shape (...)."""
        return self.greatest - self.least


def joint_motion(
    robot: Robot, pose: ArrayLike, rates: ArrayLike, accelerations: ArrayLike = (0.0, 0.0, 0.0)
) -> JointMotion:
    """Joint motion of a pose motion: qd = J^-1 Xdot, qdd = J^-1 (Xddot - Jdot qd).

    Exact: Jdot qd is the pose's acceleration at zero qdd, told by the bodies' motion (3-PRRU
    paper, equations 24 and 25, without its Hessian).

    :param pose: shape (..., 3); ``rates`` and ``accelerations`` are its derivatives in time.
    :raises UnreachableError: a pose out of reach, by limb, sample and miss.
    :raises SingularityError: the Jacobian has no inverse.
    """
    q, inverse = _inverse_jacobian(robot, np.asarray(pose, np.float64))
    qd = np.einsum("...ij,...j->...i", inverse, np.asarray(rates, np.float64))
    bias = robot.pose_acceleration(q, qd, np.zeros(robot.joints_count))
    rest = np.asarray(accelerations, np.float64) - bias
    qdd = np.einsum("...ij,...j->...i", inverse, rest)
    q, qd, qdd = np.broadcast_arrays(q, qd, qdd)
    return JointMotion(q.copy(), qd.copy(), qdd)


def energy_matrices(robot: Robot, pose: ArrayLike) -> tuple[Array, Array]:
    """Kinetic energy of the platform and of all bodies as forms of the pose rates.

    E = Xdot' M Xdot / 2 (3-PRRU paper, equations 42 and 43).

    :param pose: shape (..., 3).
    :returns: platform with payload, and all bodies; shape (..., 3, 3) each.
    """
    q, inverse = _inverse_jacobian(robot, np.asarray(pose, np.float64))
    platform = body_mass_matrix(robot, q, robot.graph.platform)
    pair = np.stack([platform, mass_matrix(robot, q)], -3)
    turn = inverse[..., None, :, :]
    forms = turn.swapaxes(-1, -2) @ pair @ turn
    forms = (forms + forms.swapaxes(-1, -2)) / 2
    return forms[..., 0, :, :], forms[..., 1, :, :]


def energy_transfer(robot: Robot, pose: ArrayLike, direction: ArrayLike) -> Array:
    """eta_KE = E_M / E_all, the platform's part of the kinetic energy (equations 44 and 46).

    :param pose: shape (..., 3).
    :param direction: pose rates of any length above zero, shape (..., 3).
    :returns: shape (...), 0 to 1.
    """
    x = _directions(direction)
    platform, everything = energy_matrices(robot, pose)
    return _form(platform, x) / _form(everything, x)


def energy_transfer_range(robot: Robot, pose: ArrayLike) -> Extremes:
    """Extremes of eta_KE over all directions, exact, from generalised eigenvalues.

    :param pose: shape (..., 3).
    :raises ParameterError: bodies without inertia against some direction.
    """
    platform, everything = energy_matrices(robot, pose)
    back = _inverse_root(robot, everything)
    values, vectors = np.linalg.eigh(_congruent(back, platform))
    ends = vectors[..., [0, 2]]
    directions = _directions((back @ ends).swapaxes(-1, -2))
    return Extremes(values[..., 0], values[..., 2], directions)


def max_driving_force(
    robot: Robot,
    pose: ArrayLike,
    direction: ArrayLike,
    energy: float = ENERGY,
    acceleration: ArrayLike = 0.0,
) -> Array:
    """F_max, the largest |F_d| over the actuators (equation 47), N or N m.

    Gravity and payload act, friction does not.

    :param pose: shape (..., 3).
    :param direction: of the pose rates, shape (..., 3); their length follows from ``energy``.
    :param energy: kinetic energy E_M of the platform, J.
    :param acceleration: Xddot, a number or shape (..., 3).
    :returns: shape (...).
    """
    x = _directions(direction)
    platform, _ = energy_matrices(robot, pose)
    _inverse_root(robot, platform)
    rates = np.sqrt(2 * _energy(energy) / _form(platform, x))[..., None] * x
    motion = joint_motion(robot, pose, rates, acceleration)
    forces = inverse_dynamics(robot.changed(friction=_FREE), *motion)
    return np.asarray(np.abs(forces).max(-1), np.float64)


def max_driving_force_range(
    robot: Robot, pose: ArrayLike, energy: float = ENERGY, acceleration: ArrayLike = 0.0
) -> Extremes:
    """Extremes of F_max over all directions at the platform's energy E_M, N or N m.

    On the ellipsoid of Xdot with that energy, scaled to the unit sphere, every F_d is a
    quadratic form y' G y. The greatest |F_d| is an eigenvalue, exact. The least F_max is the
    minimum of the largest of these forms: found by branch and bound over all directions, refined
    to rounding by Newton steps on the forms that are largest there.

    :param pose: shape (..., 3).
    :param acceleration: Xddot, a number or shape (..., 3).
    """
    where = np.asarray(pose, np.float64)
    platform, _ = energy_matrices(robot, where)
    back = np.sqrt(2 * _energy(energy)) * _inverse_root(robot, platform)
    free = robot.changed(friction=_FREE)
    start = joint_motion(free, where, _NONE, acceleration)
    constant = inverse_dynamics(free, *start)
    weightless = free.changed(gravity=[0.0, 0.0, 0.0])
    probes = np.einsum("...ij,kj->...ki", back, _PROBES)
    moved = inverse_dynamics(weightless, *joint_motion(weightless, where[..., None, :], probes))
    forms = np.zeros((*constant.shape, 3, 3))
    for j in range(3):
        forms[..., j, j] = moved[..., j, :]
        k, l = (j + 1) % 3, (j + 2) % 3  # noqa: E741
        mixed = (moved[..., 3 + j, :] - moved[..., k, :] - moved[..., l, :]) / 2
        forms[..., k, l] = forms[..., l, k] = mixed
    forms += constant[..., None, None] * np.eye(3)

    values, vectors = np.linalg.eigh(forms)
    ends = np.abs(values[..., [0, 2]]).reshape(*constant.shape[:-1], 6)
    best = ends.argmax(-1)[..., None]
    candidates = vectors[..., [0, 2]].swapaxes(-1, -2).reshape(*constant.shape[:-1], 6, 3)
    high = np.take_along_axis(candidates, best[..., None], -2)[..., 0, :]
    greatest = np.take_along_axis(ends, best, -1)[..., 0]
    flat = forms.reshape(-1, 3, 3, 3)
    low = np.array([_least_direction(form) for form in flat]).reshape(high.shape)
    least = np.abs(np.einsum("...i,...aij,...j->...a", low, forms, low)).max(-1)
    y = np.stack([low, high], -2)
    return Extremes(least, greatest, _directions(np.einsum("...ij,...kj->...ki", back, y)))


def spread(values: ArrayLike) -> Array:
    """Greatest less least over the last axis, shape (...): of an index on a sphere's directions."""
    return np.asarray(np.ptp(np.asarray(values, np.float64), axis=-1), np.float64)


def tilted_pose(height: ArrayLike, azimuth: ArrayLike, tilt: ArrayLike) -> Array:
    """Pose (z, alpha, beta) of tilt-and-torsion angles with zero torsion, shape (..., 3).

    The platform's axis leans by ``tilt`` towards ``azimuth`` (rad), as on the paper's atlas.
    """
    z, a, t = np.broadcast_arrays(*(np.asarray(v, np.float64) for v in (height, azimuth, tilt)))
    x = np.sin(t) * np.cos(a)
    y = np.sin(t) * np.sin(a)
    return np.stack([z, np.arctan2(-y, np.cos(t)), np.arcsin(x)], -1)


def _inverse_jacobian(robot: Robot, pose: Array) -> tuple[Array, Array]:
    """Joint positions and joint rates per pose rate, shapes (..., 3) and (..., 3, 3)."""
    q = robot.inverse(pose)
    u, s, vt = np.linalg.svd(robot.jacobian(q))
    # Against one m/rad at least: where all limbs are stretched the whole Jacobian vanishes.
    measure = s[..., 2] / np.maximum(s[..., 0], 1.0)
    bad = np.argwhere(~(measure > STRETCHED))
    if len(bad):
        index = tuple(int(i) for i in bad[0])
        raise SingularityError("pose", index, float(measure[index]), STRETCHED)
    inverse = (vt.swapaxes(-1, -2) / s[..., None, :]) @ u.swapaxes(-1, -2)
    return q, np.asarray(inverse, np.float64)


def _inverse_root(robot: Robot, form: Array) -> Array:
    """B with B' M B = 1, shape (..., 3, 3)."""
    try:
        root = np.linalg.cholesky(form)
    except np.linalg.LinAlgError:
        raise ParameterError(
            "inertia", robot.name, "masses and inertias that resist every motion of the platform"
        ) from None
    return np.asarray(np.linalg.inv(root).swapaxes(-1, -2), np.float64)


def _congruent(back: Array, form: Array) -> Array:
    result = back.swapaxes(-1, -2) @ form @ back
    return np.asarray((result + result.swapaxes(-1, -2)) / 2, np.float64)


def _form(matrix: Array, x: Array) -> Array:
    """Quadratic form x' M x over batches."""
    return np.asarray(np.einsum("...i,...ij,...j->...", x, matrix, x), np.float64)


def _directions(vectors: ArrayLike) -> Array:
    """Unit vectors.

    :raises ValueError: a vector of length zero or not finite, or a wrong last axis.
    """
    x = np.asarray(vectors, np.float64)
    if x.shape[-1:] != (3,):
        raise ValueError(f"the last axis of a direction has to be 3, the shape is {x.shape}")
    norm = np.linalg.norm(x, axis=-1, keepdims=True)
    if not (np.isfinite(norm) & (norm > 0.0)).all():
        raise ValueError("a direction has to be finite and longer than zero")
    return np.asarray(x / norm, np.float64)


def _energy(energy: float) -> float:
    if not 0.0 < energy < np.inf:
        raise ValueError(f"energy has to be above zero and finite, not {energy}")
    return energy


def _least_direction(forms: Array) -> Array:
    """Unit y with the least max |y' G_a y|, forms (3, 3, 3); returns shape (3,).

    Branch and bound over patches of the half sphere (three faces of a cube; y and -y are alike):
    within an angle r of a centre a form changes by at most |gradient| r + (range of its
    eigenvalues) r^2. Patches that cannot hold less than the best so far are dropped.
    """
    signed = np.concatenate([forms, -forms])
    spans = np.ptp(np.linalg.eigvalsh(forms), axis=-1)
    grid = (np.arange(_GRID) + 0.5) * 2 / _GRID - 1
    face = np.repeat(np.arange(3), _GRID * _GRID)
    u: Array = np.tile(np.repeat(grid, _GRID), 3)
    v: Array = np.tile(grid, 3 * _GRID)
    half = 1.0 / _GRID
    least, value = np.array([0.0, 0.0, 1.0]), np.inf
    for _ in range(_SPLITS):
        corner = np.stack([np.ones_like(u), u, v], -1)
        turned = corner[np.arange(len(u))[:, None], (np.arange(3) - face[:, None]) % 3]
        y = turned / np.linalg.norm(turned, axis=-1, keepdims=True)
        pulled = np.einsum("aij,nj->nai", forms, y)
        amounts = np.einsum("nai,ni->na", pulled, y)
        gradients = 2 * np.linalg.norm(pulled - amounts[..., None] * y[:, None], axis=-1)
        sizes = np.abs(amounts).max(-1)
        if sizes.min() < value:
            least, value = _polished(signed, y[sizes.argmin()])
        angle = np.sqrt(2) * half
        lowest = (np.abs(amounts) - gradients * angle - spans * angle**2).max(-1)
        open_ = np.flatnonzero(lowest < value * (1 - _PROVEN))
        if not open_.size:
            break
        # A whole curve of equal minima would never close; its most promising part is enough.
        open_ = open_[np.argsort(lowest[open_])[:_PATCHES]]
        half /= 2
        face = np.repeat(face[open_], 4)
        u = (u[open_, None] + half * np.array([-1, -1, 1, 1])).ravel()
        v = (v[open_, None] + half * np.array([-1, 1, -1, 1])).ravel()
    return least


def _polished(signed: Array, start: Array) -> tuple[Array, float]:
    """Descend from a point to a local minimum, and its value."""
    y, value = start, float(_largest(signed, start))
    for _ in range(_ROUNDS):
        tried = _steps(signed, y)
        sizes = _largest(signed, tried)
        best = sizes.argmin()
        if not sizes[best] < value:
            break
        y, value = tried[best], float(sizes[best])
    return y, value


def _largest(signed: Array, y: Array) -> Array:
    """max_k y' A_k y, shape of y less its last axis."""
    return np.asarray(np.einsum("...i,kij,...j->...k", y, signed, y).max(-1), np.float64)


def _tangent(signed: Array, y: Array) -> tuple[Array, Array, Array, Array]:
    """Values, gradients and Hessians of the forms on the sphere at y, and the tangent basis."""
    basis = np.linalg.svd(y[None, :])[2][1:]
    values = np.einsum("i,kij,j->k", y, signed, y)
    gradients = 2 * np.einsum("ai,kij,j->ka", basis, signed, y)
    hessians = 2 * np.einsum("ai,kij,bj->kab", basis, signed, basis)
    hessians -= 2 * values[:, None, None] * np.eye(2)
    return values, gradients, hessians, basis


def _steps(signed: Array, y: Array) -> Array:
    """Points to try from y: Newton steps on one, two and three of the largest forms."""
    f, g, h, basis = _tangent(signed, y)
    first, second, third = np.argsort(-f)[:3].tolist()
    lengths = _LENGTHS[:, None]
    moves = [lengths * _newton(g[first], h[first])]
    for other in (second, third):
        # Along the curve on which two forms are equal; the weight of both that descends least.
        apart = g[first] - g[other]
        square = apart @ apart
        if not square > 0.0:
            continue
        weight = min(1.0, max(0.0, -(g[other] @ apart) / square))
        slope = weight * g[first] + (1 - weight) * g[other]
        bend = weight * h[first] + (1 - weight) * h[other]
        onto = (f[other] - f[first]) / square * apart
        along = np.array([-apart[1], apart[0]]) / np.sqrt(square)
        curvature = along @ bend @ along
        descent = along @ (slope + bend @ onto)
        reach = -descent / curvature if curvature > 0.0 else -np.sign(descent)
        step = onto + lengths * np.clip(reach, -1.0, 1.0) * along
        # Back onto the curve, to second order: else the kink between the forms stops the steps.
        off = np.einsum("na,ab,nb->n", step, h[first] - h[other], step) / 2
        moves.append(step - (off / square)[:, None] * apart)
    corner = np.array([g[first] - g[second], g[first] - g[third]])
    if abs(np.linalg.det(corner)) > 0.0:
        step = np.linalg.solve(corner, f[[second, third]] - f[first])
        moves.append(np.asarray(lengths * step, np.float64))
    tried = np.concatenate(moves)
    tried = tried / np.maximum(1.0, np.linalg.norm(tried, axis=-1, keepdims=True))
    points = y + tried @ basis
    return np.asarray(points / np.linalg.norm(points, axis=-1, keepdims=True), np.float64)


def _newton(g: Array, h: Array) -> Array:
    """Newton's step, or the steepest descent where the form does not bend upwards."""
    values, vectors = np.linalg.eigh(h)
    if values[0] > 0.0:
        return np.asarray(-vectors @ ((vectors.T @ g) / values), np.float64)
    size = np.linalg.norm(g)
    return np.asarray(-g / size if size > 0.0 else np.zeros(2), np.float64)
