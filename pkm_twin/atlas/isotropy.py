# SPDX-License-Identifier: Apache-2.0
"""Dynamic-isotropy atlas: on every pose of a grid a sphere of directions, coloured by an index.

The indices of delta_dynamics/isotropy.py, eta_KE and F_max, over unit vectors of three pose rates.
A machine that tilts stands on a polar grid of azimuth and tilt (3-PRRU paper, section 5), others on
a grid of two coordinates: of those across the axis, or of the first two.

May import: numpy, pkm_twin's core and the two packages above it; never rclpy.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from delta_dynamics.isotropy import (
    ENERGY,
    STRETCHED,
    energy_matrices,
    energy_transfer_range,
    max_driving_force,
)
from pkm_twin.atlas import figures, pages
from pkm_twin.atlas.extras import require
from pkm_twin.atlas.grids import circles, ladder, turns, workspace_box
from pkm_twin.atlas.sweep import Chunk, Field, Kind, Sweep, Values, Variable
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.workspace import distance_unit, reachable, singularity_at, try_inverse
from pkm_twin.machine.robot import Robot

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from xarray import Dataset

Array = NDArray[np.float64]

POINTS: Final = 48_000
TILT: Final = math.radians(45.0)
"""Largest tilt of the paper's atlas, rad."""
CHUNK: Final = 16384
VIEW: Final = np.array([0.36, 0.8, 0.48])
"""Where spheres are looked at from, in pose rates."""
PIXELS: Final = 61
BEYOND: Final[Mapping[str, Any]] = {"ec": "#D55E00", "lw": 1.6, "ls": "--"}
"""Rim of a sphere beyond the limits."""
TAIL: Final = 0.5
"""Percent of the values on spheres beyond each end of their colours: a few extremes would leave
all others one colour."""

_SPHERE: Final = ("polar", "turn")


