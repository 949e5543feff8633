# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Delta robots: three arms, three forearms, a platform that only translates.

Frame: origin at the centre of the base circle, z up, so the platform hangs at negative z. Pose:
platform centre x, y, z (m). Joint: arm angle from the horizontal, positive towards the platform
(rad). A forearm is a ``rod`` between two points (a parallelogram, or the closure equation that the
Delta-CU paper writes for all limbs) or an ``rcu``: a rod on a cylindrical joint whose axis is
parallel to the arm's, so that its elbow end slides along that axis and the forearm's length
holds in the plane normal to it. Its universal joint at the platform turns about that axis and about
the limb's radial direction. (The paper names the joint but not its second axis. Across the
forearm the constraint would be the forearm's torsion, which cannot hold the platform's rotation
where tan of the forearms' slope is the root of 2: within a degree of the paper's home pose.)

Home has the elbows outwards and the platform below them.

Source: Delta-CU paper (table 1; equations 1 to 16 are computed by ``pkm_twin.kinematics``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import Expression, plain, reference
from pkm_twin.codegen.operations import cos, sin
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.motion import cross
from pkm_twin.kinematics.pose import COORDINATES, Coordinate
from pkm_twin.kinematics.three_rods import meet_spheres
from pkm_twin.machine import schema
from pkm_twin.machine.graph import BASE, PLATFORM, UP, Body, Direction, Graph, Joint, Rod, array
from pkm_twin.machine.joints import unit
from pkm_twin.machine.members import Beam, RigidError, Structure, Tube, axial, disc
from pkm_twin.machine.pose_grid import PoseGrid
from pkm_twin.machine.sections import check_azimuths, length, mass, shared_middle
from pkm_twin.mechanisms import TwinRobot

LIMBS: Final = ("I", "II", "III")
MAX_ITERATIONS: Final = 12
EVEN: Final = 0.02
"""Least of :meth:`Delta._evenness` at home, of 1."""


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
    arm_com: float = schema.number(low=0.0, high=1.0, unit="of the arm, from its pivot", default=0.5)
    arm_inertia: float | None = schema.number(low=0.0, unit="kg m2", default=None)
    rotor_inertia: float = schema.number(low=0.0, unit="kg m2", default=0.0)


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
    drive_compliance: float = schema.number(low=0.0, high=1.0, unit="rad/(N m)", default=0.0)
    elbow_compliance: float = schema.number(low=0.0, high=1.0, unit="m/N", default=0.0)
    platform_joint_compliance: float = schema.number(low=0.0, high=1.0, unit="m/N", default=0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class Delta(TwinRobot):
    """A Delta robot, symmetric or with one R-C-U limb (Delta-CU)."""

    mechanism: str = schema.choice("delta")
    geometry: Geometry = schema.section(Geometry)
    inertia: Inertia = schema.section(Inertia)
    joints: tuple[str, ...] = schema.words(size=3, default=["joint_1", "joint_2", "joint_3"])
    members: Members | None = schema.section(Members, default=None)

    mobility: ClassVar[str] = "3: translations x, y, z"
    coordinates: ClassVar[tuple[Coordinate, ...]] = tuple(COORDINATES[c] for c in "xyz")
    limb_names: ClassVar[tuple[str, ...]] = tuple(f"limb {limb}" for limb in LIMBS)

    @property
    def description(self) -> str:
        """What machine it is, with its closures."""
        kinds = ", ".join(self.geometry.closures)
        return f"Delta robot, the platform translates; forearms of limbs 1 to 3: {kinds}"

    @property
    def size(self) -> float:
        """The platform's radius, m."""
        return self.geometry.platform_radius

    @cached_property
    def _directions(self) -> list[tuple[Array, Array]]:
        """Outwards, and along the arm's axis, of every limb."""
        outwards = [np.array([np.cos(a), np.sin(a), 0.0]) for a in self.geometry.azimuths]
        return [(out, np.cross(UP, out)) for out in outwards]

    def _elbow(self, i: int, q: Any) -> Any:
        """Elbow of limb i; of an rcu, where its axis meets the plane of the arm."""
        g, (out, _) = self.geometry, self._directions[i]
        return g.base_radius * out + g.arm_length * (cos(q) * out - sin(q) * UP)

    def _forearm(self, i: int, q: Any, platform: Any) -> Any:
        """Forearm of limb i from elbow to platform joint; of an rcu, without its slide.

        Delta-CU paper, equation 9.
        """
        g, (out, along) = self.geometry, self._directions[i]
        span = platform + g.platform_radius * out - self._elbow(i, q)
        return span - (span @ along) * along if g.closures[i] == "rcu" else span

    @cached_property
    def _home(self) -> tuple[Array, Array]:
        """Joints and platform at home."""
        q = array(np.full(3, self.chosen_home() if self.home_joint is None else self.home_joint))
        platform = self._assemble(q)
        if platform is None:
            g = self.geometry
            raise ParameterError(
                "geometry.forearm_length",
                g.forearm_length,
                "a length with which the limbs can be assembled",
            )
        return q, platform

    def chosen_home(self) -> float:
        """Angle of the arms at home, rad: the middle of their limits, if it is regular.

        Else the one that is farthest from singularities.
        """
        middle = shared_middle(self.limits.position)
        if middle is not None and self._evenness(middle) > EVEN:
            return middle
        return float(max(np.linspace(-1.5, 1.5, 61), key=self._evenness))

    def _evenness(self, angle: float) -> float:
        """How well forearms hold the platform, and each arm moves its own; 0: no assembly."""
        platform = self._assemble(np.full(3, angle))
        if platform is None:
            return 0.0
        rows = np.array([self._forearm(i, angle, platform) for i in range(3)], float)
        rows /= self.geometry.forearm_length
        measure = float(abs(np.linalg.det(rows)))
        for row, (out, _) in zip(rows, self._directions, strict=True):
            measure = min(measure, float(abs(row @ (np.sin(angle) * out + np.cos(angle) * UP))))
        return measure

    def _assemble(self, q: Array) -> Array | None:
        """Platform centre below the elbows; None where there is none in a known case."""
        x, length = self._below(q), self.geometry.forearm_length
        for _ in range(MAX_ITERATIONS):
            rows = [self._forearm(i, q[i], x) for i in range(3)]
            value = [(row @ row - length * length) * 0.5 for row in rows]
            # Columns of the inverse, by Cramer's rule.
            pairs = [cross(rows[i - 2], rows[i - 1]) for i in range(3)]
            determinant = rows[0] @ pairs[0]
            if not abs(reference(determinant)) > 1e-9 * reference(length) ** 3:
                return None
            step = sum(v * pair for v, pair in zip(value, pairs, strict=True)) / determinant
            x = x - step
            # An expression's other cases take the steps that they may need.
            if x.dtype != object or not any(isinstance(v, Expression) for v in x):
                x = np.asarray(x, np.float64)
                if np.abs(np.asarray(step, float)).max() < 1e-13 * length:
                    return x
        return None if x.dtype != object else x

    def _below(self, q: Any) -> Any:
        """Return the place of a platform on three rods, below the elbows; with an rcu a guess."""
        g = self.geometry
        centres = [self._elbow(i, q[i]) - g.platform_radius * self._directions[i][0] for i in range(3)]
        return meet_spheres(centres, [g.forearm_length**2] * 3, -UP)[0]

    def grid(self) -> PoseGrid:
        """Places about the vertical axis."""
        return PoseGrid("cylinder", self.pose_names, "z", ("x", "y"))

    def search_box(self) -> Array:
        """Each platform joint is within arm and forearm of its pivot, below the highest elbow."""
        g = self.geometry
        far = g.arm_length + g.forearm_length
        out = g.base_radius - g.platform_radius
        box = np.empty((3, 2))
        for k, cosines in enumerate((np.cos(g.azimuths), np.sin(g.azimuths))):
            box[k] = (out * cosines).max() - far, (out * cosines).min() + far
        # An arm at a negative angle points up.
        low = -np.pi / 2 if self.limits.position is None else float(self.limits.position.min())
        box[2] = -far, g.arm_length * np.sin(min(max(-low, 0.0), np.pi / 2))
        return box

    def make_graph(self) -> Graph:
        """Arms on the base, forearms as parallelograms or on an rcu's joints, a platform.

        Each limb closes from base to platform (Delta-CU paper, equation 9).
        """
        g = self.geometry
        m: Any = self.spelled.inertia
        q, platform = self._home
        rotor = self.reflected_rotor(m.rotor_inertia, slides=False)
        bodies: dict[str, Body] = {}
        joints: dict[str, Joint] = {}
        rods: dict[str, Rod] = {}
        sliding: dict[str, Joint] = {}
        for i, limb in enumerate(LIMBS):
            out, along = self._directions[i]
            arm, forearm = f"arm {limb}", f"forearm {limb}"
            pivot = array(g.base_radius * out)
            lever = plain(self._elbow(i, q[i])) - pivot
            bodies[arm] = Body(arm, m.arm_mass, array(pivot + m.arm_com * lever), _thin(m.arm_inertia, lever))
            fixed = tuple(Direction(name, BASE, array(v)) for name, v in (("r", out), ("t", along), ("z", UP)))
            joints[self.joints[i]] = Joint(
                self.joints[i],
                "revolute",
                BASE,
                arm,
                pivot,
                array([along]),
                actuated=True,
                home=q[i],
                rotor_inertia=rotor,
                directions=fixed,
                label=f"base joint {limb}",
            )
            corner = array(platform + g.platform_radius * out)
            span = plain(self._forearm(i, q[i], platform))
            foot = array(corner - span)
            names = f"elbow {limb}", f"platform joint {limb}"
            if g.closures[i] == "rod":
                rods[forearm] = Rod(
                    forearm,
                    arm,
                    PLATFORM,
                    array([foot, corner]),
                    m.forearm_mass,
                    array(along),
                    0.0 if self.members is None else self.members.parallelogram_width,
                    joints=names,
                    label=f"limb {limb}",
                )
                continue
            middle = array((foot + corner) / 2)
            rod = _thin(m.forearm_mass * g.forearm_length**2 / 12, span)
            bodies[forearm] = Body(forearm, m.forearm_mass, middle, rod)
            sliding[names[0]] = Joint(names[0], "cylindrical", arm, forearm, foot, array([along]), directions=fixed)
            sliding[names[1]] = Joint(
                names[1],
                "universal",
                forearm,
                PLATFORM,
                corner,
                array([along, out]),
                directions=fixed,
                normal="z",
            )
        turning = None if self.members is None else self.members.platform_inertia
        if turning is None:
            turning = disc(m.platform_mass, g.platform_radius)
        bodies[PLATFORM] = Body(PLATFORM, m.platform_mass, array(platform), array(turning))
        # What the parallelograms hold is taken as given, so that three slides carry the platform.
        joints["translation"] = Joint("translation", "translation", BASE, PLATFORM, array(platform), virtual=True)
        return Graph(bodies, {**joints, **sliding}, rods, PLATFORM, array(platform))

    @property
    def spelled(self) -> Delta:
        """With the arms' inertia: of even bars."""
        m = self.inertia
        bar = m.arm_mass * self.geometry.arm_length**2 / 12
        given = bar if m.arm_inertia is None else m.arm_inertia
        return self._with(inertia=replace(m, arm_inertia=given))

    @cached_property
    def beams(self) -> tuple[Beam, ...]:
        """Arms and rods; none where the file does not tell every diameter."""
        members, g = self.members, self.geometry
        if members is None or ("rcu" in g.closures and members.rcu_forearm is None):
            return ()
        beams: list[Beam] = []
        q, platform = self._home
        for i, limb in enumerate(LIMBS):
            out, along = self._directions[i]
            arm, forearm = f"arm {limb}", f"forearm {limb}"
            pivot = g.base_radius * out
            tip = plain(self._elbow(i, q[i]))
            beams.append(Beam(arm, arm, i, (arm, pivot), (arm, tip), (arm,), members.arm.outer_diameter / 2))
            corner = platform + g.platform_radius * out
            if g.closures[i] == "rcu":
                foot = corner - plain(self._forearm(i, q[i], platform))
                radius = members.rcu_forearm.outer_diameter / 2  # type: ignore[union-attr]
                ends = (forearm, foot), (forearm, corner)
                beams.append(Beam(forearm, forearm, i, *ends, (forearm,), radius))
                continue
            for side, name in ((-0.5, "a"), (0.5, "b")):
                aside = side * members.parallelogram_width * along
                ends = (arm, tip + aside), (PLATFORM, corner + aside)
                radius = members.forearm.outer_diameter / 2
                beams.append(Beam(f"{forearm} {name}", forearm, i, *ends, (forearm,), radius))
        return tuple(beams)

    def structure(self) -> Structure:
        """Arms clamped at their locked drives, rods between arms and platform.

        :raises RigidError: the file has no members.
        :raises ParameterError: it has no rod for the rcu limb, or sections that no bar has.
        """
        g, m, members = self.geometry, self.inertia, self.members
        if members is None:
            raise RigidError("members", None, "a section with the elastic members, arms and forearms")
        if "rcu" in g.closures and members.rcu_forearm is None:
            raise ParameterError("members.rcu_forearm", None, "required for the rcu limb")
        spread = m.forearm_mass / g.forearm_length
        kinds = {"arm": members.arm.section(m.arm_mass / g.arm_length, "members.arm")}
        if "rod" in g.closures:
            kinds["rod"] = members.forearm.section(spread / 2, "members.forearm")
        if members.rcu_forearm is not None and "rcu" in g.closures:
            kinds["rcu"] = members.rcu_forearm.section(spread, "members.rcu_forearm")
        sections = {
            beam.name: kinds["arm" if beam.element.startswith("arm") else g.closures[beam.limb]] for beam in self.beams
        }
        compliances: dict[str, Sequence[float]] = {}
        for limb, closure in zip(LIMBS, g.closures, strict=True):
            elbow, outer = members.elbow_compliance, members.platform_joint_compliance
            compliances[f"base joint {limb}"] = (0, 0, 0, 0, members.drive_compliance, 0)
            held = (elbow, 0, elbow) if closure == "rcu" else (elbow,) * 3
            compliances[f"elbow {limb}"] = (*held, 0, 0, 0)
            compliances[f"platform joint {limb}"] = (outer, outer, outer, 0, 0, 0)
        return Structure(self.beams, sections, compliances)


def _thin(across: float, along: Array) -> Array:
    """Inertia of a thin bar, ``across`` about every axis across it."""
    return array(axial(across, 0.0, unit(along)))
