# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A recording for identification: rates without delay, regressor and efforts filtered alike.

Rates and accelerations are a Savitzky-Golay fit read off in the middle of its window: no phase
is lost. The window is the one whose acceleration has the least expected error: what the positions'
noise makes of it, and what a polynomial of two degrees more says beside. Then the columns of the
regressor and the efforts go through one zero-phase low-pass filter (Butterworth, forwards and
backwards): both sides of tau = Y pi stay equal, what the noise has beyond the motion goes
(Gautier, Khalil, Exciting trajectories ..., 1992; Janot et al., doi:10.1109/TCST.2013.2253321).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.recordings import Recording
from pkm_twin.streams.noise import SIGMAS, estimate_noise

DEGREE: Final = 4
"""Degree of the local polynomial of the differentiation."""
WINDOWS: Final = (7, 9, 11, 15, 19, 25, 33, 43, 57, 75, 99, 131)
"""Candidate windows of the differentiation, samples."""
CUTOFF_RATIO: Final = 10.0
"""Ratio of the low-pass filter's cut-off to the motion's mean frequency."""
MIN_SAMPLES: Final = 200
"""Smallest number of samples of a recording."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Joints' positions, rates and accelerations, (k, n) each, and what is on the platform.

    ``wrench``: (k, 6). ``payload_fraction``: how much of the payload that is fitted is carried, (k,),
    0 to 1.
    """

    q: Array
    qd: Array
    qdd: Array
    wrench: Array
    payload_fraction: Array

    @property
    def joints(self) -> tuple[Array, Array, Array]:
        """Positions, rates and accelerations."""
        return self.q, self.qd, self.qdd

    def part(self, rows: slice | Mask) -> Motion:
        """Return some of the rows."""
        return Motion(*(one[rows] for one in (*self.joints, self.wrench, self.payload_fraction)))


@dataclass(frozen=True, eq=False)
class Track(Motion):
    """Evenly sampled motion of one piece of a recording: ``time`` (k,), s; effort (k, n).

    ``missed``: by rates and accelerations, as a polynomial of two degrees more says, (k, n, 2).
    """

    time: Array
    effort: Array
    period: float
    missed: Array

    def moves(self, how: Filtering) -> Mask:
        """Return the mask of samples whose joint rates exceed those of noise, (k, n)."""
        weights = scipy.signal.savgol_coeffs(how.window, DEGREE, 1, self.period)
        slow = SIGMAS * np.array(how.position_noise) * np.linalg.norm(weights)
        mean = (self.qd[:-2] + self.qd[1:-1] + self.qd[2:]) / 3.0
        rough = SIGMAS * np.abs(self.qd[1:-1] - mean).sum(0) / len(self.qd)
        return np.asarray(np.abs(self.qd) > np.maximum(np.maximum(rough, slow), 1e-9))

    def find_certain_rates(self, how: Filtering) -> Array:
        """Return the rates, zero where they may be noise alone, (k, n)."""
        return np.where(self.moves(how), self.qd, 0.0)


@dataclass(frozen=True)
class Filtering:
    """Processing of the signals: window, samples; cut-off, Hz (None: unfiltered); decimation."""

    window: int
    position_noise: tuple[float, ...]
    cutoff: float | None
    keep_every: int


def choose_window(pieces: list[Array], period: float, noise: Array) -> int:
    """Choose the window whose accelerations have the least expected error, over all joints."""
    best, least = WINDOWS[0], np.inf
    for window in WINDOWS:
        if window > min(len(q) for q in pieces) // 4:
            break
        change = scipy.signal.savgol_coeffs(window, DEGREE, 2, period)
        error, size = np.zeros(noise.shape), np.zeros(noise.shape)
        for q in pieces:
            rough = local_fit(q, window, DEGREE, 2, period)
            size += np.mean(rough**2, 0)
            if window > DEGREE + 3:
                fine = local_fit(q, window, DEGREE + 2, 2, period)
                inner = slice(window, -window)
                extra = scipy.signal.savgol_coeffs(window, DEGREE + 2, 2, period) - change
                made = noise**2 * (extra @ extra)
                error += np.maximum(np.mean((fine - rough)[inner] ** 2, 0) - made, 0.0)
        error += len(pieces) * noise**2 * (change @ change)
        total = float(np.sum(error / np.maximum(size, 1e-300)))
        if total < least:
            best, least = window, total
    return best


