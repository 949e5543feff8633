# SPDX-License-Identifier: Apache-2.0
"""Modes atlas: the lowest natural frequencies over the regular workspace, actuators locked.

The grid: heights, distances from the axis (tilts, for a machine that tilts) and azimuths.

The file also has the shapes of the modes at one pose, on the axis at the middle height, and the
lines of the frame to draw them on: a stored atlas is drawn without the robot.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas import figures, pages
from pkm_twin.atlas.extras import require
from pkm_twin.atlas.grids import (
    circles,
    cylinder,
    height_range,
    ladder,
    largest_cylinder,
    turns,
)
from pkm_twin.atlas.sweep import Chunk, Field, Kind, Sweep, Values, Variable
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.workspace import distance_unit
from pkm_twin.machine.graph import BASE
from pkm_twin.machine.robot import Robot
from stiffness_monitor.modes import has_modes, modes, natural_frequencies
from stiffness_monitor.structure import Member, StructuralModel, structural_model

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from xarray import Dataset

Array = NDArray[np.float64]

POINTS: Final = 600
LAYERS: Final = 201
"""Heights of the circles that the largest cylinder is looked for in."""
COUNT: Final = 6
ENLARGED: Final = 0.13
"""Largest displacement of a drawn mode shape over the size of the machine."""
PHASES: Final = 24
"""Pictures in one swing of a mode."""
SWINGS: Final = 10
"""Swings that the button plays; plotly cannot repeat without end."""
_GRID: Final = ("z", "distance", "azimuth")


@dataclass(frozen=True, eq=False)
class ModesSweep(Sweep):
    """Frequencies at ``heights`` (n,), m, ``distances`` (m,), m or rad, and ``azimuths``.

    ``nodes``: names of the points whose motion in a mode is stored, and ``elements`` of the parts
    whose energy is, as :func:`stiffness_monitor.modes.modes` has them. ``edges``: pairs of nodes
    between which a line is drawn, shape (edges, 2).
    """

    heights: Array
    distances: Array
    azimuths: int
    nodes: tuple[str, ...]
    elements: tuple[str, ...]
    edges: NDArray[np.int64]

    kind: ClassVar[str] = "modes"
    fields: ClassVar[Mapping[str, Field]] = {
        "frequency": Field(
            (*_GRID, "mode"), {"units": "Hz", "long_name": "natural frequency, actuators locked"}
        )
    }

    @property
    def coordinates(self) -> dict[str, Variable]:
        """Height, distance from the axis, azimuth, number of the mode; names for the shapes."""
        what = "tilt" if distance_unit(self.robot) == "rad" else "distance from the axis"
        return {
            "z": Variable(("z",), self.heights, {"units": "m", "long_name": "height"}),
            "distance": Variable(
                ("distance",),
                self.distances,
                {"units": distance_unit(self.robot), "long_name": what},
            ),
            "azimuth": Variable(("azimuth",), turns(self.azimuths), {"units": "rad"}),
            "mode": Variable(("mode",), np.arange(1, COUNT + 1), {"long_name": "lowest first"}),
            "node": _names("node", self.nodes, "the platform's origin, then points of the members"),
            "axis": _names("axis", ("x", "y", "z"), "fixed axes"),
            "element": _names("element", self.elements, "bodies, and joints with elasticity"),
            "parameter": _names("parameter", self.robot.pose_names, "parameters of a pose"),
            "line": Variable(
                ("edge", "end"), self.edges, {"long_name": "indices of the nodes that it joins"}
            ),
        }

    @property
    def middle(self) -> Array:
        """The pose whose shapes are stored: on the axis at the middle height, shape (m,)."""
        return self.robot.grid().polar_pose(self.heights[len(self.heights) // 2], 0.0, 0.0)

    @property
    def settings(self) -> dict[str, Any]:
        """How many modes."""
        return {"modes": COUNT, "points": self.points}

    @property
    def rows_a_chunk(self) -> int:
        """Distances in one chunk."""
        return 1

    def count(self, chunk: Chunk) -> int:
        """Poses of one chunk."""
        return (chunk.stop - chunk.start) * self.azimuths

    def evaluate(self, chunk: Chunk) -> Values:
        """Frequencies of one ring, Hz."""
        distance = self.distances[chunk.start : chunk.stop, None]
        poses = self.robot.grid().polar_pose(
            self.heights[chunk.first], distance, turns(self.azimuths)
        )
        return {"frequency": natural_frequencies(self.robot, poses, COUNT)}

    def summaries(self, partial: Iterable[Values]) -> dict[str, Variable]:
        """The shapes of the modes in the middle pose, and where their energy is."""
        found = modes(self.robot, self.middle, COUNT)
        units = ", ".join(self.robot.pose_units)
        moved, turned = found.shapes[..., :3], found.shapes[..., 3:]
        node, part = ("mode", "node", "axis"), ("mode", "element")
        what = "of the nodes in a mode of unit generalised mass"
        return {
            **super().summaries(partial),
            "shape_pose": Variable(
                ("parameter",), self.middle, {"units": units, "long_name": "pose of the shapes"}
            ),
            "shape_frequency": Variable(
                ("mode",), found.frequencies, {"units": "Hz", "long_name": "frequency of the shape"}
            ),
            "position": Variable(
                ("node", "axis"), found.positions, {"units": "m", "long_name": "node at rest"}
            ),
            "displacement": Variable(
                node, moved, {"units": "1/sqrt(kg)", "long_name": f"displacements {what}"}
            ),
            "rotation": Variable(
                node, turned, {"units": "rad/(m sqrt(kg))", "long_name": f"rotations {what}"}
            ),
            "strain_share": Variable(
                part,
                found.energies.strain,
                {"units": "1", "long_name": "part of the mode's strain energy"},
            ),
            "kinetic_share": Variable(
                part,
                found.energies.kinetic,
                {"units": "1", "long_name": "part of the mode's kinetic energy"},
            ),
        }


def structure_edges(model: StructuralModel, nodes: tuple[str, ...]) -> NDArray[np.int64]:
    """Pairs of nodes to draw lines between, shape (edges, 2).

    Along the members; from a member's end to those that stand on it; the platform as spokes from
    its origin and the outline of the points where members meet it.

    :param nodes: names as :func:`stiffness_monitor.modes.modes` gives them: the platform's origin,
        then ``<member> <k>/<elements>``.
    """
    members = [part for part in model.parts if isinstance(part, Member)]
    of: dict[str, list[int]] = {member.name: [] for member in members}
    for index, name in enumerate(nodes[1:], start=1):
        of[name.rpartition(" ")[0]].append(index)
    lines: list[tuple[int, int]] = []
    corners: list[tuple[int, Array]] = []
    for member in members:
        own = of[member.name]
        lines += pairwise(own)
        for support, node, point in (
            (member.inner, own[0], member.start),
            (member.outer, own[-1], member.end),
        ):
            if support is None or support.body == BASE:
                continue
            if support.body == model.platform:
                corners.append((node, point))
            elif support.body in of:
                lines.append((of[support.body][-1], node))
    # Around the platform by angle, in the plane of its points.
    arms = np.array([point - model.origin for _, point in corners])
    across = np.linalg.svd(arms - arms.mean(0))[2][:2]
    turn = np.arctan2(*((arms - arms.mean(0)) @ across.T).T)
    around = [corners[k][0] for k in np.argsort(turn)]
    lines += [(0, node) for node in around]
    if len(around) > 2:
        lines += pairwise([*around, around[0]])
    return np.array(lines, np.int64)


def _names(dim: str, names: Iterable[str], what: str) -> Variable:
    return Variable((dim,), np.array(list(names)), {"long_name": what})


def modes_sweep(robot: Robot, points: int | None = None) -> ModesSweep:
    """The modes atlas of a robot, over the largest cylinder of its workspace.

    :param points: poses, about; default 600.
    :raises ParameterError: a robot without data for modes, or without a regular workspace.
    """
    if not has_modes(robot):
        raise ParameterError("robot", robot.name, "a robot whose file has data for modes")
    grid = cylinder(robot, "modes over it")
    total = POINTS if points is None else points
    if total < 50:
        raise ParameterError("points", total, "50 or more")
    # A little inside: on the edge rounding decides.
    best = largest_cylinder(circles(robot, np.linspace(*height_range(robot), LAYERS)))
    if best.radius == 0.0:
        raise ParameterError("limits", robot.name, "limits that leave a regular workspace")
    side = total ** (1 / 3)
    layers = max(3, 2 * round(side / 4) + 1)
    azimuths = 4 * max(2, round(side * 1.8 / 4))
    rungs = max(3, round(total / layers / azimuths))
    step = 0.999 * best.radius / (rungs - 1)
    if not math.isfinite(step):
        raise ParameterError("points", total, "enough for three rings")
    heights = np.linspace(best.low, best.high, layers)
    # Names and lines are the same in every pose: members keep their divisions.
    pose = grid.polar_pose(heights[layers // 2], 0.0, 0.0)
    found = modes(robot, pose, COUNT)
    edges = structure_edges(structural_model(robot, pose), found.nodes)
    return ModesSweep(
        robot,
        heights,
        ladder(step, rungs),
        azimuths,
        found.nodes,
        found.energies.elements,
        edges,
    )


# Figures


def frequency(
    atlas: Dataset, mode: int = 1, z: float | None = None, ax: Axes | None = None
) -> Axes:
    """One natural frequency across the axis at one height.

    :param mode: 1 is the lowest.
    :param z: m; the nearest height is drawn; default the middle one.
    """
    ax = figures.axes_or_new(ax)
    middle = float(atlas.z[atlas.sizes["z"] // 2])
    layer = atlas.frequency.sel(mode=mode).sel(z=middle if z is None else z, method="nearest")
    x, y, values, labels = across(atlas, layer.values)
    figures.contours(ax, x, y, values, "frequency (Hz)")
    ax.set_xlabel(labels[0])
    ax.set_ylabel(labels[1])
    ax.set_title(f"mode {mode}, z = {float(layer.z):.3f} m")
    return ax


def across(atlas: Dataset, values: Array) -> tuple[Array, Array, Array, tuple[str, str]]:
    """A field of a modes atlas in the plane across the axis: x, y, the field, and axes' labels.

    :param values: shape (distance, azimuth); of any unit.
    """
    distance, unit = figures.in_degrees(atlas.distance)
    turn, closed = figures.around(atlas.azimuth.values, values, 96)
    x, y = (distance[:, None] * f(turn) for f in (np.cos, np.sin))
    first, second = atlas.attrs["lateral"].split()
    if atlas.attrs["zero_torsion"] == "yes":
        labels = f"tilt towards azimuth 0° ({unit})", f"tilt towards azimuth 90° ({unit})"
        return x, y, closed, labels
    if unit == "deg":
        # As in the strain-energy pictures; azimuth 0 is towards the first.
        return y, x, closed, (f"{second} ({unit})", f"{first} ({unit})")
    return x, y, closed, (f"{first} ({unit})", f"{second} ({unit})")


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
    ax.set_xlabel("z (m)")
    ax.set_ylabel("frequency, least to greatest (Hz)")
    ax.set_ylim(bottom=0.0)
    ax.margins(x=0)
    ax.grid(alpha=0.3)
    # In the order of the lines: the highest mode on top.
    handles, labels = ax.get_legend_handles_labels()
    ax.legend(handles[::-1], labels[::-1], loc="center left", bbox_to_anchor=(1.0, 0.5))
    return ax


def deformed(atlas: Dataset, mode: int) -> tuple[Array, Array]:
    """Nodes of a mode shape, enlarged, and how far each moves; (nodes, 3), m, and (nodes,).

    The second is over the largest of all nodes.
    """
    rest = atlas.position.values
    moved = atlas.displacement.sel(mode=mode).values
    far = np.linalg.norm(moved, axis=1)
    scale = ENLARGED * float(np.linalg.norm(np.ptp(rest, axis=0))) / far.max()
    return rest + scale * moved, far / far.max()


def grounded(atlas: Dataset) -> NDArray[np.int64]:
    """Nodes on the ground, by index: the ends that one line alone meets."""
    nodes, lines = np.unique(atlas.line.values, return_counts=True)
    return np.asarray(nodes[lines == 1], np.int64)


def largest_shares(atlas: Dataset, mode: int, kind: str = "strain", most: int = 3) -> str:
    """Which parts hold most of a mode's energy, as text.

    :param kind: ``strain`` or ``kinetic``.
    """
    shares = atlas[f"{kind}_share"].sel(mode=mode).values
    order = np.argsort(-shares, kind="stable")[:most]
    names = atlas.element.values
    return ", ".join(f"{names[k]} {100 * shares[k]:.0f} %" for k in order if shares[k] >= 0.005)


def shape_pose(atlas: Dataset) -> str:
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
    figure, axes = figures.subplots(2, 3, figsize=(14.5, 8.2), layout="constrained")
    for mode, ax in zip(atlas.mode.values.tolist(), axes.ravel(), strict=False):
        frequency(atlas, mode, ax=ax)
    figure.suptitle(f"{atlas.attrs['robot']}: natural frequencies, actuators locked")
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
        2, 3, figsize=(12.5, 8), layout="constrained", subplot_kw={"projection": "3d"}
    )
    for mode, ax in zip(atlas.mode.values.tolist(), axes.ravel(), strict=False):
        mode_shape(atlas, mode, ax)
    colour = cm.ScalarMappable(colors.Normalize(0.0, 1.0), figures.MAP)
    bar = figure.colorbar(colour, ax=axes, shrink=0.6, aspect=30, pad=0.05)
    bar.set_label("displacement over the mode's largest (1)")
    figure.suptitle(
        f"{atlas.attrs['robot']} at {shape_pose(atlas)}: lowest modes, actuators locked\n"
        "grey: at rest; coloured: deformed, enlarged; below: the parts that hold most energy"
    )
    return figure


# Page


def title(atlas: Dataset) -> str:
    """What the page shows, in a line."""
    return f"Modes of {atlas.attrs['robot']}"


def page(atlas: Dataset) -> Any:
    """Mode shapes that swing, and the frequency over the workspace; a menu chooses the mode."""
    graph = require("plotly.graph_objects", "atlas")
    plots = require("plotly.subplots", "atlas")
    modes = atlas.mode.values.tolist()
    figure = plots.make_subplots(
        1, 2, specs=[[{"type": "scene"}, {"type": "scene"}]], horizontal_spacing=0.02
    )
    rest, path = atlas.position.values, _path(atlas.line.values)
    ground = grounded(atlas)
    still: dict[str, Any] = {"hoverinfo": "skip", "showlegend": False}
    figure.add_scatter3d(
        **_points(rest, path), mode="lines", line={"color": "#b0b0b0", "width": 3}, **still
    )
    figure.add_scatter3d(
        **_points(rest, ground),
        mode="markers",
        marker={"symbol": "square", "size": 4, "color": "#444444"},
        **still,
    )
    shapes = {mode: deformed(atlas, mode) for mode in modes}
    names = ["" if k < 0 else str(atlas.node.values[k]) for k in path.tolist()]
    figure.add_scatter3d(
        **_points(shapes[modes[0]][0], path),
        mode="lines",
        line={
            "color": _picked(shapes[modes[0]][1], path, 0.0),
            "coloraxis": "coloraxis",
            "width": 7,
        },
        text=names,
        hovertemplate="%{text}<extra></extra>",
        showlegend=False,
    )
    swinging = len(figure.data) - 1
    part = pages.thinned(atlas, {"z": 15, "distance": pages.MOST, "azimuth": 2 * pages.MOST})
    fields = {mode: part.frequency.sel(mode=mode).values for mode in modes}
    mesh, labels = _discs(part)
    shown = {mode: _vertices(part, values) for mode, values in fields.items()}
    # One mesh of triangles: surfaces would be worked out anew in every picture of a swing.
    figure.add_mesh3d(
        **mesh,
        intensity=shown[modes[0]],
        text=_hertz(shown[modes[0]]),
        coloraxis="coloraxis2",
        flatshading=True,
        lighting={"ambient": 1.0, "diffuse": 0.0, "specular": 0.0, "fresnel": 0.0},
        hovertemplate=f"{labels[0]} %{{x:.4~f}}<br>{labels[1]} %{{y:.4~f}}<br>z %{{z:.4~f}} m"
        "<br>frequency %{text}<extra></extra>",
        row=1,
        col=2,
    )
    phases = turns(PHASES)
    frames = []
    buttons = []
    for mode in modes:
        moved, far = shapes[mode]
        for n, phase in enumerate(phases.tolist()):
            place = rest + math.cos(phase) * (moved - rest)
            shape = graph.Scatter3d(**_points(place, path))
            frames.append(graph.Frame(name=f"{mode}/{n}", data=[shape], traces=[swinging]))
        hertz = float(atlas.shape_frequency.sel(mode=mode))
        # One call changes the shape, the discs, and which frames the slider and button play.
        data = {
            axis: [_picked(moved[:, k], path), pages.few(mesh[axis])]
            for k, axis in enumerate("xyz")
        }
        data["line.color"] = [_picked(far, path, 0.0), None]
        data["intensity"] = [None, pages.few(shown[mode])]
        data["text"] = [names, _hertz(shown[mode])]
        layout = {
            "sliders": [_phases(mode, phases)],
            "updatemenus[1].buttons": _players(mode),
            "annotations": _notes(atlas, mode),
            **pages.colours("frequency (Hz)", fields[mode], axis="coloraxis2"),
        }
        buttons.append(
            pages.button(f"mode {mode}: {hertz:.4g} Hz", data, layout, [swinging, swinging + 1])
        )
    figure.frames = frames
    size = float(ENLARGED * np.linalg.norm(np.ptp(rest, axis=0)))
    low, high = rest.min(0), rest.max(0)
    ranges = [[float(a) - size, float(b) + size] for a, b in zip(low, high, strict=True)]
    figure.update_layout(
        title=f"{title(atlas)}, actuators locked",
        coloraxis={
            "colorscale": "Viridis",
            "cmin": 0.0,
            "cmax": 1.0,
            "colorbar": {
                "title": {"text": "displacement over<br>the mode's largest (1)"},
                "x": 0.44,
                "len": 0.7,
                "thickness": 18,
            },
        },
        coloraxis2={"colorscale": "Viridis", "colorbar": {"x": 1.0, "len": 0.7, "thickness": 18}},
        scene={
            # Of the ranges, which are the same in all modes; "data" would follow the shape.
            "aspectmode": "manual",
            "aspectratio": pages.aspect(ranges, 1.1),
            "camera": {**pages.CAMERA, "projection": {"type": "orthographic"}},
            "domain": {"x": [0.0, 0.44], "y": [0.0, 1.0]},
            **{
                f"{axis}axis": {"title": f"{axis} (m)", "range": ends, "nticks": 7}
                for axis, ends in zip("xyz", ranges, strict=True)
            },
        },
        scene2={
            "aspectmode": "manual",
            "aspectratio": {"x": 1.0, "y": 1.0, "z": 1.2},
            "camera": {**pages.CAMERA, "projection": {"type": "orthographic"}},
            "domain": {"x": [0.54, 0.98], "y": [0.0, 1.0]},
            "xaxis_title": labels[0],
            "yaxis_title": labels[1],
            "zaxis_title": "z (m)",
        },
        margin={**pages.MARGIN, "t": 140},
        # The cameras stay where they were turned to.
        uirevision="modes",
        updatemenus=[
            {"buttons": buttons, **pages.MENU},
            {
                "type": "buttons",
                "direction": "left",
                "showactive": False,
                "buttons": _players(modes[0]),
                **pages.MENU,
                "x": 0.17,
            },
        ],
    )
    figure.update_layout(
        sliders=buttons[0]["args"][1]["sliders"], annotations=_notes(atlas, modes[0])
    )
    figure.update_layout(pages.colours("frequency (Hz)", fields[modes[0]], axis="coloraxis2"))
    return figure


def _discs(atlas: Dataset) -> tuple[dict[str, Any], tuple[str, str]]:
    """Discs of a modes atlas, one a height, as vertices and triangles, and names of x and y."""
    heights = atlas.z.values
    x, y, _, labels = across(atlas, atlas.frequency.values[0, :, :, 0])
    rings, turn = x.shape
    # Corners of the cells between two rings and two azimuths, two triangles each.
    first = np.add.outer(np.arange(rings - 1) * turn, np.arange(turn - 1)).ravel()
    halves = [first, first + 1, first + turn], [first + 1, first + turn + 1, first + turn]
    shift = np.arange(len(heights))[:, None] * x.size
    corners = [(shift + np.concatenate(c)).ravel() for c in zip(*halves, strict=True)]
    mesh = {
        "x": pages.short(np.tile(x.ravel(), len(heights))),
        "y": pages.short(np.tile(y.ravel(), len(heights))),
        "z": pages.short(np.repeat(heights, x.size)),
        **dict(zip("ijk", corners, strict=True)),
    }
    return mesh, labels


def _vertices(atlas: Dataset, values: Array) -> NDArray[np.float32]:
    """A field (z, distance, azimuth) of a modes atlas at the vertices of its discs."""
    return pages.short(np.concatenate([across(atlas, f)[2].ravel() for f in values]))


def _hertz(values: NDArray[Any]) -> list[str]:
    return [f"{value:.4g} Hz" for value in values.tolist()]


def _path(lines: NDArray[np.int64]) -> NDArray[np.int64]:
    """Lines (n, 2) one after the other, with -1 for a gap: lines that follow on are one."""
    path: list[int] = []
    for a, b in lines.tolist():
        if not path or path[-1] != a:
            path += [-1, a] if path else [a]
        path.append(b)
    return np.array(path, np.int64)


def _picked(values: Array, path: NDArray[np.int64], gap: float | None = None) -> list[float | None]:
    """Values (nodes,) along a path; a plain list, as only that can have None in its gaps."""
    return [gap if k < 0 else round(float(values[k]), 5) for k in path.tolist()]


def _points(nodes: Array, path: NDArray[np.int64]) -> dict[str, Any]:
    """Coordinates of nodes (n, 3) along a path."""
    return {axis: _picked(nodes[:, k], path) for k, axis in enumerate("xyz")}


def _phases(mode: int, phases: Array) -> dict[str, Any]:
    """A slider over the phases of a mode's swing."""
    still = {"mode": "immediate", "frame": {"duration": 0, "redraw": True}}
    steps = [
        {
            "label": f"{math.degrees(phase):.0f}",
            "method": "animate",
            "args": [[f"{mode}/{n}"], {**still, "transition": {"duration": 0}}],
        }
        for n, phase in enumerate(phases.tolist())
    ]
    return {**pages.slider(steps, "phase (deg): "), "len": 0.42, "x": 0.01}


