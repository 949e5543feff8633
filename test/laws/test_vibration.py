# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Frequency response and chatter: laws, and a stability analysis that shares no code with ours."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from scipy.io import loadmat
from scipy.linalg import expm

from pkm_twin.errors import ParameterError
from stiffness_monitor import compliance, frequency_response, stability_lobes, stable_depth
from stiffness_monitor.chatter import Milling, lobes_from_modes, refine_lobes, stable_depth_from_modes
from stiffness_monitor.modes import natural_frequencies
from stiffness_monitor.vibration import ToolModes, tool_modes
from test.support.command import command
from test.support.robots import ELASTIC, load, partly_long

KT = 600e6


def modes_of(frequencies, damping, shapes):
    """Modes of a tool point without the rest of a machine; shapes in the plane, 1/sqrt(kg)."""
    whole = np.zeros((len(frequencies), 6))
    whole[:, :2] = shapes
    return ToolModes(np.array(frequencies, float), np.array(damping, float), whole, np.zeros((6, 6)), np.eye(3))


ONE = modes_of([922.0], [0.011], [[1.0 / np.sqrt(0.03993), 0.0]])
"""Published charts share this machine (Insperger and Stepan 2004, Ding et al. 2010)."""


def multiplier(modes, milling, speed, depth, steps):
    """Semi-discretisation: the force's matrix and the delayed term constant in each step."""
    p, w, z = modes.shapes[:, :2], 2.0 * np.pi * modes.frequencies, modes.damping
    count, period = len(w), 60.0 / (speed * milling.teeth)
    h, size = period / steps, 2 * len(w) + 2 * steps
    free = np.zeros((2 * count, 2 * count))
    free[:count, count:] = np.eye(count)
    free[count:, :count], free[count:, count:] = -np.diag(w**2), -np.diag(2.0 * z * w)
    width = np.arccos(1.0 - 2.0 * milling.immersion)
    enter, leave = (0.0, width) if milling.up else (np.pi - width, np.pi)
    whole = np.eye(size)
    for k in range(steps):
        matrix = np.zeros((2, 2))
        for part in (np.arange(20) + 0.5) / 20:
            turn = 2.0 * np.pi * speed / 60.0 * h * (k + part)
            for tooth in range(milling.teeth):
                a = (turn + 2.0 * np.pi * tooth / milling.teeth) % (2.0 * np.pi)
                if enter <= a <= leave:
                    s, c, r = np.sin(a), np.cos(a), milling.radial
                    force = np.array([-c - r * s, s - r * c])
                    matrix += milling.tangential / 20 * np.outer(force, [s, c])
        pushed = np.vstack([np.zeros((count, 2)), p]) @ (depth * matrix)
        state = free.copy()
        state[:, :count] += pushed @ p.T
        both = np.zeros((2 * count + 2, 2 * count + 2))
        both[: 2 * count, : 2 * count], both[: 2 * count, 2 * count :] = state, -pushed
        step = expm(both * h)[: 2 * count]
        move = np.zeros((size, size))
        move[: 2 * count, : 2 * count] = step[:, : 2 * count]
        # The mean of the delayed displacement at both ends of the step.
        move[: 2 * count, -2:] += 0.5 * step[:, -2:]
        move[: 2 * count, -4:-2] += 0.5 * step[:, -2:]
        move[2 * count : 2 * count + 2, :count] = p.T
        move[2 * count + 2 :, 2 * count : -2] = np.eye(size - 2 * count - 2)
        whole = move @ whole
    return np.abs(np.linalg.eigvals(whole)).max()


