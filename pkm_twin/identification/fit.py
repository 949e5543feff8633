# SPDX-License-Identifier: Apache-2.0
"""The numbers of a robot's file from recordings of its motion and efforts.

The last third of every recording is held out: it is judged, not fitted. Efforts may be late
against positions, by some samples and alike in all joints: a drive that holds its torque for a
period would else look like friction. How late is fitted beside, for each recording. Two windows of
the differentiation are fitted; what they differ by counts as uncertainty beside the noise's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import PkmTwinError, SingularityError, UnreachableError
from pkm_twin.identification.estimation import Estimate, nearest, possible
from pkm_twin.identification.file_parameters import FileParameters, file_parameters
from pkm_twin.identification.fit_plausible import recording_fault
from pkm_twin.identification.fit_rows import Recorded, Rows, next_window, rows_of
from pkm_twin.identification.fit_solved import held_from, solve
from pkm_twin.identification.fit_verdict import verdict_of
from pkm_twin.identification.noise import EXACT
from pkm_twin.identification.samples import Filtering
from pkm_twin.identification.verdict import Verdict
from pkm_twin.machine.friction import LAWS, FrictionLaw
from pkm_twin.machine.places import path_of
from pkm_twin.machine.shared import KINDS, Key, Kind, Shared
from pkm_twin.robot.robot import Robot

Status = Literal["fitted", "combination", "not excited"]

LOADED: Final = frozenset(name for name, law in LAWS.items() if law.share is not FrictionLaw.share)
"""Laws that grow with the load."""
LOAD_PASSES: Final = 2
FEW: Final = 5.0
"""Independent measured values for each fitted number, below which there are too few."""
WORSE: Final = 1.2
"""Held-out residual of a joint over that of the file's values that a machine like the file's does
not leave."""
SURE: Final = 0.2
"""A number that is known this much better than before is fitted."""
STAYS: Final = 1e-3
"""Change over the deviation before that says nothing."""
UNSURE: Final = 0.98
"""One that is known no better than this is not excited."""


@dataclass(frozen=True)
class Number:
    """One number of the file: where it stands, before and after, and its standard deviation.

    ``deviation``: NaN where it is withheld, as the model does not explain the recordings.
    ``share``: that of the noise alone over that of before. ``status``: ``fitted``; ``combination``:
    known only in combination; ``not excited``: the motion does not identify it, the file's value
    stays.
    """

    key: Key
    unit: str
    before: float
    after: float
    deviation: float
    share: float
    status: Status

    @property
    def spread(self) -> str:
        """The standard deviation in words."""
        return f"{self.deviation:.2g}" if np.isfinite(self.deviation) else "withheld"

    @property
    def name(self) -> str:
        """The key, with dots."""
        return path_of(self.key)


@dataclass(frozen=True, eq=False)
class Judged:
    """Held-out efforts of a recording: ``time`` (k,), s; measured, before and after (k, n).

    ``least``: by least squares, before the numbers are corrected, (k, n). ``deviation``: of those
    after, by what is not known of the parameters, (k, n). ``noise``: of a sample as if samples were
    independent, (n,).
    """

    name: str
    time: Array
    measured: Array
    before: Array
    after: Array
    deviation: Array
    noise: Array = field(default_factory=lambda: np.ones(1))
    least: Array = field(default_factory=lambda: np.zeros((0, 1)))

    def rms(self, which: Array) -> Array:
        """Of measured less predicted, shape (n,)."""
        return np.asarray(np.sqrt(np.mean((self.measured - which) ** 2, 0)), np.float64)


@dataclass(frozen=True, eq=False)
class Fit:
    """What recordings say of a robot's file.

    ``estimate``: of least squares; ``numbers``: corrected by what the verdict's suspects change.
    """

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
    verdict: Verdict
    """Whether the model explains the recordings."""
    accepted: tuple[str, ...] = ()
    """Why this machine cannot have made them, although they were fitted."""

    def of(self, status: Status) -> tuple[Number, ...]:
        """The numbers of a status."""
        return tuple(number for number in self.numbers if number.status == status)


def fit(
    robot: Robot,
    recordings: Sequence[Recorded],
    what: Sequence[Kind] = KINDS,
    *,
    accept: bool = False,
    progress: Callable[[int], None] | None = None,
    trial: Verdict | None = None,
    accepted: Sequence[str] | None = None,
) -> Fit:
    """Fit some kinds of numbers of a robot's file.

    :param what: of ``friction``, ``rotor``, ``payload``, ``inertia``.
    :param accept: fit recordings that this machine cannot have made, too.
    :param progress: called with the number of recordings that are worked on, twice each.
    :param trial: the verdict of a fit before: this fit only predicts and is not judged again.
    :param accepted: what a fit before found of the recordings; None: ask whether this machine can
        have made them.
    :raises PkmTwinError: recordings that are too short, that show nothing, or that this machine
        cannot have made.
    """
    everything, parameters = file_parameters(robot), file_parameters(robot, what)
    chosen = np.concatenate([[g.kind in what] * len(g.names) for g in everything.groups])
    whole, filtering, loaded = [], [], set(robot.laws) & LOADED
    for i, recording in enumerate(recordings):
        made, how = _rows(robot, everything, recording)
        whole.append(made)
        filtering.append(how)
        if progress is not None:
            progress(2 * i + 1)
    for _ in range((LOAD_PASSES if trial is None else 1) if loaded else 0):
        # Friction by the load of the fitted machine, not of the file's.
        values = everything.values.copy()
        values[chosen] = solve(
            parameters, [made.only(chosen, everything.values) for made in whole]
        ).estimate.values
        everything = replace(everything, loads=values)
        whole = [
            rows_of(robot, everything, recording, how.window)[0]
            for recording, how in zip(recordings, filtering, strict=True)
        ]
    faults = [*(accepted or ())]
    for recording, made in zip(recordings, whole, strict=True) if accepted is None else ():
        fault = recording_fault(robot, everything, recording, made)
        if fault is not None:
            faults.append(f"{recording.name}: {fault}")
    refuse_faults(faults, accept)
    rows = [made.only(chosen, everything.values) for made in whole]
    solved = solve(parameters, rows)
    result, delays = solved.estimate, solved.delays
    _enough(rows, result, what)
    if accepted is None and not faults:
        faults = _worse(robot, recordings, rows, parameters.values, result.values)
        refuse_faults(faults, accept)
    if trial is None:
        other = []
        for i, (recording, how) in enumerate(zip(recordings, filtering, strict=True)):
            other.append(rows_of(robot, everything, recording, next_window(how.window))[0])
            if progress is not None:
                progress(2 * i + 2)
        again = solve(parameters, [made.only(chosen, everything.values) for made in other])
        result = _less_sure(result, again.estimate.values - result.values)
    verdict = trial or verdict_of(robot, recordings, everything, chosen, whole, solved)
    if faults:
        verdict = replace(verdict, answer="does not explain")
    best = result if trial else _corrected(parameters, result, verdict)
    numbers = () if trial else _numbers(parameters, best, verdict)
    if not result.directions or (numbers and all(n.status == "not excited" for n in numbers)):
        raise PkmTwinError(
            f"no excitation: the motion does not identify {', '.join(what)}; pkm-twin excite "
            "designs a motion that does"
        )
    wide = best.covariance if trial else verdict.widened(best.covariance)
    judged = []
    for recording, made in zip(recordings, rows, strict=True):
        end = made.part(slice(held_from(made), None))
        before, after, least = (
            end.rest + end.table @ v for v in (parameters.values, best.values, result.values)
        )
        spread = np.sqrt(np.sum((end.table @ wide) * end.table, -1).clip(0.0))
        measured = end.target + end.rest
        floor = np.maximum(end.signals.noise, EXACT * np.sqrt(np.mean(measured**2, 0)))
        judged.append(
            Judged(recording.name, end.time, measured, before, after, spread, floor, least)
        )
    return Fit(
        robot, parameters, replace(result, bound=best.bound), numbers, tuple(judged),
        tuple(filtering), sum(made.outliers for made in rows),
        sum(held_from(made) for made in rows), delays, verdict, tuple(faults),
    )  # fmt: skip


def refuse_faults(faults: Sequence[str], accept: bool) -> None:
    """Refuse recordings that a machine cannot have made.

    :raises PkmTwinError: by the first fault, unless they are accepted.
    """
    if faults and not accept:
        raise PkmTwinError(f"{faults[0]}; --accept fits it nevertheless")


def _enough(rows: Sequence[Rows], result: Estimate, what: Sequence[Kind]) -> None:
    """Reject fewer independent values than the numbers need.

    :raises PkmTwinError: with how many there are.
    """
    values = sum(float(one.counts[: held_from(one)].sum()) * one.signals.band for one in rows)
    if values < FEW * result.directions:
        raise PkmTwinError(
            f"too few samples: {values:.0f} independent efforts for {result.directions} numbers of "
            f"{', '.join(what)}, {FEW * result.directions:.0f} or more are needed; record a "
            "motion with more changes of speed (`pkm-twin excite`), or fit less with --what"
        )


def _worse(
    robot: Robot, recordings: Sequence[Recorded], rows: Sequence[Rows], before: Array, after: Array
) -> list[str]:
    """Recordings whose held-out part the fitted values predict worse than the file's, in words."""
    told = []
    for recording, made in zip(recordings, rows, strict=True):
        end = made.part(slice(held_from(made), None))
        old, new = (
            np.sqrt(np.mean(end.counts * (end.target - end.table @ v) ** 2, 0))
            for v in (before, after)
        )
        j = int(np.argmax(new / np.maximum(old, 1e-300)))
        if new[j] > WORSE * old[j] and new[j] > EXACT * np.std(end.effort[:, j]):
            told.append(
                f"{recording.name}: the fitted values leave {new[j]:.3g} {robot.effort_units[j]} "
                f"of the held-out efforts of {robot.joint_names[j]}, the file's {old[j]:.3g} "
                "(another machine, or a motion that is too short or changes?)"
            )
    return told


