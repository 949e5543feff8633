# SPDX-License-Identifier: Apache-2.0
"""Strain-energy atlas: total energy and the elements' factors over the regular workspace.

The grid: heights, tilts and azimuths of the tilt, beta = tilt cos(azimuth), gamma = tilt
sin(azimuth). Tilts beyond a height's circle are left out (NaN, element -1).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.atlas import figures, pages, plots
from pkm_twin.atlas.grids import circles, cylinder, height_range, ladder, nice, turns
from pkm_twin.atlas.sweep import Chunk, Field, Kind, Sweep, Values, Variable
from pkm_twin.errors import ParameterError
from pkm_twin.machine.robot import Robot
from stiffness_monitor.compliance import strain_energy

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from xarray import Dataset

Array = NDArray[np.float64]

ELEMENTS: Final = ("1R", "1B", "1U", "2R", "2B", "2U", "3R", "3B", "3U")
WRENCHES: Final[Mapping[str, tuple[float, ...]]] = MappingProxyType(
    {
        "P1": (0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
        "P2": (0.8, 0.3, 0.52, 0.0, 0.0, 0.0),
        "P3": (0.52, 0.3, 0.8, 0.5, 0.7, 0.51),
    }
)
"""Loads of the 2UPR-RPU paper's section 4: force (N) and moment (N m) at o."""
TABLE_2: Final[Mapping[str, tuple[float, ...]]] = MappingProxyType(
    {
        "P1": (0.044, 0.254, 0.146, 0.044, 0.254, 0.146, 0.007, 0.083, 0.023),
        "P2": (1.39e-4, 0.036, 1.99e-4, 9.55e-4, 0.122, 6.06e-4, 0.007, 0.825, 0.008),
        "P3": (0.002, 0.216, 0.003, 0.004, 0.194, 0.011, 0.007, 0.550, 0.012),
    }
)
"""Global strain-energy factors of the paper's table 2, in the order of ``ELEMENTS``."""
PLANE: Final = -0.6
"""Height of the paper's figures, m."""

CHUNK: Final = 65536
LEAST_RADIUS: Final = math.radians(10.0)
"""Circles below this are no part of the regular workspace (2UPR-RPU paper, section 4)."""
TILT_STEP: Final = math.radians(1.0)
AZIMUTHS: Final = 72
FINEST: Final = 8
"""Most layers that one coarse step of height is divided into."""

_GRID: Final = ("z", "tilt", "azimuth")


@dataclass(frozen=True, eq=False)
class StrainEnergySweep(Sweep):
    """Strain energy of one wrench over the regular workspace.

    ``wrench``: six numbers, N and N m. ``heights`` (n,), m, with their ``radii`` (n,), rad;
    ``tilts`` (m,), rad, evenly spaced from 0; ``azimuths``: how many.
    """

    wrench: tuple[float, ...]
    heights: Array
    radii: Array
    tilts: Array
    azimuths: int
    rows: int

    kind: ClassVar[str] = "strain-energy"
    fields: ClassVar[Mapping[str, Field]] = {
        "energy": Field(_GRID, {"units": "J", "long_name": "total strain energy"}),
        "factor": Field(
            (*_GRID, "element"), {"units": "1", "long_name": "strain-energy factor, U_e / U"}
        ),
        "dominant": Field(
            _GRID, {"long_name": "index of the element with the largest factor, -1 outside"}, "i1"
        ),
    }

    @property
    def turn(self) -> Array:
        """Azimuths, shape (azimuths,), rad."""
        return turns(self.azimuths)

    @property
    def coordinates(self) -> dict[str, Variable]:
        """Height, tilt, azimuth, element, and each height's circle."""
        return {
            "z": Variable(("z",), self.heights, {"units": "m", "long_name": "height of o"}),
            "tilt": Variable(
                ("tilt",), self.tilts, {"units": "rad", "long_name": "root of beta^2 + gamma^2"}
            ),
            "azimuth": Variable(
                ("azimuth",), self.turn, {"units": "rad", "long_name": "from beta to gamma"}
            ),
            "element": Variable(("element",), np.array(self.robot.element_names, "U"), {}),
            "radius": Variable(
                ("z",), self.radii, {"units": "rad", "long_name": "largest circle of tilts"}
            ),
        }

    @property
    def settings(self) -> dict[str, Any]:
        """The wrench, N and N m."""
        return {"wrench": list(self.wrench), "points": self.points}

    @property
    def rows_a_chunk(self) -> int:
        """Tilts in one chunk."""
        return self.rows

    def count(self, chunk: Chunk) -> int:
        """Poses of one chunk inside the workspace."""
        return self._inside(chunk) * self.azimuths

    def _inside(self, chunk: Chunk) -> int:
        """How many of the chunk's tilts are in the height's circle; they come first."""
        step = float(self.tilts[1] - self.tilts[0])
        last = math.floor(float(self.radii[chunk.first]) / step * (1 + 1e-12))
        return min(max(last + 1 - chunk.start, 0), chunk.stop - chunk.start)

    def evaluate(self, chunk: Chunk) -> Values:
        """Energies of the chunk, and its part of the global factors."""
        rows, kept = chunk.stop - chunk.start, self._inside(chunk)
        names = self.robot.element_names
        energy = np.full((rows, self.azimuths), np.nan)
        factor = np.full((rows, self.azimuths, len(names)), np.nan)
        dominant = np.full((rows, self.azimuths), -1, np.int8)
        tilt = self.tilts[chunk.start : chunk.start + kept]
        if kept:
            height = self.heights[chunk.first]
            result = strain_energy(
                self.robot,
                self.robot.grid().polar_pose(height, tilt[:, None], self.turn),
                self.wrench,
            )
            energy[:kept], factor[:kept] = result.total, result.factors
            dominant[:kept] = result.factors.argmax(-1)
        ring = factor[:kept].sum(1)
        return {
            "energy": energy,
            "factor": factor,
            "dominant": dominant,
            "rays": ring.sum(0),
            "volume": tilt @ ring,
            "counts": np.array([kept * self.azimuths, tilt.sum() * self.azimuths]),
        }

    def summaries(self, partial: Iterable[Values]) -> dict[str, Variable]:
        """Global factors (equation 39), over points on rays and over the volume."""
        parts = [(p["rays"], p["volume"], p["counts"]) for p in partial]
        rays, volume, counts = (np.array(column).T for column in zip(*parts, strict=True))
        number, weight = (math.fsum(row) for row in counts)
        result = {}
        for name, sums, count, what in (
            ("global_factor", rays, number, "mean over the grid's points, dense near the axis"),
            ("volume_factor", volume, weight, "mean over the volume of z, beta and gamma"),
        ):
            values = np.array([math.fsum(row) for row in sums]) / count
            attrs = {"units": "1", "long_name": f"global strain-energy factor, {what}"}
            result[name] = Variable(("element",), values, attrs)
        return result


