# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Dynamic isotropy: how energy and driving force depend on the direction of the platform's motion.

Two indices of the 3-PRRU paper, for every robot with masses, over the pose rates Xdot:

- eta_KE = E_M / E_all (equation 44), the platform's part of the kinetic energy;
- F_max = max |F_d| at a given E_M and Xddot (equations 47 and 48).

A payload counts as part of the platform. Directions are unit vectors of pose rates in SI
units (m/s and rad/s for the 3-PRRU), as in the paper; eta's extremes do not depend on
that choice. Xddot = 0 is meant in the pose's own coordinates, so F_max does depend on them:
turned by a third of a turn, the same motion has another Xddot in alpha and beta.
"""

from __future__ import annotations

import itertools
import math
import operator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from delta_dynamics.torques.torque_terms import efforts_without_friction
from delta_dynamics.torques.virtual_work import body_mass_matrix, mass_matrix
from pkm_twin.codegen.arrays import Array, common_batch, doubles, require_finite, vectors
from pkm_twin.errors import ParameterError, SingularityError
from pkm_twin.machine.pose_grid import zero_torsion
from pkm_twin.robot.derivatives import joint_accelerations
from pkm_twin.robot.robot import Robot


def sphere_directions(count: int) -> Array:
    """Return unit vectors evenly over the sphere (Fibonacci lattice), shape (count, 3)."""
    count = operator.index(count)
    if count < 1:
        raise ValueError(f"count has to be at least 1, not {count}")
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    turn = np.pi * (3 - np.sqrt(5)) * i
    out = np.sqrt(1 - z * z)
    return np.stack([out * np.cos(turn), out * np.sin(turn), z], -1)


MAX_COORDINATES: Final = 3
"""Largest number of pose coordinates for which all candidate minima are known."""


def evaluate_largest(forms: Array, y: Array) -> Array:
    """Return max_a |y' G_a y|, shape (...); forms (..., n, m, m), y (..., m)."""
    return np.asarray(np.abs(np.einsum("...i,...aij,...j->...a", y, forms, y)).max(-1), np.float64)


def minimax_direction(forms: Array) -> Array:
    """Find the unit y, (m,), with the least max_a |y' G_a y| of symmetric forms G, (n, m, m).

    For m up to 3. At a minimum one form is stationary, or two are equal but for their sign and one
    of them is stationary along the cone y' H y = 0 on which they are, or three are equal. All such
    points are known: eigenvectors; common points, in the projective plane, of the cone and the
    cubic det(y, G y, H y) = 0; common points of two cones. The best of them all is the answer, to
    rounding.
    """
    count, size = forms.shape[:2]
    pairs = list(itertools.combinations(range(count), 2))
    cones = [(a, forms[a] - sign * forms[b]) for a, b in pairs for sign in (1.0, -1.0)]
    found = [np.eye(size), *np.linalg.eigh(forms)[1].swapaxes(-1, -2)]
    for cone in (*forms, *(cone for _, cone in cones)):
        values, vectors = np.linalg.eigh(cone)
        if values[0] < 0.0 < values[-1]:
            # Directions on the cone y' G y = 0: all of them for two coordinates, two of them for three.
            x = math.sqrt(values[-1]) * vectors[:, 0]
            z = math.sqrt(-values[0]) * vectors[:, -1]
            found.append(np.stack([x + z, x - z]))
    if size == 3:
        # At y = (1, u, v): rows G y as polynomials, and the polynomial y' G y of each form.
        rows = {
            a: np.einsum("ij,juv->iuv", _normalise(_ROTATION.T @ forms[a] @ _ROTATION), _COORDINATE_POLYNOMIALS)
            for a in range(count)
        }
        curves = []
        for a, cone in cones:
            g, h = (
                rows[a],
                np.einsum("ij,juv->iuv", _normalise(_ROTATION.T @ cone @ _ROTATION), _COORDINATE_POLYNOMIALS),
            )
            conic = np.sum([_multiply_polynomials(_COORDINATE_POLYNOMIALS[i], h[i]) for i in range(3)], axis=0)
            # det(y, G y, H y): zero where y' G y is stationary along y' H y = 0.
            stationary = np.zeros((4, 4))
            for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
                stationary += _multiply_polynomials(
                    _COORDINATE_POLYNOMIALS[i], _multiply_polynomials(g[j], h[k]) - _multiply_polynomials(g[k], h[j])
                )
            found.append(_intersect_conic(conic, stationary) @ _ROTATION.T)
            curves.append(conic)
        for one, other in itertools.combinations(curves, 2):
            found.append(_intersect_conic(one, other) @ _ROTATION.T)
    points = np.concatenate(found)
    # Evaluate the forms at all points, because some may be no minimum.
    points = points[np.isfinite(points).all(-1) & points.any(-1)]
    points /= np.linalg.norm(points, axis=-1, keepdims=True)
    return np.asarray(points[evaluate_largest(forms, points).argmin()], np.float64)


