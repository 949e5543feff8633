# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The machine as a function of its file's numbers: variants, design for a path, tolerances."""

from pkm_twin.design.pose_path import PosePath
from pkm_twin.design.quantities import QUANTITIES
from pkm_twin.design.search import Design, DesignPoint, design
from pkm_twin.design.sweep import Sweep, sweep
from pkm_twin.design.tolerance import Tolerances, drawn, tolerances

__all__ = [
    "QUANTITIES",
    "Design",
    "DesignPoint",
    "PosePath",
    "Sweep",
    "Tolerances",
    "design",
    "drawn",
    "sweep",
    "tolerances",
]