def strain_energy_sweep(
    robot: Robot, wrench: ArrayLike | str = "P1", points: int | None = None
) -> StrainEnergySweep:
    """The strain-energy atlas of a robot.

    Without ``points`` heights every 0.05 m (for a machine of the paper's size), tilts every
    degree, 72 azimuths: the points over which the paper's table 2 comes out. With it all steps
    are divided alike, so that about as many poses lie inside; -0.6 m stays a height.

    :param wrench: P1, P2 or P3 of the paper, or six numbers, N and N m.
    :raises ParameterError: a robot without elastic members, a wrench that is none, or a robot
        that has no regular workspace.
    """
    if not robot.element_names:
        raise ParameterError(
            "mechanism", robot.mechanism, "a mechanism with elastic members (upr_rpu)"
        )
    load = checked_wrench(wrench)
    cylinder(robot, "strain energy over tilts")
    step = nice(float(np.ptp(height_range(robot))) / 15)
    base = _layers(robot, step)
    if points is None:
        return _sweep(robot, load, base, TILT_STEP, AZIMUTHS)
    if points < 100:
        raise ParameterError("points", points, "100 or more")
    base_points = float(AZIMUTHS * (np.floor(base[1] / TILT_STEP) + 1).sum())
    scale = (points / base_points) ** (1 / 3)
    layers = min(FINEST, max(1, round(scale)))
    heights = base if layers == 1 else _layers(robot, step / layers)
    share = math.sqrt(points / base_points / (len(heights[0]) / len(base[0])))
    azimuths = 4 * max(2, round(AZIMUTHS * share / 4))
    rungs = points / azimuths
    # Each height has its axis, so the count is not quite linear in the step.
    tilt_step = float(heights[1].sum()) / max(rungs - len(heights[0]) / 2, 1.0)
    return _sweep(robot, load, heights, tilt_step, azimuths)


def checked_wrench(wrench: ArrayLike | str) -> tuple[float, ...]:
    """Six finite numbers from a name of the paper's or from numbers."""
    if isinstance(wrench, str):
        if wrench not in WRENCHES:
            raise ParameterError("wrench", wrench, f"{', '.join(WRENCHES)} or six numbers")
        return WRENCHES[wrench]
    values = np.asarray(wrench, np.float64)
    if values.shape != (6,) or not np.isfinite(values).all():
        raise ParameterError("wrench", values.tolist(), "six finite numbers, N and N m")
    if not values.any():
        raise ParameterError(
            "wrench", values.tolist(), "a wrench above zero: none stores no energy"
        )
    return tuple(values.tolist())


def table_2(wrench: tuple[float, ...]) -> tuple[float, ...] | None:
    """The paper's global factors for a wrench, None where it prints none."""
    for name, values in WRENCHES.items():
        if tuple(wrench) == values:
            return TABLE_2[name]
    return None


def _layers(robot: Robot, step: float) -> tuple[Array, Array]:
    """Heights that are multiples of a step, and the radii of their circles, rad."""
    low, high = height_range(robot)
    ticks = step * np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    reach = circles(robot, ticks)
    kept = reach.radius >= LEAST_RADIUS
    if not kept.any():
        raise ParameterError("limits", robot.name, "limits that leave a regular workspace")
    return reach.z[kept], reach.radius[kept]


