# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Read a machine's file as a graph: bodies, joints, rods, copies of limbs, and drives."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import references
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.machine import schema
from pkm_twin.machine.formulas import ExpressionText
from pkm_twin.machine.friction import check_laws, list_friction_keys
from pkm_twin.machine.graph import Body, Graph, Joint, Rod, array, rotation_about_z
from pkm_twin.machine.joints import TURN, TYPES, Freedom, unit
from pkm_twin.machine.members import Tube, compliances
from pkm_twin.machine.places import Keys, find_number, join_path, replace_numbers
from pkm_twin.machine.sections import (
    MAX_PLACE,
    DriveSpec,
    Redundancy,
    check_angles,
    friction_fields,
    length,
    make_friction_schema,
    make_limits_schema,
    mass,
    place,
)

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class MemberSpec:
    """A body as an elastic bar between two of its points, m, or as a rigid capsule of a radius, m.

    ``section``: of the elastic bar, along which the body's mass is distributed.
    """

    start: Array = place(name="from")
    end: Array = place(name="to")
    section: Tube | None = schema.section(Tube, default=None)
    radius: float | None = length(default=None)

    def verify(self, path: str) -> None:
        """Check the length, and that a section or a radius is given."""
        if not float(np.linalg.norm(self.end - self.start)) > 1e-9:
            raise ParameterError(f"{path}.to", self.end.tolist(), "a point apart from `from`")
        if self.section is None and self.radius is None:
            raise ParameterError(path, None, "a section, or a radius")

    @property
    def outer(self) -> float:
        """Outer radius, m."""
        return self.section.outer_diameter / 2 if self.section is not None else float(self.radius or 0)


@dataclass(frozen=True, eq=False)
class BodySpec:
    """Mass (kg), centre of mass (m) and inertia about it (kg m2), base axes at home."""

    mass: float = mass(default=0.0)
    com: Array | None = place(default=None)
    inertia: Array = schema.inertia(positive=False, default=[0, 0, 0])
    member: MemberSpec | None = schema.section(MemberSpec, default=None)

    def verify(self, path: str) -> None:
        """Check that a body with mass has a centre of mass."""
        if self.com is None and (self.mass > 0.0 or self.inertia.any()):
            raise ParameterError(f"{path}.com", None, "the centre of mass of a body with mass, m")


_Laws: Any = dataclasses.make_dataclass("_Laws", friction_fields(schema.number, default=0.0), frozen=True, eq=False)


@dataclass(frozen=True, eq=False)
class FrictionSpec(_Laws):  # type: ignore[misc]  # its fields are those of the laws
    """Friction of a joint, opposite to its velocity; a named mechanism has one number, or one per joint.

    ``viscous``: per velocity. ``coulomb``: by the sign of the velocity. ``offset``: a constant effort
    of the drive. The other keys belong to further friction laws of drives, see docs/fit.md.
    """

    def verify(self, path: str) -> None:
        """Check that a friction law has all of its parameters."""
        check_laws(self, path)


@dataclass(frozen=True, eq=False)
class LimitSpec:
    """Limits of one joint: position [min, max], velocity and effort, or ``swivel``."""

    position: Array | None = schema.interval(unit="{joint}", default=None)
    velocity: float | None = schema.number(above=0.0, high=math.inf, unit="{joint}/s", default=None)
    effort: float | None = schema.number(above=0.0, high=math.inf, unit="{effort}", default=None)
    swivel: float | None = schema.number(
        above=0.0,
        high=np.pi,
        unit="rad",
        default=None,
        text="largest angle of `axis` from its direction at home, in the other body's frame",
    )
    axis: Array | None = schema.vector(
        3, text="base axes; default: the attached bar; of a universal joint the normal of its axes", default=None
    )

    def verify(self, path: str) -> None:
        """Check that an axis is not zero, and belongs to a swivel."""
        if self.axis is not None and self.swivel is None:
            raise ParameterError(f"{path}.axis", self.axis.tolist(), "none without swivel")
        if self.axis is not None and not float(np.linalg.norm(self.axis)) > 1e-9:
            raise ParameterError(f"{path}.axis", self.axis.tolist(), "a vector with a length")


