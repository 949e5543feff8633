# SPDX-License-Identifier: Apache-2.0
"""The 3-PRRU head: three vertical sliders, three limbs, a platform that lifts and tilts.

Frame: origin at the centre of the base circle, z up. Pose: height z of the platform's centre (m),
alpha, beta (rad); the platform's rotation is Rx(alpha) Ry(beta) Rz(gamma). Joint: slider height q,
force positive up (N). Limb i stands in the vertical plane of azimuth phi_i: its slider at
C_i = (-R cos phi_i, -R sin phi_i, q_i), its platform joint U_i at (-r cos phi_i, -r sin phi_i, 0)
in the platform frame, l apart. The limb swings by theta_i about t_i = (-sin phi_i, cos phi_i, 0),
direction d_i = sin theta_i e_i + cos theta_i z with e_i = (cos phi_i, sin phi_i, 0); its upper
link turns in addition about d_i, so that the universal joint's platform-fixed axis, tangential,
and its link-fixed axis stay at a right angle.

Parasitic motions. t_i . U_i = 0 for three limbs is linear in x, y, cos gamma and sin gamma, so
gamma, x and y have a closed form for any three different azimuths; at 120 degrees it is equation
11 of the paper.

Motion. U_i depends on q_i and theta_i alone, so the platform's rigid triangle,
|U_i - U_j| constant, gives three equations for the swings, and their derivatives three linear ones
for the swing rates and accelerations. The platform's centre and its x and y axes are fixed linear
combinations of the U_i; all else follows from these without a derivative of a Jacobian.

Branches: ``below`` has every slider below its platform joint (the paper's equation 9), ``above``
every slider above it. Of the assemblies that a set of slider heights allows, ``forward`` gives
the one that is reached from equal heights (the level platform) when all sliders move straight to
their places, without passing a singularity; its beta is within a quarter turn. ``inverse`` takes
the poses on the same side of the singularities as the level one and refuses those beyond, where
the measure is zero or negative. For limbs at 120 degrees and a platform no wider than the base,
``forward`` undoes ``inverse`` up to the singularity; a platform much wider, or uneven limbs, can
have further assemblies on that side in steep poses.

Source: 3-PRRU paper (equations 1 to 17 geometry, 18 to 31 velocities, 32 to 41 virtual work). The
paper has each link's mass at its slider joint, which ``link_com: 0`` gives.
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
    HEAD,
    PAYLOAD_COM,
    PAYLOAD_INERTIA,
    PAYLOAD_MASS,
    ROW,
    TWIST,
    virtual_work,
)
from pkm_twin.machine.joints import (
    GROUND,
    MOVING,
    Joint,
    PlatformMotion,
    joint,
    platform_motion,
)
from pkm_twin.machine.members import Frame, Member, RigidBody, Support, Tube, disc
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
LIMB: Final = HEAD + 2
SIGN: Final = HEAD + 3
HOME: Final = HEAD + 4
SCALE: Final = HEAD + 5
COS: Final = HEAD + 6
SIN: Final = HEAD + 9
SPREAD: Final = HEAD + 12
SIDE: Final = HEAD + 15
CENTRE: Final = HEAD + 18
AXIS_X: Final = HEAD + 21
AXIS_Y: Final = HEAD + 24
TURN: Final = HEAD + 27
M_SLIDER: Final = HEAD + 29
M_LOWER: Final = HEAD + 30
M_UPPER: Final = HEAD + 31
LINK_COM: Final = HEAD + 32
I_LOWER: Final = HEAD + 33
I_UPPER: Final = HEAD + 34
SPIN_UPPER: Final = HEAD + 35
M_PLATFORM: Final = HEAD + 36
PLATFORM_COM: Final = HEAD + 37
PLATFORM_INERTIA: Final = HEAD + 40
R_LIMB: Final = HEAD + 49

BODIES: Final = 11
SCRATCH: Final = ROW * BODIES + TWIST

SWING_STEP: Final = 0.35
"""Longest swing (rad) that one Newton run may bridge on the way from the level platform."""
LEAST_STEP: Final = 1e-7
"""Least part of the way from the level platform that is tried."""
CONVERGED: Final = 1e-10
"""Newton's last step (rad); it converges quadratically, so what is left is below rounding."""


@dataclass(frozen=True, eq=False)
class Geometry:
    """Lengths (m), limb azimuths phi (rad), and where the sliders stand."""

    base_radius: float = length()
    platform_radius: float = length()
    limb_length: float = length()
    azimuths: Array = schema.vector(3)
    branch: str = schema.choice("above", "below")

    def verify(self, path: str) -> None:
        """Limbs apart, and long enough for the level platform."""
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
    default a thin rod of length l. ``platform_com`` and ``platform_inertia`` (about the com)
    in platform axes; default a thin disc of the platform's radius.
    """

    slider_mass: float = mass()
    lower_link_mass: float = mass()
    upper_link_mass: float = mass()
    platform_mass: float = mass()
    link_com: float = schema.number(at_least=0.0, at_most=1.0, default=0.5)
    lower_link_inertia: Array | None = schema.vector(2, at_least=0.0, default=None)
    upper_link_inertia: Array | None = schema.vector(2, at_least=0.0, default=None)
    platform_com: Array = schema.vector(3, default=[0, 0, 0])
    platform_inertia: Array | None = schema.inertia(positive=False, default=None)

    def verify(self, path: str) -> None:
        """Axial moments within the triangle rule."""
        for key in ("lower_link_inertia", "upper_link_inertia"):
            value = getattr(self, key)
            if value is not None and value[1] > 2 * value[0] * (1 + 1e-9):
                raise ParameterError(
                    f"{path}.{key}", value.tolist(), "triangle rule: axial at most twice across"
                )


@dataclass(frozen=True, eq=False)
class Members:
    """A limb's two links as one tube with the masses of both, for elasticity and interference."""

    limb: Tube = schema.section(Tube)


