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
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any, Final, Literal

import numpy as np

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.identification.evidence import Model, Posterior, Signals, Spectra
from pkm_twin.identification.samples import MIN_RELATIVE_NOISE

Answer = Literal["explains", "explains partly", "does not explain"]
Deviations = Literal["as estimated", "widened", "withheld"]
SENTENCE: Final[dict[Answer, str]] = {
    "explains": "explains",
    "explains partly": "partly explains",
    "does not explain": "does not explain",
}
SIGMAS: Final = 4.5
"""Standard deviations that a normal error exceeds in one of 150,000 cases."""
PRESENT_PROBABILITY: Final = 0.2
"""Prior probability that a machine or a recording has any error of one kind."""
FOUND_LOG_ODDS: Final = float(np.log(99.0))
"""Log odds from which an error is found: 99 %."""
ALTERNATIVE_LOG_ODDS: Final = 3.0
"""Log evidence below the best error's up to which another one is named with it: one in 20."""
MAX_NOISE_RATIO: Final = 1.5
"""Largest ratio of residual to noise, in the band of the motion, that noise alone explains."""
MAX_UNEXPLAINED: Final = 0.2
"""Largest fraction of a channel's measured variation that may stay unexplained."""
ALL_JOINTS: Final = "all joints"
"""Place of an error that all joints share."""
UNKNOWN_ERROR: Final = "no known error"
"""Name of a finding whose error explains the signal but has an impossible size."""
GEOMETRY: Final = "geometry"


@dataclass(frozen=True)
class Suspect:
    """An error that a machine or a recording may have.

    ``kind``: in words; ``where``: a joint, a direction, or a number of the file; ``unit``: of its
    size, empty for a ratio; ``usual``: its prior standard deviation, None where there is none;
    ``known``: every machine has it, as no length is exact. ``positive``: no size below zero is
    possible.
    """

    kind: str
    where: str
    unit: str = ""
    usual: float | None = None
    known: bool = False
    positive: bool = False

    def __str__(self) -> str:
        return f"{self.kind} ({self.where})"


@dataclass(frozen=True)
class Finding:
    """A suspect that the residual shows: its size, standard deviation, and how clearly.

    ``sigmas``: of the residual; no more than of the size, which other findings make less sure.

    ``others``: suspects that explain the residual nearly as well.
    """

    suspect: Suspect
    size: float
    deviation: float
    sigmas: float
    others: tuple[Suspect, ...] = ()

    def __str__(self) -> str:
        return (
            f"{self.suspect} {_write_size(self.size, self.suspect.unit)} +- "
            f"{_write_size(self.deviation, self.suspect.unit)}, {self.sigmas:.3g} sigma"
            + "".join(f", or {other}" for other in self.others)
        )


@dataclass(frozen=True)
class Channel:
    """A joint's, or a direction's, residual in the band of the motion.

    ``residual`` and ``noise``: rms, in the unit of the measurements; ``noise`` is what the signal
    has above the band, scaled to it. ``left``: the part of the measured variation that neither the
    fit nor a finding nor noise explains; ``left_ratio``: that residual over noise, less what chance
    may do. ``held_out``: residual of what was held out over that of what was fitted, or over noise.
    """

    name: str
    residual: float
    noise: float
    left: float
    left_ratio: float
    held_out: float


