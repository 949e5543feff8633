# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Read a machine's plain description for the independent engines, independently of the package.

Limbs are expanded to bodies, joints and rods; every vector is in base axes at home. Only the names,
freedoms and constraints of joint types come from the package; each engine writes their equations.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]

from pkm_twin.machine.joints import TYPES, JointType

Array = NDArray[np.float64]
Description = Mapping[str, Any]

BASE: Final = "base"


class UnfitError(ValueError):
    """A description or a state that an engine cannot compute; the text says why."""


@dataclass(frozen=True)
class Body:
    """A rigid body in its position at home."""

    mass: float
    """kg"""
    com: Array
    """Centre of mass, shape (3,), m."""
    inertia: Array
    """About the centre of mass, shape (3, 3), kg m2."""


@dataclass(frozen=True)
class Joint:
    """A joint in its position at home, where its value is ``home``."""

    name: str
    type: type[JointType]
    inner: str
    outer: str
    at: Array
    """Position, shape (3,), m; arbitrary for a joint that constrains orientations only."""
    axes: Array
    """Unit vectors, shape (axes, 3)."""
    actuated: bool
    home: float
    position: tuple[float, float]
    """Limits of the value, rad or m."""
    viscous: float
    coulomb: float
    offset: float
    rotor_inertia: float
    friction: Mapping[str, Any]
    """The friction section of the file."""
    pitch: float
    """Pitch of a screw, m/rad."""

    @property
    def slides(self) -> bool:
        """True if the joint's value is a length."""
        return self.type.steps == ("slide",)

    @property
    def steps(self) -> list[tuple[bool, Array]]:
        """Single freedoms from the inner to the outer body: true for a rotation, and the axis.

        A screw is a translation and a rotation that an additional equation couples.
        """
        found = []
        for freedom in self.type.freedoms(self.axes, self.pitch):
            axis = np.asarray(freedom.axis, dtype=float)
            found += [(False, axis)] * bool(freedom.slide) + [(True, axis)] * freedom.turns
        return found


@dataclass(frozen=True)
class Rod:
    """A thin homogeneous bar with a ball joint at each end."""

    name: str
    inner: str
    outer: str
    ends: Array
    """Shape (2, 3), m."""
    mass: float

    @property
    def length(self) -> float:
        """Length between the ends, m."""
        return float(np.linalg.norm(self.ends[1] - self.ends[0]))


@dataclass(frozen=True)
class Machine:
    """A machine's geometry and masses, as read from its description for the engines."""

    gravity: Array
    platform: str
    origin: Array
    """The platform's reference point at home, shape (3,), m."""
    pose: tuple[str, ...]
    angles: Mapping[str, str]
    """Names and axes of the platform's angles, from the base on."""
    bodies: Mapping[str, Body]
    joints: tuple[Joint, ...]
    rods: tuple[Rod, ...]
    actuated: tuple[Joint, ...] = field(init=False)
    """The actuated joints in the order of the description."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "actuated", tuple(j for j in self.joints if j.actuated))

    @property
    def home(self) -> Array:
        """Values of the actuated joints at home, shape (n,), rad or m."""
        return np.array([joint.home for joint in self.actuated])

    @property
    def sequence(self) -> str:
        """Axes of the three angles in scipy's notation of intrinsic rotations."""
        return "XYZ" if next(iter(self.angles.values())) == "x" else "ZYX"

    def select_pose_rows(self, position_rows: Array, angle_rows: Array) -> Array:
        """Return the rows of the m pose coordinates from three position rows and three angle rows."""
        rows = dict(zip("xyz", position_rows, strict=True)) | dict(zip(self.angles, angle_rows, strict=False))
        return np.array([rows[name] for name in self.pose])


def vector(value: Any) -> Array:
    """Convert three numbers to an array, shape (3,)."""
    result = np.asarray(value, dtype=float)
    if result.shape != (3,):
        raise UnfitError(f"expected three numbers, found {value!r}")
    return result


