# SPDX-License-Identifier: Apache-2.0
"""Delta robots: three arms, three forearms, a platform that only translates.

Frame: origin at the centre of the base circle, z up, so the platform hangs at negative z. Pose:
platform centre x, y, z (m). Joint: arm angle from the horizontal, positive towards the platform
(rad). A forearm is a ``rod`` between two points (a parallelogram, or the closure equation that the
Delta-CU paper writes for all limbs) or an ``rcu``: a rod on a cylindrical joint whose axis is
parallel to the arm's, so that its elbow end slides along that axis and the forearm's length
holds in the plane normal to it.

Branches: ``inverse`` takes the elbows outwards; ``forward`` takes the platform below the elbows.

Source: Delta-CU paper (table 1; closure, velocity and acceleration equations).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.codegen.kernels import NOT_FINITE, SINGULAR, UNREACHABLE, Kernel, scalar
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.clearance import BAR, bar, least
from pkm_twin.machine import schema
from pkm_twin.machine.bodies import (
    COULOMB,
    HEAD,
    PAYLOAD_COM,
    PAYLOAD_MASS,
    ROW,
    TWIST,
    VISCOUS,
)
from pkm_twin.machine.joints import GROUND, MOVING, Joint, PlatformMotion, joint
from pkm_twin.machine.members import (
    RIGID,
    Frame,
    Member,
    RigidBody,
    Section,
    Support,
    Tube,
    disc,
)
from pkm_twin.machine.pose_grid import PoseGrid
from pkm_twin.machine.robot import (
    SINGULARITY_BOUND,
    Friction,
    Limits,
    Payload,
    Robot,
    check_azimuths,
    dynamic_head,
    length,
    mass,
)

Array = NDArray[np.float64]

BASE: Final = HEAD
PLATFORM: Final = HEAD + 1
ARM: Final = HEAD + 2
FOREARM: Final = HEAD + 3
COS: Final = HEAD + 4
SIN: Final = HEAD + 7
RCU: Final = HEAD + 10
M_PLATFORM: Final = HEAD + 13
M_ARM: Final = HEAD + 14
ARM_COM: Final = HEAD + 15
ARM_INERTIA: Final = HEAD + 16
M_FOREARM: Final = HEAD + 17
R_ARM: Final = HEAD + 18
R_FOREARM: Final = HEAD + 19
HALF_WIDTH: Final = HEAD + 22
"""Half the distance of a parallelogram's rods, m."""

BODIES: Final = 8
SCRATCH: Final = ROW * BODIES + TWIST
SEARCH_STEPS: Final = 256
BARS: Final = 9
"""Most members: an arm and two rods a limb."""


@dataclass(frozen=True, eq=False)
class Geometry:
    """Lengths (m), limb azimuths (rad) and forearm closures."""

    base_radius: float = length()
    platform_radius: float = length()
    arm_length: float = length()
    forearm_length: float = length()
    azimuths: Array = schema.vector(3)
    closures: tuple[str, ...] = schema.choices(3, "rod", "rcu")

    def verify(self, path: str) -> None:
        """Limbs apart, and at most one of them an rcu."""
        if self.closures.count("rcu") > 1:
            raise ParameterError(f"{path}.closures", list(self.closures), "at most one rcu limb")
        check_azimuths(self.azimuths, f"{path}.azimuths")


@dataclass(frozen=True, eq=False)
class Inertia:
    """Masses (kg) and inertias (kg m2); arm_inertia about the arm's com, across; thin rods."""

    platform_mass: float = mass()
    arm_mass: float = mass()
    forearm_mass: float = mass()
    arm_com: float = schema.number(at_least=0.0, at_most=1.0, default=0.5)
    arm_inertia: float | None = schema.number(at_least=0.0, default=None)
    rotor_inertia: float = schema.number(at_least=0.0, default=0.0)


@dataclass(frozen=True, eq=False)
class Members:
    """Arms and forearms as tubes, whose masses stand in the inertia section.

    For elasticity, and by the outer diameters for limb interference; dynamics read none of it.

    ``forearm``: each of a parallelogram's two rods, ``parallelogram_width`` apart (m), half of
    the forearm's mass each. ``rcu_forearm``: the one rod of an rcu limb, for modes of a robot that
    has one. ``platform_inertia``: about the platform's origin, kg m2; default a thin disc of the
    platform's radius. ``drive_compliance``: of a locked drive, rad/(N m); ``elbow_compliance`` and
    ``platform_joint_compliance``: of each rod's end in all directions that it holds, m/N.
    """

    arm: Tube = schema.section(Tube)
    forearm: Tube = schema.section(Tube)
    parallelogram_width: float = length()
    rcu_forearm: Tube | None = schema.section(Tube, default=None)
    platform_inertia: Array | None = schema.inertia(positive=True, default=None)
    drive_compliance: float = schema.number(at_least=0.0, at_most=1.0, default=0.0)
    elbow_compliance: float = schema.number(at_least=0.0, at_most=1.0, default=0.0)
    platform_joint_compliance: float = schema.number(at_least=0.0, at_most=1.0, default=0.0)


