# SPDX-License-Identifier: Apache-2.0
"""Pictures of stored atlases. Functions that draw one thing take ``ax=None`` and return the axes.

Each reads from the file only what it draws, so atlases larger than memory can be drawn.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin import plots
from pkm_twin.atlas.strain_energy import PLANE, table_2
from pkm_twin.errors import ParameterError

Array = NDArray[np.float64]

MAP: Final = "viridis"
OTHER_MAP: Final = "cividis"
VIEW: Final = np.array([0.36, 0.8, 0.48])
"""Where spheres are looked at from, in pose rates."""
PIXELS: Final = 61
FINEST: Final = 200
"""Most samples along one axis of a picture; denser atlases are thinned."""


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
    :param options: for ``pcolormesh``, such as ``vmin`` and ``vmax``.
    """
    ax = _axes(ax)
    layer = atlas.isel(z=nearest_height(atlas, z))
    tilt = _thin(atlas.tilt.values)
    azimuth = _thin(atlas.azimuth.values)
    steps = {"tilt": _every(atlas.sizes["tilt"]), "azimuth": _every(atlas.sizes["azimuth"])}
    layer = layer.isel({dim: slice(None, None, step) for dim, step in steps.items()})
    if variable == "energy":
        values, label = layer.energy.values, "total strain energy (J)"
    else:
        values, label = layer.factor.sel(element=variable).values, f"factor of {variable}"
    shown = np.isfinite(values).any(1)
    # The circle is closed: the first azimuth stands again at the end.
    turn = np.append(azimuth, azimuth[0] + 2 * np.pi)
    values = np.concatenate([values, values[:, :1]], 1)[shown]
    beta, gamma = (np.degrees(tilt[shown])[:, None] * f(turn) for f in (np.cos, np.sin))
    mesh = ax.pcolormesh(
        gamma, beta, values, shading="gouraud", cmap=options.pop("cmap", MAP), **options
    )
    ax.set_aspect("equal")
    ax.set_xlabel("gamma (deg)")
    ax.set_ylabel("beta (deg)")
    ax.set_title(f"z = {float(layer.z):.3f} m")
    bar = ax.figure.colorbar(mesh, ax=ax)
    bar.set_label(label)
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
    energy = part.energy.isel(z=picked).values
    norm = colors.LogNorm(np.nanmin(energy), np.nanmax(energy))
    turn = np.append(part.azimuth.values, part.azimuth.values[0] + 2 * np.pi)
    for k, layer in zip(picked, energy, strict=True):
        shown = np.isfinite(layer).any(1)
        values = np.concatenate([layer, layer[:, :1]], 1)[shown]
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
    ax.set_xlabel("gamma (deg)")
    ax.set_ylabel("beta (deg)")
    ax.set_zlabel("z (m)")
    bar = ax.figure.colorbar(cm.ScalarMappable(norm, MAP), ax=ax, shrink=0.7, pad=0.1)
    bar.set_label("total strain energy (J)")
    return ax


def _energy_plane(atlas: Any) -> Any:
    figure, ax = _pyplot().subplots(figsize=(7, 5.5), layout="constrained")
    plane(atlas, ax=ax)
    figure.suptitle(f"{_load(atlas)}: total strain energy")
    return figure


def _energy_slices(atlas: Any) -> Any:
    figure = _pyplot().figure(figsize=(8, 7), layout="constrained")
    stack(atlas, figure.add_subplot(projection="3d"))
    figure.suptitle(f"{_load(atlas)}: total strain energy over the regular workspace")
    return figure


def _factor_plane(atlas: Any) -> Any:
    figure, axes = _pyplot().subplots(3, 3, figsize=(12, 10), layout="constrained")
    height = float(atlas.z[nearest_height(atlas, None)])
    for name, ax in zip(atlas.element.values, axes.T.ravel(), strict=True):
        plane(atlas, str(name), ax=ax, vmin=0.0)
        ax.set_title(f"element {name}")
    figure.suptitle(f"{_load(atlas)}: strain-energy factors at z = {height:.3f} m")
    return figure


def _global(atlas: Any) -> Any:
    figure, ax = _pyplot().subplots(figsize=(9, 4.5), layout="constrained")
    global_factors(atlas, ax)
    figure.suptitle(f"{_load(atlas)}: global strain-energy factors")
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


def _load(atlas: Any) -> str:
    numbers = ", ".join(f"{value:g}" for value in wrench_of(atlas))
    return f"{atlas.attrs['robot']} under ({numbers}) N, N m"


# Isotropy


