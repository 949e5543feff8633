# SPDX-License-Identifier: Apache-2.0
"""Workspace atlas: what a machine reaches, how far from a singularity, and the regular part.

The grid is the pose's own: height and two tilts, or x, y, z. Reachable: the limits of actuators
and of passive joints, limbs apart from each other where the file tells their diameters, on the
branch of the home pose. Regular: the largest circle about the axis at each height, and the
largest upright cylinder that fits into them.

May import: numpy, pkm_twin's core and the two packages above it; never rclpy.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas import figures, pages, plots
from pkm_twin.atlas.extras import require
from pkm_twin.atlas.grids import (
    circles,
    distance_unit,
    height_range,
    largest_cylinder,
    largest_distance,
    singularity,
    tilts,
)
from pkm_twin.atlas.sweep import Chunk, Field, Kind, Sweep, Values, Variable
from pkm_twin.codegen.kernels import OK
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.workspace import clearance, has_clearance, reachable
from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]

POINTS: Final = 200_000
CHUNK: Final = 32768
LAYERS: Final = 101
"""Heights of the regular workspace."""
_COARSE: Final = 33


@dataclass(frozen=True, eq=False)
class WorkspaceSweep(Sweep):
    """Reach over a grid of poses; ``axes``: ticks of the three pose parameters, m and rad.

    ``least``: singularity measure below which a pose counts as out of reach. ``least_clearance``:
    distance of members of different limbs, m, that is too little; where it is not known, nothing.
    """

    axes: tuple[Array, Array, Array]
    least: float
    least_clearance: float = 0.0

    kind: ClassVar[str] = "workspace"

    @property
    def fields(self) -> Mapping[str, Field]:  # type: ignore[override]
        """Reach, singularity measure, passive angle and clearance where the machine tells them."""
        names = self.robot.pose_names
        fields = {
            "reachable": Field(names, {"long_name": "1 where all limits are kept"}, "i1"),
            "singularity": Field(
                names,
                {
                    "units": "1",
                    "long_name": "distance to a singularity: 0 in one, 1 at best; reachable poses",
                },
            ),
        }
        if self.robot.angles_kernel is not None:
            fields["joint_angle"] = Field(
                names, {"units": "rad", "long_name": "largest passive joint angle; reachable poses"}
            )
        if has_clearance(self.robot):
            # Also where limbs meet, so that the file shows what interference takes away.
            fields["clearance"] = Field(
                names,
                {
                    "units": "m",
                    "long_name": "least distance of different limbs' members, negative where they "
                    "meet; poses that are reachable but for it",
                },
            )
        return fields

    @property
    def coordinates(self) -> dict[str, Variable]:
        """The pose parameters, and the heights of the circles."""
        robot = self.robot
        result = {
            name: Variable((name,), ticks, {"units": unit, "long_name": f"pose parameter {name}"})
            for name, unit, ticks in zip(robot.pose_names, robot.pose_units, self.axes, strict=True)
        }
        result["height"] = Variable(
            ("height",), self.heights, {"units": "m", "long_name": "height of the circles"}
        )
        return result

    @property
    def heights(self) -> Array:
        """Heights of the circles, shape (n,), m."""
        ticks = self.axes[self.robot.pose_names.index("z")]
        return np.linspace(ticks[0], ticks[-1], LAYERS)

    @property
    def settings(self) -> dict[str, Any]:
        """Least singularity measure and clearance."""
        return {
            "least_singularity": self.least,
            "least_clearance": self.least_clearance,
            "points": self.points,
        }

    @property
    def rows_a_chunk(self) -> int:
        """Ticks of the second parameter in one chunk."""
        return max(1, CHUNK // len(self.axes[2]))

    def count(self, chunk: Chunk) -> int:
        """Poses of one chunk."""
        return (chunk.stop - chunk.start) * len(self.axes[2])

    def evaluate(self, chunk: Chunk) -> Values:
        """Reach of the chunk; how many poses are reachable, and how many but for interference."""
        robot = self.robot
        first, second, third = self.axes
        rows = second[chunk.start : chunk.stop]
        poses = np.empty((len(rows), len(third), 3))
        poses[..., 0], poses[..., 1], poses[..., 2] = first[chunk.first], rows[:, None], third
        inside = reachable(robot, poses, -math.inf)
        measure = np.full(inside.shape, np.nan)
        measure[inside] = singularity(robot, poses[inside])
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
        if robot.angles_kernel is not None:
            angles, fault = robot.angles_kernel(robot.parameters, poses)
            shown = inside & (fault[..., 0] == OK)
            values["joint_angle"] = np.where(shown, angles.max(-1), np.nan)
        values["counts"] = np.array([inside.sum(), otherwise])
        return values

    def summaries(self, partial: Iterable[Values]) -> dict[str, Variable]:
        """Volume, circles and cylinder, and what interference takes away."""
        count, otherwise = np.sum([p["counts"] for p in partial], axis=0).tolist()
        steps = [ticks[1] - ticks[0] for ticks in self.axes]
        reach = circles(
            self.robot, self.heights, least=self.least, least_clearance=self.least_clearance
        )
        best = largest_cylinder(reach)
        unit = distance_unit(self.robot)
        volume = "m3" if unit == "m" else "m rad2"
        cylinder = np.array([best.low, best.high, best.radius])
        lost: dict[str, Variable] = {}
        if has_clearance(self.robot):
            share = (otherwise - count) / otherwise if otherwise else math.nan
            lost["interference"] = Variable(
                (),
                np.array(share),
                {"units": "1", "long_name": "share of otherwise reachable poses where limbs meet"},
            )
        return {
            "volume": Variable(
                (),
                np.array(count * math.prod(steps)),
                {"units": volume, "long_name": "volume of the reachable poses"},
            ),
            **lost,
            "circle": Variable(
                ("height",), reach.radius, {"units": unit, "long_name": "largest circle, radius"}
            ),
            **{
                f"cylinder_{name}": Variable(
                    (), np.array(value), {"units": u, "long_name": f"largest cylinder, {name}"}
                )
                for name, value, u in zip(
                    ("low", "high", "radius"), cylinder, ("m", "m", unit), strict=True
                )
            },
        }


def workspace_sweep(
    robot: Robot,
    points: int | None = None,
    *,
    least_singularity: float = 0.0,
    least_clearance: float = 0.0,
) -> WorkspaceSweep:
    """The workspace atlas of a robot, on a box around all that a coarse search reaches.

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
    low, high = _box(robot)
    side = max(5, round(total ** (1 / 3)))
    # Odd across the axis, so that the axis is on the grid.
    odd = side + 1 - side % 2
    axes = [
        np.linspace(a, b, side if name == "z" else odd)
        for a, b, name in zip(low, high, robot.pose_names, strict=True)
    ]
    return WorkspaceSweep(robot, (axes[0], axes[1], axes[2]), least_singularity, least_clearance)