@dataclass(frozen=True, eq=False)
class Delta(Robot):
    """A Delta robot, symmetric or with one R-C-U limb (Delta-CU)."""

    mechanism: str = schema.choice("delta")
    geometry: Geometry = schema.section(Geometry)
    inertia: Inertia = schema.section(Inertia)
    payload: Payload = schema.section(Payload, default={})
    friction: Friction = schema.section(Friction, default={})
    gravity: Array = schema.vector(3, default=[0, 0, -9.81])
    joints: tuple[str, ...] = schema.names(3, default=["joint_1", "joint_2", "joint_3"])
    limits: Limits = schema.section(Limits, default={})
    members: Members | None = schema.section(Members, default=None)

    description: ClassVar[str] = "Delta robot, three arms with forearms, the platform translates"
    mobility: ClassVar[str] = "3: translations x, y, z"
    pose_names: ClassVar[tuple[str, str, str]] = ("x", "y", "z")
    pose_units: ClassVar[tuple[str, str, str]] = ("m", "m", "m")
    joint_unit: ClassVar[str] = "rad"
    effort_unit: ClassVar[str] = "N m"
    changeable: ClassVar[tuple[str, ...]] = ("payload", "friction", "gravity", "limits")
    body_names: ClassVar[tuple[str, ...]] = (
        *(f"{body} {limb}" for limb in ("I", "II", "III") for body in ("arm", "forearm")),
        "platform",
        "payload",
    )

    def rotation(self, pose: ArrayLike) -> Array:
        """Always the identity, shape (..., 3, 3): the platform only translates."""
        return np.broadcast_to(np.eye(3), (*np.shape(pose)[:-1], 3, 3)).copy()

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
        low = -math.pi / 2 if self.limits.position is None else float(self.limits.position.min())
        box[2] = -far, g.arm_length * math.sin(min(max(-low, 0.0), math.pi / 2))
        return box

    def pose_rates(self, platform: PlatformMotion) -> tuple[Array, Array]:
        """First and second derivative of the pose in time: the platform's origin is the pose."""
        return platform.velocity, platform.acceleration

    def body_joints(self, q: Array, platform: PlatformMotion) -> tuple[Joint, ...]:
        """Base joints A, elbows B and platform joints C of the limbs, and what they transmit.

        Directions of a limb: r outwards, t = z x r along the arm's axis, w from elbow to platform
        joint, e = t x w made unit. A revolute at A holds all but the turn about t, which the
        actuator holds.

        ``rod``: a parallelogram of two equal thin rods, side by side along t, with a ball joint at
        each end. Their end forces add up to one force at B and one at C; the difference of the
        two axial forces is a couple along e that passes from arm to platform, the same at B
        and C, whatever the distance of the rods. The rods' spin about themselves is idle.

        ``rcu``: the cylindrical joint at B holds forces and moments across t. The universal joint
        at C turns about t on the forearm's side and about r on the platform's side; the
        platform only translates, so it holds all forces and the moment along r x t = z. (The paper
        names the joint but not its second axis. With that axis along e the constraint would be
        the forearm's torsion, which cannot hold the platform's rotation where tan of the
        forearms' slope is the root of 2: within a degree of the paper's home pose.)
        """
        g = self.geometry
        up = np.array([0.0, 0.0, 1.0])
        joints: list[Joint] = []
        for i, limb in enumerate(("I", "II", "III")):
            r = np.array([math.cos(g.azimuths[i]), math.sin(g.azimuths[i]), 0.0])
            t = np.cross(up, r)
            angle = q[..., i, None]
            pivot = np.broadcast_to(g.base_radius * r, q.shape)
            elbow = pivot + g.arm_length * (np.cos(angle) * r - np.sin(angle) * up)
            corner = platform.position + g.platform_radius * r
            rcu = g.closures[i] == "rcu"
            if rcu:
                elbow = elbow + ((corner - elbow) @ t)[..., None] * t
            w = (corner - elbow) / g.forearm_length
            e = np.cross(t, w)
            e /= np.linalg.norm(e, axis=-1, keepdims=True)
            arm, forearm = f"arm {limb}", f"forearm {limb}"
            fixed = {"r": r, "t": t, "z": up}
            joints.append(
                joint(
                    f"base joint {limb}",
                    (GROUND, arm),
                    pivot,
                    fixed,
                    fixed,
                    actuated="moment along t",
                )
            )
            if rcu:
                across = {"r": r, "z": up}
                inner = joint(f"elbow {limb}", (arm, forearm), elbow, across, across)
                outer = joint(f"platform joint {limb}", (forearm, MOVING), corner, fixed, {"z": up})
            else:
                axes = {"w": w, "e": e, "w x e": np.cross(w, e)}
                couple = {f"limb {limb}: moment along e": e}
                inner = joint(f"elbow {limb}", (arm, forearm), elbow, axes, {}, passed=couple)
                outer = joint(
                    f"platform joint {limb}", (forearm, MOVING), corner, axes, {}, passed=couple
                )
            joints += [inner, outer]
        return tuple(joints)

    def frame(self, pose: Array) -> Frame:
        """Arms clamped at their locked drives, rods between arms and platform.

        The joints are those of :meth:`body_joints`: a parallelogram's rods stand on ball joints,
        side by side along t, and an rcu's rod slides along t and turns about t at the elbow, turns
        about t and r at the platform. A rod between two ball joints would spin idly, so the
        elbow's holds that spin, which carries no load.

        :param pose: shape (3,), m.
        :raises ParameterError: the file has no members.
        """
        g, m, members = self.geometry, self.inertia, self.members
        if members is None:
            raise ParameterError(
                "members", None, "a section with the elastic members, arms and forearms"
            )
        arm_section, sections = self._sections()
        up = np.array([0.0, 0.0, 1.0])
        beams: list[Member] = []
        free = math.inf
        drive = (*RIGID[:4], members.drive_compliance, 0.0)
        inner, outer = members.elbow_compliance, members.platform_joint_compliance
        for i, limb in enumerate(("I", "II", "III")):
            angle = float(self.inverse(pose)[i])
            r = np.array([math.cos(g.azimuths[i]), math.sin(g.azimuths[i]), 0.0])
            t = np.cross(up, r)
            pivot = g.base_radius * r
            tip = pivot + g.arm_length * (math.cos(angle) * r - math.sin(angle) * up)
            corner = pose + g.platform_radius * r
            arm, forearm = f"arm {limb}", f"forearm {limb}"
            fixed = np.column_stack((r, t, up))
            base = Support(f"base joint {limb}", GROUND, fixed, drive)
            beams.append(Member(arm, arm, arm_section, pivot, tip, base, None))
            elbow, platform = f"elbow {limb}", f"platform joint {limb}"
            if g.closures[i] == "rcu":
                start = tip + ((corner - tip) @ t) * t
                beams.append(
                    Member(
                        forearm,
                        forearm,
                        sections[i],
                        start,
                        corner,
                        Support(elbow, arm, fixed, (inner, free, inner, 0.0, free, 0.0)),
                        Support(platform, MOVING, fixed, (outer, outer, outer, free, free, 0.0)),
                    )
                )
                continue
            w = (corner - tip) / np.linalg.norm(corner - tip)
            e = np.cross(t, w)
            e /= np.linalg.norm(e)
            axes = np.column_stack((w, e, np.cross(w, e)))
            for side, name in ((-0.5, "a"), (0.5, "b")):
                offset = side * members.parallelogram_width * t
                beams.append(
                    Member(
                        f"{forearm} {name}",
                        forearm,
                        sections[i],
                        tip + offset,
                        corner + offset,
                        Support(elbow, arm, axes, (inner, inner, inner, 0.0, free, free)),
                        Support(platform, MOVING, axes, (outer, outer, outer, free, free, free)),
                    )
                )
        inertia = members.platform_inertia
        if inertia is None:
            inertia = disc(m.platform_mass, g.platform_radius)
        bodies = [RigidBody(MOVING, m.platform_mass, np.zeros(3), inertia)]
        load = self.payload
        if load.mass > 0.0:
            bodies.append(RigidBody("payload", load.mass, load.com, load.inertia))
        return Frame(np.array(pose), tuple(beams), tuple(bodies))

    def _sections(self) -> tuple[Section, tuple[Section, ...]]:
        """Sections of an arm and of each limb's rods.

        Checked here and not at loading: dynamics of a robot whose masses or closures were changed
        need no sections.
        """
        g, m, members = self.geometry, self.inertia, self.members
        assert members is not None  # noqa: S101
        arm = members.arm.section(m.arm_mass / g.arm_length, "members.arm")
        spread = m.forearm_mass / g.forearm_length
        rods: list[Section] = []
        for closure in g.closures:
            if closure == "rod":
                rods.append(members.forearm.section(spread / 2, "members.forearm"))
            elif members.rcu_forearm is None:
                raise ParameterError("members.rcu_forearm", None, "required for the rcu limb")
            else:
                rods.append(members.rcu_forearm.section(spread, "members.rcu_forearm"))
        return arm, tuple(rods)

    @property
    def radii(self) -> tuple[float, ...] | None:
        """Outer radii of an arm and of each limb's rods, m; None: the file lacks one."""
        members = self.members
        if members is None:
            return None
        tubes = [members.arm]
        for closure in self.geometry.closures:
            tube = members.forearm if closure == "rod" else members.rcu_forearm
            if tube is None:
                return None
            tubes.append(tube)
        return tuple(tube.outer_diameter / 2 for tube in tubes)

    def _pack(self) -> list[float]:
        g, m = self.geometry, self.inertia
        arm = m.arm_inertia
        about_com = m.arm_mass * g.arm_length**2 / 12 if arm is None else arm
        return [
            *dynamic_head(self),
            g.base_radius,
            g.platform_radius,
            g.arm_length,
            g.forearm_length,
            *np.cos(g.azimuths),
            *np.sin(g.azimuths),
            *(float(closure == "rcu") for closure in g.closures),
            m.platform_mass,
            m.arm_mass,
            m.arm_com,
            about_com + m.rotor_inertia,
            m.forearm_mass,
            *(self.radii or 4 * (math.nan,)),
            math.nan if self.members is None else self.members.parallelogram_width / 2,
        ]


