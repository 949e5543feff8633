# SPDX-License-Identifier: Apache-2.0
"""Figures of a workspace atlas: sections, and where limbs come near each other."""

from __future__ import annotations

import functools
import json
import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas import figures, planes, plots
from pkm_twin.atlas.workspace.page import LABELS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from xarray import Dataset

Array = NDArray[np.float64]


def section(
    atlas: Dataset, ax: Axes | None = None, upright: bool = True, z: float | None = None
) -> Axes:
    """A section through the workspace, coloured by the singularity index.

    What limb interference takes away is hatched.

    :param upright: through the axis, else across it at height z.
    :param z: m; default the middle of the largest cylinder.
    """
    ax = figures.axes_or_new(ax)
    first, second, hidden = _plane_of(atlas, upright)
    ticks = atlas[hidden].values
    if upright:
        cut = {hidden: len(ticks) // 2}
        ax.set_title(f"{hidden} = 0")
    else:
        height = middle_height(atlas) if z is None else z
        cut = {hidden: int(np.abs(ticks - height).argmin())}
        ax.set_title(f"{hidden} = {float(ticks[cut[hidden]]):.3f} m")
    values = atlas.singularity.isel(cut).transpose(second, first).values
    greatest = float(atlas.singularity.max())
    mesh = _mesh(atlas, ax, first, second, values, cmap=figures.MAP, vmin=0.0, vmax=greatest)
    marks = []
    if "clearance" in atlas:
        gap = atlas.clearance.isel(cut).transpose(second, first).values
        marks = _hatch(atlas, ax, first, second, gap, "lost: limbs")
    scale = 1.0 if atlas.circle.attrs["units"] == "m" else 180 / math.pi
    radius = scale * float(atlas.cylinder_radius)
    if upright:
        circle, height = scale * atlas.circle.values, atlas.height.values
        label = "largest circle about the axis"
        for side in (-1, 1):
            shown = np.where(circle > 0, side * circle, np.nan)
            ax.plot(shown, height, color="white", lw=2.5)
            ax.plot(
                shown, height, color=plots.COLOURS[1], lw=1.2, label=label if side > 0 else None
            )
        low, high = float(atlas.cylinder_low), float(atlas.cylinder_high)
        ax.plot(
            [-radius, radius, radius, -radius, -radius],
            [low, low, high, high, low],
            "k--",
            lw=1.2,
            label="largest cylinder",
        )
        marks = [*ax.get_legend_handles_labels()[0], *marks]
    else:
        ax.add_patch(plots.pyplot().Circle((0, 0), radius, fill=False, ls="--", lw=1.2, ec="black"))
        ax.set_aspect("equal")
    _legend_above(ax, marks)
    figures.bar(ax, mesh, "singularity index (dimensionless)")
    return ax


def closest(atlas: Dataset, ax: Axes | None = None, upright: bool = True) -> Axes:
    """Where limbs come closest: least clearance over the pose parameter that is not shown.

    :param upright: over the second parameter across the axis, else over z.
    """
    ax = figures.axes_or_new(ax)
    first, second, hidden = _plane_of(atlas, upright)
    names = [name for name in atlas.clearance.dims if name != hidden]
    gap = _clearance(atlas, np.fmin, names)
    if names != [second, first]:
        gap = gap.T
    # The colours are those of what is not hatched.
    shown = np.where(gap > _least_clearance(atlas), 1e3 * gap, np.nan)
    mesh = _mesh(atlas, ax, first, second, shown, cmap=figures.OTHER_MAP, vmin=0.0)
    ax.set_title(f"least clearance over {hidden}")
    if not upright:
        ax.set_aspect("equal")
    _legend_above(ax, _hatch(atlas, ax, first, second, gap, f"for some {hidden} limbs"))
    figures.bar(ax, mesh, "clearance between limbs (mm)")
    return ax


def _plane_of(atlas: Dataset, upright: bool) -> tuple[str, str, str]:
    """Pose coordinates to the right and up in a section, and the one that it cuts."""
    one, other = atlas.attrs["lateral"].split()
    height = atlas.attrs["height"]
    if upright:
        return one, height, other
    tilting = atlas[one].attrs["units"] == "rad"
    return (other, one, height) if tilting else (one, other, height)


def _mesh(atlas: Dataset, ax: Axes, first: str, second: str, values: Array, **options: Any) -> Any:
    """A field over two pose parameters, with their names at the axes; NaN is left out."""
    x, y = (figures.in_degrees(atlas[name])[0] for name in (first, second))
    for label, name in ((ax.set_xlabel, first), (ax.set_ylabel, second)):
        label(f"{name} ({figures.in_degrees(atlas[name])[1]})")
    return ax.pcolormesh(x, y, np.ma.masked_invalid(values), shading="nearest", **options)


def _hatch(atlas: Dataset, ax: Axes, first: str, second: str, gap: Array, what: str) -> list[Any]:
    """Hatch where limbs are too near, and what to put into the legend for it."""
    near = np.nan_to_num(gap, nan=np.inf) <= _least_clearance(atlas)
    if not near.any():
        return []
    x, y = (figures.in_degrees(atlas[name])[0] for name in (first, second))
    # Filled contours take hatches, a mesh of colours does not.
    ax.contourf(x, y, near, [0.5, 1.5], colors=["0.85"], hatches=["////"])
    ax.contour(x, y, near, [0.5], colors="0.2", linewidths=0.8)
    label = f"{what} {_near(atlas)}"
    return [plots.pyplot().Rectangle((0, 0), 1, 1, fc="0.85", ec="0.2", hatch="////", label=label)]


def _clearance(atlas: Dataset, ufunc: Any, kept: list[str]) -> Array:
    """Least (fmin) or greatest (fmax) clearance, m, over all dimensions but ``kept``.

    Slab by slab, as the file is stored. NaN where no pose is.
    """
    first, *rest = atlas.clearance.dims
    over = tuple(k for k, name in enumerate(rest) if name not in kept)
    slabs = (
        ufunc.reduce(atlas.clearance.isel({first: k}).values, over)
        for k in range(atlas.sizes[first])
    )
    return np.stack(list(slabs)) if first in kept else np.asarray(functools.reduce(ufunc, slabs))


def _least_clearance(atlas: Dataset) -> float:
    """What a reachable pose's clearance is above, m."""
    return float(json.loads(atlas.attrs["settings"])["least_clearance"])


def _near(atlas: Dataset) -> str:
    bound = _least_clearance(atlas)
    return f"are within {1e3 * bound:g} mm" if bound > 0.0 else "meet"


def _legend_above(ax: Axes, handles: list[Any]) -> None:
    """A legend in room of its own above what is drawn."""
    if not handles:
        return
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + (0.05 + 0.06 * len(handles)) * (high - low))
    ax.legend(handles=handles, loc="upper right", fontsize=8)


