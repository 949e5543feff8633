# SPDX-License-Identifier: Apache-2.0
"""Joints of several freedoms, and rods, as rows of joints with one axis each.

May import: numpy, the rotations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.machine.rotations import about, across

Array = NDArray[np.float64]

BASE: Final = "base"
"""The ground's name in a description."""
STEPS: Final = {
    "fixed": (),
    "revolute": ("",),
    "prismatic": ("",),
    "cylindrical": ("1", "2"),
    "universal": ("1", "2"),
    "spherical": ("x", "y", "z"),
    "translation": ("x", "y", "z"),
    "free": ("px", "py", "pz", "x", "y", "z"),
}
"""What the single joints of a type are called after its name."""
Motion = tuple[Array, Array]
"""Rotation (..., 3, 3) and shift (..., 3), m, that bring a point from home: ``R x + t``."""


@dataclass(frozen=True, eq=False)
class Axis:
    """One single joint: ``kind`` R or P, or nothing if fixed; ``axis`` (3,) and ``point`` (3,) m.

    ``inner``, ``outer``: bodies or rods of the description, or massless links between.
    ``joint``: the joint or rod it is one axis of.
    """

    name: str
    kind: str
    axis: Array
    point: Array
    inner: str
    outer: str
    joint: str


@dataclass(frozen=True, eq=False)
class Row:
    """The single joints in a row that lead from one body or rod to the next, outwards.

    ``source``: the joint or rod that it stands for; ``names``: the single joints'; ``kinds``: R
    or P each; ``axes``: (count, 3) and ``point``: (3,) m, base axes at home; ``home``: the first
    one's value at home.
    """

    source: str
    type: str
    inner: str
    outer: str
    point: Array
    names: tuple[str, ...]
    kinds: str
    axes: Array
    home: float

    @property
    def single(self) -> list[Axis]:
        """The single joints, with links of their names between them."""
        if not self.names:
            nowhere = np.zeros(3)
            return [Axis(self.source, "", nowhere, self.point, self.inner, self.outer, self.source)]
        between = [f"{name}_link" for name in self.names[:-1]]
        links = [self.inner, *between, self.outer]
        return [
            Axis(name, kind, axis, self.point, links[i], links[i + 1], self.source)
            for i, (name, kind, axis) in enumerate(
                zip(self.names, self.kinds, self.axes, strict=True)
            )
        ]

    def values(self, inner: Motion, outer: Motion) -> Array:
        """The joints' values in given motions of the two, shape (..., count), rad and m."""
        back = np.swapaxes(inner[0], -1, -2)
        rotation = back @ outer[0]
        point = _moved(outer, self.point) - inner[1]
        slip = np.einsum("...ij,...j->...i", back, point) - self.point
        found = []
        for i, (kind, axis) in enumerate(zip(self.kinds, self.axes, strict=True)):
            if kind == "P":
                value = slip @ axis
            else:
                # Seen from here, the last axis is turned by this joint and the ones between.
                far = self.axes[-1] if i + 1 < len(self.axes) else across(axis)
                side = np.cross(axis, far)
                seen = np.einsum("...ij,j->...i", rotation, far)
                value = np.arctan2(seen @ side, seen @ np.cross(side, axis))
                rotation = about(axis, -value) @ rotation
            found.append(value + self.home if i == 0 else value)
        return np.stack(found, axis=-1) if found else np.zeros((*rotation.shape[:-2], 0))


def joint_row(description: Mapping[str, Any], name: str, inner: str, outer: str) -> Row:
    """The row of a joint between two bodies, seen from ``inner``, whichever way it is given."""
    joint = description["joints"][name]
    kind, axes = joint["type"], axes_of(joint)
    if kind in ("spherical", "translation"):
        axes = np.eye(3)
    elif kind == "cylindrical":
        axes = np.array([axes[0], axes[0]])
    kinds = {"prismatic": "P", "translation": "PPP", "cylindrical": "PR"}.get(kind, "R" * len(axes))
    names = tuple(f"{name}_{end}" if end else name for end in STEPS[kind])
    if joint["between"][0] != inner:
        # Seen from the outer body all runs backwards, with the same values.
        axes = -axes
        if kind in ("universal", "translation"):
            axes, names = axes[::-1], names[::-1]
    home = float(joint.get("home", 0.0)) if len(names) == 1 else 0.0
    point = point_of(description, joint)
    return Row(name, kind, inner, outer, point, names, kinds, axes, home)


def free_row(body: str, com: Array) -> Row:
    """The row of a body that no joint reaches: three slides and three turns from the ground."""
    names = tuple(f"{body}_free_{end}" for end in STEPS["free"])
    axes = np.concatenate([np.eye(3), np.eye(3)])
    return Row(f"{body}_free", "free", BASE, body, com, names, "PPPRRR", axes, 0.0)


def rod_row(name: str, rod: Mapping[str, Any]) -> Row:
    """A rod on two hinges across it at its inner end; with the rod they are right-handed."""
    start, end = (np.array(end, dtype=float) for end in rod["ends"])
    along = (end - start) / np.linalg.norm(end - start)
    first = across(along)
    axes = np.array([first, np.cross(along, first)])
    names = (f"{name}_1", f"{name}_2")
    return Row(name, "rod", rod["between"][0], name, start, names, "RR", axes, 0.0)


def rod_motion(row: Row, rod: Mapping[str, Any], known: Mapping[str, Motion]) -> Motion:
    """How a rod moves that does not turn about itself, from the motions of its two bodies."""
    inner, outer = (known[body] for body in rod["between"])
    start = _moved(inner, row.point)
    end = _moved(outer, np.array(rod["ends"][1], dtype=float))
    along = np.einsum("...ji,...j->...i", inner[0], end - start)
    along = along / np.linalg.norm(along, axis=-1)[..., None]
    first, second = row.axes
    turned = np.arctan2(-(along @ second), along @ np.cross(first, second))
    raised = np.arcsin(np.clip(along @ first, -1.0, 1.0))
    rotation = inner[0] @ about(first, turned) @ about(second, raised)
    return rotation, start - np.einsum("...ij,j->...i", rotation, row.point)


def axes_of(joint: Mapping[str, Any]) -> Array:
    """The axes that a joint is given with, unit vectors, shape (count, 3)."""
    axes = joint.get("axes", [joint["axis"]] if "axis" in joint else [])
    found = np.reshape(np.array(axes, dtype=float), (-1, 3))
    unit: Array = found / np.linalg.norm(found, axis=1)[:, None]
    return unit


def point_of(description: Mapping[str, Any], joint: Mapping[str, Any]) -> Array:
    """Where a joint is; one that may stand anywhere stands in the outer body's centre."""
    body = description["bodies"].get(joint["between"][1], {})
    return np.array(joint.get("at", body.get("com", [0.0, 0.0, 0.0])), dtype=float)


def _moved(motion: Motion, point: Array) -> Array:
    moved: Array = np.einsum("...ij,j->...i", motion[0], point) + motion[1]
    return moved
