# SPDX-License-Identifier: Apache-2.0
"""What is read off a stored modes atlas: planes across the axis, mode shapes, where energy is."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas import figures

if TYPE_CHECKING:
    from xarray import Dataset

Array = NDArray[np.float64]

ENLARGED: Final = 0.13
"""Largest displacement of a drawn mode shape over the size of the machine."""


def across(atlas: Dataset, values: Array) -> tuple[Array, Array, Array, tuple[str, str]]:
    """A field of a modes atlas in the plane across the axis: x, y, the field, and axes' labels.

    :param values: shape (distance, azimuth); of any unit.
    """
    distance, unit = figures.in_degrees(atlas.distance)
    turn, closed = figures.around(atlas.azimuth.values, values, 96)
    x, y = (distance[:, None] * f(turn) for f in (np.cos, np.sin))
    first, second = atlas.attrs["lateral"].split()
    if atlas.attrs["zero_torsion"] == "yes":
        labels = f"tilt towards azimuth 0° ({unit})", f"tilt towards azimuth 90° ({unit})"
        return x, y, closed, labels
    if unit == "deg":
        # As in the strain-energy pictures; azimuth 0 is towards the first.
        return y, x, closed, (f"{second} ({unit})", f"{first} ({unit})")
    return x, y, closed, (f"{first} ({unit})", f"{second} ({unit})")


def deformed(atlas: Dataset, mode: int) -> tuple[Array, Array]:
    """Nodes of a mode shape, enlarged, and how far each moves; (nodes, 3), m, and (nodes,).

    The second is over the largest of all nodes.
    """
    rest = atlas.position.values
    moved = atlas.displacement.sel(mode=mode).values
    far = np.linalg.norm(moved, axis=1)
    scale = ENLARGED * float(np.linalg.norm(np.ptp(rest, axis=0))) / far.max()
    return rest + scale * moved, far / far.max()


def grounded(atlas: Dataset) -> NDArray[np.int64]:
    """Nodes on the ground, by index: the ends that one line alone meets."""
    nodes, lines = np.unique(atlas.line.values, return_counts=True)
    return np.asarray(nodes[lines == 1], np.int64)


def largest_shares(atlas: Dataset, mode: int, kind: str = "strain", most: int = 3) -> str:
    """Which parts hold most of a mode's energy, as text.

    :param kind: ``strain`` or ``kinetic``.
    """
    shares = atlas[f"{kind}_share"].sel(mode=mode).values
    order = np.argsort(-shares, kind="stable")[:most]
    names = atlas.element.values
    return ", ".join(f"{names[k]} {100 * shares[k]:.0f} %" for k in order if shares[k] >= 0.005)


def shape_pose(atlas: Dataset) -> str:
    """The pose of the stored shapes, as text."""
    units = atlas.shape_pose.attrs["units"].split(", ")
    parts = []
    for name, value, unit in zip(
        atlas.parameter.values, atlas.shape_pose.values.tolist(), units, strict=True
    ):
        # Adding zero takes the sign off a zero.
        number = round(math.degrees(value), 1) if unit == "rad" else round(value, 3)
        parts.append(f"{name} = {number + 0.0:g} {'deg' if unit == 'rad' else unit}")
    return ", ".join(parts)