@pytest.mark.parametrize("name", partly_long(ELASTIC, "upr_rpu"))
def test_the_response_is_a_linear_structure_s(name):
    robot = load(name)
    pose, tool = robot.home(), [0.02, -0.01, -0.05]
    own = natural_frequencies(robot, pose, 3)
    at = np.array([0.0, 0.37 * own[0], own[0], 1.3 * own[2]])
    found = frequency_response(robot, pose, at, damping=0.02)
    np.testing.assert_allclose(found[0].real, compliance(robot, pose), atol=1e-9 * abs(found[0]).max())
    np.testing.assert_allclose(found, found.swapaxes(-1, -2), rtol=1e-9, atol=1e-12 * abs(found).max())
    # Work of a harmonic force is never negative: damping takes it.
    assert (np.linalg.eigvalsh(-found.imag) > -1e-12 * abs(found).max()).all()
    offset = np.eye(6)
    x, y, z = tool
    offset[:3, 3:] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
    there = frequency_response(robot, pose, at, damping=0.02, tool=tool)
    np.testing.assert_allclose(there, offset @ found @ offset.T, atol=1e-9 * abs(there).max())
    # Twice the damping halves a resonance that stands alone.
    peak = [np.abs(frequency_response(robot, pose, own[:1], damping=z)).max() for z in (1e-4, 2e-4)]
    assert peak[0] / peak[1] == pytest.approx(2.0, rel=1e-2)


def test_damping_is_the_file_s_or_given(tmp_path):
    robot = load("upr_rpu").changed(modal_damping=[0.03, 0.01])
    modes = tool_modes(robot, robot.home())
    assert modes.damping[:3].tolist() == [0.03, 0.01, 0.01]
    assert robot.changed(payload={"mass": 1.0}).modal_damping.tolist() == [0.03, 0.01]
    with pytest.raises(ParameterError, match="modal_damping"):
        tool_modes(robot.changed(modal_damping=[]), robot.home())
    for bad in (0.0, 1.0, -0.1, [0.02, np.nan]):
        with pytest.raises(ParameterError, match="damping"):
            tool_modes(robot, robot.home(), damping=bad)
    with pytest.raises(ParameterError, match="modal_damping"):
        robot.changed(modal_damping=[1.5])


def test_a_published_machine_has_its_multipliers():
    """Of a slot at 5000 rpm (Ding et al., Int. J. Machine Tools and Manufacture 50, 2010)."""
    published = {0.2e-3: 0.8192, 0.5e-3: 1.0726, 0.7e-3: 1.2197, 1.0e-3: 1.4040}
    slot = Milling(2, KT, 1.0 / 3.0)
    for depth, expected in published.items():
        assert multiplier(ONE, slot, 5000.0, depth, 120) == pytest.approx(expected, rel=1e-2)
    limit = lobes_from_modes(ONE, slot, [5000.0]).depths[0]
    # Between the first two.
    assert limit == pytest.approx(np.interp(1.0, [0.8192, 1.0726], [0.2e-3, 0.5e-3]), rel=0.05)


CASES = [
    (ONE, Milling(2, KT, 1.0 / 3.0, 0.1), 17000.0),
    (ONE, Milling(2, KT, 1.0 / 3.0, 0.5, up=True), 9000.0),
    (
        modes_of([60.0, 75.0], [0.03, 0.02], [[0.4, 0.15], [-0.05, 0.2]]),
        Milling(3, KT, 0.3, 0.3, feed=1.0),
        1500.0,
    ),
    (
        modes_of([60.0, 75.0, 140.0], [0.03, 0.02, 0.02], [[0.4, 0.1], [-0.1, 0.5], [0.3, 0.3]]),
        Milling(4, KT, 0.2, 0.3, up=True),
        700.0,
    ),
]


@pytest.mark.parametrize("case", partly_long(range(len(CASES)), 0, 2))
def test_limits_are_an_independent_semi_discretisation_s(case):
    modes, milling, speed = CASES[case]
    depth = lobes_from_modes(modes, milling, [speed]).depths[0]
    c, s = np.cos(milling.feed), np.sin(milling.feed)
    turned = np.array([[c, -s], [s, c]])
    plain = modes_of(modes.frequencies, modes.damping, modes.shapes[:, :2] @ turned)
    assert multiplier(plain, milling, speed, 0.95 * depth, 60) < 1.0
    assert multiplier(plain, milling, speed, 1.05 * depth, 60) > 1.0


