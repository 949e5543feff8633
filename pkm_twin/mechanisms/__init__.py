# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The mechanisms, one file each, and their common base class."""

from __future__ import annotations

from dataclasses import dataclass

from pkm_twin.robot.robot import ControlLoop, Robot


@dataclass(frozen=True, eq=False, kw_only=True)
class TwinRobot(Robot):
    """A robot with the inverse dynamics as a method."""

    def torque_loop(self, samples: int = 1) -> ControlLoop:
        """Prepare inverse dynamics for a control loop, see :meth:`Robot.torque_loop`."""
        # Imported here, so that commands without torques do not load them.
        from delta_dynamics.torques.virtual_work import TorqueLoop

        return TorqueLoop(self, samples)
