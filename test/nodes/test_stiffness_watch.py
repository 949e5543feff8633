# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The stiffness alarm's core: over the recorded bags and the frame engine, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest

from pkm_twin.bags.reader import open_bag
from pkm_twin.errors import MessageError
from pkm_twin.messages.reading import read_deflection, rotate_to_base
from pkm_twin.messages.stamps import SECOND, StampRules
from stiffness_monitor.alarm import MAX_WAITING, AlarmSettings, StiffnessAlarm, StiffnessWatch
from stiffness_monitor.monitor import Monitor
from test.bags.test_recordings import FOLDER
from test.laws.deflections import SENSORS, noisy, twin_recording
from test.nodes.harness import Maker, Plain, reject
from test.support.robots import load

ROBOT = load("upr_rpu")
FRAMES = ("base_link", "platform")
RULES = StampRules(future_tolerance=2**62)
JOINT_LATENCY = 200_000
LATENCIES = {"/joint_states": JOINT_LATENCY, "/wrench": 300_000}
MAKE = Maker(Plain())


def watched(name, topic, **settings):
    """The core after a bag, of which the messages at the deflections' stamps are taken.

    And every judgement that it came to.
    """
    bag = open_bag(FOLDER / f"{name}.mcap")
    wanted = {m.log_time - 400_000 for m in bag.messages([topic])}
    monitor, watch = Monitor(ROBOT), StiffnessWatch(ROBOT, RULES, FRAMES, AlarmSettings(**settings))
    judged = []
    for m in bag.messages([topic, *LATENCIES]):
        if m.topic == topic:
            watch.deflection(m.message, m.log_time)
        elif m.log_time - LATENCIES[m.topic] not in wanted:
            continue
        elif m.topic == "/wrench":
            watch.answer(monitor.wrench(m.message, m.log_time))
        else:
            monitor.joint_state(m.message, m.log_time)
        while (work := watch.judgement()) is not None:
            for _ in work:
                pass
            if watch.departures is not None:
                judged.append((watch.stamp, watch.departures))
    return watch, judged


def test_a_joint_three_times_softer_is_found_by_name_in_the_recorded_bag():
    watch, judged = watched("upr_rpu_soft_joint", "/measured_deflection")
    (found,) = watch.departures
    assert (found.element, found.others) == ("3U", ())
    assert abs(found.factor - 3.0) < 3.0 * found.deviation < 0.5
    # No other element is named on the way.
    assert {d.element for _, departures in judged for d in departures} == {"3U"}
    first = next(stamp for stamp, departures in judged if departures)
    # The cutter enters at 2 s.
    assert first - 1_700_000_000 * SECOND < 8 * SECOND
    assert not watch.taken.rejected


def test_no_alarm_in_the_whole_sound_milling_bag():
    watch, judged = watched("upr_rpu_milling", "/ground_truth/deflection")
    assert len(judged) > 10
    assert not any(departures for _, departures in judged)
    assert watch.taken.accepted == 400


def departures_of(factors, rng=None, robot=ROBOT, **settings):
    clean = twin_recording(factors)
    recording = clean if rng is None else noisy(clean, rng, SENSORS)
    alarm = StiffnessAlarm(robot, AlarmSettings(**settings))
    rows = zip(
        recording.time,
        robot.forward(recording.q),
        recording.wrench,
        recording.deflection,
        strict=True,
    )
    for row in rows:
        alarm.push(*row)
    return alarm.judge()


def test_what_loads_do_not_tell_apart_is_named_together():
    (found,) = departures_of({"1R": 3.0}, np.random.default_rng(1))
    assert found.candidates == "1R or 1U"
    assert 1.0 < dict(found.others)["1U"] < found.factor


def test_two_soft_elements_are_both_found():
    found = departures_of({"1B": 1.5, "3U": 3.0}, np.random.default_rng(1))
    assert {d.element: d.factor for d in found} == pytest.approx({"1B": 1.5, "3U": 3.0}, rel=0.05)


