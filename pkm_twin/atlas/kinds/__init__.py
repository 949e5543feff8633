# SPDX-License-Identifier: Apache-2.0
"""The kinds of maps, one a file."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from pkm_twin.atlas.kind import Kind
from pkm_twin.atlas.kinds.acceleration import Acceleration
from pkm_twin.atlas.kinds.compliance import Compliance
from pkm_twin.atlas.kinds.cutting_depth import CuttingDepth
from pkm_twin.atlas.kinds.frequency import Frequency
from pkm_twin.atlas.kinds.isotropy import Isotropy
from pkm_twin.atlas.kinds.modes import Modes
from pkm_twin.atlas.kinds.payload import Payload
from pkm_twin.atlas.kinds.pose_error import PoseError
from pkm_twin.atlas.kinds.speeds import Speeds
from pkm_twin.atlas.kinds.strain_energy import StrainEnergy
from pkm_twin.atlas.kinds.workspace import Workspace

_ALL: Final[tuple[type[Kind], ...]] = (
    Workspace, Compliance, StrainEnergy, Payload, Acceleration, Speeds, Frequency, Modes,
    CuttingDepth, PoseError, Isotropy,
)  # fmt: skip
KINDS: Final[Mapping[str, type[Kind]]] = MappingProxyType({kind.name: kind for kind in _ALL})
