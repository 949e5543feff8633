# SPDX-License-Identifier: Apache-2.0
"""The 2UPR-RPU machine: two UPR limbs and one RPU limb, all three driven along their length.

Frame: O at the middle of B1 B2, X along B1 B2, Y along O B3, z up; the platform stands at negative
z. B1, B2 = (-b, 0, 0), (b, 0, 0), B3 = (0, b, 0); on the platform A1, A2 = (-a, 0, 0), (a, 0, 0),
A3 = (0, a, 0) about its origin o, the middle of A1 A2. Pose: z (m), beta, gamma (rad) with
R = Rx(beta) Ry(gamma) and o = (0, -z tan(beta), z): z is the Z coordinate of o, and o stays in the
plane x = 0 that the RPU limb keeps. Joint: limb length |A_i - B_i| (m).

In axes turned by beta about X all is plane: X, y (the revolute axis of limbs 1 and 2) and
tau = X x y, with o = (0, 0, rho), rho = z / cos(beta), and

    L1^2 = (b - a cos gamma)^2 + (rho + a sin gamma)^2
    L2^2 = (b - a cos gamma)^2 + (rho - a sin gamma)^2
    L3^2 = (b cos beta - a)^2 + (b sin beta + rho)^2

Branch: ``forward`` gives the assembly that is connected to the home pose without a singularity:
z < 0, rho^2 cos gamma > a b sin^2 gamma (limbs 1 and 2), z + a sin beta < 0 (A3 below the base).
``inverse`` takes any pose with z < 0 and |beta| below 90 degrees; within the branch the two are
each other's inverses.

Source: 2UPR-RPU paper (geometry of table 1; equations 1 to 37). Its sign conventions are kept;
they matter only in the product of a limb's couple with its bending.
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
from pkm_twin.machine.members import (
    GROUND,
    MOVING,
    Frame,
    Member,
    RigidBody,
    Section,
    Support,
    disc,
)
from pkm_twin.machine.pose_grid import PoseGrid
from pkm_twin.machine.robot import SINGULARITY_BOUND, Robot, length, mass
from pkm_twin.mechanisms.elements import BLOCK, SCRATCH, divide, factorise, invert

Array = NDArray[np.float64]

BASE: Final = 0
PLATFORM: Final = 1
AXIAL: Final = 2
"""1 / (E A) of the three bars, 1/N."""
SHEAR: Final = 5
"""1 / (G A_shear), 1/N."""
BENDING: Final = 8
"""1 / (E I), 1/(N m2)."""
TORSION: Final = 11
"""1 / (G Ip), 1/(N m2)."""
UPR_R: Final = 14
UPR_U: Final = 20
RPU_U: Final = 26
RPU_R: Final = 32
RADIUS: Final = 38

FAR: Final = 1e5
"""Longest limb over the machine's size; beyond, rounding would lose the pose, or overflow."""
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
    """Round bars: moduli (Pa), diameters (m), and the shear factor A / A_shear."""

    youngs_modulus: float = schema.number(at_least=1e3, at_most=1e14)
    shear_modulus: float = schema.number(at_least=1e3, at_most=1e14)
    diameter: Array = schema.vector(3, above=0.0, spread=True)
    shear_factor: float = schema.number(at_least=0.0, at_most=10.0, default=1.0)

    def verify(self, path: str) -> None:
        """Diameters whose fourth power is a number to compute with."""
        for i, value in enumerate(self.diameter.tolist()):
            if not 1e-6 <= value <= 10.0:
                raise ParameterError(f"{path}.diameter[{i}]", value, "1e-6 to 10 m")


