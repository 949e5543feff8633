# SPDX-License-Identifier: Apache-2.0
"""Elastostatics of parallel kinematic machines: compliance, strain energy, workspace."""

from stiffness_monitor.compliance import StrainEnergy, compliance, stiffness, strain_energy
from stiffness_monitor.workspace import (
    RegularWorkspace,
    clearance,
    reachable,
    regular_workspace,
)

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