def local_fit(values: Array, window: int, degree: int, order: int, period: float) -> Array:
    """Differentiate along the first axis by a polynomial through the samples around each.

    The first and the last polynomial are differentiated at the ends, too.
    """
    fitted = scipy.signal.savgol_filter(values, window, degree, order, period, axis=0)
    return np.asarray(fitted, np.float64)


def fit_spline(values: Array, period: float, cutoff: float | None) -> list[Array]:
    """Fit signals (samples, n) below a frequency, Hz; return also the first and second derivative.

    A least-squares spline with two knots a period: unlike a filter it assumes nothing about the
    signal beyond its ends, so that derivatives hold there too. None: the signals as they are.
    """
    if cutoff is None:
        return [values, *(differentiate(values, order, period) for order in (1, 2))]
    last, degree = (len(values) - 1) * period, 5
    places = np.linspace(0.0, last, 1 + max(1, round(2.0 * cutoff * last)))
    knots = np.concatenate([np.zeros(degree), places, np.full(degree, last)])
    time = np.linspace(0.0, last, len(values))
    spline = scipy.interpolate.make_lsq_spline(time, values, knots, degree)
    return [np.asarray(spline(time, order), np.float64) for order in range(3)]


def differentiate(values: Array, order: int, period: float) -> Array:
    """Differentiate along the first axis: central differences of sixth order, polynomials at the ends."""
    inner, ends = (local_fit(values, points, degree, order, period) for points, degree in ((7, 6), (9, 4)))
    return np.concatenate([ends[:3], inner[3:-3], ends[-3:]])


def resample_recording(
    time: Array,
    q: Array,
    effort: Array,
    wrench: Array | None = None,
    payload_fraction: Array | None = None,
    window: int | None = None,
    rates: tuple[Array, Array] | None = None,
    min_samples: int = MIN_SAMPLES // 2,
) -> tuple[list[Track], Filtering]:
    """Resample a recording evenly, differentiate it, and return its pieces without their ends.

    :param wrench: (k, 6), none by default; ``payload_fraction``: fraction of the payload that is carried,
        (k,), 1 by default.
    :param window: of the polynomial, samples; None chooses it.
    :param rates: velocities and accelerations (k, n) that are known, to be used as they are.
    :param min_samples: smallest number of samples of a piece that is used.
    """
    wrench = np.zeros((len(time), 6)) if wrench is None else wrench
    payload_fraction = np.ones(len(time)) if payload_fraction is None else payload_fraction
    if len(time) < 2:
        return [], Filtering(0, (), None, 1)
    # Pieces without a gap, resampled evenly by cubic splines where needed.
    period, pieces = float(np.median(np.diff(time))), list[tuple[Array, list[Array]]]()
    edges = [0, *(np.flatnonzero(np.diff(time) > 5.0 * period) + 1).tolist(), len(time)]
    for begin, end in pairwise(edges):
        if end - begin >= min_samples:
            t, own = time[begin:end], [c[begin:end] for c in (q, effort, wrench, payload_fraction, *(rates or ()))]
            if np.abs(np.diff(t) - period).max() > 0.02 * period:
                even = np.arange(t[0], t[-1], period)
                own = [np.asarray(scipy.interpolate.CubicSpline(t, c)(even), np.float64) for c in own]
                t = even
            pieces.append((t, own))
    if not pieces:
        return [], Filtering(0, (), None, 1)
    positions = [own[0] for _, own in pieces]
    # The noise of each piece counts by its number of samples.
    noise = np.average([estimate_noise(t, own[0]) for t, own in pieces], 0, [len(t) for t, _ in pieces])
    width = window or choose_window(positions, period, noise)
    result = []
    for t, (place, force, load, carried, *known) in pieces:
        rough, fine = (
            known or [local_fit(place, width, degree, k, period) for k in (1, 2)] for degree in (DEGREE, DEGREE + 2)
        )
        cut = slice(width // 2, len(t) - width // 2)
        smooth = place if known else local_fit(place, width, DEGREE, 0, period)
        motion = Motion(smooth, rough[0], rough[1], load, carried).part(cut)
        missed = np.stack(rough, -1)[cut] - np.stack(fine, -1)[cut]
        result.append(Track(**vars(motion), time=t[cut], effort=force[cut], period=period, missed=missed))
    speed = np.sqrt(np.mean(np.concatenate([p.qd for p in result]) ** 2, 0))
    change = np.sqrt(np.mean(np.concatenate([p.qdd for p in result]) ** 2, 0))
    moving = speed > 0.0
    mean = float(np.max(change[moving] / speed[moving], initial=0.0)) / (2 * np.pi)
    cutoff = CUTOFF_RATIO * mean
    # Without a motion, or faster than the samples, nothing is filtered.
    filtered = 0.0 < cutoff < 0.2 / period
    keep = max(1, int(0.2 / (cutoff * period))) if filtered else 1
    return result, Filtering(width, tuple(noise.tolist()), cutoff if filtered else None, keep)


def kept_rows(count: int, period: float, how: Filtering) -> slice:
    """Return the slice of samples that :func:`low_pass` keeps."""
    # The filter's end effects decay within a period of its cut-off.
    edge = 0 if how.cutoff is None else min(int(1.0 / (how.cutoff * period)), count // 4)
    return slice(edge, count - edge, how.keep_every)


def low_pass(values: Array, period: float, how: Filtering) -> Array:
    """Filter signals along the first axis without phase, decimate them and cut the ends."""
    if how.cutoff is None:
        return values
    sections = scipy.signal.butter(4, 2.0 * how.cutoff * period, output="sos")
    smooth = scipy.signal.sosfiltfilt(sections, values, axis=0)
    return np.asarray(smooth[kept_rows(len(values), period, how)], np.float64)


def filtered(pieces: Sequence[Mapping[str, Array]], period: float, how: Filtering) -> dict[str, Array]:
    """Filter signals of pieces by name, (samples, ...) each, alike; join the pieces one after the other."""
    shapes = {name: values.shape[1:] for name, values in pieces[0].items()}
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes.values()])[:-1]
    smooth = [low_pass(np.concatenate([v.reshape(len(v), -1) for v in one.values()], 1), period, how) for one in pieces]
    parts = np.split(np.concatenate(smooth), ends, 1)
    named = zip(shapes.items(), parts, strict=True)
    return {name: part.reshape(len(part), *shape) for (name, shape), part in named}


