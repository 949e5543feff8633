# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Recordings that a fit judges: sound ones, such as another machine makes, such as none makes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pytest

from delta_dynamics import inverse_dynamics, mass_matrix
from pkm_twin import Robot
from pkm_twin.errors import PkmTwinError
from pkm_twin.identification.compare import missing_samples
from pkm_twin.identification.estimation import estimate
from pkm_twin.identification.fit import Fit, fit
from pkm_twin.identification.friction_laws import fit_recordings, fit_with_laws
from pkm_twin.identification.hypotheses import explain
from pkm_twin.identification.identifiable import make_nonnegative_cone
from pkm_twin.identification.parameters import file_parameters
from pkm_twin.identification.rows import make_rows
from pkm_twin.recordings import Load, Recording
from pkm_twin.report import Verdict
from test.identification.machines import IMPOSSIBLE, WRONG, Drawn, machine, noisy, shifted, unit_of
from test.laws.test_fit import truths
from test.support.robots import load, partly_long

KINDS: Any = ("friction", "payload")
LIKELY = {
    "gain": "gain of the efforts",
    "late": "efforts late",
    "sensor": "sensor offset",
    "load_friction": "friction that grows with the load",
    "stribeck": "static friction above Coulomb friction",
    "elastic": "elastic drive",
    "lengths": "geometry",
}


@cache
def drawn(name: str, seed: int, seconds: float = 12.0) -> Drawn:
    return machine(load(name), np.random.default_rng([seed, *name.encode()]), seconds)


def recorded(what: str, name: str, seed: int) -> Recording:
    """Of a machine of the file, another one's, or nobody's."""
    m, rng = drawn(name, seed), np.random.default_rng([seed, 17])
    made = noisy(WRONG[what](m, rng) if what in WRONG else m.recorded(), rng)
    return IMPOSSIBLE[what](made, rng) if what in IMPOSSIBLE else made


def judged(what: str, name: str, seed: int) -> Fit:
    return fit(drawn(name, seed).robot, [recorded(what, name, seed)], KINDS)


def named(*findings: Any) -> set[str]:
    """Kinds of what may explain findings."""
    return {one.kind for found in findings for one in (found.suspect, *found.others)}


def worst(result: Fit, m: Drawn) -> float:
    """Greatest error of a fitted number over its standard deviation."""
    true = truths(m.truth, KINDS)
    return max(abs(n.after - true[n.name]) / n.deviation for n in result.numbers)


def fault_of(robot: Robot, record: Recording) -> str | None:
    """Why a machine cannot have made a recording."""
    found = explain(make_rows(robot, file_parameters(robot), record))
    return found.text if found.fault else None


def rejected(what: str, name: str, seed: int) -> bool:
    try:
        return fault_of(load(name), recorded(what, name, seed)) is not None
    except PkmTwinError:
        return True


@pytest.mark.parametrize("name", partly_long(["linear_delta", "delta_cu"], "linear_delta"))
def test_a_sound_recording_is_explained(name: str) -> None:
    result = judged("sound", name, 3)
    assert result.verdict.answer == "explains"
    assert not result.verdict.findings and not result.accepted
    assert worst(result, drawn(name, 3)) < 3.0


def test_a_recording_with_gaps_is_fitted_like_the_whole_one() -> None:
    """Pieces of 100 samples to some hundreds, and some that are too short."""
    m, rng = drawn("delta_cu", 3), np.random.default_rng(12)
    whole = noisy(m.recorded(), rng)
    keep = np.ones(len(whole.time), bool)
    for begin in np.cumsum([110, 30, 180, 340]):
        keep[begin : begin + 8] = False
    cut = whole.select(keep)
    (one, _, none), (other, _, (note,)) = (fit_recordings(m.robot, [record], KINDS) for record in (whole, cut))
    missing = missing_samples(cut.time)
    assert not none and missing.verdict is Verdict.BAD
    assert missing.value == "32 of 1200 (2.67 %)" and missing.value in note
    assert other.verdict.answer == "explains" and worst(other, m) < 4.0
    for n, k in zip(one.numbers, other.numbers, strict=True):
        assert k.deviation < 4.0 * n.deviation or n.status != "fitted"


@pytest.mark.parametrize(
    "what", partly_long(["time_reversed", "milliseconds", "efforts_late"], "time_reversed", "milliseconds")
)
def test_what_no_machine_of_the_file_makes_is_rejected(what: str) -> None:
    assert rejected(what, "linear_delta", 4)


