# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A recording as rows of a least-squares problem: regressor and efforts, filtered alike.

With them the signals of the same rows that a fit's residual is held against.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Final

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for

from delta_dynamics.torques.regressor import law_columns, law_keys, parameter_values, regressor
from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import PkmTwinError, SingularityError, UnreachableError
from pkm_twin.identification.estimation import Estimate, estimate
from pkm_twin.identification.identifiable import Kind
from pkm_twin.identification.parameters import FileParameters, file_parameters
from pkm_twin.identification.samples import (
    MIN_RELATIVE_NOISE,
    MIN_SAMPLES,
    Filtering,
    Line,
    Motion,
    Track,
    estimate_noise_density,
    evaluate_blocks,
    filtered,
    find_lines,
    find_passed_band,
    fit_spline,
    resample_recording,
    select_motion,
    simulate_noise,
)
from pkm_twin.identification.verdict import write_unreachable
from pkm_twin.machine.friction import (
    KNOWN_FRACTION,
    Dahl,
    Memory,
    list_friction_keys,
    list_unshareable_laws,
    select_compiled_laws,
)
from pkm_twin.recordings.recording import Recording
from pkm_twin.robot.robot import Robot
from pkm_twin.streams.noise import estimate_deviation

BLOCK_ROWS: Final = 2048
MAX_EFFORT: Final = 1e9
"""Largest effort that a drive can have, N m or N."""
HELD_OUT_FRACTION: Final = 1 / 3
"""Fraction of each recording, at its end, that is predicted and not fitted."""


@dataclass(frozen=True, eq=False)
class Model:
    """A robot's efforts, linear in the parameters of its file.

    ``carried``: the robot with the payload that is known, while it is held; None where there is
    none.
    """

    robot: Robot
    parameters: FileParameters
    carried: Robot | None = None

    @property
    def of_drives(self) -> Mask:
        """Mask of the parameters that are friction of the drives."""
        keys, drives = list_friction_keys(), set(self.robot.joint_names)
        pairs = [name.rpartition(".")[::2] for name in self.parameters.names]
        return np.array([joint in drives and key in keys for joint, key in pairs])

    def columns(self, motion: Motion, memory: Memory | None = None) -> tuple[Array, Array]:
        """Return the parameters' columns, (k, n, p), and the efforts of all else, (k, n).

        :param memory: of the drives' friction along the motion, (k, n); None: without.
        """

        def block(rows: slice) -> Array:
            own, rest = self._columns(motion.part(rows))
            return np.concatenate([own, rest[..., None]], -1)

        both = evaluate_blocks(len(motion.q), BLOCK_ROWS, block)
        if memory is not None:
            place = {name: k for k, name in enumerate(self.parameters.names)}
            for j in np.flatnonzero(self._drives("presliding") > 0.0):
                joint = self.robot.joint_names[j]
                both[:, j, place[f"{joint}.coulomb"]] = memory.z[:, j]
                if (k := place.get(f"{joint}.presliding")) is not None:
                    both[:, j, k] = self._drives("coulomb")[j] * memory.slope[:, j]
                    both[:, j, -1] -= both[:, j, k] * self._drives("presliding")[j]
        return both[..., :-1], both[..., -1]

    def _drives(self, key: str) -> Array:
        """Return a number of the drives' friction at which efforts are linearised, shape (n,)."""
        p = self.parameters
        known = {} if p.loads is None else dict(zip(p.names, p.loads.tolist(), strict=True))
        own = zip(self.robot.joint_names, getattr(self.robot.friction, key), strict=True)
        return np.array([known.get(f"{joint}.{key}", value) for joint, value in own])

    def memory(self, track: Track, how: Filtering) -> Memory | None:
        """Return the friction hysteresis along a track; None if no drive has any."""
        distance = self._drives("presliding")
        return Dahl.states(track.q, track.find_certain_rates(how), distance) if distance.any() else None

    def efforts(self, motion: Motion, values: Array, memory: Memory | None = None) -> Array:
        """Compute efforts for parameter values, (k, n); memory as in :meth:`columns`."""
        table, rest = self.columns(motion, memory)
        return np.asarray(rest + table @ values, np.float64)

    def _columns(self, motion: Motion) -> tuple[Array, Array]:
        robot, parameters, fraction = self.robot, self.parameters, motion.payload_fraction
        pi = parameter_values(robot)
        extra = np.zeros(len(pi)) if self.carried is None else parameter_values(self.carried) - pi
        full = regressor(robot, *motion.joints, motion.wrench)
        own = full @ parameters.mixing
        rest = full @ pi - own @ parameters.values + fraction[:, None] * (full @ extra)
        for where, group in zip(parameters.slices, parameters.groups, strict=True):
            if group.kind == "payload":
                own[..., where] *= fraction[:, None, None]
        if parameters.loads is not None and law_keys(robot):
            rubs = self.of_drives
            load = rest + own[..., ~rubs] @ parameters.loads[~rubs]
            laws = law_columns(robot, motion.q, motion.qd, load)
            names = [f"{joint}.{key}" for key in law_keys(robot) for joint in robot.joint_names]
            for name, column in zip(names, np.moveaxis(laws, -1, 0), strict=True):
                own[..., parameters.names.index(name)] = column
        return own, rest


