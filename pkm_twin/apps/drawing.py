# SPDX-License-Identifier: Apache-2.0
"""A robot at home as a drawing of its graph: bodies between their joints, rods, actuated joints."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas.plots import rendered
from pkm_twin.errors import ParameterError, PkmTwinError
from pkm_twin.files import replace_file
from pkm_twin.machine.graph import BASE, Graph
from pkm_twin.machine.outline import body_points, crosspieces, platform_face
from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]

PICTURES: Final = (".png", ".svg")
"""What a picture's name may end in."""
BODY: Final = "#7F7F7F"
ROD: Final = "#56B4E9"
PLATFORM: Final = "#D55E00"
GROUND: Final = "#000000"
DRIVE: Final = "#0072B2"
"""Colours that are told apart with every kind of colour vision (Okabe and Ito 2008)."""


def draw(robot: Robot, ax: Any = None) -> Any:
    """The robot at home on 3-D axes, those given or new ones; returns them.

    A body is lines from its joints' middle to each of them, the platform a face; a dot is a joint,
    an arrow an actuated one along its axis.
    """
    if ax is None:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot

        ax = pyplot.figure(figsize=(6, 6), layout="constrained").add_subplot(projection="3d")
    graph = robot.graph
    points = body_points(graph)
    for name, places in points.items():
        if name == BASE:
            ax.scatter(*np.array(places).T, color=GROUND, s=30, marker="s", label="base")
        elif name == graph.platform:
            _platform(ax, graph, np.array(places))
        else:
            _lines(ax, np.array([*places, *_only_com(graph, name, places)]), BODY, 3)
    for rod in graph.rods.values():
        for shift in (0.0,) if rod.pair is None else (-rod.width / 2, rod.width / 2):
            aside = shift * (np.zeros(3) if rod.pair is None else rod.pair)
            ax.plot(*(rod.ends + aside).T, color=ROD, linewidth=2)
    for bar in crosspieces(graph):
        colour = PLATFORM if bar.part == graph.platform else BODY
        ax.plot(*np.array([bar.start[1], bar.end[1]]).T, color=colour, linewidth=2)
    for joint in graph.joints.values():
        if joint.kind == "translation":
            continue
        ax.scatter(*joint.at, color=DRIVE if joint.actuated else BODY, s=14)
        if joint.actuated:
            ax.quiver(
                *joint.at, *joint.axes[0], length=0.15 * graph.size, color=DRIVE, normalize=True
            )
    _frame(ax, np.array([p for places in points.values() for p in places]), robot)
    return ax


def picture(robot: Robot, path: Path) -> None:
    """Draw a robot into a file.

    :raises PkmTwinError: the file cannot be written, or its name ends in something else.
    """
    if path.suffix not in PICTURES:
        # Another one would get an ending that nobody has asked for.
        raise ParameterError("picture", str(path), f"a name that ends in {' or '.join(PICTURES)}")
    figure = draw(robot).figure
    data = rendered(figure, 90, path.suffix[1:])
    try:
        replace_file(path, data)
    except OSError as error:
        raise PkmTwinError(f"{path} cannot be written: {error.strerror}") from None


def _only_com(graph: Graph, name: str, places: list[Array]) -> list[Array]:
    """The centre of mass of a body with one joint: else nothing of it could be seen."""
    return [graph.bodies[name].com] if len({tuple(p) for p in places}) == 1 else []


def _lines(ax: Any, places: Array, colour: str, width: float) -> None:
    """From the first to the second of two points, else from the middle to each."""
    if len(places) == 2:
        ax.plot(*places.T, color=colour, linewidth=width, solid_capstyle="round")
        return
    middle = places.mean(0)
    for place in places:
        ax.plot(*np.array([middle, place]).T, color=colour, linewidth=width)


def _platform(ax: Any, graph: Graph, places: Array) -> None:
    """A face around the joints of the platform where they span one, and lines in any case."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

    origin, joints = places[0], places[1:]
    corners = platform_face(graph)
    if len(corners):
        face = Poly3DCollection([corners], facecolor=PLATFORM, alpha=0.35, edgecolor=PLATFORM)
        ax.add_collection3d(face)
    else:
        _lines(ax, joints, PLATFORM, 3)
    for joint in joints:
        ax.plot(*np.array([origin, joint]).T, color=PLATFORM, linewidth=1, alpha=0.6)
    ax.scatter(*origin, color=PLATFORM, s=50, marker="*", label="reference point")


def _frame(ax: Any, points: Array, robot: Robot) -> None:
    """Equal scales around everything, names and units."""
    low, high = points.min(0), points.max(0)
    half = 0.55 * float((high - low).max())
    middle = (low + high) / 2
    for set_limits, centre in zip((ax.set_xlim, ax.set_ylim, ax.set_zlim), middle, strict=True):
        set_limits(centre - half, centre + half)
    ax.set_box_aspect((1, 1, 1))
    ax.locator_params(nbins=5)
    ax.set(xlabel="x, m", ylabel="y, m", title=f"{robot.name} at home")
    ax.set_zlabel("z, m", labelpad=3)
    ax.plot([], [], [], color=BODY, linewidth=3, label="bodies")
    if robot.graph.rods:
        ax.plot([], [], [], color=ROD, linewidth=2, label="rods")
    ax.plot([], [], [], color=DRIVE, marker=">", label="actuated joints, along their axes")
    ax.view_init(elev=20, azim=-60)
    ax.legend(loc="upper left", fontsize="small")
