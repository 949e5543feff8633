# SPDX-License-Identifier: Apache-2.0
"""Modes sweep: natural frequencies over a cylinder, and the shapes of the modes at one pose.

The grid: heights, distances from the axis (tilts, for a machine that tilts) and azimuths.

The file also has the shapes of the modes at one pose, on the axis at the middle height, and the
lines of the frame to draw them on: a stored atlas is drawn without the robot.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas.grids import circles, cylinder, height_range, ladder, largest_cylinder, turns
from pkm_twin.atlas.sweep import POSITIVE, SHARE, Chunk, Field, Sweep, Values, Variable, about, axis
from pkm_twin.errors import ParameterError
from pkm_twin.machine.graph import BASE
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import distance_unit
from stiffness_monitor.modes import has_modes, modes, natural_frequencies
from stiffness_monitor.structure import StructuralModel, structural_model

Array = NDArray[np.float64]

POINTS: Final = 600
LAYERS: Final = 201
"""Heights of the circles that the largest cylinder is looked for in."""
COUNT: Final = 6
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
            (*_GRID, "mode"), about("natural frequency, actuators locked", "Hz", POSITIVE)
        )
    }

    @property
    def coordinates(self) -> dict[str, Variable]:
        """Height, distance from the axis, azimuth, number of the mode; names for the shapes."""
        what = "tilt" if distance_unit(self.robot) == "rad" else "distance from the axis"
        ends = {"valid_min": 0, "valid_max": len(self.nodes) - 1}
        return {
            "z": axis("z", self.heights, "height", "m"),
            "distance": axis("distance", self.distances, what, distance_unit(self.robot)),
            "azimuth": Variable(("azimuth",), turns(self.azimuths), {"units": "rad"}),
            "mode": axis("mode", np.arange(1, COUNT + 1), "lowest first"),
            "node": axis("node", self.nodes, "the platform's origin, then points of the members"),
            "axis": axis("axis", ("x", "y", "z"), "fixed axes"),
            "element": axis("element", self.elements, "bodies, and joints with elasticity"),
            "parameter": axis("parameter", self.robot.pose_names, "parameters of a pose"),
            "line": Variable(
                ("edge", "end"), self.edges, about("indices of the nodes that it joins", "", ends)
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
            "shape_pose": Variable(("parameter",), self.middle, about("pose of the shapes", units)),
            "shape_frequency": Variable(
                ("mode",), found.frequencies, about("frequency of the shape", "Hz", POSITIVE)
            ),
            "position": Variable(("node", "axis"), found.positions, about("node at rest", "m")),
            "displacement": Variable(node, moved, about(f"displacements {what}", "1/sqrt(kg)")),
            "rotation": Variable(node, turned, about(f"rotations {what}", "rad/(m sqrt(kg))")),
            "strain_share": Variable(
                part, found.energies.strain, about("part of the mode's strain energy", "", SHARE)
            ),
            "kinetic_share": Variable(
                part, found.energies.kinetic, about("part of the mode's kinetic energy", "", SHARE)
            ),
        }


def structure_edges(model: StructuralModel, nodes: tuple[str, ...]) -> NDArray[np.int64]:
    """Pairs of nodes to draw lines between, shape (edges, 2).

    Along the members; from a member's end to those that stand on it; the platform as spokes from
    its origin and the outline of the points where members meet it.

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
    # Around the platform by angle, in the plane of its points.
    arms = np.array([point - model.origin for _, point in corners])
    across = np.linalg.svd(arms - arms.mean(0))[2][:2]
    turn = np.arctan2(*((arms - arms.mean(0)) @ across.T).T)
    around = [corners[k][0] for k in np.argsort(turn)]
    lines += [(0, node) for node in around]
    if len(around) > 2:
        lines += pairwise([*around, around[0]])
    return np.array(lines, np.int64)


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
        raise ParameterError(
            "limits", robot.name, "limits that leave room for an inscribed cylinder"
        )
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
    edges = structure_edges(structural_model(robot, robot.inverse(pose)), found.nodes)
    return ModesSweep(
        robot,
        heights,
        ladder(step, rungs),
        azimuths,
        found.nodes,
        found.energies.elements,
        edges,
    )