def sphere_image(values: Array, polar: Array, turn: Array) -> Array:
    """A sphere of values as it is seen from ``VIEW``, shape (61, 61); NaN around it.

    :param values: on the directions, shape (polar, turn).
    """
    right, up = _view()
    ticks = np.linspace(-1.0, 1.0, PIXELS)
    u, v = np.meshgrid(ticks, ticks)
    square = u * u + v * v
    depth = np.sqrt(np.maximum(1.0 - square, 0.0))
    x = u[..., None] * right + v[..., None] * up + depth[..., None] * VIEW
    theta = np.arccos(np.clip(x[..., 2], -1.0, 1.0)) / (polar[1] - polar[0])
    phi = np.mod(np.arctan2(x[..., 1], x[..., 0]), 2 * np.pi) / (turn[1] - turn[0])
    i = np.minimum(theta.astype(int), len(polar) - 2)
    j = np.minimum(phi.astype(int), len(turn) - 1)
    s, t = theta - i, phi - j
    k = (j + 1) % len(turn)
    image = (1 - s) * ((1 - t) * values[i, j] + t * values[i, k])
    image += s * ((1 - t) * values[i + 1, j] + t * values[i + 1, k])
    return np.where(square <= 1.0, image, np.nan)


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
    low, high = np.nanmin(values), np.nanmax(values)
    norm = colors.LogNorm(low, high) if index == "force" else colors.Normalize(low, high)
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
            ax.imshow(
                np.ma.masked_invalid(sphere_image(values[a, b], polar, turn)),
                origin="lower",
                extent=(x - size, x + size, y - size, y + size),
                cmap=MAP if index == "eta" else OTHER_MAP,
                norm=norm,
                interpolation="bilinear",
                zorder=2,
            )
    if polar_grid:
        reach = _rings(ax, first[list(firsts)], second[list(seconds)], scale, ring)
        ax.set_xlabel("azimuth (deg) around, tilt (deg) outwards")
        ax.set_xticks([])
        ax.set_yticks([])
    else:
        reach = float(np.abs(first).max()) + 1.2 * radius
        ax.set_xlabel(f"{names[0]} (m)")
        ax.set_ylabel(f"{names[1]} (m)")
    ax.set_xlim(-reach, reach)
    ax.set_ylim(-reach, reach)
    ax.set_aspect("equal")
    colour = cm.ScalarMappable(norm, MAP if index == "eta" else OTHER_MAP)
    bar = ax.figure.colorbar(colour, ax=ax, shrink=0.8)
    unit = atlas[index].attrs["units"]
    bar.set_label(f"eta_KE = E_M / E_all ({unit})" if index == "eta" else f"F_max ({unit})")
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
        out = outermost + 0.75 * ring
        place = (out * math.cos(azimuth), out * math.sin(azimuth))
        ax.text(*place, f"{math.degrees(azimuth):.0f}°", ha="center", va="center", fontsize=9)
    between = math.pi / len(azimuths)
    for tilt in tilts[1:]:
        out = scale * float(tilt) + ring
        ax.text(
            out * math.cos(between),
            out * math.sin(between),
            f"{scale * float(tilt):.3g}°",
            ha="center",
            va="center",
            fontsize=7,
            color="0.3",
            zorder=3,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.8},
        )
    return outermost + 1.15 * ring