@dataclass(frozen=True, eq=False)
class Prru(Robot):
    """A 3-PRRU head with three vertical sliders."""

    mechanism: str = schema.choice("prru")
    geometry: Geometry = schema.section(Geometry)
    inertia: Inertia = schema.section(Inertia)
    payload: Payload = schema.section(Payload, default={})
    friction: Friction = schema.section(Friction, default={})
    gravity: Array = schema.vector(3, default=[0, 0, -9.81])
    joints: tuple[str, ...] = schema.names(3, default=["slider_1", "slider_2", "slider_3"])
    limits: Limits = schema.section(Limits, default={})
    members: Members | None = schema.section(Members, default=None)

    description: ClassVar[str] = "3-PRRU head, three vertical sliders and two links a limb"
    mobility: ClassVar[str] = "3: translation z, rotations alpha, beta (x, y, gamma follow)"
    pose_names: ClassVar[tuple[str, str, str]] = ("z", "alpha", "beta")
    pose_units: ClassVar[tuple[str, str, str]] = ("m", "rad", "rad")
    joint_unit: ClassVar[str] = "m"
    effort_unit: ClassVar[str] = "N"
    rotation_kernel: ClassVar[Kernel]
    changeable: ClassVar[tuple[str, ...]] = ("payload", "friction", "gravity", "limits")
    body_names: ClassVar[tuple[str, ...]] = (
        *(
            f"{body} {limb}"
            for limb in ("I", "II", "III")
            for body in ("slider", "lower link", "upper link")
        ),
        "platform",
        "payload",
    )

    def rotation(self, pose: ArrayLike) -> Array:
        """Platform axes as columns in fixed axes, Rx(alpha) Ry(beta) Rz(gamma), shape (..., 3, 3).

        :raises SingularityError: gamma is not determined.
        """
        rows, fault = self.rotation_kernel(self.parameters, pose)
        self.raise_fault(fault, "pose")
        return rows.reshape(*rows.shape[:-1], 3, 3)

    def grid(self) -> PoseGrid:
        """Tilts about the vertical axis, in tilt-and-torsion angles without torsion."""
        return PoseGrid("cylinder", self.pose_names, "z", ("alpha", "beta"), zero_torsion=True)

    def search_box(self) -> Array:
        """Each platform joint is within a limb of its slider; tilts up to a right angle.

        :raises ParameterError: sliders without limits travel without end.
        """
        g, travel = self.geometry, self.limits.position
        if travel is None:
            raise ParameterError(
                "limits.position", None, "limits of the sliders: without them z has no end"
            )
        reach, right = g.limb_length + g.platform_radius, math.pi / 2
        z = float(travel.min()) - reach, float(travel.max()) + reach
        return np.array([z, (-right, right), (-right, right)])

    def pose_rates(self, platform: PlatformMotion) -> tuple[Array, Array]:
        """First and second derivative of the pose in time.

        The platform's z axis is (sin beta, -sin alpha cos beta, cos alpha cos beta).
        """
        n, nd, ndd = (
            np.moveaxis(axes[..., 2], -1, 0)
            for axes in (platform.axes, platform.axes_rate, platform.axes_acceleration)
        )
        square = n[1] * n[1] + n[2] * n[2]
        root = np.sqrt(square)
        alpha = (n[1] * nd[2] - nd[1] * n[2]) / square
        beta = nd[0] / root
        swell = 2.0 * (n[1] * nd[1] + n[2] * nd[2])
        alpha_rate = (n[1] * ndd[2] - ndd[1] * n[2] - alpha * swell) / square
        beta_rate = (ndd[0] + n[0] * beta * beta) / root
        return (
            np.stack([platform.velocity[..., 2], alpha, beta], -1),
            np.stack([platform.acceleration[..., 2], alpha_rate, beta_rate], -1),
        )

    def body_joints(self, q: Array, platform: PlatformMotion) -> tuple[Joint, ...]:
        """Guides, slider joints, link joints and platform joints, and what they transmit.

        Directions of a limb: e and t (across e) horizontal, d from the slider to the platform
        joint, h the platform-fixed axis of the universal joint. Guide: all but the travel along z,
        which the actuator holds. Slider joint: a revolute about t. Link joint: a revolute
        about d; it is taken at the slider joint's point C, where the paper has both links'
        frames. Platform joint: a universal joint with the axes h and d x h: all forces, and the
        moment along n, normal to both axes.
        """
        g = self.geometry
        up = np.array([0.0, 0.0, 1.0])
        joints: list[Joint] = []
        for i, limb in enumerate(("I", "II", "III")):
            e = np.array([math.cos(g.azimuths[i]), math.sin(g.azimuths[i]), 0.0])
            t = np.cross(up, e)
            carriage = q[..., i, None] * up - g.base_radius * e
            corner = platform.position - g.platform_radius * (platform.axes @ e)
            d = (corner - carriage) / g.limb_length
            h = platform.axes @ t
            n = d - np.sum(h * d, axis=-1, keepdims=True) * h
            n /= np.linalg.norm(n, axis=-1, keepdims=True)
            slider, lower, upper = (f"{b} {limb}" for b in ("slider", "lower link", "upper link"))
            fixed = {"e": e, "t": t, "z": up}
            s = np.cross(t, d)
            along = {"d": d, "t": t, "t x d": s}
            joints += [
                joint(
                    f"guide {limb}",
                    (GROUND, slider),
                    carriage,
                    fixed,
                    fixed,
                    actuated="force along z",
                ),
                joint(
                    f"slider joint {limb}", (slider, lower), carriage, along, {"d": d, "t x d": s}
                ),
                joint(f"link joint {limb}", (lower, upper), carriage, along, {"t": t, "t x d": s}),
                joint(f"platform joint {limb}", (upper, MOVING), corner, along, {"n": n}),
            ]
        return tuple(joints)

    def frame(self, pose: Array) -> Frame:
        """Limbs between locked sliders and the platform.

        The joints are those of :meth:`body_joints`: a limb turns about t and about itself at its
        slider, about h and d x h at the platform. The sliders stand still.

        :param pose: shape (3,): z (m), alpha, beta (rad).
        :raises ParameterError: the file has no members.
        """
        g, m = self.geometry, self.inertia
        if self.members is None:
            raise ParameterError("members", None, "a section with the elastic members, the limbs")
        spread = (m.lower_link_mass + m.upper_link_mass) / g.limb_length
        section = self.members.limb.section(spread, "members.limb")
        q = self.inverse(pose)
        platform = platform_motion(self, q)
        turn, up, free = platform.axes, np.array([0.0, 0.0, 1.0]), math.inf
        beams: list[Member] = []
        for i, limb in enumerate(("I", "II", "III")):
            e = np.array([math.cos(g.azimuths[i]), math.sin(g.azimuths[i]), 0.0])
            t = np.cross(up, e)
            start = q[i] * up - g.base_radius * e
            end = platform.position - g.platform_radius * (turn @ e)
            d = (end - start) / np.linalg.norm(end - start)
            h = turn @ t
            across = np.cross(d, h)
            across /= np.linalg.norm(across)
            foot = np.column_stack((d, t, np.cross(d, t)))
            head = np.column_stack((h, across, np.cross(h, across)))
            inner = Support(f"slider joint {limb}", GROUND, foot, (0.0, 0.0, 0.0, free, free, 0.0))
            outer = Support(
                f"platform joint {limb}", MOVING, head, (0.0, 0.0, 0.0, free, free, 0.0)
            )
            beams.append(Member(f"limb {limb}", f"limb {limb}", section, start, end, inner, outer))
        own = m.platform_inertia
        if own is None:
            own = disc(m.platform_mass, g.platform_radius)
        bodies = [RigidBody(MOVING, m.platform_mass, turn @ m.platform_com, turn @ own @ turn.T)]
        load = self.payload
        if load.mass > 0.0:
            inertia = turn @ load.inertia @ turn.T
            bodies.append(RigidBody("payload", load.mass, turn @ load.com, inertia))
        return Frame(platform.position, tuple(beams), tuple(bodies))

    @property
    def radii(self) -> tuple[float, ...] | None:
        """Outer radius of a limb, m; None: the file has no members."""
        return None if self.members is None else (self.members.limb.outer_diameter / 2,)

    def _pack(self) -> list[float]:
        g, m = self.geometry, self.inertia
        cosines, sines = np.cos(g.azimuths), np.sin(g.azimuths)
        sign = 1.0 if g.branch == "below" else -1.0
        swing = math.asin((g.base_radius - g.platform_radius) / g.limb_length)
        spread = np.array([math.cos(g.azimuths[i] - g.azimuths[(i + 1) % 3]) for i in range(3)])
        side = 2 * g.platform_radius**2 * (1 - spread)
        # Columns: the U_i's weights in the platform's centre, x axis and y axis.
        weights = np.linalg.inv(
            [np.ones(3), -g.platform_radius * cosines, -g.platform_radius * sines]
        )
        centre = weights[:, 0]
        thin = np.array([g.limb_length**2 / 12, 0.0])
        lower = m.lower_link_mass * thin if m.lower_link_inertia is None else m.lower_link_inertia
        upper = m.upper_link_mass * thin if m.upper_link_inertia is None else m.upper_link_inertia
        disc = m.platform_mass * g.platform_radius**2 / 4 * np.diag([1.0, 1.0, 2.0])
        platform = disc if m.platform_inertia is None else m.platform_inertia
        return [
            *dynamic_head(self),
            g.base_radius,
            g.platform_radius,
            g.limb_length,
            sign,
            swing if sign > 0.0 else math.pi - swing,
            -sign / (2 * g.limb_length**3 * math.sqrt(side.prod())),
            *cosines,
            *sines,
            *spread,
            *side,
            *centre,
            *weights[:, 1],
            *weights[:, 2],
            float(centre @ np.sin(2 * g.azimuths)),
            float(centre @ np.cos(2 * g.azimuths)),
            m.slider_mass,
            m.lower_link_mass,
            m.upper_link_mass,
            m.link_com,
            lower[0],
            *upper,
            m.platform_mass,
            *m.platform_com,
            *platform.ravel(),
            *(self.radii or (math.nan,)),
        ]


