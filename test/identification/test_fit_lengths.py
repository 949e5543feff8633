# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Lengths that a fit takes for certain: their derivatives, their sizes, slow motions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from delta_dynamics import inverse_dynamics
from pkm_twin import Robot
from pkm_twin.codegen.arrays import Array
from pkm_twin.identification.columns import PRIOR_DEVIATIONS, Lengths
from pkm_twin.identification.fit import fit
from pkm_twin.identification.parameters import file_parameters
from pkm_twin.identification.rows import make_rows
from pkm_twin.identification.samples import differentiate
from pkm_twin.identification.verdict import GEOMETRY
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.recordings import Load, Recording
from test.identification.machines import machine, noisy, of_prior
from test.laws.test_fit import truths
from test.machine.random_machines import variant
from test.support.robots import load, partly_long, unsure

KINDS: Any = ("friction", "payload")


def robot_named(name: str) -> Robot:
    """A shipped robot, or one of random dimensions."""
    kind, _, what = name.partition(" ")
    if kind != "random":
        return load(name)
    return robot_of_data(variant(what, np.random.default_rng(len(what))), what)


@pytest.mark.parametrize(
    "name",
    partly_long(
        ["delta_cu", "linear_delta", "prru", "upr_rpu", "delta", "stewart", "random five_bar", "random rsur"],
        "delta_cu",
    ),
)
def test_columns_are_differences_of_the_efforts(name: str) -> None:
    """Of the machine as fitted, with the payload while it is held."""
    robot = robot_named(name)
    m = machine(robot, np.random.default_rng(3), 6.0)
    load = Load(0.4, times=((3.0, 6.0),), sought=True)
    record = replace(noisy(m.recorded(), np.random.default_rng(4)), load=load)
    everything = file_parameters(robot)
    rows = make_rows(robot, everything, record)
    heavy = robot.changed(payload={"mass": 0.4})
    none = robot.changed(payload={"mass": 0.0, "inertia": [0.0, 0.0, 0.0]})
    values = file_parameters(heavy).values
    lengths = Lengths.from_robot(robot)
    found = lengths.columns(rows, values)
    size = np.abs(inverse_dynamics(robot, *rows.signals.motion.joints)).max() / robot.graph.size
    tried = 0
    for k in np.random.default_rng(5).permutation(len(lengths.paths))[:8]:
        (where,) = np.flatnonzero(lengths.mixing[:, k])
        path = lengths.paths[where]
        step = 1e-5 * robot.graph.size
        sides = []
        try:
            for one in (heavy, none):
                pair = [one.with_file_values({path: one.number(path) + h}) for h in (-step, step)]
                low, high = (inverse_dynamics(other, *rows.signals.motion.joints) for other in pair)
                sides.append((high - low) / (2.0 * step))
        except ValueError:
            continue  # a closure that only this number's own value meets
        loaded = rows.signals.motion.payload_fraction[:, None]
        expected = loaded * sides[0] + (1.0 - loaded) * sides[1]
        np.testing.assert_allclose(found[..., k], expected, rtol=0, atol=1e-4 * size)
        tried += 1
    assert tried >= min(3, len(lengths.paths))


@pytest.mark.parametrize("order", [1, 2])
def test_a_sine_is_differentiated_to_its_ends(order: int) -> None:
    time = np.arange(200) / 100.0
    rates = 2.0 * np.pi * np.array([0.5, 1.0, 3.0])
    phases = np.outer(time, rates) + np.array([0.3, 1.0, 2.0])
    exact = rates**order * np.sin(phases + order * np.pi / 2.0)
    found = differentiate(np.sin(phases), order, time[1])
    assert np.abs(found - exact).max() < 0.05 * rates.max() ** order
    assert np.abs(found - exact)[3:-3].max() < 1e-3 * rates.max() ** order


@pytest.mark.parametrize("name", partly_long(["linear_delta", "delta_cu", "five_bar"], "linear_delta", "five_bar"))
def test_drawn_lengths_change_the_efforts_as_their_columns_say(name: str) -> None:
    """At every row, those at the ends of the recording too."""
    robot, rng = load(name), np.random.default_rng(8)
    m = machine(robot, rng, 4.0, 1000.0)
    everything = file_parameters(robot)
    rows = make_rows(robot, everything, noisy(m.recorded(), rng))
    lengths = Lengths.from_robot(robot)
    columns = lengths.columns(rows, everything.values)
    motion = [CubicSpline(m.time, values)(rows.time) for values in (m.q, m.qd, m.qdd)]
    here = inverse_dynamics(robot, *motion)
    for _ in range(5):
        sizes = 0.02 * rng.normal(size=columns.shape[-1])
        sizes *= [one.usual or 0.0 for one in lengths.suspects]
        changes = dict(zip(lengths.paths, lengths.mixing @ sizes, strict=True))
        other = robot.numbered({p: robot.number(p) + change for p, change in changes.items()})
        change = inverse_dynamics(other, *motion) - here
        apart = np.abs(columns @ sizes - change)
        assert apart.max() < 0.02 * np.abs(change).max()


