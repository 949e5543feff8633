# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""fit and check judge a recording alike: one filter, one noise model, one verdict."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin import Robot
from pkm_twin.errors import PkmTwinError
from pkm_twin.identification.check import check, cut_recording
from pkm_twin.identification.compare import compare
from pkm_twin.identification.fit import Fit, find_worse, fit
from pkm_twin.identification.friction_laws import fit_recordings
from pkm_twin.machine.friction import Dahl
from pkm_twin.recordings import Load, Recording
from pkm_twin.streams.rates import rms
from test.identification.machines import IMPOSSIBLE, WRONG, Drawn, machine, noisy, shifted
from test.support.robots import load, often, partly_long

MACHINES = (
    "delta",
    "delta_cu",
    "five_bar",
    "linear_delta",
    "prru",
    "rps3",
    "stewart",
    "machines/rsur",
    "machines/prru3",
    "machines/rcuu",
)
FAULTS = ("one_effort_negated", "effort_columns_swapped", "half_speed", "kilogram_force")


def fitted(result: Fit) -> Robot:
    return result.robot.with_file_values({number.name: number.after for number in result.numbers})


def agree(robot: Robot, recorded: Recording) -> str:
    """What a fit says; and `check` has to say the same, of the fitted machine or of the file's."""
    try:
        result = fit(robot, [recorded], ("friction", "rotor"))
    except PkmTwinError:
        found = compare(replace(recorded, robot=robot))
        assert found is None or not found.good.all()
        return "rejected"
    compared = compare(replace(recorded, robot=fitted(result)))
    assert compared is not None
    good = bool(compared.good.all())
    if result.verdict.answer == "explains":
        assert good
        np.testing.assert_allclose(compared.late, result.delays[0], atol=0.2 * compared.period)
    elif result.verdict.answer == "does not explain":
        assert not good
    return result.verdict.answer


def path_of(name: str) -> str:
    kind, _, rest = name.partition("/")
    return f"test/machine/machines/{rest}.yaml" if rest else kind


@pytest.mark.parametrize("name", ["delta", pytest.param("five_bar", marks=pytest.mark.long)])
def test_an_encoder_s_noise_is_not_the_model_s_fault(name: str) -> None:
    """Velocities by the noise of 500 Hz positions would be far off; the efforts are late."""
    rng = np.random.default_rng([5, *name.encode()])
    m = machine(load(name), rng, 10.0, 500.0)
    made = m.recorded(effort=shifted(m.efforts, m.time, 3e-3))
    recorded = replace(noisy(made, rng), q=m.q + 2e-5 * rng.normal(size=m.q.shape))
    result = fit(m.robot, [recorded], ("friction", "payload"))
    assert result.verdict.answer == "explains"
    friction = {n.name: n.after for n in result.numbers if n.name.startswith("friction")}
    robot = m.truth.with_file_values(friction)
    compared = compare(replace(recorded, robot=robot))
    assert compared is not None and compared.good.all()
    (end,) = result.problem.held_out
    left = end.target - end.table @ result.problem.estimate.values
    assert compared.rms == pytest.approx(rms(left), abs=1e-3 * float(compared.peak.max()))


def test_efforts_that_are_late_leave_noise_alone() -> None:
    """Whatever the delay, it is found, also beside other friction, and then only noise is left."""
    rng = np.random.default_rng(11)
    m = machine(load("delta"), rng, 8.0, 500.0)
    friction = {key: 1.2 * np.array(getattr(m.truth.friction, key)) for key in ("viscous", "coulomb")}
    rubbing = m.truth.changed(friction={key: each.tolist() for key, each in friction.items()})
    for late in (0.0, *rng.uniform(-8e-3, 8e-3, 2)):
        made = noisy(m.recorded(effort=shifted(m.efforts, m.time, late)), rng)
        found, other = (compare(replace(made, robot=robot)) for robot in (m.truth, rubbing))
        assert found is not None and other is not None
        assert found.late == pytest.approx(late, abs=2e-4)
        assert other.late == pytest.approx(late, abs=2e-4)
        assert (found.rms < 2.0 * found.noise).all()