@dataclass(frozen=True, eq=False)
class Verdict:
    """Whether a model explains its recordings, and the posterior of the fitted numbers.

    ``hints``: errors that are as likely as not. ``change``: posterior mean of the numbers less the
    prior's mean, (p,). ``plain``: their covariance by noise alone, with the errors that were found;
    ``covariance``: with all errors that may be present, (p, p). ``own``: posterior mean of each
    recording's own unknowns. ``slow``: the motion is too slow to show any inertia.
    """

    answer: Answer
    channels: tuple[Channel, ...]
    findings: tuple[Finding, ...]
    hints: tuple[Finding, ...]
    change: Array
    plain: Array
    covariance: Array
    own: tuple[Array, ...]
    slow: bool = False

    @property
    def deviations(self) -> Deviations:
        """Report of the standard deviations: as estimated, widened, or withheld."""
        if self.answer == "does not explain":
            return "withheld"
        loud = any(channel.left_ratio > MAX_NOISE_RATIO for channel in self.channels)
        return "widened" if self.findings or self.hints or loud else "as estimated"

    def __str__(self) -> str:
        return f"the model {SENTENCE[self.answer]} the recordings"

    def list_sentences(self, units: tuple[str, ...]) -> list[str]:
        """List the sentences that explain the answer: causes, residuals and what is not excluded.

        :param units: units of the channels' measurements.
        """
        told = [f"likely cause: {one}" for one in self.findings]
        if self.slow:
            told.append(
                "the motion is too slow to show inertia above the noise: inertia parameters are "
                "undetermined, and a wrong time scale would not show"
            )
        for channel, unit in zip(self.channels, units, strict=True):
            if channel.left_ratio > 1.0 or self.answer == "does not explain":
                told.append(
                    f"{channel.name}: residual {channel.residual:.3g} {unit} in the band of the "
                    f"motion, noise {channel.noise:.3g} {unit}; {100 * channel.left:.2g} % of the "
                    "variation has no known cause"
                )
        told += [f"not excluded: {one}" for one in self.hints]
        if self.deviations != "as estimated":
            told.append(f"standard deviations are {self.deviations}")
        return told

    def as_json(self, units: tuple[str, ...]) -> dict[str, Any]:
        """Return plain data for JSON.

        :param units: of the channels' measurements.
        """
        return {
            "model": self.answer,
            "standard_deviations": self.deviations,
            "too_slow_for_inertia": self.slow,
            "findings": [_as_json(one) for one in self.findings],
            "not_excluded": [_as_json(one) for one in self.hints],
            "channels": [
                {
                    "name": channel.name,
                    "unit": unit,
                    "residual_in_band": channel.residual,
                    "noise_in_band": channel.noise,
                    "unexplained_part": channel.left,
                    "held_out_over_fitted": channel.held_out,
                }
                for channel, unit in zip(self.channels, units, strict=True)
            ],
        }


def _write_size(size: float, unit: str) -> str:
    return f"{size:.3g} {unit}" if unit else f"{100 * size:.2g} %"


def _as_json(one: Finding) -> dict[str, Any]:
    return {
        "kind": one.suspect.kind,
        "where": one.suspect.where,
        "size": one.size,
        "unit": one.suspect.unit,
        "standard_deviation": one.deviation,
        "sigmas": one.sigmas,
        "or": [{"kind": other.kind, "where": other.where} for other in one.others],
    }


