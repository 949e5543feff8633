# SPDX-License-Identifier: Apache-2.0
"""Reachable workspace of a machine, and the regular one of a height and two tilts.

May import: numpy, pkm_twin's core, the standard library; never rclpy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.clearance import has_clearance, joint_clearance
from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]


def reachable(robot: Robot, pose: ArrayLike, least_clearance: float = 0.0) -> NDArray[np.bool_]:
    """Whether poses keep the limits of actuators and passive joints and limbs apart, shape (...).

    A passive joint's angle is that between its limb and the vertical, and between its limb and
    the platform's normal (2UPR-RPU paper, equation 40). A pose also has to be on the branch that
    ``forward`` gives. Limits that are absent hold everywhere; a pose that is not finite raises.

    :param pose: shape (..., 3), in the robot's pose parameters, m and rad.
    :param least_clearance: what :func:`clearance` has to be above, m; -inf lets limbs meet. It
        bounds no robot whose clearance is not known.
    """
    poses = np.asarray(pose, np.float64)
    if not np.isfinite(poses).all():
        raise ValueError("a pose is not finite")
    q, inside = robot.try_inverse(poses)
    back, found = robot.try_forward(np.where(inside[..., None], q, 0.0))
    scale = 1e-6 * (1.0 + np.abs(poses))
    inside &= found
    inside &= (np.abs(np.where(inside[..., None], back, np.inf) - poses) < scale).all(-1)
    limits = robot.limits.position
    if limits is not None:
        with np.errstate(invalid="ignore"):
            inside &= ((q >= limits[:, 0]) & (q <= limits[:, 1])).all(-1)
    bound = getattr(robot.limits, "joint_angle", None)
    angles = None if bound is None else robot.limit_angles(poses)
    if bound is not None and angles is not None:
        with np.errstate(invalid="ignore"):
            inside &= (angles <= bound).all(-1)
    if has_clearance(robot) and least_clearance > -math.inf:
        # The dearest test, so only where all others hold.
        inside = np.asarray(inside)
        gap = joint_clearance(robot, q[inside], refuse=False)
        inside[inside] = gap > least_clearance
    return np.asarray(inside)


@dataclass(frozen=True, eq=False)
class RegularWorkspace:
    """Stacked circles about the axis of zero tilt: heights z (n,), m, radii (n,), rad."""

    z: Array
    radius: Array

    def polar_samples(self, step: float = math.radians(1.0), azimuths: int = 72) -> Array:
        """Poses on rays from the axis, shape (m, 3): denser towards the axis.

        The source's global factors (equation 39: a mean over N points) come out with these points.

        :param step: distance of neighbouring points on a ray, rad.
        :param azimuths: rays a circle; the axis itself stands once a ray.
        """
        turn = np.arange(azimuths) * (2 * np.pi / azimuths)
        layers = []
        for z, radius in zip(self.z.tolist(), self.radius.tolist(), strict=True):
            rungs = step * np.arange(_count(radius, step) + 1)[:, None]
            first, second = rungs * np.cos(turn), rungs * np.sin(turn)
            layers.append(_layer(z, first.ravel(), second.ravel()))
        return np.concatenate(layers) if layers else np.empty((0, 3))

    def even_samples(self, step: float = math.radians(1.0)) -> Array:
        """Poses on a square grid of tilts, shape (m, 3): a mean over the volume.

        :param step: distance of neighbouring tilts, rad.
        """
        layers = []
        for z, radius in zip(self.z.tolist(), self.radius.tolist(), strict=True):
            n = _count(radius, step)
            ticks = step * np.arange(-n, n + 1)
            first, second = (t.ravel() for t in np.meshgrid(ticks, ticks, indexing="ij"))
            inside = first**2 + second**2 <= radius**2 * (1 + 1e-12)
            layers.append(_layer(z, first[inside], second[inside]))
        return np.concatenate(layers) if layers else np.empty((0, 3))


def _count(radius: float, step: float) -> int:
    if not step > 0.0:
        raise ValueError(f"step is {step}; it has to be above zero")
    return math.floor(radius / step * (1 + 1e-12))


def _layer(z: float, first: Array, second: Array) -> Array:
    return np.column_stack((np.full(len(first), z), first, second))


def regular_workspace(
    robot: Robot,
    z: ArrayLike,
    least_radius: float = math.radians(10.0),
    directions: int = 360,
    step: float = math.radians(0.25),
) -> RegularWorkspace:
    """Largest circle of reachable tilts about the axis at each height.

    2UPR-RPU paper, section 4: heights whose circle is smaller than ``least_radius`` are left out.

    :param z: heights, shape (n,), m.
    :param directions: rays a circle.
    :param step: first search along a ray, rad; a bisection refines it to 1e-9 rad.
    """
    if robot.limit_angles(np.zeros(len(robot.pose_names))) is None:
        raise ParameterError("mechanism", robot.mechanism, "a mechanism with two tilts (upr_rpu)")
    heights = np.atleast_1d(np.asarray(z, np.float64))
    turn = np.arange(directions) * (2 * np.pi / directions)
    rays = np.column_stack((np.cos(turn), np.sin(turn)))
    ladder = np.arange(0.0, math.pi / 2, step)

    def inside(radius: Array) -> NDArray[np.bool_]:
        """Of radii (n, directions, ...), whether those points are reachable."""
        extra = radius.ndim - 2
        poses = np.empty((*radius.shape, 3))
        poses[..., 0] = heights.reshape(-1, *[1] * (extra + 1))
        poses[..., 1:] = radius[..., None] * rays.reshape(1, directions, *[1] * extra, 2)
        return reachable(robot, poses)

    grid = np.broadcast_to(ladder, (len(heights), directions, len(ladder)))
    outside = ~inside(grid)
    first = np.where(outside.any(-1), outside.argmax(-1), len(ladder))
    low = step * np.maximum(first - 1, 0)
    high = step * first
    for _ in range(32):
        middle = (low + high) / 2
        good = inside(middle)
        low, high = np.where(good, middle, low), np.where(good, high, middle)
    radius = low.min(-1)
    kept = (radius >= least_radius) & (radius > 0.0)
    return RegularWorkspace(heights[kept], radius[kept])
