# SPDX-License-Identifier: Apache-2.0
"""What the pages of all kinds of atlas share: the shell, menus, sliders, colours, thinning."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOST: Final = 48
"""Samples along one axis of a surface."""
CAMERA: Final = {"eye": {"x": 1.3, "y": -1.5, "z": 0.95}, "center": {"x": 0, "y": 0, "z": -0.1}}
FLAT: Final = {"eye": {"x": 0.0, "y": -0.6, "z": 1.5}, "projection": {"type": "orthographic"}}
"""Camera for what lies in a plane."""
CONFIG: Final = {"displaylogo": False, "responsive": True, "showSendToCloud": False}
"""No buttons that lead into the network."""
MENU: Final = {"x": 0.0, "y": 1.0, "xanchor": "left", "yanchor": "bottom", "pad": {"b": 8}}
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
main {{ grid-row: 1; position: relative; min-height: 0; }}
main > div {{ position: absolute; inset: 0; }}
</style>
</head>
<body>
<p>{help}</p>
<main>{plot}</main>
</body>
</html>
"""


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
    """Four digits: what a button changes stands in the page as text."""
    with np.errstate(divide="ignore", invalid="ignore"):
        power = np.floor(np.log10(np.abs(values)))
    unit = 10.0 ** (3.0 - np.where(np.isfinite(power), power, 0.0))
    return np.asarray(np.round(np.asarray(values, np.float64) * unit) / unit, np.float64)


def span(values: Array) -> list[float]:
    """Ends of an axis a little beyond the values: it stays when some are hidden."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return [low - 0.05 * (high - low), high + 0.05 * (high - low)]


def aspect(ranges: list[list[float]], longest: float) -> dict[str, float]:
    """Lengths of a scene's sides with equal scales along all axes."""
    sides = [high - low for low, high in ranges]
    return {axis: longest * side / max(sides) for axis, side in zip("xyz", sides, strict=True)}


def thinned(atlas: Any, most: dict[str, int]) -> Any:
    """Every n-th sample along the named dimensions, so that at most these many are left."""
    return atlas.isel(
        {
            dim: slice(None, None, max(1, math.ceil(atlas.sizes[dim] / count)))
            for dim, count in most.items()
        }
    ).load()
