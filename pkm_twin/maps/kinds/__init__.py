# SPDX-License-Identifier: Apache-2.0
"""The kinds of maps, one a file."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from pkm_twin.maps.kind import Kind
from pkm_twin.maps.kinds.acceleration import Acceleration
from pkm_twin.maps.kinds.compliance import Compliance
from pkm_twin.maps.kinds.cutting_depth import CuttingDepth
from pkm_twin.maps.kinds.frequency import Frequency
from pkm_twin.maps.kinds.isotropy import Isotropy
from pkm_twin.maps.kinds.modes import Modes
from pkm_twin.maps.kinds.payload import Payload
from pkm_twin.maps.kinds.pose_error import PoseError
from pkm_twin.maps.kinds.speeds import Speeds
from pkm_twin.maps.kinds.strain_energy import StrainEnergy
from pkm_twin.maps.kinds.workspace import Workspace

_ALL: Final[tuple[type[Kind], ...]] = (
    Workspace, Compliance, StrainEnergy, Payload, Acceleration, Speeds, Frequency, Modes,
    CuttingDepth, PoseError, Isotropy,
)  # fmt: skip
KINDS: Final[Mapping[str, type[Kind]]] = MappingProxyType({kind.name: kind for kind in _ALL})
