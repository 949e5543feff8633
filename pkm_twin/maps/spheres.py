# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Draw spheres of directions on a polar plane of tilts: 3-PRRU paper, section 2.3.

The picture is the paper's 5-D image. A sphere stands for a pose: around the plane the azimuth of
the platform's tilt, outwards the tilt, without torsion. A point of a sphere is a unit vector of
pose rates, and its colour is an index of isotropy in this direction of motion. An index is the same
in opposite directions, so the visible half of a sphere shows all of them.
"""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from delta_dynamics.torques.isotropy import (
    energy_transfer,
    max_driving_force,
    sphere_directions,
    tilted_pose,
)
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, import_extra
from pkm_twin.maps.kind import FLAG_BOUNDS, NON_NEGATIVE, UNIT_INTERVAL, Space, Variable, describe, scalar
from pkm_twin.report import plots
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import reachable

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from xarray import Dataset

TILTS: Final = np.radians([0.0, 15.0, 30.0, 45.0])
"""Tilts of the spheres, rad; the paper's images end at 45 degrees."""
AZIMUTHS: Final = np.radians(np.arange(0.0, 360.0, 30.0))
"""Azimuths of the spheres, rad; those of the paper's statement, 60, 180 and 300 degrees, too."""
RADIUS: Final = math.radians(7.0)
"""Radius of a drawn sphere, rad of tilt: neighbours on a ring and of the next ring stay apart."""
VIEW_DIRECTION: Final = np.array([0.5, math.sqrt(0.75), 0.0])
"""Unit vector towards the viewer, in pose rates: the rate of the position points up, and that of a
tilt to the right does so too."""


def check_tilts(robot: Robot) -> None:
    """Check that the pose is a coordinate of the position and two tilts.

    :raises ParameterError: another pose.
    """
    if robot.pose_units != ("m", "rad", "rad"):
        what = "a machine whose pose is a coordinate of the position and two tilts (as prru)"
        raise ParameterError("spheres", ",".join(robot.pose_names), what)


def find_spheres(space: Space, energy: float) -> dict[str, Variable]:
    """Compute eta_KE (equation 44) and F_max (equation 47) on spheres of directions.

    The height is that of the pose that the map's planes are asked to go through, or of home.

    :param energy: the platform's kinetic energy, J.
    :raises ParameterError: the two angles are not tilts about x and y.
    """
    robot = space.robot
    height = float((robot.home() if space.at is None else space.at)[0])
    azimuth, tilt = np.meshgrid(AZIMUTHS, TILTS, indexing="ij")
    poses = tilted_pose(height, azimuth, tilt)
    q, known = robot.try_inverse(poses)
    lean = robot.platform(q[known])[1][:, 2, 2]
    if not np.allclose(lean, np.cos(tilt[known]), rtol=0.0, atol=1e-9):
        raise ParameterError("spheres", ",".join(robot.pose_names), "tilts about x and y (as prru)")
    # Nearer to a singularity efforts grow without bound.
    known[known] = robot.try_singularity(q[known])[0] >= 1e-3
    # About 6 degrees apart.
    directions = sphere_directions(1000)
    share, force = np.full((2, *tilt.shape, len(directions)), np.nan)
    at = poses[known][:, None]
    share[known] = energy_transfer(robot, at, directions)
    force[known] = max_driving_force(robot, at, directions, energy)
    inside = known.copy()
    inside[known] = reachable(robot, poses[known])
    sphere = ("azimuth", "tilt", "way")
    unit = robot.effort_unit
    return {
        "sphere_height": scalar(height, "position coordinate of the spheres", "m"),
        "azimuth": Variable(("azimuth",), AZIMUTHS, describe("towards which it tilts", "rad")),
        "tilt": Variable(("tilt",), TILTS, describe("tilt of the platform", "rad")),
        "way": Variable(("way", "axis"), directions, describe("unit vector of pose rates")),
        "sphere_energy": Variable(
            sphere,
            share,
            describe("eta_KE, share of the kinetic energy in the platform", "", UNIT_INTERVAL),
        ),
        "sphere_force": Variable(sphere, force, describe("F_max, largest effort of the drives", unit, NON_NEGATIVE)),
        "sphere_inside": Variable(
            sphere[:2], inside.astype(np.int8), describe("1 where all limits are kept", "", FLAG_BOUNDS)
        ),
    }


def list_index_labels(data: Dataset) -> dict[str, tuple[str, str]]:
    """Return the question that eta_KE and F_max each answer, and the label of its colour scale."""
    energy = json.loads(data.attrs["settings"])["options"]["energy"]
    unit = str(data.sphere_force.attrs["units"])
    what = "force" if unit == "N" else "torque"
    return {
        "energy": (
            "which share of the kinetic energy is the platform's, in each direction of motion?",
            "eta_KE: share of the kinetic energy in the platform (dimensionless)",
        ),
        "force": (
            f"how much drive {what} does each direction of motion need, platform at {energy:g} J?",
            f"F_max: largest driving {what} ({unit})",
        ),
    }


