# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Euler and Lagrange's equations of the two machines: their points, gaps and energies."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mpmath
import numpy as np

from tools.certificate.lagrange import (
    DIGITS,
    Energies,
    Shape,
    Solid,
    Vector,
    axes_of,
    cross,
    dot,
    plus,
    unit,
)


class DeltaEnergies(Energies):
    """A Delta: pivots, elbows and platform joints. The unknowns are the platform's centre."""

    unknowns = 3

    def __init__(self, params: Mapping[str, Any]) -> None:
        super().__init__(params)
        m = params["inertia"]
        self.sliding = [c == "rcu" for c in params["geometry"].get("closures", ("rod",) * 3)]
        exact = mpmath.mpf
        self.platform_mass = exact(float(m["platform_mass"]))
        self.arm_mass = exact(float(m["arm_mass"]))
        self.forearm_mass = exact(float(m["forearm_mass"]))
        self.arm_com = exact(float(m.get("arm_com", 0.5)))
        with mpmath.workdps(DIGITS):
            given = m.get("arm_inertia")
            thin = self.arm_mass * self.lengths["arm_length"] ** 2 / 12
            about = thin if given is None else exact(float(given))
            self.arm_inertia = about + exact(float(m.get("rotor_inertia", 0.0)))

    def middles(self, q: np.ndarray) -> list[float]:
        """Return start values for Newton's method: angles at which three forearms meet."""
        size = {k: float(v) for k, v in self.lengths.items()}
        angles = [float(np.mean(q)) + shift for shift in (0.0, 0.2, 0.4, 0.7, 1.0)]
        reach = size["base_radius"] - size["platform_radius"]
        return [
            angle
            for angle in angles
            if abs(reach + size["arm_length"] * math.cos(angle)) < 0.99 * size["forearm_length"]
        ]

    def start(self, middle: float) -> list[float]:
        size = {k: float(v) for k, v in self.lengths.items()}
        out = size["base_radius"] - size["platform_radius"] + size["arm_length"] * math.cos(middle)
        drop = math.sqrt(size["forearm_length"] ** 2 - out**2)
        return [0.0, 0.0, -size["arm_length"] * math.sin(middle) - drop]

    def _limb(self, i: int, q: Any, u: Sequence[Any], m: Any) -> tuple[Vector, Vector, Vector]:
        """Return the arm's direction, and the forearm's ends at elbow and platform."""
        size: Callable[[Any], Any] = float if m is math else mpmath.mpf
        r = [size(v) for v in self.out[i]]
        base, platform, arm = (size(self.lengths[k]) for k in ("base_radius", "platform_radius", "arm_length"))
        direction = [m.cos(q) * r[0], m.cos(q) * r[1], -m.sin(q)]
        elbow = [base * r[k] + arm * direction[k] for k in range(3)]
        corner = [u[k] + platform * r[k] for k in range(3)]
        if self.sliding[i]:
            axis = [-r[1], r[0], 0]
            elbow = plus(elbow, axis, dot(plus(corner, elbow, -1), axis))
        return direction, elbow, corner

    def gaps(self, q: Sequence[Any], u: Sequence[Any], m: Any) -> Vector:
        result = []
        for i in range(3):
            _, elbow, corner = self._limb(i, q[i], u, m)
            rod = plus(corner, elbow, -1)
            size = self.lengths["forearm_length"]
            long = float(size) if m is math else size
            result.append(dot(rod, rod) - long * long)
        return result

    def shape(self, q: Vector, u: Vector) -> Shape:
        points = [p for i in range(3) for p in self._limb(i, q[i], u, mpmath)]
        axes = [unit(k) for k in range(3)]
        return Shape([*points, *(s.place(u, axes) for s in self.solids), u], u, axes)

    def kinetic_of(self, rates: list[Vector], axes: list[Vector]) -> Any:
        lever = self.arm_com * self.lengths["arm_length"]
        arm = self.arm_inertia + self.arm_mass * lever**2
        total = self.platform_mass * dot(rates[-1], rates[-1]) / 2
        for i in range(3):
            turn, one, end = rates[3 * i : 3 * i + 3]
            total += arm * dot(turn, turn) / 2
            # A thin rod whose points move in proportion between its ends.
            total += self.forearm_mass / 6 * (dot(one, one) + dot(one, end) + dot(end, end))
        for solid, rate in zip(self.solids, rates[9:-1], strict=True):
            total += solid.mass * dot(rate, rate) / 2 + solid.turning(axes)
        return total

    def potential_of(self, shape: Shape) -> Any:
        points = shape.points
        lever = self.arm_com * self.lengths["arm_length"]
        total = self.platform_mass * dot(self.gravity, points[-1])
        for i in range(3):
            direction, one, end = points[3 * i : 3 * i + 3]
            place = [self.lengths["base_radius"] * v for v in self.out[i]]
            total += self.arm_mass * dot(self.gravity, plus(place, direction, lever))
            total += self.forearm_mass * dot(self.gravity, plus(one, end)) / 2
        for solid, place in zip(self.solids, points[9:-1], strict=True):
            total += solid.mass * dot(self.gravity, place)
        return -total


