# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A node that gets more than it can answer answers what is new, counts the rest, and says so."""

from collections import deque

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pkm_twin.errors import MessageError
from pkm_twin.messages.stamps import SECOND, StampRules
from pkm_twin.streams.monitor import CAUGHT_UP_FRACTION, RELIEF_TIME, Backlog
from test.nodes.harness import text_of, values_of

MAX_WAIT = 0.05


def work_through(backlog, arrivals, service, drop_cost=2e-5):
    """Serve a queue in its order: the waits of the answered messages, s, and those before drops."""
    now, answered, before = 0.0, [], 0
    for arrival in arrivals:
        now = max(now, arrival)
        if backlog.should_drop(now - arrival, MAX_WAIT, now):
            now += drop_cost
            continue
        answered.append(now - arrival)
        before += not backlog.dropped
        now += service
    return answered, before


@settings(max_examples=50)
@given(
    period=st.floats(5e-4, 5e-3),
    load=st.floats(0.1, 4.0),
    every=st.booleans(),
    seed=st.integers(0, 2**16),
)
def test_no_answer_is_of_a_message_that_waited_too_long_and_all_are_counted(period, load, every, seed):
    backlog, count = Backlog(every), 3000
    arrivals = [(k + (seed * k % 7) / 7.0) * period for k in range(count)]
    answered, before = work_through(backlog, sorted(arrivals), load * period)
    assert len(answered) + backlog.dropped == count
    assert max(answered) <= MAX_WAIT
    if load < 0.4:
        assert backlog.dropped == 0
    if load > 1.2 and (load - 1.0) * period * count > 2.0 * MAX_WAIT:
        assert backlog.dropped > 0
        # It drops what it cannot answer, and not much more than this.
        most = period * count / (load * period)
        assert len(answered) > 0.5 * most
        if not every:
            # The newest, as long as it lasts.
            assert max(answered[before:]) <= CAUGHT_UP_FRACTION * MAX_WAIT


def test_after_an_overload_a_node_takes_every_message_again():
    backlog = Backlog()
    assert backlog.should_drop(1.0, MAX_WAIT, 100.0)
    assert backlog.should_drop(0.9 * MAX_WAIT, MAX_WAIT, 100.1)
    assert not backlog.should_drop(0.0, MAX_WAIT, 100.2 + RELIEF_TIME)
    assert not backlog.should_drop(0.9 * MAX_WAIT, MAX_WAIT, 100.3 + RELIEF_TIME)
    assert (backlog.dropped, backlog.take_longest(), backlog.take_longest()) == (2, 1.0, 0.0)


@pytest.mark.parametrize(("age", "cause"), [(0.2, "overloaded"), (3600.0, "use_sim_time")])
def test_an_old_stamp_has_the_cause_that_fits_its_age(age, cause):
    now = 10_000 * SECOND
    with pytest.raises(MessageError, match=cause):
        StampRules(max_age=SECOND // 10).check(now - round(age * SECOND), now)


def test_lines_of_one_reason_are_logged_with_growing_pauses():
    health = pytest.importorskip("pkm_twin.ros.health", exc_type=ImportError)
    one, lines = health._LogThrottle(), deque()
    for tick in range(3000):
        held = one.begin_line(0.1 * tick)
        if held is not None:
            lines.append(0.1 * tick)
    # Five minutes of ten lines a second.
    assert len(lines) < 20
    assert min(b - a for a, b in zip(lines, list(lines)[1:], strict=False)) >= health.MIN_PAUSE
    assert one.begin_line(300.0 + 2.0 * health.MAX_PAUSE) is not None
    assert one.begin_line(301.1 + 2.0 * health.MAX_PAUSE) is not None


def test_a_flooded_node_says_so_and_answers_the_newest(peer, launch):
    pytest.importorskip("rclpy", exc_type=ImportError)
    from test.nodes.harness import stamp_of
    from test.nodes.twin import launched, state

    twin = launched(peer, launch, "flooded", "stale_after:=30.0", f"max_wait:={MAX_WAIT}")
    torques = twin.received("joint_torques")
    twin.until(lambda: torques, repeat=lambda: twin.send_state(state(twin.stamp())))

    def flood():
        for _ in range(500):
            twin.send_state(state(twin.stamp(1)))

    told = twin.peer.received("/diagnostics")
    told.clear()

    def overloaded():
        own = [a for a in told if a.status[0].name == "/flooded"]
        return next((a for a in own if "the node is overloaded" in text_of(a)), None)

    array = peer.until(overloaded, repeat=flood, every=0.0)
    values = values_of(array)
    assert int(values["dropped by overload: joint_states"]) > 0
    assert float(values["behind (ms): joint_states"]) > 1e3 * MAX_WAIT
    # Afterwards it answers as before.
    last = 0

    def send():
        nonlocal last
        last = twin.stamp()
        twin.send_state(state(last))

    peer.until(lambda: last and any(stamp_of(m) >= last for m in torques), repeat=send, every=0.01)
    twin.process.stop()
