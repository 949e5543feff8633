# SPDX-License-Identifier: Apache-2.0
"""Pictures of stored atlases. Functions that draw one thing take ``ax=None`` and return the axes.

Each reads from the file only what it draws, so atlases larger than memory can be drawn.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas import plots
from pkm_twin.atlas.strain_energy import PLANE, WRENCHES, table_2
from pkm_twin.errors import ParameterError

Array = NDArray[np.float64]

MAP: Final = "viridis"
OTHER_MAP: Final = "cividis"
VIEW: Final = np.array([0.36, 0.8, 0.48])
"""Where spheres are looked at from, in pose rates."""
PIXELS: Final = 61
FINEST: Final = 200
"""Most samples along one axis of a picture; denser atlases are thinned."""
LEVELS: Final = 30
"""Steps of a map of colours, about: few enough to follow one around, and a small file."""
TAIL: Final = 0.5
"""Percent of the values on spheres beyond each end of their colours: a few extremes would leave
all others one colour."""
ENLARGED: Final = 0.13
"""Largest displacement of a drawn mode shape over the size of the machine."""
LINES: Final = tuple(colour for colour in plots.COLOURS if colour != "#F0E442")
"""Colours of lines on white, where yellow is hard to see."""
PREFIXES: Final = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}


def draw(atlas: Any) -> dict[str, Any]:
    """All figures of an atlas: name to matplotlib figure.

    :param atlas: an ``xarray.Dataset`` of ``open_atlas``.
    :raises ParameterError: a kind without pictures.
    """
    kind = atlas.attrs["kind"]
    if kind not in FIGURES:
        raise ParameterError("kind", kind, ", ".join(FIGURES))
    return {name: figure(atlas) for name, figure in FIGURES[kind].items()}


def save_all(atlas: Any, out: Path) -> list[Path]:
    """Write all figures as PNG beside a path, ``<stem>_<figure>.png``."""
    return [
        plots.save(figure, out.with_name(f"{out.stem}_{name}.png"))
        for name, figure in draw(atlas).items()
    ]


# Strain energy


def plane(
    atlas: Any, variable: str = "energy", z: float | None = None, ax: Any = None, **options: Any
) -> Any:
    """One field of a strain-energy atlas over the plane of beta and gamma at one height.

    :param variable: ``energy``, or the name of an element for its factor.
    :param z: m; the nearest height is drawn; default that of the paper's figures.
    :param options: for ``contourf``; ``least``: the value of the first colour.
    """
    ax = _axes(ax)
    layer = atlas.isel(z=nearest_height(atlas, z))
    tilt = _thin(atlas.tilt.values)
    azimuth = _thin(atlas.azimuth.values)
    steps = {"tilt": _every(atlas.sizes["tilt"]), "azimuth": _every(atlas.sizes["azimuth"])}
    layer = layer.isel({dim: slice(None, None, step) for dim, step in steps.items()})
    if variable == "energy":
        values, unit = prefixed(layer.energy.values, "J")
        label = f"total strain energy ({unit})"
    else:
        values, label = layer.factor.sel(element=variable).values, f"factor of {variable} (1)"
    shown = np.isfinite(values).any(1)
    turn, values = _around(azimuth, values[shown])
    beta, gamma = (np.degrees(tilt[shown])[:, None] * f(turn) for f in (np.cos, np.sin))
    _contours(ax, gamma, beta, values, label, **options)
    ax.set_xlabel("gamma (deg)")
    ax.set_ylabel("beta (deg)")
    ax.set_title(f"z = {float(layer.z):.3f} m")
    return ax


def global_factors(atlas: Any, ax: Any = None) -> Any:
    """Global strain-energy factors, beside the paper's where it prints them."""
    ax = _axes(ax)
    names = [str(name) for name in atlas.element.values]
    bars = [("this atlas", atlas.global_factor.values, plots.COLOURS[0])]
    printed = table_2(wrench_of(atlas))
    if printed is not None:
        bars.append(("paper, table 2", np.array(printed), plots.COLOURS[4]))
    bars.append(("this atlas, mean over the volume", atlas.volume_factor.values, plots.COLOURS[2]))
    width = 0.8 / len(bars)
    for k, (label, values, colour) in enumerate(bars):
        place = np.arange(len(names)) + (k - (len(bars) - 1) / 2) * width
        ax.bar(place, values, width, label=label, color=colour)
    ax.set_xticks(np.arange(len(names)), names)
    ax.set_xlabel("element: limb, and revolute joint, bar or universal joint")
    ax.set_ylabel("global strain-energy factor (1)")
    ax.grid(axis="y", alpha=0.3)
    ax.legend()
    return ax


