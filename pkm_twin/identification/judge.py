# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Fit numbers to recordings and judge whether the model explains them, by one posterior.

The model is that of :mod:`pkm_twin.identification.evidence`. Its columns are those of the fitted
numbers, of each recording's own unknowns (a delay, what the differentiation misses), and of errors
that machines and recordings commonly have (a gain, a sensor's offset, an elastic drive, another
friction law, another geometry), each with its usual size as the prior's standard deviation. An
error is found where it multiplies the evidence so much that, with its prior odds, it is present
with 99 %. The numbers and their covariance are means over all sets of kinds of errors, each with
its posterior probability (Hoeting et al., Bayesian model averaging, 1999): an error that the
recordings cannot show counts with its prior probability.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.identification.columns import (
    DELAY,
    DELAYED_EFFORTS,
    ELASTIC,
    GAIN,
    PRIOR_DEVIATIONS,
    SPEED,
    Errors,
    find_deviation,
)
from pkm_twin.identification.evidence import Model, Posterior, Signals, Spectra
from pkm_twin.identification.rows import Problem
from pkm_twin.identification.samples import MIN_RELATIVE_NOISE
from pkm_twin.identification.verdict import (
    ALL_JOINTS,
    GEOMETRY,
    LINE,
    MAX_NOISE_RATIO,
    Answer,
    Channel,
    Finding,
    Suspect,
    Verdict,
)

SIGMAS: Final = 4.5
"""Standard deviations that a normal error exceeds in one of 150,000 cases."""
PRESENT_PROBABILITY: Final = 0.2
"""Prior probability that a machine or a recording has any error of one kind."""
FOUND_LOG_ODDS: Final = float(np.log(99.0))
"""Log odds from which an error is found: 99 %."""
ALTERNATIVE_LOG_ODDS: Final = 3.0
"""Log evidence below the best error's up to which another one is named with it: one in 20."""
MAX_UNEXPLAINED: Final = 0.2
"""Largest fraction of a channel's measured variation that may stay unexplained."""


@dataclass(frozen=True, eq=False)
class Case(Signals):
    """One recording, the first ``split`` rows of which are fitted.

    ``columns``: of the p numbers, of the s errors, and of the recording's own d unknowns, (k, n,
    p + s + d). ``own_sizes``: prior standard deviations of the latter, (d,).
    """

    own_sizes: Array
    split: int


@dataclass(frozen=True)
class Selected:
    """Columns of an error that was selected, log odds, and columns that explain as much."""

    places: list[int]
    odds: float
    others: tuple[list[int], ...]


