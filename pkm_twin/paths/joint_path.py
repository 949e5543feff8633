# SPDX-License-Identifier: Apache-2.0
"""A path as joint positions over its length: points with derivatives, and quintics between."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, SingularityError, UnreachableError
from pkm_twin.paths.geometry import Path, Stretch
from pkm_twin.paths.pieces import Piece, Smooth
from pkm_twin.robot.robot import Robot

Index = NDArray[np.int64]

LEAST_POINTS: Final = 16
"""Intervals of the shortest piece."""
PER_KNOT: Final = 1
"""Least intervals between two waypoints of a smooth curve."""
GRADE: Final = 1.5
"""Power of the distance from a stop by which points are set: speeds go by its root."""
ROUNDING: Final = 1e-9
"""A position this far beyond its limit, of unit one, is on it."""


@dataclass(frozen=True)
class JointPath:
    """A stretch of a path in joint coordinates, from rest to rest.

    ``s``: points, shape (p,), m; where two pieces meet there are two points of one s.
    ``q``, ``first``, ``second``: joint positions and derivatives by s, shape (p, n).
    ``travel``: the reference point's way by s, shape (p,); ``left``: first point of each interval,
    whose other end is the next point. ``felt``: travel times what multiplies the speed for its
    limit, shape (p,).
    """

    s: Array
    q: Array
    first: Array
    second: Array
    travel: Array
    left: Index
    felt: Array

    @property
    def steps(self) -> Array:
        """Length of each interval, shape (intervals,), m."""
        return self.s[self.left + 1] - self.s[self.left]

    def between(self, interval: Index, part: Array) -> tuple[Array, Array, Array]:
        """Positions and derivatives by s at a part (0 to 1) of intervals, shape (k, n) each.

        A quintic in each interval with the values and both derivatives of its ends.
        """
        a = self.left[interval]
        b, h = a + 1, self.steps[interval][:, None]
        t = part[:, None]
        d = self.q[b] - self.q[a]
        u, v = self.first[a] * h, self.first[b] * h
        x, y = self.second[a] * h**2, self.second[b] * h**2
        c2, c3 = 0.5 * x, 10.0 * d - 6.0 * u - 4.0 * v - 1.5 * x + 0.5 * y
        c4 = -15.0 * d + 8.0 * u + 7.0 * v + 1.5 * x - y
        c5 = 6.0 * d - 3.0 * (u + v) - 0.5 * (x - y)
        q = self.q[a] + t * (u + t * (c2 + t * (c3 + t * (c4 + t * c5))))
        first = u + t * (2 * c2 + t * (3 * c3 + t * (4 * c4 + t * 5 * c5)))
        second = 2 * c2 + t * (6 * c3 + t * (12 * c4 + t * 20 * c5))
        return q, first / h, second / h**2

    def motion(self, interval: Index, part: Array, v: Array, u: Array) -> tuple[Array, ...]:
        """Positions, rates and accelerations there, (k, n) each, at v and u along the path."""
        q, first, second = self.between(interval, part)
        return q, first * v[:, None], first * u[:, None] + second * (v**2)[:, None]

    def speed(self, slopes: Array, interval: Index, part: Array, v: Array) -> Array:
        """There at v along the path, (k,), by ways per s as ``travel`` and ``felt``, (p,)."""
        left = self.left[interval]
        return v * ((1.0 - part) * slopes[left] + part * slopes[left + 1])


def _joints(robot: Robot, places: Array, way: Array) -> Array:
    """Joint positions of poses (k, m).

    :raises ParameterError: by the first pose out of reach, its way along the path (k,).
    """
    q, good = robot.try_inverse(places)
    if good.all():
        return q
    row = int(np.argmin(good))
    where = Place(float(way[row]), tuple(places[row].tolist()), robot.pose_names)
    try:
        robot.inverse(places[row])
    except (UnreachableError, SingularityError) as error:
        raise ParameterError(
            f"path {where}", str(error), "a pose that the machine reaches"
        ) from None
    return robot.inverse(places)


Slowdown = Callable[[Array, Array], Array]
"""Of joint positions (p, n) and the way that the reference point goes (p, 3): factors (p,)."""


def joint_path(
    robot: Robot,
    path: Path,
    stretch: Stretch,
    points: int,
    begin: float = 0.0,
    slowdown: Slowdown | None = None,
) -> JointPath:
    """A stretch of a path as joint positions.

    :param begin: way up to the stretch, m.
    :param points: about how many; half by the pieces' lengths, half alike for all pieces.
    :raises ParameterError: by the place, a pose that the machine does not reach.
    :raises UnreachableError: joint positions without an assembly.
    :raises SingularityError: joint positions beyond a singularity.
    """
    pieces = stretch.pieces
    counts = [
        max(_least(p), round(0.5 * points * (p.length / stretch.length + 1.0 / len(pieces))))
        for p in pieces
    ]
    last = len(pieces) - 1
    locals_ = [
        p.length * _graded(n, begins=k == 0, ends=k == last)
        for k, (p, n) in enumerate(zip(pieces, counts, strict=True))
    ]
    parts = [p.at(s) for p, s in zip(pieces, locals_, strict=True)]
    begins = np.concatenate([[0.0], np.cumsum([p.length for p in pieces])])
    s = np.concatenate([b + x for b, x in zip(begins, locals_, strict=False)])
    place, slope, bend = (np.concatenate([part[k] for part in parts]) for k in range(3))
    ends = np.cumsum([n + 1 for n in counts])
    left = np.delete(np.arange(len(s)), ends - 1)
    if path.space == "joint":
        q, first, second = place, slope, bend
        robot.forward(q)
    else:
        q = _joints(robot, place, begin + s)
        jacobian = robot.jacobian(q)
        first = np.linalg.solve(jacobian, slope[..., None])[..., 0]
        own = robot.pose_acceleration(q, first, np.zeros_like(q))
        second = np.linalg.solve(jacobian, (bend - own)[..., None])[..., 0]
    twist = np.einsum("kij,kj->ki", robot.platform_jacobian(q)[:, :3], first)
    travel = np.linalg.norm(twist, axis=1)
    felt = travel
    if slowdown is not None:
        felt = travel * slowdown(q, twist / np.maximum(travel, 1e-300)[:, None])
    return JointPath(s, q, first, second, travel, left, felt)


def _least(piece: Piece) -> int:
    """Intervals that a piece needs for its own bends."""
    bends = PER_KNOT * (len(piece.spline.x) - 1) if isinstance(piece, Smooth) else 0
    return max(LEAST_POINTS, bends)


def _graded(count: int, *, begins: bool, ends: bool) -> Array:
    """Points from 0 to 1, shape (count + 1,), closer where the machine is slow: at a stop."""
    t = np.linspace(0.0, 1.0, count + 1)
    if begins and ends:
        half = 0.5 * (2.0 * np.minimum(t, 1.0 - t)) ** GRADE
        return np.where(t < 0.5, half, 1.0 - half)
    if begins:
        return np.asarray(t**GRADE)
    return np.asarray(1.0 - (1.0 - t) ** GRADE if ends else t)


@dataclass(frozen=True)
class Place:
    """Where on a path something is: way from the beginning (m), pose and what is wrong there."""

    way: float
    pose: tuple[float, ...]
    names: tuple[str, ...]

    def __str__(self) -> str:
        numbers = ", ".join(
            f"{n} {round(v, 12) + 0.0:.4g}" for n, v in zip(self.names, self.pose, strict=True)
        )
        return f"{self.way:.4g} m after the start ({numbers})"


def place_at(robot: Robot, q: Array, way: float) -> Place:
    """A place of a path by its joint positions (n,)."""
    pose = tuple(float(v) for v in robot.forward(q))
    return Place(way, pose, robot.pose_names)


def check_positions(robot: Robot, part: JointPath, begin: float, singularity: float) -> float:
    """A path that keeps joint limits, passive joints' angles and away from singularities.

    :param begin: way up to the stretch, m.
    :param singularity: least singularity index, 0 to 1.
    :returns: the least singularity index on the path.
    :raises ParameterError: by the first joint and place.
    """
    limits = robot.limits.position
    if limits is not None:
        excess = np.maximum(part.q - limits[:, 1], limits[:, 0] - part.q)
        bad = excess > ROUNDING * np.maximum(1.0, np.abs(part.q))
        if bad.any():
            row = int(bad.any(1).argmax())
            joint = int(excess[row].argmax())
            unit, name = robot.joint_units[joint], robot.joint_names[joint]
            low, high = limits[joint]
            where = place_at(robot, part.q[row], begin + float(part.s[row]))
            raise ParameterError(
                f"path: {name} {where}", round(float(part.q[row, joint]), 6),
                f"{low:g} to {high:g} {unit}",
            )  # fmt: skip
    most = getattr(robot.limits, "joint_angle", None)
    angles = None if most is None else robot.limit_angles(robot.forward(part.q))
    if angles is not None and most is not None:
        over = np.abs(angles).max(1) > most + ROUNDING
        if over.any():
            row = int(over.argmax())
            where = place_at(robot, part.q[row], begin + float(part.s[row]))
            value = float(np.abs(angles[row]).max())
            raise ParameterError(f"path: joint angle {where}", round(value, 6), f"to {most:g} rad")
    index = robot.singularity(part.q)
    row = int(index.argmin())
    if index[row] < singularity:
        where = place_at(robot, part.q[row], begin + float(part.s[row]))
        raise ParameterError(
            f"path: singularity index {where}", round(float(index[row]), 6),
            f"{singularity:g} or more",
        )  # fmt: skip
    return float(index[row])


def joint_paths(
    robot: Robot, path: Path, points: int, singularity: float, slowdown: Slowdown | None = None
) -> list[JointPath]:
    """All stretches of a path, checked; ``points`` shared by their lengths.

    :raises ParameterError: a place beyond a limit or too close to a singularity.
    """
    result = []
    begin = 0.0
    for stretch in path.stretches:
        share = max(2 * LEAST_POINTS, round(points * stretch.length / path.length))
        try:
            part = joint_path(robot, path, stretch, share, begin, slowdown)
        except (UnreachableError, SingularityError) as error:
            raise ParameterError("path", str(error), "joints that can be assembled") from None
        check_positions(robot, part, begin, singularity)
        begin += stretch.length
        result.append(part)
    return result
