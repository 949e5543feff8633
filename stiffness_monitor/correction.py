# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Joint offsets that cancel the displacement of the tool point by a wrench."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array, Mask, common_batch, doubles, require_finite, vectors
from pkm_twin.machine.rotations import skew
from pkm_twin.messages.stamps import SECOND
from pkm_twin.robot.robot import Robot
from pkm_twin.streams.wrench import check_order


@dataclass(frozen=True)
class Correction:
    """Hold joint offsets and the remaining displacement.

    ``offset``: added to the joints' set points, shape (..., n), rad or m. ``before`` and ``left``:
    displacement of the tool point and rotation of the platform without and with the offset, base
    axes, shape (..., 6), m and rad. ``bounded``: whether the bound reduced it, shape (...).
    """

    offset: Array
    before: Array
    left: Array
    bounded: Mask


def setpoint_correction(
    robot: Robot,
    q: ArrayLike,
    deflection: ArrayLike,
    *,
    tool: ArrayLike = (0.0, 0.0, 0.0),
    bound: ArrayLike = np.inf,
    rotation: Array | None = None,
) -> Correction:
    """Find joint offsets that move the tool point back to its position without load.

    To first order, the offsets move the tool point opposite to the deflection. The position of the
    tool point has priority; remaining joints rotate the platform back. A machine with fewer than
    six degrees of freedom may rotate slightly more to move its tool point back.

    :param q: joint positions, shape (..., n), rad or m.
    :param deflection: of the platform at its reference point, base axes, shape (..., 6), m and
        rad, as ``strain_energy`` gives it.
    :param tool: from the platform's reference point, platform axes, shape (..., 3), m.
    :param bound: largest offset of a joint, shape (n,) or one for all; a larger offset is scaled
        down, with its direction kept.
    :param rotation: of the platform at q, shape (..., 3, 3), where it is known.
    :raises UnreachableError: a joint state without an assembly, by limb, sample and miss.
    :raises ValueError: a wrong last axis, a value that is not finite, or a bound below zero.
    """
    robot.check_independent("corrections of joints", "the others cannot be set")
    limit = doubles(bound, "the bound")
    if limit.shape not in ((), (robot.joints_count,)) or not (limit >= 0.0).all():
        raise ValueError(f"bound is {limit.tolist()}; expected 0 or more, one number or one per joint")
    moved, point = vectors(deflection, 6, "the deflection"), vectors(tool, 3, "the tool point")
    if rotation is None:
        _, rotation = robot.platform(q)
    common_batch(rotation.shape[:-2], moved.shape[:-1], point.shape[:-1])
    lever = skew((rotation @ point[..., None])[..., 0])
    twist = robot.platform_jacobian(q) / robot.joint_scales
    place, turn = twist[..., :3, :] - lever @ twist[..., 3:, :], twist[..., 3:, :]
    there = moved[..., :3] - _multiply(lever, moved[..., 3:])
    before = np.concatenate((there, np.broadcast_to(moved[..., 3:], there.shape)), -1)
    offset, spare = _solve_least_norm(place, -there, place)
    rest = moved[..., 3:] + _multiply(turn, offset)
    offset = offset + _multiply(spare, _solve_least_norm(turn @ spare, -rest, turn)[0])
    given = offset / robot.joint_scales
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = np.where(given == 0.0, 0.0, np.abs(given) / limit).max(-1)
    share = 1.0 / np.maximum(excess, 1.0)
    both = np.concatenate((place, np.broadcast_to(turn, place.shape)), -2)
    left = before + _multiply(both, offset * share[..., None])
    cause = "the deflection or the tool point"
    return Correction(
        require_finite(given * share[..., None], cause), before, require_finite(left, cause), excess > 1.0
    )


@dataclass
class SetpointStream:
    """Add offsets to a stream of set points, within position limits and a rate.

    ``rate``: largest rate of an offset, rad/s or m/s. ``max_elapsed``: longest time between two set
    points that the rate applies to, s, so that an offset does not jump after a pause.
    """

    robot: Robot
    rate: float
    max_elapsed: float
    at_limit: int = 0
    """Set points that a position limit bounded."""
    at_rate: int = 0
    """Set points whose offset the rate bounded."""
    _stamp: int = field(default=0, init=False)
    """Stamp of the last set point, ns; 0 before the first."""
    _offset: Array | None = field(default=None, init=False)
    """Offset of the last set point, shape (n,)."""

    def reset(self) -> None:
        """Forget the last stamp, as when the clock jumps; the offset goes on from its present value."""
        self._stamp = 0

    def correct(self, stamp: int, setpoint: Array, offset: Array) -> Array:
        """Return the corrected set point, shape (n,), rad or m.

        Each joint is bounded by itself: a common factor would change the offsets of all joints at
        once where one reaches its limit.

        :param stamp: of the set point, ns. ``offset``: of the last wrench, shape (n,), rad or m.
        :raises MessageError: the set point is older than the last one.
        """
        check_order(stamp, self._stamp)
        if self._offset is not None:
            elapsed = min((stamp - self._stamp) / SECOND, self.max_elapsed) if self._stamp else 0.0
            limited = self._offset + np.clip(offset - self._offset, -self.rate * elapsed, self.rate * elapsed)
            self.at_rate += bool((limited != offset).any())
            offset = limited
        self._stamp, self._offset = stamp, offset
        corrected = setpoint + offset
        limits = self.robot.limits.position
        if limits is not None:
            within = np.clip(corrected, limits[:, 0], limits[:, 1])
            self.at_limit += bool((within != corrected).any())
            corrected = within
        return require_finite(corrected, "the corrected set point")


def _solve_least_norm(matrix: Array, target: Array, target_change: Array) -> tuple[Array, Array]:
    """Return the least-norm solution in well-conditioned directions, and the projector on the others.

    :param target_change: matrix whose largest singular value is the reference for the condition.
    """
    u, values, vt = np.linalg.svd(matrix, full_matrices=False)
    greatest = np.linalg.svd(target_change, compute_uv=False)[..., :1]
    # Below a ratio of 0.02 a direction would need joint offsets of fifty times the deflection.
    held = values > 0.02 * greatest
    along = np.where(held, _multiply(u.swapaxes(-1, -2), target) / np.where(held, values, 1.0), 0.0)
    kept = np.where(held[..., None], vt, 0.0)
    spare = np.eye(matrix.shape[-1]) - kept.swapaxes(-1, -2) @ kept
    return _multiply(vt.swapaxes(-1, -2), along), spare


def _multiply(matrix: Array, vector: Array) -> Array:
    return np.asarray((matrix @ vector[..., None])[..., 0], np.float64)