@dataclass(frozen=True, eq=False)
class JointSpec:
    """A joint between an inner and an outer body, through the point ``at`` (m) at home.

    Its value is how far the outer body has moved relative to the inner one, along or about
    ``axis``; ``home`` is the value at home (default 0). A ``universal`` joint has two ``axes``, the
    first fixed in the inner body, the second in the outer one. The value of a ``helical`` joint is
    its turn; ``lead`` is the travel per turn, negative for a left-handed thread. A ``translation``
    has three slides along base axes, a ``planar`` joint two slides across its axis and a turn about
    it. ``limits``: ``position`` and ``swivel`` of a passive joint bound the workspace; an actuated
    joint has all but ``swivel``. ``rotor_inertia`` is reflected to the joint and has no weight;
    ``drive`` replaces it. ``compliance``: along u, v, w, then about them; 0 or .inf where a passive
    joint is free. Of an actuated joint's own motion it is that of gear or screw, with the motor
    locked. u is ``axis``, v = u x e with e the base axis most nearly perpendicular to u,
    w = u x v; v and w turn with the inner body. For a universal joint u and v are its ``axes``; for
    a spherical one u, v, w are base axes.
    """

    type: str = schema.choice(*TYPES)
    between: tuple[str, ...] = schema.words(size=2)
    at: Array | None = place(default=None)
    axis: Array | None = schema.vector(3, default=None)
    axes: Array | None = schema.matrix(2, 3, default=None)
    lead: float | None = schema.number(low=-10.0, high=10.0, unit="m per turn", default=None)
    actuated: bool = schema.flag(default=False)
    home: float | None = schema.number(unit="{joint}", default=None)
    limits: LimitSpec | None = schema.section(LimitSpec, default=None)
    friction: FrictionSpec | None = schema.section(FrictionSpec, default=None)
    rotor_inertia: float = schema.number(low=0.0, unit="{rotor}", default=0.0)
    drive: DriveSpec | None = schema.section(DriveSpec, default=None)
    compliance: Array | None = compliances(default=None)

    def verify(self, path: str) -> None:
        """Check that the axes and the point that the joint type needs are there."""
        kind = TYPES[self.type]
        count = kind.count
        for key, wanted in (("axis", count == 1), ("axes", count == 2)):
            value = getattr(self, key)
            if wanted and value is None:
                raise ParameterError(f"{path}.{key}", None, f"required for a {self.type} joint")
            if value is not None and not wanted:
                raise ParameterError(f"{path}.{key}", value.tolist(), f"none for a {self.type} joint")
            for row in [] if value is None else np.atleast_2d(value):
                if not float(np.linalg.norm(row)) > 1e-9:
                    raise ParameterError(f"{path}.{key}", row.tolist(), "a vector with a length")
        if kind.threaded() != bool(self.lead):
            allowed = "m per turn, not zero" if kind.threaded() else f"none for a {self.type} joint"
            raise ParameterError(f"{path}.lead", self.lead, allowed)
        if self.at is None and kind.placed:
            raise ParameterError(f"{path}.at", None, f"the point of a {self.type} joint, m")
        freedoms = self._freedoms()
        if self.actuated and len(freedoms) != 1:
            raise ParameterError(f"{path}.actuated", self.type, "a joint of one freedom")
        for key in list_friction_keys():
            value = getattr(self.friction, key, 0.0)
            if value and not self.actuated and key not in ("viscous", "coulomb"):
                raise ParameterError(f"{path}.friction.{key}", value, "0 at a joint that is not actuated")
        if self.rotor_inertia and self.drive is not None:
            raise ParameterError(f"{path}.drive", "given", "either drive or rotor_inertia")
        swivels = self.limits is not None and self.limits.swivel is not None
        if swivels and self.type not in ("spherical", "universal"):
            raise ParameterError(f"{path}.limits.swivel", self.type, "a spherical or universal joint")
        if swivels and any(getattr(self.limits, key) is not None for key in ("position", "velocity", "effort")):
            raise ParameterError(f"{path}.limits", self.type, "swivel alone")
        for key in ("limits", "friction", "rotor_inertia", "drive", "home"):
            if getattr(self, key) and len(freedoms) != 1 and not (key == "limits" and swivels):
                raise ParameterError(f"{path}.{key}", self.type, "a joint of one freedom")
        if self.compliance is not None:
            for k in np.flatnonzero(np.isinf(self.compliance) & ~self._free()):
                raise ParameterError(f"{path}.compliance[{k}]", math.inf, "a finite number: the joint holds there")
        if len(freedoms) == 1 and freedoms[0].turns:
            check_angles(self.home or 0.0, f"{path}.home")

    @property
    def slides(self) -> bool:
        """True for a joint of one freedom whose value is a length."""
        return [freedom.turns for freedom in self._freedoms()] == [False]

    def _freedoms(self) -> tuple[Freedom, ...]:
        pitch = 0.0 if self.lead is None else self.lead / TURN
        return TYPES[self.type].freedoms(self._unit_axes(), pitch)

    def _free(self) -> NDArray[np.bool_]:
        """Return which of the six directions of ``compliance`` are free."""
        free = np.zeros(6, bool)
        if self.actuated:
            return free
        kind = TYPES[self.type]
        directions = kind.directions(self._unit_axes())
        for k, freedom in enumerate(self._freedoms()):
            if not (freedom.turns and freedom.slide):
                along = k if kind.count == 2 else freedom.nearest(directions)
                free[3 * freedom.turns + along] = True
        return free

    def _unit_axes(self) -> Array:
        rows = self.axes if self.axes is not None else self.axis
        found = [] if rows is None else [unit(row) for row in np.atleast_2d(rows)]
        return np.reshape(found, (-1, 3))

    def joint(self, name: str, path: str) -> Joint:
        """Make the joint of the graph."""
        rub = self.friction or FrictionSpec()
        rotor = self.rotor_inertia
        if self.drive is not None:
            rotor = self.drive.reflect_inertia(self.slides, f"{path}.drive")
        inner, outer = self.between
        at = np.zeros(3) if self.at is None else self.at
        return Joint(
            name,
            self.type,
            inner,
            outer,
            array(at),
            array(self._unit_axes()),
            self.actuated,
            self.home or 0.0,
            rub.viscous,
            rub.coulomb,
            rotor,
            pitch=0.0 if self.lead is None else self.lead / TURN,
        )


