# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Dry friction of joints at rest: its direction is unknown, its size bounded.

At rest, friction holds the joint with any effort up to the dry friction in both directions. The
model has no friction there, so measured efforts may differ from it by up to the dry friction.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from delta_dynamics.torques.virtual_work import inverse_dynamics
from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.machine.friction import LoadDependent, read_friction_values, solve_load, sum_laws
from pkm_twin.robot.robot import Robot

SIGN_RATE: Final = 1e-6
"""Joint rate that sets the sign of dry friction while viscous friction is negligible, rad/s or m/s."""


def friction_reach(robot: Robot) -> Array:
    """Compute the effort of dry friction at each joint that moves alone, shape (n,), N m or N.

    At home, passive joints' friction included; zero for a robot without masses.
    """
    n = robot.joints_count
    if not robot.has_masses:
        return np.zeros(n)
    if robot.redundant:
        # No drive of a redundant machine can move alone: take each drive's own friction.
        return np.array(robot.friction.coulomb)
    q, still = robot.inverse(robot.home()), np.zeros(n)
    size = np.abs(inverse_dynamics(robot, q, still, still)).max()

    def odd_part(rate: float) -> Array:
        """Return the part of each joint's effort that changes its sign with the joint's rate."""
        rows = rate * np.eye(n)
        ahead = np.array([inverse_dynamics(robot, q, row, still) for row in rows])
        back = np.array([inverse_dynamics(robot, q, -row, still) for row in rows])
        return np.asarray(np.diag(ahead - back) / 2.0, np.float64)

    # Viscous friction doubles with the rates; a remainder below 1e-9 of the effort is rounding.
    reach = 2.0 * odd_part(SIGN_RATE) - odd_part(2.0 * SIGN_RATE)
    return np.where(reach > 1e-9 * (1.0 + size), reach, 0.0)


class LoadFrictionCompensation:
    """Remove the friction that grows with the load from measured efforts.

    An unknown payload or contact also increases this friction, so it cannot be computed from the
    known load. ``robot``: the robot without that friction law, for the remaining efforts.
    ``fraction``: friction as a fraction of the load, shape (n,).
    """

    def __init__(self, robot: Robot) -> None:
        self._full = self.robot = robot
        self.fraction = np.zeros(robot.joints_count)
        if LoadDependent.name in robot.laws:
            self.fraction = read_friction_values(robot.laws, robot.friction)["load_dependent"]
            self.robot = robot.changed(friction={"load_dependent": (0.0 * self.fraction).tolist()})

    def remove(self, q: Array, rates: Array, effort: Array) -> tuple[Array, Array]:
        """Return efforts without this friction, and its bound for joints at rest, (n,) each.

        :param rates: zero at rest.
        """
        if self.robot is self._full:
            return effort, self.fraction
        laws, own = self._full.laws, self._full.friction
        directions = np.sign(rates)
        position_friction, dry, share = sum_laws(laws, read_friction_values(laws, own), q, np.abs(rates))
        driving = effort - own.viscous * rates - own.offset - position_friction
        load = solve_load(driving - (own.coulomb + dry) * directions, share, directions)
        resting_bound = np.where(directions == 0.0, share / (1.0 - share) * np.abs(driving), 0.0)
        return effort - share * np.abs(load) * directions, resting_bound


def zero_resting_rates(qd: Array, still: Mask, reach: Array) -> Array:
    """Return rates (..., n), zero for joints at rest that have dry friction."""
    return np.where(still & (reach > 0.0), 0.0, qd)


def beyond_friction(residual: Array, still: Mask, reach: Array) -> Array:
    """Return the part of residuals beyond friction of resting joints, (..., n), N m or N."""
    slack = np.where(still, reach, 0.0)
    return np.asarray(np.sign(residual) * np.maximum(np.abs(residual) - slack, 0.0), np.float64)
