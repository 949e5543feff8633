# SPDX-License-Identifier: Apache-2.0
"""The shortest motion along a path within the limits of drives, joints and tool."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from delta_dynamics import inverse_dynamics
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.paths.constraints import Forces, Limits, Rows, check_rest, shares
from pkm_twin.paths.geometry import Path, through
from pkm_twin.paths.jerk import smooth_profile, smooth_run
from pkm_twin.paths.joint_path import JointPath, Slowdown, joint_paths
from pkm_twin.paths.laws import LAWS, Law, quintic, shortest
from pkm_twin.paths.motion import Run, Timed, TimedPath, needs_forces
from pkm_twin.paths.profile import fastest_profile
from pkm_twin.robot.robot import Robot

POINTS: Final = 1000
"""Points of a path."""
JERK_POINTS: Final = 400
"""The same where jerks are limited: each is a variable of linear programs."""
SINGULARITY: Final = 0.01
"""Least singularity index of a path, by default the nodes' ``singularity_stop``."""
KEPT: Final = 1e-4
"""Part of each limit that the points of a path leave to what is between them."""
LOOKED: Final = np.array([1e-6, 0.25, 0.5, 0.75, 1.0 - 1e-6])
"""Parts of each interval of time at which limits are checked."""
SMALL: Final = 3e-4
"""Part of a limit passed between the points that slowing the whole down makes good."""
ROUNDING: Final = 1e-12
ROUNDS: Final = 4
"""How often limits are tightened where they are passed between the points."""


def fastest(
    robot: Robot,
    path: Path | ArrayLike,
    *,
    effort: ArrayLike | None = None,
    velocity: ArrayLike | None = None,
    acceleration: ArrayLike | None = None,
    jerk: ArrayLike | None = None,
    speed: float | None = None,
    share: float = 1.0,
    singularity: float = SINGULARITY,
    wrench: ArrayLike | None = None,
    points: int = POINTS,
    slowdown: Slowdown | None = None,
) -> TimedPath:
    """The shortest motion along a path, at rest at its ends, by the exact inverse dynamics.

    The points of the path keep limits that are smaller by :data:`KEPT`, so that the limits
    themselves hold between the points too, which is checked with the inverse dynamics.

    :param robot: with the payload that it carries, ``robot.changed(payload=...)``.
    :param path: of ``paths.through``, ``lines``, ``cycle`` or ``circle``; or poses (k, m), through
        which the path passes smoothly without a stop.
    :param effort: greatest efforts, (n,) or one for all, N m or N; default the robot file's.
    :param velocity: largest velocities of the joints, rad/s or m/s; default the robot file's.
    :param acceleration: of the joints, rad/s2 or m/s2; default no limit.
    :param jerk: of the joints, rad/s3 or m/s3; default no limit.
    :param speed: of the platform's reference point, m/s; default no limit.
    :param share: fraction of the robot file's efforts and velocities to use.
    :param singularity: least singularity index on the path, 0 to 1.
    :param wrench: constant external wrench on the platform, (6,), base axes.
    :param points: of the path, about; with a limit of jerk at most :data:`JERK_POINTS`.
    :param slowdown: divides ``speed`` at points of the path, by their joint positions (p, n) and
        the direction (p, 3) of the reference point, base axes: returns 1 or more, (p,).
    :returns: the motion: ``.times``, ``.q``, ``.qd``, ``.qdd``, ``.effort`` and ``.pose`` at its
        points, the same of ``.uniform(rate)`` and ``.sample(times)``; ``.bounds``, which limit
        binds when; ``.duration``, s.
    :raises ParameterError: with the position: a pose out of reach, beyond a joint's limit or close
        to a singularity, or a drive that cannot hold the machine; or no limit bounds the speed.
    """
    made = path if isinstance(path, Path) else through(robot, path)
    limits = Limits.of(
        robot, effort=effort, velocity=velocity, acceleration=acceleration, jerk=jerk,
        speed=speed, share=share,
    )  # fmt: skip
    limits.check()
    load = None if wrench is None else np.asarray(wrench, float)
    if np.isfinite(limits.jerk).any():
        points = min(points, JERK_POINTS)
    runs, begin = [], 0.0
    for part, stretch in zip(
        joint_paths(robot, made, points, singularity, slowdown), made.stretches, strict=True
    ):
        runs.append(_run(robot, part, limits, load, begin))
        begin += stretch.length
    rests = (made.wait, *(stretch.dwell for stretch in made.stretches))
    return TimedPath(robot, made, limits, tuple(runs), rests, "fastest", load)