def test_lobes_follow_the_laws_of_scale():
    """Depth is as stiffness over coefficient; a slot's zero-order depth is stable at each speed."""
    slot = Milling(2, KT, 1.0 / 3.0)
    speeds = np.array([6000.0, 9000.0, 14000.0])
    found = lobes_from_modes(ONE, slot, speeds)
    half = lobes_from_modes(ONE, Milling(2, KT / 2.0, 1.0 / 3.0), speeds)
    np.testing.assert_allclose(half.depths, 2.0 * found.depths, rtol=5e-3)
    assert (found.depths > found.safe).all() and found.best == found.depths.argmax()
    # A single mode along x: the classical limit 2 k z (1 + z) over the mean coefficient.
    stiffness = 0.03993 * (2.0 * np.pi * 922.0) ** 2
    mean = slot.mean()[0, 0]
    assert found.safe == pytest.approx(2.0 * stiffness * 0.011 * 1.011 / mean, rel=1e-3)
    both = modes_of([922.0, 3000.0], [0.011, 0.02], [[5.0, 0.0], [0.0, 1.0]])
    assert stable_depth_from_modes(both, slot)[1] == 0
    capped = lobes_from_modes(ONE, slot, speeds, deepest=1e-4)
    assert capped.open.all() and (capped.depths == 1e-4).all()
    with pytest.raises(ParameterError, match="speeds"):
        lobes_from_modes(ONE, slot, [50.0])
    with pytest.raises(ParameterError, match="immersion"):
        Milling(2, KT, 0.3, 1.2)
    for other_unit in (600.0, 0.6, 6e14):
        with pytest.raises(ParameterError, match="tangential"):
            Milling(2, other_unit, 0.3)


