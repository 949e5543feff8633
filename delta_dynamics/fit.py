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
from delta_dynamics.fit_rows import LATE, Recorded, Rows, next_window, prior_scales, rows_of
from delta_dynamics.samples import Filtering
from pkm_twin.errors import PkmTwinError
from pkm_twin.machine.robot import Robot
from pkm_twin.machine.shared import KINDS, Key, Kind, Shared

Array = NDArray[np.float64]
Status = Literal["fitted", "combination", "not excited"]

HELD_OUT: Final = 1 / 3
"""Part of each recording, its end, that is judged and not fitted."""
SURE: Final = 0.2
"""A number that is known this much better than before is fitted."""
SCALE: Final = 200.0
"""How many times heavier or lighter than its file a machine may be as a whole."""
LIKE: Final = 0.7
"""Correlation of efforts, measured and by the file, from which the one tells the other's unit."""
STAYS: Final = 1e-3
"""Change over the deviation before that says nothing."""
UNSURE: Final = 0.98
"""One that is known no better than this is not excited."""


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
    """Held-out efforts of a recording: ``time`` (k,), s; measured, before and after (k, n).

    ``deviation``: of those after, by what is not known of the parameters, shape (k, n).
    """

    name: str
    time: Array
    measured: Array
    before: Array
    after: Array
    deviation: Array

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
    start = parameters.values
    for i, recording in enumerate(recordings):
        made, how = rows_of(robot, parameters, recording, None)
        rows.append(made)
        filtering.append(how)
        if progress is not None:
            progress(2 * i + 1)
    for recording, made in zip(recordings, rows, strict=True):
        _check_scale(recording.name, made.target + made.rest, made.rest + made.table @ start)
    result, delays = _estimate(parameters, rows)
    other = []
    for i, (recording, how) in enumerate(zip(recordings, filtering, strict=True)):
        other.append(rows_of(robot, parameters, recording, next_window(how.window))[0])
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
        spread = np.sqrt(np.sum((end.table @ result.covariance) * end.table, -1).clip(0.0))
        measured = end.target + end.rest
        judged.append(Judged(recording.name, end.time, measured, before, after, spread))
    return Fit(
        robot, parameters, result, numbers, tuple(judged), tuple(filtering),
        sum(made.outliers for made in rows), sum(_split(made) for made in rows), delays,
    )  # fmt: skip


def _check_scale(name: str, measured: Array, predicted: Array) -> None:
    """Refuse efforts in another unit: alike but for a factor that no machine is off by.

    :raises PkmTwinError: by recording.
    """
    both, own = float(np.sum(measured * predicted)), float(np.sum(predicted**2))
    size = np.sqrt(own * float(np.sum(measured**2)))
    if both > LIKE * size > 0.0 and not 1.0 / SCALE <= both / own <= SCALE:
        raise PkmTwinError(
            f"{name}: efforts are {both / own:.3g} times what the robot's file makes of the "
            "motion: units? N m and N"
        )


def _split(rows: Rows) -> int:
    return round((1.0 - HELD_OUT) * len(rows.time))


def _estimate(
    parameters: FileParameters, rows: Sequence[Rows]
) -> tuple[Estimate, tuple[float, ...]]:
    """Of the parameters, and how late the efforts of each recording are, s."""
    used = [made.part(slice(0, _split(made))) for made in rows]
    table, target, rest, counts = (
        np.concatenate([getattr(made, name) for made in used])
        for name in ("table", "target", "rest", "counts")
    )
    scales = prior_scales(parameters, table, target + rest)
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
        numbers.append(known(key, _unit(group, key), before[key], value, deviation, usual))
    return tuple(numbers)


def known(
    key: Key, unit: str, before: float, value: float, deviation: float, usual: float
) -> Number:
    """A number with how well it is known.

    :param usual: its deviation before.
    """
    share = deviation / usual if usual > 0.0 else 1.0
    status: Status = "combination"
    if share < SURE:
        status = "fitted"
    elif share > UNSURE and abs(value - before) <= STAYS * usual:
        status, value = "not excited", before
    return Number(key, unit, before, value, deviation, share, status)


def _unit(group: Shared, key: Key) -> str:
    """Unit of a number of the file."""
    words = [str(k) for k in key if isinstance(k, str)]
    if len(group.names) == 1:
        return group.units[0]
    last = words[-1]
    if last.endswith("com"):
        return "m" if len(key) > 2 and isinstance(key[-1], int) else "1"
    return "kg" if last.endswith("mass") else "kg m2"
