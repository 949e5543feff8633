# SPDX-License-Identifier: Apache-2.0
"""Laws of the strain-energy atlas, and the 2UPR-RPU paper's table 2."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pkm_twin.atlas.run import run
from pkm_twin.atlas.store import open_atlas
from pkm_twin.atlas.strain_energy.sweep import (
    ELEMENTS,
    TABLE_2,
    WRENCHES,
    strain_energy_sweep,
)
from pkm_twin.errors import ParameterError
from stiffness_monitor import regular_workspace, strain_energy
from test.support.robots import load, partly_long
from test.support.workspaces import even_samples, polar_samples

ROBOT = load("upr_rpu")


def poses_of(data):
    """Poses of the grid, shape (z, tilt, azimuth, 3), and which are in the workspace."""
    z, tilt, azimuth = np.meshgrid(data.z, data.tilt, data.azimuth, indexing="ij")
    poses = np.stack([z, tilt * np.cos(azimuth), tilt * np.sin(azimuth)], -1)
    return poses, np.isfinite(data.energy.values)


def test_global_factors_are_the_direct_mean(strain):
    """Against points that stiffness_monitor makes itself, and against a plain mean of the file."""
    sweep, path = strain
    workspace = regular_workspace(ROBOT, sweep.heights)
    poses = polar_samples(workspace)
    assert len(poses) == sweep.points
    direct = strain_energy(ROBOT, poses, WRENCHES["P1"]).factors.mean(0)
    with open_atlas(path) as data:
        assert data.global_factor.values == pytest.approx(direct, rel=1e-12)
        factors = data.factor.values
        inside = np.isfinite(factors[..., 0])
        assert data.global_factor.values == pytest.approx(factors[inside].mean(0), rel=1e-12)
        weights = np.broadcast_to(data.tilt.values[:, None], inside.shape)[inside]
        weighted = (weights[:, None] * factors[inside]).sum(0) / weights.sum()
        assert data.volume_factor.values == pytest.approx(weighted, rel=1e-12)


def test_volume_factors_are_those_of_an_even_grid(strain):
    even = even_samples(regular_workspace(ROBOT, strain[0].heights))
    direct = strain_energy(ROBOT, even, WRENCHES["P1"]).factors.mean(0)
    with open_atlas(strain[1]) as data:
        assert data.volume_factor.values == pytest.approx(direct, abs=0.005)


def test_every_pose_is_that_of_strain_energy(strain):
    with open_atlas(strain[1]) as data:
        poses, inside = poses_of(data)
        direct = strain_energy(ROBOT, poses[inside], WRENCHES["P1"])
        assert data.energy.values[inside] == pytest.approx(direct.total, rel=1e-9)
        assert data.factor.values[inside] == pytest.approx(direct.factors, abs=1e-9)
        assert data.factor.values[inside].sum(-1) == pytest.approx(1.0, rel=1e-12)
        assert (data.dominant.values[~inside] == -1).all()
        best = data.factor.values[inside].argmax(-1)
        assert (data.dominant.values[inside] == best).all()
        assert tuple(data.element.values) == ELEMENTS == ROBOT.element_names


@pytest.mark.parametrize("name", list(WRENCHES))
def test_table_2(name, strain, tmp_path):
    """The paper's global factors to 0.01 (P1 hangs on how the workspace is sampled)."""
    sweep, path = strain
    assert sweep.wrench == WRENCHES["P1"]
    if name != "P1":
        path = run(replace(sweep, wrench=WRENCHES[name]), tmp_path / "a.nc", workers=1)
    with open_atlas(path) as data:
        assert data.global_factor.values == pytest.approx(np.array(TABLE_2[name]), abs=0.01)
        assert data.volume_factor.values == pytest.approx(np.array(TABLE_2[name]), abs=0.05)


@pytest.mark.parametrize("points", partly_long([1000, 20_000, 200_000], 20_000))
def test_points_are_about_as_many_as_asked_and_the_papers_plane_is_there(points):
    sweep = strain_energy_sweep(ROBOT, "P1", points)
    assert sweep.points == pytest.approx(points, rel=0.1)
    assert np.abs(sweep.heights + 0.6).min() < 1e-9
    assert math.hypot(sweep.tilts[0], sweep.turn[0]) == 0.0


def test_the_energy_goes_with_the_square_of_the_wrench(strain, tmp_path):
    wrenches = (1.0,) * 6, (-3.0,) * 6
    paths = [
        run(replace(strain[0], wrench=wrench), tmp_path / f"{k}.nc", workers=1)
        for k, wrench in enumerate(wrenches)
    ]
    with open_atlas(paths[0]) as one, open_atlas(paths[1]) as nine:
        inside = np.isfinite(one.energy.values)
        assert nine.energy.values[inside] == pytest.approx(9 * one.energy.values[inside], rel=1e-12)
        assert nine.factor.values[inside] == pytest.approx(one.factor.values[inside], abs=1e-12)


def test_refusals():
    for robot, wrench, points in (
        (load("delta"), "P1", None),
        (ROBOT, "P4", None),
        (ROBOT, [1, 2, 3], None),
        (ROBOT, [0, 0, np.nan, 0, 0, 0], None),
        (ROBOT, "P1", 3),
        # The next ones would leave the paper's plane with its axis alone.
        (ROBOT, "P1", 100),
        (ROBOT, "P1", 122),
        (ROBOT.changed(limits={"joint_angle": 0.05}), "P1", None),
    ):
        with pytest.raises(ParameterError):
            strain_energy_sweep(robot, wrench, points)
    assert len(strain_energy_sweep(ROBOT, "P1", 125).tilts) > 1
