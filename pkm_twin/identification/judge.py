# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The verdict on a fit, from its residual.

Noise is measured where the model cannot err: above the band of the motion. Inside the band the
residual must not be larger. Each error that a machine commonly has (a gain, a delay, a sensor's
offset, an elastic drive, another friction law, another geometry) adds its own signal to the
residual; the derivatives of the measurements by these errors, the suspects, are regressed on it one
by one, after what the fitted numbers and the differentiation can explain has been taken out. A
suspect that explains more than noise does is a finding (forward selection by the score test of a
restricted model: Rao, 1948).

Errors of usual size that the residual would not show may be there all the same, and lengths that
hide behind each other. All suspects together have a posterior distribution, given the residual,
with their usual sizes as the prior's standard deviations. The fitted numbers are corrected by the
mean of what they change, and its covariance widens the standard deviations (consider parameters:
Schmidt, 1966).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Final, Literal

import numpy as np

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.identification.estimation import WIDEN
from pkm_twin.identification.samples import EXACT

Answer = Literal["explains", "explains partly", "does not explain"]
Deviations = Literal["as estimated", "widened", "withheld"]
SENTENCE: Final[dict[Answer, str]] = {
    "explains": "explains", "explains partly": "partly explains",
    "does not explain": "does not explain",
}  # fmt: skip
SIGMAS: Final = 4.5
"""Standard deviations from which a suspect is a finding."""
HINT: Final = 3.0
"""And from which it is not excluded."""
NEAR: Final = 0.9
"""A suspect that explains this part of the best one's significance is named with it."""
CHOICES: Final = 3
"""Most suspects that are named in the place of a finding."""
FINDINGS: Final = 12
"""Most findings that are looked for."""
SEEN: Final = 1e-3
"""Part of its norm that a suspect keeps beside the fitted numbers, or it cannot be seen."""
RANK: Final = 1e-7
"""Least singular value, of columns of norm one, that counts."""
LOUD: Final = 1.5
"""Residual over noise, in the band of the motion, from which more than noise is left."""
MAX_UNEXPLAINED: Final = 0.2
"""Part of a channel's measured variation that may stay unexplained."""
ABSURD: Final = 10.0
"""Times its usual size from which an error, beyond doubt, is another model's."""
MAYBE: Final = 4
"""Findings without a usual size that may be none; the others are taken for certain."""
DOUBT: Final = 0.2
"""Part of a correction that is uncertain, as effects of errors are taken to be linear."""
HARM: Final = 3.0
"""Standard deviations of a fitted number by which an unseen error is worth a word."""
UNSEEN: Final = 3
"""Most unseen errors that are told."""
VALUES: Final = 30000
"""Values of the residual that are judged; of more, every so many rows."""
ALL: Final = "all joints"
"""Where an error is that all of them share."""
UNKNOWN: Final = "no known error"
"""What is named where a suspect fits that has no such size."""