@pytest.mark.parametrize("name", partly_long(["delta_cu", "prru", "five_bar"], "delta_cu"))
def test_a_payload_that_is_on_the_platform_for_a_while_is_named(name: str) -> None:
    """No other positions or times are the cause, though some samples say nothing of a payload."""
    m = drawn(name, 4)
    bare = m.truth.changed(payload={"mass": 0.0, "inertia": [0.0, 0.0, 0.0]})
    held = (m.time > 5.0) & (m.time < 9.0)
    efforts = np.where(held[:, None], m.efforts, inverse_dynamics(bare, m.q, m.qd, m.qdd))
    record = noisy(m.recorded(effort=efforts), np.random.default_rng(7))
    fault = fault_of(m.robot, record)
    assert fault is not None and fault.startswith("a payload of ")
    edges = fault.rpartition(" ")[2].split(",")
    assert tuple(map(float, edges)) == pytest.approx((5.0, 9.0), abs=0.2)


def test_a_known_payload_that_the_efforts_do_not_show_is_rejected() -> None:
    """Also where time in another unit would ask for efforts beyond any number."""
    m = drawn("delta_cu", 3, 6.0)
    record = replace(noisy(m.recorded(), np.random.default_rng(7)), load=Load(20.0))
    assert fault_of(m.robot, record) is not None


@pytest.mark.parametrize(("who", "late"), [pytest.param([0, 1, 2], 0.06, marks=pytest.mark.long), ([0], 0.04)])
def test_a_short_delay_is_named_by_its_length(who: list[int], late: float) -> None:
    """Up to 50 ms the efforts of all joints may be late."""
    m = drawn("delta_cu", 4)
    efforts = m.efforts.copy()
    efforts[:, who] = shifted(m.efforts, m.time, late)[:, who]
    record = noisy(m.recorded(effort=efforts), np.random.default_rng(7))
    fault = fault_of(m.robot, record)
    names = "all joints" if len(who) > 1 else m.robot.joint_names[0]
    assert fault is not None and fault.startswith(f"efforts of {names} are {late:g} s late")


@pytest.mark.parametrize("wrong_way", partly_long([False, True], False))
def test_a_cause_that_does_not_explain_the_efforts_is_not_named(wrong_way: bool) -> None:
    """A force that is not recorded looks like a payload that comes and goes; so does one that is
    recorded backwards, which is named.
    """
    m = drawn("delta_cu", 4, 6.0)
    force = np.zeros((len(m.time), 6))
    force[:, 2] = -5.0 * np.sin(2.0 * np.pi * 0.7 * m.time)
    efforts = inverse_dynamics(m.truth, m.q, m.qd, m.qdd, force)
    made = replace(m.recorded(effort=efforts), wrench=-force if wrong_way else None)
    fault = fault_of(m.robot, noisy(made, np.random.default_rng(7)))
    named = "the wrench has the opposite sign" if wrong_way else "no machine like the file's "
    assert fault is not None and fault.startswith(named)


@pytest.mark.long
def test_half_its_speed_is_rejected_though_weight_makes_up_the_efforts() -> None:
    assert rejected("half_speed", "prru", 5)


@pytest.mark.long
@pytest.mark.parametrize("name", ["delta", "prru", "rps3", "upr_rpu", "linear_delta"])
@pytest.mark.parametrize("what", IMPOSSIBLE)
def test_others_are_rejected_too(what: str, name: str) -> None:
    assert rejected(what, name, 5)


@pytest.mark.parametrize("what", partly_long(["gains", "sensors", "lengths"], "lengths"))
def test_another_machine_of_the_file_s_kind_is_not_rejected(what: str) -> None:
    assert not rejected(what, "linear_delta", 4)


WRONG_WAY = partly_long(product(["five_bar", "prru", "rps3"], [True, False], [1.0, -1.0]), ("prru", False, -1.0))


@pytest.mark.parametrize("case", WRONG_WAY)
def test_a_drive_that_counts_the_wrong_way_is_named(case: tuple[str, bool, float]) -> None:
    """Its positions are mirrored where it was homed, or anywhere: no fault of units or times."""
    name, homed, way = case
    m = machine(load(name), np.random.default_rng(6), 6.0)
    sound = noisy(m.recorded(), np.random.default_rng(7))
    q, effort = sound.q.copy(), sound.effort.copy()
    middle = m.robot.graph.home[-1] if homed else q[:, -1].mean() + 0.01 * m.robot.size
    q[:, -1] = 2.0 * middle - q[:, -1]
    effort[:, -1] *= way
    record = replace(sound, q=q, effort=effort)
    fault = fault_of(m.robot, record)
    both = "positions and efforts of" if way < 0.0 else "positions of"
    assert fault is not None and fault.startswith(f"{both} {m.robot.joint_names[-1]} ")