def _inverse(p, pose, q, scratch, fault):  # type: ignore[no-untyped-def]
    """Arm angles of a pose, elbows outwards: a cos q - z sin q = g in each limb's plane."""
    if not math.isfinite(pose[0] + pose[1] + pose[2]):
        fault[0] = NOT_FINITE
        return
    for i in range(3):
        a = pose[0] * p[COS + i] + pose[1] * p[SIN + i] + p[PLATFORM] - p[BASE]
        h = pose[1] * p[COS + i] - pose[0] * p[SIN + i]
        z = pose[2]
        rho = p[FOREARM]
        if p[RCU + i] == 0.0:
            if abs(h) >= rho:
                fault[0] = UNREACHABLE
                fault[1] = i
                fault[2] = abs(h) - rho
                return
            rho = math.sqrt(rho * rho - h * h)
        reach = math.sqrt(a * a + z * z)
        miss = max(reach - p[ARM] - rho, abs(p[ARM] - rho) - reach)
        if miss > 0.0 or reach == 0.0:
            fault[0] = UNREACHABLE
            fault[1] = i
            fault[2] = miss
            return
        g = (reach * reach + p[ARM] * p[ARM] - rho * rho) / (2.0 * p[ARM] * reach)
        angle = math.atan2(-z, a) - math.acos(min(1.0, max(-1.0, g)))
        q[i] = angle + 2.0 * math.pi if angle <= -math.pi else angle