@dataclass(frozen=True)
class Suspect:
    """An error that a machine or a recording may have.

    ``kind``: in words; ``where``: a joint, a direction, or a number of the file; ``unit``: of its
    size, empty for a ratio; ``usual``: a size that is common, None where there is none; ``known``:
    it is the standard deviation, and much larger sizes explain nothing. ``positive``: no size below
    zero is possible.
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
            f"{self.suspect} {_sized(self.size, self.suspect.unit)} +- "
            f"{_sized(self.deviation, self.suspect.unit)}, {self.sigmas:.3g} sigma"
            + "".join(f", or {other}" for other in self.others)
        )


@dataclass(frozen=True)
class Blind:
    """A suspect of usual size that the recordings would not show, and what it would do.

    ``change``: of the fitted parameter ``index``, the one it moves by the most deviations.
    """

    suspect: Suspect
    index: int
    change: float


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
    """Whether a model explains its recordings, by channel and by finding.

    ``hints``: suspects that the residual does not show clearly, but does not clear either.
    ``blind``: what the recordings would not show. ``shift``: what the suspects
    probably change in the fitted parameters, (p,), and ``unseen``: a factor of its covariance, rows
    whose squares sum to it, (rows, p). ``inflation``: factor on the covariance for what stays
    unexplained. ``slow``: the motion is too slow to show any inertia.
    """

    answer: Answer
    channels: tuple[Channel, ...]
    findings: tuple[Finding, ...]
    hints: tuple[Finding, ...]
    blind: tuple[Blind, ...]
    shift: Array
    inflation: float
    unseen: Array
    slow: bool = False

    def widened(self, covariance: Array) -> Array:
        """A covariance of corrected parameters (p, p), with what the model does not explain."""
        return np.asarray(self.inflation * covariance + self.unseen.T @ self.unseen, np.float64)

    @property
    def deviations(self) -> Deviations:
        """What becomes of the standard deviations."""
        if self.answer == "does not explain":
            return "withheld"
        return "widened" if self.findings or self.hints or self.inflation > 1.0 else "as estimated"

    def __str__(self) -> str:
        return f"the model {SENTENCE[self.answer]} the recordings"

    def lines(self, units: tuple[str, ...]) -> list[str]:
        """What it says beyond its answer, in plain sentences.

        :param units: of the channels' measurements.
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

    def blind_lines(self, names: tuple[str, ...], units: tuple[str, ...]) -> list[str]:
        """What the recordings would not show.

        :param names: of the fitted parameters, with their ``units``.
        """
        told = []
        for one in self.blind:
            change = f"{abs(one.change):.2g} {units[one.index]}".rstrip()
            told.append(
                f"these recordings cannot show: {one.suspect}. "
                f"{_sized(one.suspect.usual or 0.0, one.suspect.unit)} of it would change "
                f"{names[one.index]} by {change}; the standard deviations include this"
            )
        return told

    def as_json(self, units: tuple[str, ...], names: tuple[str, ...]) -> dict[str, Any]:
        """Plain data.

        :param units: of the channels' measurements. ``names``: of the fitted parameters.
        """
        return {
            "model": self.answer,
            "standard_deviations": self.deviations,
            "too_slow_for_inertia": self.slow,
            "findings": [_as_json(one) for one in self.findings],
            "not_excluded": [_as_json(one) for one in self.hints],
            "would_not_show": [
                {
                    "kind": one.suspect.kind, "where": one.suspect.where,
                    "size": one.suspect.usual, "unit": one.suspect.unit,
                    "parameter": names[one.index], "change": one.change,
                }
                for one in self.blind
            ],
            "channels": [
                {
                    "name": channel.name, "unit": unit, "residual_in_band": channel.residual,
                    "noise_in_band": channel.noise, "unexplained_part": channel.left,
                    "held_out_over_fitted": channel.held_out,
                }
                for channel, unit in zip(self.channels, units, strict=True)
            ],
        }  # fmt: skip


def _sized(size: float, unit: str) -> str:
    return f"{size:.3g} {unit}" if unit else f"{100 * size:.2g} %"


def _as_json(one: Finding) -> dict[str, Any]:
    return {
        "kind": one.suspect.kind, "where": one.suspect.where, "size": one.size,
        "unit": one.suspect.unit, "standard_deviation": one.deviation, "sigmas": one.sigmas,
        "or": [{"kind": other.kind, "where": other.where} for other in one.others],
    }  # fmt: skip