@scalar
def _closure(p, d0, d1, d2, sn, cs):  # type: ignore[no-untyped-def]
    """The platform's triangle, side k from joint k to joint k + 1.

    ``d``: q_k less q_k+1. Returns the joints' distances rho along e (U = rho e + ...), the
    height of U_k over U_k+1, the derivatives (U_k - U_k+1) . dU/dtheta of side k by its two
    swings, the errors of half the squared sides, and their determinant.
    """
    l = p[LIMB]  # noqa: E741
    rho = (l * sn[0] - p[BASE], l * sn[1] - p[BASE], l * sn[2] - p[BASE])
    h = (d0 + l * (cs[0] - cs[1]), d1 + l * (cs[1] - cs[2]), d2 + l * (cs[2] - cs[0]))
    g0 = p[SPREAD]
    g1 = p[SPREAD + 1]
    g2 = p[SPREAD + 2]
    k = (
        l * (cs[0] * (rho[0] - g0 * rho[1]) - sn[0] * h[0]),
        l * (cs[1] * (rho[1] - g0 * rho[0]) + sn[1] * h[0]),
        l * (cs[1] * (rho[1] - g1 * rho[2]) - sn[1] * h[1]),
        l * (cs[2] * (rho[2] - g1 * rho[1]) + sn[2] * h[1]),
        l * (cs[2] * (rho[2] - g2 * rho[0]) - sn[2] * h[2]),
        l * (cs[0] * (rho[0] - g2 * rho[2]) + sn[0] * h[2]),
    )
    f0 = rho[0] * rho[0] + rho[1] * rho[1] - 2.0 * g0 * rho[0] * rho[1] + h[0] * h[0]
    f1 = rho[1] * rho[1] + rho[2] * rho[2] - 2.0 * g1 * rho[1] * rho[2] + h[1] * h[1]
    f2 = rho[2] * rho[2] + rho[0] * rho[0] - 2.0 * g2 * rho[2] * rho[0] + h[2] * h[2]
    f = (0.5 * (f0 - p[SIDE]), 0.5 * (f1 - p[SIDE + 1]), 0.5 * (f2 - p[SIDE + 2]))
    return rho, h, k, f, k[0] * k[2] * k[4] + k[1] * k[3] * k[5]


