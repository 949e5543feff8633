# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The gallery's pictures of all robots: ``python -m tools.pages.robots docs/gallery``."""

from __future__ import annotations

import sys
from pathlib import Path

from pkm_twin import load, robot_names
from pkm_twin.report import plots
from pkm_twin.view.drawing import DPI, draw

MACHINES = Path(__file__).parents[2] / "examples/machines"
GALLERY = sorted(path for path in MACHINES.iterdir() if path.suffix in (".yaml", ".urdf"))
"""Files of example machines."""
_PAGE = (MACHINES.parents[1] / "docs/index.md").read_text(encoding="utf-8")
PICTURED = [path for path in GALLERY if f"robot_{path.stem}.png" in _PAGE]
"""Machines with a picture on the page of machines."""


if __name__ == "__main__":
    for source in (*robot_names(), *PICTURED):
        target = Path(sys.argv[1]) / f"robot_{Path(source).stem}.png"
        plots.save(draw(load(source)), target, DPI)
