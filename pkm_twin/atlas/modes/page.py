# SPDX-License-Identifier: Apache-2.0
"""The page of a modes atlas: mode shapes that swing, beside the frequency over the workspace."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas import pages
from pkm_twin.atlas.extras import require
from pkm_twin.atlas.grids import turns
from pkm_twin.atlas.modes.stored import (
    ENLARGED,
    across,
    deformed,
    grounded,
    largest_shares,
    shape_pose,
)

if TYPE_CHECKING:
    from xarray import Dataset

Array = NDArray[np.float64]

PHASES: Final = 24
"""Pictures in one swing of a mode."""
SWINGS: Final = 10
"""Swings that the button plays; plotly cannot repeat without end."""


def title(atlas: Dataset) -> str:
    """What the page shows, in a line."""
    return f"Modes of {atlas.attrs['robot']}"


def page(atlas: Dataset) -> Any:
    """Mode shapes that swing, and the frequency over the workspace; a menu chooses the mode."""
    graph = require("plotly.graph_objects", "atlas")
    plots = require("plotly.subplots", "atlas")
    modes = atlas.mode.values.tolist()
    figure = plots.make_subplots(
        1, 2, specs=[[{"type": "scene"}, {"type": "scene"}]], horizontal_spacing=0.02
    )
    rest, path = atlas.position.values, _path(atlas.line.values)
    ground = grounded(atlas)
    still: dict[str, Any] = {"hoverinfo": "skip", "showlegend": False}
    figure.add_scatter3d(
        **_points(rest, path), mode="lines", line={"color": "#b0b0b0", "width": 3}, **still
    )
    figure.add_scatter3d(
        **_points(rest, ground),
        mode="markers",
        marker={"symbol": "square", "size": 4, "color": "#444444"},
        **still,
    )
    shapes = {mode: deformed(atlas, mode) for mode in modes}
    names = ["" if k < 0 else str(atlas.node.values[k]) for k in path.tolist()]
    figure.add_scatter3d(
        **_points(shapes[modes[0]][0], path),
        mode="lines",
        line={
            "color": _picked(shapes[modes[0]][1], path, 0.0),
            "coloraxis": "coloraxis",
            "width": 7,
        },
        text=names,
        hovertemplate="%{text}<extra></extra>",
        showlegend=False,
    )
    swinging = len(figure.data) - 1
    part = pages.thinned(atlas, {"z": 15, "distance": pages.MOST, "azimuth": 2 * pages.MOST})
    fields = {mode: part.frequency.sel(mode=mode).values for mode in modes}
    mesh, labels = _discs(part)
    shown = {mode: _vertices(part, values) for mode, values in fields.items()}
    # One mesh of triangles: surfaces would be worked out anew in every picture of a swing.
    figure.add_mesh3d(
        **mesh,
        intensity=shown[modes[0]],
        text=_hertz(shown[modes[0]]),
        coloraxis="coloraxis2",
        flatshading=True,
        lighting={"ambient": 1.0, "diffuse": 0.0, "specular": 0.0, "fresnel": 0.0},
        hovertemplate=f"{labels[0]} %{{x:.4~f}}<br>{labels[1]} %{{y:.4~f}}<br>z %{{z:.4~f}} m"
        "<br>frequency %{text}<extra></extra>",
        row=1,
        col=2,
    )
    phases = turns(PHASES)
    frames = []
    buttons = []
    for mode in modes:
        moved, far = shapes[mode]
        for n, phase in enumerate(phases.tolist()):
            place = rest + math.cos(phase) * (moved - rest)
            shape = graph.Scatter3d(**_points(place, path))
            frames.append(graph.Frame(name=f"{mode}/{n}", data=[shape], traces=[swinging]))
        hertz = float(atlas.shape_frequency.sel(mode=mode))
        # One call changes the shape, the discs, and which frames the slider and button play.
        data = {
            axis: [_picked(moved[:, k], path), pages.few(mesh[axis])]
            for k, axis in enumerate("xyz")
        }
        data["line.color"] = [_picked(far, path, 0.0), None]
        data["intensity"] = [None, pages.few(shown[mode])]
        data["text"] = [names, _hertz(shown[mode])]
        layout = {
            "sliders": [_phases(mode, phases)],
            "updatemenus[1].buttons": _players(mode),
            "annotations": _notes(atlas, mode),
            **pages.colours("frequency (Hz)", fields[mode], axis="coloraxis2"),
        }
        buttons.append(
            pages.button(f"mode {mode}: {hertz:.4g} Hz", data, layout, [swinging, swinging + 1])
        )
    figure.frames = frames
    size = float(ENLARGED * np.linalg.norm(np.ptp(rest, axis=0)))
    low, high = rest.min(0), rest.max(0)
    ranges = [[float(a) - size, float(b) + size] for a, b in zip(low, high, strict=True)]
    figure.update_layout(
        title=f"{title(atlas)}, actuators locked",
        coloraxis={
            "colorscale": "Viridis",
            "cmin": 0.0,
            "cmax": 1.0,
            "colorbar": {
                "title": {"text": "displacement over<br>the mode's largest"},
                "x": 0.44,
                "len": 0.7,
                "thickness": 18,
            },
        },
        coloraxis2={"colorscale": "Viridis", "colorbar": {"x": 1.0, "len": 0.7, "thickness": 18}},
        scene={
            # Of the ranges, which are the same in all modes; "data" would follow the shape.
            "aspectmode": "manual",
            "aspectratio": pages.aspect(ranges, 1.1),
            "camera": {**pages.CAMERA, "projection": {"type": "orthographic"}},
            "domain": {"x": [0.0, 0.44], "y": [0.0, 1.0]},
            **{
                f"{axis}axis": {"title": f"{axis} (m)", "range": ends, "nticks": 7}
                for axis, ends in zip("xyz", ranges, strict=True)
            },
        },
        scene2={
            "aspectmode": "manual",
            "aspectratio": {"x": 1.0, "y": 1.0, "z": 1.2},
            "camera": {**pages.CAMERA, "projection": {"type": "orthographic"}},
            "domain": {"x": [0.54, 0.98], "y": [0.0, 1.0]},
            "xaxis_title": labels[0],
            "yaxis_title": labels[1],
            "zaxis_title": "z (m)",
        },
        margin={**pages.MARGIN, "t": 140},
        meta=_narrow(),
        # The cameras stay where they were turned to.
        uirevision="modes",
        updatemenus=[
            {"buttons": buttons, **pages.MENU},
            {
                "type": "buttons",
                "direction": "left",
                "showactive": False,
                "buttons": _players(modes[0]),
                **pages.MENU,
                "x": 0.17,
            },
        ],
    )
    figure.update_layout(
        sliders=buttons[0]["args"][1]["sliders"], annotations=_notes(atlas, modes[0])
    )
    figure.update_layout(pages.colours("frequency (Hz)", fields[modes[0]], axis="coloraxis2"))
    return figure


def _narrow() -> dict[str, Any]:
    """One plot above the other in windows that are too narrow for both."""
    middle, bar = 0.42, {"x": 0.86, "len": 0.4}
    entries: dict[str, Any] = {"annotations[1].y": 0.47, "updatemenus[1].x": 0.5}
    entries["sliders[0].len"] = 0.9
    for k in range(2):
        entries |= {f"annotations[{k}].x": middle, f"annotations[{k}].font.size": 11}
    return pages.narrow(
        pages.WIDE,
        {"coloraxis": bar | {"y": 0.75}, "coloraxis2": bar | {"y": 0.22}},
        scene__domain={"x": [0.0, 0.84], "y": [0.52, 0.93]},
        scene2__domain={"x": [0.0, 0.84], "y": [0.0, 0.43]},
        **entries,
    )


def _discs(atlas: Dataset) -> tuple[dict[str, Any], tuple[str, str]]:
    """Discs of a modes atlas, one a height, as vertices and triangles, and names of x and y."""
    heights = atlas.z.values
    x, y, _, labels = across(atlas, atlas.frequency.values[0, :, :, 0])
    rings, turn = x.shape
    # Corners of the cells between two rings and two azimuths, two triangles each.
    first = np.add.outer(np.arange(rings - 1) * turn, np.arange(turn - 1)).ravel()
    halves = [first, first + 1, first + turn], [first + 1, first + turn + 1, first + turn]
    shift = np.arange(len(heights))[:, None] * x.size
    corners = [(shift + np.concatenate(c)).ravel() for c in zip(*halves, strict=True)]
    mesh = {
        "x": pages.short(np.tile(x.ravel(), len(heights))),
        "y": pages.short(np.tile(y.ravel(), len(heights))),
        "z": pages.short(np.repeat(heights, x.size)),
        **dict(zip("ijk", corners, strict=True)),
    }
    return mesh, labels


def _vertices(atlas: Dataset, values: Array) -> NDArray[np.float32]:
    """A field (z, distance, azimuth) of a modes atlas at the vertices of its discs."""
    return pages.short(np.concatenate([across(atlas, f)[2].ravel() for f in values]))


def _hertz(values: NDArray[Any]) -> list[str]:
    return [f"{value:.4g} Hz" for value in values.tolist()]


def _path(lines: NDArray[np.int64]) -> NDArray[np.int64]:
    """Lines (n, 2) one after the other, with -1 for a gap: lines that follow on are one."""
    path: list[int] = []
    for a, b in lines.tolist():
        if not path or path[-1] != a:
            path += [-1, a] if path else [a]
        path.append(b)
    return np.array(path, np.int64)


def _picked(values: Array, path: NDArray[np.int64], gap: float | None = None) -> list[float | None]:
    """Values (nodes,) along a path; a plain list, as only that can have None in its gaps."""
    return [gap if k < 0 else round(float(values[k]), 5) for k in path.tolist()]


def _points(nodes: Array, path: NDArray[np.int64]) -> dict[str, Any]:
    """Coordinates of nodes (n, 3) along a path."""
    return {axis: _picked(nodes[:, k], path) for k, axis in enumerate("xyz")}


def _phases(mode: int, phases: Array) -> dict[str, Any]:
    """A slider over the phases of a mode's swing."""
    still = {"mode": "immediate", "frame": {"duration": 0, "redraw": True}}
    steps = [
        {
            "label": f"{math.degrees(phase):.0f}",
            "method": "animate",
            "args": [[f"{mode}/{n}"], {**still, "transition": {"duration": 0}}],
        }
        for n, phase in enumerate(phases.tolist())
    ]
    return {**pages.slider(steps, "phase (deg): "), "len": 0.42, "x": 0.01}


