# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The law of every effort that leaves a node, for the pure cores and for live nodes.

The machine stands still in each joint state, in another place each time: an effort that is not
zero is the weight in one place, which tells from which state it was computed, and how old that is.
"""

import numpy as np

from delta_dynamics import inverse_dynamics
from pkm_twin.robot.effort_limits import effort_limits
from test.support.robots import load

ROBOT = load("delta_cu")
HEAVY = ROBOT.changed(payload={"mass": 60.0, "com": [0.0, 0.0, 0.0]})
"""With a payload that the drives cannot hold."""
LIMITS = effort_limits(ROBOT)
PLACES = np.array([0.1, 0.2, 0.3]) + 0.2 * np.sin(np.outer(0.002 * np.arange(20_000), [1.0, 1.3, 0.7]))
"""Joint positions of one state after the other, rad."""
WEIGHTS = [inverse_dynamics(robot, PLACES, 0.0 * PLACES, 0.0 * PLACES) for robot in (ROBOT, HEAVY)]
assert (np.abs(WEIGHTS[0]) < LIMITS).all() and (np.abs(WEIGHTS[1]) > LIMITS).any(-1).all(), "held everywhere, nowhere"

ROUNDING = 1e-6
"""Of times in s, counted from 1970."""


class Judge:
    """Joint states that were sent, and the judgement of efforts; times in s, of any one clock."""

    def __init__(self):
        self._states = np.zeros((0, 2))
        self.judged = 0
        """Efforts that were not zero."""

    def state(self, place, measured):
        """Record that a state with this index of PLACES was measured at this time."""
        self._states = np.vstack([self._states[-3000:], [measured, place]])

    def judge(self, effort, left, max_age, policy="zeros"):
        """Check an effort that left at this time; ``policy`` of its limits as in EffortLimits."""
        effort = np.asarray(effort, float)
        assert np.isfinite(effort).all()
        assert policy == "warn" or (np.abs(effort) <= LIMITS).all(), effort
        if not effort.any():
            return
        self.judged += 1
        age = left - self._states[:, 0]
        fresh = self._states[(age <= max_age + ROUNDING) & (age >= -ROUNDING), 1].astype(int)
        for weights in WEIGHTS:
            sent = weights[fresh]
            if policy == "clamp":
                sent = np.clip(sent, -LIMITS, LIMITS)
            if (np.abs(sent - effort) <= 1e-9).all(-1).any():
                return
        raise AssertionError(f"{effort} left at {left}: not the weight in a state of the last {max_age} s")
