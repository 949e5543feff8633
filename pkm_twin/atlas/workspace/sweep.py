# SPDX-License-Identifier: Apache-2.0
"""Workspace sweep: reach, distance to a singularity and clearance over a grid of poses.

The grid is the pose's own: all coordinates of two or three, of more every pair of them with the
others at home. Reachable: the limits of actuators and of passive joints, limbs apart from each
other where the file tells their diameters, on the branch of the home pose. Regular, of poses that
lie about an axis: the largest circle about it at each height, and the largest upright cylinder
that fits into them.

May import: numpy, pkm_twin's core and the two packages above it; never rclpy.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas.grids import FULL, circles, largest_cylinder, workspace_box
from pkm_twin.atlas.sweep import FLAG, POSITIVE, SHARE, Chunk, Field, Sweep, Values, Variable
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

Array = NDArray[np.float64]

POINTS: Final = 200_000
CHUNK: Final = 32768
LONGEST: Final = 2001
"""Most poses along one coordinate."""
LAYERS: Final = 101
"""Heights of the regular workspace."""

SLICED: Final = ("slice", "row", "column")
"""Dimensions of an atlas of pairs of coordinates."""


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
        return SLICED if self.slices else self.robot.pose_names

    @property
    def fields(self) -> Mapping[str, Field]:  # type: ignore[override]
        """Reach, singularity measure, passive angle and clearance where the machine tells them."""
        fields = {
            "reachable": Field(
                self.dims, {**FLAG, "long_name": "1 where all limits are kept"}, "i1"
            ),
            "singularity": Field(
                self.dims,
                {
                    **SHARE,
                    "long_name": "distance to a singularity: 0 in one, 1 at best; reachable poses",
                },
            ),
        }
        if has_joint_angles(self.robot):
            fields["joint_angle"] = Field(
                self.dims,
                {
                    **POSITIVE,
                    "units": "rad",
                    "long_name": "largest passive joint angle; reachable poses",
                },
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
                {**POSITIVE, "units": units, "long_name": "volume of the reachable poses"},
            )
        if has_clearance(self.robot):
            share = (otherwise - count) / otherwise if otherwise else math.nan
            result["interference"] = Variable(
                (),
                np.array(share),
                {**SHARE, "long_name": "share of otherwise reachable poses where limbs meet"},
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
                ("height",),
                reach.radius,
                {**POSITIVE, "units": unit, "long_name": "largest circle, radius"},
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