def stack(atlas: Any, ax: Any = None, layers: int = 6) -> Any:
    """Total energy on slices of the regular workspace, stacked by height, on 3-D axes."""
    if ax is None:
        ax = _pyplot().figure(figsize=(8, 7), layout="constrained").add_subplot(projection="3d")
    from matplotlib import cm, colors

    picked = np.unique(np.linspace(0, atlas.sizes["z"] - 1, layers).round().astype(int))
    every = {d: max(1, math.ceil(atlas.sizes[d] / 48)) for d in ("tilt", "azimuth")}
    part = atlas.isel({d: slice(None, None, s) for d, s in every.items()})
    energy, unit = prefixed(part.energy.isel(z=picked).values, "J")
    norm = colors.LogNorm(np.nanmin(energy), np.nanmax(energy))
    for k, layer in zip(picked, energy, strict=True):
        shown = np.isfinite(layer).any(1)
        turn, values = _around(part.azimuth.values, layer[shown], 144)
        tilt = np.degrees(part.tilt.values[shown])[:, None]
        beta, gamma = tilt * np.cos(turn), tilt * np.sin(turn)
        height = np.full_like(values, float(atlas.z[k]))
        ax.plot_surface(
            gamma,
            beta,
            height,
            facecolors=_colours(norm, values),
            rstride=1,
            cstride=1,
            shade=False,
            linewidth=0,
            antialiased=False,
        )
    ax.view_init(elev=24, azim=-60)
    ax.set_box_aspect((1, 1, 0.8), zoom=1.12)
    ax.set_xlabel("gamma (deg)")
    ax.set_ylabel("beta (deg)")
    ax.set_zlabel("z (m)", labelpad=8)
    bar = ax.figure.colorbar(cm.ScalarMappable(norm, MAP), ax=ax, shrink=0.75, pad=0.12)
    bar.set_label(f"total strain energy ({unit})")
    _plain_ticks(bar)
    return ax


def _energy_plane(atlas: Any) -> Any:
    figure, ax = _pyplot().subplots(figsize=(7, 6), layout="constrained")
    plane(atlas, ax=ax)
    figure.suptitle(f"{load_case(atlas)}: total strain energy")
    return figure


def _energy_slices(atlas: Any) -> Any:
    figure = _pyplot().figure(figsize=(8, 6.2), layout="constrained")
    stack(atlas, figure.add_subplot(projection="3d"))
    figure.suptitle(f"{load_case(atlas)}: total strain energy over the regular workspace")
    return figure


def _factor_plane(atlas: Any) -> Any:
    figure, axes = _pyplot().subplots(3, 3, figsize=(13.5, 10), layout="constrained")
    height = float(atlas.z[nearest_height(atlas, None)])
    for name, ax in zip(atlas.element.values, axes.T.ravel(), strict=True):
        plane(atlas, str(name), ax=ax, least=0.0)
        ax.set_title(f"element {name}")
    figure.suptitle(f"{load_case(atlas)}: strain-energy factors at z = {height:.3f} m")
    return figure


def _global(atlas: Any) -> Any:
    figure, ax = _pyplot().subplots(figsize=(9, 4.5), layout="constrained")
    global_factors(atlas, ax)
    figure.suptitle(f"{load_case(atlas)}: global strain-energy factors")
    return figure


def nearest_height(atlas: Any, z: float | None) -> int:
    """Index of the height nearest to z; default -0.6 m, or the middle where that is outside."""
    heights = atlas.z.values
    if z is None:
        z = PLANE if heights.min() <= PLANE <= heights.max() else float(heights.mean())
    return int(np.abs(heights - z).argmin())


def wrench_of(atlas: Any) -> tuple[float, ...]:
    """The wrench that made a strain-energy atlas, N and N m."""
    return tuple(json.loads(atlas.attrs["settings"])["wrench"])


def load_case(atlas: Any) -> str:
    """Robot and wrench of a strain-energy atlas, as text."""
    wrench = wrench_of(atlas)
    name = "".join(f"{name} = " for name, value in WRENCHES.items() if tuple(value) == wrench)
    numbers = ", ".join(f"{value:g}" for value in wrench)
    return f"{atlas.attrs['robot']} under {name}({numbers}) N, N m"


# Isotropy


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


