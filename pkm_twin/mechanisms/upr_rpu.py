# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
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

Between singularities are the poses with z < 0, rho^2 cos gamma > a b sin^2 gamma (limbs 1 and 2)
and z + a sin beta < 0 (A3 below the base).

Source: 2UPR-RPU paper (geometry of table 1; equations 1 to 37). Its sign conventions are kept;
they matter only in the product of a limb's couple with its bending.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import Numbers, norm
from pkm_twin.codegen.operations import absolute, atan2, cos, maximum, minimum, sin, sqrt
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.motion import Motion
from pkm_twin.kinematics.pose import COORDINATES, Coordinate, name_angles
from pkm_twin.kinematics.scheme import ClosedFormStart
from pkm_twin.machine import schema
from pkm_twin.machine.graph import BASE, MIN_LENGTH, PLATFORM, Body, Direction, Graph, Joint, array
from pkm_twin.machine.members import Beam, Parts, Section, axial, compliances, disc, modulus
from pkm_twin.machine.pose_grid import PoseGrid
from pkm_twin.machine.sections import length, mass, shared_middle
from pkm_twin.machine.tree import Tree
from pkm_twin.mechanisms import TwinRobot

MIN_HEIGHT_RATIO: Final = 1e-2
"""Smallest height of a limb at home relative to its width: below it the limbs lie in the base."""
MAX_ROOT_RATIO: Final = 1e4
"""Largest root of the cubic over a b; roots 4 a b apart have errors near 1e-16 (root / a b)^2."""
_LIMB_DIRECTIONS: Final = array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_X: Final = array([1.0, 0.0, 0.0])
_Y: Final = array([0.0, 1.0, 0.0])


FREE_AXES: Final = {
    "upr_revolute": (4,),
    "upr_universal": (3, 4),
    "rpu_universal": (3, 4),
    "rpu_revolute": (3,),
}
"""Entries of each joint's compliance that are free axes."""
_COMPLIANCE_DIRECTIONS: Final = ("along u", "along v", "along w", "about u", "about v", "about w")


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
    diameter: Array = schema.vector(3, low=MIN_LENGTH, spread=True, unit="m")
    shear_factor: float = schema.number(low=0.0, high=10.0, default=1.0)

    def verify(self, path: str) -> None:
        """Check that the diameters' fourth powers neither overflow nor vanish."""
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
        """Check that a joint is free exactly about its axes, and elastic in the other directions."""
        for joint, free in FREE_AXES.items():
            for i, value in enumerate(getattr(self, joint).tolist()):
                field = f"{path}.{joint}[{i}]"
                if i in free and value != math.inf:
                    raise ParameterError(field, value, f".inf: the joint turns {_COMPLIANCE_DIRECTIONS[i]}")
                if i not in free and not value <= 1.0:
                    raise ParameterError(field, value, f"0 to 1: the joint carries load {_COMPLIANCE_DIRECTIONS[i]}")


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

    density: float = schema.number(above=0.0, high=1e5, unit="kg/m3")
    platform_mass: float = mass()
    platform_com: Array = schema.vector(3, unit="m", default=[0, 0, 0])
    platform_inertia: Array | None = schema.inertia(positive=False, default=None)
    rotor_inertia: float = schema.number(low=0.0, unit="kg", default=0.0)


@dataclass(frozen=True, eq=False)
class Limits:
    """Limb lengths [min, max], one pair or three (m); bound of every passive joint's angle (rad).

    The default is no limit.
    """

    limb_length: Array | None = schema.interval(above=0.0, count=3, unit="m", default=None)
    joint_angle: float | None = schema.number(above=0.0, high=math.pi, unit="rad", default=None)
    velocity: ClassVar[None] = None
    effort: ClassVar[None] = None

    @property
    def position(self) -> Array | None:
        """Limits of the actuated joints, shape (3, 2), m."""
        return self.limb_length


