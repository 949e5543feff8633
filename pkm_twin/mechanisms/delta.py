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
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import Expression, cross, plain, reference
from pkm_twin.codegen.operations import cos, sin
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.pose import COORDINATES, Coordinate
from pkm_twin.kinematics.three_rods import meet_spheres
from pkm_twin.machine import schema
from pkm_twin.machine.graph import BASE, PLATFORM, UP, Body, Direction, Graph, Joint, Rod, array
from pkm_twin.machine.joints import unit
from pkm_twin.machine.members import Beam, Parts, Place, Tube, axial, disc
from pkm_twin.machine.pose_grid import PoseGrid
from pkm_twin.machine.sections import check_azimuths, length, mass, shared_middle
from pkm_twin.mechanisms import TwinRobot

LIMBS: Final = ("I", "II", "III")
MAX_ITERATIONS: Final = 12
MIN_REGULARITY: Final = 0.02
"""Smallest regularity, 0 to 1, with which the middle of the limits is the home."""


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
        """Check that limbs have different azimuths, and that at most one is an rcu."""
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
    layout: ClassVar[PoseGrid] = PoseGrid("cylinder", ("x", "y", "z"), "z", ("x", "y"))
    limb_names: ClassVar[tuple[str, ...]] = tuple(f"limb {limb}" for limb in LIMBS)

    @property
    def description(self) -> str:
        """Name of the machine, with its limbs' closures."""
        kinds = ", ".join(self.geometry.closures)
        return f"Delta robot, the platform translates; forearms of limbs 1 to 3: {kinds}"

    @cached_property
    def _directions(self) -> list[tuple[Array, Array]]:
        """Unit vectors of each limb: outwards, and along the axis of the arm."""
        outwards = [np.array([np.cos(a), np.sin(a), 0.0]) for a in self.geometry.azimuths]
        return [(out, np.cross(UP, out)) for out in outwards]

    def _elbow(self, i: int, q: Any) -> Any:
        """Return the elbow of limb i; for an rcu limb the point of its axis in the plane of the arm."""
        g, (out, _) = self.geometry, self._directions[i]
        return g.base_radius * out + g.arm_length * (cos(q) * out - sin(q) * UP)

    def _forearm(self, i: int, q: Any, platform: Any) -> Any:
        """Return the vector of forearm i from elbow to platform joint, for an rcu limb normal to its slide.

        Delta-CU paper, equation 9.
        """
        g, (out, along) = self.geometry, self._directions[i]
        span = platform + g.platform_radius * out - self._elbow(i, q)
        return span - (span @ along) * along if g.closures[i] == "rcu" else span

    def _assemble(self, q: Any) -> Array | None:
        """Return the platform's centre below elbows at q (3,), rad; None if it cannot be assembled.

        By Newton's method on the forearms' lengths, from the point on three rods.
        """
        g, length = self.geometry, self.geometry.forearm_length
        centres = [self._elbow(i, q[i]) - g.platform_radius * self._directions[i][0] for i in range(3)]
        x = meet_spheres(centres, [length**2] * 3, -UP)[0]
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
            # Expressions are evaluated for other values, which may need all steps.
            if x.dtype != object or not any(isinstance(v, Expression) for v in x):
                x = np.asarray(x, np.float64)
                if np.abs(np.asarray(step, float)).max() < 1e-13 * length:
                    return x
        return None if x.dtype != object else x

    def chosen_home(self) -> float:
        """Angle of the arms at home, rad: the middle of their limits, if it is regular.

        Else the angle farthest from singularities.
        """

        def regularity(angle: float) -> float:
            """Return how well forearms hold the platform and arms move them; 0: no assembly."""
            platform = self._assemble(np.full(3, angle))
            if platform is None:
                return 0.0
            rows = np.array([self._forearm(i, angle, platform) for i in range(3)], float)
            rows /= self.geometry.forearm_length
            pushed = [
                float(abs(row @ (np.sin(angle) * out + np.cos(angle) * UP)))
                for row, (out, _) in zip(rows, self._directions, strict=True)
            ]
            return min(float(abs(np.linalg.det(rows))), *pushed)

        middle = shared_middle(self.limits.position)
        if middle is not None and regularity(middle) > MIN_REGULARITY:
            return middle
        return float(max(np.linspace(-1.5, 1.5, 61), key=regularity))

    def default_inertia(self) -> dict[str, Any]:
        """Return the arms' inertia as even bars."""
        return {"arm_inertia": self.inertia.arm_mass * self.geometry.arm_length**2 / 12}

    def make_parts(self) -> Parts:
        """Make arms on the base, forearms as parallelograms or on an rcu's joints, a platform.

        Each limb closes from base to platform (Delta-CU paper, equation 9). Arms are clamped at
        their locked drives.
        """
        g, members = self.geometry, self.members
        m: Any = self.with_default_inertia.inertia
        q = array(np.full(3, self.home_joint))
        platform = self._assemble(q)
        if platform is None:
            bound = "a length with which the limbs can be assembled"
            raise ParameterError("geometry.forearm_length", g.forearm_length, bound)
        bodies: dict[str, Body] = {}
        joints: dict[str, Joint] = {}
        sliding: dict[str, Joint] = {}
        rods: dict[str, Rod] = {}
        bars: list[tuple[int, str, str, Place, Place, str, Any]] = []
        compliances: dict[str, Sequence[float]] = {}
        for i, limb in enumerate(LIMBS):
            out, along = self._directions[i]
            rcu = g.closures[i] == "rcu"
            arm, forearm = f"arm {limb}", f"forearm {limb}"
            base, elbow, outer = (f"{joint} {limb}" for joint in ("base joint", "elbow", "platform joint"))
            pivot, tip = array(g.base_radius * out), plain(self._elbow(i, q[i]))
            corner = array(platform + g.platform_radius * out)
            span = plain(self._forearm(i, q[i], platform))
            foot = array(corner - span)
            fixed = tuple(Direction(name, BASE, array(v)) for name, v in (("r", out), ("t", along), ("z", UP)))
            bodies[arm] = Body(
                arm, m.arm_mass, array(pivot + m.arm_com * (tip - pivot)), _bar_inertia(m.arm_inertia, tip - pivot)
            )
            joints[self.joints[i]] = Joint(
                self.joints[i],
                "revolute",
                BASE,
                arm,
                pivot,
                array([along]),
                actuated=True,
                home=q[i],
                rotor_inertia=self.reflect_rotor(m.rotor_inertia, slides=False),
                directions=fixed,
                label=base,
            )
            if rcu:
                inertia = _bar_inertia(m.forearm_mass * g.forearm_length**2 / 12, span)
                bodies[forearm] = Body(forearm, m.forearm_mass, array((foot + corner) / 2), inertia)
                sliding[elbow] = Joint(elbow, "cylindrical", arm, forearm, foot, array([along]), directions=fixed)
                axes = array([along, out])
                sliding[outer] = Joint(
                    outer, "universal", forearm, PLATFORM, corner, axes, directions=fixed, normal="z"
                )
            else:
                rods[forearm] = Rod(
                    forearm,
                    arm,
                    PLATFORM,
                    array([foot, corner]),
                    m.forearm_mass,
                    array(along),
                    0.0 if members is None else members.parallelogram_width,
                    joints=(elbow, outer),
                    label=f"limb {limb}",
                )
            line = m.forearm_mass / g.forearm_length
            bars.append((i, arm, "", (arm, pivot), (arm, tip), "arm", m.arm_mass / g.arm_length))
            if rcu:
                bars.append((i, forearm, "", (forearm, foot), (forearm, corner), "rcu_forearm", line))
            elif members is not None:
                for side, end in ((-0.5, " a"), (0.5, " b")):
                    aside = side * members.parallelogram_width * along
                    ends = (arm, tip + aside), (PLATFORM, corner + aside)
                    bars.append((i, forearm, end, *ends, "forearm", line / 2))
            if members is not None:
                soft = members.elbow_compliance
                compliances[base] = (0, 0, 0, 0, members.drive_compliance, 0)
                compliances[elbow] = (soft, 0 if rcu else soft, soft, 0, 0, 0)
                compliances[outer] = (*[members.platform_joint_compliance] * 3, 0, 0, 0)
        turning = None if members is None else members.platform_inertia
        if turning is None:
            turning = disc(m.platform_mass, g.platform_radius)
        bodies[PLATFORM] = Body(PLATFORM, m.platform_mass, array(platform), array(turning))
        # Parallelograms prevent rotation, so the platform has three translations.
        joints["translation"] = Joint("translation", "translation", BASE, PLATFORM, array(platform), virtual=True)
        graph = Graph(bodies, {**joints, **sliding}, rods, PLATFORM, array(platform))
        if members is None:
            return Parts(graph)
        if members.rcu_forearm is None and "rcu" in g.closures:
            # Without the diameter of one forearm no clearance is computed.
            return Parts(graph, (), compliances, missing="members.rcu_forearm")
        beams = []
        for i, part, end, start, stop, key, line in bars:
            tube: Tube = getattr(members, key)
            radius = tube.outer_diameter / 2
            beams.append(Beam(part + end, part, i, start, stop, (part,), radius, (), tube, line, f"members.{key}"))
        return Parts(graph, tuple(beams), compliances)

    def search_box(self) -> Array:
        """Return bounds of the platform: within arm and forearm of all pivots, below all elbows."""
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


def _bar_inertia(across: float, along: Array) -> Array:
    """Return the inertia of a thin bar along a vector, ``across`` about every normal axis."""
    return array(axial(across, 0.0, unit(along)))