@dataclass(frozen=True, eq=False)
class Signals:
    """Signals of a recording at its rows, filtered as they are; k rows, n joints.

    ``motion``: without noise beyond the motion's band, and ``missed``: what the
    differentiation misses of qd and qdd; ``load``: of the efforts without friction, with its first
    and second derivative, (k, n) each. ``effort``: what a first fit predicts, (k, n).
    ``own``: friction of other laws, a unit of each, (k, n, laws). ``noise``: deviation of a row's
    noise as if rows were independent, (n,). ``band``: the part of the rows' rate that the filter
    passes. ``lines``: in the spectrum of the residual above the band.
    """

    motion: Motion
    missed: Array
    load: Array
    effort: Array
    own: Array
    noise: Array
    band: float
    lines: tuple[Line, ...] = ()


@dataclass(frozen=True, eq=False)
class Rows:
    """Filtered rows of one recording: time (k,), table (k, n, parameters), target (k, n).

    ``rest``: what the parameters that stay need; ``counts``: what is judged; ``change``: of the
    efforts in time, (k, n) each. ``tracks``: before the filter ``how``. ``model``: of all
    parameters. ``make``: the signals of the same rows, once: most rows need none.
    """

    recording: Recording
    model: Model
    how: Filtering
    tracks: tuple[Track, ...]
    time: Array
    table: Array
    target: Array
    rest: Array
    counts: Array
    change: Array
    outliers: int
    make: Callable[[], Signals]

    @property
    def signals(self) -> Signals:
        """Signals of the same rows, computed at the first use."""
        return self.make()

    @property
    def period(self) -> float:
        """Sampling period, s."""
        return self.tracks[0].period

    @property
    def effort(self) -> Array:
        """Measured efforts, filtered, shape (k, n)."""
        return self.target + self.rest

    @property
    def held_from(self) -> int:
        """Index of the first held-out row."""
        return round((1.0 - HELD_OUT_FRACTION) * len(self.time))

    @property
    def fitted(self) -> Rows:
        """The rows that are fitted."""
        return self._part(slice(0, self.held_from))

    def held_out(self, late: float) -> Rows:
        """Return the held-out rows, which judge a fit, with efforts put on time by a delay, s."""
        end = self._part(slice(self.held_from, None))
        return replace(end, target=end.target + late * end.change)

    def _part(self, rows: slice) -> Rows:
        cut = ("time", "table", "target", "rest", "counts", "change")
        return replace(self, **{name: getattr(self, name)[rows] for name in cut})

    def select_parameters(self, columns: Mask, values: Array) -> Rows:
        """Return rows with some of the parameters; the others stay at these values, (parameters,)."""
        stay = self.table[..., ~columns] @ values[~columns]
        return replace(self, table=self.table[..., columns], target=self.target - stay, rest=self.rest + stay)

    def reread(self, parameters: FileParameters, window: int) -> Rows:
        """Read the recording again with other parameters or another window of differentiation."""
        return make_rows(self.model.robot, parameters, self.recording, window)


