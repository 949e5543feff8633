# SPDX-License-Identifier: Apache-2.0
"""Figures of an isotropy atlas: spheres of directions, and how far an index differs over them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas import figures, plots
from pkm_twin.atlas.isotropy.stored import at_height, rates_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from xarray import Dataset

Array = NDArray[np.float64]

VIEW: Final = np.array([0.36, 0.8, 0.48])
"""Where spheres are looked at from, in pose rates."""
PIXELS: Final = 61
BEYOND: Final[Mapping[str, Any]] = {"ec": "#D55E00", "lw": 1.6, "ls": "--"}
"""Rim of a sphere beyond the limits."""
TAIL: Final = 0.5
"""Percent of the values on spheres beyond each end of their colours: a few extremes would leave
all others one colour."""


def sphere_image(values: Array, polar: Array, turn: Array) -> Array:
    """A sphere of values as it is seen from ``VIEW``, shape (61, 61).

    Around it the values of its rim go on, for a picture that is cut off at the rim.

    :param values: on the directions, shape (polar, turn).
    """
    right, up = _view()
    ticks = np.linspace(-1.0, 1.0, PIXELS)
    u, v = np.meshgrid(ticks, ticks)
    outside = np.maximum(np.hypot(u, v), 1.0)
    u, v = u / outside, v / outside
    depth = np.sqrt(np.maximum(1.0 - u * u - v * v, 0.0))
    x = u[..., None] * right + v[..., None] * up + depth[..., None] * VIEW
    theta = np.arccos(np.clip(x[..., 2], -1.0, 1.0)) / (polar[1] - polar[0])
    phi = np.mod(np.arctan2(x[..., 1], x[..., 0]), 2 * np.pi) / (turn[1] - turn[0])
    i = np.minimum(theta.astype(int), len(polar) - 2)
    j = np.minimum(phi.astype(int), len(turn) - 1)
    s, t = theta - i, phi - j
    k = (j + 1) % len(turn)
    image = (1 - s) * ((1 - t) * values[i, j] + t * values[i, k])
    image += s * ((1 - t) * values[i + 1, j] + t * values[i + 1, k])
    return np.asarray(image, np.float64)


def spheres(atlas: Dataset, index: str = "eta", ax: Axes | None = None) -> Axes:
    """Spheres of directions over the grid of poses, coloured by an index.

    :param index: ``eta`` or ``force``.
    """
    from matplotlib import cm, colors

    ax = figures.axes_or_new(ax, (8.5, 8))
    names = atlas[index].dims[:2]
    polar_grid = names == ("azimuth", "tilt")
    scale = 1.0 if not polar_grid else 180 / math.pi
    first, second = (atlas[name].values for name in names)
    most = 13
    firsts = range(0, len(first), max(1, math.ceil(len(first) / most)))
    seconds = range(0, len(second), max(1, math.ceil(len(second) / most)))
    picked = {names[0]: list(firsts), names[1]: list(seconds)}
    values = atlas[index].isel(picked).values
    within = atlas.within_limits.isel(picked).values > 0
    low, high = np.nanpercentile(values, (TAIL, 100 - TAIL))
    norm = colors.LogNorm(low, high) if index == "force" else colors.Normalize(low, high)
    steps = plots.pyplot().get_cmap(
        figures.MAP if index == "eta" else figures.OTHER_MAP, figures.LEVELS
    )
    ring = scale * float(second[seconds[1]] - second[0])
    radius = 0.46 * ring
    beyond = False
    polar, turn = atlas.polar.values, atlas.turn.values
    for a, i in enumerate(firsts):
        for b, j in enumerate(seconds):
            # The upright pose once; the others on rings, the first further out for room.
            known = np.isfinite(values[a, b]).all()
            if (polar_grid and j == 0 and a > 0) or (not polar_grid and not known):
                continue
            if polar_grid:
                out = scale * second[j] + (0.0 if j == 0 else ring)
                x, y = out * math.cos(first[i]), out * math.sin(first[i])
            else:
                x, y = float(first[i]), float(second[j])
            size = radius if not polar_grid else min(radius, _room(first, scale, second, j, ring))
            ring_of = {"ec": "0.3", "lw": 0.6} if within[a, b] else BEYOND
            rim = plots.pyplot().Circle((x, y), size, fill=False, zorder=2.1, **ring_of)
            ax.add_patch(rim)
            beyond |= not within[a, b]
            if not known:
                continue
            image = ax.imshow(
                sphere_image(values[a, b], polar, turn),
                origin="lower",
                extent=(x - size, x + size, y - size, y + size),
                cmap=steps,
                norm=norm,
                interpolation="bilinear",
                interpolation_stage="data",
                zorder=2,
            )
            image.set_clip_path(rim)
    if beyond:
        label = "beyond the machine's limits"
        handle = plots.pyplot().Line2D([], [], ls="--", lw=1.6, color=BEYOND["ec"], label=label)
        ax.legend(handles=[handle], loc="upper right", fontsize=8)
    if polar_grid:
        reach = _rings(ax, first[list(firsts)], second[list(seconds)], scale, ring)
        ax.set_xlabel("around: azimuth of the tilt (deg); outwards: tilt (deg)")
        ax.set_xticks([])
        ax.set_yticks([])
    else:
        x_label, y_label = (f"{name} ({atlas[name].attrs['units']})" for name in names)
        ax.set_xlabel(x_label)
        ax.set_ylabel(y_label)
        side = float(np.ptp(first)) / 2 + 1.2 * radius
        middle = float(first.mean()), float(second.mean())
        ax.set_xlim(middle[0] - side, middle[0] + side)
        ax.set_ylim(middle[1] - side, middle[1] + side)
    if polar_grid:
        ax.set_xlim(-reach, reach)
        ax.set_ylim(-reach, reach)
    ax.set_aspect("equal")
    unit = figures.unit_of(atlas[index])
    label = f"eta_KE = E_M / E_all ({unit})" if index == "eta" else f"F_max ({unit})"
    colour = cm.ScalarMappable(norm, steps)
    bar = ax.figure.colorbar(colour, ax=ax, shrink=0.9, fraction=0.04, aspect=32, extend="both")
    bar.set_label(label)
    if index == "force":
        figures.plain_ticks(bar)
    _triad(atlas, ax)
    return ax


def _room(first: Array, scale: float, second: Array, j: int, ring: float) -> float:
    out = scale * float(second[j]) + (0.0 if j == 0 else ring)
    shown = min(len(first), 13)
    return 0.48 * out * 2 * math.sin(math.pi / shown) if j else math.inf


def _rings(ax: Axes, azimuths: Array, tilts: Array, scale: float, ring: float) -> float:
    """Circles of equal tilt with their names; returns the picture's half width."""
    turn = np.linspace(0, 2 * np.pi, 181)
    for tilt in tilts[1:]:
        out = scale * tilt + ring
        ax.plot(out * np.cos(turn), out * np.sin(turn), color="0.85", lw=0.8, zorder=0)
    outermost = scale * float(tilts[-1]) + ring
    for azimuth in azimuths:
        out = outermost + 0.72 * ring
        place = (out * math.cos(azimuth), out * math.sin(azimuth))
        ax.text(*place, f"{math.degrees(azimuth):.0f}°", ha="center", va="center", fontsize=10)
    between = math.pi / len(azimuths)
    for k, tilt in enumerate(tilts[1:]):
        # The spheres of the first ring leave no room on it.
        out = scale * float(tilt) + (0.35 if k == 0 else 1.0) * ring
        ax.text(
            out * math.cos(between),
            out * math.sin(between),
            f"{scale * float(tilt):.4g}°",
            ha="center",
            va="center",
            fontsize=9,
            color="0.3",
            zorder=3,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.8},
        )
    return outermost + ring


