# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Map the smallest axial depth of cut of the stability lobes, in zero order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.maps.kind import Found, size_and_direction
from pkm_twin.maps.kinds.frequency import Frequency
from pkm_twin.robot.robot import Robot
from stiffness_monitor.chatter import Milling, stable_depth_from_modes
from stiffness_monitor.vibration import DYNAMIC_MODES, tool_modes


@dataclass(frozen=True)
class CuttingDepth(Frequency):
    """Map the smallest axial depth of cut of the stability lobes, in zero order.

    At small immersion some speeds chatter at a smaller depth: `lobes` is exact at one pose.
    """

    milling: Milling
    # Parameters of stiffness_monitor.vibration.tool_modes.
    damping: tuple[float, ...] | None = None
    tool: tuple[float, ...] = (0.0, 0.0, 0.0)

    name = "cutting-depth"
    question = "how deep does it mill without chatter?"
    answer = "chatters first"
    what = "axial depth of cut, zero-order"
    unit = "m"
    element = "mode"
    together = False

    def elements(self, robot: Robot) -> tuple[str, ...]:
        """Return the names of the tool point's modes, lowest first."""
        return tuple(f"mode {k}" for k in range(1, DYNAMIC_MODES + 1))

    def each(self, robot: Robot, q: Array, cases: object) -> list[Found]:
        """Return the zero-order depth, and direction and index of the chattering mode."""
        poses = robot.forward(q)
        found = [tool_modes(robot, p, damping=self.damping, tool=self.tool) for p in poses]
        depths = [stable_depth_from_modes(modes, self.milling) for modes in found]
        moved = [modes.shapes[k, :3] for modes, (_, k) in zip(found, depths, strict=True)]
        value, mode = np.array(depths).reshape(-1, 2).T
        direction = size_and_direction(np.array(moved))[1]
        return [Found(value, direction, mode.astype(np.int64))]