def spheres(atlas: Any, index: str = "eta", ax: Any = None) -> Any:
    """Spheres of directions over the grid of poses, coloured by an index.

    :param index: ``eta`` or ``force``.
    """
    from matplotlib import cm, colors

    ax = _axes(ax, (8.5, 8))
    names = atlas[index].dims[:2]
    polar_grid = names == ("azimuth", "tilt")
    scale = 1.0 if not polar_grid else 180 / math.pi
    first, second = (atlas[name].values for name in names)
    most = 13
    firsts = range(0, len(first), max(1, math.ceil(len(first) / most)))
    seconds = range(0, len(second), max(1, math.ceil(len(second) / most)))
    values = atlas[index].isel({names[0]: list(firsts), names[1]: list(seconds)}).values
    low, high = np.nanpercentile(values, (TAIL, 100 - TAIL))
    norm = colors.LogNorm(low, high) if index == "force" else colors.Normalize(low, high)
    steps = _pyplot().get_cmap(MAP if index == "eta" else OTHER_MAP, LEVELS)
    ring = scale * float(second[seconds[1]] - second[0])
    radius = 0.46 * ring
    polar, turn = atlas.polar.values, atlas.turn.values
    for a, i in enumerate(firsts):
        for b, j in enumerate(seconds):
            # The upright pose once; the others on rings, the first further out for room.
            if not np.isfinite(values[a, b]).all() or (polar_grid and j == 0 and a > 0):
                continue
            if polar_grid:
                out = scale * second[j] + (0.0 if j == 0 else ring)
                x, y = out * math.cos(first[i]), out * math.sin(first[i])
            else:
                x, y = float(first[i]), float(second[j])
            size = radius if not polar_grid else min(radius, _room(first, scale, second, j, ring))
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
            rim = _pyplot().Circle((x, y), size, fill=False, ec="0.3", lw=0.6, zorder=2.1)
            image.set_clip_path(ax.add_patch(rim))
    if polar_grid:
        reach = _rings(ax, first[list(firsts)], second[list(seconds)], scale, ring)
        ax.set_xlabel("around: azimuth of the tilt (deg); outwards: tilt (deg)")
        ax.set_xticks([])
        ax.set_yticks([])
    else:
        reach = float(np.abs(first).max()) + 1.2 * radius
        ax.set_xlabel(f"{names[0]} (m)")
        ax.set_ylabel(f"{names[1]} (m)")
    ax.set_xlim(-reach, reach)
    ax.set_ylim(-reach, reach)
    ax.set_aspect("equal")
    unit = atlas[index].attrs["units"]
    label = f"eta_KE = E_M / E_all ({unit})" if index == "eta" else f"F_max ({unit})"
    colour = cm.ScalarMappable(norm, steps)
    bar = ax.figure.colorbar(colour, ax=ax, shrink=0.9, fraction=0.04, aspect=32, extend="both")
    bar.set_label(label)
    if index == "force":
        _plain_ticks(bar)
    _triad(atlas, ax)
    return ax


def _room(first: Array, scale: float, second: Array, j: int, ring: float) -> float:
    out = scale * float(second[j]) + (0.0 if j == 0 else ring)
    shown = min(len(first), 13)
    return 0.48 * out * 2 * math.sin(math.pi / shown) if j else math.inf


def _rings(ax: Any, azimuths: Array, tilts: Array, scale: float, ring: float) -> float:
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


def _triad(atlas: Any, ax: Any) -> None:
    """Where the spheres' axes point, in the lower left corner."""
    right, up = _view()
    inset = ax.inset_axes((0.01, 0.01, 0.18, 0.18))
    names = _rates(atlas)
    for k, name in enumerate(names):
        tip = np.array([right[k], up[k]])
        inset.annotate(
            "", tip, (0.0, 0.0), arrowprops={"arrowstyle": "->", "color": "black", "lw": 1.0}
        )
        side = "center" if abs(tip[0]) < 0.3 else "left" if tip[0] > 0 else "right"
        inset.text(*(1.12 * tip + (0.0, 0.1 * tip[1])), name, ha=side, va="center", fontsize=9)
    inset.set_xlim(-1.9, 1.3)
    inset.set_ylim(-1.4, 1.8)
    inset.set_aspect("equal")
    inset.axis("off")


def _rates(atlas: Any) -> tuple[str, ...]:
    tilting = "azimuth" in atlas.sizes
    names = ("z", "alpha", "beta") if tilting else ("x", "y", "z")
    return tuple(f"d{name}/dt" for name in names)


def _view() -> tuple[Array, Array]:
    """Unit vectors of the picture's right and up, in pose rates."""
    right = np.cross([0.0, 0.0, 1.0], VIEW)
    right /= np.linalg.norm(right)
    return right, np.cross(VIEW, right)


