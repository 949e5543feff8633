# SPDX-License-Identifier: Apache-2.0
"""Reachable workspace of a machine, and the regular one of a height and two tilts.

May import: numpy, pkm_twin's core, the standard library; never rclpy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.codegen.kernels import OK, Kernel
from pkm_twin.errors import ParameterError
from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]


def clearance(robot: Robot, pose: ArrayLike) -> Array:
    """Least distance between the surfaces of members of different limbs, shape (...), m.

    Members are round bars between their joints, of the outer diameters in the robot's file:
    the bars of the 2UPR-RPU, the limbs of the 3-PRRU, arms and rods of a Delta. Zero where two
    touch; below zero they are in each other, by the axes' distance less the radii. Of platform,
    base, drives and joints the files tell no shape, so they are not counted.

    :param pose: shape (..., 3), in the robot's pose parameters.
    :raises ParameterError: the file does not tell the members' diameters.
    :raises UnreachableError: a pose that is none of the mechanism's, by limb, sample and miss.
    :raises SingularityError: a pose where the mechanism is singular.
    :raises ValueError: a pose that is not finite.
    """
    kernel = _clearance_kernel(robot)
    if kernel is None:
        raise ParameterError("members", None, "a section that gives the members' outer diameters")
    poses = np.asarray(pose, np.float64)
    gap, fault = kernel(robot.parameters, poses, robot.inverse(poses))
    robot.raise_fault(fault, "pose")
    return np.asarray(gap[..., 0])


def has_clearance(robot: Robot) -> bool:
    """Whether :func:`clearance` is known: the robot's file tells the members' diameters."""
    return _clearance_kernel(robot) is not None


def _clearance_kernel(robot: Robot) -> Kernel | None:
    return None if robot.radii is None else robot.clearance_kernel


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
    p = robot.parameters
    q, fault = robot.inverse_kernel(p, poses)
    inside = fault[..., 0] == OK
    # Lengths of refused poses are empty memory.
    q = np.where(inside[..., None], q, 0.0)
    back, fault = robot.forward_kernel(p, q)
    scale = 1e-6 * (1.0 + np.abs(poses))
    inside &= fault[..., 0] == OK
    inside &= (np.abs(np.where(inside[..., None], back, np.inf) - poses) < scale).all(-1)
    limits: Any = getattr(robot, "limits", None)
    if limits is not None and limits.position is not None:
        low, high = limits.position[:, 0], limits.position[:, 1]
        inside &= ((q >= low) & (q <= high)).all(-1)
    bound = getattr(limits, "joint_angle", None)
    if bound is not None and robot.angles_kernel is not None:
        angles, fault = robot.angles_kernel(p, poses)
        inside &= (fault[..., 0] == OK) & (np.where(inside[..., None], angles, 0.0) <= bound).all(
            -1
        )
    kernel = _clearance_kernel(robot)
    if kernel is not None and least_clearance > -math.inf:
        # The dearest test, so only where all others hold.
        inside = np.asarray(inside)
        gap, fault = kernel(p, poses[inside], q[inside])
        inside[inside] = (fault[:, 0] == OK) & (gap[:, 0] > least_clearance)
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
    if robot.angles_kernel is None:
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
