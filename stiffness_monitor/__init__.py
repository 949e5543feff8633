# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Elastostatics of parallel kinematic machines: compliance, strain energy, workspace."""

from pkm_twin.robot.clearance import clearance
from pkm_twin.robot.workspace import RegularWorkspace, reachable, regular_workspace
from stiffness_monitor.alarm import AlarmSettings, Departure, StiffnessAlarm
from stiffness_monitor.chatter import Lobes, Milling, stability_lobes, stable_depth
from stiffness_monitor.compliance import (
    PlatformResponse,
    StrainEnergy,
    compliance,
    platform_response,
    stiffness,
    strain_energy,
)
from stiffness_monitor.correction import Correction, setpoint_correction
from stiffness_monitor.derivatives import compliance_derivatives, compliance_deviation, deflection_deviation
from stiffness_monitor.limbs import LimbStiffness, limb_stiffness
from stiffness_monitor.response import ElementResponse, element_response
from stiffness_monitor.vibration import frequency_response, tool_modes

__all__ = [
    "AlarmSettings",
    "Correction",
    "Departure",
    "ElementResponse",
    "LimbStiffness",
    "Lobes",
    "Milling",
    "PlatformResponse",
    "RegularWorkspace",
    "StiffnessAlarm",
    "StrainEnergy",
    "clearance",
    "compliance",
    "compliance_derivatives",
    "compliance_deviation",
    "deflection_deviation",
    "element_response",
    "frequency_response",
    "limb_stiffness",
    "platform_response",
    "reachable",
    "regular_workspace",
    "setpoint_correction",
    "stability_lobes",
    "stable_depth",
    "stiffness",
    "strain_energy",
    "tool_modes",
]