@scalar
def _centre(p, q, i):  # type: ignore[no-untyped-def]
    """Elbow of limb i less the platform's radius, then cosine and sine of the arm's angle."""
    cq = math.cos(q[i])
    sq = math.sin(q[i])
    out = p[BASE] - p[PLATFORM] + p[ARM] * cq
    return out * p[COS + i], out * p[SIN + i], -p[ARM] * sq, cq, sq


@scalar
def _cross(ax, ay, az, bx, by, bz):  # type: ignore[no-untyped-def]
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@scalar
def _row(p, i, x, y, z, cx, cy, cz):  # type: ignore[no-untyped-def]
    """Forearm vector of limb i from elbow to platform; for an rcu without the slide along t."""
    dx = x - cx
    dy = y - cy
    if p[RCU + i] != 0.0:
        slide = dy * p[COS + i] - dx * p[SIN + i]
        dx += slide * p[SIN + i]
        dy -= slide * p[COS + i]
    return dx, dy, z - cz


@scalar
def _residuals(p, c0, c1, c2, x, y, z):  # type: ignore[no-untyped-def]
    """Forearm vectors, their determinant, and half the errors of their squared lengths."""
    a = _row(p, 0, x, y, z, c0[0], c0[1], c0[2])
    b = _row(p, 1, x, y, z, c1[0], c1[1], c1[2])
    c = _row(p, 2, x, y, z, c2[0], c2[1], c2[2])
    n = _cross(b[0], b[1], b[2], c[0], c[1], c[2])
    det = a[0] * n[0] + a[1] * n[1] + a[2] * n[2]
    square = p[FOREARM] * p[FOREARM]
    ra = 0.5 * (a[0] * a[0] + a[1] * a[1] + a[2] * a[2] - square)
    rb = 0.5 * (b[0] * b[0] + b[1] * b[1] + b[2] * b[2] - square)
    rc = 0.5 * (c[0] * c[0] + c[1] * c[1] + c[2] * c[2] - square)
    return a, b, c, n, det, ra, rb, rc


@scalar
def _newton(p, c0, c1, c2, x, y, z):  # type: ignore[no-untyped-def]
    """Polish a position on the closure equations: x, y, z, determinant, converged."""
    det = 0.0
    size = p[ARM] + p[FOREARM]
    for _ in range(12):
        a, b, c, n, det, ra, rb, rc = _residuals(p, c0, c1, c2, x, y, z)
        if det == 0.0:
            return x, y, z, 0.0, False
        m = _cross(c[0], c[1], c[2], a[0], a[1], a[2])
        k = _cross(a[0], a[1], a[2], b[0], b[1], b[2])
        sx = (n[0] * ra + m[0] * rb + k[0] * rc) / det
        sy = (n[1] * ra + m[1] * rb + k[1] * rc) / det
        sz = (n[2] * ra + m[2] * rb + k[2] * rc) / det
        x -= sx
        y -= sy
        z -= sz
        # Convergence is quadratic: the step after one so small is below rounding.
        if abs(sx) + abs(sy) + abs(sz) < 1e-10 * size:
            return x, y, z, det, True
    return x, y, z, det, False


