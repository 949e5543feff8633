# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""2UPR-RPU paper: stiffness by screw theory and strain energy."""

from __future__ import annotations

import math
from typing import Final

from pkm_twin import load
from stiffness_monitor import strain_energy
from tools.papers.rows import Comparison, Paper, Printed, Row

TEST: Final = "test/validation/test_upr_rpu_paper.py::"
LOAD: Final = (30.0, -50.0, -40.0, 10.0, -20.0, 50.0)
"""Of table 1, N and N m."""
COMPONENTS: Final = ("x, µm", "y, µm", "z, µm", "rx, µrad", "ry, µrad", "rz, µrad")
TABLE_1: Final = {
    "configuration 1": (
        (-0.6, 0.0, 0.0),
        "3.400 -1.062 0.006 0.646 2.671 7.756",
        "3.503 -1.137 0.006 0.701 2.852 8.287",
    ),
    "configuration 2": (
        (-0.6, math.radians(5), math.radians(-3)),
        "3.627 -1.184 -0.119 0.863 2.170 8.459",
        "3.862 -1.265 -0.125 0.911 2.276 8.924",
    ),
}
"""Pose; deflections by theory, and by finite elements."""
ELEMENTS: Final = ("1R", "1B", "1U", "2R", "2B", "2U", "3R", "3B", "3U")
TABLE_2: Final = {
    "P1": ((0.0, 0.0, 1.0, 0.0, 0.0, 0.0), "0.044 0.254 0.146 0.044 0.254 0.146 0.007 0.083 0.023"),
    "P2": (
        (0.8, 0.3, 0.52, 0.0, 0.0, 0.0),
        "1.39e-4 0.036 1.99e-4 9.55e-4 0.122 6.06e-4 0.007 0.825 0.008",
    ),
    "P3": (
        (0.52, 0.3, 0.8, 0.5, 0.7, 0.51),
        "0.002 0.216 0.003 0.004 0.194 0.011 0.007 0.550 0.012",
    ),
}
"""Load, N and N m; global strain-energy factors of the elements."""


def find_rows() -> Paper:
    """Compute the paper's tables and return its rows."""
    robot = load("upr_rpu")
    deflections = {}
    for name, (pose, theory, _) in TABLE_1.items():
        found = 1e6 * strain_energy(robot, pose, LOAD).deflection
        deflections[name] = [Printed(t, v) for t, v in zip(theory.split(), found, strict=True)]
    table_1 = Comparison("2UPR-RPU: table 1, deflections by theory", COMPONENTS, deflections)
    return Paper(
        "upr_rpu",
        "2UPR-RPU: stiffness by screws and strain energy",
        {"equation": 40, "table": 2, "figure": 10},
        ("2UPR-RPU paper: table 1 agrees.",),
        (
            Row(
                "table",
                (1,),
                "deflections of two configurations",
                ("stiffness_monitor.strain_energy",),
                (TEST + "test_table_1_theory",),
                comparisons=(table_1,),
            ),
        ),
    )
