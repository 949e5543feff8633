# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Elastic members of a machine: round bars between points of its bodies, and their sections."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import number, reference
from pkm_twin.codegen.operations import maximum, sign, sqrt
from pkm_twin.errors import ParameterError
from pkm_twin.machine import schema
from pkm_twin.machine.graph import Graph

Place = tuple[str, Array]
"""A point of a body, given at home."""


class RigidError(ParameterError):
    """Raised for a robot whose file makes nothing elastic."""


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
        """Area of the section, m2."""
        return math.pi / 4 * (self.outer_diameter**2 - self.inner_diameter**2)

    @property
    def second_moment(self) -> float:
        """Second moment of area about a diameter, m4; half of the polar one."""
        return math.pi / 64 * (self.outer_diameter**4 - self.inner_diameter**4)

    @property
    def rigidities(self) -> tuple[float, float, float, float]:
        """EA (N), GJ and EI (N m2), and 12 E I over the shear rigidity (m2)."""
        bending = self.youngs_modulus * self.second_moment
        across = 12 * bending * self.shear_factor / (self.shear_modulus * self.area)
        twisting = self.shear_modulus * 2 * self.second_moment
        return self.youngs_modulus * self.area, twisting, bending, across

    @property
    def rotary_inertia(self) -> float:
        """Moment of inertia per length about a diameter, kg m; half of that about the axis."""
        return self.mass_per_length * self.second_moment / self.area


def shear_area_ratio(ratio: float) -> float:
    """Return A / A_shear of a tube by its inner over outer diameter: 7/6 solid, 2 thin.

    Cowper 1966, table 1, hollow circle, for a Poisson's ratio of 0: a laminate's moduli are
    independent of each other and give no ratio that could stand in.
    """
    square = ratio * ratio
    return (7 + 34 * square + 7 * square * square) / (6 * (1 + square) ** 2)


def modulus() -> Any:
    """Make a field of an elastic modulus, Pa."""
    return schema.number(low=1e3, high=1e14, unit="Pa")


def compliances(**options: Any) -> Any:
    """Make a field of a joint's compliances along and about its three axes; .inf where it is free."""
    return schema.vector(6, low=0.0, high=math.inf, unit="m/N (3), rad/(N m) (3)", **options)


@dataclass(frozen=True, eq=False)
class Tube:
    """A tube whose mass is given elsewhere: moduli (Pa), outer diameter (m).

    Give either ``density`` (kg/m3) or ``inner_diameter`` (m); the other follows from the mass.
    ``shear_factor``: A / A_shear. The default is Cowper's (1966) for a tube at a Poisson's ratio of
    0, 7/6 solid to 2 thin-walled. At 0.3, as for metals, the factors are 1.13 and 1.88.
    """

    youngs_modulus: float = modulus()
    shear_modulus: float = modulus()
    outer_diameter: float = schema.number(low=1e-6, high=10.0, unit="m")
    density: float | None = schema.number(above=0.0, high=1e5, unit="kg/m3", default=None)
    inner_diameter: float | None = schema.number(low=0.0, high=10.0, unit="m", default=None)
    shear_factor: float | None = schema.number(low=0.0, high=10.0, default=None)

    def verify(self, path: str) -> None:
        """Check that exactly one of ``density`` and ``inner_diameter`` is given."""
        if (self.density is None) == (self.inner_diameter is None):
            given = "neither" if self.density is None else "both"
            raise ParameterError(path, given, "one of density and inner_diameter")
        inner = self.inner_diameter
        if inner is not None and not inner < self.outer_diameter * (1 - 1e-6):
            raise ParameterError(f"{path}.inner_diameter", inner, f"below outer_diameter = {self.outer_diameter:g} m")

    def section(self, mass_per_length: float, path: str) -> Section:
        """Return the section of a tube with this mass per length, kg/m.

        For expressions an impossible section gives NaN at run time.

        :raises ParameterError: the mass is not above zero, or exceeds that of the solid bar.
        """
        outer = self.outer_diameter
        inner = self.inner_diameter
        if not reference(mass_per_length) > 0.0:
            raise ParameterError(path, mass_per_length, "a member with mass, kg/m above zero")
        if inner is None:
            square = outer * outer - 4 * mass_per_length / (math.pi * self.density)  # type: ignore[operator]
            # A mass computed from a solid bar may exceed it by rounding.
            spare = square + 1e-9 * outer * outer
            if reference(spare) < 0.0:
                raise ParameterError(
                    f"{path}.density",
                    self.density,
                    f"at least {4 * mass_per_length / (math.pi * outer * outer):.6g} kg/m3: the "
                    f"mass in a solid bar of that diameter",
                )
            inner = number(sqrt(maximum(0.0, square)) * sqrt(sign(spare)))
        factor = shear_area_ratio(inner / outer) if self.shear_factor is None else self.shear_factor
        # The factor is 1, or NaN without mass.
        young = number(self.youngs_modulus * sqrt(2.0 * sign(mass_per_length) - 1.0))
        return Section(young, self.shear_modulus, outer, inner, mass_per_length, factor)


