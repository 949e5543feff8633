# SPDX-License-Identifier: Apache-2.0
"""What the pages of all kinds of atlas share: the shell, menus, sliders, colours, thinning."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas.extras import require

if TYPE_CHECKING:
    from xarray import Dataset

Array = NDArray[np.float64]

MOST: Final = 48
"""Samples along one axis of a surface."""
CAMERA: Final = {"eye": {"x": 1.3, "y": -1.5, "z": 0.95}, "center": {"x": 0, "y": 0, "z": -0.1}}
FLAT: Final = {"eye": {"x": 0.0, "y": -0.6, "z": 1.5}, "projection": {"type": "orthographic"}}
"""Camera for what lies in a plane."""
CONFIG: Final = {"displaylogo": False, "responsive": True, "showSendToCloud": False}
"""No buttons that lead into the network."""
MENU: Final = {"x": 0.0, "y": 1.0, "xanchor": "left", "yanchor": "bottom", "pad": {"b": 8}}
LEAST: Final = 400
"""Width below which titles and labels would overlap, pixels: narrower windows scroll sideways."""
NARROW: Final = 760
"""Width below which a page is laid out for a narrow window, pixels; of two scenes WIDE."""
WIDE: Final = 1200
TITLE: Final = {"y": 1.0, "yanchor": "top", "pad": {"t": 36}}
"""Below the buttons of the plot, above the menu."""
TALL: Final = 900
"""Height of two scenes one above the other, pixels: lower windows scroll."""
FIT: Final = r"""
const plot = document.getElementById('{plot_id}');
const {below, narrow, farther} = plot.layout.meta;
const get = path =>
  path.match(/[^.[\]]+/g).reduce((part, key) => part == null ? part : part[key], plot.layout);
const now = path => get(path) ?? null;
const wide = Object.fromEntries(Object.keys(narrow).map(path => [path, now(path)]));
const eye = now('scene.camera.eye');
let last = false, title = '', shown = '', tried = '';
function wrapped() {
  const text = now('title.text');
  if (text !== shown) title = text;
  if (/[<&]/.test(title)) return title;
  const letters = plot.clientWidth / (0.56 * now('title.font.size')), lines = [''];
  for (const word of title.split(' '))
    if ((lines.at(-1) + word).length < letters || !lines.at(-1))
      lines.push(lines.pop() + word + ' ');
    else lines.push(word + ' ');
  return shown = lines.map(line => line.trim()).join('<br>');
}
function fit() {
  const small = plot.clientWidth < below;
  const wanted = {...(small ? narrow : wide), 'title.font.size': small ? 13 : 17};
  if (now('title.font.size') === wanted['title.font.size']) wanted['title.text'] = wrapped();
  const change = {};
  for (const path in wanted)
    if (JSON.stringify(now(path)) !== JSON.stringify(wanted[path])) change[path] = wanted[path];
  if (small !== last && farther) {
    const far = small ? farther : 1;
    change['scene.camera.eye'] = {x: far * eye.x, y: far * eye.y, z: far * eye.z};
  }
  last = small;
  const text = JSON.stringify(change);
  if (text === '{}') tried = '';
  else if (text !== tried) { tried = text; Plotly.relayout(plot, change); }
}
addEventListener('resize', fit);
plot.on('plotly_afterplot', fit);
fit();
"""
"""Lays a page out by its width, also after a menu has put back what it changes. Of the layout's
``meta``: the width, what narrow windows have instead, and how much farther away their camera is."""
THIN_BAR: Final = {"thickness": 10, "title.side": "right"}
"""A bar of colours in a narrow window: its title is along it."""
MARGIN: Final = {"l": 20, "r": 20, "t": 110, "b": 20}
# The text below the plot comes first: the plot takes the room that is left when it is drawn.
SHELL: Final = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>{title}</title>
<style>
html, body {{ margin: 0; height: 100%; }}
body {{ display: grid; grid-template-rows: 1fr auto; font: 14px sans-serif; color: #2a3f5f; }}
p {{ grid-row: 2; margin: 4px 20px 10px; }}
main {{ grid-row: 1; position: relative; min-height: 0; overflow: auto; }}
main > div {{ position: absolute; inset: 0; min-width: {width}px; }}
@media (max-width: {below}px) {{ main > div {{ min-height: {tall}px; }} }}
</style>
</head>
<body>
<p>{help}</p>
<main>{plot}</main>
</body>
</html>
"""