def tensor(value: Any) -> Array:
    """Make an inertia matrix from three principal moments or nine numbers, shape (3, 3), kg m2."""
    result = np.asarray(value, dtype=float)
    return np.diag(result) if result.shape == (3,) else result.reshape(3, 3)


def expand(description: Description) -> dict[str, Any]:
    """Expand the ``limbs`` of a description to bodies, joints and rods.

    :returns: a new mapping without ``limbs``; the input is not changed.
    """
    result = {key: value for key, value in description.items() if key != "limbs"}
    for kind in ("bodies", "joints", "rods"):
        result[kind] = {name: dict(entry or {}) for name, entry in _section_items(description, kind)}
    sections = description.get("limbs") or []
    if isinstance(sections, Mapping):
        sections = [sections]
    for section in sections:
        own = {name for name, _ in _section_items(section, "bodies")}
        for number, azimuth in enumerate(section["azimuths"], 1):
            turn = Rotation.from_euler("z", float(azimuth)).as_matrix()
            for kind in ("bodies", "joints", "rods"):
                for name, entry in _section_items(section, kind):
                    full = f"{name}_{number}"
                    if full in result[kind]:
                        raise UnfitError(f"{kind}.{full} occurs twice")
                    result[kind][full] = _rotate_entry(dict(entry or {}), turn, own, number)
    return result


def _section_items(section: Description, kind: str) -> list[tuple[str, Any]]:
    return list((section.get(kind) or {}).items())


def _rotate_entry(entry: dict[str, Any], turn: Array, own: set[str], number: int) -> dict[str, Any]:
    for key in ("at", "axis", "com"):
        if key in entry:
            entry[key] = (turn @ vector(entry[key])).tolist()
    for key in ("axes", "ends"):
        if key in entry:
            entry[key] = [(turn @ vector(v)).tolist() for v in entry[key]]
    if "member" in entry:
        ends = {key: (turn @ vector(entry["member"][key])).tolist() for key in ("from", "to")}
        entry["member"] = entry["member"] | ends
    if "inertia" in entry:
        entry["inertia"] = (turn @ tensor(entry["inertia"]) @ turn.T).tolist()
    # Drives of the copies may differ: a list has one number per copy.
    if isinstance(entry.get("rotor_inertia"), list):
        entry["rotor_inertia"] = entry["rotor_inertia"][number - 1]
    if entry.get("friction"):
        entry["friction"] = {
            key: value[number - 1] if isinstance(value, list) else value for key, value in entry["friction"].items()
        }
    if "between" in entry:
        entry["between"] = [f"{name}_{number}" if name in own else name for name in entry["between"]]
    return entry


def read(description: Description) -> Machine:
    """Read a ``mechanism: machine`` mapping.

    :raises UnfitError: the mapping cannot be read; the package's own loader has better messages.
    """
    data = expand(description)
    origin = (0.0, 0.0, 0.0)
    bodies = {
        name: Body(float(one.get("mass", 0.0)), vector(one.get("com", origin)), tensor(one.get("inertia", origin)))
        for name, one in data["bodies"].items()
    }
    known = {BASE, *bodies}
    joints = tuple(_read_joint(name, entry, known) for name, entry in data["joints"].items())
    rods = tuple(
        Rod(
            name,
            *_read_ends(f"rods.{name}", one, known),
            np.array([vector(end) for end in one["ends"]]),
            float(one.get("mass", 0.0)),
        )
        for name, one in data["rods"].items()
    )
    platform = str(data.get("platform", "platform"))
    if platform not in bodies:
        raise UnfitError(f"no body is named {platform!r}, the platform")
    reference = vector(data.get("origin", bodies[platform].com))
    load = data.get("payload") or {}
    if load.get("mass"):
        # The payload's centre is relative to the platform's reference point.
        at = reference + vector(load.get("com", origin))
        payload = Body(float(load["mass"]), at, tensor(load.get("inertia", origin)))
        one = bodies[platform]
        mass = one.mass + payload.mass
        com, inertia = (one.mass * one.com + payload.mass * payload.com) / mass, np.zeros((3, 3))
        for body in (one, payload):
            arm = body.com - com
            inertia += body.inertia + body.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        bodies[platform] = Body(mass, com, inertia)
    return Machine(
        vector(data.get("gravity", (0.0, 0.0, -9.81))),
        platform,
        reference,
        # Without pose coordinates of its own only positions and rotations are compared.
        tuple(data.get("pose", ())),
        # R = Rz(yaw) Ry(pitch) Rx(roll)
        data.get("angles") or {"yaw": "z", "pitch": "y", "roll": "x"},
        bodies,
        joints,
        rods,
    )