@dataclass(frozen=True)
class LargestRoot(ClosedFormStart):
    """The home assembly: rho, beta and gamma by the largest root of a cubic.

    The guess about home is too far from most states: limbs triple their length.
    """

    def solve_unknowns(self, tree: Tree, q: Numbers) -> list[Any]:
        """Return cosine and sine of the turns of the passive joints from home.

        With c = cos(gamma) = (P + K) / (2 a b), P = rho^2 and 4 a rho sin(gamma) = L1^2 - L2^2 = D,
        c^2 + s^2 = 1 is the cubic P (P + K)^2 - 4 a^2 b^2 P + b^2 D^2 / 4 = 0 with
        K = a^2 + b^2 - (L1^2 + L2^2) / 2. Its slope at a root is
        4 a b (rho^2 cos(gamma) - a b sin^2(gamma)), so the largest root is the home branch until it
        meets the middle one, which is the singularity. Limb 3:
        a cos(beta) - rho sin(beta) = h cos(beta - atan2(-rho, a)).
        """
        joints, height = tree.graph.joints, tree.graph.origin[2]
        a, b = joints["R joint 2"].at[0], joints["U joint 2"].at[0]
        l1, l2, l3 = q
        k = a * a + b * b - 0.5 * (l1 * l1 + l2 * l2)
        ab = a * a * b * b
        d = (l1 - l2) * (l1 + l2)
        r = sqrt(k * k + 12.0 * ab)
        c = k * (8.0 / 3.0 * ab - 2.0 / 27.0 * k * k) + 0.25 * b * b * d * d
        g = minimum(1.0, maximum(-1.0, -13.5 * c / (r * r * r)))
        third = atan2(sqrt((1.0 - g) * (1.0 + g)), g) * (1.0 / 3.0)
        square = maximum(2.0 / 3.0 * (r * cos(third) - k), 1e-12 * a * b)
        rho = -sqrt(square)
        gamma = atan2(d / (4.0 * a * rho), (square + k) / (2.0 * a * b))
        h = sqrt(a * a + square)
        g = minimum(1.0, maximum(-1.0, (a * a + b * b + square - l3 * l3) / (2.0 * b * h)))
        beta = atan2(-rho, a) - atan2(sqrt((1.0 - g) * (1.0 + g)), g)

        def limb_components(i: int, rho: Any, beta: Any, gamma: Any) -> tuple[Any, Any]:
            """Return a limb's components: 0, 1 (UPR) along X, tau from B; 2 (RPU) along y, tau from A."""
            if i == 2:
                return b * cos(beta) - a, -b * sin(beta) - rho
            side = -1.0 if i == 0 else 1.0
            return side * (a * cos(gamma) - b), rho - side * a * sin(gamma)

        turns: dict[str, list[Any]] = {}
        for i, limb in enumerate("123"):
            (x, z), (x0, z0) = limb_components(i, rho, beta, gamma), limb_components(i, height, 0.0, 0.0)
            turned = atan2(x * z0 - z * x0, x * x0 + z * z0)
            if i < 2:
                turns |= {f"U joint {limb}": [beta, turned], f"R joint {limb}": [gamma - turned]}
            else:
                # The plane of limb 3 is given in axes rotated by beta.
                turns[f"R joint {limb}"] = [beta - turned]
        result = list(tree.home)
        for link in tree.links.values():
            passive = [step for step in link.steps if not step.actuated]
            for step, angle in zip(passive, turns.get(str(link.joint), ()), strict=False):
                result[step.position : step.position + 2] = [cos(angle), sin(angle)]
        return result

    def find_conditions(self, motion: Motion) -> list[Any]:
        """Return expressions that are positive between the singularities, where roots are accurate.

        As the cubic is not negative at 0, its largest root is the positive one of positive slope.
        """
        joints, (position, turned) = motion.graph.joints, motion.platform()
        a, b, z = joints["R joint 2"].at[0], joints["U joint 2"].at[0], position[2]
        square, ab = z * z, a * b * turned[1][1] * turned[1][1]
        slope = square * turned[0][0] - ab * turned[0][2] * turned[0][2]
        return [-z * turned[1][1], slope, -(z + a * turned[2][1]), MAX_ROOT_RATIO * ab - square]


