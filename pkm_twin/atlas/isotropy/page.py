# SPDX-License-Identifier: Apache-2.0
"""The page of an isotropy atlas: its spheres, to be turned."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas import pages
from pkm_twin.atlas.extras import require
from pkm_twin.atlas.isotropy.figures import BEYOND, TAIL
from pkm_twin.atlas.isotropy.stored import at_height, rates_of
from pkm_twin.atlas.isotropy.sweep import unit_vectors

if TYPE_CHECKING:
    from xarray import Dataset

Array = NDArray[np.float64]


def title(atlas: Dataset) -> str:
    """What the page shows, in a line."""
    return f"Dynamic isotropy of {at_height(atlas)}"


def page(atlas: Dataset) -> Any:
    """Spheres of an isotropy atlas that turn; a menu chooses eta_KE or F_max."""
    graph = require("plotly.graph_objects", "atlas")
    names = atlas.eta.dims[:2]
    part = pages.thinned(atlas, {names[0]: 13, names[1]: 9, "polar": 25, "turn": 48})
    balls = _balls(part)
    unit = atlas.force.attrs["units"]
    figure = graph.Figure()
    for nodes in balls.nodes:
        figure.add_mesh3d(
            **{axis: pages.short(nodes[:, k]) for k, axis in enumerate("xyz")},
            **balls.triangles,
            coloraxis="coloraxis",
            lighting={"ambient": 0.85, "diffuse": 0.3, "specular": 0.05},
        )
    buttons = []
    for label, said, field, logarithmic in (
        ("eta_KE (dimensionless)", "eta_KE %{intensity:.4~g}", balls.eta, False),
        (f"F_max ({unit})", f"F_max %{{customdata:.4~g}} {unit}", balls.force, True),
    ):
        coloured = [np.log10(values) if logarithmic else values for values in field]
        data = {
            "intensity": [pages.few(values) for values in coloured],
            "customdata": [pages.few(values) if logarithmic else None for values in field],
            "hovertemplate": [f"{name}<br>{said}<extra></extra>" for name in balls.names],
        }
        layout = pages.colours(label, np.array(coloured), logarithmic=logarithmic, tail=TAIL)
        buttons.append(pages.button(label, data, layout, list(range(len(balls.nodes)))))
    first = buttons[0]["args"][0]
    for k, trace in enumerate(figure.data):
        trace.update({key: values[k] for key, values in first.items()})
    if balls.beyond:
        figure.add_scatter3d(**_rims(balls))
    rates = rates_of(atlas)
    ends = ", ".join(f"{axis} {rate}" for axis, rate in zip("xyz", rates, strict=True))
    hidden = {"visible": False}
    thick = [-0.5 * balls.step, 0.5 * balls.step]
    sides = [[middle - balls.half, middle + balls.half] for middle in balls.middle]
    longest = 2.2 if balls.polar else 1.7
    scene: dict[str, Any] = {
        "aspectmode": "manual",
        "aspectratio": pages.aspect([*sides, thick], longest),
        "camera": pages.FLAT,
        "zaxis": hidden,
    }
    for axis, name, side in zip(("xaxis", "yaxis"), names, sides, strict=True):
        shown = {"title": f"{name} ({atlas[name].attrs['units']})", "range": side}
        scene[axis] = hidden if balls.polar else shown
    around = ""
    if balls.polar:
        around = "around: azimuth, outwards: tilt<br>"
        tilts = np.degrees(part.tilt.values)
        figure.add_scatter3d(**_polar_names(part.azimuth.values, tilts, balls.step))
    figure.update_layout(
        title=f"{title(atlas)}<br><span style='font-size:12px'>"
        f"{around}axes of a sphere: {ends}</span>",
        coloraxis={"colorscale": "Viridis", "colorbar": {"len": 0.8}},
        scene=scene,
        # Room for a title of three lines.
        margin=pages.MARGIN | {"t": 140},
        legend={"x": 1.0, "xanchor": "right", "y": 1.0, "yanchor": "bottom"},
        # A parallel projection is as high as its window.
        meta=pages.narrow(scene__aspectratio=pages.aspect([*sides, thick], longest / 2.3)),
        updatemenus=[{"buttons": buttons, **pages.MENU}],
    )
    figure.update_layout(buttons[0]["args"][1])
    return figure


@dataclass(frozen=True, eq=False)
class _Balls:
    """The spheres of a page: nodes (n, 3) of each, and the fields at them, shape (n,).

    ``names``: where each sphere is; ``beyond``: middles of those beyond the limits. ``triangles``:
    of every one of them. ``step``: distance of spheres. ``middle`` and ``half`` width of
    the picture.
    """

    nodes: list[Array]
    triangles: dict[str, NDArray[np.int64]]
    eta: list[Array]
    force: list[Array]
    names: list[str]
    beyond: list[tuple[float, float]]
    step: float
    middle: tuple[float, float]
    half: float
    polar: bool


def _balls(part: Dataset) -> _Balls:
    names = part.eta.dims[:2]
    polar = names == ("azimuth", "tilt")
    first, second = (part[name].values for name in names)
    units = [part[name].attrs["units"] for name in names]
    step = float(second[1] - second[0]) * (180 / math.pi if polar else 1.0)
    turn = np.append(part.turn.values, part.turn.values[0] + 2 * np.pi)
    ball = 0.44 * step * unit_vectors(part.polar.values, turn)
    whole = pages.triangles(np.ones(ball.shape[:2], bool))
    within = part.within_limits.values > 0
    nodes: list[Array] = []
    said: list[str] = []
    kept: list[tuple[int, int]] = []
    beyond: list[tuple[float, float]] = []
    for i, a in enumerate(first.tolist()):
        for j, b in enumerate(second.tolist()):
            known = np.isfinite(part.eta.values[i, j]).all()
            if not known or (polar and j == 0 and i > 0):
                continue
            if polar:
                out = 0.0 if j == 0 else math.degrees(b) + step
                x, y = out * math.cos(a), out * math.sin(a)
                name = f"azimuth {math.degrees(a):.0f} deg, tilt {math.degrees(b):.4g} deg"
            else:
                x, y = a, b
                name = f"{names[0]} {a:.4g} {units[0]}, {names[1]} {b:.4g} {units[1]}"
            if not within[i, j]:
                beyond.append((x, y))
                name += "<br>beyond the machine's limits"
            said.append(name)
            nodes.append((ball + np.array([x, y, 0.0])).reshape(-1, 3))
            kept.append((i, j))
    eta, force = (
        [pages.closed(field.values[i, j]).ravel() for i, j in kept]
        for field in (part.eta, part.force)
    )
    if polar:
        middle, half = (0.0, 0.0), math.degrees(float(second.max())) + 2.2 * step
    else:
        middle = float(first.mean()), float(second.mean())
        half = float(np.ptp(second)) / 2 + 0.6 * step
    return _Balls(nodes, whole, eta, force, said, beyond, step, middle, half, polar)


def _rims(balls: _Balls) -> dict[str, Any]:
    """Circles around the spheres beyond the limits, as a trace."""
    turn = np.linspace(0.0, 2 * np.pi, 49)
    circle = 0.47 * balls.step * np.stack([np.cos(turn), np.sin(turn)], -1)
    # A gap after each.
    lines = [np.vstack([circle + middle, [np.nan, np.nan]]) for middle in balls.beyond]
    x, y = np.concatenate(lines).T
    return {
        "x": pages.short(x),
        "y": pages.short(y),
        "z": np.zeros(len(x)),
        "mode": "lines",
        "line": {"color": BEYOND["ec"], "width": 4},
        "hoverinfo": "skip",
        "name": "beyond the limits",
        "showlegend": True,
    }


def _polar_names(azimuth: Array, tilt: Array, step: float) -> dict[str, Any]:
    """Names of azimuths (rad) around the spheres and of tilts (deg) among them, as a trace."""
    far = float(tilt[-1]) + 1.9 * step
    x = (far * np.cos(azimuth)).tolist()
    y = (far * np.sin(azimuth)).tolist()
    text = [f"{math.degrees(a):.0f}°" for a in azimuth]
    for k, value in enumerate(tilt[1:].tolist()):
        # Below the spheres of azimuth 0; at the first ring the room is inside it.
        x.append(value + (0.0 if k == 0 else step))
        y.append(0.0 if k == 0 else -0.72 * step)
        text.append(f"{value:.4g}°")
    return {
        "x": x,
        "y": y,
        "z": [0.0] * len(x),
        "mode": "text",
        "text": text,
        "textposition": "middle center",
        "hoverinfo": "skip",
        "showlegend": False,
    }
