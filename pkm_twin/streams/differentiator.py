# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Acceleration of a joint-state stream: Savitzky and Golay's fit, causal, for uneven stamps.

A polynomial of degree ``order`` is fitted to the last ``window`` velocities (or one of degree
``order + 1`` to the positions where the stream carries no velocity) by their own stamps, and
its derivative is taken at the newest sample. A motion whose velocity is a polynomial of that
degree comes out exactly, so the delay is zero for ``order`` 2 and above; ``order`` 1 gives the mean
slope of the window, which is the acceleration half a window ago.

A. Savitzky, M. J. E. Golay, Smoothing and differentiation of data by simplified least squares
procedures, Analytical Chemistry 36 (1964), doi:10.1021/ac60214a047.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.code import Code
from pkm_twin.codegen.expressions import Objects, Tape
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.key import EMPTY
from pkm_twin.codegen.operations import sqrt
from pkm_twin.codegen.program import Program
from pkm_twin.errors import MessageError
from pkm_twin.messages.stamps import SECOND

LEAST_PIVOT: Final = 1e-4
"""Least diagonal entry of the normal equations' Cholesky factor; even stamps stay above 1e-2."""
BLOCK: Final = 32
"""Samples that one call of a program sums up: those of the default window, and some."""
LEAST: Final = 5
"""Samples that a window has in any case."""
JITTER: Final = 1.1
"""Length of a window over what it should be that is no slow stream."""
_NONE: Final = np.zeros(0)


