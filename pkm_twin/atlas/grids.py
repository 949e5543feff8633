# SPDX-License-Identifier: Apache-2.0
"""Poses in cylinder coordinates about a machine's axis, and where the machine reaches.

Height and a polar place around it: for the Delta the horizontal distance and its azimuth (m,
rad), for machines that tilt the tilt and its azimuth (rad, rad). For the 3-PRRU those are
tilt-and-torsion angles with zero torsion, for the 2UPR-RPU the plane of beta and gamma.

May import: numpy, pkm_twin's core and the two packages above it; never rclpy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from delta_dynamics.isotropy import tilted_pose
from pkm_twin.codegen.kernels import OK
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.workspace import reachable
from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]

RAYS: Final = 360
REFINEMENTS: Final = 32
BLOCK: Final = 16


def polar_pose(robot: Robot, height: ArrayLike, distance: ArrayLike, azimuth: ArrayLike) -> Array:
    """Poses of cylinder coordinates, shape (..., 3).

    :param height: m, shape (...).
    :param distance: from the axis: m for a machine that translates, rad for one that tilts.
    :param azimuth: rad.
    """
    if robot.mechanism == "prru":
        return tilted_pose(height, azimuth, distance)
    z, r, a = np.broadcast_arrays(*(np.asarray(v, np.float64) for v in (height, distance, azimuth)))
    first, second = r * np.cos(a), r * np.sin(a)
    parts = [first, second, z] if tilts(robot) == 0 else [z, first, second]
    return np.stack(parts, -1)


def tilts(robot: Robot) -> int:
    """How many of the pose's parameters are angles: 0 or 2."""
    return robot.pose_units.count("rad")


def distance_unit(robot: Robot) -> str:
    """Unit of the distance from the axis, ``m`` or ``rad``."""
    return "rad" if tilts(robot) else "m"


def turns(count: int) -> Array:
    """Angles all around, evenly spaced from 0, shape (count,), rad."""
    return ladder(2 * np.pi / count, count)


def ladder(step: float, count: int) -> Array:
    """Multiples of a step from 0, shape (count,)."""
    return np.asarray(step * np.arange(count), np.float64)


def nice(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above a value."""
    power = 10.0 ** math.floor(math.log10(value) + 1e-12)
    return power * max(k for k in (1, 2, 5) if k * power <= value * (1 + 1e-12))


def size(robot: Robot) -> float:
    """Longest reach, m: above it no platform can be."""
    g = getattr(robot, "geometry")  # noqa: B009
    limits = getattr(getattr(robot, "limits", None), "position", None)
    if robot.mechanism == "delta":
        return float(g.arm_length + g.forearm_length)
    if limits is None:
        raise ParameterError(
            "limits", robot.name, "limits of the actuators: without them the workspace has no end"
        )
    extra = g.limb_length if robot.mechanism == "prru" else 0.0
    return float(np.abs(limits).max() + extra)


def height_range(robot: Robot) -> tuple[float, float]:
    """Heights outside of which nothing is reachable, m."""
    far = size(robot)
    return (-far, far) if robot.mechanism == "prru" else (-far, 0.0)


def largest_distance(robot: Robot) -> float:
    """Distance from the axis beyond which nothing is looked for, m or rad."""
    if tilts(robot):
        return math.radians(85.0)
    return size(robot)


def singularity(robot: Robot, pose: ArrayLike) -> Array:
    """``Robot.singularity`` at poses: 0 in a singularity or out of reach, 1 at best, shape (...).

    :param pose: shape (..., 3), m and rad.
    """
    q, fault = robot.inverse_kernel(robot.parameters, pose)
    good = fault[..., 0] == OK
    # Refused poses are empty memory.
    q = np.where(good[..., None], q, 0.0)
    _, _, fault = robot.jacobian_kernel(robot.parameters, q)
    good &= fault[..., 0] == OK
    measure = np.zeros(good.shape)
    measure[good] = robot.singularity(q[good])
    return measure


@dataclass(frozen=True, eq=False)
class Reach:
    """Largest reachable circles about the axis: heights z (n,), m, radii (n,), m or rad.

    Radius 0 where the axis itself is out of reach.
    """

    z: Array
    radius: Array


def circles(
    robot: Robot,
    heights: ArrayLike,
    steps: int = 340,
    least: float = 0.0,
    least_clearance: float = 0.0,
) -> Reach:
    """The largest circle about the axis at each height that is reachable with all its inside.

    :param heights: shape (n,), m.
    :param steps: first search along each of 360 rays; a bisection refines it.
    :param least: singularity measure below which a pose counts as out of reach.
    :param least_clearance: what the limbs' clearance has to be above, m.
    """
    z = np.atleast_1d(np.asarray(heights, np.float64))
    turn = turns(RAYS)
    step = largest_distance(robot) / steps
    radius = np.zeros(len(z))

    def inside(height: float, distance: Array, azimuth: Array) -> NDArray[np.bool_]:
        poses = polar_pose(robot, height, distance, azimuth)
        kept = reachable(robot, poses, least_clearance)
        if least > 0.0:
            kept &= singularity(robot, poses) >= least
        return kept

    for k, height in enumerate(z.tolist()):
        # The first rung that any ray leaves bounds the circle; what is beyond does not matter.
        rung, out = 0, ~inside(height, np.zeros(1), turn)
        while not out.any() and rung < steps:
            block = np.arange(rung + 1, min(rung + BLOCK, steps) + 1)
            outside = ~inside(height, np.multiply(step, block)[:, None], turn)
            hit = outside.any(-1)
            first = int(hit.argmax()) if hit.any() else len(block) - 1
            rung, out = int(block[first]), outside[first]
        if not out.any() or rung == 0:
            radius[k] = step * rung
            continue
        rays = turn[out]
        low, high = np.full(len(rays), step * (rung - 1)), np.full(len(rays), step * rung)
        for _ in range(REFINEMENTS):
            middle = (low + high) / 2
            good = inside(height, middle, rays)
            low, high = np.where(good, middle, low), np.where(good, high, middle)
        radius[k] = low.min()
    return Reach(z, radius)


@dataclass(frozen=True)
class Cylinder:
    """The largest upright cylinder about the axis in a stack of circles, m (radius m or rad)."""

    low: float
    high: float
    radius: float


def largest_cylinder(reach: Reach) -> Cylinder:
    """The cylinder of greatest radius squared times height between two of the heights."""
    best, volume = Cylinder(math.nan, math.nan, 0.0), 0.0
    for i in range(len(reach.z)):
        thin = np.minimum.accumulate(reach.radius[i:])
        volumes = thin**2 * (reach.z[i:] - reach.z[i])
        j = int(volumes.argmax())
        if volumes[j] > volume:
            volume = float(volumes[j])
            best = Cylinder(float(reach.z[i]), float(reach.z[i + j]), float(thin[j]))
    return best
