# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Measured efforts against the model's, by the derivative, filter and noise of a fit.

Nothing is fitted but how late the efforts are against the positions, as in a fit.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for

from delta_dynamics.torques.stiction import beyond_friction, friction_reach, zero_resting_rates
from delta_dynamics.torques.virtual_work import inverse_dynamics, null_efforts
from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import PkmTwinError
from pkm_twin.identification.estimation import estimate
from pkm_twin.identification.rows import BLOCK_ROWS
from pkm_twin.identification.samples import (
    Filtering,
    Track,
    estimate_noise_density,
    filtered,
    find_passed_band,
    kept_rows,
    resample_recording,
    simulate_noise,
)
from pkm_twin.identification.verdict import MAX_DELAY, MAX_NOISE_RATIO, write_late
from pkm_twin.machine.friction import Dahl
from pkm_twin.recordings import Load, Recording, find_resting_joints, split_by_load
from pkm_twin.report import Fact, make_judged_fact
from pkm_twin.robot.robot import Robot
from pkm_twin.streams.drives import find_idle_samples
from pkm_twin.streams.noise import estimate_deviation
from pkm_twin.streams.rates import rms
from pkm_twin.streams.steps import Steps, find_sampling

MAX_MISSING: Final = 0.01
"""Largest fraction of the expected samples that may be missing."""
MAX_RESIDUAL: Final = 0.05
"""Largest good RMS torque residual, as a fraction of the joint's peak effort."""
MIN_PIECE_SAMPLES: Final = 40
"""Smallest number of samples of a piece: fewer than for a fit, as nothing is fitted."""
MAX_LOCAL_RATIO: Final = 3.0
"""Largest RMS residual over 0.25 s, as a multiple of the limit for the whole recording."""
MIN_REST_TIME: Final = 0.05
"""Shortest time, s, for which a constant position is a rest and a constant effort is stuck."""
MAX_PAYLOAD_MARGIN: Final = 0.5
"""Longest time before and after a pick or release that is not compared, s."""
MAX_DELAY_PASSES: Final = 4
"""Largest number of delay corrections: each finds the delay to first order."""


