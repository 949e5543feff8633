# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Find the largest efforts and speeds of drives over the whole workspace."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from delta_dynamics import inverse_dynamics, inverse_dynamics_at_pose
from delta_dynamics.torques.isotropy import sphere_directions
from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import ParameterError
from pkm_twin.paths.joint_path import Index, only_turns
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import belong_to_workspace, describe_causes, try_inverse

DEFAULT_RAYS: Final = 1000
"""Rays from home on which poses of the workspace are taken."""
COARSE_DIRECTIONS: Final = 32
"""Number of directions of the tool point's velocity that are tried at every pose."""
FINE_DIRECTIONS: Final = 2000
"""Number of directions that are tried at each drive's worst poses."""
MIN_SINGULARITY_INDEX: Final = 0.05
"""Default: poses with a smaller singularity index are left out."""
MIN_LEVER_RATIO: Final = 0.3
"""Default: poses at which the lever of a drive is below this fraction of its largest lever are left out."""


@dataclass(frozen=True)
class Worst:
    """Hold the drives' largest effort, effort at rest and speed, shape (n,), and their poses.

    Efforts in N m or N, speeds in rad/s or m/s, poses (n, m). ``poses``: number of poses evaluated.
    """

    effort: Array
    effort_pose: Array
    holding: Array
    holding_pose: Array
    speed: Array
    speed_pose: Array
    poses: int


def sample_workspace_poses(
    robot: Robot,
    rays: int = DEFAULT_RAYS,
    singularity: float = MIN_SINGULARITY_INDEX,
    lever: float = 0.0,
) -> Array:
    """Return poses of the workspace, (k, m): reachable, within limits, without singularities.

    They lie on rays from home through the pose coordinates, up to the end of the workspace.

    :param lever: least :func:`compute_levers` of each drive, against its greatest in the workspace: near
        zero at a stretched limb, where the singularity index of the machine may still be high.
    :raises ParameterError: a workspace without bounds, or a home outside of it.
    """
    least = np.zeros(robot.joints_count)
    if lever > 0.0:
        largest = compute_levers(robot, robot.inverse(_poses_on_rays(robot, rays, singularity, least))).max(0)
        home = robot.home()
        share = compute_levers(robot, robot.inverse(home[None]))[0] / largest
        if share.min() < lever:
            joint = robot.joint_names[int(share.argmin())]
            raise ParameterError(
                "lever",
                lever,
                f"{math.floor(100.0 * share.min()) / 100.0:g} or less: at home "
                f"({_name_coordinates(robot, home)}) the lever of {joint} is {share.min():.3g} of its largest "
                "in the workspace",
            )
        least = lever * largest
    return _poses_on_rays(robot, rays, singularity, least)


def _name_coordinates(robot: Robot, pose: Array) -> str:
    return ", ".join(f"{n} {v + 0.0:.4g}" for n, v in zip(robot.pose_names, pose, strict=True))


def compute_levers(robot: Robot, q: Array) -> Array:
    """Return the tool point's speed per joint rate in its smallest direction, shape (k, n).

    In m per rad or m; for a machine that only rotates, the platform's rotation, rad per rad or m.
    """
    size = np.linalg.norm(_joint_rates(robot, q), axis=-1)
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / size)


def _poses_on_rays(robot: Robot, rays: int, singularity: float, least: Array) -> Array:
    """Return poses on rays from home within the workspace, whose ends bisection finds."""
    home, box = robot.home(), robot.search_box()
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(rays, len(home)))
    ways /= np.abs(ways).max(1, keepdims=True)
    ways = np.concatenate([np.eye(len(home)), -np.eye(len(home)), ways])
    # From home to the side of the box through which the ray leaves.
    span = np.where(ways > 0.0, box[:, 1] - home, home - box[:, 0]) * ways
    if not _are_in_workspace(robot, home[None], singularity, least)[0]:
        q, known = try_inverse(robot, home[None])
        why = describe_causes(robot, q, home[None], known, singularity, -math.inf)
        raise ParameterError("workspace", f"home ({_name_coordinates(robot, home)})", f"a home inside: {why}")
    low, high = np.zeros(len(span)), np.ones(len(span))
    for _ in range(14):
        middle = 0.5 * (low + high)
        good = _are_in_workspace(robot, home + middle[:, None] * span, singularity, least)
        low, high = np.where(good, middle, low), np.where(good, high, middle)
    rows = [home + (part * low)[:, None] * span for part in (1.0, 0.8, 0.5)]
    found = np.concatenate([home[None], *rows])
    return np.asarray(found[_are_in_workspace(robot, found, singularity, least)], np.float64)


def _are_in_workspace(robot: Robot, poses: Array, singularity: float, least: Array) -> Mask:
    """Return which poses (k, m) are in the workspace."""
    q, known = try_inverse(robot, poses)
    inside = belong_to_workspace(robot, q, poses, known, singularity, -np.inf)
    if least.any():
        inside[inside] = (compute_levers(robot, q[inside]) >= least).all(-1)
    return inside


