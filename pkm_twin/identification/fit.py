# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The numbers of a robot's file from recordings of its motion and efforts.

The last third of every recording is held out: it is judged, not fitted. Two windows of the
differentiation are fitted; what they differ by counts as uncertainty next to the noise's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import PkmTwinError
from pkm_twin.identification.compare import MAX_DELAY_PASSES, MAX_RESIDUAL
from pkm_twin.identification.estimation import Estimate, find_nearest, find_violations
from pkm_twin.identification.hypotheses import Explanation, explain
from pkm_twin.identification.identifiable import KINDS, Kind
from pkm_twin.identification.judge import judge_problem, make_basis
from pkm_twin.identification.parameters import Number, Status, make_group_numbers
from pkm_twin.identification.rows import Problem, Rows
from pkm_twin.identification.samples import MIN_RELATIVE_NOISE
from pkm_twin.identification.verdict import MAX_DELAY, Verdict, write_late
from pkm_twin.recordings import Recording
from pkm_twin.robot.robot import Robot


@dataclass(frozen=True, eq=False)
class Judged:
    """Held-out samples of a recording: ``time`` (k,), s; efforts measured, before and after, (k, n).

    Efforts that are late against the positions are on time here, as in ``check``.

    ``deviation``: of those after, by what is not known of the parameters, (k, n).
    """

    name: str
    time: Array
    measured: Array
    before: Array
    after: Array
    deviation: Array

    def rms(self, which: Array) -> Array:
        """Return the RMS of measured less predicted efforts, (n,)."""
        return np.asarray(np.sqrt(np.mean((self.measured - which) ** 2, 0)), np.float64)


@dataclass(frozen=True, eq=False, kw_only=True)
class Result:
    """Result of an identification: numbers of a robot's file from recordings.

    ``estimate``: the parameters, their covariance and prior. ``numbers``: the same as numbers of
    the file. ``verdict``: whether the model explains the recordings. ``accepted``: reasons why this
    machine cannot have made the recordings, which the user accepted.
    """

    robot: Robot
    estimate: Estimate
    numbers: tuple[Number, ...]
    judged: tuple[Judged, ...]
    samples: int
    verdict: Verdict
    accepted: tuple[str, ...] = ()

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of what was measured: actuated joints."""
        return self.robot.joint_names

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the channels."""
        return self.robot.effort_units

    def list_numbers(self, status: Status) -> tuple[Number, ...]:
        """List the numbers of a status."""
        return tuple(number for number in self.numbers if number.status == status)


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit(Result):
    """A fit of efforts.

    ``explained``: what explains each recording most probably, as `check` has it; empty for currents.
    """

    problem: Problem
    explained: tuple[Explanation, ...] = ()

    @property
    def delays(self) -> tuple[float, ...]:
        """How late the efforts are against the positions, s, by recording."""
        return self.problem.total_delays

    @property
    def outliers(self) -> int:
        """Number of efforts that were replaced as outliers."""
        return sum(made.outliers for made in self.problem.whole)


def fit(
    robot: Robot,
    recordings: Sequence[Recording],
    what: Sequence[Kind] = KINDS,
    *,
    accept: bool = False,
    progress: Callable[[int], None] | None = None,
    explained: Sequence[Explanation] = (),
    known: Sequence[Rows] = (),
) -> Fit:
    """Fit some kinds of numbers of a robot's file.

    :param what: of ``friction``, ``rotor``, ``payload``, ``inertia``.
    :param accept: fit recordings that this machine cannot have made, too.
    :param progress: called with the number of recordings that are read.
    :param explained: of each recording, where it is known, what
        :func:`~pkm_twin.identification.hypotheses.explain_recording` returns; ``known``: rows that are read.
    :raises PkmTwinError: recordings that are too short, that show nothing, or that this machine
        cannot have made.
    """
    problem = Problem.from_recordings(robot, recordings, what, progress=progress, known=known)
    why = explained or [explain(made) for made in problem.whole]
    names = [made.recording.name for made in problem.whole]
    faults = [f"{name}: {one.cause}" for name, one in zip(names, why, strict=True) if one.fault]
    if not faults:
        # The delay of another machine's recording has no meaning.
        problem = correct_delays(problem)
        faults = [
            f"{made.recording.name}: {write_late('all joints', late)}"
            for made, late in zip(problem.whole, problem.total_delays, strict=True)
            # A delay that was not corrected for is too uncertain to be a fault.
            if abs(late) > MAX_DELAY and made.recording.late
        ]
    refuse_faults(faults, accept)
    problem.check_count()
    faults = faults or _list_worse(problem)
    refuse_faults(faults, accept)
    return solve_and_judge(problem, tuple(faults))


