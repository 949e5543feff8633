# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Record upr_rpu_soft_joint.mcap: the milling head with one joint three times softer.

The same motion and cuts as in upr_rpu_milling.mcap, on the same frame engine; beside the sensors
of that bag an instrument measures the platform's deflection.

May import: numpy, the standard library, its neighbours in this package.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from bags.recording.capture import Capture, Progress
from bags.recording.frame_model import FrameSolution
from bags.recording.record_upr_rpu import deflection_message, mill

NAME: Final = "upr_rpu_soft_joint"
PERIOD_NS: Final = 10_000_000
"""Measurement period of wrench and limb lengths."""
DEFLECTION_STRIDE: Final = 5
"""Measurement periods between two measured deflections."""
SOFT: Final = {"3U": 3.0}
"""Factors on the compliance of elements."""
SHIFT_NOISE: Final = 0.1e-6
TURN_NOISE: Final = 0.2e-6
"""Standard deviations of the measured deflection, m and rad."""


def measure(capture: Capture, now: int, solution: FrameSolution, rng: np.random.Generator) -> None:
    """Write the deflection as the instrument reads it."""
    noise = np.repeat((SHIFT_NOISE, TURN_NOISE), 3) * rng.normal(size=6)
    moved = FrameSolution(solution.deflection + noise, {})
    capture.write("/measured_deflection", now, deflection_message(now, moved))


def record(path: Path, seed: int = 20261122, progress: Progress | None = None) -> None:
    """Simulate and write the bag."""
    capture = mill(
        "record_soft_joint",
        ("/measured_deflection",),
        seed,
        PERIOD_NS,
        DEFLECTION_STRIDE,
        measure,
        SOFT,
        {"softer_elements": ", ".join(f"{k} by {v:g}" for k, v in SOFT.items())},
        {"deflection_noise_m": SHIFT_NOISE, "deflection_noise_rad": TURN_NOISE},
        progress,
    )
    capture.save(path)