@scalar
def _swings(k, det, y0, y1, y2):  # type: ignore[no-untyped-def]
    """Solve k0 x0 + k1 x1 = y0, k2 x1 + k3 x2 = y1, k4 x2 + k5 x0 = y2."""
    f = 1.0 / det
    return (
        f * (k[2] * k[4] * y0 - k[1] * k[4] * y1 + k[1] * k[3] * y2),
        f * (k[4] * k[0] * y1 - k[3] * k[0] * y2 + k[3] * k[5] * y0),
        f * (k[0] * k[2] * y2 - k[5] * k[2] * y0 + k[5] * k[1] * y1),
    )


@scalar
def _turned(p, pose):  # type: ignore[no-untyped-def]
    """First two columns of the platform's rotation by rows, and what gamma was normed by.

    With the upper left of Rx Ry = [[m, 0], [n, o]], sum w_i t_i . U_i = 0, where sum w_i t_i = 0
    and sum w_i = 1, reads a cos gamma + b sin gamma = 0; b > 0 in the level pose. At 120 degrees
    it is equation 11: tan gamma = -n / (m + o).
    """
    ca = math.cos(pose[1])
    sa = math.sin(pose[1])
    cb = math.cos(pose[2])
    sb = math.sin(pose[2])
    n = sa * sb
    a = (ca - cb) * p[TURN] + n * (p[TURN + 1] + 1.0)
    b = (ca - cb) * p[TURN + 1] - n * p[TURN] + ca + cb
    norm = math.sqrt(a * a + b * b)
    if not norm > SINGULARITY_BOUND:
        return (0.0, 0.0), (0.0, 0.0), (0.0, 0.0), norm
    cg = b / norm
    sg = -a / norm
    return (
        (cb * cg, -cb * sg),
        (n * cg + ca * sg, ca * cg - n * sg),
        (sa * sg - ca * sb * cg, sa * cg + ca * sb * sg),
        norm,
    )


def _rotation(p, pose, rotation, scratch, fault):  # type: ignore[no-untyped-def]
    """Rotation of the platform (equation 1), row by row."""
    if not math.isfinite(pose[0] + pose[1] + pose[2]):
        fault[0] = NOT_FINITE
        return
    row1, row2, row3, norm = _turned(p, pose)
    if not norm > SINGULARITY_BOUND:
        fault[0] = SINGULAR
        fault[2] = norm
        return
    for i in range(2):
        rotation[i] = row1[i]
        rotation[3 + i] = row2[i]
        rotation[6 + i] = row3[i]
    rotation[2] = math.sin(pose[2])
    rotation[5] = -math.sin(pose[1]) * math.cos(pose[2])
    rotation[8] = math.cos(pose[1]) * math.cos(pose[2])


@scalar
def _middle(p, row1, row2):  # type: ignore[no-untyped-def]
    """Platform's centre, x and y: least squares of the three planes, which agree."""
    r = p[PLATFORM]
    xx = yy = xy = bx = by = 0.0
    for i in range(3):
        c = p[COS + i]
        s = p[SIN + i]
        off = r * (c * (row2[0] * c + row2[1] * s) - s * (row1[0] * c + row1[1] * s))
        xx += s * s
        yy += c * c
        xy -= s * c
        bx -= s * off
        by += c * off
    det = xx * yy - xy * xy
    return (yy * bx - xy * by) / det, (xx * by - xy * bx) / det


