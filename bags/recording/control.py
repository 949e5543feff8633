# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A machine under its controller: joint PID with the effort held between samples, and its drives.

The plant is Pinocchio's constrained forward dynamics.

May import: numpy, the standard library, its neighbours in this package.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bags.recording.capture import Capture, Progress, steps
from bags.recording.pinocchio_loops import LoopEngine

Array = NDArray[np.float64]
Push = Callable[[float, Array, Array], Array | None]
"""Wrench on the platform, world axes, at a time and a state of the tree."""

ENGINE: Final = ("pinocchio constrained forward dynamics", "pin")
PERIOD_NS: Final = 1_000_000
"""Control and measurement period."""
SUBSTEPS: Final = 2
"""Runge-Kutta steps of the plant in one period."""


@dataclass(frozen=True)
class Drives:
    """Resolutions and standard deviations of the drives' signals, and the controller's gains.

    Positions, rates and efforts in SI; ``integral`` per second.
    """

    position_step: float
    velocity_noise: float
    velocity_step: float
    effort_noise: float
    effort_step: float
    stiffness: float
    damping: float
    integral: float

    def facts(self, rate: str, effort: str) -> dict[str, float]:
        """Return what the metadata say of the signals of rates and efforts, by their units."""
        return {
            f"velocity_noise_{rate}": self.velocity_noise,
            f"velocity_step_{rate}": self.velocity_step,
            f"effort_noise_{effort}": self.effort_noise,
            f"effort_step_{effort}": self.effort_step,
        }


def simulate(
    capture: Capture,
    motion: tuple[Array, Array, Array],
    plant: Callable[[float], LoopEngine],
    drives: Drives,
    known: Callable[[Array, Array], Array],
    rng: np.random.Generator,
    push: Push = lambda *_: None,
    progress: Progress | None = None,
) -> None:
    """Run the machine along a reference and keep its joint states.

    :param motion: positions, rates and accelerations that are commanded, shape (samples, 3) each.
    :param plant: the machine as it is at a time, s.
    :param known: efforts that the controller expects at positions and accelerations.
    """
    begin, still = plant(0.0), np.zeros(3)
    limits = begin.params.get("limits") or {}
    peak = np.asarray(limits.get("effort", np.inf), dtype=float)
    configuration = begin.assemble(motion[0][0])
    velocity = np.zeros_like(configuration)
    effort = begin.inverse_dynamics(motion[0][0], still, still)
    integral = effort - known(motion[0][0], still)
    count, period = len(motion[0]), PERIOD_NS * 1e-9
    for k in range(count):
        engine = plant(k * period)
        q = steps(configuration[engine.actuated], drives.position_step)
        noise = rng.normal(size=(2, 3))
        rate = velocity[engine.actuated] + drives.velocity_noise * noise[0]
        qd = steps(rate, drives.velocity_step)
        measured = steps(effort + drives.effort_noise * noise[1], drives.effort_step)
        capture.joint_state(k * PERIOD_NS, q, qd, measured)
        error = motion[0][k] - q
        integral = integral + drives.integral * error * period
        effort = known(motion[0][k], motion[2][k]) + drives.stiffness * error
        effort = effort + drives.damping * (motion[1][k] - qd) + integral
        effort = np.clip(effort, -peak, peak)
        for _ in range(SUBSTEPS):
            wrench = push(k * period, configuration, velocity)
            configuration, velocity = engine.step(configuration, velocity, effort, wrench, period / SUBSTEPS)
        if progress is not None and k % 100 == 99:
            progress((k + 1) / count)
