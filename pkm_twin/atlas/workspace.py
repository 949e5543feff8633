# SPDX-License-Identifier: Apache-2.0
"""Workspace atlas: what a machine reaches, how far from a singularity, and the regular part.

The grid is the pose's own: all coordinates of two or three, of more every pair of them with the
others at home. Reachable: the limits of actuators and of passive joints, limbs apart from each
other where the file tells their diameters, on the branch of the home pose. Regular, of poses that
lie about an axis: the largest circle about it at each height, and the largest upright cylinder
that fits into them.

May import: numpy, pkm_twin's core and the two packages above it; never rclpy.
"""

from __future__ import annotations

import functools
import itertools
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas import figures, pages, plots
from pkm_twin.atlas.extras import require
from pkm_twin.atlas.grids import FULL, circles, largest_cylinder, workspace_box
from pkm_twin.atlas.sweep import Chunk, Field, Kind, Sweep, Values, Variable
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.clearance import clearance, has_clearance
from pkm_twin.kinematics.workspace import (
    distance_unit,
    has_joint_angles,
    joint_angle_at,
    reachable,
    singularity_at,
)
from pkm_twin.machine.robot import Robot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from xarray import Dataset

Array = NDArray[np.float64]

POINTS: Final = 200_000
CHUNK: Final = 32768
LONGEST: Final = 2001
"""Most poses along one coordinate."""
LAYERS: Final = 101
"""Heights of the regular workspace."""

_SLICED: Final = ("slice", "row", "column")


