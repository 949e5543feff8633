# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Images of the papers: spheres of directions; slices of shares, inside the largest circles."""

from __future__ import annotations

import numpy as np
import pytest

from delta_dynamics import dynamics_terms, energy, inverse_dynamics, joint_motion
from pkm_twin.errors import ParameterError
from pkm_twin.maps import figures, spheres
from pkm_twin.maps.kinds.isotropy import Isotropy
from pkm_twin.maps.kinds.payload import Payload
from pkm_twin.maps.kinds.strain_energy import StrainEnergy
from pkm_twin.maps.page import write_page
from pkm_twin.maps.run import run
from pkm_twin.maps.store import open_map
from pkm_twin.maps.sweep import plan_map
from pkm_twin.robot.workspace import reachable
from stiffness_monitor import regular_workspace, strain_energy
from test.maps.conftest import shorten
from test.support.robots import load, partly_long


def stored(folder, robot, kind, **options):
    """A short map in a file."""
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch)
        return run(plan_map(load(robot), kind, 3000, **options), folder / "map.nc", workers=1)


def lean(azimuth, tilt):
    """Rz(azimuth) Ry(tilt) Rz(-azimuth)."""
    c, s = np.cos(azimuth), np.sin(azimuth)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    c, s = np.cos(tilt), np.sin(tilt)
    return turn @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ turn.T


@pytest.fixture(scope="module", params=partly_long(["prru", "upr_rpu", "rps3"], "prru"))
def balls(request, tmp_path_factory):
    """A machine and its map with spheres."""
    folder = tmp_path_factory.mktemp("balls")
    with open_map(stored(folder, request.param, Isotropy(40.0, spheres=True))) as data:
        yield load(request.param), data.load()


def test_a_point_of_a_sphere_is_the_index_in_that_direction(balls, rng):
    """Against the machine's energy, and its inverse dynamics at the platform's energy."""
    robot, data = balls
    known = np.argwhere(np.isfinite(data.sphere_force.values))
    assert len(known) > 20 * len(data.way)
    for a, t, k in rng.choice(known, 12):
        rotation = lean(data.azimuth.values[a], data.tilt.values[t])
        # Tilts of Rx Ry Rz by its third column, and of Rz Ry Rx by its third row: both have these.
        pose = np.array(
            [float(data.sphere_height), np.arctan2(-rotation[1, 2], rotation[2, 2]), np.arcsin(rotation[0, 2])]
        )
        assert np.allclose(robot.rotation(pose)[2, 2], rotation[2, 2], atol=1e-12)
        way = data.way.values[k]
        motion = joint_motion(robot, pose, way)
        whole = energy(robot, motion.q, motion.qd).kinetic
        share = float(data.sphere_energy.values[a, t, k])
        assert 0.0 < share < 1.0
        rates = np.sqrt(40.0 / (share * whole)) * way
        motion = joint_motion(robot, pose, rates)
        rubs = dynamics_terms(robot, *motion).friction
        effort = np.abs(inverse_dynamics(robot, *motion) - rubs).max()
        assert float(data.sphere_force.values[a, t, k]) == pytest.approx(effort, rel=1e-9)


def test_spheres_are_drawn_where_poses_are_and_dashed_beyond_limits(balls):
    from matplotlib import pyplot

    robot, data = balls
    azimuth, tilt = np.meshgrid(data.azimuth.values, data.tilt.values, indexing="ij")
    known = np.isfinite(data.sphere_energy.values).all(-1)
    poses = np.stack(
        [
            np.full(known.sum(), float(data.sphere_height)),
            np.arctan2(-np.sin(tilt) * np.sin(azimuth), np.cos(tilt))[known],
            np.arcsin(np.sin(tilt) * np.cos(azimuth))[known],
        ],
        -1,
    )
    inside = data.sphere_inside.values[known] > 0
    assert (inside == reachable(robot, poses)).all() and inside.any()
    drawn = spheres.draw_spheres(data)
    assert set(drawn) == {"spheres_energy", "spheres_force"}
    for figure in drawn.values():
        ax = figure.axes[0]
        rims = [patch for patch in ax.patches if patch.get_zorder() == 3]
        assert len(rims) == len(ax.collections) > 12
        assert len({mesh.get_clim() for mesh in ax.collections}) == 1
        dashed = sum(rim.get_linestyle() == "--" for rim in rims)
        assert (dashed > 0) == ("dashed" in figure.get_supxlabel()) == (not inside.all())
        pyplot.close(figure)


