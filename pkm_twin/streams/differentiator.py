# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Estimate the acceleration of a joint-state stream by a causal Savitzky-Golay fit.

A polynomial of degree ``order`` is fitted to the last ``window`` velocities (or one of degree
``order + 1`` to the positions if the stream carries no velocities) at their stamps, which may be
uneven, and differentiated at the newest sample. The result is exact for a motion whose velocity is
such a polynomial, so the delay is zero for ``order`` 2 and above; ``order`` 1 gives the mean slope
of the window, which is the acceleration half a window ago.

A. Savitzky, M. J. E. Golay, Smoothing and differentiation of data by simplified least squares
procedures, Analytical Chemistry 36 (1964), doi:10.1021/ac60214a047.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.polynomial import polynomial

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.cholesky import SparseCholesky
from pkm_twin.codegen.code import Code
from pkm_twin.codegen.expressions import Tape
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.key import EMPTY
from pkm_twin.codegen.program import Program
from pkm_twin.errors import MessageError
from pkm_twin.messages.stamps import SECOND

BLOCK_SAMPLES: Final = 32
"""Samples that one call of the program sums up; the default window, 25, fits in one block."""
MIN_SAMPLES: Final = 5
"""Fewest samples of a window."""
_NO_PARAMETERS: Final = np.zeros(0)


def fit_weights(times: Array, degree: int, derivative: int, at: float) -> Array:
    """Return the weights of samples in a derivative of the polynomial fitted to them, (w,).

    :param times: rising, shape (w,); ``at``: time at which the polynomial is differentiated.
    """
    half = 0.5 * float(times[-1] - times[0])
    powers = np.vander((times - times[0]) / half - 1.0, degree + 1, increasing=True)
    slopes = polynomial.polyder(np.eye(degree + 1), derivative)
    here = polynomial.polyval((at - times[0]) / half - 1.0, slopes) / half**derivative
    return np.asarray(powers @ np.linalg.solve(powers.T @ powers, here), np.float64)


