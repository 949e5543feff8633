# SPDX-License-Identifier: Apache-2.0
"""The numbers of a robot's file from recordings of its motion and efforts.

The last third of every recording is held out: it is judged, not fitted. Efforts may be late
against positions, by some samples and alike in all joints: a drive that holds its torque for a
period would else look like friction. How late is fitted beside, for each recording. Two windows of
the differentiation are fitted; what they differ by counts as uncertainty beside the noise's.

May import: numpy, pkm_twin's core, this package, the standard library.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from delta_dynamics.estimation import Estimate, estimate
from delta_dynamics.file_parameters import FileParameters, file_parameters
from delta_dynamics.regressor import parameter_values, regressor
from delta_dynamics.samples import LEAST, WINDOWS, Filtering, Track, by_blocks, low_pass, tracks
from pkm_twin.errors import PkmTwinError
from pkm_twin.machine.robot import Robot
from pkm_twin.machine.shared import KINDS, Key, Kind, Shared

Array = NDArray[np.float64]
Status = Literal["fitted", "combination", "not excited"]

HELD_OUT: Final = 1 / 3
"""Part of each recording, its end, that is judged and not fitted."""
BLOCK: Final = 2048
OUTLIER: Final = 8.0
"""Robust deviations beyond which a measured effort is no measurement."""
STILL: Final = 4.0
"""Deviations of a rate's noise below which a joint stands still."""
SURE: Final = 0.2
"""A number that is known this much better than before is fitted."""
STAYS: Final = 1e-3
"""Change over the deviation before that says nothing."""
LATE: Final = 2.0
"""Samples by which efforts may well be late."""
UNSURE: Final = 0.98
"""One that is known no better than this is not excited."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """A recording: ``time`` (k,), s; q and efforts (k, n); wrench (k, 6) or None.

    ``held``: 1 where the payload that is looked for is on the platform, shape (k,). ``carried``:
    a robot with the payload that is known, while it is held; None where there is none.
    """

    name: str
    time: Array
    q: Array
    effort: Array
    wrench: Array | None = None
    held: Array | None = None
    carried: Robot | None = None


@dataclass(frozen=True)
class Number:
    """One number of the file: where it stands, before and after, and its standard deviation.

    ``share``: the deviation over that of before. ``status``: ``fitted``; ``combination``: known
    only together with others; ``not excited``: the motion tells nothing, the file's value stays.
    """

    key: Key
    unit: str
    before: float
    after: float
    deviation: float
    share: float
    status: Status

    @property
    def name(self) -> str:
        """The key, with dots."""
        return "".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in self.key)[1:]


@dataclass(frozen=True, eq=False)
class Judged:
    """Held-out efforts of a recording: ``time`` (k,), s; measured, before and after (k, n)."""

    name: str
    time: Array
    measured: Array
    before: Array
    after: Array

    def rms(self, which: Array) -> Array:
        """Of measured less predicted, shape (n,)."""
        return np.asarray(np.sqrt(np.mean((self.measured - which) ** 2, 0)), np.float64)


@dataclass(frozen=True, eq=False)
class Fit:
    """What recordings say of a robot's file."""

    robot: Robot
    parameters: FileParameters
    estimate: Estimate
    numbers: tuple[Number, ...]
    judged: tuple[Judged, ...]
    filtering: tuple[Filtering, ...]
    outliers: int
    samples: int
    delays: tuple[float, ...]
    """How late the efforts are against the positions, s, by recording."""

    def of(self, status: Status) -> tuple[Number, ...]:
        """The numbers of a status."""
        return tuple(number for number in self.numbers if number.status == status)


@dataclass(frozen=True, eq=False)
class _Rows:
    """Filtered rows of one recording: time (k,), table (k, n, parameters), target (k, n).

    ``rest``: what the parameters that stay need; ``counts``: what is judged; ``change``: of the
    efforts in time, (k, n) each. ``period``: of the samples, s.
    """

    time: Array
    table: Array
    target: Array
    rest: Array
    counts: Array
    change: Array
    outliers: int
    period: float

    def part(self, rows: slice) -> _Rows:
        return _Rows(
            self.time[rows], self.table[rows], self.target[rows], self.rest[rows],
            self.counts[rows], self.change[rows], self.outliers, self.period,
        )  # fmt: skip