def evaluate_blocks(rows: int, block: int, evaluate: Callable[[slice], Array]) -> Array:
    """Evaluate rows in blocks, to bound the memory."""
    starts = range(0, rows, block)
    return np.concatenate([evaluate(slice(a, min(a + block, rows))) for a in starts])


MIN_RELATIVE_NOISE: Final = 1e-3
"""Smallest noise with which a recording is judged, as a fraction of the measured RMS."""
MIN_OUTLIER_DISTANCE: Final = 6.0
"""Smallest residual of an outlier, standard deviations of the noise."""
MAX_SOUND_DISTANCE: Final = 3.0
"""Distance up to which poses count for the noise: of 100,000 good ones one is farther off."""
MIN_NOISE: Final = 1e-9
"""Smallest noise of an instrument, m or rad."""
NOISE_BAND_START: Final = 0.25
"""Fraction of the sampling rate above which unfiltered signals are taken as noise alone."""
NOISE_BAND_END: Final = 0.48
"""Fraction of the sampling rate up to which the noise is evaluated."""
PEAK_NEIGHBOURS: Final = 12
"""Number of frequencies on each side with which a peak is compared."""
MIN_PEAK_RATIO: Final = 4.0
"""Smallest ratio of a peak's spectral density to that of its neighbours."""
MAX_LOG_CHANCE: Final = -16.0
"""Largest log probability of a peak by chance at which it is reported."""


def huber(away: Array, bound: float = 1.5) -> Array:
    """Return Huber weights of residuals from their sizes over the noise, of any shape."""
    return np.asarray(bound / np.maximum(away, bound), np.float64)


def find_passed_band(how: Filtering, rate: float) -> float:
    """Return the part of white noise at a sampling rate that the filter passes."""
    # The width for white noise of a Butterworth filter of fourth order, forwards and backwards.
    return 1.0 if how.cutoff is None else min(1.0, 2.0 * 0.898 * how.cutoff / rate)


def select_motion(values: Sequence[Array], moves: Sequence[Array | Mask]) -> list[Array]:
    """Return noise (samples, n) of pieces where the direction of friction is known, else zero.

    It is scaled so that its power is that of a joint that moves all the time.

    :param moves: where it is known, of the same shapes.
    """
    known = np.asarray(np.concatenate(moves), np.float64)
    share = np.sqrt(np.maximum(np.mean(known, 0), 1e-300))
    return [one * some / share for one, some in zip(values, moves, strict=True)]


