# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Draw stored maps: planes through the worst pose, with the answer in the title."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import UnknownNameError
from pkm_twin.maps.kind import Kind
from pkm_twin.maps.kinds import KINDS
from pkm_twin.report import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.figure import Figure
    from xarray import Dataset


COLOUR_MAP: Final = "viridis"
PREFIXES: Final = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}
MAX_PANELS: Final = 3
"""Largest number of planes in a picture."""
MIN_SHOWN: Final = 5e-5
"""Coordinate, m or rad, or component of a direction, below which zero is shown."""
SCALE_QUANTILE: Final = 0.95
"""Quantile of the values that ends the colour scale if there are outliers."""


def choose_prefix(greatest: float, unit: str) -> tuple[float, str]:
    """Return factor and prefixed unit that leave values up to ``greatest`` below 1000.

    Prefixes are used where they exist: kg has g and t; units that start with a power or an angle
    have none.
    """
    power = 3 * math.floor(math.log10(abs(greatest) or 1.0) / 3) if math.isfinite(greatest) else 0
    if unit == "kg":
        power = min(max(power, -3), 3)
        return 10.0**-power, {-3: "g", 0: "kg", 3: "t"}[power]
    if not re.match(r"(m|N|J|Hz|Pa)(?!\w)", unit):
        return 1.0, unit
    power = min(max(power, min(PREFIXES)), 0 if unit[0] == "m" else max(PREFIXES))
    return 10.0**-power, PREFIXES[power] + unit


def format_value(value: float, unit: str, digits: int = 4) -> str:
    """Format a value with its unit."""
    scale, prefixed = choose_prefix(value, unit)
    return f"{scale * value + 0.0:.{digits}g} {prefixed}".strip()


def find_kind(data: Dataset) -> type[Kind]:
    """Return the kind of a stored map.

    :raises UnknownNameError: a kind that this version does not know.
    """
    name = str(data.attrs["kind"])
    if name not in KINDS:
        raise UnknownNameError("map", name, tuple(KINDS))
    return KINDS[name]


def list_answers(data: Dataset) -> list[dict[str, Any]]:
    """Return the worst of each case as plain data: case, value, unit, pose, direction, element."""
    names = [str(name) for name in data.coordinate.values]
    found = []
    for k, case in enumerate(data.case.values):
        part = data.isel(case=k)
        if not math.isfinite(float(part.worst_value)):
            continue
        answer = {
            "case": str(case),
            "what": str(part.case_what.values),
            "answer": str(part.case_answer.values),
            "value": float(part.worst_value),
            "unit": str(part.case_unit.values),
            "pose": dict(zip(names, part.worst_pose.values.tolist(), strict=True)),
            "pose_units": list_units(data),
        }
        if "worst_bound" in data:
            answer["singularity"] = float(part.worst_singularity)
            bound = float(part.worst_bound)
            answer["singularity_bound"] = bound if math.isfinite(bound) else None
        if "worst_direction" in data:
            answer["direction"] = part.worst_direction.values.tolist()
            answer["axes"] = [str(name) for name in data.axis.values]
        if "worst_element" in data and int(part.worst_element) >= 0:
            answer["element"] = str(data.element.values[int(part.worst_element)])
        found.append(answer)
    return found


def write_sentence(answer: dict[str, Any]) -> str:
    """State the worst of a case: "softest: 32.8 µm/N along y at (0, -0.16, -0.35) m, arm III".

    The pose can be given to commands; it has enough digits to keep its singularity index.
    """
    pose = ", ".join(f"{_drop_noise(v, 5e-6):.6g}" for v in answer["pose"].values())
    text = f"{answer['answer']}: {format_value(answer['value'], answer['unit'])}"
    way = np.array(answer.get("direction", []))
    if len(way) and np.isfinite(way).all() and way.any():
        axis = int(np.abs(way).argmax())
        alone = abs(way[axis]) > 0.9995
        words = ", ".join(f"{_drop_noise(v):.3g}" for v in way)
        text += f" along {answer['axes'][axis] if alone else f'({words})'}"
    units = list(answer["pose_units"].values())
    text += f" at ({pose}) " + (units[0] if len(set(units)) == 1 else f"[{', '.join(units)}]")
    text += f", {answer['element']}" if "element" in answer else ""
    if (bound := answer.get("singularity_bound")) is not None:
        text += f"; uncertain: on the bound of the singularity index, {bound:g}"
        text += ": worse poses lie below it"
    return text


def _drop_noise(value: float, least: float = MIN_SHOWN) -> float:
    """Return zero for a value that is only rounding or search noise."""
    return value if abs(value) >= least else 0.0


