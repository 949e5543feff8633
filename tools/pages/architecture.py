# SPDX-License-Identifier: Apache-2.0
"""Which folder imports which, as a picture: ``python -m tools.pages.architecture OUT.png``."""

from __future__ import annotations

import sys
from pathlib import Path

from test.support import sources

CORE = "pkm_twin"
"""Name of the modules beside pkm_twin's folders: errors and the like, that all may import."""
PLACES = {
    "apps": (2.0, 5.2),
    "delta_dynamics.node": (0.0, 4.2),
    "stiffness_monitor.node": (4.0, 4.2),
    "state.node": (6.6, 4.2),
    "maps": (2.0, 4.2),
    "export": (-1.2, 4.9),
    "design": (4.0, 4.7),
    "identification": (5.6, 4.9),
    "paths": (-1.0, 3.4),
    "ros": (5.6, 3.3),
    "delta_dynamics": (0.6, 3.0),
    "stiffness_monitor": (3.4, 3.0),
    "state": (6.8, 2.9),
    "streams": (4.6, 2.5),
    "messages": (5.6, 2.05),
    "mechanisms": (0.6, 2.1),
    "robot": (2.4, 1.75),
    "kinematics": (3.2, 1.15),
    "machine": (1.2, 0.6),
    "bags": (-1.2, 0.7),
    "codegen": (2.0, 0.0),
}
"""Where each folder stands; arrows go down."""


def name_of(room):
    """As the picture has it."""
    return room.removeprefix(f"{CORE}.")


def arrows():
    """Pairs of folders, who imports and what, without those to the core's own modules."""
    rooms = {f"{CORE}.{name}" for name in PLACES} | set(PLACES)
    return sorted(
        (name_of(here), name_of(there))
        for here, there in sources.arrows()
        if {here, there} <= rooms
    )


def draw(path):
    """Folders as boxes, an arrow from who imports to what."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, ax = pyplot.subplots(figsize=(10, 8), layout="constrained")
    for here, there in arrows():
        (x, y), (u, v) = PLACES[here], PLACES[there]
        ax.annotate(
            "",
            (u, v),
            (x, y),
            arrowprops={
                "arrowstyle": "-|>",
                "color": "#D55E00" if v >= y else "#0072B2",
                "alpha": 0.55,
                "shrinkA": 22,
                "shrinkB": 22,
                "connectionstyle": "arc3,rad=0.08",
            },
        )
    for name, (x, y) in PLACES.items():
        box = {"boxstyle": "round,pad=0.5", "facecolor": "white", "edgecolor": "black"}
        ax.text(x, y, name, ha="center", va="center", bbox=box, fontsize=11)
    ax.set(xlim=(-2, 7.5), ylim=(-0.5, 5.5))
    ax.axis("off")
    figure.savefig(path, dpi=90)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
