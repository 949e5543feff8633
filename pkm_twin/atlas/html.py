# SPDX-License-Identifier: Apache-2.0
"""Pages of stored atlases that turn and zoom, whole in one file: plotly's script is inside."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas.extras import require
from pkm_twin.errors import ParameterError

Array = NDArray[np.float64]

MOST: Final = 48
"""Samples along one axis of a surface."""


def write_page(atlas: Any, path: Path) -> Path:
    """Write an atlas as one HTML file that needs no network.

    :param atlas: an ``xarray.Dataset`` of ``open_atlas``.
    :raises MissingExtraError: plotly is not installed.
    """
    page(atlas).write_html(path, include_plotlyjs=True, full_html=True)
    return path


def page(atlas: Any) -> Any:
    """The plotly figure of an atlas.

    :raises ParameterError: a kind without a page.
    """
    pages = {"strain-energy": slices, "isotropy": spheres, "workspace": reach}
    kind = atlas.attrs["kind"]
    if kind not in pages:
        raise ParameterError("kind", kind, ", ".join(pages))
    return pages[kind](atlas)


def slices(atlas: Any) -> Any:
    """Slices of a strain-energy atlas; a menu chooses total energy or an element's factor."""
    graph = require("plotly.graph_objects", "atlas")
    part = _thinned(atlas, {"z": 12, "tilt": MOST, "azimuth": 2 * MOST})
    turn = np.append(part.azimuth.values, part.azimuth.values[0] + 2 * np.pi)
    tilt = np.degrees(part.tilt.values)[:, None]
    gamma, beta = tilt * np.sin(turn), tilt * np.cos(turn)
    names = [str(name) for name in part.element.values]
    fields = [part.energy.values, *np.moveaxis(part.factor.values, -1, 0)]
    labels = ["total strain energy (J)", *(f"factor of {name}" for name in names)]
    figure = graph.Figure()
    colours: list[list[Array]] = []
    for k, z in enumerate(part.z.values.tolist()):
        layers = [np.concatenate([f[k], f[k][:, :1]], 1) for f in fields]
        colours.append(layers)
        height = np.where(np.isfinite(layers[0]), z, np.nan)
        figure.add_surface(
            x=gamma,
            y=beta,
            z=height,
            surfacecolor=layers[0],
            coloraxis="coloraxis",
            name=f"z = {z:.3f} m",
            hovertemplate="gamma %{x:.1f} deg<br>beta %{y:.1f} deg<br>z %{z:.3f} m"
            "<br>%{surfacecolor:.3g}",
        )
    buttons = [
        {
            "label": label,
            "method": "update",
            "args": [
                {"surfacecolor": [layers[n] for layers in colours]},
                {"coloraxis.colorbar.title.text": label},
            ],
        }
        for n, label in enumerate(labels)
    ]
    figure.update_layout(
        title=atlas.attrs["title"],
        coloraxis={"colorscale": "Viridis", "colorbar": {"title": {"text": labels[0]}}},
        scene={
            "xaxis_title": "gamma (deg)",
            "yaxis_title": "beta (deg)",
            "zaxis_title": "z (m)",
        },
        updatemenus=[{"buttons": buttons, "x": 0.0, "y": 1.0, "xanchor": "left"}],
    )
    return figure


