# SPDX-License-Identifier: Apache-2.0
"""Figures of a strain-energy atlas: planes and slices of the energy, and the elements' factors."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from pkm_twin.atlas import figures, plots
from pkm_twin.atlas.strain_energy.stored import lateral_of, load_case, wrench_of
from pkm_twin.atlas.strain_energy.sweep import nearest_height, table_2

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from xarray import Dataset


def plane(
    atlas: Dataset,
    variable: str = "energy",
    z: float | None = None,
    ax: Axes | None = None,
    **options: Any,
) -> Axes:
    """One field of a strain-energy atlas over the plane of beta and gamma at one height.

    :param variable: ``energy``, or the name of an element for its factor.
    :param z: m; the nearest height is drawn; default that of the paper's figures.
    :param options: for ``contourf``; ``least`` and ``greatest``: values of
        the first and the last colour.
    """
    ax = figures.axes_or_new(ax)
    layer = atlas.isel(z=nearest_height(atlas.z.values, z))
    tilt = figures.thin(atlas.tilt.values)
    azimuth = figures.thin(atlas.azimuth.values)
    steps = {
        "tilt": figures.every(atlas.sizes["tilt"]),
        "azimuth": figures.every(atlas.sizes["azimuth"]),
    }
    layer = layer.isel({dim: slice(None, None, step) for dim, step in steps.items()})
    if variable == "energy":
        values, unit = figures.prefixed(layer.energy.values, "J")
        label = f"total strain energy ({unit})"
    else:
        values, label = (
            layer.factor.sel(element=variable).values,
            "share of the strain energy (dimensionless)",
        )
    shown = np.isfinite(values).any(1)
    turn, values = figures.around(azimuth, values[shown])
    beta, gamma = (np.degrees(tilt[shown])[:, None] * f(turn) for f in (np.cos, np.sin))
    figures.contours(ax, gamma, beta, values, label, **options)
    first, second = lateral_of(atlas)
    ax.set_xlabel(f"{second} (deg)")
    ax.set_ylabel(f"{first} (deg)")
    ax.set_title(f"z = {float(layer.z):.3f} m")
    return ax


def global_factors(atlas: Dataset, ax: Axes | None = None) -> Axes:
    """Global strain-energy factors, compared with the paper's where it prints them."""
    ax = figures.axes_or_new(ax)
    names = [str(name) for name in atlas.element.values]
    bars = [("this map", atlas.global_factor.values, plots.COLOURS[0])]
    printed = table_2(wrench_of(atlas))
    if printed is not None:
        bars.append(("paper, table 2", np.array(printed), plots.COLOURS[4]))
    bars.append(("this map, mean over the volume", atlas.volume_factor.values, plots.COLOURS[2]))
    width = 0.8 / len(bars)
    for k, (label, values, colour) in enumerate(bars):
        place = np.arange(len(names)) + (k - (len(bars) - 1) / 2) * width
        ax.bar(place, values, width, label=label, color=colour)
    ax.set_xticks(np.arange(len(names)), names)
    ax.set_xlabel("element: limb, and revolute joint, bar or universal joint")
    ax.set_ylabel("global strain-energy factor (dimensionless)")
    ax.grid(axis="y", alpha=0.3)
    ax.legend()
    return ax


def stack(atlas: Dataset, ax: Any = None, layers: int = 6) -> Any:
    """Total energy on slices of the workspace, stacked by height, on 3-D axes."""
    if ax is None:
        ax = (
            plots.pyplot().figure(figsize=(8, 7), layout="constrained").add_subplot(projection="3d")
        )
    from matplotlib import cm, colors

    picked = np.unique(np.linspace(0, atlas.sizes["z"] - 1, layers).round().astype(int))
    every = {d: max(1, math.ceil(atlas.sizes[d] / 48)) for d in ("tilt", "azimuth")}
    part = atlas.isel({d: slice(None, None, s) for d, s in every.items()})
    energy, unit = figures.prefixed(part.energy.isel(z=picked).values, "J")
    norm = colors.LogNorm(np.nanmin(energy), np.nanmax(energy))
    for k, layer in zip(picked, energy, strict=True):
        shown = np.isfinite(layer).any(1)
        turn, values = figures.around(part.azimuth.values, layer[shown], 144)
        tilt = np.degrees(part.tilt.values[shown])[:, None]
        beta, gamma = tilt * np.cos(turn), tilt * np.sin(turn)
        height = np.full_like(values, float(atlas.z[k]))
        ax.plot_surface(
            gamma,
            beta,
            height,
            facecolors=figures.colours(norm, values),
            rstride=1,
            cstride=1,
            shade=False,
            linewidth=0,
            antialiased=False,
        )
    ax.view_init(elev=24, azim=-60)
    ax.set_box_aspect((1, 1, 0.8), zoom=1.12)
    first, second = lateral_of(atlas)
    ax.set_xlabel(f"{second} (deg)")
    ax.set_ylabel(f"{first} (deg)")
    ax.set_zlabel("z (m)", labelpad=8)
    bar = ax.figure.colorbar(cm.ScalarMappable(norm, figures.MAP), ax=ax, shrink=0.75, pad=0.12)
    bar.set_label(f"total strain energy ({unit})")
    figures.plain_ticks(bar)
    return ax


def _energy_plane(atlas: Dataset) -> Figure:
    figure, ax = figures.subplots(figsize=(7, 6), layout="constrained")
    plane(atlas, ax=ax)
    figure.suptitle(f"{load_case(atlas)}: total strain energy")
    return figure


def _energy_slices(atlas: Dataset) -> Figure:
    figure = figures.new_figure(figsize=(8, 6.2), layout="constrained")
    stack(atlas, figure.add_subplot(projection="3d"))
    figure.suptitle(f"{load_case(atlas)}: total strain energy over the workspace")
    return figure


def _factor_plane(atlas: Dataset) -> Figure:
    """The four elements with the greatest shares at this height, on one scale."""
    figure, axes = figures.subplots(2, 2, figsize=(9, 7.6), layout="constrained")
    layer = nearest_height(atlas.z.values)
    greatest = atlas.factor.isel(z=layer).max(("tilt", "azimuth"))
    names = greatest.sortby(greatest, ascending=False).element.values[:4]
    for name, ax in zip(sorted(names), axes.ravel(), strict=True):
        plane(atlas, str(name), ax=ax, least=0.0, greatest=float(greatest.max()))
        ax.set_title(f"element {name}")
    figure.suptitle(
        f"{load_case(atlas)}\nwhich elements store the energy at z = {float(atlas.z[layer]):.3f} m?"
    )
    return figure


def _global(atlas: Dataset) -> Figure:
    figure, ax = figures.subplots(figsize=(9, 4.5), layout="constrained")
    global_factors(atlas, ax)
    figure.suptitle(f"{load_case(atlas)}: global strain-energy factors")
    return figure


FIGURES: Final = {
    "plane": _energy_plane,
    "factors": _factor_plane,
    "slices": _energy_slices,
    "global": _global,
}