@dataclass(frozen=True)
class Line:
    """A line in the spectrum of a joint's residual: frequency, its resolution, Hz; RMS of the effort.

    ``sigmas``: how clearly it stands above its surroundings.
    """

    joint: int
    frequency: float
    resolution: float
    rms: float
    sigmas: float


def estimate_noise_density(residual: Sequence[Array], shaken: Array, period: float, how: Filtering) -> Array:
    """Estimate the density of the efforts' noise in the motion's band, N m or N per root hertz, (n,).

    Above the band nothing but noise is left: the loudest octave there counts. The positions' noise
    comes through the differentiation with another spectrum; what it does is taken off above the
    band, and added in the band.

    :param residual: measured less fitted, every sample, (samples, n) by piece.
    :param shaken: what the positions' noise changes in the fitted efforts, (samples, n).
    """
    rate = 1.0 / period
    begin = NOISE_BAND_START * rate if how.cutoff is None else how.cutoff
    loudest = np.zeros(shaken.shape[1])
    # Half of the samples are in pieces of a segment or more, so that all pieces have one grid.
    lengths = np.sort([len(piece) for piece in residual])
    half = int(np.searchsorted(np.cumsum(lengths), 0.5 * lengths.sum()))
    segment = min(256, int(lengths[half]), len(shaken))
    frequency, density = _spectrum(residual, rate, segment)
    _, passed = _spectrum([shaken], rate, segment)
    while begin < 0.9 * NOISE_BAND_END * rate:
        inside = (frequency >= begin) & (frequency < min(2.0 * begin, NOISE_BAND_END * rate))
        if np.count_nonzero(inside) > 2:
            both = (np.mean(one[inside], 0) for one in (density, passed))
            above, own = both
            loudest = np.maximum(loudest, above - own)
        begin *= 2.0
    inside = frequency <= (NOISE_BAND_END * rate if how.cutoff is None else how.cutoff)
    return np.asarray(np.sqrt(loudest + np.mean(passed[inside], 0)), np.float64)


