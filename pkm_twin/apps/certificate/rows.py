# SPDX-License-Identifier: Apache-2.0
"""Joints as equations between points and directions that move with bodies.

How a point moves is the engine's; what a joint holds is written here once for those engines that
work with velocities in base axes. A row is made of vectors, each with its velocity and the part of
its acceleration that needs no acceleration of the coordinates.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pkm_twin.apps.certificate.description import Array, Joint, Machine, Rod, UnfitError, across


class Jet(NamedTuple):
    """A vector that moves with the bodies."""

    value: Array
    """Shape (3,)."""
    columns: Array
    """Its velocity per coordinate rate, shape (3, size)."""
    rate: Array
    """Its velocity."""
    bias: Array
    """Its acceleration where the coordinates' accelerations are zero."""

    def minus(self, other: Jet) -> Jet:
        """Difference of two."""
        return Jet(*(a - b for a, b in zip(self, other, strict=True)))


class Rows(NamedTuple):
    """Equations: value = 0, columns u = 0, columns u' + bias = 0."""

    value: Array
    columns: Array
    bias: Array


class Moving(ABC):
    """A machine whose bodies' points and directions some engine moves."""

    machine: Machine
    size: int
    """How many rates the engine's coordinates have."""

    @abstractmethod
    def point(self, body: str, at: Array) -> Jet:
        """A point fixed in a body, by its place at home (m)."""

    @abstractmethod
    def direction(self, body: str, axis: Array) -> Jet:
        """A direction fixed in a body, by its components at home."""

    @abstractmethod
    def spin(self, body: str) -> Jet:
        """A body's angular velocity; as a vector it is nothing, its value is zero."""

    def still(self, value: Array) -> Jet:
        """What stands."""
        return Jet(value, np.zeros((3, self.size)), np.zeros(3), np.zeros(3))

    def _joint_rows(self, joint: Joint) -> list[Rows]:
        inner, outer = joint.inner, joint.outer
        gap = self.point(outer, joint.at).minus(self.point(inner, joint.at))
        rows = []
        if joint.kind in ("revolute", "universal", "spherical", "fixed"):
            rows.append(Rows(gap.value, gap.columns, gap.bias))
        if joint.kind in ("prismatic", "cylindrical"):
            for side in across(joint.axes[0]):
                rows.append(dot(self.direction(inner, side), gap))
        if joint.kind in ("revolute", "cylindrical"):
            axis = self.direction(outer, joint.axes[0])
            for side in across(joint.axes[0]):
                rows.append(dot(self.direction(inner, side), axis))
        if joint.kind in ("prismatic", "fixed", "translation"):
            for k in range(3):
                first, second = np.eye(3)[k], np.eye(3)[(k + 1) % 3]
                rows.append(dot(self.direction(inner, first), self.direction(outer, second)))
        if joint.kind == "universal":
            one, other = joint.axes
            crossed = dot(self.direction(inner, one), self.direction(outer, other))
            rows.append(crossed._replace(value=crossed.value - one @ other))
        return rows

    def rates(self, joint: Joint) -> Rows:
        """Rates of a joint's own axes: columns u are they, columns u' + bias change them."""
        if joint.kind == "prismatic":
            return self._slide(joint)
        if joint.kind == "revolute":
            return self._turning(joint)
        if joint.kind == "cylindrical":
            slide, turning = self._slide(joint), self._turning(joint)
            return stacked([slide, turning])
        if joint.kind == "universal":
            # Axis k's rate: the relative turning along what is perpendicular to the other axis.
            one = self.direction(joint.inner, joint.axes[0]).value
            other = self.direction(joint.outer, joint.axes[1]).value
            dual = np.linalg.pinv(np.array([one, other]).T)
            relative = self.spin(joint.outer).minus(self.spin(joint.inner))
            return Rows(np.zeros(2), dual @ relative.columns, np.full(2, np.nan))
        raise UnfitError(f"joints.{joint.name}: a {joint.kind} joint has no rates of its own")

    def _slide(self, joint: Joint) -> Rows:
        gap = self.point(joint.outer, joint.at).minus(self.point(joint.inner, joint.at))
        return dot(self.direction(joint.inner, joint.axes[0]), gap)

    def _turning(self, joint: Joint) -> Rows:
        axis = self.direction(joint.inner, joint.axes[0])
        relative = self.spin(joint.outer).minus(self.spin(joint.inner))
        side, other = across(joint.axes[0])
        moved = self.direction(joint.outer, side).value
        cosine = self.direction(joint.inner, side).value @ moved
        sine = self.direction(joint.inner, other).value @ moved
        return Rows(
            np.array([math.atan2(sine, cosine)]),
            (axis.value @ relative.columns)[None],
            np.array([axis.rate @ relative.rate + axis.value @ relative.bias]),
        )

    def loops(self) -> Sequence[Joint]:
        """The joints that are equations; an engine with a tree leaves the tree's out."""
        return self.machine.joints

    def closures(self) -> Rows:
        """All joints' and rods' rows at the present state."""
        rows = [row for joint in self.loops() for row in self._joint_rows(joint)]
        rows += [self.rod_rows(rod) for rod in self.machine.rods]
        return stacked(rows, self.size)

    def rod_rows(self, rod: Rod) -> Rows:
        """A rod keeps its length."""
        gap = self.point(rod.outer, rod.ends[1]).minus(self.point(rod.inner, rod.ends[0]))
        half = dot(gap, gap)
        return Rows(half.value / 2 - rod.length**2 / 2, half.columns / 2, half.bias / 2)

    def drives(self) -> Rows:
        """The actuated joints' rows; the value is the way from home, rad or m."""
        return stacked([self.rates(joint) for joint in self.machine.actuated], self.size)

    def missing(self, way: Array) -> Array:
        """How far the actuated joints are from their way from home, shape (n,), rad or m."""
        result: Array = way - self.drives().value
        for k, joint in enumerate(self.machine.actuated):
            if joint.kind == "revolute":
                result[k] = math.remainder(result[k], 2 * math.pi)
        return result

    def twist_columns(self) -> Array:
        """The platform's twist at its reference point per coordinate rate, shape (6, size)."""
        machine = self.machine
        point = self.point(machine.platform, machine.origin)
        return np.vstack([point.columns, self.spin(machine.platform).columns])

    def rotors(self, tangent: Array) -> Array:
        """The rotors' part of the mass matrix, shape (n, n); the coordinates' rates by joint."""
        result = np.zeros((tangent.shape[1], tangent.shape[1]))
        for joint in self.machine.joints:
            if joint.rotor_inertia:
                rates = self.rates(joint).columns @ tangent
                result += joint.rotor_inertia * rates.T @ rates
        return result


def dot(a: Jet, b: Jet) -> Rows:
    """The row a . b."""
    return Rows(
        np.array([a.value @ b.value]),
        (a.value @ b.columns + b.value @ a.columns)[None],
        np.array([a.value @ b.bias + 2 * a.rate @ b.rate + b.value @ a.bias]),
    )


def stacked(rows: list[Rows], size: int | None = None) -> Rows:
    """Rows one under another; ``size`` columns where there are none."""
    if not rows:
        return Rows(np.zeros(0), np.zeros((0, size or 0)), np.zeros(0))
    return Rows(
        np.concatenate([row.value for row in rows]),
        np.vstack([row.columns for row in rows]),
        np.concatenate([row.bias for row in rows]),
    )
