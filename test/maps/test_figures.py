# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Pictures of stored maps, and what pages hold."""

from __future__ import annotations

import html
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from pkm_twin.errors import UnknownNameError
from pkm_twin.maps import figures
from pkm_twin.maps.kinds import KINDS, modes
from pkm_twin.maps.kinds.modes import deform_nodes, find_ground_nodes, structure_edges
from pkm_twin.maps.page import write_page
from pkm_twin.maps.store import open_map
from pkm_twin.report import plots
from stiffness_monitor.modes import modes as modes_of
from stiffness_monitor.structure import structural_model
from test.support.robots import load, partly_long

MODES = "modes upr_rpu"
STORED = partly_long(
    [
        "compliance delta",
        "payload stewart",
        "acceleration five_bar",
        "workspace delta_cu",
        "strain-energy upr_rpu",
        "isotropy prru",
        MODES,
    ],
    "compliance delta",
    "payload stewart",
    "acceleration five_bar",
    MODES,
)


@pytest.fixture(params=STORED)
def stored(request, small_maps):
    with open_map(small_maps[request.param]) as data:
        yield data.load()


def test_a_picture_answers_and_the_star_has_its_cells_colour(stored):
    from matplotlib import pyplot

    told = {one["case"]: one for one in figures.list_answers(stored)}
    drawn = figures.draw(stored)
    for name in map(str, stored.case.values):
        figure = drawn[name if len(stored.case) > 1 else ""]
        panels = [ax for ax in figure.axes if ax.get_xlabel()]
        assert 1 <= len(panels) <= figures.MAX_PANELS
        assert all(ax.get_ylabel() for ax in panels)
        # At 900 pixels of width.
        texts = [t for ax in panels for t in (ax.title, ax.xaxis.label, *ax.get_xticklabels())]
        sizes = [text.get_fontsize() for text in [*texts, *(t for ax in panels for t in ax.texts)]]
        assert min(sizes) * 900 / plots.WIDTH / 72 >= 10.6
        if name not in told:
            continue
        assert figures.write_sentence(told[name]).split(",")[0] in figure.get_suptitle()
        value = told[name]["value"]
        limits = set()
        for ax in panels:
            (mesh,) = [c for c in ax.collections if type(c).__name__ == "QuadMesh"]
            (star,) = [line for line in ax.lines if line.get_marker() == "*"]
            low, high = mesh.get_clim()
            limits.add((low, high))
            corners, colours = mesh.get_coordinates(), mesh.get_array()
            colours = colours.reshape(corners.shape[0] - 1, -1)
            x, y = star.get_xydata()[0]
            column = np.searchsorted(corners[0, :, 0], x) - 1
            row = np.searchsorted(corners[:, 0, 1], y) - 1
            factor = colours[row, column] / value
            prefixes = [10.0**-power for power in figures.PREFIXES]
            assert np.isclose([*prefixes, 180 / np.pi], factor, rtol=1e-9).any()
            assert low * (1 - 1e-12) <= colours[row, column]
            assert star.get_markerfacecolor() == mesh.to_rgba(colours[row, column])
            # Colours end below the largest value only with an arrow on their bar.
            beyond = mesh.get_array().max() > high * (1 + 1e-12)
            (bar,) = {one.colorbar for a in panels for one in a.collections} - {None}
            assert bar.extend == ("max" if beyond else "neither")
        # One scale, from 0 or from the least that is drawn.
        assert len(limits) == 1
    for figure in drawn.values():
        pyplot.close(figure)


def test_a_long_title_is_wrapped_and_keeps_values_with_their_units():
    figure, _ = plots.make_subplots(1, 1)
    words = " ".join(f"part_{k} bears {k}.25 N m;" for k in range(9))
    count = plots.write_title(figure, words)
    rows = figure.get_suptitle().split("\n")
    assert count == len(rows) > 1 and max(map(len, rows)) < 90
    assert " ".join(rows) == words
    assert not any(row.endswith(("25", "N")) for row in rows)
    plots.render(figure, 20)


@pytest.mark.parametrize(("seconds", "panels"), [(2.0, 2), (20.0, 4)])
def test_efforts_have_their_residual_and_a_long_motion_the_seconds_of_its_peak(seconds, panels):
    from matplotlib import pyplot

    robot, time = load("five_bar"), np.linspace(0.0, seconds, 401)
    table = {"time": time}
    for joint in robot.joint_names:
        effort = np.exp(-((time - 0.7 * seconds) ** 2))
        table |= {f"{joint}.effort": effort, f"{joint}.measured": effort + 0.01}
        table |= {f"{joint}.effort_{term}": 0.0 * effort for term in plots.TERMS}
    figure = plots.draw_torques(dict(zip(robot.joint_names, robot.effort_units, strict=True)), table, "title")
    assert len(figure.axes) == panels
    for ax in figure.axes:
        (residual,) = [one for one in ax.lines if one.get_label() == "measured - sum"]
        assert residual.get_ydata() == pytest.approx(0.01)
    low, high = figure.axes[-1].get_xlim()
    assert low < 0.7 * seconds < high and high - low < 2.5
    pyplot.close(figure)


