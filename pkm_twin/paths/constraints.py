# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write limits of a motion along a path as rows in the path's acceleration and speed.

With v = ds/dt, x = v^2 and u = d2s/dt2 the efforts are exactly

    tau = a u + b x + w v + k + g,

with a from the masses, b from the velocity terms, w from viscous and k from dry friction in the
direction of the path, g from gravity, offsets and the wrench. Five calls of the inverse dynamics
give these coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, check_limit
from pkm_twin.paths.joint_path import Index, JointPath, describe_place
from pkm_twin.robot.robot import Robot

MIN_RATE_FRACTION: Final = 1e-12
"""Velocity, relative to the largest, below which a joint does not move: rounding."""


@dataclass(frozen=True)
class Limits:
    """Hold limits of a motion; infinite means no limit.

    ``effort``, ``velocity``, ``acceleration``, ``jerk``: of the actuated joints, shape (n,).
    ``speed``: of the platform's reference point, m/s.
    """

    effort: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    speed: float = np.inf

    @classmethod
    def of(
        cls,
        robot: Robot,
        *,
        effort: ArrayLike | None = None,
        velocity: ArrayLike | None = None,
        acceleration: ArrayLike | None = None,
        jerk: ArrayLike | None = None,
        speed: float | None = None,
        share: float = 1.0,
    ) -> Limits:
        """Return the limits of a robot's file, or those given; one number applies to all joints.

        :param share: part of the file's efforts and velocities that a motion may use.
        :raises ParameterError: a limit that no machine has, or too many numbers.
        """
        n = robot.joints_count
        own = robot.limits
        if not 0.0 < share <= 1.0:
            raise ParameterError("share", share, "above 0, at most 1")

        def of(name: str, given: ArrayLike | None, file: Array | None) -> Array:
            if given is None:
                return np.full(n, np.inf) if file is None else share * np.asarray(file, float)
            values = np.asarray(given, float)
            if values.shape not in ((), (1,), (n,)):
                raise ParameterError(name, values.tolist(), f"one number, or {n}")
            for value in values[~np.isposinf(values)].ravel().tolist():
                check_limit(name, value)
            return np.broadcast_to(values, (n,)).astype(float)

        most = np.inf if speed is None else float(speed)
        if most != np.inf:
            check_limit("speed", most, "m/s")
        return cls(
            of("effort", effort, own.effort),
            of("velocity", velocity, own.velocity),
            of("acceleration", acceleration, None),
            of("jerk", jerk, None),
            most,
        )

    def part(self, share: float) -> Limits:
        """Return the limits scaled by ``share``."""
        return Limits(
            share * self.effort,
            share * self.velocity,
            share * self.acceleration,
            share * self.jerk,
            share * self.speed,
        )

    def check(self) -> None:
        """Reject limits that do not bound the speed.

        :raises ParameterError: no limit is finite.
        """
        bounds = (self.effort, self.velocity, self.acceleration, self.jerk)
        if not (np.isfinite(self.speed) or any(np.isfinite(b).any() for b in bounds)):
            raise ParameterError(
                "limits",
                "none",
                "a limit of effort, velocity, acceleration or speed, in the robot's file or given",
            )


def needs_forces(part: JointPath, limits: Limits) -> bool:
    """Return whether efforts bound the motion.

    :raises ParameterError: they do, and the robot's file has no masses.
    """
    if not np.isfinite(limits.effort).any():
        return False
    part.curve.robot.massive()
    return True


@dataclass(frozen=True)
class Forces:
    """Hold the coefficients a, b, w, k and g of the efforts at points of a path, shape (p, n) each."""

    a: Array
    b: Array
    w: Array
    k: Array
    g: Array

    @classmethod
    def from_inverse_dynamics(
        cls,
        part: JointPath,
        points: Index,
        q: Array,
        first: Array,
        second: Array,
        wrench: Array | None = None,
    ) -> Forces:
        """Compute the coefficients from the inverse dynamics at q with derivatives by s, (p, n) each.

        :param points: of the stretch, whose payloads are carried, (p,).
        :param wrench: on the platform all the time, (6,); None: no wrench.
        :raises ParameterError: a friction law that these coefficients do not describe.
        """
        if part.curve.robot.laws:
            raise ParameterError(
                "friction",
                part.curve.robot.laws[0],
                "only viscous, coulomb and offset friction for a fastest motion",
            )
        zero = np.zeros_like(q)
        rates = (zero, zero, first, -first, 2.0 * first)
        changes = (zero, first, second, second, 4.0 * second)
        efforts = part.efforts(
            np.tile(points, 5),
            np.tile(q, (5, 1)),
            np.concatenate(rates),
            np.concatenate(changes),
            wrench,
        )
        g, a, ahead, back, twice = efforts.reshape(5, *q.shape)
        b = 0.5 * (ahead + back) - g
        odd = 0.5 * (ahead - back)
        w = twice - g - 4.0 * b - odd
        # Remainders of the size of rounding errors are not friction.
        size = 1e-12 * np.abs(efforts).max(initial=0.0)
        w = np.where(np.abs(w) > size, w, 0.0)
        k = odd - w
        return cls(a - g, b, w, np.where(np.abs(k) > size, k, 0.0), g)

    def efforts(self, v: Array, u: Array) -> Array:
        """Return efforts at speeds v and accelerations u along the path, (p,) each: (p, n)."""
        moving = (v > 0.0)[:, None]
        v, u = v[:, None], u[:, None]
        # Dry friction also acts at rest if the joint accelerates.
        moving |= u != 0.0
        return self.a * u + self.b * v**2 + self.w * v + self.g + np.where(moving, self.k, 0.0)


