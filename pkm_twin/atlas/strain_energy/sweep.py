# SPDX-License-Identifier: Apache-2.0
"""Strain-energy sweep: the energy of one wrench, and which elements of the limbs have it.

The grid: heights, tilts and azimuths of the tilt, beta = tilt cos(azimuth), gamma = tilt
sin(azimuth). Tilts beyond a height's circle are left out (NaN, element -1).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.atlas.grids import circles, cylinder, height_range, ladder, nice, turns
from pkm_twin.atlas.maps.quantity import Case
from pkm_twin.atlas.maps.sweep import (
    MapSweep,
    map_sweep,
    worst_coordinates,
    worst_of,
    worst_variables,
)
from pkm_twin.atlas.sweep import POSITIVE, SHARE, Chunk, Field, Sweep, Values, Variable, about, axis
from pkm_twin.errors import ParameterError
from pkm_twin.robot.robot import Robot
from stiffness_monitor.compliance import strain_energy

Array = NDArray[np.float64]

ELEMENTS: Final = ("1R", "1B", "1U", "2R", "2B", "2U", "3R", "3B", "3U")
WRENCHES: Final[Mapping[str, tuple[float, ...]]] = MappingProxyType(
    {
        "P1": (0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
        "P2": (0.8, 0.3, 0.52, 0.0, 0.0, 0.0),
        "P3": (0.52, 0.3, 0.8, 0.5, 0.7, 0.51),
    }
)
"""Loads of the 2UPR-RPU paper's section 4: force (N) and moment (N m) at o."""
TABLE_2: Final[Mapping[str, tuple[float, ...]]] = MappingProxyType(
    {
        "P1": (0.044, 0.254, 0.146, 0.044, 0.254, 0.146, 0.007, 0.083, 0.023),
        "P2": (1.39e-4, 0.036, 1.99e-4, 9.55e-4, 0.122, 6.06e-4, 0.007, 0.825, 0.008),
        "P3": (0.002, 0.216, 0.003, 0.004, 0.194, 0.011, 0.007, 0.550, 0.012),
    }
)
"""Global strain-energy factors of the paper's table 2, in the order of ``ELEMENTS``."""

CHUNK: Final = 65536
LEAST_RADIUS: Final = math.radians(10.0)
"""Circles below this are no part of the regular workspace (2UPR-RPU paper, section 4)."""
TILT_STEP: Final = math.radians(1.0)
AZIMUTHS: Final = 72
PLANE: Final = -0.6
"""Height of the paper's figures, m."""
FINEST: Final = 8
"""Most layers that one coarse step of height is divided into."""

DOMINANT: Final = "index of the element with the largest factor, -1 outside"
_GRID: Final = ("z", "tilt", "azimuth")