class Fitted:
    """All recordings of a fit, and the kinds of errors by their places among x.

    ``model``: of the rows that are fitted, for the numbers; ``whole``: of all rows, for the errors.
    """

    def __init__(self, errors: Sequence[Suspect], cases: Sequence[Case], sizes: Array) -> None:
        self.errors, self.cases, self.count = errors, cases, len(sizes)
        some = slice(self.count, self.count + len(errors))
        rms, size = (
            np.sqrt(sum(np.mean(part**2, 0) for part in parts))
            for parts in ([np.moveaxis(c.columns[..., some], -1, 1) for c in cases], [c.measured for c in cases])
        )
        usual = [find_deviation(one, own, size) for one, own in zip(errors, rms, strict=True)]
        first = self.count + len(errors)
        self.places, deviations = [], [sizes, np.array(usual, np.float64)]
        for case in cases:
            last = first + len(case.own_sizes)
            self.places.append(np.r_[: self.count + len(errors), first:last])
            deviations.append(case.own_sizes)
            first = last
        self.model, self.whole = (
            Model.from_spectra(
                [Spectra.from_signals(c, slice(0, k)) for c, k in zip(cases, counts, strict=True)],
                self.places,
                np.concatenate(deviations),
            )
            for counts in ([c.split for c in cases], [len(c.measured) for c in cases])
        )
        self.certain = np.ones(first, np.bool_)
        self.certain[self.count : self.count + len(errors)] = False
        self.used = self.certain
        self.known = [self.count + k for k, one in enumerate(errors) if one.known]
        self.kinds: dict[tuple[str, bool], list[int]] = {}
        for k, one in enumerate(errors):
            self.kinds.setdefault((one.kind, one.where == ALL_JOINTS), []).append(self.count + k)

    def with_columns(self, used: Mask, places: Sequence[int]) -> Mask:
        """Return a mask of columns with some more of them."""
        wide = used.copy()
        wide[list(places)] = True
        return wide

    @cached_property
    def candidates(self) -> list[tuple[list[int], float]]:
        """Columns that may be selected, with log prior odds: errors, and kinds on all joints.

        Any joint is as likely as another, and twice as likely as all. Lengths are one error.
        """
        odds = float(np.log(PRESENT_PROBABILITY / (1.0 - PRESENT_PROBABILITY)))
        single, whole = list[tuple[list[int], float]](), list[tuple[list[int], float]]()
        for (kind, _), own in self.kinds.items():
            if kind != GEOMETRY:
                single += [([k], odds - float(np.log(len(own)))) for k in own]
            if len(own) > 1:
                whole.append((own, odds - (0.0 if kind == GEOMETRY else float(np.log(2.0 * len(own))))))
        return single + whole

    def select(self, certain: Mask) -> tuple[list[Selected], Mask]:
        """Select errors one by one, the most probable first, by what they add to the evidence.

        :param certain: columns of numbers and own unknowns that may explain the signals.
        :returns: also the columns of those that are found.
        """
        used, chosen = certain.copy(), list[Selected]()
        while len(chosen) < 12:
            more = np.zeros(len(used), np.bool_)
            more[self.count : self.count + len(self.errors)] = True
            gains, sizes = self.whole.gains(used, more & ~used)
            before = self.whole.log_evidence(used)
            odds, possible = list[float](), list[bool]()
            for places, prior in self.candidates:
                first = self.errors[places[0] - self.count]
                possible.append(not first.positive or bool((sizes[places] >= 0.0).all()))
                if used[places].all():
                    odds.append(-np.inf)
                elif len(places) == 1:
                    odds.append(float(gains[places[0]]) + prior)
                else:
                    wide = self.with_columns(used, places)
                    odds.append(self.whole.log_evidence(wide) - before + prior)
            best = int(np.argmax(odds))
            if not odds[best] > 0.0:
                break
            near = [
                k
                for k in np.argsort(-np.array(odds)).tolist()
                if odds[k] > odds[best] - ALTERNATIVE_LOG_ODDS
                and possible[k]
                and not {*self.candidates[best][0]} & {*self.candidates[k][0]}
            ]
            places = self.candidates[best][0]
            others = tuple(self.candidates[k][0] for k in near[:3])
            chosen.append(Selected(places, odds[best], others))
            if odds[best] < FOUND_LOG_ODDS:
                break
            used = self.with_columns(used, places)
        return chosen, used

    def average(self, used: Mask, chosen: Sequence[Selected]) -> tuple[Array, Array]:
        """Return the numbers' mean, and their covariance about it over all sets of kinds of errors.

        The mean is that of the found errors: numbers that are used without the others predict best.
        Errors that are known to be there, such as those of lengths, and those that are as likely as
        not are in all sets. The sets are weighed by all rows, as errors are selected; each set's
        numbers are those of the fitted rows.

        :param used: columns of the found errors: their shares of the discrepancy are taken.
        """
        # Errors that have a usual size; all of a kind have one or none.
        firsts = [(self.errors[own[0] - self.count], own) for own in self.kinds.values()]
        kinds = [own for first, own in firsts if first.usual and not first.known]
        always = self.with_columns(self.certain, [*self.known, *(k for one in chosen for k in one.places)])
        usual = {*self.known, *(k for own in kinds for k in own)}
        others = [[k for other in one.others for k in other if k not in usual] for one in chosen]
        kinds += [own for own in others if own][:3]
        shares, all_logs = self.model.logs(used), self.whole.logs(used)
        logs, masks = [], []
        for which in product((False, True), repeat=len(kinds)):
            inside = [k for own, on in zip(kinds, which, strict=True) if on for k in own]
            masks.append(self.with_columns(always, inside))
            prior = [PRESENT_PROBABILITY if on else 1.0 - PRESENT_PROBABILITY for on in which]
            logs.append(self.whole.log_evidence(masks[-1], all_logs) + float(np.log(prior).sum()))
        weights = np.exp(np.array(logs) - max(logs))
        weights[weights < 1e-3] = 0.0
        weights /= weights.sum()
        some, best = slice(0, self.count), self.model.posterior(used)
        mean, plain = best.mean[some], best.covariance[some, some]
        covariance = np.zeros((self.count, self.count))
        for k in np.flatnonzero(weights):
            one = self.model.posterior(masks[k], shares)
            away = one.mean[some] - mean
            covariance += weights[k] * (one.covariance[some, some] + np.outer(away, away))
        # Combinations that the recordings hardly determine keep the file's values.
        sizes = self.model.deviation[some]
        values, vectors = np.linalg.eigh(plain / np.outer(sizes, sizes))
        # A combination is determined if its deviation is a fifth of the prior's.
        told = vectors[:, values < 1.0 / 26.0]
        change = sizes * (told @ (told.T @ (mean / sizes)))
        return change, covariance + np.outer(mean - change, mean - change)

    def find_suspect(self, places: Sequence[int]) -> Suspect:
        """Return the error that a set of columns belongs to; columns of several joints: of all joints."""
        first = self.errors[places[0] - self.count]
        if len(places) == 1:
            return first
        if first.kind == GEOMETRY:
            return Suspect(GEOMETRY, "lengths and angles", "usual errors", 1.0)
        return replace(first, where=ALL_JOINTS)

    def describe(self, posterior: Posterior, one: Selected) -> Finding:
        """Return a selected error with its size, the root mean square of several columns'."""
        own, rows = self.find_suspect(one.places), np.array(one.places)
        mean = posterior.mean[rows]
        size = float(mean[0])
        deviation = float(np.sqrt(posterior.covariance[rows[0], rows[0]]))
        if len(rows) > 1:
            scale = self.model.deviation[rows] if own.kind == GEOMETRY else 1.0
            size = float(np.sqrt(np.mean((mean / scale) ** 2)))
            deviation = size / np.sqrt(2.0 * max(one.odds, 1e-9))
        if own.positive and (mean < 0.0).any():
            # The size is impossible, so the cause of the signal is another error.
            own = replace(own, kind="no known error")
        others = tuple(dict.fromkeys(map(self.find_suspect, one.others)))
        return Finding(own, size, deviation, abs(size) / max(deviation, 1e-300), others)

    def residuals(self, posterior: Posterior) -> list[Array]:
        """Return what a posterior's mean leaves of the signals, (k, n) of each recording."""
        return [
            case.counts * (case.measured - case.certain - case.columns @ posterior.mean[place])
            for case, place in zip(self.cases, self.places, strict=True)
        ]


