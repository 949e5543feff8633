# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Map the strain energy of loads, and each element's share."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.maps.kind import Case, Found, size_and_direction
from pkm_twin.maps.kinds.compliance import Compliance
from pkm_twin.report import plots
from pkm_twin.robot.robot import Robot
from pkm_twin.settings import setting
from stiffness_monitor import platform_response

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from xarray import Dataset

MAX_PANELS: Final = 3
"""Number of elements in a picture."""
SLICES: Final = 5
"""Number of heights in a picture."""


@dataclass(frozen=True)
class StrainEnergy(Compliance):
    """Map the strain energy of loads, and each element's share; default load 1 N along z."""

    slices: bool = setting(
        False,
        "also pictures of energy and shares, in slices and a plane",
        name="elements",
    )

    name = "strain-energy"
    question = "which part gives?"
    answer = "most strain energy"
    what = "strain energy"
    unit = "J"
    has_shares = True

    def cases(self, robot: Robot) -> tuple[Case, ...]:
        """Return the case of a force of 1 N upwards."""
        (case,) = super().cases(robot)
        return (replace(case, name="1 N along z", wrench=(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)),)

    def loaded(self, robot: Robot, name: str, wrench: object) -> Case:
        """Return the case of another load."""
        load = super().loaded(robot, name, wrench)  # type: ignore[arg-type]
        return replace(self.cases(robot)[0], name=name, wrench=load.wrench)

    def found(self, robot: Robot, q: Array, case: Case) -> Found:
        """Return the total energy, the platform's direction of motion, and the elements' shares.

        2UPR-RPU paper: U (equation 37) and the local strain-energy factors mu_ij (equation 38).
        """
        response = platform_response(robot, q, np.array(case.wrench))
        _, direction = size_and_direction(response.deflection[..., :3])
        factors = response.factors
        return Found(np.asarray(response.total), direction, factors.argmax(-1), factors)

    @classmethod
    def facts(cls, data: Dataset) -> list[str]:
        """Return mean shares of the elements, largest first (global factor, equation 39)."""
        lines = []
        for case in data.case.values:
            mean, order = _rank(data, case)
            shown = order if _draws_elements(data) else order[:4]
            parts = [f"{data.element.values[n]} {100 * mean[n]:.1f} %" for n in shown]
            lines.append(f"{case}: mean share over the workspace: {', '.join(parts)}")
        return lines

    @classmethod
    def figures(cls, data: Dataset) -> dict[str, Figure]:
        """Draw the energy and the ranked shares in slices and in a plane if ``slices`` is set."""
        pictures: dict[str, Figure] = {}
        for case in data.case.values if _draws_elements(data) else ():
            before = f"{case}_" if len(data.case) > 1 else ""
            mean, order = _rank(data, case)
            ranked = [int(n) for n in order if mean[n] >= 0.005]
            named = {f"{before}energy": _draw_slices(data, case, [])}
            for k in range(0, len(ranked), MAX_PANELS):
                part = ranked[k : k + MAX_PANELS]
                name = f"{before}elements_{k // MAX_PANELS + 1}"
                named[name] = _draw_slices(data, case, part) | _draw_planes(data, case, part)
            pictures |= {f"{name}_{end}": one for name, ends in named.items() for end, one in ends.items()}
        return pictures


def _draws_elements(data: Dataset) -> bool:
    """Return whether a stored map is to have pictures of its elements."""
    return bool(json.loads(data.attrs["settings"])["options"].get("slices", False))


def _rank(data: Dataset, case: str) -> tuple[Array, Any]:
    """Return the elements' mean shares over the workspace, and their order, largest first."""
    share = data.factor.sel(case=case)
    mean = share.mean([d for d in share.dims if d != "element"]).values
    return mean, np.argsort(-mean, kind="stable")


def _title(data: Dataset, case: str, elements: list[int], where: str) -> str:
    """Return the question, and the mean shares of the elements that answer it."""
    mean, _ = _rank(data, case)
    means = ", ".join(f"{data.element.values[n]} {100 * mean[n]:.1f} %" for n in elements)
    what = f"which part gives? Mean share: {means}; " if elements else "where is the strain energy? "
    return f"{data.attrs['robot']}, {case}: {what}{where}"