@dataclass(frozen=True, eq=False)
class StrainEnergySweep(Sweep):
    """Strain energy of one wrench over the regular workspace.

    ``wrench``: six numbers, N and N m. ``heights`` (n,), m, with their ``radii`` (n,), rad;
    ``tilts`` (m,), rad, evenly spaced from 0; ``azimuths``: how many.
    """

    wrench: tuple[float, ...]
    heights: Array
    radii: Array
    tilts: Array
    azimuths: int
    rows: int

    kind: ClassVar[str] = "strain-energy"
    fields: ClassVar[Mapping[str, Field]] = {
        "energy": Field(_GRID, about("total strain energy", "J", POSITIVE)),
        "factor": Field((*_GRID, "element"), about("strain-energy factor, U_e / U", "", SHARE)),
        "dominant": Field(_GRID, about(DOMINANT, "", {"valid_min": -1}), "i1"),
    }

    @property
    def turn(self) -> Array:
        """Azimuths, shape (azimuths,), rad."""
        return turns(self.azimuths)

    @property
    def coordinates(self) -> dict[str, Variable]:
        """Height, tilt, azimuth, element, and each height's circle."""
        return {
            "z": axis("z", self.heights, "height of o", "m"),
            "tilt": axis("tilt", self.tilts, "root of beta^2 + gamma^2", "rad"),
            "azimuth": axis("azimuth", self.turn, "from beta to gamma", "rad"),
            "element": Variable(("element",), np.array(ELEMENTS, "U"), {}),
            "radius": Variable(("z",), self.radii, about("largest circle of tilts", "rad")),
            **worst_coordinates(self.whole),
        }

    @cached_property
    def whole(self) -> MapSweep:
        """The map of the same over the whole workspace, whose worst pose is stored."""
        return map_sweep(self.robot, self.kind, cases=[Case("wrench", self.wrench)])

    @property
    def settings(self) -> dict[str, Any]:
        """The wrench, N and N m."""
        return {"wrench": list(self.wrench), "points": self.points}

    @property
    def rows_a_chunk(self) -> int:
        """Tilts in one chunk."""
        return self.rows

    def count(self, chunk: Chunk) -> int:
        """Poses of one chunk inside the workspace."""
        return self._inside(chunk) * self.azimuths

    def _inside(self, chunk: Chunk) -> int:
        """How many of the chunk's tilts are in the height's circle; they come first."""
        step = float(self.tilts[1] - self.tilts[0])
        last = math.floor(float(self.radii[chunk.first]) / step * (1 + 1e-12))
        return min(max(last + 1 - chunk.start, 0), chunk.stop - chunk.start)

    def evaluate(self, chunk: Chunk) -> Values:
        """Energies of the chunk, and its part of the global factors."""
        rows, kept = chunk.stop - chunk.start, self._inside(chunk)
        energy = np.full((rows, self.azimuths), np.nan)
        factor = np.full((rows, self.azimuths, len(ELEMENTS)), np.nan)
        dominant = np.full((rows, self.azimuths), -1, np.int8)
        tilt = self.tilts[chunk.start : chunk.start + kept]
        if kept:
            height = self.heights[chunk.first]
            result = strain_energy(
                self.robot,
                self.robot.grid().polar_pose(height, tilt[:, None], self.turn),
                self.wrench,
            )
            energy[:kept], factor[:kept] = result.total, result.factors
            dominant[:kept] = result.factors.argmax(-1)
        ring = factor[:kept].sum(1)
        return {
            "energy": energy,
            "factor": factor,
            "dominant": dominant,
            "rays": ring.sum(0),
            "volume": tilt @ ring,
            "counts": np.array([kept * self.azimuths, tilt.sum() * self.azimuths]),
        }

    def summaries(self, partial: Iterable[Values]) -> dict[str, Variable]:
        """Global factors (equation 39), over points on rays and over the volume."""
        parts = [(p["rays"], p["volume"], p["counts"]) for p in partial]
        rays, volume, counts = (np.array(column).T for column in zip(*parts, strict=True))
        number, weight = (math.fsum(row) for row in counts)
        result = {}
        for name, sums, count, what in (
            ("global_factor", rays, number, "mean over the grid's points, dense near the axis"),
            ("volume_factor", volume, weight, "mean over the volume of z, beta and gamma"),
        ):
            values = np.array([math.fsum(row) for row in sums]) / count
            attrs = about(f"global strain-energy factor, {what}", "", SHARE)
            result[name] = Variable(("element",), values, attrs)
        whole = self.whole
        # Three coordinates and a smooth quantity: a small part of the usual search is enough.
        quantity = replace(whole.quantity, samples=1024, population=48, rounds=80)
        worst = worst_of(whole, whole.cases[0], np.empty((0, 3)), quantity)
        return result | worst_variables(whole, [worst])


