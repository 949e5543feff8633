# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Plan the fastest motion along a path within limits, or a motion by a law.

Limits are those of drives, joints and tool. Laws are the quintic and S-curves of limited jerk.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.paths.carrying import split_at_payloads
from pkm_twin.paths.constraints import Forces, Limits, Rows, needs_forces
from pkm_twin.paths.geometry import MAX_LENGTH, Path, through
from pkm_twin.paths.jerk import MAX_PROGRAMS, smooth_profile, smooth_run
from pkm_twin.paths.joint_path import JointPath, Slowdown, make_joint_paths
from pkm_twin.paths.motion import Run, TimedPath, find_run_usage, sample_run
from pkm_twin.paths.profile import find_fastest_profile
from pkm_twin.robot.robot import Robot


@dataclass(frozen=True, eq=False)
class Law:
    """A motion law: polynomials from 0 to 1 over the normalised time 0 to 1, as in :class:`Run`."""

    knots: Array
    coefficients: Array

    def make_run(self, part: JointPath, duration: float) -> Run:
        """Return the run of a stretch by this law, duration in s."""
        return Run(part, self.knots, float(part.ends[-1]) * self.coefficients).slower(duration)


QUINTIC: Final = Law(np.array([0.0, 1.0]), np.array([[0.0, 0.0, 0.0, 10.0, -15.0, 6.0]]).T)


def make_s_curve(cruise: float, smooth: float) -> Law:
    """Return a law of seven parts with constant jerk.

    :param cruise: part of the duration at even speed, 0 to below 1.
    :param smooth: part of each ramp in which its acceleration changes, above 0 to 1.
    """
    ramp = 0.5 * (1.0 - cruise)
    change, even = 0.5 * smooth * ramp, (1.0 - smooth) * ramp
    top = 1.0 / (ramp + cruise)
    jerk = top / (ramp - change) / change * np.array([1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0])
    steps = np.array([change, even, change, cruise, change, even, change])
    # Drop parts without duration.
    jerk, steps = jerk[steps > 0.0], steps[steps > 0.0]
    state, rows = np.zeros(3), []
    for h, j in zip(steps, jerk, strict=True):
        s, v, a = state
        rows.append((s, v, a / 2, j / 6))
        state = np.array([s + v * h + a * h**2 / 2 + j * h**3 / 6, v + a * h + j * h**2 / 2, a + j * h])
    return Law(np.concatenate([[0.0], np.cumsum(steps)]), np.array(rows).T)


LAWS: Final[Mapping[str, Sequence[Law]]] = {
    "quintic": (QUINTIC,),
    "s-curve": tuple(
        make_s_curve(cruise, smooth) for cruise in (0.0, 0.15, 0.3, 0.45, 0.6, 0.75) for smooth in (0.3, 0.5, 0.75, 1.0)
    ),
}
"""Laws by name; the one that is fastest within the limits is used."""


def run_by_law(part: JointPath, law: Law, limits: Limits, wrench: Array | None) -> Run:
    """Return the shortest run of a stretch by a law; limits hold at one time per point."""
    run = law.make_run(part, 1.0)
    time = np.linspace(0.0, 1.0, len(part.ends))
    interval, share, v, u = run.at(time)
    _, qd, qdd = part.motion(interval, share, v, u)
    jerk = np.gradient(qdd, time, axis=0)
    travel = sample_run(run, time).felt
    duration = max(
        float((np.abs(qd) / limits.velocity).max()),
        float((travel / limits.speed).max()),
        float((np.abs(qdd) / limits.acceleration).max()) ** (1 / 2),
        float((np.abs(jerk) / limits.jerk).max()) ** (1 / 3),
    )
    if needs_forces(part, limits):
        forces = Forces.from_inverse_dynamics(part, part.left[interval], *part.interpolate(interval, share), wrench)
        square = forces.a * u[:, None] + forces.b * (v**2)[:, None]
        linear, fixed = forces.w * v[:, None], forces.g + forces.k
        for sign in (1.0, -1.0):
            rest = limits.effort - sign * fixed
            if (rest <= 0.0).any():
                row, column = np.argwhere(rest <= 0.0)[0]
                raise ParameterError(
                    f"path: effort of {part.curve.robot.joint_names[column]} at rest",
                    float(fixed[row, column]),
                    f"below {limits.effort[column]:g}",
                )
            # square y^2 + linear y <= rest, y = 1 / duration.
            root = np.sqrt(np.maximum((sign * linear) ** 2 + 4.0 * sign * square * rest, 0.0))
            hits = (sign * linear) ** 2 + 4.0 * sign * square * rest >= 0.0
            slowest = np.where(hits, (sign * linear + root) / (2.0 * rest), 0.0)
            duration = max(duration, float(slowest.max()))
    return run.slower(max(duration, 1e-6))