def _triad(atlas: Any, ax: Any) -> None:
    """Where the spheres' axes point, in the lower left corner."""
    right, up = _view()
    inset = ax.inset_axes((0.02, 0.01, 0.17, 0.17))
    names = _rates(atlas)
    for k, name in enumerate(names):
        tip = np.array([right[k], up[k]])
        inset.annotate(
            "", tip, (0.0, 0.0), arrowprops={"arrowstyle": "->", "color": "black", "lw": 1.0}
        )
        inset.text(*(1.3 * tip), name, ha="center", va="center", fontsize=8)
    inset.set_xlim(-1.6, 1.6)
    inset.set_ylim(-1.6, 1.6)
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
                style = ("-", "--", ":", "-.")[k % 4]
                colour = plots.COLOURS[k % len(plots.COLOURS)]
                ax.plot(
                    tilt, values[k], style, color=colour, marker="o", ms=3, label=f"{azimuth:.0f}°"
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
    ax.figure.colorbar(mesh, ax=ax).set_label(f"{what} ({unit})")
    return ax


def _spheres_eta(atlas: Any) -> Any:
    return _spheres(atlas, "eta")


def _spheres_force(atlas: Any) -> Any:
    return _spheres(atlas, "force")


def _spheres(atlas: Any, index: str) -> Any:
    figure, ax = _pyplot().subplots(figsize=(9.5, 8.5), layout="constrained")
    spheres(atlas, index, ax)
    settings = json.loads(atlas.attrs["settings"])
    name = atlas.attrs["robot"]
    if index == "eta":
        what = "energy transfer over directions of the pose rates"
    else:
        what = f"largest driving force at a platform energy of {settings['energy']:g} J"
    figure.suptitle(f"{name}, z = {settings['height']:.3f} m: {what}")
    return figure


def _spreads(atlas: Any) -> Any:
    figure, axes = _pyplot().subplots(1, 2, figsize=(12, 4.8), layout="constrained")
    for index, ax in zip(("eta", "force"), axes, strict=True):
        spread_over_poses(atlas, index, ax)
    figure.suptitle(f"{atlas.attrs['robot']}: how far the indices differ over directions")
    return figure


# Workspace


def section(atlas: Any, ax: Any = None, upright: bool = True, z: float | None = None) -> Any:
    """A section through the workspace, coloured by the distance to a singularity.

    :param upright: through the axis, else across it at height z.
    :param z: m; default the middle of the largest cylinder.
    """
    ax = _axes(ax)
    names = atlas.singularity.dims
    across = [name for name in names if name != "z"]
    field = atlas.singularity
    if upright:
        values = field.isel({across[1]: atlas.sizes[across[1]] // 2})
        first, second = across[0], "z"
        ax.set_title(f"{across[1]} = 0")
    else:
        height = middle_height(atlas) if z is None else z
        values = field.sel(z=height, method="nearest")
        tilting = atlas[across[0]].attrs["units"] == "rad"
        first, second = (across[1], across[0]) if tilting else (across[0], across[1])
        ax.set_title(f"z = {float(values.z):.3f} m")
    grid = values.transpose(second, first).values
    ticks = {n: _shown(atlas[n])[0] for n in (first, second)}
    mesh = ax.pcolormesh(
        ticks[first],
        ticks[second],
        np.ma.masked_invalid(grid),
        cmap=MAP,
        shading="nearest",
        vmin=0.0,
        vmax=float(field.max()),
    )
    for axis, name in ((ax.set_xlabel, first), (ax.set_ylabel, second)):
        axis(f"{name} ({_shown(atlas[name])[1]})")
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
        ax.legend(loc="upper right", fontsize=8)
    else:
        ax.add_patch(_pyplot().Circle((0, 0), radius, fill=False, ls="--", lw=1.2, ec="black"))
        ax.set_aspect("equal")
    ax.figure.colorbar(mesh, ax=ax).set_label("distance to a singularity (1)")
    return ax


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
    figure, axes = _pyplot().subplots(
        1, 3, figsize=(16, 5), layout="constrained", width_ratios=(1, 1, 0.75)
    )
    section(atlas, axes[0])
    section(atlas, axes[1], upright=False)
    circles(atlas, axes[2])
    unit = atlas.circle.attrs["units"]
    radius = float(atlas.cylinder_radius)
    shown = f"{math.degrees(radius):.1f} deg" if unit == "rad" else f"{radius:.3f} m"
    figure.suptitle(
        f"{atlas.attrs['robot']}: reachable {float(atlas.volume):.4g} "
        f"{atlas.volume.attrs['units']}; largest cylinder z = {float(atlas.cylinder_low):.3f} to "
        f"{float(atlas.cylinder_high):.3f} m, radius {shown}"
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
    distance, unit = _shown(atlas.distance)
    turn = np.append(atlas.azimuth.values, atlas.azimuth.values[0] + 2 * np.pi)
    values = np.concatenate([layer.values, layer.values[:, :1]], 1)
    x, y = (distance[:, None] * f(turn) for f in (np.cos, np.sin))
    mesh = ax.pcolormesh(x, y, values, shading="gouraud", cmap=MAP)
    ax.set_aspect("equal")
    what = "tilt" if unit == "deg" else "distance"
    ax.set_xlabel(f"{what} ({unit}) towards azimuth 0")
    ax.set_ylabel(f"{what} ({unit}) towards 90 deg")
    ax.set_title(f"mode {mode}, z = {float(layer.z):.3f} m")
    ax.figure.colorbar(mesh, ax=ax).set_label("frequency (Hz)")
    return ax


def frequency_range(atlas: Any, ax: Any = None) -> Any:
    """Least and greatest frequency of every mode over the height."""
    ax = _axes(ax)
    for k, mode in enumerate(atlas.mode.values.tolist()):
        values = atlas.frequency.sel(mode=mode)
        low, high = (values.reduce(f, ("distance", "azimuth")).values for f in (np.min, np.max))
        colour = plots.COLOURS[k % len(plots.COLOURS)]
        ax.fill_between(atlas.z.values, low, high, color=colour, alpha=0.45, label=f"mode {mode}")
        ax.plot(atlas.z.values, low, color=colour, lw=1)
    ax.set_xlabel("z (m)")
    ax.set_ylabel("frequency, least to greatest (Hz)")
    ax.set_ylim(bottom=0.0)
    ax.grid(alpha=0.3)
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    return ax


def _frequency_plane(atlas: Any) -> Any:
    figure, axes = _pyplot().subplots(2, 3, figsize=(14, 8.5), layout="constrained")
    for mode, ax in zip(atlas.mode.values.tolist(), axes.ravel(), strict=False):
        frequency(atlas, mode, ax=ax)
    figure.suptitle(f"{atlas.attrs['robot']}: natural frequencies, actuators locked")
    return figure


def _frequency_range(atlas: Any) -> Any:
    figure, ax = _pyplot().subplots(figsize=(8, 5), layout="constrained")
    frequency_range(atlas, ax)
    figure.suptitle(f"{atlas.attrs['robot']}: natural frequencies over the largest cylinder")
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
    "modes": {"plane": _frequency_plane, "range": _frequency_range},
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


def _colours(norm: Any, values: Array) -> Any:
    from matplotlib import cm

    return cm.ScalarMappable(norm, MAP).to_rgba(values)


def _every(count: int) -> int:
    return max(1, math.ceil(count / FINEST))


def _thin(ticks: Array) -> Array:
    return ticks[:: _every(len(ticks))]
