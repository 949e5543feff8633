# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""2UPR-RPU paper: tables 1 and 2, what its figures say, and its workspace."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pkm_twin.errors import ParameterError
from stiffness_monitor import (
    compliance,
    limb_stiffness,
    reachable,
    regular_workspace,
    stiffness,
    strain_energy,
)
from test.support.robots import load
from test.support.upr_rpu import limbs
from test.support.workspaces import even_samples, polar_samples
from tools.papers import upr_rpu
from tools.papers.upr_rpu import HEIGHTS, LOAD

ROBOT = load("upr_rpu")

UNIT = 0.001


def numbers(text):
    """Return the numbers of a printed line."""
    return [float(word) for word in text.split()]


TABLE_1 = [(pose, *map(numbers, lines)) for pose, *lines in upr_rpu.TABLE_1.values()]
TABLE_2 = {name: (load, numbers(line)) for name, (load, line) in upr_rpu.TABLE_2.items()}
P1 = TABLE_2["P1"][0]


@pytest.fixture(scope="module")
def workspace():
    return regular_workspace(ROBOT, HEIGHTS)


@pytest.mark.parametrize(("pose", "theory", "finite_elements"), TABLE_1)
def test_table_1_theory(pose, theory, finite_elements):
    expected = np.array(theory)
    deflection = 1e6 * strain_energy(ROBOT, pose, LOAD).deflection
    allowed = np.maximum(0.003 * np.abs(expected), UNIT)
    assert (np.abs(deflection - expected) <= allowed).all(), deflection - expected
    assert 1e6 * compliance(ROBOT, pose) @ LOAD == pytest.approx(deflection, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(("pose", "theory", "finite_elements"), TABLE_1)
def test_table_1_finite_elements_within_the_papers_error(pose, theory, finite_elements):
    expected = np.array(finite_elements)
    deflection = 1e6 * strain_energy(ROBOT, pose, LOAD).deflection
    error = np.abs(deflection - expected)
    assert (error <= np.maximum(0.078 * np.abs(expected), UNIT)).all(), error / np.abs(expected)


def test_limb_stiffness_is_the_papers():
    """J_i (equations 1, 19, 30), K_i (17, 28), K (34) and W_i (36) against closed forms."""
    poses = np.random.default_rng(3).uniform((-0.8, -0.3, -0.3), (-0.4, 0.3, 0.3), (20, 3))
    found = limb_stiffness(ROBOT, poses)
    amplitudes = found.amplitudes(LOAD)
    turned = np.swapaxes(found.wrenches, -1, -2)
    whole = (found.wrenches @ found.stiffness @ turned).sum(-3)
    assert whole == pytest.approx(stiffness(ROBOT, poses), rel=1e-11, abs=1e-9 * whole.max())
    balance = (found.wrenches @ amplitudes[..., None])[..., 0].sum(-2)
    assert balance == pytest.approx(np.broadcast_to(LOAD, (20, 6)), abs=1e-9)
    for k, pose in enumerate(poses):
        moved = compliance(ROBOT, pose) @ LOAD
        for i, (unit, elements) in enumerate(limbs(ROBOT, pose)):
            assert found.wrenches[k, i] == pytest.approx(unit, abs=1e-14)
            expected = np.linalg.inv(sum(elements))
            size = np.sqrt(np.outer(*[np.diag(expected)] * 2))
            assert (np.abs(found.stiffness[k, i] - expected) <= 1e-11 * size).all()
            assert amplitudes[k, i] == pytest.approx(expected @ unit.T @ moved, rel=1e-8, abs=1e-8)
    with pytest.raises(ParameterError, match="limbs' wrenches"):
        limb_stiffness(load("delta"), load("delta").home())


@pytest.mark.parametrize("last", [1e-11, 3.22e-11])
def test_table_1_does_not_hang_on_the_lost_entry(last):
    entries = ROBOT.joints_compliance.upr_universal.tolist()
    entries[5] = last
    robot = ROBOT.changed(joints_compliance={"upr_universal": entries})
    for pose, theory, _ in TABLE_1:
        expected = np.array(theory)
        error = np.abs(1e6 * strain_energy(robot, pose, LOAD).deflection - expected)
        assert (error <= np.maximum(0.003 * np.abs(expected), UNIT)).all()


@pytest.mark.parametrize(("load_name", "tolerance"), [("P1", 0.006), ("P2", 0.01), ("P3", 0.01)])
def test_table_2_over_points_on_rays(workspace, load_name, tolerance):
    """The paper averages over N points of a search; on rays from the axis all three come out."""
    wrench, expected = TABLE_2[load_name]
    mean = strain_energy(ROBOT, polar_samples(workspace), wrench).factors.mean(axis=0)
    assert mean == pytest.approx(np.array(expected), abs=tolerance)


@pytest.mark.parametrize(("load_name", "tolerance"), [("P1", 0.04), ("P2", 0.01), ("P3", 0.01)])
def test_table_2_over_the_volume(workspace, load_name, tolerance):
    """An even mean over the volume: P1 hangs on how the workspace is sampled."""
    wrench, expected = TABLE_2[load_name]
    mean = strain_energy(ROBOT, even_samples(workspace), wrench).factors.mean(axis=0)
    assert mean == pytest.approx(np.array(expected), abs=tolerance)


def test_regular_workspace(workspace):
    """Radii of the workspace that reproduces table 2; the paper shows it as figure 5 only."""
    assert workspace.z == pytest.approx(np.arange(-0.9, -0.34, 0.05))
    whole = np.floor(np.degrees(workspace.radius)).astype(int)
    assert whole.tolist() == [11, 16, 20, 25, 29, 31, 30, 29, 27, 25, 22, 12]


def test_regular_workspace_is_the_largest_circle(workspace):
    """Just inside all is reachable, just outside something is not; checked on other rays."""
    turn = np.linspace(0, 2 * np.pi, 1001)
    for z, radius in zip(workspace.z, workspace.radius, strict=True):
        for factor, whole in ((0.999, True), (1.001, False)):
            r = factor * radius
            poses = np.column_stack((np.full(1001, z), r * np.cos(turn), r * np.sin(turn)))
            assert bool(reachable(ROBOT, poses).all()) is whole
        grid = radius * 0.999 * np.linspace(0, 1, 30)[:, None]
        poses = np.empty((30, 1001, 3))
        poses[..., 0], poses[..., 1], poses[..., 2] = z, grid * np.cos(turn), grid * np.sin(turn)
        assert reachable(ROBOT, poses).all()


def test_reachable_symmetric_about_gamma_zero():
    """Figure 5: symmetric about gamma = 0, not about beta = 0."""
    z, beta, gamma = np.meshgrid(HEIGHTS, np.linspace(-0.9, 0.9, 61), np.linspace(-0.9, 0.9, 61))
    poses = np.stack((z, beta, gamma), axis=-1)
    inside = reachable(ROBOT, poses)
    assert inside.any()
    assert (inside == reachable(ROBOT, poses * [1, 1, -1])).all()
    assert (inside != reachable(ROBOT, poses * [1, -1, 1])).any()


def test_limits_bound_the_reachable_workspace():
    """Equation 40, entry by entry: each limit refuses something that the others let pass."""
    poses = np.random.default_rng(5).uniform((-1.1, -0.9, -0.9), (-0.1, 0.9, 0.9), (20_000, 3))
    lengths, _ = ROBOT.try_inverse(poses)
    kept = reachable(ROBOT, poses)
    assert lengths[kept].min() >= 0.3
    assert lengths[kept].max() <= 1.0
    wide = ROBOT.changed(limits={"joint_angle": math.pi})
    assert reachable(wide, poses).sum() > kept.sum()
    long = ROBOT.changed(limits={"limb_length": [0.01, 5.0]})
    assert reachable(long, poses).sum() > kept.sum()


def test_vertical_load_at_home():
    """Figure 8: at P1 the home pose stores 0.073 in each R and 0.249 in each U of the UPRs."""
    energy = strain_energy(ROBOT, [-0.6, 0, 0], P1)
    factors = dict(zip(energy.elements, energy.factors, strict=True))
    assert factors["1R"] == pytest.approx(0.073, abs=5e-4)
    assert factors["1U"] == pytest.approx(0.249, abs=5e-4)
    for name in "RBU":
        assert factors[f"1{name}"] == pytest.approx(factors[f"2{name}"], rel=1e-12)
        assert factors[f"3{name}"] < 1e-20
    assert energy.dominant == "1U"
    assert energy.tie


def test_stated_maxima_at_z_600():
    """Figures 7 and 8, load P1: maxima 0.08 and 0.25 of the UPR's R and U, 0.02 and 0.07 of RPU."""
    poses = even_samples(regular_workspace(ROBOT, [-0.6]))
    energy = strain_energy(ROBOT, poses, P1)
    top = dict(zip(energy.elements, energy.factors.max(axis=0), strict=True))
    for name, value in {"1R": 0.08, "1U": 0.25, "3R": 0.02, "3U": 0.07}.items():
        assert top[name] == pytest.approx(value, abs=0.006)
    assert top["1B"] == pytest.approx(0.45, abs=0.02)
    # "The smallest energy is at the initial position": within a tilt of 2 degrees.
    best = poses[energy.total.argmin(), 1:]
    assert np.hypot(*best) <= math.radians(2.0) + 1e-12


def test_distributions_symmetric_about_gamma_zero(workspace):
    """Figures 6 and 7: with P1, energy and factors are even in gamma, limbs 1 and 2 exchanged."""
    poses = even_samples(workspace, math.radians(2))
    one, other = (strain_energy(ROBOT, p, P1) for p in (poses, poses * [1, 1, -1]))
    swapped = other.factors[:, [3, 4, 5, 0, 1, 2, 6, 7, 8]]
    assert one.total == pytest.approx(other.total, rel=1e-11)
    assert one.factors == pytest.approx(swapped, abs=1e-11)


def test_order_of_elements_under_vertical_load(workspace):
    """Section 4: bars store most, then the UPR's universal joints, then its revolute joints."""
    mean = strain_energy(ROBOT, polar_samples(workspace), P1).factors.mean(axis=0)
    r, b, u = mean[:3]
    assert b > u > r
    # "80 % of the energy is in the UPR's U joints and bars."
    assert 2 * (b + u) == pytest.approx(0.80, abs=0.02)


def test_shape_factor_moves_the_result_by_a_thousandth():
    robot = ROBOT.changed(members={"shear_factor": 10 / 9})
    pose = TABLE_1[1][0]
    one, other = (strain_energy(r, pose, LOAD).deflection for r in (ROBOT, robot))
    change = np.abs(other / one - 1)
    assert 1e-4 < change.max() < 5e-3