@dataclass
class Differentiator:
    """Differentiates a stream of joint states, sample by sample.

    ``order``: degree of the velocity's polynomial. ``window``: most samples that are fitted.
    ``time``: longest window, s; a slow stream has fewer samples in it, but at least
    :data:`MIN_SAMPLES`. ``middle``: evaluate the polynomial at the window's middle sample instead
    of the newest, which is less noisy and half a window late: for recordings, not for control.
    """

    order: int = 2
    window: int = 25
    middle: bool = False
    time: float = math.inf
    _carries_velocity: bool | None = None

    def __post_init__(self) -> None:
        # A ring of whole blocks plus one sample, so that the newest can be removed. Every sample is
        # stored twice, so that each window is contiguous, oldest first.
        self._most = self.window
        self._held = -(-self.window // BLOCK_SAMPLES) * BLOCK_SAMPLES
        self._places = self._held + 1
        # Time since the first sample, ns: integers as doubles are exact for a hundred days.
        self._stamps = np.zeros(2 * self._places)
        self._begin = 0
        self._values = np.zeros(0)
        self._fit: _Fit | None = None
        self._count = 0
        self._span = 0.0

    @property
    def delay(self) -> float:
        """Delay of the acceleration, samples."""
        if self.order == 1:
            return (self.window - 1) / 2
        return float(self.window - 1 - self.window // 2) if self.middle else 0.0

    def prepare(self, joints: int) -> None:
        """Compile, or load, the programs for this number of joints, with velocities and without."""
        for degree in (self.order, self.order + 1):
            _Fit(degree, self.window, joints)

    def reset(self) -> None:
        """Forget all samples."""
        self._count = 0
        self._fit_samples(self._most)

    def retract(self) -> None:
        """Remove the newest sample; possible once after a push."""
        self._count = max(0, self._count - 1)

    @property
    def degree(self) -> int:
        """Degree of the polynomial that is fitted."""
        return self.order + (not self._carries_velocity)

    @property
    def period(self) -> float:
        """Mean time between the samples of a full window, s; 0 before."""
        if self._count < self.window:
            return 0.0
        return self._span / (self.window - 1) / SECOND

    def sine_error(self, frequency: float) -> float:
        """Return the largest error of the acceleration of a sine, as a fraction of its peak.

        :param frequency: of the sine, Hz.
        """
        turns = 2.0 * np.pi * frequency * self.period
        derivative, back, weights = self._fit_weights()
        return float(abs(weights @ np.exp(1j * turns * back) / (1j * turns) ** derivative - 1.0))

    def noise_gain(self) -> float:
        """Return the ratio of the acceleration's noise to that of the samples.

        In 1/s^2 for positions, in 1/s for velocities, at the stream's period.
        """
        derivative, _, weights = self._fit_weights()
        return float(np.linalg.norm(weights)) / self.period**derivative

    def slope_gain(self) -> float:
        """Return the noise of velocities over that of the positions, times the period."""
        at = self.window // 2 if self.middle else self.window - 1
        return float(np.linalg.norm(fit_weights(np.arange(float(self.window)), self.order + 1, 1, at)))

    def _fit_weights(self) -> tuple[int, Array, Array]:
        """Return the order of derivative, the samples' times in periods, and their weights."""
        back: Array = np.arange(1.0 - self.window, 1.0)
        derivative = 1 if self._carries_velocity else 2
        return derivative, back, fit_weights(back, self.degree, derivative, 0.0)

    def _fit_samples(self, window: int) -> None:
        if window == self.window:
            return
        self.window = window
        if self._fit is not None:
            self._fit = _Fit(self.degree, window, self._fit.joints)

    def push(self, stamp: int, q: Array, qd: Array | None) -> tuple[Array, Array] | None:
        """Add a sample; return velocities and accelerations once the window is full.

        :param stamp: ns, later than that of the last sample.
        :param q: joint positions, shape (n,).
        :param qd: joint velocities, shape (n,), or None.
        :returns: velocities and accelerations at this stamp (with ``middle`` at that of the middle
            sample), shape (n,) each; None while the window fills.
        :raises MessageError: the stamps are too uneven to determine a polynomial.
        """
        carries = qd is not None
        values = q if qd is None else qd
        n = len(values)
        if self._count >= MIN_SAMPLES:
            newest = self._stamps.item((self._count - 1) % self._places)
            # A longer silence is too long to fit one polynomial.
            if stamp - self._begin - newest > max(self._span, self.time * SECOND):
                self.reset()
        if self._fit is None or carries is not self._carries_velocity or n != self._fit.joints:
            self.reset()
            self._carries_velocity = carries
            self._values = np.zeros(2 * self._places * n)
            self._fit = _Fit(self.degree, self.window, n)
        if self._count == 0:
            self._begin = stamp
        slot = self._count % self._places
        twin = slot + self._places
        self._stamps[slot] = self._stamps[twin] = stamp - self._begin
        self._values[slot * n : slot * n + n] = self._values[twin * n : twin * n + n] = values
        self._count += 1
        # The window ends at the newest sample's first copy if all blocks fit before it.
        end = (slot if slot + 1 >= self._held else twin) + 1
        # Fit fewer samples if the window spans too long a time.
        held = min(self._count, self.window)
        self._span = self._stamps.item(end - 1) - self._stamps.item(end - held)
        least, time = max(MIN_SAMPLES, self.degree + 2), self.time * SECOND
        # A full window may be twice too long for a moment, because samples were lost.
        filling = self._count <= self.window == self._most
        if held > least and self._span > (1.1 if filling else 2.0) * time:
            self._fit_samples(max(1 + round(time * (held - 1) / self._span), least))
        if self._count < self.window:
            return None
        at = end - 1 - (self.window - 1 - self.window // 2 if self.middle else 0)
        first, second = self._fit.derivatives(self._stamps, self._values, end, at)
        if qd is None:
            return first, second
        return (self._values[at * n : at * n + n].copy() if self.middle else qd), first


class _Fit:
    """The least-squares polynomial of one degree for the samples of one window.

    Time is scaled to t from -1 (oldest sample) to 1 (newest), so that the normal equations
    V V' c = V y are well conditioned up to degree 5.
    """

    def __init__(self, degree: int, window: int, joints: int) -> None:
        self.joints, self._window = joints, window
        self._call = _make_fit_kernel(degree, joints, solved=True).bound(_NO_PARAMETERS)
        self._sums = _make_fit_kernel(degree, joints, solved=False)
        size = degree + 1
        self._nothing = np.zeros(2 * degree + 1 + size * joints)
        self._blocks = -(-window // BLOCK_SAMPLES)
        if self._blocks > 1:
            self._sums.warm_up()
        self._all = np.ones(BLOCK_SAMPLES)
        # The oldest block contains samples from before the window, which have weight 0.
        self._oldest = np.zeros(BLOCK_SAMPLES)
        self._oldest[self._blocks * BLOCK_SAMPLES - window :] = 1.0

    def derivatives(self, stamps: Array, values: Array, end: int, at: int) -> tuple[Array, Array]:
        """Return first and second time derivative at sample ``at``, shape (n,) each.

        :param stamps: ns, and ``values``, n per sample; the window ends before index ``end``.
        :raises MessageError: the stamps are too uneven.
        """
        n = self.joints
        oldest, newest = stamps.item(end - self._window), stamps.item(end - 1)
        half = 0.5 * (newest - oldest)
        place = np.array((oldest + half, half, stamps.item(at)))
        sums, weights = self._nothing, self._oldest
        for block in range(self._blocks - 1, 0, -1):
            last = end - block * BLOCK_SAMPLES
            part = slice(last - BLOCK_SAMPLES, last), slice((last - BLOCK_SAMPLES) * n, last * n)
            (sums,), _ = self._sums(_NO_PARAMETERS, sums, stamps[part[0]], values[part[1]], weights, place)
            weights = self._all
        first = end - BLOCK_SAMPLES
        inputs = sums, stamps[first:end], values[first * n : end * n], weights, place
        result: Array = self._call(*inputs)
        # The pivots are 1e-4 or more for evenly spaced stamps.
        if not min(result[2 * n :].tolist()) > 1e-8:
            raise MessageError("uneven stamps", "the stamps of the window are too uneven to differentiate")
        return result[:n], result[n : 2 * n]


@cache
def _make_fit_kernel(degree: int, joints: int, *, solved: bool) -> Kernel:
    """Return the program that adds a block of samples to the sums of the normal equations.

    Inputs: the sums before, of t^k and of t^k y; stamps, values and weights (0 or 1) of the block;
    middle and half length of the window, and the stamp to evaluate at, ns. Output: the new sums;
    with ``solved`` first and second derivative by seconds at that stamp, and the pivots of V V'.
    """
    key = EMPTY.extend(f"polynomial fit {degree} {joints} {solved}", _write_fit_program)
    return Kernel(Code(lambda: _write_fit_program(degree, joints, solved), key))


def _write_fit_program(degree: int, joints: int, solved: bool) -> Program:
    tape, size = Tape(), degree + 1
    sizes = {
        "before": 2 * degree + 1 + size * joints,
        "stamps": BLOCK_SAMPLES,
        "values": BLOCK_SAMPLES * joints,
        "weights": BLOCK_SAMPLES,
        "place": 3,
    }
    before, stamps, values, weights, (middle, half, look) = (tape.inputs(name, count) for name, count in sizes.items())
    inverse = 1.0 / half
    powers = list(before[: 2 * degree + 1])
    mixed = before[2 * degree + 1 :].reshape(size, joints)
    for k in range(BLOCK_SAMPLES):
        t, power = (stamps[k] - middle) * inverse, weights[k]
        for i in range(2 * degree + 1):
            powers[i] = powers[i] + power
            if i < size:
                mixed[i] = mixed[i] + power * values[k * joints : (k + 1) * joints]
            power = power * t
    results = [*powers, *mixed.ravel()]
    if solved:
        t = (look - middle) * inverse
        # The normal equations give first and second derivative at t, by seconds.
        rate = float(SECOND) * inverse
        matrix = {(i, j): powers[i + j] for i in range(size) for j in range(i + 1)}
        factors = SparseCholesky(matrix, [1.0] * size)
        here: list[Any] = [1.0]
        for _ in range(size):
            here.append(here[-1] * t)
        results = []
        for slopes, scale in (([0, *range(1, size)], rate), ([k * (k - 1) for k in range(size)], rate * rate)):
            first = 1 if scale is rate else 2
            # The derivative is w' V y with V V' w = d.
            d = [float(s) * here[k - first] if s else 0.0 for k, s in enumerate(slopes)]
            w = np.array(factors.solve(d), dtype=object)
            results += [scale * (w @ mixed[:, j]) for j in range(joints)]
        results += factors.pivots
    return Program(sizes, 0, {"result": [tape.lift(value) for value in results]})
