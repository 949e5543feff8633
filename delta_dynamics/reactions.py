# SPDX-License-Identifier: Apache-2.0
"""Joint reactions by d'Alembert's principle: the force route beside the power route.

Every body's force and moment balance, A lambda = b, over what the joints can transmit; the
actuators' efforts come out as components of lambda, independently of virtual work.

May import: numpy, pkm_twin's core, the standard library; never rclpy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from delta_dynamics.virtual_work import bodies
from pkm_twin.errors import SingularityError
from pkm_twin.machine.bodies import GRAVITY
from pkm_twin.machine.joints import (
    GROUND,
    MOVING,
    PAYLOAD,
    Joint,
    jointed,
    platform_motion,
)
from pkm_twin.machine.robot import SINGULARITY_BOUND, Robot

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

RANK_BOUND: Final = SINGULARITY_BOUND
"""Singular values of the balance below this part of the largest count as zero."""
CLEAR_RANK: Final = 1e-6
"""Reciprocal condition above which no singular values are needed to tell the rank."""
DETERMINATE_BOUND: Final = 1e-6
"""A component is determinate where no unit vector of the null space reaches beyond this."""
BALANCE_BOUND: Final = 1e-6
"""Largest part of the loads that may stay unbalanced before there is no equilibrium."""


@dataclass(frozen=True)
class Reactions:
    """What each joint's inner body (on the base's side) applies to its outer body.

    Arrays are read-only. What statics of rigid bodies cannot tell is NaN and False in the masks.
    """

    names: tuple[str, ...]
    """The joints."""
    bodies: tuple[tuple[str, str], ...]
    """Inner and outer body of each joint; the outer one receives the wrench."""
    points: Array
    """The joints' points, shape (..., joints, 3), m."""
    wrenches: Array
    """Force (N) and moment (N m) about the joint's point, world axes, (..., joints, 6)."""
    determinate: Mask
    """Which entries of ``wrenches`` rigid-body statics determines, (..., joints, 6)."""
    components: tuple[str, ...]
    """The unknowns along the joints' own directions, by name."""
    values: Array
    """Their amounts, shape (..., components), N or N m."""
    determinate_components: Mask
    """Which of ``values`` are determinate, shape (..., components)."""
    actuated: tuple[str, str, str]
    """Names of the three components that the actuators apply."""
    residual: Array
    """Greatest imbalance of a body's force or moment over the greatest load, shape (...)."""

    @property
    def indeterminate(self) -> tuple[str, ...]:
        """Names of the components that are indeterminate in one sample or more."""
        known = self.determinate_components.reshape(-1, len(self.components))
        return tuple(n for k, n in enumerate(self.components) if not known[:, k].all())

    @property
    def efforts(self) -> Array:
        """Actuator efforts less friction, shape (..., 3), N m or N, positive as in q."""
        return self.values[..., [self.components.index(name) for name in self.actuated]]

    def wrench(self, name: str) -> Array:
        """Wrench at the joint ``name``, shape (..., 6)."""
        return self.wrenches[..., self.names.index(name), :]


def reactions(
    robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, wrench: ArrayLike | None = None
) -> Reactions:
    """Constraint forces and moments at every joint, for a motion.

    Force and moment balance of each body (Delta-CU paper, d'Alembert's principle, section 3: at
    A, B and C of each limb), the payload fixed to the platform. The actuated components are
    what reaches the bodies: motor effort less the joint's friction.

    Which components the mechanism's statics determines is decided by the rank of the balance;
    the others are NaN, see ``Reactions.determinate`` and ``Reactions.indeterminate``.

    :param q: joint positions, shape (..., 3), rad or m.
    :param qd: joint rates, shape (..., 3).
    :param qdd: joint accelerations, shape (..., 3).
    :param wrench: force and moment that the surroundings apply to the platform at its
        origin, world axes, shape (..., 6), N and N m; None is none.
    :raises UnreachableError: a joint state without an assembly, by limb, sample and miss.
    :raises SingularityError: the Jacobian of the closure has no inverse, or the joints cannot
        hold the loads (a constraint singularity).
    :raises ParameterError: a mechanism without masses or without declared joints.
    :raises ValueError: a wrong last axis, or a value that is not finite.
    """
    full = least_norm_reactions(robot, q, qd, qdd, wrench)
    return replace(
        full,
        wrenches=_read_only(np.where(full.determinate, full.wrenches, np.nan)),
        values=_read_only(np.where(full.determinate_components, full.values, np.nan)),
    )