def fit(
    robot: Robot,
    recordings: Sequence[Recorded],
    what: Sequence[Kind] = KINDS,
    *,
    progress: Callable[[int], None] | None = None,
) -> Fit:
    """Fit some kinds of numbers of a robot's file.

    :param what: of ``friction``, ``rotor``, ``payload``, ``inertia``.
    :param progress: called with the number of recordings that are worked on, twice each.
    :raises PkmTwinError: recordings that are too short, or that show nothing.
    """
    parameters = file_parameters(robot, what)
    rows, filtering = [], []
    for i, recording in enumerate(recordings):
        made, how = _rows(robot, parameters, recording, None)
        rows.append(made)
        filtering.append(how)
        if progress is not None:
            progress(2 * i + 1)
    result, delays = _estimate(parameters, rows)
    other = []
    for i, (recording, how) in enumerate(zip(recordings, filtering, strict=True)):
        other.append(_rows(robot, parameters, recording, _next_window(how.window))[0])
        if progress is not None:
            progress(2 * i + 2)
    again, _ = _estimate(parameters, other)
    result = _less_sure(result, again.values - result.values)
    numbers = tuple(n for group in _numbers(parameters, result) for n in group)
    if not result.directions or all(n.status == "not excited" for n in numbers):
        raise PkmTwinError(
            f"no excitation: the motion tells nothing of {', '.join(what)}; a trajectory that "
            "does: pkm-twin excite"
        )
    judged = []
    for recording, made in zip(recordings, rows, strict=True):
        end = made.part(slice(_split(made), None))
        before, after = (end.rest + end.table @ v for v in (parameters.values, result.values))
        judged.append(Judged(recording.name, end.time, end.target + end.rest, before, after))
    return Fit(
        robot, parameters, result, numbers, tuple(judged), tuple(filtering),
        sum(made.outliers for made in rows), sum(_split(made) for made in rows), delays,
    )  # fmt: skip


def _split(rows: _Rows) -> int:
    return round((1.0 - HELD_OUT) * len(rows.time))


def _next_window(window: int) -> int:
    """The window that is fitted beside: the next shorter one, of the shortest the next."""
    k = WINDOWS.index(window)
    return WINDOWS[k - 1] if k else WINDOWS[1]


def _rows(
    robot: Robot, parameters: FileParameters, recording: Recorded, window: int | None
) -> tuple[_Rows, Filtering]:
    """A recording's filtered rows.

    :raises PkmTwinError: it is too short, or its joints stand still.
    """
    r = recording
    if len(r.time) < LEAST:
        raise PkmTwinError(
            f"{r.name}: too short to fit, {len(r.time)} samples; {LEAST} or more in a row"
        )
    none = np.zeros((len(r.time), 6))
    held = np.ones(len(r.time)) if r.held is None else r.held
    pieces, how = tracks(
        r.time, r.q, r.effort, none if r.wrench is None else r.wrench, held, window
    )
    if not pieces:
        raise PkmTwinError(f"{r.name}: too short to fit, no {LEAST // 2} samples without a gap")
    parts = [_piece(robot, parameters, r.carried, track) for track in pieces]
    if all(not part.moves.any() for part in parts):
        raise PkmTwinError(f"{r.name}: no excitation, the joints stand still")
    first, outliers = _drop_outliers(parts, parameters, how.keep_every)
    made = [part.filtered(first, track, how) for part, track in zip(parts, pieces, strict=True)]
    joined = [np.concatenate([one[k] for one in made]) for k in range(6)]
    return _Rows(*joined, outliers, pieces[0].period), how


@dataclass(frozen=True, eq=False)
class _Piece:
    """One even piece before the filter."""

    table: Array
    target: Array
    rest: Array
    moves: Array
    """1 where a joint moves, or where standing still is no matter, shape (k, n)."""

    def filtered(self, first: Array, track: Track, how: Filtering) -> tuple[Array, ...]:
        """Time, table, target, rest, what counts and the efforts' change, all filtered alike."""
        samples = len(self.table)
        change = np.gradient(self.rest + self.table @ first, track.period, axis=0)
        flat = np.concatenate(
            [self.table.reshape(samples, -1), self.target, self.rest, self.moves, change,
             track.time[:, None]], 1,
        )  # fmt: skip
        smooth = low_pass(flat, track.period, how)
        n = self.target.shape[1]
        ends = np.cumsum([self.table[0].size, n, n, n, n])
        table, target, rest, moves, change, time = np.split(smooth, ends, 1)
        # Where standing still is in the filter's reach, friction's sign is not known.
        counts = (moves > 0.8).astype(np.float64)
        return time[:, 0], table.reshape(len(table), n, -1), target, rest, counts, change


def _piece(robot: Robot, parameters: FileParameters, carried: Robot | None, track: Track) -> _Piece:
    pi = parameter_values(robot)
    extra = np.zeros(len(pi)) if carried is None else parameter_values(carried) - pi
    loads = [
        where
        for where, group in zip(parameters.slices, parameters.groups, strict=True)
        if group.kind == "payload"
    ]

    def block(rows: slice) -> Array:
        full = regressor(robot, track.q[rows], track.qd[rows], track.qdd[rows], track.wrench[rows])
        own = full @ parameters.mixing
        held = track.held[rows]
        rest = full @ pi - own @ parameters.values + held[:, None] * (full @ extra)
        for where in loads:
            own[..., where] *= held[:, None, None]
        return np.concatenate([own, rest[..., None]], -1)

    both = by_blocks(len(track.q), BLOCK, block)
    table, rest = both[..., :-1], both[..., -1]
    rate_noise = STILL * np.abs(track.qd - np.asarray(_smooth(track.qd))).mean(0)
    moves = np.abs(track.qd) > np.maximum(rate_noise, 1e-9)
    return _Piece(table, track.effort - rest, rest, moves.astype(np.float64))


