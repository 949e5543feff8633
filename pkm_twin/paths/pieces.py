# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Evaluate pieces of paths: curves p(s) with their first two derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError

NO_KNOTS: Final = np.empty(0)


class Piece(Protocol):
    """A curve over s in [0, length]."""

    @property
    def length(self) -> float:
        """Range of s."""

    @property
    def knots(self) -> Array:
        """Values of s where a derivative jumps, rising."""

    def at(self, s: Array) -> tuple[Array, Array, Array]:
        """Return coordinates and their first two derivatives by s, shape (k, m) each."""


@dataclass(frozen=True)
class Line:
    """A straight line from ``begin`` with a constant ``slope`` by s, shape (m,)."""

    begin: Array
    slope: Array
    length: float
    knots = NO_KNOTS

    def at(self, s: Array) -> tuple[Array, Array, Array]:
        """Return coordinates and their first two derivatives by s, shape (k, m) each."""
        first = np.broadcast_to(self.slope, (len(s), len(self.slope)))
        return self.begin + s[:, None] * self.slope, first, np.zeros(first.shape)


@dataclass(frozen=True)
class Corner:
    """Round a corner with continuous second derivatives.

    The curve leaves one line ``radius`` before the corner and meets the next one ``radius`` after
    it. With t = s / radius - 1 and f(t) = 3/16 + t/2 + 3/8 t^2 - t^4/16: p = corner + radius
    (before (t - f) + behind f).
    """

    corner: Array
    before: Array
    behind: Array
    radius: float
    knots = NO_KNOTS

    @property
    def length(self) -> float:
        """Range of s."""
        return 2.0 * self.radius

    def at(self, s: Array) -> tuple[Array, Array, Array]:
        """Return coordinates and their first two derivatives by s, shape (k, m) each."""
        t = (s / self.radius - 1.0)[:, None]
        f = 3 / 16 + t / 2 + 3 / 8 * t**2 - t**4 / 16
        slope = 1 / 2 + 3 / 4 * t - t**3 / 4
        bend = 3 / 4 * (1 - t**2) / self.radius
        turn = self.behind - self.before
        place = self.corner + self.radius * (self.before * t + turn * f)
        return place, self.before + turn * slope, turn * bend


@dataclass(frozen=True)
class SubPiece:
    """Restrict another piece to the range from ``begin`` to ``end`` of its s."""

    whole: Piece
    begin: float
    end: float

    @property
    def length(self) -> float:
        """Range of s."""
        return self.end - self.begin

    @property
    def knots(self) -> Array:
        """Knots of the whole within the range."""
        inner = (self.whole.knots > self.begin) & (self.whole.knots < self.end)
        return np.asarray(self.whole.knots[inner] - self.begin)

    def at(self, s: Array) -> tuple[Array, Array, Array]:
        """Return coordinates and their first two derivatives by s, shape (k, m) each."""
        return self.whole.at(self.begin + s)


@dataclass(frozen=True)
class Arc:
    """Describe a circular arc of the position; the other coordinates change linearly along it.

    ``across``, ``along``: unit vectors (m,) from the centre to the beginning, and of the motion
    there; ``rest``: change of the other coordinates by s.
    """

    centre: Array
    across: Array
    along: Array
    rest: Array
    radius: float
    angle: float
    knots = NO_KNOTS

    @property
    def length(self) -> float:
        """Range of s."""
        return self.radius * self.angle

    def arc_length_at(self, point: Array) -> float:
        """Return the arc length s of a point of the arc."""
        arm = point - self.centre
        return self.radius * float(np.arctan2(arm @ self.along, arm @ self.across) % (2 * np.pi))

    def at(self, s: Array) -> tuple[Array, Array, Array]:
        """Return coordinates and their first two derivatives by s, shape (k, m) each."""
        angle = (s / self.radius)[:, None]
        c, si = np.cos(angle), np.sin(angle)
        place = self.centre + self.radius * (c * self.across + si * self.along)
        first = c * self.along - si * self.across
        second = -(c * self.across + si * self.along) / self.radius
        return place + s[:, None] * self.rest, first + self.rest, second


@dataclass(frozen=True)
class Smooth:
    """A cubic spline over its length."""

    spline: scipy.interpolate.CubicSpline

    @property
    def length(self) -> float:
        """Range of s."""
        return float(self.spline.x[-1])

    @property
    def knots(self) -> Array:
        """Where the third derivative jumps."""
        return np.asarray(self.spline.x[1:-1], np.float64)

    def at(self, s: Array) -> tuple[Array, Array, Array]:
        """Return coordinates and their first two derivatives by s, shape (k, m) each."""
        return self.spline(s), self.spline(s, 1), self.spline(s, 2)


def arc_through(begin: Array, middle: Array, end: Array, *, places: Sequence[int], where: str = "arc") -> Arc:
    """Return the arc through three points; ``places`` are the coordinates that are lengths.

    :raises ParameterError: three points on a line.
    """
    a, b, c = (np.asarray(p, float)[list(places)] for p in (begin, middle, end))
    u, v = b - a, c - a
    gram = np.array([[u @ u, u @ v], [u @ v, v @ v]])
    if not np.linalg.det(gram) > 1e-16 * float(gram.max()) ** 2:
        raise ParameterError(where, "three points on a line", "points of an arc, not on a line")
    parts = np.linalg.solve(gram, 0.5 * np.diag(gram))
    offset = parts[0] * u + parts[1] * v
    radius = float(np.linalg.norm(offset))
    across = -offset / radius
    normal = u - (u @ across) * across
    along = normal / np.linalg.norm(normal)

    def find_angle(p: Array) -> float:
        d = p - a - offset
        return float(np.arctan2(d @ along, d @ across) % (2 * np.pi))

    if find_angle(c) < find_angle(b):
        along = -along
    whole = find_angle(c)
    size = len(np.asarray(begin))
    full = [np.zeros(size) for _ in range(3)]
    for row, part in zip(full, (a + offset, across, along), strict=True):
        row[list(places)] = part
    others = [i for i in range(size) if i not in places]
    rest = np.zeros(size)
    full[0][others] = np.asarray(begin, float)[others]
    rest[others] = (np.asarray(end, float) - np.asarray(begin, float))[others] / (radius * whole)
    return Arc(full[0], full[1], full[2], rest, radius, whole)
