# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Map the largest mass that the drives hold at rest."""

from __future__ import annotations

import numpy as np

from delta_dynamics import inverse_dynamics
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.maps.kind import Case, Found, Kind, drive_limits
from pkm_twin.robot.robot import Robot


class Payload(Kind):
    """Map the largest mass that the drives hold at rest, with the machine's own weight."""

    name = "payload"
    question = "how much can it carry?"
    answer = "carries least"
    what = "largest payload"
    unit = "kg"
    largest = False
    element = "drive"
    takes_wrench = True

    def axes(self, robot: Robot) -> tuple[str, ...]:
        """Return no axes: weight acts along gravity."""
        return ()

    def found(self, robot: Robot, q: Array, case: Case) -> Found:
        """Return the largest mass at the centre of the file's payload, which is removed.

        The value is 0 if the drives cannot hold the machine without it, infinite if no drive feels
        the mass. The element is the drive at its limit.

        :raises ParameterError: the mass does not move, as the platform rotates about it.
        """
        moved, com = robot.platform_jacobian(robot.graph.home)[:3], robot.payload.com
        if not com.any() and np.abs(moved).max() < 1e-12 * robot.size:
            bound = "--payload MASS,x,y,z, away from the point that the platform turns about"
            raise ParameterError("payload.com", com.tolist(), bound)
        limits, still = drive_limits(robot, "effort"), np.zeros_like(q)
        none = {"mass": 0.0, "inertia": np.zeros((3, 3)).tolist()}
        bare, loaded = (robot.changed(payload=none | {"mass": mass}) for mass in (0.0, 1.0))
        held = inverse_dynamics(bare, q, still, still, case.wrench)
        each = inverse_dynamics(loaded, q, still, still, case.wrench) - held
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(np.abs(each) < 1e-12 * limits, np.inf, (np.copysign(limits, each) - held) / each)
        over = np.abs(held) / limits
        fails = over.max(-1) > 1.0
        joint = np.where(fails, over.argmax(-1), room.argmin(-1))
        return Found(np.where(fails, 0.0, room.min(-1)), None, joint)