class PrruEnergies(Energies):
    """A 3-PRRU head. The unknowns are the platform's centre and its three angles.

    Every platform joint stays in its limb's vertical plane at the limb's length from the slider.
    The upper link's x axis is at a right angle to the limb and to the platform's tangent.
    """

    unknowns = 6

    def __init__(self, params: Mapping[str, Any]) -> None:
        super().__init__(params)
        m, exact = params["inertia"], mpmath.mpf
        self.rise = 1 if params["geometry"].get("branch", "below") == "below" else -1
        self.slider_mass = exact(float(m["slider_mass"]))
        self.link_com = exact(float(m.get("link_com", 0.5)))
        self.links = []
        with mpmath.workdps(DIGITS):
            for name in ("lower", "upper"):
                mass = exact(float(m[f"{name}_link_mass"]))
                given = m.get(f"{name}_link_inertia")
                thin = (mass * self.lengths["limb_length"] ** 2 / 12, exact(0))
                across, about = thin if given is None else (exact(float(v)) for v in given)
                self.links.append((mass, across, about))
            com = m.get("platform_com", (0, 0, 0))
            self.solids.append(Solid.of(m["platform_mass"], com, m["platform_inertia"]))

    def start(self, middle: float) -> list[float]:
        size = {k: float(v) for k, v in self.lengths.items()}
        reach = size["base_radius"] - size["platform_radius"]
        height = math.sqrt(size["limb_length"] ** 2 - reach**2)
        return [0.0, 0.0, middle + self.rise * height, 0.0, 0.0, 0.0]

    def _corner(self, i: int, u: Sequence[Any], axes: list[Vector], m: Any) -> Vector:
        size: Callable[[Any], Any] = float if m is math else mpmath.mpf
        radius = size(self.lengths["platform_radius"])
        r = [size(v) for v in self.out[i]]
        return plus(plus(u[:3], axes[0], -radius * r[0]), axes[1], -radius * r[1])

    def gaps(self, q: Sequence[Any], u: Sequence[Any], m: Any) -> Vector:
        size: Callable[[Any], Any] = float if m is math else mpmath.mpf
        axes = axes_of(u[3], u[4], u[5], m)
        base, limb = size(self.lengths["base_radius"]), size(self.lengths["limb_length"])
        result = []
        for i in range(3):
            r = [size(v) for v in self.out[i]]
            corner = self._corner(i, u, axes, m)
            way = [corner[0] + base * r[0], corner[1] + base * r[1], corner[2] - q[i]]
            result += [dot(way, way) - limb * limb, way[1] * r[0] - way[0] * r[1]]
        return result

    def shape(self, q: Vector, u: Vector) -> Shape:
        axes = axes_of(u[3], u[4], u[5], mpmath)
        base, limb = self.lengths["base_radius"], self.lengths["limb_length"]
        points: list[Vector] = []
        for i in range(3):
            r = self.out[i]
            corner = self._corner(i, u, axes, mpmath)
            slider = [-base * r[0], -base * r[1], q[i]]
            along = [v / limb for v in plus(corner, slider, -1)]
            tangent = plus([-r[1] * v for v in axes[0]], axes[1], r[0])
            x = cross(tangent, along)
            long = mpmath.sqrt(dot(x, x))
            x = [v / long for v in x]
            com = plus(slider, along, self.link_com * limb)
            points += [slider, com, along, x, cross(along, x)]
        points += [s.place(u[:3], axes) for s in self.solids]
        return Shape(points, u[:3], axes)

    def kinetic_of(self, rates: list[Vector], axes: list[Vector]) -> Any:
        (m_lower, i_lower, _), (m_upper, across, about) = self.links
        total = mpmath.mpf(0)
        for i in range(3):
            slider, com, along, x, y = rates[5 * i : 5 * i + 5]
            total += self.slider_mass * dot(slider, slider) / 2
            total += (m_lower + m_upper) * dot(com, com) / 2
            # The lower link turns in its plane only.
            total += i_lower * dot(along, along) / 2
            # Second moments of a round body: about / 2 sideways, across - about / 2 along.
            total += about / 4 * (dot(x, x) + dot(y, y))
            total += (across - about / 2) * dot(along, along) / 2
        for solid, rate in zip(self.solids, rates[15:], strict=True):
            total += solid.mass * dot(rate, rate) / 2 + solid.turning(axes)
        return total

    def potential_of(self, shape: Shape) -> Any:
        total = mpmath.mpf(0)
        for i in range(3):
            slider, com = shape.points[5 * i : 5 * i + 2]
            total += self.slider_mass * dot(self.gravity, slider)
            total += (self.links[0][0] + self.links[1][0]) * dot(self.gravity, com)
        for solid, place in zip(self.solids, shape.points[15:], strict=True):
            total += solid.mass * dot(self.gravity, place)
        return -total


def energies(params: Mapping[str, Any]) -> Energies:
    """Return the energies of a machine from its parameters."""
    return PrruEnergies(params) if params["mechanism"] == "prru" else DeltaEnergies(params)
