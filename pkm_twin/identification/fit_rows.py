# SPDX-License-Identifier: Apache-2.0
"""A recording as rows of a least-squares problem: regressor and efforts, filtered alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for

from delta_dynamics.regressor import law_columns, law_keys, parameter_values, regressor
from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import PkmTwinError
from pkm_twin.identification.estimation import estimate
from pkm_twin.identification.file_parameters import FileParameters
from pkm_twin.identification.fit_signals import (
    Efforts,
    Signals,
    signals_of,
)
from pkm_twin.identification.noise import noise_of, resonances_of, usual_size
from pkm_twin.identification.samples import (
    LEAST,
    WINDOWS,
    Filtering,
    Track,
    by_blocks,
    low_pass,
    tracks,
)
from pkm_twin.machine.friction import linear_keys
from pkm_twin.robot.robot import Robot

BLOCK: Final = 2048
OUTLIER: Final = 8.0
"""Robust deviations beyond which a measured effort is no measurement."""
IN_A_ROW: Final = 10
"""Samples in a row that are no outliers, but something that the model lacks."""
LEAST_EFFORT: Final = 1e-9
"""Efforts that change by less are no measurement, N m or N."""
LARGEST: Final = 1e9
"""Effort that no drive has, N m or N."""
LATE: Final = 2.0
"""Samples by which efforts may well be late."""
SHAKEN: Final = 3000
"""Samples that show what the positions' noise does."""


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


@dataclass(frozen=True, eq=False)
class Rows:
    """Filtered rows of one recording: time (k,), table (k, n, parameters), target (k, n).

    ``rest``: what the parameters that stay need; ``counts``: what is judged; ``change``: of the
    efforts in time, (k, n) each. ``period``: of the samples, s. ``signals``: of the same rows.
    """

    time: Array
    table: Array
    target: Array
    rest: Array
    counts: Array
    change: Array
    outliers: int
    period: float
    signals: Signals

    @property
    def effort(self) -> Array:
        """As measured, filtered, shape (k, n)."""
        return self.target + self.rest

    def part(self, rows: slice) -> Rows:
        """Some of the rows."""
        cut = ("time", "table", "target", "rest", "counts", "change")
        return replace(self, **{name: getattr(self, name)[rows] for name in cut})

    def only(self, columns: Mask, values: Array) -> Rows:
        """With some of the parameters, the others at these values, (parameters,)."""
        stay = self.table[..., ~columns] @ values[~columns]
        return replace(
            self, table=self.table[..., columns], target=self.target - stay, rest=self.rest + stay
        )


def next_window(window: int) -> int:
    """The window that is fitted beside: the next shorter one, of the shortest the next."""
    k = WINDOWS.index(window)
    return WINDOWS[k - 1] if k else WINDOWS[1]


def rows_of(
    robot: Robot, parameters: FileParameters, recording: Recorded, window: int | None
) -> tuple[Rows, Filtering]:
    """A recording's filtered rows.

    :raises PkmTwinError: it is too short, its joints stand still, or its efforts are none.
    """
    r = recording
    _check_efforts(robot, r)
    if len(r.time) < LEAST:
        raise PkmTwinError(
            f"{r.name}: too short to fit, {len(r.time)} samples; {LEAST} or more in a row"
        )
    pieces, how = tracks(r.time, r.q, r.effort, r.wrench, r.held, window)
    if not pieces:
        raise PkmTwinError(f"{r.name}: too short to fit, no {LEAST // 2} samples without a gap")
    parts = [_piece(robot, parameters, r.carried, track, how) for track in pieces]
    if all(not part.moves.any() for part in parts):
        raise PkmTwinError(f"{r.name}: no excitation, the joints stand still")
    first, outliers = _drop_outliers(parts, parameters, how.keep_every)
    made = [part.filtered(first, track, how) for part, track in zip(parts, pieces, strict=True)]
    time, table, target, rest, counts, change = (
        np.concatenate([one[k] for one in made]) for k in range(6)
    )
    told = [part.rest + part.table @ first for part in parts]
    rubs = _of_drives(robot, parameters)
    rub = [part.table[..., rubs] @ first[rubs] for part in parts]
    left = [part.target - part.table @ first for part in parts]

    def efforts(track: Track) -> Array:
        part = _piece(robot, parameters, r.carried, track, how)
        return np.asarray(part.rest + part.table @ first, np.float64)

    shaken = shaken_efforts(r, max(pieces, key=lambda t: len(t.time)), how, efforts)
    noise = noise_of(left, shaken, pieces[0].period, how)
    size = np.sqrt(np.mean(np.concatenate([part.target + part.rest for part in parts]) ** 2, 0))
    rings = resonances_of(left, pieces[0].period, how, size)
    signals = signals_of(pieces, told, rub, how, noise, rings)
    period = pieces[0].period
    return Rows(time, table, target, rest, counts, change, outliers, period, signals), how


def efforts_of(
    robot: Robot, parameters: FileParameters, carried: Robot | None, values: Array,
    signals: Signals,
) -> Efforts:  # fmt: skip
    """What a motion beside a recording's needs at its rows, by all parameters of the file."""

    def efforts(q: Array, qd: Array, qdd: Array) -> Array:
        def block(rows: slice) -> Array:
            motion = q[rows], qd[rows], qdd[rows], signals.wrench[rows]
            table, rest = _columns(robot, parameters, carried, motion, signals.held[rows])
            return np.asarray(rest + table @ values, np.float64)

        return by_blocks(len(q), BLOCK, block)

    return efforts