def spread_over_poses(atlas: Any, index: str = "eta", ax: Any = None) -> Any:
    """How far an index differs over the sphere at each pose: greatest less least."""
    ax = _axes(ax)
    names = atlas[index].dims[:2]
    values = (
        (atlas.eta_greatest - atlas.eta_least).values
        if index == "eta"
        else np.ptp(atlas[index].values, axis=(-2, -1))
    )
    unit = atlas[index].attrs["units"]
    what = "spread of eta_KE" if index == "eta" else "spread of F_max"
    if names == ("azimuth", "tilt"):
        tilt = np.degrees(atlas.tilt.values)
        for k, azimuth in enumerate(np.degrees(atlas.azimuth.values)):
            if azimuth <= 180.0 + 1e-9 and k % max(1, len(atlas.azimuth) // 12) == 0:
                # Thinner and thinner: azimuths whose lines are the same stay visible.
                drawn = len(ax.lines)
                ax.plot(
                    tilt,
                    values[k],
                    color=LINES[drawn % len(LINES)],
                    lw=max(1.2, 5.0 - 0.65 * drawn),
                    label=f"{azimuth:.0f}°",
                )
        ax.set_xlabel("tilt (deg)")
        ax.set_ylabel(f"{what} ({unit})")
        ax.legend(title="azimuth", fontsize=8)
        ax.grid(alpha=0.3)
        return ax
    first, second = (atlas[name].values for name in names)
    from matplotlib import colors

    mesh = ax.pcolormesh(
        first,
        second,
        np.ma.masked_invalid(values.T),
        cmap=MAP if index == "eta" else OTHER_MAP,
        shading="nearest",
        norm=colors.LogNorm() if index == "force" else None,
    )
    ax.set_aspect("equal")
    ax.set_xlabel(f"{names[0]} (m)")
    ax.set_ylabel(f"{names[1]} (m)")
    bar = _bar(ax, mesh, f"{what} ({unit})")
    if index == "force":
        _plain_ticks(bar)
    return ax


def _spheres_eta(atlas: Any) -> Any:
    return _spheres(atlas, "eta")


def _spheres_force(atlas: Any) -> Any:
    return _spheres(atlas, "force")


def _spheres(atlas: Any, index: str) -> Any:
    figure, ax = _pyplot().subplots(figsize=(10.6, 8.6), layout="constrained")
    spheres(atlas, index, ax)
    if index == "eta":
        what = "the platform's part of the kinetic energy, by direction of the pose rates"
    else:
        energy = json.loads(atlas.attrs["settings"])["energy"]
        what = f"largest driving {_effort(atlas)} at a platform energy of {energy:g} J"
    figure.suptitle(f"{at_height(atlas)}: {what}")
    return figure


def _spreads(atlas: Any) -> Any:
    figure, axes = _pyplot().subplots(1, 2, figsize=(12, 4.8), layout="constrained")
    titles = ("the platform's part of the kinetic energy", f"largest driving {_effort(atlas)}")
    for index, title, ax in zip(("eta", "force"), titles, axes, strict=True):
        spread_over_poses(atlas, index, ax)
        ax.set_title(title)
    figure.suptitle(f"{at_height(atlas)}: greatest less least over all directions")
    return figure


def _effort(atlas: Any) -> str:
    return "force" if atlas.force.attrs["units"] == "N" else "torque"


def at_height(atlas: Any) -> str:
    """Robot and height of an isotropy atlas, as text."""
    height = json.loads(atlas.attrs["settings"])["height"]
    return f"{atlas.attrs['robot']} at z = {height:.3f} m"


# Workspace


def section(atlas: Any, ax: Any = None, upright: bool = True, z: float | None = None) -> Any:
    """A section through the workspace, coloured by the distance to a singularity.

    What limb interference takes away is hatched.

    :param upright: through the axis, else across it at height z.
    :param z: m; default the middle of the largest cylinder.
    """
    ax = _axes(ax)
    first, second, hidden = _plane_of(atlas, upright)
    if upright:
        cut = {hidden: atlas.sizes[hidden] // 2}
        ax.set_title(f"{hidden} = 0")
    else:
        height = middle_height(atlas) if z is None else z
        cut = {"z": int(np.abs(atlas.z.values - height).argmin())}
        ax.set_title(f"z = {float(atlas.z[cut['z']]):.3f} m")
    values = atlas.singularity.isel(cut).transpose(second, first).values
    greatest = float(atlas.singularity.max())
    mesh = _mesh(atlas, ax, first, second, values, cmap=MAP, vmin=0.0, vmax=greatest)
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
        ax.add_patch(_pyplot().Circle((0, 0), radius, fill=False, ls="--", lw=1.2, ec="black"))
        ax.set_aspect("equal")
    _legend_above(ax, marks)
    _bar(ax, mesh, "distance to a singularity (1)")
    return ax


def closest(atlas: Any, ax: Any = None, upright: bool = True) -> Any:
    """Where limbs come closest: least clearance over the pose parameter that is not shown.

    :param upright: over the second parameter across the axis, else over z.
    """
    ax = _axes(ax)
    first, second, hidden = _plane_of(atlas, upright)
    names = [name for name in atlas.clearance.dims if name != hidden]
    gap = _clearance(atlas, np.fmin, names)
    if names != [second, first]:
        gap = gap.T
    # The colours are those of what is not hatched.
    shown = np.where(gap > _least_clearance(atlas), 1e3 * gap, np.nan)
    mesh = _mesh(atlas, ax, first, second, shown, cmap=OTHER_MAP)
    ax.set_title(f"least over {hidden}")
    if not upright:
        ax.set_aspect("equal")
    _legend_above(ax, _hatch(atlas, ax, first, second, gap, f"for some {hidden} limbs"))
    _bar(ax, mesh, "least clearance of the limbs (mm)")
    return ax


def clearance_over_height(atlas: Any, ax: Any = None) -> Any:
    """Least and greatest clearance of the limbs at each height, also of poses where they meet."""
    ax = _axes(ax)
    low, high = (1e3 * _clearance(atlas, ufunc, ["z"]) for ufunc in (np.fmin, np.fmax))
    height = atlas.z.values
    ax.fill_betweenx(height, low, high, color=plots.COLOURS[0], alpha=0.35)
    ax.plot(low, height, color=plots.COLOURS[0], lw=1.2, label="least")
    ax.plot(high, height, color=plots.COLOURS[0], lw=1.2, ls="--", label="greatest")
    bound = 1e3 * _least_clearance(atlas)
    ax.axvline(bound, color="black", ls=":", lw=1.2, label=f"left of it limbs {_near(atlas)}")
    ax.set_xlabel("clearance of the limbs (mm)")
    ax.set_ylabel("z (m)")
    ax.grid(alpha=0.3)
    _legend_above(ax, ax.get_legend_handles_labels()[0])
    return ax


def _plane_of(atlas: Any, upright: bool) -> tuple[str, str, str]:
    """Pose parameters to the right and up in a section, and the one that it cuts."""
    one, other = (name for name in atlas.singularity.dims if name != "z")
    if upright:
        return one, "z", other
    tilting = atlas[one].attrs["units"] == "rad"
    return (other, one, "z") if tilting else (one, other, "z")


def _mesh(atlas: Any, ax: Any, first: str, second: str, values: Array, **options: Any) -> Any:
    """A field over two pose parameters, with their names at the axes; NaN is left out."""
    x, y = (_shown(atlas[name])[0] for name in (first, second))
    for label, name in ((ax.set_xlabel, first), (ax.set_ylabel, second)):
        label(f"{name} ({_shown(atlas[name])[1]})")
    return ax.pcolormesh(x, y, np.ma.masked_invalid(values), shading="nearest", **options)


def _hatch(atlas: Any, ax: Any, first: str, second: str, gap: Array, what: str) -> list[Any]:
    """Hatch where limbs are too near, and what to put into the legend for it."""
    near = np.nan_to_num(gap, nan=np.inf) <= _least_clearance(atlas)
    if not near.any():
        return []
    x, y = (_shown(atlas[name])[0] for name in (first, second))
    # Filled contours take hatches, a mesh of colours does not.
    ax.contourf(x, y, near, [0.5, 1.5], colors=["0.85"], hatches=["////"])
    ax.contour(x, y, near, [0.5], colors="0.2", linewidths=0.8)
    label = f"{what} {_near(atlas)}"
    return [_pyplot().Rectangle((0, 0), 1, 1, fc="0.85", ec="0.2", hatch="////", label=label)]


def _clearance(atlas: Any, ufunc: Any, kept: list[str]) -> Array:
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


def _least_clearance(atlas: Any) -> float:
    """What a reachable pose's clearance is above, m."""
    return float(json.loads(atlas.attrs["settings"])["least_clearance"])


def _near(atlas: Any) -> str:
    bound = _least_clearance(atlas)
    return f"are within {1e3 * bound:g} mm" if bound > 0.0 else "meet"


def _legend_above(ax: Any, handles: list[Any]) -> None:
    """A legend in room of its own above what is drawn."""
    if not handles:
        return
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + (0.05 + 0.06 * len(handles)) * (high - low))
    ax.legend(handles=handles, loc="upper right", fontsize=8)


def circles(atlas: Any, ax: Any = None) -> Any:
    """Radius of the largest circle about the axis over the height."""
    ax = _axes(ax)
    rad = atlas.circle.attrs["units"] == "rad"
    scale = 180 / math.pi if rad else 1.0
    ax.plot(scale * atlas.circle.values, atlas.height.values, color=plots.COLOURS[0])
    low, high = float(atlas.cylinder_low), float(atlas.cylinder_high)
    radius = scale * float(atlas.cylinder_radius)
    ax.fill_between(
        [0.0, radius], low, high, color=plots.COLOURS[4], alpha=0.5, label="largest cylinder"
    )
    ax.set_xlabel(f"radius of the largest circle ({'deg of tilt' if rad else 'm'})")
    ax.set_ylabel("z (m)")
    ax.set_xlim(left=0.0)
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)
    return ax


