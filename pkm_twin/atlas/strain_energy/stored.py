# SPDX-License-Identifier: Apache-2.0
"""What a stored strain-energy atlas says of its wrench and its tilts."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from pkm_twin.atlas.strain_energy.sweep import WRENCHES

if TYPE_CHECKING:
    from xarray import Dataset


def wrench_of(atlas: Dataset) -> tuple[float, ...]:
    """The wrench that made a strain-energy atlas, N and N m."""
    return tuple(json.loads(atlas.attrs["settings"])["wrench"])


def load_case(atlas: Dataset) -> str:
    """Robot and wrench of a strain-energy atlas, as text."""
    wrench = wrench_of(atlas)
    name = "".join(f"{name} = " for name, value in WRENCHES.items() if tuple(value) == wrench)
    numbers = ", ".join(f"{value:g}" for value in wrench)
    return f"{atlas.attrs['robot']} under {name}({numbers}) N, N m"


def lateral_of(atlas: Dataset) -> tuple[str, str]:
    """Names of the two tilts, at azimuth 0 and a quarter turn."""
    first, second = atlas.attrs["lateral"].split()
    return first, second
