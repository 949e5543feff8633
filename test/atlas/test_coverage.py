# SPDX-License-Identifier: Apache-2.0
"""The default atlas of every robot holds all that it reaches, whatever its pose coordinates are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pkm_twin import robot_names
from pkm_twin.atlas import kinds, workspace
from pkm_twin.atlas.grids import height_range, largest_distance
from pkm_twin.atlas.planes import planes
from pkm_twin.atlas.run import run
from pkm_twin.atlas.store import open_atlas
from pkm_twin.atlas.workspace.sweep import workspace_sweep
from pkm_twin.errors import ParameterError
from pkm_twin.robot.workspace import reachable, singularity_at, try_forward
from test.support.robots import SHIPPED, load, partly_long

COUNTS = partly_long([20_000, 100_000], 20_000)
"""Random joint states."""


def reached(robot, rng, count):
    """Reachable poses of random joint states between the limits."""
    low, high = robot.limits.position.T
    poses, good = try_forward(robot, rng.uniform(low, high, (count, len(low))))
    poses = poses[good]
    poses = poses[reachable(robot, poses)]
    assert len(poses) > count / 10
    return poses


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("name", partly_long(robot_names(), "delta_cu", "five_bar", "upr_rpu"))
def test_the_default_atlas_holds_all_that_is_reachable(name, count, rng):
    robot = load(name)
    poses = reached(robot, rng, count)
    axes = workspace_sweep(robot).axes
    assert len(axes) == len(robot.pose_names)
    for k, ticks in enumerate(axes):
        assert ticks[0] <= poses[:, k].min()
        assert poses[:, k].max() <= ticks[-1]
        # And little else: the grid is not spent on what is empty.
        assert np.ptp(poses[:, k]) > 0.4 * np.ptp(ticks)
    box = robot.search_box()
    assert ((box[:, 0] <= poses) & (poses <= box[:, 1])).all()


# A box of two and of three coordinates, and one about an axis.
VOLUMES = partly_long(
    [n for n, robot in SHIPPED.items() if len(robot.pose_names) in (2, 3)], "five_bar", "delta_cu"
)


@pytest.mark.parametrize("count", partly_long([40_000, 200_000], 40_000))
@pytest.mark.parametrize("name", VOLUMES)
def test_the_volume_is_that_of_random_poses(name, count, rng, monkeypatch, tmp_path):
    """By Monte Carlo in the search box, which the atlas's own box has no part in."""
    monkeypatch.setattr(workspace.sweep, "LAYERS", 3)
    robot = load(name)
    low, high = robot.search_box().T
    share = reachable(robot, rng.uniform(low, high, (count, len(low)))).mean()
    sweep = workspace_sweep(robot, 40 ** len(low))
    with open_atlas(run(sweep, tmp_path / "a.nc", workers=1)) as data:
        expected = share * np.prod(high - low)
        assert float(data.volume) == pytest.approx(expected, rel=0.06)


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("name", robot_names())
def test_a_cylinder_of_poses_holds_all_that_is_reachable(name, count, rng):
    robot = load(name)
    grid = robot.grid()
    if grid.kind == "box":
        with pytest.raises(ValueError, match="no height"):
            grid.polar_pose(0.0, 0.0, 0.0)
        return
    poses = dict(zip(robot.pose_names, reached(robot, rng, count).T, strict=True))
    low, high = height_range(robot)
    assert low <= poses[grid.height].min()
    assert poses[grid.height].max() <= high
    for coordinate in grid.lateral:
        assert np.abs(poses[coordinate]).max() <= largest_distance(robot)
    # On the axis the azimuth means nothing, and the coordinates stand where the names say.
    on_axis = grid.polar_pose(0.1, 0.0, [0.0, 2.0])
    assert on_axis == pytest.approx(np.array([[0.1 * (n == grid.height) for n in grid.names]] * 2))


@pytest.mark.parametrize(
    "name",
    partly_long(
        [n for n, robot in SHIPPED.items() if robot.grid().kind == "box"], "five_bar", "stewart"
    ),
)
def test_an_atlas_without_an_axis(name, tmp_path):
    """Sections through the home pose: a whole grid of two or three coordinates, pairs of more."""
    from matplotlib import pyplot

    robot = load(name)
    size = len(robot.pose_names)
    with open_atlas(run(workspace_sweep(robot, 3000), tmp_path / "a.nc", workers=1)) as data:
        data.load()
        assert data.attrs["layout"] == "box"
        assert "circle" not in data
        shown = planes(data, ("singularity", "clearance", "joint_angle"))
        assert len(shown) == max(1, size * (size - 1) // 2)
        for figure in kinds.draw(data).values():
            assert sum(bool(ax.get_xlabel()) for ax in figure.axes) >= len(shown)
            pyplot.close(figure)
        pytest.importorskip("plotly")
        assert "Plotly.newPlot" in kinds.write_page(data, tmp_path / "a.html").read_text()
    inside = data.reachable.values > 0
    assert inside.any()
    names = list(robot.pose_names)
    if size in (2, 3):
        grid = np.stack(np.meshgrid(*(data[n] for n in names), indexing="ij"), -1)
    else:
        assert list(data.coordinate.values) == names
        grid = np.empty((*inside.shape, size))
        for k in range(len(data.slice)):
            part = data.isel(slice=k)
            grid[k] = data.home.values
            grid[k][..., names.index(str(part.row_name.values))] = part.row_value.values[:, None]
            grid[k][..., names.index(str(part.column_name.values))] = part.column_value.values
    assert (reachable(robot, grid) == inside).all()
    expected = singularity_at(robot, grid[inside])
    assert data.singularity.values[inside] == pytest.approx(expected, abs=1e-9)
    assert np.isnan(data.singularity.values[~inside]).all()


@pytest.mark.parametrize(("name", "key"), [("prru", "position"), ("upr_rpu", "limb_length")])
def test_a_workspace_without_end_is_refused(name, key):
    robot = load(name)
    endless = replace(robot, limits=replace(robot.limits, **{key: None}))
    with pytest.raises(ParameterError, match=rf"limits\.{key}"):
        workspace_sweep(endless)


@pytest.mark.parametrize("kind", ["isotropy", "modes", "strain-energy"])
def test_kinds_that_need_more_say_what(kind):
    from pkm_twin.atlas.isotropy.sweep import isotropy_sweep
    from pkm_twin.atlas.modes.sweep import modes_sweep
    from pkm_twin.atlas.strain_energy.sweep import strain_energy_sweep

    make = {"isotropy": isotropy_sweep, "modes": modes_sweep, "strain-energy": strain_energy_sweep}
    with pytest.raises(ParameterError):
        make[kind](load("five_bar"))
