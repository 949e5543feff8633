# SPDX-License-Identifier: Apache-2.0
"""What a stored isotropy atlas says of its poses, as text for its figures and its page."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from xarray import Dataset


def rates_of(atlas: Dataset) -> tuple[str, ...]:
    """Names of the pose rates, which the axes of a sphere are."""
    return tuple(f"d{name}/dt" for name in atlas.attrs["pose"].split())


def at_height(atlas: Dataset) -> str:
    """Robot and height of an isotropy atlas, as text."""
    settings = json.loads(atlas.attrs["settings"])
    return f"{atlas.attrs['robot']} at {settings['height_name']} = {settings['height']:.3f} m"