def list_units(data: Dataset) -> dict[str, str]:
    """Return the units of the pose coordinates, by name."""
    return {str(k): str(u) for k, u in zip(data.coordinate.values, data.unit.values, strict=True)}


def write_lines(data: Dataset) -> list[str]:
    """Return the answers of a map: a line per case, and the kind's facts on the workspace."""
    found = list_answers(data)
    alone = len(found) == 1
    texts = [("" if alone else f"{a['case']}: ") + write_sentence(a) for a in found]
    kind = find_kind(data)
    facts = kind.facts(data)
    return [*facts, *texts] if kind.facts_first else [*texts, *facts]


def title(data: Dataset, case: int) -> list[str]:
    """Return the lines of a case's title: question and answer."""
    name = str(data.case.values[case])
    own = [write_sentence(a) for a in list_answers(data) if a["case"] == name]
    label = "" if len(data.case) == 1 else f", {name.replace('-', ' ')}"
    head = f"{data.attrs['robot']}{label}: {data.attrs['question']}"
    kind = find_kind(data)
    facts = ["; ".join(kind.facts(data))] if kind.facts_first and case == 0 else []
    return [head, *facts, *own]


def draw(data: Dataset) -> dict[str, Figure]:
    """Draw all pictures of a stored map, by name: one per case, and those of its kind."""
    names = [str(name) for name in data.case.values]
    pictures = {n if len(names) > 1 else "": planes(data, k) for k, n in enumerate(names)}
    return pictures | find_kind(data).figures(data)


def choose_colour_limits(values: Array, worst: float) -> tuple[float, float]:
    """Choose the ends of a colour scale: 0 and the largest value, or both extremes if these are close.

    A few outliers above the others share the last colour.
    """
    known = values[np.isfinite(values)]
    every = np.append(known, worst) if math.isfinite(worst) else known
    low, high = (float(every.min()), float(every.max())) if len(every) else (0.0, 1.0)
    if len(known) and high > 2.0 * (most := float(np.quantile(known, SCALE_QUANTILE))) > 0.0:
        high = most
    if 0.0 <= low <= 0.5 * high:
        low = 0.0
    return low, high if high > low else low + (abs(low) or 1.0)


@dataclass(frozen=True, eq=False)
class Plane:
    """Hold a plane of a map for drawing: names, units and ticks of its sides, values and reach.

    ``star``: position of the worst pose; None if it is not in the plane. ``through``: a pose in the
    plane, by coordinate; ``held``: its coordinates that are constant, in words.
    """

    names: tuple[str, ...]
    units: list[str]
    ticks: list[Array]
    values: Array
    reach: NDArray[np.int8]
    star: list[float] | None
    through: dict[str, float]
    held: str


def extract_plane(data: Dataset, case: int, plane: int) -> Plane:
    """Return a plane of a case for drawing."""
    part, units = data.isel(case=case, plane=plane), list_units(data)
    names = tuple(n for n in (str(part.row_name.values), str(part.column_name.values)) if n)
    sides = [part.row_value.values, part.column_value.values]
    pose, through = part.worst_pose.values, part.through.values
    every = [str(name) for name in data.coordinate.values]
    at = {n: float(through[every.index(n)]) for n in every}
    held = [f"{n} = {_drop_noise(at[n]):.4g} {units[n]}" for n in every if n not in names]
    star = None
    if np.isfinite(pose).all() and np.allclose(pose, through, rtol=0.0, atol=1e-12):
        star = [at[n] for n in names]
    values, reach = part.plane_value.values, part.plane_reach.values
    return Plane(names, [units[n] for n in names], sides[: len(names)], values, reach, star, at, ", ".join(held))


def list_full_planes(data: Dataset, case: int) -> list[int]:
    """Return the planes of a case that have more than one counted pose, fullest first."""
    known = np.isfinite(data.plane_value.isel(case=case).values).sum((1, 2))
    order = np.argsort(-known, kind="stable")
    return [int(k) for k in order if known[k] > 1] or [int(order[0])]


