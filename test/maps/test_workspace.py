# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Laws of the workspace map."""

from __future__ import annotations

import numpy as np
import pytest

from pkm_twin.errors import ParameterError
from pkm_twin.maps import figures
from pkm_twin.maps.kinds.workspace import Workspace, find_circle_radii, find_largest_cylinder
from pkm_twin.maps.run import run
from pkm_twin.maps.search import find_workspace_box
from pkm_twin.maps.store import open_map
from pkm_twin.maps.sweep import plan_map
from pkm_twin.robot.clearance import clearance
from pkm_twin.robot.workspace import MIN_WORKSPACE_INDEX, RAYS_PER_CIRCLE, singularity_of_pose
from stiffness_monitor import reachable
from test.support.robots import load, parameters_of, partly_long

pytestmark = pytest.mark.usefixtures("short")
ROBOTS = ("prru", "delta_cu", "upr_rpu")
TURN = np.linspace(0, 2 * np.pi, 1001)


@pytest.fixture(params=partly_long(ROBOTS, "delta_cu", "upr_rpu"))
def reach_map(request, small_maps):
    with open_map(small_maps[f"workspace {request.param}"]) as data:
        yield load(request.param), data.load()


def values(data, case):
    return data.value.sel(case=case).values


def heights_of(robot):
    low, high = robot.search_box()[robot.pose_names.index(robot.grid().height)]
    return float(low), float(high)


def test_reach_and_singularity_are_those_of_the_library(reach_map):
    robot, data = reach_map
    grid = np.stack(np.meshgrid(*(data[n] for n in robot.pose_names), indexing="ij"), -1)
    inside = reachable(robot, grid)
    assert inside.any()
    index = values(data, "singularity")
    assert (np.isfinite(index) == inside).all()
    q = robot.inverse(grid[inside])
    assert index[inside] == pytest.approx(robot.singularity(q), abs=1e-9)
    low, high = robot.limits.position.T
    assert (q >= low).all()
    assert (q <= high).all()


def test_clearance_is_that_of_the_library(reach_map):
    """It is there wherever the other limits hold."""
    robot, data = reach_map
    grid = np.stack(np.meshgrid(*(data[n] for n in robot.pose_names), indexing="ij"), -1)
    otherwise = reachable(robot, grid, -np.inf)
    gap = values(data, "clearance")
    assert (np.isfinite(gap) == otherwise).all()
    expected = clearance(robot, grid[otherwise])
    assert gap[otherwise] == pytest.approx(expected, abs=1e-12)
    worst = data.isel(case=list(data.case.values).index("clearance"))
    assert str(worst.case_unit.values) == "m"
    assert float(worst.worst_value) <= np.nanmin(gap)
    assert clearance(robot, worst.worst_pose.values) == pytest.approx(float(worst.worst_value))
    assert float(data.interference) == 0.0


def test_the_cylinder_is_reachable_and_no_wider_one_is(reach_map):
    robot, data = reach_map
    low, high, radius = (float(data[f"cylinder_{k}"]) for k in ("low", "high", "radius"))
    heights = data.height.values[(data.height >= low) & (data.height <= high)]
    assert len(heights) > 5

    def whole(factor):
        poses = robot.grid().polar_pose(heights[:, None], factor * radius, TURN)
        return reachable(robot, poses).all()

    assert whole(0.999)
    assert whole(0.5)
    assert not whole(1.002)


@pytest.mark.parametrize("name", partly_long(ROBOTS, "prru"))
def test_circles_end_where_the_first_ray_does(name):
    """Each height alone, its rays one test at a time: whole inside, not whole a hair beyond."""
    robot = load(name)
    heights = np.linspace(*heights_of(robot), 31)
    found = find_circle_radii(robot, heights)
    assert (found > 0.0).sum() > 4
    turn = np.arange(RAYS_PER_CIRCLE) * (2 * np.pi / RAYS_PER_CIRCLE)
    lateral = [robot.pose_names.index(name) for name in robot.grid().lateral]
    step = np.abs(robot.search_box()[lateral]).max() / 340

    def clear(z, distance):
        poses = robot.grid().polar_pose(z, distance, turn)
        return ((singularity_of_pose(robot, poses) >= MIN_WORKSPACE_INDEX) & reachable(robot, poses)).all()

    for z, radius in zip(heights.tolist(), found.tolist(), strict=True):
        if radius == 0.0:
            assert not clear(z, step)
            continue
        for distance in (*np.arange(0.0, radius, 20 * step), radius):
            assert clear(z, distance)
        assert not clear(z, radius + 1e-9)