def fit_and_judge(
    channels: Sequence[str], errors: Sequence[Suspect], cases: Sequence[Case], sizes: Array
) -> tuple[Verdict, Fitted]:
    """Fit parameters to recordings and judge whether the model explains them.

    :param errors: errors that machines and recordings commonly have, (s,).
    :param sizes: prior standard deviations of the parameters, (p,).
    """
    fitted = Fitted(errors, cases, sizes)
    chosen, used = fitted.select(fitted.certain)
    first, last = (fitted.model.posterior(one) for one in (fitted.certain, used))
    seen = fitted.whole.posterior(used)
    wide = fitted.whole.posterior(fitted.with_columns(used, [k for o in chosen for k in o.places]))
    found = [fitted.describe(seen if one.odds >= FOUND_LOG_ODDS else wide, one) for one in chosen]
    sure = sum(one.odds >= FOUND_LOG_ODDS for one in chosen)
    mean, covariance = fitted.average(used, chosen)
    taken = fitted.count + sum(len(one.places) for one in chosen)
    both = [fitted.residuals(one) for one in (first, last)]
    told = tuple(_judge_channel(name, k, cases, both, taken) for k, name in enumerate(channels))
    # An error certainly above ten times its usual size shows that the model is another one.
    absurd = [
        one for one in found[:sure] if abs(one.size) - SIGMAS * one.deviation > 10.0 * (one.suspect.usual or np.inf)
    ]
    answer: Answer = "explains"
    if absurd or max(channel.left for channel in told) > MAX_UNEXPLAINED:
        answer = "does not explain"
    elif sure or any(max(channel.left_ratio, channel.held_out) > MAX_NOISE_RATIO for channel in told):
        answer = "explains partly"
    plain, fitted.used = last.covariance[: fitted.count, : fitted.count], used
    return Verdict(answer, told, tuple(found[:sure]), tuple(found[sure:]), mean, plain, covariance), fitted


def make_basis(table: Array) -> Array:
    """Return an orthonormal basis of a table's columns."""
    norms = np.linalg.norm(table, axis=0)
    vectors, sizes, _ = np.linalg.svd(table[:, norms > 0.0] / norms[norms > 0.0], False)
    return np.asarray(vectors[:, sizes > 1e-7 * sizes.max(initial=0.0)], np.float64)


