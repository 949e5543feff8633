# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Paths, motion laws, the fastest motion along a path, and the sizing of drives."""

from pkm_twin.paths.constraints import Limits
from pkm_twin.paths.fastest import fastest, timed
from pkm_twin.paths.geometry import Path, circle, cycle, lines, through
from pkm_twin.paths.motion import Bound, Samples, TimedPath
from pkm_twin.paths.shaping import ShapedPath, shaped
from pkm_twin.paths.sizing import Motor, size_drives
from pkm_twin.paths.worst import worst_over_workspace

__all__ = [
    "Bound",
    "Limits",
    "Motor",
    "Path",
    "Samples",
    "ShapedPath",
    "TimedPath",
    "circle",
    "cycle",
    "fastest",
    "lines",
    "shaped",
    "size_drives",
    "through",
    "timed",
    "worst_over_workspace",
]