_ROTATION: Final = np.linalg.qr([[1.0, 0.3, -0.4], [0.2, 0.9, 0.7], [-0.5, 0.6, 1.1]])[0]
"""An arbitrary rotation, so that no plane of symmetry is a line u = constant and no minimum is at
infinity."""
_COORDINATE_POLYNOMIALS: Final = np.zeros((3, 2, 2))
"""y = (1, u, v) as polynomials: entry (i, j) of each is the coefficient of u^i v^j."""
_COORDINATE_POLYNOMIALS[0, 0, 0] = _COORDINATE_POLYNOMIALS[1, 1, 0] = _COORDINATE_POLYNOMIALS[2, 0, 1] = 1.0


def _multiply_polynomials(p: Array, q: Array) -> Array:
    """Multiply two polynomials in u and v."""
    result = np.zeros((p.shape[0] + q.shape[0] - 1, p.shape[1] + q.shape[1] - 1))
    for i, j in np.ndindex(*p.shape):
        result[i : i + q.shape[0], j : j + q.shape[1]] += p[i, j] * q
    return result


def _normalise(matrix: Array) -> Array:
    size = np.abs(matrix).max()
    return np.asarray(matrix / size if size > 0.0 else matrix, np.float64)


def _intersect_conic(conic: Array, curve: Array) -> Array:
    """Return points (1, u, v) of a conic, shape (k, 3), with all those of another curve.

    u are the eigenvalues of the polynomial Sylvester matrix of both in v; v follows from the
    conic.
    """
    d, e = conic.shape[1] - 1, curve.shape[1] - 1
    n, degree = d + e, max(len(conic), len(curve)) - 1
    sylvester = np.zeros((degree + 1, n, n))
    for row in range(e):
        sylvester[: len(conic), row, row : row + d + 1] = conic[:, ::-1]
    for row in range(d):
        sylvester[: len(curve), e + row, row : row + e + 1] = curve[:, ::-1]
    first, last = np.eye(n * degree, k=n), np.eye(n * degree)
    first[-n:] = np.hstack(list(-sylvester[:-1]))
    last[-n:, -n:] = sylvester[-1]
    from scipy.linalg import eig  # type: ignore[import-untyped]

    u = eig(first, last, right=False)
    u = u[np.isfinite(u)].real
    c, b, a = (np.polynomial.polynomial.polyvander(u, len(conic) - 1) @ conic).T
    with np.errstate(all="ignore"):
        half = -(b + np.copysign(np.sqrt(np.maximum(b * b - 4 * a * c, 0.0)), b)) / 2
        v = np.concatenate([half / a, c / half])
    return np.stack([np.ones(len(v)), np.concatenate([u, u]), v], -1)


PAPER_ENERGY: Final = 100.0
"""The platform's kinetic energy in the paper's equation 48, J."""
MIN_SINGULAR_VALUE_RATIO: Final = 1e-6
"""Smallest singular value of dq/dX, relative to the largest one or 1 m/rad, that is inverted."""


class JointMotion(NamedTuple):
    """Joint positions, rates and accelerations, shape (..., m) each."""

    q: Array
    qd: Array
    qdd: Array


