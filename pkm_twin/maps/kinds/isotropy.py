# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Dynamic isotropy: kinetic energy and drive force in the worst direction of the motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from delta_dynamics.torques.isotropy import ENERGY, driving_force_peak, energy_transfer_range
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.maps.kind import Case, Found, Kind
from pkm_twin.robot.robot import Robot
from pkm_twin.settings import setting

TRANSFER = Case(
    "energy", "least share of the kinetic energy in the platform", "", "moves itself most", False
)


@dataclass(frozen=True)
class Isotropy(Kind):
    """Kinetic energy and driving force in the worst direction of motion."""

    energy: float = setting(ENERGY, "the platform's kinetic energy for the driving force (J)")

    name = "isotropy"
    question = "what does the worst direction cost?"
    element = "drive"
    points = 20_000

    def cases(self, robot: Robot) -> tuple[Case, ...]:
        """The platform's share of the kinetic energy, and the driving force at its energy."""
        robot.massive()
        if not 0.0 < self.energy < np.inf:
            raise ParameterError("energy", self.energy, "above zero, J")
        what = f"driving {'force' if robot.effort_unit == 'N' else 'torque'} at {self.energy:g} J"
        return TRANSFER, Case("force", what, robot.effort_unit, "needs most drive")

    def elements(self, robot: Robot) -> tuple[str, ...]:
        """The drives."""
        return robot.joint_names

    def axes(self, robot: Robot) -> tuple[str, ...]:
        """Directions are unit vectors of the pose's rates."""
        return tuple(f"d{name}/dt" for name in robot.pose_names)

    def found(self, robot: Robot, q: Array, case: Case) -> Found:
        """Least eta_KE, or greatest F_max, over all directions (3-PRRU paper, section 5)."""
        pose = robot.forward(q)
        if case == TRANSFER:
            ends = energy_transfer_range(robot, pose)
            return Found(ends.least, ends.directions[..., 0, :])
        return Found(*driving_force_peak(robot, pose, self.energy))