def least_norm_reactions(
    robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, wrench: ArrayLike | None = None
) -> Reactions:
    """As :func:`reactions`, with indeterminate components filled by the least-norm solution.

    Of all solutions of the balance the one with the least sum of squares, moments counted as
    forces at the mechanism's size (root mean square distance of the joints from their centre). In
    a real machine elasticity and tolerances decide; this is one of many possible answers.
    """
    arrays = [np.asarray(value, np.float64) for value in (q, qd, qdd)]
    batch = np.broadcast_shapes(*(a.shape[:-1] for a in arrays))
    load = np.zeros(6) if wrench is None else np.asarray(wrench, np.float64)
    if load.shape[-1:] != (6,) or not np.isfinite(load).all():
        raise ValueError(f"wrench has to be finite with a last axis of 6, shape {load.shape}")
    batch = np.broadcast_shapes(batch, load.shape[:-1])
    place, rate, change = (np.broadcast_to(a, (*batch, *a.shape[-1:])) for a in arrays)
    rows, _ = bodies(robot, place, rate, change)
    platform = platform_motion(robot, place, rate, change)
    joints = jointed(robot).body_joints(place, platform)

    names = tuple(dict.fromkeys(name for joint in joints for name in joint.components))
    points = np.stack([np.broadcast_to(joint.point, (*batch, 3)) for joint in joints], -2)
    centred = points - points.mean(-2, keepdims=True)
    size = np.sqrt(np.mean(np.sum(centred**2, -1), -1))

    free = [name for name in robot.body_names if name != PAYLOAD]
    origin = {name: rows[..., robot.body_names.index(name), 1:4] for name in free}
    a = _transmission(joints, names, origin, batch)
    b = _loads(robot, rows, origin, platform.position, load, batch)
    moment = _moments(joints, names)
    value, null, residual = _solve(a, b, moment, size)

    spread = np.stack([_columns(joint, names, batch) for joint in joints], -3)
    # Moments and forces of the null space in one unit again, so that one bound holds.
    reach = np.einsum("...jik,...kn->...jin", spread, null * _unit(moment, size)[..., None])
    reach[..., 3:, :] /= size[..., None, None, None]
    actuated = tuple(joint.actuated for joint in joints if joint.actuated is not None)
    return Reactions(
        names=tuple(joint.name for joint in joints),
        bodies=tuple((joint.inner, joint.outer) for joint in joints),
        points=_read_only(points),
        wrenches=_read_only(np.einsum("...jik,...k->...ji", spread, value)),
        determinate=_small(reach),
        components=names,
        values=_read_only(value),
        determinate_components=_small(null),
        actuated=(actuated[0], actuated[1], actuated[2]),
        residual=_read_only(residual),
    )


def _columns(joint: Joint, names: tuple[str, ...], batch: tuple[int, ...]) -> Array:
    """The joint's wrench basis over all unknowns, shape (..., 6, unknowns)."""
    result = np.zeros((*batch, 6, len(names)))
    result[..., [names.index(name) for name in joint.components]] = joint.basis
    return result


def _moments(joints: tuple[Joint, ...], names: tuple[str, ...]) -> Mask:
    """Which unknowns are moments, shape (unknowns,)."""
    result = np.zeros(len(names), bool)
    for joint in joints:
        pure = np.logical_not(np.any(joint.basis[..., :3, :], -2))
        for k, name in enumerate(joint.components):
            result[names.index(name)] = bool(np.all(pure[..., k]))
    return result


def _transmission(
    joints: tuple[Joint, ...],
    names: tuple[str, ...],
    origin: dict[str, Array],
    batch: tuple[int, ...],
) -> Array:
    """Wrench on each body about its own point per unknown, shape (..., 6 bodies, unknowns)."""
    result = np.zeros((*batch, len(origin), 6, len(names)))
    order = list(origin)
    for joint in joints:
        columns = _columns(joint, names, batch)
        for body, sign in ((joint.inner, -1.0), (joint.outer, 1.0)):
            if body == GROUND:
                continue
            lever = joint.point - origin[body]
            shifted = np.cross(lever[..., None, :], columns[..., :3, :].swapaxes(-1, -2))
            on_body = result[..., order.index(body), :, :]
            on_body += sign * columns
            on_body[..., 3:, :] += sign * shifted.swapaxes(-1, -2)
    return result.reshape(*batch, 6 * len(origin), len(names))