def make_rows(robot: Robot, parameters: FileParameters, recording: Recording, window: int | None = None) -> Rows:
    """Return a recording's filtered rows.

    :param window: of the differentiation, samples; None chooses it.
    :raises PkmTwinError: it is too short, its joints stand still, its efforts are none, or the
        machine cannot take its positions.
    """
    r = recording
    if len(r.time) < MIN_SAMPLES:
        raise PkmTwinError(f"{r.name}: too short to fit, {len(r.time)} samples; {MIN_SAMPLES} or more in a row")
    for joint, effort in zip(robot.joint_names, r.measured.T, strict=True):
        worst = float(effort[np.argmax(~(np.abs(effort) < MAX_EFFORT))])
        if not abs(worst) < MAX_EFFORT:
            raise PkmTwinError(f"{r.name}: effort of {joint} is {worst:g}; below {MAX_EFFORT:g} is what a drive has")
        if np.ptp(effort) < 1e-9:
            only = effort[0] + 0.0  # no minus before zero
            raise PkmTwinError(f"{r.name}: effort of {joint} is {only:g} throughout: nothing was measured")
    pieces, how = resample_recording(r.time, r.q, r.measured, r.wrench, r.payload_fraction, window)
    if not pieces:
        raise PkmTwinError(f"{r.name}: too short to fit, no {MIN_SAMPLES // 2} samples without a gap")
    # With the friction laws on trial, as the robot has them.
    carried = None if r.loaded_robot is None else replace(robot, payload=r.loaded_robot.payload)
    model = Model(robot, parameters, carried)
    parts = list[_Piece]()
    try:
        for track in pieces:
            memory, moves = model.memory(track, how), track.moves(how)
            table, rest = model.columns(track, memory)
            if memory is not None:
                moves = np.where(robot.friction.presliding > 0.0, memory.unknown < KNOWN_FRACTION, moves)
            parts.append(_Piece(track, table, track.effort - rest, rest, moves.astype(np.float64)))
    except (UnreachableError, SingularityError) as error:
        raise PkmTwinError(f"{r.name}: {write_unreachable(error)}") from None
    if all(not part.moves.any() for part in parts):
        raise PkmTwinError(f"{r.name}: no excitation, the joints stand still")
    first, outliers = _drop_outliers(parts, parameters, how.keep_every)
    rubs, first_fits, columns = model.of_drives, list[_FirstFit](), list[dict[str, Array]]()
    for part in parts:
        efforts = part.rest + part.table @ first
        load = efforts - part.table[..., rubs] @ first[rubs]
        first_fits.append(_FirstFit(part.track, efforts, load, part.target - part.table @ first, part.moves))
        columns.append({name: getattr(part, name) for name in ("table", "target", "rest", "moves")})
        columns[-1]["time"] = part.track.time
        columns[-1]["doubt"] = (1.0 - part.moves) * np.abs(efforts - load)
        columns[-1]["change"] = np.gradient(efforts, part.track.period, axis=0)
    f = filtered(columns, pieces[0].period, how)
    # Where standing still is in the filter's reach, friction's sign is not known.
    moves, left = f["moves"] > 0.8, f["target"] - f["table"] @ first
    usual = [
        float(estimate_deviation(one[some])) if some.any() else 0.0 for one, some in zip(left.T, moves.T, strict=True)
    ]
    # And what it may add is below what else is left.
    least = np.maximum(usual, MIN_RELATIVE_NOISE * np.sqrt(np.mean(f["target"] ** 2, 0)))
    counts = (moves & (np.abs(f["doubt"]) < least)).astype(np.float64)
    return Rows(
        r,
        model,
        how,
        tuple(pieces),
        f["time"],
        f["table"],
        f["target"],
        f["rest"],
        counts,
        f["change"],
        outliers,
        cache(lambda: _filter_signals(r, model, how, first_fits, first)),
    )


def _filter_signals(
    r: Recording, model: Model, how: Filtering, first_fits: Sequence[_FirstFit], first: Array
) -> Signals:
    """Filter a recording's motion, wrench and efforts, and find the noise and spectral lines of its residuals.

    :param first_fits: one per piece. ``first``: the parameters of that fit.
    """
    tracks = [one.track for one in first_fits]
    left = select_motion([one.residuals for one in first_fits], [one.moves for one in first_fits])
    longest = max(tracks, key=lambda t: len(t.time))
    speed = np.sqrt(np.mean(np.concatenate([track.qd for track in tracks]) ** 2, 0))
    f = filtered([one.columns(speed, how) for one in first_fits], longest.period, how)
    shaken = simulate_noise(r, longest, how, lambda track: model.efforts(track, first, model.memory(track, how)))
    noise = estimate_noise_density(left, shaken, longest.period, how)
    size = np.sqrt(np.mean(np.concatenate([track.effort for track in tracks]) ** 2, 0))
    spectral = find_lines(left, longest.period, how, size, longest.wrench)
    rate = 1.0 / (longest.period * how.keep_every)
    missed, load = (np.moveaxis(f[name], -1, 0) for name in ("missed", "load"))
    return Signals(
        Motion(f["q"], f["qd"], f["qdd"], f["wrench"], f["payload_fraction"]),
        missed,
        load,
        f["effort"],
        f["own"],
        noise * np.sqrt(rate),
        find_passed_band(how, rate),
        spectral,
    )


@dataclass(frozen=True, eq=False)
class _Piece:
    """Regressor and efforts of one evenly sampled piece, before filtering."""

    track: Track
    table: Array
    target: Array
    rest: Array
    moves: Array
    """1 where the direction of friction is known, shape (k, n)."""