@pytest.mark.parametrize("seed", partly_long(range(6), 0))
def test_no_speed_of_a_range_is_worse_than_its_least_depth(seed):
    """Nor any within the margin of the best speed; speeds that nobody chose."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 4))
    modes = modes_of(
        rng.uniform(40.0, 250.0, count),
        rng.uniform(0.01, 0.04, count),
        0.3 * rng.normal(size=(count, 2)),
    )
    milling = Milling(int(rng.integers(1, 4)), KT, 0.3, rng.choice([0.1, 0.5, 1.0]))
    high = 60.0 * modes.frequencies.max() / milling.teeth * rng.uniform(0.5, 1.5)
    low = 0.6 * high
    found = refine_lobes(modes, milling, low, high, 8)
    tried = lobes_from_modes(modes, milling, rng.uniform(low, high, 15))
    assert tried.depths.min() > (1.0 - 2e-3) * found.depths.min()
    speed, depth, _ = found.steady()
    near = lobes_from_modes(modes, milling, speed * (1.0 + 0.01 * rng.uniform(-1.0, 1.0, 5)))
    assert near.depths.min() > (1.0 - 2e-3) * depth
    # A range without speeds between: cliffs and minima are found from its ends.
    again = refine_lobes(modes, milling, low, high, 5)
    assert again.depths.min() == pytest.approx(found.depths.min(), rel=2e-3)


COARSE = {"an island at half a mode's period": (4, 3, 0.1, False), "a window": (28, 4, 0.05, True)}


@pytest.mark.parametrize("case", partly_long(COARSE, "a window"))
def test_the_ends_of_a_range_are_enough_to_find_what_holds_in_it(case):
    """Of lightly damped machines and narrow cuts, whose limits change within 1 % of the speed."""
    seed, count, immersion, up = COARSE[case]
    rng = np.random.default_rng(seed)
    if up:
        frequencies = np.sort(rng.uniform(30.0, 600.0, count))
        damping, size = rng.choice([0.005, 0.01, 0.02], count), 0.1
    else:
        frequencies = np.sort(rng.uniform(40.0, 250.0, count))
        damping, size = rng.uniform(0.005, 0.03, count), 0.3
    modes = modes_of(frequencies, damping, size * rng.normal(size=(count, 2)))
    milling = Milling(1, KT, 0.3, immersion, up)
    low, high = 60.0 * frequencies[-1] * np.array([0.62, 0.87] if up else [1.1, 1.3])
    found = refine_lobes(modes, milling, low, high, 2)
    speed, depth, _ = found.steady()
    near = lobes_from_modes(modes, milling, speed * (1.0 + np.linspace(-0.01, 0.01, 9)))
    assert near.depths.min() > (1.0 - 5e-3) * depth
    tried = lobes_from_modes(modes, milling, np.linspace(low, high, 17))
    assert tried.depths.min() > (1.0 - 5e-3) * found.depths.min()


def test_what_no_machine_has_is_rejected_by_name():
    robot = load("upr_rpu")
    pose, milling = robot.home(), Milling(2, KT, 0.3)
    for name, call in {
        "tool": lambda: tool_modes(robot, pose, damping=0.02, tool=[0.0, 0.0, 1e300]),
        "damping": lambda: tool_modes(robot, pose, damping=1e-9),
        "frequencies": lambda: frequency_response(robot, pose, [0.0, 1e300], damping=0.02),
        "immersion": lambda: Milling(2, KT, 0.3, 1e-12),
        "speeds": lambda: refine_lobes(ONE, milling, 3000.0, 1e300, 181),
        "deepest": lambda: lobes_from_modes(ONE, milling, [5000.0], deepest=1e-12),
    }.items():
        with pytest.raises(ParameterError) as caught:
            call()
        assert caught.value.field == name


def test_commands_write_what_the_functions_give(capsys, tmp_path):
    robot = load("upr_rpu")
    table, mat = tmp_path / "frf.csv", tmp_path / "lobes.mat"
    shared = ("--tool", "0,0,-0.1", "--damping", "0.03", "--json")
    told = json.loads(command(capsys, "frf", "upr_rpu", "--out", str(table), "--points", "5", *shared).out)
    rows = list(csv.DictReader(table.open()))
    at = [float(row["frequency"]) for row in rows]
    found = frequency_response(robot, robot.home(), at, damping=0.03, tool=[0, 0, -0.1])
    assert [float(row["xy.imag"]) for row in rows] == pytest.approx(found[:, 0, 1].imag.tolist())
    assert told["modes"][0]["frequency_hz"] == pytest.approx(natural_frequencies(robot, robot.home(), 1)[0])
    assert told["most"]["compliance_m_per_n"] >= np.linalg.svd(found[:, :3, :3])[1].max()
    process = ("--teeth", "2", "--tangential", "600e6", "--radial", "0.3", "--immersion", "0.5")
    speeds = ("--speeds", "8000,12000", "--points", "2", "--out", str(mat))
    told = json.loads(command(capsys, "lobes", "upr_rpu", *process, *speeds, *shared).out)
    milling = Milling(2, 600e6, 0.3, 0.5)
    given = {"damping": 0.03, "tool": [0, 0, -0.1]}
    lobes = stability_lobes(robot, robot.home(), milling, told["speeds_rpm"], **given)
    assert told["depths_m"] == lobes.depths.tolist()
    assert loadmat(mat)["depth"][:, 0].tolist() == lobes.depths.tolist()
    assert told["least"]["depth_m"] == lobes.depths.min()
    assert told["zero_order_depth_m"] == stable_depth(robot, robot.home(), milling, **given)
    best = told["best"]
    assert (best["speed_rpm"], best["depth_m"], best["open"]) == lobes.steady()
    assert table.with_suffix(".png").exists() and mat.with_suffix(".png").exists()
