# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Measured poses of a Delta-CU that is not built as drawn, for ``pkm-twin calibrate``."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from bags.recording.capture import machine_parameters

NAME: Final = "delta_cu_poses"
SHIFTS: Final = {"base_radius": 1.2e-3, "arm_length": 9e-4, "forearm_length": -1.1e-3}
"""What the machine's lengths are more than drawn, m."""
TURNS: Final = (0.004, -0.003, 0.002)
"""The same of its azimuths, rad."""
OFFSETS: Final = (0.01, -0.015, 0.008)
"""What the joints' sensors read where the joints are at zero, rad."""
NOISE: Final = 2e-5
"""Standard deviation of the instrument an axis, m."""


def record(
    path: Path,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
    *,
    noise: float = NOISE,
    count: int = 60,
) -> None:
    """Write the joints' positions and the platform's places by Pinocchio's closed loops."""
    from bags.recording.pinocchio_delta import DeltaEngine

    parameters = machine_parameters("delta_cu")
    geometry = parameters["geometry"]
    for name, shift in SHIFTS.items():
        geometry[name] += shift
    geometry["azimuths"] = [a + t for a, t in zip(geometry["azimuths"], TURNS, strict=True)]
    engine = DeltaEngine(parameters)
    rng = np.random.default_rng(seed)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*(f"arm_{k}.position" for k in (1, 2, 3)), "x", "y", "z"])
        for k in range(count):
            q = rng.uniform(-0.6, 1.0, 3)
            place = engine.platform_placement(engine.assemble(q)).translation
            row = np.array([*(q + OFFSETS), *(place + noise * rng.normal(size=3))])
            writer.writerow(np.round(row, 9).tolist())
            if progress is not None:
                progress((k + 1) / count)
