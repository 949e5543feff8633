# SPDX-License-Identifier: Apache-2.0
"""Paths, their time laws, the fastest motion along them, and the sizing of drives."""

from pkm_twin.paths.constraints import Limits
from pkm_twin.paths.fastest import fastest, timed
from pkm_twin.paths.geometry import Path, circle, cycle, lines, through
from pkm_twin.paths.motion import Bound, Samples, TimedPath

__all__ = [
    "Bound", "Limits", "Path", "Samples", "TimedPath", "circle", "cycle", "fastest", "lines",
    "through", "timed",
]  # fmt: skip
