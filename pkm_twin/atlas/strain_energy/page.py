# SPDX-License-Identifier: Apache-2.0
"""The page of a strain-energy atlas: slices by height, of the energy or an element's factor."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pkm_twin.atlas import figures, pages
from pkm_twin.atlas.strain_energy.stored import lateral_of, load_case

if TYPE_CHECKING:
    from xarray import Dataset

Array = NDArray[np.float64]


def title(atlas: Dataset) -> str:
    """What the page shows, in a line."""
    return f"Strain energy of {load_case(atlas)}"


def page(atlas: Dataset) -> Any:
    """Slices of a strain-energy atlas.

    A menu chooses total energy or an element's factor, a slider one height or all.
    """
    part = pages.thinned(atlas, {"z": 12, "tilt": pages.MOST, "azimuth": 2 * pages.MOST})
    turn = np.append(part.azimuth.values, part.azimuth.values[0] + 2 * np.pi)
    tilt = np.degrees(part.tilt.values)[:, None]
    energy, unit = figures.prefixed(part.energy.values, "J")

    def closed(values: Array) -> Array:
        return np.stack([pages.closed(layer) for layer in values])

    # Over two decades: in steps of equal ratio, or all but the edge is one colour. Nothing has a
    # logarithm where nothing bears the wrench.
    ratio = bool(np.nanmin(energy) > 0.0)
    label = f"total strain energy ({unit})"
    fields = [pages.Shown(label, "energy", unit, closed(energy), logarithmic=ratio)]
    for k, name in enumerate(part.element.values):
        values = closed(part.factor.values[..., k])
        fields.append(
            pages.Shown(f"share of {name} (dimensionless)", f"factor of {name}", "", values)
        )
    first, second = lateral_of(atlas)
    return pages.layers(
        title(atlas),
        tilt * np.sin(turn),
        tilt * np.cos(turn),
        part.z.values,
        (second, first, "z"),
        ("deg", "deg", "m"),
        fields,
    )