DEFAULT_POINTS: Final = 1000
"""Default number of points of a path."""
MIN_SINGULARITY_INDEX: Final = 0.01
"""Default smallest singularity index of a path: the nodes' ``singularity_stop``."""
LIMIT_RESERVE: Final = 1e-4
"""Fraction of each limit that the points leave to the motion between them."""
MAX_EXCESS: Final = 3e-4
"""Excess of a limit between points, as a fraction, that slowing the whole motion corrects."""
REFINEMENT_EXCESS: Final = 1e-3
"""Excess of a limit, as a fraction, above which intervals are divided; with jerk limits, also the
gain of duration that justifies another program."""
SLOWDOWN_RESERVE: Final = 1e-5
"""Fraction by which a motion is slowed more than needed; four times as much in each attempt."""
MAX_SLOWDOWNS: Final = 12
"""Largest number of attempts to slow a motion that exceeds a limit."""
MAX_TIGHTENINGS: Final = 4
"""Largest number of times that limits are tightened where they are exceeded between points."""
MAX_REFINEMENTS: Final = 5
"""Largest number of times that intervals are divided before that."""
MAX_PARTS: Final = 8
"""Largest number of parts into which an interval is divided at a time."""
MAX_JERK_REFINEMENTS: Final = 4
"""Largest number of times that intervals are divided with jerk limits."""


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
    singularity: float = MIN_SINGULARITY_INDEX,
    wrench: ArrayLike | None = None,
    points: int = DEFAULT_POINTS,
    slowdown: Slowdown | None = None,
    payload: Sequence[float | None] | None = None,
) -> TimedPath:
    """Plan the fastest motion along a path, at rest at its ends, by the exact inverse dynamics.

    The limits hold at all times: between the points of the path the inverse dynamics checks them
    as closely as needed (:func:`~pkm_twin.paths.motion.peaks`). If one is exceeded, the path gets
    more points, then smaller limits; if that is not enough, the whole motion slows down.

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
    :param points: about how many points of the path; at most 400 with a
        jerk limit.
    :param slowdown: divides ``speed`` at points of the path, by their joint positions (p, n) and
        the direction (p, 3) of the reference point, base axes: returns 1 or more, (p,).
    :param payload: mass from each waypoint on, kg, (waypoints,); None is the robot's own payload,
        also the default. A waypoint with a rounded corner is reached in the middle of the rounding.
        If a waypoint is repeated, its payload changes after the rests of the copies before it. A
        cycle has 4 waypoints, with the way back 7; a circle has its two ends.
    :returns: the motion: ``.times``, ``.q``, ``.qd``, ``.qdd``, ``.effort`` and ``.pose`` at its
        points; ``.uniform(rate)`` and ``.sample(times)`` return these at other times; ``.bounds``, which
        limit binds when; ``.duration``, s.
    :raises ParameterError: with the position: a pose out of reach, beyond a joint's limit or close
        to a singularity, or a drive that cannot hold the machine; or no limit bounds the speed.
    """
    return timed(
        robot,
        path,
        "fastest",
        effort=effort,
        velocity=velocity,
        acceleration=acceleration,
        jerk=jerk,
        speed=speed,
        share=share,
        singularity=singularity,
        wrench=wrench,
        points=points,
        slowdown=slowdown,
        payload=payload,
    )