@dataclass(frozen=True, eq=False, kw_only=True)
class UprRpu(TwinRobot):
    """A 2UPR-RPU machine with elastic bars and joints."""

    mechanism: str = schema.choice("upr_rpu")
    geometry: Geometry = schema.section(Geometry)
    members: Members = schema.section(Members)
    joints_compliance: JointsCompliance = schema.section(JointsCompliance)
    limits: Limits = schema.section(Limits, default={})
    joints: tuple[str, ...] = schema.words(size=3, default=["limb_1", "limb_2", "limb_3"])
    inertia: Inertia | None = schema.section(Inertia, default=None)

    description: ClassVar[str] = "2UPR-RPU head, three actuated telescopic limbs"
    mobility: ClassVar[str] = "3: translation along Oo, rotations beta, gamma"
    limb_names: ClassVar[tuple[str, ...]] = ("limb 1", "limb 2", "limb 3")
    layout: ClassVar[PoseGrid] = PoseGrid("cylinder", ("z", "beta", "gamma"), "z", ("beta", "gamma"))
    limit_key: ClassVar[str] = "limits.limb_length"
    start: ClassVar[LargestRoot] = LargestRoot()
    coordinates: ClassVar[tuple[Coordinate, ...]] = (
        COORDINATES["z"],
        *name_angles({"beta": "x", "gamma": "y"}),
    )
    changeable: ClassVar[tuple[str, ...]] = (
        "members",
        "joints_compliance",
        "limits",
        "payload",
        "friction",
        "gravity",
        "element_compliance",
        "modal_damping",
    )

    @property
    def _radii(self) -> tuple[float, float]:
        return self.geometry.platform_radius, self.geometry.base_radius

    def chosen_home(self) -> float:
        """Length of the limbs at home, m: the middle of their limits, if the platform is below the base.

        Otherwise the length with the platform 1.5 times the larger radius below the base.
        """
        a, b = self._radii
        aside, middle = abs(a - b), shared_middle(self.limits.position)
        if middle is not None and middle > aside * (1.0 + MIN_HEIGHT_RATIO):
            return middle
        deep = 1.5 * max(a, b)
        return math.sqrt(aside * aside + deep * deep)

    def limit_angles(self, pose: ArrayLike) -> Array:
        """Angle of each limb to the vertical, then to the platform's normal, (..., 6), rad."""
        a, b = self._radii
        origin, x, y = self._platform_axes(pose)
        normal = np.cross(x, y)
        angles = []
        for i in range(3):
            arm = _LIMB_DIRECTIONS[i, 0] * x + _LIMB_DIRECTIONS[i, 1] * y
            up = b * _LIMB_DIRECTIONS[i] - origin - a * arm
            up /= np.linalg.norm(up, axis=-1, keepdims=True)
            angles.append(np.arctan2(np.hypot(up[..., 0], up[..., 1]), up[..., 2]))
            along = np.clip((up * normal).sum(-1), -1.0, 1.0)
            angles.append(np.arccos(along))
        return np.stack(angles, -1)

    def _platform_axes(self, pose: ArrayLike) -> tuple[Array, Array, Array]:
        """Return o, and the platform's x and y in base axes, of poses (..., 3); (..., 3) each."""
        z, beta, gamma = np.moveaxis(np.asarray(pose, np.float64), -1, 0)
        zero = np.zeros_like(z)
        origin = np.stack([zero, -z * np.tan(beta), z], -1)
        x = np.stack([np.cos(gamma), np.sin(beta) * np.sin(gamma), -np.cos(beta) * np.sin(gamma)], -1)
        return origin, x, np.stack([zero, np.cos(beta), np.sin(beta)], -1)

    def limb_wrenches(self, pose: ArrayLike) -> Array:
        """Return the wrenches that each limb can apply to the platform, shape (..., 3, 6, 3).

        The paper's J_i (equation 30): columns are the unit actuation force, the unit constraint
        force and the unit constraint couple about tau = X x y, as force and moment at the
        platform's reference point, base axes. UPR limbs (equation 1): forces along B_i A_i and y
        through B_i. RPU limb (equation 19): forces along A_3 B_3 and X through A_3.

        :param pose: shape (..., 3), m and rad.
        """
        a, b = self._radii
        origin, x, y = self._platform_axes(pose)
        axis = np.broadcast_to(_X, y.shape)
        tau = np.cross(axis, y)
        limbs = []
        for i in range(3):
            arm = a * (_LIMB_DIRECTIONS[i, 0] * x + _LIMB_DIRECTIONS[i, 1] * y)
            foot = b * _LIMB_DIRECTIONS[i] - origin
            along = (arm - foot) * (1.0 if i < 2 else -1.0)
            along /= np.linalg.norm(along, axis=-1, keepdims=True)
            point, forces = (foot, (along, y)) if i < 2 else (arm, (along, axis))
            columns = [np.concatenate([f, np.cross(point, f)], -1) for f in forces]
            columns.append(np.concatenate([np.zeros_like(tau), tau], -1))
            limbs.append(np.stack(columns, -1))
        return np.stack(limbs, -3)

    def search_box(self) -> Array:
        """Return bounds of the pose; z is at most the length of limbs 1 and 2, which are symmetric about o."""
        box, lengths = super().search_box(), self.limits.limb_length
        return box if lengths is None else np.array([(-float(lengths[:2].max()), 0.0), *box[1:]])

    def default_inertia(self) -> dict[str, Any]:
        """Return the platform's inertia, of a disc."""
        m: Any = self.inertia
        return {"platform_inertia": disc(m.platform_mass, self.geometry.platform_radius)}

    def make_parts(self) -> Parts:
        """Make telescopic limbs at home, the platform level; joints elastic in their own axes.

        Joint compliances of equations 8, 15 and 25 act in the joints' axes (equations 10 and 14);
        bar and joints of a limb in series have the compliance C_i (equations 16 and 27).
        A bar reaches from B to A, as in the paper, and its mass with it: a telescope's tubes that
        overlap are not told apart. Without inertia bars have no mass.
        """
        a, b = self._radii
        inertia: Any = self.with_default_inertia.inertia
        limb_length, aside = self.home_joint, absolute(b - a)
        origin = array([0.0, 0.0, -sqrt((limb_length - aside) * (limb_length + aside))])
        rotor = self.reflect_rotor(0.0 if inertia is None else inertia.rotor_inertia, slides=True)
        members, soft = self.members, self.joints_compliance
        density = 0.0 if inertia is None else inertia.density
        bodies: dict[str, Body] = {}
        joints: dict[str, Joint] = {}
        beams: list[Beam] = []
        compliances: dict[str, Sequence[float]] = {}
        for i, limb in enumerate("123"):
            foot, head = array(b * _LIMB_DIRECTIONS[i]), array(origin + a * _LIMB_DIRECTIONS[i])
            reach = norm(head - foot)
            d = (head - foot) / reach
            low, high = f"lower tube {limb}", f"upper tube {limb}"
            diameter = members.diameter[i]
            half, radius = reach / 2, diameter / 2
            weight = density * math.pi * radius**2 * half
            across, along = weight * (half**2 / 12 + radius**2 / 4), weight * radius**2 / 2
            for name, at in ((low, foot + 0.25 * reach * d), (high, head - 0.25 * reach * d)):
                bodies[name] = Body(name, weight, array(at), array(axial(across, along, d)))
            section = Section(
                members.youngs_modulus,
                members.shear_modulus,
                diameter,
                0.0,
                density * math.pi / 4 * diameter**2,
                members.shear_factor,
            )
            bar, ends = f"{limb}B", ((low, foot), (high, head))
            beams.append(Beam(bar, bar, i, *ends, (low, high), radius, (), section))
            compliances[f"{limb}U"] = (soft.upr_universal if i < 2 else soft.rpu_universal).tolist()
            compliances[f"{limb}R"] = (soft.upr_revolute if i < 2 else soft.rpu_revolute).tolist()
            # UPR: the universal joint stands on the base; RPU: at the platform.
            at_base, at_platform = ((BASE, low), foot), ((high, PLATFORM), head)
            (pair, at), (other_pair, other_at) = (at_base, at_platform) if i < 2 else (at_platform, at_base)
            inner, outer, w = *pair, np.cross(_X, _Y)
            universal = Joint(
                f"U joint {limb}",
                "universal",
                *pair,
                at,
                array([_X, _Y]),
                directions=_make_directions(((inner, _X), (outer, _Y), (inner, w))),
                label=f"{limb}U",
            )
            axis, turning = (_Y, high) if i < 2 else (_X, low)
            u, v = (np.cross(_Y, -d), _Y) if i < 2 else (_X, np.cross(-d, _X))
            revolute = Joint(
                f"R joint {limb}",
                "revolute",
                *other_pair,
                other_at,
                array([axis]),
                directions=_make_directions(((turning, u), (turning, v), (turning, -d))),
                label=f"{limb}R",
            )
            drive = Joint(
                self.joints[i],
                "prismatic",
                low,
                high,
                foot,
                array([d]),
                actuated=True,
                home=reach,
                rotor_inertia=rotor,
                label=f"P joint {limb}",
            )
            chain = (universal, drive, revolute) if i < 2 else (revolute, drive, universal)
            joints |= {joint.name: joint for joint in chain}
        bodies[PLATFORM] = Body(PLATFORM, 0.0, origin)
        if inertia is not None:
            com, about = origin + inertia.platform_com, inertia.platform_inertia
            bodies[PLATFORM] = Body(PLATFORM, inertia.platform_mass, array(com), array(about))
        order = tuple(f"{limb}{element}" for limb in "123" for element in "RBU")
        return Parts(Graph(bodies, joints, {}, PLATFORM, origin), tuple(beams), compliances, order)


def _make_directions(axes: Sequence[tuple[str, Array]]) -> tuple[Direction, ...]:
    """Return the named directions u, v and w; each axis comes with the body in which it is fixed."""
    return tuple(Direction(name, body, array(v)) for name, (body, v) in zip("uvw", axes, strict=True))
