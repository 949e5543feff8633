# SPDX-License-Identifier: Apache-2.0
"""Isotropy sweep: two indices over all directions of the pose rates, on a grid of poses.

The indices of delta_dynamics/isotropy.py, eta_KE and F_max, over unit vectors of three pose rates.
A machine that tilts stands on a polar grid of azimuth and tilt (3-PRRU paper, section 5), others on
a grid of two coordinates: of those across the axis, or of the first two.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from delta_dynamics.isotropy import (
    ENERGY,
    STRETCHED,
    energy_matrices,
    energy_transfer_range,
    max_driving_force,
)
from pkm_twin.atlas.grids import circles, ladder, turns, workspace_box
from pkm_twin.atlas.sweep import (
    FLAG,
    POSITIVE,
    SHARE,
    Chunk,
    Field,
    Sweep,
    Values,
    Variable,
    about,
    axis,
)
from pkm_twin.errors import ParameterError
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import distance_unit, reachable, singularity_at, try_inverse

Array = NDArray[np.float64]

POINTS: Final = 48_000
TILT: Final = math.radians(45.0)
"""Largest tilt of the paper's atlas, rad."""
CHUNK: Final = 16384
SINGULARITY: Final = "singularity index: 0 in a singularity, 1 at best"
WITHIN: Final = "1 where the pose keeps all limits of the machine"

_SPHERE: Final = ("polar", "turn")


