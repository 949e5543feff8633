# SPDX-License-Identifier: Apache-2.0
"""Laws of the workspace atlas."""

from __future__ import annotations

import numpy as np
import pytest

from pkm_twin.atlas import workspace
from pkm_twin.atlas.grids import circles, height_range, largest_cylinder, largest_distance, nice
from pkm_twin.atlas.run import run
from pkm_twin.atlas.store import open_atlas
from pkm_twin.atlas.workspace.sweep import workspace_sweep
from pkm_twin.errors import ParameterError
from pkm_twin.robot.clearance import clearance
from pkm_twin.robot.workspace import CLEAR, RAYS, singularity_at
from stiffness_monitor import reachable, regular_workspace
from test.atlas.conftest import LAYERS
from test.support.robots import load, parameters_of, partly_long

ROBOTS = ("prru", "delta_cu", "upr_rpu")
TURN = np.linspace(0, 2 * np.pi, 1001)


@pytest.fixture(params=partly_long([r + w for w in ("", " whole") for r in ROBOTS], *ROBOTS))
def reach_atlas(request, small_atlases):
    with open_atlas(small_atlases[f"workspace {request.param}"]) as data:
        yield load(request.param.split()[0]), data.load()


@pytest.fixture
def few_layers(monkeypatch):
    monkeypatch.setattr(workspace.sweep, "LAYERS", LAYERS)


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


def test_clearance_is_that_of_the_library(reach_atlas):
    """It is there wherever the other limits hold."""
    robot, data = reach_atlas
    grid = np.stack(np.meshgrid(*(data[n] for n in robot.pose_names), indexing="ij"), -1)
    otherwise = reachable(robot, grid, -np.inf)
    assert (np.isfinite(data.clearance.values) == otherwise).all()
    expected = clearance(robot, grid[otherwise])
    assert data.clearance.values[otherwise] == pytest.approx(expected, abs=1e-12)
    assert data.clearance.attrs["units"] == "m"
    assert float(data.interference) == 0.0


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
        poses = robot.grid().polar_pose(heights[:, None], factor * radius, TURN)
        return reachable(robot, poses).all()

    assert whole(0.999)
    assert whole(0.5)
    assert not whole(1.002)


@pytest.mark.parametrize("name", ROBOTS)
def test_circles_end_where_the_first_ray_does(name):
    """Each height alone, its rays one test at a time: whole inside, not whole a hair beyond."""
    robot = load(name)
    low, high = height_range(robot)
    found = circles(robot, np.linspace(low, high, 31))
    assert (found.radius > 0.0).sum() > 4
    turn = np.arange(RAYS) * (2 * np.pi / RAYS)
    step = largest_distance(robot) / 340

    def clear(z, distance):
        poses = robot.grid().polar_pose(z, distance, turn)
        return ((singularity_at(robot, poses) >= CLEAR) & reachable(robot, poses)).all()

    for z, radius in zip(found.z.tolist(), found.radius.tolist(), strict=True):
        if radius == 0.0:
            assert not clear(z, step)
            continue
        for distance in (*np.arange(0.0, radius, 20 * step), radius):
            assert clear(z, distance)
        assert not clear(z, radius + 1e-9)


def test_circles_of_the_upr_rpu_are_those_of_the_regular_workspace():
    """Whatever the steps of the search."""
    robot = load("upr_rpu")
    regular = regular_workspace(robot, np.arange(-1.0, -0.24, 0.15))
    found = circles(robot, regular.z)
    assert found.radius == pytest.approx(regular.radius, abs=1e-8)