@dataclass(frozen=True, eq=False)
class Case:
    """One recording: k rows of n channels, the first ``split`` of which are fitted.

    ``target``: measured signals less those of the prior's mean, (k, n). ``fitted``: columns of the
    p numbers; ``own``: of the recording's own d unknowns, with their standard deviations
    ``own_sizes``; ``errors``: of the s errors, (k, n, ...) each. ``counts``: 1 for what is used.
    ``noise``: deviation of a row's noise as if rows were independent, (n,). ``band``: the part of
    the rows' rate that the filter passes.
    """

    target: Array
    fitted: Array
    own: Array
    own_sizes: Array
    errors: Array
    measured: Array
    counts: Array
    noise: Array
    band: float
    split: int

    @property
    def columns(self) -> Array:
        """Columns of numbers, errors and own unknowns, shape (k, n, p + s + d)."""
        return np.concatenate([self.fitted, self.errors, self.own], -1)

    def spectra(self, count: int) -> Spectra:
        """Return the statistics of the first rows."""
        some = slice(0, count)
        return Spectra.from_signals(
            Signals(
                (self.measured - self.target)[some],
                self.columns[some],
                self.measured[some],
                self.counts[some],
                self.noise,
                self.band,
            )
        )


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
        # An error without a usual size makes up 3 % of the efforts.
        rms, size = (
            np.sqrt(sum(np.mean(part**2, 0) for part in parts))
            for parts in ([np.moveaxis(c.errors, -1, 1) for c in cases], [c.measured for c in cases])
        )
        usual = list[float]()
        for one, own in zip(errors, rms, strict=True):
            j = int(np.argmax(own / np.maximum(size, 1e-300)))
            usual.append(one.usual or (0.03 * float(size[j] / own[j]) if own[j] > 0.0 else 0.0))
        first = self.count + len(errors)
        self.places, deviations = [], [sizes, np.array(usual, np.float64)]
        for case in cases:
            last = first + len(case.own_sizes)
            self.places.append(np.r_[: self.count + len(errors), first:last])
            deviations.append(case.own_sizes)
            first = last
        self.model, self.whole = (
            Model.from_spectra(
                [c.spectra(k) for c, k in zip(cases, counts, strict=True)], self.places, np.concatenate(deviations)
            )
            for counts in ([c.split for c in cases], [len(c.target) for c in cases])
        )
        self.certain = np.ones(first, np.bool_)
        self.certain[self.count : self.count + len(errors)] = False
        self.used = self.certain
        self.known = [self.count + k for k, one in enumerate(errors) if one.known]
        self.kinds: dict[tuple[str, bool], list[int]] = {}
        for k, one in enumerate(errors):
            if one.usual and not one.known:
                own = self.kinds.setdefault((one.kind, one.where == ALL_JOINTS), [])
                own.append(self.count + k)

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
        alike = dict[tuple[str, bool], list[int]]()
        for k, one in enumerate(self.errors):
            alike.setdefault((one.kind, one.where == ALL_JOINTS), []).append(self.count + k)
        odds = float(np.log(PRESENT_PROBABILITY / (1.0 - PRESENT_PROBABILITY)))
        found = [
            ([k], odds - float(np.log(len(own)))) for (kind, _), own in alike.items() for k in own if kind != GEOMETRY
        ]
        found += [
            (own, odds - (0.0 if kind == GEOMETRY else float(np.log(2.0 * len(own)))))
            for (kind, _), own in alike.items()
            if len(own) > 1
        ]
        return found

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
        kinds: list[list[int]] = list(self.kinds.values())
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
        some = slice(0, self.count)
        mean = self.model.posterior(used).mean[some]
        covariance = np.zeros((self.count, self.count))
        for k in np.flatnonzero(weights):
            one = self.model.posterior(masks[k], shares)
            away = one.mean[some] - mean
            covariance += weights[k] * (one.covariance[some, some] + np.outer(away, away))
        # Combinations that the recordings hardly determine keep the file's values.
        plain = self.model.posterior(used).covariance[some, some]
        sizes = self.model.deviation[some]
        values, vectors = np.linalg.eigh(plain / np.outer(sizes, sizes))
        # A combination is determined if its deviation is a fifth of the prior's.
        told = vectors[:, values < 1.0 / 26.0]
        change = sizes * (told @ (told.T @ (mean / sizes)))
        return change, covariance + np.outer(mean - change, mean - change)

    def name(self, places: Sequence[int]) -> Suspect:
        """Return the error of some columns; that of several joints is of all."""
        first = self.errors[places[0] - self.count]
        if len(places) == 1:
            return first
        if first.kind == GEOMETRY:
            return Suspect(GEOMETRY, "lengths and angles", "usual errors", 1.0)
        return replace(first, where=ALL_JOINTS)

    def describe(self, posterior: Posterior, one: Selected) -> Finding:
        """Return a selected error with its size, the root mean square of several columns'."""
        own, rows = self.name(one.places), np.array(one.places)
        mean = posterior.mean[rows]
        size = float(mean[0])
        deviation = float(np.sqrt(posterior.covariance[rows[0], rows[0]]))
        if len(rows) > 1:
            scale = self.model.deviation[rows] if own.kind == GEOMETRY else 1.0
            size = float(np.sqrt(np.mean((mean / scale) ** 2)))
            deviation = size / np.sqrt(2.0 * max(one.odds, 1e-9))
        if own.positive and (mean < 0.0).any():
            # The size is impossible, so the cause of the signal is another error.
            own = replace(own, kind=UNKNOWN_ERROR)
        others = tuple(dict.fromkeys(map(self.name, one.others)))
        return Finding(own, size, deviation, abs(size) / max(deviation, 1e-300), others)

    def residuals(self, posterior: Posterior) -> list[Array]:
        """Return what a posterior's mean leaves of the signals, (k, n) of each recording."""
        return [
            case.counts * (case.target - case.columns @ posterior.mean[place])
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
    own = tuple(last.mean[place[fitted.count + len(errors) :]] for place in fitted.places)
    some = slice(0, fitted.count)
    fitted.used = used
    return Verdict(
        answer,
        told,
        tuple(found[:sure]),
        tuple(found[sure:]),
        mean,
        last.covariance[some, some],
        covariance,
        own,
    ), fitted


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
