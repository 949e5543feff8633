# SPDX-License-Identifier: Apache-2.0
"""Pages of stored atlases that turn and zoom, whole in one file: plotly's script is inside."""

from __future__ import annotations

import html
import math
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas import figures
from pkm_twin.atlas.extras import require
from pkm_twin.atlas.grids import turns
from pkm_twin.errors import ParameterError

Array = NDArray[np.float64]

MOST: Final = 48
"""Samples along one axis of a surface."""
PHASES: Final = 24
"""Pictures in one swing of a mode."""
SWINGS: Final = 10
"""Swings that the button plays; plotly cannot repeat without end."""
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
HELP: Final = {
    "strain-energy": "Each slice is one height; the slider shows one alone. The menu chooses the "
    "total energy or one element's part of it.",
    "isotropy": "A sphere is all directions of the pose rates at one pose; it looks the same from "
    "behind. A few values beyond the ends of the colours have the end's colour.",
    "workspace": "Nested surfaces of equal distance to a singularity: 0 in one, 1 at best.",
    "modes": "Left: the frame at rest (grey) and in the chosen mode, enlarged; squares stand on "
    "the ground. The button swings it, the slider stops it. Right: the mode's frequency "
    "at places of the workspace; modes are numbered at each place, lowest first.",
}


def write_page(atlas: Any, path: Path) -> Path:
    """Write an atlas as one HTML file that needs no network.

    :param atlas: an ``xarray.Dataset`` of ``open_atlas``.
    :raises MissingExtraError: plotly is not installed.
    """
    plot = page(atlas).to_html(
        include_plotlyjs=True,
        full_html=False,
        config=CONFIG,
        default_width="100%",
        default_height="100%",
        auto_play=False,
    )
    kind = atlas.attrs["kind"]
    text = SHELL.format(title=html.escape(_title(atlas)), plot=plot, help=html.escape(HELP[kind]))
    path.write_text(text, encoding="utf-8")
    return path


def page(atlas: Any) -> Any:
    """The plotly figure of an atlas.

    :raises ParameterError: a kind without a page.
    """
    pages = {"strain-energy": slices, "isotropy": spheres, "workspace": reach, "modes": swings}
    kind = atlas.attrs["kind"]
    if kind not in pages:
        raise ParameterError("kind", kind, ", ".join(pages))
    return pages[kind](atlas)