@scalar
def _search(p, c0, c1, c2, lead, sign):  # type: ignore[no-untyped-def]
    """Lowest assembly with an rcu limb, by a walk around its cylinder.

    On the cylinder of limb ``lead`` at angle psi, the plane that the other two limbs' spheres
    share fixes the slide; a change of sign of the distance to one sphere brackets an assembly.
    Returns x, y, z, found, and the least miss (m).
    """
    c = c0 if lead == 0 else (c1 if lead == 1 else c2)
    ci = c1 if lead == 0 else (c2 if lead == 1 else c0)
    cj = c2 if lead == 0 else (c0 if lead == 1 else c1)
    ex = p[COS + lead]
    ey = p[SIN + lead]
    nx = cj[0] - ci[0]
    ny = cj[1] - ci[1]
    nz = cj[2] - ci[2]
    half = 0.5 * (
        cj[0] * cj[0] + cj[1] * cj[1] + cj[2] * cj[2]
        - ci[0] * ci[0] - ci[1] * ci[1] - ci[2] * ci[2]
    )  # fmt: skip
    along = ny * ex - nx * ey
    found = False
    bx = by = bz = 0.0
    miss = math.inf
    if abs(along) < 1e-9 * p[FOREARM]:
        return bx, by, bz, found, miss
    last = 0.0
    for step in range(SEARCH_STEPS + 1):
        low = 2.0 * math.pi * (step - 1) / SEARCH_STEPS
        high = 2.0 * math.pi * step / SEARCH_STEPS
        psi = high
        value = 0.0
        x = y = z = 0.0
        rounds = 1
        for turn in range(60):
            if turn >= rounds:
                break
            out = c[0] * ex + c[1] * ey + p[FOREARM] * math.cos(psi)
            z = c[2] + p[FOREARM] * math.sin(psi)
            slide = (half - nz * z - out * (nx * ex + ny * ey)) / along
            x = out * ex - slide * ey
            y = out * ey + slide * ex
            dx = x - ci[0]
            dy = y - ci[1]
            dz = z - ci[2]
            value = math.sqrt(dx * dx + dy * dy + dz * dz) - p[FOREARM]
            if turn == 0:
                miss = min(miss, abs(value))
                if step == 0 or (value > 0.0) == (last > 0.0):
                    last = value
                    break
                rounds = 60
                psi = 0.5 * (low + high)
                continue
            if (value > 0.0) == (last > 0.0):
                low = psi
            else:
                high = psi
            psi = 0.5 * (low + high)
        if rounds == 60:
            last = -last
            px, py, pz, det, good = _newton(p, c0, c1, c2, x, y, z)
            if good and det * sign > 0.0 and (not found or pz < bz):
                bx, by, bz, found = px, py, pz, True
    return bx, by, bz, found, miss


@scalar
def _assemble(p, c0, c1, c2):  # type: ignore[no-untyped-def]
    """Platform centre below the elbows: x, y, z, fault code, limb, amount.

    Rods: three spheres of equal radius about the (moved) elbows meet above and below the
    circumcentre of their triangle. An rcu starts from there and is polished by Newton.
    """
    ux = c1[0] - c0[0]
    uy = c1[1] - c0[1]
    uz = c1[2] - c0[2]
    vx = c2[0] - c0[0]
    vy = c2[1] - c0[1]
    vz = c2[2] - c0[2]
    n = _cross(ux, uy, uz, vx, vy, vz)
    nn = n[0] * n[0] + n[1] * n[1] + n[2] * n[2]
    uu = ux * ux + uy * uy + uz * uz
    vv = vx * vx + vy * vy + vz * vz
    scale = p[FOREARM] * p[FOREARM]
    if not nn > 1e-18 * scale * scale or n[2] == 0.0:
        return 0.0, 0.0, 0.0, SINGULAR, 0, math.sqrt(nn) / scale
    wx = uu * vx - vv * ux
    wy = uu * vy - vv * uy
    wz = uu * vz - vv * uz
    r = _cross(wx, wy, wz, n[0], n[1], n[2])
    rx = r[0] / (2.0 * nn)
    ry = r[1] / (2.0 * nn)
    rz = r[2] / (2.0 * nn)
    rr = rx * rx + ry * ry + rz * rz
    lead = 3
    for i in range(3):
        if p[RCU + i] != 0.0:
            lead = i
    sign = -1.0 if n[2] > 0.0 else 1.0
    if rr <= scale:
        height = sign * math.sqrt((scale - rr) / nn)
        x = c0[0] + rx + height * n[0]
        y = c0[1] + ry + height * n[1]
        z = c0[2] + rz + height * n[2]
        if lead == 3:
            return x, y, z, 0.0, 0, 0.0
        x, y, z, det, good = _newton(p, c0, c1, c2, x, y, z)
        if good and det * sign > 0.0:
            return x, y, z, 0.0, 0, 0.0
    if lead == 3:
        # The limb that stands apart from the two closest elbows is the one that misses.
        sx = vx - ux
        sy = vy - uy
        sz = vz - uz
        ss = sx * sx + sy * sy + sz * sz
        lead = 2
        if vv < uu and vv <= ss:
            lead = 1
        elif ss < uu and ss < vv:
            lead = 0
        return 0.0, 0.0, 0.0, UNREACHABLE, lead, math.sqrt(rr) - p[FOREARM]
    x, y, z, found, miss = _search(p, c0, c1, c2, lead, sign)
    if found:
        return x, y, z, 0.0, 0, 0.0
    return 0.0, 0.0, 0.0, UNREACHABLE, lead, miss


