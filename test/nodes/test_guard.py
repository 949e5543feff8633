# SPDX-License-Identifier: Apache-2.0
"""What is counted of a topic: lost messages and answers that took too long."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pkm_twin.streams.monitor import Pace

MILLISECOND = 10**6


@given(st.lists(st.booleans(), min_size=1, max_size=50))
def test_what_is_missing_between_two_messages_is_counted(come):
    pace = Pace()
    for number, here in enumerate(come, 1):
        if here and pace.arrived(number, number * MILLISECOND):
            pace.confirm()
    first, last = (come.index(True), len(come) - come[::-1].index(True)) if any(come) else (0, 0)
    assert pace.lost == come[first:last].count(False)


def test_a_publisher_that_begins_anew_or_gives_no_numbers_has_lost_nothing():
    for numbers in ([100, 101, 1, 2, 3], [None, None, None], [7, None, 9]):
        pace = Pace()
        for sent, number in enumerate(numbers, 1):
            assert not pace.arrived(number, sent * MILLISECOND)


def test_unconfirmed_gaps_are_not_counted():
    pace = Pace()
    assert [pace.arrived(number, number) for number in (1, 900, 2)] == [False, True, False]
    assert pace.lost == 0


@pytest.mark.parametrize(("took", "overruns"), [(0.9e-3, 0), (1.1e-3, 20)])
def test_an_answer_that_takes_longer_than_the_period_is_an_overrun(took, overruns):
    pace = Pace()
    for i in range(21):
        pace.arrived(i, i * MILLISECOND)
        pace.answered(took)
    # The first message has no period yet; stamp zero is none.
    assert pace.overruns == pytest.approx(overruns, abs=1)
    assert pace.longest == took


def test_the_period_is_a_mean():
    """Two messages close together do not make a good answer late."""
    pace = Pace()
    sent = 0
    for i in range(100):
        sent += MILLISECOND * (4 if i % 2 else 8)
        pace.arrived(i, sent)
        pace.answered(5e-3)
    assert pace.overruns <= 1


def test_a_silence_is_no_period():
    """Batches of 20 at 1 kHz, a second apart."""
    pace = Pace()
    sent = 0
    for i in range(200):
        sent += MILLISECOND * (1 if i % 20 else 1000)
        pace.arrived(i, sent)
        pace.answered(5e-3)
    assert pace.overruns >= 190


def test_a_slower_stream_is_learned():
    pace = Pace()
    sent = 0
    for i in range(300):
        sent += MILLISECOND * (1 if i < 100 else 20)
        pace.arrived(i, sent)
        pace.answered(5e-3)
    assert 98 <= pace.overruns <= 140
