# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A trajectory that identifies well: finite Fourier series, D-optimal, within all limits.

Swevers, Ganseman, Tukel, De Schutter, Van Brussel, Optimal robot excitation and identification,
1997, doi:10.1109/70.631234. The determinant of the information over the base parameters is made
large, by random steps from the best so far; what leaves a limit is made smaller until it does not.

Slow sweeps show friction: each joint alone up and down its range, at several speeds. At a steady
speed weight and friction are all that a drive has to overcome: up and down differ by twice the
friction, and at three speeds a Stribeck law differs from viscous friction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Final

import numpy as np

from delta_dynamics.torques.regressor import choose_independent_columns, random_states, regressor
from delta_dynamics.torques.virtual_work import inverse_dynamics
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import PkmTwinError, check_limit
from pkm_twin.identification.parameters import FileParameters
from pkm_twin.identification.samples import resample_recording
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import describe_singularity_bound, position_range, reachable

SHRINK_FACTOR: Final = 0.85
MAX_HARMONIC_RATIO: Final = 20.0
"""Largest ratio of the highest harmonic to the lowest."""
SWEEP_SPEEDS: Final = (1.0, 4.0, 16.0)
"""Speeds of the sweeps, as multiples of the slowest; ramps may reduce them."""
RAMP_FRACTION: Final = 0.1
"""Fraction of a full traverse in which a sweep accelerates, and brakes."""
SWEEP_DURATION: Final = 4.0 + 8.0 * RAMP_FRACTION
"""Duration of a sweep up and down, over that of half a traverse at constant speed."""
SWEEP_STATES: Final = 200
"""Number of states of each part of a sweep at which limits are checked."""


@dataclass(frozen=True)
class TrajectoryLimits:
    """Limits of an excitation trajectory.

    ``share``: fraction of the file's limits and of the position range that is used.
    ``acceleration``: limit of every joint, rad/s2 or m/s2; None: no limit. ``singularity``:
    smallest singularity index. ``rate``: sampling rate of the written trajectory, Hz, which
    limits its highest frequency.

    :raises ParameterError: the acceleration is not a plausible limit.
    """

    share: float = 0.9
    acceleration: float | None = None
    singularity: float = 0.05
    rate: float = 100.0

    def __post_init__(self) -> None:
        if self.acceleration is not None:
            check_limit("acceleration", self.acceleration)


@dataclass(frozen=True, eq=False)
class Excitation:
    """A periodic trajectory that begins and ends at rest, without acceleration.

    q_j(t) = centre_j + sum over i of sine_ji sin(w k_i t) + cosine_ji cos(w k_i t), w = 2 pi /
    duration; ``harmonics``: k, shape (h,); ``sines``, ``cosines``: shape (n, h), rad or m.
    ``condition``: condition number of the scaled regressor over the base parameters.
    """

    duration: float
    harmonics: Array
    centre: Array
    sines: Array
    cosines: Array
    condition: float

    def at(self, time: Array) -> tuple[Array, Array, Array]:
        """Positions, rates and accelerations, shape (k, n) each."""
        return _evaluate_series(time, self.duration, self.harmonics, self.centre, np.stack([self.sines, self.cosines]))


def _evaluate_series(
    time: Array, duration: float, harmonics: Array, centre: Array, pair: Array
) -> tuple[Array, Array, Array]:
    w = 2 * np.pi * harmonics / duration
    s, c = np.sin(np.outer(time, w)), np.cos(np.outer(time, w))
    a, b = pair[0].T, pair[1].T
    q = centre + s @ a + c @ b
    return q, (c * w) @ a - (s * w) @ b, -(s * w**2) @ a - (c * w**2) @ b