@dataclass(frozen=True, eq=False)
class JointsCompliance:
    """Compliance of each joint in its own axes u, v, w: three m/N, three rad/(N m).

    R of UPR: v its axis, w from A to B. U of UPR and of RPU: u, v its axes. R of RPU: u its
    axis, w from A to B. Entries about an axis of the joint are free (.inf); 0 is rigid.
    """

    upr_revolute: Array = schema.vector(6, at_least=0.0, infinite=True)
    upr_universal: Array = schema.vector(6, at_least=0.0, infinite=True)
    rpu_universal: Array = schema.vector(6, at_least=0.0, infinite=True)
    rpu_revolute: Array = schema.vector(6, at_least=0.0, infinite=True)

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
    """Masses for modes: density of the bars (kg/m3), and the platform with what it carries.

    ``platform_com`` (m) and ``platform_inertia`` (about the com, kg m2) in platform axes; default
    a thin disc of the platform's radius about its origin.
    """

    density: float = schema.number(above=0.0, at_most=1e5)
    platform_mass: float = mass()
    platform_com: Array = schema.vector(3, default=[0, 0, 0])
    platform_inertia: Array | None = schema.inertia(positive=False, default=None)


@dataclass(frozen=True, eq=False)
class Limits:
    """Limb lengths [min, max], one pair or three (m); bound of every passive joint's angle (rad).

    Absent is None: no limit.
    """

    limb_length: Array | None = schema.interval(above=0.0, count=3, default=None)
    joint_angle: float | None = schema.number(above=0.0, at_most=math.pi, default=None)

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


