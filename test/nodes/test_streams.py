# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What is known of a stream: its pace, its losses, and whether rates and positions agree."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from delta_dynamics.feedforward import Feedforward, Settings
from pkm_twin.errors import PkmTwinError
from pkm_twin.recordings.recording import Recording
from pkm_twin.streams.monitor import Pace, StreamMonitor, TopicStatistics
from pkm_twin.streams.rates import RateAgreement, _block_moves, compare_rates
from test.nodes.harness import SECOND
from test.support.robots import load


def check_history(stream, events):
    trip, recovery = stream.trip_count, stream.recovery_count
    stopped, bad, good, accepted, rejected, stops = False, 0, 0, 0, [], []
    reason, since = "", []
    for number, event in enumerate(events):
        text = str(number)
        if event == "good":
            bad, good = 0, good + 1
            if not stopped:
                good = 0
            stopped = stopped and good < recovery
            accepted += not stopped
            assert stream.accept() is not stopped
        elif event == "resume":
            status = stream.status
            assert stream.resume() == (status if stopped else "")
            stopped, bad, good = False, 0, 0
        else:
            good = 0
            if event != "stop":
                bad += 1
                rejected.append(event)
                since.append(f"{event}: {text}")
            begins = not stopped and (event == "stop" or bad >= trip)
            if not stopped:
                reason = f"{event}: {text}"
            if begins:
                stopped, since = True, []
                stops.append(event)
            ask = stream.stop if event == "stop" else stream.reject
            reactions = []
            with stream.reacting(lambda seen=reactions, at=number: seen.append(at)):
                assert ask(event, text) is begins
                assert not reactions
            assert reactions == [number] * begins
        assert (stream.stopped, stream.accepted) == (stopped, accepted)
        assert stream.stops == Counter(stops)
        assert stream.counts("x", "taken") == {
            "x taken": accepted,
            **{f"x rejected: {why}": count for why, count in Counter(rejected).items()},
        }
        assert not reason or f"{stream.reason}: {stream.text}" == reason
        if not stopped:
            since = []
            continue
        more = f"; rejected since then: {len(since)}" * (len(since) >= 5)
        if more and since[-1].split(":")[0] != reason.split(":")[0]:
            more += f", the last: {since[-1]}"
        assert stream.status == reason + more


@pytest.mark.parametrize("trip", [1, 2, 3])
@pytest.mark.parametrize("recovery", [1, 2, 4])
def test_a_stream_is_what_its_history_says(trip, recovery, rng):
    """Stopped from the trip-th reject in a row to the recovery-th good sample in a row."""
    for _ in range(50):
        events = rng.choice(["good", "a", "b", "stop", "resume"], 40, p=[0.4, 0.3, 0.2, 0.08, 0.02])
        check_history(StreamMonitor(trip, recovery), events.tolist())


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


MILLISECOND = 10**6


@given(st.lists(st.booleans(), min_size=1, max_size=50))
def test_what_is_missing_between_two_messages_is_counted(come):
    topic = TopicStatistics()
    for number, here in enumerate(come, 1):
        if here and topic.record_message(number, number * MILLISECOND):
            topic.count_missed()
    first, last = (come.index(True), len(come) - come[::-1].index(True)) if any(come) else (0, 0)
    assert topic.missed == come[first:last].count(False)


def test_a_publisher_that_begins_anew_or_gives_no_numbers_has_lost_nothing():
    for numbers in ([100, 101, 1, 2, 3], [None, None, None], [7, None, 9]):
        topic = TopicStatistics()
        for sent, number in enumerate(numbers, 1):
            assert not topic.record_message(number, sent * MILLISECOND)


def test_unconfirmed_gaps_are_not_counted():
    topic = TopicStatistics()
    assert [topic.record_message(number, number) for number in (1, 900, 2)] == [False, True, False]
    assert topic.missed == 0


@pytest.mark.parametrize(("took", "overruns"), [(0.9e-3, 0), (1.1e-3, 20)])
def test_an_answer_that_takes_longer_than_the_period_is_an_overrun(took, overruns):
    topic = TopicStatistics()
    for i in range(21):
        topic.record_message(i, i * MILLISECOND)
        topic.record_duration(took)
    # The first message has no period yet; stamp zero is none.
    assert topic.overruns == pytest.approx(overruns, abs=1)
    assert topic.longest == took


def test_the_period_is_a_mean():
    """Two messages close together do not make a good answer late."""
    topic = TopicStatistics()
    sent = 0
    for i in range(100):
        sent += MILLISECOND * (4 if i % 2 else 8)
        topic.record_message(i, sent)
        topic.record_duration(5e-3)
    assert topic.overruns <= 1


@pytest.mark.parametrize("regular", [1, 4, 20])
def test_a_silence_counts_as_two_periods(regular):
    topic = TopicStatistics()
    topic.record_message(0, MILLISECOND)
    topic.record_duration(1.0)
    for i in range(1, regular + 1):
        topic.record_message(i, (i + 1) * MILLISECOND)
    topic.record_message(regular + 1, 100 * SECOND)
    period = 1e-3 * (1.0 + max(0.1, 1.0 / (regular + 1)))
    for took, overruns in ((0.999 * period, 0), (1.001 * period, 1)):
        topic.record_duration(took)
        assert topic.overruns == overruns


def test_a_slower_stream_is_learned():
    topic = TopicStatistics()
    sent = 0
    for i in range(300):
        sent += MILLISECOND * (1 if i < 100 else 20)
        topic.record_message(i, sent)
        topic.record_duration(5e-3)
    assert 98 <= topic.overruns <= 140


