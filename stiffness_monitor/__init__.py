# SPDX-License-Identifier: Apache-2.0
"""Elastostatics of parallel kinematic machines: compliance, strain energy, workspace."""

from pkm_twin.kinematics.clearance import clearance
from pkm_twin.kinematics.workspace import (
    RegularWorkspace,
    reachable,
    regular_workspace,
)
from stiffness_monitor.compliance import StrainEnergy, compliance, stiffness, strain_energy
from stiffness_monitor.correction import Correction, setpoint_correction
from stiffness_monitor.uncertainty import compliance_deviation

__all__ = [
    "Correction",
    "RegularWorkspace",
    "StrainEnergy",
    "clearance",
    "compliance",
    "compliance_deviation",
    "reachable",
    "regular_workspace",
    "setpoint_correction",
    "stiffness",
    "strain_energy",
]