@dataclass(frozen=True, eq=False)
class IsotropySweep(Sweep):
    """Spheres of eta_KE and F_max over a grid of poses at one height.

    ``first`` and ``second``: the grid's axes: two coordinates, or azimuth and tilt (rad). ``polar``
    angles from the direction's third axis, ``turn`` angles about it, from the first, rad.
    ``beyond``: also poses beyond the limits; else they are NaN.
    """

    height: float
    energy: float
    first: Array
    second: Array
    polar: Array
    turn: Array
    beyond: bool

    kind: ClassVar[str] = "isotropy"

    @property
    def axes(self) -> tuple[str, str]:
        """Names of the grid's axes."""
        return ("azimuth", "tilt") if tilting(self.robot) else plane_of(self.robot)[:2]

    @property
    def fields(self) -> Mapping[str, Field]:  # type: ignore[override]
        """Indices on the spheres, and the exact range of eta_KE at each pose."""
        unit = self.robot.effort_unit
        sphere = (*self.axes, *_SPHERE)
        share = "eta_KE, the platform's part of the kinetic energy"
        return {
            "eta": Field(sphere, about(share, bounds=SHARE)),
            "force": Field(sphere, about("F_max, largest driving force", unit, POSITIVE)),
            "eta_least": Field(self.axes, about(f"least {share}, exact", bounds=SHARE)),
            "eta_greatest": Field(self.axes, about(f"greatest {share}, exact", bounds=SHARE)),
            "singularity": Field(self.axes, about(SINGULARITY, bounds=SHARE)),
            "within_limits": Field(self.axes, about(WITHIN, bounds=FLAG), "i1"),
        }

    @property
    def coordinates(self) -> dict[str, Variable]:
        """The grid's axes, and the angles of the directions."""
        rates = [f"d{name}/dt" for name in self.robot.pose_names]
        units = dict(zip(self.robot.pose_names, self.robot.pose_units, strict=True))
        what = {
            "azimuth": "direction that the platform leans to",
            "tilt": "lean of the platform's axis, no torsion",
        }
        result = {
            name: axis(
                name, values, what.get(name, f"pose coordinate {name}"), units.get(name, "rad")
            )
            for name, values in zip(self.axes, (self.first, self.second), strict=True)
        }
        turn = f"about {rates[2]}, from {rates[0]} to {rates[1]}"
        return result | {
            "polar": axis("polar", self.polar, f"angle from {rates[2]}", "rad"),
            "turn": axis("turn", self.turn, turn, "rad"),
        }

    @property
    def directions(self) -> Array:
        """Unit vectors of pose rates, shape (polar, turn, 3)."""
        return unit_vectors(self.polar, self.turn)

    @property
    def settings(self) -> dict[str, Any]:
        """Height of the poses, m or rad, the platform's energy, J, and what is left out."""
        return {
            "height": self.height,
            "height_name": plane_of(self.robot)[2],
            "energy": self.energy,
            "beyond_limits": self.beyond,
            "points": self.points,
        }

    @property
    def rows_a_chunk(self) -> int:
        """Poses in one chunk."""
        return max(1, CHUNK // (len(self.polar) * len(self.turn)))

    def count(self, chunk: Chunk) -> int:
        """Directions at all poses of a chunk."""
        return (chunk.stop - chunk.start) * len(self.polar) * len(self.turn)

    def poses(self, chunk: Chunk) -> Array:
        """Poses of a chunk, shape (rows, 3)."""
        second = self.second[chunk.start : chunk.stop]
        if tilting(self.robot):
            return self.robot.grid().polar_pose(self.height, second, self.first[chunk.first])
        poses = np.empty((len(second), 3))
        where = [self.robot.pose_names.index(name) for name in plane_of(self.robot)]
        for k, values in zip(where, (self.first[chunk.first], second, self.height), strict=True):
            poses[:, k] = values
        return poses

    def evaluate(self, chunk: Chunk) -> Values:
        """Indices at the poses; NaN where a pose is out of reach, beyond limits, or singular."""
        robot, poses = self.robot, self.poses(chunk)
        measure = singularity_at(robot, poses)
        _, good = try_inverse(robot, poses)
        good &= measure > STRETCHED
        within = reachable(robot, poses)
        if not self.beyond:
            good &= within
        if robot.grid().kind == "cylinder" and not tilting(robot):
            # Places outside the circle that the limits of the actuators leave.
            out = np.hypot(self.first[chunk.first], self.second[chunk.start : chunk.stop])
            good &= out <= self.second[-1] * (1 + 1e-9)
        shape = (len(poses), len(self.polar), len(self.turn))
        values = {
            "eta": np.full(shape, np.nan),
            "force": np.full(shape, np.nan),
            "eta_least": np.full(len(poses), np.nan),
            "eta_greatest": np.full(len(poses), np.nan),
            "singularity": np.where(good, measure, np.nan),
            "within_limits": within.astype(np.int8),
        }
        if good.any():
            kept, x = poses[good], self.directions
            values["eta"][good] = _share(robot, kept, x)
            values["force"][good] = max_driving_force(robot, kept[:, None, None, :], x, self.energy)
            ends = energy_transfer_range(robot, kept)
            values["eta_least"][good], values["eta_greatest"][good] = ends.least, ends.greatest
        return values


def _share(robot: Robot, poses: Array, x: Array) -> Array:
    """eta_KE at poses (n, 3) over directions (..., 3), shape (n, ...)."""
    platform, everything = energy_matrices(robot, poses)
    forms = [np.einsum("...i,nij,...j->n...", x, form, x) for form in (platform, everything)]
    return np.asarray(forms[0] / forms[1], np.float64)


def unit_vectors(polar: Array, turn: Array) -> Array:
    """Directions of spherical angles, shape (polar, turn, 3)."""
    theta, phi = np.meshgrid(polar, turn, indexing="ij")
    out = np.sin(theta)
    return np.stack([out * np.cos(phi), out * np.sin(phi), np.cos(theta)], -1)


def isotropy_sweep(
    robot: Robot,
    points: int | None = None,
    *,
    height: float | None = None,
    energy: float = ENERGY,
    tilt: float = TILT,
    beyond_limits: bool = True,
) -> IsotropySweep:
    """The isotropy atlas of a robot.

    :param points: poses times directions, about; the grid is 12 azimuths by 4 tilts (and the
        upright pose), or 9 by 9 places, unless the spheres then had over 5,000 directions.
    :param height: of the poses, m; default the home pose's. For a robot without an axis the third
        pose coordinate, m or rad.
    :param energy: kinetic energy E_M of the platform for F_max, J.
    :param tilt: largest tilt, rad.
    :param beyond_limits: also poses beyond the limits, which the file marks; else NaN there.
    :raises ParameterError: a robot without masses, or whose directions make no sphere.
    """
    robot.massive()
    if len(robot.pose_names) != 3:
        raise ParameterError("pose", list(robot.pose_names), "three pose coordinates, for spheres")
    if points is not None and points < 1000:
        raise ParameterError("points", points, "1000 or more")
    if not 0.0 < energy < math.inf:
        raise ParameterError("energy", energy, "above zero, J")
    if height is not None and not math.isfinite(height):
        raise ParameterError("height", height, "a finite number, m")
    if not 0.0 < tilt < math.pi / 2:
        raise ParameterError("tilt", tilt, "between 0 and a right angle, rad")
    total = points or POINTS
    names = plane_of(robot)
    home = float(robot.home()[robot.pose_names.index(names[2])])
    z = home if height is None else height
    finer = max(1.0, math.sqrt(total / (60 * 5000)))
    if tilting(robot):
        azimuths, rungs = 12 * round(finer), 4 * round(finer)
        first = turns(azimuths)
        second = ladder(tilt / rungs, rungs + 1)
    elif robot.grid().kind == "box":
        box = workspace_box(robot)
        low, high = box[robot.pose_names.index(names[2])]
        if not low <= z <= high:
            raise ParameterError("height", z, f"{low:.3g} to {high:.3g}, where the robot reaches")
        side = 8 * round(finer) + 1
        first, second = (
            np.linspace(float(a), float(b), side)
            for a, b in (box[robot.pose_names.index(name)] for name in names[:2])
        )
    else:
        side = 8 * round(finer) + 1
        radius = float(circles(robot, [z]).radius[0])
        if radius == 0.0:
            raise ParameterError("height", z, "a height that the robot reaches, m")
        first = second = radius * np.linspace(-1.0, 1.0, side)
    # An even number of turns and of polar steps: each direction has its opposite.
    a_sphere = total / (len(first) * len(second))
    half = max(4, round(math.sqrt(a_sphere / 2) / 2))
    polar = ladder(np.pi / (2 * half), 2 * half + 1)
    turn = turns(4 * half)
    return IsotropySweep(robot, z, energy, first, second, polar, turn, beyond_limits)


def tilting(robot: Robot) -> bool:
    """Whether the robot's poses are tilts about an axis."""
    return robot.grid().kind == "cylinder" and distance_unit(robot) == "rad"


def plane_of(robot: Robot) -> tuple[str, str, str]:
    """The two pose coordinates of a grid of spheres, and the one that is the same in all."""
    grid = robot.grid()
    if grid.kind == "cylinder":
        return grid.lateral[0], grid.lateral[1], grid.height
    return robot.pose_names[0], robot.pose_names[1], robot.pose_names[2]