class Extremes(NamedTuple):
    """Least and largest value over all directions, shape (...), and their directions.

    ``directions``: unit vectors of pose rates, shape (..., 2, m), least then greatest.
    """

    least: Array
    greatest: Array
    directions: Array

    @property
    def spread(self) -> Array:
        """Maximum minus minimum, shape (...)."""
        return self.greatest - self.least


def joint_motion(robot: Robot, pose: ArrayLike, rates: ArrayLike, accelerations: ArrayLike = 0.0) -> JointMotion:
    """Compute the joint motion of a pose motion: qd = J^-1 Xdot, qdd = J^-1 (Xddot - Jdot qd).

    Exact: Jdot qd is the pose's acceleration at qdd = 0, computed from the bodies' motion (3-PRRU
    paper, equations 24 and 25, without its Hessian).

    :param pose: shape (..., m); ``rates`` and ``accelerations`` are its derivatives in time.
    :raises UnreachableError: a pose out of reach, by limb, sample and miss.
    :raises SingularityError: the Jacobian has no inverse.
    """
    q, inverse = _inverse_jacobian(robot, pose)
    m = len(robot.pose_names)
    change = doubles(accelerations, "pose accelerations")
    rates = vectors(rates, m, "pose rates")
    change = vectors(np.broadcast_to(change, m) if change.ndim == 0 else change, m, "Xddot")
    common_batch(q.shape[:-1], rates.shape[:-1], change.shape[:-1])
    qd = np.einsum("...ij,...j->...i", inverse, rates)
    qdd = joint_accelerations(robot, q, qd, inverse, change)
    require_finite(qdd, "an acceleration")
    q, qd, qdd = np.broadcast_arrays(q, qd, qdd)
    return JointMotion(q.copy(), qd.copy(), qdd)


def energy_matrices(robot: Robot, pose: ArrayLike) -> tuple[Array, Array]:
    """Return the kinetic energy of the platform and of all bodies as forms of the pose rates.

    E = Xdot' M Xdot / 2 (3-PRRU paper, equations 42 and 43).

    :param pose: shape (..., m).
    :returns: platform with payload, and all bodies; shape (..., m, m) each.
    """
    q, inverse = _inverse_jacobian(robot, pose)
    platform = body_mass_matrix(robot, q, robot.graph.platform)
    pair = np.stack([platform, mass_matrix(robot, q)], -3)
    turn = inverse[..., None, :, :]
    forms = turn.swapaxes(-1, -2) @ pair @ turn
    forms = (forms + forms.swapaxes(-1, -2)) / 2
    return forms[..., 0, :, :], forms[..., 1, :, :]


def energy_transfer(robot: Robot, pose: ArrayLike, direction: ArrayLike) -> Array:
    """Compute eta_KE = E_M / E_all, the platform's part of the kinetic energy (equations 44, 46).

    :param pose: shape (..., m).
    :param direction: pose rates of any length above zero, shape (..., m).
    :returns: shape (...), 0 to 1.
    """
    x = _normalise_directions(direction, len(robot.pose_names))
    platform, everything = energy_matrices(robot, pose)
    common_batch(platform.shape[:-2], x.shape[:-1])
    return _evaluate_form(platform, x) / _evaluate_form(everything, x)


def energy_transfer_range(robot: Robot, pose: ArrayLike) -> Extremes:
    """Find the extremes of eta_KE over all directions, exact, from generalised eigenvalues.

    :param pose: shape (..., m).
    :raises ParameterError: a direction of motion in which the bodies have no inertia.
    """
    platform, everything = energy_matrices(robot, pose)
    back = _inverse_root(robot, everything)
    form = back.swapaxes(-1, -2) @ platform @ back
    values, vectors = np.linalg.eigh((form + form.swapaxes(-1, -2)) / 2)
    ends = vectors[..., [0, -1]]
    directions = _normalise_directions((back @ ends).swapaxes(-1, -2))
    return Extremes(values[..., 0], values[..., -1], directions)