RATES = partly_long(
    product(["prru", "linear_delta", "upr_rpu", "five_bar"], [0.5, 2.0], [2.0, 4.0, 8.0, 16.0]),
    ("prru", 0.5, 2.0),
    ("upr_rpu", 2.0, 4.0),
)


@pytest.mark.parametrize("case", RATES)
def test_another_rate_of_time_is_rejected_said_or_within_the_deviations(case: tuple[str, float, float]) -> None:
    """Also of motions so slow that weight and friction make nearly all of the efforts."""
    name, rate, factor = case
    m = drawn(name, 6)
    slow = Drawn(
        m.robot,
        m.truth,
        factor * m.time,
        m.q,
        m.qd / factor,
        m.qdd / factor**2,
        inverse_dynamics(m.truth, m.q, m.qd / factor, m.qdd / factor**2),
    )
    sound = noisy(slow.recorded(), np.random.default_rng(7))
    assert fit(m.robot, [sound], KINDS).accepted == ()
    try:
        result = fit(m.robot, [replace(sound, time=rate * sound.time)], KINDS)
    except PkmTwinError:
        return
    assert result.verdict.answer != "explains" or worst(result, slow) < 4.0


@pytest.mark.long
@pytest.mark.parametrize("share", [1.0, 3.0])
@pytest.mark.parametrize("name", ["delta_cu", "prru", "upr_rpu"])
def test_rotors_that_the_file_does_not_have_are_no_other_rate_of_time(name: str, share: float) -> None:
    m = drawn(name, 6)
    home = m.robot.graph.home
    rotors = share * float(np.diag(mass_matrix(m.robot, home)).max()) * m.qdd
    record = noisy(m.recorded(effort=m.efforts + rotors), np.random.default_rng(7))
    assert fault_of(m.robot, record) is None


@pytest.mark.parametrize(
    "what",
    partly_long(LIKELY, "load_friction", "stribeck", "lengths"),
)
def test_what_the_model_leaves_out_is_found(what: str) -> None:
    result = judged(what, "delta_cu", 2)
    assert result.verdict.answer != "explains"
    assert LIKELY[what] in named(*result.verdict.findings)
    for finding in result.verdict.findings:
        assert finding.sigmas <= 1.001 * abs(finding.size) / finding.deviation
    assert result.verdict.deviations in ("widened", "withheld")


ELASTIC = [
    ("delta_cu", 0.01, 0.0),
    ("five_bar", 0.01, 0.0),
    ("linear_delta", 0.01, 0.0),
    ("five_bar", 0.0, 3e-3),
    ("delta_cu", 0.0, 3e-3),
    ("linear_delta", 0.0, 3e-3),
    ("delta_cu", -5e-3, 0.0),
]
"""How far drives give, rad or parts of the machine's size, and how late their efforts are, s."""


@pytest.mark.parametrize("case", partly_long(ELASTIC, ELASTIC[1], ELASTIC[6]))
def test_an_elastic_drive_is_one_explanation_of_a_delay(case: tuple[str, float, float]) -> None:
    """Efforts that are late are no elastic drive, nor is one of negative compliance."""
    name, give, late = case
    m = drawn(name, 2)
    given = give * unit_of(m.robot) / np.abs(m.efforts).max(0) * m.efforts
    record = m.recorded(q=m.q + given, effort=shifted(m.efforts, m.time, late))
    noise = np.random.default_rng(3)
    verdict = fit(m.robot, [noisy(record, noise)], KINDS, accept=give < 0.0).verdict
    assert verdict.answer != "explains" or give >= 0.0
    assert ("elastic drive" in named(*verdict.findings, *verdict.hints)) == (give > 0.0)


ERRONEOUS = partly_long(
    product(WRONG, ["delta", "five_bar", "linear_delta", "prru", "upr_rpu"]),
    ("sensors", "five_bar"),
    ("gains", "upr_rpu"),
)