@dataclass(frozen=True, eq=False)
class RodSpec:
    """A thin even straight bar with a ball joint at each end: points (m), mass (kg).

    ``swivel``: seen from each body, the rod may tilt by at most this from its home direction, rad.
    """

    between: tuple[str, ...] = schema.words(size=2)
    ends: Array = schema.matrix(2, 3, low=-MAX_PLACE, high=MAX_PLACE, unit="m")
    mass: float = mass(default=0.0)
    section: Tube | None = schema.section(Tube, default=None)
    radius: float | None = length(default=None)
    swivel: float | None = schema.number(above=0.0, high=np.pi, unit="rad", default=None)


@dataclass(frozen=True)
class Source:
    """The path of an entry in the file, its name there, and the index and number of its copies."""

    path: Keys
    name: str
    copy: int = 0
    copies: int = 1
    azimuth: float = 0.0


KINDS: Final[Mapping[str, type]] = {"bodies": BodySpec, "joints": JointSpec, "rods": RodSpec}
"""The three mappings of a graph, and the schemas of their entries."""
PER_COPY_KEYS: Final = (["rotor_inertia"], *(["friction", key] for key in list_friction_keys()))
"""Keys of a limb's numbers that may be lists, one number per copy."""


def _raw_field() -> Any:
    return schema.mapping(schema.key(lambda _, value: value, ""), default={})


