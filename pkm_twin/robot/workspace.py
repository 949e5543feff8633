# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Find the reachable workspace of a machine, and the regular workspace of a height and two tilts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.codegen.arrays import Array, Mask, doubles, vectors
from pkm_twin.errors import ParameterError
from pkm_twin.robot.clearance import has_clearance, joint_clearance
from pkm_twin.robot.outline import Posture
from pkm_twin.robot.robot import Robot


def passive_values(robot: Robot, q: ArrayLike) -> Array:
    """Return the values that ``robot.passive_limits`` bound, shape (..., k), rad or m.

    :param q: joint positions, shape (..., n); errors as ``robot.forward``.
    """
    posture, values = Posture(robot, q), []
    turned, placed = posture.rotate_vector, posture.locate_point
    for limit in robot.passive_limits:
        axis = turned(limit.inner, limit.axis)
        if limit.kind == "slide":
            way = placed(limit.outer, limit.at) - placed(limit.inner, limit.at)
            values.append(limit.home + (way * axis).sum(-1))
            continue
        if limit.kind in ("swivel", "rod"):
            other = turned(limit.outer, limit.axis)
            if limit.far is not None:
                other = placed(limit.outer, limit.far) - placed(limit.inner, limit.at)
            sine = np.linalg.norm(np.cross(axis, other), axis=-1)
            values.append(np.arctan2(sine, (axis * other).sum(-1)))
            continue
        across = np.eye(3)[np.abs(limit.axis).argmin()]
        across = np.cross(limit.axis, across)
        one, other = turned(limit.inner, across), turned(limit.outer, across)
        sine = (np.cross(one, other) * axis).sum(-1)
        values.append(limit.home + np.arctan2(sine, (one * other).sum(-1)))
    return np.stack(values, -1)


RAYS_PER_CIRCLE: Final = 360
"""Rays of a circle about the axis."""
STEPS_PER_BLOCK: Final = 16
"""Steps along a ray that are tried at a time."""
MIN_WORKSPACE_INDEX: Final = 0.01
"""Smallest singularity index (0 singular, 1 best) in a regular workspace."""
MIN_TILT_RADIUS: Final = math.radians(10.0)
"""Radius, rad, below which a circle of tilts is left out (2UPR-RPU paper, section 4)."""
MIN_SAMPLED_INDEX: Final = 0.05
"""Smallest singularity index of random joint positions."""


def try_inverse(robot: Robot, pose: ArrayLike) -> tuple[Array, Mask]:
    """Return joint positions of poses, shape (..., n), and which poses are valid, shape (...).

    Invalid poses, also those that are not finite, get the joint positions at home.
    """
    q, good = robot.try_inverse(pose)
    return np.where(good[..., None], q, robot.graph.home), good


def try_forward(robot: Robot, q: ArrayLike) -> tuple[Array, Mask]:
    """Return poses of joint positions, shape (..., m), zero if invalid, and which are valid."""
    pose, good = robot.try_forward(q)
    return np.where(good[..., None], pose, 0.0), good


def singularity_of_pose(robot: Robot, pose: ArrayLike) -> Array:
    """Return ``Robot.singularity`` at poses, shape (...): 0 in a singularity or out of reach.

    :param pose: shape (..., m), m and rad.
    """
    q, good = try_inverse(robot, pose)
    measure = np.zeros(good.shape)
    measure[good], _ = robot.try_singularity(q[good])
    return measure


def has_passive_joint_limits(robot: Robot) -> bool:
    """Return whether the angles of passive joints are limited."""
    return robot.limit_angles(np.zeros(len(robot.pose_names))) is not None


def joint_angle_at(robot: Robot, pose: ArrayLike) -> Array:
    """Return the largest angle of a passive joint, rad, shape (...); NaN if a pose is out of reach.

    The angles are between a limb and the vertical, or the platform's normal (2UPR-RPU paper, equation
    40).

    :raises ParameterError: a machine whose passive joints have no such angles.
    """
    with np.errstate(all="ignore"):
        angles = robot.limit_angles(pose)
    if angles is None:
        raise ParameterError("limits", robot.name, "a machine with a bound on passive joint angles")
    _, good = robot.try_inverse(pose)
    return np.where(good, angles.max(-1), np.nan)