def _box(robot: Robot) -> tuple[Array, Array]:
    """Least and greatest pose parameters of a coarse search, one of its steps wider."""
    far = largest_distance(robot)
    bounds = [height_range(robot) if n == "z" else (-far, far) for n in robot.pose_names]
    low, high = np.array(bounds).T
    across = [i for i, name in enumerate(robot.pose_names) if name != "z"]
    # Twice: a machine may reach a small part of what its lengths allow.
    for _ in range(2):
        ticks = [np.linspace(a, b, _COARSE) for a, b in zip(low, high, strict=True)]
        step = (high - low) / (_COARSE - 1)
        grid = np.stack(np.meshgrid(*ticks, indexing="ij"), -1)
        # With what interference takes away, which the atlas shows.
        inside = reachable(robot, grid, -math.inf)
        if not inside.any():
            raise ParameterError("limits", robot.name, "limits that leave a workspace")
        found = grid[inside]
        low, high = found.min(0) - step, found.max(0) + step
        # The axis stays in the middle, and on the grid: workspaces end in tips there.
        half = np.maximum(np.abs(low), np.abs(high))[across]
        low[across], high[across] = -half, half
    if tilts(robot) == 0:
        high[2] = min(high[2], 0.0)
    return low, high


# Figures


def section(atlas: Any, ax: Any = None, upright: bool = True, z: float | None = None) -> Any:
    """A section through the workspace, coloured by the distance to a singularity.

    What limb interference takes away is hatched.

    :param upright: through the axis, else across it at height z.
    :param z: m; default the middle of the largest cylinder.
    """
    ax = figures.axes_or_new(ax)
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


