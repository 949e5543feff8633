# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What a controller must notice, on the pure core."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pkm_twin.apps.commands.monitor_torques import Offer, judge
from pkm_twin.report import Verdict
from pkm_twin.streams.arrivals import Arrivals
from test.nodes.harness import SECOND

NOW = 1_000 * SECOND
STEP = SECOND // 1000
DEADLINE = 100 * STEP
NAMES = ("a", "b")
EFFORT = (1.0, -2.0)
SOUND = Offer(1, 0.1, 0.1)


def send(arrivals, index, age=STEP, names=NAMES, effort=EFFORT, number=None, stamp=None):
    """A message of a stream at 1 kHz that is so old when it comes."""
    now = NOW + index * STEP
    stamp = now - age if stamp is None else stamp
    arrivals.count_message(names, effort, stamp, now, index * STEP, number, now - age)


def stream(count=10, **changes):
    arrivals = Arrivals(0.1)
    for i in range(count):
        send(arrivals, i, number=i + 1, **changes)
    return arrivals


def bad(arrivals, offer=SOUND):
    facts = judge("/t", arrivals, offer).facts
    return {fact.text for fact in facts if fact.verdict is Verdict.BAD}


def test_a_sound_stream_is_good():
    data = judge("/t", stream(), SOUND).data
    assert data["good"]
    assert {item["verdict"] for item in data["items"]} == {"good"}
    assert data["messages"] == 10
    assert data["longest_silence_s"] == 0.001
    assert data["mean_age_s"] == data["oldest_s"] == 0.001


@given(st.lists(st.integers(0, 3 * DEADLINE), min_size=1, max_size=30))
def test_every_silence_beyond_the_deadline_counts_the_last_one_too(silences):
    arrivals = Arrivals(0.1)
    time = 0
    arrivals.count_message(NAMES, EFFORT, NOW, NOW, time)
    for i, silence in enumerate(silences, 1):
        time += silence
        if i < len(silences):
            arrivals.count_message(NAMES, EFFORT, NOW + i, NOW + i, time)
    arrivals.end_count(time)
    assert arrivals.silences == sum(silence > DEADLINE for silence in silences)
    assert arrivals.longest_silence == max(silences)


@given(st.lists(st.integers(-DEADLINE, 3 * DEADLINE), min_size=1, max_size=30))
def test_every_message_older_than_the_deadline_counts(ages):
    arrivals = Arrivals(0.1)
    for i, age in enumerate(ages):
        send(arrivals, i, age=age)
    assert arrivals.late == sum(age > DEADLINE for age in ages)
    assert arrivals.oldest == max(0, *ages)


@given(st.lists(st.integers(1, 5), min_size=1, max_size=30))
def test_every_number_that_is_left_out_counts(steps):
    arrivals = Arrivals(0.1)
    number = 1
    send(arrivals, 0, number=number)
    for i, step in enumerate(steps, 1):
        number += step
        send(arrivals, i, number=number)
    assert arrivals.topic.missed == sum(step - 1 for step in steps)


@pytest.mark.parametrize(
    ("fault", "changes"),
    [
        ("not finite", {"effort": (1.0, math.nan)}),
        ("not finite", {"effort": (-math.inf, 0.0)}),
        ("length", {"effort": (1.0,)}),
        ("length", {"effort": ()}),
        ("names", {"names": ("a", "a")}),
        ("zero stamp", {"stamp": 0}),
        ("stamp order", {"stamp": NOW}),
        ("other joints", {"names": ("a", "c")}),
    ],
)
def test_every_fault_of_a_message_is_told(fault, changes):
    arrivals = stream()
    send(arrivals, 10, number=11, **changes)
    assert arrivals.faults[fault] == 1
    assert "faults" in bad(arrivals)
    send(arrivals, 11, number=12)
    assert sum(arrivals.faults.values()) <= 2


def test_a_topic_of_which_nothing_came_is_bad_and_the_rest_unknown():
    data = judge("/t", Arrivals(0.1), Offer()).data
    assert not data["good"]
    assert bad(Arrivals(0.1), Offer()) == {"messages", "publishers"}
    assert data["mean_age_s"] is None


@pytest.mark.parametrize(
    ("offer", "what"),
    [
        (Offer(2, 0.1, 0.1), "publishers"),
        (Offer(1, math.inf, 0.1), "deadline offered"),
        (Offer(1, 0.1, 0.2), "lifespan offered"),
    ],
)
def test_what_the_publishers_promise_is_judged(offer, what):
    assert bad(stream(), offer) == {what}