@dataclass(frozen=True, eq=False)
class UprRpu(Robot):
    """A 2UPR-RPU machine with elastic bars and joints."""

    mechanism: str = schema.choice("upr_rpu")
    geometry: Geometry = schema.section(Geometry)
    members: Members = schema.section(Members)
    joints_compliance: JointsCompliance = schema.section(JointsCompliance)
    limits: Limits = schema.section(Limits, default={})
    joints: tuple[str, ...] = schema.names(3, default=["limb_1", "limb_2", "limb_3"])
    inertia: Inertia | None = schema.section(Inertia, default=None)

    description: ClassVar[str] = "2UPR-RPU head, three actuated telescopic limbs"
    mobility: ClassVar[str] = "3: translation along Oo, rotations beta, gamma"
    # Five wrenches of rank 2 (two parallel forces make one force and the same couple), so three.
    redundant_constraints: ClassVar[tuple[str, ...]] = (
        "constraint couples of limbs 1, 2, 3 along tau",
        "constraint forces of limbs 1, 2 along y",
    )
    limb_names: ClassVar[tuple[str, str, str]] = ("limb 1", "limb 2", "limb 3")
    pose_names: ClassVar[tuple[str, str, str]] = ("z", "beta", "gamma")
    pose_units: ClassVar[tuple[str, str, str]] = ("m", "rad", "rad")
    joint_unit: ClassVar[str] = "m"
    effort_unit: ClassVar[str] = "N"
    changeable: ClassVar[tuple[str, ...]] = ("members", "joints_compliance", "limits")
    element_names: ClassVar[tuple[str, ...]] = tuple(
        f"{limb}{element}" for limb in (1, 2, 3) for element in "RBU"
    )

    def _home_joints(self) -> Array:
        return np.full(3, 1.5 * self.geometry.base_radius)

    def grid(self) -> PoseGrid:
        """Tilts about the vertical axis, in the plane of beta and gamma."""
        return PoseGrid("cylinder", self.pose_names, "z", ("beta", "gamma"))

    def search_box(self) -> Array:
        """Limbs 1 and 2 end above and below o alike, so it is no deeper than they are long.

        :raises ParameterError: limbs without limits grow without end.
        """
        lengths = self.limits.limb_length
        if lengths is None:
            raise ParameterError(
                "limits.limb_length", None, "limits of the limbs: without them z has no end"
            )
        right = math.pi / 2
        return np.array([(-float(lengths[:2].max()), 0.0), (-right, right), (-right, right)])

    def rotation(self, pose: ArrayLike) -> Array:
        """R = Rx(beta) Ry(gamma): platform axes as columns in fixed axes, shape (..., 3, 3)."""
        angles = np.asarray(pose, np.float64)[..., 1:]
        (cb, cg), (sb, sg) = np.moveaxis(np.cos(angles), -1, 0), np.moveaxis(np.sin(angles), -1, 0)
        zero = np.zeros_like(cb)
        rows = [[cg, zero, sg], [sb * sg, cb, -sb * cg], [-cb * sg, sb, cb * cg]]
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)

    def frame(self, pose: Array) -> Frame:
        """Bars between base and platform, joints elastic in their own axes, drives locked.

        A bar reaches from B to A, as in the paper, and its mass with it: a telescope's tubes that
        overlap are not told apart.

        :param pose: shape (3,): z (m), beta, gamma (rad).
        :raises ParameterError: the file has no inertia.
        """
        g, members, joints, inertia = (
            self.geometry,
            self.members,
            self.joints_compliance,
            self.inertia,
        )
        if inertia is None:
            raise ParameterError(
                "inertia", None, "a section with density, platform_mass and more, for modes"
            )
        turn = self.rotation(pose)
        z, beta = float(pose[0]), float(pose[1])
        origin = np.array([0.0, -z * math.tan(beta), z])
        pattern = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        x, y = np.array([1.0, 0.0, 0.0]), turn[:, 1]
        universal = np.column_stack((x, y, np.cross(x, y)))
        bars: list[Member] = []
        for i, limb in enumerate("123"):
            d = float(members.diameter[i])
            section = Section(
                members.youngs_modulus,
                members.shear_modulus,
                d,
                0.0,
                inertia.density * math.pi / 4 * d * d,
                members.shear_factor,
            )
            lower = g.base_radius * pattern[i]
            upper = origin + g.platform_radius * turn @ pattern[i]
            w = (lower - upper) / np.linalg.norm(lower - upper)
            if i == 2:
                revolute = np.column_stack((x, np.cross(w, x), w))
                feet = (f"{limb}R", revolute, joints.rpu_revolute)
                heads = (f"{limb}U", universal, joints.rpu_universal)
            else:
                revolute = np.column_stack((np.cross(y, w), y, w))
                feet = (f"{limb}U", universal, joints.upr_universal)
                heads = (f"{limb}R", revolute, joints.upr_revolute)
            bar = f"{limb}B"
            inner = Support(feet[0], GROUND, feet[1], tuple(feet[2].tolist()))
            outer = Support(heads[0], MOVING, heads[1], tuple(heads[2].tolist()))
            bars.append(Member(bar, bar, section, lower, upper, inner, outer))
        own = inertia.platform_inertia
        if own is None:
            own = disc(inertia.platform_mass, g.platform_radius)
        platform = RigidBody(
            MOVING, inertia.platform_mass, turn @ inertia.platform_com, turn @ own @ turn.T
        )
        return Frame(origin, tuple(bars), (platform,))

    @property
    def radii(self) -> tuple[float, ...] | None:
        """Radii of the three bars, m."""
        return tuple((self.members.diameter / 2).tolist())

    def _pack(self) -> list[float]:
        m, j = self.members, self.joints_compliance
        area = np.pi * m.diameter**2 / 4
        second = np.pi * m.diameter**4 / 64
        joints = np.concatenate([j.upr_revolute, j.upr_universal, j.rpu_universal, j.rpu_revolute])
        return [
            self.geometry.base_radius,
            self.geometry.platform_radius,
            *(1 / (m.youngs_modulus * area)),
            *(m.shear_factor / (m.shear_modulus * area)),
            *(1 / (m.youngs_modulus * second)),
            *(1 / (m.shear_modulus * 2 * second)),
            # Free axes carry no load; their entries are never read.
            *np.where(np.isinf(joints), 0.0, joints),
            *(m.diameter / 2),
        ]


@scalar
def _place(p, pose, fault):  # type: ignore[no-untyped-def]
    """rho, then cosines and sines of beta and gamma; False where the pose is none."""
    z = pose[0]
    beta = pose[1]
    if not math.isfinite(z + beta + pose[2]):
        fault[0] = NOT_FINITE
        return False, 0.0, 0.0, 0.0, 0.0, 0.0
    # Limb 3 cannot turn the platform over: o is below the base where rho < 0 < cos(beta).
    if not z < 0.0 or not abs(beta) < 0.5 * math.pi:
        fault[0] = UNREACHABLE
        fault[1] = 2
        fault[2] = abs(z)
        return False, 0.0, 0.0, 0.0, 0.0, 0.0
    cb = math.cos(beta)
    rho = z / cb
    excess = -rho - FAR * (p[BASE] + p[PLATFORM])
    if excess > 0.0:
        fault[0] = UNREACHABLE
        fault[1] = 2
        fault[2] = excess
        return False, 0.0, 0.0, 0.0, 0.0, 0.0
    return True, rho, cb, math.sin(beta), math.cos(pose[2]), math.sin(pose[2])


