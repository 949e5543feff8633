# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Actuator efforts by cause, and without friction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from delta_dynamics.torques.virtual_work import torque_kernel
from pkm_twin.codegen.arrays import Array, Indices, common_batch, vectors
from pkm_twin.machine.inertia import GRAVITY_PART, Layout
from pkm_twin.robot.robot import Robot


@dataclass(frozen=True)
class Terms:
    """Actuator efforts by cause, shape (..., n) each, N m or N.

    ``gravity``, ``inertia`` (linear in qdd) and ``velocity`` (quadratic in qd) are those of the
    robot without its payload; ``payload`` is the gravity, inertia and velocity part of the
    payload together; ``friction`` is viscous, Coulomb and offset; ``external`` balances
    the wrench on the platform; ``preload``: efforts that move nothing, of a machine with more
    motors than degrees of freedom.
    """

    gravity: Array
    inertia: Array
    velocity: Array
    payload: Array
    friction: Array
    external: Array
    preload: Array

    @property
    def total(self) -> Array:
        """Sum of all terms, shape (..., n): the result of ``inverse_dynamics``."""
        own = self.gravity + self.inertia + self.velocity
        return own + self.payload + self.friction + self.external + self.preload


def efforts_without_friction(
    robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, *, weight: bool = True
) -> Array:
    """Compute the actuator efforts without friction of any joint, shape (..., n), N m or N.

    :param weight: False leaves gravity out, too.
    """
    layout = Layout(robot.massive().tree)
    p = _zero_inputs(robot.inertial, layout.friction)
    if not weight:
        p = _zero_inputs(p, layout.part(GRAVITY_PART))
    return robot.evaluate(torque_kernel(robot), q, qd, qdd, np.zeros(6), p=p)[0]


def _zero_inputs(p: Array, part: slice | Indices) -> Array:
    result = p.copy()
    result[part] = 0.0
    return result


def dynamics_terms(robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, wrench: ArrayLike | None = None) -> Terms:
    """Split the actuator efforts of a motion by cause, exactly.

    Each term is the inverse dynamics (virtual work; Delta-CU paper, equation 23; 3-PRRU paper,
    equation 41) with the other causes set to zero. The terms of payload and friction are
    differences of the efforts with and without them. This is exact because the efforts are linear
    in gravity, qdd, the masses, the basic friction's coefficients and the wrench; other friction
    laws are the difference of all efforts with and without friction.

    :returns: the terms, each of the common batch shape; parameters and errors as of
        :func:`~delta_dynamics.inverse_dynamics`.
    """
    kernel = torque_kernel(robot)
    load = np.zeros(6) if wrench is None else vectors(wrench, 6, "the wrench")
    n = robot.joints_count
    given = (q, "joint positions"), (qd, "joint rates"), (qdd, "joint accelerations")
    arrays = [vectors(values, n, what) for values, what in given]
    # Broadcast all inputs, so that every term has the same batch shape.
    shape = common_batch(*(a.shape[:-1] for a in (*arrays, load)))
    position, rate, acceleration = (np.broadcast_to(a, (*shape, *a.shape[-1:])) for a in arrays)
    still = np.zeros(n)
    none = np.zeros(6)

    def evaluate(p: Array, qd: Array, qdd: Array, wrench: Array) -> Array:
        return robot.evaluate(kernel, position, qd, qdd, wrench, p=p)[0]

    layout = Layout(robot.massive().tree)
    without_friction = _zero_inputs(robot.inertial, layout.friction)
    own_without_friction = _zero_inputs(robot.own_inertial, layout.friction)
    weightless = _zero_inputs(own_without_friction, layout.part(GRAVITY_PART))
    own_without_gravity = _zero_inputs(robot.own_inertial, layout.part(GRAVITY_PART))
    preload = np.zeros((*shape, n))
    if robot.redundant:
        # The effort that remains at rest without gravity, friction and wrench.
        preload = evaluate(weightless, still, still, none)

    def evaluate_less_preload(p: Array, qd: Array, qdd: Array, wrench: Array) -> Array:
        return evaluate(p, qd, qdd, wrench) - preload

    velocity_acceleration, inertia_acceleration = still, acceleration
    if robot.redundant:
        # Accelerations of dependent drives are counted in the mass matrix's term.
        projector = robot.inverse_jacobian(position) @ robot.jacobian(position)
        velocity_acceleration = robot.project_redundant(position, rate)[2]
        velocity_acceleration = velocity_acceleration - np.einsum("...ij,...j->...i", projector, velocity_acceleration)
        inertia_acceleration = np.einsum("...ij,...j->...i", projector, acceleration)
    velocity = evaluate_less_preload(weightless, rate, velocity_acceleration, none)
    friction = evaluate_less_preload(own_without_gravity, rate, velocity_acceleration, none) - velocity
    if robot.laws:
        # Friction may grow with the load of the motion itself.
        both = (evaluate_less_preload(p, rate, acceleration, load) for p in (robot.inertial, without_friction))
        friction = next(both) - next(both)
    return Terms(
        gravity=evaluate_less_preload(own_without_friction, still, still, none),
        inertia=evaluate_less_preload(weightless, still, inertia_acceleration, none),
        velocity=velocity,
        payload=evaluate_less_preload(without_friction, rate, acceleration, none)
        - evaluate_less_preload(own_without_friction, rate, acceleration, none),
        friction=friction,
        external=evaluate_less_preload(weightless, still, still, load),
        preload=preload,
    )