@dataclass(frozen=True, eq=False)
class Beam:
    """A straight round bar between two points; ``limb``: the number of its limb.

    ``element``: its name in the energy shares, which the two rods of a forearm have in common.
    ``parts``: the bodies, or the rod, that the bar models; two for a telescope. ``carries``: other
    bodies whose mass it includes. ``radius``: outer, m. ``section``: of an elastic beam, or the
    tube that makes it with ``mass_per_length``, kg/m; ``path``: the tube's path in the file.
    """

    name: str
    element: str
    limb: int
    inner: Place
    outer: Place
    parts: tuple[str, ...]
    radius: float
    carries: tuple[str, ...] = ()
    section: Section | Tube | None = None
    mass_per_length: Any = 0.0
    path: str = ""


@dataclass(frozen=True, eq=False)
class Structure:
    """Beams with their sections, and the compliance of joints, all by name.

    A joint's six compliances are along and about the directions of its reactions: m/N, rad/(N m);
    joints that are not named are rigid. Freedoms of passive joints are always free. ``order``: names
    of the energy shares in the order of the mechanism, if it has one.
    """

    beams: tuple[Beam, ...]
    sections: Mapping[str, Section]
    compliances: Mapping[str, Sequence[float]]
    order: tuple[str, ...] = ()

    @property
    def elements(self) -> tuple[str, ...]:
        """Names of the elastic parts: bars, then joints."""
        if self.order:
            return self.order
        soft = [name for name, values in self.compliances.items() if any(0.0 < value < math.inf for value in values)]
        return tuple(dict.fromkeys([*(beam.element for beam in self.beams), *soft]))

    def scaled(self, factors: Mapping[str, float]) -> Structure:
        """Return the structure with the compliance of some elements multiplied, by name."""
        if not factors:
            return self
        moduli = {beam.name: 1.0 / factors.get(beam.element, 1.0) for beam in self.beams}
        sections = {
            name: replace(
                section,
                youngs_modulus=section.youngs_modulus * moduli[name],
                shear_modulus=section.shear_modulus * moduli[name],
            )
            for name, section in self.sections.items()
        }
        compliances = {
            name: [factors.get(name, 1.0) * value for value in values] for name, values in self.compliances.items()
        }
        return replace(self, sections=sections, compliances=compliances)


@dataclass(frozen=True, eq=False)
class Parts:
    """What a robot file describes: the graph, its beams, and the compliance of joints by name.

    ``order``: as in :class:`Structure`. ``rigid``: path and text of what makes parts elastic, for
    the error where nothing is. ``missing``: path of a section that a bar must have and has not.
    """

    graph: Graph
    beams: tuple[Beam, ...] = ()
    compliances: Mapping[str, Sequence[float]] = field(default_factory=dict)
    order: tuple[str, ...] = ()
    rigid: tuple[str, str] = ("members", "a section with the elastic members")
    missing: str = ""

    def structure(self) -> Structure:
        """Return the elastic beams with their sections, and the compliance of joints.

        :raises RigidError: no beam and no joint is elastic.
        :raises ParameterError: sections that no bar can have, all named, or a missing one.
        """
        sections, faults = dict[str, Section](), dict[str, ParameterError]()
        for beam in self.beams:
            tube = beam.section
            try:
                if isinstance(tube, Tube):
                    sections[beam.name] = tube.section(beam.mass_per_length, beam.path)
                elif tube is not None:
                    sections[beam.name] = tube
            except ParameterError as error:
                faults.setdefault(error.field, error)
        if faults:
            first, *others = faults.values()
            more = "".join(f"; wrong too: {error.field}" for error in others)
            raise ParameterError(first.field, first.value, f"{first.bound}{more}")
        if not sections and not self.compliances:
            raise RigidError(self.rigid[0], None, self.rigid[1])
        if self.missing:
            raise ParameterError(self.missing, None, "a section, as rods carry load")
        beams = tuple(beam for beam in self.beams if beam.name in sections)
        return Structure(beams, sections, self.compliances, self.order)


def axial(across: Any, along: Any, axis: Array) -> Array:
    """Return the inertia of an axisymmetric body from its moments across and along a unit vector."""
    return np.asarray(across * np.eye(3) + (along - across) * np.outer(axis, axis))


def disc(mass: float, radius: float) -> Array:
    """Return the inertia of a thin disc about its centre, axis z, shape (3, 3), kg m2."""
    return mass * radius**2 / 4 * np.diag([1.0, 1.0, 2.0])