def state_ranges(data: Dataset) -> list[str]:
    """Return each index's smallest and largest value at the smallest and largest tilt."""
    lines = []
    for index, (_, label) in list_index_labels(data).items():
        values = data[f"sphere_{index}"].values
        drawn = [k for k in range(len(TILTS)) if np.isfinite(values[:, k]).any()]
        ranges = [
            f"{np.nanmin(values[:, k]):.4g} to {np.nanmax(values[:, k]):.4g} at a tilt of "
            f"{math.degrees(TILTS[k]):.0f} degrees"
            for k in (drawn[0], drawn[-1])
        ]
        lines.append(f"spheres at {_read_height(data)}, {label}, {', '.join(ranges)}")
    return lines


def _read_height(data: Dataset) -> str:
    return f"{data.coordinate.values[0]} = {float(data.sphere_height):.4g} m"


def _sphere_centres(data: Dataset) -> list[tuple[int, int, Array]]:
    """Return azimuth and tilt by index, and the centre (2,), of each drawn sphere.

    The level pose has one sphere, and the first ring every other azimuth, for want of room.
    """
    known = np.isfinite(data.sphere_energy.values).all(-1)
    return [
        (a, t, tilt * np.array([math.cos(azimuth), math.sin(azimuth)]))
        for t, tilt in enumerate(data.tilt.values.tolist())
        for a, azimuth in enumerate(data.azimuth.values.tolist())
        if known[a, t] and a % (len(data.azimuth), 2, 1)[min(t, 2)] == 0
    ]


