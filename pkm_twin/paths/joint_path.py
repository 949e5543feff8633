# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Sample a path as joint positions over its length, with quintics between the points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, SingularityError, UnreachableError
from pkm_twin.paths.carrying import PayloadChange, compute_efforts
from pkm_twin.paths.geometry import Path, Stretch
from pkm_twin.robot.derivatives import joint_rates
from pkm_twin.robot.limits import find_first_beyond
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import describe_singularity_bound

Index = NDArray[np.int64]

MIN_INTERVALS: Final = 16
"""Smallest number of intervals of a piece."""
Slowdown = Callable[[Array, Array], Array]
"""Function of joint positions (p, n) and the reference point's direction (p, 3): factors (p,)."""


@dataclass(frozen=True)
class Curve:
    """Describe a stretch of a robot's path, at any points of which joints can be computed.

    ``robots``: with the payload of each piece. ``begin``: length up to the stretch, m.
    ``singularity``: least singularity index on it, 0 to 1.
    """

    robot: Robot
    path: Path
    stretch: Stretch
    begin: float
    singularity: float
    robots: tuple[Robot, ...]
    slowdown: Slowdown | None = None

    @property
    def least_step(self) -> float:
        """Shortest interval, m; second derivatives of a quintic over less are rounding errors."""
        return 1e-5 * self.robot.size

    def grid(self, points: int) -> list[Array]:
        """Distribute about ``points`` points: half by the pieces' lengths, half equally over the pieces."""
        pieces, result = self.stretch.pieces, []
        for k, piece in enumerate(pieces):
            share = piece.length / self.stretch.length + 1.0 / len(pieces)
            count = max(MIN_INTERVALS, len(piece.knots), round(0.5 * points * share))
            # Closer near a stop, where the speed grows with the root of the distance.
            t = np.linspace(0.0, 1.0, count + 1)
            begins, ends = k == 0, k == len(pieces) - 1
            if begins and ends:
                half = 0.5 * (2.0 * np.minimum(t, 1.0 - t)) ** 1.5
                t = np.where(t < 0.5, half, 1.0 - half)
            elif begins:
                t = t**1.5
            elif ends:
                t = 1.0 - (1.0 - t) ** 1.5
            s = piece.length * t
            knots: list[float] = []
            for knot in piece.knots.tolist():
                inside = min(knot, s[-1] - knot) > self.least_step
                if inside and not (knots and knot - knots[-1] < self.least_step):
                    knots.append(knot)
            if knots:
                # Points closer to a knot than a quarter of their spacing move to it.
                away = np.abs(s[:, None] - np.array(knots)).min(1)
                free = away > np.maximum(0.25 * np.gradient(s), self.least_step)
                free[[0, -1]] = True
                s = np.sort(np.concatenate([s[free], knots]))
            result.append(s)
        return result

    def at(self, grid: list[Array]) -> JointPath:
        """Compute the joint positions at points of each piece.

        :raises ParameterError: with the position: a pose out of reach, a joint beyond its limits,
            or a singularity.
        :raises UnreachableError: joint positions without an assembly.
        :raises SingularityError: joint positions beyond a singularity.
        """
        robot, pieces = self.robot, self.stretch.pieces
        parts = [p.at(s) for p, s in zip(pieces, grid, strict=True)]
        begins = np.concatenate([[0.0], np.cumsum([p.length for p in pieces])])
        s = np.concatenate([b + x for b, x in zip(begins, grid, strict=False)])
        place, slope, bend = (np.concatenate([part[k] for part in parts]) for k in range(3))
        if self.path.space == "joint":
            q, first, second = place, slope, bend
            robot.forward(q)
        else:
            q, good = robot.try_inverse(place)
            if not good.all():
                row = int(np.argmin(good))
                where = _format_place(robot, place[row], self.begin + float(s[row]))
                try:
                    robot.inverse(place[row])
                except (UnreachableError, SingularityError) as error:
                    raise ParameterError(f"path {where}", error, "a pose that the machine reaches") from None
            first, second = joint_rates(robot, q, slope, bend)
        check_positions(robot, s, q, self.begin)
        check_singularity(robot, self.begin + s, q, self.singularity)
        twist = reference_velocity(robot, q, first)
        travel = np.linalg.norm(twist, axis=1)
        slower = np.ones(len(s))
        if self.slowdown is not None:
            direction = twist / np.maximum(travel, 1e-300)[:, None]
            slower = np.asarray(self.slowdown(q, direction), np.float64)
        ends = np.cumsum([len(own) for own in grid])
        left = np.delete(np.arange(len(s)), ends - 1)
        return JointPath(self, tuple(grid), s, q, first, second, travel * slower, slower, left)