def test_the_largest_cylinder_is_better_than_all_others(reach_map):
    _, data = reach_map
    z, radius = data.height.values, data.circle.values
    best = float(data.cylinder_radius) ** 2 * float(data.cylinder_high - data.cylinder_low)
    for i in range(0, len(z), max(1, len(z) // 15)):
        for j in range(i + 1, len(z)):
            assert radius[i : j + 1].min() ** 2 * (z[j] - z[i]) <= best * (1 + 1e-12)


def test_no_cylinder_where_nothing_is_reachable():
    far = find_circle_radii(load("delta"), [-5.0, -4.0])
    assert (far == 0.0).all()
    assert find_largest_cylinder(np.array([-5.0, -4.0]), far).radius == 0.0
    assert singularity_of_pose(load("delta"), [[0.0, 0.0, -5.0]]) == [0.0]


@pytest.mark.long
def test_a_bound_on_singularity_takes_away(small_maps, tmp_path):
    sweep = plan_map(load("upr_rpu"), Workspace(), 4000, least_singularity=0.28)
    file = run(sweep, tmp_path / "a.nc", workers=1)
    with open_map(small_maps["workspace upr_rpu"]) as wide, open_map(file) as narrow:
        assert 0 < float(narrow.volume) < float(wide.volume)
        assert float(narrow.cylinder_radius) < float(wide.cylinder_radius)
        assert np.nanmin(values(narrow, "singularity")) >= 0.28
        answer = figures.list_answers(narrow)[0]
        assert answer["value"] == pytest.approx(0.28, rel=1e-3)
        at = singularity_of_pose(sweep.robot, list(answer["pose"].values()))
        assert at == pytest.approx(answer["value"]) and answer["singularity_bound"] == 0.28
        assert (narrow.through.values[0] == list(answer["pose"].values())).all()


@pytest.mark.parametrize("name", partly_long(ROBOTS, "delta_cu"))
@pytest.mark.long
def test_a_bound_on_clearance_takes_away(name, small_maps, tmp_path):
    """Volume, circles and cylinder are those of what is left; the rest is in the file."""
    robot = load(name)
    with open_map(small_maps[f"workspace {name}"]) as data:
        data.load()
    gaps = values(data, "clearance")
    bound = float(np.nanquantile(gaps, 0.1))
    sweep = plan_map(robot, Workspace(), 4000, least_clearance=bound)
    with open_map(run(sweep, tmp_path / "narrow.nc", workers=1)) as left:
        left.load()
    np.testing.assert_array_equal(values(left, "clearance"), gaps)
    kept = np.nan_to_num(gaps, nan=-np.inf) > bound
    assert (np.isfinite(values(left, "singularity")) == kept).all()
    lost = float(left.interference)
    assert 0 < lost < 0.2
    assert f"interfere in {100 * lost:.3g} %" in "\n".join(figures.write_lines(left))
    assert "interfere in" not in "\n".join(figures.write_lines(data))
    assert float(left.volume) == pytest.approx((1 - lost) * float(data.volume))
    assert (left.circle.values <= data.circle.values).all()
    assert left.circle.values == pytest.approx(find_circle_radii(robot, left.height.values, least_clearance=bound))


@pytest.mark.long
def test_the_box_holds_what_interference_takes_away(variant):
    """Limbs so thick that they meet wherever the head tilts far."""
    thin = load("prru")
    limb = parameters_of("prru")["members"]["limb"] | {"outer_diameter": 0.40}
    thick, _ = variant("prru", members={"limb": limb})
    box = find_workspace_box(thin)
    ticks = [np.linspace(low, high, 16) for low, high in box]
    poses = np.stack(np.meshgrid(*ticks, indexing="ij"), -1)
    tilt = np.abs(poses[..., 1:]).max((0, 1, 2))
    assert (np.abs(poses[reachable(thick, poses)])[:, 1:].max(0) < 0.9 * tilt).all()
    assert (find_workspace_box(thick) == box).all()


def test_all_taken_away_is_no_map(tmp_path):
    sweep = plan_map(load("delta"), Workspace(), 4000, least_clearance=0.05)
    with pytest.raises(ParameterError):
        run(sweep, tmp_path / "none.nc", workers=1)
    assert not list(tmp_path.glob("*.nc"))


def test_without_members_there_is_no_clearance(monkeypatch):
    import pkm_twin

    monkeypatch.setattr(type(load("delta")), "beams", ())
    bare = pkm_twin.load("delta")
    assert [case.name for case in plan_map(bare, Workspace(), 4000).cases] == ["singularity"]
    with pytest.raises(ParameterError) as caught:
        plan_map(bare, Workspace(), 4000, least_clearance=0.01)
    assert caught.value.field == "least_clearance"


def test_bounds_are_checked():
    for bad in (
        {"points": 10},
        {"least_singularity": 1.0},
        {"least_clearance": -0.01},
        {"least_clearance": np.inf},
        {"least_clearance": np.nan},
    ):
        with pytest.raises(ParameterError):
            plan_map(load("delta"), Workspace(), **bad)


def test_circles_stay_clear_of_a_constraint_singularity():
    """The Delta-CU's surface, where its Jacobian is sound."""
    robot, least = load("delta_cu"), 0.1
    heights = np.array([-0.28, -0.25])
    found = find_circle_radii(robot, heights, steps=60, least=least)
    assert (found > 0.1).all()
    turn = np.linspace(0, 2 * np.pi, 361)
    grid = robot.grid()
    for z, radius in zip(heights, found, strict=True):
        inside = grid.polar_pose(z, radius * np.linspace(0.0, 0.999, 100)[:, None], turn)
        assert singularity_of_pose(robot, inside).min() > 0.99 * least
        # All are reachable a little beyond, so it is the measure that bounds the circle.
        beyond = grid.polar_pose(z, np.full(361, 1.01 * radius), turn)
        assert reachable(robot, beyond).all()
        assert singularity_of_pose(robot, beyond).min() < least
        jacobian = robot.jacobian(robot.inverse(beyond))
        assert (1.0 / np.linalg.cond(jacobian)).min() > 2 * least