def spheres(atlas: Any) -> Any:
    """Spheres of an isotropy atlas that turn; a menu chooses eta_KE or F_max."""
    graph = require("plotly.graph_objects", "atlas")
    names = atlas.eta.dims[:2]
    part = _thinned(atlas, {names[0]: 13, names[1]: 9, "polar": 25, "turn": 48})
    polar_grid = names == ("azimuth", "tilt")
    first, second = (part[name].values for name in names)
    step = float(second[1] - second[0]) * (180 / math.pi if polar_grid else 1.0)
    turn = np.append(part.turn.values, part.turn.values[0] + 2 * np.pi)
    theta = part.polar.values[:, None]
    ball = np.stack(np.broadcast_arrays(np.sin(theta) * np.cos(turn), np.sin(theta) * np.sin(turn)))
    up = np.broadcast_to(np.cos(theta), ball.shape[1:])
    figure = graph.Figure()
    fields = {"eta_KE (1)": part.eta.values}
    fields[f"log10 of F_max ({atlas.force.attrs['units']})"] = np.log10(part.force.values)
    shown: list[list[Array]] = []
    for i, a in enumerate(first.tolist()):
        for j, b in enumerate(second.tolist()):
            layers = [np.concatenate([f[i, j], f[i, j][:, :1]], 1) for f in fields.values()]
            if not np.isfinite(layers[0]).all() or (polar_grid and j == 0 and i > 0):
                continue
            if polar_grid:
                out = 0.0 if j == 0 else math.degrees(b) + step
                x, y = out * math.cos(a), out * math.sin(a)
                name = f"azimuth {math.degrees(a):.0f} deg, tilt {math.degrees(b):.1f} deg"
            else:
                x, y, name = a, b, f"x {a:.3f} m, y {b:.3f} m"
            shown.append(layers)
            figure.add_surface(
                x=x + 0.44 * step * ball[0],
                y=y + 0.44 * step * ball[1],
                z=0.44 * step * up,
                surfacecolor=layers[0],
                coloraxis="coloraxis",
                name=name,
                hovertemplate=f"{name}<br>%{{surfacecolor:.3g}}<extra></extra>",
            )
    buttons = [
        {
            "label": label,
            "method": "update",
            "args": [
                {"surfacecolor": [layers[n] for layers in shown]},
                {"coloraxis.colorbar.title.text": label},
            ],
        }
        for n, label in enumerate(fields)
    ]
    rates = ("z", "alpha", "beta") if polar_grid else ("x", "y", "z")
    ends = "; ".join(
        f"{axis} of a sphere is d{name}/dt"
        for axis, name in zip(("first axis", "second", "third (up)"), rates, strict=True)
    )
    where = "tilt + one ring (deg)" if polar_grid else "(m)"
    figure.update_layout(
        title=f"{atlas.attrs['title']}: {ends}",
        coloraxis={"colorscale": "Viridis", "colorbar": {"title": {"text": next(iter(fields))}}},
        scene={
            "aspectmode": "data",
            "xaxis_title": f"x {where}",
            "yaxis_title": f"y {where}",
            "zaxis": {"visible": False},
        },
        updatemenus=[{"buttons": buttons, "x": 0.0, "y": 1.0, "xanchor": "left"}],
    )
    return figure


def reach(atlas: Any) -> Any:
    """The reachable workspace as nested surfaces of distance to a singularity."""
    graph = require("plotly.graph_objects", "atlas")
    names = atlas.singularity.dims
    part = _thinned(atlas, dict.fromkeys(names, 41))
    scale = [180 / math.pi if part[n].attrs["units"] == "rad" else 1.0 for n in names]
    ticks = [s * part[n].values for n, s in zip(names, scale, strict=True)]
    grid = np.meshgrid(*ticks, indexing="ij")
    order = [*(k for k, n in enumerate(names) if n != "z"), names.index("z")]
    values = np.nan_to_num(part.singularity.values, nan=-0.01)
    figure = graph.Figure(
        graph.Isosurface(
            x=grid[order[0]].ravel(),
            y=grid[order[1]].ravel(),
            z=grid[order[2]].ravel(),
            value=values.ravel(),
            isomin=0.0,
            isomax=float(values.max()) * 0.98,
            surface_count=6,
            opacity=0.35,
            colorscale="Viridis",
            caps={"x_show": False, "y_show": False, "z_show": False},
            colorbar={"title": {"text": "distance to a singularity (1)"}},
        )
    )
    label = [f"{names[k]} ({'deg' if scale[k] != 1.0 else 'm'})" for k in order]
    figure.update_layout(
        title=atlas.attrs["title"],
        scene={"xaxis_title": label[0], "yaxis_title": label[1], "zaxis_title": label[2]},
    )
    return figure


def _thinned(atlas: Any, most: dict[str, int]) -> Any:
    """Every n-th sample along the named dimensions, so that at most these many are left."""
    return atlas.isel(
        {
            dim: slice(None, None, max(1, math.ceil(atlas.sizes[dim] / count)))
            for dim, count in most.items()
        }
    ).load()
