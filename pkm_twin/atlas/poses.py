# SPDX-License-Identifier: Apache-2.0
"""A grid of poses over all that a machine reaches, and which of them count.

All coordinates of two or three; of more every pair of them, with the others at home.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas.grids import FULL, workspace_box
from pkm_twin.atlas.sweep import Chunk, Sweep, Variable, about, axis
from pkm_twin.errors import ParameterError
from pkm_twin.robot.clearance import has_clearance
from pkm_twin.robot.robot import Robot

Array = NDArray[np.float64]

CHUNK: Final = 32768
"""Poses in one chunk, about."""
LONGEST: Final = 2001
"""Most poses along one coordinate."""
SLICED: Final = ("slice", "row", "column")
"""Dimensions of an atlas of pairs of coordinates."""


@dataclass(frozen=True, eq=False)
class PoseSweep(Sweep):
    """A grid of poses; ``axes``: ticks of the m pose coordinates, m and rad.

    ``home``: the pose (m,) whose coordinates stand for those that a slice does not show.
    ``least``: singularity measure below which a pose counts as out of reach. ``least_clearance``:
    distance of members of different limbs, m, that is too little; where it is not known, nothing.
    """

    axes: tuple[Array, ...]
    home: Array
    least: float
    least_clearance: float = 0.0

    @property
    def slices(self) -> list[tuple[int, ...]]:
        """Coordinates that each slice goes over, by index; empty where the grid is whole."""
        count = len(self.axes)
        if 1 < count <= FULL:
            return []
        return list(itertools.combinations(range(count), 2)) or [(0,)]

    @property
    def dims(self) -> tuple[str, ...]:
        """Dimensions of the fields."""
        return SLICED if self.slices else self.robot.pose_names

    @property
    def coordinates(self) -> dict[str, Variable]:
        """The pose coordinates, and home, which the sections of a picture go through."""
        robot = self.robot
        if self.slices:
            return self._sliced_coordinates()
        ticks = {
            name: axis(name, ticks, f"pose coordinate {name}", unit)
            for name, unit, ticks in zip(robot.pose_names, robot.pose_units, self.axes, strict=True)
        }
        return ticks | self._home()

    def _sliced_coordinates(self) -> dict[str, Variable]:
        """What each slice's rows and columns are, and the pose of the others."""
        names, units = self.robot.pose_names, self.robot.pose_units
        rows = [s[0] for s in self.slices]
        # Of a single coordinate there is one column, at home, which is that coordinate's own.
        columns = [s[-1] for s in self.slices]
        result = {
            "slice": texts("slice", [" by ".join(names[k] for k in s) for s in self.slices]),
            "unit": texts("coordinate", units),
            **self._home(),
        }
        for dim, picked in (("row", rows), ("column", columns)):
            ticks = [self.axes[k] for k in picked]
            if dim == "column" and len(names) == 1:
                ticks = [self.home]
            result[f"{dim}_name"] = texts("slice", [names[k] for k in picked])
            result[f"{dim}_unit"] = texts("slice", [units[k] for k in picked])
            along = about(f"coordinate along the {dim}s")
            result[f"{dim}_value"] = Variable(("slice", dim), np.array(ticks), along)
        return result

    def _home(self) -> dict[str, Variable]:
        return {
            "coordinate": texts("coordinate", self.robot.pose_names),
            "home": Variable(("coordinate",), self.home, about("pose that sections go through")),
        }

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
    def poses_a_chunk(self) -> int:
        """Poses in one chunk, about."""
        return CHUNK

    @property
    def rows_a_chunk(self) -> int:
        """Ticks of the second dimension in one chunk."""
        return max(1, self.poses_a_chunk // self._across)

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


def texts(dim: str, words: Iterable[str]) -> Variable:
    """A coordinate of names."""
    return Variable((dim,), np.array(list(words), "U"), {})


def pose_axes(robot: Robot, points: int, least: float, least_clearance: float) -> tuple[Array, ...]:
    """Ticks of the pose coordinates, over a box around all that a robot reaches.

    :param points: poses of the grid, about.
    :param least: singularity measure below which a pose counts as out of reach.
    :param least_clearance: distance of members of different limbs, m, that is too little; zero
        is no bound for a robot whose file does not give their diameters.
    :raises ParameterError: no limits where the workspace has no end without, no reach at all, or a
        bound on a clearance that is not known.
    """
    if not 0.0 <= least < 1.0:
        raise ParameterError("least_singularity", least, "0 to below 1")
    if not 0.0 <= least_clearance < math.inf:
        raise ParameterError("least_clearance", least_clearance, "0 or more, m")
    if least_clearance > 0.0 and not has_clearance(robot):
        raise ParameterError(
            "least_clearance", least_clearance, "0: the file does not give the members' diameters"
        )
    box = workspace_box(robot)
    count = len(box)
    if count <= FULL:
        side = max(5, min(round(points ** (1 / count)), LONGEST))
    else:
        side = max(5, round(math.sqrt(points / math.comb(count, 2))))
    # Odd across the axis, so that the axis is on the grid.
    odd = side + 1 - side % 2
    lateral = robot.grid().lateral
    return tuple(
        np.linspace(low, high, odd if name in lateral else side)
        for (low, high), name in zip(box, robot.pose_names, strict=True)
    )
