# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Actuator efforts from energies alone, in 50 digits.

A machine here is points and directions: where the bodies' points are for given actuator positions,
found by Newton's method on lengths and planes, and the kinetic and potential energy as functions
of those points and of their velocities. Everything else is differentiation. All derivatives,
the velocities too, are central differences at steps of 1e-14, which in 50 digits leaves more
than 20 good ones:

    T(q, q') from the points' velocities, (X(q + h q') - X(q - h q')) / 2 h
    tau_j = d/dt (dT/dq'_j) - dT/dq_j + dV/dq_j - F . do/dq_j - M . turn_j
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import mpmath
import numpy as np

DIGITS = 50
STEP = mpmath.mpf(10) ** -14
HOMOTOPY_STEPS = 12
"""Number of steps from the symmetric assembly to the wanted one."""

Vector = list[Any]


class Result(NamedTuple):
    """The solution of Lagrange's equations at a state."""

    effort: np.ndarray
    """Efforts without friction, shape (3,), N m or N."""
    platform: np.ndarray
    """The platform's centre, shape (3,), m."""
    energy: float
    """Kinetic and potential energy, J."""
    kinetic: float
    """The kinetic part, J."""
    energy_rate: float
    """Its derivative in time, W."""
    wrench_power: float
    """Power of the wrench, W."""


class Shape(NamedTuple):
    """An assembled configuration with the points and axes of the energies."""

    points: list[Vector]
    """Points and directions from whose velocities the kinetic energy follows."""
    centre: Vector
    axes: list[Vector]
    """The platform's axes x, y, z in the world."""


def dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Sequence[Any], b: Sequence[Any]) -> Vector:
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]


def plus(a: Sequence[Any], b: Sequence[Any], factor: Any = 1) -> Vector:
    return [a[k] + factor * b[k] for k in range(3)]


def axes_of(alpha: Any, beta: Any, gamma: Any, m: Any) -> list[Vector]:
    """Return the columns of Rx(alpha) Ry(beta) Rz(gamma)."""
    ca, sa, cb, sb = m.cos(alpha), m.sin(alpha), m.cos(beta), m.sin(beta)
    cg, sg = m.cos(gamma), m.sin(gamma)
    return [
        [cb * cg, ca * sg + sa * sb * cg, sa * sg - ca * sb * cg],
        [-cb * sg, ca * cg - sa * sb * sg, sa * cg + ca * sb * sg],
        [sb, -sa * cb, ca * cb],
    ]


class Solid(NamedTuple):
    """A body fixed to the platform; its kinetic energy follows from the com and the rotating axes."""

    mass: Any
    com: Vector
    planar: list[Vector]
    """Second moments of mass about the com, P = trace(I) / 2 - I, kg m2."""

    @classmethod
    def of(cls, mass: Any, com: Any, inertia: Any) -> Solid:
        full = np.asarray(inertia, dtype=float)
        full = np.diag(full) if full.shape == (3,) else full
        exact = [[mpmath.mpf(float(v)) for v in row] for row in full]
        half = (exact[0][0] + exact[1][1] + exact[2][2]) / 2
        planar = [[(half if i == j else 0) - exact[i][j] for j in range(3)] for i in range(3)]
        return cls(mpmath.mpf(float(mass)), [mpmath.mpf(float(c)) for c in com], planar)

    def place(self, centre: Vector, axes: list[Vector]) -> Vector:
        point = centre
        for k in range(3):
            point = plus(point, axes[k], self.com[k])
        return point

    def turning(self, rates: list[Vector]) -> Any:
        """Return the kinetic energy of rotation from the axes' velocities, half trace R' P R'T."""
        total = mpmath.mpf(0)
        for i in range(3):
            for j in range(3):
                if self.planar[i][j]:
                    total += self.planar[i][j] * dot(rates[i], rates[j])
        return total / 2