def _forward(p, q, pose, scratch, fault):  # type: ignore[no-untyped-def]
    """Platform centre of arm angles, platform below the elbows."""
    if not math.isfinite(q[0] + q[1] + q[2]):
        fault[0] = NOT_FINITE
        return
    c0 = _centre(p, q, 0)
    c1 = _centre(p, q, 1)
    c2 = _centre(p, q, 2)
    x, y, z, code, limb, amount = _assemble(p, c0, c1, c2)
    pose[0] = x
    pose[1] = y
    pose[2] = z
    fault[0] = code
    fault[1] = limb
    fault[2] = amount


@scalar
def _kinematics(p, q, qd, qdd, s, t, fault):  # type: ignore[no-untyped-def]
    """Assembly and accelerations; the platform's linear Jacobian goes to s from t on.

    Velocity: d_i . (v - L1 qd_i u'_i) = 0; acceleration: its derivative, d_i the forearm, u_i
    the arm's direction, u'_i its derivative by q_i.

    Returns whether the state is good, platform position and acceleration, the forearms' vectors,
    and the limbs' centres with cosine and sine of the arms' angles.
    """
    zero = (0.0, 0.0, 0.0)
    none = (0.0, 0.0, 0.0, 0.0, 0.0)
    bad = (False, zero, zero, zero, zero, zero, none, none, none)
    if not math.isfinite(q[0] + q[1] + q[2] + qd[0] + qd[1] + qd[2] + qdd[0] + qdd[1] + qdd[2]):
        fault[0] = NOT_FINITE
        return bad
    c0 = _centre(p, q, 0)
    c1 = _centre(p, q, 1)
    c2 = _centre(p, q, 2)
    x, y, z, code, limb, amount = _assemble(p, c0, c1, c2)
    fault[0] = code
    fault[1] = limb
    fault[2] = amount
    if code != 0.0:
        return bad
    a, b, c, n0, det, _ra, _rb, _rc = _residuals(p, c0, c1, c2, x, y, z)
    arm = p[ARM]
    cube = p[FOREARM] * p[FOREARM] * p[FOREARM]
    if not abs(det) > SINGULARITY_BOUND * cube:
        fault[0] = SINGULAR
        fault[2] = abs(det) / cube
        return bad
    n1 = _cross(c[0], c[1], c[2], a[0], a[1], a[2])
    n2 = _cross(a[0], a[1], a[2], b[0], b[1], b[2])
    vx = vy = vz = 0.0
    for i in range(3):
        d = a if i == 0 else (b if i == 1 else c)
        n = n0 if i == 0 else (n1 if i == 1 else n2)
        m = c0 if i == 0 else (c1 if i == 1 else c2)
        # u' = -sin q e - cos q z
        du = -m[4] * (p[COS + i] * d[0] + p[SIN + i] * d[1]) - m[3] * d[2]
        f = arm * du / det
        s[t + 3 * i] = f * n[0]
        s[t + 3 * i + 1] = f * n[1]
        s[t + 3 * i + 2] = f * n[2]
        vx += f * n[0] * qd[i]
        vy += f * n[1] * qd[i]
        vz += f * n[2] * qd[i]
    ax = ay = az = 0.0
    for i in range(3):
        d = a if i == 0 else (b if i == 1 else c)
        n = n0 if i == 0 else (n1 if i == 1 else n2)
        m = c0 if i == 0 else (c1 if i == 1 else c2)
        cq = m[3]
        sq = m[4]
        radial = p[COS + i] * d[0] + p[SIN + i] * d[1]
        du = -sq * radial - cq * d[2]
        u = cq * radial - sq * d[2]
        rate = arm * qd[i]
        ex = vx + rate * sq * p[COS + i]
        ey = vy + rate * sq * p[SIN + i]
        ez = vz + rate * cq
        if p[RCU + i] != 0.0:
            slide = ey * p[COS + i] - ex * p[SIN + i]
            ex += slide * p[SIN + i]
            ey -= slide * p[COS + i]
        f = arm * (du * qdd[i] - u * qd[i] * qd[i]) - (ex * ex + ey * ey + ez * ez)
        f /= det
        ax += f * n[0]
        ay += f * n[1]
        az += f * n[2]
    return True, (x, y, z), (ax, ay, az), a, b, c, c0, c1, c2