def _players(mode: int) -> list[dict[str, Any]]:
    """Buttons that swing a mode and hold it."""
    names = [f"{mode}/{n % PHASES}" for n in range(SWINGS * PHASES + 1)]
    timing = {"mode": "immediate", "transition": {"duration": 0}}
    swing = {**timing, "frame": {"duration": 50, "redraw": True}}
    hold = {**timing, "frame": {"duration": 0, "redraw": False}}
    return [
        {"label": "swing", "method": "animate", "args": [names, swing]},
        {"label": "hold", "method": "animate", "args": [[None], hold]},
    ]


def _notes(atlas: Dataset, mode: int) -> list[dict[str, Any]]:
    """Heads of the two plots of a mode."""
    hertz = float(atlas.shape_frequency.sel(mode=mode))
    texts = (
        f"mode {mode}: {hertz:.4g} Hz at {shape_pose(atlas)}"
        f"<br>strain energy: {largest_shares(atlas, mode)}"
        f"<br>kinetic energy: {largest_shares(atlas, mode, 'kinetic')}",
        f"frequency of mode {mode} over the largest cylinder of the workspace",
    )
    return [
        {
            "text": text,
            "x": x,
            "y": 1.0,
            "xref": "paper",
            "yref": "paper",
            "xanchor": "center",
            "yanchor": "top",
            "showarrow": False,
        }
        for text, x in zip(texts, (0.22, 0.76), strict=True)
    ]