class Energies:
    """Assemble a machine and differentiate its energies; base class of the machines."""

    unknowns: int

    def __init__(self, params: Mapping[str, Any]) -> None:
        exact = mpmath.mpf
        gravity = params.get("gravity", (0.0, 0.0, -9.81))
        self.gravity = [exact(float(v)) for v in gravity]
        g = params["geometry"]
        self.lengths = {k: exact(float(v)) for k, v in g.items() if isinstance(v, float)}
        self.azimuths = [exact(float(a)) for a in g["azimuths"]]
        with mpmath.workdps(DIGITS):
            self.out = [[mpmath.cos(a), mpmath.sin(a), exact(0)] for a in self.azimuths]
        self.solids: list[Solid] = []
        payload = params.get("payload") or {}
        if payload.get("mass"):
            self.solids.append(
                Solid.of(payload["mass"], payload.get("com", (0, 0, 0)), payload.get("inertia", (0,) * 3))
            )
        self._base: Vector = []
        self._slope: Any = None

    # Functions that a machine defines

    def gaps(self, q: Sequence[Any], u: Sequence[Any], m: Any) -> Vector:
        """Return the closure errors, zero in an assembled configuration; m is math or mpmath."""
        raise NotImplementedError

    def start(self, middle: float) -> list[float]:
        """Return the unknowns of the symmetric assembly with all actuators at ``middle``."""
        raise NotImplementedError

    def middles(self, q: np.ndarray) -> list[float]:
        """Return the symmetric assemblies from which a path to ``q`` may start."""
        return [float(np.mean(q))]

    def shape(self, q: Vector, u: Vector) -> Shape:
        raise NotImplementedError

    def kinetic_of(self, rates: list[Vector], axes: list[Vector]) -> Any:
        """Return the kinetic energy from the velocities of the points and of the platform's axes."""
        raise NotImplementedError

    def potential_of(self, shape: Shape) -> Any:
        raise NotImplementedError

    # Assembly

    def _rough(self, q: np.ndarray) -> np.ndarray:
        """Walk from a symmetric assembly, in floating point."""
        for middle in self.middles(q):
            try:
                u = self._walk(q, middle)
            except (np.linalg.LinAlgError, OverflowError):
                continue
            left = np.abs(np.array(self.gaps(q.tolist(), u.tolist(), math), dtype=float)).max()
            if left < 1e-12:
                return u
        raise ValueError(f"no way to the assembly at {q}")

    def _walk(self, q: np.ndarray, middle: float) -> np.ndarray:
        u = np.array(self.start(middle))
        for k in range(1, HOMOTOPY_STEPS + 1):
            at = (middle + k / HOMOTOPY_STEPS * (q - middle)).tolist()
            for _ in range(8):
                error = np.array(self.gaps(at, u.tolist(), math), dtype=float)
                slope = np.empty((self.unknowns, self.unknowns))
                for j in range(self.unknowns):
                    shift = 1e-7 * np.eye(self.unknowns)[j]
                    high = np.array(self.gaps(at, (u + shift).tolist(), math), dtype=float)
                    low = np.array(self.gaps(at, (u - shift).tolist(), math), dtype=float)
                    slope[:, j] = (high - low) / 2e-7
                step = np.linalg.solve(slope, error)
                u = u - step
                if np.abs(step).max() < 1e-10:
                    break
        return u

    def _settle(self, q: np.ndarray) -> None:
        """Solve the closure by Newton's method in all digits; keep the matrix for neighbours of ``q``."""
        at = [mpmath.mpf(float(v)) for v in q]
        u = [mpmath.mpf(float(v)) for v in self._rough(q)]
        tiny = mpmath.mpf(10) ** -25
        n = self.unknowns
        for _ in range(6):
            slope = mpmath.matrix(n, n)
            for j in range(n):
                high = self.gaps(at, [v + tiny * (k == j) for k, v in enumerate(u)], mpmath)
                low = self.gaps(at, [v - tiny * (k == j) for k, v in enumerate(u)], mpmath)
                for i in range(n):
                    slope[i, j] = (high[i] - low[i]) / (2 * tiny)
            self._slope = (slope**-1).tolist()
            change = self._correct(at, u)
            if change < mpmath.mpf(10) ** -24:
                break
        self._base = u
        self._at = at

    def _correct(self, q: Vector, u: Vector) -> Any:
        error = self.gaps(q, u, mpmath)
        largest = mpmath.mpf(0)
        for i, row in enumerate(self._slope):
            step = sum(a * b for a, b in zip(row, error, strict=True))
            u[i] -= step
            largest = max(largest, abs(step))
        return largest

    def assemble(self, q: Vector) -> Shape:
        """Solve the configuration at actuator positions near the settled ones."""
        u = list(self._base)
        for _ in range(8):
            if self._correct(q, u) < mpmath.mpf(10) ** -(DIGITS - 14):
                break
        else:
            raise ValueError("the assembly did not converge")
        return self.shape(q, u)

    # Energies

    def kinetic(self, q: Vector, qd: Vector) -> Any:
        """Return the kinetic energy of a state."""
        high = self.assemble(plus(q, qd, STEP))
        low = self.assemble(plus(q, qd, -STEP))
        rates = [_rate(a, b) for a, b in zip(high.points, low.points, strict=True)]
        axes = [_rate(a, b) for a, b in zip(high.axes, low.axes, strict=True)]
        return self.kinetic_of(rates, axes)

    def total(self, q: Vector, qd: Vector) -> Any:
        """Return the kinetic and potential energy of a state."""
        return self.kinetic(q, qd) + self.potential_of(self.assemble(q))

    def _momentum(self, q: Vector, qd: Vector) -> Vector:
        """Differentiate the kinetic energy by the rates; exact for a quadratic form."""
        result = []
        for j in range(3):
            high = self.kinetic(q, plus(qd, unit(j)))
            low = self.kinetic(q, plus(qd, unit(j), -1))
            result.append((high - low) / 2)
        return result

    def solve(self, q: Any, qd: Any, qdd: Any, wrench: Any) -> Result:
        """Solve Lagrange's equations for one state; all arguments are floats."""
        with mpmath.workdps(DIGITS):
            self._settle(np.asarray(q, dtype=float))
            at = self._at
            rate, change, load = ([mpmath.mpf(float(v)) for v in values] for values in (qd, qdd, wrench))
            later = plus(at, rate, STEP), plus(rate, change, STEP)
            earlier = plus(at, rate, -STEP), plus(rate, change, -STEP)
            gained = _rate(self._momentum(*later), self._momentum(*earlier))
            here = self.assemble(at)
            effort = []
            power = mpmath.mpf(0)
            for j in range(3):
                high, low = plus(at, unit(j), STEP), plus(at, unit(j), -STEP)
                steep = (self.kinetic(high, rate) - self.kinetic(low, rate)) / (2 * STEP)
                up, down = self.assemble(high), self.assemble(low)
                weight = (self.potential_of(up) - self.potential_of(down)) / (2 * STEP)
                turned = [mpmath.mpf(0)] * 3
                for k in range(3):
                    moved = _rate(up.axes[k], down.axes[k])
                    turned = plus(turned, cross(here.axes[k], moved), mpmath.mpf(1) / 2)
                work = dot(load[:3], _rate(up.centre, down.centre)) + dot(load[3:], turned)
                effort.append(gained[j] - steep + weight - work)
                power += work * rate[j]
            energy_rate = (self.total(*later) - self.total(*earlier)) / (2 * STEP)
            return Result(
                np.array([float(v) for v in effort]),
                np.array([float(v) for v in here.centre]),
                float(self.total(at, rate)),
                float(self.kinetic(at, rate)),
                float(energy_rate),
                float(power),
            )

    def state_energy(self, q: Any, qd: Any) -> float:
        """Return the kinetic and potential energy of a state of floats, J."""
        with mpmath.workdps(DIGITS):
            self._settle(np.asarray(q, dtype=float))
            return float(self.total(self._at, [mpmath.mpf(float(v)) for v in qd]))


def _rate(high: Sequence[Any], low: Sequence[Any]) -> Vector:
    return [(a - b) / (2 * STEP) for a, b in zip(high, low, strict=True)]


def unit(k: int) -> Vector:
    return [mpmath.mpf(int(j == k)) for j in range(3)]