def timed(
    robot: Robot,
    path: Path | ArrayLike,
    law: str = "fastest",
    *,
    duration: float | None = None,
    singularity: float = SINGULARITY,
    wrench: ArrayLike | None = None,
    points: int = POINTS,
    **bounds: Any,
) -> TimedPath:
    """A motion along a path by a law, with a given duration or the shortest within the limits.

    :param law: ``fastest``, ``quintic`` or ``s-curve``, each from stop to stop.
    :param duration: of the whole, rests included, s; all stretches are slowed down alike.
    :param bounds: limits as those of :func:`fastest`; so are the other parameters and errors.
    :raises ParameterError: a duration too short for the limits.
    """
    if law not in ("fastest", *LAWS):
        raise UnknownNameError("law", law, ("fastest", *LAWS))
    made = path if isinstance(path, Path) else through(robot, path)
    shared: dict[str, Any] = {"singularity": singularity, "wrench": wrench, "points": points}
    if law == "fastest":
        result = fastest(robot, made, **shared, **bounds)
    else:
        limits = Limits.of(robot, **bounds)
        if duration is None:
            limits.check()
        load = None if wrench is None else np.asarray(wrench, float)
        parts = joint_paths(robot, made, points, singularity)
        runs = tuple(_lawful(robot, part, LAWS[law], limits, load) for part in parts)
        rests = (made.wait, *(stretch.dwell for stretch in made.stretches))
        result = TimedPath(robot, made, limits, runs, rests, law, load)
    if duration is None:
        return result
    moving = sum(run.duration for run in result.runs)
    least = moving + sum(result.rests)
    if not (np.isfinite(duration) and duration >= least * (1.0 - 1e-9)):
        raise ParameterError("duration", duration, f"{least:.6g} s or more, within the limits")
    factor = (duration - sum(result.rests)) / moving
    slower = tuple(run.slower(factor) for run in result.runs)
    return TimedPath(robot, made, result.limits, slower, result.rests, law, result.wrench)


def _run(
    robot: Robot, part: JointPath, limits: Limits, wrench: Array | None, begin: float
) -> Timed:
    """One stretch, its limits kept between the points too."""
    forces = None
    if needs_forces(robot, limits):
        forces = Forces.of(robot, part.q, part.first, part.second, wrench)
    rows = Rows.of(part, forces, limits.part(1.0 - KEPT))
    check_rest(robot, part, rows, limits, begin)
    if np.isfinite(limits.jerk).any():
        slow = shortest(robot, part, quintic, limits, wrench)
        start = slow.profile() * (1.0 - KEPT)
        smooth = smooth_run(part, smooth_profile(part, rows, limits, start))
        return kept(robot, smooth, limits, wrench)
    share = np.ones(len(part.left))
    x: Array | None = None
    for _ in range(ROUNDS):
        x = fastest_profile(rows, part.left, part.steps, share, x)
        run = Run(part, x)
        _check_moves(run, begin)
        over = passed(robot, run, limits, wrench)
        bad = over > 1.0 + SMALL
        if not bad.any():
            break
        share[bad] /= over[bad]
    return kept(robot, run, limits, wrench, float(over.max()))


def _lawful(
    robot: Robot, part: JointPath, laws: Sequence[Law], limits: Limits, wrench: Array | None
) -> Timed:
    """One stretch by the fastest of some laws."""
    runs = (shortest(robot, part, law, limits, wrench) for law in laws)
    return kept(robot, min(runs, key=lambda run: run.duration), limits, wrench)


def _check_moves(run: Run, begin: float) -> None:
    """Reject a profile that stands still on its way."""
    slow = (run.x[:-1] + run.x[1:]) <= 0.0
    if slow.any():
        way = begin + float(run.part.s[run.part.left[int(slow.argmax())]])
        raise ParameterError(
            "path", f"no motion after {way:.4g} m", "limits that let the machine pass"
        )


def passed(robot: Robot, run: Timed, limits: Limits, wrench: Array | None) -> Array:
    """Greatest used part of a limit between neighbouring times of a run, shape (i,); 1 is it.

    At :data:`LOOKED` of each interval of time, jerks over the time between them.
    """
    count = len(run.times) - 1
    begin, span = run.times[:-1], np.diff(run.times)
    time = (begin[:, None] + span[:, None] * LOOKED).ravel()
    interval, at, v, u = run.at(time)
    part = run.part
    q, qd, qdd = part.motion(interval, at, v, u)
    effort = None
    if needs_forces(robot, limits):
        effort = inverse_dynamics(robot, q, qd, qdd, wrench)
    jerk = np.zeros_like(qd)
    if np.isfinite(limits.jerk).any():
        inner = np.arange(len(time)).reshape(count, -1)[:, 1:-1]
        jerk[inner] = np.gradient(qdd[inner.ravel()], time[inner.ravel()], axis=0).reshape(
            *inner.shape, robot.joints_count
        )
    used = shares(limits, effort, qd, qdd, jerk, part.speed(part.felt, interval, at, v))
    return np.asarray(used.max(1).reshape(count, len(LOOKED)).max(1), np.float64)


def kept(
    robot: Robot, run: Timed, limits: Limits, wrench: Array | None, over: float = 0.0
) -> Timed:
    """A run, slower by as much as its limits need.

    :param over: greatest used part of a limit, where it is known.

    :raises ParameterError: no speed keeps them.
    """
    over = over or float(passed(robot, run, limits, wrench).max())
    slower = run
    for _ in range(ROUNDS):
        if over <= 1.0:
            return slower
        # What moves goes by the speed or its square; what rests does not.
        slower = slower.slower(over * (1.0 + ROUNDING))
        over = float(passed(robot, slower, limits, wrench).max())
    low, high = 1.0, 1.0 + 10.0 * KEPT
    while passed(robot, run.slower(high), limits, wrench).max() > 1.0:
        low, high = high, 1.0 + 2.0 * (high - 1.0)
        if high > 1e3:
            raise ParameterError("path", "any speed", "limits that a slow motion meets")
    while high - low > KEPT:
        middle = 0.5 * (low + high)
        good = passed(robot, run.slower(middle), limits, wrench).max() <= 1.0
        low, high = (low, middle) if good else (middle, high)
    return run.slower(high)