def _corrected(parameters: FileParameters, result: Estimate, verdict: Verdict) -> Estimate:
    """Without what the suspects probably changed, or the nearest possible machine to that.

    Of recordings that the model does not explain nothing is known of what they changed.
    """
    if verdict.answer == "does not explain":
        return result
    aim, cones = result.values - verdict.shift, parameters.cones
    if possible(aim, cones):
        return replace(result, values=aim)
    covariance = verdict.widened(result.covariance) / np.outer(result.prior, result.prior)
    sizes, vectors = np.linalg.eigh(covariance)
    factor = vectors * np.sqrt(np.maximum(sizes, 1e-12 * sizes.max()))
    start = parameters.values
    near = nearest((aim - start) / result.prior, factor, start, result.prior, cones)
    # How far a bound moves the numbers next to it is an estimate.
    moved = result.covariance + np.outer(near - aim, near - aim)
    return replace(result, values=near, bound=True, covariance=moved)


def _less_sure(result: Estimate, change: Array) -> Estimate:
    """What another differentiation changes is uncertain too."""
    return replace(result, covariance=result.covariance + np.outer(change, change))


def _rows(robot: Robot, everything: FileParameters, recording: Recorded) -> tuple[Rows, Filtering]:
    """Rows of a recording; an error names it."""
    try:
        return rows_of(robot, everything, recording, None)
    except (UnreachableError, SingularityError) as error:
        raise PkmTwinError(
            f"{recording.name}: {error} (positions of this machine, in rad and m?)"
        ) from None


def _numbers(parameters: FileParameters, result: Estimate, verdict: Verdict) -> tuple[Number, ...]:
    """The file's numbers: known by the noise alone, their deviations by the verdict too."""
    numbers = []
    wide = verdict.widened(result.covariance)
    for group, where in zip(parameters.groups, parameters.slices, strict=True):
        own, all_in_all = (
            _group(group, replace(result, covariance=one), where)
            for one in (result.covariance, wide)
        )
        numbers += [
            replace(n, deviation=w.deviation if n.status != "not excited" else n.deviation)
            for n, w in zip(own, all_in_all, strict=True)
        ]
    if verdict.deviations == "withheld":
        numbers = [
            n if n.status == "not excited" else replace(n, deviation=np.nan) for n in numbers
        ]
    return tuple(numbers)


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
        return "m" if len(key) > 2 and isinstance(key[-1], int) else ""
    return "kg" if last.endswith("mass") else "kg m2"
