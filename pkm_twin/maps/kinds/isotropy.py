# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Map dynamic isotropy: kinetic energy and drive force in the worst direction of motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from delta_dynamics.torques.isotropy import PAPER_ENERGY, driving_force_peak, energy_transfer_range
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.maps import spheres
from pkm_twin.maps.kind import Case, Found, Kind, Space, Variable
from pkm_twin.robot.robot import Robot
from pkm_twin.settings import setting

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from xarray import Dataset

TRANSFER = Case("energy", "least share of the kinetic energy in the platform", "", "moves itself most", False)


@dataclass(frozen=True)
class Isotropy(Kind):
    """Map kinetic energy and driving force in the worst direction of motion."""

    energy: float = setting(PAPER_ENERGY, "the platform's kinetic energy for the driving force (J)")
    spheres: bool = setting(False, "also both indices in every direction, on spheres")

    name = "isotropy"
    question = "what does the worst direction cost?"
    element = "drive"
    points = 20_000
    page_help = (
        "With --spheres, below: a sphere is a pose at azimuth and tilt; the colour of a point is "
        "the index in that direction of motion."
    )

    def cases(self, robot: Robot) -> tuple[Case, ...]:
        """Return two cases: the platform's share of energy, and the driving force at ``energy``."""
        robot.massive()
        if self.spheres:
            spheres.check_tilts(robot)
        if not 0.0 < self.energy < np.inf:
            raise ParameterError("energy", self.energy, "above zero, J")
        what = f"driving {'force' if robot.effort_unit == 'N' else 'torque'} at {self.energy:g} J"
        return TRANSFER, Case("force", what, robot.effort_unit, "needs most drive")

    def axes(self, robot: Robot) -> tuple[str, ...]:
        """Return the components of directions, which are unit vectors of pose rates."""
        return tuple(f"d{name}/dt" for name in robot.pose_names)

    def found(self, robot: Robot, q: Array, case: Case) -> Found:
        """Return the least eta_KE or the greatest F_max (3-PRRU paper, equations 44 and 47)."""
        pose = robot.forward(q)
        if case == TRANSFER:
            ends = energy_transfer_range(robot, pose)
            return Found(ends.least, ends.directions[..., 0, :])
        return Found(*driving_force_peak(robot, pose, self.energy))

    def summaries(self, space: Space, counted: int, separate: int) -> dict[str, Variable]:
        """Return both indices in every direction of motion if ``spheres`` is set."""
        return spheres.find_spheres(space, self.energy) if self.spheres else {}

    @classmethod
    def facts(cls, data: Dataset) -> list[str]:
        """Return ranges of the indices on the spheres."""
        return spheres.state_ranges(data) if "sphere_energy" in data else []

    @classmethod
    def figures(cls, data: Dataset) -> dict[str, Figure]:
        """Draw the spheres."""
        return spheres.draw_spheres(data) if "sphere_energy" in data else {}

    @classmethod
    def page(cls, data: Dataset) -> Any:
        """Return a figure with the spheres to rotate."""
        return spheres.make_page(data) if "sphere_energy" in data else None