@scalar
def _limb(p, i, rho, cb, sb, cg, sg):  # type: ignore[no-untyped-def]
    """Limb i = 0 or 1 from B to A along X and tau; limb 2 from A to B along y and tau."""
    if i == 2:
        return p[BASE] * cb - p[PLATFORM], -p[BASE] * sb - rho
    side = -1.0 if i == 0 else 1.0
    return side * (p[PLATFORM] * cg - p[BASE]), rho - side * p[PLATFORM] * sg


def _inverse(p, pose, q, scratch, fault):  # type: ignore[no-untyped-def]
    """Limb lengths of a pose."""
    good, rho, cb, sb, cg, sg = _place(p, pose, fault)
    if not good:
        return
    for i in range(3):
        across, up = _limb(p, i, rho, cb, sb, cg, sg)
        q[i] = math.sqrt(across * across + up * up)


@scalar
def _distance(a, b, l1, l2):  # type: ignore[no-untyped-def]
    """P = rho^2 of the home branch from the lengths of limbs 1 and 2; -1 where there is none.

    With c = cos(gamma) = (P + K) / (2 a b) and 4 a rho sin(gamma) = L1^2 - L2^2 = D, c^2 + s^2 = 1
    is the cubic P (P + K)^2 - 4 a^2 b^2 P + b^2 D^2 / 4 = 0, K = a^2 + b^2 - (L1^2 + L2^2) / 2.
    Its slope at a root is 4 a b (rho^2 cos(gamma) - a b sin^2(gamma)), so the largest root is
    the home branch until it meets the middle one, which is the singularity.
    """
    k = a * a + b * b - 0.5 * (l1 * l1 + l2 * l2)
    ab = a * a * b * b
    d = (l1 - l2) * (l1 + l2)
    r = math.sqrt(k * k + 12.0 * ab)
    # Depressed by P = t - 2 k / 3: t^3 - r^2 / 3 t + c = 0.
    c = k * (8.0 / 3.0 * ab - 2.0 / 27.0 * k * k) + 0.25 * b * b * d * d
    g = -13.5 * c / (r * r * r)
    if not abs(g) <= 1.0:
        if not abs(g) <= 1.0 + 1e-14:
            return -1.0
        g = max(-1.0, min(1.0, g))
    square = 2.0 / 3.0 * (r * math.cos(math.acos(g) / 3.0) - k)
    # Limbs too short for each other leave the root 0 of limbs of one length, in rounding.
    return square if square > 1e-12 * a * b else -1.0


@scalar
def _blame(a, b, l1, l2):  # type: ignore[no-untyped-def]
    """Which of limbs 0 and 1 is the wrong length beside the other, and by how much (m).

    Two limbs of one length are a pose with gamma = 0 if they are longer than |b - a|; between that
    and the given lengths a bisection finds where the assembly begins. The smaller of the two
    possible corrections counts.
    """
    limb = 0
    miss = math.inf
    for i in range(2):
        given = l1 if i == 0 else l2
        other = l2 if i == 0 else l1
        good = max(other, abs(b - a) * (1.0 + 1e-9))
        if not _distance(a, b, good, other) > 0.0:
            continue
        bad = given
        for _ in range(60):
            middle = 0.5 * (good + bad)
            first = middle if i == 0 else other
            second = other if i == 0 else middle
            if _distance(a, b, first, second) > 0.0:
                good = middle
            else:
                bad = middle
        if abs(given - good) < miss:
            limb = i
            miss = abs(given - good)
    if miss == math.inf:
        limb = 0 if l1 < l2 else 1
        miss = abs(b - a) - min(l1, l2)
    return limb, miss