def timed(
    robot: Robot,
    path: Path | ArrayLike,
    law: str = "fastest",
    *,
    duration: float | None = None,
    singularity: float = MIN_SINGULARITY_INDEX,
    wrench: ArrayLike | None = None,
    points: int = DEFAULT_POINTS,
    slowdown: Slowdown | None = None,
    payload: Sequence[float | None] | None = None,
    **bounds: Any,
) -> TimedPath:
    """Plan a motion along a path by a law, with a duration or the shortest within the limits.

    :param law: ``fastest``, ``quintic`` or ``s-curve``, each from stop to stop.
    :param duration: of the whole, rests included, s; all stretches are slowed down alike.
    :param bounds: limits, parameters of :func:`fastest`; the other parameters and errors are those, too.
    :raises ParameterError: a duration too short for the limits.
    """
    if law not in ("fastest", *LAWS):
        raise UnknownNameError("law", law, ("fastest", *LAWS))
    made = path if isinstance(path, Path) else through(robot, path)
    made, carried = split_at_payloads(robot, made, payload)
    robot = carried[0].robot
    limits = Limits.of(robot, **bounds)
    if law == "fastest" or duration is None:
        limits.check()
    load = None if wrench is None else np.asarray(wrench, float)
    jerks = law == "fastest" and np.isfinite(limits.jerk).any()
    # Each point is a variable of linear programs.
    points = min(points, 400) if jerks else points

    def plan(part: JointPath) -> Run:
        if law == "fastest":
            return (_solve_with_jerk if jerks else _solve_stretch)(part, limits, load)
        runs = (run_by_law(part, one, limits, load) for one in LAWS[law])
        return slow_within_limits(min(runs, key=lambda run: run.duration), limits, load)

    parts = make_joint_paths(made, carried, points, singularity, slowdown)
    rests = (made.wait, *(stretch.dwell for stretch in made.stretches))
    result = TimedPath(robot, made, limits, tuple(map(plan, parts)), rests, law, carried, load)
    result.check_rests()
    if duration is None:
        return result
    moving = sum(run.duration for run in result.runs)
    least = moving + sum(result.rests)
    if not least * (1.0 - 1e-9) <= duration <= MAX_LENGTH:
        bound = f"{least:.6g} s or more, within the limits by law {law}, at most {MAX_LENGTH:g} s"
        raise ParameterError("duration", duration, bound)
    factor = (duration - sum(result.rests)) / moving
    result = replace(result, runs=tuple(run.slower(factor) for run in result.runs))
    over = max(result.worst.values(), default=0.0)
    if over > 1.0 + LIMIT_RESERVE:
        # A slower motion has smaller inertial forces, which may have helped to hold the load.
        raise ParameterError("duration", duration, f"a motion within limits, not {over:.4g} of one")
    return result


def _solve_stretch(part: JointPath, limits: Limits, wrench: Array | None) -> Run:
    """Find the fastest run of one stretch that keeps the limits between its points too.

    Intervals within which a limit is exceeded are divided, and finally use smaller limits.
    """
    share = np.ones(len(part.left))
    rows = Rows.from_limits(part, limits.part(1.0 - LIMIT_RESERVE), wrench)
    x: Array | None = None
    for count in range(MAX_REFINEMENTS + MAX_TIGHTENINGS):
        x = find_fastest_profile(rows, part.left, part.steps, share, x)
        stopped = (x[:-1] + x[1:]) <= 0.0
        if stopped.any():
            distance = part.curve.begin + float(part.s[part.left[int(stopped.argmax())]])
            raise ParameterError("path", f"no motion after {distance:.4g} m", "limits that let the machine pass")
        run = Run.from_profile(part, x)
        # Where the joints turn back and nothing bounds their acceleration, the path's speed has no bound.
        unbounded = np.diff(run.knots) <= np.finfo(float).eps * run.duration
        if unbounded.any():
            distance = part.curve.begin + float(part.s[part.left[int(unbounded.argmax())]])
            raise ParameterError(
                "path", f"no limit bounds the motion at {distance:.4g} m", "acceleration or effort limits"
            )
        used = find_run_usage(run, limits, wrench)
        over = used.max(1)
        bad = over > 1.0 + MAX_EXCESS
        if not bad.any():
            break
        parts = np.ones(len(bad), np.int64)
        if count < MAX_REFINEMENTS:
            # The excess between two points grows with the square of their distance.
            wanted = np.ceil(np.sqrt(np.maximum(over - 1.0, 0.0) / MAX_EXCESS))
            most = np.minimum(part.steps / part.curve.least_step, MAX_PARTS)
            coarse = over > 1.0 + REFINEMENT_EXCESS
            parts[coarse] = np.maximum(np.minimum(wanted, most)[coarse], 1.0)
        tight = bad & (parts == 1)
        share[tight] /= over[tight]
        if (parts > 1).any():
            ends, part, share = part.ends, part.refine(parts), np.repeat(share, parts)
            rows = Rows.from_limits(part, limits.part(1.0 - LIMIT_RESERVE), wrench)
            x = np.interp(part.ends, ends, x)
    return slow_within_limits(run, limits, wrench, used.max(0))