@pytest.mark.parametrize(
    ("values", "worst", "ends"),
    [
        ([1.0, 5.0], 9.0, (0.0, 9.0)),
        ([7.0, 9.0], 6.5, (6.5, 9.0)),
        ([-1.0, 3.0], -2.0, (-2.0, 3.0)),
        ([2.0, 2.0], np.nan, (2.0, 4.0)),
        ([np.nan], np.nan, (0.0, 1.0)),
        ([0.5, *[1.0] * 39, 10.0], 12.0, (0.0, 1.0)),
    ],
)
def test_a_scale_begins_at_zero_or_at_the_least_with_the_worst_inside(values, worst, ends):
    assert figures.choose_colour_limits(np.array(values), worst) == ends


def test_shapes_are_those_of_the_pose_that_rings_lowest(small_maps):
    robot = load("upr_rpu")
    with open_map(small_maps[MODES]) as data:
        found = modes_of(robot, data.through.values[0], modes.MODE_COUNT)
        assert data.shape_frequency.values == pytest.approx(found.frequencies, rel=1e-9)
        assert data.worst_value.values == pytest.approx(found.frequencies, rel=1e-9)
        assert data.displacement.values == pytest.approx(found.shapes[..., :3], rel=1e-9, abs=1e-9)
        assert data.strain_share.values == pytest.approx(found.energies.strain, abs=1e-9)
        rest = data.position.values
        size = np.linalg.norm(np.ptp(rest, axis=0))
        for mode in range(modes.MODE_COUNT):
            moved, far = deform_nodes(data, mode)
            steps = np.linalg.norm(moved - rest, axis=1)
            assert steps.max() == pytest.approx(modes.MAX_DRAWN_DISPLACEMENT * size)
            assert far == pytest.approx(steps / steps.max())
        pytest.importorskip("plotly")
        page = KINDS["modes"].page(data)
        frames = {frame.name: frame.data[0] for frame in page.frames}
        assert len(frames) == modes.MODE_COUNT * modes.FRAMES_PER_SWING
        # Half a swing later the shape is on the other side of rest.
        one, other = (
            np.array([v for v in frames[f"3/{n}"].x if v is not None]) for n in (0, modes.FRAMES_PER_SWING // 2)
        )
        still = np.array([v for v in page.data[0].x if v is not None])
        assert one + other == pytest.approx(2 * still, abs=2e-5)
        assert np.abs(one - still).max() > 1e-3
        assert list(page.layout.updatemenus[0].buttons[3].args[0]["x"][0]) == list(frames["3/0"].x)
        ground = find_ground_nodes(data)
        assert [str(n).rpartition(" ")[2] for n in data.node.values[ground]] == ["0/8"] * 3


@pytest.mark.parametrize("name", partly_long(["prru", "delta_cu", "upr_rpu"], "delta_cu"))
def test_lines_join_the_whole_frame(name):
    """Every node is in one figure of lines; the platform's rim closes in any order of members."""
    robot = load(name)
    model, found = structural_model(robot, robot.graph.home), modes_of(robot, robot.home(), 1)
    for parts in (model.parts, (*model.parts[::2], *model.parts[1::2])):
        lines = structure_edges(replace(model, parts=parts), found.nodes)
        group = np.arange(len(found.nodes))
        for _ in found.nodes:
            for a, b in lines:
                group[group == group[a]] = group[b]
        assert len(set(group.tolist())) == 1
        spokes = sorted(int(b) for a, b in lines if a == 0)
        rim = [pair for pair in lines.tolist() if set(pair) <= set(spokes)]
        assert len(rim) == len(spokes) >= 3
        assert sorted(node for pair in rim for node in pair) == sorted(spokes * 2)


def test_kinds_of_another_version_are_named(small_maps):
    with open_map(small_maps["acceleration five_bar"]) as data:
        data.attrs["kind"] = "weather"
        with pytest.raises(UnknownNameError):
            figures.draw(data)


class Links(HTMLParser):
    """What the tags of a page would load; text inside scripts is none."""

    def __init__(self):
        super().__init__()
        self.tags, self.found = set(), []

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.found += [value for key, value in attrs if key in ("src", "href", "data", "action")]


def test_pages_hold_all_they_need(stored, tmp_path):
    """Also the picture's answer, star and value."""
    pytest.importorskip("plotly")
    text = write_page(stored, tmp_path / "page.html").read_text()
    assert "Plotly.newPlot" in text
    links = Links()
    links.feed(text)
    assert links.tags >= {"html", "h1", "script"}
    assert links.found == []
    assert '"showSendToCloud": false' in text
    assert 1_000_000 < len(text) < 9_000_000
    for answer in figures.list_answers(stored):
        assert html.escape(figures.write_sentence(answer)) in text
