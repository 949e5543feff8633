# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write pages of stored maps: one HTML file that works offline."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import import_extra
from pkm_twin.files import replace_file
from pkm_twin.maps import figures
from pkm_twin.maps.store import convert_read_errors, convert_write_errors, source
from pkm_twin.report import Report
from pkm_twin.report.page import page as of_report

if TYPE_CHECKING:
    from xarray import Dataset


CAMERA: Final = {"eye": {"x": 1.3, "y": -1.5, "z": 0.95}, "center": {"x": 0, "y": 0, "z": -0.1}}
FLAT_LIGHT: Final = {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0, "fresnel": 0.0}
"""Light that shows colours as in the colour bar."""
MENU: Final = {"x": 0.0, "y": 1.0, "xanchor": "left", "yanchor": "bottom", "pad": {"b": 8}}
COLOUR_BAR: Final = {"len": 0.8, "thickness": 12, "title": {"side": "right"}}
"""Colour bar with its title along it, to fit narrow windows."""
MARGIN: Final = {"l": 20, "r": 20, "t": 60, "b": 20}
MAX_SAMPLES: Final = (15, 61)
"""Largest number of layers, and of samples along the sides of a layer."""
WORST_POSE_MARKER: Final = {"color": "red", "line": {"color": "white", "width": 1}}
HELP: Final = "Coloured poses count: joints within limits, limbs apart, clear of singularities. The \
menu chooses the case and plane, a slider one layer alone."


def write_page(data: Dataset, path: Path) -> Path:
    """Write a stored map as one HTML file with plotly's script inside.

    :raises MissingExtraError: plotly is not installed.
    """
    import_extra("plotly", "maps")
    kind = figures.find_kind(data)
    with convert_read_errors(source(data)):
        first, *rest = figures.write_lines(data)
        drawn, more = page(data), kind.page(data)
    parts = [drawn, *([] if more is None else [more])]
    shown = [
        one.to_html(
            include_plotlyjs=k == 0,
            full_html=False,
            # No buttons that need the network.
            config={"displaylogo": False, "responsive": True, "showSendToCloud": False},
            default_width="100%",
            default_height="100%",
            auto_play=False,
        )
        for k, one in enumerate(parts)
    ]
    report = Report(first, notes=[*rest, HELP, *([kind.page_help] if kind.page_help else [])])
    text = of_report(str(data.attrs["title"]), report, figures=shown)
    with convert_write_errors(path):
        replace_file(path, text.encode())
    return path


def page(data: Dataset) -> Any:
    """Return a figure of all cases: layers for three coordinates, else planes."""
    figure, buttons = _draw_layers(data) if len(data.coordinate) == 3 else _draw_planes(data)
    figure.update_layout(
        coloraxis={"colorscale": "Viridis", "colorbar": COLOUR_BAR},
        updatemenus=[{"buttons": buttons, **MENU}],
    )
    # Show the menu's first entry.
    first, layout = buttons[0]["args"]
    for name, values in first.items():
        for trace, value in zip(figure.data, values, strict=True):
            if value is not None:
                trace[name] = value
    figure.update_layout(layout)
    return figure


def _case_layout(data: Dataset, case: int, values: Array) -> tuple[float, str, dict[str, Any]]:
    """Return scale, unit, and layout of a case, with one colour scale that includes the worst."""
    part = data.isel(case=case)
    low, high = figures.choose_colour_limits(values, float(part.worst_value))
    scale, unit = figures.choose_prefix(max(abs(low), abs(high)), str(part.case_unit.values))
    label = f"{part.case_what.values} ({unit})" if unit else str(part.case_what.values)
    label += ", brightest: or more" if (values > high).any() else ""
    layout = {
        "coloraxis.cmin": float(round_digits(np.array(scale * low))),
        "coloraxis.cmax": float(round_digits(np.array(scale * high))),
        "coloraxis.colorbar.title.text": label,
    }
    return scale, unit, layout


