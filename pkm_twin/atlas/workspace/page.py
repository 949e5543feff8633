# SPDX-License-Identifier: Apache-2.0
"""The page of a workspace atlas: slices of three coordinates, or one picture for each two."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

from pkm_twin.atlas import planes
from pkm_twin.atlas.planes import Label

if TYPE_CHECKING:
    from xarray import Dataset


LABELS: Final = {
    "singularity": Label("singularity index (dimensionless)", "singularity index", ""),
    "clearance": Label("clearance of the limbs (mm)", "clearance", "mm", 1e3),
    "joint_angle": Label(
        "largest passive joint angle (deg)", "passive angle", "deg", 180 / math.pi
    ),
}


def title(atlas: Dataset) -> str:
    """What the page shows, in a line."""
    return f"Workspace of {atlas.attrs['robot']}"


def page(atlas: Dataset) -> Any:
    """The reachable poses: slices of three coordinates, or one picture for each two."""
    return planes.page(title(atlas), atlas, LABELS, atlas.reachable > 0)