@scalar
def _motion(p, q, qd, qdd, s, fault):  # type: ignore[no-untyped-def]
    """Rows of all bodies, see bodies.py; False where the state is faulty."""
    t = ROW * BODIES
    good, at, acceleration, a, b, c, c0, c1, c2 = _kinematics(p, q, qd, qdd, s, t, fault)
    if not good:
        return False
    x, y, z = at
    ax, ay, az = acceleration
    # Locals: a store into s could be one into p for all the compiler knows.
    arm = p[ARM]
    platform = p[PLATFORM]
    m_arm = p[M_ARM]
    lever = arm * p[ARM_COM]
    arm_inertia = p[ARM_INERTIA]
    m_forearm = p[M_FOREARM]
    base = p[BASE]
    for k in range(9):
        s[t + 9 + k] = 0.0
    twelfth = m_forearm / 12.0
    inverse = 1.0 / (p[FOREARM] * p[FOREARM])
    for i in range(3):
        d = a if i == 0 else (b if i == 1 else c)
        co = p[COS + i]
        si = p[SIN + i]
        m = c0 if i == 0 else (c1 if i == 1 else c2)
        cq = m[3]
        sq = m[4]
        # Arm direction u and its derivative u' by the angle.
        ux = cq * co
        uy = cq * si
        dx = -sq * co
        dy = -sq * si
        square = qd[i] * qd[i]
        kx = dx * qdd[i] - ux * square
        ky = dy * qdd[i] - uy * square
        kz = -cq * qdd[i] + sq * square
        o = 2 * i * ROW
        s[o] = m_arm
        s[o + 1] = base * co + lever * ux
        s[o + 2] = base * si + lever * uy
        s[o + 3] = -lever * sq
        s[o + 4] = lever * kx
        s[o + 5] = lever * ky
        s[o + 6] = lever * kz
        s[o + 7] = -si * arm_inertia * qdd[i]
        s[o + 8] = co * arm_inertia * qdd[i]
        s[o + 9] = 0.0
        for k in range(10, 28):
            s[o + k] = 0.0
        s[o + 10 + 3 * i] = lever * dx
        s[o + 11 + 3 * i] = lever * dy
        s[o + 12 + 3 * i] = -lever * cq
        s[o + 19 + 3 * i] = -si
        s[o + 20 + 3 * i] = co
        # Forearm: a thin rod from the elbow B to the platform joint C, no spin. An rcu's elbow
        # end follows the platform along t.
        free = p[RCU + i]
        slide = free * (ay * co - ax * si)
        bx = arm * kx - slide * si
        by = arm * ky + slide * co
        bz = arm * kz
        o += ROW
        s[o] = m_forearm
        s[o + 1] = x + platform * co - 0.5 * d[0]
        s[o + 2] = y + platform * si - 0.5 * d[1]
        s[o + 3] = z - 0.5 * d[2]
        s[o + 4] = 0.5 * (ax + bx)
        s[o + 5] = 0.5 * (ay + by)
        s[o + 6] = 0.5 * (az + bz)
        n = _cross(d[0], d[1], d[2], ax - bx, ay - by, az - bz)
        s[o + 7] = twelfth * n[0]
        s[o + 8] = twelfth * n[1]
        s[o + 9] = twelfth * n[2]
        for j in range(3):
            jx = s[t + 3 * j]
            jy = s[t + 3 * j + 1]
            jz = s[t + 3 * j + 2]
            slide = free * (jy * co - jx * si)
            bx = -slide * si
            by = slide * co
            bz = 0.0
            if j == i:
                bx += arm * dx
                by += arm * dy
                bz -= arm * cq
            s[o + 10 + 3 * j] = 0.5 * (jx + bx)
            s[o + 11 + 3 * j] = 0.5 * (jy + by)
            s[o + 12 + 3 * j] = 0.5 * (jz + bz)
            n = _cross(d[0], d[1], d[2], jx - bx, jy - by, jz - bz)
            s[o + 19 + 3 * j] = n[0] * inverse
            s[o + 20 + 3 * j] = n[1] * inverse
            s[o + 21 + 3 * j] = n[2] * inverse
    for body in range(6, 8):
        o = body * ROW
        held = body == 7
        s[o] = p[PAYLOAD_MASS] if held else p[M_PLATFORM]
        s[o + 1] = x + (p[PAYLOAD_COM] if held else 0.0)
        s[o + 2] = y + (p[PAYLOAD_COM + 1] if held else 0.0)
        s[o + 3] = z + (p[PAYLOAD_COM + 2] if held else 0.0)
        s[o + 4] = ax
        s[o + 5] = ay
        s[o + 6] = az
        for k in range(9):
            s[o + 10 + k] = s[t + k]
            s[o + 19 + k] = 0.0
        s[o + 7] = 0.0
        s[o + 8] = 0.0
        s[o + 9] = 0.0
    return True


def _jacobian(p, q, rates, twist, scratch, fault):  # type: ignore[no-untyped-def]
    """Pose rates and platform twist per joint rate, joint by joint."""
    if not _motion(p, q, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), scratch, fault):
        return
    for k in range(9):
        rates[k] = scratch[ROW * BODIES + k]
    for k in range(18):
        twist[k] = scratch[ROW * BODIES + k]


def _bodies(p, q, qd, qdd, rows, scratch, fault):  # type: ignore[no-untyped-def]
    """Rows of all bodies and the platform's twist, see bodies.py."""
    _motion(p, q, qd, qdd, rows, fault)


