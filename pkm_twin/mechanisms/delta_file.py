# SPDX-License-Identifier: Apache-2.0
"""The sections of a delta's parameter file."""

from __future__ import annotations

from dataclasses import dataclass

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.machine import schema
from pkm_twin.machine.members import Tube
from pkm_twin.machine.sections import check_azimuths, length, mass


@dataclass(frozen=True, eq=False)
class Geometry:
    """Lengths (m), limb azimuths (rad) and forearm closures."""

    base_radius: float = length()
    platform_radius: float = length()
    arm_length: float = length()
    forearm_length: float = length()
    azimuths: Array = schema.vector(3, unit="rad")
    closures: tuple[str, ...] = schema.words("rod", "rcu", size=3, distinct=False)

    def verify(self, path: str) -> None:
        """Limbs apart, and at most one of them an rcu."""
        if self.closures.count("rcu") > 1:
            raise ParameterError(f"{path}.closures", list(self.closures), "at most one rcu limb")
        check_azimuths(self.azimuths, f"{path}.azimuths")


@dataclass(frozen=True, eq=False)
class Inertia:
    """Masses (kg) and inertias (kg m2).

    ``arm_inertia``: about the arm's centre of mass, across the arm. Forearms are thin rods.
    """

    platform_mass: float = mass()
    arm_mass: float = mass()
    forearm_mass: float = mass()
    arm_com: float = schema.number(
        at_least=0.0, at_most=1.0, unit="of the arm, from its pivot", default=0.5
    )
    arm_inertia: float | None = schema.number(at_least=0.0, unit="kg m2", default=None)
    rotor_inertia: float = schema.number(at_least=0.0, unit="kg m2", default=0.0)


@dataclass(frozen=True, eq=False)
class Members:
    """Arms and forearms as tubes; their masses are in the section inertia.

    Used for elasticity, and the outer diameters for limb interference; the dynamics do not use it.

    ``forearm``: each of a parallelogram's two rods, ``parallelogram_width`` apart (m), each with
    half of the forearm's mass. ``rcu_forearm``: the one rod of an rcu limb, for modes of a robot
    with such a limb. ``platform_inertia``: about the platform's reference point, kg m2; default a
    thin disc of the platform's radius. ``drive_compliance``: of a locked drive, rad/(N m).
    ``elbow_compliance`` and ``platform_joint_compliance``: of each rod's end in all directions that
    the joint constrains, m/N.
    """

    arm: Tube = schema.section(Tube)
    forearm: Tube = schema.section(Tube)
    parallelogram_width: float = length()
    rcu_forearm: Tube | None = schema.section(Tube, default=None)
    platform_inertia: Array | None = schema.inertia(positive=True, default=None)
    drive_compliance: float = schema.number(
        at_least=0.0, at_most=1.0, unit="rad/(N m)", default=0.0
    )
    elbow_compliance: float = schema.number(at_least=0.0, at_most=1.0, unit="m/N", default=0.0)
    platform_joint_compliance: float = schema.number(
        at_least=0.0, at_most=1.0, unit="m/N", default=0.0
    )