def test_what_the_files_uncertainty_allows_is_no_alarm():
    """All joints by a fifth: four deviations of one cause, and below every element's bound."""
    factors = {f"{limb}{kind}": 1.2 for limb in (1, 2, 3) for kind in "RU"}
    assert departures_of(factors) == ()
    (found,) = departures_of({"1B": 1.5}, np.random.default_rng(1), directions=(True,) * 3 + (False,) * 3)
    assert found.element == "1B"


@pytest.mark.long
@pytest.mark.parametrize("name", ROBOT.element_names)
def test_every_element_is_found_in_noise(name):
    """Where the noise leaves it below its bound there is no alarm, and never a wrong name."""
    missed = 0
    for seed in range(10):
        departures = departures_of({name: 3.0}, np.random.default_rng(seed))
        missed += not departures
        for found in departures:
            assert name in found.candidates.split(" or ")
            if found.element == name:
                assert abs(found.factor - 3.0) < 4.0 * found.deviation
    assert missed <= (4 if name == "3R" else 0)


@pytest.mark.long
def test_no_alarm_in_a_hundred_sound_noisy_recordings():
    for seed in range(100):
        assert departures_of({}, np.random.default_rng(seed)) == ()


def deflection(stamp=10**9, frame="base_link", shift=(1e-5, 0.0, 0.0), turn=(0.0, 0.0, 0.0, 1.0)):
    fields = MAKE.kind
    return fields.header(
        header=MAKE.header(stamp, frame),
        transform=fields.header(
            translation=fields.header(**dict(zip("xyz", shift, strict=True))),
            rotation=fields.header(**dict(zip("xyzw", turn, strict=True))),
        ),
    )


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"frame": ""}, "frame"),
        ({"frame": "tool"}, "frame"),
        ({"shift": (np.nan, 0.0, 0.0)}, "not finite"),
        ({"shift": (0.0, np.inf, 0.0)}, "not finite"),
        ({"shift": (0.2, 0.0, 0.0)}, "bounds"),
        ({"shift": (1e-310, 0.0, 0.0)}, "bounds"),
        ({"turn": (0.0, 0.0, 0.0, 0.0)}, "bounds"),
        ({"turn": (0.0, 0.6, 0.0, 0.8)}, "bounds"),
        ({"turn": (0.0, 0.0, np.nan, 1.0)}, "not finite"),
        ({"stamp": 0}, "zero stamp"),
        ({"stamp": 5 * SECOND}, "future stamp"),
    ],
)
def test_a_bad_deflection_is_refused_whole(changes, reason):
    watch = StiffnessWatch(ROBOT, StampRules(), FRAMES)
    assert reject(watch.deflection, deflection(**changes), SECOND)[0] == reason
    assert watch.taken.rejected == {reason: 1}
    assert watch.count == 0


def test_samples_older_than_the_window_are_dropped():
    """Of a machine that has warmed up what was measured cold tells nothing."""
    recording = twin_recording({})
    alarm = StiffnessAlarm(ROBOT, AlarmSettings(window=1.0))
    row = ROBOT.forward(recording.q[0]), recording.wrench[0], recording.deflection[0]
    counts = []
    for time in (0.0, 0.5, 1.0, 1.2, 5.0):
        alarm.push(time, *row)
        counts.append(alarm.count)
    assert counts == [1, 2, 3, 3, 1]


