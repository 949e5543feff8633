# SPDX-License-Identifier: Apache-2.0
"""What is counted of a topic: lost messages and answers that took too long."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pkm_twin.streams.monitor import TopicStatistics

MILLISECOND = 10**6


@given(st.lists(st.booleans(), min_size=1, max_size=50))
def test_what_is_missing_between_two_messages_is_counted(come):
    topic = TopicStatistics()
    for number, here in enumerate(come, 1):
        if here and topic.received(number, number * MILLISECOND):
            topic.count_missed()
    first, last = (come.index(True), len(come) - come[::-1].index(True)) if any(come) else (0, 0)
    assert topic.missed == come[first:last].count(False)


def test_a_publisher_that_begins_anew_or_gives_no_numbers_has_lost_nothing():
    for numbers in ([100, 101, 1, 2, 3], [None, None, None], [7, None, 9]):
        topic = TopicStatistics()
        for sent, number in enumerate(numbers, 1):
            assert not topic.received(number, sent * MILLISECOND)


def test_unconfirmed_gaps_are_not_counted():
    topic = TopicStatistics()
    assert [topic.received(number, number) for number in (1, 900, 2)] == [False, True, False]
    assert topic.missed == 0


@pytest.mark.parametrize(("took", "overruns"), [(0.9e-3, 0), (1.1e-3, 20)])
def test_an_answer_that_takes_longer_than_the_period_is_an_overrun(took, overruns):
    topic = TopicStatistics()
    for i in range(21):
        topic.received(i, i * MILLISECOND)
        topic.handled(took)
    # The first message has no period yet; stamp zero is none.
    assert topic.overruns == pytest.approx(overruns, abs=1)
    assert topic.longest == took


def test_the_period_is_a_mean():
    """Two messages close together do not make a good answer late."""
    topic = TopicStatistics()
    sent = 0
    for i in range(100):
        sent += MILLISECOND * (4 if i % 2 else 8)
        topic.received(i, sent)
        topic.handled(5e-3)
    assert topic.overruns <= 1


def test_a_silence_is_no_period():
    """Batches of 20 at 1 kHz, a second apart."""
    topic = TopicStatistics()
    sent = 0
    for i in range(200):
        sent += MILLISECOND * (1 if i % 20 else 1000)
        topic.received(i, sent)
        topic.handled(5e-3)
    assert topic.overruns >= 190


def test_a_slower_stream_is_learned():
    topic = TopicStatistics()
    sent = 0
    for i in range(300):
        sent += MILLISECOND * (1 if i < 100 else 20)
        topic.received(i, sent)
        topic.handled(5e-3)
    assert 98 <= topic.overruns <= 140