def correct_delays(problem: Problem) -> Problem:
    """Correct the efforts' delays, if that reduces the residual.

    A problem's own delays are to the first order, good for a sample or so.
    """
    found = list[float]()
    for rows, late in zip(problem.rows, problem.delays, strict=True):
        # The first-order estimate, or the delay of the least residual where that is farther.
        period, count = rows.period * rows.how.keep_every, len(rows.time)
        most = min(int(2.0 * MAX_DELAY / period), count // 4)
        inner = slice(most, count - most)
        weight = rows.counts[inner] / problem.both.noise
        table = rows.table[inner] * weight[..., None]
        basis = make_basis(table.reshape(-1, table.shape[-1]))
        left = []
        for step in range(2 * most + 1):
            target = rows.effort[step : count - 2 * most + step] - rows.rest[inner]
            seen = (target * weight).ravel()
            left.append(float(seen @ seen - np.sum((basis.T @ seen) ** 2)))
        far = period * (int(np.argmin(left)) - most)
        found.append(far if abs(far - late) > period else late)
    for _ in range(MAX_DELAY_PASSES):
        moved = [
            made.recording.compensate_effort_delay(late) if abs(late) > made.period else made.recording
            for made, late in zip(problem.whole, found, strict=True)
        ]
        if not any(
            now is not made.recording and abs(now.late) < 2.0 * MAX_DELAY
            for now, made in zip(moved, problem.whole, strict=True)
        ):
            break
        try:
            other = Problem.from_recordings(problem.robot, moved, problem.what)
        except PkmTwinError:
            break
        if np.mean(other.both.noise / problem.both.noise) >= 1.0:
            break
        problem, found = other, list(other.delays)
    return problem


def solve_and_judge(problem: Problem, accepted: tuple[str, ...] = ()) -> Fit:
    """Solve a problem and judge the solution.

    :param accepted: why the machine cannot have made the recordings, although they are fitted.
    :raises PkmTwinError: recordings that show nothing.
    """
    parameters, verdict = problem.parameters, judge_problem(problem)
    if accepted:
        verdict = replace(verdict, answer="does not explain")
    # The posterior's numbers, or the nearest that a machine can have.
    start, cones, first = parameters.values, parameters.cones, problem.estimate
    aim, wide = start + verdict.change, verdict.covariance
    bound, near = find_violations(aim, cones), aim
    if bound:
        sizes, vectors = np.linalg.eigh(verdict.plain / np.outer(first.prior, first.prior))
        factor = vectors * np.sqrt(np.maximum(sizes, 1e-12 * sizes.max()))
        near = find_nearest((aim - start) / first.prior, factor, start, first.prior, cones)
        # How far a bound moves the numbers next to it is an estimate.
        wide = wide + np.outer(near - aim, near - aim)
    best = replace(first, values=near, covariance=wide, bound=bound)
    told = np.full_like(wide, np.nan) if verdict.deviations == "withheld" else wide
    numbers: list[Number] = []
    for group, k in zip(parameters.groups, parameters.slices, strict=True):
        both = verdict.plain[k, k], told[k, k]
        numbers += make_group_numbers(group, best.values[k], best.prior[k], both)
    if all(n.status == "not excited" for n in numbers):
        raise PkmTwinError(
            f"no excitation: the motion does not identify {', '.join(problem.what)}; pkm-twin "
            "excite designs a motion that does"
        )
    judged = []
    for end in problem.held_out:
        before, after = (end.rest + end.table @ v for v in (parameters.values, best.values))
        spread = np.sqrt(np.sum((end.table @ wide) * end.table, -1).clip(0.0))
        judged.append(Judged(end.recording.name, end.time, end.effort, before, after, spread))
    return Fit(
        robot=problem.robot,
        problem=problem,
        estimate=best,
        numbers=tuple(numbers),
        judged=tuple(judged),
        verdict=verdict,
        accepted=accepted,
        samples=sum(made.held_from for made in problem.rows),
    )


def _list_worse(problem: Problem) -> list[str]:
    """List recordings whose held-out part the fitted values predict worse than the file's.

    Where the file's explain it, the fitted follow noise: the machine is not at fault.
    """
    robot, told = problem.robot, []
    values = problem.parameters.values, problem.estimate.values
    for end in problem.held_out:
        old, new = (np.sqrt(np.mean(end.counts * (end.target - end.table @ v) ** 2, 0)) for v in values)
        j = int(np.argmax(new / np.maximum(old, 1e-300)))
        if new[j] > 1.2 * old[j] and new[j] > MIN_RELATIVE_NOISE * np.std(end.effort[:, j]):
            why = "another machine, or a motion that is too short or changes?"
            if (old <= MAX_RESIDUAL * np.abs(end.effort).max(0)).all():
                why = (
                    "these explain the recording; it does not excite the numbers enough, condition "
                    f"number {problem.estimate.condition:.3g}: keep them, fit less with --what, or "
                    "record a longer motion"
                )
            told.append(
                f"{end.recording.name}: the fitted values leave {new[j]:.3g} "
                f"{robot.effort_units[j]} of the held-out efforts of {robot.joint_names[j]}, "
                f"the values before {old[j]:.3g} ({why})"
            )
    return told


def find_worse(result: Result) -> str:
    """Say where a result predicts the held-out samples worse than the file, or return nothing.

    By the mean over the channels of the squares' ratio, so that all have one weight.
    """
    sums = np.zeros((3, len(result.channels)))
    for one in result.judged:
        parts = one.measured - one.before, one.measured - one.after, 1e-6 * one.measured
        sums += [np.nansum(part**2, 0) for part in parts]
    before, after, floor = sums
    # A channel that no recording measures has neither residual.
    seen = np.flatnonzero(before + after > 2.0 * floor)
    ratios = after[seen] / np.maximum(before, np.maximum(floor, 1e-300))[seen]
    if not len(seen) or np.mean(ratios) <= 1.0:
        return ""
    worst = int(seen[np.argmax(ratios)])
    count = sum(np.isfinite(one.measured[:, worst]).sum() for one in result.judged)
    new, old = (float(np.sqrt(part[worst] / count)) for part in (after, before))
    return (
        f"the fitted values predict the held-out samples worse than the file's: {new:.3g} "
        f"{result.units[worst]} RMS for {old:.3g} on {result.channels[worst]}; the file's values "
        "explain the recordings, or these excite too little: nothing is written"
    )


def refuse_faults(faults: Sequence[str], accept: bool) -> None:
    """Refuse recordings that a machine cannot have made.

    :raises PkmTwinError: by the first fault, unless they are accepted.
    """
    if faults and not accept:
        raise PkmTwinError(f"{faults[0]}; --accept fits it nevertheless")