def calm_table(
    robot: Robot, parameters: FileParameters, carried: Robot | None, signals: Signals
) -> Array:
    """The parameters' columns at a recording's rows, without noise, (k, n, parameters)."""

    def block(rows: slice) -> Array:
        q, qd, qdd = (one[rows] for one in signals.motion)
        motion = q, qd, qdd, signals.wrench[rows]
        return _columns(robot, parameters, carried, motion, signals.held[rows])[0]

    return by_blocks(len(signals.held), BLOCK, block)


def shaken_efforts(
    r: Recorded, track: Track, how: Filtering, efforts: Callable[[Track], Array]
) -> Array:
    """What noise of the positions, as large as theirs, changes in the efforts, (samples, n).

    :param efforts: of a motion, shape (samples, n).
    """
    noise, rng = np.array(how.position_noise), np.random.default_rng(0)
    edge = (how.window // 2 + 0.5) * track.period
    inside = (r.time > track.time[0] - edge) & (r.time < track.time[-1] + edge)
    some = np.flatnonzero(inside)[:SHAKEN]
    time, q = r.time[some], r.q[some]
    told = []
    for shake in (np.zeros_like(q), noise * rng.normal(size=q.shape)):
        pieces, _ = tracks(
            time,
            q + shake,
            np.zeros_like(q),
            window=how.window,
            least=min(LEAST // 2, len(track.time)),
        )
        told.append(np.concatenate([efforts(t) for t in pieces]))
    return np.asarray(told[1] - told[0], np.float64)


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


def _check_efforts(robot: Robot, r: Recorded) -> None:
    for joint, effort in zip(robot.joint_names, r.effort.T, strict=True):
        worst = float(effort[np.argmax(~(np.abs(effort) < LARGEST))])
        if not abs(worst) < LARGEST:
            raise PkmTwinError(
                f"{r.name}: effort of {joint} is {worst:g}; below {LARGEST:g} is what a drive has"
            )
        if len(effort) and np.ptp(effort) < LEAST_EFFORT:
            only = effort[0] + 0.0  # no minus before zero
            raise PkmTwinError(
                f"{r.name}: effort of {joint} is {only:g} throughout: nothing was measured"
            )


def _columns(
    robot: Robot, parameters: FileParameters, carried: Robot | None,
    motion: tuple[Array, Array, Array, Array], held: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """The parameters' columns of a motion (q, qd, qdd, wrench), and what the others need."""
    pi = parameter_values(robot)
    extra = np.zeros(len(pi)) if carried is None else parameter_values(carried) - pi
    full = regressor(robot, *motion)
    own = full @ parameters.mixing
    rest = full @ pi - own @ parameters.values + held[:, None] * (full @ extra)
    for where, group in zip(parameters.slices, parameters.groups, strict=True):
        if group.kind == "payload":
            own[..., where] *= held[:, None, None]
    if parameters.loads is not None and robot.laws:
        rubs = _of_drives(robot, parameters)
        load = rest + own[..., ~rubs] @ parameters.loads[~rubs]
        laws = law_columns(robot, motion[0], motion[1], load)
        names = [f"{joint}.{key}" for key in law_keys(robot) for joint in robot.joint_names]
        for name, column in zip(names, np.moveaxis(laws, -1, 0), strict=True):
            own[..., parameters.names.index(name)] = column
    return own, rest


def _of_drives(robot: Robot, parameters: FileParameters) -> Mask:
    """Which parameters are friction of the drives."""
    keys, drives = linear_keys(robot.laws), set(robot.joint_names)
    pairs = [name.rpartition(".")[::2] for name in parameters.names]
    return np.array([joint in drives and key in keys for joint, key in pairs])


def _piece(
    robot: Robot, parameters: FileParameters, carried: Robot | None, track: Track, how: Filtering
) -> _Piece:
    def block(rows: slice) -> Array:
        motion = track.q[rows], track.qd[rows], track.qdd[rows], track.wrench[rows]
        own, rest = _columns(robot, parameters, carried, motion, track.held[rows])
        return np.concatenate([own, rest[..., None]], -1)

    both = by_blocks(len(track.q), BLOCK, block)
    table, rest = both[..., :-1], both[..., -1]
    return _Piece(table, track.effort - rest, rest, track.moves(how).astype(np.float64))


def _drop_outliers(
    parts: list[_Piece], parameters: FileParameters, every: int
) -> tuple[Array, int]:
    """Efforts far from a first robust fit take its values, but not many of them or in a row.

    :returns: that fit's parameters, and how many efforts.
    """
    table = np.concatenate([part.table[::every] for part in parts])
    target = np.concatenate([part.target[::every] for part in parts])
    rest = np.concatenate([part.rest[::every] for part in parts])
    scales = prior_scales(parameters, table, target + rest)
    first = estimate(table, target, parameters.values, scales).values
    count = 0
    for part in parts:
        told = part.table @ first
        away = np.abs(part.target - told)
        bound = OUTLIER * usual_size(part.target - told)
        # Where friction turns over, an effort that is some samples late is no outlier.
        near = scipy.ndimage.maximum_filter1d(
            np.abs(np.diff(told, axis=0, prepend=told[:1])), 7, axis=0
        )
        far = (away > bound + LATE * near) & (bound > 1e-6 * np.abs(part.target).max(0))
        far &= ~scipy.ndimage.binary_opening(far, np.ones((IN_A_ROW, 1)))
        if far.mean() > 0.05:
            continue
        part.target[far] = told[far]
        count += int(far.sum())
    return first, count


def prior_scales(parameters: FileParameters, table: Array, effort: Array) -> Array:
    """The prior's deviations; of friction and rotors what would be all of the joints' efforts."""
    scales = parameters.scales.copy()
    size = np.sqrt(np.mean(effort**2, 0))
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