def narrow(
    below: int = NARROW,
    bars: Mapping[str, Mapping[str, Any]] | None = None,
    *,
    farther: float = 0.0,
    **others: Any,
) -> dict[str, Any]:
    """What :data:`FIT` reads: how a page is laid out in windows of less than a width, pixels.

    :param bars: of the colour axes, by name; default the only one with a thin bar.
    :param farther: factor of the camera's distance, of one scene in perspective.
    :param others: further entries of the layout, ``__`` for the dots of their names.
    """
    found = {name.replace("__", "."): value for name, value in others.items()}
    for axis, bar in ({"coloraxis": {}} if bars is None else bars).items():
        found |= {f"{axis}.colorbar.{key}": v for key, v in (THIN_BAR | dict(bar)).items()}
    return {"below": below, "narrow": found, "farther": farther}


def button(
    label: str, data: dict[str, Any], layout: dict[str, Any], traces: list[int] | None = None
) -> dict[str, Any]:
    """An entry of a menu that changes data and layout."""
    args: list[Any] = [data, layout]
    return {"label": label, "method": "update", "args": args if traces is None else [*args, traces]}


def slider(steps: list[dict[str, Any]], prefix: str) -> dict[str, Any]:
    """A slider below the plot."""
    return {
        "steps": steps,
        "active": 0,
        "currentvalue": {"prefix": prefix},
        "len": 0.9,
        "x": 0.05,
        "pad": {"t": 10, "b": 10},
    }


def colours(
    label: str,
    field: Array,
    *,
    logarithmic: bool = False,
    tail: float = 0.0,
    axis: str = "coloraxis",
) -> dict[str, Any]:
    """Layout of a colour axis for a field, of its logarithm to base 10 where so named.

    :param tail: percent of the values beyond each end.
    """
    low, high = np.nanpercentile(field, (tail, 100 - tail)).tolist()
    result: dict[str, Any] = {
        f"{axis}.cmin": low,
        f"{axis}.cmax": high,
        f"{axis}.colorbar.title.text": label,
        f"{axis}.colorbar.tickvals": None,
        f"{axis}.colorbar.ticktext": None,
    }
    if logarithmic:
        decades = range(math.floor(low), math.ceil(high) + 1)
        ticks = [k * 10.0**d for d in decades for k in (1, 2, 3, 5, 7)]
        ticks = [tick for tick in ticks if low <= math.log10(tick) <= high]
        result[f"{axis}.colorbar.tickvals"] = [math.log10(tick) for tick in ticks]
        result[f"{axis}.colorbar.ticktext"] = [f"{tick:g}" for tick in ticks]
    return result


def closed(values: Array) -> Array:
    """A field (n, azimuth) with the first azimuth again at the end."""
    return np.concatenate([values, values[:, :1]], 1)


def short(values: Array) -> NDArray[np.float32]:
    """Single precision: half the page, and more than a screen shows."""
    return np.asarray(values, np.float32)


def few(values: NDArray[Any]) -> Array:
    """Five digits: what a button changes stands in the page as text."""
    with np.errstate(divide="ignore", invalid="ignore"):
        power = np.floor(np.log10(np.abs(values)))
    unit = 10.0 ** (4.0 - np.where(np.isfinite(power), power, 0.0))
    return np.asarray(np.round(np.asarray(values, np.float64) * unit) / unit, np.float64)


def triangles(shown: NDArray[np.bool_]) -> dict[str, NDArray[np.int64]]:
    """Corners i, j, k of the triangles between those points of a grid that are shown.

    Points that are not shown are not counted. A mesh of triangles says of a place under the cursor
    which point it is; plotly's surfaces mix up rows and columns there.

    :param shown: shape (rows, columns).
    """
    number = np.full(shown.shape, -1)
    number[shown] = np.arange(shown.sum())
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    corners = np.concatenate(
        [np.stack(three, -1).reshape(-1, 3) for three in ((a, b, c), (a, c, d))]
    )
    whole = (corners >= 0).all(1)
    # Where one corner of a cell is missing, the other three make a triangle.
    three = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, d), (b, c, d))])
    missing = (np.stack([a, b, c, d], -1).reshape(-1, 4) < 0).sum(1) == 1
    three = three[np.tile(missing, 2) & (three >= 0).all(1)]
    corners = np.concatenate([corners[whole], three])
    return dict(zip("ijk", np.unique(corners, axis=0).T, strict=True))


