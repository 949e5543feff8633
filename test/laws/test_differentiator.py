# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The causal differentiator: exact on polynomials, on any stamps, and never guessing."""

import numpy as np
import pytest
import scipy

from pkm_twin.errors import MessageError
from pkm_twin.streams.differentiator import Differentiator

SECOND = 10**9
STEP = SECOND // 1000


def stamps_of(rng, count, jitter):
    """Rising stamps (ns) of a 1 kHz stream, unevenly spaced by up to ``jitter`` of a step."""
    begin = 1_700_000_000 * SECOND
    shift = rng.uniform(-jitter / 2, jitter / 2, count) * STEP
    return [begin + i * STEP + round(s) for i, s in enumerate(shift)]


def polynomial(rng, degree):
    """Positions as a polynomial of time, its rate and its acceleration, each (3,) of s."""
    c = rng.normal(size=(degree + 1, 3))
    k = np.arange(degree + 1)

    def at(t):
        q = (t**k) @ c
        qd = (k[1:] * t ** (k[1:] - 1)) @ c[1:]
        qdd = (k[2:] * (k[2:] - 1) * t ** (k[2:] - 2)) @ c[2:]
        return q, qd, qdd

    return at


@pytest.mark.parametrize("order", [1, 2, 3, 4])
@pytest.mark.parametrize("window", [6, 25, 101])
@pytest.mark.parametrize("jitter", [0.0, 0.8])
def test_a_velocity_polynomial_of_the_order_is_differentiated_exactly(rng, order, window, jitter):
    stamps = stamps_of(rng, window + 7, jitter)
    motion = polynomial(rng, order + 1)
    differentiator = Differentiator(order, window)
    for i, stamp in enumerate(stamps):
        q, qd, qdd = motion((stamp - stamps[0]) / SECOND)
        result = differentiator.push(stamp, q, qd)
        assert (result is None) == (i < window - 1)
        if result is not None:
            assert (result[0] == qd).all()
            # The end of a short window sees rounding over its length.
            assert np.abs(result[1] - qdd).max() < 1e-11 * SECOND / STEP
            assert differentiator.delay == (0.0 if order > 1 else (window - 1) / 2)


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("jitter", [0.0, 0.8])
def test_positions_alone_give_rates_and_accelerations(rng, order, jitter):
    window = 25
    stamps = stamps_of(rng, window + 3, jitter)
    motion = polynomial(rng, order + 1)
    differentiator = Differentiator(order, window)
    for stamp in stamps:
        q, qd, qdd = motion((stamp - stamps[0]) / SECOND)
        result = differentiator.push(stamp, q, None)
    assert np.abs(result[0] - qd).max() < 1e-10
    assert np.abs(result[1] - qdd).max() < 1e-7


def test_order_one_gives_the_acceleration_half_a_window_ago(rng):
    window = 21
    differentiator = Differentiator(1, window)
    stamps = stamps_of(rng, 60, 0.0)
    for stamp in stamps:
        t = (stamp - stamps[0]) / SECOND
        result = differentiator.push(stamp, np.zeros(3), np.full(3, 3 * t**2))
    middle = (stamps[-1] - stamps[0]) / SECOND - differentiator.delay * STEP / SECOND
    assert np.allclose(result[1], 6 * middle, rtol=1e-9)


def test_a_reset_or_another_kind_of_stream_fills_the_window_anew():
    differentiator = Differentiator(2, 5)
    stamps = iter(range(STEP, 1000 * STEP, STEP))

    def push(count, rates):
        zero = np.zeros(3)
        return [differentiator.push(next(stamps), zero, zero if rates else None) is not None for _ in range(count)]

    filling = [False] * 4 + [True] * 2
    assert push(6, True) == filling
    differentiator.reset()
    assert push(6, True) == filling
    assert push(6, False) == filling
    assert push(6, True) == filling


@pytest.mark.parametrize("cluster", [1, 10, 1000])
def test_stamps_that_tell_no_polynomial_are_rejected(cluster):
    # All samples but one within a few nanoseconds, then a gap: any curvature fits these.
    differentiator = Differentiator(3, 25)
    for i in range(24):
        assert differentiator.push(SECOND + i * cluster, np.zeros(3), np.ones(3)) is None
    with pytest.raises(MessageError) as caught:
        differentiator.push(SECOND + 3600 * SECOND, np.zeros(3), np.ones(3))
    assert caught.value.reason == "uneven stamps"


@pytest.mark.parametrize("carries", [True, False])
def test_what_came_before_the_window_leaves_no_bit(rng, carries):
    window = 7
    stamps = stamps_of(rng, 4 * window, 0.8)
    rows = rng.normal(size=(len(stamps), 2, 3))

    def answers(first):
        differentiator = Differentiator(2, window)
        found = [
            differentiator.push(stamp, q, qd if carries else None)
            for stamp, (q, qd) in zip(stamps[first:], rows[first:], strict=True)
        ]
        return np.array(found[2 * window - first :])

    expected = answers(0)
    for first in range(1, window + 1):
        assert answers(first).tobytes() == expected.tobytes()


