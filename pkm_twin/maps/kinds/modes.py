# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Map the six lowest natural frequencies, actuators locked, and store their mode shapes."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import import_extra
from pkm_twin.machine.graph import BASE
from pkm_twin.maps.kind import NON_NEGATIVE, UNIT_INTERVAL, Case, Space, Variable, describe
from pkm_twin.maps.kinds.frequency import Frequency
from pkm_twin.report import plots
from pkm_twin.robot.robot import Robot
from stiffness_monitor.modes import modes
from stiffness_monitor.structure import StructuralModel, structural_model

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from xarray import Dataset

MODE_COUNT: Final = 6
"""Number of modes of the map."""
MAX_DRAWN_DISPLACEMENT: Final = 0.13
"""Largest displacement of a drawn mode shape over the size of the machine."""
FRAMES_PER_SWING: Final = 16
"""Frames in one period of a mode's animation."""


class Modes(Frequency):
    """Map the six lowest natural frequencies, and store their mode shapes."""

    name = "modes"
    question = "how does it vibrate?"
    page_help = (
        "Below: the frame at rest (grey) and in a mode, magnified, at the map's worst pose; the button animates it."
    )

    def cases(self, robot: Robot) -> tuple[Case, ...]:
        """Return one case per mode, lowest first."""
        (first,) = super().cases(robot)
        numbers = range(1, MODE_COUNT + 1)
        return tuple(
            replace(
                first,
                name=f"mode {k}",
                what=f"frequency of mode {k}",
                answer="lowest frequency" if k == 1 else "frequency there",
            )
            for k in numbers
        )

    def summaries(self, space: Space, counted: int, separate: int) -> dict[str, Variable]:
        """Return the mode shapes at the planes' pose, their energy shares, and lines to draw."""
        pose, node, part = space.planes_pose(0), ("mode", "node", "space"), ("mode", "element")
        found = modes(space.robot, pose, len(space.cases))
        edges = structure_edges(structural_model(space.robot, space.robot.inverse(pose)), found.nodes)
        ends = {"valid_min": 0, "valid_max": len(found.nodes) - 1}
        what = "displacement of the nodes in a mode of unit generalised mass"
        share = {
            kind: describe(f"part of the mode's {kind} energy", "", UNIT_INTERVAL) for kind in ("strain", "kinetic")
        }
        return {
            "node": Variable(("node",), np.array(found.nodes, "U"), {}),
            "line": Variable(("edge", "end"), edges, describe("nodes that it joins", "", ends)),
            "position": Variable(("node", "space"), found.positions, describe("node at rest", "m")),
            "displacement": Variable(node, found.shapes[..., :3], describe(what, "1/sqrt(kg)")),
            "shape_frequency": Variable(("mode",), found.frequencies, describe("of the shape", "Hz", NON_NEGATIVE)),
            "strain_share": Variable(part, found.energies.strain, share["strain"]),
            "kinetic_share": Variable(part, found.energies.kinetic, share["kinetic"]),
        }

    @classmethod
    def figures(cls, data: Dataset) -> dict[str, Figure]:
        """Draw the shapes of the lowest modes, coloured by displacement."""
        from mpl_toolkits.mplot3d.art3d import Line3DCollection  # type: ignore[import-untyped]

        ax: Any  # of three dimensions
        figure, columns = plots.make_subplots(3, 1, 4.6, subplot_kw={"projection": "3d"})
        axes = [column[0] for column in columns]
        rest, edges = data.position.values, data.line.values
        low, high = _scene_bounds(rest)
        for mode, ax in enumerate(axes):
            moved, far = deform_nodes(data, mode)
            ax.add_collection3d(Line3DCollection(rest[edges], colors="0.7", linewidths=1.0))
            drawn = Line3DCollection(moved[edges], cmap="viridis", linewidths=2.2)
            drawn.set_array(far[edges].mean(1))
            drawn.set_clim(0.0, 1.0)
            ax.add_collection3d(drawn)
            ax.scatter(*rest[find_ground_nodes(data)].T, marker="s", s=14, color="0.3", depthshade=False)
            ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
            ax.set_box_aspect(high - low, zoom=0.95)
            ax.view_init(elev=18, azim=-58)
            ax.set_axis_off()
            ax.set_title("\n".join(_mode_title(data, mode)), fontsize=9)
        figure.colorbar(drawn, ax=axes, aspect=25, pad=0.01).set_label(
            "displacement over the mode's largest (dimensionless)", fontsize=9
        )
        plots.write_title(
            figure,
            f"{data.attrs['robot']}: lowest modes at the map's worst pose, actuators locked\n"
            "grey: at rest; coloured: deformed, magnified; named: the parts with most energy",
            10,
        )
        return {"shapes": figure}

    @classmethod
    def page(cls, data: Dataset) -> Any:
        """Return a figure of the frame at rest and in a mode, with menu and animation."""
        graph = import_extra("plotly.graph_objects", "maps")
        from pkm_twin.maps.page import CAMERA, COLOUR_BAR, MARGIN, MENU, make_button

        # All lines as one path, with -1 between lines that do not meet.
        rest, nodes = data.position.values, list[int]()
        for start, end in data.line.values.tolist():
            if not nodes or nodes[-1] != start:
                nodes += [-1, start] if nodes else [start]
            nodes.append(end)
        path = np.array(nodes)
        low, high = _scene_bounds(rest)
        still: dict[str, Any] = {"hoverinfo": "skip", "showlegend": False}
        figure = graph.Figure()
        grey, square = {"color": "#b0b0b0"}, {"symbol": "square", "size": 4, "color": "#444"}
        ground = _path_coordinates(rest, find_ground_nodes(data))
        figure.add_scatter3d(**_path_coordinates(rest, path), mode="lines", line=grey, **still)
        figure.add_scatter3d(**ground, mode="markers", marker=square, **still)
        names = ["" if k < 0 else str(data.node.values[k]) for k in path.tolist()]
        figure.add_scatter3d(mode="lines", text=names, hovertemplate="%{text}<extra></extra>", showlegend=False)
        buttons, frames = [], []
        for mode in range(data.sizes["mode"]):
            moved, far = deform_nodes(data, mode)
            line = {
                "color": _values_along_path(far, path, 0.0),
                "coloraxis": "coloraxis",
                "width": 7,
            }
            for n in range(FRAMES_PER_SWING):
                place = rest + math.cos(2 * math.pi * n / FRAMES_PER_SWING) * (moved - rest)
                shape = graph.Scatter3d(**_path_coordinates(place, path), line=line)
                frames.append(graph.Frame(name=f"{mode}/{n}", data=[shape], traces=[2]))
            head = _mode_title(data, mode)
            change = {axis: [values] for axis, values in _path_coordinates(moved, path).items()}
            change["line"] = [line]
            buttons.append(
                make_button(
                    "; ".join(head),
                    change,
                    {"updatemenus[1].buttons": _animation_buttons(mode)},
                    [2],
                )
            )
        figure.frames = frames
        first = buttons[0]["args"][0]
        figure.data[2].update({name: values[0] for name, values in first.items()})
        title = {"text": "displacement over the mode's largest", "side": "right"}
        figure.update_layout(
            coloraxis={"colorscale": "Viridis", "cmin": 0.0, "cmax": 1.0, "colorbar": {**COLOUR_BAR, "title": title}},
            scene={
                "aspectmode": "manual",
                "aspectratio": dict(zip("xyz", (1.3 * (high - low) / (high - low).max()).tolist(), strict=True)),
                "camera": {**CAMERA, "projection": {"type": "orthographic"}},
                **{
                    f"{axis}axis": {"title": f"{axis} (m)", "range": [a, b], "nticks": 6}
                    for axis, a, b in zip("xyz", low.tolist(), high.tolist(), strict=True)
                },
            },
            margin=MARGIN,
            uirevision="modes",
            updatemenus=[
                {"buttons": buttons, **MENU},
                {
                    "type": "buttons",
                    "direction": "left",
                    "showactive": False,
                    "buttons": _animation_buttons(0),
                    **MENU,
                    "x": 1.0,
                    "xanchor": "right",
                },
            ],
        )
        return figure