def slices(atlas: Any) -> Any:
    """Slices of a strain-energy atlas.

    A menu chooses total energy or an element's factor, a slider one height or all.
    """
    graph = require("plotly.graph_objects", "atlas")
    part = _thinned(atlas, {"z": 12, "tilt": MOST, "azimuth": 2 * MOST})
    turn = np.append(part.azimuth.values, part.azimuth.values[0] + 2 * np.pi)
    tilt = np.degrees(part.tilt.values)[:, None]
    gamma, beta = tilt * np.sin(turn), tilt * np.cos(turn)
    energy, unit = figures.prefixed(part.energy.values, "J")
    # Over two decades: in steps of equal ratio, or all but the edge is one colour.
    fields = {f"total strain energy ({unit})": np.log10(energy)}
    for k, name in enumerate(part.element.values):
        fields[f"factor of {name} (1)"] = part.factor.values[..., k]
    heights = part.z.values.tolist()
    place = "gamma %{{x:.1f}} deg<br>beta %{{y:.1f}} deg<br>z {:.3f} m<br>{}<extra></extra>"
    powers, parts = f"energy 10^%{{surfacecolor:.2f}} {unit}", "factor %{surfacecolor:.3g}"
    figure = graph.Figure()
    for k, z in enumerate(heights):
        value = next(iter(fields.values()))[k]
        figure.add_surface(
            x=_short(gamma),
            y=_short(beta),
            z=_short(np.where(np.isfinite(_closed(value)), z, np.nan)),
            surfacecolor=_short(_closed(value)),
            coloraxis="coloraxis",
            hovertemplate=place.format(z, powers),
        )
    buttons = []
    for n, (label, field) in enumerate(fields.items()):
        shown = [_closed(layer) for layer in field]
        data = {
            "surfacecolor": [_few(layer) for layer in shown],
            "hovertemplate": [place.format(z, powers if n == 0 else parts) for z in heights],
        }
        buttons.append(_button(label, data, _colours(label, field, logarithmic=n == 0)))
    steps = [{"label": "all", "method": "restyle", "args": [{"visible": [True] * len(heights)}]}]
    for k, z in enumerate(heights):
        alone = [n == k for n in range(len(heights))]
        steps.append(
            {"label": f"{z:.3f}", "method": "restyle", "args": [{"visible": alone}]},
        )
    figure.update_layout(
        title=_title(atlas),
        coloraxis={"colorscale": "Viridis", "colorbar": {"len": 0.8}},
        scene={
            "xaxis": {"title": "gamma (deg)", "range": _range(gamma)},
            "yaxis": {"title": "beta (deg)", "range": _range(beta)},
            "zaxis": {"title": "z (m)", "range": _range(part.z.values)},
            "camera": CAMERA,
        },
        margin=MARGIN,
        updatemenus=[{"buttons": buttons, **MENU}],
        sliders=[_slider(steps, "height (m): ")],
    )
    figure.update_layout(buttons[0]["args"][1])
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
    unit = atlas.force.attrs["units"]
    labels = ("eta_KE (1)", f"F_max ({unit})")
    fields = (part.eta.values, np.log10(part.force.values))
    values = ("eta_KE %{surfacecolor:.3g}", f"F_max 10^%{{surfacecolor:.2f}} {unit}")
    shown: list[list[Array]] = []
    places: list[str] = []
    for i, a in enumerate(first.tolist()):
        for j, b in enumerate(second.tolist()):
            layers = [_closed(f[i, j]) for f in fields]
            if not np.isfinite(layers[0]).all() or (polar_grid and j == 0 and i > 0):
                continue
            if polar_grid:
                out = 0.0 if j == 0 else math.degrees(b) + step
                x, y = out * math.cos(a), out * math.sin(a)
                name = f"azimuth {math.degrees(a):.0f} deg, tilt {math.degrees(b):.4g} deg"
            else:
                x, y, name = a, b, f"x {a:.3f} m, y {b:.3f} m"
            shown.append(layers)
            places.append(name)
            figure.add_surface(
                x=_short(x + 0.44 * step * ball[0]),
                y=_short(y + 0.44 * step * ball[1]),
                z=_short(0.44 * step * up),
                surfacecolor=_short(layers[0]),
                coloraxis="coloraxis",
                hovertemplate=f"{name}<br>eta_KE %{{surfacecolor:.3g}}<extra></extra>",
                lighting={"ambient": 0.85, "diffuse": 0.3, "specular": 0.05},
            )
    buttons = []
    for n, (label, field) in enumerate(zip(labels, fields, strict=True)):
        data = {
            "surfacecolor": [_few(layers[n]) for layers in shown],
            "hovertemplate": [f"{name}<br>{values[n]}<extra></extra>" for name in places],
        }
        layout = _colours(label, field, logarithmic=n == 1, tail=figures.TAIL)
        buttons.append(_button(label, data, layout, list(range(len(shown)))))
    where = "around: azimuth, outwards: tilt; " if polar_grid else ""
    rates = ("z", "alpha", "beta") if polar_grid else ("x", "y", "z")
    ends = ", ".join(f"{axis} d{name}/dt" for axis, name in zip("xyz", rates, strict=True))
    hidden = {"visible": False}
    far = float(np.abs(second).max()) + (0.6 * step if not polar_grid else 0.0)
    if polar_grid:
        far = math.degrees(far) + 2.2 * step
    side, thick = [-far, far], [-0.5 * step, 0.5 * step]
    scene: dict[str, Any] = {
        "aspectmode": "manual",
        "aspectratio": _aspect([side, side, thick], 2.2 if polar_grid else 1.7),
        "camera": FLAT,
        "xaxis": hidden if polar_grid else {"title": "x (m)", "range": side},
        "yaxis": hidden if polar_grid else {"title": "y (m)", "range": side},
        "zaxis": hidden,
    }
    if polar_grid:
        figure.add_scatter3d(**_polar_names(first, np.degrees(second), step))
    figure.update_layout(
        title=f"{_title(atlas)}; {where}axes of a sphere: {ends}",
        coloraxis={"colorscale": "Viridis", "colorbar": {"len": 0.8}},
        scene=scene,
        margin=MARGIN,
        updatemenus=[{"buttons": buttons, **MENU}],
    )
    figure.update_layout(buttons[0]["args"][1])
    return figure