@pytest.mark.parametrize("case", ERRONEOUS)
def test_it_is_found_or_within_the_standard_deviations(case: tuple[str, str]) -> None:
    what, name = case
    result = judged(what, name, 3)
    assert result.verdict.answer != "explains" or worst(result, drawn(name, 3)) < 4.0


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("delta_cu", "delta"),
        *(pytest.param(*pair, marks=pytest.mark.long) for pair in (("delta", "delta_cu"), ("delta_cu", "rps3"))),
    ],
)
@pytest.mark.parametrize(("duration", "rate"), [(1.2, 300.0), pytest.param(4.0, 100.0, marks=pytest.mark.long)])
def test_another_machine_is_rejected_or_not_explained(name: str, other: str, duration: float, rate: float) -> None:
    m = machine(load(other), np.random.default_rng(3), duration, rate)
    rng = np.random.default_rng(4)
    try:
        result, _ = fit_with_laws(load(name), [noisy(m.recorded(), rng)])
    except PkmTwinError:
        return
    assert result.verdict.answer == "does not explain"


def test_too_few_samples_for_the_numbers_are_rejected() -> None:
    m, rng = (
        machine(load("delta_cu"), np.random.default_rng(3), 0.8, 300.0),
        np.random.default_rng(4),
    )
    with pytest.raises(PkmTwinError, match="too few samples"):
        fit(m.robot, [noisy(m.recorded(), rng)])


def test_what_is_accepted_is_marked() -> None:
    m, rng = drawn("five_bar", 4, 6.0), np.random.default_rng([4, 17])
    record = IMPOSSIBLE["newton_millimetres"](noisy(m.recorded(), rng), rng)
    assert "(N mm or mN m?)" in (fault_of(m.robot, record) or "")
    with pytest.raises(PkmTwinError, match=r"N mm.*--accept"):
        fit(m.robot, [record], KINDS)
    result = fit(m.robot, [record], KINDS, accept=True)
    assert len(result.accepted) == 1
    assert result.verdict.deviations == "withheld"
    assert all(np.isnan(n.deviation) for n in result.numbers if n.status != "not excited")


@pytest.mark.parametrize("name", partly_long(["delta_cu", "stewart"], "delta_cu"))
def test_scaled_efforts_are_rejected_and_heavier_machines_are_not(name: str) -> None:
    """Friction tells them apart; a file without any does not."""
    m = drawn(name, 3)
    rubs = {key: getattr(m.truth.friction, key).tolist() for key in ("viscous", "coulomb")}
    robot, bare = (m.robot.changed(friction=one) for one in (rubs, {"viscous": 0.0, "coulomb": 0}))
    kg = {p: 1.5 * v for p, (v, unit) in robot.file_numbers().items() if unit in ("kg", "kg m2")}
    heavy = robot.numbered({p: v for p, v in kg.items() if "rotor" not in p})
    rng = np.random.default_rng(8)
    sound, heavier = (noisy(m.recorded(effort=inverse_dynamics(one, m.q, m.qd, m.qdd)), rng) for one in (robot, heavy))
    scaled = replace(sound, effort=1.5 * sound.effort)
    for one, told in ((robot, r" N m and N"), (bare, "cannot tell"))[: 2 if "cu" in name else 1]:
        with pytest.raises(PkmTwinError, match=rf"are 1\.5\d* times .*{told}; --accept"):
            fit(one, [scaled])
    assert not fit(robot, [heavier]).accepted


def test_a_bound_that_is_active_counts_in_the_standard_deviations() -> None:
    """Of two columns with a common part the noise, which is slow, hides the one that is bounded.

    The data know the other column well, but a fit that takes noise for white moves it with the
    first one as far as the bound moves that.
    """
    rng, k = np.random.default_rng(8), np.arange(4000) / 4000.0
    slow = np.sin(2.0 * np.pi * k)
    errors, deviations = [], []
    for _ in range(60):
        table = np.stack([slow, slow + rng.normal(size=4000)], -1)[:, None]
        drift = np.cumsum(rng.normal(size=4000))
        target = table @ [0.0, 1.0] + 0.02 * (drift - drift.mean())[:, None]
        cones = [(slice(0, 1), make_nonnegative_cone(0, 1))]
        found = estimate(table, target, np.ones(2), np.ones(2), cones)
        assert found.values[0] >= 0.0
        if found.bound:
            assert found.bound == ((0,),)
            errors.append(found.values - [0.0, 1.0])
            deviations.append(np.sqrt(np.diag(found.covariance)))
    assert len(errors) > 20
    assert np.mean(np.abs(errors) < 3.0 * np.array(deviations)) >= 0.95


def test_efforts_of_zero_leave_nothing_to_fit():
    """Without an error of the numbers, too."""
    with np.errstate(all="raise", under="ignore"):
        found = estimate(np.ones((50, 1, 1)), np.zeros((50, 1)), np.zeros(1), np.ones(1))
    assert found.values == 0.0 and np.isfinite(found.covariance).all()