def _sweep(
    robot: Robot,
    wrench: tuple[float, ...],
    layers: tuple[Array, Array],
    tilt_step: float,
    azimuths: int,
) -> StrainEnergySweep:
    heights, radii = layers
    rungs = math.floor(float(radii.max()) / tilt_step * (1 + 1e-12)) + 1
    tilts = ladder(tilt_step, max(rungs, 2))
    rows = max(1, CHUNK // azimuths)
    return StrainEnergySweep(robot, wrench, heights, radii, tilts, azimuths, rows)


# Figures


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
    :param options: for ``contourf``; ``least``: the value of the first colour.
    """
    ax = figures.axes_or_new(ax)
    layer = atlas.isel(z=nearest_height(atlas, z))
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
        values, label = layer.factor.sel(element=variable).values, f"factor of {variable} (1)"
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
    """Global strain-energy factors, beside the paper's where it prints them."""
    ax = figures.axes_or_new(ax)
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


def stack(atlas: Dataset, ax: Any = None, layers: int = 6) -> Any:
    """Total energy on slices of the regular workspace, stacked by height, on 3-D axes."""
    if ax is None:
        ax = (
            figures.pyplot()
            .figure(figsize=(8, 7), layout="constrained")
            .add_subplot(projection="3d")
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
    figure.suptitle(f"{load_case(atlas)}: total strain energy over the regular workspace")
    return figure


def _factor_plane(atlas: Dataset) -> Figure:
    figure, axes = figures.subplots(3, 3, figsize=(13.5, 10), layout="constrained")
    height = float(atlas.z[nearest_height(atlas, None)])
    for name, ax in zip(atlas.element.values, axes.T.ravel(), strict=True):
        plane(atlas, str(name), ax=ax, least=0.0)
        ax.set_title(f"element {name}")
    figure.suptitle(f"{load_case(atlas)}: strain-energy factors at z = {height:.3f} m")
    return figure


def _global(atlas: Dataset) -> Figure:
    figure, ax = figures.subplots(figsize=(9, 4.5), layout="constrained")
    global_factors(atlas, ax)
    figure.suptitle(f"{load_case(atlas)}: global strain-energy factors")
    return figure


def nearest_height(atlas: Dataset, z: float | None) -> int:
    """Index of the height nearest to z; default -0.6 m, or the middle where that is outside."""
    heights = atlas.z.values
    if z is None:
        z = PLANE if heights.min() <= PLANE <= heights.max() else float(heights.mean())
    return int(np.abs(heights - z).argmin())


def wrench_of(atlas: Dataset) -> tuple[float, ...]:
    """The wrench that made a strain-energy atlas, N and N m."""
    return tuple(json.loads(atlas.attrs["settings"])["wrench"])


def load_case(atlas: Dataset) -> str:
    """Robot and wrench of a strain-energy atlas, as text."""
    wrench = wrench_of(atlas)
    name = "".join(f"{name} = " for name, value in WRENCHES.items() if tuple(value) == wrench)
    numbers = ", ".join(f"{value:g}" for value in wrench)
    return f"{atlas.attrs['robot']} under {name}({numbers}) N, N m"


def lateral_of(atlas: Dataset) -> tuple[str, str]:
    """Names of the two tilts, at azimuth 0 and a quarter turn."""
    first, second = atlas.attrs["lateral"].split()
    return first, second


# Page


def title(atlas: Dataset) -> str:
    """What the page shows, in a line."""
    return f"Strain energy of {load_case(atlas)}"


def page(atlas: Dataset) -> Any:
    """Slices of a strain-energy atlas.

    A menu chooses total energy or an element's factor, a slider one height or all.
    """
    part = pages.thinned(atlas, {"z": 12, "tilt": pages.MOST, "azimuth": 2 * pages.MOST})
    turn = np.append(part.azimuth.values, part.azimuth.values[0] + 2 * np.pi)
    tilt = np.degrees(part.tilt.values)[:, None]
    energy, unit = figures.prefixed(part.energy.values, "J")

    def closed(values: Array) -> Array:
        return np.stack([pages.closed(layer) for layer in values])

    # Over two decades: in steps of equal ratio, or all but the edge is one colour. Nothing has a
    # logarithm where nothing bears the wrench.
    ratio = bool(np.nanmin(energy) > 0.0)
    label = f"total strain energy ({unit})"
    fields = [pages.Shown(label, "energy", unit, closed(energy), logarithmic=ratio)]
    for k, name in enumerate(part.element.values):
        values = closed(part.factor.values[..., k])
        fields.append(pages.Shown(f"factor of {name} (1)", f"factor of {name}", "", values))
    first, second = lateral_of(atlas)
    return pages.layers(
        title(atlas),
        tilt * np.sin(turn),
        tilt * np.cos(turn),
        part.z.values,
        (second, first, "z"),
        ("deg", "deg", "m"),
        fields,
    )


KIND: Final = Kind(
    "strain-energy",
    figures={
        "plane": _energy_plane,
        "factors": _factor_plane,
        "slices": _energy_slices,
        "global": _global,
    },
    page=page,
    title=title,
    help="Each slice is one height; the slider shows one alone. The menu chooses the total "
    "energy or one element's part of it.",
)
