# SPDX-License-Identifier: Apache-2.0
"""Rigid-body dynamics of parallel kinematic machines."""

from delta_dynamics.virtual_work import (
    Energy,
    energy,
    forward_dynamics,
    inverse_dynamics,
    mass_matrix,
)

__all__ = ["Energy", "energy", "forward_dynamics", "inverse_dynamics", "mass_matrix"]