@scalar
def _solve(p, q, fault):  # type: ignore[no-untyped-def]
    """rho, beta, gamma of the limb lengths; False where there is no assembly."""
    l1 = q[0]
    l2 = q[1]
    l3 = q[2]
    a = p[PLATFORM]
    b = p[BASE]
    if not math.isfinite(l1 + l2 + l3):
        fault[0] = NOT_FINITE
        return False, 0.0, 0.0, 0.0
    fault[0] = UNREACHABLE
    for i in range(3):
        if not q[i] > 0.0:
            fault[1] = i
            fault[2] = -q[i]
            return False, 0.0, 0.0, 0.0
    bound = FAR * (a + b)
    for i in range(3):
        if q[i] > bound:
            fault[1] = i
            fault[2] = q[i] - bound
            return False, 0.0, 0.0, 0.0
    square = _distance(a, b, l1, l2)
    if not square > 0.0:
        limb, miss = _blame(a, b, l1, l2)
        fault[1] = limb
        fault[2] = miss
        return False, 0.0, 0.0, 0.0
    rho = -math.sqrt(square)
    sg = (l1 - l2) * (l1 + l2) / (4.0 * a * rho)
    cg = (square + a * a + b * b - 0.5 * (l1 * l1 + l2 * l2)) / (2.0 * a * b)
    gamma = math.atan2(sg, cg)
    for _ in range(2):
        cg = math.cos(gamma)
        sg = math.sin(gamma)
        # Half the errors of the squared lengths, and their derivatives.
        x = b - a * cg
        u = rho + a * sg
        v = rho - a * sg
        e1 = 0.5 * (x * x + u * u - l1 * l1)
        e2 = 0.5 * (x * x + v * v - l2 * l2)
        g1 = a * (b * sg + rho * cg)
        g2 = a * (b * sg - rho * cg)
        det = u * g2 - v * g1
        # At the singularity the two roots are one; a step would leave it.
        if abs(det) > 1e-6 * a * square:
            rho -= (e1 * g2 - e2 * g1) / det
            gamma -= (u * e2 - v * e1) / det
    # Limb 3: a cos(beta) - rho sin(beta) = h cos(beta - atan2(-rho, a)).
    h = math.sqrt(a * a + rho * rho)
    low = abs(h - b)
    if l3 < low:
        fault[1] = 2
        fault[2] = low - l3
        return False, 0.0, 0.0, 0.0
    # At beta = -90 degrees the platform stands upright, at a longer limb it would be above.
    high = math.sqrt(a * a + (b - rho) * (b - rho))
    if l3 >= high:
        fault[1] = 2
        fault[2] = l3 - high
        return False, 0.0, 0.0, 0.0
    g = (a * a + b * b + rho * rho - l3 * l3) / (2.0 * b * h)
    beta = math.atan2(-rho, a) - math.acos(max(-1.0, min(1.0, g)))
    cb = math.cos(beta)
    sb = math.sin(beta)
    slope = a * sb + rho * cb
    if abs(slope) > 1e-6 * h:
        y = b * cb - a
        w = b * sb + rho
        beta -= 0.5 * (y * y + w * w - l3 * l3) / (b * slope)
    fault[0] = 0.0
    return True, rho, beta, gamma


def _forward(p, q, pose, scratch, fault):  # type: ignore[no-untyped-def]
    """Pose of limb lengths, on the home branch."""
    good, rho, beta, gamma = _solve(p, q, fault)
    if good:
        pose[0] = rho * math.cos(beta)
        pose[1] = beta
        pose[2] = gamma


