# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Friction laws, torque constants and lines in the spectra of recordings; sweeps that show friction."""

from dataclasses import replace

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics
from pkm_twin.errors import ParameterError, PkmTwinError, UnknownNameError
from pkm_twin.identification.drives import fit_constants, parse_constants
from pkm_twin.identification.excitation import Judge, TrajectoryLimits, design_sweeps
from pkm_twin.identification.fit import fit
from pkm_twin.identification.friction_laws import fit_with_laws, parse_laws
from pkm_twin.identification.hypotheses import explain_recording
from pkm_twin.identification.parameters import file_parameters
from pkm_twin.identification.samples import Filtering, find_lines
from pkm_twin.recordings import Recording
from pkm_twin.recordings.payload import Load
from test.identification.machines import machine, noisy
from test.support.robots import load, often, partly_long

CASES = [
    f"{name} {law}"
    for name in ("five_bar", "delta_cu", "linear_delta")
    for law in ("none", "stribeck", "load-dependent", "periodic")
]


def rubbing(m, law):
    """The machine with a law beside its friction, of a size that matters."""
    n, coulomb = len(m.size), m.truth.friction.coulomb
    speed, travel = np.sqrt(np.mean(m.qd**2, 0)), np.ptp(m.q, axis=0)
    laws = {
        "none": {},
        "stribeck": {"stribeck": 1.5 * coulomb, "stribeck_speed": 0.15 * speed},
        "load-dependent": {"load_dependent": np.full(n, 0.1)},
        "periodic": {
            "cogging_cos": 0.05 * m.size,
            "cogging_sin": -0.03 * m.size,
            "cogging_period": travel / 7.3,
        },
    }
    values = {key: value.tolist() for key, value in laws[law].items()}
    return m.truth.changed(friction=values), values


@pytest.mark.parametrize("case", partly_long(CASES, "five_bar load-dependent"))
def test_the_law_of_a_drive_is_found_by_what_was_held_out(case):
    pytest.importorskip("cvxpy")
    name, law = case.split()
    rng = np.random.default_rng([7, *name.encode()])
    m = machine(load(name), rng, 8.0 if name == "five_bar" else 16.0)
    truth, values = rubbing(m, law)
    effort = inverse_dynamics(truth, m.q, m.qd, m.qdd)
    record = noisy(m.recorded(effort=effort), rng, 0.005)
    result, choices = fit_with_laws(m.robot, [record], ("friction", "payload"))
    taken = [one.law for one in choices if one.taken]
    assert taken == ([] if law == "none" else [law])
    assert result.verdict.answer == "explains"
    for one in choices:
        assert not one.taken or (one.sigmas > 4.5 and one.after < one.before)
    found = {key: [] for key in values}
    for number in result.numbers:
        for key in found:
            if key in number.key:
                found[key].append((number.after, number.deviation))
    for key, rows in found.items():
        value, deviation = np.array(rows).T
        assert (np.abs(value - values[key]) < 4.0 * deviation + 0.05 * np.abs(values[key])).all()


def test_a_large_cogging_torque_is_a_cause_and_no_fault():
    rng = np.random.default_rng(8)
    m = machine(load("five_bar"), rng, 8.0)
    truth, _ = rubbing(m, "periodic")
    effort = inverse_dynamics(truth, m.q, m.qd, m.qdd)
    found = explain_recording(m.robot, noisy(m.recorded(effort=effort), rng, 0.005))
    assert "--friction periodic" in found.text and not found.fault
    assert found.considered[0][1] > 0.99


def test_laws_are_tried_with_a_known_payload():
    rng = np.random.default_rng(3)
    m = machine(load("five_bar"), rng, 8.0)
    truth, _ = rubbing(m, "load-dependent")
    payload = Load(0.4, (0.0, 0.0, 0.0))
    effort = inverse_dynamics(payload.apply_to(truth), m.q, m.qd, m.qdd)
    record = replace(m.recorded(effort=effort), load=payload)
    _, choices = fit_with_laws(m.robot, [noisy(record, rng, 0.005)], ("friction",))
    assert [one.law for one in choices if one.taken] == ["load-dependent"]


def test_names_of_laws():
    assert parse_laws("auto") is None
    assert parse_laws("coulomb") == ()
    assert parse_laws("load-dependent, stribeck") == ("stribeck", "load-dependent")
    with pytest.raises(UnknownNameError):
        parse_laws("stribek")


@pytest.mark.parametrize("name", partly_long(["delta_cu", "five_bar", "prru"], "five_bar"))
def test_torque_constants_follow_from_known_masses(name, rng):
    m = machine(load(name), rng)
    robot = m.truth
    constants = rng.uniform(0.05, 2.0, len(m.size)) * rng.choice([-1.0, 1.0], len(m.size))
    effort = inverse_dynamics(robot, m.q, m.qd, m.qdd)
    record = noisy(m.recorded(effort=effort / constants), rng)
    found = fit_constants(robot, [record])
    assert (np.abs(found.values - constants) < 4.0 * found.deviations).all()
    assert (found.deviations < 0.02 * np.abs(constants)).all()
    words = ",".join(str(value) for value in constants)
    given = parse_constants(robot, words).convert(record)
    assert np.allclose(given.effort, record.effort * constants, rtol=1e-12)
    noise = rng.normal(size=effort.shape)
    with pytest.raises(PkmTwinError):
        fit_constants(robot, [m.recorded(effort=noise)])
    for wrong in ("0", "nan", "a", "1,2,3,4,5,6,7"):
        with pytest.raises(ParameterError):
            parse_constants(robot, wrong)