def middle_height(atlas: Any) -> float:
    """Middle of the largest cylinder, m."""
    low, high = float(atlas.cylinder_low), float(atlas.cylinder_high)
    return (low + high) / 2 if math.isfinite(low) else float(atlas.z.mean())


def _workspace(atlas: Any) -> Any:
    known = "clearance" in atlas
    figure, axes = _pyplot().subplots(
        1 + known,
        3,
        figsize=(16, 9.5 if known else 5),
        layout="constrained",
        width_ratios=(1, 1, 0.75),
        squeeze=False,
    )
    section(atlas, axes[0, 0])
    section(atlas, axes[0, 1], upright=False)
    circles(atlas, axes[0, 2])
    share = ""
    if known:
        closest(atlas, axes[1, 0])
        closest(atlas, axes[1, 1], upright=False)
        clearance_over_height(atlas, axes[1, 2])
        lost = 100 * float(atlas.interference)
        where = "nowhere" if lost == 0.0 else f"in {lost:.3g} % of otherwise reachable poses"
        share = f"; limbs {_near(atlas)} {where}"
    unit = atlas.circle.attrs["units"]
    radius = float(atlas.cylinder_radius)
    shown = f"{math.degrees(radius):.1f} deg" if unit == "rad" else f"{radius:.3f} m"
    figure.suptitle(
        f"{atlas.attrs['robot']}: reachable {float(atlas.volume):.4g} "
        f"{atlas.volume.attrs['units']}; largest cylinder z = {float(atlas.cylinder_low):.3f} to "
        f"{float(atlas.cylinder_high):.3f} m, radius {shown}{share}"
    )
    return figure


