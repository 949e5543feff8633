# SPDX-License-Identifier: Apache-2.0
"""The verdict on a fit of efforts: its residual against noise and against common errors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.identification.judge import (
    HINT,
    NEAR,
    SIGMAS,
    VALUES,
    Evidence,
    Finding,
    Suspect,
    Verdict,
    basis_of,
    judge,
)
from pkm_twin.identification.noise import Resonance
from pkm_twin.identification.problem import Problem
from pkm_twin.identification.rows import Rows
from pkm_twin.identification.suspects import (
    ELASTIC,
    GEOMETRY,
    INTERFERENCE,
    LATE,
    RESONANCE,
    SPEED,
    Lengths,
    errors_of,
)

OF_THE_FILE: Final = {
    "friction": "friction other than the file's",
    "rotor": "rotor inertia other than the file's",
    "payload": "payload other than the file's",
    "inertia": "mass or inertia other than the file's",
}
"""Suspects that were not fitted, by the kind of the file's numbers."""
OF_INERTIA: Final = ("rotor", "payload", "inertia")
"""Kinds of numbers that only an accelerated motion tells."""
RATE: Final = 8.0 / 3.0 * SIGMAS
"""Deviations by which the rate of time has to show. Twice the rate takes three quarters of the
efforts of inertia, 3/8 of their derivative by the rate: that is a finding's."""
INERTIA: Final = 0.1
"""And the part of the efforts' variation that is inertia: of less, other masses and offsets of the
sensors, within their priors, take up three quarters."""


def verdict_of(problem: Problem) -> Verdict:
    """Whether the fitted model explains its recordings."""
    chosen, lengths = problem.chosen, Lengths.of(problem.robot)
    court = _Court(problem, lengths)
    verdict = court.judged(chosen)
    masses = court.kinds == "inertia"
    if (chosen & masses).any():
        verdict = _simpler(verdict, court.judged(chosen & ~masses))
    if (chosen & np.isin(court.kinds, OF_INERTIA)).any() and not court.inertia_shown():
        answer = "explains partly" if verdict.answer == "explains" else verdict.answer
        verdict = replace(verdict, answer=answer, slow=True)
    named = {one.suspect.kind for one in verdict.findings}
    either = None if named & {ELASTIC, LATE} else court.late_or_elastic(chosen)
    if either is not None:
        finding, change = either
        unseen = np.concatenate([verdict.unseen, change[None]])
        verdict = replace(verdict, hints=(*verdict.hints, finding), unseen=unseen)
    rings = _resonances(problem)
    if rings:
        answer = "explains partly" if verdict.answer == "explains" else verdict.answer
        verdict = replace(verdict, answer=answer, findings=(*verdict.findings, *rings))
    return verdict


def _resonances(problem: Problem) -> tuple[Finding, ...]:
    """Of each joint the clearest of all recordings: above the band, so that no number changes."""
    robot, best = problem.robot, dict[int, Resonance]()
    for one in (ring for made in problem.whole for ring in made.signals.resonances):
        if one.joint not in best or one.sigmas > best[one.joint].sigmas:
            best[one.joint] = one
    found = []
    for j, ring in sorted(best.items()):
        where = f"{robot.joint_names[j]}, {ring.rms:.2g} {robot.effort_units[j]} rms"
        other = (Suspect(INTERFERENCE, robot.joint_names[j], "Hz"),) if ring.line else ()
        suspect = Suspect(RESONANCE, where, "Hz")
        found.append(Finding(suspect, ring.frequency, ring.width, ring.sigmas, other))
    return tuple(found)