ROBOTS = ("delta_cu", "five_bar", "stewart")


def motion(rng, robot, t):
    """A random smooth motion of all joints about zero: positions and rates, shape (k, n) each."""
    units = np.array([1.0 if unit == "rad" else robot.size for unit in robot.joint_units])
    turns = 2.0 * np.pi * rng.uniform(0.3, 2.0, (4, 1, robot.joints_count))
    phase, reach = rng.uniform(0.0, 2.0 * np.pi, turns.shape), 0.05 * units
    angle = turns * t[:, None] + phase
    return (reach * np.sin(angle)).sum(0), (reach * turns * np.cos(angle)).sum(0)


def faults(robot, stamps, q, qd):
    """What is said after each sample."""
    agreement, found = RateAgreement(robot), []
    for stamp, place, rate in zip(stamps.tolist(), q, qd, strict=True):
        agreement.push(stamp, place, rate)
        found.append(agreement.fault)
    return found


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("rate", [50.0, 200.0, 1000.0])
def test_a_true_motion_agrees_and_one_of_a_wrong_scale_does_not(rng, name, rate):
    """With jitter, lost samples, noise and velocities that are 10 ms late."""
    robot = load(name)
    t = np.arange(0.0, 4.0, 1.0 / rate)
    t = (t + rng.uniform(0.0, 0.5 / rate, len(t)))[rng.uniform(size=len(t)) > 0.05]
    stamps = np.round(1e9 * t).astype(np.int64) + SECOND
    seed = int(rng.integers(2**31))
    q, _ = motion(np.random.default_rng(seed), robot, t)
    _, late = motion(np.random.default_rng(seed), robot, t - 0.01)
    q = q + 1e-5 * rng.normal(size=q.shape)
    qd = late + 1e-2 * np.abs(late).max(0) * rng.normal(size=q.shape)
    assert set(faults(robot, stamps, q, qd)) == {""}
    for j in range(robot.joints_count):
        for factor in (0.05, 0.0, -1.0, 57.3):
            wrong = np.where(np.arange(robot.joints_count) == j, factor, 1.0)
            for found in (
                faults(robot, stamps, wrong * q, qd),
                faults(robot, stamps, q, wrong * qd),
            ):
                assert all(text.startswith(robot.joint_names[j]) for text in found[-len(t) // 4 :])


def test_noise_at_rest_says_nothing(rng):
    robot = load("delta_cu")
    stamps = SECOND + np.arange(3000) * SECOND // 1000
    noise = rng.normal(size=(3000, 3))
    assert set(faults(robot, stamps, 1e-5 * noise, 0.05 * noise)) == {""}


def test_the_stream_of_the_node_is_judged(make):
    """Positions scaled by 0.05 with true velocities pass every limit."""
    robot = load("delta_cu")
    for factor in (1.0, 0.05):
        core = Feedforward(robot, Settings())
        for i in range(2000):
            t, stamp = 1e-3 * i, SECOND + i * SECOND // 1000
            q = factor * 0.2 * np.sin(5.0 * t) * np.ones(3)
            qd = np.cos(5.0 * t) * np.ones(3)
            core.joint_state(make.joint_state(robot.joint_names, q, qd, stamp=stamp), stamp)
        assert core.stream.rejected.total() == 0
        assert bool(core.rates.fault) == (factor != 1.0)


def test_a_stream_and_its_recording_are_compared_alike(rng):
    """The share of the difference of both, over stamps with jitter and losses, at rates about the least of a block."""
    robot = load("delta_cu")
    for rate in (60.0, 100.0, 101.0, 1000.0):
        t = (np.arange(400) + rng.uniform(0.0, 0.5, 400))[rng.uniform(size=400) > 0.1] / rate
        stamps = np.round(1e9 * t).astype(np.int64) + SECOND
        q, qd = motion(rng, robot, t)
        stream = RateAgreement(robot, blocks=10**6)
        moved, told = _block_moves(stamps, q, 0.5 * qd)
        for stamp, place, rates in zip(stamps.tolist(), q, 0.5 * qd, strict=True):
            stream.push(stamp, place, rates)
        assert np.array_equal(np.moveaxis(np.array(stream._blocks), 1, 0), [moved, told])


@pytest.mark.parametrize("noise", [0.01, 0.3, 3.0])
def test_noise_is_no_fault_and_velocities_of_two_joints_in_turn_are_one(rng, noise):
    robot = load("delta_cu")
    t = np.arange(0.0, 4.0, 0.002)
    stamps = np.round(1e9 * t).astype(np.int64) + SECOND
    for _ in range(10):
        q, qd = motion(rng, robot, t)
        size = noise * np.abs(qd).max()
        honest = qd + size * rng.normal(size=qd.shape)
        assert not compare_rates(robot, stamps, q, honest)[1]
        if noise < 3.0:
            turned = np.where(np.arange(len(t))[:, None] % 2, honest, honest[:, ::-1])
            faults = compare_rates(robot, stamps, q, turned)[1]
            assert {text.split()[0] for text in faults} == {robot.joint_names[0], robot.joint_names[-1]}


def test_positions_of_two_publishers_in_turn_are_no_motion(rng):
    robot = load("delta_cu")
    t = np.arange(0.0, 4.0, 0.002)
    q, qd = motion(rng, robot, t)
    for second in (q[::-1], q + 0.3):
        both = np.where(np.arange(len(t))[:, None] % 2, q, second)
        with pytest.raises(PkmTwinError, match="two publishers"):
            Recording(robot, t, both, qd).with_rates()
    Recording(robot, t, q, qd).with_rates()