def test_a_line_is_found_with_its_frequency_and_no_other(rng):
    from scipy.signal import lfilter

    period, how = 1e-3, Filtering(7, (1e-6, 1e-6), 15.0, 10)
    count = 12000
    for _ in range(20):
        noise = rng.normal(size=(count, 2)) * [0.1, 0.02]
        assert find_lines([noise], period, how, np.ones(2)) == ()
    damping = 0.02
    for frequency in (62.0, 140.0):
        # A lightly damped oscillator that noise excites.
        turn = 2.0 * np.pi * frequency * period
        radius, ring = np.exp(-damping * turn), np.zeros((count, 2))
        poles = [1.0, -2.0 * radius * np.cos(turn), radius**2]
        ring[:, 1] = lfilter([1.0], poles, rng.normal(size=count))
        ring *= 0.02 / ring[:, 1].std()
        noise = rng.normal(size=(count, 2)) * [0.1, 0.02]
        (found,) = find_lines([noise + ring], period, how, np.ones(2))
        assert found.joint == 1
        assert abs(found.frequency - frequency) < 3.0
        assert found.rms == pytest.approx(0.02, rel=0.4)
        # What is nothing beside the efforts is rounding.
        assert find_lines([noise + ring], period, how, np.full(2, 100.0)) == ()


@pytest.mark.parametrize("name", ["five_bar", "delta_cu"])
def test_sweeps_stay_inside_the_limits_and_move_one_joint_at_a_time(name):
    robot = load(name)
    judge = Judge.from_robot(robot, file_parameters(robot, ("friction",)))
    found = design_sweeps(judge, 60.0, TrajectoryLimits(share=1.0))
    time = np.linspace(0.0, found.duration, 20001)
    q, qd, qdd = found.at(time)
    step = time[1]
    assert np.abs(np.gradient(q, step, axis=0) - qd).max() < 0.02 * np.abs(qd).max()
    assert np.abs(np.gradient(qd, step, axis=0) - qdd).max() < 0.2 * np.abs(qdd).max()
    assert np.abs(q[[0, -1]] - found.centre).max() < 1e-9 and np.abs(qd[[0, -1]]).max() < 1e-9
    assert ((np.abs(qd) > 0.0).sum(1) <= 1).all()
    low, high = robot.limits.position.T
    assert (q >= low - 1e-12).all() and (q <= high + 1e-12).all()
    assert (np.abs(qd) <= robot.limits.velocity * (1.0 + 1e-12)).all()
    assert (robot.singularity(q[::50]) > TrajectoryLimits().singularity * 0.99).all()
    assert np.isfinite(found.condition)
    for least in (0.05, 1.0):
        slow = design_sweeps(judge, 60.0, TrajectoryLimits(share=1.0, acceleration=least * np.abs(qdd).max()))
        change = slow.at(np.linspace(0.0, slow.duration, 40001))[2]
        assert np.abs(change).max() <= least * np.abs(qdd).max() * (1.0 + 1e-9)
    # Both ways, at three speeds each.
    for j, row in enumerate(found.speeds):
        for speed in row:
            for way in (1.0, -1.0):
                assert (np.abs(qd[:, j] - way * speed) < 1e-9 * speed).any()
    for third in np.array_split(qd, 3):
        assert (np.abs(third) > 0.0).any(0).all()


@pytest.mark.parametrize("name", partly_long(["delta", "five_bar", "upr_rpu"], "delta"))
@pytest.mark.parametrize("seeds", often(2, 6))
def test_sweeps_alone_show_the_friction_of_every_joint(name, seeds):
    """Fast ones, too, whose ramps a coarse encoder smooths: errors are as large as they say."""
    robot, errors, away = load(name), [], []
    found = design_sweeps(
        Judge.from_robot(robot, file_parameters(robot, ("friction",))), 20.0, TrajectoryLimits(rate=200.0)
    )
    time = np.arange(0.0, found.duration, 0.005)
    motion = found.at(time)
    size = np.abs(inverse_dynamics(robot, *motion)).max(0)
    fastest = np.abs(motion[1]).max(0)
    for seed in range(seeds):
        rng = np.random.default_rng([seed, *name.encode()])
        viscous, coulomb = rng.uniform([[0.05], [0.05]], [[0.5], [0.3]], (2, len(size)))
        friction = {"viscous": viscous * size / fastest, "coulomb": coulomb * size}
        truth = robot.changed(friction={key: value.tolist() for key, value in friction.items()})
        effort = inverse_dynamics(truth, *motion)
        record = noisy(Recording(robot, time, motion[0], effort=effort), rng, 0.01, 1e4)
        assert record.jump_description == ""
        numbers = fit(robot, [record], ("friction",)).numbers
        for key, values in friction.items():
            own = [one for one in numbers if key in one.name][: len(values)]
            after, deviations = np.array([(one.after, one.deviation) for one in own]).T
            errors.append(np.abs(after / values - 1.0))
            away.append((after - values) / deviations)
    assert np.median(errors) < 0.1 and np.sqrt(np.mean(np.square(away))) < 1.5
