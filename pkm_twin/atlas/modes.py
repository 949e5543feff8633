# SPDX-License-Identifier: Apache-2.0
"""Modes atlas: the lowest natural frequencies over the regular workspace, actuators locked.

The grid: heights, distances from the axis (tilts, for a machine that tilts) and azimuths. Places
beyond a height's circle are left out (NaN).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas.grids import (
    circles,
    distance_unit,
    height_range,
    ladder,
    largest_cylinder,
    polar_pose,
    turns,
)
from pkm_twin.atlas.sweep import Chunk, Field, Sweep, Values, Variable
from pkm_twin.errors import ParameterError
from pkm_twin.mechanisms.robot import Robot
from stiffness_monitor.modes import has_modes, natural_frequencies

Array = NDArray[np.float64]

POINTS: Final = 600
COUNT: Final = 6
_GRID: Final = ("z", "distance", "azimuth")


@dataclass(frozen=True, eq=False)
class ModesSweep(Sweep):
    """Frequencies at ``heights`` (n,), m, ``distances`` (m,), m or rad, and ``azimuths``."""

    heights: Array
    distances: Array
    azimuths: int

    kind: ClassVar[str] = "modes"
    fields: ClassVar[Mapping[str, Field]] = {
        "frequency": Field(
            (*_GRID, "mode"), {"units": "Hz", "long_name": "natural frequency, actuators locked"}
        )
    }

    @property
    def coordinates(self) -> dict[str, Variable]:
        """Height, distance from the axis, azimuth, and the number of the mode."""
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
        }

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
        poses = polar_pose(self.robot, self.heights[chunk.first], distance, turns(self.azimuths))
        return {"frequency": natural_frequencies(self.robot, poses, COUNT)}


def modes_sweep(robot: Robot, points: int | None = None) -> ModesSweep:
    """The modes atlas of a robot, over the largest cylinder of its workspace.

    :param points: poses, about; default 600.
    :raises ParameterError: a robot without data for modes, or without a regular workspace.
    """
    if not has_modes(robot):
        raise ParameterError("robot", robot.name, "a robot whose file has data for modes")
    total = POINTS if points is None else points
    if total < 50:
        raise ParameterError("points", total, "50 or more")
    # A little inside: on the edge rounding decides.
    best = largest_cylinder(circles(robot, np.linspace(*height_range(robot), 201)))
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
    return ModesSweep(robot, heights, ladder(step, rungs), azimuths)