def deform_nodes(data: Dataset, mode: int) -> tuple[Array, Array]:
    """Return a mode's magnified nodes, (nodes, 3), m, and relative displacements, (nodes,).

    Displacements are relative to the largest of all nodes.

    :param mode: by index, 0 is the lowest.
    """
    rest, moved = data.position.values, data.displacement.values[mode]
    far = np.linalg.norm(moved, axis=1)
    scale = MAX_DRAWN_DISPLACEMENT * float(np.linalg.norm(np.ptp(rest, axis=0))) / far.max()
    return rest + scale * moved, far / far.max()


def find_ground_nodes(data: Dataset) -> NDArray[np.int64]:
    """Return the nodes on the ground, by index: the ends that only one line meets."""
    nodes, count = np.unique(data.line.values, return_counts=True)
    return np.asarray(nodes[count == 1], np.int64)


def _mode_title(data: Dataset, mode: int) -> list[str]:
    """Return a mode's number, its frequency, and the parts with most of its energy."""
    lines = [f"mode {mode + 1}: {float(data.shape_frequency[mode]):.4g} Hz"]
    for kind in ("strain", "kinetic"):
        shares = data[f"{kind}_share"].values[mode]
        order = np.argsort(-shares, kind="stable")[:3]
        parts = [f"{data.element.values[k]} {100 * shares[k]:.0f} %" for k in order if shares[k] >= 0.005]
        lines.append(f"{kind}: {', '.join(parts)}")
    return lines