@dataclass(frozen=True, eq=False)
class LimbFile:
    """Bodies, joints and rods at azimuth 0, copied and turned about base z by each azimuth.

    The copies' names get _1, _2 and so on. Each copy has its own copies of the section's bodies; all
    copies have the other bodies in common.
    """

    azimuths: Array = schema.vector(0, unit="rad")
    bodies: Mapping[str, Any] = _raw_field()
    joints: Mapping[str, Any] = _raw_field()
    rods: Mapping[str, Any] = _raw_field()

    def verify(self, path: str) -> None:
        """Check that azimuths are in rad."""
        for i, azimuth in enumerate(self.azimuths.tolist()):
            check_angles(azimuth, f"{path}.azimuths[{i}]")


@dataclass(frozen=True, eq=False)
class Limb:
    """A limb of a file: its azimuths, the keys of its section, and the names of each entry's copies."""

    place: Keys
    azimuths: Array
    entries: Mapping[str, Mapping[str, Sequence[Any]]]


def read_limbs(field: str, value: Any) -> list[Limb]:
    """Read and check one section of a limb or a list of them."""
    listed = isinstance(value, list)
    limbs = []
    for k, section in enumerate(value if listed else [value] if value else []):
        place = (field, k) if listed else (field,)
        path = join_path(place)
        limb = schema.build(LimbFile, section, path)
        entries: dict[str, Any] = {
            kind: {
                name: [
                    schema.build(spec, one, f"{path}.{kind}.{name}")
                    for one in _copy_entry(entry, len(limb.azimuths), f"{path}.{kind}.{name}")
                ]
                for name, entry in getattr(limb, kind).items()
            }
            for kind, spec in KINDS.items()
        }
        limbs.append(Limb(place, limb.azimuths, entries))
    return limbs


def expand_limbs(
    kinds: Mapping[str, Mapping[str, Any]], limbs: Sequence[Limb]
) -> tuple[dict[str, dict[str, Any]], dict[tuple[str, str], Source]]:
    """Return all entries by kind and name, with the rotated copies of limbs, and the source of each."""
    result = {kind: dict(entries) for kind, entries in kinds.items()}
    sources = {(kind, n): Source((kind, n), n) for kind, all_ in result.items() for n in all_}
    for limb in limbs:
        own = set(limb.entries["bodies"])
        rows = [
            (number, azimuth, kind, name, copies[number])
            for number, azimuth in enumerate(limb.azimuths.tolist())
            for kind, entries in limb.entries.items()
            for name, copies in entries.items()
        ]
        for number, azimuth, kind, name, entry in rows:
            full, place = f"{name}_{number + 1}", (*limb.place, kind, name)
            if full in result[kind]:
                where = join_path(sources[kind, full].path)
                raise ParameterError(
                    join_path(place),
                    full,
                    f"a name of its own for each copy: {full} stands for "
                    f"{where} already, so rename one of the two, for example {name}_b",
                )
            result[kind][full] = _rotate_entry(entry, azimuth, own, number + 1)
            sources[kind, full] = Source(place, name, number, len(limb.azimuths), azimuth)
    return result, sources


def _copy_entry(entry: Any, count: int, path: str) -> list[Any]:
    """Return a limb's entry for each copy; numbers of drives may be lists, one number per copy."""
    result = [entry] * count
    if not isinstance(entry, Mapping):
        return result
    for keys in PER_COPY_KEYS:
        value: Any = entry
        for key in keys:
            value = value.get(key) if isinstance(value, Mapping) else None
        if not isinstance(value, list):
            continue
        if len(value) != count:
            raise ParameterError(f"{path}.{'.'.join(keys)}", value, f"one number, or {count}, one per copy")
        for k in range(count):
            one = value[k]
            one = ExpressionText.from_text(one, one.book, f"[{k}]") if isinstance(one, ExpressionText) else one
            inner = {keys[-1]: one}
            whole = inner if len(keys) == 1 else {keys[0]: {**result[k][keys[0]], **inner}}
            result[k] = {**result[k], **whole}
    return result