def middle_height(atlas: Dataset) -> float:
    """Middle of the largest cylinder, m."""
    low, high = float(atlas.cylinder_low), float(atlas.cylinder_high)
    heights = atlas[atlas.attrs["height"]]
    return (low + high) / 2 if math.isfinite(low) else float(heights.mean())


def _workspace(atlas: Dataset) -> Figure:
    return _upright(atlas) if "circle" in atlas else _sections(atlas)


def _sections(atlas: Dataset) -> Figure:
    """Every pair of coordinates through the home pose."""
    shown = planes.planes(atlas, list(LABELS))
    columns = min(len(shown), 5 if len(shown) > 4 else 3)
    rows = math.ceil(len(shown) / columns)
    figure, axes = figures.subplots(
        rows, columns, figsize=(5.2 * columns, 4.2 * rows), layout="constrained", squeeze=False
    )
    greatest = float(atlas.singularity.max()) or 1.0
    for ax in axes.ravel()[len(shown) :]:
        ax.set_visible(False)
    for one, ax in zip(shown, axes.ravel(), strict=False):
        planes.draw(one, "singularity", LABELS["singularity"], 0.0, greatest, ax)
    size = ""
    if "volume" in atlas:
        size = f" {float(atlas.volume):.4g} {atlas.volume.attrs['units']}"
    figure.suptitle(f"{atlas.attrs['robot']}: reachable{size or ' poses through home'}")
    return figure


def _upright(atlas: Dataset) -> Figure:
    known = "clearance" in atlas
    figure, axes = figures.subplots(
        1 + known, 2, figsize=(9, 8 if known else 4.2), layout="constrained", squeeze=False
    )
    section(atlas, axes[0, 0])
    section(atlas, axes[0, 1], upright=False)
    share = ""
    if known:
        closest(atlas, axes[1, 0])
        closest(atlas, axes[1, 1], upright=False)
        lost = 100 * float(atlas.interference)
        where = "nowhere" if lost == 0.0 else f"in {lost:.3g} % of otherwise reachable poses"
        share = f"; limbs {_near(atlas)} {where}"
    unit = atlas.circle.attrs["units"]
    radius = float(atlas.cylinder_radius)
    shown = f"{math.degrees(radius):.1f} deg" if unit == "rad" else f"{radius:.3f} m"
    figure.suptitle(
        f"{atlas.attrs['robot']}: reachable {float(atlas.volume):.4g} "
        f"{atlas.volume.attrs['units']}\nlargest cylinder {atlas.attrs['height']} = "
        f"{float(atlas.cylinder_low):.3f} to "
        f"{float(atlas.cylinder_high):.3f} m, radius {shown}{share}"
    )
    return figure


FIGURES: Final = {"sections": _workspace}
