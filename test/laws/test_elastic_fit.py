# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Fits of loads and deflections: close to the truth, honest about the rest."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pkm_twin.errors import PkmTwinError
from pkm_twin.identification.deflections import fit_elements
from pkm_twin.identification.parameters import group_elements
from stiffness_monitor.response import element_response
from test.laws.deflections import SENSORS, frame_recording, noisy, twin_recording
from test.support.robots import load

ROBOT = load("upr_rpu")
NAMES = ROBOT.element_names
TRUTH = dict(zip(NAMES, (1.3, 0.9, 2.0, 0.8, 1.1, 1.0, 1.6, 1.0, 3.0), strict=True))
"""Of a machine whose file has 1 everywhere."""
ENGINES = (
    twin_recording,
    pytest.param(lambda factors: frame_recording(tuple(factors.items())), marks=pytest.mark.long, id="frame"),
)
"""The twin itself, and the independent one."""


def within(result, true, sigmas=3.0):
    """Whether every true factor is as near as the fit says."""
    return all(abs(n.after - true[n.key[-1]]) <= sigmas * n.deviation for n in result.numbers)


@pytest.mark.parametrize("engine", ENGINES)
def test_clean_deflections_give_every_element(engine):
    result = fit_elements(ROBOT, [engine(TRUTH)])
    assert [n.key[-1] for n in result.numbers] == list(NAMES)
    for number in result.numbers:
        assert number.status == "fitted"
        assert number.after == pytest.approx(TRUTH[number.key[-1]], rel=1e-6)
    assert not result.groups
    (judged,) = result.judged
    assert (judged.rms(judged.after) < 1e-6 * judged.rms(judged.before)).all()


def test_a_fit_begins_at_the_files_own_factors():
    known = ROBOT.changed(element_compliance={"3U": 2.5, "1B": 1.2})
    numbers = {n.key[-1]: n for n in fit_elements(known, [twin_recording(TRUTH)]).numbers}
    assert numbers["3U"].before == 2.5
    assert numbers["3U"].after == pytest.approx(3.0, rel=1e-6)
    assert numbers["1B"].after == pytest.approx(0.9, rel=1e-6)


def test_an_instruments_zero_is_found_and_a_direction_may_be_missing():
    clean = twin_recording(TRUTH)
    zero = np.array([5e-6, -3e-6, 8e-6, 0.0, 0.0, 0.0])
    partial = clean.deflection + zero
    partial[:, 3:] = np.nan
    recording = dataclasses.replace(clean, deflection=partial)
    result = fit_elements(ROBOT, [clean, recording])
    np.testing.assert_allclose(result.zeros[1, :3], zero[:3], atol=1e-12)
    assert result.measured.tolist() == [[True] * 6, [True] * 3 + [False] * 3]
    for number in result.numbers:
        assert number.after == pytest.approx(TRUTH[number.key[-1]], rel=1e-6)
    both = [noisy(one, np.random.default_rng(k), SENSORS) for k, one in enumerate((clean, recording))]
    result = fit_elements(ROBOT, both)
    np.testing.assert_allclose(result.zeros[1, :3], zero[:3], atol=5e-8)
    assert within(result, TRUTH)
    # Nor is it so sure of nothing that all is within.
    assert max(n.deviation for n in result.numbers if n.key[-1].endswith("B")) < 0.025


def test_what_noise_hides_is_named_as_a_combination():
    recording = noisy(twin_recording(TRUTH), np.random.default_rng(1), SENSORS)
    result = fit_elements(ROBOT, [recording])
    status = {n.key[-1]: n.status for n in result.numbers}
    assert {status[name] for name in ("1B", "2B", "3B")} == {"fitted"}
    assert {status[name] for name in ("1R", "2R", "3R")} == {"combination"}
    told = {group.elements: group.known for group in result.groups}
    assert set(told) == {("1R", "1U"), ("2R", "2U"), ("3R", "3U")}
    for known in told.values():
        for one in known:
            truth = sum(w * TRUTH[name] for name, w in one.weights.items())
            assert abs(one.value - truth) < 4.0 * one.deviation


def test_elements_in_series_that_always_share_a_load_are_one_group():
    covariance = np.diag([1e-4, 1.0, 1e-4, 1.0])
    turned = np.eye(4)
    turned[:2, :2] = turned[2:, 2:] = np.sqrt(0.5) * np.array([[1.0, 1.0], [1.0, -1.0]])
    groups = group_elements(tuple("abcd"), np.array([1.0, 2.0, 3.0, 4.0]), turned @ covariance @ turned)
    assert [group.elements for group in groups] == [("a", "b"), ("c", "d")]
    (first,) = groups[0].known
    assert first.weights == pytest.approx({"a": np.sqrt(0.5), "b": np.sqrt(0.5)})
    assert first.value == pytest.approx(3.0 * np.sqrt(0.5))
    assert first.deviation == pytest.approx(1e-2)


def cut(**changes):
    return dataclasses.replace(twin_recording(TRUTH), **changes)


def test_what_cannot_work_is_refused_by_name():
    clean = twin_recording(TRUTH)
    few = cut(**{k: getattr(clean, k)[:8] for k in ("time", "q", "wrench", "deflection")})
    one = np.outer(np.linspace(1.0, 2.0, len(clean.time)), clean.wrench[75])
    still = np.broadcast_to(clean.q[75], clean.q.shape)
    response = element_response(ROBOT, ROBOT.forward(clean.q[75]))
    moved, _ = response.deflection(one, np.ones(9))
    delta, noise = clean.deflection, np.random.default_rng(4).normal(size=(40, 6))
    some = {k: getattr(clean, k)[::10] for k in ("time", "q", "wrench")}
    for recording, text in (
        (few, "too short to fit, 8 deflections"),
        (cut(deflection=np.full_like(clean.deflection, np.nan)), "too short to fit, 0 deflections"),
        (cut(wrench=np.zeros_like(clean.wrench)), "no load"),
        (cut(q=still, wrench=one, deflection=moved), "one load direction in one pose"),
        (cut(deflection=1e3 * delta), "units. m and rad"),
        (cut(wrench=1e-3 * clean.wrench), "units. m and rad"),
        (cut(deflection=-delta), "against its loads"),
        (cut(deflection=0.0 * delta + 1e-4), "no deflection, every one is the same"),
        (cut(**some, deflection=1e-6 * noise), "no compliance of this robot explains"),
    ):
        with pytest.raises(PkmTwinError, match=text):
            fit_elements(ROBOT, [recording])


def coverage(count, engine=twin_recording):
    """In how many of so many noisy fits every true value is within three deviations."""
    clean = engine(TRUTH)
    return sum(
        within(fit_elements(ROBOT, [noisy(clean, np.random.default_rng(seed), SENSORS)]), TRUTH)
        for seed in range(count)
    )


def test_true_values_are_within_three_deviations_in_most_noisy_fits():
    assert coverage(5) == 5


@pytest.mark.long
@pytest.mark.parametrize("engine", ENGINES)
def test_true_values_are_within_three_deviations_in_95_of_100_noisy_fits(engine):
    assert coverage(100, engine) >= 95
