# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The mechanism ``machine``: a parameter file with the graph of bodies, joints and rods at home.

Every vector stands in base axes at the home pose. ``forward`` gives the assembly that is connected
to home along the straight line in joint space; a singularity on the way is an error that says
where. ``inverse`` goes the straight way in the pose coordinates.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from operator import getitem
from typing import Any, ClassVar, Final, TypeVar

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import reference
from pkm_twin.errors import ParameterError, UnknownNameError, warn_of_file
from pkm_twin.kinematics.pose import COORDINATES, Coordinate, name_angles
from pkm_twin.kinematics.rounding import repair_rounded
from pkm_twin.kinematics.scheme import check_masses, choose_coordinates, choose_leads
from pkm_twin.machine import schema
from pkm_twin.machine.file_parts import find_parts, find_passive_limits
from pkm_twin.machine.formulas import PARAMETERS, Book
from pkm_twin.machine.friction import list_unshareable_laws
from pkm_twin.machine.graph import Graph
from pkm_twin.machine.graph_file import (
    KINDS,
    PER_COPY_KEYS,
    BodySpec,
    JointSpec,
    Limb,
    RodSpec,
    Source,
    build_graph,
    collect_drives,
    expand_limbs,
    find_entry_number,
    read_limbs,
    replace_entry_numbers,
    set_drive,
    share_efforts,
)
from pkm_twin.machine.members import Parts
from pkm_twin.machine.places import (
    Keys,
    check_number,
    drop_missing,
    find_number,
    full_keys,
    has_entry,
    join_path,
    replace_numbers,
    split_path,
)
from pkm_twin.machine.precision import rounding_error
from pkm_twin.machine.reach import PassiveLimit
from pkm_twin.machine.sections import DriveSpec, Redundancy
from pkm_twin.mechanisms import TwinRobot
from pkm_twin.robot.mechanism import Common
from pkm_twin.robot.robot_urdf import robot_description

M = TypeVar("M", bound="Machine")

