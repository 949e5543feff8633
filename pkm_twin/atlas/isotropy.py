# SPDX-License-Identifier: Apache-2.0
"""Dynamic-isotropy atlas: on every pose of a grid a sphere of directions, coloured by an index.

The indices of delta_dynamics/isotropy.py, eta_KE and F_max, over unit vectors of pose rates. A
machine that tilts stands on a polar grid of azimuth and tilt (3-PRRU paper, section 5), one that
translates on a grid of x and y.

May import: numpy, pkm_twin's core and the two packages above it; never rclpy.
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
from pkm_twin.atlas.grids import circles, ladder, polar_pose, singularity, tilts, turns
from pkm_twin.atlas.sweep import Chunk, Field, Sweep, Values, Variable
from pkm_twin.codegen.kernels import OK
from pkm_twin.errors import ParameterError
from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]

POINTS: Final = 48_000
TILT: Final = math.radians(45.0)
"""Largest tilt of the paper's atlas, rad."""
CHUNK: Final = 16384

_SPHERE: Final = ("polar", "turn")


@dataclass(frozen=True, eq=False)
class IsotropySweep(Sweep):
    """Spheres of eta_KE and F_max over a grid of poses at one height.

    ``first`` and ``second``: the grid's axes: x and y (m), or azimuth and tilt (rad). ``polar``
    angles from the direction's third axis, ``turn`` angles about it, from the first, rad.
    """

    height: float
    energy: float
    first: Array
    second: Array
    polar: Array
    turn: Array

    kind: ClassVar[str] = "isotropy"

    @property
    def axes(self) -> tuple[str, str]:
        """Names of the grid's axes."""
        return ("azimuth", "tilt") if tilts(self.robot) else ("x", "y")

    @property
    def fields(self) -> Mapping[str, Field]:  # type: ignore[override]
        """Indices on the spheres, and the exact range of eta_KE at each pose."""
        unit = self.robot.effort_unit
        sphere = (*self.axes, *_SPHERE)
        share = "eta_KE, the platform's part of the kinetic energy"
        return {
            "eta": Field(sphere, {"units": "1", "long_name": share}),
            "force": Field(sphere, {"units": unit, "long_name": "F_max, largest driving force"}),
            "eta_least": Field(self.axes, {"units": "1", "long_name": f"least {share}, exact"}),
            "eta_greatest": Field(
                self.axes, {"units": "1", "long_name": f"greatest {share}, exact"}
            ),
            "singularity": Field(
                self.axes,
                {"units": "1", "long_name": "distance to a singularity: 0 in one, 1 at best"},
            ),
        }

    @property
    def coordinates(self) -> dict[str, Variable]:
        """The grid's axes, and the angles of the directions."""
        rates = [f"d{name}/dt" for name in self.robot.pose_names]
        what = {
            "azimuth": "direction that the platform leans to",
            "tilt": "lean of the platform's axis, no torsion",
            "x": "x of the platform's centre",
            "y": "y of the platform's centre",
        }
        result = {
            name: Variable(
                (name,),
                values,
                {"units": "rad" if tilts(self.robot) else "m", "long_name": what[name]},
            )
            for name, values in zip(self.axes, (self.first, self.second), strict=True)
        }
        result["polar"] = Variable(
            ("polar",), self.polar, {"units": "rad", "long_name": f"angle from {rates[2]}"}
        )
        result["turn"] = Variable(
            ("turn",),
            self.turn,
            {"units": "rad", "long_name": f"about {rates[2]}, from {rates[0]} to {rates[1]}"},
        )
        return result

    @property
    def directions(self) -> Array:
        """Unit vectors of pose rates, shape (polar, turn, 3)."""
        return unit_vectors(self.polar, self.turn)

    @property
    def settings(self) -> dict[str, Any]:
        """Height of the poses, m, and the platform's energy, J."""
        return {"height": self.height, "energy": self.energy, "points": self.points}

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
        if tilts(self.robot):
            return polar_pose(self.robot, self.height, second, self.first[chunk.first])
        x = np.full(len(second), self.first[chunk.first])
        return np.stack([x, second, np.full(len(second), self.height)], -1)

    def evaluate(self, chunk: Chunk) -> Values:
        """Indices at the poses; NaN where a pose is out of reach, its limits too, or singular."""
        robot, poses = self.robot, self.poses(chunk)
        measure = singularity(robot, poses)
        _, fault = robot.inverse_kernel(robot.parameters, poses)
        good = (fault[..., 0] == OK) & (measure > STRETCHED)
        if not tilts(robot):
            # Places outside the circle that the limits of the actuators leave.
            good &= np.hypot(poses[:, 0], poses[:, 1]) <= self.second[-1] * (1 + 1e-9)
        shape = (len(poses), len(self.polar), len(self.turn))
        values = {
            "eta": np.full(shape, np.nan),
            "force": np.full(shape, np.nan),
            "eta_least": np.full(len(poses), np.nan),
            "eta_greatest": np.full(len(poses), np.nan),
            "singularity": np.where(good, measure, np.nan),
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
) -> IsotropySweep:
    """The isotropy atlas of a robot.

    :param points: poses times directions, about; the grid is 12 azimuths by 4 tilts (and the
        upright pose), or 9 by 9 places, unless the spheres then had over 5,000 directions.
    :param height: of the poses, m; default the home pose's.
    :param energy: kinetic energy E_M of the platform for F_max, J.
    :param tilt: largest tilt, rad.
    :raises ParameterError: a robot without masses.
    """
    if robot.motion_kernel is None:
        raise ParameterError("mechanism", robot.mechanism, "a mechanism with masses (delta, prru)")
    if points is not None and points < 1000:
        raise ParameterError("points", points, "1000 or more")
    if not 0.0 < energy < math.inf:
        raise ParameterError("energy", energy, "above zero, J")
    if not 0.0 < tilt < math.pi / 2:
        raise ParameterError("tilt", tilt, "between 0 and a right angle, rad")
    total = points or POINTS
    z = float(robot.home()[robot.pose_names.index("z")]) if height is None else height
    finer = max(1.0, math.sqrt(total / (60 * 5000)))
    if tilts(robot):
        azimuths, rungs = 12 * round(finer), 4 * round(finer)
        first = turns(azimuths)
        second = ladder(tilt / rungs, rungs + 1)
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
    return IsotropySweep(robot, z, energy, first, second, polar, turn)