def _draw_layers(data: Dataset) -> tuple[Any, list[dict[str, Any]]]:
    graph = import_extra("plotly.graph_objects", "maps")
    units = figures.list_units(data)
    dims = list(units)
    upwards = data.attrs["height"] or dims[2]
    flat = [name for name in dims if name != upwards]
    steps = {n: math.ceil(data.sizes[n] / (MAX_SAMPLES[0] if n == upwards else MAX_SAMPLES[1])) for n in dims}
    part = data.value.isel({n: slice(None, None, step) for n, step in steps.items()})
    values = part.transpose("case", upwards, *flat).values
    x, y, heights = (part[n].values for n in (*flat, upwards))
    names = [f"{name} ({units[name]})" for name in (*flat, upwards)]
    x, y = np.meshgrid(x, y, indexing="ij")
    kept = np.isfinite(values).any(0)
    figure = graph.Figure()
    for z, seen in zip(heights.tolist(), kept, strict=True):
        figure.add_mesh3d(
            x=np.float32(x[seen]),
            y=np.float32(y[seen]),
            z=np.float32(np.full(seen.sum(), z)),
            **grid_triangles(seen),
            coloraxis="coloraxis",
            flatshading=True,
            lighting=FLAT_LIGHT,
        )
    figure.add_scatter3d(mode="markers", marker=WORST_POSE_MARKER | {"size": 7, "symbol": "diamond"})
    where = "".join(f"{n} %{{{axis}:.4~f}}<br>" for n, axis in zip(names, "xyz", strict=True))
    buttons = []
    for k, case in enumerate(data.case.values):
        scale, unit, layout = _case_layout(data, k, values[k])
        name = str(data.case_what.values[k])
        said = f"{where}{name} %{{intensity:.4~g}} {unit}<extra></extra>"
        pose = dict(zip(units, data.worst_pose.values[k].tolist(), strict=True))
        known = math.isfinite(float(data.worst_value[k]))
        star = [round_digits(np.array([pose[n]] * known)).tolist() for n in (*flat, upwards)]
        worst = figures.format_value(float(data.worst_value[k]), str(data.case_unit.values[k]))
        change = {
            "intensity": [
                *(round_digits(scale * v[s]) for v, s in zip(values[k], kept, strict=True)),
                None,
            ],
            "hovertemplate": [*[said] * len(kept), f"{where}worst {worst}<extra></extra>"],
            **{axis: [*(t[axis] for t in figure.data[:-1]), place] for axis, place in zip("xyz", star, strict=True)},
        }
        buttons.append(make_button(str(case), change, layout))
    # Ranges with a margin stay constant when traces are hidden.
    ends = [(float(np.nanmin(values)), float(np.nanmax(values))) for values in (x, y, heights)]
    ranges = [[low - 0.05 * (high - low), high + 0.05 * (high - low)] for low, high in ends]
    count = len(kept)
    every = {"label": "all", "method": "restyle", "args": [{"visible": [True] * (count + 1)}]}
    slices = [
        {"label": f"{z:.3f}", "method": "restyle", "args": [{"visible": [*(n == k for n in range(count)), True]}]}
        for k, z in enumerate(heights.tolist())
    ]
    figure.update_layout(
        scene={
            **{
                f"{axis}axis": {"title": name, "range": span}
                for axis, name, span in zip("xyz", names, ranges, strict=True)
            },
            "aspectmode": "cube",
            "camera": CAMERA,
        },
        margin=MARGIN,
        sliders=[
            {
                "steps": [every, *slices],
                "currentvalue": {"prefix": f"{names[2]}: "},
                "len": 0.9,
                "x": 0.05,
                "pad": {"t": 10, "b": 10},
            }
        ],
    )
    return figure, buttons