def _solve_with_jerk(part: JointPath, limits: Limits, wrench: Array | None) -> Run:
    """Find the fastest run within jerk limits: the best of several profiles, or a quintic."""
    rows = Rows.from_limits(part, limits.part(1.0 - LIMIT_RESERVE), wrench)
    slow = run_by_law(part, QUINTIC, limits, wrench)
    best: Run = slow
    least = estimate_slowdown_factor(find_run_usage(slow, limits, wrench).max(0)) * slow.duration
    x = slow.profile() * (1.0 - LIMIT_RESERVE)
    share, jerks = np.ones((2, len(part.left)))
    n = len(limits.jerk)
    programs, improved = MAX_PROGRAMS, 0
    for count in range(MAX_JERK_REFINEMENTS + MAX_TIGHTENINGS):
        found = smooth_profile(part, rows, limits, x, share, jerks, programs)
        if found is None:
            break
        x = found
        run = smooth_run(part, x)
        if run is None:
            break
        used = find_run_usage(run, limits, wrench)
        factor = estimate_slowdown_factor(used.max(0))
        if factor * run.duration < (1.0 - REFINEMENT_EXCESS) * least:
            improved = count
        if factor * run.duration < least:
            best, least = run, factor * run.duration
        if factor <= 1.0 + REFINEMENT_EXCESS or count >= improved + 2:
            break
        over = np.ones((2, len(share)))
        interval = run.at(0.5 * (run.times[1:] + run.times[:-1]))[0]
        np.maximum.at(over[0], interval, np.delete(used, np.s_[3 * n : 4 * n], 1).max(1))
        np.maximum.at(over[1], interval, used[:, 3 * n : 4 * n].max(1))
        # The linear programs are inaccurate where the speed changes much within an interval.
        parts = np.ones(len(share), np.int64)
        if count < MAX_JERK_REFINEMENTS:
            steep = np.maximum(x[1:], x[:-1]) > 2.0 * np.minimum(x[1:], x[:-1])
            # Points next to a stop are already closer.
            steep[:8] = steep[-8:] = False
            long = part.steps > MAX_PARTS * part.curve.least_step
            parts[steep & long & (over.max(0) > 1.0 + REFINEMENT_EXCESS)] = MAX_PARTS
        divided = bool((parts > 1).any())
        share, jerks = (
            np.repeat(np.where(parts > 1, 1.0, old / own), parts) for old, own in zip((share, jerks), over, strict=True)
        )
        programs = MAX_PROGRAMS if divided else 1
        if divided:
            ends, part = part.ends, part.refine(parts)
            rows = Rows.from_limits(part, limits.part(1.0 - LIMIT_RESERVE), wrench)
            x = np.interp(part.ends, ends, x**0.75) ** (4 / 3)
    return slow_within_limits(best, limits, wrench)


def estimate_slowdown_factor(used: Array) -> float:
    """Estimate the factor of the duration that a motion needs, from used fractions (4 n + 1,).

    Velocities scale with the speed, accelerations with its square, jerks with its cube. The moving
    part of an effort scales with the square too; its part at rest does not change.
    """
    n = len(used) // 4
    powers = np.append(np.repeat([2.0, 1.0, 2.0, 3.0], n), 1.0)
    return float((used ** (1.0 / powers)).max())


def slow_within_limits(run: Run, limits: Limits, wrench: Array | None, used: Array | None = None) -> Run:
    """Slow a run down as much as its limits need.

    :param used: largest used fraction of each limit if known, shape (4 n + 1,).

    :raises ParameterError: no speed keeps the limits.
    """
    factor = 1.0
    for more in SLOWDOWN_RESERVE * 4.0 ** np.arange(MAX_SLOWDOWNS):
        slower = run if factor == 1.0 else run.slower(factor)
        if used is None:
            used = find_run_usage(slower, limits, wrench).max(0)
        if used.max() <= 1.0:
            return slower
        factor *= max(estimate_slowdown_factor(used), 1.0) + more
        used = None
    raise ParameterError("path", "any speed", "limits that a slow motion meets")
