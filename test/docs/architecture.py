# SPDX-License-Identifier: Apache-2.0
"""Which folder imports which, as a picture: ``python -m test.docs.architecture OUT.png``."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TOPS = ("pkm_twin", "delta_dynamics", "stiffness_monitor")
CORE = "pkm_twin"
"""Name of the modules beside pkm_twin's folders: errors and the like, that all may import."""
PLACES = {
    "apps": (2.0, 5.2),
    "delta_dynamics.node": (0.0, 4.2),
    "stiffness_monitor.node": (4.0, 4.2),
    "state.node": (6.6, 4.2),
    "atlas": (2.0, 4.2),
    "export": (-1.3, 3.4),
    "ros": (5.6, 3.3),
    "delta_dynamics": (0.6, 3.0),
    "stiffness_monitor": (3.4, 3.0),
    "state": (6.8, 2.9),
    "streams": (5.0, 2.2),
    "identification": (-0.6, 2.1),
    "mechanisms": (2.0, 2.0),
    "machine": (1.0, 1.0),
    "kinematics": (3.0, 1.0),
    "ros.messages": (5.2, 1.4),
    "bags": (-1.2, 0.7),
    "codegen": (2.0, 0.0),
}
"""Where each folder stands; arrows go down, but between machine and kinematics."""
PURE = "pkm_twin.ros.messages"
"""Messages to arrays, without ROS: stands apart from the folder that it is in."""


def part(module):
    """The folder of a module, a node's modules apart; None: not one of the package's."""
    names = module.split(".")
    if names[0] not in TOPS:
        return None
    if names[:3] == PURE.split("."):
        return "ros.messages"
    if names[0] != CORE:
        node = len(names) > 1 and names[1].endswith("node")
        return f"{names[0]}.node" if node else names[0]
    inside = len(names) > 1 and (ROOT / CORE / names[1]).is_dir()
    if not inside:
        return CORE
    # The base class of nodes is in ros.
    return ".".join(names[1:]) if names[2:] == ["node"] and names[1] != "ros" else names[1]


def is_module(name):
    """Whether a dotted name is a folder or a file of the package."""
    path = ROOT / Path(*name.split("."))
    return path.is_dir() or path.with_suffix(".py").is_file()


def running(tree):
    """Nodes of a source without those that stand for types alone."""
    todo = [tree]
    while todo:
        node = todo.pop()
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING":
            continue
        yield node
        todo += ast.iter_child_nodes(node)


def arrows():
    """Pairs of folders, who imports and what, without those to the core's own modules."""
    found = set()
    for top in TOPS:
        for path in sorted((ROOT / top).rglob("*.py")):
            here = part(".".join(path.relative_to(ROOT).with_suffix("").parts))
            for node in running(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Import):
                    modules = [alias.name for alias in node.names]
                elif isinstance(node, ast.ImportFrom) and node.module:
                    # What is imported may be a module of a folder, or a name in a module.
                    whole = [f"{node.module}.{alias.name}" for alias in node.names]
                    modules = [m if is_module(m) else node.module for m in whole]
                else:
                    continue
                for there in map(part, modules):
                    if CORE not in (here, there) and there not in (None, here):
                        found.add((here, there))
    return sorted(found)


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