def _judge_channel(name: str, j: int, cases: Sequence[Case], both: Sequence[Sequence[Array]], taken: int) -> Channel:
    """Compare a channel's residual with its noise, over all recordings.

    :param both: residuals before and after the found errors, (k, n) of each recording.
    :param taken: how many numbers and errors were fitted.
    """
    before, after = ([one[:, j] for one in part] for part in both)
    rows = sum(float(case.counts[:, j].sum()) for case in cases)
    if not rows:
        return Channel(name, 0.0, 0.0, 0.0, 0.0, 1.0)
    free = sum(float(case.counts[:, j].sum()) * case.band for case in cases)
    share = min(taken / len(cases[0].noise), 0.5 * free) / max(free, 1.0)

    def mean(parts: Sequence[Array]) -> float:
        return float(sum((one**2).sum() for one in parts)) / rows

    level, variation = 0.0, 0.0
    for case in cases:
        part = float(case.counts[:, j].sum()) / rows
        own = case.measured[:, j]
        floor = max(float(case.noise[j]), MIN_RELATIVE_NOISE * float(np.sqrt(np.mean(own**2))))
        level += part * case.band * floor**2
        variation += part * float(np.var(own))
    now = mean(after) / (1.0 - share)
    left = np.sqrt(max(now - level, 0.0) / max(variation, 1e-300))
    sure = 1.0 + 4.0 * np.sqrt(2.0 / max(free, 1.0))
    halves = []
    for begin, end in ((0, 1), (1, 2)):
        square = count = 0.0
        for one, case in zip(after, cases, strict=True):
            some = slice(*(0, case.split, len(one))[begin : end + 1])
            square += float(np.sum(one[some] ** 2))
            count += float(case.counts[some, j].sum())
        halves.append(np.sqrt(square / max(count, 1.0)))
    fitted, held = halves
    return Channel(
        name,
        float(np.sqrt(mean(before) / (1.0 - share))),
        float(np.sqrt(level)),
        float(left),
        float(np.sqrt(now / max(level * sure, 1e-300))),
        float(held / max(fitted, np.sqrt(level), 1e-300)),
    )


def judge_problem(problem: Problem) -> Verdict:
    """Fit the chosen numbers of a problem, and judge whether the model explains its recordings."""
    robot, everything, chosen = problem.robot, problem.everything, problem.chosen
    kinds = everything.kinds
    cases, errors = list[Case](), list[Suspect]()
    for rows in problem.whole:
        found, s = Errors.from_rows(rows, problem.values), rows.signals
        # Columns of numbers that are not fitted are those of a motion without noise; the sign of a
        # velocity is filtered as the efforts are.
        nominal, _ = rows.model.columns(s.motion)
        others = np.where(kinds == "friction", rows.table, nominal)[..., ~chosen]
        parts = [rows.table[..., chosen], found.columns, others, -rows.change[..., None], found.missed]
        sizes = np.append(PRIOR_DEVIATIONS[DELAY], np.ones(found.missed.shape[-1]))
        certain, columns = rows.rest + rows.table @ everything.values, np.concatenate(parts, -1)
        cases.append(Case(certain, columns, rows.effort, rows.counts, s.noise, s.band, sizes, rows.held_from))
        errors = [*found.suspects]
    words = {"rotor": "rotor inertia", "inertia": "mass or inertia"}
    for k in np.flatnonzero(~chosen).tolist():
        kind = f"{words.get(kinds[k], kinds[k])} other than the file's"
        errors.append(Suspect(kind, everything.names[k], everything.units[k]))
    verdict, fitted = fit_and_judge(robot.joint_names, errors, cases, problem.both.prior[: chosen.sum()])
    slow = bool((chosen & (kinds != "friction")).any()) and not _shows_inertia(fitted, kinds[chosen] == "friction")
    verdict = replace(verdict, slow=slow)
    if (chosen & (kinds == "inertia")).any() and not verdict.findings:
        verdict = _compare_file_masses(verdict, fitted, kinds[chosen] == "inertia")
    if not {one.suspect.kind for one in verdict.findings} & {ELASTIC, DELAYED_EFFORTS}:
        verdict = _compare_elastic_drives(verdict, fitted)
    # Of each joint the clearest line: above the band, so that no number changes.
    lines = sorted((one for rows in problem.whole for one in rows.signals.lines), key=lambda one: one.sigmas)
    told = []
    for j, line in sorted({one.joint: one for one in lines}.items()):
        where = f"{robot.joint_names[j]}, {line.rms:.2g} {robot.effort_units[j]} rms"
        told.append(Finding(Suspect(LINE, where, "Hz"), line.frequency, line.resolution, line.sigmas))
    verdict = replace(verdict, findings=(*verdict.findings, *told))
    if (slow or told) and verdict.answer == "explains":
        verdict = replace(verdict, answer="explains partly")
    return verdict