def _loads(
    robot: Robot,
    rows: Array,
    origin: dict[str, Array],
    platform: Array,
    wrench: Array,
    batch: tuple[int, ...],
) -> Array:
    """What the joints have to apply to each body about its own point, shape (..., 6 bodies)."""
    result = np.zeros((*batch, len(origin), 6))
    order = list(origin)
    pull = robot.parameters[GRAVITY : GRAVITY + 3]
    for k, name in enumerate(robot.body_names):
        body = MOVING if name == PAYLOAD else name
        row = rows[..., k, :]
        force = row[..., :1] * (row[..., 4:7] - pull)
        needed = result[..., order.index(body), :]
        needed[..., :3] += force
        needed[..., 3:] += row[..., 7:10] + np.cross(row[..., 1:4] - origin[body], force)
    needed = result[..., order.index(MOVING), :]
    needed[..., :3] -= wrench[..., :3]
    needed[..., 3:] -= wrench[..., 3:] + np.cross(platform - origin[MOVING], wrench[..., :3])
    return result.reshape(*batch, 6 * len(origin))


def _unit(moment: Mask, size: Array) -> Array:
    """The size where the unknown is a moment, else one, shape (..., unknowns)."""
    return np.where(moment, size[..., None], 1.0)


def _solve(a: Array, b: Array, moment: Mask, size: Array) -> tuple[Array, Array, Array]:
    """Least-norm solution, orthonormal null space and relative imbalance.

    Moments and lengths are divided by the mechanism's size, so that all numbers are forces. The
    columns of the null space, shape (..., unknowns, unknowns), are zero beyond its dimension.
    """
    equations, unknowns = a.shape[-2:]
    batch = b.shape[:-1]
    turning = np.tile(np.arange(6) >= 3, equations // 6)
    unit = _unit(moment, size)
    rows = np.where(turning, 1.0 / size[..., None], 1.0)
    matrix = (a * rows[..., None] * unit[..., None, :]).reshape(-1, equations, unknowns)
    right = (b * rows).reshape(-1, equations)
    value, regular = _regular(matrix, right)
    null = np.zeros((len(matrix), unknowns, unknowns))
    if not regular.all():
        value[~regular], null[~regular] = _deficient(matrix[~regular], right[~regular])
    left = right - np.einsum("...rk,...k->...r", matrix, value)
    scale = np.maximum(np.abs(right).max(-1), np.finfo(np.float64).tiny)
    residual = np.asarray(np.abs(left).max(-1) / scale, np.float64).reshape(batch)
    if (residual > BALANCE_BOUND).any():
        index = tuple(int(i) for i in np.argwhere(residual > BALANCE_BOUND)[0])
        s = np.linalg.svd(matrix.reshape(*batch, equations, unknowns)[index], compute_uv=False)
        measure = float(s[-1] / s[0])
        raise SingularityError("constraint of the joint state", index, measure, RANK_BOUND)
    null = null.reshape(*batch, unknowns, unknowns)
    return value.reshape(*batch, unknowns) * unit, null, residual


def _regular(matrix: Array, right: Array) -> tuple[Array, Mask]:
    """Solve where the columns are clearly independent, by QR; which samples these are.

    Ten times cheaper than the singular values that decide the other samples.
    """
    equations, unknowns = matrix.shape[-2:]
    if unknowns > equations:
        return np.zeros((len(matrix), unknowns)), np.zeros(len(matrix), bool)
    q, r = np.linalg.qr(matrix)
    diagonal = np.abs(np.diagonal(r, axis1=-2, axis2=-1))
    sound = diagonal.min(-1) > CLEAR_RANK * diagonal.max(-1)
    inverse = np.linalg.inv(np.where(sound[:, None, None], r, np.eye(unknowns)))
    condition = np.linalg.norm(r, axis=(-2, -1)) * np.linalg.norm(inverse, axis=(-2, -1))
    value = np.einsum("nij,nj->ni", inverse, np.einsum("nrk,nr->nk", q, right))
    return value, sound & (condition * CLEAR_RANK < 1.0)


def _deficient(matrix: Array, right: Array) -> tuple[Array, Array]:
    """Least-norm solution and null space by singular values."""
    equations, unknowns = matrix.shape[-2:]
    # Empty equations, so that there is a singular value for every unknown.
    missing = max(0, unknowns - equations)
    full = np.pad(matrix, [(0, 0), (0, missing), (0, 0)])
    u, s, vt = np.linalg.svd(full, full_matrices=False)
    sound = s > RANK_BOUND * s[:, :1]
    inverse = np.where(sound, 1.0 / np.where(sound, s, 1.0), 0.0)
    along = inverse * np.einsum("nrk,nr->nk", u, np.pad(right, [(0, 0), (0, missing)]))
    value = np.einsum("nks,nk->ns", vt, along)
    return value, np.where(sound[..., None], 0.0, vt).swapaxes(-1, -2)


def _small(reach: Array) -> Mask:
    """Whether the null space does not reach an entry, over the last axis."""
    result: Mask = np.linalg.norm(reach, axis=-1) < DETERMINATE_BOUND
    result.setflags(write=False)
    return result


def _read_only(values: Array) -> Array:
    values.setflags(write=False)
    return values
