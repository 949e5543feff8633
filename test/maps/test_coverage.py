# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The default map of every robot holds all that it reaches, whatever its pose coordinates are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pkm_twin import robot_names
from pkm_twin.errors import ParameterError
from pkm_twin.maps import figures
from pkm_twin.maps.kinds.workspace import Workspace
from pkm_twin.maps.page import write_page
from pkm_twin.maps.run import run
from pkm_twin.maps.search import find_workspace_box
from pkm_twin.maps.store import open_map
from pkm_twin.maps.sweep import plan_map
from pkm_twin.mechanisms.catalogue import robot_of_data
from pkm_twin.robot.workspace import reachable, singularity_of_pose, try_forward
from test.support.robots import SHIPPED, load, often, partly_long


def reached(robot, rng, count):
    """Reachable poses of random joint states between the limits."""
    low, high = robot.limits.position.T
    poses, good = try_forward(robot, rng.uniform(low, high, (count, len(low))))
    poses = poses[good]
    poses = poses[reachable(robot, poses)]
    assert len(poses) > count / 10
    return poses


@pytest.mark.parametrize("count", often(20_000, 100_000))
@pytest.mark.parametrize("name", partly_long(robot_names(), "delta_cu", "five_bar"))
def test_the_default_map_holds_all_that_is_reachable(name, count, rng):
    robot = load(name)
    poses = reached(robot, rng, count)
    bounds = find_workspace_box(robot)
    assert len(bounds) == len(robot.pose_names)
    for k, (low, high) in enumerate(bounds):
        assert low <= poses[:, k].min()
        assert poses[:, k].max() <= high
        # And little else: the grid is not spent on what is empty.
        assert np.ptp(poses[:, k]) > 0.4 * (high - low)
    box = robot.search_box()
    assert ((box[:, 0] <= poses) & (poses <= box[:, 1])).all()


# A box of two and of three coordinates, and one about an axis; by default the first.
VOLUMES = partly_long([n for n, robot in SHIPPED.items() if len(robot.pose_names) in (2, 3)], "five_bar")


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("count", often(40_000, 200_000))
@pytest.mark.parametrize("name", VOLUMES)
def test_the_volume_is_that_of_random_poses(name, count, rng, tmp_path):
    """By Monte Carlo in the search box, which the map's own box has no part in."""
    robot = load(name)
    low, high = robot.search_box().T
    share = reachable(robot, rng.uniform(low, high, (count, len(low)))).mean()
    sweep = plan_map(robot, Workspace(), 14_000)
    with open_map(run(sweep, tmp_path / "a.nc", workers=1)) as data:
        expected = share * np.prod(high - low)
        assert float(data.volume) == pytest.approx(expected, rel=0.06)


@pytest.mark.usefixtures("short")
def test_of_one_coordinate_the_map_tells_its_range(tmp_path):
    """Of an arm about one axis, which has no area."""
    joint = {"type": "revolute", "between": ["base", "arm"], "at": [0, 0, 0], "axis": [0, 1, 0], "actuated": True}
    arm = {"mass": 1.0, "com": [0.2, 0, 0], "inertia": [0.01, 0.01, 0.01]}
    data = {"mechanism": "machine", "platform": "arm", "origin": [0.4, 0, 0], "pose": ["pitch"], "bodies": {"arm": arm}}
    data["joints"] = {"hub": joint | {"limits": {"position": [-0.5, 0.7]}}}
    sweep = plan_map(robot_of_data(data, "arm"), Workspace(), 2000)
    with open_map(run(sweep, tmp_path / "a.nc", workers=1)) as found:
        assert float(found.volume) == pytest.approx(1.2, rel=0.01)
        assert "range of the reachable pitch" in Workspace.facts(found)[0]


@pytest.mark.parametrize("name", robot_names())
def test_on_the_axis_of_a_cylinder_the_azimuth_means_nothing(name):
    """The coordinates stand where the names say."""
    grid = load(name).grid()
    if grid.kind == "box":
        with pytest.raises(ValueError, match="no height"):
            grid.polar_pose(0.0, 0.0, 0.0)
        return
    on_axis = grid.polar_pose(0.1, 0.0, [0.0, 2.0])
    assert on_axis == pytest.approx(np.array([[0.1 * (n == grid.height) for n in grid.names]] * 2))


@pytest.mark.parametrize(
    "name",
    partly_long([n for n, robot in SHIPPED.items() if robot.grid().kind == "box"], "five_bar"),
)
def test_planes_of_every_number_of_coordinates(name, tmp_path, monkeypatch):
    """Through the least singularity index: values are those of the poses that planes have."""
    from matplotlib import pyplot

    monkeypatch.setattr("pkm_twin.maps.sweep.GRID_SIDE", 21)
    robot = load(name)
    size = len(robot.pose_names)
    with open_map(run(plan_map(robot, Workspace(), 3000), tmp_path / "a.nc", workers=1)) as data:
        data.load()
        assert "circle" not in data
        assert data.sizes["plane"] == max(1, size * (size - 1) // 2)
        for figure in figures.draw(data).values():
            assert 1 <= sum(bool(ax.get_xlabel()) for ax in figure.axes) <= figures.MAX_PANELS
            pyplot.close(figure)
        pytest.importorskip("plotly")
        assert "Plotly.newPlot" in write_page(data, tmp_path / "a.html").read_text()
    names = list(robot.pose_names)
    through = data.through.values[0]
    index = singularity_of_pose(robot, through)
    assert index == pytest.approx(float(data.worst_value[0]), rel=1e-6)
    assert index == pytest.approx(float(data.plane_value[0, ..., 0].min()), rel=1e-6)
    for k in range(data.sizes["plane"]):
        part = data.isel(plane=k, case=0)
        grid = np.tile(through, (part.sizes["row"], part.sizes["column"], 1))
        grid[..., names.index(str(part.row_name.values))] = part.row_value.values[:, None]
        if size > 1:
            grid[..., names.index(str(part.column_name.values))] = part.column_value.values
        inside = reachable(robot, grid)
        assert inside.any()
        assert (np.isfinite(part.plane_value.values) == inside).all()
        expected = singularity_of_pose(robot, grid[inside])
        assert part.plane_value.values[inside] == pytest.approx(expected, abs=1e-9)
    if size > 3:
        kept = np.isfinite(data.value.values[:, 0])
        at = singularity_of_pose(robot, data.pose.values[kept])
        assert data.value.values[kept, 0] == pytest.approx(at, abs=1e-9)


@pytest.mark.parametrize(("name", "key"), [("prru", "position"), ("upr_rpu", "limb_length")])
def test_a_workspace_without_end_is_refused(name, key):
    robot = load(name)
    endless = replace(robot, limits=replace(robot.limits, **{key: None}))
    with pytest.raises(ParameterError, match=rf"limits\.{key}"):
        plan_map(endless, Workspace())