def _inverse(p, pose, q, scratch, fault):  # type: ignore[no-untyped-def]
    """Slider heights of a pose (equation 9)."""
    if not math.isfinite(pose[0] + pose[1] + pose[2]):
        fault[0] = NOT_FINITE
        return
    row1, row2, row3, norm = _turned(p, pose)
    if not norm > SINGULARITY_BOUND:
        fault[0] = SINGULAR
        fault[2] = norm
        return
    r = p[PLATFORM]
    x, y = _middle(p, row1, row2)
    l = p[LIMB]  # noqa: E741
    for i in range(3):
        c = p[COS + i]
        s = p[SIN + i]
        inward = c * (row1[0] * c + row1[1] * s) + s * (row2[0] * c + row2[1] * s)
        out = c * x + s * y - r * inward + p[BASE]
        if not abs(out) <= l:
            fault[0] = UNREACHABLE
            fault[1] = i
            fault[2] = abs(out) - l
            return
        up = pose[0] - r * (row3[0] * c + row3[1] * s)
        scratch[i] = out / l
        scratch[3 + i] = p[SIGN] * math.sqrt((1.0 - out / l) * (1.0 + out / l))
        q[i] = up - l * scratch[3 + i]
    _rho, _h, _k, _f, det = _closure(
        p,
        q[0] - q[1],
        q[1] - q[2],
        q[2] - q[0],
        (scratch[0], scratch[1], scratch[2]),
        (scratch[3], scratch[4], scratch[5]),
    )
    measure = det * p[SCALE]
    if not measure > SINGULARITY_BOUND:
        fault[0] = SINGULAR
        fault[2] = measure


@scalar
def _assemble(p, q):  # type: ignore[no-untyped-def]
    """Swings of slider heights: theta_0, theta_1, theta_2, fault code, limb, amount.

    Newton's method on the triangle's sides, from the level platform along the straight way of
    the sliders; the way is cut where Newton's method would bridge more than SWING_STEP or touch
    a singularity.
    """
    t0 = t1 = t2 = p[HOME]
    d0 = q[0] - q[1]
    d1 = q[1] - q[2]
    d2 = q[2] - q[0]
    done = 0.0
    step = 1.0
    while done < 1.0 and step > LEAST_STEP:
        way = min(1.0, done + step)
        u0 = t0
        u1 = t1
        u2 = t2
        good = False
        for _ in range(10):
            sn = (math.sin(u0), math.sin(u1), math.sin(u2))
            cs = (math.cos(u0), math.cos(u1), math.cos(u2))
            _rho, _h, k, f, det = _closure(p, way * d0, way * d1, way * d2, sn, cs)
            if not det * p[SCALE] > SINGULARITY_BOUND:
                break
            x = _swings(k, det, f[0], f[1], f[2])
            u0 -= x[0]
            u1 -= x[1]
            u2 -= x[2]
            if not max(abs(u0 - t0), abs(u1 - t1), abs(u2 - t2)) < SWING_STEP:
                break
            if abs(x[0]) + abs(x[1]) + abs(x[2]) < CONVERGED:
                good = True
                break
        if good:
            t0 = u0
            t1 = u1
            t2 = u2
            done = way
            step *= 2.0
        else:
            step *= 0.5
    limb = 0
    amount = 0.0
    if done < 1.0:
        # The slider farthest from the mean height has to come back the most.
        mean = (q[0] + q[1] + q[2]) / 3.0
        for i in range(3):
            left = (1.0 - done) * abs(q[i] - mean)
            if left > amount:
                amount = left
                limb = i
        return t0, t1, t2, UNREACHABLE, limb, amount
    code = 0.0
    for i in range(3):
        high = p[SIGN] * p[LIMB] * math.cos(t0 if i == 0 else (t1 if i == 1 else t2))
        if not high > amount:
            # The slider has passed its platform joint, where inverse gives the other branch.
            code = UNREACHABLE
            limb = i
            amount = -high
            break
    return t0, t1, t2, code, limb, amount


@scalar
def _sum(p, o, rho, up):  # type: ignore[no-untyped-def]
    """Combination of the three limbs' vectors rho e + up z with the weights at ``o``."""
    a = p[o] * rho[0]
    b = p[o + 1] * rho[1]
    c = p[o + 2] * rho[2]
    return (
        a * p[COS] + b * p[COS + 1] + c * p[COS + 2],
        a * p[SIN] + b * p[SIN + 1] + c * p[SIN + 2],
        p[o] * up[0] + p[o + 1] * up[1] + p[o + 2] * up[2],
    )


@scalar
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@scalar
def _cross(a, b):  # type: ignore[no-untyped-def]
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@scalar
def _place(p, q, rho, cs):  # type: ignore[no-untyped-def]
    """Platform's centre and axes x, y, z."""
    l = p[LIMB]  # noqa: E741
    up = (q[0] + l * cs[0], q[1] + l * cs[1], q[2] + l * cs[2])
    x = _sum(p, AXIS_X, rho, up)
    y = _sum(p, AXIS_Y, rho, up)
    return _sum(p, CENTRE, rho, up), x, y, _cross(x, y)


def _forward(p, q, pose, scratch, fault):  # type: ignore[no-untyped-def]
    """Pose of slider heights, in the level platform's assembly."""
    if not math.isfinite(q[0] + q[1] + q[2]):
        fault[0] = NOT_FINITE
        return
    t0, t1, t2, code, limb, amount = _assemble(p, q)
    fault[0] = code
    fault[1] = limb
    fault[2] = amount
    if code != 0.0:
        return
    cs = (math.cos(t0), math.cos(t1), math.cos(t2))
    l = p[LIMB]  # noqa: E741
    b = p[BASE]
    rho = (l * math.sin(t0) - b, l * math.sin(t1) - b, l * math.sin(t2) - b)
    o, x, y, z = _place(p, q, rho, cs)
    pose[0] = o[2]
    pose[1] = math.atan2(-z[1], z[2])
    pose[2] = math.atan2(z[0], math.sqrt(x[0] * x[0] + y[0] * y[0]))


