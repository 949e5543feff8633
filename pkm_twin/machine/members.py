# SPDX-License-Identifier: Apache-2.0
"""How a mechanism declares its elastic frame: beams, the joints at their ends, a rigid platform.

A member is a straight round bar or tube. Each of its ends stands on a body through a joint, or is
free, so that other members can stand on it. A joint is six compliances along its own axes: zero
is rigid, infinite is free. World axes, SI units, one pose. Actuators are locked.

May import: numpy, the mechanisms' core, the standard library.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from pkm_twin.errors import ParameterError
from pkm_twin.machine import schema
from pkm_twin.machine.joints import GROUND, MOVING
from pkm_twin.machine.robot import Robot

Array = NDArray[np.float64]

RIGID: Final = (0.0,) * 6
"""Compliance of a joint that holds all six directions."""


@dataclass(frozen=True)
class Section:
    """A round section, hollow or not: moduli (Pa), diameters (m), mass per length (kg/m).

    ``shear_factor`` is A / A_shear; zero is a beam that does not shear.
    """

    youngs_modulus: float
    shear_modulus: float
    outer_diameter: float
    inner_diameter: float
    mass_per_length: float
    shear_factor: float

    @property
    def area(self) -> float:
        """Area, m2."""
        return math.pi / 4 * (self.outer_diameter**2 - self.inner_diameter**2)

    @property
    def second_moment(self) -> float:
        """Second moment of area about a diameter, m4; the polar one is twice that."""
        return math.pi / 64 * (self.outer_diameter**4 - self.inner_diameter**4)

    @property
    def rotary_inertia(self) -> float:
        """Moment of inertia per length about a diameter, kg m; about the axis twice that."""
        return self.mass_per_length * self.second_moment / self.area


def cowper(ratio: float) -> float:
    """A / A_shear of a tube by its inner over outer diameter: 7/6 solid, 2 thin.

    Cowper 1966, table 1, hollow circle, for a Poisson's ratio of zero: a laminate's moduli are
    independent of each other and give no ratio that could stand in.
    """
    square = ratio * ratio
    return (7 + 34 * square + 7 * square * square) / (6 * (1 + square) ** 2)


def modulus() -> Any:
    """Field: an elastic modulus, Pa."""
    return schema.number(at_least=1e3, at_most=1e14)


@dataclass(frozen=True, eq=False)
class Tube:
    """Schema of a member whose mass is given elsewhere: moduli (Pa), outer diameter (m).

    Of ``density`` (kg/m3) and ``inner_diameter`` (m) one is given, and the other follows from
    the mass. ``shear_factor``: A / A_shear; default Cowper's for a tube.
    """

    youngs_modulus: float = modulus()
    shear_modulus: float = modulus()
    outer_diameter: float = schema.number(at_least=1e-6, at_most=10.0)
    density: float | None = schema.number(above=0.0, at_most=1e5, default=None)
    inner_diameter: float | None = schema.number(at_least=0.0, at_most=10.0, default=None)
    shear_factor: float | None = schema.number(at_least=0.0, at_most=10.0, default=None)

    def verify(self, path: str) -> None:
        """One of the two ways to tell the wall."""
        if (self.density is None) == (self.inner_diameter is None):
            given = "neither" if self.density is None else "both"
            raise ParameterError(path, given, "one of density and inner_diameter")
        inner = self.inner_diameter
        if inner is not None and not inner < self.outer_diameter * (1 - 1e-6):
            raise ParameterError(
                f"{path}.inner_diameter", inner, f"below outer_diameter = {self.outer_diameter:g} m"
            )

    def section(self, mass_per_length: float, path: str) -> Section:
        """The section of a tube with this mass per length, kg/m.

        :raises ParameterError: at that density the mass is more than the whole circle's, or none.
        """
        outer = self.outer_diameter
        inner = self.inner_diameter
        if not mass_per_length > 0.0:
            raise ParameterError(path, mass_per_length, "a member with mass, kg/m above zero")
        if inner is None:
            square = outer * outer - 4 * mass_per_length / (math.pi * self.density)  # type: ignore[operator]
            # A mass that was worked out from a solid bar may miss it by rounding.
            if square < -1e-9 * outer * outer:
                raise ParameterError(
                    f"{path}.density",
                    self.density,
                    f"at least {4 * mass_per_length / (math.pi * outer * outer):.6g} kg/m3: the "
                    f"mass in a solid bar of that diameter",
                )
            inner = math.sqrt(max(0.0, square))
        factor = cowper(inner / outer) if self.shear_factor is None else self.shear_factor
        return Section(
            self.youngs_modulus, self.shear_modulus, outer, inner, mass_per_length, factor
        )


@dataclass(frozen=True, eq=False)
class Support:
    """How one end of a member stands on a body.

    ``joint``: its name; joints of one name are one element of the energy shares. ``body``:
    ``GROUND``, ``MOVING`` or the name of a member, whose free end is meant. ``axes``: the joint's
    axes as columns, shape (3, 3). ``compliance``: along them three m/N, about them three
    rad/(N m); 0 rigid, infinite free.
    """

    joint: str
    body: str
    axes: Array
    compliance: tuple[float, ...] = RIGID


@dataclass(frozen=True, eq=False)
class Member:
    """A straight beam from ``start`` to ``end``, shape (3,), m.

    ``body`` is the name that it has in the energy shares: two rods can be one forearm. A member
    whose ``outer`` is None ends free, and others can stand there.
    """

    name: str
    body: str
    section: Section
    start: Array
    end: Array
    inner: Support
    outer: Support | None


@dataclass(frozen=True, eq=False)
class RigidBody:
    """A body fixed to the platform: mass (kg), centre of mass from the platform's origin (m).

    ``inertia`` about its centre of mass, shape (3, 3), kg m2; both along the fixed axes.
    """

    name: str
    mass: float
    com: Array
    inertia: Array


@dataclass(frozen=True, eq=False)
class Frame:
    """The elastic frame of a robot in one pose; ``origin``: the platform's origin, shape (3,)."""

    origin: Array
    members: tuple[Member, ...]
    bodies: tuple[RigidBody, ...]


@runtime_checkable
class Framed(Protocol):
    """A mechanism that can declare its elastic frame."""

    def frame(self, pose: Array) -> Frame:
        """The frame in a pose, shape (3,).

        :raises ParameterError: the parameter file has no section that modes need.
        :raises UnreachableError: no pose of the mechanism.
        """
        ...


def framed(robot: Robot) -> Framed:
    """The robot as one that declares its elastic frame.

    :raises ParameterError: the mechanism declares none.
    """
    if not isinstance(robot, Framed):
        raise ParameterError("mechanism", robot.mechanism, "a mechanism with an elastic frame")
    return robot


def disc(mass: float, radius: float) -> Array:
    """Inertia of a thin disc about its centre, axis z, shape (3, 3), kg m2."""
    return mass * radius**2 / 4 * np.diag([1.0, 1.0, 2.0])


__all__ = [
    "GROUND",
    "MOVING",
    "RIGID",
    "Frame",
    "Framed",
    "Member",
    "RigidBody",
    "Section",
    "Support",
    "Tube",
    "cowper",
    "disc",
    "framed",
    "modulus",
]