def within_limits(robot: Robot, q: ArrayLike) -> Mask:
    """Return whether joint positions are within the actuators' limits, shape (...); True without limits."""
    values, limits = doubles(q), robot.limits.position
    if limits is None:
        return np.ones(values.shape[:-1], bool)
    return np.asarray(((values >= limits[:, 0]) & (values <= limits[:, 1])).all(-1))


def reachable(robot: Robot, pose: ArrayLike, least_clearance: float = 0.0) -> Mask:
    """Return whether a pose is inside all joint limits and without limb interference, shape (...).

    Limits of limb lengths and passive joints: 2UPR-RPU paper, equation 40.
    A missing limit is no limit. A pose that is not finite raises an error.

    :param pose: shape (..., m), in the robot's pose coordinates, m and rad.
    :param least_clearance: least value of :func:`clearance`, m; -inf permits limb interference. It
        has no effect for a robot whose clearance is not known.
    """
    poses = vectors(pose, len(robot.pose_names), "the pose")
    q, inside = try_inverse(robot, poses)
    return inside & satisfies_limits(robot, q, poses, least_clearance, inside)


def satisfies_limits(
    robot: Robot, q: Array, pose: Array, least_clearance: float = 0.0, known: Mask | bool = True
) -> Mask:
    """Return whether joint positions are within all limits without limb interference, shape (...).

    :param q: shape (..., n); ``pose``: the poses of q, shape (..., m).
    :param least_clearance: as in :func:`reachable`.
    :param known: where there is an assembly; elsewhere the result is False.
    """
    inside = np.array(within_limits(robot, q) & known)
    bound = getattr(robot.limits, "joint_angle", None)
    if bound is not None and has_passive_joint_limits(robot):
        # A pose out of reach has NaN, which is outside by the comparison.
        inside &= joint_angle_at(robot, pose) <= bound
    if robot.passive_limits:
        values = passive_values(robot, q[inside])
        low, high = np.array([[one.low, one.high] for one in robot.passive_limits]).T
        inside[inside] = ((values >= low) & (values <= high)).all(-1)
    if has_clearance(robot) and least_clearance > -math.inf:
        # The most expensive test, so only where all others hold.
        inside[inside] = joint_clearance(robot, q[inside], refuse=False) > least_clearance
    return inside


def belong_to_workspace(robot: Robot, q: Array, pose: Array, known: Mask, least: float, least_clearance: float) -> Mask:
    """Return which joint positions (k, n) and poses (k, m) belong to a workspace, shape (k,).

    :param known: where there is an assembly.
    :param least: singularity index, and ``least_clearance``: clearance (m), that are too little.
    """
    inside = satisfies_limits(robot, q, pose, least_clearance, known)
    inside[inside] = robot.try_singularity(q[inside])[0] >= least
    return inside


def workspace_radius_unit(robot: Robot) -> str:
    """Return the unit of the workspace cylinder's radius, which is in pose coordinates: ``m`` or ``rad``."""
    return robot.pose_units[robot.pose_names.index(robot.grid().lateral[0])]


@dataclass(frozen=True, eq=False)
class RegularWorkspace:
    """Stacked circles about the axis of zero tilt: heights z (n,), m, radii (n,), rad."""

    z: Array
    radius: Array