def _polar_names(azimuth: Array, tilt: Array, step: float) -> dict[str, Any]:
    """Names of azimuths (rad) around the spheres and of tilts (deg) between them, as a trace."""
    far = float(tilt[-1]) + 1.9 * step
    x = (far * np.cos(azimuth)).tolist()
    y = (far * np.sin(azimuth)).tolist()
    text = [f"{math.degrees(a):.0f}°" for a in azimuth]
    between = math.pi / len(azimuth)
    for k, value in enumerate(tilt[1:].tolist()):
        # The spheres of the first ring leave no room on it.
        out = value + (0.35 if k == 0 else 1.0) * step
        x.append(out * math.cos(between))
        y.append(out * math.sin(between))
        text.append(f"{value:.4g}°")
    return {
        "x": x,
        "y": y,
        "z": [0.44 * step] * len(x),
        "mode": "text",
        "text": text,
        "hoverinfo": "skip",
        "showlegend": False,
    }


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
            x=_short(grid[order[0]].ravel()),
            y=_short(grid[order[1]].ravel()),
            z=_short(grid[order[2]].ravel()),
            value=_short(values.ravel()),
            isomin=0.0,
            isomax=float(values.max()) * 0.98,
            surface_count=6,
            opacity=0.35,
            colorscale="Viridis",
            caps={"x_show": False, "y_show": False, "z_show": False},
            colorbar={"title": {"text": "distance to a<br>singularity (1)"}, "len": 0.8},
        )
    )
    label = [f"{names[k]} ({'deg' if scale[k] != 1.0 else 'm'})" for k in order]
    figure.update_layout(
        title=_title(atlas),
        scene={
            "xaxis_title": label[0],
            "yaxis_title": label[1],
            "zaxis_title": label[2],
            "camera": CAMERA,
        },
        margin={**MARGIN, "t": 70},
    )
    return figure


def swings(atlas: Any) -> Any:
    """Mode shapes that swing, and the frequency over the workspace; a menu chooses the mode."""
    graph = require("plotly.graph_objects", "atlas")
    plots = require("plotly.subplots", "atlas")
    modes = atlas.mode.values.tolist()
    figure = plots.make_subplots(
        1, 2, specs=[[{"type": "scene"}, {"type": "scene"}]], horizontal_spacing=0.02
    )
    rest, path = atlas.position.values, _path(atlas.line.values)
    ground = figures.grounded(atlas)
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
    shapes = {mode: figures.deformed(atlas, mode) for mode in modes}
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
    part = _thinned(atlas, {"z": 15, "distance": MOST, "azimuth": 2 * MOST})
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
        hovertemplate=f"{labels[0]} %{{x:.3g}}<br>{labels[1]} %{{y:.3g}}<br>z %{{z:.3f}} m"
        "<br>%{text}<extra></extra>",
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
            axis: [_picked(moved[:, k], path), _few(mesh[axis])] for k, axis in enumerate("xyz")
        }
        data["line.color"] = [_picked(far, path, 0.0), None]
        data["intensity"] = [None, _few(shown[mode])]
        data["text"] = [names, _hertz(shown[mode])]
        layout = {
            "sliders": [_phases(mode, phases)],
            "updatemenus[1].buttons": _players(mode),
            "annotations": _notes(atlas, mode),
            **_colours("frequency (Hz)", fields[mode], axis="coloraxis2"),
        }
        buttons.append(
            _button(f"mode {mode}: {hertz:.4g} Hz", data, layout, [swinging, swinging + 1])
        )
    figure.frames = frames
    size = float(figures.ENLARGED * np.linalg.norm(np.ptp(rest, axis=0)))
    low, high = rest.min(0), rest.max(0)
    ranges = [[float(a) - size, float(b) + size] for a, b in zip(low, high, strict=True)]
    figure.update_layout(
        title=f"{_title(atlas)}, actuators locked",
        coloraxis={
            "colorscale": "Viridis",
            "cmin": 0.0,
            "cmax": 1.0,
            "colorbar": {
                "title": {"text": "displacement over<br>the mode's largest (1)"},
                "x": 0.44,
                "len": 0.7,
                "thickness": 18,
            },
        },
        coloraxis2={"colorscale": "Viridis", "colorbar": {"x": 1.0, "len": 0.7, "thickness": 18}},
        scene={
            # Of the ranges, which are the same in all modes; "data" would follow the shape.
            "aspectmode": "manual",
            "aspectratio": _aspect(ranges, 1.1),
            "camera": {**CAMERA, "projection": {"type": "orthographic"}},
            "domain": {"x": [0.0, 0.44], "y": [0.0, 1.0]},
            **{
                f"{axis}axis": {"title": f"{axis} (m)", "range": ends, "nticks": 7}
                for axis, ends in zip("xyz", ranges, strict=True)
            },
        },
        scene2={
            "aspectmode": "manual",
            "aspectratio": {"x": 1.0, "y": 1.0, "z": 1.2},
            "camera": {**CAMERA, "projection": {"type": "orthographic"}},
            "domain": {"x": [0.54, 0.98], "y": [0.0, 1.0]},
            "xaxis_title": labels[0],
            "yaxis_title": labels[1],
            "zaxis_title": "z (m)",
        },
        margin={**MARGIN, "t": 140},
        # The cameras stay where they were turned to.
        uirevision="modes",
        updatemenus=[
            {"buttons": buttons, **MENU},
            {
                "type": "buttons",
                "direction": "left",
                "showactive": False,
                "buttons": _players(modes[0]),
                **MENU,
                "x": 0.17,
            },
        ],
    )
    figure.update_layout(
        sliders=buttons[0]["args"][1]["sliders"], annotations=_notes(atlas, modes[0])
    )
    figure.update_layout(_colours("frequency (Hz)", fields[modes[0]], axis="coloraxis2"))
    return figure