def max_driving_force(
    robot: Robot, pose: ArrayLike, direction: ArrayLike, energy: float = PAPER_ENERGY, acceleration: ArrayLike = 0.0
) -> Array:
    """Compute F_max, the largest |F_d| over the actuators (equation 47), N or N m.

    Gravity and payload act, friction does not.

    :param pose: shape (..., m).
    :param direction: of the pose rates, shape (..., m); their length follows from ``energy``.
    :param energy: kinetic energy E_M of the platform, J; the default is that of equation 48.
    :param acceleration: Xddot, a number or shape (..., m).
    :returns: shape (...).
    """
    x = _normalise_directions(direction, len(robot.pose_names))
    platform, _ = energy_matrices(robot, pose)
    common_batch(platform.shape[:-2], x.shape[:-1])
    _inverse_root(robot, platform)
    rates = np.sqrt(2 * _check_energy(energy) / _evaluate_form(platform, x))[..., None] * x
    motion = joint_motion(robot, pose, rates, acceleration)
    forces = efforts_without_friction(robot, *motion)
    return np.asarray(np.abs(forces).max(-1), np.float64)


def max_driving_force_range(
    robot: Robot, pose: ArrayLike, energy: float = PAPER_ENERGY, acceleration: ArrayLike = 0.0
) -> Extremes:
    """Find the extremes of F_max over all directions at the platform's energy E_M, N or N m.

    On the ellipsoid of Xdot with that energy, scaled to the unit sphere, every F_d is a
    quadratic form y' G y. The greatest |F_d| is an eigenvalue, exact. The least F_max is the
    minimum of the largest of these forms (:func:`minimax_direction`), exact too.

    :param pose: shape (..., m).
    :param acceleration: Xddot, a number or shape (..., m).
    :raises ParameterError: more than three pose coordinates.
    """
    if len(robot.pose_names) > MAX_COORDINATES:
        raise ParameterError("pose", len(robot.pose_names), f"at most {MAX_COORDINATES} pose coordinates")
    back, forms = _driving_forms(robot, pose, energy, acceleration)
    greatest, high, _ = _find_largest_form(forms)
    flat = forms.reshape(-1, *forms.shape[-3:])
    low = np.array([minimax_direction(form) for form in flat]).reshape(high.shape)
    least = evaluate_largest(forms, low)
    y = np.stack([low, high], -2)
    return Extremes(least, greatest, _normalise_directions(np.einsum("...ij,...kj->...ki", back, y)))