@dataclass(frozen=True)
class JointPath:
    """Hold a stretch of a path in joint coordinates, from rest to rest.

    ``grid``: points of each piece of ``curve``. ``s``: all of them, shape (p,), m; where two pieces
    meet there are two points of one s. ``q``, ``first``, ``second``: joint positions and
    derivatives by s, shape (p, n). ``felt``: derivative of the reference point's path length by
    s, times ``slower``, which scales its speed for the speed limit, shape (p,). ``left``: index of
    the first point of each interval, whose other end is the next point.
    """

    curve: Curve
    grid: tuple[Array, ...]
    s: Array
    q: Array
    first: Array
    second: Array
    felt: Array
    slower: Array
    left: Index

    @property
    def steps(self) -> Array:
        """Length of each interval, shape (intervals,), m."""
        return self.s[self.left + 1] - self.s[self.left]

    @property
    def ends(self) -> Array:
        """The intervals' ends, shape (intervals + 1,), m."""
        return np.append(self.s[self.left], self.s[-1])

    def find_first_interval(self, piece: int) -> int:
        """Return the first interval of a piece; the number of intervals if there is none."""
        return sum(len(own) - 1 for own in self.grid[:piece])

    @cached_property
    def piece(self) -> Index:
        """Piece of each point, shape (p,)."""
        return np.repeat(np.arange(len(self.grid)), [len(own) for own in self.grid])

    def efforts(self, points: Index, q: Array, qd: Array, qdd: Array, wrench: Array | None) -> Array:
        """Return efforts with the payloads of the points' pieces, points (k,): shape (k, n)."""
        return compute_efforts(self.curve.robots, self.piece[points], q, qd, qdd, wrench)

    @cached_property
    def _quintics(self) -> Array:
        """Coefficients by powers of the fraction of an interval, shape (6, intervals, n).

        A quintic in each interval has the values and both derivatives of its ends.
        """
        a = self.left
        b, h = a + 1, self.steps[:, None]
        d = self.q[b] - self.q[a]
        u, v = self.first[a] * h, self.first[b] * h
        x, y = self.second[a] * h**2, self.second[b] * h**2
        c3 = 10.0 * d - 6.0 * u - 4.0 * v - 1.5 * x + 0.5 * y
        c4 = -15.0 * d + 8.0 * u + 7.0 * v + 1.5 * x - y
        c5 = 6.0 * d - 3.0 * (u + v) - 0.5 * (x - y)
        return np.stack([self.q[a], u, 0.5 * x, c3, c4, c5])

    def interpolate(self, interval: Index, part: Array) -> tuple[Array, Array, Array]:
        """Return positions and derivatives by s at fractions of intervals, shape (k, n) each."""
        c0, c1, c2, c3, c4, c5 = self._quintics[:, interval]
        h, t = self.steps[interval][:, None], part[:, None]
        q = c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * c5))))
        first = c1 + t * (2 * c2 + t * (3 * c3 + t * (4 * c4 + t * 5 * c5)))
        second = 2 * c2 + t * (6 * c3 + t * (12 * c4 + t * 20 * c5))
        return q, first / h, second / h**2

    def motion(self, interval: Index, part: Array, v: Array, u: Array) -> tuple[Array, ...]:
        """Return positions, velocities and accelerations at fractions of intervals, (k, n) each."""
        q, first, second = self.interpolate(interval, part)
        return q, first * v[:, None], first * u[:, None] + second * (v**2)[:, None]

    def refine(self, parts: Index) -> JointPath:
        """Return the path with each interval divided into ``parts`` parts.

        :param parts: shape (intervals,).
        :raises ParameterError: as of :meth:`Curve.at`.
        """
        grid, begin = [], 0
        for own in self.grid:
            count = parts[begin : begin + len(own) - 1]
            begin += len(own) - 1
            at = np.repeat(np.arange(len(count)), count)
            part = (np.arange(len(at)) - np.repeat(np.cumsum(count) - count, count)) / count[at]
            grid.append(np.append(own[at] + part * np.diff(own)[at], own[-1]))
        return self.curve.at(grid)


