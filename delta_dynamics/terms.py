# SPDX-License-Identifier: Apache-2.0
"""The actuator efforts by cause: gravity, inertia, velocity, payload, friction, external wrench.

May import: numpy, pkm_twin's core, the standard library; never rclpy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from delta_dynamics.virtual_work import kernels
from pkm_twin.machine.bodies import (
    COULOMB,
    GRAVITY,
    HEAD,
    PAYLOAD_MASS,
    VISCOUS,
)
from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]

_FRICTION: Final = slice(VISCOUS, COULOMB + 3)
_PAYLOAD: Final = slice(PAYLOAD_MASS, HEAD)
_PULL: Final = slice(GRAVITY, GRAVITY + 3)


@dataclass(frozen=True)
class Terms:
    """Actuator efforts by cause, shape (..., 3) each, N m or N.

    ``gravity``, ``inertia`` (linear in qdd) and ``velocity`` (quadratic in qd) are those of the
    robot without its payload; ``payload`` is what the payload adds, its own gravity, inertia
    and velocity parts together; ``friction`` is viscous and Coulomb; ``external`` balances
    the wrench on the platform.
    """

    gravity: Array
    inertia: Array
    velocity: Array
    payload: Array
    friction: Array
    external: Array

    @property
    def total(self) -> Array:
        """Sum of all, shape (..., 3): what ``inverse_dynamics`` gives."""
        own = self.gravity + self.inertia + self.velocity
        return own + self.payload + self.friction + self.external


def dynamics_terms(
    robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, wrench: ArrayLike | None = None
) -> Terms:
    """Split the actuator efforts of a motion by cause, exactly.

    There is no second formula: each term is the inverse dynamics (virtual work; Delta-CU paper,
    step 4; 3-PRRU paper, equation 41) with the other causes switched off, or for payload and
    friction the difference of with and without, because the efforts are linear in gravity, qdd,
    the masses, the friction coefficients and the wrench.

    :param q: joint positions, shape (..., 3), rad or m.
    :param qd: joint rates, shape (..., 3).
    :param qdd: joint accelerations, shape (..., 3).
    :param wrench: as in ``inverse_dynamics``, shape (..., 6); None is none.
    :returns: the terms, each of the common batch shape.
    :raises UnreachableError: a joint state without an assembly, by limb, sample and miss.
    :raises SingularityError: the Jacobian of the closure has no inverse.
    :raises ValueError: a wrong last axis, or a value that is not finite.
    """
    *_, kernel = kernels(robot)
    load = np.zeros(6) if wrench is None else np.asarray(wrench, np.float64)
    arrays = [np.asarray(value, np.float64) for value in (q, qd, qdd)]
    # The batch of all inputs together, so that every term has it.
    shape = np.broadcast_shapes(*(a.shape[:-1] for a in arrays), load.shape[:-1])
    place, rate, change = (np.broadcast_to(a, (*shape, *a.shape[-1:])) for a in arrays)
    still = np.zeros(3)
    none = np.zeros(6)

    def efforts(p: Array, qd: Array, qdd: Array, wrench: Array) -> Array:
        tau, fault = kernel(p, place, qd, qdd, wrench)
        robot.raise_fault(fault, "joint state")
        return tau

    held = robot.parameters.copy()
    held[_FRICTION] = 0.0
    empty = held.copy()
    empty[_PAYLOAD] = 0.0
    weightless = empty.copy()
    weightless[_PULL] = 0.0
    rubbing = weightless.copy()
    rubbing[_FRICTION] = robot.parameters[_FRICTION]

    velocity = efforts(weightless, rate, still, none)
    return Terms(
        gravity=efforts(empty, still, still, none),
        inertia=efforts(weightless, still, change, none),
        velocity=velocity,
        payload=efforts(held, rate, change, none) - efforts(empty, rate, change, none),
        friction=efforts(rubbing, rate, still, none) - velocity,
        external=efforts(weightless, still, still, load),
    )
