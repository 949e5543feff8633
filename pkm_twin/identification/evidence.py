# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""One Gaussian model of measured signals, with its posterior and its evidence in closed form.

    y = X x + discrepancy + noise,    x ~ N(mean, deviation^2)

The columns X are those of the numbers that are fitted and of usual errors. The likelihood is
evaluated in the cosine transform along time, where stationary signals are independent (Whittle,
1953). There the noise is white in the band of the motion, with a measured density, and the
discrepancy, which stands for every error without a column, has the spectrum of the measured
signal times the square of an unknown ratio (Kennedy, O'Hagan, Bayesian calibration of computer
models, 2001). The ratio's prior is uniform in its logarithm. For each ratio the posterior of x is
normal, and the evidence, the probability of the signals, is a determinant and a sum of squares
(MacKay, 1992).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for

from pkm_twin.codegen.arrays import Array, Indices, Mask
from pkm_twin.identification.samples import MIN_RELATIVE_NOISE

DISCREPANCY_RATIOS: Final = np.geomspace(1e-3, 0.5, 8)
"""Candidate ratios of the discrepancy to the measured signal, both RMS; below them is rounding."""
BANDS: Final = 12
"""Number of frequency bands, of equal logarithmic width, in which spectra are taken as constant."""
FLAT_BAND: Final = 0.8
"""Fraction of the filter's band in which its gain is one."""
NEGLIGIBLE_LOG_WEIGHT: Final = 6.0
"""Log evidence below the best ratio's from which a ratio is skipped: a weight of 1 in 400."""


@dataclass(frozen=True, eq=False)
class Signals:
    """Rows of one recording: k samples of n channels.

    ``certain``: what the model says at x = 0, (k, n). ``columns``: its derivatives by x, (k, n, c).
    ``measured``: (k, n). ``counts``: 1 where a sample is used, else 0. ``noise``: standard
    deviation of a row's noise as if rows were independent, (n,). ``band``: the part of the rows'
    rate that the filter passes.
    """

    certain: Array
    columns: Array
    measured: Array
    counts: Array
    noise: Array
    band: float


Information = tuple[Array, Array, float, float]
"""X'V^-1 X, X'V^-1 y, y'V^-1 y and -log det V / 2, of y less what is certain."""


@dataclass(frozen=True, eq=False)
class Spectra:
    """Sufficient statistics of a recording, by channel and band of frequency.

    ``grams``: inner products of what is certain, the columns, and the measured signals of all
    channels, (n, bands, 1 + c + n, 1 + c + n). ``counts``: coefficients in each band. ``noise``:
    variance of a coefficient's noise, (n, 1). ``power``: mean square of a coefficient of the
    measured signal, smoothed over bands, (n, bands).
    """

    grams: Array
    counts: Array
    noise: Array
    power: Array

    @classmethod
    def from_signals(cls, s: Signals, rows: slice = slice(None)) -> Spectra:
        """Transform some rows of a recording's signals."""
        certain, columns, measured, counts = (one[rows] for one in (s.certain, s.columns, s.measured, s.counts))
        k, n = measured.shape
        table = np.concatenate([certain[..., None], columns], -1) * counts[..., None]
        both = scipy.fft.dct(table, axis=0, norm="ortho")
        seen = scipy.fft.dct(measured * counts, axis=0, norm="ortho")
        last = max(min(BANDS + 2, k), round(FLAT_BAND * s.band * k) if s.band < 1.0 else k)
        edges = np.unique(np.geomspace(1, last, BANDS + 1).astype(int))
        edges[0] = 0
        grams, power = [], []
        for a, b in pairwise(edges.tolist()):
            every = np.broadcast_to(seen[a:b, None], (b - a, n, n))
            part = np.moveaxis(np.concatenate([both[a:b], every], -1), 1, 0)
            grams.append(part.swapaxes(1, 2) @ part)
            # Without the constant part of the signal.
            power.append(np.mean(seen[max(a, 1) : max(b, 2)] ** 2, 0))
        p = np.array(power)
        wide = np.concatenate([p[:1], p, p[-1:]])
        p = np.maximum((wide[:-2] + 2.0 * wide[1:-1] + wide[2:]) / 4.0, 1e-6 * p.max(0))
        rms = np.sqrt(np.mean(measured**2, 0))
        used = np.maximum(counts.mean(0), 1.0 / k)
        noise = np.maximum(np.maximum(s.noise, MIN_RELATIVE_NOISE * rms) ** 2 * used, 1e-300)
        return cls(np.stack(grams, 1), np.diff(edges).astype(float), noise[:, None], p.T)

    def information(self, ratio: float, gains: Array | None = None, order: Sequence[int] | None = None) -> Information:
        """Return the information matrix of x, its right side, the sum of squares and the log determinant.

        :param ratio: of the discrepancy to the measured signal. ``gains``: factors on the model's
            signals, (n,). ``order``: the channel whose model each measured channel is compared with.
        """
        n = len(self.noise)
        count = self.grams.shape[-1] - n
        weights = 1.0 / (self.noise + ratio**2 * self.power)
        total, side, square = np.zeros((count, count)), np.zeros(count), 0.0
        for j, i in enumerate(range(n) if order is None else order):
            gram = np.tensordot(weights[j], self.grams[i], 1)
            gain = 1.0 if gains is None else float(gains[j])
            total += gain**2 * gram[:count, :count]
            side += gain * gram[:count, count + j]
            square += float(gram[count + j, count + j])
        square += float(total[0, 0] - 2.0 * side[0])
        log = 0.5 * float(np.sum(self.counts * np.log(weights)))
        return total[1:, 1:], side[1:] - total[1:, 0], square, log