def closest(atlas: Any, ax: Any = None, upright: bool = True) -> Any:
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


def clearance_over_height(atlas: Any, ax: Any = None) -> Any:
    """Least and greatest clearance of the limbs at each height, also of poses where they meet."""
    ax = figures.axes_or_new(ax)
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
    x, y = (figures.in_degrees(atlas[name])[0] for name in (first, second))
    for label, name in ((ax.set_xlabel, first), (ax.set_ylabel, second)):
        label(f"{name} ({figures.in_degrees(atlas[name])[1]})")
    return ax.pcolormesh(x, y, np.ma.masked_invalid(values), shading="nearest", **options)


def _hatch(atlas: Any, ax: Any, first: str, second: str, gap: Array, what: str) -> list[Any]:
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


def circle_radii(atlas: Any, ax: Any = None) -> Any:
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
    figure, axes = figures.pyplot().subplots(
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
        f"{atlas.volume.attrs['units']}; largest cylinder z = {float(atlas.cylinder_low):.3f} to "
        f"{float(atlas.cylinder_high):.3f} m, radius {shown}{share}"
    )
    return figure


# Page


def title(atlas: Any) -> str:
    """What the page shows, in a line."""
    return f"Workspace of {atlas.attrs['robot']}"


def page(atlas: Any) -> Any:
    """The reachable workspace as nested surfaces of distance to a singularity."""
    graph = require("plotly.graph_objects", "atlas")
    names = atlas.singularity.dims
    part = pages.thinned(atlas, dict.fromkeys(names, 41))
    scale = [180 / math.pi if part[n].attrs["units"] == "rad" else 1.0 for n in names]
    ticks = [s * part[n].values for n, s in zip(names, scale, strict=True)]
    grid = np.meshgrid(*ticks, indexing="ij")
    order = [*(k for k, n in enumerate(names) if n != "z"), names.index("z")]
    values = np.nan_to_num(part.singularity.values, nan=-0.01)
    figure = graph.Figure(
        graph.Isosurface(
            x=pages.short(grid[order[0]].ravel()),
            y=pages.short(grid[order[1]].ravel()),
            z=pages.short(grid[order[2]].ravel()),
            value=pages.short(values.ravel()),
            isomin=0.0,
            isomax=float(values.max()) * 0.98,
            surface_count=6,
            opacity=0.35,
            colorscale="Viridis",
            caps={"x_show": False, "y_show": False, "z_show": False},
            colorbar={"title": {"text": "distance to a<br>singularity (1)"}, "len": 0.8},
        )
    )
    label = [f"{names[k]} ({'deg' if scale[k] != 1.0 else 'm'})" for k in order]
    figure.update_layout(
        title=title(atlas),
        scene={
            "xaxis_title": label[0],
            "yaxis_title": label[1],
            "zaxis_title": label[2],
            "camera": pages.CAMERA,
        },
        margin={**pages.MARGIN, "t": 70},
    )
    return figure


KIND: Final = Kind(
    "workspace",
    figures={"sections": _workspace},
    page=page,
    title=title,
    help="Nested surfaces of equal distance to a singularity: 0 in one, 1 at best.",
)
