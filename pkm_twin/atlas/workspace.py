# SPDX-License-Identifier: Apache-2.0
"""Workspace atlas: what a machine reaches, how far from a singularity, and the regular part.

The grid is the pose's own: height and two tilts, or x, y, z. Reachable: the limits of actuators
and of passive joints, limbs apart from each other where the file tells their diameters, on the
branch of the home pose. Regular: the largest circle about the axis at each height, and the
largest upright cylinder that fits into them.

May import: numpy, pkm_twin's core and the two packages above it; never rclpy.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas.grids import (
    circles,
    distance_unit,
    height_range,
    largest_cylinder,
    largest_distance,
    singularity,
    tilts,
)
from pkm_twin.atlas.sweep import Chunk, Field, Sweep, Values, Variable
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
