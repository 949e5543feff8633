# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A cutter's load on a platform: passes, tooth ripple, run-out and slow wander.

May import: numpy, the standard library, its neighbours in this package.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bags.recording.capture import smooth

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Milling:
    """An end mill at work."""

    spindle_hz: float
    teeth: int
    tool_tip: tuple[float, float, float]
    """Where the cutter meets the work, platform axes, m."""
    mean_force: tuple[float, float, float]
    """Feed, normal and axial force in full engagement, N."""
    cutting_moment: float
    """Mean moment of the work about the tool, N m."""
    passes: tuple[tuple[float, float], ...]
    """Times at which the cutter enters and leaves, s; both take 0.4 s."""

    @property
    def tooth_hz(self) -> float:
        """Tooth passing frequency."""
        return self.spindle_hz * self.teeth

    def engagement(self, time: float) -> float:
        """Return how deep the cutter is in the work, 0 to 1."""
        return sum(smooth((time - enter) / 0.4)[0] - smooth((time - leave) / 0.4)[0] for enter, leave in self.passes)

    def wrench(self, time: float) -> Array:
        """Return the load on the platform at its origin, platform axes, N and N m, shape (6,).

        The mean force wanders slowly while the feed turns about the tool; on it lie ripple at tooth
        passing and its double, and the run-out at spindle speed. All of it acts at the tool's tip.
        """
        turn = 2.0 * math.pi * time
        tooth = turn * self.tooth_hz
        phases = np.array([0.0, 1.1, 2.0])
        ripple = 0.45 * np.sin(tooth + phases) + 0.12 * np.sin(2.0 * tooth + phases)
        runout = 0.10 * np.sin(turn * self.spindle_hz + phases)
        wander = 0.25 * np.sin(turn * np.array([0.21, 0.13, 0.17]) + phases)
        feed, normal, axial = np.array(self.mean_force) * (1.0 + wander + ripple + runout)
        along, across = math.cos(turn * 0.05), math.sin(turn * 0.05)
        force = np.array([feed * along - normal * across, feed * across + normal * along, axial])
        moment = np.cross(np.array(self.tool_tip), force)
        moment[2] -= self.cutting_moment * (1.0 + wander[0] + ripple[0])
        load: Array = self.engagement(time) * np.concatenate((force, moment))
        return load