def _compare_file_masses(verdict: Verdict, fitted: Fitted, masses: Mask) -> Verdict:
    """Name one error beside the fitted masses where it explains as much with the file's masses.

    Any scale of the efforts is one of them.
    """
    certain = fitted.certain.copy()
    certain[: fitted.count][masses] = False
    other = copy(fitted)
    scale = [one.kind == GAIN and one.where == ALL_JOINTS for one in fitted.errors].index(True)
    factors = np.ones(len(certain))
    factors[fitted.count + scale] = 1.0 / PRIOR_DEVIATIONS[GAIN]
    other.whole = fitted.whole.widened(factors)
    selected, used = other.select(certain)
    if len(selected) != 1 or selected[0].odds < FOUND_LOG_ODDS:
        return verdict
    log = other.whole.log_evidence(used) - FOUND_LOG_ODDS
    if log < fitted.whole.log_evidence(fitted.used) - ALTERNATIVE_LOG_ODDS:
        return verdict
    found = fitted.describe(other.whole.posterior(used), selected[0])
    alike = Suspect("the masses that were fitted", "all of them")
    change = fitted.model.posterior(used).mean[: fitted.count] - verdict.change
    return replace(
        verdict,
        answer="explains partly",
        findings=(replace(found, others=(*found.others, alike)),),
        covariance=verdict.covariance + np.outer(change, change),
    )


def _compare_elastic_drives(verdict: Verdict, fitted: Fitted) -> Verdict:
    """Name elastic drives beside a delay of all efforts where they explain as much."""
    delays = [place[fitted.count + len(fitted.errors)] for place in fitted.places]
    elastic = [fitted.count + k for k, one in enumerate(fitted.errors) if one.kind == ELASTIC]
    delayed = fitted.used
    stiff = delayed.copy()
    stiff[delays] = False
    other = fitted.with_columns(stiff, elastic)
    logs = [fitted.whole.log_evidence(one) for one in (delayed, other, stiff)]
    if logs[1] < max(logs[0] - ALTERNATIVE_LOG_ODDS, logs[2]):
        return verdict
    one, two = (fitted.whole.posterior(used) for used in (delayed, other))
    gives, errors = two.mean[elastic], np.sqrt(np.diag(two.covariance)[elastic])
    if (gives < -2.0 * errors).any():
        return verdict
    sizes = ", ".join(
        f"{fitted.errors[k - fitted.count].where} {give:.2g} {fitted.errors[k - fitted.count].unit}"
        for k, give in zip(elastic, gives.tolist(), strict=True)
        if give > 0.0
    )
    place = max(delays, key=lambda k: abs(one.mean[k]))
    size, deviation = float(one.mean[place]), float(np.sqrt(one.covariance[place, place]))
    late, others = Suspect(DELAYED_EFFORTS, ALL_JOINTS, "s"), (Suspect(ELASTIC, sizes),)
    hint = Finding(late, size, deviation, abs(size) / deviation, others)
    change = (two.mean - one.mean)[: fitted.count]
    return replace(verdict, hints=(*verdict.hints, hint), covariance=verdict.covariance + np.outer(change, change))


def _shows_inertia(fitted: Fitted, friction: Mask) -> bool:
    """Return whether the recordings show time at twice or half its rate, with any friction.

    :param friction: which of the numbers are friction, (p,).
    """
    speed = fitted.count + [one.kind for one in fitted.errors].index(SPEED)
    own = fitted.count + len(fitted.errors)
    square, fraction, count = 0.0, 0.0, 0.0
    for case in fitted.cases:
        floor = np.maximum(case.noise, MIN_RELATIVE_NOISE * np.sqrt(np.mean(case.measured**2, 0)))
        weight = case.counts[..., None] / np.maximum(floor, 1e-300)[:, None]
        columns = [*np.flatnonzero(friction), *range(own, case.columns.shape[-1])]
        table = case.columns[..., columns] * weight
        basis = make_basis(table.reshape(-1, table.shape[-1]))
        column = (case.columns[..., speed] * weight[..., 0]).ravel()
        left = column - basis @ (basis.T @ column)
        square += float(left @ left)
        # The derivative by the rate is twice the efforts of inertia.
        inertial = 0.5 * left.reshape(case.measured.shape) * floor
        fraction += float(np.sum((inertial / np.maximum(np.std(case.measured, 0), 1e-300)) ** 2))
        count += float(case.counts.sum())
    # Twice the rate takes three quarters of the efforts of inertia, which are 3/8 of their derivative
    # by the rate. Other masses and offsets take up what is below a tenth of the efforts.
    return square > (8.0 / 3.0 * SIGMAS) ** 2 and fraction > 0.1**2 * count
