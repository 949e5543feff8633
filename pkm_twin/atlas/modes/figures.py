# SPDX-License-Identifier: Apache-2.0
"""Figures of a modes atlas: frequencies across and along the axis, and mode shapes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from pkm_twin.atlas import figures, plots
from pkm_twin.atlas.modes.stored import (
    ENLARGED,
    across,
    deformed,
    grounded,
    largest_shares,
    shape_pose,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from xarray import Dataset


def frequency(
    atlas: Dataset, mode: int = 1, z: float | None = None, ax: Axes | None = None, **options: Any
) -> Axes:
    """One natural frequency across the axis at one height.

    :param mode: 1 is the lowest.
    :param z: m; the nearest height is drawn; default the middle one.
    :param options: for ``contourf``; ``least`` and ``greatest``: values of the first and the last
        colour.
    """
    ax = figures.axes_or_new(ax)
    middle = float(atlas.z[atlas.sizes["z"] // 2])
    layer = atlas.frequency.sel(mode=mode).sel(z=middle if z is None else z, method="nearest")
    x, y, values, labels = across(atlas, layer.values)
    figures.contours(ax, x, y, values, "frequency (Hz)", **options)
    ax.set_xlabel(labels[0])
    ax.set_ylabel(labels[1])
    ax.set_title(f"mode {mode}, z = {float(layer.z):.3f} m")
    return ax


def frequency_range(atlas: Dataset, ax: Axes | None = None) -> Axes:
    """Least and greatest frequency of every mode over the height."""
    ax = figures.axes_or_new(ax)
    for k, mode in enumerate(atlas.mode.values.tolist()):
        values = atlas.frequency.sel(mode=mode)
        low, high = (values.reduce(f, ("distance", "azimuth")).values for f in (np.min, np.max))
        style: dict[str, Any] = {
            "color": figures.LINES[k % len(figures.LINES)],
            "ls": ("-", "--")[k % 2],
            "lw": 1.5,
        }
        ax.fill_between(atlas.z.values, low, high, color=style["color"], alpha=0.2, lw=0)
        ax.plot(atlas.z.values, low, **style, label=f"mode {mode}")
        ax.plot(atlas.z.values, high, **style)
    plots.label(ax, "z (m)", "frequency, least to greatest (Hz)")
    ax.set_ylim(bottom=0.0)
    ax.margins(x=0)
    # In the order of the lines: the highest mode on top.
    handles, labels = ax.get_legend_handles_labels()
    ax.legend(handles[::-1], labels[::-1], loc="center left", bbox_to_anchor=(1.0, 0.5))
    return ax


def mode_shape(atlas: Dataset, mode: int = 1, ax: Any = None) -> Any:
    """The frame at rest in grey and in a mode, enlarged, on 3-D axes; colour: how far it moves."""
    if ax is None:
        figure = figures.new_figure(figsize=(6, 6), layout="constrained")
        ax = figure.add_subplot(projection="3d")
    from matplotlib import ticker
    from mpl_toolkits.mplot3d.art3d import Line3DCollection  # type: ignore[import-untyped]

    rest, lines = atlas.position.values, atlas.line.values
    moved, far = deformed(atlas, mode)
    ax.add_collection3d(Line3DCollection(rest[lines], colors="0.7", linewidths=1.0))
    drawn = Line3DCollection(moved[lines], cmap=figures.MAP, linewidths=2.2)
    drawn.set_array(far[lines].mean(1))
    drawn.set_clim(0.0, 1.0)
    ax.add_collection3d(drawn)
    ground = grounded(atlas)
    ax.scatter(*rest[ground].T, marker="s", s=16, color="0.3", depthshade=False)
    # Equal lengths along all axes, whatever the matplotlib; all modes of one file alike.
    span = np.ptp(rest, axis=0)
    margin = 0.6 * ENLARGED * float(np.linalg.norm(span))
    low, high = rest.min(0) - margin, rest.max(0) + margin
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.set_zlim(low[2], high[2])
    ax.set_box_aspect(high - low, zoom=0.93)
    ax.view_init(elev=18, azim=-58)
    ax.grid(visible=False)
    # Labels of the axes beside it stay visible.
    ax.patch.set_visible(False)
    for axis, name in zip((ax.xaxis, ax.yaxis, ax.zaxis), "xyz", strict=True):
        axis.set_major_locator(ticker.MaxNLocator(4))
        axis.set_tick_params(labelsize=8, pad=0)
        axis.set_label_text(f"{name} (m)", fontsize=9)
        axis.labelpad = -2
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
    hertz = float(atlas.shape_frequency.sel(mode=mode))
    ax.set_title(
        f"mode {mode}: {hertz:.4g} Hz\n"
        f"strain: {largest_shares(atlas, mode)}\n"
        f"kinetic: {largest_shares(atlas, mode, 'kinetic')}",
        fontsize=9,
        pad=0,
    )
    return ax


def _frequency_plane(atlas: Dataset) -> Figure:
    """The four lowest, on one scale."""
    figure, axes = figures.subplots(2, 2, figsize=(9, 7.6), layout="constrained")
    modes = atlas.mode.values.tolist()[:4]
    layer = atlas.frequency.sel(mode=modes).isel(z=atlas.sizes["z"] // 2)
    scale = {"least": 0.0, "greatest": float(layer.max())}
    for mode, ax in zip(modes, axes.ravel(), strict=False):
        frequency(atlas, mode, ax=ax, **scale)
    figure.suptitle(f"{atlas.attrs['robot']}: lowest natural frequencies, actuators locked")
    return figure


def _frequency_range(atlas: Dataset) -> Figure:
    figure, ax = figures.subplots(figsize=(8, 5), layout="constrained")
    frequency_range(atlas, ax)
    figure.suptitle(
        f"{atlas.attrs['robot']}: natural frequencies over the largest cylinder, actuators locked"
    )
    return figure


def _mode_shapes(atlas: Dataset) -> Figure:
    from matplotlib import cm, colors

    figure, axes = figures.subplots(
        2, 2, figsize=(9, 8.5), layout="constrained", subplot_kw={"projection": "3d"}
    )
    for mode, ax in zip(atlas.mode.values.tolist()[:4], axes.ravel(), strict=False):
        mode_shape(atlas, mode, ax)
    colour = cm.ScalarMappable(colors.Normalize(0.0, 1.0), figures.MAP)
    bar = figure.colorbar(colour, ax=axes, shrink=0.6, aspect=30, pad=0.05)
    bar.set_label("displacement over the mode's largest (dimensionless)")
    figure.suptitle(
        f"{atlas.attrs['robot']} at {shape_pose(atlas)}: lowest modes, actuators locked\n"
        "grey: at rest; coloured: deformed, enlarged; in the titles: the parts with most energy"
    )
    return figure


FIGURES: Final = {
    "plane": _frequency_plane,
    "range": _frequency_range,
    "shapes": _mode_shapes,
}
