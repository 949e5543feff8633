# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The 3-PRRU head: three vertical sliders, three limbs, a platform that lifts and tilts.

Frame: origin at the centre of the base circle, z up. Pose: height z of the platform's centre (m),
alpha, beta (rad); the platform's rotation is Rx(alpha) Ry(beta) Rz(gamma). Joint: slider height q,
force positive up (N). Limb i stands in the vertical plane of azimuth phi_i: its slider at
C_i = (-R cos phi_i, -R sin phi_i, q_i), its platform joint U_i at (-r cos phi_i, -r sin phi_i, 0)
in the platform frame, l apart. The limb swings by theta_i about t_i = (-sin phi_i, cos phi_i, 0),
direction d_i = sin theta_i e_i + cos theta_i z with e_i = (cos phi_i, sin phi_i, 0); its upper
link turns in addition about d_i, so that the universal joint's platform-fixed axis, tangential,
and its link-fixed axis stay at a right angle.

At home every slider is ``below`` its platform joint (the paper's equation 9) or ``above`` it. The
parasitic motions gamma, x and y follow from the planes of the limbs.

Source: 3-PRRU paper (equations 1 to 17 geometry, 18 to 31 velocities, 32 to 41 virtual work). The
paper has each link's mass at its slider joint, which ``link_com: 0`` gives.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.operations import sqrt
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.pose import COORDINATES, Coordinate, name_angles
from pkm_twin.machine import schema
from pkm_twin.machine.graph import BASE, PLATFORM, UP, Body, Direction, Graph, Joint, array
from pkm_twin.machine.members import Beam, Parts, Tube, axial, disc
from pkm_twin.machine.pose_grid import PoseGrid
from pkm_twin.machine.sections import check_azimuths, length, mass, shared_middle
from pkm_twin.mechanisms import TwinRobot

LIMBS: Final = ("I", "II", "III")


@dataclass(frozen=True, eq=False)
class Geometry:
    """Lengths (m), limb azimuths phi (rad), and the position of the sliders (above or below)."""

    base_radius: float = length()
    platform_radius: float = length()
    limb_length: float = length()
    azimuths: Array = schema.vector(3, unit="rad")
    branch: str = schema.choice("above", "below")

    def verify(self, path: str) -> None:
        """Check that limbs have different azimuths and reach the level platform."""
        check_azimuths(self.azimuths, f"{path}.azimuths")
        out = abs(self.base_radius - self.platform_radius)
        if not self.limb_length > out * (1 + 1e-6):
            raise ParameterError(
                f"{path}.limb_length",
                self.limb_length,
                f"above |base_radius - platform_radius| = {out:.6g} m",
            )


@dataclass(frozen=True, eq=False)
class Inertia:
    """Masses (kg), centres of mass and inertias (kg m2).

    ``link_com``: both links' centre of mass as a fraction of l from the slider joint.
    ``lower_link_inertia``, ``upper_link_inertia``: about that centre, [across, along the limb];
    the default is a thin rod of length l. ``platform_com`` and ``platform_inertia`` (about the
    centre of mass) are in platform axes; the default is a thin disc of the platform's radius.
    ``rotor_inertia``: of the drives, reflected to the sliders, kg, without weight.
    """

    slider_mass: float = mass()
    lower_link_mass: float = mass()
    upper_link_mass: float = mass()
    platform_mass: float = mass()
    link_com: float = schema.number(low=0.0, high=1.0, unit="of the link, from the slider's joint", default=0.5)
    lower_link_inertia: Array | None = schema.vector(2, low=0.0, unit="kg m2", default=None)
    upper_link_inertia: Array | None = schema.vector(2, low=0.0, unit="kg m2", default=None)
    platform_com: Array = schema.vector(3, unit="m", default=[0, 0, 0])
    platform_inertia: Array | None = schema.inertia(positive=False, default=None)
    rotor_inertia: float = schema.number(low=0.0, unit="kg", default=0.0)

    def verify(self, path: str) -> None:
        """Check that axial moments of inertia satisfy the triangle inequality."""
        for key in ("lower_link_inertia", "upper_link_inertia"):
            value = getattr(self, key)
            if value is not None and value[1] > 2 * value[0] * (1 + 1e-9):
                raise ParameterError(f"{path}.{key}", value.tolist(), "triangle rule: axial at most twice across")


@dataclass(frozen=True, eq=False)
class Members:
    """A limb's two links as one tube with the masses of both, for elasticity and interference."""

    limb: Tube = schema.section(Tube)


@dataclass(frozen=True, eq=False, kw_only=True)
class Prru(TwinRobot):
    """A 3-PRRU head with three vertical sliders."""

    mechanism: str = schema.choice("prru")
    geometry: Geometry = schema.section(Geometry)
    inertia: Inertia = schema.section(Inertia)
    joints: tuple[str, ...] = schema.words(size=3, default=["slider_1", "slider_2", "slider_3"])
    members: Members | None = schema.section(Members, default=None)

    description: ClassVar[str] = "3-PRRU head, three vertical sliders and two links per limb"
    mobility: ClassVar[str] = "3: translation z, rotations alpha, beta (x, y, gamma follow)"
    coordinates: ClassVar[tuple[Coordinate, ...]] = (
        COORDINATES["z"],
        *name_angles({"alpha": "x", "beta": "y"}),
    )
    layout: ClassVar[PoseGrid] = PoseGrid("cylinder", ("z", "alpha", "beta"), "z", ("alpha", "beta"), zero_torsion=True)
    limb_names: ClassVar[tuple[str, ...]] = tuple(f"limb {limb}" for limb in LIMBS)

    def chosen_home(self) -> float:
        """Height of the sliders at home, m: the middle of their limits, else zero."""
        return shared_middle(self.limits.position) or 0.0

    def default_inertia(self) -> dict[str, Any]:
        """Return the inertias of links, thin rods, and of the platform, a disc."""
        g, m = self.geometry, self.inertia
        thin = np.array([g.limb_length**2 / 12, 0.0])
        return {
            "lower_link_inertia": m.lower_link_mass * thin,
            "upper_link_inertia": m.upper_link_mass * thin,
            "platform_inertia": disc(m.platform_mass, g.platform_radius),
        }

    def make_parts(self) -> Parts:
        """Make sliders, links and platform, level; limbs are bars between slider and platform.

        The upper link turns about the limb (equation 4) by the angle that its universal joint's
        tangential axis, fixed to the platform, requires (equations 13 to 17): the closures find it.
        """
        g, members = self.geometry, self.members
        m: Any = self.with_default_inertia.inertia
        height, l = self.home_joint, g.limb_length  # noqa: E741
        lower, upper = m.lower_link_inertia, m.upper_link_inertia
        rotor = self.reflect_rotor(m.rotor_inertia, slides=True)
        aside = g.base_radius - g.platform_radius
        # The level platform's height over the sliders.
        rise = (1.0 if g.branch == "below" else -1.0) * sqrt(g.limb_length**2 - aside**2)
        beams = []
        bodies: dict[str, Body] = {}
        joints: dict[str, Joint] = {}
        origin = array([0.0, 0.0, height + rise])
        for i, limb in enumerate(LIMBS):
            # Radial and tangential direction, equations 2 and 3.
            e = np.array([np.cos(g.azimuths[i]), np.sin(g.azimuths[i]), 0.0])
            t = np.cross(UP, e)
            foot = array(height * UP - g.base_radius * e)
            head = array(origin - g.platform_radius * e)
            d = (head - foot) / l
            slider, low, high = (f"{b} {limb}" for b in ("slider", "lower link", "upper link"))
            com = array(foot + m.link_com * l * d)
            bodies[slider] = Body(slider, m.slider_mass, foot)
            bodies[low] = Body(low, m.lower_link_mass, com, array(axial(lower[0], lower[1], d)))
            bodies[high] = Body(high, m.upper_link_mass, com, array(axial(upper[0], upper[1], d)))
            fixed = _make_directions(BASE, e=e, t=t, z=UP)
            along = _make_directions(low, **{"d": d, "t": t, "t x d": np.cross(t, d)})
            name = self.joints[i]
            joints[name] = Joint(
                name,
                "prismatic",
                BASE,
                slider,
                foot,
                array([UP]),
                actuated=True,
                home=height,
                rotor_inertia=rotor,
                directions=fixed,
                label=f"guide {limb}",
            )
            for label, kind, pair, at, axes in (
                ("slider joint", "revolute", (slider, low), foot, [t]),
                ("link joint", "revolute", (low, high), foot, [d]),
                ("platform joint", "universal", (high, PLATFORM), head, [np.cross(d, t), t]),
            ):
                full = f"{label} {limb}"
                joints[full] = Joint(full, kind, *pair, at, array(axes), directions=along)
            if members is not None:
                beam, tube, line = f"limb {limb}", members.limb, (m.lower_link_mass + m.upper_link_mass) / l
                radius, ends = tube.outer_diameter / 2, ((high, foot), (high, head))
                beams.append(Beam(beam, beam, i, *ends, (high,), radius, (low,), tube, line, "members.limb"))
        bodies[PLATFORM] = Body(PLATFORM, m.platform_mass, array(origin + m.platform_com), array(m.platform_inertia))
        return Parts(Graph(bodies, joints, {}, PLATFORM, origin), tuple(beams))


def _make_directions(body: str, **vectors: Array) -> tuple[Direction, ...]:
    """Return named directions of a body."""
    return tuple(Direction(name, body, array(vector)) for name, vector in vectors.items())