def _jacobian(p, q, rates, twist, scratch, fault):  # type: ignore[no-untyped-def]
    """Pose rates and platform twist per joint rate, joint by joint.

    The squared lengths above, differentiated: limbs 1 and 2 give rho and gamma, limb 3 beta. The
    twist is v = d(rho tau), omega = beta' X + gamma' y.
    """
    good, rho, beta, gamma = _solve(p, q, fault)
    if not good:
        return
    a = p[PLATFORM]
    b = p[BASE]
    cb = math.cos(beta)
    sb = math.sin(beta)
    cg = math.cos(gamma)
    sg = math.sin(gamma)
    pair = rho * rho * cg - a * b * sg * sg
    slope = a * sb + rho * cb
    square = rho * rho
    measure = min(abs(pair) / (square + a * b), abs(slope) / math.sqrt(square + a * a))
    # Squared: where two assemblies meet, lengths tell the pose only to the root of their error.
    measure *= measure
    if not measure > SINGULARITY_BOUND:
        fault[0] = SINGULAR
        fault[2] = measure
        return
    for j in range(3):
        r = 0.0
        g = 0.0
        e = 0.0
        if j == 0:
            r = q[0] * (rho * cg - b * sg) / (2.0 * pair)
            g = q[0] * (rho - a * sg) / (2.0 * a * pair)
        elif j == 1:
            r = q[1] * (rho * cg + b * sg) / (2.0 * pair)
            g = -q[1] * (rho + a * sg) / (2.0 * a * pair)
        else:
            e = q[2] / (b * slope)
        e -= (rho + b * sb) * r / (b * slope)
        rates[3 * j] = cb * r - rho * sb * e
        rates[3 * j + 1] = e
        rates[3 * j + 2] = g
        twist[3 * j] = 0.0
        twist[3 * j + 1] = -sb * r - rho * cb * e
        twist[3 * j + 2] = cb * r - rho * sb * e
        twist[9 + 3 * j] = e
        twist[9 + 3 * j + 1] = cb * g
        twist[9 + 3 * j + 2] = sb * g


def _angles(p, pose, angles, scratch, fault):  # type: ignore[no-untyped-def]
    """Angle of each limb to the vertical, then to the platform's normal, limb by limb, rad."""
    good, rho, cb, sb, cg, sg = _place(p, pose, fault)
    if not good:
        return
    for i in range(3):
        across, up = _limb(p, i, rho, cb, sb, cg, sg)
        # Both from the platform up to the base.
        if i == 2:
            x = 0.0
            y = across * cb - up * sb
            z = across * sb + up * cb
            along = up * cg
        else:
            x = -across
            y = up * sb
            z = -up * cb
            along = -across * sg - up * cg
        size = math.sqrt(across * across + up * up)
        angles[2 * i] = math.atan2(math.sqrt(x * x + y * y), z)
        angles[2 * i + 1] = math.acos(max(-1.0, min(1.0, along / size))) if size > 0.0 else 0.0


def _clearance(p, pose, q, clearance, scratch, fault):  # type: ignore[no-untyped-def]
    """Clearance of the bars from B to A, see clearance.py."""
    good, rho, cb, sb, cg, sg = _place(p, pose, fault)
    if not good:
        return
    a = p[PLATFORM]
    b = p[BASE]
    # o = rho tau, y = (0, cb, sb), tau = (0, -sb, cb).
    for i in range(2):
        side = -1.0 if i == 0 else 1.0
        up = rho - side * a * sg
        bar(scratch, i, i, p[RADIUS + i], (side * b, 0.0, 0.0), (side * a * cg, -sb * up, cb * up))
    bar(scratch, 2, 2, p[RADIUS + 2], (0.0, b, 0.0), (0.0, a * cb - rho * sb, a * sb + rho * cb))
    clearance[0] = least(scratch, 3)


@scalar
def _element(s, o, c11, c22, c23, c33):  # type: ignore[no-untyped-def]
    """Write one element's compliance on (f1, f2, m)."""
    for k in range(9):
        s[o + k] = 0.0
    s[o] = c11
    s[o + 4] = c22
    s[o + 5] = c23
    s[o + 7] = c23
    s[o + 8] = c33


@scalar
def _wrench(s, o, cb, sb, fx, fy, ft, mx, my, mt):  # type: ignore[no-untyped-def]
    """Write one unit wrench, given along X, y, tau, in fixed axes."""
    s[o] = fx
    s[o + 1] = cb * fy - sb * ft
    s[o + 2] = sb * fy + cb * ft
    s[o + 3] = mx
    s[o + 4] = cb * my - sb * mt
    s[o + 5] = sb * my + cb * mt


