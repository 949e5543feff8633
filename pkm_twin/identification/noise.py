# SPDX-License-Identifier: Apache-2.0
"""Noise and robust weights: of residuals by their median and by their spectrum.

A residual within :data:`HUBER` standard deviations counts with its square, one beyond with its size
(Huber).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for

from pkm_twin.codegen.arrays import Array
from pkm_twin.identification.samples import Filtering

EXACT: Final = 1e-3
"""Noise, as part of the measured rms, below which no recording is judged more strictly."""
HUBER: Final = 1.5
"""Standard deviations up to which a residual counts with its square."""
OUTLIER: Final = 6.0
"""Distance from which a pose is an outlier."""
CLEAR: Final = 3.0
"""Distance up to which poses count for the noise: of 100,000 good ones one is farther off."""
FINEST: Final = 1e-9
"""Noise that no instrument is below, m or rad."""
NOISE_BAND: Final = 0.898
"""Width of the low-pass filter for white noise, over its cut-off: a Butterworth filter of fourth
order, forwards and backwards."""
UNFILTERED: Final = 0.25
"""Part of the samples' rate above which there is noise alone, where nothing is filtered."""
HIGHEST: Final = 0.48
"""Part of the samples' rate up to which the noise is looked at."""
SEGMENT: Final = 256
"""Samples of a spectrum."""
RESOLVED: Final = 1024
"""And of one in which resonances are looked for."""
PASSED: Final = 1.2
"""Times the filter's cut-off, from where on they are."""
AROUND: Final = 12
"""Frequencies on each side that a peak is held against."""
PEAK: Final = 4.0
"""Density over its surroundings' from which one may be a peak."""
LIKELY: Final = -16.0
"""Logarithm of the probability by chance below which it is."""


def huber(away: Array, bound: float = HUBER) -> Array:
    """Weights of residuals by their sizes over the noise, of any shape."""
    return np.asarray(bound / np.maximum(away, bound), np.float64)


def passed_band(how: Filtering, rate: float) -> float:
    """The part of white noise, sampled so many times a second, that the filter passes."""
    return 1.0 if how.cutoff is None else min(1.0, 2.0 * NOISE_BAND * how.cutoff / rate)


def usual_size(residual: Array) -> Array:
    """Standard deviation of normal residuals (k, n) by the median of their sizes, (n,)."""
    return np.asarray(1.4826 * np.median(np.abs(residual), axis=0), np.float64)


@dataclass(frozen=True)
class Resonance:
    """A peak in the spectrum of a joint's residual: frequency, half width, Hz; rms of the effort.

    ``sigmas``: how clearly it stands above its surroundings. ``line``: no wider than the spectrum
    resolves, so it may be interference.
    """

    joint: int
    frequency: float
    width: float
    rms: float
    sigmas: float
    line: bool


def noise_of(residual: Sequence[Array], shaken: Array, period: float, how: Filtering) -> Array:
    """Density of the efforts' noise in the band of the motion, N m or N per root hertz, (n,).

    Above the band nothing but noise is left: the loudest octave there counts. The positions' noise
    comes through the differentiation with another spectrum; what it does is taken off above the
    band, and added in the band.

    :param residual: measured less fitted, every sample, (samples, n) by piece.
    :param shaken: what the positions' noise changes in the fitted efforts, (samples, n).
    """
    rate = 1.0 / period
    begin = UNFILTERED * rate if how.cutoff is None else how.cutoff
    loudest = np.zeros(shaken.shape[1])
    # Half of the samples are in pieces of a segment or more, so that all pieces have one grid.
    lengths = np.sort([len(piece) for piece in residual])
    half = int(np.searchsorted(np.cumsum(lengths), 0.5 * lengths.sum()))
    segment = min(SEGMENT, int(lengths[half]), len(shaken))
    frequency, density = _spectrum(residual, rate, segment)
    _, passed = _spectrum([shaken], rate, segment)
    while begin < 0.9 * HIGHEST * rate:
        inside = (frequency >= begin) & (frequency < min(2.0 * begin, HIGHEST * rate))
        if np.count_nonzero(inside) > 2:
            both = (np.mean(one[inside], 0) for one in (density, passed))
            above, own = both
            loudest = np.maximum(loudest, above - own)
        begin *= 2.0
    inside = frequency <= (HIGHEST * rate if how.cutoff is None else how.cutoff)
    return np.asarray(np.sqrt(loudest + np.mean(passed[inside], 0)), np.float64)


def resonances_of(
    residual: Sequence[Array], period: float, how: Filtering, size: Array
) -> tuple[Resonance, ...]:
    """The lowest clear peak above the motion's band of each joint's residual, where there is one.

    :param residual: measured less fitted, every sample, (samples, n) by piece. ``size``: RMS of
        the measured efforts, (n,): a peak below :data:`EXACT` of it is rounding.
    """
    whole, rate = max(residual, key=len), 1.0 / period
    segment = min(RESOLVED, len(whole) // 4)
    if segment < 64:
        return ()
    frequency, density = _spectrum([whole], rate, segment)
    # Segments overlap by half, with a Hann window: so many independent ones.
    freedoms = 2.0 * 0.95 * max(1.0, 2.0 * len(whole) / segment - 1.0)
    begin = UNFILTERED * rate if how.cutoff is None else PASSED * how.cutoff
    inside = np.flatnonzero((frequency > begin) & (frequency < HIGHEST * rate))
    if len(inside) < 2 * AROUND:
        return ()
    step, found = frequency[1] - frequency[0], []
    for j in range(whole.shape[1]):
        own = density[inside, j]
        ground = scipy.ndimage.median_filter(own, 2 * AROUND + 1, mode="nearest")
        ratio = own / np.maximum(ground, 1e-300)
        # The mean of a chi square over its median.
        chance = scipy.stats.chi2.logsf(0.9 * ratio * freedoms, freedoms) + np.log(len(inside))
        clear = np.flatnonzero((chance < LIKELY) & (ratio > PEAK))
        if not len(clear):
            continue
        last = clear[0]
        while last + 1 < len(own) and ratio[last + 1] > PEAK:
            last += 1
        peak = clear[0] + int(own[clear[0] : last + 1].argmax())
        near = slice(max(peak - AROUND // 2, 0), peak + AROUND // 2 + 1)
        above = np.maximum(own - ground, 0.0)[near]
        place = frequency[inside][near]
        centre = float(np.sum(place * above) / np.sum(above))
        wide = np.flatnonzero(own[near] - ground[near] > 0.5 * above.max())
        width = 0.5 * step * (wide[-1] - wide[0] + 1)
        sigmas = float(scipy.stats.norm.isf(np.exp(max(chance[peak], -700.0))))
        rms = float(np.sqrt(2.0 * step * np.sum(above)))
        if not rms > EXACT * size[j]:
            continue
        found.append(Resonance(j, centre, float(width), rms, sigmas, bool(width < 1.25 * step)))
    return tuple(found)


def _spectrum(pieces: Sequence[Array], rate: float, segment: int) -> tuple[Array, Array]:
    """Frequencies, and two-sided spectral densities by channel (Welch), (frequencies, n).

    Of the pieces that are as long as a segment, each by its length.
    """
    used = [piece for piece in pieces if len(piece) >= segment]
    both = [
        scipy.signal.welch(piece, rate, nperseg=segment, axis=0, detrend="linear") for piece in used
    ]
    density = np.average([own for _, own in both], 0, [len(piece) for piece in used])
    return np.asarray(both[0][0], np.float64), np.asarray(0.5 * density, np.float64)