@dataclass(frozen=True, eq=False)
class Posterior:
    """The posterior of x, normal: log evidence, ratio of the discrepancy, mean, covariance.

    The mean and the covariance have the columns that are ``used`` only; others are zero.
    """

    log: float
    discrepancy_ratio: float
    mean: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class Model:
    """Recordings and the prior of x: zero mean and ``deviation``, (c,).

    ``parts``: by ratio of the discrepancy the information, its side, its square and its log
    normalisation, all recordings together.
    """

    parts: tuple[Information, ...]
    deviation: Array
    ratios: Array

    @classmethod
    def from_spectra(
        cls,
        spectra: Sequence[Spectra],
        places: Sequence[Indices],
        deviation: Array,
        ratios: Array = DISCREPANCY_RATIOS,
        gains: Array | None = None,
        order: Sequence[int] | None = None,
    ) -> Model:
        """Sum the information of all recordings, for each ratio of the discrepancy.

        :param places: indices in x of each recording's columns. ``deviation``: prior standard
            deviations of x, (c,).
        :param gains, order: gain and order of the channels, as in :meth:`Spectra.information`.
        """
        count, parts = len(deviation), []
        for ratio in ratios:
            total, side, square, log = np.zeros((count, count)), np.zeros(count), 0.0, 0.0
            for one, place in zip(spectra, places, strict=True):
                own = one.information(float(ratio), gains, order)
                total[np.ix_(place, place)] += own[0]
                side[place] += own[1]
                square, log = square + own[2], log + own[3]
            scaled = total * np.outer(deviation, deviation)
            parts.append((scaled, side * deviation, square, log))
        return cls(tuple(parts), deviation, ratios)

    def widened(self, factors: Array) -> Model:
        """Return the model with other deviations of the prior, (c,) times these."""
        parts = tuple(
            (total * np.outer(factors, factors), side * factors, square, log) for total, side, square, log in self.parts
        )
        return Model(parts, self.deviation * factors, self.ratios)

    def _solve(self, k: int, used: Mask) -> tuple[float, Array, Array]:
        """Return the log evidence at the ratio k, the Cholesky factor, and L^-1 X'V^-1 y."""
        total, side, square, log = self.parts[k]
        a = total[np.ix_(used, used)]
        a[np.diag_indices(len(a))] += 1.0 + 1e-10 * a.diagonal()
        # LAPACK's own functions: scipy's take twice as long to call as these matrices to factor.
        root, refused = scipy.linalg.lapack.dpotrf(a, lower=True, clean=True)
        if refused:
            raise np.linalg.LinAlgError("the information is not positive definite")
        half = scipy.linalg.lapack.dtrtrs(root, side[used], lower=True)[0]
        log = log - 0.5 * (square - half @ half) - float(np.log(root.diagonal()).sum())
        return log, root, half

    def logs(self, used: Mask) -> Array:
        """Return the log evidence at each ratio, with some of the columns."""
        return np.array([self._solve(k, used)[0] for k in range(len(self.parts))])

    def log_evidence(self, used: Mask, near: Array | None = None) -> float:
        """Return the log evidence with the selected columns, summed over the ratios of the discrepancy.

        :param near: log weights of the ratios; ratios of negligible weight are skipped. None: none.
        """
        keys = np.arange(len(self.parts))
        if near is not None:
            keys = keys[near > near.max() - NEGLIGIBLE_LOG_WEIGHT]
        return float(np.logaddexp.reduce([self._solve(int(k), used)[0] for k in keys]))

    def posterior_at(self, k: int, used: Mask) -> tuple[Array, Array]:
        """Return mean and covariance of the used columns at the ratio k, in prior deviations."""
        _, root, half = self._solve(k, used)
        mean = scipy.linalg.lapack.dtrtrs(root, half, lower=True, trans=1)[0]
        return mean, scipy.linalg.lapack.dpotrs(root, np.eye(len(half)), lower=True)[0]

    def posterior(self, used: Mask, ratios: Array | None = None) -> Posterior:
        """Return the posterior with some of the columns.

        :param ratios: log weights of the ratios, default the evidence's.
        """
        logs = self.logs(used)
        weights = logs if ratios is None else ratios
        weights = np.exp(weights - weights.max())
        weights = np.where(weights > np.exp(-NEGLIGIBLE_LOG_WEIGHT), weights, 0.0)
        weights /= weights.sum()
        count, d = len(self.deviation), self.deviation[used]
        means, inverses = [], []
        for k in np.flatnonzero(weights):
            at_ratio = self.posterior_at(int(k), used)
            means.append(at_ratio[0])
            inverses.append(at_ratio[1])
        each = weights[weights > 0.0]
        mean = np.tensordot(each, means, 1)
        away = (np.array(means) - mean) * np.sqrt(each)[:, None]
        full, covariance = np.zeros(count), np.zeros((count, count))
        full[used] = mean * d
        own = np.tensordot(each, inverses, 1) + away.T @ away
        covariance[np.ix_(used, used)] = own * np.outer(d, d)
        return Posterior(
            float(np.logaddexp.reduce(logs)), float(self.ratios[int(np.argmax(weights))]), full, covariance
        )

    def gains(self, used: Mask, more: Mask) -> tuple[Array, Array]:
        """Return what each column of ``more`` alone adds to the log evidence, and its size."""
        logs, found = np.zeros(len(self.parts)), np.full((len(self.parts), len(more)), -np.inf)
        sizes = np.zeros_like(found)
        for k, (total, side, _, _) in enumerate(self.parts):
            logs[k], root, half = self._solve(k, used)
            cross = scipy.linalg.solve_triangular(root, total[np.ix_(used, more)], lower=True, check_finite=False)
            seen = np.maximum(np.diag(total)[more] - np.sum(cross**2, 0), 0.0)
            left = side[more] - cross.T @ half
            sizes[k, more] = left / (1.0 + seen)
            found[k, more] = logs[k] + 0.5 * left**2 / (1.0 + seen) - 0.5 * np.log1p(seen)
        gains = np.logaddexp.reduce(found) - np.logaddexp.reduce(logs)
        return np.asarray(gains, np.float64), self.deviation * sizes[int(np.argmax(logs))]
