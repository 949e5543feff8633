# SPDX-License-Identifier: Apache-2.0
"""The spanning tree of a description, with one axis a joint, and the values of its joints.

May import: numpy, the rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from pkm_twin.errors import ParameterError
from pkm_twin.machine.urdf_rows import (
    BASE,
    Array,
    Axis,
    Motion,
    Row,
    free_row,
    joint_row,
    rod_motion,
    rod_row,
)

FREEDOMS: Final = {
    "fixed": 0,
    "revolute": 1,
    "prismatic": 1,
    "cylindrical": 2,
    "universal": 2,
    "spherical": 3,
    "translation": 1,
}
"""What a joint costs as an edge; slides along fixed axes are no dearer than one."""


@dataclass(frozen=True, eq=False)
class Layout:
    """A machine's rows from the ground outwards, rods last; ``cut``: what closes its loops.

    ``names``: the single joints, in the order of their rows.
    """

    description: Mapping[str, Any]
    rows: tuple[Row, ...]
    cut: tuple[str, ...]

    @property
    def axes(self) -> list[Axis]:
        """The single joints, from the ground outwards."""
        return [axis for row in self.rows for axis in row.single]

    @property
    def names(self) -> tuple[str, ...]:
        """The single joints' names, from the ground outwards, the actuated ones among them."""
        return tuple(name for row in self.rows for name in row.names)

    def values(self, motions: Mapping[str, Motion]) -> Array:
        """The single joints' values, shape (..., count), rad and m.

        :param motions: of every body but the ground.
        """
        first = next(iter(motions.values()))
        known: dict[str, Motion] = {
            BASE: (np.broadcast_to(np.eye(3), first[0].shape), np.zeros_like(first[1])),
            **motions,
        }
        rods = self.description.get("rods", {})
        found = []
        for row in self.rows:
            if row.type == "rod":
                known[row.outer] = rod_motion(row, rods[row.source], known)
            found.append(row.values(known[row.inner], known[row.outer]))
        return np.concatenate(found, axis=-1)


def layout(description: Mapping[str, Any], tree: Sequence[str] | None = None) -> Layout:
    """The rows of a description whose limbs are written out.

    Bodies that no joint of the tree reaches hang free on the ground; rods close loops.

    :param tree: the joints of the spanning tree; default those of the fewest freedoms, the
        actuated joints first.
    :raises ParameterError: a tree with a loop, or one that leaves an actuated joint out.
    """
    joints, rods = description["joints"], description.get("rods", {})
    chosen = _spanning(description) if tree is None else list(tree)
    cut = [name for name in joints if name not in chosen]
    for name in cut:
        if joints[name].get("actuated"):
            raise ParameterError(f"joints.{name}", name, "actuated joints in the tree")
    rows: list[Row] = []
    reached, left = [BASE], list(description["bodies"])
    while True:
        for body in reached:
            for name in [n for n in chosen if body in joints[n]["between"]]:
                a, b = joints[name]["between"]
                other = b if a == body else a
                chosen.remove(name)
                if other in reached:
                    raise ParameterError(f"joints.{name}", name, "a tree without loops")
                reached.append(other)
                rows.append(joint_row(description, name, body, other))
        left = [body for body in left if body not in reached]
        if not left:
            break
        com = np.array(description["bodies"][left[0]].get("com", [0.0, 0.0, 0.0]), dtype=float)
        rows.append(free_row(left[0], com))
        reached.append(left[0])
    rows += [rod_row(name, rod) for name, rod in rods.items()]
    return Layout(description, tuple(rows), (*cut, *rods))


def _spanning(description: Mapping[str, Any]) -> list[str]:
    """Kruskal: actuated joints first, then the fewest freedoms."""
    joints = description["joints"]
    group = {body: body for body in (BASE, *description["bodies"])}

    def root(body: str) -> str:
        while group[body] != body:
            body = group[body]
        return body

    def rank(name: str) -> tuple[bool, int]:
        return not joints[name].get("actuated", False), FREEDOMS[joints[name]["type"]]

    chosen = []
    for name in sorted(joints, key=rank):
        a, b = (root(body) for body in joints[name]["between"])
        if a != b:
            group[a] = b
            chosen.append(name)
    return chosen
