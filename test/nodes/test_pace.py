# SPDX-License-Identifier: Apache-2.0
"""At most so many samples a second, by their stamps."""

import numpy as np
import pytest

from pkm_twin.streams.monitor import Pace

SECOND = 10**9


def answered(pace, stamps):
    found = []
    for stamp in stamps:
        if pace.due(stamp):
            pace.answered(stamp)
            found.append(stamp)
    return found


@pytest.mark.parametrize("input_rate", [40.0, 100.0, 101.0, 250.0, 1000.0, 990.0])
@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_the_rate_is_kept_and_a_slower_stream_is_answered_whole(input_rate, jitter):
    rng = np.random.default_rng(1)
    steps = np.arange(4000) + jitter * rng.uniform(-1, 1, 4000)
    stamps = (SECOND * (1000 + steps / input_rate)).astype(int).tolist()
    found = answered(Pace(100.0), stamps)
    seconds = len(stamps) / input_rate
    expected = min(len(stamps), 100.0 * seconds)
    assert 0.97 * expected - 2 <= len(found) <= expected + 3
    # Never more than two within a period.
    assert all(b - a >= SECOND // 100 for a, b in zip(found, found[2:], strict=False))


def test_zero_is_every_sample():
    assert answered(Pace(0.0), [5, 5, 6, 3]) == [5, 5, 6, 3]


def test_a_silence_earns_no_burst_and_a_reset_begins_anew():
    pace = Pace(10.0)
    period = SECOND // 10
    stamps = [1000 * period, 5000 * period, *(5000 * period + k for k in range(1, 100))]
    assert len(answered(pace, stamps)) <= 3
    assert not pace.due(10)
    pace.reset()
    assert pace.due(10)