@pytest.mark.parametrize("name", partly_long(["delta", "five_bar", "linear_delta"], "five_bar"))
@pytest.mark.parametrize("late", often(0.045, -0.03))
def test_fit_and_check_say_the_same_of_late_efforts(name: str, late: float) -> None:
    """Up to 50 ms both take the delay out, and no friction is in its place."""
    m = machine(load(name), np.random.default_rng([3, *name.encode()]), 6.0, 250.0)
    effort = shifted(m.efforts, m.time, late)
    made = replace(noisy(m.recorded(effort=effort), np.random.default_rng(7)), robot=m.truth)
    found, (result, *_) = check(made), fit_recordings(m.truth, [made])
    assert found.answer == "good" and found.compared is not None
    assert result.verdict.answer == "explains"
    assert result.verdict.findings == result.verdict.hints == ()
    deviation = np.sqrt(result.problem.both.covariance[-1, -1])
    assert result.delays[0] == pytest.approx(late, abs=3.0 * deviation)
    assert found.compared.late == pytest.approx(late, abs=3.0 * deviation)
    # Also where the file has no friction.
    bare = m.truth.changed(friction={"viscous": 0.0, "coulomb": 0.0})
    made = replace(made, robot=bare)
    (cause,), (result, *_) = check(made).causes, fit_recordings(bare, [made])
    told = re.search(r"(\S+) ms late", cause)
    assert told is not None and float(told[1]) == pytest.approx(1e3 * result.delays[0], abs=0.5)


@pytest.mark.parametrize("name", partly_long(["delta", "five_bar", "linear_delta"], "five_bar"))
@pytest.mark.parametrize(("late", "known"), [(0.054, True), pytest.param(0.08, False, marks=pytest.mark.long)])
def test_fit_and_check_tell_of_efforts_that_are_later(name: str, late: float, known: bool) -> None:
    """Whether friction and payload are known or not."""
    m = machine(load(name), np.random.default_rng([3, *name.encode()]), 6.0, 250.0)
    robot = m.truth if known else m.robot
    made = noisy(m.recorded(effort=shifted(m.efforts, m.time, late)), np.random.default_rng(7))
    text = f"efforts of all joints are {late:g} s late"
    judged = check(replace(made, robot=robot))
    assert judged.answer == "bad"
    assert (*judged.causes, *judged.findings)[0].startswith(text)
    with pytest.raises(PkmTwinError, match=text):
        fit_recordings(robot, [made])


def test_drives_that_are_off_before_the_motion_are_left_out_of_both() -> None:
    """Else the efforts that are zero would be the fault of a mass."""
    rng = np.random.default_rng(5)
    m = machine(load("delta"), rng, 8.0, 250.0)
    sound, count = noisy(m.recorded(), rng), 500
    recorded = replace(
        sound,
        robot=m.truth,
        time=np.arange(count + len(m.time)) / 250.0,
        q=np.concatenate([np.repeat(m.q[:1], count, 0), m.q]),
        effort=np.concatenate([np.zeros((count, 3)), sound.measured]),
    )
    assert check(recorded).answer == "good"
    result = fit(m.robot, [cut_recording(recorded)], ("friction", "payload"))
    assert result.verdict.answer == "explains"


def test_neither_stale_samples_nor_noise_make_twice_the_efforts_good() -> None:
    """Stale samples are missing ones; where noise hides what efforts are, there is no verdict."""
    rng = np.random.default_rng(8)
    m = machine(load("delta"), rng, 8.0, 200.0)
    sound = replace(noisy(m.recorded(), rng), robot=m.truth)
    some = np.arange(len(m.time))
    some[5:-5:40] -= 1
    stale = replace(sound, q=m.q[some])
    assert check(stale.without_repeats).answer == "bad"  # 2.5 % of the samples are missing
    for scale, good in ((1.0, True), (2.0, False)):
        found = compare(replace(stale, effort=scale * stale.measured).without_repeats)
        assert found is not None and found.good.all() == good
    shaken = replace(sound, q=0.3 * m.q + 0.7 * stale.q)
    assert check(replace(shaken, effort=2.0 * shaken.measured)).answer == "not judged"