def _shown(coordinate: Any) -> tuple[Array, str]:
    """Ticks in degrees where they are angles, and the unit."""
    unit = coordinate.attrs["units"]
    if unit == "rad":
        return np.degrees(coordinate.values), "deg"
    return np.asarray(coordinate.values, np.float64), unit


# Modes


def frequency(atlas: Any, mode: int = 1, z: float | None = None, ax: Any = None) -> Any:
    """One natural frequency across the axis at one height.

    :param mode: 1 is the lowest.
    :param z: m; the nearest height is drawn; default the middle one.
    """
    ax = _axes(ax)
    middle = float(atlas.z[atlas.sizes["z"] // 2])
    layer = atlas.frequency.sel(mode=mode).sel(z=middle if z is None else z, method="nearest")
    x, y, values, labels = across(atlas, layer.values)
    _contours(ax, x, y, values, "frequency (Hz)")
    ax.set_xlabel(labels[0])
    ax.set_ylabel(labels[1])
    ax.set_title(f"mode {mode}, z = {float(layer.z):.3f} m")
    return ax


def across(atlas: Any, values: Array) -> tuple[Array, Array, Array, tuple[str, str]]:
    """A field of a modes atlas in the plane across the axis: x, y, the field, and axes' labels.

    :param values: shape (distance, azimuth); of any unit.
    """
    distance, unit = _shown(atlas.distance)
    turn, closed = _around(atlas.azimuth.values, values, 96)
    x, y = (distance[:, None] * f(turn) for f in (np.cos, np.sin))
    mechanism = atlas.attrs["mechanism"]
    if mechanism == "upr_rpu":
        # As in the strain-energy pictures; azimuth 0 is towards beta.
        return y, x, closed, (f"gamma ({unit})", f"beta ({unit})")
    if unit == "deg":
        labels = f"tilt towards azimuth 0° ({unit})", f"tilt towards azimuth 90° ({unit})"
        return x, y, closed, labels
    return x, y, closed, (f"x ({unit})", f"y ({unit})")


def frequency_range(atlas: Any, ax: Any = None) -> Any:
    """Least and greatest frequency of every mode over the height."""
    ax = _axes(ax)
    for k, mode in enumerate(atlas.mode.values.tolist()):
        values = atlas.frequency.sel(mode=mode)
        low, high = (values.reduce(f, ("distance", "azimuth")).values for f in (np.min, np.max))
        style = {"color": LINES[k % len(LINES)], "ls": ("-", "--")[k % 2], "lw": 1.5}
        ax.fill_between(atlas.z.values, low, high, color=style["color"], alpha=0.2, lw=0)
        ax.plot(atlas.z.values, low, **style, label=f"mode {mode}")
        ax.plot(atlas.z.values, high, **style)
    ax.set_xlabel("z (m)")
    ax.set_ylabel("frequency, least to greatest (Hz)")
    ax.set_ylim(bottom=0.0)
    ax.margins(x=0)
    ax.grid(alpha=0.3)
    # In the order of the lines: the highest mode on top.
    handles, labels = ax.get_legend_handles_labels()
    ax.legend(handles[::-1], labels[::-1], loc="center left", bbox_to_anchor=(1.0, 0.5))
    return ax


def deformed(atlas: Any, mode: int) -> tuple[Array, Array]:
    """Nodes of a mode shape, enlarged, and how far each moves; (nodes, 3), m, and (nodes,).

    The second is over the largest of all nodes.
    """
    rest = atlas.position.values
    moved = atlas.displacement.sel(mode=mode).values
    far = np.linalg.norm(moved, axis=1)
    scale = ENLARGED * float(np.linalg.norm(np.ptp(rest, axis=0))) / far.max()
    return rest + scale * moved, far / far.max()


def grounded(atlas: Any) -> NDArray[np.int64]:
    """Nodes on the ground, by index: the ends that one line alone meets."""
    nodes, lines = np.unique(atlas.line.values, return_counts=True)
    return np.asarray(nodes[lines == 1], np.int64)


def largest_shares(atlas: Any, mode: int, kind: str = "strain", most: int = 3) -> str:
    """Which parts hold most of a mode's energy, as text.

    :param kind: ``strain`` or ``kinetic``.
    """
    shares = atlas[f"{kind}_share"].sel(mode=mode).values
    order = np.argsort(-shares, kind="stable")[:most]
    names = atlas.element.values
    return ", ".join(f"{names[k]} {100 * shares[k]:.0f} %" for k in order if shares[k] >= 0.005)


def shape_pose(atlas: Any) -> str:
    """The pose of the stored shapes, as text."""
    units = atlas.shape_pose.attrs["units"].split(", ")
    parts = []
    for name, value, unit in zip(
        atlas.parameter.values, atlas.shape_pose.values.tolist(), units, strict=True
    ):
        # Adding zero takes the sign off a zero.
        number = round(math.degrees(value), 1) if unit == "rad" else round(value, 3)
        parts.append(f"{name} = {number + 0.0:g} {'deg' if unit == 'rad' else unit}")
    return ", ".join(parts)


def mode_shape(atlas: Any, mode: int = 1, ax: Any = None) -> Any:
    """The frame at rest in grey and in a mode, enlarged, on 3-D axes; colour: how far it moves."""
    if ax is None:
        figure = _pyplot().figure(figsize=(6, 6), layout="constrained")
        ax = figure.add_subplot(projection="3d")
    from matplotlib import ticker
    from mpl_toolkits.mplot3d.art3d import Line3DCollection  # type: ignore[import-untyped]

    rest, lines = atlas.position.values, atlas.line.values
    moved, far = deformed(atlas, mode)
    ax.add_collection3d(Line3DCollection(rest[lines], colors="0.7", linewidths=1.0))
    drawn = Line3DCollection(moved[lines], cmap=MAP, linewidths=2.2)
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


def _frequency_plane(atlas: Any) -> Any:
    figure, axes = _pyplot().subplots(2, 3, figsize=(14.5, 8.2), layout="constrained")
    for mode, ax in zip(atlas.mode.values.tolist(), axes.ravel(), strict=False):
        frequency(atlas, mode, ax=ax)
    figure.suptitle(f"{atlas.attrs['robot']}: natural frequencies, actuators locked")
    return figure


def _frequency_range(atlas: Any) -> Any:
    figure, ax = _pyplot().subplots(figsize=(8, 5), layout="constrained")
    frequency_range(atlas, ax)
    figure.suptitle(
        f"{atlas.attrs['robot']}: natural frequencies over the largest cylinder, actuators locked"
    )
    return figure


def _mode_shapes(atlas: Any) -> Any:
    from matplotlib import cm, colors

    figure, axes = _pyplot().subplots(
        2, 3, figsize=(12.5, 8), layout="constrained", subplot_kw={"projection": "3d"}
    )
    for mode, ax in zip(atlas.mode.values.tolist(), axes.ravel(), strict=False):
        mode_shape(atlas, mode, ax)
    colour = cm.ScalarMappable(colors.Normalize(0.0, 1.0), MAP)
    bar = figure.colorbar(colour, ax=axes, shrink=0.6, aspect=30, pad=0.05)
    bar.set_label("displacement over the mode's largest (1)")
    figure.suptitle(
        f"{atlas.attrs['robot']} at {shape_pose(atlas)}: lowest modes, actuators locked\n"
        "grey: at rest; coloured: deformed, enlarged; below: the parts that hold most energy"
    )
    return figure


# All


FIGURES: Final[Mapping[str, Mapping[str, Callable[[Any], Any]]]] = {
    "strain-energy": {
        "plane": _energy_plane,
        "factors": _factor_plane,
        "slices": _energy_slices,
        "global": _global,
    },
    "isotropy": {"eta": _spheres_eta, "force": _spheres_force, "spread": _spreads},
    "workspace": {"sections": _workspace},
    "modes": {"plane": _frequency_plane, "range": _frequency_range, "shapes": _mode_shapes},
}


def _pyplot() -> Any:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def _axes(ax: Any, size: tuple[float, float] = (7, 5.5)) -> Any:
    if ax is not None:
        return ax
    return _pyplot().subplots(figsize=size, layout="constrained")[1]


def _contours(ax: Any, x: Array, y: Array, values: Array, label: str, **options: Any) -> None:
    """A field as steps of colour on axes of equal scale, with its colour bar."""
    from matplotlib import ticker

    least = float(np.nanmin(values)) if "least" not in options else options.pop("least")
    greatest = float(np.nanmax(values))
    if "levels" not in options:
        if not greatest > least:
            least, greatest = least - 0.5, least + 0.5
        ticks = ticker.MaxNLocator(LEVELS, steps=[1, 2, 2.5, 5, 10])
        options["levels"] = ticks.tick_values(least, greatest)
    drawn = ax.contourf(x, y, np.ma.masked_invalid(values), **{"cmap": MAP, **options})
    ax.set_aspect("equal")
    _bar(ax, drawn, label, ticks=ticker.MaxNLocator(8, steps=[1, 2, 5, 10]))


def _bar(ax: Any, drawn: Any, label: str, **options: Any) -> Any:
    """A colour bar as high as its axes, which the figure's own would not be at equal scale."""
    bar = ax.figure.colorbar(drawn, cax=ax.inset_axes((1.04, 0.0, 0.045, 1.0)), **options)
    bar.set_label(label)
    return bar


def _plain_ticks(bar: Any) -> None:
    """Numbers without powers of ten on a logarithmic colour bar."""
    from matplotlib import ticker

    axis = bar.ax.yaxis
    axis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 3.0, 5.0, 7.0)))
    axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(ticker.NullLocator())


