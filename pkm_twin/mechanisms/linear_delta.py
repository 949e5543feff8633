# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Linear Delta as 3D printers have it: three towers, a rod pair from each carriage, a platform.

Its numbers are those of a printer's firmware (Klipper, Marlin, RepRapFirmware). Frame: origin on
the bed between the towers, z up. Pose: nozzle x, y, z (m). Joint: height of a carriage's rod ends
above those of the platform with the nozzle on the bed (m). ``radius`` is the horizontal length of a
rod pair with the nozzle at the centre: the tower's less the platform's and the carriage's offsets.

Branch: the nozzle below the carriages.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import plain
from pkm_twin.codegen.operations import cos, sin, sqrt
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.pose import COORDINATES, Coordinate
from pkm_twin.machine import schema
from pkm_twin.machine.graph import BASE, PLATFORM, UP, Body, Graph, Joint, Rod, array
from pkm_twin.machine.members import Parts, disc
from pkm_twin.machine.pose_grid import PoseGrid
from pkm_twin.machine.sections import check_azimuths, length, mass
from pkm_twin.mechanisms import TwinRobot

LIMBS: Final = ("a", "b", "c")


@dataclass(frozen=True, eq=False)
class Geometry:
    """Lengths (m), tower angles about z from x, and the towers' leans (rad).

    ``leans``: angles of each tower from the vertical at home, outwards and sideways
    (counter-clockwise).
    """

    radius: float = length()
    angles: Array = schema.vector(3, unit="rad")
    arm_lengths: Array = schema.vector(3, above=0.0, unit="m")
    leans: Array | None = schema.vector(6, unit="rad", default=None)

    def verify(self, path: str) -> None:
        """Check that towers have different azimuths, and that rods are longer than the radius."""
        check_azimuths(self.angles, f"{path}.angles")
        for i, arm in enumerate(self.arm_lengths):
            if not arm > self.radius:
                raise ParameterError(f"{path}.arm_lengths[{i}]", float(arm), "above the radius")


@dataclass(frozen=True, eq=False)
class Inertia:
    """Masses, kg, of platform, carriage and rod pair, and the rotor inertia reflected to a carriage."""

    platform_mass: float = mass()
    carriage_mass: float = mass()
    rod_mass: float = mass(default=0.0)
    rotor_inertia: float = schema.number(low=0.0, unit="kg", default=0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class LinearDelta(TwinRobot):
    """A linear Delta of a printer."""

    mechanism: str = schema.choice("linear_delta")
    geometry: Geometry = schema.section(Geometry)
    inertia: Inertia = schema.section(Inertia)
    joints: tuple[str, ...] = schema.words(size=3, default=["stepper_a", "stepper_b", "stepper_c"])

    mobility: ClassVar[str] = "3: translations x, y, z"
    coordinates: ClassVar[tuple[Coordinate, ...]] = tuple(COORDINATES[c] for c in "xyz")
    layout: ClassVar[PoseGrid] = PoseGrid("cylinder", ("x", "y", "z"), "z", ("x", "y"))
    limb_names: ClassVar[tuple[str, ...]] = tuple(f"tower {limb}" for limb in LIMBS)
    description: ClassVar[str] = "linear Delta, three towers with rod pairs"

    @property
    def size(self) -> float:
        """Radius of the towers, m: the scale of lengths."""
        return self.geometry.radius

    def make_parts(self) -> Parts:
        """Make carriages on their towers, rods to the nozzle, a platform that does not turn."""
        g, m = self.geometry, self.inertia
        rotor = self.reflect_rotor(m.rotor_inertia, slides=True)
        bodies: dict[str, Body] = {}
        joints: dict[str, Joint] = {}
        rods: dict[str, Rod] = {}
        for i, limb in enumerate(LIMBS):
            angle = g.angles[i]
            out = plain([cos(angle), sin(angle), 0.0 * angle])
            # The rods' upper end with the nozzle at the origin.
            top = g.radius * out + sqrt(g.arm_lengths[i] ** 2 - g.radius**2) * UP
            axis: Any = UP
            if g.leans is not None:
                along = plain([-sin(angle), cos(angle), 0.0 * angle])
                axis = g.leans[2 * i] * out + g.leans[2 * i + 1] * along + UP
                axis = axis / sqrt(axis @ axis)
            carriage = f"carriage {limb}"
            bodies[carriage] = Body(carriage, m.carriage_mass, array(top), np.zeros((3, 3)))
            joints[self.joints[i]] = Joint(
                self.joints[i],
                "prismatic",
                BASE,
                carriage,
                array(top),
                array([axis]),
                actuated=True,
                home=top[2],
                rotor_inertia=rotor,
            )
            rods[f"rods {limb}"] = Rod(
                f"rods {limb}",
                carriage,
                PLATFORM,
                array([top, np.zeros(3)]),
                m.rod_mass,
                array(np.cross(UP, out)),
            )
        turning = disc(m.platform_mass, 0.3 * g.radius)
        bodies[PLATFORM] = Body(PLATFORM, m.platform_mass, array(np.zeros(3)), array(turning))
        # Rod pairs prevent rotation, so the platform has three translations.
        joints["translation"] = Joint("translation", "translation", BASE, PLATFORM, array(np.zeros(3)), virtual=True)
        return Parts(Graph(bodies, joints, rods, PLATFORM, array(np.zeros(3))))