def _inverse_dynamics(p, q, qd, qdd, wrench, tau, scratch, fault):  # type: ignore[no-untyped-def]
    """Arm torques by virtual work, N m, from forces at the forearms' ends.

    A thin rod's inertia forces are exactly m (2 a_B + a_C) / 6 at its end B and m (a_B + 2 a_C) / 6
    at C: no rotation is needed. The law tests hold this against the rows of all bodies.
    """
    good, _, acceleration, _a, _b, _c, c0, c1, c2 = _kinematics(p, q, qd, qdd, scratch, 0, fault)
    if not good:
        return
    ax, ay, az = acceleration
    gx = p[0]
    gy = p[1]
    gz = p[2]
    arm = p[ARM]
    sixth = p[M_FOREARM] / 6.0
    half = p[M_FOREARM] / 2.0
    lever = p[M_ARM] * p[ARM_COM] * arm
    about_pivot = p[ARM_INERTIA] + lever * p[ARM_COM] * arm
    held = p[M_PLATFORM] + p[PAYLOAD_MASS]
    fx = held * (ax - gx) - wrench[0]
    fy = held * (ay - gy) - wrench[1]
    fz = held * (az - gz) - wrench[2]
    for i in range(3):
        m = c0 if i == 0 else (c1 if i == 1 else c2)
        cq = m[3]
        sq = m[4]
        co = p[COS + i]
        si = p[SIN + i]
        # u' = -sin q e - cos q z; the elbow's acceleration L1 (u' qdd - u qd^2).
        dx = -sq * co
        dy = -sq * si
        square = qd[i] * qd[i]
        slide = p[RCU + i] * (ay * co - ax * si)
        bx = arm * (dx * qdd[i] - cq * co * square) - slide * si
        by = arm * (dy * qdd[i] - cq * si * square) + slide * co
        bz = arm * (sq * square - cq * qdd[i])
        ex = sixth * (2.0 * bx + ax) - half * gx
        ey = sixth * (2.0 * by + ay) - half * gy
        ez = sixth * (2.0 * bz + az) - half * gz
        # What slides along t at an rcu's elbow is carried by the platform.
        slide = p[RCU + i] * (ey * co - ex * si)
        fx += sixth * (bx + 2.0 * ax) - half * gx - slide * si
        fy += sixth * (by + 2.0 * ay) - half * gy + slide * co
        fz += sixth * (bz + 2.0 * az) - half * gz
        effort = arm * (dx * ex + dy * ey - cq * ez) + about_pivot * qdd[i]
        effort -= lever * (dx * gx + dy * gy - cq * gz)
        tau[i] = effort + p[VISCOUS + i] * qd[i]
        if qd[i] > 0.0:
            tau[i] += p[COULOMB + i]
        elif qd[i] < 0.0:
            tau[i] -= p[COULOMB + i]
    for i in range(3):
        k = 3 * i
        tau[i] += scratch[k] * fx + scratch[k + 1] * fy + scratch[k + 2] * fz
    # The moment does no work on a platform that only translates, but has to be a number.
    moment = wrench[3] + wrench[4] + wrench[5]
    if not math.isfinite(tau[0] + tau[1] + tau[2] + moment):
        fault[0] = NOT_FINITE


def _clearance(p, pose, q, clearance, scratch, fault):  # type: ignore[no-untyped-def]
    """Clearance of arms and rods: the members of ``frame``, see clearance.py."""
    count = 0
    for i in range(3):
        co = p[COS + i]
        si = p[SIN + i]
        base = p[BASE]
        out = base + p[ARM] * math.cos(q[i])
        tip = (out * co, out * si, -p[ARM] * math.sin(q[i]))
        corner = (pose[0] + p[PLATFORM] * co, pose[1] + p[PLATFORM] * si, pose[2])
        count = bar(scratch, count, i, p[R_ARM], (base * co, base * si, 0.0), tip)
        # The rods stand off along t = (-si, co, 0): an rcu's by its slide, at the elbow only.
        slide = (corner[1] - tip[1]) * co - (corner[0] - tip[0]) * si
        rods = 1 if p[RCU + i] != 0.0 else 2
        for rod in range(rods):
            inner = slide if rods == 1 else (2 * rod - 1) * p[HALF_WIDTH]
            outer = 0.0 if rods == 1 else inner
            elbow = (tip[0] - inner * si, tip[1] + inner * co, tip[2])
            joint = (corner[0] - outer * si, corner[1] + outer * co, corner[2])
            count = bar(scratch, count, i, p[R_FOREARM + i], elbow, joint)
    clearance[0] = least(scratch, count)


Delta.inverse_kernel = Kernel(_inverse, (3,), (3,))
Delta.forward_kernel = Kernel(_forward, (3,), (3,))
Delta.jacobian_kernel = Kernel(_jacobian, (3,), (9, 18), SCRATCH)
Delta.motion_kernel = Kernel(_bodies, (3, 3, 3), (SCRATCH,))
Delta.dynamics_kernel = Kernel(_inverse_dynamics, (3, 3, 3, 6), (3,), 9)
Delta.clearance_kernel = Kernel(_clearance, (3, 3), (1,), BAR * BARS)
