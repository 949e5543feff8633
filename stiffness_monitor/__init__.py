# SPDX-License-Identifier: Apache-2.0
"""Elastostatics of parallel kinematic machines: compliance, strain energy, workspace."""

from pkm_twin.kinematics.clearance import clearance
from pkm_twin.kinematics.workspace import (
    RegularWorkspace,
    reachable,
    regular_workspace,
)
from stiffness_monitor.compliance import StrainEnergy, compliance, stiffness, strain_energy

__all__ = [
    "RegularWorkspace",
    "StrainEnergy",
    "clearance",
    "compliance",
    "reachable",
    "regular_workspace",
    "stiffness",
    "strain_energy",
]
