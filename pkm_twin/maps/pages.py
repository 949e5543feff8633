# SPDX-License-Identifier: Apache-2.0
"""What the pages of all maps share: shell, layout by the window's width, menus, sliders, meshes."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array

CAMERA: Final = {"eye": {"x": 1.3, "y": -1.5, "z": 0.95}, "center": {"x": 0, "y": 0, "z": -0.1}}
LIT: Final = {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0, "fresnel": 0.0}
"""Light that leaves colours as the bar has them."""
CONFIG: Final = {"displaylogo": False, "responsive": True, "showSendToCloud": False}
"""No buttons that lead into the network."""
MENU: Final = {"x": 0.0, "y": 1.0, "xanchor": "left", "yanchor": "bottom", "pad": {"b": 8}}
LEAST: Final = 400
"""Width below which titles and labels would overlap, pixels: narrower windows scroll sideways."""
NARROW: Final = 760
"""Width below which a page is laid out for a narrow window, pixels."""
TITLE: Final = {"y": 1.0, "yanchor": "top", "pad": {"t": 36}}
"""Below the buttons of the plot, above the menu."""
FIT: Final = r"""{
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
}"""
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
main {{ grid-row: 1; min-height: 0; overflow: auto; scrollbar-gutter: stable; }}
main > div {{ height: calc(100vh - 4.5em); min-width: {width}px; }}
</style>
</head>
<body>
<p>{help}</p>
<main>{plot}</main>
</body>
</html>
"""


def narrow(farther: float = 0.0) -> dict[str, Any]:
    """What :data:`FIT` reads: how a page is laid out in narrow windows.

    :param farther: factor of the camera's distance, of a scene in perspective.
    """
    bar = {f"coloraxis.colorbar.{key}": value for key, value in THIN_BAR.items()}
    return {"below": NARROW, "narrow": bar, "farther": farther}


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


def span(values: Array) -> list[float]:
    """Ends of an axis a little beyond the values: it stays when some are hidden."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return [low - 0.05 * (high - low), high + 0.05 * (high - low)]