def test_the_page_turns_the_spheres(balls, tmp_path):
    pytest.importorskip("plotly")
    _, data = balls
    figure = spheres.make_page(data)
    mesh = figure.data[0]
    assert len(mesh.x) == len(mesh.intensity) == len(mesh.customdata)
    assert [one.label for one in figure.layout.updatemenus[0].buttons] == ["eta_KE", "F_max"]
    # A point is the sphere's centre and its direction, and has that direction's value.
    count = len(data.way)
    k = 3 * count + 7
    azimuth, tilt, *way = mesh.customdata[k]
    at = data.sel(azimuth=np.radians(azimuth), tilt=np.radians(tilt), method="nearest")
    assert np.allclose(data.way.values[7], way, atol=1e-6)
    assert mesh.intensity[k] == pytest.approx(float(at.sphere_energy[7]), rel=1e-4)
    centre = np.radians(tilt) * np.array([np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))])
    offset = np.array([mesh.x[k], mesh.y[k]]) - centre
    assert np.hypot(*offset) <= spheres.RADIUS + 1e-6
    assert write_page(data, tmp_path / "page.html").stat().st_size < 9e6


@pytest.mark.parametrize("name", ["delta", "examples/machines/agile_eye.yaml", "five_bar"])
def test_spheres_need_two_tilts(name):
    with pytest.raises(ParameterError, match="two tilts"):
        plan_map(load(name), Isotropy(spheres=True), 3000)


LOADS = {"P1": [0, 0, 1, 0, 0, 0], "P2": [0.8, 0.3, 0.52, 0, 0, 0]}


@pytest.fixture(scope="module")
def shares(tmp_path_factory):
    """The strain energy of the 2UPR-RPU inside the largest circles."""
    robot, kind = load("upr_rpu"), StrainEnergy(slices=True)
    cases = [kind.loaded(robot, name, wrench) for name, wrench in LOADS.items()]
    folder = tmp_path_factory.mktemp("shares")
    path = stored(folder, "upr_rpu", kind, cases=cases, at=[-0.6, 0.0, 0.0], regular=True)
    with open_map(path) as data:
        yield robot, data.load()


def test_poses_count_inside_the_largest_circles_alone(shares):
    robot, data = shares
    z, beta, gamma = np.meshgrid(*(data[n].values for n in ("z", "beta", "gamma")), indexing="ij")
    counted = np.isfinite(data.value.values[..., 0])
    heights = np.unique(z[counted])
    circles = regular_workspace(robot, heights)
    radius = np.interp(z[counted], circles.z, circles.radius)
    out = np.hypot(beta, gamma)
    assert (out[counted] <= radius * (1 + 1e-3) + 1e-3).all()
    # All that is clearly inside counts.
    for height, wide in zip(circles.z, circles.radius, strict=True):
        inside = (z == height) & (out < wide - 0.01)
        assert counted[inside].all() and inside.any()
    pose = data.worst_pose.values
    circles = regular_workspace(robot, pose[:, 0])
    assert (np.hypot(pose[:, 1], pose[:, 2]) <= circles.radius * (1 + 1e-3) + 1e-3).all()


@pytest.mark.parametrize(("name", "unit"), [("prru", "rad"), pytest.param("delta", "m", marks=pytest.mark.long)])
def test_circles_of_other_machines(name, unit):
    """Tilts without torsion count by the tilt itself, places by their distance from the axis."""
    robot = load(name)
    space = plan_map(robot, Payload(), 500, regular=True)
    grid = robot.grid()
    heights, radii = space.circles
    k = int(np.nanargmax(radii))
    assert space.circles is not None and np.nanmin(radii) > (0.17 if unit == "rad" else 0.0)
    turn = np.linspace(0, 2 * np.pi, 37)
    for factor, whole in ((0.999, True), (1.001, False)):
        poses = grid.polar_pose(heights[k], factor * radii[k], turn)
        assert space.is_encircled(poses).all() == whole
        np.testing.assert_allclose(grid.distance(poses), factor * radii[k], rtol=1e-12)
    with pytest.raises(ParameterError, match="about an axis"):
        plan_map(load("stewart"), Payload(), 500, regular=True)


def test_shares_are_drawn_by_rank_in_slices_and_in_the_plane(shares):
    from matplotlib import pyplot

    robot, data = shares
    facts = StrainEnergy.facts(data)
    assert all(f"{name} " in facts[0] for name in data.element.values)
    # The plane is that of the pose asked for, and its shares sum to one.
    factor = data.plane_factor.values
    known = np.isfinite(data.plane_value.values)
    assert factor[known].sum(-1) == pytest.approx(1.0, abs=1e-12)
    (plane,) = [p for p in range(3) if "z" not in (str(data.row_name.values[p]), str(data.column_name.values[p]))]
    i, j = np.argwhere(known[plane, :, :, 0])[5]
    pose = [-0.6, data.row_value.values[0, plane, i], data.column_value.values[0, plane, j]]
    expected = strain_energy(robot, pose, LOADS["P1"]).factors
    assert factor[plane, i, j, 0] == pytest.approx(expected, abs=1e-12)
    drawn = figures.draw(data)
    assert {"P1_energy_slices", "P1_elements_1_plane", "P1_elements_3_slices"} <= set(drawn)
    # Under P2 the three bars store most.
    titles = [ax.get_title() for ax in drawn["P2_elements_1_plane"].axes]
    assert titles[:3] == ["3B", "2B", "1B"]
    for figure in drawn.values():
        pyplot.close(figure)