def _joint_rates(robot: Robot, q: Array) -> Array:
    """Return joint rates per velocity of the tool point at constant orientation, (k, n, size).

    For a machine that only rotates, per angular velocity of the platform, in platform axes.
    """
    if only_turns(robot):
        robot.check_independent("worst directions of a rotation")
        return np.asarray(np.linalg.inv(np.linalg.qr(_rotation_jacobian(robot, q))[1]), np.float64)
    return robot.inverse_jacobian(q)[..., _position_columns(robot)]


def _position_columns(robot: Robot) -> list[int]:
    return [i for i, name in enumerate(robot.pose_names) if name in ("x", "y", "z")]


def _rotation_jacobian(robot: Robot, q: Array) -> Array:
    return robot.platform_jacobian(q)[..., 3:, :]


def worst_over_workspace(
    robot: Robot,
    speed: float,
    acceleration: float,
    *,
    singularity: float = MIN_SINGULARITY_INDEX,
    lever: float = MIN_LEVER_RATIO,
    rays: int = DEFAULT_RAYS,
) -> Worst:
    """Find the drives' largest efforts and speeds, for the worst directions of the tool point.

    Speed and acceleration are those of the position; the orientation stays constant. The worst
    acceleration is exact; for the speed :data:`COARSE_DIRECTIONS` directions are tried at all
    poses, and :data:`FINE_DIRECTIONS` at the worst.

    :param speed: of the tool point, m/s; ``acceleration``: m/s2. Of a machine that only turns, of
        the platform's rotation, rad/s and rad/s2.
    :param singularity: least singularity index of a pose that counts, 0 to 1.
    :param lever: as of :func:`sample_workspace_poses`.
    :raises ParameterError: a workspace without bounds.
    """
    poses = sample_workspace_poses(robot, rays, singularity, lever)
    q = robot.inverse(poses)
    back = _joint_rates(robot, q)
    k, n = q.shape
    zero = np.zeros_like(q)
    holding = np.abs(inverse_dynamics(robot, q, zero, zero))

    def find_greatest(rows: Index | slice, directions: int) -> Array:
        found = _efforts_by_direction(robot, poses[rows], q[rows], back[rows], speed, acceleration, directions)
        return np.asarray(found.max(1), np.float64)

    greatest = find_greatest(slice(None), COARSE_DIRECTIONS)
    for joint in range(n):
        close = np.argsort(-greatest[:, joint])[:8]
        finer = find_greatest(close, FINE_DIRECTIONS)
        greatest[close] = np.maximum(greatest[close], finer)
    rates = speed * np.linalg.norm(back, axis=-1)

    def pick(values: Array) -> tuple[Array, Array]:
        best = values.argmax(0)
        return values[best, np.arange(n)], poses[best]

    return Worst(*pick(greatest), *pick(holding), *pick(rates), poses=k)


def _efforts_by_direction(
    robot: Robot, poses: Array, q: Array, back: Array, speed: float, acceleration: float, count: int
) -> Array:
    """Return the largest efforts by direction of the speed, (k, count + 1, n); the last is rest.

    :param back: joint rates per velocity of the position, shape (k, n, size), at ``poses`` and q.
    """
    size = back.shape[-1]
    if size == 1:
        ways = np.array([[1.0], [-1.0]])
    elif size == 2:
        angle = 2 * np.pi * np.arange(count) / count
        ways = np.stack([np.cos(angle), np.sin(angle)], -1)
    else:
        ways = sphere_directions(count)
    ways = np.concatenate([speed * ways, np.zeros((1, size))])
    if only_turns(robot):
        qd = np.einsum("knj,dj->kdn", back, ways)
        qs = np.broadcast_to(q[:, None], qd.shape)
        # Joint accelerations without angular acceleration, from differences of the Jacobian.
        step = 1e-4 / np.maximum(np.abs(qd).max(-1, keepdims=True), 1e-4)
        ahead, behind = (_rotation_jacobian(robot, qs + way * step * qd) for way in (1.0, -1.0))
        own = (ahead - behind) @ qd[..., None] / (2.0 * step[..., None])
        qdd = -(np.linalg.pinv(_rotation_jacobian(robot, qs)) @ own)[..., 0]
        base = inverse_dynamics(robot, qs, qd, qdd)
    else:
        rates = np.zeros((len(ways), poses.shape[-1]))
        rates[:, _position_columns(robot)] = ways
        base = inverse_dynamics_at_pose(robot, poses[:, None], rates, np.zeros_like(poses[0])).tau
    still = np.zeros_like(q)
    held = inverse_dynamics(robot, q, still, still)
    # Efforts by an acceleration along each axis of the position.
    rows = [inverse_dynamics(robot, q, still, back[..., i]) - held for i in range(size)]
    swing = acceleration * np.linalg.norm(np.stack(rows, -1), axis=-1)
    return np.asarray(np.abs(base) + swing[:, None], np.float64)
