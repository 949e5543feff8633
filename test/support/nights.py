# SPDX-License-Identifier: Apache-2.0
"""Recordings of one motion, night after night, of a machine whose friction may change."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from delta_dynamics import inverse_dynamics
from pkm_twin import Robot


def night(
    path: Path,
    robot: Robot,
    rng: np.random.Generator,
    viscous: Sequence[float] = (0.0, 0.0, 0.0),
    coulomb: Sequence[float] = (0.0, 0.0, 0.0),
    mass: float = 0.0,
) -> Path:
    """Write a CSV of a Delta with all joints at many speeds, with noise of 0.02 N m.

    :param viscous: true friction of the drives, N m s/rad; ``coulomb``: N m; ``mass``: kg.
    """
    time, q, qd, qdd = motion()
    real = robot.changed(payload={"mass": mass}, friction={"viscous": viscous, "coulomb": coulomb})
    effort = inverse_dynamics(real, q, qd, qdd) + rng.normal(0.0, 0.02, q.shape)
    names = [f"{j}.{w}" for w in ("position", "velocity", "acceleration", "measured")
             for j in robot.joint_names]  # fmt: skip
    table = np.column_stack([time, q, qd, qdd, effort])
    np.savetxt(path, table, delimiter=",", header=",".join(["time", *names]), comments="")
    return path


def motion() -> tuple[NDArray[np.float64], ...]:
    """Times (k,) and q, qd, qdd (k, 3) of four seconds."""
    time = np.arange(0.0, 4.0, 0.004)
    rate = 2 * np.pi * np.array([0.7, 1.1, 1.3])
    phase = np.outer(time, rate) + np.array([0.0, 1.0, 2.0])
    q, qd = 0.2 + 0.25 * np.sin(phase), 0.25 * rate * np.cos(phase)
    return time, q, qd, rate**2 * (0.2 - q)