def rubbing(name: str) -> tuple[Drawn, Recording, np.random.Generator]:
    """A machine whose file has its friction, and its recording in noise of 1 %."""
    m = machine(load(path_of(name)), np.random.default_rng([3, *name.encode()]), 8.0, 200.0)
    rubs = {key: getattr(m.truth.friction, key).tolist() for key in ("viscous", "coulomb")}
    m, rng = replace(m, robot=m.robot.changed(friction=rubs)), np.random.default_rng(8)
    return m, noisy(m.recorded(effort=inverse_dynamics(m.robot, m.q, m.qd, m.qdd)), rng), rng


SCALES = [(-1.0, True), (-1.0, False), (0.5, True), (0.8, False), (1.25, True), (2.0, False)]
"""A factor of the efforts, and whether it is that of all drives."""


@pytest.mark.parametrize("scale", partly_long(SCALES, SCALES[1], SCALES[4]))
@pytest.mark.parametrize("name", partly_long(MACHINES, "delta_cu"))
def test_fit_and_check_name_one_scale(name: str, scale: tuple[float, bool]) -> None:
    (factor, whole), (m, sound, _) = scale, rubbing(name)
    count = m.robot.joints_count
    which = np.ones(count) if whole else np.eye(count)[0]
    made = replace(sound, effort=sound.effort * np.where(which > 0.0, factor, 1.0))
    (cause,) = check(made).causes
    with pytest.raises(PkmTwinError, match=re.escape(cause)):
        fit_recordings(m.robot, [made])
    if factor > 0.0:
        told = re.search(r"efforts of (.*) are (.*) times what", cause)
        assert told is not None and ("all" in told[1]) == bool(which.all() and count > 1)
        assert float(told[2]) == pytest.approx(factor, rel=0.02)


@pytest.mark.long
@pytest.mark.parametrize("name", MACHINES)
def test_fit_and_check_name_one_drive_in_more_noise(name: str) -> None:
    """Its scale may be a machine's: both name the drive, whether it is fitted or not."""
    m, sound, _ = rubbing(name)
    less = replace(sound, effort=sound.effort * 0.85 ** np.eye(m.robot.joints_count)[0])
    made = noisy(less, np.random.default_rng(8), 0.05)
    (cause,) = check(made).causes
    try:
        (note,) = fit_recordings(m.robot, [made])[-1]
    except PkmTwinError as error:
        note = str(error)
    assert cause in note


@pytest.mark.parametrize("mass", often(0.2, 5.0))
@pytest.mark.parametrize("name", partly_long(MACHINES, "delta_cu"))
def test_fit_and_check_name_one_payload(name: str, mass: float) -> None:
    """It is held throughout."""
    m, sound, rng = rubbing(name)
    robot = m.robot
    assert check(sound).answer == "good"
    mass += robot.payload.mass
    heavy = robot.changed(payload={"mass": mass})
    made = noisy(m.recorded(effort=inverse_dynamics(heavy, m.q, m.qd, m.qdd)), rng)
    judged = check(made)
    if judged.answer == "good":
        assert name != "delta_cu"
        return
    (cause,) = judged.causes
    found, _, notes = fit_recordings(robot, [made])
    (payload,) = (n for n in found.numbers if n.name == "payload.mass")
    assert float(cause.split()[-1]) == pytest.approx(mass, rel=0.05)
    assert notes[0].endswith("held throughout") and found.verdict.answer == "explains"
    assert abs(payload.after - mass) < 3.0 * payload.deviation


