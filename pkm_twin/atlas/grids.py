# SPDX-License-Identifier: Apache-2.0
"""Where a machine reaches: the box of all its poses, and the circles about its axis.

A robot tells how its poses are laid out (``robot.grid()``) and where they end
(``robot.search_box()``); nothing here knows a mechanism.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.errors import ParameterError
from pkm_twin.machine.pose_grid import PoseGrid
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import (
    CLEAR,
    circle_radii,
    reachable,
    try_forward,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

JOINT_STATES: Final = 2**14
"""Joint states, evenly spread between the limits, whose poses bound a workspace."""
CLIMBERS: Final = 32
"""States from which the ends of a workspace of many coordinates are looked for."""
COARSE: Final = 33
"""Poses along each coordinate of the grid that bounds a workspace."""
FULL: Final = 3
"""Most pose coordinates of which a whole grid is made."""


def cylinder(robot: Robot, what: str) -> PoseGrid:
    """The robot's layout, which has to be one about an axis.

    :param what: what needs the axis, for the error.
    :raises ParameterError: the poses lie in a box.
    """
    grid = robot.grid()
    if grid.kind != "cylinder":
        raise ParameterError(
            "robot", robot.name, f"a robot whose poses lie about an axis for {what}"
        )
    return grid


def height_range(robot: Robot) -> tuple[float, float]:
    """Heights outside of which nothing is reachable, m."""
    low, high = robot.search_box()[robot.pose_names.index(robot.grid().height)]
    return float(low), float(high)


def largest_distance(robot: Robot) -> float:
    """Distance from the axis beyond which nothing is looked for, m or rad."""
    lateral = [robot.pose_names.index(name) for name in robot.grid().lateral]
    return float(np.abs(robot.search_box()[lateral]).max())


def workspace_box(robot: Robot) -> Array:
    """Bounds of all reachable poses, limb interference aside, a little wider; shape (m, 2).

    From poses of joint states all over the limits and, for few coordinates, from a grid of poses.
    Lateral coordinates of a cylinder are bounded alike on both sides of the axis.

    :raises ParameterError: nothing bounds the workspace, or it is empty.
    """
    return _once(robot, "box", lambda: _workspace_box(robot)).copy()


def _once(robot: Robot, key: Hashable, make: Callable[[], Array]) -> Array:
    """What maps of one robot ask for again and again, computed once a robot."""
    kept: dict[Hashable, Array] = robot.calls.setdefault("workspace", {})
    if key not in kept:
        kept[key] = make()
    return kept[key]


def _workspace_box(robot: Robot) -> Array:
    bounds = np.asarray(robot.search_box(), np.float64)
    # With what interference takes away, which atlases show.
    found = _from_joints(robot)
    grid = robot.grid()
    lateral = [robot.pose_names.index(name) for name in grid.lateral]
    box = bounds
    if len(bounds) > FULL:
        if len(found):
            box = _around(found, 0.1 * np.ptp(found, axis=0), bounds)
        return box
    # Twice: a machine may reach a small part of what its lengths allow.
    for _ in range(2):
        ticks = [np.linspace(low, high, COARSE) for low, high in box]
        poses = np.stack(np.meshgrid(*ticks, indexing="ij"), -1).reshape(-1, len(ticks))
        seen = np.concatenate([found, poses[reachable(robot, poses, -math.inf)]])
        if not len(seen):
            raise ParameterError("limits", robot.name, "limits that leave a workspace")
        box = _around(seen, np.ptp(box, axis=1) / (COARSE - 1), bounds)
        if lateral:
            # The axis stays in the middle, and on the grid: workspaces end in tips there.
            half = np.abs(box[lateral]).max(1)
            box[lateral] = np.stack([-half, half], -1)
    return box


def _around(poses: Array, margin: Array, bounds: Array) -> Array:
    low, high = poses.min(0) - margin, poses.max(0) + margin
    return np.stack([np.maximum(low, bounds[:, 0]), np.minimum(high, bounds[:, 1])], -1)


def _from_joints(robot: Robot) -> Array:
    """Reachable poses of joint states between the limits, shape (k, m); none without limits."""
    limits = robot.limits.position
    count = len(robot.joint_names)
    if limits is None or not np.isfinite(limits).all():
        return np.empty((0, len(robot.pose_names)))
    # Not above: every process of a sweep would load it, which takes longer than many sweeps.
    from scipy.stats import qmc  # type: ignore[import-untyped]

    # Extremes are mostly where joints are at a limit or in the middle.
    corners = np.stack(np.meshgrid(*[[0.0, 0.5, 1.0]] * count, indexing="ij"), -1)
    inner = qmc.Halton(count, scramble=False).random(JOINT_STATES)
    share = np.concatenate([corners.reshape(-1, count), inner])
    q = limits[:, 0] + share * np.ptp(limits, axis=1)
    poses, good = try_forward(robot, q)
    good[good] = reachable(robot, poses[good], -math.inf)
    poses, q = poses[good], q[good]
    if len(robot.pose_names) > FULL and len(q):
        # States so few are far apart where joints are many.
        ends = [
            _farthest(robot, limits, q[np.argsort(-sign * poses[:, k])[:CLIMBERS]], k, sign)
            for k in range(poses.shape[1])
            for sign in (-1.0, 1.0)
        ]
        poses = np.concatenate([poses, *ends])
    return poses


def _farthest(robot: Robot, limits: Array, q: Array, k: int, sign: float) -> Array:
    """Poses uphill of joint states (c, n) in pose coordinate k times a sign.

    :param limits: of the joints, shape (n, 2).
    """
    low, high = limits.T
    best, _ = try_forward(robot, q)
    for step in np.repeat(0.5 ** np.arange(1, 9), 3):
        rates, known = robot.try_jacobian(q)
        uphill = np.where(known[:, None], sign * np.sign(rates[:, k]), 0.0)
        tried = np.clip(q + step * (high - low) * uphill, low, high)
        poses, good = try_forward(robot, tried)
        good[good] = reachable(robot, poses[good], -math.inf)
        good &= sign * (poses[:, k] - best[:, k]) > 0.0
        q, best = np.where(good[:, None], tried, q), np.where(good[:, None], poses, best)
    return best


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
    :param least: singularity measure below which a pose counts as out of reach; ``CLEAR`` at least.
    :param least_clearance: what the limbs' clearance has to be above, m.
    """
    z = np.atleast_1d(np.asarray(heights, np.float64))
    cylinder(robot, "circles about it")
    least, step = max(least, CLEAR), largest_distance(robot) / steps
    radius = _once(
        robot,
        (z.tobytes(), steps, least, least_clearance),
        lambda: circle_radii(robot, z, step, steps, least=least, least_clearance=least_clearance),
    )
    return Reach(z, radius.copy())


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