def regular_workspace(
    robot: Robot,
    z: ArrayLike,
    least_radius: float = MIN_TILT_RADIUS,
    directions: int = 360,
    step: float = math.radians(0.25),
) -> RegularWorkspace:
    """Find the largest circle of reachable tilts about the axis at each height.

    The singularity index stays above ``MIN_WORKSPACE_INDEX``. Heights whose circle is smaller than ``least_radius``
    are left out (2UPR-RPU paper, section 4).

    :param z: heights, shape (n,), m.
    :param least_radius: rad.
    :param directions: rays a circle.
    :param step: first search along a ray, rad; a bisection refines it to 1e-9 rad.
    """
    grid = robot.grid()
    if grid.kind == "box" or grid.zero_torsion or workspace_radius_unit(robot) != "rad":
        raise ParameterError("mechanism", robot.mechanism, "a height and two tilts side by side (as upr_rpu)")
    heights = np.atleast_1d(doubles(z, "heights"))
    steps = math.ceil(math.pi / 2 / step) - 1
    radius = compute_circle_radii(robot, heights, step, steps, directions)
    kept = (radius >= least_radius) & (radius > 0.0)
    return RegularWorkspace(heights[kept], radius[kept])


def compute_circle_radii(
    robot: Robot,
    heights: Array,
    step: float,
    steps: int,
    rays: int = RAYS_PER_CIRCLE,
    least: float = MIN_WORKSPACE_INDEX,
    least_clearance: float = 0.0,
) -> Array:
    """Find the radii of the largest circles about the axis whose interior is reachable, (n,), m or rad.

    A radius is 0 if the axis itself is out of reach.

    :param heights: shape (n,), m.
    :param step: first search along each ray, ``steps`` of them; a bisection refines it.
    :param least: singularity measure below which a pose counts as out of reach.
    :param least_clearance: clearance of the limbs below which a pose counts as out of reach, m.
    :raises ValueError: the robot's poses have no axis.
    """
    grid = robot.grid()
    turn = np.asarray(np.arange(rays) * (2 * np.pi / rays), np.float64)

    def outside(height: Array, distance: Array, azimuth: Array) -> Mask:
        poses = grid.polar_pose(height, distance, azimuth)
        kept = reachable(robot, poses, least_clearance)
        kept[kept] = singularity_of_pose(robot, poses[kept]) >= least
        return ~kept

    exit_step, left = np.zeros(len(heights), np.int64), np.zeros((len(heights), rays), bool)
    # About 65536 poses at a time.
    at_once = max(1, 2**16 // (STEPS_PER_BLOCK * rays))
    for start in range(0, len(heights), at_once):
        part = slice(start, start + at_once)
        exit_step[part], left[part] = _find_first_exit(outside, heights[part], turn, step, steps)
    low, high = step * np.maximum(exit_step - 1, 0), step * exit_step
    # Only the shortest rays of a height matter, so drop longer ones.
    row, ray = np.nonzero(left & (exit_step > 0)[:, None])
    ends = np.isin(np.arange(len(heights)), row)
    for _ in range(32):
        middle = (low + high) / 2
        gone = outside(heights[row], middle[row], turn[ray])
        nearer = np.isin(np.arange(len(heights)), row[gone])
        low, high = np.where(nearer, low, middle), np.where(nearer, middle, high)
        kept = gone | ~nearer[row]
        row, ray = row[kept], ray[kept]
    return np.where(ends, low, step * exit_step)


def _find_first_exit(
    outside: Callable[[Array, Array, Array], Mask], heights: Array, turn: Array, step: float, steps: int
) -> tuple[NDArray[np.int64], Mask]:
    """Search outward in equal steps for the first step at which any ray leaves the workspace.

    :returns: number of the step, shape (n,), the last one if no ray leaves; and which rays leave
        there, shape (n, rays).
    """
    exit_step = np.zeros(len(heights), np.int64)
    left = outside(heights[:, None], np.zeros(1), turn)
    inner = np.flatnonzero(~left.any(-1))
    for start in range(1, steps + 1, STEPS_PER_BLOCK):
        if not len(inner):
            break
        block = np.arange(start, min(start + STEPS_PER_BLOCK, steps + 1))
        gone = outside(heights[inner, None, None], np.multiply(step, block)[:, None], turn)
        hit = gone.any(-1)
        ended = hit.any(-1)
        first = np.where(ended, hit.argmax(-1), len(block) - 1)
        exit_step[inner], left[inner] = block[first], gone[np.arange(len(inner)), first]
        inner = inner[~ended]
    return exit_step, left


def describe_singularity_bound(index: float, bound: str = "--singularity ") -> str:
    """Return a bound's name with a value that a singularity index passes: the index, rounded down."""
    if not index > 0.0:
        return f"{bound}0"
    digits = 1 - math.floor(math.log10(index))
    return f"{bound}{math.floor(index * 10**digits) / 10**digits:g}"


def describe_causes(robot: Robot, q: Array, pose: Array, known: Mask, least: float, least_clearance: float) -> str:
    """Describe why joint positions (k, n) are outside a workspace, the most frequent first.

    Each is counted for the first of these that it fails: assembly, actuator limits, limits of
    passive joints, singularity index, clearance.

    :param pose: of the joint positions, shape (k, m); ``known``: where there is one, shape (k,).
    :param least: singularity index, and ``least_clearance``: clearance (m), that are too little.
    """
    left, found = np.array(known), {"no assembly": ~known}

    def count_failures(what: str, kept: Mask) -> None:
        nonlocal left
        found[what] = left & ~kept
        left = left & kept

    count_failures("an actuator beyond its limits", within_limits(robot, q))
    count_failures("a passive joint beyond its limits", satisfies_limits(robot, q, pose, -math.inf, left))
    index = robot.try_singularity(q)[0]
    best = float(index[left].max(initial=0.0))
    hint = f" (best: {best:.3g}; {describe_singularity_bound(best)} passes)" if best < least else ""
    count_failures(f"a singularity index below {least:g}{hint}", index >= least)
    if has_clearance(robot):
        gap = joint_clearance(robot, q, refuse=False)
        home = float(joint_clearance(robot, robot.graph.home))
        what = "limbs interfere" if least_clearance == 0.0 else f"limbs within {least_clearance:g} m"
        count_failures(f"{what} (clearance {home:.3g} m at home)", np.asarray(gap > least_clearance))
    shares = {what: 100.0 * float(out.mean()) for what, out in found.items()}
    ranked = sorted(shares.items(), key=lambda item: -item[1])
    texts = [f"{what} in {share:.3g} %" for what, share in ranked if share >= 0.1]
    return f"{', '.join(texts)} of the joint states tried"


def position_range(robot: Robot) -> tuple[Array, Array]:
    """Return middle and half width of the joints' limits, or of a range about home, shape (n,) each."""
    home, size = robot.graph.home, robot.engine.tree.size
    half = np.array([0.15 * size if unit == "m" else 0.3 for unit in robot.joint_units])
    low, high = home - half, home + half
    if robot.limits.position is not None:
        given = np.isfinite(robot.limits.position)
        low = np.where(given[:, 0], robot.limits.position[:, 0], low)
        high = np.where(given[:, 1], robot.limits.position[:, 1], high)
    return (low + high) / 2, (high - low) / 2


def random_joints(robot: Robot, rng: np.random.Generator, count: int) -> Array:
    """Draw joint positions clear of singularities and within the limits, shape (count, n)."""
    home, (middle, reach) = robot.graph.home, position_range(robot)
    low, high = middle - reach, middle + reach
    kept, share = np.empty((0, len(home))), 1.0
    # A machine with a large transmission ratio has a small index everywhere.
    least = min(MIN_SAMPLED_INDEX, 0.5 * float(robot.singularity(home)))
    while len(kept) < count:
        drawn = rng.uniform(middle - share * reach, middle + share * reach, (2 * count, len(home)))
        drawn = robot.try_project_redundant(drawn)
        measure, good = robot.try_singularity(drawn)
        good = good & (measure > least) & ((low <= drawn) & (drawn <= high)).all(-1)
        kept = np.concatenate([kept, drawn[good]])
        if good.mean() < 0.05:
            # Few joint positions have an assembly; nearer to home there are more.
            middle, share = (middle + home) / 2, 0.7 * share
    return kept[:count]