@pytest.mark.parametrize("name", partly_long(["delta_cu", "linear_delta"], "delta_cu"))
def test_a_payload_that_is_picked_is_fitted_with_its_times(name: str) -> None:
    m = machine(load(name), np.random.default_rng(5), 12.0, 100.0)
    light, heavy = (m.robot.changed(payload={"mass": mass}) for mass in (0.0, 0.5))
    held = (m.time > 4.0) & (m.time < 9.0)
    efforts = [inverse_dynamics(one, m.q, m.qd, m.qdd) for one in (light, heavy)]
    made = noisy(m.recorded(effort=np.where(held[:, None], *efforts[::-1])), np.random.default_rng(7))
    made = replace(made, robot=light)
    (cause,) = check(made).causes
    found, _, notes = fit_recordings(light, [made])
    (payload,) = (n for n in found.numbers if n.name == "payload.mass")
    # The fit's mass is the one that is told.
    assert "--payload" not in notes[0] and found.verdict.answer == "explains"
    for edge in cause.rpartition(" --load-times ")[2].split(","):
        assert f" {edge} " in notes[0]
    assert payload.after == pytest.approx(0.5, abs=3.0 * payload.deviation)
    assert payload.deviation < 0.05
    # Where no payload is fitted, nothing else takes its place.
    with pytest.raises(PkmTwinError, match=re.escape(cause)):
        fit_recordings(light, [made], ("friction",))


@pytest.mark.long
@pytest.mark.parametrize("name", MACHINES)
def test_fit_and_check_agree(name: str) -> None:
    rng = np.random.default_rng([7, *name.encode()])
    m = machine(load(path_of(name)), rng)
    # The payload is the file's: what is fitted can explain all.
    sound = noisy(m.recorded(), rng)
    bare = m.robot.changed(
        payload={
            "mass": m.truth.payload.mass,
            "com": list(m.truth.payload.com),
            "inertia": m.truth.payload.inertia.tolist(),
        }
    )
    assert agree(bare, sound) == "explains"
    for what in (*FAULTS, "gain"):
        if what == "effort_columns_swapped" and bare.joints_count == 1:
            continue
        made = noisy(WRONG[what](m, rng), rng) if what in WRONG else IMPOSSIBLE[what](sound, rng)
        agree(bare, made)


@pytest.mark.parametrize(
    ("name", "what"),
    [
        pytest.param(name, what, marks=() if name == "five_bar" and what == "play" else pytest.mark.long)
        for name in ("five_bar", "linear_delta", "prru")
        for what in (*IMPOSSIBLE, *WRONG, "sound", "play")
    ],
)
def test_fit_and_check_read_one_explanation(name: str, what: str) -> None:
    """A cause that `fit` rejects is bad in `check`; both have it from one value."""
    rng = np.random.default_rng([8, *name.encode()])
    m = machine(load(name), rng, 6.0)
    made = WRONG[what](m, rng) if what in WRONG else m.recorded()
    if what == "play":
        made = replace(made, q=m.q + 1e-3 * m.robot.size * np.sign(m.qd))
    made = noisy(made, rng)
    made = IMPOSSIBLE[what](made, rng) if what in IMPOSSIBLE else made
    found = check(made)
    try:
        result, *_ = fit_recordings(m.robot, [made], ("friction", "payload"), (), accept=True)
    except PkmTwinError:
        assert found.answer == "bad"
        return
    (one,) = result.explained
    assert found.explanation in (one, None)
    if one.fault:
        assert found.answer == "bad" and found.causes[:1] in ((one.cause,), ())
        assert any(one.cause in text for text in result.accepted)
    # The give of an elastic drive steps where the load turns, as play does.
    if what != "elastic":
        assert ("play" in one.steps) == (what == "play")


@pytest.mark.parametrize("name", ["five_bar", "upr_rpu"])
def test_fit_and_check_say_that_the_machine_cannot_take_the_positions(name: str) -> None:
    m = machine(load(name), np.random.default_rng([5, *name.encode()]), 3.0)
    record = m.recorded(q=-m.q)
    with pytest.raises(PkmTwinError, match="positions of this machine"):
        fit_recordings(m.robot, [record])
    (cause,) = check(record).causes
    assert "positions of this machine" in cause