def _players(mode: int) -> list[dict[str, Any]]:
    """Buttons that swing a mode and hold it."""
    names = [f"{mode}/{n % PHASES}" for n in range(SWINGS * PHASES + 1)]
    timing = {"mode": "immediate", "transition": {"duration": 0}}
    swing = {**timing, "frame": {"duration": 50, "redraw": True}}
    hold = {**timing, "frame": {"duration": 0, "redraw": False}}
    return [
        {"label": "swing", "method": "animate", "args": [names, swing]},
        {"label": "hold", "method": "animate", "args": [[None], hold]},
    ]


def _notes(atlas: Dataset, mode: int) -> list[dict[str, Any]]:
    """Heads of the two plots of a mode."""
    hertz = float(atlas.shape_frequency.sel(mode=mode))
    texts = (
        f"mode {mode}: {hertz:.4g} Hz at {shape_pose(atlas)}"
        f"<br>strain energy: {largest_shares(atlas, mode)}"
        f"<br>kinetic energy: {largest_shares(atlas, mode, 'kinetic')}",
        f"frequency of mode {mode} over the largest cylinder of the workspace",
    )
    return [
        {
            "text": text,
            "x": x,
            "y": 1.0,
            "xref": "paper",
            "yref": "paper",
            "xanchor": "center",
            "yanchor": "top",
            "showarrow": False,
        }
        for text, x in zip(texts, (0.22, 0.76), strict=True)
    ]


KIND: Final = Kind(
    "modes",
    figures={"plane": _frequency_plane, "range": _frequency_range, "shapes": _mode_shapes},
    page=page,
    title=title,
    help="Left: the frame at rest (grey) and in the chosen mode, enlarged; squares stand on the "
    "ground. The button swings it, the slider stops it. Right: the mode's frequency at places of "
    "the workspace; modes are numbered at each place, lowest first.",
)
