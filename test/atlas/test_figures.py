# SPDX-License-Identifier: Apache-2.0
"""Pictures and pages of every kind of atlas."""

from __future__ import annotations

import numpy as np
import pytest

from pkm_twin.atlas import figures
from pkm_twin.atlas.store import open_atlas
from pkm_twin.errors import ParameterError

KINDS = [
    "strain-energy upr_rpu",
    "isotropy prru",
    "isotropy delta_cu",
    "workspace prru",
    "workspace delta_cu",
    "workspace upr_rpu",
]


@pytest.mark.parametrize("name", [*KINDS, "modes prru"])
def test_all_figures_have_axes_with_labels(name, small_atlases):
    from matplotlib import pyplot

    with open_atlas(small_atlases[name]) as data:
        drawn = figures.draw(data)
    assert drawn
    for figure in drawn.values():
        assert figure.get_suptitle()
        assert figure.axes
        for ax in figure.axes:
            assert ax.get_xlabel() or ax.get_ylabel()
        pyplot.close(figure)


@pytest.mark.parametrize(
    ("name", "draw"),
    [
        ("strain-energy upr_rpu", figures.plane),
        ("strain-energy upr_rpu", figures.global_factors),
        ("isotropy prru", figures.spheres),
        ("isotropy delta_cu", figures.spread_over_poses),
        ("workspace prru", figures.section),
        ("workspace delta_cu", figures.circles),
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


def test_a_sphere_is_seen_from_its_side():
    """The middle of the picture is the value towards the viewer; colours are the field's."""
    polar, turn = np.linspace(0, np.pi, 91), np.arange(180) * (2 * np.pi / 180)
    theta, phi = np.meshgrid(polar, turn, indexing="ij")
    x = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    for k in range(3):
        image = figures.sphere_image(x[..., k], polar, turn)
        middle = figures.PIXELS // 2
        assert image[middle, middle] == pytest.approx(figures.VIEW[k], abs=1e-3)
        assert np.isnan(image[0, 0])
        assert np.nanmax(np.abs(image)) <= 1.0


def test_kinds_without_pictures_are_refused(small_atlases):
    with open_atlas(small_atlases[KINDS[0]]) as data:
        data.attrs["kind"] = "weather"
        with pytest.raises(ParameterError):
            figures.draw(data)


@pytest.mark.parametrize("name", KINDS)
def test_pages_hold_all_they_need(name, small_atlases, tmp_path):
    pytest.importorskip("plotly")
    from pkm_twin.atlas.html import write_page

    with open_atlas(small_atlases[name]) as data:
        text = write_page(data, tmp_path / "page.html").read_text()
    assert "Plotly.newPlot" in text
    assert "<script src=" not in text
    assert len(text) > 1_000_000