def prefixed(values: Array, unit: str) -> tuple[Array, str]:
    """Values in a unit whose prefix leaves numbers between 1 and 1000, and that unit."""
    power = 3 * math.floor(math.log10(float(np.nanmax(np.abs(values)))) / 3)
    power = min(max(power, min(PREFIXES)), max(PREFIXES))
    return values / 10.0**power, PREFIXES[power] + unit


def _around(azimuth: Array, values: Array, least: int = 0) -> tuple[Array, Array]:
    """Azimuths and a field (n, azimuth) with the first again at the end: the circle is closed.

    :param least: azimuths wanted; between the field's own the values are on straight lines.
    """
    turn = np.append(azimuth, azimuth[0] + 2 * np.pi)
    closed = np.concatenate([values, values[:, :1]], 1)
    finer = math.ceil(least / len(azimuth))
    if finer <= 1:
        return turn, closed
    ticks = np.linspace(turn[0], turn[-1], finer * len(azimuth) + 1)
    return ticks, np.array([np.interp(ticks, turn, row) for row in closed])


def _colours(norm: Any, values: Array) -> Any:
    from matplotlib import cm

    return cm.ScalarMappable(norm, MAP).to_rgba(values)


def _every(count: int) -> int:
    return max(1, math.ceil(count / FINEST))


def _thin(ticks: Array) -> Array:
    return ticks[:: _every(len(ticks))]