@pytest.mark.parametrize("window", [6, 7, 12, 25])
@pytest.mark.parametrize("order", [2, 3])
def test_the_middle_is_as_late_as_the_delay_says(rng, order, window):
    stamps = stamps_of(rng, window, 0.0)
    motion = polynomial(rng, order + 1)
    differentiator = Differentiator(order, window, middle=True)
    for stamp in stamps:
        q, qd, _ = motion((stamp - stamps[0]) / SECOND)
        result = differentiator.push(stamp, q, qd)
    _, qd, qdd = motion((stamps[-1] - stamps[0]) / SECOND - differentiator.delay * STEP / SECOND)
    assert np.allclose(result[0], qd, rtol=1e-9)
    assert np.abs(result[1] - qdd).max() < 1e-11 * SECOND / STEP


@pytest.mark.parametrize("carries", [True, False])
def test_a_sample_that_is_taken_back_was_never_there(rng, carries):
    window = 5
    stamps = stamps_of(rng, 40, 0.8)
    rows = rng.normal(size=(40, 3))

    def push(differentiator, stamp, row):
        return differentiator.push(stamp, row, row if carries else None)

    plain, spoiled = Differentiator(2, window), Differentiator(2, window)
    for i, (stamp, row) in enumerate(zip(stamps, rows, strict=True)):
        if i % 3:
            push(spoiled, stamp - 1000, 1e6 * row)
            spoiled.retract()
        expected, found = push(plain, stamp, row), push(spoiled, stamp, row)
        assert (expected is None) == (found is None)
        if found is not None:
            assert np.array(found).tobytes() == np.array(expected).tobytes()


@pytest.mark.parametrize("rate", [1500.0, 1000.0, 800.0, 430.0, 200.0, 100.0, 40.0])
@pytest.mark.parametrize("carries", [True, False])
def test_a_window_of_a_time_has_the_error_for_a_sine_that_it_says(rate, carries):
    """Whatever the rate, and after a slower or faster stream before."""
    time = 0.024
    differentiator = Differentiator(2, 25, time=time)
    errors, turn = [], 2.0 * np.pi
    for before in (120.0, 900.0):
        for i in range(60):
            differentiator.push(round(i * SECOND / before), np.zeros(3), np.zeros(3))
        differentiator.reset()
    for i in range(round(2 * rate) + 25):
        t = i / rate
        q, qd, qdd = np.sin(turn * t) * np.array([1.0, 1.0, -(turn**2)])
        qd = turn * np.cos(turn * t)
        result = differentiator.push(round(t * SECOND), np.full(2, q), np.full(2, qd) if carries else None)
        if result is not None:
            errors.append(abs(result[1][0] - qdd) / turn**2)
    span = (differentiator.window - 1) / rate
    assert differentiator.window == 5 or 0.8 * time < span < 1.11 * time or rate > 1000.0
    assert differentiator.window <= 25
    assert differentiator.period == pytest.approx(1.0 / rate)
    assert max(errors) == pytest.approx(differentiator.sine_error(1.0), rel=0.02, abs=1e-6)
    assert max(errors) < 0.005 or rate < 150.0


def test_lost_samples_and_jitter_leave_the_window_as_long(rng):
    stamps = np.array(stamps_of(rng, 400, 0.8))[rng.uniform(size=400) > 0.05].tolist()
    differentiator = Differentiator(2, 25, time=0.024)
    for k, stamp in enumerate(stamps):
        assert (differentiator.push(stamp, np.zeros(3), np.zeros(3)) is None) == (k < differentiator.window - 1)
    assert 22 <= differentiator.window <= 25


def test_a_stream_that_slows_down_gets_a_shorter_window(rng):
    differentiator = Differentiator(2, 25, time=0.024)
    stamp = 0
    for i in range(200):
        stamp += STEP if i < 100 else 5 * STEP
        assert (differentiator.push(stamp, np.zeros(3), np.zeros(3)) is None) == (i < 24)
    assert differentiator.window <= 10


@pytest.mark.parametrize(("rate", "window"), [(1000, 25), (100, 5)])
@pytest.mark.parametrize("longer", [False, True])
def test_a_silence_longer_than_the_window_fills_it_anew(rate, window, longer):
    differentiator = Differentiator(2, 25, time=0.024)

    def fill(first):
        stamps = [round((first + i) * SECOND / rate) for i in range(40)]
        return [differentiator.push(at, np.zeros(3), np.zeros(3)) is None for at in stamps]

    filling = sum(fill(0))
    assert sum(fill(39 + window - 1 + longer)) == filling * longer


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("window", [9, 25])
@pytest.mark.parametrize("middle", [True, False])
def test_a_stream_is_differentiated_as_savitzky_and_golay_do_offline(rng, order, window, middle):
    q = rng.normal(size=(4 * window, 3)).cumsum(0)
    differentiator = Differentiator(order, window, middle=middle)
    results = [differentiator.push(STEP * i, row, None) for i, row in enumerate(q)]
    found = np.array([result for result in results if result is not None])
    for k in (1, 2):
        if middle:
            fitted = scipy.signal.savgol_filter(q, window, order + 1, k, STEP / SECOND, axis=0)
            fitted = fitted[window // 2 : len(q) - window // 2]
        else:
            end = window - 1
            weights = scipy.signal.savgol_coeffs(window, order + 1, k, STEP / SECOND, end, "dot")
            fitted = np.array([weights @ q[i - end : i + 1] for i in range(end, len(q))])
        np.testing.assert_allclose(found[:, k - 1], fitted, rtol=1e-7, atol=1e-7 * fitted.std())