LIT: Final = {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0, "fresnel": 0.0}
"""Light that leaves colours as the bar has them."""


@dataclass(frozen=True)
class Shown:
    """A field of a page: what its menu, its bar of colours and the label at the cursor say.

    ``values``: shape (layers, rows, columns), NaN where nothing is. ``logarithmic``: colours in
    steps of equal ratio.
    """

    label: str
    name: str
    unit: str
    values: Array
    logarithmic: bool = False


def layers(
    title: str,
    x: Array,
    y: Array,
    heights: Array,
    axes: tuple[str, str, str],
    units: tuple[str, str, str],
    fields: Sequence[Shown],
) -> Any:
    """Fields on layers one above the other; a menu chooses the field, a slider one layer or all.

    :param x: of the points of a layer, shape (rows, columns); y alike.
    :param heights: of the layers, shape (layers,).
    :param axes: names of x, y and height; ``units`` alike.
    :param fields: all NaN at the same points.
    """
    graph = require("plotly.graph_objects", "atlas")
    figure = graph.Figure()
    kept = [np.isfinite(layer) for layer in fields[0].values]
    where = "<br>".join(
        f"{name} %{{{axis}:.4~f}} {unit}"
        for name, axis, unit in zip(axes, "xyz", units, strict=True)
    )
    for z, shown in zip(heights.tolist(), kept, strict=True):
        figure.add_mesh3d(
            x=short(x[shown]),
            y=short(y[shown]),
            z=short(np.full(shown.sum(), z)),
            **triangles(shown),
            coloraxis="coloraxis",
            flatshading=True,
            lighting=LIT,
        )
    buttons = []
    for field in fields:
        values = [few(layer[shown]) for layer, shown in zip(field.values, kept, strict=True)]
        data: dict[str, Any] = {"intensity": values, "customdata": [None] * len(values)}
        said = "intensity"
        if field.logarithmic:
            data |= {"intensity": [few(np.log10(v)) for v in values], "customdata": values}
            said = "customdata"
        label = f"{field.name} %{{{said}:.4~g}} {field.unit}".strip()
        data["hovertemplate"] = f"{where}<br>{label}<extra></extra>"
        coloured = np.log10(field.values) if field.logarithmic else field.values
        layout = colours(field.label, coloured, logarithmic=field.logarithmic)
        buttons.append(button(field.label, data, layout))
    first = buttons[0]["args"][0]
    for k, trace in enumerate(figure.data):
        trace.update(
            intensity=first["intensity"][k],
            customdata=first["customdata"][k],
            hovertemplate=first["hovertemplate"],
        )
    steps = [{"label": "all", "method": "restyle", "args": [{"visible": [True] * len(kept)}]}]
    for k, z in enumerate(heights.tolist()):
        alone = [n == k for n in range(len(kept))]
        steps.append({"label": f"{z:.3f}", "method": "restyle", "args": [{"visible": alone}]})
    names = [f"{name} ({unit})" for name, unit in zip(axes, units, strict=True)]
    figure.update_layout(
        title=title,
        coloraxis={"colorscale": "Viridis", "colorbar": {"len": 0.8}},
        scene={
            "xaxis": {"title": names[0], "range": span(x)},
            "yaxis": {"title": names[1], "range": span(y)},
            "zaxis": {"title": names[2], "range": span(heights)},
            "aspectmode": "cube",
            "camera": CAMERA,
        },
        margin=MARGIN,
        meta=narrow(farther=1.8),
        updatemenus=[{"buttons": buttons, **MENU}],
        sliders=[slider(steps, f"{names[2]}: ")],
    )
    figure.update_layout(buttons[0]["args"][1])
    return figure


def span(values: Array) -> list[float]:
    """Ends of an axis a little beyond the values: it stays when some are hidden."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return [low - 0.05 * (high - low), high + 0.05 * (high - low)]


def aspect(ranges: list[list[float]], longest: float) -> dict[str, float]:
    """Lengths of a scene's sides with equal scales along all axes."""
    sides = [high - low for low, high in ranges]
    return {axis: longest * side / max(sides) for axis, side in zip("xyz", sides, strict=True)}


def thinned(atlas: Dataset, most: dict[str, int]) -> Dataset:
    """Every n-th sample along the named dimensions, so that at most these many are left."""
    return atlas.isel(
        {
            dim: slice(None, None, max(1, math.ceil(atlas.sizes[dim] / count)))
            for dim, count in most.items()
        }
    ).load()