@dataclass(frozen=True, eq=False)
class Judge:
    """Measure of a motion's information: the regressor's independent columns, scaled."""

    robot: Robot
    parameters: FileParameters
    columns: tuple[int, ...]
    scales: Array
    weights: Array

    @classmethod
    def from_robot(cls, robot: Robot, parameters: FileParameters) -> Judge:
        """Choose independent columns and their scales from random states.

        :raises PkmTwinError: nothing of the parameters shows in any motion.
        """
        count = max(60, 3 * len(parameters.names) // robot.joints_count)
        states = random_states(robot, count, seed=0)
        table = regressor(robot, *states) @ parameters.mixing
        size = np.sqrt(np.mean(inverse_dynamics(robot, *states) ** 2, 0))
        weights = 1.0 / np.maximum(size, 1e-9 * size.max())
        rows = (table * weights[:, None]).reshape(-1, table.shape[-1])
        norms = np.sqrt(np.mean(rows**2, 0))
        known = np.where(np.isnan(parameters.scales), 0.0, parameters.scales)
        scales = np.where(known > 0.0, known, 1.0 / np.where(norms > 0.0, norms, 1.0))
        if not (rows * scales).any():
            raise PkmTwinError("no motion of this robot excites the parameters to identify")
        columns, _ = choose_independent_columns(rows * scales)
        return cls(robot, parameters, columns, scales, weights)

    def singular_values(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the singular values of the scaled regressor, per root sample, (b,)."""
        table = regressor(self.robot, q, qd, qdd) @ self.parameters.mixing[:, list(self.columns)]
        table = table * self.weights[:, None] * self.scales[list(self.columns)]
        values = np.linalg.svd(table.reshape(-1, len(self.columns)), compute_uv=False)
        return np.asarray(values / np.sqrt(len(table)), np.float64)

    def condition(self, q: Array, qd: Array, qdd: Array) -> float:
        """Condition number of a motion; infinite where it does not show a base parameter."""
        values = self.singular_values(q, qd, qdd)
        return float(values[0] / values[-1]) if values[-1] > 1e-12 * values[0] else np.inf

    def recorded_condition(self, time: Array, q: Array) -> float | None:
        """Return the condition number of recorded positions; None if too few follow one another.

        :param time: shape (k,), s; ``q``: joint positions, shape (k, n).
        """
        pieces, _ = resample_recording(time, q, np.zeros_like(q))
        if not pieces:
            return None
        states = [np.concatenate([getattr(piece, name) for piece in pieces]) for name in ("q", "qd", "qdd")]
        # About 2000 samples determine the condition number; more only take time.
        step = max(1, len(states[0]) // 2000)
        return self.condition(*(rows[::step] for rows in states))


def optimize_excitation(
    judge: Judge,
    duration: float = 10.0,
    terms: int = 6,
    bounds: TrajectoryLimits | None = None,
    *,
    trials: int = 300,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> Excitation:
    """Draw random Fourier series within the limits and return the most informative one (D-optimal).

    :param duration: s. ``terms``: number of harmonics of each joint, at least 3.
    :param trials: number of trajectories drawn; ``progress`` is called with the number so far.
    :raises PkmTwinError: no trajectory drawn is within the limits, or the sampling rate of the
        written trajectory is too low for the harmonics.
    """
    robot, keep = judge.robot, bounds or TrajectoryLimits()
    centre, reach = position_range(robot)
    reach *= keep.share
    harmonics = _choose_harmonics(robot, duration, terms, reach, keep)
    whole = _TimeGrid(duration, harmonics)
    # Sines and cosines without velocity and acceleration at the ends, (2 h, 2 h - 2).
    h = len(harmonics)
    rows = np.zeros((2, 2 * h))
    rows[0, :h], rows[1, h:] = harmonics, harmonics**2
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    # High harmonics start small, because velocity limits restrict them first.
    damped = np.concatenate([1.0 / harmonics, 1.0 / harmonics])
    basis = damped[:, None] * np.linalg.svd(rows)[2][2:].T
    basis = np.asarray(basis - rows.T @ (rows @ basis), np.float64)
    rng = np.random.default_rng(seed)
    shape = (len(centre), basis.shape[1])
    coarse = np.linspace(0.0, duration, 120, endpoint=False)
    best: tuple[float, Array, Array] | None = None
    step = 1.0
    for trial in range(trials):
        fresh = best is None or trial < max(10, trials // 5)
        amount = rng.normal(size=shape)
        free = amount if fresh or best is None else best[1] + step * amount
        pair = np.moveaxis((free @ basis.T).reshape(shape[0], 2, -1), 1, 0)
        small = whole.scaled(robot, keep, reach, pair)
        fitted = _shrink_until_clear(robot, keep, duration, harmonics, centre, small, coarse)
        if fitted is not None:
            motion = _evaluate_series(coarse, duration, harmonics, centre, fitted)
            values = judge.singular_values(*motion)
            score = float(np.sum(np.log(np.maximum(values, 1e-12))))
            if best is None or score > best[0]:
                size = np.abs(fitted).max() / np.abs(pair).max()
                best = score, free * size, fitted
                step = float(np.sqrt(np.mean((free * size) ** 2))) * (0.5 if fresh else 0.4)
            elif not fresh:
                step *= 0.98
        if progress is not None:
            progress(trial + 1)
    if best is None:
        raise PkmTwinError(f"no trajectory found inside the limits; {_describe_remedy(robot, keep, centre)}")
    final = _shrink_until_clear(robot, keep, duration, harmonics, centre, best[2], whole.time, whole.margin)
    if final is None:
        raise PkmTwinError(
            "the best trajectory leaves the limits between the states of the trials; try another "
            "--seed or a smaller --singularity"
        )
    few = whole.time[:: -(-len(whole.time) // 2400)]
    condition = judge.condition(*_evaluate_series(few, duration, harmonics, centre, final))
    return Excitation(duration, harmonics, centre, final[0], final[1], condition)


def _choose_harmonics(robot: Robot, duration: float, terms: int, reach: Array, keep: TrajectoryLimits) -> Array:
    """Choose multiples of 1 / duration, up to the frequency where velocity and position limits meet."""
    # Ten points or more in a period of the highest harmonic.
    highest = keep.rate / 10.0
    if terms / duration > highest:
        raise PkmTwinError(
            f"{terms} harmonics in {duration:g} s reach {terms / duration:.3g} Hz; {keep.rate:g} "
            f"points per second allow {highest:.3g} Hz: use fewer --harmonics, a longer --duration "
            "or a higher --rate"
        )
    # Highest frequency: 1 Hz without velocity limits, never above 5 Hz.
    top = min(1.0, highest)
    if robot.limits.velocity is not None:
        velocity = np.where(np.isfinite(robot.limits.velocity), robot.limits.velocity, np.inf)
        meeting = keep.share * velocity / (2 * np.pi * reach)
        top = float(np.min(meeting, initial=min(5.0, highest)))
    most = max(terms, int(top * duration))
    # In a long trajectory the slowest harmonic would take all of the position range.
    least = max(1, min(round(most / MAX_HARMONIC_RATIO), most - terms + 1))
    return np.unique(np.round(np.linspace(least, most, terms))).astype(np.float64)


class _TimeGrid:
    """Time grid dense enough that limits kept at its points hold between them too.

    ``margin``: what a trigonometric polynomial reaches at its samples is at least this part of what
    it reaches between them (Ehlich, Zeller, 1964, doi:10.1007/BF01111276).
    """

    def __init__(self, duration: float, harmonics: Array) -> None:
        count = max(1200, 20 * round(float(harmonics[-1])))
        self.time = np.asarray(np.arange(count) * (duration / count), np.float64)
        self.margin = float(np.cos(np.pi * harmonics[-1] / count))
        eye = np.moveaxis(np.eye(2 * len(harmonics)).reshape(-1, 2, len(harmonics)), 1, 0)
        # Of positions, rates and accelerations, (states, 2 h) each.
        self.bases = _evaluate_series(self.time, duration, harmonics, np.zeros(eye.shape[1]), eye)

    def scaled(self, robot: Robot, keep: TrajectoryLimits, reach: Array, pair: Array) -> Array:
        """Scale the series (2, n, h) to the limits of position, rate and acceleration."""
        values = np.moveaxis(pair, 0, 1).reshape(pair.shape[1], -1)
        peak = [np.abs(basis @ values.T).max(0) / self.margin for basis in self.bases]
        use = [peak[0] / reach]
        if robot.limits.velocity is not None:
            use.append(peak[1] / (keep.share * robot.limits.velocity))
        if keep.acceleration is not None:
            use.append(peak[2] / (keep.share * keep.acceleration))
        return np.asarray(pair / np.max(use, 0, initial=1e-300)[:, None], np.float64)


def _shrink_until_clear(
    robot: Robot,
    keep: TrajectoryLimits,
    duration: float,
    harmonics: Array,
    centre: Array,
    pair: Array,
    time: Array,
    margin: float = 1.0,
) -> Array | None:
    """Shrink the series until it keeps clear of everything; None where it never does."""
    for _ in range(20):
        blocks = (time[k : k + 4096] for k in range(0, len(time), 4096))
        if all(
            is_clear(robot, keep, *_evaluate_series(some, duration, harmonics, centre, pair), margin) for some in blocks
        ):
            return pair
        pair = SHRINK_FACTOR * pair
    return None


def is_clear(robot: Robot, keep: TrajectoryLimits, q: Array, qd: Array, qdd: Array, margin: float) -> bool:
    """Return whether states are within the limits: assembly, singularity, workspace and efforts.

    :param margin: part of the effort limits up to which these states may go.
    """
    measure, good = robot.try_singularity(q)
    if not good.all() or (measure < keep.singularity).any():
        return False
    # Passive joints and limbs that meet: dear, so at some of the states.
    if not reachable(robot, robot.forward(q[::4])).all():
        return False
    if robot.limits.effort is None:
        return True
    efforts = inverse_dynamics(robot, q, qd, qdd)
    return bool((np.abs(efforts) <= margin * keep.share * robot.limits.effort).all())


def _describe_remedy(robot: Robot, keep: TrajectoryLimits, centre: Array) -> str:
    """Return what would let joints move about their centre (n,): the bound of the index, or limits.

    Motions shrink towards the centre, so that its index decides.
    """
    index = float(robot.try_singularity(centre[None])[0][0])
    if index >= keep.singularity:
        return "try wider limits.position"
    return (
        f"the singularity index is {index:.3g} in the middle of the travel, allowed "
        f"{keep.singularity:g} or more; {describe_singularity_bound(index)} passes there, half of it "
        "leaves room to move"
    )


@dataclass(frozen=True, eq=False)
class Sweeps:
    """Sweeps of one joint at a time, the other joints at their centres.

    ``reach``: half of each joint's travel, rad or m; ``speeds``: shape (n, speeds), rad/s or m/s.
    ``condition``: as of an :class:`Excitation`.
    """

    centre: Array
    reach: Array
    speeds: Array
    condition: float = np.inf

    @property
    def lengths(self) -> Array:
        """Durations from the centre to one end and back, s, shape (n, speeds)."""
        return np.asarray(0.5 * SWEEP_DURATION * self.reach[:, None] / self.speeds)

    @property
    def duration(self) -> float:
        """Duration of all sweeps, s."""
        return 2.0 * float(self.lengths.sum())

    def at(self, time: Array) -> tuple[Array, Array, Array]:
        """Positions, rates and accelerations, shape (k, n) each."""
        q = np.tile(self.centre, (len(time), 1))
        qd, qdd = np.zeros_like(q), np.zeros_like(q)
        start = 0.0
        # All joints at all speeds upward, then downward: a fit and what it holds out have each.
        for way, (k, j) in product((1.0, -1.0), np.ndindex(self.speeds.T.shape)):
            length = float(self.lengths[j, k])
            inside = (time >= start) & (time <= start + length)
            own, reach, speed = time[inside] - start, float(self.reach[j]), float(self.speeds[j, k])
            ramp = RAMP_FRACTION * 2.0 * reach / speed
            whole, wave = reach / speed + ramp, np.pi / ramp
            sweep = np.zeros((3, len(own)))
            # From the centre to one end and back, at rest in between.
            for begin, place, sign in ((0.0, 0.0, 1.0), (whole, reach, -1.0)):
                t = np.clip(own - begin, 0.0, whole)
                up, down = np.minimum(t, ramp), np.maximum(t - (whole - ramp), 0.0)
                x = t - up + (0.5 * (up - np.sin(wave * up) / wave))
                x -= 0.5 * (down - np.sin(wave * down) / wave)
                v = 0.5 * (1.0 - np.cos(wave * up)) - 0.5 * (1.0 - np.cos(wave * down))
                a = 0.5 * wave * (np.sin(wave * up) - np.sin(wave * down))
                now = (own >= begin) & (own <= begin + whole)
                sweep[:, now] = (sign * speed * np.stack([x, v, a]))[:, now]
                sweep[0, now] += place
            position, qd[inside, j], qdd[inside, j] = way * sweep
            q[inside, j] = self.centre[j] + position
            start += length
        return q, qd, qdd


def design_sweeps(judge: Judge, duration: float, bounds: TrajectoryLimits | None = None) -> Sweeps:
    """Design sweeps of single joints within all limits.

    :param duration: s; longer where limits of velocity or acceleration, or ramps, ask for it.
    :raises PkmTwinError: a joint that cannot move alone.
    """
    robot, keep = judge.robot, bounds or TrajectoryLimits()
    centre, reach = position_range(robot)
    reach *= keep.share
    n, ratios = len(centre), np.array(SWEEP_SPEEDS)
    limits = robot.limits.velocity
    most = np.full(n, np.inf) if limits is None else keep.share * np.broadcast_to(limits, n)
    lengths = SWEEP_DURATION * np.sum(1.0 / ratios) * n / duration

    def speeds(j: int) -> Array:
        """Choose the speeds by the duration, and the limits of the fastest sweep."""
        fastest = most[j]
        if keep.acceleration is not None:
            # A ramp of half a cosine has pi / 2 of its mean acceleration.
            change = keep.share * keep.acceleration
            fastest = min(fastest, np.sqrt(4.0 * RAMP_FRACTION * reach[j] * change / np.pi))
        slowest = min(lengths * reach[j], fastest / ratios[-1])
        # A ramp has ten points or more: a faster one is a step of the written positions.
        return np.asarray(np.minimum(slowest * ratios, 2.0 * RAMP_FRACTION * reach[j] * keep.rate / 10.0))

    for j in range(n):
        for _ in range(30):
            alone = Sweeps(centre[j : j + 1], reach[j : j + 1], speeds(j)[None])
            ends = np.append(0.0, np.cumsum(np.tile(alone.lengths, 2)))
            time = np.concatenate([np.linspace(*pair, SWEEP_STATES) for pair in pairwise(ends)])
            q = np.tile(centre, (len(time), 1))
            qd, qdd = np.zeros_like(q), np.zeros_like(q)
            q[:, j], qd[:, j], qdd[:, j] = (one[:, 0] for one in alone.at(time))
            if is_clear(robot, keep, q, qd, qdd, 1.0):
                break
            reach[j] *= SHRINK_FACTOR
        else:
            raise PkmTwinError(
                f"{robot.joint_names[j]} cannot move alone inside the limits; {_describe_remedy(robot, keep, centre)}"
            )
    found = Sweeps(centre, reach, np.array([speeds(j) for j in range(n)]))
    motion = found.at(np.linspace(0.0, found.duration, 3 * n * SWEEP_STATES))
    return Sweeps(centre, reach, found.speeds, judge.condition(*motion))
