# SPDX-License-Identifier: Apache-2.0
"""A machine that moves: its rigid bodies under efforts, with dry friction and stops.

In the actuated joints' coordinates, so that no loop can drift open. Pure: time is a step.

May import: numpy, pkm_twin's core, this package; never rclpy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from delta_dynamics.virtual_work import forward_dynamics, mass_matrix
from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]

SWEEPS: Final = 500
"""Most sweeps of the search for rates under dry friction; it ends where they stand still."""


@dataclass
class Plant:
    """A robot's state and how it goes on.

    A step is one of the classical Runge-Kutta method, efforts and wrench constant in it. Coulomb
    friction and stops act as a constant load of the step: the one that the implicit law of friction
    (Moreau's time stepping) asks for, so that a joint sticks exactly and leaves only beyond
    its friction. Friction of passive joints acts while they move. Stops do not bounce.
    """

    robot: Robot
    q: Array
    qd: Array = field(init=False)

    def __post_init__(self) -> None:
        self.q = np.array(self.q, np.float64)
        self.qd = np.zeros_like(self.q)
        self.change_robot(self.robot)

    def change_robot(self, robot: Robot) -> None:
        """Go on as a robot of the same joints, with another payload."""
        n = robot.joints_count
        self.robot = robot
        self._coulomb = np.array(robot.friction.coulomb, np.float64)
        self._smooth = robot.changed(friction={"coulomb": [0.0] * n})
        self._rubs = bool(self._coulomb.any())
        limits = robot.limits.position
        limits = np.tile([-math.inf, math.inf], (n, 1)) if limits is None else limits
        self._low, self._high = limits[:, 0].copy(), limits[:, 1].copy()

    def rest(self) -> None:
        """Stand still."""
        self.qd = np.zeros_like(self.q)

    def advance(self, effort: Array, wrench: Array, step: float) -> None:
        """Go on by a step, s.

        :param effort: of the actuators, shape (n,), N m or N.
        :param wrench: what the surroundings apply to the platform at its reference point, base
            axes, shape (6,), N and N m.
        :raises UnreachableError: the machine has left where it can be assembled.
        :raises SingularityError: it has reached a singularity.
        :raises ValueError: a result that is not finite.
        """
        robot, q, qd = self._smooth, self.q, self.qd
        first = forward_dynamics(robot, q, qd, effort, wrench)
        rates = self._resisted(first, step)
        if rates is not None:
            matrix = mass_matrix(robot, q)
            load = matrix @ (qd + step * first - rates) / step
            effort = effort - load
            first = (rates - qd) / step
        half = 0.5 * step
        second_qd = qd + half * first
        second = forward_dynamics(robot, q + half * qd, second_qd, effort, wrench)
        third_qd = qd + half * second
        third = forward_dynamics(robot, q + half * second_qd, third_qd, effort, wrench)
        last_qd = qd + step * third
        last = forward_dynamics(robot, q + step * third_qd, last_qd, effort, wrench)
        moved = q + (step / 6.0) * (qd + 2.0 * (second_qd + third_qd) + last_qd)
        self.qd = qd + (step / 6.0) * (first + 2.0 * (second + third) + last)
        self.q = np.clip(moved, self._low, self._high)
        if rates is None:
            return
        stopped = rates == 0.0
        self.qd[stopped] = 0.0
        held = stopped & (qd == 0.0)
        self.q[held] = q[held]
        outward = ((moved >= self._high) & (self.qd > 0.0)) | (
            (moved <= self._low) & (self.qd < 0.0)
        )
        self.qd[outward] = 0.0

    def _resisted(self, acceleration: Array, step: float) -> Array | None:
        """Rates at the step's end under dry friction and stops; None where neither acts.

        They are least in (v - free)' M (v - free) / 2 + step sum C |v| within the rates that the
        stops leave, whose optimality is Coulomb's law.
        """
        free = self.qd + step * acceleration
        low, high = (self._low - self.q) / step, (self._high - self.q) / step
        inside = bool(((free >= low) & (free <= high)).all())
        if not self._rubs and inside:
            return None
        matrix = mass_matrix(self._smooth, self.q)
        impulse = step * self._coulomb
        if inside:
            sliding = np.sign(self.qd)
            rates = free - np.linalg.solve(matrix, impulse * sliding)
            kept = (np.sign(rates) == sliding) & (sliding != 0.0)
            if bool((kept | (impulse == 0.0)).all() and ((rates >= low) & (rates <= high)).all()):
                return np.asarray(rates, np.float64)
        return _least(matrix, free, impulse, low, high)


def _least(matrix: Array, free: Array, impulse: Array, low: Array, high: Array) -> Array:
    """The rates of :meth:`Plant._resisted`, coordinate by coordinate, shape (n,)."""
    rows = matrix.tolist()
    goal, dry = free.tolist(), impulse.tolist()
    bounds = list(zip(low.tolist(), high.tolist(), strict=True))
    v = [0.0] * len(goal)
    size = 1e-15 * max(map(abs, goal))
    for _ in range(SWEEPS):
        change = 0.0
        for j, row in enumerate(rows):
            # The best rate of joint j alone, without friction, then with it and with the stops.
            pull = sum(row[k] * (goal[k] - v[k]) for k in range(len(v)) if k != j)
            own = goal[j] + pull / row[j]
            best = math.copysign(max(abs(own) - dry[j] / row[j], 0.0), own)
            best = min(max(best, bounds[j][0]), bounds[j][1])
            change = max(change, abs(best - v[j]))
            v[j] = best
        if change <= size:
            break
    # Zeros of both signs are one.
    return np.array(v) + 0.0