def _rotate_entry(entry: Any, azimuth: Any, own: set[str], number: int) -> Any:
    """Rotate a copy of a limb's entry about base z, and number the names of its own bodies."""
    rotation = rotation_about_z(azimuth)
    vectors = {key: getattr(entry, key, None) for key in ("com", "at", "axis", "axes", "ends")}
    new: dict[str, Any] = {key: array(value @ rotation.T) for key, value in vectors.items() if value is not None}
    if isinstance(entry, BodySpec):
        new["inertia"] = array(rotation @ entry.inertia @ rotation.T)
        m = entry.member
        if m is not None:
            new["member"] = dataclasses.replace(m, start=array(rotation @ m.start), end=array(rotation @ m.end))
    else:
        new["between"] = tuple(f"{b}_{number}" if b in own else b for b in entry.between)
        limits = getattr(entry, "limits", None)
        if limits is not None and limits.axis is not None:
            new["limits"] = dataclasses.replace(limits, axis=array(rotation @ limits.axis))
    return dataclasses.replace(entry, **new)


def replace_entry_numbers(entry: T, values: Mapping[Keys, Any], azimuth: float, path: str) -> T:
    """Return an entry with other numbers or expressions, without checks.

    :param values: new numbers by their keys in the entry; ``azimuth`` alone: a new azimuth of the limb.
    :param azimuth: rotation of the entry's vectors; the new numbers are those before the rotation.
    :param path: of the entry, for the error.
    """
    if ("azimuth",) in values:
        turned: T = _rotate_entry(entry, values["azimuth",] - azimuth, set(), 0)
        return turned
    entry = _add_implied_zeros(entry, values)
    if azimuth:
        made = replace_numbers(_rotate_entry(entry, -azimuth, set(), 0), values, path)
        back, whole = _rotate_entry(made, azimuth, set(), 0), copy.copy(entry)
        for key in {str(key) for key, *_ in values}:
            vars(whole)[key] = getattr(back, key)
        made = whole
    else:
        made = replace_numbers(entry, values, path)
    if ("rotor_inertia",) in values:
        vars(made)["drive"] = None
    return made


def find_entry_number(entry: Any, keys: tuple[str | int, ...], azimuth: float, path: str) -> float:
    """Return the number that :func:`replace_entry_numbers` replaces.

    :raises ParameterError: there is no number.
    """
    if keys == ("azimuth",):
        return azimuth
    if azimuth:
        entry = _rotate_entry(entry, -azimuth, set(), 0)
    return find_number(schema.plain(_add_implied_zeros(entry, [keys])), keys, path)


def _add_implied_zeros(entry: T, places: Iterable[Keys]) -> T:
    """Return a joint's entry with the zeros at some keys that a file may leave out."""
    if not isinstance(entry, JointSpec):
        return entry
    zeros: dict[str, Any] = {"home": 0.0}
    zeros |= {"friction": FrictionSpec()} if entry.actuated else {}
    named = {str(key) for key, *_ in places}
    zeros = {k: v for k, v in zeros.items() if k in named and getattr(entry, k) is None}
    return dataclasses.replace(entry, **zeros) if zeros else entry


def build_graph(platform: str, specs: Mapping[str, Mapping[str, Any]], origin: Array | None = None) -> Graph:
    """Return the graph of a file's entries, as :func:`expand_limbs` gives them.

    :param origin: the platform's reference point, default its centre of mass.
    :raises ParameterError: no bodies, or a platform that is none of them.
    """
    bodies = {
        name: Body(name, b.mass, array(np.zeros(3) if b.com is None else b.com), b.inertia)
        for name, b in specs["bodies"].items()
    }
    if not bodies:
        raise ParameterError("bodies", None, "the machine's bodies, by name")
    if platform not in bodies:
        raise UnknownNameError("platform", platform, bodies)
    joints = {n: j.joint(n, f"joints.{n}") for n, j in specs["joints"].items()}
    rods = {n: Rod(n, r.between[0], r.between[1], r.ends, r.mass) for n, r in specs["rods"].items()}
    place = bodies[platform].com if origin is None else array(origin)
    return Graph(bodies, joints, rods, platform, place)


