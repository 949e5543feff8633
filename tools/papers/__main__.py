# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Draw the figures and write the page: ``python -m tools.papers docs``."""

from __future__ import annotations

import sys
from pathlib import Path

from tools.pages.pictures import draw_pictures
from tools.papers.page import MODULES, write_page


def main(docs: Path) -> None:
    """Compute every row, draw the pictures into ``docs/gallery``, and write ``docs/papers.md``."""
    papers = tuple(module.find_rows() for module in MODULES)
    gallery = docs / "gallery"
    rows = [row for paper in papers for row in paper.rows]
    ways = {name: way for row in rows for name, way in row.drawn_by.items()}
    wanted = {file for row in rows for file in row.pictures}
    draw_pictures(gallery, {name: w for name, w in ways.items() if isinstance(w, str)}, wanted)
    for name, way in ways.items():
        if not isinstance(way, str):
            way(gallery / name)
    (docs / "papers.md").write_text(write_page(papers), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