@dataclass(frozen=True, eq=False)
class IsotropySweep(Sweep):
    """Spheres of eta_KE and F_max over a grid of poses at one height.

    ``first`` and ``second``: the grid's axes: two coordinates, or azimuth and tilt (rad). ``polar``
    angles from the direction's third axis, ``turn`` angles about it, from the first, rad.
    ``beyond``: also poses beyond the limits; else they are NaN.
    """

    height: float
    energy: float
    first: Array
    second: Array
    polar: Array
    turn: Array
    beyond: bool

    kind: ClassVar[str] = "isotropy"

    @property
    def axes(self) -> tuple[str, str]:
        """Names of the grid's axes."""
        return ("azimuth", "tilt") if tilting(self.robot) else plane_of(self.robot)[:2]

    @property
    def fields(self) -> Mapping[str, Field]:  # type: ignore[override]
        """Indices on the spheres, and the exact range of eta_KE at each pose."""
        unit = self.robot.effort_unit
        sphere = (*self.axes, *_SPHERE)
        share = "eta_KE, the platform's part of the kinetic energy"
        return {
            "eta": Field(sphere, {"units": "1", "long_name": share}),
            "force": Field(sphere, {"units": unit, "long_name": "F_max, largest driving force"}),
            "eta_least": Field(self.axes, {"units": "1", "long_name": f"least {share}, exact"}),
            "eta_greatest": Field(
                self.axes, {"units": "1", "long_name": f"greatest {share}, exact"}
            ),
            "singularity": Field(
                self.axes,
                {"units": "1", "long_name": "distance to a singularity: 0 in one, 1 at best"},
            ),
            "within_limits": Field(
                self.axes, {"long_name": "1 where the pose keeps all limits of the machine"}, "i1"
            ),
        }

    @property
    def coordinates(self) -> dict[str, Variable]:
        """The grid's axes, and the angles of the directions."""
        rates = [f"d{name}/dt" for name in self.robot.pose_names]
        units = dict(zip(self.robot.pose_names, self.robot.pose_units, strict=True))
        what = {
            "azimuth": "direction that the platform leans to",
            "tilt": "lean of the platform's axis, no torsion",
        }
        result = {
            name: Variable(
                (name,),
                values,
                {
                    "units": units.get(name, "rad"),
                    "long_name": what.get(name, f"pose coordinate {name}"),
                },
            )
            for name, values in zip(self.axes, (self.first, self.second), strict=True)
        }
        result["polar"] = Variable(
            ("polar",), self.polar, {"units": "rad", "long_name": f"angle from {rates[2]}"}
        )
        result["turn"] = Variable(
            ("turn",),
            self.turn,
            {"units": "rad", "long_name": f"about {rates[2]}, from {rates[0]} to {rates[1]}"},
        )
        return result

    @property
    def directions(self) -> Array:
        """Unit vectors of pose rates, shape (polar, turn, 3)."""
        return unit_vectors(self.polar, self.turn)

    @property
    def settings(self) -> dict[str, Any]:
        """Height of the poses, m or rad, the platform's energy, J, and what is left out."""
        return {
            "height": self.height,
            "height_name": plane_of(self.robot)[2],
            "energy": self.energy,
            "beyond_limits": self.beyond,
            "points": self.points,
        }

    @property
    def rows_a_chunk(self) -> int:
        """Poses in one chunk."""
        return max(1, CHUNK // (len(self.polar) * len(self.turn)))

    def count(self, chunk: Chunk) -> int:
        """Directions at all poses of a chunk."""
        return (chunk.stop - chunk.start) * len(self.polar) * len(self.turn)

    def poses(self, chunk: Chunk) -> Array:
        """Poses of a chunk, shape (rows, 3)."""
        second = self.second[chunk.start : chunk.stop]
        if tilting(self.robot):
            return self.robot.grid().polar_pose(self.height, second, self.first[chunk.first])
        poses = np.empty((len(second), 3))
        where = [self.robot.pose_names.index(name) for name in plane_of(self.robot)]
        for k, values in zip(where, (self.first[chunk.first], second, self.height), strict=True):
            poses[:, k] = values
        return poses

    def evaluate(self, chunk: Chunk) -> Values:
        """Indices at the poses; NaN where a pose is out of reach, beyond limits, or singular."""
        robot, poses = self.robot, self.poses(chunk)
        measure = singularity_at(robot, poses)
        _, good = try_inverse(robot, poses)
        good &= measure > STRETCHED
        within = reachable(robot, poses)
        if not self.beyond:
            good &= within
        if robot.grid().kind == "cylinder" and not tilting(robot):
            # Places outside the circle that the limits of the actuators leave.
            out = np.hypot(self.first[chunk.first], self.second[chunk.start : chunk.stop])
            good &= out <= self.second[-1] * (1 + 1e-9)
        shape = (len(poses), len(self.polar), len(self.turn))
        values = {
            "eta": np.full(shape, np.nan),
            "force": np.full(shape, np.nan),
            "eta_least": np.full(len(poses), np.nan),
            "eta_greatest": np.full(len(poses), np.nan),
            "singularity": np.where(good, measure, np.nan),
            "within_limits": within.astype(np.int8),
        }
        if good.any():
            kept, x = poses[good], self.directions
            values["eta"][good] = _share(robot, kept, x)
            values["force"][good] = max_driving_force(robot, kept[:, None, None, :], x, self.energy)
            ends = energy_transfer_range(robot, kept)
            values["eta_least"][good], values["eta_greatest"][good] = ends.least, ends.greatest
        return values


def _share(robot: Robot, poses: Array, x: Array) -> Array:
    """eta_KE at poses (n, 3) over directions (..., 3), shape (n, ...)."""
    platform, everything = energy_matrices(robot, poses)
    forms = [np.einsum("...i,nij,...j->n...", x, form, x) for form in (platform, everything)]
    return np.asarray(forms[0] / forms[1], np.float64)


def unit_vectors(polar: Array, turn: Array) -> Array:
    """Directions of spherical angles, shape (polar, turn, 3)."""
    theta, phi = np.meshgrid(polar, turn, indexing="ij")
    out = np.sin(theta)
    return np.stack([out * np.cos(phi), out * np.sin(phi), np.cos(theta)], -1)


def isotropy_sweep(
    robot: Robot,
    points: int | None = None,
    *,
    height: float | None = None,
    energy: float = ENERGY,
    tilt: float = TILT,
    beyond_limits: bool = True,
) -> IsotropySweep:
    """The isotropy atlas of a robot.

    :param points: poses times directions, about; the grid is 12 azimuths by 4 tilts (and the
        upright pose), or 9 by 9 places, unless the spheres then had over 5,000 directions.
    :param height: of the poses, m; default the home pose's. For a robot without an axis the third
        pose coordinate, m or rad.
    :param energy: kinetic energy E_M of the platform for F_max, J.
    :param tilt: largest tilt, rad.
    :param beyond_limits: also poses beyond the limits, which the file marks; else NaN there.
    :raises ParameterError: a robot without masses, or whose directions make no sphere.
    """
    robot.massive()
    if len(robot.pose_names) != 3:
        raise ParameterError("pose", list(robot.pose_names), "three pose coordinates, for spheres")
    if points is not None and points < 1000:
        raise ParameterError("points", points, "1000 or more")
    if not 0.0 < energy < math.inf:
        raise ParameterError("energy", energy, "above zero, J")
    if height is not None and not math.isfinite(height):
        raise ParameterError("height", height, "a finite number, m")
    if not 0.0 < tilt < math.pi / 2:
        raise ParameterError("tilt", tilt, "between 0 and a right angle, rad")
    total = points or POINTS
    names = plane_of(robot)
    home = float(robot.home()[robot.pose_names.index(names[2])])
    z = home if height is None else height
    finer = max(1.0, math.sqrt(total / (60 * 5000)))
    if tilting(robot):
        azimuths, rungs = 12 * round(finer), 4 * round(finer)
        first = turns(azimuths)
        second = ladder(tilt / rungs, rungs + 1)
    elif robot.grid().kind == "box":
        box = workspace_box(robot)
        low, high = box[robot.pose_names.index(names[2])]
        if not low <= z <= high:
            raise ParameterError("height", z, f"{low:.3g} to {high:.3g}, where the robot reaches")
        side = 8 * round(finer) + 1
        first, second = (
            np.linspace(float(a), float(b), side)
            for a, b in (box[robot.pose_names.index(name)] for name in names[:2])
        )
    else:
        side = 8 * round(finer) + 1
        radius = float(circles(robot, [z]).radius[0])
        if radius == 0.0:
            raise ParameterError("height", z, "a height that the robot reaches, m")
        first = second = radius * np.linspace(-1.0, 1.0, side)
    # An even number of turns and of polar steps: each direction has its opposite.
    a_sphere = total / (len(first) * len(second))
    half = max(4, round(math.sqrt(a_sphere / 2) / 2))
    polar = ladder(np.pi / (2 * half), 2 * half + 1)
    turn = turns(4 * half)
    return IsotropySweep(robot, z, energy, first, second, polar, turn, beyond_limits)


def tilting(robot: Robot) -> bool:
    """Whether the robot's poses are tilts about an axis."""
    return robot.grid().kind == "cylinder" and distance_unit(robot) == "rad"


def plane_of(robot: Robot) -> tuple[str, str, str]:
    """The two pose coordinates of a grid of spheres, and the one that is the same in all."""
    grid = robot.grid()
    if grid.kind == "cylinder":
        return grid.lateral[0], grid.lateral[1], grid.height
    return robot.pose_names[0], robot.pose_names[1], robot.pose_names[2]


# Figures


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
    steps = figures.pyplot().get_cmap(
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
            rim = figures.pyplot().Circle((x, y), size, fill=False, zorder=2.1, **ring_of)
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
        handle = figures.pyplot().Line2D([], [], ls="--", lw=1.6, color=BEYOND["ec"], label=label)
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
    unit = atlas[index].attrs["units"]
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
    names = _rates(atlas)
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


def _rates(atlas: Dataset) -> tuple[str, ...]:
    return tuple(f"d{name}/dt" for name in atlas.attrs["pose"].split())


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
                    color=figures.LINES[drawn % len(figures.LINES)],
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
        what = "the platform's part of the kinetic energy, by direction of the pose rates"
    else:
        energy = json.loads(atlas.attrs["settings"])["energy"]
        what = f"largest driving {_effort(atlas)} at a platform energy of {energy:g} J"
    figure.suptitle(f"{at_height(atlas)}: {what}")
    return figure


def _spreads(atlas: Dataset) -> Figure:
    figure, axes = figures.subplots(1, 2, figsize=(12, 4.8), layout="constrained")
    titles = ("the platform's part of the kinetic energy", f"largest driving {_effort(atlas)}")
    for index, title, ax in zip(("eta", "force"), titles, axes, strict=True):
        spread_over_poses(atlas, index, ax)
        ax.set_title(title)
    figure.suptitle(f"{at_height(atlas)}: greatest less least over all directions")
    return figure


def _effort(atlas: Dataset) -> str:
    return "force" if atlas.force.attrs["units"] == "N" else "torque"


def at_height(atlas: Dataset) -> str:
    """Robot and height of an isotropy atlas, as text."""
    settings = json.loads(atlas.attrs["settings"])
    return f"{atlas.attrs['robot']} at {settings['height_name']} = {settings['height']:.3f} m"


# Page


def title(atlas: Dataset) -> str:
    """What the page shows, in a line."""
    return f"Dynamic isotropy of {at_height(atlas)}"


def page(atlas: Dataset) -> Any:
    """Spheres of an isotropy atlas that turn; a menu chooses eta_KE or F_max."""
    graph = require("plotly.graph_objects", "atlas")
    names = atlas.eta.dims[:2]
    part = pages.thinned(atlas, {names[0]: 13, names[1]: 9, "polar": 25, "turn": 48})
    balls = _balls(part)
    unit = atlas.force.attrs["units"]
    figure = graph.Figure()
    for nodes in balls.nodes:
        figure.add_mesh3d(
            **{axis: pages.short(nodes[:, k]) for k, axis in enumerate("xyz")},
            **balls.triangles,
            coloraxis="coloraxis",
            lighting={"ambient": 0.85, "diffuse": 0.3, "specular": 0.05},
        )
    buttons = []
    for label, said, field, logarithmic in (
        ("eta_KE (1)", "eta_KE %{intensity:.4~g}", balls.eta, False),
        (f"F_max ({unit})", f"F_max %{{customdata:.4~g}} {unit}", balls.force, True),
    ):
        coloured = [np.log10(values) if logarithmic else values for values in field]
        data = {
            "intensity": [pages.few(values) for values in coloured],
            "customdata": [pages.few(values) if logarithmic else None for values in field],
            "hovertemplate": [f"{name}<br>{said}<extra></extra>" for name in balls.names],
        }
        layout = pages.colours(label, np.array(coloured), logarithmic=logarithmic, tail=TAIL)
        buttons.append(pages.button(label, data, layout, list(range(len(balls.nodes)))))
    first = buttons[0]["args"][0]
    for k, trace in enumerate(figure.data):
        trace.update({key: values[k] for key, values in first.items()})
    if balls.beyond:
        figure.add_scatter3d(**_rims(balls))
    rates = _rates(atlas)
    ends = ", ".join(f"{axis} {rate}" for axis, rate in zip("xyz", rates, strict=True))
    hidden = {"visible": False}
    thick = [-0.5 * balls.step, 0.5 * balls.step]
    sides = [[middle - balls.half, middle + balls.half] for middle in balls.middle]
    scene: dict[str, Any] = {
        "aspectmode": "manual",
        "aspectratio": pages.aspect([*sides, thick], 2.2 if balls.polar else 1.7),
        "camera": pages.FLAT,
        "zaxis": hidden,
    }
    for axis, name, side in zip(("xaxis", "yaxis"), names, sides, strict=True):
        shown = {"title": f"{name} ({atlas[name].attrs['units']})", "range": side}
        scene[axis] = hidden if balls.polar else shown
    around = ""
    if balls.polar:
        around = "around: azimuth, outwards: tilt; "
        tilts = np.degrees(part.tilt.values)
        figure.add_scatter3d(**_polar_names(part.azimuth.values, tilts, balls.step))
    figure.update_layout(
        title=f"{title(atlas)}; {around}axes of a sphere: {ends}",
        coloraxis={"colorscale": "Viridis", "colorbar": {"len": 0.8}},
        scene=scene,
        margin=pages.MARGIN,
        updatemenus=[{"buttons": buttons, **pages.MENU}],
    )
    figure.update_layout(buttons[0]["args"][1])
    return figure


@dataclass(frozen=True, eq=False)
class _Balls:
    """The spheres of a page: nodes (n, 3) of each, and the fields at them, shape (n,).

    ``names``: where each sphere is; ``beyond``: middles of those beyond the limits. ``triangles``:
    of every one of them. ``step``: distance of spheres. ``middle`` and ``half`` width of
    the picture.
    """

    nodes: list[Array]
    triangles: dict[str, NDArray[np.int64]]
    eta: list[Array]
    force: list[Array]
    names: list[str]
    beyond: list[tuple[float, float]]
    step: float
    middle: tuple[float, float]
    half: float
    polar: bool


def _balls(part: Dataset) -> _Balls:
    names = part.eta.dims[:2]
    polar = names == ("azimuth", "tilt")
    first, second = (part[name].values for name in names)
    units = [part[name].attrs["units"] for name in names]
    step = float(second[1] - second[0]) * (180 / math.pi if polar else 1.0)
    turn = np.append(part.turn.values, part.turn.values[0] + 2 * np.pi)
    ball = 0.44 * step * unit_vectors(part.polar.values, turn)
    whole = pages.triangles(np.ones(ball.shape[:2], bool))
    within = part.within_limits.values > 0
    nodes: list[Array] = []
    said: list[str] = []
    kept: list[tuple[int, int]] = []
    beyond: list[tuple[float, float]] = []
    for i, a in enumerate(first.tolist()):
        for j, b in enumerate(second.tolist()):
            known = np.isfinite(part.eta.values[i, j]).all()
            if not known or (polar and j == 0 and i > 0):
                continue
            if polar:
                out = 0.0 if j == 0 else math.degrees(b) + step
                x, y = out * math.cos(a), out * math.sin(a)
                name = f"azimuth {math.degrees(a):.0f} deg, tilt {math.degrees(b):.4g} deg"
            else:
                x, y = a, b
                name = f"{names[0]} {a:.4g} {units[0]}, {names[1]} {b:.4g} {units[1]}"
            if not within[i, j]:
                beyond.append((x, y))
                name += "<br>beyond the machine's limits"
            said.append(name)
            nodes.append((ball + np.array([x, y, 0.0])).reshape(-1, 3))
            kept.append((i, j))
    eta, force = (
        [pages.closed(field.values[i, j]).ravel() for i, j in kept]
        for field in (part.eta, part.force)
    )
    if polar:
        middle, half = (0.0, 0.0), math.degrees(float(second.max())) + 2.2 * step
    else:
        middle = float(first.mean()), float(second.mean())
        half = float(np.ptp(second)) / 2 + 0.6 * step
    return _Balls(nodes, whole, eta, force, said, beyond, step, middle, half, polar)


def _rims(balls: _Balls) -> dict[str, Any]:
    """Circles around the spheres beyond the limits, as a trace."""
    turn = np.linspace(0.0, 2 * np.pi, 49)
    circle = 0.47 * balls.step * np.stack([np.cos(turn), np.sin(turn)], -1)
    # A gap after each.
    lines = [np.vstack([circle + middle, [np.nan, np.nan]]) for middle in balls.beyond]
    x, y = np.concatenate(lines).T
    return {
        "x": pages.short(x),
        "y": pages.short(y),
        "z": np.zeros(len(x)),
        "mode": "lines",
        "line": {"color": BEYOND["ec"], "width": 4},
        "hoverinfo": "skip",
        "name": "beyond the limits",
        "showlegend": True,
    }


def _polar_names(azimuth: Array, tilt: Array, step: float) -> dict[str, Any]:
    """Names of azimuths (rad) around the spheres and of tilts (deg) between them, as a trace."""
    far = float(tilt[-1]) + 1.9 * step
    x = (far * np.cos(azimuth)).tolist()
    y = (far * np.sin(azimuth)).tolist()
    text = [f"{math.degrees(a):.0f}°" for a in azimuth]
    between = math.pi / len(azimuth)
    for k, value in enumerate(tilt[1:].tolist()):
        # The spheres of the first ring leave no room on it.
        out = value + (0.35 if k == 0 else 1.0) * step
        x.append(out * math.cos(between))
        y.append(out * math.sin(between))
        text.append(f"{value:.4g}°")
    return {
        "x": x,
        "y": y,
        "z": [0.0] * len(x),
        "mode": "text",
        "text": text,
        "hoverinfo": "skip",
        "showlegend": False,
    }


KIND: Final = Kind(
    "isotropy",
    figures={"eta": _spheres_eta, "force": _spheres_force, "spread": _spreads},
    page=page,
    title=title,
    help="A sphere is all directions of the pose rates at one pose; it looks the same from behind. "
    "A few values beyond the ends of the colours have the end's colour.",
)