@scalar
def _velocities(p, q, s, fault):  # type: ignore[no-untyped-def]
    """The platform's twist per joint rate into the end of ``s``, and what it was found from.

    Returns: good, sines and cosines of the swings, rho, h, k and determinant of the closure,
    the swing rates per joint rate (by limb), centre and axes.
    """
    t0, t1, t2, code, limb, amount = _assemble(p, q)
    fault[0] = code
    fault[1] = limb
    fault[2] = amount
    sn = (math.sin(t0), math.sin(t1), math.sin(t2))
    cs = (math.cos(t0), math.cos(t1), math.cos(t2))
    rho, h, k, _f, det = _closure(p, q[0] - q[1], q[1] - q[2], q[2] - q[0], sn, cs)
    if code != 0.0:
        # Nothing below is used; only the division has to pass.
        det = 1.0
    o, x, y, z = _place(p, q, rho, cs)
    a = _swings(k, det, -h[0], 0.0, h[2])
    b = _swings(k, det, h[0], -h[1], 0.0)
    c = _swings(k, det, 0.0, h[1], -h[2])
    l = p[LIMB]  # noqa: E741
    t = ROW * BODIES
    for j in range(3):
        w = a if j == 0 else (b if j == 1 else c)
        out = (l * cs[0] * w[0], l * cs[1] * w[1], l * cs[2] * w[2])
        up = (
            (1.0 if j == 0 else 0.0) - l * sn[0] * w[0],
            (1.0 if j == 1 else 0.0) - l * sn[1] * w[1],
            (1.0 if j == 2 else 0.0) - l * sn[2] * w[2],
        )
        v = _sum(p, CENTRE, out, up)
        xd = _sum(p, AXIS_X, out, up)
        yd = _sum(p, AXIS_Y, out, up)
        # The axes turn with the platform: x' = omega x x, y' = omega x y.
        wx = _dot(yd, z)
        wy = -_dot(xd, z)
        wz = _dot(xd, y)
        for i in range(3):
            s[t + 3 * j + i] = v[i]
            s[t + 9 + 3 * j + i] = wx * x[i] + wy * y[i] + wz * z[i]
    rates = ((a[0], b[0], c[0]), (a[1], b[1], c[1]), (a[2], b[2], c[2]))
    return code == 0.0, sn, cs, rho, h, k, det, rates, o, x, y, z


@scalar
def _fixed(p, s, o, body, com, inertia, centre, a, w, al, x, y, z):  # type: ignore[no-untyped-def]
    """Row at ``o`` of a body fixed to the platform; its mass, com and inertia stand in ``p``.

    ``a``: acceleration of the centre; ``w``, ``al``: angular velocity and acceleration, world.
    """
    c0 = p[com]
    c1 = p[com + 1]
    c2 = p[com + 2]
    c = (
        c0 * x[0] + c1 * y[0] + c2 * z[0],
        c0 * x[1] + c1 * y[1] + c2 * z[1],
        c0 * x[2] + c1 * y[2] + c2 * z[2],
    )
    inward = _cross(w, _cross(w, c))
    across = _cross(al, c)
    wb = (_dot(w, x), _dot(w, y), _dot(w, z))
    ab = (_dot(al, x), _dot(al, y), _dot(al, z))
    i0 = (p[inertia], p[inertia + 1], p[inertia + 2])
    i1 = (p[inertia + 3], p[inertia + 4], p[inertia + 5])
    i2 = (p[inertia + 6], p[inertia + 7], p[inertia + 8])
    turn = _cross(wb, (_dot(i0, wb), _dot(i1, wb), _dot(i2, wb)))
    n0 = _dot(i0, ab) + turn[0]
    n1 = _dot(i1, ab) + turn[1]
    n2 = _dot(i2, ab) + turn[2]
    s[o] = p[body]
    for i in range(3):
        s[o + 1 + i] = centre[i] + c[i]
        s[o + 4 + i] = a[i] + across[i] + inward[i]
        s[o + 7 + i] = n0 * x[i] + n1 * y[i] + n2 * z[i]
    t = ROW * BODIES
    for j in range(3):
        g = (s[t + 9 + 3 * j], s[t + 10 + 3 * j], s[t + 11 + 3 * j])
        v = _cross(g, c)
        for i in range(3):
            s[o + 10 + 3 * j + i] = s[t + 3 * j + i] + v[i]
            s[o + 19 + 3 * j + i] = g[i]


