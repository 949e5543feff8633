# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The table of docs/engine.md: ``python -m tools.pages.engine docs/engine.md`` writes it anew."""

from __future__ import annotations

import sys
from pathlib import Path

from delta_dynamics.torques.virtual_work import torques
from pkm_twin import load, robot_names


def row(name):
    """Sizes of a robot's graph and programs."""
    robot = load(name)
    m = robot.engine.mobility
    newton, efforts = torques(robot).program.operations
    return f"| `{name}` | {m.unknowns} | {m.closures} | {m.rank} | {newton} | {efforts} |"


def rewritten(text):
    """The page with the table of today's robots."""
    lines = text.splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("| `"))
    rest = [line for line in lines[first:] if not line.startswith("| `")]
    return "\n".join([*lines[:first], *(row(name) for name in robot_names()), *rest]) + "\n"


if __name__ == "__main__":
    page = Path(sys.argv[1])
    page.write_text(rewritten(page.read_text(encoding="utf-8")), encoding="utf-8")