@dataclass(frozen=True, eq=False)
class _FirstFit:
    """Efforts of one piece by the first fit, before filtering, (k, n) each.

    ``load``: the efforts without the drives' friction. ``residuals``: measured less fitted.
    ``moves``: 1 where the direction of friction is known.
    """

    track: Track
    efforts: Array
    load: Array
    residuals: Array
    moves: Array

    def columns(self, speed: Array, how: Filtering) -> dict[str, Array]:
        """Return what signals are made of, by name, (samples, ...) each.

        Motion and load are those in the motion's own band, where nearly no noise is: noise in both
        of two columns would look like something in common.

        :param speed: RMS rates, (n,).
        """
        track, load, sign = self.track, self.load, np.sign(self.track.qd)
        laws = [np.abs(load) * sign, track.qd * np.abs(track.qd)]
        for share in (0.05, 0.1, 0.2):
            laws.append(np.exp(-((track.qd / np.maximum(share * speed, 1e-300)) ** 2)) * sign)
        # Nearly all of the motion is below this part of the filter's cut-off.
        cutoff = None if how.cutoff is None else 0.4 * how.cutoff
        motion, force = (fit_spline(values, track.period, cutoff) for values in (track.q, load))
        return {
            "effort": self.efforts,
            "q": motion[0],
            "qd": motion[1],
            "qdd": motion[2],
            "missed": track.missed,
            "load": np.stack(force, -1),
            "own": np.stack(laws, -1),
            "wrench": track.wrench,
            "payload_fraction": track.payload_fraction,
        }


def _drop_outliers(parts: list[_Piece], parameters: FileParameters, every: int) -> tuple[Array, int]:
    """Replace isolated efforts far from a first robust fit by its values.

    :returns: that fit's parameters, and how many efforts.
    """
    table, target, rest, moves = (
        np.concatenate([getattr(part, name)[::every] for part in parts])
        for name in ("table", "target", "rest", "moves")
    )
    scales = prior_scales(parameters, table, target + rest)
    first = estimate(table, target, parameters.values, scales, judged=moves).values
    count = 0
    for part in parts:
        predicted = part.table @ first
        away = np.abs(part.target - predicted)
        bound = 8.0 * estimate_deviation(part.target - predicted)
        # Where friction turns over, an effort that is some samples late is no outlier.
        near = scipy.ndimage.maximum_filter1d(np.abs(np.diff(predicted, axis=0, prepend=predicted[:1])), 7, axis=0)
        far = (away > bound + 2.0 * near) & (bound > 1e-6 * np.abs(part.target).max(0))
        far &= ~scipy.ndimage.binary_opening(far, np.ones((10, 1)))
        if far.mean() > 0.05:
            continue
        part.target[far] = predicted[far]
        count += int(far.sum())
    return first, count


def prior_scales(parameters: FileParameters, table: Array, effort: Array) -> Array:
    """Return the prior's deviations; friction and rotors may be all of the joints' efforts."""
    scales = parameters.scales.copy()
    size = np.sqrt(np.mean(effort**2, 0))
    columns = np.sqrt(np.mean(table**2, 0))
    for k in np.flatnonzero(np.isnan(scales)):
        joint = int(np.argmax(columns[:, k]))
        shown = columns[joint, k]
        scales[k] = size[joint] / shown if shown > 0.0 else 0.0
    kinds = [name.rpartition(".")[2] for name in parameters.names]
    for k in np.flatnonzero(scales == 0.0):
        # If its joint does not move, a parameter gets the largest scale of its kind.
        alike = [s for s, kind in zip(scales, kinds, strict=True) if kind == kinds[k] and s > 0.0]
        scales[k] = max(alike, default=1.0)
    return scales