def _draw_planes(data: Dataset) -> tuple[Any, list[dict[str, Any]]]:
    graph = import_extra("plotly.graph_objects", "maps")
    figure, buttons = graph.Figure(), []
    every = [(k, p) for k in range(len(data.case)) for p in figures.list_full_planes(data, k)]
    for k, p in every:
        scale, unit, layout = _case_layout(data, k, data.plane_value.isel(case=k).values)
        one = figures.extract_plane(data, k, p)
        what, (x, *y) = str(data.case_what.values[k]), one.names
        values, axes = scale * one.values, [round_digits(ticks) for ticks in one.ticks]
        named = [f"{n} ({u})" for n, u in zip(one.names, one.units, strict=True)]
        where = "".join(f"{n} %{{{a}:.4~f}}<br>" for n, a in zip(named, "xy", strict=False))
        said = f"{where}{what} %{{{'z' if y else 'y'}:.4~g}} {unit}<extra></extra>"
        if y:
            figure.add_heatmap(
                x=axes[0],
                y=axes[1],
                z=round_digits(values.T),
                coloraxis="coloraxis",
                hoverongaps=False,
                hovertemplate=said,
            )
        else:
            figure.add_scatter(x=axes[0], y=round_digits(values[:, 0]), hovertemplate=said)
        star = one.star if one.star and y else [None, None]
        worst = figures.format_value(float(data.worst_value[k]), str(data.case_unit.values[k]))
        figure.add_scatter(
            x=star[:1],
            y=star[1:2],
            mode="markers",
            showlegend=False,
            marker=WORST_POSE_MARKER | {"symbol": "star", "size": 16},
            hovertemplate=f"worst {worst}<extra></extra>",
        )
        layout |= {"xaxis.title.text": named[0], "yaxis.title.text": named[1] if y else what}
        text = ", ".join([x, *y]) + ("" if len(data.case) == 1 else f": {data.case.values[k]}")
        buttons.append((text, layout))
    visible = [[n // 2 == k for n in range(len(figure.data))] for k in range(len(buttons))]
    for trace, seen in zip(figure.data, visible[0], strict=True):
        trace.visible = seen
    figure.update_layout(margin={**MARGIN, "l": 70, "b": 60})
    shown = zip(buttons, visible, strict=True)
    return figure, [make_button(text, {"visible": seen}, layout) for (text, layout), seen in shown]


def make_button(
    label: str, data: dict[str, Any], layout: dict[str, Any], traces: list[int] | None = None
) -> dict[str, Any]:
    """Return a menu entry that changes data and layout."""
    args: list[Any] = [data, layout]
    return {"label": label, "method": "update", "args": args if traces is None else [*args, traces]}


def round_digits(values: NDArray[Any]) -> Array:
    """Round to five digits, because a button's data are text in the page."""
    with np.errstate(divide="ignore", invalid="ignore"):
        power = np.floor(np.log10(np.abs(values)))
    unit = 10.0 ** (4.0 - np.where(np.isfinite(power), power, 0.0))
    return np.asarray(np.round(np.asarray(values, np.float64) * unit) / unit, np.float64)


def grid_triangles(shown: NDArray[np.bool_]) -> dict[str, NDArray[np.int64]]:
    """Return corners i, j, k of the triangles between the shown points of a grid.

    Hidden points are not counted. Meshes report the point under the cursor correctly; plotly's
    surfaces swap rows and columns there.

    :param shown: shape (rows, columns).
    """
    number = np.full(shown.shape, -1)
    number[shown] = np.arange(shown.sum())
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    corners = np.concatenate([np.stack(three, -1).reshape(-1, 3) for three in ((a, b, c), (a, c, d))])
    whole = (corners >= 0).all(1)
    # A cell with one missing corner gives one triangle.
    three = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, d), (b, c, d))])
    missing = (np.stack([a, b, c, d], -1).reshape(-1, 4) < 0).sum(1) == 1
    three = three[np.tile(missing, 2) & (three >= 0).all(1)]
    corners = np.concatenate([corners[whole], three])
    return dict(zip("ijk", np.unique(corners, axis=0).T, strict=True))
