# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""3-PRRU paper: dynamics by virtual work, and dynamic isotropy. It prints no numbers."""

from __future__ import annotations

from typing import Final

from tools.papers.rows import Paper, Row

TEST: Final = "test/validation/test_prru_paper.py::"


def find_rows() -> Paper:
    """Return the paper's rows."""
    return Paper(
        "prru",
        "3-PRRU: dynamics and dynamic isotropy",
        {"equation": 48, "table": 0, "figure": 4},
        ("3-PRRU paper: it prints no numbers; its equations agree to rounding.",),
        (
            Row(
                "equation",
                (9,),
                "slider heights of a pose",
                ("pkm_twin.mechanisms.prru.Prru.solved",),
                (TEST + "test_position",),
            ),
        ),
    )