@dataclass(frozen=True, eq=False)
class EffortComparison:
    """Efforts of a recording in the band of its motion, k rows, n joints.

    ``time``: (k,), s; ``measured``, ``expected``, ``residual``: (k, n), N m or N; ``change``: of
    the expected efforts, per s; ``raw``: the residual before the filter. ``noise``: standard
    deviation in the band, ``peak``: of the model's efforts, ``hidden``: whether noise hides them,
    (n,). ``late``: of the efforts against the positions, taken out, s. ``starts``: the first rows
    of the pieces. ``tracks``: their motion before the filter, and ``inner``, which part of it has
    rows. ``bound``: of a good residual, RMS, as a part of the peak.
    """

    time: Array
    measured: Array
    expected: Array
    change: Array
    residual: Array
    raw: Array
    noise: Array
    peak: Array
    hidden: Mask
    late: float
    period: float
    starts: tuple[int, ...]
    tracks: tuple[Track, ...]
    inner: tuple[slice, ...]
    how: Filtering
    bound: float

    @property
    def edge(self) -> float:
        """Time over which the filter spreads a step, s."""
        return 0.0 if self.how.cutoff is None else 1.0 / self.how.cutoff

    @property
    def rests(self) -> Mask:
        """Mask of rests of each joint, and of the rows that the filter mixes with them, (k, n).

        Dry friction holds any effort there, and a rest does not change it.
        """
        spans = 0.5 * MIN_REST_TIME, self.edge
        long, near = (np.ones((2 * round(span / self.period) + 1, 1)) for span in spans)
        parts = []
        for track, rows in zip(self.tracks, self.inner, strict=True):
            rests = scipy.ndimage.binary_opening(~track.moves(self.how), long)
            parts.append(scipy.ndimage.binary_dilation(rests, near)[rows])
        return np.concatenate(parts)

    @property
    def rms(self) -> Array:
        """RMS of the residual, shape (n,)."""
        return rms(self.residual)

    @property
    def limit(self) -> Array:
        """Largest good residual, RMS, shape (n,): a fraction of the peak, and not below the noise."""
        return np.maximum(self.bound * self.peak, MAX_NOISE_RATIO * self.noise)

    def find_largest_local_rms(self) -> tuple[Array, Array]:
        """Return the residual's largest RMS within 0.25 s, and the time of that window's middle, s, (n,) each."""
        n = self.residual.shape[1]
        worst, at = np.zeros(n), np.full(n, self.time[0])
        # A collision is shorter than a recording: each quarter of a second is judged by itself.
        width = max(1, round(0.25 / self.period))
        for begin, end in zip(self.starts, (*self.starts[1:], len(self.time)), strict=True):
            some = min(width, end - begin)
            total = np.cumsum(self.residual[begin:end] ** 2, 0)
            total = np.concatenate([np.zeros((1, n)), total])
            found = np.sqrt(np.maximum(total[some:] - total[:-some], 0.0) / some)
            place = found.argmax(0)
            more = found.max(0) > worst
            worst = np.where(more, found.max(0), worst)
            at = np.where(more, self.time[begin + place + some // 2], at)
        return worst, at

    def find_first_excess(self) -> float | None:
        """Return when the residual first exceeds the local limit of any joint, s; None: never.

        Before the filter, which spreads a step in time.
        """
        away = np.abs(self.raw)
        usual, limit = estimate_deviation(self.raw), self.limit
        far = away > MAX_LOCAL_RATIO * limit + 4.0 * np.minimum(usual, limit)
        beyond: Mask = np.asarray(far.any(1), np.bool_)
        # A single row may be noise, so two in a row are required.
        rows = np.flatnonzero(beyond[1:] & beyond[:-1])
        return float(self.time[rows[0]]) if len(rows) else None

    @property
    def good(self) -> Mask:
        """Mask of the joints whose efforts agree with the model, shape (n,)."""
        return np.asarray((self.rms <= self.limit) & (self.find_largest_local_rms()[0] <= MAX_LOCAL_RATIO * self.limit))

    @property
    def delayed(self) -> str:
        """Words for efforts that are later than a recording's may be; empty if they are not."""
        return write_late("all joints", self.late) if abs(self.late) > MAX_DELAY else ""


def evaluate_loaded(r: Recording, function: Callable[..., Array], time: Array, *motion: Array) -> Array:
    """Evaluate a function of the robot, loaded while it holds its payload, and a motion, (k, n)."""
    parts = split_by_load(r.robot, r.load, time, BLOCK_ROWS)
    return np.concatenate([function(robot, *(v[rows] for v in motion)) for robot, rows in parts])


def _project_motion(robot: Robot, q: Array) -> Array:
    """Return the projection of efforts on the smallest ones with the same motion, (k, n, n).

    Smallest over their limits. Drives that share may do so otherwise than the model says: what they
    give against each other moves nothing. The identity where no drives share.
    """
    one = np.eye(robot.joints_count)
    if not robot.redundant:
        return np.broadcast_to(one, (len(q), *one.shape))
    rows = null_efforts(robot, q)
    return one - rows.swapaxes(-1, -2) @ (rows / robot.effort_scale**2)


def compare(r: Recording, bound: float = MAX_RESIDUAL) -> EffortComparison | None:
    """Compare a recording with the model; None where no piece of it is long enough.

    Velocities and accelerations of a recording that has both are used as they are. Of drives that
    share, what moves nothing is in neither efforts. Late efforts that agree once they are put on
    time are put on time.

    :param bound: of a good residual, RMS, as a part of the peak effort.
    """
    first, made = _compare_recording(r, bound), r
    c = first
    for _ in range(MAX_DELAY_PASSES):
        if c is None or abs(c.late - made.late) <= c.period:
            break
        made = made.compensate_effort_delay(c.late - made.late)
        c = _compare_recording(made, bound) if len(made.time) >= MIN_PIECE_SAMPLES else None
    return first if c is None or not c.good.all() else c


def _compare_recording(r: Recording, bound: float) -> EffortComparison | None:
    """Compare measured and modelled efforts; the delay is estimated and removed to first order."""
    robot, reach = r.robot, friction_reach(r.robot)
    rates = None if r.qd is None or r.qdd is None else (r.qd, r.qdd)
    pieces, how = resample_recording(r.time, r.q, r.measured, r.wrench, rates=rates, min_samples=MIN_PIECE_SAMPLES)
    if not pieces:
        return None

    def compute_efforts(track: Track) -> Array:
        """Compute the model's efforts, the smallest ones with the same motion."""
        qd = zero_resting_rates(track.qd, ~track.moves(how), reach)
        efforts = evaluate_loaded(r, inverse_dynamics, track.time, track.q, qd, track.qdd, track.wrench)
        efforts = efforts + Dahl.bounded_memory_effort(robot.friction, track.q, qd)[0]
        return np.asarray(np.einsum("kij,kj->ki", _project_motion(robot, track.q), efforts), np.float64)

    period, every, how = pieces[0].period, how.keep_every, replace(how, keep_every=1)
    sharp: list[dict[str, Array]] = []
    for track in pieces:
        expected, projection = compute_efforts(track), _project_motion(robot, track.q)
        _, doubt = Dahl.bounded_memory_effort(robot.friction, track.q, track.find_certain_rates(how))
        slack = np.einsum("kij,kj->ki", np.abs(projection), np.where(track.moves(how), doubt, reach))
        measured = np.einsum("kij,kj->ki", projection, track.effort)
        left = beyond_friction(measured - expected, slack > 0.0, slack)
        change = np.gradient(expected, period, axis=0)
        qd = zero_resting_rates(track.qd, ~track.moves(how), reach)
        rubs = np.concatenate([projection * part[:, None] for part in (qd, np.sign(qd))], -1)
        sharp.append({"expected": expected, "left": left, "change": change, "rubs": rubs})
    smooth = filtered(sharp, period, how)
    expected, left, change, rubs = smooth.values()
    inside = [kept_rows(len(track.time), period, how) for track in pieces]
    starts = np.cumsum([0, *(rows.stop - rows.start for rows in inside[:-1])]).tolist()
    time = np.concatenate([one.time[rows] for one, rows in zip(pieces, inside, strict=True)])
    cut_left, cut_change = (
        np.concatenate([one[name][rows] for one, rows in zip(sharp, inside, strict=True)])
        for name in ("left", "change")
    )
    # The delay, beside other friction of the drives; one at the bound is the effect of another error.
    some, rubs = left[::every], rubs[::every]
    table = np.concatenate([-change[::every, ..., None], rubs], -1)
    scales = max(float(rms(some).max()), 1e-12) / np.maximum(np.sqrt(np.mean(rubs**2, (0, 1))), 1e-12)
    found = estimate(table, some, np.zeros(table.shape[-1]), np.array([MAX_DELAY, *scales]))
    late, sure = float(found.values[0]), 3.0 * np.sqrt(found.covariance[0, 0])
    late = late if sure < abs(late) < MAX_DELAY else 0.0
    longest = max(pieces, key=lambda track: len(track.time))
    raw = [one["left"] for one in sharp]
    long = [one for one in raw if len(one) >= 256] or [max(raw, key=len)]
    shaken = np.zeros_like(r.q) if rates is not None else simulate_noise(r, longest, how, compute_efforts)
    noise = estimate_noise_density(long, shaken, period, how) * np.sqrt(find_passed_band(how, 1.0 / period) / period)
    residual, size, units = left + late * change, np.abs(expected).max(0), np.array(robot.effort_units)
    # A joint with next to no effort is judged as if it had a twentieth of the greatest of its unit.
    # Noise as large as half of the efforts hides efforts that are twice the model's.
    greatest, greatest_rms = (
        np.array([sizes[units == unit].max() for unit in units]) for sizes in (size, rms(expected + residual))
    )
    return EffortComparison(
        time,
        expected + residual,
        expected,
        change,
        residual,
        cut_left + late * cut_change,
        noise,
        np.maximum(size, 0.05 * greatest),
        MAX_NOISE_RATIO * noise > 0.5 * greatest_rms,
        r.late + late,
        period,
        tuple(starts),
        tuple(pieces),
        tuple(inside),
        how,
        bound,
    )


def describe_delay(late: float, period: float) -> str:
    """Describe how late efforts are against the positions; empty within a tenth of a sample."""
    if abs(late) <= 0.1 * period:
        return ""
    return f"{1e3 * abs(late):.3g} ms {'late' if late > 0.0 else 'early'}"


def missing_samples(time: Array) -> Fact:
    """Judge how many samples are missing.

    :param time: rising, shape (k,), k 2 or more, s.
    """
    sampling, good, numbers = find_sampling(time), None, dict[str, Any]()
    text = "the samples have no common period"
    if sampling.missing is not None:
        share = sampling.missing / sampling.expected
        text, good = f"{sampling.missing} of {sampling.expected}", share <= MAX_MISSING
        numbers = {"number": share, "limit": MAX_MISSING}
        text += f" ({100 * share:.3g} %)" if sampling.missing else ""
    bound = f"at most {100 * MAX_MISSING:g} %"
    return make_judged_fact("missing samples", text, bound, good, **numbers)


def near_jumps(steps: Steps, count: int) -> Mask:
    """Find samples so near to a jump that no derivative holds there, shape (count,)."""
    found = np.zeros(count, np.bool_)
    for k in np.flatnonzero(steps.jumps.any(1)):
        found[max(k - 4, 0) : k + 6] = True
    return found


def cut_recording(r: Recording, leave_out: Mask | None = None) -> Recording:
    """Remove samples near a pick, a release or a step, and those of idle drives.

    :param leave_out: the latter two, (samples,), where they are known. A gap divides the recording.
    """
    if leave_out is None:
        leave_out = near_jumps(r.steps, len(r.time))
        # Currents are not compared with efforts, and what has no state is the fit's to reject.
        with suppress(PkmTwinError, ValueError):
            leave_out |= find_idle(r) & (r.efforts != "current")
        # If no sample would remain, keep all: the efforts themselves are the fault.
        leave_out &= not leave_out.all()
    return r.select(~(leave_out | near_change(r)[0]))


def near_change(r: Recording, load: Load | None = None) -> tuple[Mask, float]:
    """Find samples next to a pick or release, shape (samples,), and how near they are, s."""
    load, within = load or r.load, MAX_PAYLOAD_MARGIN
    if load is None or not load.times:
        return np.zeros(len(r.time), np.bool_), within
    if len(r.time) >= MIN_PIECE_SAMPLES:
        rates = None if r.qd is None or r.qdd is None else (r.qd, r.qdd)
        pieces, how = resample_recording(r.time, r.q, np.zeros_like(r.q), rates=rates, min_samples=MIN_PIECE_SAMPLES)
        if how.cutoff is not None:
            within = min(MAX_PAYLOAD_MARGIN, 4.0 / how.cutoff)
        elif any(piece.qd.any() for piece in pieces):
            # Not filtered from a fifth of the rate of the samples on.
            within = min(MAX_PAYLOAD_MARGIN, 20.0 * pieces[0].period)
    return load.near_change(r.time, within), within


def compare_part(r: Recording, idle: Mask, bound: float = MAX_RESIDUAL) -> EffortComparison | None:
    """Filter efforts to the band of the motion, without samples whose drives are idle."""
    part = cut_recording(r, idle)
    return None if len(part.time) < 3 else compare(part, bound)


def find_idle(r: Recording) -> Mask:
    """Find samples with zero efforts, or constant ones at standstill, against the model."""
    assert r.effort is not None  # noqa: S101
    still = np.zeros_like(r.q)
    wrench = np.zeros((len(r.time), 6)) if r.wrench is None else r.wrench
    needed = evaluate_loaded(r, inverse_dynamics, r.time, r.q, still, still, wrench)
    rates = r.qd
    if rates is None:
        rates = np.gradient(r.q, r.time, axis=0) if len(r.time) > 1 else still
    return find_idle_samples(r.time, find_resting_joints(r, rates), r.effort, needed)