def _scene_bounds(rest: Array) -> tuple[Array, Array]:
    """Return bounds of the scene for all modes, with a margin for the shapes."""
    margin = 0.6 * MAX_DRAWN_DISPLACEMENT * float(np.linalg.norm(np.ptp(rest, axis=0)))
    return rest.min(0) - margin, rest.max(0) + margin


def _values_along_path(values: Array, path: NDArray[np.int64], gap: float | None = None) -> list[Any]:
    """Return values (nodes,) along a path as a list, which can hold None in gaps."""
    return [gap if k < 0 else round(float(values[k]), 5) for k in path.tolist()]


def _path_coordinates(nodes: Array, path: NDArray[np.int64]) -> dict[str, Any]:
    """Return the coordinates of nodes (n, 3) along a path."""
    return {axis: _values_along_path(nodes[:, k], path) for k, axis in enumerate("xyz")}


def _animation_buttons(mode: int) -> list[dict[str, Any]]:
    """Return buttons that animate a mode for ten periods and stop it: plotly cannot loop."""
    names = [f"{mode}/{n % FRAMES_PER_SWING}" for n in range(10 * FRAMES_PER_SWING + 1)]
    timing = {"mode": "immediate", "transition": {"duration": 0}}
    swing = {**timing, "frame": {"duration": 60, "redraw": True}}
    hold = {**timing, "frame": {"duration": 0, "redraw": False}}
    return [
        {"label": "swing", "method": "animate", "args": [names, swing]},
        {"label": "hold", "method": "animate", "args": [[None], hold]},
    ]


def structure_edges(model: StructuralModel, nodes: tuple[str, ...]) -> NDArray[np.int64]:
    """Return pairs of nodes to draw lines between, shape (edges, 2).

    Lines go along the members, from a member's end to members attached to it, from the platform's
    origin to its points, and around these points.

    :param nodes: names as :func:`stiffness_monitor.modes.modes` gives them: the platform's origin,
        then ``<member> <k>/<elements>``.
    """
    members = model.members
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
    # Order the platform's points by angle in their plane.
    arms = np.array([point - model.origin for _, point in corners])
    across = np.linalg.svd(arms - arms.mean(0))[2][:2]
    turn = np.arctan2(*((arms - arms.mean(0)) @ across.T).T)
    around = [corners[k][0] for k in np.argsort(turn)]
    lines += [(0, node) for node in around]
    if len(around) > 2:
        lines += pairwise([*around, around[0]])
    return np.array(lines, np.int64)