MAX_PASSES: Final = 6
"""Largest number of repetitions of a fit whose columns depend on its values."""
SETTLED_CHANGE: Final = 0.1
"""Change between two repetitions, in standard deviations, that does not count."""
MIN_VALUES_PER_NUMBER: Final = 5.0
"""Smallest number of independent measured values for each fitted number."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Recordings as one least-squares problem in some of the parameters of a robot's file.

    ``everything``: all parameters, ``whole``: rows with all of them, by recording. ``what``: the
    kinds that are fitted.
    """

    robot: Robot
    what: tuple[Kind, ...]
    everything: FileParameters
    whole: tuple[Rows, ...]

    @classmethod
    def from_recordings(
        cls,
        robot: Robot,
        recordings: Sequence[Recording],
        what: Sequence[Kind],
        passes: int = MAX_PASSES,
        progress: Callable[[int], None] | None = None,
        known: Sequence[Rows] = (),
    ) -> Problem:
        """Filter recordings and build their regressors.

        :param passes: largest number of repetitions in which load-dependent friction and hysteresis
            use the values of the previous fit instead of the file's, until these stay.
        :param progress: called with the number of recordings processed so far.
        :param known: rows of the same robot that are used again instead of being recomputed.
        """
        everything, whole = file_parameters(robot), list[Rows]()
        for i, recording in enumerate(recordings):
            same = (one for one in known if one.recording is recording and one.model.robot is robot)
            whole.append(next(same, None) or make_rows(robot, everything, recording))
            if progress is not None:
                progress(i + 1)
        problem = cls(robot, tuple(what), everything, tuple(whole))
        laws = (*select_compiled_laws(robot.laws), *robot.open_laws)
        for _ in range(passes if list_unshareable_laws(laws) else 0):
            before = problem.estimate
            opened = replace(everything, loads=problem.values)
            whole = [made.reread(opened, made.how.window) for made in problem.whole]
            problem = replace(problem, everything=opened, whole=tuple(whole))
            deviations = np.sqrt(np.diag(before.covariance))
            if (np.abs(problem.estimate.values - before.values) <= SETTLED_CHANGE * deviations).all():
                break
        return problem

    @cached_property
    def parameters(self) -> FileParameters:
        """Parameters that are fitted."""
        return file_parameters(self.robot, self.what)

    @cached_property
    def chosen(self) -> Mask:
        """Mask of the fitted ones among all parameters."""
        return np.isin(self.everything.kinds, self.what)

    @cached_property
    def rows(self) -> tuple[Rows, ...]:
        """Rows with the fitted parameters alone."""
        return tuple(made.select_parameters(self.chosen, self.everything.values) for made in self.whole)

    @cached_property
    def columns(self) -> Array:
        """Regressor of parameters and delays, (samples, n, both), over all fitted rows."""
        used = [made.fitted for made in self.rows]
        # To first order a delay subtracts the efforts' derivative times the delay.
        late = [np.concatenate([-made.change * (i == j) for j, made in enumerate(used)]) for i in range(len(used))]
        table = np.concatenate([made.table for made in used])
        return np.concatenate([table, np.stack(late, -1)], -1)

    @cached_property
    def both(self) -> Estimate:
        """The parameters by least squares, then how late the efforts of each recording are, s."""
        used, count = [made.fitted for made in self.rows], len(self.rows)
        target, effort, counts = (
            np.concatenate([getattr(made, name) for made in used]) for name in ("target", "effort", "counts")
        )
        p, table = self.parameters, self.columns
        scales = prior_scales(p, table[..., :-count], effort)
        return estimate(
            table,
            target,
            np.append(p.values, np.zeros(count)),
            np.append(scales, [2.0 * made.period for made in used]),
            p.cones,
            counts,
        )

    @cached_property
    def estimate(self) -> Estimate:
        """Return the estimate of the file's parameters, without the delays."""
        e, k = self.both, slice(0, -len(self.rows))
        return replace(e, values=e.values[k], covariance=e.covariance[k, k], prior=e.prior[k])

    @property
    def delays(self) -> tuple[float, ...]:
        """Delay of each recording's efforts, s, beside what was compensated."""
        return tuple(self.both.values[-len(self.rows) :].tolist())

    @property
    def total_delays(self) -> tuple[float, ...]:
        """Delays of each recording's efforts after the positions, s."""
        return tuple(made.recording.late + late for made, late in zip(self.whole, self.delays, strict=True))

    @property
    def held_out(self) -> list[Rows]:
        """Held-out rows, corrected for the delays."""
        pairs = zip(self.rows, self.delays, strict=True)
        return [made.held_out(late) for made, late in pairs]

    @property
    def values(self) -> Array:
        """Values of all parameters: fitted ones as estimated, others as in the file."""
        values = self.everything.values.copy()
        values[self.chosen] = self.estimate.values
        return values

    def check_count(self) -> None:
        """Reject fewer independent values than the numbers need.

        :raises PkmTwinError: with how many there are.
        """
        directions = self.both.directions
        used = ((made.fitted.counts.sum(), made.signals.band) for made in self.rows)
        values = sum(float(count) * band for count, band in used)
        if values < MIN_VALUES_PER_NUMBER * directions:
            raise PkmTwinError(
                f"too few samples: {values:.0f} independent efforts for {directions} numbers of "
                f"{', '.join(self.what)}, {MIN_VALUES_PER_NUMBER * directions:.0f} or more are needed; record a "
                "motion with more changes of speed (`pkm-twin excite`), or fit less with --what"
            )
