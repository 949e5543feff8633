# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Draw which folder imports which: ``python -m tools.pages.architecture OUT.png``."""

from __future__ import annotations

import sys
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from pkm_twin.report import plots
from test.support import sources

CORE = "pkm_twin"
"""Its own modules, such as errors, are left out, as all folders import them."""


def is_folder(room):
    """Whether a room is a folder, or the nodes of one."""
    parts = room.removesuffix(".node").split(".")
    return room != CORE and sources.ROOT.joinpath(*parts).is_dir()


@cache
def below():
    """Return the folders that each folder imports."""
    pairs = [pair for pair in sources.arrows() if all(map(is_folder, pair))]
    names = sorted({name for pair in pairs for name in pair})
    return {n: frozenset(there for here, there in pairs if here == n) for n in names}


@cache
def reached(name):
    """Return the folders that a folder imports, directly or not."""
    return below()[name].union(*map(reached, below()[name]))


@cache
def level(name):
    """Return the length of the longest import chain below a folder; reject a cycle."""
    return 1 + max(map(level, below()[name]), default=-1)


@cache
def row_of(name):
    """Return a folder's row, below all folders that import it; 0 is the lowest."""
    above = [row_of(n) for n, found in below().items() if name in found]
    return min(above) - 1 if above else level(name)


def arrows():
    """Return pairs of importing and imported folder that no longer chain implies."""
    return [
        (here, there)
        for here, found in below().items()
        for there in sorted(found)
        if not any(there in reached(other) for other in found)
    ]


def places():
    """Place the folders: a row per level, near those with arrows to and from them."""
    rows = [[n for n in below() if row_of(n) == k] for k in range(max(map(row_of, below())) + 1)]
    x = {name: k - (len(row) - 1) / 2 for row in rows for k, name in enumerate(row)}
    for _ in range(50):
        for row in rows:
            near = {n: np.mean([x[b if a == n else a] for a, b in arrows() if n in (a, b)]) for n in row}
            row.sort(key=near.__getitem__)
            for k, name in enumerate(row):
                x[name] = 0.5 * near[name] + 0.5 * (k - (len(row) - 1) / 2)
            for left, right in pairwise(row):
                x[right] = max(x[right], x[left] + 1.0)
    return {name: (x[name], row_of(name)) for name in below()}


def draw(path):
    """Draw folders as boxes with arrows from importing to imported folders."""
    figure, ((ax,),) = plots.make_subplots(1, 1, 8)
    at = places()
    ends, boxes = np.array(list(at.values())), {}
    for name, place in at.items():
        box = {"boxstyle": "round,pad=0.4", "facecolor": "white", "edgecolor": "black"}
        words = name.removeprefix(f"{CORE}.").replace("_", "\n", 1).replace(".", "\n")
        text = ax.text(*place, words, ha="center", va="center", bbox=box, fontsize=9)
        boxes[name] = text.get_bbox_patch()
    ax.set_xlim(ends[:, 0].min() - 0.6, ends[:, 0].max() + 0.6)
    ax.set_ylim(ends[:, 1].min() - 0.5, ends[:, 1].max() + 0.5)
    ax.axis("off")
    figure.canvas.draw()  # Boxes have their sizes then.
    for here, there in arrows():
        style = {"arrowstyle": "-|>", "color": plots.COLOURS[0], "shrinkA": 0, "shrinkB": 1}
        style |= {"patchA": boxes[here], "patchB": boxes[there]}
        ax.annotate("", at[there], at[here], arrowprops=style, zorder=2)
    plots.save(figure, path, 100)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