@dataclass(frozen=True, eq=False)
class WorkspaceSweep(Sweep):
    """Reach over a grid of poses; ``axes``: ticks of the m pose coordinates, m and rad.

    ``home``: the pose (m,) whose coordinates stand for those that a slice does not show.
    ``least``: singularity measure below which a pose counts as out of reach. ``least_clearance``:
    distance of members of different limbs, m, that is too little; where it is not known, nothing.
    """

    axes: tuple[Array, ...]
    home: Array
    least: float
    least_clearance: float = 0.0

    kind: ClassVar[str] = "workspace"

    @property
    def slices(self) -> list[tuple[int, ...]]:
        """Coordinates that each slice goes over, by index; empty where the grid is whole."""
        count = len(self.axes)
        if 1 < count <= FULL:
            return []
        return list(itertools.combinations(range(count), 2)) or [(0,)]

    @property
    def upright(self) -> bool:
        """Whether the poses lie about an axis, with circles and a cylinder about it."""
        return not self.slices and self.robot.grid().kind == "cylinder"

    @property
    def dims(self) -> tuple[str, ...]:
        """Dimensions of the fields."""
        return _SLICED if self.slices else self.robot.pose_names

    @property
    def fields(self) -> Mapping[str, Field]:  # type: ignore[override]
        """Reach, singularity measure, passive angle and clearance where the machine tells them."""
        fields = {
            "reachable": Field(self.dims, {"long_name": "1 where all limits are kept"}, "i1"),
            "singularity": Field(
                self.dims,
                {
                    "units": "1",
                    "long_name": "distance to a singularity: 0 in one, 1 at best; reachable poses",
                },
            ),
        }
        if has_joint_angles(self.robot):
            fields["joint_angle"] = Field(
                self.dims,
                {"units": "rad", "long_name": "largest passive joint angle; reachable poses"},
            )
        if has_clearance(self.robot):
            # Also where limbs meet, so that the file shows what interference takes away.
            fields["clearance"] = Field(
                self.dims,
                {
                    "units": "m",
                    "long_name": "least distance of different limbs' members, negative where they "
                    "meet; poses that are reachable but for it",
                },
            )
        return fields

    @property
    def coordinates(self) -> dict[str, Variable]:
        """The pose coordinates, and of a cylinder the heights of the circles."""
        robot = self.robot
        if self.slices:
            return self._sliced_coordinates()
        result = {
            name: Variable((name,), ticks, {"units": unit, "long_name": f"pose coordinate {name}"})
            for name, unit, ticks in zip(robot.pose_names, robot.pose_units, self.axes, strict=True)
        }
        if not self.upright:
            result |= self._home()
        else:
            result["height"] = Variable(
                ("height",), self.heights, {"units": "m", "long_name": "height of the circles"}
            )
        return result

    def _sliced_coordinates(self) -> dict[str, Variable]:
        """What each slice's rows and columns are, and the pose of the others."""
        names, units = self.robot.pose_names, self.robot.pose_units
        rows = [s[0] for s in self.slices]
        # Of a single coordinate there is one column, at home, which is that coordinate's own.
        columns = [s[-1] for s in self.slices]
        result = {
            "slice": _texts("slice", [" by ".join(names[k] for k in s) for s in self.slices]),
            "unit": _texts("coordinate", units),
            **self._home(),
        }
        for dim, picked in (("row", rows), ("column", columns)):
            ticks = [self.axes[k] for k in picked]
            if dim == "column" and len(names) == 1:
                ticks = [self.home]
            result[f"{dim}_name"] = _texts("slice", [names[k] for k in picked])
            result[f"{dim}_unit"] = _texts("slice", [units[k] for k in picked])
            result[f"{dim}_value"] = Variable(
                ("slice", dim), np.array(ticks), {"long_name": f"coordinate along the {dim}s"}
            )
        return result

    def _home(self) -> dict[str, Variable]:
        return {
            "coordinate": _texts("coordinate", self.robot.pose_names),
            "home": Variable(
                ("coordinate",), self.home, {"long_name": "pose that sections go through"}
            ),
        }

    @property
    def heights(self) -> Array:
        """Heights of the circles, shape (n,), m."""
        ticks = self.axes[self.robot.pose_names.index(self.robot.grid().height)]
        return np.linspace(float(ticks[0]), float(ticks[-1]), LAYERS)

    @property
    def settings(self) -> dict[str, Any]:
        """Least singularity measure and clearance."""
        return {
            "least_singularity": self.least,
            "least_clearance": self.least_clearance,
            "points": self.points,
        }

    @property
    def _across(self) -> int:
        """Poses in one row of a chunk."""
        return math.prod(self.sizes[dim] for dim in self.dims[2:])

    @property
    def rows_a_chunk(self) -> int:
        """Ticks of the second dimension in one chunk."""
        return max(1, CHUNK // self._across)

    def count(self, chunk: Chunk) -> int:
        """Poses of one chunk."""
        return (chunk.stop - chunk.start) * self._across

    def poses(self, chunk: Chunk) -> Array:
        """Poses of a chunk, shape (rows, ..., m)."""
        rows = slice(chunk.start, chunk.stop)
        if not self.slices:
            first, second, *rest = self.axes
            ticks = np.meshgrid(first[chunk.first], second[rows], *rest, indexing="ij")
            return np.asarray(np.stack(ticks, -1)[0])
        shown = self.slices[chunk.first]
        columns = [self.axes[k] for k in shown[1:]]
        ticks = np.meshgrid(self.axes[shown[0]][rows], *columns, indexing="ij")
        poses = np.broadcast_to(self.home, (*ticks[0].shape, len(self.home))).copy()
        for k, values in zip(shown, ticks, strict=True):
            poses[..., k] = values
        return poses if columns else poses[:, None]

    def evaluate(self, chunk: Chunk) -> Values:
        """Reach of the chunk; how many poses are reachable, and how many but for interference."""
        robot = self.robot
        poses = self.poses(chunk)
        inside = reachable(robot, poses, -math.inf)
        measure = np.full(inside.shape, np.nan)
        measure[inside] = singularity_at(robot, poses[inside])
        if self.least > 0.0:
            inside &= np.nan_to_num(measure) >= self.least
        values: Values = {"singularity": measure}
        otherwise = inside.sum()
        if has_clearance(robot):
            gap = np.full(inside.shape, np.nan)
            gap[inside] = clearance(robot, poses[inside])
            # As in reachable; NaN is not above.
            inside &= gap > self.least_clearance
            values["clearance"] = gap
        measure[~inside] = np.nan
        values["reachable"] = inside.astype(np.int8)
        if has_joint_angles(robot):
            values["joint_angle"] = np.where(inside, joint_angle_at(robot, poses), np.nan)
        values["counts"] = np.array([inside.sum(), otherwise])
        return values

    def summaries(self, partial: Iterable[Values]) -> dict[str, Variable]:
        """Volume, circles and cylinder, and what interference takes away."""
        count, otherwise = np.sum([p["counts"] for p in partial], axis=0).tolist()
        result: dict[str, Variable] = {}
        if not self.slices:
            steps = [ticks[1] - ticks[0] for ticks in self.axes]
            units = _product(self.robot.pose_units)
            result["volume"] = Variable(
                (),
                np.array(count * math.prod(steps)),
                {"units": units, "long_name": "volume of the reachable poses"},
            )
        if has_clearance(self.robot):
            share = (otherwise - count) / otherwise if otherwise else math.nan
            result["interference"] = Variable(
                (),
                np.array(share),
                {"units": "1", "long_name": "share of otherwise reachable poses where limbs meet"},
            )
        if self.upright:
            result |= self._regular()
        return result

    def _regular(self) -> dict[str, Variable]:
        """The circles about the axis, and the cylinder."""
        reach = circles(
            self.robot, self.heights, least=self.least, least_clearance=self.least_clearance
        )
        best = largest_cylinder(reach)
        unit = distance_unit(self.robot)
        result = {
            "circle": Variable(
                ("height",), reach.radius, {"units": unit, "long_name": "largest circle, radius"}
            )
        }
        for name, value, u in (
            ("low", best.low, "m"),
            ("high", best.high, "m"),
            ("radius", best.radius, unit),
        ):
            about = {"units": u, "long_name": f"largest cylinder, {name}"}
            result[f"cylinder_{name}"] = Variable((), np.array(value), about)
        return result


def _texts(dim: str, texts: Iterable[str]) -> Variable:
    return Variable((dim,), np.array(list(texts), "U"), {})


def _product(units: Iterable[str]) -> str:
    """Unit of a volume: "m3", "m rad2"."""
    counts = {unit: list(units).count(unit) for unit in sorted(set(units))}
    return " ".join(f"{unit}{power if power > 1 else ''}" for unit, power in counts.items())


def workspace_sweep(
    robot: Robot,
    points: int | None = None,
    *,
    least_singularity: float = 0.0,
    least_clearance: float = 0.0,
) -> WorkspaceSweep:
    """The workspace atlas of a robot, on a box around all that it reaches.

    :param points: poses of the grid, about; default 200,000.
    :param least_singularity: singularity measure below which a pose counts as out of reach.
    :param least_clearance: distance of members of different limbs, m, that is too little; zero
        is no bound for a robot whose file does not tell their diameters.
    :raises ParameterError: no limits where the workspace has no end without, no reach at all, or a
        bound on a clearance that is not known.
    """
    total = POINTS if points is None else points
    if total < 1000:
        raise ParameterError("points", total, "1000 or more")
    if not 0.0 <= least_singularity < 1.0:
        raise ParameterError("least_singularity", least_singularity, "0 to below 1")
    if not 0.0 <= least_clearance < math.inf:
        raise ParameterError("least_clearance", least_clearance, "0 or more, m")
    if least_clearance > 0.0 and not has_clearance(robot):
        raise ParameterError(
            "least_clearance", least_clearance, "0: the file does not tell the members' diameters"
        )
    box = workspace_box(robot)
    count = len(box)
    if count <= FULL:
        side = max(5, min(round(total ** (1 / count)), LONGEST))
    else:
        side = max(5, round(math.sqrt(total / math.comb(count, 2))))
    # Odd across the axis, so that the axis is on the grid.
    odd = side + 1 - side % 2
    lateral = robot.grid().lateral
    axes = tuple(
        np.linspace(low, high, odd if name in lateral else side)
        for (low, high), name in zip(box, robot.pose_names, strict=True)
    )
    return WorkspaceSweep(robot, axes, robot.home(), least_singularity, least_clearance)


# Figures


def section(
    atlas: Dataset, ax: Axes | None = None, upright: bool = True, z: float | None = None
) -> Axes:
    """A section through the workspace, coloured by the distance to a singularity.

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
        ax.add_patch(
            figures.pyplot().Circle((0, 0), radius, fill=False, ls="--", lw=1.2, ec="black")
        )
        ax.set_aspect("equal")
    _legend_above(ax, marks)
    figures.bar(ax, mesh, "distance to a singularity (1)")
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
    mesh = _mesh(atlas, ax, first, second, shown, cmap=figures.OTHER_MAP)
    ax.set_title(f"least over {hidden}")
    if not upright:
        ax.set_aspect("equal")
    _legend_above(ax, _hatch(atlas, ax, first, second, gap, f"for some {hidden} limbs"))
    figures.bar(ax, mesh, "least clearance of the limbs (mm)")
    return ax


def clearance_over_height(atlas: Dataset, ax: Axes | None = None) -> Axes:
    """Least and greatest clearance of the limbs at each height, also of poses where they meet."""
    ax = figures.axes_or_new(ax)
    upwards = atlas.attrs["height"]
    low, high = (1e3 * _clearance(atlas, ufunc, [upwards]) for ufunc in (np.fmin, np.fmax))
    height = atlas[upwards].values
    ax.fill_betweenx(height, low, high, color=plots.COLOURS[0], alpha=0.35)
    ax.plot(low, height, color=plots.COLOURS[0], lw=1.2, label="least")
    ax.plot(high, height, color=plots.COLOURS[0], lw=1.2, ls="--", label="greatest")
    bound = 1e3 * _least_clearance(atlas)
    ax.axvline(bound, color="black", ls=":", lw=1.2, label=f"left of it limbs {_near(atlas)}")
    ax.set_xlabel("clearance of the limbs (mm)")
    ax.set_ylabel(f"{upwards} (m)")
    ax.grid(alpha=0.3)
    _legend_above(ax, ax.get_legend_handles_labels()[0])
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
    return [
        figures.pyplot().Rectangle((0, 0), 1, 1, fc="0.85", ec="0.2", hatch="////", label=label)
    ]


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


def circle_radii(atlas: Dataset, ax: Axes | None = None) -> Axes:
    """Radius of the largest circle about the axis over the height."""
    ax = figures.axes_or_new(ax)
    rad = atlas.circle.attrs["units"] == "rad"
    scale = 180 / math.pi if rad else 1.0
    ax.plot(scale * atlas.circle.values, atlas.height.values, color=plots.COLOURS[0])
    low, high = float(atlas.cylinder_low), float(atlas.cylinder_high)
    radius = scale * float(atlas.cylinder_radius)
    ax.fill_between(
        [0.0, radius], low, high, color=plots.COLOURS[4], alpha=0.5, label="largest cylinder"
    )
    ax.set_xlabel(f"radius of the largest circle ({'deg of tilt' if rad else 'm'})")
    ax.set_ylabel(f"{atlas.attrs['height']} (m)")
    ax.set_xlim(left=0.0)
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)
    return ax


def middle_height(atlas: Dataset) -> float:
    """Middle of the largest cylinder, m."""
    low, high = float(atlas.cylinder_low), float(atlas.cylinder_high)
    heights = atlas[atlas.attrs["height"]]
    return (low + high) / 2 if math.isfinite(low) else float(heights.mean())


def _workspace(atlas: Dataset) -> Figure:
    return _upright(atlas) if "circle" in atlas else _sections(atlas)


@dataclass(frozen=True, eq=False)
class Plane:
    """Two pose coordinates of an atlas without an axis, all others held.

    ``names``, ``units`` and ``ticks`` of both, angles in degrees; ``where`` says the others.
    ``fields``: by name, shape (first, second); of one coordinate the second is a single tick.
    """

    names: tuple[str, str]
    units: tuple[str, str]
    ticks: tuple[Array, Array]
    where: str
    fields: Mapping[str, Array]


def planes(atlas: Dataset) -> list[Plane]:
    """Every pair of coordinates of an atlas without an axis, through the home pose."""
    names = ("singularity", "clearance", "joint_angle")
    fields = [name for name in names if name in atlas]
    result = []
    home = dict(zip(atlas.coordinate.values, atlas.home.values.tolist(), strict=True))
    if atlas.singularity.dims == _SLICED:
        for k in range(atlas.sizes["slice"]):
            part = atlas.isel(slice=k)
            pair = str(part.row_name.values), str(part.column_name.values)
            shown = [
                _degrees(part[f"{dim}_value"].values, str(part[f"{dim}_unit"].values))
                for dim in ("row", "column")
            ]
            result.append(_plane(atlas, pair, shown, home, {f: part[f].values for f in fields}))
        return result
    dims = atlas.singularity.dims
    cut = {name: int(np.abs(atlas[name].values - home[name]).argmin()) for name in dims}
    held = {name: float(atlas[name][k]) for name, k in cut.items()}
    for pair in itertools.combinations(dims, 2):
        part = atlas.isel({name: k for name, k in cut.items() if name not in pair})
        shown = [_degrees(atlas[name].values, atlas[name].attrs["units"]) for name in pair]
        result.append(_plane(atlas, pair, shown, held, {f: part[f].values for f in fields}))
    return result


def _plane(
    atlas: Dataset,
    pair: tuple[str, str],
    shown: Sequence[tuple[Array, str]],
    held: Mapping[str, float],
    fields: Mapping[str, Array],
) -> Plane:
    (first, one), (second, other) = shown
    units = _units(atlas)
    others = [
        f"{name} = {float(_degrees(np.array(value), units[name])[0]):.4g} "
        f"{'deg' if units[name] == 'rad' else units[name]}"
        for name, value in held.items()
        if name not in pair
    ]
    return Plane(pair, (one, other), (first, second), ", ".join(others), fields)


def _units(atlas: Dataset) -> dict[str, str]:
    """Units of the pose coordinates."""
    if atlas.singularity.dims == _SLICED:
        return dict(zip(atlas.coordinate.values, atlas.unit.values, strict=True))
    return {name: atlas[name].attrs["units"] for name in atlas.singularity.dims}


def _degrees(values: Array, unit: str) -> tuple[Array, str]:
    return (np.degrees(values), "deg") if unit == "rad" else (values, unit)


def plane(shown: Plane, greatest: float, ax: Axes | None = None) -> Axes:
    """Distance to a singularity over two pose coordinates, or over the only one.

    :param greatest: value of the last colour.
    """
    ax = figures.axes_or_new(ax)
    first, second = shown.ticks
    values = shown.fields["singularity"]
    ax.set_title(shown.where, fontsize=9)
    ax.set_xlabel(f"{shown.names[0]} ({shown.units[0]})")
    if len(second) == 1:
        ax.plot(first, values[:, 0], color=plots.COLOURS[0])
        ax.set_ylabel("distance to a singularity (1)")
        ax.set_ylim(0.0, 1.05 * greatest)
        ax.grid(alpha=0.3)
        return ax
    ax.set_ylabel(f"{shown.names[1]} ({shown.units[1]})")
    mesh = ax.pcolormesh(
        first,
        second,
        np.ma.masked_invalid(values.T),
        shading="nearest",
        cmap=figures.MAP,
        vmin=0.0,
        vmax=greatest,
    )
    figures.bar(ax, mesh, "distance to a singularity (1)")
    return ax


def _sections(atlas: Dataset) -> Figure:
    """Every pair of coordinates through the home pose."""
    shown = planes(atlas)
    columns = min(len(shown), 5 if len(shown) > 4 else 3)
    rows = math.ceil(len(shown) / columns)
    figure, axes = figures.subplots(
        rows, columns, figsize=(5.2 * columns, 4.2 * rows), layout="constrained", squeeze=False
    )
    greatest = float(atlas.singularity.max())
    for ax in axes.ravel()[len(shown) :]:
        ax.set_visible(False)
    for one, ax in zip(shown, axes.ravel(), strict=False):
        plane(one, greatest if greatest > 0.0 else 1.0, ax)
    size = ""
    if "volume" in atlas:
        size = f" {float(atlas.volume):.4g} {atlas.volume.attrs['units']}"
    figure.suptitle(f"{atlas.attrs['robot']}: reachable{size or ' poses through home'}")
    return figure


def _upright(atlas: Dataset) -> Figure:
    known = "clearance" in atlas
    figure, axes = figures.subplots(
        1 + known,
        3,
        figsize=(16, 9.5 if known else 5),
        layout="constrained",
        width_ratios=(1, 1, 0.75),
        squeeze=False,
    )
    section(atlas, axes[0, 0])
    section(atlas, axes[0, 1], upright=False)
    circle_radii(atlas, axes[0, 2])
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
        f"{atlas.volume.attrs['units']}; largest cylinder {atlas.attrs['height']} = "
        f"{float(atlas.cylinder_low):.3f} to "
        f"{float(atlas.cylinder_high):.3f} m, radius {shown}{share}"
    )
    return figure


# Page


def title(atlas: Dataset) -> str:
    """What the page shows, in a line."""
    return f"Workspace of {atlas.attrs['robot']}"


def page(atlas: Dataset) -> Any:
    """The reachable poses: slices of three coordinates, or one picture for each two."""
    return (
        _page_of_slices(atlas)
        if atlas.singularity.ndim == 3 and "slice" not in atlas.dims
        else (_page_of_planes(atlas))
    )


_LABELS: Final = {
    "singularity": ("distance to a singularity (1)", "distance to a singularity", "", 1.0),
    "clearance": ("clearance of the limbs (mm)", "clearance", "mm", 1e3),
    "joint_angle": ("largest passive joint angle (deg)", "passive angle", "deg", 180 / math.pi),
}


def _page_of_slices(atlas: Dataset) -> Any:
    dims = atlas.singularity.dims
    upwards = atlas.attrs["height"] or dims[2]
    one, other = (name for name in dims if name != upwards)
    most = {upwards: 15, one: 61, other: 61}
    part = pages.thinned(atlas, most).transpose(upwards, one, other, ...)
    (x, x_unit), (y, y_unit), (z, z_unit) = (
        figures.in_degrees(part[name]) for name in (one, other, upwards)
    )
    inside = part.reachable.values > 0
    # All at the same points, those that are reachable.
    fields = [
        pages.Shown(label, name, unit, np.where(inside, scale * part[field].values, np.nan))
        for field, (label, name, unit, scale) in _LABELS.items()
        if field in part
    ]
    return pages.layers(
        title(atlas),
        *np.meshgrid(x, y, indexing="ij"),
        z,
        (one, other, upwards),
        (x_unit, y_unit, z_unit),
        fields,
    )


def _page_of_planes(atlas: Dataset) -> Any:
    graph = require("plotly.graph_objects", "atlas")
    figure = graph.Figure()
    shown = planes(atlas)
    buttons: list[dict[str, Any]] = []
    count = sum(len(one.fields) for one in shown)
    for one in shown:
        (first, second), (x, y) = one.ticks, one.names
        for field, values in one.fields.items():
            label, name, unit, scale = _LABELS[field]
            where = f"{x} %{{x:.4~f}} {one.units[0]}<br>"
            names = {"xaxis.title.text": f"{x} ({one.units[0]})"}
            if len(second) == 1:
                figure.add_scatter(
                    x=pages.few(first),
                    y=pages.few(scale * values[:, 0]),
                    hovertemplate=f"{where}{name} %{{y:.4~g}} {unit}<extra></extra>",
                )
                names["yaxis.title.text"] = label
            else:
                figure.add_heatmap(
                    x=pages.few(first),
                    y=pages.few(second),
                    z=pages.few(scale * values.T),
                    coloraxis="coloraxis",
                    hoverongaps=False,
                    hovertemplate=f"{where}{y} %{{y:.4~f}} {one.units[1]}<br>"
                    f"{name} %{{z:.4~g}} {unit}<extra></extra>",
                )
                names["yaxis.title.text"] = f"{y} ({one.units[1]})"
            visible = [n == len(buttons) for n in range(count)]
            figure.data[-1].visible = not buttons
            text = f"{x} and {y}: {label}" if len(second) > 1 else label
            layout = names | {"coloraxis.colorbar.title.text": label}
            layout["title.text"] = title(atlas) + (f"; {one.where}" if one.where else "")
            buttons.append(pages.button(text, {"visible": visible}, layout))
    figure.update_layout(
        coloraxis={"colorscale": "Viridis", "colorbar": {"len": 0.8}},
        margin={**pages.MARGIN, "l": 70, "b": 60},
        updatemenus=[{"buttons": buttons, **pages.MENU}],
    )
    figure.update_layout(buttons[0]["args"][1])
    return figure


KIND: Final = Kind(
    "workspace",
    figures={"sections": _workspace},
    page=page,
    title=title,
    help="Reachable poses, coloured by the distance to a singularity: 0 in one, 1 at best. The "
    "menu chooses what is shown, the slider one layer alone.",
)
