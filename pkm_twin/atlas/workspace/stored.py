# SPDX-License-Identifier: Apache-2.0
"""The planes of a stored workspace atlas without an axis: two coordinates, the others held.

May import: numpy, this package, the standard library.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas.workspace.sweep import SLICED

if TYPE_CHECKING:
    from xarray import Dataset

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Plane:
    """Two pose coordinates of an atlas without an axis, all others held.

    ``names``, ``units`` and ``ticks`` of both, angles in degrees; ``where`` says the others.
    ``fields``: by name, shape (first, second); of one coordinate the second is a single tick.
    """

    names: tuple[str, str]
    units: tuple[str, str]
    ticks: tuple[Array, Array]
    where: str
    fields: Mapping[str, Array]


def planes(atlas: Dataset) -> list[Plane]:
    """Every pair of coordinates of an atlas without an axis, through the home pose."""
    names = ("singularity", "clearance", "joint_angle")
    fields = [name for name in names if name in atlas]
    result = []
    home = dict(zip(atlas.coordinate.values, atlas.home.values.tolist(), strict=True))
    if atlas.singularity.dims == SLICED:
        for k in range(atlas.sizes["slice"]):
            part = atlas.isel(slice=k)
            pair = str(part.row_name.values), str(part.column_name.values)
            shown = [
                _degrees(part[f"{dim}_value"].values, str(part[f"{dim}_unit"].values))
                for dim in ("row", "column")
            ]
            result.append(_plane(atlas, pair, shown, home, {f: part[f].values for f in fields}))
        return result
    dims = atlas.singularity.dims
    cut = {name: int(np.abs(atlas[name].values - home[name]).argmin()) for name in dims}
    held = {name: float(atlas[name][k]) for name, k in cut.items()}
    for pair in itertools.combinations(dims, 2):
        part = atlas.isel({name: k for name, k in cut.items() if name not in pair})
        shown = [_degrees(atlas[name].values, atlas[name].attrs["units"]) for name in pair]
        result.append(_plane(atlas, pair, shown, held, {f: part[f].values for f in fields}))
    return result


def _plane(
    atlas: Dataset,
    pair: tuple[str, str],
    shown: Sequence[tuple[Array, str]],
    held: Mapping[str, float],
    fields: Mapping[str, Array],
) -> Plane:
    (first, one), (second, other) = shown
    units = _units(atlas)
    others = [
        f"{name} = {float(_degrees(np.array(value), units[name])[0]):.4g} "
        f"{'deg' if units[name] == 'rad' else units[name]}"
        for name, value in held.items()
        if name not in pair
    ]
    return Plane(pair, (one, other), (first, second), ", ".join(others), fields)


def _units(atlas: Dataset) -> dict[str, str]:
    """Units of the pose coordinates."""
    if atlas.singularity.dims == SLICED:
        return dict(zip(atlas.coordinate.values, atlas.unit.values, strict=True))
    return {name: atlas[name].attrs["units"] for name in atlas.singularity.dims}


def _degrees(values: Array, unit: str) -> tuple[Array, str]:
    return (np.degrees(values), "deg") if unit == "rad" else (values, unit)