@scalar
def _elements(p, pose, s, fault):  # type: ignore[no-untyped-def]
    """Blocks of the three limbs, see elements.py; False where the pose has none.

    Wrenches of each limb: f1 along it, f2 along y through B (UPR) or along X through A (RPU), the
    couple m about tau (2UPR-RPU paper, equations 1 and 19). Each joint's compliance is that of
    its own directions, with f1, f2 and m projected to its centre (equations 5 to 14, 21 to 25).
    """
    good, rho, cb, sb, cg, sg = _place(p, pose, fault)
    if not good:
        return False
    a = p[PLATFORM]
    b = p[BASE]
    for i in range(3):
        across, up = _limb(p, i, rho, cb, sb, cg, sg)
        size = math.sqrt(across * across + up * up)
        if not size > 0.0:
            fault[0] = SINGULAR
            fault[1] = i
            return False
        across /= size
        up /= size
        o = BLOCK * i
        # The couple's parts along the limb's bending axis and along the limb itself.
        if i == 2:
            # In the revolute's axes u = X, v = w x u, w from A to B.
            bend = -across
            turn = up
            _wrench(s, o, cb, sb, 0.0, across, up, a * up, 0.0, 0.0)
            _wrench(s, o + 6, cb, sb, 1.0, 0.0, 0.0, 0.0, 0.0, -a)
        else:
            # In the revolute's axes u = v x w, v = y, w from A to B.
            bend = across
            turn = -up
            side = -1.0 if i == 0 else 1.0
            rx = side * a * cg
            rt = -side * a * sg
            _wrench(s, o, cb, sb, across, 0.0, up, 0.0, rt * across - rx * up, 0.0)
            _wrench(s, o + 6, cb, sb, 0.0, 1.0, 0.0, rho, 0.0, side * b)
        _wrench(s, o + 12, cb, sb, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        bending = p[BENDING + i] * size
        # Force f2 acts at one end of the limb, the joint R stands at the other: moment -L f2 there.
        if i == 2:
            j = RPU_R
            c2, about = p[j], p[j + 4]
        else:
            j = UPR_R
            c2, about = p[j + 1], p[j + 3]
        _element(
            s,
            o + 18,
            p[j + 2],
            c2 + size * size * about,
            -size * bend * about,
            bend * bend * about + turn * turn * p[j + 5],
        )
        _element(
            s,
            o + 27,
            p[AXIAL + i] * size,
            p[SHEAR + i] * size + bending * size * size / 3.0,
            -0.5 * bend * bending * size,
            bend * bend * bending + turn * turn * p[TORSION + i] * size,
        )
        # The universal joint's axes are X, y and tau.
        if i == 2:
            j = RPU_U
            c1 = across * across * p[j + 1] + up * up * p[j + 2]
            c2 = p[j]
        else:
            j = UPR_U
            c1 = across * across * p[j] + up * up * p[j + 2]
            c2 = p[j + 1]
        _element(s, o + 36, c1, c2, 0.0, p[j + 5])
    return True


def _elastic(p, pose, c, scratch, fault):  # type: ignore[no-untyped-def]
    """Compliance of the platform, row-major."""
    if _elements(p, pose, scratch, fault) and factorise(scratch, fault):
        invert(scratch, c)


def _energy(p, pose, wrench, deflection, energies, factors, summary, scratch, fault):  # type: ignore[no-untyped-def]
    """Deflection and strain energies of a wrench, see elements.py."""
    if _elements(p, pose, scratch, fault) and factorise(scratch, fault):
        divide(scratch, wrench, deflection, energies, factors, summary, fault)


UprRpu.inverse_kernel = Kernel(_inverse, (3,), (3,))
UprRpu.forward_kernel = Kernel(_forward, (3,), (3,))
UprRpu.jacobian_kernel = Kernel(_jacobian, (3,), (9, 18))
UprRpu.angles_kernel = Kernel(_angles, (3,), (6,))
UprRpu.clearance_kernel = Kernel(_clearance, (3, 3), (1,), 3 * BAR)
UprRpu.elastic_kernel = Kernel(_elastic, (3,), (36,), SCRATCH)
UprRpu.energy_kernel = Kernel(_energy, (3, 6), (6, 9, 9, 3), SCRATCH)