@dataclass
class Differentiator:
    """``order``: degree of the velocity's polynomial; ``window``: samples fitted, at most.

    ``time``: length of the window, s, at most; a slow stream has fewer samples in it, but at least
    :data:`LEAST`. ``middle``: read the polynomial off at the window's middle sample instead of its
    newest. That is less noisy and half a window late: for recordings, not for control.
    """

    order: int = 2
    window: int = 25
    middle: bool = False
    time: float = math.inf
    _carries_velocity: bool | None = None

    def __post_init__(self) -> None:
        # One place more than whole blocks have, so that the newest sample can be taken back; every
        # sample stands twice, so that each window is one piece, oldest first.
        self._most = self.window
        self._held = -(-self.window // BLOCK) * BLOCK
        self._places = self._held + 1
        # Since the first sample, ns: whole numbers, exact for a hundred days.
        self._stamps = np.zeros(2 * self._places)
        self._begin = 0
        self._values = np.zeros(0)
        self._fit: _Fit | None = None
        self._count = 0
        self._span = 0.0

    @property
    def delay(self) -> float:
        """Delay of the acceleration in samples."""
        if self.order == 1:
            return (self.window - 1) / 2
        return float(self.window - 1 - self.window // 2) if self.middle else 0.0

    def prepare(self, joints: int) -> None:
        """Compile, or load, what samples of so many joints call, with rates and without."""
        for degree in (self.order, self.order + 1):
            _Fit(degree, self.window, joints)

    def reset(self) -> None:
        """Forget all samples."""
        self._count = 0
        self._fit_samples(self._most)

    def retract(self) -> None:
        """Take the newest sample back, as if it had not been pushed; once after a push."""
        self._count = max(0, self._count - 1)

    @property
    def degree(self) -> int:
        """Of the polynomial that is fitted."""
        return self.order + (not self._carries_velocity)

    @property
    def period(self) -> float:
        """Mean time between the samples of a full window, s; 0 before."""
        if self._count < self.window:
            return 0.0
        return self._span / (self.window - 1) / SECOND

    def sine_error(self, frequency: float) -> float:
        """Greatest error of the acceleration of a sine, part of its peak, at the stream's period.

        :param frequency: Hz.
        """
        turns = 2.0 * np.pi * frequency * self.period
        derivative, back, weights = self._weights()
        return float(abs(weights @ np.exp(1j * turns * back) / (1j * turns) ** derivative - 1.0))

    def noise_gain(self) -> float:
        """Noise of the acceleration over that of the samples at the stream's period.

        1/s^2 of positions, 1/s of velocities.
        """
        derivative, _, weights = self._weights()
        return float(np.linalg.norm(weights)) / self.period**derivative

    def _weights(self) -> tuple[int, Array, Array]:
        """Which derivative the acceleration is; places of the window's samples; their weights."""
        back: Array = np.arange(1.0 - self.window, 1.0)
        powers = np.vander(back, self.degree + 1, increasing=True)
        derivative = 1 if self._carries_velocity else 2
        return derivative, back, np.asarray(derivative * np.linalg.pinv(powers)[derivative])

    def _apart(self, stamp: int) -> bool:
        """Whether a live stream was silent for longer than its window: no polynomial spans that."""
        if self._count < LEAST:
            return False
        newest = self._stamps.item((self._count - 1) % self._places)
        return stamp - self._begin - newest > max(self._span, self.time * SECOND)

    def _keep_time(self, end: int) -> None:
        """Fit fewer samples where the window, while it fills or later, is too long in time."""
        held = min(self._count, self.window)
        self._span = self._stamps.item(end - 1) - self._stamps.item(end - held)
        least, time = max(LEAST, self.degree + 2), self.time * SECOND
        # Later it may be too long for once, of lost samples.
        filling = self._count <= self.window == self._most
        if held > least and self._span > (JITTER if filling else 2.0) * time:
            self._fit_samples(max(1 + round(time * (held - 1) / self._span), least))

    def _fit_samples(self, window: int) -> None:
        if window == self.window:
            return
        self.window = window
        if self._fit is not None:
            self._fit = _Fit(self.degree, window, self._fit.joints)

    def push(self, stamp: int, q: Array, qd: Array | None) -> tuple[Array, Array] | None:
        """Add a sample with a later stamp (ns); rates and accelerations once the window is full.

        :param q: joint positions, ``qd`` their rates or None, shape (n,).
        :returns: qd and qdd at this stamp (the middle one's, if so set), shape (n,) each, or
            None while samples are missing.
        :raises MessageError: stamps so uneven that they do not determine a polynomial.
        """
        carries = qd is not None
        values = q if qd is None else qd
        n = len(values)
        if self._apart(stamp):
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
        # The blocks end at the newest sample's second place, or at its first.
        end = (slot if slot + 1 >= self._held else twin) + 1
        self._keep_time(end)
        if self._count < self.window:
            return None
        at = end - 1 - (self.window - 1 - self.window // 2 if self.middle else 0)
        first, second = self._fit.derivatives(self._stamps, self._values, end, at)
        if qd is None:
            return first, second
        return (self._values[at * n : at * n + n].copy() if self.middle else qd), first


class _Fit:
    """A least-squares polynomial of one degree through the samples of one window.

    With t from -1 at the oldest sample to 1 at the newest, so that the normal equations
    V V' c = V y of a degree up to 5 stay far from rounding.
    """

    def __init__(self, degree: int, window: int, joints: int) -> None:
        self.joints, self._window = joints, window
        self._call = _kernel(degree, joints, solved=True).bound(_NONE)
        self._sums = _kernel(degree, joints, solved=False)
        size = degree + 1
        self._nothing = np.zeros(2 * degree + 1 + size * joints)
        self._blocks = -(-window // BLOCK)
        if self._blocks > 1:
            self._sums.warm_up()
        self._all = np.ones(BLOCK)
        # Of the oldest block, those of the window alone.
        self._oldest = np.zeros(BLOCK)
        self._oldest[self._blocks * BLOCK - window :] = 1.0

    def derivatives(self, stamps: Array, values: Array, end: int, at: int) -> tuple[Array, Array]:
        """First and second derivative by time at the sample ``at``, shape (n,) each.

        :param stamps: ns, and ``values``, n each: the window is what stands before ``end``.
        :raises MessageError: the stamps are too uneven.
        """
        n = self.joints
        oldest, newest = stamps.item(end - self._window), stamps.item(end - 1)
        half = 0.5 * (newest - oldest)
        place = np.array((oldest + half, half, stamps.item(at)))
        sums, weights = self._nothing, self._oldest
        for block in range(self._blocks - 1, 0, -1):
            last = end - block * BLOCK
            part = slice(last - BLOCK, last), slice((last - BLOCK) * n, last * n)
            (sums,), _ = self._sums(_NONE, sums, stamps[part[0]], values[part[1]], weights, place)
            weights = self._all
        first = end - BLOCK
        inputs = sums, stamps[first:end], values[first * n : end * n], weights, place
        result: Array = self._call(*inputs)
        if not min(result[2 * n :].tolist()) > LEAST_PIVOT:
            raise MessageError(
                "uneven stamps", "the stamps of the window are too uneven to differentiate"
            )
        return result[:n], result[n : 2 * n]


@cache
def _kernel(degree: int, joints: int, *, solved: bool) -> Kernel:
    """Sums over a block of samples, added to those before: of powers of t, and of them and values.

    In: the sums before; stamps, values and weights (0 or 1) of the block; the middle of the window
    and half of it, and where to look, ns. Out: the sums; or, ``solved``, the first and the second
    derivative by s there, and the pivots of V V'.
    """
    key = EMPTY.also(f"polynomial fit {degree} {joints} {solved}", _program)
    return Kernel(Code(lambda: _program(degree, joints, solved), key))


def _program(degree: int, joints: int, solved: bool) -> Program:
    tape, size = Tape(), degree + 1
    sizes = {
        "before": 2 * degree + 1 + size * joints, "stamps": BLOCK, "values": BLOCK * joints,
        "weights": BLOCK, "place": 3,
    }  # fmt: skip
    before, stamps, values, weights, (middle, half, look) = (
        tape.inputs(name, count) for name, count in sizes.items()
    )
    inverse = 1.0 / half
    powers = list(before[: 2 * degree + 1])
    mixed = before[2 * degree + 1 :].reshape(size, joints)
    for k in range(BLOCK):
        t, power = (stamps[k] - middle) * inverse, weights[k]
        for i in range(2 * degree + 1):
            powers[i] = powers[i] + power
            if i < size:
                mixed[i] = mixed[i] + power * values[k * joints : (k + 1) * joints]
            power = power * t
    results = [*powers, *mixed.ravel()]
    if solved:
        t = (look - middle) * inverse
        results = _solution(powers, mixed, t, float(SECOND) * inverse)
    return Program(sizes, 0, {"result": [tape.lift(value) for value in results]})


def _solution(powers: list[Any], mixed: Objects, t: Any, rate: Any) -> list[Any]:
    """First and second derivative at t, n each, ``rate`` the change of t in a second; the pivots.

    :param powers: sums of t^k; ``mixed``: of t^k y, shape (degree + 1, n).
    """
    size, joints = mixed.shape
    factor = np.zeros((size, size), dtype=object)
    for j in range(size):
        for i in range(j, size):
            rest = powers[i + j] - factor[i, :j] @ factor[j, :j]
            factor[i, j] = sqrt(rest) if i == j else rest / factor[j, j]
    here: list[Any] = [1.0]
    for _ in range(size):
        here.append(here[-1] * t)
    results: list[Any] = []
    for slopes, scale in (
        ([0, *range(1, size)], rate),
        ([k * (k - 1) for k in range(size)], rate * rate),
    ):
        first = 1 if scale is rate else 2
        # V V' w = d, by both triangles; then w' V y.
        w = np.zeros(size, dtype=object)
        for k in range(size):
            d = float(slopes[k]) * here[k - first] if slopes[k] else 0.0
            w[k] = (d - factor[k, :k] @ w[:k]) / factor[k, k]
        for k in reversed(range(size)):
            w[k] = (w[k] - factor[k + 1 :, k] @ w[k + 1 :]) / factor[k, k]
        results += [scale * (w @ mixed[:, j]) for j in range(joints)]
    return [*results, *(factor[k, k] for k in range(size))]
