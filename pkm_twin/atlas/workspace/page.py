# SPDX-License-Identifier: Apache-2.0
"""The page of a workspace atlas: slices of three coordinates, or one picture for each two.

May import: numpy, plotly when it draws, the pages' common parts, this package.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from pkm_twin.atlas import figures, pages
from pkm_twin.atlas.extras import require
from pkm_twin.atlas.workspace.stored import planes

if TYPE_CHECKING:
    from xarray import Dataset


def title(atlas: Dataset) -> str:
    """What the page shows, in a line."""
    return f"Workspace of {atlas.attrs['robot']}"


def page(atlas: Dataset) -> Any:
    """The reachable poses: slices of three coordinates, or one picture for each two."""
    return (
        _page_of_slices(atlas)
        if atlas.singularity.ndim == 3 and "slice" not in atlas.dims
        else (_page_of_planes(atlas))
    )


_LABELS: Final = {
    "singularity": ("distance to a singularity (1)", "distance to a singularity", "", 1.0),
    "clearance": ("clearance of the limbs (mm)", "clearance", "mm", 1e3),
    "joint_angle": ("largest passive joint angle (deg)", "passive angle", "deg", 180 / math.pi),
}


def _page_of_slices(atlas: Dataset) -> Any:
    dims = atlas.singularity.dims
    upwards = atlas.attrs["height"] or dims[2]
    one, other = (name for name in dims if name != upwards)
    most = {upwards: 15, one: 61, other: 61}
    part = pages.thinned(atlas, most).transpose(upwards, one, other, ...)
    (x, x_unit), (y, y_unit), (z, z_unit) = (
        figures.in_degrees(part[name]) for name in (one, other, upwards)
    )
    inside = part.reachable.values > 0
    # All at the same points, those that are reachable.
    fields = [
        pages.Shown(label, name, unit, np.where(inside, scale * part[field].values, np.nan))
        for field, (label, name, unit, scale) in _LABELS.items()
        if field in part
    ]
    return pages.layers(
        title(atlas),
        *np.meshgrid(x, y, indexing="ij"),
        z,
        (one, other, upwards),
        (x_unit, y_unit, z_unit),
        fields,
    )


def _page_of_planes(atlas: Dataset) -> Any:
    graph = require("plotly.graph_objects", "atlas")
    figure = graph.Figure()
    shown = planes(atlas)
    buttons: list[dict[str, Any]] = []
    count = sum(len(one.fields) for one in shown)
    for one in shown:
        (first, second), (x, y) = one.ticks, one.names
        for field, values in one.fields.items():
            label, name, unit, scale = _LABELS[field]
            where = f"{x} %{{x:.4~f}} {one.units[0]}<br>"
            names = {"xaxis.title.text": f"{x} ({one.units[0]})"}
            if len(second) == 1:
                figure.add_scatter(
                    x=pages.few(first),
                    y=pages.few(scale * values[:, 0]),
                    hovertemplate=f"{where}{name} %{{y:.4~g}} {unit}<extra></extra>",
                )
                names["yaxis.title.text"] = label
            else:
                figure.add_heatmap(
                    x=pages.few(first),
                    y=pages.few(second),
                    z=pages.few(scale * values.T),
                    coloraxis="coloraxis",
                    hoverongaps=False,
                    hovertemplate=f"{where}{y} %{{y:.4~f}} {one.units[1]}<br>"
                    f"{name} %{{z:.4~g}} {unit}<extra></extra>",
                )
                names["yaxis.title.text"] = f"{y} ({one.units[1]})"
            visible = [n == len(buttons) for n in range(count)]
            figure.data[-1].visible = not buttons
            text = f"{x} and {y}: {label}" if len(second) > 1 else label
            layout = names | {"coloraxis.colorbar.title.text": label}
            layout["title.text"] = title(atlas) + (f"; {one.where}" if one.where else "")
            buttons.append(pages.button(text, {"visible": visible}, layout))
    figure.update_layout(
        coloraxis={"colorscale": "Viridis", "colorbar": {"len": 0.8}},
        margin={**pages.MARGIN, "l": 70, "b": 60},
        updatemenus=[{"buttons": buttons, **pages.MENU}],
    )
    figure.update_layout(buttons[0]["args"][1])
    return figure
