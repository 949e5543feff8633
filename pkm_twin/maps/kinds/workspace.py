# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Map reach, singularities, limb interference, and the largest cylinder in the workspace."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.maps.kind import (
    NON_NEGATIVE,
    UNIT_INTERVAL,
    Case,
    Found,
    Kind,
    Space,
    Variable,
    describe,
    scalar,
)
from pkm_twin.robot.clearance import has_clearance, member_gaps, member_pairs
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import (
    MIN_WORKSPACE_INDEX,
    compute_circle_radii,
    has_passive_joint_limits,
    joint_angle_at,
    workspace_radius_unit,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from xarray import Dataset

SINGULARITY: Final = Case("singularity", "singularity index", "", "least singularity index", largest=False)
CLEARANCE: Final = Case("clearance", "clearance of the limbs", "m", "limbs nearest", False, interfering=True)
ANGLE: Final = Case("joint-angle", "largest passive joint angle", "rad", "bends most")
LAYERS: Final = 101
"""Number of heights of the circles."""
OVERLAY_CAPTION: Final = "; white lines: largest circles; dashed: largest cylinder"


class Workspace(Kind):
    """Map reach, singularities, limb interference, and the largest inscribed cylinder."""

    name = "workspace"
    question = "where can it move?"
    least = 0.0
    signed = True
    facts_first = True
    points = 200_000
    element = "members that are nearest"

    def elements(self, robot: Robot) -> tuple[str, ...]:
        """Return the names of pairs of members of different limbs."""
        return tuple(f"{a.name} and {b.name}" for a, b in member_pairs(robot))

    def cases(self, robot: Robot) -> tuple[Case, ...]:
        """Return singularity index, and clearance and passive angle if the file gives them."""
        known = (True, has_clearance(robot), has_passive_joint_limits(robot))
        cases = (SINGULARITY, CLEARANCE, ANGLE)
        return tuple(case for case, there in zip(cases, known, strict=True) if there)

    def axes(self, robot: Robot) -> tuple[str, ...]:
        """Return no axes: distances and angles have no direction."""
        return ()

    def found(self, robot: Robot, q: Array, case: Case) -> Found:
        """Return one number per pose; for the clearance also the nearest pair of members."""
        if case == SINGULARITY:
            return Found(robot.try_singularity(q)[0])
        if case == CLEARANCE:
            gaps = member_gaps(robot, q, refuse=False)
            return Found(gaps.min(-1), element=gaps.argmin(-1))
        return Found(joint_angle_at(robot, robot.forward(q)))

    def summaries(self, space: Space, counted: int, separate: int) -> dict[str, Variable]:
        """Return volume, interference, and circles and cylinder of a workspace with an axis."""
        robot, result = space.robot, {}
        if len(space.ticks) == len(robot.pose_names):
            cell = math.prod(float(ticks[1] - ticks[0]) for ticks in space.ticks)
            what = "volume of the reachable poses"
            counts = {unit: robot.pose_units.count(unit) for unit in sorted(set(robot.pose_units))}
            # As "m3", "m rad2".
            unit = " ".join(f"{unit}{power if power > 1 else ''}" for unit, power in counts.items())
            result["volume"] = scalar(separate * cell, what, unit, NON_NEGATIVE)
        if has_clearance(robot):
            share = (counted - separate) / counted if counted else math.nan
            what = "share of otherwise reachable poses in which limbs interfere"
            result["interference"] = scalar(share, what, "", UNIT_INTERVAL)
        if space.ticks and robot.grid().kind == "cylinder":
            low, high = space.ticks[robot.pose_names.index(robot.grid().height)][[0, -1]]
            heights = np.linspace(low, high, LAYERS)
            radius = find_circle_radii(robot, heights, least=space.least, least_clearance=space.least_clearance)
            best, unit = find_largest_cylinder(heights, radius), workspace_radius_unit(robot)
            result |= make_circle_variables(robot, heights, radius) | {
                "cylinder_low": scalar(best.low, "largest cylinder, low", "m"),
                "cylinder_high": scalar(best.high, "largest cylinder, high", "m"),
                "cylinder_radius": scalar(best.radius, "largest cylinder, radius", unit),
            }
        return result

    @classmethod
    def facts(cls, data: Dataset) -> list[str]:
        """Return sentences on the reachable volume and the cylinder."""
        facts = []
        if "volume" in data:
            names = [str(name) for name in data.coordinate.values]
            counted = np.isfinite(data.value.values).any(-1)
            extents = []
            for k, name in enumerate(names):
                others = tuple(axis for axis in range(len(names)) if axis != k)
                ends = data[name].values[counted.any(others)]
                extents.append(f"{name} {ends.min():.3g} to {ends.max():.3g}")
            what = {1: "range", 2: "area", 3: "volume"}.get(len(names), "measure")
            facts.append(
                f"{what} of the reachable {', '.join(names)}: {float(data.volume):.4g} "
                f"{data.volume.attrs['units']}; {', '.join(extents)}"
            )
        else:
            of = "joint states within limits" if "sample" in data.sizes else "the poses tried"
            facts.append(f"reaches {100 * float(data.valid):.3g} % of {of}")
        if "interference" in data and (lost := float(data.interference)) > 0.0:
            facts.append(f"limbs interfere in {100 * lost:.3g} % of otherwise reachable poses")
        if "cylinder_radius" in data and (radius := float(data.cylinder_radius)) > 0.0:
            wide = f"{radius:.3f} {data.cylinder_radius.attrs['units']}"
            low, high = float(data.cylinder_low), float(data.cylinder_high)
            name = data.attrs["height"]
            facts.append(f"largest cylinder: {name} {low:.3f} to {high:.3f} m, radius {wide}")
        return facts

    @classmethod
    def overlay(cls, data: Dataset, names: tuple[str, ...], through: Mapping[str, float], ax: Axes) -> str:
        """Draw the circles about the axis and the cylinder, as a plane cuts them."""
        if "circle" not in data or len(names) != 2:
            return ""
        height = data.attrs["height"]
        apart = math.hypot(*(v for name, v in through.items() if name not in (*names, height)))
        radii = np.array([float(data.cylinder_radius), *data.circle.values])
        cut = np.sqrt(np.maximum(radii**2 - apart**2, 0.0))
        radius = float(cut[0])
        low, high = float(data.cylinder_low), float(data.cylinder_high)
        if height not in names:
            if low <= through[height] <= high:
                turn = np.linspace(0.0, 2 * np.pi, 181)
                ax.plot(radius * np.cos(turn), radius * np.sin(turn), "--", color="white", lw=1.2)
            return OVERLAY_CAPTION
        outline = [radius, radius, -radius, -radius, radius], [low, high, high, low, low]
        circle = np.where(cut[1:] > 0.0, cut[1:], np.nan)
        sides = np.concatenate([circle, [np.nan], -circle])
        heights = np.concatenate([data.height.values, [np.nan], data.height.values])
        for style, (x, y) in (("-", (sides, heights)), ("--", outline)):
            ax.plot(*((x, y) if names[1] == height else (y, x)), style, color="white", lw=1.2)
        return OVERLAY_CAPTION


def make_circle_variables(robot: Robot, heights: Array, radius: Array) -> dict[str, Variable]:
    """Return circles about the axis at heights (n,), m, of radii (n,), for a file."""
    what = describe("largest circle, radius", workspace_radius_unit(robot), NON_NEGATIVE)
    return {
        "height": Variable(("height",), heights, describe("height of the circles", "m")),
        "circle": Variable(("height",), radius, what),
    }


def find_circle_radii(
    robot: Robot,
    heights: ArrayLike,
    steps: int = 340,
    least: float = 0.0,
    least_clearance: float = 0.0,
) -> Array:
    """Return radii of the largest reachable circles about the axis, insides included, (n,).

    Radii are in m or rad, 0 where the axis itself is out of reach.

    :param heights: shape (n,), m.
    :param steps: first search along each of 360 rays; a bisection refines it.
    :param least: singularity index below which a pose counts as out of reach; ``MIN_WORKSPACE_INDEX`` at least.
    :param least_clearance: smallest clearance of the limbs, m.
    """
    z = np.atleast_1d(np.asarray(heights, np.float64))
    lateral = [robot.pose_names.index(name) for name in robot.grid().lateral]
    step = float(np.abs(robot.search_box()[lateral]).max()) / steps
    return compute_circle_radii(
        robot, z, step, steps, least=max(least, MIN_WORKSPACE_INDEX), least_clearance=least_clearance
    )


@dataclass(frozen=True)
class Cylinder:
    """Describe the largest upright cylinder about the axis in a stack of circles.

    Heights in m, radius in m or rad.
    """

    low: float
    high: float
    radius: float


def find_largest_cylinder(heights: Array, radius: Array) -> Cylinder:
    """Return the cylinder of largest radius squared times height between two heights (n,)."""
    best, volume = Cylinder(math.nan, math.nan, 0.0), 0.0
    for i in range(len(heights)):
        thin = np.minimum.accumulate(radius[i:])
        volumes: NDArray[np.float64] = thin**2 * (heights[i:] - heights[i])
        j = int(volumes.argmax())
        if volumes[j] > volume:
            volume = float(volumes[j])
            best = Cylinder(float(heights[i]), float(heights[i + j]), float(thin[j]))
    return best
