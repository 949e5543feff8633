# SPDX-License-Identifier: Apache-2.0
"""The map of the axial depth of cut that mills without chatter at every spindle speed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pkm_twin.atlas.maps.frequency import FREQUENCY
from pkm_twin.atlas.maps.quantity import Array, Found, Quantity, no_wrench, size_and_direction
from pkm_twin.robot.robot import Robot
from stiffness_monitor.chatter import Milling, stable_depth_of
from stiffness_monitor.vibration import COUNT, tool_modes

CUTTING_DEPTH: Final = "cutting-depth"


@dataclass(frozen=True)
class Process:
    """Milling at a point of the platform; ``damping`` and ``tool`` as of ``tool_modes``."""

    milling: Milling
    damping: tuple[float, ...] | None = None
    tool: tuple[float, ...] = (0.0, 0.0, 0.0)

    @property
    def quantity(self) -> Quantity:
        """The zero-order depth, how the tool point swings in the mode that chatters, and which."""
        return replace(
            FREQUENCY,
            name=CUTTING_DEPTH,
            what="axial depth of cut without chatter at every spindle speed",
            question="how deep does it mill without chatter?",
            evaluate=self._depth,
            elements=lambda robot: tuple(f"mode {k}" for k in range(1, COUNT + 1)),
            unit=lambda robot, case: "m",
            default=no_wrench("milling"),
            element="mode",
        )

    def _depth(self, robot: Robot, q: Array, wrench: Array | None) -> Found:
        del wrench
        poses = robot.forward(q)
        found = [tool_modes(robot, p, damping=self.damping, tool=self.tool) for p in poses]
        depths = [stable_depth_of(modes, self.milling) for modes in found]
        moved = [modes.shapes[k, :3] for modes, (_, k) in zip(found, depths, strict=True)]
        value, mode = np.array(depths).reshape(-1, 2).T
        return Found(value, size_and_direction(np.array(moved))[1], mode.astype(np.int64))
