# SPDX-License-Identifier: Apache-2.0
"""Pictures and pages of every kind of atlas."""

from __future__ import annotations

import functools
from html.parser import HTMLParser

import numpy as np
import pytest
from typer.testing import CliRunner

from pkm_twin.atlas import isotropy, kinds, modes, strain_energy, workspace
from pkm_twin.atlas.store import open_atlas
from pkm_twin.errors import UnknownNameError
from test.support.robots import partly_long

MODES = partly_long(["modes prru", "modes delta_cu", "modes upr_rpu"], "modes upr_rpu")
KINDS = partly_long(
    [
        "coarse-energy upr_rpu",
        "isotropy prru",
        "isotropy delta_cu",
        "workspace prru",
        "workspace delta_cu",
        "workspace upr_rpu",
    ],
    "coarse-energy upr_rpu",
    "isotropy prru",
    "workspace delta_cu",
)


@pytest.mark.parametrize("name", [*KINDS, *MODES])
def test_all_figures_have_axes_with_labels(name, small_atlases):
    from matplotlib import pyplot

    with open_atlas(small_atlases[name]) as data:
        drawn = kinds.draw(data)
    assert drawn
    for figure in drawn.values():
        assert figure.get_suptitle()
        assert figure.axes
        for ax in figure.axes:
            assert ax.get_xlabel() or ax.get_ylabel()
        pyplot.close(figure)


LONG = functools.partial(pytest.param, marks=pytest.mark.long)


@pytest.mark.parametrize(
    ("name", "draw"),
    [
        ("coarse-energy upr_rpu", strain_energy.figures.plane),
        LONG("coarse-energy upr_rpu", strain_energy.figures.global_factors),
        ("isotropy prru", isotropy.figures.spheres),
        LONG("isotropy delta_cu", isotropy.figures.spread_over_poses),
        LONG("workspace prru", workspace.figures.section),
        ("workspace delta_cu", workspace.figures.closest),
        ("modes upr_rpu", modes.figures.frequency),
        LONG("modes delta_cu", modes.figures.frequency_range),
    ],
)
def test_functions_draw_on_given_axes_or_their_own(name, draw, small_atlases):
    from matplotlib import pyplot

    with open_atlas(small_atlases[name]) as data:
        _, ax = pyplot.subplots()
        assert draw(data, ax=ax) is ax
        own = draw(data)
        assert own is not ax
        assert own.get_xlabel()
    pyplot.close("all")


@pytest.mark.parametrize(
    ("name", "draw"),
    [
        ("coarse-energy upr_rpu", strain_energy.figures.stack),
        ("modes prru", modes.figures.mode_shape),
    ],
)
def test_functions_draw_on_given_axes_in_space_or_their_own(name, draw, small_atlases):
    from matplotlib import pyplot

    with open_atlas(small_atlases[name]) as data:
        ax = pyplot.figure().add_subplot(projection="3d")
        assert draw(data, ax=ax) is ax
        own = draw(data)
        assert own is not ax
        assert own.get_zlabel()
    pyplot.close("all")


@pytest.mark.parametrize("name", MODES)
def test_a_drawn_mode_is_the_stored_shape_enlarged(name, small_atlases):
    with open_atlas(small_atlases[name]) as data:
        rest = data.position.values
        size = np.linalg.norm(np.ptp(rest, axis=0))
        for mode in data.mode.values.tolist():
            moved, far = modes.stored.deformed(data, mode)
            steps = np.linalg.norm(moved - rest, axis=1)
            assert steps.max() == pytest.approx(modes.stored.ENLARGED * size)
            assert far == pytest.approx(steps / steps.max())
            shape = data.displacement.sel(mode=mode).values
            assert np.cross(moved - rest, shape) == pytest.approx(np.zeros_like(rest), abs=1e-12)


@pytest.mark.parametrize("name", MODES)
def test_a_machine_stands_on_the_ground_with_its_three_limbs(name, small_atlases):
    with open_atlas(small_atlases[name]) as data:
        ground = modes.stored.grounded(data)
        assert [str(n).rpartition(" ")[2] for n in data.node.values[ground]] == ["0/8"] * 3


def test_the_title_of_a_mode_names_the_parts_that_hold_most_energy(small_atlases):
    with open_atlas(small_atlases["modes upr_rpu"]) as data:
        share = data.strain_share.sel(mode=1)
        first = str(data.element.values[np.argmax(share.values)])
        text = modes.stored.largest_shares(data, 1)
        assert text.startswith(f"{first} {100 * float(share.max()):.0f} %")
        title = modes.figures.mode_shape(data, 1).get_title()
        assert text in title
        assert f"{float(data.shape_frequency.sel(mode=1)):.4g} Hz" in title


