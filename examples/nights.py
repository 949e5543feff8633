# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""24 nights of a Delta whose first drive wears, for ``pkm-twin trend``: no ROS needed.

    python examples/nights.py simulated.db && pkm-twin trend simulated.db

Each night has one motion of four seconds. After 17 nights the dry friction of the first drive grows
by 0.06 N m. A real machine's nights come from ``pkm-twin check RECORDING --history nights.db``.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from delta_dynamics import inverse_dynamics
from pkm_twin import Robot, load
from pkm_twin.identification.history import append, measure
from pkm_twin.recordings import read

NIGHTS, HEALTHY_NIGHTS = 24, 17
DAY, FIRST_NIGHT = 86400.0, 1.7621e9
"""Length of a day, s, and time of the first night, s since 1970."""


def make_motion() -> tuple[NDArray[np.float64], ...]:
    """Return times (k,) and q, qd, qdd (k, 3) of a motion of four seconds."""
    time = np.arange(0.0, 4.0, 0.004)
    rate = 2 * np.pi * np.array([0.7, 1.1, 1.3])
    phase = np.outer(time, rate) + np.array([0.0, 1.0, 2.0])
    q, qd = 0.2 + 0.25 * np.sin(phase), 0.25 * rate * np.cos(phase)
    return time, q, qd, rate**2 * (0.2 - q)


def write_night(
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
    time, q, qd, qdd = make_motion()
    real = robot.changed(payload={"mass": mass}, friction={"viscous": viscous, "coulomb": coulomb})
    effort = inverse_dynamics(real, q, qd, qdd) + rng.normal(0.0, 0.02, q.shape)
    names = [f"{j}.{w}" for w in ("position", "velocity", "acceleration", "measured") for j in robot.joint_names]
    table = np.column_stack([time, q, qd, qdd, effort])
    np.savetxt(path, table, delimiter=",", header=",".join(["time", *names]), comments="")
    return path


def write_history(history: Path) -> None:
    """Simulate all nights and append their measurements to a history."""
    robot, rng = load("delta_cu"), np.random.default_rng(5)
    with tempfile.TemporaryDirectory() as folder:
        for k in range(NIGHTS):
            dry = [0.16 if k >= HEALTHY_NIGHTS else 0.10, 0.10, 0.10]
            # The friction of a healthy drive varies from night to night, too.
            coulomb = tuple(np.array(dry) + rng.normal(0.0, 0.003, 3))
            path = write_night(Path(folder) / f"{k}.csv", robot, rng, (0.05, 0.05, 0.05), coulomb)
            numbers = measure(read(path, robot))
            append(history, "cell 3", robot.name, path, FIRST_NIGHT + DAY * k, True, numbers)


if __name__ == "__main__":
    write_history(Path(sys.argv[1]))
