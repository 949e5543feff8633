# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Describe a motion along a path in time, and find which limit binds where."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import ParameterError
from pkm_twin.paths.carrying import PayloadChange, compute_efforts
from pkm_twin.paths.constraints import Limits, compute_limit_usage, limit_names, needs_forces
from pkm_twin.paths.geometry import Path
from pkm_twin.paths.joint_path import Index, JointPath, reference_velocity
from pkm_twin.recordings.payload import Load
from pkm_twin.robot.robot import Robot

BINDING_USE: Final = 0.98
"""Used fraction of a limit from which on it binds."""
MAX_SAMPLES: Final = 10_000_000
"""Largest number of samples of a motion at a rate."""
JUMP_CLEARANCE: Final = 1e-6
"""Fraction of an interval between its outer samples and its ends, where accelerations jump."""
PEAK_TOLERANCE: Final = 2e-5
"""Excess between samples, as a fraction of a limit, that is added to them; above it, more samples
are taken."""


@dataclass(frozen=True)
class Bound:
    """Describe an interval in which one limit binds: times (s), limit and its used fraction.

    ``what`` is empty where the machine rests or no limit binds.
    """

    begin: float
    end: float
    what: str
    used: float

    def as_json(self) -> dict[str, Any]:
        """Return plain data, units in the keys."""
        return {
            "from_s": self.begin,
            "to_s": self.end,
            "limit": self.what or None,
            "used": self.used,
        }


@dataclass(frozen=True)
class Run:
    """Describe one stretch in time: its path length as polynomials of the time since knots.

    ``knots``: rising from 0, the last one the end, shape (k + 1,), s. ``coefficients``: of the path length, by
    rising powers, shape (powers, k), m, m/s, ...
    """

    part: JointPath
    knots: Array
    coefficients: Array

    @classmethod
    def from_profile(cls, part: JointPath, x: Array) -> Run:
        """Return the run by x = v^2 at the intervals' ends, linear in between, shape (i + 1,)."""
        v = np.sqrt(x)
        knots = np.concatenate([[0.0], np.cumsum(2.0 * part.steps / (v[:-1] + v[1:]))])
        return cls(part, knots, np.stack([part.ends[:-1], v[:-1], np.diff(x) / (4.0 * part.steps)]))

    @property
    def duration(self) -> float:
        """Time from rest to rest, s."""
        return float(self.knots[-1])

    def slower(self, factor: float) -> Run:
        """Return the run with ``factor`` times the duration."""
        powers = np.arange(len(self.coefficients))[:, None]
        return Run(self.part, factor * self.knots, self.coefficients / factor**powers)

    def evaluate(self, k: Index, time: Array) -> tuple[Array, Array, Array]:
        """Return path length, v and u at times after knots k."""
        t = np.clip(time - self.knots[k], 0.0, self.knots[k + 1] - self.knots[k])
        length, v, u = np.zeros((3, len(t)))
        for row in self.coefficients[::-1, k]:
            length, v, u = length * t + row, v * t + length, u * t + 2.0 * v
        return length, v, u

    def _last_knot(self, time: Array) -> Index:
        """Return the index of the last knot before times (k,)."""
        last = len(self.knots) - 2
        return np.clip(np.searchsorted(self.knots, time, side="right") - 1, 0, last)

    @cached_property
    def ends(self) -> Array:
        """Times of the intervals' ends, shape (i + 1,), s."""
        length, begins = self.part.ends[1:-1], self.coefficients[0]
        k = np.clip(np.searchsorted(begins, length, side="right") - 1, 0, len(begins) - 1)
        low, high = self.knots[k], self.knots[k + 1]
        # Bisect until the interval has the size of rounding errors.
        for _ in range(60):
            middle = 0.5 * (low + high)
            before = self.evaluate(k, middle)[0] < length
            low, high = np.where(before, middle, low), np.where(before, high, middle)
        inner = np.where(begins[k] == length, self.knots[k], high)
        return np.concatenate([self.knots[:1], inner, self.knots[-1:]])

    @cached_property
    def times(self) -> Array:
        """Knots and intervals' ends, rising, s; the motion is smooth between two of them."""
        return np.unique(np.concatenate([self.knots, self.ends]))

    def profile(self) -> Array:
        """Return v^2 at the intervals' ends, shape (i + 1,)."""
        x = self.evaluate(self._last_knot(self.ends), self.ends)[1] ** 2
        x[[0, -1]] = 0.0
        return x

    def at(self, time: Array) -> tuple[Index, Array, Array, Array]:
        """Return the interval at times (k,), the fraction of it, ds/dt (v) and d2s/dt2 (u)."""
        length, v, u = self.evaluate(self._last_knot(time), time)
        s = self.part.ends
        j = np.clip(np.searchsorted(s, length, side="right") - 1, 0, len(s) - 2)
        return j, np.clip((length - s[j]) / (s[j + 1] - s[j]), 0.0, 1.0), v, u