def _draw_slices(data: Dataset, case: str, elements: list[int]) -> dict[str, Figure]:
    """Draw elements' shares, or without elements the energy, at some heights.

    :returns: the picture by the end of its name; none where poses have no height.
    """
    from pkm_twin.maps.figures import COLOUR_MAP, choose_colour_limits, choose_prefix, list_units

    units = list_units(data)
    upwards = data.attrs["height"]
    if upwards not in data.value.dims:
        return {}
    flat = [name for name in units if name != upwards]
    fields = [data.factor.isel(element=n) for n in elements] or [data.value]
    tables = [one.sel(case=case).transpose(upwards, *flat).values for one in fields]
    filled = np.flatnonzero(np.isfinite(tables[0]).sum((1, 2)) >= 4)
    chosen = filled[np.unique(np.linspace(0, len(filled) - 1, SLICES).round().astype(int))]
    low, high = choose_colour_limits(np.concatenate([table.ravel() for table in tables]), np.nan)
    scale, unit = (1.0, "") if elements else choose_prefix(high, str(data.case_unit.values[0]))
    levels = np.linspace(scale * low, scale * high, 22)
    beyond = any(np.nanmax(table) > high * (1.0 + 1e-12) for table in tables)
    extend = "max" if beyond else "neither"
    x, y = np.meshgrid(*(data[name].values for name in flat), indexing="ij")
    heights = data[upwards].values[chosen]
    ax: Any  # of three dimensions
    figure, columns = plots.make_subplots(len(tables), 1, 4.6 if elements else 6.0, subplot_kw={"projection": "3d"})
    drawn: Any = None
    for table, (ax,), n in zip(tables, columns, elements or [-1], strict=True):
        for layer, height in zip(table[chosen], heights.tolist(), strict=True):
            drawn = ax.contourf(
                x,
                y,
                np.ma.masked_invalid(scale * layer),
                levels,
                cmap=COLOUR_MAP,
                zdir="z",
                offset=height,
                extend=extend,
            )
        ax.set(
            xlim=(x.min(), x.max()),
            ylim=(y.min(), y.max()),
            zlim=(heights[0], heights[-1]),
            xlabel=f"{flat[0]} ({units[flat[0]]})",
            ylabel=f"{flat[1]} ({units[flat[1]]})",
            zticks=heights.round(3),
        )
        ax.locator_params(axis="x", nbins=3)
        ax.locator_params(axis="y", nbins=3)
        ax.set_box_aspect((1.0, 1.0, 1.5), zoom=0.85)
        ax.tick_params(labelsize=8)
        ax.tick_params(axis="z", pad=7)
        ax.view_init(elev=22, azim=-60)
        if elements:
            ax.set_title(str(data.element.values[n]))
    label = "share of the strain energy (dimensionless)" if elements else f"strain energy ({unit})"
    bar = figure.colorbar(drawn, ax=figure.axes, aspect=25, pad=0.02)
    bar.locator = plots.pyplot().MaxNLocator(6)
    bar.update_ticks()
    bar.set_label(label)
    plots.write_title(figure, _title(data, case, elements, f"slices at heights {upwards} (m)"), 10)
    return {"slices": figure}


def _draw_planes(data: Dataset, case: str, elements: list[int]) -> dict[str, Figure]:
    """Draw elements' shares in the plane across the height, or in the fullest plane."""
    from pkm_twin.maps.figures import draw_panel, extract_plane, list_full_planes

    k = [str(name) for name in data.case.values].index(case)
    upwards = data.attrs["height"]
    full = list_full_planes(data, k)
    across = [p for p in full if upwards not in (str(data.row_name.values[p]), str(data.column_name.values[p]))]
    plane = (across or full)[0]
    one = extract_plane(data, k, plane)
    if len(one.names) < 2:
        return {}
    table = data.plane_factor.isel(plane=plane, case=k).values[..., elements]
    high = float(np.nanmax(table))
    figure, columns = plots.make_subplots(len(elements), 1, plots.WIDTH / MAX_PANELS + 0.9)
    for column, (ax,), n in zip(np.moveaxis(table, -1, 0), columns, elements, strict=True):
        mesh = draw_panel(replace(one, values=column, star=None), ax, 1.0, 0.0, high, (0.25, 0.6, 0.9))
        ax.set_title(str(data.element.values[n]), fontsize=10)
    bar = figure.colorbar(mesh, ax=figure.axes, aspect=25, pad=0.01)
    bar.set_label("share of the strain energy (dimensionless)")
    plots.write_title(figure, _title(data, case, elements, one.held), 10)
    return {"plane": figure}