def share_efforts(graph: Graph, leads: Sequence[str], how: Redundancy, effort: Any) -> Graph:
    """Return the graph in which redundant actuated joints follow the leading ones, and share efforts.

    :param effort: limits of all actuated joints, shape (n,); None, or all infinite, for no limits.
    :raises ParameterError: only some joints have limits, or the preload has a wrong length.
    """
    names = graph.actuated
    if len(leads) == len(names):
        if how.preload.size:
            raise ParameterError(
                "redundancy.preload",
                how.preload.tolist(),
                "none where there are no more actuated joints than degrees of freedom",
            )
        return graph
    n = len(names)
    preload: Any = how.preload if how.preload.size else np.zeros(n)
    if len(preload) != n:
        raise ParameterError("redundancy.preload", list(preload), f"{n} efforts, one per joint")
    none = effort is None or np.isinf(references(effort)).all()
    limits: Any = np.ones(n) if none else np.broadcast_to(effort, n)
    for name, limit in zip(names, references(limits), strict=True):
        if not np.isfinite(limit):
            raise ParameterError(
                f"joints.{name}.limits.effort",
                float(limit),
                "a finite limit of every actuated joint, or of none: they share the effort by it",
            )
    joints = {
        name: dataclasses.replace(joint, follows=joint.actuated and name not in leads)
        for name, joint in graph.joints.items()
    }
    sharing = array([how.tolerance, *limits, *preload])
    return dataclasses.replace(graph, joints=joints, sharing=sharing)


def collect_drives(graph: Graph, joints: Mapping[str, JointSpec]) -> dict[str, Any]:
    """Return the friction and limits of the actuated joints."""
    drives = graph.actuated
    limits = [joints[j].limits or LimitSpec() for j in drives]
    rubs = [joints[j].friction or FrictionSpec() for j in drives]
    n = len(drives)
    return {
        "friction": make_friction_schema(n)(
            **{key: array([getattr(rub, key) for rub in rubs]) for key in list_friction_keys()}
        ),
        "limits": make_limits_schema(n)(
            position=_join_values([v.position for v in limits], [-math.inf, math.inf]),
            velocity=_join_values([v.velocity for v in limits], math.inf),
            effort=_join_values([v.effort for v in limits], math.inf),
        ),
    }


def list_drive_numbers(friction: Any, limits: Any, k: int) -> tuple[dict[str, float], dict[str, Any]]:
    """Return friction and limits of the actuated joint k by key, from those of :func:`collect_drives`.

    Infinite limits are left out.
    """
    n = len(friction.viscous)
    found: dict[str, Any] = {}
    for key, shape in (("position", (n, 2)), ("velocity", (n,)), ("effort", (n,))):
        values = getattr(limits, key)
        if values is not None:
            own = np.broadcast_to(values, shape)[k]
            found |= {key: own.tolist()} if np.isfinite(own).any() else {}
    return {key: float(getattr(friction, key)[k]) for key in list_friction_keys()}, found


def set_drive(joint: JointSpec, friction: Any, limits: Any, k: int) -> JointSpec:
    """Return the entry of the actuated joint k with other friction and limits."""
    rub, bounds = list_drive_numbers(friction, limits, k)
    if "position" in bounds:
        bounds["position"] = array(bounds["position"])
    return dataclasses.replace(joint, friction=FrictionSpec(**rub), limits=LimitSpec(**bounds))


def _join_values(values: list[Any], absent: Any) -> Array | None:
    """Return one array of the joints' values; None if no joint has one."""
    known = [absent if value is None else value for value in values]
    return None if all(value is None for value in values) else array(known)
