# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Steps that no motion makes, two publishers on one topic, and missing samples."""

import numpy as np
import pytest

from pkm_twin.streams.steps import find_repeats, find_sampling, find_steps

LIMIT = (20.0, 20.0, 20.0)


def drawn(rng, rate=1000.0, seconds=6.0):
    """A motion of three joints as a sum of harmonics: times, positions and velocities."""
    time = np.arange(round(seconds * rate)) / rate
    speed = rng.uniform(2.0, 15.0, (4, 3))
    size, phase = rng.uniform(0.05, 0.2, (4, 3)), rng.uniform(0.0, 6.0, (4, 3))
    angle = speed * time[:, None, None] + phase
    return time, np.sum(size * np.sin(angle), 1), np.sum(size * speed * np.cos(angle), 1)


@pytest.mark.parametrize("rate", [50.0, 200.0, 1000.0])
@pytest.mark.parametrize("measured", [True, False])
def test_no_motion_jumps(rng, rate, measured):
    """Whatever the encoder, its noise, late velocities, stamps that tremble and lost samples."""
    for _ in range(5):
        time, q, qd = drawn(rng, rate)
        step = rng.uniform(1e-5, 2e-3)
        period = 1.0 / rate
        late = np.roll(qd, round(0.005 * rate), 0)
        some = np.sort(rng.choice(len(time), len(time) * 2 // 3, replace=False))
        trembling = time + rng.uniform(-0.2, 0.2, len(time)) * period
        cases = [
            (time, q, qd),
            (time, np.round(q / step) * step, qd),
            (time, q, late),
            (time, q + 1e-4 * rng.normal(size=q.shape), qd + 0.01 * rng.normal(size=q.shape)),
            (trembling, q, qd),
            (time[some], q[some], qd[some]),
            (time, 1e-3 * q, 1e-3 * qd),
            (time, np.round(0.02 * q / step) * step, 0.02 * qd),
            (time, 0.0 * q, 0.0 * qd),
        ]
        for case, (t, x, v) in enumerate(cases):
            found = find_steps(t, x, v if measured else None, LIMIT)
            assert not found.jumps.any() and found.publishers == (), case
            assert not find_repeats(t, x).any(), case


@pytest.mark.parametrize("part", [0.005, 0.1, 0.5])
@pytest.mark.parametrize("noise", [0.0, 1e-5])
def test_samples_that_repeat_the_one_before_are_found(rng, part, noise):
    """All of them, but slow ones, whose numbers tell nothing, and none beside them."""
    for _ in range(5):
        time, q, qd = drawn(rng, 200.0)
        q = q + noise * rng.normal(size=q.shape)
        stale = np.zeros(len(time), bool)
        stale[2:-2] = rng.random(len(time) - 4) < part
        stale &= ~(np.roll(stale, 1) & np.roll(stale, 2) & np.roll(stale, 3))
        source = np.maximum.accumulate(np.where(stale, 0, np.arange(len(time))))
        found = find_repeats(time, q[source])
        assert not found[~stale].any()
        fast = np.abs(qd).max(1) > 1.0
        assert found[stale & fast].mean() > 0.98


@pytest.mark.parametrize("measured", [True, False])
@pytest.mark.parametrize(("size", "count"), [(0.5, 2), (0.1, 40), (-0.03, 1), (0.05, 500)])
def test_a_wrong_stretch_jumps_at_both_ends(rng, size, count, measured):
    for _ in range(5):
        time, q, qd = drawn(rng)
        q += 1e-5 * rng.normal(size=q.shape)
        at, joint = int(rng.integers(100, 5000)), int(rng.integers(3))
        q[at : at + count, joint] += size
        found = find_steps(time, q, qd if measured else None, LIMIT)
        assert found.jump_indices == [(at - 1, joint), (at + count - 1, joint)]
        assert found.sizes[found.jumps] == pytest.approx(abs(size), rel=0.2)


def test_a_step_beyond_the_velocity_limit_jumps(rng):
    time, q, _ = drawn(rng, rate=20.0)
    q[60:] += 4.0
    assert not find_steps(time[:60], q[:60], None, LIMIT).jumps.any()
    assert find_steps(time, q, None, LIMIT).jump_indices[0][0] == 59


@pytest.mark.parametrize("measured", [True, False])
@pytest.mark.parametrize("share", [0.5, 0.3, 0.15])
@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("still", [True, False])
def test_two_publishers_are_told_apart(rng, measured, share, regular, still):
    time, q, qd = drawn(rng)
    _, other, rates = drawn(rng)
    other += 1.5
    if still:
        other, rates = 0.0 * other + 1.5, 0.0 * rates
    turn = np.floor(share * np.arange(len(time)))
    own = np.diff(turn, prepend=0.0) > 0.0 if regular else rng.random(len(time)) < share
    mixed, told = np.where(own[:, None], other, q), np.where(own[:, None], rates, qd)
    found = find_steps(time, mixed, told if measured else None, LIMIT)
    assert sum(found.publishers) == len(time)
    assert min(found.publishers) == pytest.approx(min(own.sum(), (~own).sum()), rel=0.02)


@pytest.mark.parametrize("measured", [True, False])
@pytest.mark.parametrize("late", [0.01, 0.05, 0.3])
def test_two_publishers_of_one_motion_are_told_apart(rng, measured, late):
    """One is late, or a little off; what is published twice, or trembles, is one publisher's."""
    for rate in (200.0, 500.0, 1000.0):
        time, q, qd = drawn(rng, rate)
        noisy = q + 1e-4 * rng.normal(size=q.shape)
        odd = np.arange(len(time))[:, None] % 2 == 1
        lag = max(5, round(late * rate))
        for other in (np.roll(noisy, lag, 0), 1.01 * noisy + 20.0 / rate):
            mixed = np.where(odd, other, noisy)[lag:]
            found = find_steps(time[lag:], mixed, qd[lag:] if measured else None, LIMIT)
            assert sum(found.publishers) == len(mixed) and found.jumps.mean() > 0.1
        twice = np.repeat(q[::2], 2, 0)[: len(q)]
        found = find_steps(time, twice, qd if measured else None, LIMIT)
        assert found.publishers == ()


def test_wrong_bits_are_no_second_publisher(rng):
    time, q, qd = drawn(rng)
    bad = rng.random(q.shape) < 0.02
    q[bad] += rng.choice([-1.0, 1.0], bad.sum()) * 2.0 ** -rng.integers(1, 6, bad.sum())
    found = find_steps(time, q, qd, LIMIT)
    assert found.jumps.any() and found.publishers == ()


@pytest.mark.parametrize("lost", [0.0, 0.05, 0.7])
def test_missing_samples_are_counted(rng, lost):
    for rate in (50.0, 333.3, 1000.0):
        time = np.arange(3000) / rate + rng.normal(0.0, 0.02 / rate, 3000)
        kept = time[(rng.random(3000) >= lost) | (np.arange(3000) % 2999 == 0)]
        found = find_sampling(kept)
        assert found.expected == pytest.approx(3000, abs=3 + 0.002 * 3000 * (lost > 0.0))
        assert found.missing == found.expected - len(kept)
        assert found.period == pytest.approx(1.0 / rate, rel=2e-3)


def test_samples_without_a_period_are_not_counted(rng):
    assert find_sampling(np.cumsum(rng.exponential(0.01, 500))).missing is None