def _triangles(ways: Array) -> NDArray[np.int64]:
    """Return corners of triangles that cover the sphere, seen from outside, shape (k, 3)."""
    from scipy.spatial import ConvexHull  # type: ignore[import-untyped]

    corners = np.asarray(ConvexHull(ways).simplices, np.int64)
    a, b, c = (ways[corners[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * a).sum(-1) < 0.0
    corners[inward] = corners[inward][:, ::-1]
    return corners


def _picture_axes() -> tuple[Array, Array]:
    """Return the picture's right and up in pose rates."""
    right = np.cross([1.0, 0.0, 0.0], VIEW_DIRECTION)
    right /= np.linalg.norm(right)
    return right, np.cross(VIEW_DIRECTION, right)


def draw_spheres(data: Dataset) -> dict[str, Figure]:
    """Draw both indices on spheres at azimuth and tilt, each on one scale of colours."""
    return {f"spheres_{index}": _draw_index(data, index) for index in list_index_labels(data)}


def _draw_index(data: Dataset, index: str) -> Figure:
    from matplotlib.patches import Circle
    from matplotlib.tri import Triangulation

    from pkm_twin.maps.figures import COLOUR_MAP

    question, label = list_index_labels(data)[index]
    values, inside = data[f"sphere_{index}"].values, data.sphere_inside.values
    low, high = float(np.nanmin(values)), float(np.nanquantile(values, 0.995))
    ways = data.way.values
    right, up = _picture_axes()
    flat = np.stack([ways @ right, ways @ up], -1)
    corners = _triangles(ways)
    front = corners[(ways @ VIEW_DIRECTION)[corners].max(-1) > 0.0]
    figure, ((ax,),) = plots.make_subplots(1, 1, 8.6)
    for a, t, centre in _sphere_centres(data):
        x, y = (centre + RADIUS * flat).T
        mesh = ax.tripcolor(
            Triangulation(x, y, front),
            values[a, t],
            shading="gouraud",
            cmap=COLOUR_MAP,
            vmin=low,
            vmax=high,
            rasterized=True,
        )
        rim: dict[str, Any] = {"ec": "0.3", "lw": 0.6}
        if not inside[a, t]:
            rim = {"ec": "#D55E00", "lw": 1.6, "ls": "--"}
        circle = Circle((float(centre[0]), float(centre[1])), RADIUS, fill=False, zorder=3, **rim)
        ax.add_patch(circle)
        mesh.set_clip_path(circle)
    # Draw a circle for each tilt, with the names of tilts and azimuths.
    turn = np.linspace(0.0, 2 * np.pi, 181)
    far = float(data.tilt.values[-1]) + 1.4 * RADIUS
    for k, tilt in enumerate(data.tilt.values[1:].tolist()):
        ax.plot(tilt * np.cos(turn), tilt * np.sin(turn), color="0.8", lw=0.8, zorder=0)
        # Where no sphere is: on the first ring, inside the others.
        at, angle = (tilt, math.pi / 6) if k == 0 else (tilt - 1.25 * RADIUS, math.pi / 12)
        ax.text(
            at * math.cos(angle),
            at * math.sin(angle),
            f"{math.degrees(tilt):.0f}°",
            ha="center",
            va="center",
            fontsize=9,
            color="0.3",
            zorder=4,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.6},
        )
    for azimuth in data.azimuth.values.tolist():
        ax.text(
            far * math.cos(azimuth),
            far * math.sin(azimuth),
            f"{math.degrees(azimuth):.0f}°",
            ha="center",
            va="center",
            fontsize=10,
        )
    ax.set(xlim=(-1.06 * far, 1.06 * far), ylim=(-1.06 * far, 1.06 * far), xticks=[], yticks=[])
    ax.set_aspect("equal")
    ax.set_axis_off()
    # Draw in the lower left corner where the spheres' axes point.
    inset = ax.inset_axes((0.0, 0.0, 0.17, 0.17))
    for k, name in enumerate(data.axis.values):
        tip = np.array([side[k] for side in _picture_axes()])
        arrow = {"arrowstyle": "->", "color": "black", "lw": 1.0}
        inset.annotate("", tuple(tip.tolist()), (0.0, 0.0), arrowprops=arrow)
        side = "center" if abs(tip[0]) < 0.3 else "left" if tip[0] > 0.0 else "right"
        inset.text(1.12 * tip[0], 1.25 * tip[1], name, ha=side, va="center", fontsize=9)
    inset.set(xlim=(-1.9, 1.5), ylim=(-1.4, 1.8))
    inset.set_aspect("equal")
    inset.set_axis_off()
    bar = figure.colorbar(mesh, ax=ax, aspect=32, pad=0.01, fraction=0.04, extend="max")
    bar.set_label(label)
    plots.write_title(figure, f"{data.attrs['robot']}, {_read_height(data)}: {question}", 10)
    dashed = "; dashed rim: beyond the limits" if not inside.all() else ""
    figure.supxlabel(
        "a sphere is a pose: azimuth of the tilt around, tilt outwards; a point of it is a "
        f"direction of motion{dashed}",
        fontsize=8.5,
        color="0.3",
    )
    return figure


def make_page(data: Dataset) -> Any:
    """Return the spheres as a plotly figure to turn; a menu chooses the index."""
    graph = import_extra("plotly.graph_objects", "maps")
    from pkm_twin.maps.page import COLOUR_BAR, FLAT_LIGHT, MARGIN, MENU, make_button, round_digits

    ways, places = data.way.values, _sphere_centres(data)
    corners = _triangles(ways)
    # The scene's z axis points to the viewer of the picture.
    scene = RADIUS * ways @ np.stack([*_picture_axes(), VIEW_DIRECTION], -1)
    vertices = np.concatenate([np.append(c, 0.0) + scene for _, _, c in places])
    every = np.concatenate([corners + k * len(ways) for k in range(len(places))])
    poses = np.degrees([(data.azimuth.values[a], data.tilt.values[t]) for a, t, _ in places])
    named = np.hstack((np.repeat(poses, len(ways), 0), np.tile(ways, (len(places), 1))))
    where = "azimuth %{customdata[0]:.0f}°, tilt %{customdata[1]:.0f}°<br>"
    for k, name in enumerate(data.axis.values, start=2):
        where += f"{name} %{{customdata[{k}]:.2f}}<br>"
    figure = graph.Figure()
    figure.add_mesh3d(
        **{axis: np.float32(vertices[:, k]) for k, axis in enumerate("xyz")},
        **{corner: np.int32(every[:, k]) for k, corner in enumerate("ijk")},
        customdata=np.float32(named),
        coloraxis="coloraxis",
        lighting=FLAT_LIGHT,
    )
    buttons = []
    for index, (_, label) in list_index_labels(data).items():
        values = data[f"sphere_{index}"].values
        low, high = float(np.nanmin(values)), float(np.nanquantile(values, 0.995))
        shown = np.concatenate([round_digits(values[a, t]) for a, t, _ in places])
        said = f"{where}{label.partition(':')[0]} %{{intensity:.4~g}}<extra></extra>"
        layout = {"coloraxis.cmin": low, "coloraxis.cmax": high, "coloraxis.colorbar.title.text": label}
        change = {"intensity": [shown.tolist()], "hovertemplate": [said]}
        buttons.append(make_button(label.partition(":")[0], change, layout, [0]))
    first, layout = buttons[0]["args"][:2]
    figure.data[0].update({name: values[0] for name, values in first.items()})
    edge = float(data.tilt.values[-1]) + 2.0 * RADIUS
    figure.add_scatter3d(
        x=[edge * math.cos(a) for a in data.azimuth.values],
        y=[edge * math.sin(a) for a in data.azimuth.values],
        z=[0.0] * len(data.azimuth),
        mode="text",
        hoverinfo="skip",
        showlegend=False,
        text=[f"{math.degrees(a):.0f}°" for a in data.azimuth.values],
    )
    hidden = {"visible": False}
    figure.update_layout(
        coloraxis={"colorscale": "Viridis", "colorbar": COLOUR_BAR},
        margin=MARGIN,
        updatemenus=[{"buttons": buttons, **MENU}],
        scene={
            "xaxis": hidden,
            "yaxis": hidden,
            "zaxis": hidden,
            "aspectmode": "data",
            "camera": {
                "eye": {"x": 0.0, "y": 0.0, "z": 1.25},
                "up": {"x": 0.0, "y": 1.0, "z": 0.0},
                "projection": {"type": "orthographic"},
            },
        },
    )
    figure.update_layout(layout)
    return figure