@scalar
def _links(p, i, qi, qdi, qddi, s, st, ct, td, tdd, rates, w, al, x, y):  # type: ignore[no-untyped-def]
    """Rows of limb i's slider, lower and upper link; False at the universal joint's singularity.

    ``st``, ``ct``, ``td``, ``tdd``: sine, cosine, rate and acceleration of the swing, ``rates``
    its rate per joint rate; ``w``, ``al``, ``x``, ``y`` of the platform, world. Spin of the upper
    link: tan = -(h . d') / (h . t), h the platform's tangential axis, d' = d d/d theta
    (equations 13 to 17).
    """
    co = p[COS + i]
    si = p[SIN + i]
    lever = p[LIMB] * p[LINK_COM]
    i_lower = p[I_LOWER]
    i_upper = p[I_UPPER]
    spin_inertia = p[SPIN_UPPER]
    m_lower = p[M_LOWER]
    m_upper = p[M_UPPER]
    tx = (-si, co, 0.0)
    d = (st * co, st * si, ct)
    dd = (ct * co, ct * si, -st)
    h = (co * y[0] - si * x[0], co * y[1] - si * x[1], co * y[2] - si * x[2])
    hd = _cross(w, h)
    turn = _cross(w, hd)
    hdd = _cross(al, h)
    hdd = (hdd[0] + turn[0], hdd[1] + turn[1], hdd[2] + turn[2])
    a = -_dot(h, dd)
    b = _dot(h, tx)
    along = _dot(h, d)
    square = a * a + b * b
    ad = td * along - _dot(hd, dd)
    bd = _dot(hd, tx)
    add = 2.0 * td * _dot(hd, d) + tdd * along - td * td * a - _dot(hdd, dd)
    bdd = _dot(hdd, tx)
    if not square > SINGULARITY_BOUND * SINGULARITY_BOUND:
        return False
    spin = (ad * b - a * bd) / square
    spin_rate = (add * b - a * bdd - 2.0 * spin * (a * ad + b * bd)) / square
    # Slider.
    o = 3 * i * ROW
    for k in range(3 * ROW):
        s[o + k] = 0.0
    s[o] = p[M_SLIDER]
    s[o + 1] = -p[BASE] * co
    s[o + 2] = -p[BASE] * si
    s[o + 3] = qi
    s[o + 6] = qddi
    s[o + 12 + 3 * i] = 1.0
    # Links: one centre of mass for both; angular velocity swing t, and swing t + spin d.
    lower = o + ROW
    upper = lower + ROW
    s[lower] = m_lower
    s[upper] = m_upper
    f = spin_inertia * spin_rate
    g = spin_inertia * spin * td
    for k in range(3):
        place = s[o + 1 + k] + lever * d[k]
        speed_up = s[o + 4 + k] + lever * (tdd * dd[k] - td * td * d[k])
        s[lower + 1 + k] = place
        s[upper + 1 + k] = place
        s[lower + 4 + k] = speed_up
        s[upper + 4 + k] = speed_up
        s[lower + 7 + k] = i_lower * tdd * tx[k]
        s[upper + 7 + k] = i_upper * tdd * tx[k] + f * d[k] + g * dd[k]
    t = ROW * BODIES + 9
    for j in range(3):
        e = (s[t + 3 * j], s[t + 3 * j + 1], s[t + 3 * j + 2])
        he = _cross(e, h)
        swing = rates[j]
        turned = ((swing * along - _dot(he, dd)) * b - a * _dot(he, tx)) / square
        for k in range(3):
            v = lever * swing * dd[k]
            if k == 2 and j == i:
                v += 1.0
            s[lower + 10 + 3 * j + k] = v
            s[upper + 10 + 3 * j + k] = v
            s[lower + 19 + 3 * j + k] = swing * tx[k]
            s[upper + 19 + 3 * j + k] = swing * tx[k] + turned * d[k]
    return True


@scalar
def _bias(rho, h, g, l, rho_d, up_d, st, ct, td, i, j):  # type: ignore[no-untyped-def]  # noqa: E741
    """Second derivative of half a squared side from joint i to j at zero accelerations."""
    r = rho_d[i] * rho_d[i] + rho_d[j] * rho_d[j] - 2.0 * g * rho_d[i] * rho_d[j]
    u = up_d[i] - up_d[j]
    along_i = st[i] * (rho[i] - g * rho[j]) + ct[i] * h
    along_j = st[j] * (g * rho[i] - rho[j]) + ct[j] * h
    return r + u * u - l * (td[i] * td[i] * along_i - td[j] * td[j] * along_j)