def _discs(atlas: Any) -> tuple[dict[str, Any], tuple[str, str]]:
    """Discs of a modes atlas, one a height, as vertices and triangles, and names of x and y."""
    heights = atlas.z.values
    x, y, _, labels = figures.across(atlas, atlas.frequency.values[0, :, :, 0])
    rings, turn = x.shape
    # Corners of the cells between two rings and two azimuths, two triangles each.
    first = np.add.outer(np.arange(rings - 1) * turn, np.arange(turn - 1)).ravel()
    halves = [first, first + 1, first + turn], [first + 1, first + turn + 1, first + turn]
    shift = np.arange(len(heights))[:, None] * x.size
    corners = [(shift + np.concatenate(c)).ravel() for c in zip(*halves, strict=True)]
    mesh = {
        "x": _short(np.tile(x.ravel(), len(heights))),
        "y": _short(np.tile(y.ravel(), len(heights))),
        "z": _short(np.repeat(heights, x.size)),
        **dict(zip("ijk", corners, strict=True)),
    }
    return mesh, labels


def _vertices(atlas: Any, values: Array) -> NDArray[np.float32]:
    """A field (z, distance, azimuth) of a modes atlas at the vertices of its discs."""
    return _short(np.concatenate([figures.across(atlas, f)[2].ravel() for f in values]))


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
    return {**_slider(steps, "phase (deg): "), "len": 0.42, "x": 0.01}


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


def _notes(atlas: Any, mode: int) -> list[dict[str, Any]]:
    """Heads of the two plots of a mode."""
    hertz = float(atlas.shape_frequency.sel(mode=mode))
    texts = (
        f"mode {mode}: {hertz:.4g} Hz at {figures.shape_pose(atlas)}"
        f"<br>strain energy: {figures.largest_shares(atlas, mode)}"
        f"<br>kinetic energy: {figures.largest_shares(atlas, mode, 'kinetic')}",
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


def _title(atlas: Any) -> str:
    """What a page shows, in a line."""
    robot, kind = atlas.attrs["robot"], atlas.attrs["kind"]
    if kind == "strain-energy":
        return f"Strain energy of {figures.load_case(atlas)}"
    if kind == "isotropy":
        return f"Dynamic isotropy of {figures.at_height(atlas)}"
    return f"{kind.capitalize()} of {robot}"


def _button(
    label: str, data: dict[str, Any], layout: dict[str, Any], traces: list[int] | None = None
) -> dict[str, Any]:
    """An entry of a menu that changes data and layout."""
    args: list[Any] = [data, layout]
    return {"label": label, "method": "update", "args": args if traces is None else [*args, traces]}


def _slider(steps: list[dict[str, Any]], prefix: str) -> dict[str, Any]:
    """A slider below the plot."""
    return {
        "steps": steps,
        "active": 0,
        "currentvalue": {"prefix": prefix},
        "len": 0.9,
        "x": 0.05,
        "pad": {"t": 10, "b": 10},
    }


def _colours(
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


def _closed(values: Array) -> Array:
    """A field (n, azimuth) with the first azimuth again at the end."""
    return np.concatenate([values, values[:, :1]], 1)


def _short(values: Array) -> NDArray[np.float32]:
    """Single precision: half the page, and more than a screen shows."""
    return np.asarray(values, np.float32)


def _few(values: NDArray[Any]) -> Array:
    """Four digits: what a button changes stands in the page as text."""
    with np.errstate(divide="ignore", invalid="ignore"):
        power = np.floor(np.log10(np.abs(values)))
    unit = 10.0 ** (3.0 - np.where(np.isfinite(power), power, 0.0))
    return np.asarray(np.round(np.asarray(values, np.float64) * unit) / unit, np.float64)


def _range(values: Array) -> list[float]:
    """Ends of an axis a little beyond the values: it stays when some are hidden."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return [low - 0.05 * (high - low), high + 0.05 * (high - low)]


def _aspect(ranges: list[list[float]], longest: float) -> dict[str, float]:
    """Lengths of a scene's sides with equal scales along all axes."""
    sides = [high - low for low, high in ranges]
    return {axis: longest * side / max(sides) for axis, side in zip("xyz", sides, strict=True)}


def _thinned(atlas: Any, most: dict[str, int]) -> Any:
    """Every n-th sample along the named dimensions, so that at most these many are left."""
    return atlas.isel(
        {
            dim: slice(None, None, max(1, math.ceil(atlas.sizes[dim] / count)))
            for dim, count in most.items()
        }
    ).load()