def find_lines(
    residual: Sequence[Array], period: float, how: Filtering, size: Array, wrench: Array | None = None
) -> tuple[Line, ...]:
    """Find the strongest line above the motion's band in each joint's residual, if there is one.

    Lines of the measured wrench are those of a force on the platform, such as a cutter's.

    :param residual: measured less fitted, every sample, (samples, n) by piece. ``size``: RMS of
        the measured efforts, (n,): a line below :data:`MIN_RELATIVE_NOISE` of it is rounding. ``wrench``: of the
        longest piece, (samples, 6), where it is measured.
    """
    whole, rate = max(residual, key=len), 1.0 / period
    segment = min(1024, len(whole) // 4)
    if segment < 64:
        return ()
    frequency, density = _spectrum([whole], rate, segment)
    # Segments overlap by half, with a Hann window: so many independent ones.
    freedoms = 2.0 * 0.95 * max(1.0, 2.0 * len(whole) / segment - 1.0)
    begin = NOISE_BAND_START * rate if how.cutoff is None else 1.2 * how.cutoff
    inside = np.flatnonzero((frequency > begin) & (frequency < NOISE_BAND_END * rate))
    if len(inside) < 2 * PEAK_NEIGHBOURS:
        return ()
    forces = np.zeros((len(frequency), 0)) if wrench is None else _spectrum([wrench], rate, segment)[1]
    own = np.concatenate([density, forces], 1)[inside]
    ground = scipy.ndimage.median_filter(own, (2 * PEAK_NEIGHBOURS + 1, 1), mode="nearest")
    ratio = own / np.maximum(ground, 1e-300)
    # A chi square whose mean is a tenth above its median; the best of so many frequencies.
    chance = scipy.stats.chi2.logsf(0.9 * ratio * freedoms, freedoms) + np.log(len(inside))
    clear = (chance < MAX_LOG_CHANCE) & (ratio > MIN_PEAK_RATIO)
    # The residual's line may be at the frequency of the spectrum next to the wrench's.
    clear &= ~scipy.ndimage.binary_dilation(clear[:, len(size) :].any(1))[:, None]
    found, step = list[Line](), float(frequency[1] - frequency[0])
    for j in np.flatnonzero(clear[:, : len(size)].any(0)).tolist():
        peak = int(np.where(clear[:, j], own[:, j], 0.0).argmax())
        near = slice(max(peak - PEAK_NEIGHBOURS // 2, 0), peak + PEAK_NEIGHBOURS // 2 + 1)
        rms = float(np.sqrt(2.0 * step * np.sum(np.maximum(own - ground, 0.0)[near, j])))
        sigmas = float(scipy.stats.norm.isf(np.exp(max(chance[peak, j], -700.0))))
        if rms > MIN_RELATIVE_NOISE * size[j]:
            found.append(Line(j, float(frequency[inside[peak]]), step, rms, sigmas))
    return tuple(found)


def _spectrum(pieces: Sequence[Array], rate: float, segment: int) -> tuple[Array, Array]:
    """Estimate two-sided spectral densities by channel (Welch), (frequencies, n); return also frequencies.

    Of the pieces that are as long as a segment, each by its length.
    """
    used = [piece for piece in pieces if len(piece) >= segment]
    both = [scipy.signal.welch(piece, rate, nperseg=segment, axis=0, detrend="linear") for piece in used]
    density = np.average([own for _, own in both], 0, [len(piece) for piece in used])
    return np.asarray(both[0][0], np.float64), np.asarray(0.5 * density, np.float64)


def simulate_noise(r: Recording, track: Track, how: Filtering, efforts: Callable[[Track], Array]) -> Array:
    """Return how much noise of the positions changes the efforts, (samples, n).

    :param efforts: of a motion, shape (samples, n).
    """
    noise, rng = np.array(how.position_noise), np.random.default_rng(0)
    edge = (how.window // 2 + 0.5) * track.period
    inside = (r.time > track.time[0] - edge) & (r.time < track.time[-1] + edge)
    some = np.flatnonzero(inside)[:3000]
    time, q = r.time[some], r.q[some]
    told = []
    for shake in (np.zeros_like(q), noise * rng.normal(size=q.shape)):
        pieces, _ = resample_recording(
            time, q + shake, np.zeros_like(q), window=how.window, min_samples=min(MIN_SAMPLES // 2, len(track.time))
        )
        told.append(np.concatenate([efforts(t) for t in pieces]))
    change = told[1] - told[0]
    return select_motion([change], [track.moves(how)[: len(change)]])[0]


def find_held_payload(
    time: Array, column: Array, residual: Array, weight: Array
) -> tuple[float, list[tuple[float, float]], Mask]:
    """Fit the payload that best explains a residual, and the time spans in which it is held.

    The time span that reduces the weighted squares most gives a first mass. The payload is held in
    all blocks of time whose own mass is above half of it; the first and last sample of each span
    are those at which the squares are least.

    :param time: increasing, s, shape (k,). ``column``: efforts per kilogram of payload.
        ``residual``: of the efforts. ``weight``: of its squares; (k, n) each.
    :returns: mass, kg, 0 if no mass explains any of it; time spans, s; mask of held samples, (k,).
    """
    # Held or not for a quarter of a second; at most 400 times.
    span = max(0.25, float(time[-1] - time[0]) / 400)
    block = np.floor((time - time[0]) / span).astype(np.int64)
    rows = [np.sum(weight * column * one, 1) for one in (residual, column)]
    pull, size = (np.bincount(block, one) for one in rows)
    sums = [np.concatenate([[0.0], np.cumsum(one)]) for one in (pull, size)]
    ahead, below = (one[None, :] - one[:, None] for one in sums)
    gain = np.triu(np.maximum(ahead, 0.0) ** 2 / np.where(below > 0.0, below, np.inf), 1)
    first, last = np.unravel_index(int(np.argmax(gain)), gain.shape)
    mass = float(ahead[first, last] / max(below[first, last], 1e-300))
    held = np.zeros(len(time), np.bool_)
    if not mass > 0.0:
        return 0.0, [], held
    own = pull > 0.5 * mass * size
    mass = float(pull[own].sum() / size[own].sum())
    apart = np.cumsum(mass * (rows[0] - 0.5 * mass * rows[1]))
    spans = []
    for edges in np.flatnonzero(np.diff(own, prepend=False, append=False)).reshape(-1, 2):
        ends = []
        for edge, best in zip(edges.tolist(), (np.argmin, np.argmax), strict=True):
            near = np.searchsorted(block, [edge - 1, edge + 1])
            inside = 0 < edge < len(own)
            place = near[0] + best(apart[slice(*near)]) if inside else edge * len(time)
            ends.append(min(int(place), len(time) - 1))
        spans.append((float(time[ends[0]]), float(time[ends[1]])))
        held[ends[0] : ends[1] + 1] = True
    return mass, spans, held