def _simpler(verdict: Verdict, frozen: Verdict) -> Verdict:
    """Other masses, or the file's and one error? What explains as much with less is a finding too.

    :param frozen: with the file's masses.
    """
    kinds = {one.suspect.kind for one in frozen.findings}
    if verdict.findings or OF_THE_FILE["inertia"] in kinds or len(kinds) != 1:
        return verdict
    if kinds == {GEOMETRY} and len(frozen.findings) > 1:
        return verdict
    if frozen.answer != "explains partly" or any(c.left_ratio > 1.0 for c in frozen.channels):
        return verdict
    other = Suspect("the masses that were fitted", "all of them")
    findings = tuple(replace(one, others=(*one.others, other)) for one in frozen.findings)
    return replace(
        verdict, answer="explains partly", findings=findings,
        unseen=np.concatenate([verdict.unseen, frozen.shift[None] - verdict.shift]),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Recording:
    """A recording at its rows: (k, n, ...) each."""

    rows: Rows
    delay: float
    columns: Array
    """By the suspects' sizes."""
    missed: Array
    calm: Array
    """All parameters' columns, without noise."""


class _Court:
    """All recordings of a fit, to be judged by several sets of parameters and suspects."""

    def __init__(self, problem: Problem, lengths: Lengths) -> None:
        self.problem, self.everything, self.values = problem, problem.everything, problem.values
        self.kinds = np.array([g.kind for g in self.everything.groups for _ in g.names])
        self.recordings: list[_Recording] = []
        self.suspects: tuple[Suspect, ...] = ()
        for rows, delay in zip(problem.whole, problem.delays, strict=True):
            errors, missed = errors_of(rows, self.values)
            own = np.stack([column for _, column in errors], -1)
            columns = np.concatenate([own, lengths.columns(rows, self.values)], -1)
            calm, _ = rows.model.columns(rows.signals.motion)
            self.recordings.append(_Recording(rows, delay, columns, missed, calm))
            self.suspects = (*(suspect for suspect, _ in errors), *lengths.suspects)

    def judged(self, free: Mask) -> Verdict:
        """With some parameters free to explain the residual, the others as the file has them."""
        kinds, file = self.kinds, self.everything
        suspects = [*self.suspects]
        suspects += [
            Suspect(OF_THE_FILE[kinds[k]], file.names[k], file.units[k])
            for k in np.flatnonzero(~free)
        ]
        cases = [self._evidence(i, free) for i in range(len(self.recordings))]
        e = self.problem.estimate
        values = np.where(free, self.values, file.values)
        prior = (
            (values - file.values)[free], e.prior[free[self.problem.chosen]],
            np.sqrt(np.diag(e.covariance)),
        )  # fmt: skip
        return judge(self.problem.robot.joint_names, suspects, cases, prior, self.problem.response)

    def late_or_elastic(self, free: Mask) -> tuple[Finding, Array] | None:
        """The delay of the efforts where elastic drives explain the residual nearly as well.

        And what these change in the fitted parameters, (f,).
        """
        which = [k for k, one in enumerate(self.suspects) if one.kind == ELASTIC]
        cases = [self._evidence(i, free) for i in range(len(self.recordings))]
        step = -(-sum(case.residual.size for case in cases) // VALUES)
        parts = []
        for i, (case, one) in enumerate(zip(cases, self.recordings, strict=True)):
            few = case.thinned(step)
            weight, change = few.weight[..., None], few.nuisance[..., :1]
            late = -change * (np.arange(len(cases)) == i)
            measured = few.residual[..., None] - one.delay * change
            columns = few.explained, few.nuisance[..., 1:], late, few.suspects[..., which], measured
            whole = np.concatenate(columns, -1) * weight
            parts.append(whole.reshape(-1, whole.shape[-1]))
        table = np.concatenate(parts)
        split = table.shape[1] - len(cases) - len(which) - 1
        basis = basis_of(table[:, :split])
        left = table[:, split:] - basis @ (basis.T @ table[:, split:])
        late, elastic, y = np.split(left, [len(cases), len(cases) + len(which)], 1)
        delays, gives = (np.linalg.lstsq(one, y[:, 0], rcond=None)[0] for one in (late, elastic))
        clear, other = np.linalg.norm(late @ delays), np.linalg.norm(elastic @ gives)
        chance = np.sqrt(HINT**2 + len(which) - 1)
        errors = np.linalg.norm(np.linalg.pinv(elastic), axis=1)
        if other < max(chance, NEAR * clear) or (gives < -2.0 * errors).any():
            return None
        place = int(np.argmax(np.abs(delays)))
        error = float(np.linalg.norm(np.linalg.pinv(late)[place]))
        sizes = ", ".join(
            f"{self.suspects[k].where} {give:.2g} {self.suspects[k].unit}"
            for k, give in zip(which, gives.tolist(), strict=True)
            if give > 0.0
        )
        finding = Finding(
            Suspect(LATE, "all joints", "s"), float(delays[place]), error, float(clear),
            (Suspect(ELASTIC, sizes),),
        )  # fmt: skip
        signals = [case.suspects[..., which] @ gives.clip(0.0)[:, None] for case in cases]
        return finding, self.problem.response(signals)[:, 0]

    def inertia_shown(self) -> bool:
        """Whether the recordings would show time at twice or half its rate, friction being any."""
        friction = self.kinds == "friction"
        which = [one.kind for one in self.suspects].index(SPEED)
        square, part, count = 0.0, 0.0, 0.0
        for i in range(len(self.recordings)):
            case = self._evidence(i, friction)
            weight = case.weight[..., None]
            table = np.concatenate([case.explained, case.nuisance], -1) * weight
            table = table.reshape(-1, table.shape[-1])
            table = table / np.maximum(np.linalg.norm(table, axis=0), 1e-300)
            column = (case.suspects[..., which] * weight[..., 0]).ravel()
            left = column - table @ np.linalg.lstsq(table, column, rcond=None)[0]
            square += float(left @ left)
            # The derivative by the rate is twice the efforts of inertia.
            own = 0.5 * left.reshape(case.residual.shape) * case.floor
            part += float(np.sum((own / np.maximum(case.variation, 1e-300)) ** 2))
            count += float(case.counts.sum())
        return square > RATE**2 and part > INERTIA**2 * count

    def _evidence(self, i: int, free: Mask) -> Evidence:
        """Of one recording; the suspects' columns, then those of what is not free."""
        one = self.recordings[i]
        rows, effort = one.rows, one.rows.effort
        values = np.where(free, self.values, self.everything.values)
        # The sign of a rate is filtered as the efforts are.
        others = np.where(self.kinds == "friction", rows.table, one.calm)[..., ~free]
        return Evidence(
            effort - rows.rest - rows.table @ values + one.delay * rows.change,
            rows.table[..., free],
            np.concatenate([rows.change[..., None], one.missed], -1),
            np.sqrt(np.sum(np.mean(one.missed**2, 0), -1)),
            np.concatenate([one.columns, others], -1),
            rows.signals.noise, rows.signals.band, rows.counts, rows.held_from,
            np.sqrt(np.mean(effort**2, 0)), np.std(effort, 0),
        )  # fmt: skip
