# SPDX-License-Identifier: Apache-2.0
"""Laws of the workspace atlas."""

from __future__ import annotations

import numpy as np
import pytest

from pkm_twin import load
from pkm_twin.atlas import workspace
from pkm_twin.atlas.grids import circles, largest_cylinder, nice, polar_pose, singularity
from pkm_twin.atlas.run import run
from pkm_twin.atlas.store import open_atlas
from pkm_twin.atlas.workspace import workspace_sweep
from pkm_twin.errors import ParameterError
from stiffness_monitor import reachable, regular_workspace

ROBOTS = ("prru", "delta_cu", "upr_rpu")
TURN = np.linspace(0, 2 * np.pi, 1001)


@pytest.fixture(params=ROBOTS)
def reach_atlas(request, small_atlases):
    with open_atlas(small_atlases[f"workspace {request.param}"]) as data:
        yield load(request.param), data.load()


def test_reach_and_singularity_are_those_of_the_library(reach_atlas):
    robot, data = reach_atlas
    grid = np.stack(np.meshgrid(*(data[n] for n in robot.pose_names), indexing="ij"), -1)
    inside = reachable(robot, grid)
    assert inside.any()
    assert (data.reachable.values == inside).all()
    assert (np.isfinite(data.singularity.values) == inside).all()
    q = robot.inverse(grid[inside])
    assert data.singularity.values[inside] == pytest.approx(robot.singularity(q), abs=1e-9)
    low, high = robot.limits.position.T
    assert (q >= low).all()
    assert (q <= high).all()


def test_the_box_holds_all_that_is_reachable(reach_atlas):
    """Nothing is reachable on its sides."""
    _, data = reach_atlas
    inside = data.reachable.values
    for axis in range(3):
        assert not inside.take([0, -1], axis).any()


def test_the_cylinder_is_reachable_and_no_wider_one_is(reach_atlas):
    robot, data = reach_atlas
    low, high, radius = (float(data[f"cylinder_{k}"]) for k in ("low", "high", "radius"))
    heights = data.height.values[(data.height >= low) & (data.height <= high)]
    assert len(heights) > 5

    def whole(factor):
        poses = polar_pose(robot, heights[:, None], factor * radius, TURN)
        return reachable(robot, poses).all()

    assert whole(0.999)
    assert whole(0.5)
    assert not whole(1.002)


def test_circles_of_the_upr_rpu_are_those_of_the_regular_workspace():
    robot = load("upr_rpu")
    regular = regular_workspace(robot, np.arange(-1.0, -0.24, 0.05))
    found = circles(robot, regular.z)
    assert found.radius == pytest.approx(regular.radius, abs=1e-8)


def test_the_largest_cylinder_is_better_than_all_others(reach_atlas):
    _, data = reach_atlas
    z, radius = data.height.values, data.circle.values
    best = float(data.cylinder_radius) ** 2 * float(data.cylinder_high - data.cylinder_low)
    for i in range(0, len(z), 7):
        for j in range(i + 1, len(z)):
            assert radius[i : j + 1].min() ** 2 * (z[j] - z[i]) <= best * (1 + 1e-12)


def test_no_cylinder_where_nothing_is_reachable():
    far = circles(load("delta"), [-5.0, -4.0])
    assert (far.radius == 0.0).all()
    assert largest_cylinder(far).radius == 0.0
    assert singularity(load("delta"), [[0.0, 0.0, -5.0]]) == [0.0]


def test_a_bound_on_singularity_takes_away(tmp_path, monkeypatch):
    monkeypatch.setattr(workspace, "LAYERS", 15)
    robot = load("upr_rpu")
    files = [
        run(
            workspace_sweep(robot, 4000, least_singularity=least),
            tmp_path / f"{least}.nc",
            workers=1,
        )
        for least in (0.0, 0.3)
    ]
    with open_atlas(files[0]) as wide, open_atlas(files[1]) as narrow:
        assert 0 < float(narrow.volume) < float(wide.volume)
        assert float(narrow.cylinder_radius) < float(wide.cylinder_radius)
        assert float(narrow.singularity.min()) >= 0.3


def test_nice():
    assert [nice(v) for v in (0.07, 0.05, 0.0499, 1.0, 19.0)] == [0.05, 0.05, 0.02, 1.0, 10.0]


def test_refusals():
    with pytest.raises(ParameterError):
        workspace_sweep(load("delta"), 10)
    with pytest.raises(ParameterError):
        workspace_sweep(load("delta"), least_singularity=1.0)