MAX_JOINTS: Final = 12
"""Largest number of actuated joints of a machine."""
_ELASTIC_KEYS: Final = (("bodies", "member"), ("joints", "compliance"), ("rods", "section"), ("rods", "radius"))
"""Elastic keys, which a graph does not have, by the kind of their entry."""
_GEOMETRY_KEYS: Final = ("at", "axis", "axes", "ends", "azimuths")
"""Keys of places and directions."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MachineFile(Common):
    """Any machine as a graph of bodies, joints and rods, every vector in base axes at home."""

    mechanism: str = schema.choice("machine")
    platform: str = schema.text(default="platform", text="the body that carries the tool")
    origin: Array | None = schema.vector(
        3, unit="m", text="the platform's reference point at home; by default its com", default=None
    )
    angles: tuple[Coordinate, ...] = schema.key(
        lambda _, value: name_angles(value),
        "names to axes",
        text="in place of roll, pitch and yaw, about x, y, z or z, y, x in this order: "
        "`{alpha: x, beta: y}` is R = Rx(alpha) Ry(beta) Rz",
        default=(),
    )
    pose: tuple[str, ...] | None = schema.words(
        text="of x, y, z, roll, pitch, yaw or `angles`, as many as the mobility; default: turns if "
        "they suffice, else the first valid",
        default=None,
    )
    bodies: Mapping[str, BodySpec] = schema.mapping(BodySpec, default={})
    joints: Mapping[str, JointSpec] = schema.mapping(JointSpec, default={})
    rods: Mapping[str, RodSpec] = schema.mapping(RodSpec, default={})
    redundancy: Redundancy = schema.section(Redundancy, default={})
    limbs: Sequence[Limb] = schema.key(read_limbs, "a section or a list of them", default=[])
    parameters: Mapping[str, Any] = schema.key(
        lambda _, value: value,
        "names to numbers or [expressions](new_machine.md#parameters)",
        default={},
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Machine(TwinRobot):
    """A machine that its parameter file describes as a graph."""

    described: Graph
    specs: Mapping[str, Mapping[str, Any]]
    sources: Mapping[tuple[str, str], Source]
    """Where each entry stands in the file, by kind and name."""
    coordinates: tuple[Coordinate, ...]  # type: ignore[misc]
    redundancy: Redundancy = schema.section(Redundancy, default={})

    changeable: ClassVar = (*TwinRobot.changeable, "redundancy")

    @classmethod
    def from_data(cls, data: Mapping[str, Any], name: str) -> Machine:
        """Create a machine from the content of a file, and check both.

        :raises ParameterError: by the field.
        """
        book = Book.of(data)
        file = schema.build(MachineFile, book.mark_expressions(data))
        specs: Mapping[str, Mapping[str, Any]]
        specs, sources = expand_limbs({kind: getattr(file, kind) for kind in KINDS}, file.limbs)
        graph = build_graph(file.platform, specs, file.origin)
        graph.check()
        # Numbers computed from expressions have no rounding to remove.
        if not book.formulas:
            specs = _remove_rounding(data, graph, specs, name)
            graph = build_graph(file.platform, specs, file.origin)
        if len(graph.actuated) > MAX_JOINTS:
            raise ParameterError("joints", len(graph.actuated), f"at most {MAX_JOINTS} actuated joints")
        own = collect_drives(graph, specs["joints"])
        leads = choose_leads(graph, file.redundancy.leads or (), len(file.pose or ()))
        graph = share_efforts(graph, leads, file.redundancy, own["limits"].effort)
        known = dict(COORDINATES)
        if file.angles:
            known = {name: known[name] for name in "xyz"}
            known |= {turn.name: turn for turn in file.angles}
        pose = tuple(file.pose or choose_coordinates(graph))
        for i, word in enumerate(pose):
            if word not in known:
                raise UnknownNameError(f"pose[{i}]", word, known)
        coordinates = tuple(known[word] for word in pose)
        common = {field.name: getattr(file, field.name) for field in dataclasses.fields(Common)}
        robot = cls(
            name=name,
            described=graph,
            specs=specs,
            sources=sources,
            coordinates=coordinates,
            book=book,
            redundancy=file.redundancy,
            **common,
            **own,
        )
        robot = dataclasses.replace(robot, uncertainty=robot.resolve_paths(robot.uncertainty))
        robot.check_laws()
        _ = robot.controller
        robot.engine.check()
        check_masses(robot.engine, robot.graph)
        _ = robot.passive_limits
        _ = robot.uncertainty_changes
        robot.check_stiffness_factors()
        return robot

    def changed(self: M, **sections: Mapping[str, object] | object) -> M:
        """Copy with new values; friction and limits go into the joints' entries too.

        Numbers whose expressions contain changed ``parameters`` follow.
        """
        parameters = sections.pop(PARAMETERS, {})
        if isinstance(parameters, Mapping) and parameters:
            self = self.with_file_values({f"{PARAMETERS}.{name}": v for name, v in parameters.items()})
        made = super().changed(**sections)
        if not sections or not set(sections) <= set(self.changeable):
            return made
        drives = not {"friction", "limits", "redundancy"}.isdisjoint(sections)
        told = {key: schema.plain(getattr(made, key)) for key in sections if not drives}
        made = dataclasses.replace(made, book=made.book.replace_sections(told))
        if not drives:
            return made
        joints = dict(made.specs["joints"])
        for k, name in enumerate(made.joint_names):
            joints[name] = set_drive(joints[name], made.friction, made.limits, k)
        specs = {**made.specs, "joints": joints}
        described = build_graph(made.described.platform, specs, made.described.origin)
        leads = choose_leads(described, made.redundancy.leads or made.described.leads)
        described = share_efforts(described, leads, made.redundancy, made.limits.effort)
        made = dataclasses.replace(made, specs=specs, described=described)
        made.check_laws()
        return made

    def check_laws(self) -> None:
        """Reject friction by the load, or with memory, where drives share the effort.

        :raises ParameterError: by the law.
        """
        if self.redundant and (bad := list_unshareable_laws(self.laws)):
            raise ParameterError(
                "friction",
                bad[0],
                f"a law of position and rate alone: {self.joints_count} actuated joints "
                f"share the effort of {len(self.graph.leads)} degrees of freedom",
            )

    def numbered(self, values: Mapping[str, Any]) -> Machine:
        """Copy the machine with other numbers at paths as ``joints.ball_1.at[0]``.

        A number of a limb (``limbs.joints.ball.at[0]``) is that of all its copies, in the axes of
        azimuth zero; another azimuth rotates its copy.
        """
        book, values = self.book.change_numbers(self.resolve_paths(values))
        sources = dict(self.sources)
        specs = {kind: dict(entries) for kind, entries in self.specs.items()}
        rest, origin = {}, self.described.origin
        # Set a limb entry's numbers in this order: the limb's, its azimuth, the copy's own.
        changes: dict[tuple[str, str, int, str, float], dict[Keys, Any]] = {}
        for path, value in values.items():
            keys = full_keys(path)
            found = list(self.named(keys))
            for kind, name, where, azimuth in found:
                order = 2 if keys[0] == kind else 1 if where == ("azimuth",) else 0
                place = join_path(keys[: len(keys) - len(where)])
                changes.setdefault((kind, name, order, place, azimuth), {})[where] = value
            if not found and keys[0] == "origin":
                origin = replace_numbers({"origin": origin}, {tuple(keys): value})["origin"]
            elif not found:
                rest[path] = value
        for (kind, name, _, place, azimuth), new in sorted(changes.items(), key=lambda c: c[0][2]):
            specs[kind][name] = replace_entry_numbers(specs[kind][name], new, azimuth, place)
            if ("azimuth",) in new:
                turned = reference(new["azimuth",])
                sources[kind, name] = dataclasses.replace(sources[kind, name], azimuth=turned)
        described = build_graph(self.described.platform, specs, origin)
        made = super().numbered(rest)
        own = collect_drives(described, specs["joints"])
        leads, sharing = self.described.leads, made.redundancy
        described = share_efforts(described, leads, sharing, own["limits"].effort)
        return dataclasses.replace(made, described=described, specs=specs, sources=sources, book=book, **own)

    def with_file_values(self, values: Mapping[str, Any]) -> Any:
        """Return the machine of the same file with other numbers, where possible with its expressions."""
        data: Any = copy.deepcopy(self.book.data)
        values = self.resolve_paths(values)
        kept = data and (self.book.values or self.book.formulas)
        if not kept or not all(has_entry(data, path) for path in values):
            return super().with_file_values(values)
        for path, value in values.items():
            *keys, last = split_path(path)
            reduce(getitem, keys, data)[last] = value
        return type(self).from_data(data, self.name)

    def check_number(self, path: str) -> None:
        """Check a number in each of the entries that have it."""
        path = self.canonical_path(path)
        keys = full_keys(path)
        for moved in self.book.list_dependent([str(keys[-1])]) if keys[0] == PARAMETERS else ():
            self.check_number(moved.path)
        named = list(self.named(keys))
        for kind, name, where, _ in named:
            if where != ("azimuth",):
                check_number(self.specs[kind][name], where, path)
        if not named and keys[0] not in ("origin", PARAMETERS):
            super().check_number(path)

    def number(self, path: str) -> float:
        """Return the number at a path; in a limb the number of its first copy."""
        path = self.canonical_path(path)
        keys = full_keys(path)
        if keys[0] == PARAMETERS:
            return find_number(dict(self.book.values), keys[1:], path)
        if keys[0] == "origin":
            return find_number(self.described.origin.tolist(), keys[1:], path)
        for kind, name, where, azimuth in self.named(keys):
            return find_entry_number(self.specs[kind][name], where, azimuth, path)
        return super().number(path)

    def canonical_path(self, path: str) -> str:
        """Convert a drive's path, as ``friction.viscous[0]``, to the path in its joint's entry."""
        section, key, k, *rest = [*split_path(path), "", ""]
        drive = section in ("friction", "limits") and isinstance(k, int)
        if not drive or int(k) >= self.joints_count:
            return path
        return join_path(["joints", self.joint_names[int(k)], section, key, *rest[:-2]])

    def named(self, keys: Sequence[str | int]) -> Iterator[tuple[str, str, Keys, float]]:
        """Yield the entries that keys name: all copies of a limb's entry, with its azimuth."""
        keys = list(keys)
        for (kind, name), source in self.sources.items():
            if keys[:2] == [kind, name]:
                yield kind, name, tuple(keys[2:]), 0.0
            own = len(source.path)
            if source.path[0] != "limbs":
                continue
            if keys[: own - 2] == list(source.path[:-2]) and keys[own - 2 :] == ["azimuths", source.copy]:
                yield kind, name, ("azimuth",), source.azimuth
            if keys[:own] == list(source.path):
                where = keys[own:]
                listed = where[:-1] in PER_COPY_KEYS
                if listed and where.pop() != source.copy:
                    continue
                yield kind, name, tuple(where), source.azimuth

    @property
    def description(self) -> str:
        """Numbers of actuated joints, bodies, joints and rods, and the pose coordinates."""
        g = self.graph
        counts = {"bodies": len(g.bodies), "joints": len(g.joints), "rods": len(g.rods)}
        parts = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
        n, m = len(g.actuated), len(g.leads)
        drives = f"{n} actuated joint{'s' * (n != 1)}"
        if self.redundant:
            drives += f" for {m} degree{'s' * (m != 1)} of freedom"
        return f"{drives}, the platform moves in {', '.join(self.pose_names)}; {parts}"

    @property
    def mobility(self) -> str:
        """Degrees of freedom and the pose coordinates."""
        return f"{self.engine.mobility.freedoms}: {', '.join(self.pose_names)}"

    @property
    def limb_names(self) -> tuple[str, ...]:
        """Names of the actuated joints, each of which drives a limb."""
        return self.graph.actuated

    @property
    def without_home(self) -> frozenset[str]:
        """Joints whose zero position the file does not state."""
        return frozenset(n for n, joint in self.specs["joints"].items() if joint.home is None)

    @property
    def without_point(self) -> frozenset[str]:
        """Joints without ``at``."""
        return frozenset(n for n, joint in self.specs["joints"].items() if joint.at is None)

    @property
    def drives(self) -> tuple[DriveSpec | None, ...]:
        """Rotor and gear of each actuated joint, None where the file does not give them."""
        return tuple(self.specs["joints"][name].drive for name in self.joint_names)

    def make_parts(self) -> Parts:
        """Return the graph that the file describes, and its elastic members and joints."""
        return find_parts(self.described, self.specs)

    def parameter_sections(self) -> dict[str, Any]:
        """Return the machine's sections written out, copies of limbs and elasticity included."""
        return robot_description(self)

    def parameter_units(self) -> dict[str, Any]:
        """Return the units of the sections' numbers; those of joints depend on their types."""
        sections = self.parameter_sections()
        plain = {key: value for key, value in sections.items() if key not in KINDS}
        result = schema.units(MachineFile, plain, {"effort": self.effort_unit})
        turning = {"joint": "rad", "effort": "N m", "rotor": "kg m2"}
        sliding = {"joint": "m", "effort": "N", "rotor": "kg"}
        for kind, spec in KINDS.items():
            result[kind] = {}
            for name, entry in sections.get(kind, {}).items():
                slides = kind == "joints" and self.graph.joints[name].slides
                result[kind][name] = schema.units(spec, entry, sliding if slides else turning)
        return result

    def file_numbers(self) -> dict[str, tuple[float, str]]:
        """List the file's numbers and its parameters, with their units."""
        units = self.parameter_units()

        def find_unit(path: str) -> str:
            keys: Sequence[str | int] = full_keys(path)
            for kind, name, where, _ in self.named(keys):
                keys = [kind, name, *where]
                break
            unit: Any = units
            for key in keys:
                unit = "rad" if key == "azimuth" else unit
                unit = unit.get(key, "") if isinstance(unit, Mapping) else unit
            return unit if isinstance(unit, str) else ""

        known = self.book.units({path: find_unit(path) for path in self.book.formulas})
        own = {f"{PARAMETERS}.{n}": (v, known[n]) for n, v in self.book.values.items()}
        return super().file_numbers() | own

    def friction_key(self, joint: str, what: str) -> Keys:
        """Return the keys of a joint's friction; a limb's joint has a list, one number per copy."""
        source = self.sources["joints", joint]
        tail: Keys = () if source.copies == 1 else (source.copy,)
        return (*source.path, "friction", what, *tail)

    def rotor_key(self, joint: str) -> Keys:
        """Return the keys of a joint's rotor; copies of a limb share them."""
        tail = ["rotor_inertia"] if self.specs["joints"][joint].drive is None else ["drive", "inertia"]
        return (*self.sources["joints", joint].path, *tail)

    def mass_keys(self) -> Iterator[Keys]:
        """Yield the keys of masses, centres and inertias; copies of a limb share them."""
        found: dict[Keys, None] = {}
        for kind, entries in (("bodies", self.graph.bodies), ("rods", self.graph.rods)):
            for name, entry in entries.items():
                path = self.sources[kind, name].path
                if entry.mass > 0.0:
                    found |= dict.fromkeys([(*path, "mass")])
                if entry.mass > 0.0 and kind == "bodies":
                    found |= dict.fromkeys((*path, "com", i) for i in range(3))
                    found |= dict.fromkeys((*path, "inertia", *ij) for ij in np.ndindex(3, 3))
        return iter(found)

    @cached_property
    def passive_limits(self) -> tuple[PassiveLimit, ...]:
        """Limits of positions and swivels of passive joints, and of swivels at both ends of rods."""
        return find_passive_limits(self.graph, self.specs)

    def elastic_entries(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Return members of bodies, sections and radii of rods, compliances of joints, for a file."""
        told: dict[str, dict[str, dict[str, Any]]] = {kind: {} for kind in KINDS}
        for kind, word in _ELASTIC_KEYS:
            for name, spec in self.specs[kind].items():
                value = drop_missing(schema.plain(getattr(spec, word)))
                if value is not None:
                    told[kind].setdefault(name, {})[word] = value
        return {kind: entries for kind, entries in told.items() if entries}

    @cached_property
    def leading_machine(self) -> Machine:
        """The machine with only the leading drives actuated; the others keep friction and rotor.

        :raises ParameterError: a friction law that passive joints do not have.
        """
        if not self.redundant:
            return self
        if self.laws:
            basic = "viscous, coulomb and offset where drives share the effort"
            raise ParameterError("friction", self.laws[0], basic)
        data = dict(self.parameter_sections())
        for key in ("redundancy", "joint_map", "uncertainty", "tolerances"):
            data.pop(key, None)
        data["joints"] = dict(data["joints"])
        for k, name in enumerate(self.joint_names):
            if name in self.graph.leads:
                continue
            spec, joint = self.specs["joints"][name], dict(data["joints"][name])
            for key in ("actuated", "limits", "drive"):
                joint.pop(key, None)
            if spec.drive is not None:
                slides = self.graph.joints[name].slides
                joint["rotor_inertia"] = spec.drive.reflect_inertia(slides, f"joints.{name}.drive")
            # A nonzero friction, since rates are computed only for joints with friction.
            viscous = max(float(self.friction.viscous[k]), 1e-12)
            joint["friction"] = {"viscous": viscous, "coulomb": float(self.friction.coulomb[k])}
            data["joints"][name] = joint
        return type(self).from_data(data, self.name)

    def sharing_entries(self) -> dict[str, Any]:
        """Return the section ``redundancy`` with the leading joints, for a file."""
        if not self.redundant:
            return {}
        own = schema.plain(self.redundancy)
        return {"redundancy": {**own, "leads": list(self.graph.leads)}}

    def passive_entries(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Return limits of passive joints and swivels of rods, for a file."""
        told: dict[str, dict[str, dict[str, Any]]] = {"joints": {}, "rods": {}}
        for limit in self.passive_limits:
            if limit.kind == "rod":
                told["rods"][limit.joint] = {"swivel": limit.high}
            elif limit.kind == "swivel":
                entry = {"swivel": limit.high, "axis": limit.axis.tolist()}
                told["joints"][limit.joint] = {"limits": entry}
            else:
                told["joints"][limit.joint] = {"limits": {"position": [limit.low, limit.high]}}
        return told


def _remove_rounding(
    data: Any, graph: Graph, specs: Mapping[str, Mapping[str, Any]], name: str
) -> Mapping[str, Mapping[str, Any]]:
    """Return the file's entries with vectors corrected for the rounding of their digits.

    Warns by how much vectors were moved. Entries that no small change repairs stay as they are.
    """

    def list_numbers(part: Any, inside: bool = False) -> Iterator[str]:
        """Yield the numbers of points and directions in a file's data, as text."""
        if isinstance(part, Mapping):
            for key, one in part.items():
                yield from list_numbers(one, inside or key in _GEOMETRY_KEYS)
        elif isinstance(part, (list, tuple)):
            for one in part:
                yield from list_numbers(one, inside)
        elif inside and isinstance(part, float):
            yield repr(part)

    parts = [data.get(key) for key in ("joints", "rods", "limbs")]
    repaired = repair_rounded(graph, rounding_error(word for part in parts for word in list_numbers(part)))
    if repaired is None or not repaired.moves:
        return specs
    warn_of_file(name, repaired.text)
    found = {kind: dict(entries) for kind, entries in specs.items()}
    for key, joint in repaired.graph.joints.items():
        spec = found["joints"][key]
        own: dict[str, Any] = {} if spec.at is None else {"at": joint.at}
        own |= {} if spec.axis is None else {"axis": joint.axes[0]}
        own |= {} if spec.axes is None else {"axes": joint.axes}
        found["joints"][key] = dataclasses.replace(spec, **own)
    for key, rod in repaired.graph.rods.items():
        found["rods"][key] = dataclasses.replace(found["rods"][key], ends=rod.ends)
    return found