def _read_ends(name: str, entry: Mapping[str, Any], known: set[str]) -> tuple[str, str]:
    inner, outer = entry["between"]
    for body in (inner, outer):
        if body not in known:
            raise UnfitError(f"{name} stands between {inner!r} and {outer!r}: no body {body!r}")
    return inner, outer


def _read_joint(name: str, entry: Mapping[str, Any], known: set[str]) -> Joint:
    kind = entry["type"]
    if kind not in TYPES:
        raise UnfitError(f"joints.{name}: no joint type {kind!r}")
    count = TYPES[kind].count
    inner, outer = _read_ends(f"joints.{name}", entry, known)
    axes: Sequence[Any] = entry.get("axes") or ([entry["axis"]] if "axis" in entry else [])
    if len(axes) != count:
        raise UnfitError(f"joints.{name}: {len(axes)} axes, a {kind} joint has {count}")
    units = [vector(axis) / np.linalg.norm(vector(axis)) for axis in axes]
    friction, limits = entry.get("friction") or {}, entry.get("limits") or {}
    rotor = float(entry.get("rotor_inertia", 0.0))
    if drive := entry.get("drive"):
        # A rotor's inertia acts at the joint with the squared gear ratio.
        rotor = float(drive["inertia"] * (drive.get("ratio") or 2.0 * math.pi / drive["lead"]) ** 2)
    low, high = limits.get("position", (-math.inf, math.inf))
    return Joint(
        name,
        TYPES[kind],
        inner,
        outer,
        vector(entry.get("at", (0, 0, 0))),
        np.array(units).reshape(-1, 3),
        bool(entry.get("actuated", False)),
        float(entry.get("home", 0.0)),
        (float(low), float(high)),
        float(friction.get("viscous", 0.0)),
        float(friction.get("coulomb", 0.0)),
        float(friction.get("offset", 0.0)),
        rotor,
        friction,
        float(entry.get("lead", 0.0)) / (2.0 * math.pi),
    )


def add_friction_laws(drives: Sequence[Joint], q: Array, qd: Array, tau: Array) -> Array:
    """Add load-dependent friction, Stribeck friction and cogging to the efforts, shape (n,).

    :param tau: efforts that include viscous friction, Coulomb friction and offset, N m or N.
    """
    result: Array = np.array(tau, dtype=float)
    for k, joint in enumerate(drives):
        f, way = joint.friction, float(np.sign(qd[k]))
        load = tau[k] - joint.viscous * qd[k] - joint.coulomb * way - joint.offset
        result[k] += way * float(f.get("load_dependent", 0.0)) * abs(load)
        if f.get("stribeck"):
            ratio = qd[k] / float(f["stribeck_speed"])
            result[k] += way * float(f["stribeck"]) * math.exp(-(ratio**2))
        if f.get("cogging_period"):
            angle = 2.0 * math.pi * q[k] / float(f["cogging_period"])
            result[k] += float(f.get("cogging_cos", 0.0)) * math.cos(angle)
            result[k] += float(f.get("cogging_sin", 0.0)) * math.sin(angle)
    return result


def cross(a: Array, b: Array) -> Array:
    """Return a x b, shape (3,); for a single pair np.cross is ten times slower."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def make_perpendicular_axes(axis: Array) -> tuple[Array, Array]:
    """Return two unit vectors that form a right-handed triple with ``axis``, shape (3,) each."""
    first = cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first = first / np.linalg.norm(first)
    return first, cross(axis, first)
