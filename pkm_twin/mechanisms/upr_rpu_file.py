# SPDX-License-Identifier: Apache-2.0
"""The sections of a 2UPR-RPU's parameter file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.machine import schema
from pkm_twin.machine.graph import MIN_LENGTH
from pkm_twin.machine.members import compliances, modulus
from pkm_twin.machine.sections import length, mass

FREE: Final = {
    "upr_revolute": (4,),
    "upr_universal": (3, 4),
    "rpu_universal": (3, 4),
    "rpu_revolute": (3,),
}
"""Entries of each joint's compliance that are free axes."""
_ENTRIES: Final = ("along u", "along v", "along w", "about u", "about v", "about w")


@dataclass(frozen=True, eq=False)
class Geometry:
    """Distances O to B_i and o to A_i, m."""

    base_radius: float = length()
    platform_radius: float = length()


@dataclass(frozen=True, eq=False)
class Members:
    """Round bars: moduli (Pa), diameters (m), and the shear factor A / A_shear.

    The default 1 is that of the paper. Cowper's factor (1966) of a round bar is 7/6 at a Poisson's
    ratio of 0 and 1.13 at 0.3.
    """

    youngs_modulus: float = modulus()
    shear_modulus: float = modulus()
    diameter: Array = schema.vector(3, at_least=MIN_LENGTH, spread=True, unit="m")
    shear_factor: float = schema.number(at_least=0.0, at_most=10.0, default=1.0)

    def verify(self, path: str) -> None:
        """Diameters whose fourth power is a number to compute with."""
        for i, value in enumerate(self.diameter.tolist()):
            if not 1e-6 <= value <= 10.0:
                raise ParameterError(f"{path}.diameter[{i}]", value, "1e-6 to 10 m")


@dataclass(frozen=True, eq=False)
class JointsCompliance:
    """Compliance of each joint in its own axes u, v, w: three m/N, three rad/(N m).

    R of UPR: v is its axis, w points from A to B. U of UPR and of RPU: u and v are its axes. R of
    RPU: u is its axis, w points from A to B. Entries about an axis of the joint are free (.inf); 0
    is rigid.
    """

    upr_revolute: Array = compliances()
    upr_universal: Array = compliances()
    rpu_universal: Array = compliances()
    rpu_revolute: Array = compliances()

    def verify(self, path: str) -> None:
        """Free exactly where the joint turns; a number in every direction that carries load."""
        for joint, free in FREE.items():
            for i, value in enumerate(getattr(self, joint).tolist()):
                field = f"{path}.{joint}[{i}]"
                if i in free and value != math.inf:
                    raise ParameterError(field, value, f".inf: the joint turns {_ENTRIES[i]}")
                if i not in free and not value <= 1.0:
                    raise ParameterError(
                        field, value, f"0 to 1: the joint carries load {_ENTRIES[i]}"
                    )


@dataclass(frozen=True, eq=False)
class Inertia:
    """Density of the bars (kg/m3), and the platform's mass.

    As rigid bodies, a limb is two equal round bars, each half as long as the limb at home, whose
    length is the middle of ``limits.limb_length``. The lower bar starts at B, the upper one at A;
    they meet at home. For modes a limb is one bar from B to A.
    ``rotor_inertia``: of the drives, reflected to the limbs, kg, without weight.
    ``platform_com`` (m) and ``platform_inertia`` (about the centre of mass, kg m2) are in platform
    axes; the default is a thin disc of the platform's radius about the reference point.
    """

    density: float = schema.number(above=0.0, at_most=1e5, unit="kg/m3")
    platform_mass: float = mass()
    platform_com: Array = schema.vector(3, unit="m", default=[0, 0, 0])
    platform_inertia: Array | None = schema.inertia(positive=False, default=None)
    rotor_inertia: float = schema.number(at_least=0.0, unit="kg", default=0.0)


@dataclass(frozen=True, eq=False)
class Limits:
    """Limb lengths [min, max], one pair or three (m); bound of every passive joint's angle (rad).

    The default is no limit.
    """

    limb_length: Array | None = schema.interval(above=0.0, count=3, unit="m", default=None)
    joint_angle: float | None = schema.number(above=0.0, at_most=math.pi, unit="rad", default=None)

    @property
    def position(self) -> Array | None:
        """Limits of the actuated joints, shape (3, 2), m."""
        return self.limb_length

    @property
    def velocity(self) -> Array | None:
        """None: the machine's file has no such limit."""
        return None

    @property
    def effort(self) -> Array | None:
        """None: the machine's file has no such limit."""
        return None
