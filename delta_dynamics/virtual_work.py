# SPDX-License-Identifier: Apache-2.0
"""Rigid-body dynamics by virtual work, for every robot with masses.

May import: numpy, pkm_twin's core, the standard library; never rclpy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.codegen.kernels import Kernel
from pkm_twin.errors import ParameterError
from pkm_twin.machine.bodies import ROW, TWIST
from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]

_ZERO: Final = np.zeros(3)
_NO_WRENCH: Final = np.zeros(6)


def inverse_dynamics(
    robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, wrench: ArrayLike | None = None
) -> Array:
    """Actuator efforts for a motion, exact rigid-body dynamics.

    tau = sum over bodies of Jv' m (a - g) + Jw' (I alpha + omega x I omega), less J' wrench, plus
    friction: the principle of virtual work (Delta-CU paper, step 4; 3-PRRU paper, F_d).

    :param q: joint positions, shape (..., 3), rad or m.
    :param qd: joint rates, shape (..., 3).
    :param qdd: joint accelerations, shape (..., 3).
    :param wrench: force and moment that the surroundings apply to the platform at its
        origin, world axes, shape (..., 6), N and N m; None is none.
    :returns: what the actuators must apply, shape (..., 3), N m or N.
    :raises UnreachableError: a joint state without an assembly, by limb, sample and miss.
    :raises SingularityError: the Jacobian of the closure has no inverse.
    :raises ValueError: a wrong last axis, or a value that is not finite.
    """
    kernel = robot.dynamics_kernel
    if kernel is None:
        raise _no_masses(robot)
    tau, fault = kernel(robot.parameters, q, qd, qdd, _NO_WRENCH if wrench is None else wrench)
    if fault.ndim > 1 or fault.item(0) != 0.0:
        robot.raise_fault(fault, "joint state")
    return tau


def mass_matrix(robot: Robot, q: ArrayLike) -> Array:
    """Generalised mass matrix on the actuated joints, payload included, shape (..., 3, 3)."""
    still = robot.changed(gravity=[0.0, 0.0, 0.0], friction={"viscous": 0.0, "coulomb": 0.0})
    positions = np.asarray(q, np.float64)[..., None, :]
    return _symmetric(inverse_dynamics(still, positions, _ZERO, np.eye(3)))


def forward_dynamics(
    robot: Robot, q: ArrayLike, qd: ArrayLike, tau: ArrayLike, wrench: ArrayLike | None = None
) -> Array:
    """Joint accelerations that the efforts ``tau`` cause, shape (..., 3)."""
    rest = np.asarray(tau, np.float64) - inverse_dynamics(robot, q, qd, _ZERO, wrench)
    qdd = np.linalg.solve(mass_matrix(robot, q), rest[..., None])[..., 0]
    return np.asarray(qdd, np.float64)


@dataclass(frozen=True)
class Energy:
    """Kinetic and potential energy, shape (...), J; the potential is zero at the origin."""

    kinetic: Array
    potential: Array

    @property
    def total(self) -> Array:
        """Sum of both, shape (...), J."""
        return self.kinetic + self.potential


def energy(robot: Robot, q: ArrayLike, qd: ArrayLike) -> Energy:
    """Mechanical energy of all bodies, payload included."""
    rates = np.asarray(qd, np.float64)
    rows, _ = bodies(robot, q, _ZERO, _ZERO)
    weights = rows[..., 0:1] * robot.parameters[:3]
    potential = -np.einsum("...bi,...bi->...", weights, rows[..., 1:4])
    momentum = np.einsum("...ij,...j->...i", mass_matrix(robot, q), rates)
    kinetic = 0.5 * np.einsum("...i,...i->...", rates, momentum)
    return Energy(kinetic, np.broadcast_to(potential, kinetic.shape).copy())


def bodies(robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike) -> tuple[Array, Array]:
    """Rows of all bodies, shape (..., bodies, 28), see ``pkm_twin.machine.bodies``.

    :returns: the rows in the order of ``robot.body_names``, and the platform's twist per
        joint rate, shape (..., 6, 3).
    """
    kernel = robot.motion_kernel
    if kernel is None:
        raise _no_masses(robot)
    flat, fault = kernel(robot.parameters, q, qd, qdd)
    robot.raise_fault(fault, "joint state")
    batch = flat.shape[:-1]
    rows = flat[..., :-TWIST].reshape(*batch, len(robot.body_names), ROW)
    twist = flat[..., -TWIST:].reshape(*batch, 2, 3, 3).swapaxes(-1, -2)
    return rows, twist.reshape(*batch, 6, 3)


def kernels(robot: Robot) -> tuple[Kernel, ...]:
    """What a live node calls, to warm up before the first sample.

    :raises ParameterError: a mechanism without masses.
    """
    if robot.dynamics_kernel is None:
        raise _no_masses(robot)
    return (robot.dynamics_kernel,)


def _no_masses(robot: Robot) -> ParameterError:
    return ParameterError("mechanism", robot.mechanism, "a mechanism with masses (delta, prru)")


def _symmetric(matrix: Array) -> Array:
    return (matrix + matrix.swapaxes(-1, -2)) / 2