def test_friction_that_may_hold_a_payload_at_rest_does_not_lighten_it() -> None:
    """Strokes of 0.4 s, and rests as long where dry friction is larger than the payload's share."""
    robot = load("delta").changed(friction={"coulomb": [1.0] * 3}, payload={"mass": 0.0})
    time = np.arange(0.0, 8.0, 2e-3)
    stroke = np.clip(np.abs((time + 0.4) % 1.6 - 0.8) / 0.4 - 0.5, 0.0, 1.0)
    size = np.array([0.5, 0.3, -0.4])
    q = robot.inverse(robot.home()) + size * (stroke**3 * (10 - stroke * (15 - 6 * stroke)))[:, None]
    qd = np.gradient(q, time, axis=0)
    heavy = robot.changed(payload={"mass": 0.5})
    effort = inverse_dynamics(heavy, q, qd, np.gradient(qd, time, axis=0))
    effort += np.random.default_rng(1).normal(0.0, 0.02, effort.shape)
    made = Recording(robot, time, q, qd, effort=effort)
    # Within the bound it is a hint.
    told = check(made, 0.9)
    assert told.answer == "good"
    for text in (*check(made, 0.02).causes, told.hint):
        assert float(text.split()[-1]) == pytest.approx(0.5, rel=0.01)
    for gain in (0.97, 1.03):
        whole = replace(made, robot=heavy, effort=gain * made.measured)
        judged = check(whole)
        assert judged.answer == "good" and not judged.hint


def test_a_fit_is_compared_with_the_file_wherever_it_starts() -> None:
    m = machine(load("delta"), np.random.default_rng(6), 8.0, 200.0)
    light, heavy = (m.robot.changed(payload={"mass": mass}) for mass in (0.1, 0.5))
    made = noisy(m.recorded(effort=inverse_dynamics(heavy, m.q, m.qd, m.qdd)), np.random.default_rng(8))
    sizes = []
    for start in (None, Load(0.6, (0.05, 0.0, 0.02))):
        found, *_ = fit_recordings(light, [replace(made, robot=light, load=start)], ("payload",))
        (payload,) = (n for n in found.numbers if n.name == "payload.mass")
        assert payload.before == 0.1
        (judged,) = found.judged
        sizes.append(judged.rms(judged.before))
        assert (sizes[-1] > 5.0 * judged.rms(judged.after)).all()
    np.testing.assert_allclose(sizes, np.broadcast_to(sizes[1], np.shape(sizes)), rtol=0.02)


@pytest.mark.long
def test_a_payload_is_looked_for_with_the_memory_of_friction() -> None:
    """It is held throughout, though no effort tells at first what friction does."""
    robot, rng = load("five_bar"), np.random.default_rng(5)
    time = np.arange(0.0, 24.0, 0.01)
    w = 2.0 * np.pi * np.array([[0.11, 0.23, 0.31], [0.13, 0.19, 0.37]])
    turn = w * time[:, None, None] + rng.uniform(0.0, 6.0, (2, 3))
    q = robot.inverse(robot.home()) + 0.05 * np.sin(turn).sum(-1)
    motion = q, 0.05 * (w * np.cos(turn)).sum(-1), -0.05 * (w**2 * np.sin(turn)).sum(-1)
    friction = {"coulomb": [3.9, 3.8], "viscous": [0.01, 0.01]}
    file = robot.changed(friction=friction, payload={"mass": 0.0})
    truth = file.changed(friction={"presliding": [0.02, 0.02]}, payload={"mass": 1.0})
    effort = inverse_dynamics(truth, *motion) + Dahl.bounded_memory_effort(truth.friction, *motion[:2])[0]
    made = noisy(Recording(file, time, q, effort=effort), rng, 0.005, 1e6)
    found, *_ = fit_recordings(file, [made], ("friction", "payload"), ("dahl",))
    (start,) = (rows.recording.load for rows in found.problem.whole)
    assert start is not None and start.mass == pytest.approx(1.0, rel=0.02)
    (payload,) = (n for n in found.numbers if n.name == "payload.mass")
    assert abs(payload.after - 1.0) < 3.0 * payload.deviation < 0.5


def test_a_channel_that_was_not_measured_is_not_compared() -> None:
    m = machine(load("five_bar"), np.random.default_rng(5), 4.0)
    result = fit(m.robot, [m.recorded()], ("friction", "payload"))
    (one,) = result.judged
    unseen = replace(one, measured=one.measured * [np.nan, 1.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert find_worse(replace(result, judged=(unseen,))) == ""
        assert "worse" in find_worse(replace(result, judged=(replace(unseen, after=2.0 * one.after),)))