def _triad(atlas: Dataset, ax: Axes) -> None:
    """Where the spheres' axes point, in the lower left corner."""
    right, up = _view()
    inset = ax.inset_axes((0.01, 0.01, 0.18, 0.18))
    names = rates_of(atlas)
    for k, name in enumerate(names):
        tip = np.array([right[k], up[k]])
        inset.annotate(
            "",
            tuple(tip.tolist()),
            (0.0, 0.0),
            arrowprops={"arrowstyle": "->", "color": "black", "lw": 1.0},
        )
        side = "center" if abs(tip[0]) < 0.3 else "left" if tip[0] > 0 else "right"
        inset.text(1.12 * tip[0], 1.22 * tip[1], name, ha=side, va="center", fontsize=9)
    inset.set_xlim(-1.9, 1.3)
    inset.set_ylim(-1.4, 1.8)
    inset.set_aspect("equal")
    inset.axis("off")


def _view() -> tuple[Array, Array]:
    """Unit vectors of the picture's right and up, in pose rates."""
    right = np.cross([0.0, 0.0, 1.0], VIEW)
    right /= np.linalg.norm(right)
    return right, np.cross(VIEW, right)


def spread_over_poses(atlas: Dataset, index: str = "eta", ax: Axes | None = None) -> Axes:
    """How far an index differs over the sphere at each pose: greatest less least."""
    ax = figures.axes_or_new(ax)
    names = atlas[index].dims[:2]
    values = (
        (atlas.eta_greatest - atlas.eta_least).values
        if index == "eta"
        else np.ptp(atlas[index].values, axis=(-2, -1))
    )
    unit = figures.unit_of(atlas[index])
    what = "range of eta_KE" if index == "eta" else "range of F_max"
    if names == ("azimuth", "tilt"):
        tilt = np.degrees(atlas.tilt.values)
        for k, azimuth in enumerate(np.degrees(atlas.azimuth.values)):
            if azimuth <= 180.0 + 1e-9 and k % max(1, len(atlas.azimuth) // 12) == 0:
                # Thinner and thinner: azimuths whose lines are the same stay visible.
                drawn = len(ax.lines)
                ax.plot(
                    tilt,
                    values[k],
                    color=figures.LINES[drawn % len(figures.LINES)],
                    lw=max(1.2, 5.0 - 0.65 * drawn),
                    label=f"{azimuth:.0f}°",
                )
        plots.label(ax, "tilt (deg)", f"{what} ({unit})")
        ax.legend(title="azimuth", fontsize=8)
        return ax
    first, second = (atlas[name].values for name in names)
    from matplotlib import colors

    mesh = ax.pcolormesh(
        first,
        second,
        np.ma.masked_invalid(values.T),
        cmap=figures.MAP if index == "eta" else figures.OTHER_MAP,
        shading="nearest",
        norm=colors.LogNorm() if index == "force" else None,
    )
    ax.set_aspect("equal")
    x_label, y_label = (f"{name} ({atlas[name].attrs['units']})" for name in names)
    ax.set_xlabel(x_label)
    ax.set_ylabel(y_label)
    bar = figures.bar(ax, mesh, f"{what} ({unit})")
    if index == "force":
        figures.plain_ticks(bar)
    return ax


def _spheres_eta(atlas: Dataset) -> Figure:
    return _spheres(atlas, "eta")


def _spheres_force(atlas: Dataset) -> Figure:
    return _spheres(atlas, "force")


def _spheres(atlas: Dataset, index: str) -> Figure:
    figure, ax = figures.subplots(figsize=(10.6, 8.6), layout="constrained")
    spheres(atlas, index, ax)
    if index == "eta":
        what = "which part of the kinetic energy is the platform's, per direction?"
    else:
        energy = json.loads(atlas.attrs["settings"])["energy"]
        what = (
            f"how much drive {_effort(atlas)} per direction, at a platform energy of {energy:g} J?"
        )
    figure.suptitle(f"{at_height(atlas)}: {what}")
    return figure


def _spreads(atlas: Dataset) -> Figure:
    figure, axes = figures.subplots(1, 2, figsize=(9, 4), layout="constrained")
    titles = ("the platform's part of the kinetic energy", f"largest driving {_effort(atlas)}")
    for index, title, ax in zip(("eta", "force"), titles, axes, strict=True):
        spread_over_poses(atlas, index, ax)
        ax.set_title(title)
    figure.suptitle(f"{at_height(atlas)}: greatest minus least value over all directions")
    return figure


def _effort(atlas: Dataset) -> str:
    return "force" if atlas.force.attrs["units"] == "N" else "torque"


FIGURES: Final = {"eta": _spheres_eta, "force": _spheres_force, "spread": _spreads}