def planes(data: Dataset, case: int) -> Figure:
    """Draw up to three planes of a case through its worst pose, with one colour scale."""
    kind, part = find_kind(data), data.isel(case=case)
    drawn = [extract_plane(data, case, k) for k in sorted(list_full_planes(data, case)[:MAX_PANELS])]
    count, flat = len(drawn), len(drawn[0].names) > 1
    worst = float(part.worst_value)
    values = np.concatenate([one.values.ravel() for one in drawn])
    low, high = choose_colour_limits(values, worst)
    beyond = bool((np.append(values, worst) > high).any())
    scale, unit = choose_prefix(max(abs(low), abs(high)), str(part.case_unit.values))
    label = textwrap.fill(f"{part.case_what.values} ({unit or 'dimensionless'})", 48)
    # Equal scales where all coordinates have one unit; a single panel fills the width.
    height, widths = 0.5 * plots.WIDTH, [1.0] * count
    if count == MAX_PANELS:
        height = plots.WIDTH / MAX_PANELS + 0.9
    elif count == 1 and flat and len(set(drawn[0].units)) == 1:
        across, up = map(np.ptp, drawn[0].ticks)
        height = float(np.clip(0.8 * plots.WIDTH * up / across, 3.0, 0.7 * plots.WIDTH) + 0.6)
    if count > 1 and len({unit for one in drawn for unit in one.units}) == 1:
        spans = np.array([np.ptp(one.ticks[0]) for one in drawn])
        widths = np.clip(spans / spans.max(), 0.5, 1.0).tolist()
    with plots.pyplot().rc_context({"font.size": 9}):
        figure, columns = plots.make_subplots(count, 1, height, gridspec_kw={"width_ratios": widths})
        axes, over = [column[0] for column in columns], ""
        for one, ax in zip(drawn, axes, strict=True):
            if not flat:
                ax.plot(one.ticks[0], scale * one.values[:, 0], color=plots.COLOURS[0])
                plots.label(ax, f"{one.names[0]} ({one.units[0]})", label)
                if one.star:
                    k = int(np.abs(one.ticks[0] - one.star[0]).argmin())
                    ax.plot(one.star[0], scale * one.values[k, 0], "*", color="red", ms=12)
                continue
            # Contours at fewer quantiles in a full row of panels.
            quantiles = (0.25, 0.6, 0.9) if count < MAX_PANELS else (0.35, 0.85)
            mesh = draw_panel(one, ax, scale, scale * low, scale * high, quantiles)
            over = kind.overlay(data, one.names, one.through, ax)
        if flat:
            bar = figure.colorbar(mesh, ax=axes, aspect=25, pad=0.01, extend="max" if beyond else "neither")
            bar.set_label(label)
        rows = plots.write_title(figure, "\n".join(title(data, case)), 10)
        figure.set_figheight(height + 0.2 * rows)
        star = "star: worst pose; " if any(one.star for one in drawn) else ""
        more = "; brightest: this or more" if beyond else ""
        caption = f"{star}outline: joint limits; white: does not count{more}{over}"
        figure.supxlabel(caption, fontsize=8.5, color="0.3")
    return figure


def draw_panel(one: Plane, ax: Axes, scale: float, low: float, high: float, shares: Sequence[float]) -> QuadMesh:
    """Draw a plane of :func:`extract_plane`, with contours at quantiles of its values."""
    x, y = one.ticks
    values = scale * one.values.T
    mesh = ax.pcolormesh(
        x,
        y,
        np.ma.masked_invalid(values),
        shading="nearest",
        cmap=COLOUR_MAP,
        vmin=low,
        vmax=high,
        rasterized=True,
    )
    if one.reach.any() and not one.reach.all():
        ax.contour(x, y, one.reach.T, [0.5], colors="0.2", linewidths=1.2)
    known = values[np.isfinite(values)]
    if len(known) > values.size // 6 and np.ptp(known) > 0.02 * (high - low):
        levels = np.unique([float(f"{v:.2g}") for v in np.quantile(known, shares)])
        contours = ax.contour(x, y, values, levels, colors="white", linewidths=0.7)
        for text in ax.clabel(contours, fmt="%.3g", fontsize=8.5):
            text.set_bbox({"facecolor": "0.25", "edgecolor": "none", "alpha": 0.55, "pad": 0.6})
    if one.star:
        # The star has the colour of the cell that it covers.
        at = [int(np.abs(side - place).argmin()) for side, place in zip((x, y), one.star, strict=True)]
        face = mesh.to_rgba(values[at[1], at[0]])
        ax.plot(*one.star, "*", color=face, mec="red", mew=1.2, ms=14, zorder=5)
    ax.set_xlabel(f"{one.names[0]} ({one.units[0]})")
    ax.set_ylabel(f"{one.names[1]} ({one.units[1]})")
    if one.held.count("=") == 1:
        ax.set_title(one.held, fontsize=9)
    if one.units[0] == one.units[1]:
        ax.set_aspect("equal")
    return mesh
