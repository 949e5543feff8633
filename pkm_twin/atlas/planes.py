# SPDX-License-Identifier: Apache-2.0
"""Planes of a stored grid of poses, two coordinates each and the others held; their pictures."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas import figures, pages, plots
from pkm_twin.atlas.extras import require
from pkm_twin.atlas.poses import SLICED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from xarray import Dataset

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Plane:
    """Two pose coordinates of an atlas, all others held.

    ``names``, ``units`` and ``ticks`` of both, angles in degrees; ``where`` says the others.
    ``fields``: by name, shape (first, second); of one coordinate the second is a single tick.
    """

    names: tuple[str, str]
    units: tuple[str, str]
    ticks: tuple[Array, Array]
    where: str
    fields: Mapping[str, Array]


@dataclass(frozen=True)
class Label:
    """How a field is shown: of its axis or bar of colours, at the cursor, unit, and its scale."""

    text: str
    name: str
    unit: str
    scale: float = 1.0


def planes(
    atlas: Dataset, fields: Sequence[str], through: Mapping[str, float] | None = None
) -> list[Plane]:
    """Every pair of coordinates of an atlas.

    :param fields: over the grid alone; those that the atlas lacks are left out.
    :param through: pose that the planes go through, of an atlas whose grid is whole; default home.
    """
    fields = [name for name in fields if name in atlas]
    result = []
    home = dict(zip(atlas.coordinate.values, atlas.home.values.tolist(), strict=True))
    dims = tuple(map(str, atlas[fields[0]].dims))
    if dims == SLICED:
        for k in range(atlas.sizes["slice"]):
            part = atlas.isel(slice=k)
            pair = str(part.row_name.values), str(part.column_name.values)
            shown = [
                _degrees(part[f"{dim}_value"].values, str(part[f"{dim}_unit"].values))
                for dim in ("row", "column")
            ]
            result.append(_plane(atlas, pair, shown, home, {f: part[f].values for f in fields}))
        return result
    cut = {n: int(np.abs(atlas[n].values - (through or home)[n]).argmin()) for n in dims}
    held = {name: float(atlas[name][k]) for name, k in cut.items()}
    for pair in itertools.combinations(dims, 2):
        part = atlas.isel({name: k for name, k in cut.items() if name not in pair})
        shown = [_degrees(atlas[name].values, atlas[name].attrs["units"]) for name in pair]
        result.append(_plane(atlas, pair, shown, held, {f: part[f].values for f in fields}))
    return result


def _plane(
    atlas: Dataset,
    pair: tuple[str, str],
    shown: Sequence[tuple[Array, str]],
    held: Mapping[str, float],
    fields: Mapping[str, Array],
) -> Plane:
    (first, one), (second, other) = shown
    units = _units(atlas)
    others = [
        f"{name} = {float(_degrees(np.array(value), units[name])[0]):.4g} "
        f"{'deg' if units[name] == 'rad' else units[name]}"
        for name, value in held.items()
        if name not in pair
    ]
    return Plane(pair, (one, other), (first, second), ", ".join(others), fields)


def _units(atlas: Dataset) -> dict[str, str]:
    """Units of the pose coordinates."""
    names = atlas.coordinate.values
    if "slice" in atlas.dims:
        return dict(zip(names, atlas.unit.values, strict=True))
    return {name: atlas[name].attrs["units"] for name in names}


def _degrees(values: Array, unit: str) -> tuple[Array, str]:
    return (np.degrees(values), "deg") if unit == "rad" else (values, unit)


def draw(
    shown: Plane, field: str, label: Label, low: float, high: float, ax: Axes | None = None
) -> Axes:
    """A field over two pose coordinates, or over the only one.

    :param low: value of the first colour; ``high``: of the last.
    """
    ax = figures.axes_or_new(ax)
    first, second = shown.ticks
    values = label.scale * shown.fields[field]
    ax.set_title(shown.where, fontsize=9)
    ax.set_xlabel(f"{shown.names[0]} ({shown.units[0]})")
    if len(second) == 1:
        ax.plot(first, values[:, 0], color=plots.COLOURS[0])
        ax.set_ylabel(label.text)
        ax.set_ylim(min(low, 0.0), 1.05 * high)
        ax.grid(alpha=0.3)
        return ax
    ax.set_ylabel(f"{shown.names[1]} ({shown.units[1]})")
    mesh = ax.pcolormesh(
        first, second, np.ma.masked_invalid(values.T), shading="nearest", cmap=figures.MAP,
        vmin=low, vmax=high,
    )  # fmt: skip
    figures.bar(ax, mesh, label.text)
    return ax


def page(title: str, atlas: Dataset, labels: Mapping[str, Label], inside: Any = None) -> Any:
    """Fields as slices of three coordinates, or as one picture for each two.

    :param inside: which poses are shown, shape of the grid; default those with a value.
    """
    labels = {name: label for name, label in labels.items() if name in atlas}
    first = atlas[next(iter(labels))]
    if first.ndim == 3 and first.dims != SLICED:
        return _page_of_slices(title, atlas, labels, tuple(map(str, first.dims)), inside)
    return _page_of_planes(title, atlas, labels)


def _page_of_slices(
    title: str, atlas: Dataset, labels: Mapping[str, Label], dims: Sequence[str], inside: Any
) -> Any:
    upwards = atlas.attrs["height"] or dims[2]
    one, other = (name for name in dims if name != upwards)
    most = {upwards: 15, one: 61, other: 61}
    if inside is not None:
        atlas = atlas.assign({name: atlas[name].where(inside) for name in labels})
    part = pages.thinned(atlas, most).transpose(upwards, one, other, ...)
    (x, x_unit), (y, y_unit), (z, z_unit) = (
        figures.in_degrees(part[name]) for name in (one, other, upwards)
    )
    fields = [
        pages.Shown(label.text, label.name, label.unit, label.scale * part[field].values)
        for field, label in labels.items()
    ]
    return pages.layers(
        title,
        *np.meshgrid(x, y, indexing="ij"),
        z,
        (one, other, upwards),
        (x_unit, y_unit, z_unit),
        fields,
    )


def _page_of_planes(title: str, atlas: Dataset, labels: Mapping[str, Label]) -> Any:
    graph = require("plotly.graph_objects", "atlas")
    figure = graph.Figure()
    shown = planes(atlas, list(labels))
    buttons: list[dict[str, Any]] = []
    count = sum(len(one.fields) for one in shown)
    for one in shown:
        (first, second), (x, y) = one.ticks, one.names
        for field, values in one.fields.items():
            label, scale = labels[field], labels[field].scale
            where = f"{x} %{{x:.4~f}} {one.units[0]}<br>"
            names = {"xaxis.title.text": f"{x} ({one.units[0]})"}
            if len(second) == 1:
                figure.add_scatter(
                    x=pages.few(first),
                    y=pages.few(scale * values[:, 0]),
                    hovertemplate=f"{where}{label.name} %{{y:.4~g}} {label.unit}<extra></extra>",
                )
                names["yaxis.title.text"] = label.text
            else:
                figure.add_heatmap(
                    x=pages.few(first),
                    y=pages.few(second),
                    z=pages.few(scale * values.T),
                    coloraxis="coloraxis",
                    hoverongaps=False,
                    hovertemplate=f"{where}{y} %{{y:.4~f}} {one.units[1]}<br>"
                    f"{label.name} %{{z:.4~g}} {label.unit}<extra></extra>",
                )
                names["yaxis.title.text"] = f"{y} ({one.units[1]})"
            visible = [n == len(buttons) for n in range(count)]
            figure.data[-1].visible = not buttons
            text = f"{x} and {y}: {label.text}" if len(second) > 1 else label.text
            layout = names | {"coloraxis.colorbar.title.text": label.text}
            layout["title.text"] = title + (f"; {one.where}" if one.where else "")
            buttons.append(pages.button(text, {"visible": visible}, layout))
    figure.update_layout(
        coloraxis={"colorscale": "Viridis", "colorbar": {"len": 0.8}},
        margin={**pages.MARGIN, "l": 70, "b": 60},
        meta=pages.narrow(),
        updatemenus=[{"buttons": buttons, **pages.MENU}],
    )
    figure.update_layout(buttons[0]["args"][1])
    return figure