def driving_force_peak(
    robot: Robot, pose: ArrayLike, energy: float = PAPER_ENERGY, acceleration: ArrayLike = 0.0
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Find the greatest F_max over all directions, its direction (..., m), and its actuator's index.

    Arguments as in :func:`max_driving_force_range`; any number of pose coordinates.
    """
    back, forms = _driving_forms(robot, pose, energy, acceleration)
    greatest, y, joint = _find_largest_form(forms)
    return greatest, _normalise_directions(np.einsum("...ij,...j->...i", back, y)), joint


def _driving_forms(robot: Robot, pose: ArrayLike, energy: float, acceleration: ArrayLike) -> tuple[Array, Array]:
    """Return pose rates of unit vectors y, (..., m, m), and F_d of y, (..., actuators, m, m)."""
    where = doubles(pose, "poses")
    platform, _ = energy_matrices(robot, where)
    back = np.sqrt(2 * _check_energy(energy)) * _inverse_root(robot, platform)
    size = where.shape[-1]
    start = joint_motion(robot, where, np.zeros(size), acceleration)
    constant = efforts_without_friction(robot, *start)
    pairs = list(itertools.combinations(range(size), 2))
    units = np.eye(size)
    mixed = np.array([units[j] + units[k] for j, k in pairs]).reshape(-1, size)
    probes = np.einsum("...ij,kj->...ki", back, np.concatenate([units, mixed]))
    motion = joint_motion(robot, where[..., None, :], probes, np.zeros(size))
    moved = efforts_without_friction(robot, *motion, weight=False)
    forms = np.zeros((*constant.shape, size, size))
    for j in range(size):
        forms[..., j, j] = moved[..., j, :]
    for probe, (j, k) in enumerate(pairs, start=size):
        both = (moved[..., probe, :] - moved[..., j, :] - moved[..., k, :]) / 2
        forms[..., j, k] = forms[..., k, j] = both
    forms += constant[..., None, None] * np.eye(size)
    return back, forms


def _find_largest_form(forms: Array) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return the largest absolute value of forms on the unit sphere, its direction and the form's index."""
    values, vectors = np.linalg.eigh(forms)
    ends = np.abs(values[..., [0, -1]])
    flat = ends.reshape(*ends.shape[:-2], ends.shape[-2] * ends.shape[-1])
    best = flat.argmax(-1)[..., None]
    sides = vectors[..., [0, -1]].swapaxes(-1, -2)
    y = np.take_along_axis(sides.reshape(*flat.shape, forms.shape[-1]), best[..., None], -2)
    return np.take_along_axis(flat, best, -1)[..., 0], y[..., 0, :], best[..., 0] // 2


def spread(values: ArrayLike) -> Array:
    """Return maximum minus minimum over the last axis, for an index over all directions."""
    return np.asarray(np.ptp(require_finite(doubles(values), "a value"), axis=-1), np.float64)


def tilted_pose(height: ArrayLike, azimuth: ArrayLike, tilt: ArrayLike) -> Array:
    """Return the pose (z, alpha, beta) of tilt-and-torsion angles with zero torsion, (..., 3).

    The platform's axis leans by ``tilt`` towards ``azimuth`` (rad), as in the paper's maps.
    """
    given = [require_finite(doubles(v), "a height or an angle") for v in (height, azimuth, tilt)]
    common_batch(*(values.shape for values in given))
    z, a, t = np.broadcast_arrays(*given)
    return np.stack([z, *zero_torsion(t, a)], -1)


def _inverse_jacobian(robot: Robot, pose: ArrayLike) -> tuple[Array, Array]:
    """Return joint positions, (..., n), and joint rates per pose rate, (..., n, m)."""
    q = robot.inverse(pose)
    s = np.linalg.svd(robot.jacobian(q), compute_uv=False)
    # Compare with 1 m/rad at least: the whole Jacobian vanishes where all limbs are stretched.
    measure = s[..., -1] / np.maximum(s[..., 0], 1.0)
    bad = np.argwhere(~(measure > MIN_SINGULAR_VALUE_RATIO))
    if len(bad):
        index = tuple(int(i) for i in bad[0])
        raise SingularityError("pose", index, float(measure[index]), MIN_SINGULAR_VALUE_RATIO)
    return q, robot.inverse_jacobian(q)


def _inverse_root(robot: Robot, form: Array) -> Array:
    """Return B with B' M B = 1, shape (..., m, m)."""
    try:
        root = np.linalg.cholesky(form)
    except np.linalg.LinAlgError:
        raise ParameterError(
            "inertia", robot.name, "masses and inertias that resist every motion of the platform"
        ) from None
    return np.asarray(np.linalg.inv(root).swapaxes(-1, -2), np.float64)


def _evaluate_form(matrix: Array, x: Array) -> Array:
    """Return the quadratic form x' M x, shape (...)."""
    return np.asarray(np.einsum("...i,...ij,...j->...", x, matrix, x), np.float64)


def _normalise_directions(directions: ArrayLike, size: int | None = None) -> Array:
    """Return directions at unit length: xdot of Xdot = X xdot (equation 45).

    :raises ValueError: a vector of length zero or not finite, or a wrong last axis.
    """
    x = doubles(directions, "directions")
    if size is not None and x.shape[-1:] != (size,):
        raise ValueError(f"the last axis of a direction must be {size}, the shape is {x.shape}")
    norm = np.linalg.norm(x, axis=-1, keepdims=True)
    if not (np.isfinite(norm) & (norm > 0.0)).all():
        raise ValueError("a direction has to be finite and longer than zero")
    return np.asarray(x / norm, np.float64)


def _check_energy(energy: float) -> float:
    if not 0.0 < energy < np.inf:
        raise ValueError(f"energy has to be above zero and finite, not {energy}")
    return energy