@dataclass(frozen=True)
class TimedPath:
    """Describe a motion along a path: runs from rest to rest, and rests before and between, s.

    ``robot``: with the first payload. ``limits``: those of the plan. ``law``: how its
    speed was chosen. ``carried``: payloads, the first from the beginning on.
    """

    robot: Robot
    path: Path
    limits: Limits
    runs: tuple[Run, ...]
    rests: tuple[float, ...]
    law: str
    carried: tuple[PayloadChange, ...]
    wrench: Array | None = None

    @property
    def duration(self) -> float:
        """Duration of the whole motion, s."""
        return self.begins[-1] + self.runs[-1].duration + self.rests[-1]

    @cached_property
    def begins(self) -> list[float]:
        """Time at which each run begins, s."""
        result, clock = [], 0.0
        for rest, run in zip(self.rests, self.runs, strict=False):
            clock += rest
            result.append(clock)
            clock += run.duration
        return result

    @cached_property
    def switches(self) -> Array:
        """Times at which the payload changes, shape (changes,), s."""
        result = []
        for change in self.carried[1:]:
            clock = change.rest
            if change.stretch >= 0:
                run = self.runs[change.stretch]
                passed = float(run.ends[run.part.find_first_interval(change.piece)])
                clock = self.begins[change.stretch] + passed + change.rest
            result.append(clock)
        return np.array(result)

    @property
    def load(self) -> Load | None:
        """Payloads of the path's waypoints over time; None if it is always the robot's own."""
        edges = [0.0, *self.switches.tolist(), np.inf]
        spans = [
            (begin, end, change.mass)
            for (begin, end), change in zip(pairwise(edges), self.carried, strict=True)
            if change.mass is not None and end > begin
        ]
        return Load.from_intervals(spans, "path") if spans else None

    def _efforts(self, t: Array, q: Array, qd: Array, qdd: Array) -> Array | None:
        """Return efforts at times (k,) with the payload then; None for a robot without masses."""
        if not self.robot.has_masses:
            return None
        which = np.searchsorted(self.switches, t, side="right")
        return compute_efforts([one.robot for one in self.carried], which, q, qd, qdd, self.wrench)

    @cached_property
    def _sample_times(self) -> Array:
        """Times of all intervals' ends and middles, s."""
        times = []
        for begin, run in zip(self.begins, self.runs, strict=True):
            ends = begin + run.times
            times += [ends, 0.5 * (ends[1:] + ends[:-1])]
        return np.unique(np.concatenate(times))

    def sample(self, times: ArrayLike) -> Samples:
        """Return the motion at times (k,), s from its beginning, at rest before and after it."""
        t = np.asarray(times, np.float64)
        robot, n = self.robot, self.robot.joints_count
        q, qd, qdd = (np.zeros((len(t), n)) for _ in range(3))
        travel, felt = np.zeros(len(t)), np.zeros(len(t))
        run_of = np.clip(np.searchsorted(self.begins, t, side="right") - 1, 0, None)
        for k, (begin, run) in enumerate(zip(self.begins, self.runs, strict=True)):
            mine = np.flatnonzero(run_of == k)
            if len(mine):
                # The beginning of a run counts as motion, with friction; its end as rest.
                moves = (t[mine] >= begin) & (t[mine] - begin < run.duration * (1.0 - 1e-12))
                local = t[mine] - begin
                for change, switch in zip(self.carried[1:], self.switches, strict=True):
                    if change.stretch == k and not change.rest:
                        # Keep times on their side of the payload change despite rounding.
                        end = float(run.ends[run.part.find_first_interval(change.piece)])
                        before = np.minimum(local, np.nextafter(end, 0.0))
                        local = np.where(t[mine] >= switch, np.maximum(local, end), before)
                own = sample_run(run, local, moves)
                q[mine], qd[mine], qdd[mine], travel[mine], felt[mine] = own[:5]
        return Samples(t, q, qd, qdd, self._efforts(t, q, qd, qdd), robot.forward(q), travel, felt)

    def uniform(self, rate: float) -> Samples:
        """Return the motion at ``rate`` samples per second.

        The last sample is its end, half to three halves of a period after the one before.

        :raises ParameterError: more than :data:`MAX_SAMPLES`.
        """
        if not self.duration * rate <= MAX_SAMPLES:
            raise ParameterError(
                "rate",
                rate,
                f"{MAX_SAMPLES / self.duration:.4g} or less, for "
                f"{MAX_SAMPLES} samples of a motion of {self.duration:.4g} s",
            )
        count = max(1, round(self.duration * rate))
        return self.sample(np.append(np.arange(count) / rate, self.duration))

    def __iter__(self) -> Iterator[Any]:
        """Yield times, q, qd, qdd, effort (as in ``fine``) and ``bounds``, to unpack."""
        s = self.fine
        return iter((s.time, s.q, s.qd, s.qdd, s.effort, self.bounds))

    @property
    def times(self) -> Array:
        """Times of ``fine``, shape (k,), s."""
        return self.fine.time

    @property
    def q(self) -> Array:
        """Joint positions of ``fine``, shape (k, n), rad or m."""
        return self.fine.q

    @property
    def qd(self) -> Array:
        """Joint rates of ``fine``, shape (k, n)."""
        return self.fine.qd

    @property
    def qdd(self) -> Array:
        """Joint accelerations of ``fine``, shape (k, n)."""
        return self.fine.qdd

    @property
    def effort(self) -> Array | None:
        """Efforts of ``fine``, shape (k, n), N m or N; None for a robot without masses."""
        return self.fine.effort

    @property
    def pose(self) -> Array:
        """Poses of ``fine``, shape (k, m)."""
        return self.fine.pose

    @cached_property
    def fine(self) -> Samples:
        """Motion at all points of the path and midway between them."""
        return self.sample(self._sample_times)

    @cached_property
    def peaks(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Largest magnitudes of each joint: velocity, acceleration, effort, with units."""
        robot, fine, peaks = self.robot, self.fine, {}
        for i, joint in enumerate(robot.joint_names):
            unit = robot.joint_units[i]
            values = [("velocity", fine.qd, f"{unit}/s"), ("acceleration", fine.qdd, f"{unit}/s2")]
            if fine.effort is not None:
                values.append(("effort", fine.effort, robot.effort_units[i]))
            peaks[joint] = {word: {"value": float(np.abs(v[:, i]).max()), "unit": u} for word, v, u in values}
        return peaks

    @cached_property
    def used(self) -> Array:
        """Used fraction of every limit at the points of ``fine``, shape (k, 4 n + 1)."""
        s = self.fine
        jerk = np.zeros_like(s.q)
        if np.isfinite(self.limits.jerk).any() and len(s.time) > 2:
            jerk = np.gradient(s.qdd, s.time, axis=0)
        return np.abs(compute_limit_usage(self.limits, s.effort, s.qd, s.qdd, jerk, s.felt))

    @cached_property
    def bounds(self) -> list[Bound]:
        """Intervals with the limit that binds, in order."""
        # The limit that binds at each time, by the used fractions (k, l); -1 for none.
        active = self.used >= BINDING_USE
        lasts = np.zeros(self.used.shape, np.int64)
        count = np.zeros(self.used.shape[1], np.int64)
        for row in range(len(self.used) - 1, -1, -1):
            count = np.where(active[row], count + 1, 0)
            lasts[row] = count
        result: list[int] = []
        for row in range(len(self.used)):
            now = result[-1] if result else -1
            if now < 0 or not active[row, now]:
                now = int(lasts[row].argmax()) if active[row].any() else -1
            result.append(now)
        time, names = self.fine.time, limit_names(self.robot)
        if len(time) < 2:
            return []
        edges = [0, *(i for i in range(1, len(result)) if result[i] != result[i - 1]), len(result) - 1]
        spans: list[tuple[int, int, int]] = []
        for b, e in pairwise(edges):
            if e == b:
                continue
            # An interval shorter than a hundredth of the duration joins the one before it, unless that has no
            # binding limit.
            brief = float(time[e] - time[b]) < 0.01 * float(time[-1] - time[0]) and spans and spans[-1][2] >= 0
            if spans and (brief or spans[-1][2] == result[b]):
                spans[-1] = (spans[-1][0], e, spans[-1][2])
            else:
                spans.append((b, e, result[b]))
        return [
            Bound(
                float(time[b]),
                float(time[e]),
                "" if column < 0 else names[column],
                float(self.used[b : e + (e == len(time) - 1 or column >= 0)].max()),
            )
            for b, e, column in spans
        ]

    def check_rests(self) -> None:
        """Reject payloads that the drives cannot hold while the machine rests.

        :raises ParameterError: names the joint and the time.
        """
        times, used = self._rest_usage
        row, column = np.unravel_index(int(used.argmax()), used.shape)
        if used[row, column] > 1.0 and len(self.carried) > 1:
            raise ParameterError(
                f"path: {limit_names(self.robot)[column]} at rest at {times[row]:.4g} s",
                f"{100 * used[row, column]:.4g} % of its limit",
                "a payload that the drives can hold there",
            )

    @property
    def _rest_usage(self) -> tuple[Array, Array]:
        """Times of rests, (k,), and the used fraction of each limit there, (k, 4 n + 1)."""
        times = np.concatenate([np.nextafter(self.begins, -1.0), self.switches, [self.duration]])
        rests = self.sample(times)
        zero = np.zeros_like(rests.q)
        resting = np.abs(rests.qd).max(1) == 0.0
        used = np.abs(compute_limit_usage(self.limits, rests.effort, zero, zero, zero, rests.felt))
        return times[resting], used[resting]

    @cached_property
    def _peak_usage(self) -> Array:
        """Largest used fraction of each limit at all times, shape (4 n + 1,)."""
        moved = [find_run_usage(run, self.limits, self.wrench).max(0) for run in self.runs]
        return np.asarray(np.concatenate([self._rest_usage[1], moved]).max(0), np.float64)

    @property
    def worst(self) -> dict[str, float]:
        """Largest used fraction of each limit, also between points; 1 is the limit."""
        return {
            name: float(value)
            for name, value in zip(limit_names(self.robot), self._peak_usage, strict=True)
            if value > 0.0
        }


@dataclass(frozen=True)
class Samples:
    """Hold a motion at times (k,), s.

    ``q``, ``qd``, ``qdd``: joint positions, velocities, accelerations, shape (k, n), rad or m.
    ``effort``: (k, n), N m or N; None for a robot without masses. ``pose``: (k, m). ``speed``: of
    the reference point, (k,), m/s. ``felt``: the speed that is limited, (k,).
    """

    time: Array
    q: Array
    qd: Array
    qdd: Array
    effort: Array | None
    pose: Array
    speed: Array
    felt: Array


class RunSamples(NamedTuple):
    """Hold a run at times: q, qd, qdd (k, n), speeds (k,) and intervals (k,).

    ``speed``: of the reference point. ``felt``: the speed that is limited.
    """

    q: Array
    qd: Array
    qdd: Array
    speed: Array
    felt: Array
    interval: Index


def sample_run(run: Run, time: Array, moves: Mask | bool = True, tool: bool = True) -> RunSamples:
    """Sample a run at times (k,).

    :param moves: at which times the machine moves; it rests at the others.

    :param tool: whether to compute the speeds; otherwise they are zero.
    """
    interval, part, v, u = run.at(time)
    # A tiny minimum speed, so that friction has the direction of the motion also at its ends.
    creep = 1e-9 * run.part.ends[-1] / run.duration
    v, u = np.where(moves, np.maximum(v, creep), 0.0), np.where(moves, u, 0.0)
    q, qd, qdd = run.part.motion(interval, part, v, u)
    robot = run.part.curve.robot
    speed = np.linalg.norm(reference_velocity(robot, q, qd), axis=1) if tool else np.zeros(len(q))
    left, slower = run.part.left[interval], run.part.slower
    factor = (1.0 - part) * slower[left] + part * slower[left + 1]
    return RunSamples(q, qd, qdd, speed, speed * factor, interval)


Moments = tuple[Array | None, Array, Array, Array]
"""Efforts, joint velocities and accelerations, (k, n), and the limited speed, (k,)."""


def find_peak_usage(limits: Limits, times: Array, sample: Callable[[Array], Moments]) -> Array:
    """Return the largest used fraction of each limit between neighbouring times, (i, 4 n + 1).

    Each interval is sampled, and a parabola through three samples estimates the excess between
    them. If it is more than :data:`PEAK_TOLERANCE` and could exceed a limit or the largest value so
    far, the interval is sampled more closely.

    :param times: between two of them the motion is smooth, shape (i + 1,), s.
    """
    jerks = np.isfinite(limits.jerk).any()
    spans = np.diff(times)
    n = len(limits.jerk)
    result = np.zeros((len(spans), 4 * n + 1))
    todo = np.arange(len(spans))
    for cells in (4, 16, 64, 256):
        parts = JUMP_CLEARANCE + (1.0 - 2.0 * JUMP_CLEARANCE) * np.linspace(0.0, 1.0, cells + 1)
        effort, qd, qdd, felt = sample((times[todo, None] + spans[todo, None] * parts).ravel())
        jerk = np.zeros_like(qd)
        if jerks:
            own = qdd.reshape(len(todo), cells + 1, n)
            changes = np.gradient(own, parts, axis=1, edge_order=2)
            jerk = (changes / spans[todo, None, None]).reshape(jerk.shape)
        used = compute_limit_usage(limits, effort, qd, qdd, jerk, felt).reshape(len(todo), cells + 1, -1)
        more = np.abs(np.diff(used, 2, axis=1)).max(1) / 8.0
        top = np.abs(used).max(1)
        result[todo] = top + np.minimum(more, PEAK_TOLERANCE)
        matters = (more > PEAK_TOLERANCE) & (top + 4.0 * more > np.minimum(1.0, result.max(0)))
        todo = todo[matters.any(1)]
        if not len(todo):
            break
    return result


def find_run_usage(run: Run, limits: Limits, wrench: Array | None) -> Array:
    """Return the largest used fraction of each limit between times of a run, (i, 4 n + 1)."""
    part = run.part
    needs = needs_forces(part, limits)

    def sample(time: Array) -> Moments:
        q, qd, qdd, _, felt, interval = sample_run(run, time, tool=np.isfinite(limits.speed))
        effort = part.efforts(part.left[interval], q, qd, qdd, wrench) if needs else None
        return effort, qd, qdd, felt

    return find_peak_usage(limits, run.times, sample)
