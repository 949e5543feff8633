# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Actuator efforts by cause, and without friction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from delta_dynamics.torques.virtual_work import torques
from pkm_twin.codegen.arrays import Array, Indices, common_batch, vectors
from pkm_twin.machine.inertia import GRAVITY, Layout
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
        """Sum of all, shape (..., n): what ``inverse_dynamics`` gives."""
        own = self.gravity + self.inertia + self.velocity
        return own + self.payload + self.friction + self.external + self.preload


def efforts_without_friction(
    robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, *, weight: bool = True
) -> Array:
    """Compute the actuator efforts without friction of any joint, shape (..., n), N m or N.

    :param weight: False leaves gravity out, too.
    """
    layout = Layout(robot.massive().tree)
    p = _zero_part(robot.inertial, layout.friction)
    if not weight:
        p = _zero_part(p, layout.part(GRAVITY))
    return robot.evaluate(torques(robot), q, qd, qdd, np.zeros(6), p=p)[0]


def _zero_part(p: Array, part: slice | Indices) -> Array:
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
    kernel = torques(robot)
    load = np.zeros(6) if wrench is None else vectors(wrench, 6, "the wrench")
    n = robot.joints_count
    given = (q, "joint positions"), (qd, "joint rates"), (qdd, "joint accelerations")
    arrays = [vectors(values, n, what) for values, what in given]
    # The batch of all inputs together, so that every term has it.
    shape = common_batch(*(a.shape[:-1] for a in (*arrays, load)))
    place, rate, change = (np.broadcast_to(a, (*shape, *a.shape[-1:])) for a in arrays)
    still = np.zeros(n)
    none = np.zeros(6)

    def whole(p: Array, qd: Array, qdd: Array, wrench: Array) -> Array:
        return robot.evaluate(kernel, place, qd, qdd, wrench, p=p)[0]

    layout = Layout(robot.massive().tree)
    held = _zero_part(robot.inertial, layout.friction)
    empty = _zero_part(robot.own_inertial, layout.friction)
    weightless = _zero_part(empty, layout.part(GRAVITY))
    rubbing = _zero_part(robot.own_inertial, layout.part(GRAVITY))
    preload = np.zeros((*shape, n))
    if robot.redundant:
        # The effort that remains at rest without gravity, friction and wrench.
        preload = whole(weightless, still, still, none)

    def efforts(p: Array, qd: Array, qdd: Array, wrench: Array) -> Array:
        return whole(p, qd, qdd, wrench) - preload

    bent, linear = still, change
    if robot.redundant:
        # Accelerations of dependent drives are counted in the mass matrix's term.
        onto = robot.inverse_jacobian(place) @ robot.jacobian(place)
        bent = robot.project_redundant(place, rate)[2]
        bent = bent - np.einsum("...ij,...j->...i", onto, bent)
        linear = np.einsum("...ij,...j->...i", onto, change)
    velocity = efforts(weightless, rate, bent, none)
    friction = efforts(rubbing, rate, bent, none) - velocity
    if robot.laws:
        # Friction may grow with the load of the motion itself.
        both = (efforts(p, rate, change, load) for p in (robot.inertial, held))
        friction = next(both) - next(both)
    return Terms(
        gravity=efforts(empty, still, still, none),
        inertia=efforts(weightless, still, linear, none),
        velocity=velocity,
        payload=efforts(held, rate, change, none) - efforts(empty, rate, change, none),
        friction=friction,
        external=efforts(weightless, still, still, load),
        preload=preload,
    )
