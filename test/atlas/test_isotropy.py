# SPDX-License-Identifier: Apache-2.0
"""Laws of the isotropy atlas."""

from __future__ import annotations

import numpy as np
import pytest

from delta_dynamics.isotropy import energy_transfer, max_driving_force, tilted_pose
from pkm_twin.atlas.isotropy.sweep import isotropy_sweep
from pkm_twin.atlas.store import open_atlas
from pkm_twin.errors import ParameterError
from test.atlas.conftest import finite
from test.support.robots import load


@pytest.fixture(params=["prru", "delta_cu"])
def sphere_atlas(request, small_atlases):
    with open_atlas(small_atlases[f"isotropy {request.param}"]) as data:
        yield load(request.param), data.load()


@pytest.mark.parametrize("index", ["eta", "force"])
def test_a_sphere_is_symmetric(sphere_atlas, index):
    """A motion and its opposite have the same energies and forces."""
    _, data = sphere_atlas
    values = data[index].values
    opposite = np.roll(values[..., ::-1, :], data.sizes["turn"] // 2, axis=-1)
    kept = np.isfinite(values)
    assert kept.any()
    assert opposite[kept] == pytest.approx(values[kept], rel=1e-9)


def test_indices_are_those_of_the_library(sphere_atlas):
    robot, data = sphere_atlas
    theta, phi = np.meshgrid(data.polar, data.turn, indexing="ij")
    out = np.sin(theta)
    x = np.stack([out * np.cos(phi), out * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    height = float(robot.home()[robot.pose_names.index("z")])
    i, j = 3, 2
    first, second = (float(data[name][k]) for name, k in zip(data.eta.dims, (i, j), strict=False))
    pose = (
        tilted_pose(height, first, second)
        if robot.mechanism == "prru"
        else np.array([first, second, height])
    )
    assert data.eta.values[i, j].ravel() == pytest.approx(energy_transfer(robot, pose, x), rel=1e-9)
    force = max_driving_force(robot, pose, x)
    assert data.force.values[i, j].ravel() == pytest.approx(force, rel=1e-9)


def test_spheres_stay_within_the_exact_range(sphere_atlas):
    _, data = sphere_atlas
    eta = data.eta.values
    kept = np.isfinite(eta[..., 0, 0])
    assert (eta[kept].min((-2, -1)) >= data.eta_least.values[kept] * (1 - 1e-9)).all()
    assert (eta[kept].max((-2, -1)) <= data.eta_greatest.values[kept] * (1 + 1e-9)).all()
    assert 0.0 < finite(eta).min() < finite(eta).max() < 1.0


def test_prru_repeats_every_third_of_a_turn(small_atlases):
    with open_atlas(small_atlases["isotropy prru"]) as data:
        third = data.sizes["azimuth"] // 3
        for values in (data.eta_least.values, data.eta_greatest.values):
            assert np.roll(values, third, axis=0) == pytest.approx(values, rel=1e-9)
        # Upright, the azimuth means nothing.
        assert np.ptp(data.force.values[:, 0], axis=0).max() < 1e-6 * data.force.values.max()


def test_prru_spreads_grow_with_the_tilt(small_atlases):
    """3-PRRU paper, section 5; eta's spread dips a little before it grows, with these masses."""
    with open_atlas(small_atlases["isotropy prru"]) as data:
        force = np.ptp(data.force.values, axis=(-2, -1))
        assert (np.diff(force, axis=1) > 0).all()
        eta = (data.eta_greatest - data.eta_least).values
        assert (eta[:, -1] > eta[:, :-1].max(1)).all()


def test_delta_leaves_out_what_its_arms_do_not_reach(small_atlases):
    with open_atlas(small_atlases["isotropy delta_cu"]) as data:
        x, y = np.meshgrid(data.x, data.y, indexing="ij")
        inside = np.hypot(x, y) <= float(data.x.max()) * (1 + 1e-9)
        assert (np.isfinite(data.eta.values[..., 0, 0]) == inside).all()


def test_refusals():
    prru = load("prru")
    for robot, options in (
        (load("five_bar"), {}),
        (prru, {"points": 5}),
        (prru, {"energy": 0.0}),
        (prru, {"tilt": 2.0}),
        (load("delta"), {"height": -5.0}),
    ):
        with pytest.raises(ParameterError):
            isotropy_sweep(robot, **options)