def test_the_wrench_of_a_deflection_is_that_between_its_neighbours(monkeypatch):
    taken = []
    monkeypatch.setattr(StiffnessAlarm, "push", lambda self, *row: taken.append(row))
    watch, monitor = StiffnessWatch(ROBOT, RULES, FRAMES), Monitor(ROBOT)
    joints = MAKE.joint_state(ROBOT.joint_names, [0.62, 0.6, 0.65], stamp=SECOND)
    monitor.joint_state(joints, SECOND)
    loads = np.array([[9.0, 8, 7, 1, 2, 3], [19.0, -2, 7, 1, 3, 3]])
    turn = ROBOT.platform([0.62, 0.6, 0.65])[1]
    fixed = [np.concatenate((turn @ wrench[:3], turn @ wrench[3:])) for wrench in loads]
    for k, wrench in enumerate(loads):
        stamp = SECOND + k * 10_000_000
        watch.answer(monitor.wrench(MAKE.wrench(wrench, stamp), stamp))
    watch.deflection(deflection(SECOND + 2_500_000), SECOND)
    ((time, _, wrench, _),) = taken
    assert time == pytest.approx(1.0025)
    np.testing.assert_allclose(wrench, 0.75 * fixed[0] + 0.25 * fixed[1])


def answers(watch, monitor, stamps):
    for stamp in stamps:
        monitor.joint_state(MAKE.joint_state(ROBOT.joint_names, [0.62, 0.6, 0.65], stamp=stamp), stamp)
        watch.answer(monitor.wrench(MAKE.wrench([9, 8, 7, 1, 2, 3], stamp), stamp))


def test_a_deflection_waits_for_the_wrench_behind_it_and_is_refused_without_one_near():
    watch, monitor = StiffnessWatch(ROBOT, RULES, FRAMES), Monitor(ROBOT)
    answers(watch, monitor, [SECOND])
    watch.deflection(deflection(SECOND + 5_000_000), SECOND)
    assert (watch.count, watch.taken.accepted) == (0, 0)
    answers(watch, monitor, [SECOND + 10_000_000])
    assert (watch.count, watch.taken.accepted) == (1, 1)
    with pytest.raises(MessageError, match="before the last"):
        watch.deflection(deflection(SECOND), SECOND)
    watch.deflection(deflection(2 * SECOND), SECOND)
    answers(watch, monitor, [3 * SECOND])
    assert watch.taken.rejected == {"stamp order": 1, "no wrench": 1}
    assert "1.000 s away" in watch.last_reject
    for k in range(MAX_WAITING + 5):
        watch.deflection(deflection(4 * SECOND + k), SECOND)
    assert watch.taken.rejected["no wrench"] == 6
    watch.reset()
    assert watch.count == 0


@pytest.mark.parametrize("count", [1, 3 * MAX_WAITING])
def test_a_deflection_that_is_refused_in_the_end_does_not_blind_the_good_ones(count):
    """Sound by itself and ahead of the clock: no wrench comes near it."""
    watch, monitor = StiffnessWatch(ROBOT, StampRules(), FRAMES), Monitor(ROBOT)
    now, step, ahead = SECOND, SECOND // 200, 99_000_000
    answers(watch, monitor, [now])
    for k in range(count):
        watch.deflection(deflection(now + ahead + k), now)
    for _ in range(15):
        now += step
        watch.deflection(deflection(now - step // 2), now)
        answers(watch, monitor, [now])
    assert watch.taken.accepted == 15
    answers(watch, monitor, [now + SECOND])
    assert watch.taken.rejected == {"no wrench": count}


def test_axes_and_rotations_of_a_deflection():
    half = 0.02
    turn = (0.0, np.sin(half), 0.0, np.cos(half))
    sample = read_deflection(deflection(turn=turn), SECOND, RULES)
    np.testing.assert_allclose(sample.values, [1e-5, 0, 0, 0, 2 * half, 0], atol=1e-15)
    other = read_deflection(deflection(turn=[-v for v in turn]), SECOND, RULES)
    np.testing.assert_allclose(other.values, sample.values, atol=1e-15)
    rotation = ROBOT.platform([0.62, 0.6, 0.65])[1]
    moved = rotate_to_base(sample.values, rotation)
    np.testing.assert_allclose(moved[:3], rotation @ sample.values[:3])
    np.testing.assert_allclose(moved[3:], rotation @ sample.values[3:])