@dataclass(frozen=True, eq=False)
class Evidence:
    """What one recording says, as rows of one rate: k rows, n channels.

    ``residual``: measured less fitted, (k, n). ``explained``: columns of the fitted parameters,
    (k, n, p). ``nuisance``: of what is no error of the model: delays that are fitted, what the
    differentiation misses, (k, n, d). ``suspects``: by the suspects' sizes, (k, n, s). ``noise``:
    deviation of a row's noise as if rows were independent, (n,). ``band``: the part of the rows'
    rate that the filter passes. ``counts``: 1 for what is judged, (k, n). ``fitted``: how many
    rows, the first ones, were fitted. ``size``: rms of the measurements, ``variation``: about their
    mean, (n,).
    """

    residual: Array
    explained: Array
    nuisance: Array
    suspects: Array
    noise: Array
    band: float
    counts: Array
    fitted: int
    size: Array
    variation: Array

    @property
    def floor(self) -> Array:
        """The noise that the residual is held against, shape (n,)."""
        return np.maximum(self.noise, EXACT * self.size)

    @property
    def weight(self) -> Array:
        """One over the noise where something is judged, shape (k, n)."""
        return self.counts / np.where(self.floor > 0.0, self.floor, np.inf)

    def thinned(self, step: int) -> Evidence:
        """Every so many rows: nearer to independent of each other."""
        if step == 1:
            return self
        cut = {
            name: getattr(self, name)[::step]
            for name in ("residual", "explained", "nuisance", "suspects", "counts")
        }
        # A row's own noise stays; as independent rows fewer have less of it each.
        band = min(1.0, step * self.band)
        noise = self.noise * np.sqrt(self.band / band)
        return replace(self, **cut, noise=noise, band=band, fitted=-(-self.fitted // step))


def judge(
    channels: Sequence[str],
    suspects: Sequence[Suspect],
    cases: Sequence[Evidence],
    prior: tuple[Array, Array, Array],
    response: Callable[[Sequence[Array]], Array],
) -> Verdict:
    """Judge a fit by all of its recordings.

    :param prior: of the parameters of ``explained`` the change that the fit made, and how far each
        may be from its value before, (p,) each; of all parameters that were fitted the standard
        deviation, (f,).
    :param response: from signals that are added to the measurements, by recording (k, n, m), to
        what they change in the parameters that were fitted, shape (f, m).
    """
    step = -(-sum(case.residual.size for case in cases) // VALUES)
    few = [case.thinned(step) for case in cases]
    y, base, left = _rows(few, prior)
    seen = np.linalg.norm(left, axis=0)
    basis = basis_of(base)
    y, left = y - basis @ (basis.T @ y), left - basis @ (basis.T @ left)
    prior_sizes = np.array([one.usual or 0.0 if one.known else np.inf for one in suspects])
    positive = np.array([one.positive for one in suspects])
    chosen, after = _select(y, left, seen, prior_sizes, positive)
    sizes = _sizes(y, left, prior_sizes, [one.index for one in chosen])
    found = [_finding(suspects, one, pair) for one, pair in zip(chosen, sizes, strict=True)]
    sure = sum(one.sigmas >= SIGMAS for one in chosen)
    clear = found[:sure]
    count = sum(case.residual.size for case in few)
    told = tuple(
        _channel(name, k, few, (y[:count], after[:count]), basis.shape[1] + len(chosen))
        for k, name in enumerate(channels)
    )
    loud = [channel.left_ratio for channel in told if channel.left_ratio > LOUD]
    answer: Answer = "explains"
    absurd = [
        one for one in clear
        if abs(one.size) - SIGMAS * one.deviation > ABSURD * (one.suspect.usual or np.inf)
    ]  # fmt: skip
    if absurd or max(channel.left for channel in told) > MAX_UNEXPLAINED:
        answer = "does not explain"
    elif clear or loud or any(channel.held_out > LOUD for channel in told):
        answer = "explains partly"
    inflation = float(max([1.0, *loud]) ** 2)
    shift, unseen = _posterior(suspects, cases, (y, left), inflation, response, chosen)
    blind = _blind(suspects, cases, (np.linalg.norm(left, axis=0), seen), prior[2], response)
    return Verdict(
        answer, told, tuple(clear), tuple(found[sure:]), blind,
        shift, inflation, unseen,
    )  # fmt: skip


def _finding(suspects: Sequence[Suspect], one: _Chosen, size: tuple[float, float]) -> Finding:
    own = suspects[one.index]
    if own.positive and size[0] < 0.0:
        # The residual is there, but this cannot be its cause.
        own = replace(own, kind=UNKNOWN)
    others = dict.fromkeys(suspects[k] for k in one.near)
    others.pop(own, None)
    return Finding(own, *size, min(one.sigmas, abs(size[0]) / size[1]), tuple(others))


def _rows(
    cases: Sequence[Evidence], prior: tuple[Array, Array, Array]
) -> tuple[Array, Array, Array]:
    """Residual, what may explain it, and suspects over the noise; the prior's rows at the end."""
    values, tables, suspects = [], [], []
    for i, case in enumerate(cases):
        weight = case.weight[..., None]
        own = [
            case.nuisance if i == j else np.zeros((*case.residual.shape, other.nuisance.shape[-1]))
            for j, other in enumerate(cases)
        ]
        values.append((case.residual * weight[..., 0]).ravel())
        table = np.concatenate([case.explained, *own], -1) * weight
        tables.append(table.reshape(-1, table.shape[-1]))
        suspects.append((case.suspects * weight).reshape(-1, case.suspects.shape[-1]))
    change, scales, _ = prior
    # Delays may be any; what the differentiation misses is about as large as it says.
    sizes = [np.append(np.inf, np.ones(case.nuisance.shape[-1]))[:-1] for case in cases]
    scales = np.concatenate([scales, *sizes])
    tables.append(np.diag(1.0 / scales))
    values.append(np.pad(-change, (0, len(scales) - len(change))) / scales)
    suspects.append(np.zeros((len(scales), suspects[0].shape[1])))
    return np.concatenate(values), np.concatenate(tables), np.concatenate(suspects)


def basis_of(table: Array) -> Array:
    """An orthonormal basis of a table's columns."""
    norms = np.linalg.norm(table, axis=0)
    vectors, sizes, _ = np.linalg.svd(table[:, norms > 0.0] / norms[norms > 0.0], False)
    return np.asarray(vectors[:, sizes > RANK * sizes.max(initial=0.0)], np.float64)


@dataclass(frozen=True)
class _Chosen:
    """A suspect by its place, and those near it."""

    index: int
    sigmas: float
    near: tuple[int, ...]


def _select(
    y: Array, table: Array, seen: Array, prior: Array, positive: Mask
) -> tuple[list[_Chosen], Array]:
    """Suspects that the residual shows, the last perhaps not clearly; what stays of it.

    :param seen: norms of the suspects before the fitted numbers were taken out, (s,).
    :param prior: standard deviations that are known of their sizes, else infinite, (s,).
    :param positive: which sizes cannot be below zero, (s,).
    """
    chosen: list[_Chosen] = []
    left, rest = table.copy(), y
    known = np.isfinite(prior)
    while len(chosen) < FINDINGS and left.shape[1]:
        norms = np.linalg.norm(left, axis=0)
        good = norms > SEEN * np.maximum(seen, 1e-300)
        norms = np.where(good, norms, 1.0)
        scores = np.where(good, (rest @ left) / norms, 0.0)
        # What a size that is likely beforehand explains.
        share = np.where(known, norms * np.where(known, prior, 0.0), np.inf)
        share = 1.0 / (1.0 + np.maximum(share, 1e-300) ** -2.0)
        scores = scores * np.sqrt(share)
        # Between a hint and a finding the prior says as much as the residual.
        if np.abs(scores).max() < SIGMAS:
            scores = np.where(known, 0.0, scores)
        best = int(np.argmax(np.abs(scores)))
        sigmas = float(abs(scores[best]))
        if sigmas < HINT:
            break
        order = np.argsort(-np.abs(scores))
        scores = np.where(positive, np.maximum(scores, 0.0), scores)
        near = [int(k) for k in order if k != best and abs(scores[k]) > NEAR * sigmas][:CHOICES]
        chosen.append(_Chosen(best, sigmas, tuple(near)))
        if sigmas < SIGMAS:
            break
        unit = left[:, best] / norms[best]
        rest = rest - unit * (unit @ rest)
        left = left - np.outer(unit, unit @ left)
    return chosen, rest


def _sizes(
    y: Array, table: Array, prior: Array, chosen: Sequence[int]
) -> list[tuple[float, float]]:
    """Of all suspects that were chosen together, with standard deviations."""
    those = list(chosen)
    whole = np.concatenate([table[:, those], np.diag(1.0 / prior[those])])
    inverse = np.linalg.pinv(whole)
    sizes, deviations = inverse[:, : len(y)] @ y, np.linalg.norm(inverse, axis=1)
    return list(zip(sizes.tolist(), deviations.tolist(), strict=True))


def _posterior(
    suspects: Sequence[Suspect], cases: Sequence[Evidence], tables: tuple[Array, Array],
    inflation: float, response: Callable[[Sequence[Array]], Array], chosen: Sequence[_Chosen],
) -> tuple[Array, Array]:  # fmt: skip
    """What all suspects together change in the fitted parameters: mean, (f,), and factor, (r, f).

    One linear Gaussian model, averaged over which kinds of errors there are (Hoeting et al., 1999).
    Lengths are always in it, as none are exact. An error without a usual size is in it where the
    residual shows it, with a prior as wide as one row determines it. Of an error that all joints
    share and the residual does not show, the mean knows nothing: else it would spoil sound fits.

    :param tables: the residual and the suspects without what the fitted parameters explain.
    :returns: the covariance is the factor's transpose times the factor.
    """
    y, left = tables
    kinds: dict[tuple[str, bool] | int, list[int]] = {}
    sizes = np.array([one.usual or 0.0 for one in suspects])
    always = [k for k, one in enumerate(suspects) if one.usual and one.known]
    for k, one in enumerate(suspects):
        if one.usual and not one.known:
            # One error that all joints share is as likely as one of some of them.
            kinds.setdefault((one.kind, one.where == ALL), []).append(k)
    for place, finding in enumerate(chosen):
        for k in (finding.index, *finding.near):
            norm = float(np.linalg.norm(left[:, k]))
            if not sizes[k] and norm > 0.0:
                sizes[k] = np.sqrt(len(y)) / norm
                own = kinds.setdefault(place, []) if place < MAYBE else always
                own.append(k)
    used = np.flatnonzero(sizes)
    scaled = left[:, used] * sizes[used]
    moved = response([case.suspects[..., used] * sizes[used] for case in cases])
    gram, side = scaled.T @ scaled / inflation, scaled.T @ y / inflation
    shown = {k for one in chosen for k in (one.index, *one.near)}
    quiet = [suspects[own[0]].where == ALL and not shown & {*own} for own in kinds.values()]
    logs, parts, counts = [], [], []
    for which in product((False, True), repeat=len(kinds)):
        inside = [k for own, good in zip(kinds.values(), which, strict=True) if good for k in own]
        rows = np.searchsorted(used, sorted([*always, *inside]))
        root = np.linalg.cholesky(np.eye(len(rows)) + gram[np.ix_(rows, rows)])
        half = np.linalg.solve(root, np.column_stack([side[rows], moved[:, rows].T]))
        logs.append(0.5 * half[:, 0] @ half[:, 0] - np.log(np.diag(root)).sum())
        parts.append((half[:, 1:].T @ half[:, 0], half[:, 1:]))
        counts.append(not any(good and one for good, one in zip(which, quiet, strict=True)))
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    told = np.where(counts, weights, 0.0)
    mean = np.einsum("w,wf->f", told / told.sum(), np.stack([middle for middle, _ in parts]))
    factors = [
        np.sqrt(weight) * np.concatenate([half, (middle - mean)[None]])
        for weight, (middle, half) in zip(weights, parts, strict=True)
    ]
    rows = np.concatenate([WIDEN * one for one in factors] + [DOUBT * mean[None]])
    return mean, np.asarray(np.linalg.qr(rows, mode="r"), np.float64)


def _blind(
    suspects: Sequence[Suspect], cases: Sequence[Evidence], norms: tuple[Array, Array],
    deviations: Array, response: Callable[[Sequence[Array]], Array],
) -> tuple[Blind, ...]:  # fmt: skip
    """Suspects of usual size that do not show, by what they would do, one of each kind.

    :param norms: the suspects' after and before the fitted numbers were taken out.
    """
    after, seen = norms
    some = [
        k for k, one in enumerate(suspects)
        if one.usual and (after[k] * one.usual < SIGMAS or after[k] <= SEEN * seen[k])
    ]  # fmt: skip
    if not some:
        return ()
    usual = np.array([suspects[k].usual for k in some])
    moved = response([case.suspects[..., some] * usual for case in cases])
    ratio = np.abs(moved) / np.maximum(deviations, 1e-300)[:, None]
    found: dict[str, Blind] = {}
    for place in np.argsort(-ratio.max(0)):
        one, index = suspects[some[place]], int(np.argmax(ratio[:, place]))
        if ratio[index, place] > HARM and one.kind not in found and len(found) < UNSEEN:
            found[one.kind] = Blind(one, index, float(moved[index, place]))
    return tuple(found.values())


def _channel(
    name: str, k: int, cases: Sequence[Evidence], values: tuple[Array, Array], taken: int
) -> Channel:
    """A channel's figures over all recordings.

    :param values: residual over noise, rows flat, before and after the findings.
    :param taken: how many numbers were fitted.
    """
    starts = np.cumsum([0, *(case.residual.size for case in cases)])
    free, sums, noise, variation, rows = 0.0, np.zeros(2), 0.0, 0.0, 0.0
    parts = np.zeros((2, 2))
    for case, a, b in zip(cases, starts[:-1], starts[1:], strict=True):
        used = case.counts[:, k]
        count, own = float(used.sum()), case.floor[k] ** 2
        rows += count
        free += count * case.band
        noise += count * case.band * own
        variation += count * case.variation[k] ** 2
        for which in range(2):
            one = values[which][a:b].reshape(-1, case.residual.shape[1])[:, k]
            sums[which] += own * float(one @ one)
        square = used * case.residual[:, k] ** 2
        for half, part in enumerate((slice(0, case.fitted), slice(case.fitted, None))):
            parts[half] += float(square[part].sum()), float(used[part].sum())
    if not rows:
        return Channel(name, 0.0, 0.0, 0.0, 0.0, 1.0)
    share = min(taken / len(cases[0].noise), 0.5 * free) / max(free, 1.0)
    before, after = np.sqrt(sums / (rows * (1.0 - share)))
    level = np.sqrt(noise / rows)
    beyond = np.sqrt(max(after**2 - level**2, 0.0) / max(variation / rows, 1e-300))
    # By what stays of the noise in so many independent rows.
    sure = 1.0 + 4.0 * np.sqrt(2.0 / max(free, 1.0))
    fitted, held = (np.sqrt(p[0] / max(p[1], 1.0)) for p in parts)
    return Channel(
        name, float(before), float(level), float(beyond), float(after / (level * np.sqrt(sure))),
        float(held / max(fitted, level)),
    )  # fmt: skip
