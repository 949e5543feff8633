# SPDX-License-Identifier: Apache-2.0
"""Workspace sweep: reach, singularity index and clearance over a grid of poses.

The grid is the pose's own: all coordinates of two or three, of more every pair of them with the
others at home. Reachable: the limits of actuators and of passive joints, limbs apart from each
other where the file tells their diameters, on the branch of the home pose. Regular, of poses that
lie about an axis: the largest circle about it at each height, and the largest upright cylinder
that fits into them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas.grids import circles, largest_cylinder
from pkm_twin.atlas.poses import PoseSweep, pose_axes
from pkm_twin.atlas.sweep import (
    FLAG,
    POSITIVE,
    SHARE,
    Chunk,
    Field,
    Values,
    Variable,
    about,
    axis,
    number,
)
from pkm_twin.errors import ParameterError
from pkm_twin.robot.clearance import clearance, has_clearance
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import (
    distance_unit,
    has_joint_angles,
    joint_angle_at,
    reachable,
    singularity_at,
)

Array = NDArray[np.float64]

POINTS: Final = 200_000
SINGULARITY: Final = "singularity index of reachable poses: 0 singular, 1 at best"
CLEARANCE: Final = (
    "least distance of different limbs' members, negative where they "
    "meet; poses that are reachable but for it"
)
LAYERS: Final = 101
"""Heights of the regular workspace."""


@dataclass(frozen=True, eq=False)
class WorkspaceSweep(PoseSweep):
    """Reach over a grid of poses."""

    kind: ClassVar[str] = "workspace"

    @property
    def upright(self) -> bool:
        """Whether the poses lie about an axis, with circles and a cylinder about it."""
        return not self.slices and self.robot.grid().kind == "cylinder"

    @property
    def fields(self) -> Mapping[str, Field]:  # type: ignore[override]
        """Reach, singularity measure, passive angle and clearance where the machine tells them."""
        fields = {
            "reachable": Field(self.dims, about("1 where all limits are kept", "", FLAG), "i1"),
            "singularity": Field(self.dims, about(SINGULARITY, "", SHARE)),
        }
        if has_joint_angles(self.robot):
            what = "largest passive joint angle; reachable poses"
            fields["joint_angle"] = Field(self.dims, about(what, "rad", POSITIVE))
        if has_clearance(self.robot):
            # Also where limbs meet, so that the file shows what interference takes away.
            fields["clearance"] = Field(self.dims, about(CLEARANCE, "m"))
        return fields

    @property
    def coordinates(self) -> dict[str, Variable]:
        """The pose coordinates, and of a cylinder the heights of the circles."""
        result = super().coordinates
        if self.upright:
            result["height"] = axis("height", self.heights, "height of the circles", "m")
        return result

    @property
    def heights(self) -> Array:
        """Heights of the circles, shape (n,), m."""
        ticks = self.axes[self.robot.pose_names.index(self.robot.grid().height)]
        return np.linspace(float(ticks[0]), float(ticks[-1]), LAYERS)

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
            what = "volume of the reachable poses"
            result["volume"] = number(count * math.prod(steps), what, units, POSITIVE)
        if has_clearance(self.robot):
            share = (otherwise - count) / otherwise if otherwise else math.nan
            what = "share of otherwise reachable poses where limbs meet"
            result["interference"] = number(share, what, "", SHARE)
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
        circle = about("largest circle, radius", unit, POSITIVE)
        return {
            "circle": Variable(("height",), reach.radius, circle),
            "cylinder_low": number(best.low, "largest cylinder, low", "m"),
            "cylinder_high": number(best.high, "largest cylinder, high", "m"),
            "cylinder_radius": number(best.radius, "largest cylinder, radius", unit),
        }


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

    :param points: poses of the grid, about; default 200,000. Others, and errors, as
        :func:`~pkm_twin.atlas.poses.pose_axes`.
    """
    total = POINTS if points is None else points
    if total < 1000:
        raise ParameterError("points", total, "1000 or more")
    axes = pose_axes(robot, total, least_singularity, least_clearance)
    return WorkspaceSweep(robot, axes, robot.home(), least_singularity, least_clearance)