def test_the_file_says_how_well_its_lengths_are_known() -> None:
    robot = load("delta_cu")
    usual = {one.where: one.usual for one in Lengths.from_robot(robot).suspects}
    assert usual["geometry.arm_length"] == PRIOR_DEVIATIONS[GEOMETRY] * robot.graph.size
    own = unsure(robot, {"geometry.arm_length": {"deviation": 1e-4}, "inertia": {"relative": 0.1}})
    usual = {one.where: one.usual for one in Lengths.from_robot(own).suspects}
    assert usual["geometry.arm_length"] == 1e-4
    assert usual["geometry.forearm_length"] == PRIOR_DEVIATIONS[GEOMETRY] * robot.graph.size
    all_in_one = Lengths.from_robot(unsure(robot, {"geometry": {"relative": 1e-3}}))
    assert len(all_in_one.suspects) == 1
    assert all_in_one.mixing[all_in_one.paths.index("geometry.arm_length"), 0] == robot.number("geometry.arm_length")


def test_lengths_that_are_known_better_make_a_payload_known_better() -> None:
    robot = load("linear_delta")
    record = noisy(machine(robot, np.random.default_rng(1)).recorded(), np.random.default_rng(2))
    sure = {"joints": {"relative": 1e-6}, "rods": {"relative": 1e-6}}
    wide, narrow = (
        next(n for n in fit(one, [record], KINDS).numbers if n.name == "payload.mass")
        for one in (robot, unsure(robot, sure))
    )
    assert abs(wide.after - narrow.after) < 3.0 * wide.deviation
    assert narrow.deviation < 0.7 * wide.deviation


def errors_of(name: str, runs: range) -> tuple[Array, Array]:
    """Of machines with lengths of the prior: errors over standard deviations of all numbers.

    And the standard deviation of the payload over its mass.
    """
    errors, parts = [], []
    for seed in runs:
        rng = np.random.default_rng([seed, *name.encode()])
        m = of_prior(load(name), rng)
        true = truths(m.truth, KINDS)
        for n in fit(m.robot, [noisy(m.recorded(), rng)], KINDS).numbers:
            if n.status != "not excited" and np.isfinite(n.deviation):
                errors.append((n.after - true[n.name]) / n.deviation)
            if n.name == "payload.mass":
                parts.append(n.deviation / true[n.name])
    return np.array(errors), np.array(parts)


@pytest.mark.parametrize(
    ("name", "runs"),
    [
        ("delta", range(2)),
        *(
            pytest.param(name, range(200), marks=[pytest.mark.long, pytest.mark.timeout(3600)])
            for name in ("delta", "linear_delta", "five_bar")
        ),
    ],
)
def test_numbers_of_machines_with_usual_lengths_are_as_sure_as_they_are_said(name: str, runs: range) -> None:
    errors, parts = errors_of(name, runs)
    assert np.abs(errors).max() < 4.5
    assert 0.4 < np.sqrt(np.mean(errors**2)) < 1.2
    assert np.nanmedian(parts) < 0.4
    assert np.isfinite(parts).mean() > 0.9


def slower(name: str, factor: float) -> tuple[Robot, Recording]:
    """A sound recording of a motion that takes so many times as long."""
    robot = load(name)
    m = machine(robot, np.random.default_rng(6))
    efforts = inverse_dynamics(m.truth, m.q, m.qd / factor, m.qdd / factor**2)
    record = Recording(robot, factor * m.time, m.q, effort=efforts)
    return robot, noisy(record, np.random.default_rng(7))


@pytest.mark.parametrize(
    ("name", "factor", "slow"),
    [
        ("linear_delta", 60.0, True),
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in (
                ("linear_delta", 1.0, False),
                ("prru", 60.0, True),
                ("five_bar", 30.0, True),
                ("prru", 2.0, False),
            )
        ),
    ],
)
def test_a_motion_too_slow_for_inertia_explains_none(name: str, factor: float, slow: bool) -> None:
    robot, record = slower(name, factor)
    verdict = fit(robot, [record], KINDS).verdict
    assert verdict.slow == slow
    assert (verdict.answer == "explains") != slow
    # Friction does not need it.
    assert not fit(robot, [record], ("friction",)).verdict.slow
