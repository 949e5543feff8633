# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What makes a message sound, written down anew: it shares nothing with the nodes' reading."""

from __future__ import annotations

import math
from typing import Any

from pkm_twin.robot.robot import Robot
from test.nodes.harness import SECOND

STALE = SECOND // 10
"""How old, and how far ahead, a stamp may be with the nodes' defaults, ns."""


class Rules:
    """Those of one robot, with the nodes' default settings."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.names = robot.joint_names
        limits = robot.limits
        self.position = None if limits.position is None else limits.position.tolist()
        self.velocity = None if limits.velocity is None else limits.velocity.tolist()

    def stamp(self, message: Any, now: int, old: int | None) -> bool:
        sec, nanosec = message.header.stamp.sec, message.header.stamp.nanosec
        at = sec * SECOND + nanosec
        if sec < 0 or not 0 <= nanosec < SECOND or at == 0:
            return False
        return at <= now + STALE and (old is None or at >= now - old)

    def named(self, message: Any, values: Any) -> dict[str, float] | None:
        """By the robot's joints, or None where that cannot be."""
        names = list(message.name)
        if any(names.count(joint) != 1 for joint in self.names) or len(values) != len(names):
            return None
        return {joint: float(values[names.index(joint)]) for joint in self.names}

    def measured(self, message: Any, values: Any, bounds: Any) -> bool:
        """An array that may be absent: empty, or NaN for all of the robot's joints."""
        if len(values) == 0:
            return True
        by_name = self.named(message, values)
        if by_name is None:
            return False
        found = list(by_name.values())
        if all(map(math.isnan, found)):
            return True
        if not all(map(math.isfinite, found)):
            return False
        return bounds is None or all(low <= v <= high for v, (low, high) in zip(found, bounds, strict=True))

    def joint_state(self, message: Any, now: int) -> bool:
        by_name = self.named(message, message.position)
        if by_name is None or not all(map(math.isfinite, by_name.values())):
            return False
        rates = None if self.velocity is None else [(-v, v) for v in self.velocity]
        return (
            self.measured(message, message.position, self.position)
            and self.measured(message, message.velocity, rates)
            and self.measured(message, message.effort, None)
            and self.stamp(message, now, STALE)
        )

    def torques(self, message: Any, now: int) -> bool:
        by_name = self.named(message, message.effort)
        if by_name is None or not all(map(math.isfinite, by_name.values())):
            return False
        limits = self.robot.limits.effort
        within = limits is None or all(abs(by_name[j]) <= limit for j, limit in zip(self.names, limits, strict=True))
        return within and self.stamp(message, now, STALE)

    def trajectory(self, message: Any) -> bool:
        if sorted(message.joint_names) != sorted(self.names) or not message.points:
            return False
        last = -1
        for point in message.points:
            start = point.time_from_start
            at = start.sec * SECOND + start.nanosec
            if not 0 <= start.nanosec < SECOND or at <= last:
                return False
            last = at
            for values in (point.positions, point.velocities, point.accelerations):
                if len(values) != len(self.names) or not all(map(math.isfinite, values)):
                    return False
        return True

    def wrench(self, message: Any, now: int) -> bool:
        parts = [*vars(message.wrench.force).values(), *vars(message.wrench.torque).values()]
        finite = all(map(math.isfinite, parts))
        return finite and message.header.frame_id == "platform" and self.stamp(message, now, None)