def reference_velocity(robot: Robot, q: Array, qd: Array) -> Array:
    """Return the reference point's velocity, base axes, (k, 3), m/s, for joint rates (k, n).

    For a machine that only rotates, the platform's angular velocity, rad/s.
    """
    rows = robot.platform_jacobian(q)[:, 3:] if only_turns(robot) else robot.platform_jacobian(q)
    return np.asarray((rows[:, :3] @ qd[..., None])[..., 0], np.float64)


def only_turns(robot: Robot) -> bool:
    """Return whether no coordinate of the pose is a position."""
    return not {"x", "y", "z"} & set(robot.pose_names)


def describe_place(robot: Robot, q: Array, distance: float) -> str:
    """Describe a position of a path by its joint positions (n,): length, m, and pose."""
    return _format_place(robot, robot.forward(q), distance)


def _format_place(robot: Robot, pose: Array, distance: float) -> str:
    values = (np.round(pose, 12) + 0.0).tolist()
    entries = zip(robot.pose_names, values, robot.pose_units, strict=True)
    place = "at " + ", ".join(f"{name} {value:.4g} {unit}" for name, value, unit in entries)
    # The length of a path in angles is not in metres.
    return f"{place}, {distance:.4g} m after the start" if "m" in robot.pose_units else place


def check_positions(robot: Robot, s: Array, q: Array, begin: float) -> None:
    """Check that a path keeps the joints' limits, passive joints too.

    :param s: length within the stretch, shape (p,), m; ``q``: joint positions there, (p, n).

    :param begin: length up to the stretch, m.

    :raises ParameterError: names the first joint and position.
    """
    if (beyond := find_first_beyond(robot, q)) is not None:
        row = beyond.index or 0
        where = describe_place(robot, q[row], begin + float(s[row]))
        raise ParameterError(
            f"path: {beyond.joint} {where}",
            round(beyond.value, 6),
            f"{beyond.low:g} to {beyond.high:g} {beyond.unit}",
        )


def check_singularity(robot: Robot, distance: Array, q: Array, singularity: float) -> None:
    """Check that a path keeps away from singularities.

    :param distance: from the start, shape (p,), m; ``q``: joint positions there, (p, n).
    :param singularity: least singularity index, 0 to 1.
    :raises ParameterError: with the least index on the path, and its place.
    """
    if singularity <= 0.0:
        return
    index = robot.singularity(q)
    row = int(index.argmin())
    if index[row] < singularity:
        least = float(index[row])
        raise ParameterError(
            f"path: singularity index {describe_place(robot, q[row], float(distance[row]))}",
            round(least, 6),
            f"{singularity:g} or more; {describe_singularity_bound(least)} passes",
        )


def make_joint_paths(
    path: Path,
    carried: Sequence[PayloadChange],
    points: int,
    singularity: float,
    slowdown: Slowdown | None = None,
) -> list[JointPath]:
    """Check all stretches of a path; return their joint paths, ``points`` split by their lengths.

    :param carried: by :func:`~pkm_twin.paths.carrying.carry`.
    :raises ParameterError: a place beyond a limit or too close to a singularity.
    """
    result = []
    begin, robot = 0.0, carried[0].robot
    for k, stretch in enumerate(path.stretches):
        share = max(2 * MIN_INTERVALS, round(points * stretch.length / path.length))
        changes = [[c.robot for c in carried if (c.stretch, c.piece) <= (k, n)] for n in range(len(stretch.pieces))]
        robots = tuple(robots[-1] for robots in changes)
        curve = Curve(robot, path, stretch, begin, 0.0, robots, slowdown)
        try:
            result.append(curve.at(curve.grid(share)))
        except (UnreachableError, SingularityError) as error:
            raise ParameterError("path", error, "joints that can be assembled") from None
        begin += stretch.length
    distance = np.concatenate([part.curve.begin + part.s for part in result])
    # After all stretches, so that the error names the path's least index.
    check_singularity(robot, distance, np.concatenate([part.q for part in result]), singularity)
    return [replace(part, curve=replace(part.curve, singularity=singularity)) for part in result]