def test_a_sphere_is_seen_from_its_side():
    """The middle of the picture is the value towards the viewer; colours are the field's."""
    polar, turn = np.linspace(0, np.pi, 91), np.arange(180) * (2 * np.pi / 180)
    theta, phi = np.meshgrid(polar, turn, indexing="ij")
    x = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    for k in range(3):
        image = isotropy.figures.sphere_image(x[..., k], polar, turn)
        middle = isotropy.figures.PIXELS // 2
        assert image[middle, middle] == pytest.approx(isotropy.figures.VIEW[k], abs=1e-3)
        # Beyond the rim, which cuts the picture off, the rim's value goes on.
        right, up = isotropy.figures._view()
        assert image[0, 0] == pytest.approx(-(right + up)[k] / np.sqrt(2), abs=1e-3)
        assert np.abs(image).max() <= 1.0


def test_kinds_without_pictures_are_refused(small_atlases):
    with open_atlas(small_atlases["coarse-energy upr_rpu"]) as data:
        data.attrs["kind"] = "weather"
        with pytest.raises(UnknownNameError):
            kinds.draw(data)


class Links(HTMLParser):
    """What the tags of a page would load; text inside scripts is none."""

    def __init__(self):
        super().__init__()
        self.tags, self.found = set(), []

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.found += [value for key, value in attrs if key in ("src", "href", "data", "action")]


@pytest.mark.parametrize("name", [*KINDS, *MODES])
def test_pages_hold_all_they_need(name, small_atlases, tmp_path):
    pytest.importorskip("plotly")
    from pkm_twin.atlas.kinds import write_page

    with open_atlas(small_atlases[name]) as data:
        text = write_page(data, tmp_path / "page.html").read_text()
    assert "Plotly.newPlot" in text
    links = Links()
    links.feed(text)
    assert links.tags >= {"html", "main", "script"}
    assert links.found == []
    assert '"showSendToCloud": false' in text
    assert 1_000_000 < len(text) < 9_000_000


@pytest.mark.parametrize("name", MODES)
def test_show_writes_the_page_of_a_stored_modes_atlas(name, small_atlases, tmp_path):
    pytest.importorskip("plotly")
    from pkm_twin.apps.cli import app

    out = tmp_path / "drawn.nc"
    result = CliRunner().invoke(
        app, ["show", str(small_atlases[name]), "--out", str(out), "--html"]
    )
    assert result.exit_code == 0, result.output
    assert {path.name for path in tmp_path.iterdir()} == {
        *(f"drawn_{figure}.png" for figure in kinds.KINDS["modes"].figures),
        "drawn.html",
    }
    text = (tmp_path / "drawn.html").read_text()
    with open_atlas(small_atlases[name]) as data:
        for mode, hertz in zip(data.mode.values, data.shape_frequency.values, strict=True):
            assert f'"mode {mode}: {hertz:.4g} Hz"' in text


@pytest.mark.parametrize("name", MODES)
def test_a_mode_on_the_page_changes_shape_slices_and_what_swings(name, small_atlases):
    pytest.importorskip("plotly")
    with open_atlas(small_atlases[name]) as data:
        figure = modes.page.page(data)
        change, layout, (swing, discs) = figure.layout.updatemenus[0].buttons[3].args
        path = modes.page._path(data.line.values)
        moved = modes.stored.deformed(data, 4)[0]
        for k, axis in enumerate("xyz"):
            assert change[axis][0] == modes.page._picked(moved[:, k], path)
        mesh = figure.data[discs]
        corners = np.stack([mesh.x, mesh.y], -1)
        for n, z in enumerate(data.z.values):
            here = np.flatnonzero(mesh.z == np.float32(z))
            # From the axis outwards; a ring begins and ends at azimuth 0.
            found = np.asarray(change["intensity"][1])[here]
            assert found[0] == pytest.approx(data.frequency.values[n, 0, 0, 3], rel=1e-3)
            assert found[-1] == pytest.approx(data.frequency.values[n, -1, 0, 3], rel=1e-3)
        # Triangles cover each disc: their areas add up to a circle's.
        a, b, c = (corners[getattr(mesh, side)].astype(float) for side in "ijk")
        (p, q), (r, s) = (b - a).T, (c - a).T
        radius = np.hypot(*corners.T).max()
        area = np.abs(p * s - q * r).sum() / 2 / data.sizes["z"]
        assert area == pytest.approx(np.pi * radius**2, rel=5e-3)
        assert layout["sliders"][0]["steps"][1]["args"][0] == ["4/1"]
        assert layout["updatemenus[1].buttons"][0]["args"][0][:2] == ["4/0", "4/1"]
        frames = {frame.name: frame for frame in figure.frames}
        assert len(frames) == 6 * modes.page.PHASES
        # Half a swing later the shape is on the other side of rest.
        rest = data.position.values
        other = frames[f"4/{modes.page.PHASES // 2}"].data[0]
        assert list(frames["4/0"].traces) == [swing]
        assert list(other.x) == modes.page._picked(2 * rest[:, 0] - moved[:, 0], path)


def test_lines_of_a_frame_are_drawn_in_one_go():
    pytest.importorskip("plotly")
    from pkm_twin.atlas.modes.page import _path

    assert _path(np.array([[1, 2], [2, 3], [0, 4]])).tolist() == [1, 2, 3, -1, 0, 4]