def test_the_largest_cylinder_is_better_than_all_others(reach_atlas):
    _, data = reach_atlas
    z, radius = data.height.values, data.circle.values
    best = float(data.cylinder_radius) ** 2 * float(data.cylinder_high - data.cylinder_low)
    for i in range(0, len(z), max(1, len(z) // 15)):
        for j in range(i + 1, len(z)):
            assert radius[i : j + 1].min() ** 2 * (z[j] - z[i]) <= best * (1 + 1e-12)


def test_no_cylinder_where_nothing_is_reachable():
    far = circles(load("delta"), [-5.0, -4.0])
    assert (far.radius == 0.0).all()
    assert largest_cylinder(far).radius == 0.0
    assert singularity_at(load("delta"), [[0.0, 0.0, -5.0]]) == [0.0]


def test_a_bound_on_singularity_takes_away(small_atlases, tmp_path, few_layers):
    sweep = workspace_sweep(load("upr_rpu"), 4000, least_singularity=0.2)
    file = run(sweep, tmp_path / "a.nc", workers=1)
    with open_atlas(small_atlases["workspace upr_rpu"]) as wide, open_atlas(file) as narrow:
        assert 0 < float(narrow.volume) < float(wide.volume)
        assert float(narrow.cylinder_radius) < float(wide.cylinder_radius)
        assert float(narrow.singularity.min()) >= 0.2


@pytest.mark.parametrize("name", partly_long(ROBOTS, "delta_cu"))
def test_a_bound_on_clearance_takes_away(name, small_atlases, tmp_path, few_layers):
    """Volume, circles and cylinder are those of what is left; the rest is in the file."""
    robot = load(name)
    with open_atlas(small_atlases[f"workspace {name}"]) as data:
        data.load()
    gaps = data.clearance.values
    bound = float(np.nanquantile(gaps, 0.1))
    sweep = workspace_sweep(robot, 4000, least_clearance=bound)
    with open_atlas(run(sweep, tmp_path / "narrow.nc", workers=1)) as left:
        left.load()
    assert (left.clearance.values[np.isfinite(gaps)] == gaps[np.isfinite(gaps)]).all()
    kept = np.nan_to_num(gaps, nan=-np.inf) > bound
    assert (left.reachable.values == kept).all()
    assert (np.isfinite(left.singularity.values) == kept).all()
    lost = float(left.interference)
    assert 0 < lost < 0.2
    assert float(left.volume) == pytest.approx((1 - lost) * float(data.volume))
    assert (left.circle.values <= data.circle.values).all()
    assert left.circle.values == pytest.approx(
        circles(robot, left.height.values, least_clearance=bound).radius
    )
    assert not left.equals(data)


def test_the_box_holds_what_interference_takes_away(variant):
    """Limbs so thick that they meet wherever the head tilts far."""
    thin = load("prru")
    limb = parameters_of("prru")["members"]["limb"] | {"outer_diameter": 0.40}
    thick, _ = variant("prru", members={"limb": limb})
    poses = np.stack(np.meshgrid(*workspace_sweep(thin, 4000).axes, indexing="ij"), -1)
    tilt = np.abs(poses[..., 1:]).max((0, 1, 2))
    assert (np.abs(poses[reachable(thick, poses)])[:, 1:].max(0) < 0.9 * tilt).all()
    for one, other in zip(
        workspace_sweep(thick, 4000).axes, workspace_sweep(thin, 4000).axes, strict=True
    ):
        assert (one == other).all()


def test_pictures_show_what_interference_takes_away(small_atlases, tmp_path, few_layers):
    """A name for the hatching, in words that say why."""
    from matplotlib import pyplot

    from pkm_twin.atlas import kinds

    sweep = workspace_sweep(load("delta"), 8000, least_clearance=0.03)
    for file, words, least in (
        (small_atlases["workspace delta"], "limbs meet nowhere", 0.0),
        (run(sweep, tmp_path / "a.nc", workers=1), "limbs are within 30 mm in ", 0.03),
    ):
        with open_atlas(file) as data:
            figure = kinds.draw(data)["sections"]
        assert words in figure.get_suptitle()
        legends = [ax.get_legend() for ax in figure.axes if ax.get_legend()]
        texts = {text.get_text() for legend in legends for text in legend.get_texts()}
        hatched = {"lost: limbs are within 30 mm", "for some z limbs are within 30 mm"}
        assert (texts & hatched) == (hatched if least else set())
        pyplot.close(figure)


def test_all_taken_away_is_still_an_atlas(tmp_path, few_layers):
    from matplotlib import pyplot

    from pkm_twin.atlas import kinds

    sweep = workspace_sweep(load("delta"), 4000, least_clearance=0.05)
    with open_atlas(run(sweep, tmp_path / "none.nc", workers=1)) as data:
        assert float(data.volume) == 0.0
        assert float(data.interference) == 1.0
        assert float(data.cylinder_radius) == 0.0
        pyplot.close(kinds.draw(data)["sections"])


def test_without_members_there_is_no_clearance(small_atlases, tmp_path, few_layers, monkeypatch):
    from matplotlib import pyplot

    import pkm_twin
    from pkm_twin.atlas import kinds

    robot = pkm_twin.load("delta")
    whole = small_atlases["workspace delta"]
    monkeypatch.setattr(type(robot), "beams", ())
    bare = run(workspace_sweep(pkm_twin.load("delta"), 4000), tmp_path / "bare.nc", workers=1)
    with open_atlas(whole) as one, open_atlas(bare) as other:
        assert set(one.variables) - set(other.variables) == {"clearance", "interference"}
        for variable in other.variables:
            assert one[variable].equals(other[variable])
        figure = kinds.draw(other)["sections"]
        assert "limbs" not in figure.get_suptitle()
        pyplot.close(figure)
    with pytest.raises(ParameterError) as caught:
        workspace_sweep(pkm_twin.load("delta"), 4000, least_clearance=0.01)
    assert caught.value.field == "least_clearance"


def test_nice():
    assert [nice(v) for v in (0.07, 0.05, 0.0499, 1.0, 19.0)] == [0.05, 0.05, 0.02, 1.0, 10.0]


def test_refusals():
    with pytest.raises(ParameterError):
        workspace_sweep(load("delta"), 10)
    with pytest.raises(ParameterError):
        workspace_sweep(load("delta"), least_singularity=1.0)
    for bad in (-0.01, np.inf, np.nan):
        with pytest.raises(ParameterError):
            workspace_sweep(load("delta"), least_clearance=bad)


def test_circles_stay_clear_of_a_constraint_singularity():
    """The Delta-CU's surface, where its Jacobian is sound."""
    robot, least = load("delta_cu"), 0.1
    heights = np.array([-0.28, -0.25])
    found = circles(robot, heights, steps=60, least=least)
    assert (found.radius > 0.1).all()
    turn = np.linspace(0, 2 * np.pi, 361)
    grid = robot.grid()
    for z, radius in zip(heights, found.radius, strict=True):
        inside = grid.polar_pose(z, radius * np.linspace(0.0, 0.999, 100)[:, None], turn)
        assert singularity_at(robot, inside).min() > 0.99 * least
        # All are reachable a little beyond, so it is the measure that bounds the circle.
        beyond = grid.polar_pose(z, np.full(361, 1.01 * radius), turn)
        assert reachable(robot, beyond).all()
        assert singularity_at(robot, beyond).min() < least
        jacobian = robot.jacobian(robot.inverse(beyond))
        assert (1.0 / np.linalg.cond(jacobian)).min() > 2 * least