def strain_energy_sweep(
    robot: Robot, wrench: ArrayLike | str = "P1", points: int | None = None
) -> StrainEnergySweep:
    """The strain-energy atlas of a robot.

    Without ``points`` heights every 0.05 m (for a machine of the paper's size), tilts every
    degree, 72 azimuths: the points over which the paper's table 2 comes out. With it all steps
    are divided alike, so that about as many poses lie inside; -0.6 m stays a height.

    :param wrench: P1, P2 or P3 of the paper, or six numbers, N and N m.
    :raises ParameterError: a robot whose elastic elements are not :data:`ELEMENTS`, a wrench that
        is none, or a robot that has no regular workspace.
    """
    if not has_paper_elements(robot):
        raise ParameterError(
            "mechanism", robot.mechanism, "elastic limbs of R joint, bar and U joint (upr_rpu)"
        )
    load = checked_wrench(wrench)
    cylinder(robot, "strain energy over tilts")
    step = nice(float(np.ptp(height_range(robot))) / 15)
    base = _layers(robot, step)
    if points is None:
        return _sweep(robot, load, base, TILT_STEP, AZIMUTHS)
    if points < 100:
        raise ParameterError("points", points, "100 or more")
    base_points = float(AZIMUTHS * (np.floor(base[1] / TILT_STEP) + 1).sum())
    scale = (points / base_points) ** (1 / 3)
    layers = min(FINEST, max(1, round(scale)))
    heights = base if layers == 1 else _layers(robot, step / layers)
    share = math.sqrt(points / base_points / (len(heights[0]) / len(base[0])))
    azimuths = 4 * max(2, round(AZIMUTHS * share / 4))
    rungs = points / azimuths
    # Each height has its axis, so the count is not quite linear in the step.
    tilt_step = float(heights[1].sum()) / max(rungs - len(heights[0]) / 2, 1.0)
    layer = nearest_height(heights[0])
    if tilt_step > heights[1][layer]:
        raise ParameterError(
            "points", points, f"more, so that the plane z = {heights[0][layer]:.4g} m has two tilts"
        )
    return _sweep(robot, load, heights, tilt_step, azimuths)


def nearest_height(heights: Array, z: float | None = None) -> int:
    """Index of the height nearest to z; default -0.6 m, or the middle where that is outside."""
    if z is None:
        z = PLANE if heights.min() <= PLANE <= heights.max() else float(heights.mean())
    return int(np.abs(heights - z).argmin())


def has_paper_elements(robot: Robot) -> bool:
    """Whether a robot's elastic elements are :data:`ELEMENTS`."""
    return robot.mechanism == "upr_rpu" and robot.element_names == ELEMENTS


def checked_wrench(wrench: ArrayLike | str) -> tuple[float, ...]:
    """Six finite numbers from a name of the paper's or from numbers."""
    if isinstance(wrench, str):
        if wrench not in WRENCHES:
            raise ParameterError("wrench", wrench, f"{', '.join(WRENCHES)} or six numbers")
        return WRENCHES[wrench]
    values = np.asarray(wrench, np.float64)
    if values.shape != (6,) or not np.isfinite(values).all():
        raise ParameterError("wrench", values.tolist(), "six finite numbers, N and N m")
    if not values.any():
        raise ParameterError(
            "wrench",
            values.tolist(),
            "a wrench that is not zero, because a zero wrench stores no energy",
        )
    return tuple(values.tolist())


def table_2(wrench: tuple[float, ...]) -> tuple[float, ...] | None:
    """The paper's global factors for a wrench, None where it prints none."""
    for name, values in WRENCHES.items():
        if tuple(wrench) == values:
            return TABLE_2[name]
    return None


def _layers(robot: Robot, step: float) -> tuple[Array, Array]:
    """Heights that are multiples of a step, and the radii of their circles, rad."""
    low, high = height_range(robot)
    ticks = step * np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    reach = circles(robot, ticks)
    kept = reach.radius >= LEAST_RADIUS
    if not kept.any():
        raise ParameterError("limits", robot.name, "limits that leave room for an inscribed circle")
    return reach.z[kept], reach.radius[kept]


def _sweep(
    robot: Robot,
    wrench: tuple[float, ...],
    layers: tuple[Array, Array],
    tilt_step: float,
    azimuths: int,
) -> StrainEnergySweep:
    heights, radii = layers
    rungs = math.floor(float(radii.max()) / tilt_step * (1 + 1e-12)) + 1
    tilts = ladder(tilt_step, max(rungs, 2))
    rows = max(1, CHUNK // azimuths)
    return StrainEnergySweep(robot, wrench, heights, radii, tilts, azimuths, rows)
