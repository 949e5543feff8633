# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Rigid-body dynamics of parallel kinematic machines."""

from delta_dynamics.estimates.contact import Contact, ContactMonitor, MomentumObserver, platform_wrench
from delta_dynamics.estimates.isolation import ContactPlace
from delta_dynamics.estimates.payload import PayloadEstimate, PayloadEstimator
from delta_dynamics.torques.at_pose import (
    PoseMotion,
    forward_dynamics_at_pose,
    inverse_dynamics_at_pose,
    mass_matrix_at_pose,
)
from delta_dynamics.torques.derivatives import TorqueDerivatives, torque_derivatives, torque_gradient
from delta_dynamics.torques.elastic_reactions import elastic_reactions
from delta_dynamics.torques.isotropy import (
    Extremes,
    JointMotion,
    energy_matrices,
    energy_transfer,
    energy_transfer_range,
    joint_motion,
    max_driving_force,
    max_driving_force_range,
    sphere_directions,
    spread,
    tilted_pose,
)
from delta_dynamics.torques.reactions import Reactions, least_norm_reactions, reactions
from delta_dynamics.torques.regressor import (
    BaseParameters,
    base_parameters,
    parameter_names,
    parameter_units,
    parameter_values,
    regressor,
)
from delta_dynamics.torques.torque_terms import Terms, dynamics_terms
from delta_dynamics.torques.transmission import Transmission, TransmissionState
from delta_dynamics.torques.uncertainty import torque_deviation
from delta_dynamics.torques.virtual_work import (
    Energy,
    energy,
    forward_dynamics,
    inverse_dynamics,
    mass_matrix,
    null_efforts,
)

__all__ = [
    "BaseParameters",
    "Contact",
    "ContactMonitor",
    "ContactPlace",
    "Energy",
    "Extremes",
    "JointMotion",
    "MomentumObserver",
    "PayloadEstimate",
    "PayloadEstimator",
    "PoseMotion",
    "Reactions",
    "Terms",
    "TorqueDerivatives",
    "Transmission",
    "TransmissionState",
    "base_parameters",
    "dynamics_terms",
    "elastic_reactions",
    "energy",
    "energy_matrices",
    "energy_transfer",
    "energy_transfer_range",
    "forward_dynamics",
    "forward_dynamics_at_pose",
    "inverse_dynamics",
    "inverse_dynamics_at_pose",
    "joint_motion",
    "least_norm_reactions",
    "mass_matrix",
    "mass_matrix_at_pose",
    "max_driving_force",
    "max_driving_force_range",
    "null_efforts",
    "parameter_names",
    "parameter_units",
    "parameter_values",
    "platform_wrench",
    "reactions",
    "regressor",
    "sphere_directions",
    "spread",
    "tilted_pose",
    "torque_derivatives",
    "torque_deviation",
    "torque_gradient",
]