@scalar
def _motion(p, q, qd, qdd, s, fault):  # type: ignore[no-untyped-def]
    """Rows of all bodies, see bodies.py; False where the state is faulty."""
    if not math.isfinite(q[0] + q[1] + q[2] + qd[0] + qd[1] + qd[2] + qdd[0] + qdd[1] + qdd[2]):
        fault[0] = NOT_FINITE
        return False
    good, sn, cs, rho, h, k, det, rates, centre, x, y, z = _velocities(p, q, s, fault)
    if not good:
        return False
    l = p[LIMB]  # noqa: E741
    td = (_dot(rates[0], qd), _dot(rates[1], qd), _dot(rates[2], qd))
    rho_d = (l * cs[0] * td[0], l * cs[1] * td[1], l * cs[2] * td[2])
    up_d = (qd[0] - l * sn[0] * td[0], qd[1] - l * sn[1] * td[1], qd[2] - l * sn[2] * td[2])
    b0 = _bias(rho, h[0], p[SPREAD], l, rho_d, up_d, sn, cs, td, 0, 1)
    b1 = _bias(rho, h[1], p[SPREAD + 1], l, rho_d, up_d, sn, cs, td, 1, 2)
    b2 = _bias(rho, h[2], p[SPREAD + 2], l, rho_d, up_d, sn, cs, td, 2, 0)
    tdd = _swings(
        k,
        det,
        -b0 - h[0] * (qdd[0] - qdd[1]),
        -b1 - h[1] * (qdd[1] - qdd[2]),
        -b2 - h[2] * (qdd[2] - qdd[0]),
    )
    rho_dd = (
        l * (cs[0] * tdd[0] - sn[0] * td[0] * td[0]),
        l * (cs[1] * tdd[1] - sn[1] * td[1] * td[1]),
        l * (cs[2] * tdd[2] - sn[2] * td[2] * td[2]),
    )
    up_dd = (
        qdd[0] - l * (sn[0] * tdd[0] + cs[0] * td[0] * td[0]),
        qdd[1] - l * (sn[1] * tdd[1] + cs[1] * td[1] * td[1]),
        qdd[2] - l * (sn[2] * tdd[2] + cs[2] * td[2] * td[2]),
    )
    a = _sum(p, CENTRE, rho_dd, up_dd)
    xdd = _sum(p, AXIS_X, rho_dd, up_dd)
    ydd = _sum(p, AXIS_Y, rho_dd, up_dd)
    t = ROW * BODIES + 9
    w = (
        s[t] * qd[0] + s[t + 3] * qd[1] + s[t + 6] * qd[2],
        s[t + 1] * qd[0] + s[t + 4] * qd[1] + s[t + 7] * qd[2],
        s[t + 2] * qd[0] + s[t + 5] * qd[1] + s[t + 8] * qd[2],
    )
    # x'' = alpha x x + omega x (omega x x), and the same of y, along the platform's axes.
    wx = _dot(w, x)
    wy = _dot(w, y)
    wz = _dot(w, z)
    ax = _dot(ydd, z) - wy * wz
    ay = wx * wz - _dot(xdd, z)
    az = _dot(xdd, y) - wx * wy
    al = (
        ax * x[0] + ay * y[0] + az * z[0],
        ax * x[1] + ay * y[1] + az * z[1],
        ax * x[2] + ay * y[2] + az * z[2],
    )
    for i in range(3):
        if not _links(
            p, i, q[i], qd[i], qdd[i], s, sn[i], cs[i], td[i], tdd[i], rates[i], w, al, x, y
        ):
            fault[0] = SINGULAR
            return False
    m = ROW * 9
    _fixed(p, s, m, M_PLATFORM, PLATFORM_COM, PLATFORM_INERTIA, centre, a, w, al, x, y, z)
    m = ROW * 10
    _fixed(p, s, m, PAYLOAD_MASS, PAYLOAD_COM, PAYLOAD_INERTIA, centre, a, w, al, x, y, z)
    return True


def _jacobian(p, q, rates, twist, scratch, fault):  # type: ignore[no-untyped-def]
    """Pose rates and platform twist per joint rate, joint by joint."""
    if not math.isfinite(q[0] + q[1] + q[2]):
        fault[0] = NOT_FINITE
        return
    good, _sn, _cs, _rho, _h, _k, _det, _rates, _o, x, y, _z = _velocities(p, q, scratch, fault)
    if not good:
        return
    # cos beta; x and y begin with cos beta cos gamma and -cos beta sin gamma.
    square = x[0] * x[0] + y[0] * y[0]
    root = math.sqrt(square)
    if not root > SINGULARITY_BOUND:
        fault[0] = SINGULAR
        fault[2] = root
        return
    t = ROW * BODIES
    for k in range(18):
        twist[k] = scratch[t + k]
    for j in range(3):
        w = (twist[9 + 3 * j], twist[10 + 3 * j], twist[11 + 3 * j])
        wx = _dot(w, x)
        wy = _dot(w, y)
        rates[3 * j] = twist[3 * j + 2]
        rates[3 * j + 1] = (wx * x[0] + wy * y[0]) / square
        rates[3 * j + 2] = (wy * x[0] - wx * y[0]) / root


def _bodies(p, q, qd, qdd, rows, scratch, fault):  # type: ignore[no-untyped-def]
    """Rows of all bodies and the platform's twist, see bodies.py."""
    _motion(p, q, qd, qdd, rows, fault)


def _inverse_dynamics(p, q, qd, qdd, wrench, tau, scratch, fault):  # type: ignore[no-untyped-def]
    """Slider forces by virtual work (equation 41), N."""
    if _motion(p, q, qd, qdd, scratch, fault) and not virtual_work(
        p, scratch, BODIES, qd, wrench, tau
    ):
        fault[0] = NOT_FINITE


def _clearance(p, pose, q, clearance, scratch, fault):  # type: ignore[no-untyped-def]
    """Clearance of the limbs between slider and platform joints, see clearance.py."""
    row1, row2, row3, norm = _turned(p, pose)
    if not norm > SINGULARITY_BOUND:
        fault[0] = SINGULAR
        fault[2] = norm
        return
    x, y = _middle(p, row1, row2)
    r = p[PLATFORM]
    for i in range(3):
        c = p[COS + i]
        s = p[SIN + i]
        slider = (-p[BASE] * c, -p[BASE] * s, q[i])
        corner = (
            x - r * (row1[0] * c + row1[1] * s),
            y - r * (row2[0] * c + row2[1] * s),
            pose[0] - r * (row3[0] * c + row3[1] * s),
        )
        bar(scratch, i, i, p[R_LIMB], slider, corner)
    clearance[0] = least(scratch, 3)


Prru.rotation_kernel = Kernel(_rotation, (3,), (9,))
Prru.inverse_kernel = Kernel(_inverse, (3,), (3,), 6)
Prru.forward_kernel = Kernel(_forward, (3,), (3,))
Prru.jacobian_kernel = Kernel(_jacobian, (3,), (9, 18), SCRATCH)
Prru.motion_kernel = Kernel(_bodies, (3, 3, 3), (SCRATCH,))
Prru.dynamics_kernel = Kernel(_inverse_dynamics, (3, 3, 3, 6), (3,), SCRATCH)
Prru.clearance_kernel = Kernel(_clearance, (3, 3), (1,), 3 * BAR)
