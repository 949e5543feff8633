# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A mechanism of your own: a Delta on three vertical rails, from a few lengths.

    python examples/rail_delta.py

Write one if a few lengths describe a family of machines. The file has a schema and a function from
its parameters to a graph, with beams and compliances if the machine is elastic; everything else,
closed forms too, follows from these. For use in robot files add one line to
``pkm_twin/mechanisms/catalogue.py``.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pkm_twin.kinematics.pose import COORDINATES
from pkm_twin.machine import schema
from pkm_twin.machine.graph import BASE, Body, Graph, Joint, Rod, array
from pkm_twin.machine.members import Parts
from pkm_twin.machine.sections import check_azimuths, length, mass
from pkm_twin.robot.robot import Robot

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Geometry:
    """Radii of the carriages' and the platform's ball joints, rod length, width of a pair (m)."""

    carriage_radius: float = length()
    platform_radius: float = length()
    rod_length: float = length()
    width: float = length()
    azimuths: np.ndarray = schema.vector(3, unit="rad")

    def verify(self, path):
        """Check that no two limbs have one azimuth."""
        check_azimuths(self.azimuths, f"{path}.azimuths")


@dataclass(frozen=True, eq=False)
class Inertia:
    """Masses (kg) and the platform's inertia; a carriage only slides, so it needs no inertia."""

    carriage_mass: float = mass()
    platform_mass: float = mass()
    rod_mass: float = mass()
    platform_inertia: np.ndarray = schema.inertia(positive=False)
    rotor_inertia: float = schema.number(low=0.0, unit="kg", default=0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class RailDelta(Robot):
    """A Delta on three vertical rails."""

    mechanism: str = schema.choice("rail_delta")
    geometry: Geometry = schema.section(Geometry)
    inertia: Inertia = schema.section(Inertia)

    description: ClassVar[str] = "Delta on three vertical rails"
    mobility: ClassVar[str] = "3: translations x, y, z"
    coordinates: ClassVar = tuple(COORDINATES[name] for name in "xyz")
    limb_names: ClassVar = ("limb 1", "limb 2", "limb 3")

    def list_limb_directions(self):
        """Yield for each limb the outward direction and the direction between the rods of its pair."""
        for azimuth in self.geometry.azimuths:
            out = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
            yield out, np.cross(UP, out)

    def make_parts(self):
        """Make the machine at home: carriages at zero, the platform below the origin."""
        g, m = self.geometry, self.inertia
        drop = np.sqrt(g.rod_length**2 - (g.carriage_radius - g.platform_radius) ** 2)
        platform = -drop * UP
        bodies = {"platform": Body("platform", m.platform_mass, array(platform), m.platform_inertia)}
        joints, rods = {}, {}
        for i, (out, along) in enumerate(self.list_limb_directions(), 1):
            ball = g.carriage_radius * out
            carriage, rail = f"carriage_{i}", f"rail_{i}"
            bodies[carriage] = Body(carriage, m.carriage_mass, array(ball))
            joints[rail] = Joint(
                rail,
                "prismatic",
                BASE,
                carriage,
                array(ball),
                array([UP]),
                actuated=True,
                rotor_inertia=m.rotor_inertia,
            )
            for name, side in (("left", 0.5), ("right", -0.5)):
                shift = side * g.width * along
                ends = array([ball + shift, platform + g.platform_radius * out + shift])
                rods[f"{name}_{i}"] = Rod(f"{name}_{i}", carriage, "platform", ends, m.rod_mass)
        return Parts(Graph(bodies, joints, rods, "platform", array(platform)))


def main():
    """Compare carriage heights with a right triangle in each limb."""
    own = RailDelta.from_data(
        {
            "mechanism": "rail_delta",
            "geometry": {
                "carriage_radius": 0.17,
                "platform_radius": 0.05,
                "rod_length": 0.37,
                "width": 0.06,
                "azimuths": [1.5707963, 3.6651914, 5.7595865],
            },
            "inertia": {
                "carriage_mass": 0.5,
                "platform_mass": 0.4,
                "rod_mass": 0.03,
                "platform_inertia": [3.0e-4, 3.0e-4, 5.0e-4],
                "rotor_inertia": 0.13,
            },
            "friction": {"viscous": 4.0, "coulomb": 1.5},
        },
        "own",
    )
    pose = np.random.default_rng(1).uniform(-0.05, 0.05, (100, 3)) - [0, 0, 0.3]
    found, heights = own.inverse(pose), []
    g = own.geometry
    for out, _ in own.list_limb_directions():
        x, y, _ = (pose + (g.platform_radius - g.carriage_radius) * out).T
        heights.append(pose[:, 2] + np.sqrt(g.rod_length**2 - x * x - y * y))
    miss = np.abs(found - np.transpose(heights)).max()
    if miss > 1e-12:
        raise SystemExit(f"carriage heights are off by {miss:.0e} m")
    print(f"carriage heights agree to {miss:.0e} m")


if __name__ == "__main__":
    main()