@dataclass(frozen=True)
class Rows:
    """Hold limits at points of a path, scaled to 1, and the largest x there.

    -1 <= alpha u + beta x + viscous v + fixed + dry <= 1, shape (p, r), and x <= most, shape (p,).
    ``dry``: dry friction, which changes sign where a joint reverses.
    """

    alpha: Array
    beta: Array
    viscous: Array
    fixed: Array
    dry: Array
    most: Array

    @classmethod
    def from_limits(cls, part: JointPath, limits: Limits, wrench: Array | None) -> Rows:
        """Return the finite limits at the points of a stretch as rows.

        :raises ParameterError: the drives cannot hold the machine at rest at a point.
        """
        zero = np.zeros_like(part.first)
        tables = [(limits.acceleration, (part.first, part.second, zero, zero, zero))]
        if needs_forces(part, limits):
            points = np.arange(len(part.s))
            forces = Forces.from_inverse_dynamics(part, points, part.q, part.first, part.second, wrench)
            tables.insert(0, (limits.effort, (forces.a, forces.b, forces.w, forces.g, forces.k)))
        columns = []
        for bound, values in tables:
            used = np.isfinite(bound)
            columns.append([value[:, used] * (1.0 / bound[used]) for value in values])
        a, b, w, g, k = (np.concatenate(rows, 1) for rows in zip(*columns, strict=True))
        held = np.abs(g + k)
        if held.size and not held.max() < 1.0:
            robot = part.curve.robot
            row, column = np.unravel_index(int(held.argmax()), held.shape)
            where = describe_place(robot, part.q[row], part.curve.begin + float(part.s[row]))
            name = robot.joint_names[np.flatnonzero(np.isfinite(limits.effort))[column]]
            raise ParameterError(
                f"path: effort of {name} at rest {where}",
                f"{100 * float(held[row, column]):.4g} % of its limit",
                "less than 100 %: the drive cannot hold the machine there",
            )
        # Bounds by joint velocities and the tool's speed.
        rates = np.abs(part.first)
        least = MIN_RATE_FRACTION * max(float(rates.max()), 1e-300)
        with np.errstate(divide="ignore"):
            fastest = np.where(rates > least, limits.velocity / np.maximum(rates, least), np.inf)
            tool = limits.speed / np.maximum(part.felt, 1e-300)
        most = np.minimum(fastest.min(1), tool) ** 2
        # An upper bound of x: ten times that of constant full acceleration.
        size = np.abs(a).max(1, initial=0.0)
        pushed = size > MIN_RATE_FRACTION * size.max()
        if pushed.any():
            beyond = float(10.0 * 2.0 * part.s[-1] * (2.0 / size[pushed]).max())
        else:
            beyond = float(most[np.isfinite(most)].max())
        return cls(a, b, w, g, k, np.minimum(most, beyond))


def limit_names(robot: Robot) -> list[str]:
    """Return the names of all limits, in the order of :func:`compute_limit_usage`."""
    joints = robot.joint_names
    words = ("effort", "velocity", "acceleration", "jerk")
    return [f"{word} {joint}" for word in words for joint in joints] + ["speed"]


def compute_limit_usage(
    limits: Limits, effort: Array | None, qd: Array, qdd: Array, qddd: Array, speed: Array
) -> Array:
    """Return the signed used fraction of each limit, (k, 4 n + 1), 1 at the limit, 0 without."""
    parts = (
        (np.zeros_like(qd) if effort is None else effort) / limits.effort,
        qd / limits.velocity,
        qdd / limits.acceleration,
        qddd / limits.jerk,
    )
    return np.concatenate([*parts, (np.asarray(speed) / limits.speed)[:, None]], 1)