def _smooth(values: Array) -> Array:
    """A running mean of three."""
    inner = (values[:-2] + values[1:-1] + values[2:]) / 3.0
    return np.concatenate([values[:1], inner, values[-1:]])


def _drop_outliers(
    parts: list[_Piece], parameters: FileParameters, every: int
) -> tuple[Array, int]:
    """Efforts far from a first robust fit take its values, but not where they are many.

    :returns: that fit's parameters, and how many efforts.
    """
    table = np.concatenate([part.table[::every] for part in parts])
    target = np.concatenate([part.target[::every] for part in parts])
    scales = _scales(parameters, table, target)
    first = estimate(table, target, parameters.values, scales).values
    count = 0
    for part in parts:
        told = part.table @ first
        away = np.abs(part.target - told)
        bound = OUTLIER * 1.4826 * np.median(away, axis=0)
        far = (away > bound) & (bound > 1e-6 * np.abs(part.target).max(0))
        if far.mean() > 0.05:
            continue
        part.target[far] = told[far]
        count += int(far.sum())
    return first, count


def _scales(parameters: FileParameters, table: Array, target: Array) -> Array:
    """The prior's deviations; of friction and rotors what would be all of the joints' efforts."""
    scales = parameters.scales.copy()
    size = np.sqrt(np.mean(target**2, 0))
    columns = np.sqrt(np.mean(table**2, 0))
    for k in np.flatnonzero(np.isnan(scales)):
        joint = int(np.argmax(columns[:, k]))
        shown = columns[joint, k]
        scales[k] = size[joint] / shown if shown > 0.0 else 0.0
    kinds = [name.rpartition(".")[2] for name in parameters.names]
    for k in np.flatnonzero(scales == 0.0):
        # As uncertain as the others of its sort, where its joint does not move.
        alike = [s for s, kind in zip(scales, kinds, strict=True) if kind == kinds[k] and s > 0.0]
        scales[k] = max(alike, default=1.0)
    return scales


def _estimate(
    parameters: FileParameters, rows: Sequence[_Rows]
) -> tuple[Estimate, tuple[float, ...]]:
    """Of the parameters, and how late the efforts of each recording are, s."""
    used = [made.part(slice(0, _split(made))) for made in rows]
    table, target, counts = (
        np.concatenate([getattr(made, name) for made in used])
        for name in ("table", "target", "counts")
    )
    scales = _scales(parameters, table, target)
    # Late by a delay is less the delay times the change.
    late = [
        np.concatenate(
            [-made.change if i == j else 0.0 * made.change for j, made in enumerate(used)]
        )
        for i in range(len(used))
    ]
    k = len(scales)
    found = estimate(
        np.concatenate([table, np.stack(late, -1)], -1), target,
        np.append(parameters.values, np.zeros(len(used))),
        np.append(scales, [LATE * made.period for made in used]), parameters.cones, counts,
    )  # fmt: skip
    own = replace(
        found, values=found.values[:k], covariance=found.covariance[:k, :k], prior=found.prior[:k]
    )
    return own, tuple(found.values[k:].tolist())


def _less_sure(result: Estimate, change: Array) -> Estimate:
    """What another differentiation changes is uncertain too."""
    return replace(result, covariance=result.covariance + np.outer(change, change))


def _numbers(parameters: FileParameters, result: Estimate) -> list[tuple[Number, ...]]:
    return [
        _group(group, result, where)
        for group, where in zip(parameters.groups, parameters.slices, strict=True)
    ]


def _group(group: Shared, result: Estimate, where: slice) -> tuple[Number, ...]:
    """A group's numbers of the file, their deviations by the derivatives of its keys."""
    new, prior = result.values[where], result.prior[where]
    before, after = group.keys(group.values), group.keys(new)
    covariance = result.covariance[where, where]
    steps = 1e-6 * prior
    columns = []
    for k, step in enumerate(steps):
        up, down = new.copy(), new.copy()
        up[k] += step
        down[k] -= step
        high, low = group.keys(up), group.keys(down)
        columns.append([(high[key] - low[key]) / (2 * step) for key in after])
    slopes = np.array(columns).T
    numbers = []
    for slope, (key, value) in zip(slopes, after.items(), strict=True):
        deviation = float(np.sqrt(max(slope @ covariance @ slope, 0.0)))
        usual = float(np.sqrt(np.sum((slope * prior) ** 2)))
        share = deviation / usual if usual > 0.0 else 1.0
        status: Status = "combination"
        if share < SURE:
            status = "fitted"
        elif share > UNSURE and abs(value - before[key]) <= STAYS * usual:
            status, value = "not excited", before[key]
        numbers.append(Number(key, _unit(group, key), before[key], value, deviation, share, status))
    return tuple(numbers)


def _unit(group: Shared, key: Key) -> str:
    """Unit of a number of the file."""
    words = [str(k) for k in key if isinstance(k, str)]
    if len(group.names) == 1:
        return group.units[0]
    last = words[-1]
    if last.endswith("com"):
        return "m" if len(key) > 2 and isinstance(key[-1], int) else "1"
    return "kg" if last.endswith("mass") else "kg m2"
