# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Describe a robot by its file: parameters, the graph that follows from them, names and units.

A mechanism is a schema and a function from its parameters to :class:`Parts`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Final, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import reference
from pkm_twin.errors import ParameterError, UnknownNameError, unknown_number_error
from pkm_twin.kinematics.pose import Coordinate
from pkm_twin.kinematics.scheme import ClosedFormStart
from pkm_twin.machine import schema
from pkm_twin.machine.formulas import Book
from pkm_twin.machine.friction import find_law_names, select_compiled_laws
from pkm_twin.machine.graph import Graph, number_limbs
from pkm_twin.machine.inertia import Coefficients
from pkm_twin.machine.joint_map import JointMap, JointMapEntry
from pkm_twin.machine.members import Beam, Parts, Structure
from pkm_twin.machine.places import (
    Key,
    Keys,
    check_number,
    drop_missing,
    find_number,
    full_keys,
    list_file_numbers,
    merge_data,
    replace_numbers,
)
from pkm_twin.machine.pose_grid import PoseGrid
from pkm_twin.machine.reach import PassiveLimit, position_box
from pkm_twin.machine.sections import DriveSpec, JointLimits, Payload, make_friction_schema, make_limits_schema
from pkm_twin.machine.uncertainty import Tolerance, UncertaintyEntry, list_causes
from pkm_twin.machine.urdf_file import Visual
from pkm_twin.settings import map_parameters

EFFORT_SHARING_NOTE: Final = "a controller may share efforts in any way"
"""Why measured efforts of a redundantly actuated machine have no unique cause: internal loads may be superposed."""
DEFAULT_GRAVITY: Final = (0.0, 0.0, -9.81)
"""Gravity of files without one, base axes, m/s2."""
R = TypeVar("R", bound="Mechanism")


@dataclass(frozen=True, eq=False, kw_only=True)
class Common:
    """Keys of every robot file."""

    mechanism: str
    payload: Payload = schema.section(Payload, default={})
    gravity: Array = schema.vector(3, unit="m/s2", text="free fall, base axes", default=list(DEFAULT_GRAVITY))
    joint_map: Mapping[str, JointMapEntry] = schema.mapping(JointMapEntry, default={})
    uncertainty: Mapping[str, UncertaintyEntry] = schema.mapping(UncertaintyEntry, default={})
    tolerances: Mapping[str, Tolerance] = schema.mapping(Tolerance, default={})
    element_compliance: Mapping[str, float] = schema.mapping(
        schema.number(low=1e-6, high=1e6),
        default={},
        text="factors on the compliance of elements, named as in `shares` of `compliance`; else 1",
    )
    modal_damping: Array = schema.vector(
        0,
        above=0.0,
        high=0.99,
        default=[],
        text="damping ratios of modes from the lowest, for `frf`, `lobes`; the last: all higher",
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Mechanism(Common):
    """The description of a machine with n actuated joints and m pose coordinates by its file.

    Frozen; :meth:`changed` gives a copy with other parameters.
    """

    name: str = ""
    """The name by which the robot was loaded."""
    home_choice: str = ""
    """How the home was chosen, if the file leaves it open."""
    visuals: tuple[Visual, ...] = ()
    """Meshes of a URDF's links."""
    friction: Coefficients = schema.section(make_friction_schema(3), default={})
    limits: JointLimits = schema.section(
        make_limits_schema(3), text="nodes and commands reject values beyond, or warn", default={}
    )
    drive: DriveSpec | None = schema.section(
        DriveSpec, text="of every actuated joint, in place of `inertia.rotor_inertia`", default=None
    )
    home_joint: Any = None
    """Value of every actuated joint at home, if the mechanism chooses it; copies keep it, so that other
    limits do not move the home."""
    book: Book = dataclasses.field(default_factory=Book)
    """The file's parameters, and its expressions."""
    open_laws: tuple[str, ...] = ()
    """Friction laws that a fit may find, although their parameters in the file are zero."""

    coordinates: ClassVar[tuple[Coordinate, ...]]
    layout: ClassVar[PoseGrid | None] = None
    """The poses of a workspace map about the machine's axis; None: along the pose coordinates."""
    limit_key: ClassVar[str] = "limits.position"
    """Path of the actuated joints' limits in the file."""
    start: ClassVar[ClosedFormStart | None] = None
    """A closed form of the forward kinematics that does not follow from the graph."""
    changeable: ClassVar[tuple[str, ...]] = (
        "payload",
        "friction",
        "gravity",
        "limits",
        "element_compliance",
        "modal_damping",
    )

    @classmethod
    def from_data(cls: type[R], data: Mapping[str, Any], name: str) -> R:
        """Make a robot from a parameter file's data.

        :raises ParameterError: an invalid value; the error names its field.
        """
        robot = schema.build(cls, data)
        robot = dataclasses.replace(robot, name=name, home_joint=robot.chosen_home())
        _ = robot.controller
        _ = robot.uncertainty_changes
        robot.check_stiffness_factors()
        return robot

    @property
    def description(self) -> str:
        """The kind of machine, in words."""
        raise NotImplementedError

    @property
    def mobility(self) -> str:
        """Number and kind of the platform's degrees of freedom, in words."""
        raise NotImplementedError

    @property
    def size(self) -> float:
        """Greatest distance of a joint on the platform from its reference point, m.

        It converts angles to lengths.
        """
        return float(self.graph.platform_radius)

    @property
    def limb_names(self) -> tuple[str, ...]:
        """Names of the limbs, one per actuated joint."""
        raise NotImplementedError

    def name_limb(self, part: str) -> str:
        """Return the limb of a joint, rod or body, or the part itself if limbs have no names."""
        if self.limb_names == self.joint_names:
            return part
        ends = self.graph.rods.get(part) or self.graph.joints.get(part)
        bodies = (part,) if ends is None else (ends.inner, ends.outer)
        numbers = number_limbs(self.graph)
        found = (numbers[body] for body in bodies if numbers.get(body, -1) >= 0)
        limb = next(found, None)
        return part if limb is None else self.limb_names[limb]

    def chosen_home(self) -> float | None:
        """Choose the value of every actuated joint at home if the file does not state it.

        It is the middle of the range common to the limits of all joints, if the mechanism can be
        assembled there; else the mechanism's own choice.
        """
        return None

    def make_parts(self) -> Parts:
        """Return the graph at home, and what of it is elastic, by the file's parameters."""
        raise NotImplementedError

    @cached_property
    def parts(self) -> Parts:
        """The graph at home, and what of it is elastic."""
        return self.make_parts()

    @cached_property
    def graph(self) -> Graph:
        """Bodies, joints and rods at home."""
        return self.parts.graph

    @cached_property
    def beams(self) -> tuple[Beam, ...]:
        """The bars for limb interference and elasticity; empty if they are unknown."""
        return self.parts.beams

    def limit_angles(self, pose: ArrayLike) -> Array | None:
        """Return the angles that ``limits.joint_angle`` bounds, shape (..., k), rad; None without any."""
        return None

    def limb_wrenches(self, pose: ArrayLike) -> Array | None:
        """Return unit wrenches that each limb can apply, (..., limbs, 6, k), or None if not known.

        Elastic elements are then in the order of the limbs, as many in each.
        """
        return None

    @property
    def passive_limits(self) -> tuple[PassiveLimit, ...]:
        """Ranges of passive joints that bound the workspace, if the file states any."""
        return ()

    def passive_entries(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Return the passive limits of joints and rods as plain data, by kind and name."""
        return {}

    def structure(self) -> Structure:
        """Return the elastic beams and joints.

        :raises RigidError: the robot's file makes nothing elastic.
        :raises ParameterError: its elastic sections are incomplete or contradict its masses.
        """
        return self.parts.structure()

    def elastic_entries(self) -> dict[str, dict[str, dict[str, Any]]]:
        """Return the elastic entries of bodies, joints and rods as plain data, by kind and name.

        They are empty if the file states elasticity in other keys.
        """
        return {}

    def sharing_entries(self) -> dict[str, Any]:
        """Return how redundant drives share the effort, as entries of a file; empty without redundancy."""
        return {}

    @property
    def without_home(self) -> frozenset[str]:
        """Joints whose zero the file should state and does not."""
        return frozenset()

    @property
    def without_point(self) -> frozenset[str]:
        """Joints without a point of their own in the file."""
        return frozenset()

    def named(self, keys: Sequence[Key]) -> Iterator[tuple[str, str, Keys, float]]:
        """Yield kind, name, keys and azimuth of each entry of the graph that a path's keys name.

        The entry's vectors are rotated about base z by the azimuth of its limb.
        """
        kind, name, *where = [*keys, "", ""][: max(2, len(keys))]
        if kind in ("bodies", "joints", "rods") and name in getattr(self.graph, str(kind)):
            yield str(kind), str(name), tuple(where), 0.0

    @property
    def drives(self) -> tuple[DriveSpec | None, ...]:
        """Rotor and gear of each actuated joint, None if the file does not state them."""
        return (self.drive,) * self.joints_count

    def default_inertia(self) -> dict[str, Any]:
        """Return the value of every key of ``inertia`` that follows from others if left out."""
        return {}

    @property
    def with_default_inertia(self: R) -> R:
        """The robot with every inertia that its file may leave out."""
        own: Any = getattr(self, "inertia", None)
        usual = {} if own is None else self.default_inertia()
        left = {key: value for key, value in usual.items() if getattr(own, key) is None}
        return self._replace_fields(inertia=dataclasses.replace(own, **left)) if left else self

    def mass_keys(self) -> Iterator[Keys]:
        """Yield the keys of masses, centres and inertias in the file of a :attr:`with_default_inertia` robot."""
        for name, value in self.parameter_sections()["inertia"].items():
            if name != "rotor_inertia":
                yield from (("inertia", name, *index) for index in np.ndindex(np.shape(value)))

    def friction_key(self, joint: str, what: str) -> Keys:
        """Return the keys of a joint's friction in the file."""
        return ("friction", what, self.joint_names.index(joint))

    def rotor_key(self, joint: str) -> Keys:
        """Return the keys of a joint's rotor in the file."""
        return ("inertia", "rotor_inertia") if self.drive is None else ("drive", "inertia")

    def reflect_rotor(self, given: float, slides: bool) -> float:
        """Return the rotor inertia at the joints, kg m2 or kg: of the file's ``drive``, or as given.

        :raises ParameterError: both are given, or a gear for another type of joint.
        """
        if self.drive is None:
            return given
        if given:
            bound = "no value, fixed or varied, because the section drive has the rotor: drive.inertia"
            raise ParameterError("inertia.rotor_inertia", reference(given), bound)
        return self.drive.reflect_inertia(slides, "drive")

    @cached_property
    def laws(self) -> tuple[str, ...]:
        """Friction laws of the drives in addition to the basic one, see ``machine.friction``."""
        return find_law_names(self.friction, self.open_laws)

    def with_friction_laws(self, graph: Graph) -> Graph:
        """Return a graph with the robot's friction laws, for programs that compute efforts."""
        laws = select_compiled_laws(self.laws)
        return dataclasses.replace(graph, laws=laws) if laws else graph

    @cached_property
    def uncertainty_changes(self) -> Mapping[str, Mapping[str, float]]:
        """Changes of the file's numbers, by path, by one standard deviation of each uncertainty."""
        return list_causes(self.uncertainty, self.file_numbers())

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for a copy in another process, without derived values."""
        derived = {
            name
            for part in type(self).__mro__
            for name, value in vars(part).items()
            if isinstance(value, cached_property)
        }
        return {name: value for name, value in vars(self).items() if name not in derived}

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the actuated joints, in the order of q."""
        return self.graph.actuated

    @cached_property
    def joint_units(self) -> tuple[str, ...]:
        """Units of q, ``rad`` or ``m``."""
        graph = self.graph
        return tuple("m" if graph.joints[name].slides else "rad" for name in graph.actuated)

    @property
    def effort_units(self) -> tuple[str, ...]:
        """Units of the efforts, ``N m`` or ``N``."""
        return tuple("N" if unit == "m" else "N m" for unit in self.joint_units)

    @property
    def joint_unit(self) -> str:
        """Unit of q if all joints have the same, else ``rad or m``."""
        return _join_units(self.joint_units)

    @property
    def effort_unit(self) -> str:
        """Unit of the efforts if all joints have the same, else ``N m or N``."""
        return _join_units(self.effort_units)

    def parameter_sections(self) -> dict[str, Any]:
        """Return the parameters by section, as plain data."""
        return {name: schema.plain(getattr(self, name)) for name in map_parameters(type(self))}

    def parameter_units(self) -> dict[str, Any]:
        """Return the units of the parameters by section; empty for a parameter without unit."""
        words = {"joint": self.joint_unit, "effort": self.effort_unit}
        return schema.units(type(self), self.parameter_sections(), words)

    def file_numbers(self) -> dict[str, tuple[float, str]]:
        """List every number of the file, by dotted path, with its unit.

        With a ``drive``, ``inertia.rotor_inertia`` is left out, because only 0 is valid.
        """
        found = list_file_numbers(self.parameter_sections(), self.parameter_units())
        if self.drive is not None:
            found.pop("inertia.rotor_inertia", None)
        return found

    @cached_property
    def controller(self) -> JointMap:
        """The conversion between the joints of the controller and of the model.

        :raises ParameterError: ``joint_map`` names an unknown joint.
        """
        return JointMap.of(self.joint_names, self.joint_map)

    @cached_property
    def elastic(self) -> Structure:
        """Elastic beams and joints with the elements' factors; errors as in :meth:`structure`."""
        return self.structure().scaled(self.element_compliance)

    @property
    def element_names(self) -> tuple[str, ...]:
        """Valid names in ``element_compliance``, bars first; errors as in :meth:`structure`.

        Results of energies and factors have their own order, in their attribute ``elements``.
        """
        return self.structure().elements

    def check_stiffness_factors(self) -> None:
        """Reject stiffness factors for names that are not elastic elements of this robot.

        :raises ParameterError: a name is unknown, or the robot has no elastic elements.
        """
        for name in self.element_compliance:
            if name not in self.element_names:
                raise UnknownNameError(f"element_compliance.{name}", name, self.element_names)

    @cached_property
    def joints_count(self) -> int:
        """Number n of actuated joints."""
        return len(self.joint_names)

    @property
    def redundant(self) -> bool:
        """True if there are more actuated joints than degrees of freedom."""
        return len(self.graph.leads) < self.joints_count

    @property
    def leading_machine(self: R) -> R:
        """The machine in which only the leading drives are actuated; the others are passive joints."""
        return self

    def check_independent(self, what: str, why: str = "they are not defined for more") -> None:
        """Reject a computation that needs as many actuated joints as degrees of freedom.

        :param what: name of the results, in the plural; ``why``: the reason.
        :raises ParameterError: there are more actuated joints.
        """
        if self.redundant:
            raise ParameterError(
                "joints",
                self.joints_count,
                f"{len(self.graph.leads)} actuated joints, the degrees of freedom, for {what}: "
                f"{why}; leave out `actuated` of "
                f"{', '.join(n for n in self.joint_names if n not in self.graph.leads)}",
            )

    @property
    def pose_names(self) -> tuple[str, ...]:
        """Names of the pose coordinates."""
        return tuple(c.name for c in self.coordinates)

    @property
    def pose_units(self) -> tuple[str, ...]:
        """Units of the pose coordinates, ``m`` or ``rad``."""
        return tuple(c.unit for c in self.coordinates)

    @property
    def body_names(self) -> tuple[str, ...]:
        """Names of bodies and rods, and the payload last."""
        return (*self.graph.bodies, *self.graph.rods, "payload")

    def numbered(self: R, values: Mapping[str, Any]) -> R:
        """Copy the robot with other numbers or expressions at dotted paths, without checks.

        :raises ParameterError: an unknown path.
        """
        values = self.resolve_paths(values)
        made = replace_numbers(self, {tuple(full_keys(path)): value for path, value in values.items()})
        return self._replace_fields(**{f.name: getattr(made, f.name) for f in dataclasses.fields(self)})

    def canonical_path(self, path: str) -> str:
        """Return the canonical path of a number that several paths of the robot file name."""
        return path

    def resolve_paths(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Replace each path of a number by its canonical path, see :meth:`canonical_path`.

        :raises ParameterError: two paths name the same number.
        """
        found: dict[str, Any] = {}
        told: dict[Keys, str] = {}
        for path, value in values.items():
            own = self.canonical_path(path)
            first = told.setdefault(tuple(full_keys(own)), path)
            if first != path:
                raise ParameterError("path", path, f"each number once; {first} is the same")
            found[own] = value
        return found

    def number(self, path: str) -> float:
        """Return the number at a dotted path of the robot's file, as in :meth:`numbered`.

        :raises ParameterError: an unknown path.
        """
        keys = full_keys(path)
        if not keys or keys[0] not in map_parameters(type(self)):
            raise unknown_number_error(path, self.file_numbers())
        return find_number(schema.plain(getattr(self, str(keys[0]))), keys[1:], path)

    def with_file_values(self: R, values: Mapping[str, Any]) -> R:
        """Return the robot of the same file with other numbers at dotted paths.

        :raises ParameterError: an unknown path, or a value that the file may not have.
        """
        data = drop_missing(self.numbered(values).parameter_sections())
        return type(self).from_data(data, self.name)

    def check_number(self, path: str) -> None:
        """Check a number of :meth:`numbered` like a number of a file.

        :raises ParameterError: the number is invalid; the error names the path.
        """
        check_number(self, full_keys(path), path)

    def _replace_fields(self: R, **values: Any) -> R:
        """Copy the robot with other fields or derived values, without checks."""
        made = object.__new__(type(self))
        vars(made).update(self.__getstate__() | values)
        return made

    @cached_property
    def pose_scales(self) -> Array:
        """Factors that convert pose coordinates to lengths, shape (m,): 1, or the platform's radius."""
        return np.array([1.0 if unit == "m" else self.size for unit in self.pose_units])

    def grid(self) -> PoseGrid:
        """Return the grid of poses of a workspace map; a box for a machine without an axis."""
        return self.layout or PoseGrid("box", self.pose_names)

    def search_box(self) -> Array:
        """Return a box that contains all poses of the workspace, shape (m, 2), m and rad.

        :raises ParameterError: a limit that would bound the workspace is missing.
        """
        paths = [self.canonical_path(f"{self.limit_key}[{k}]").removesuffix(f"[{k}]") for k in range(self.joints_count)]
        place = position_box(self.graph, self.limits.position, self.passive_limits, paths)
        rows = []
        for c in self.coordinates:
            # Tilts about an axis are below a right angle.
            whole = len(c.entries) == 2 and self.layout is None
            far = np.pi if whole else np.pi / 2
            rows.append(np.array([-far, far]) if c.axis is None else place[c.axis])
        return np.array(rows)

    def changed(self: R, **sections: Mapping[str, object] | object) -> R:
        """Copy the robot with new values: ``payload={"mass": 0.2}, geometry={"arm_length": 0.3}``.

        All values are checked as in a file; one invalid value rejects all. A change of geometry,
        masses or members is like a new file: the home is chosen again.

        :raises ParameterError: a value out of range, or an impossible machine.
        """
        if not set(sections) <= set(self.changeable):
            known = self.parameter_sections()
            for key in sections:
                if key not in known and key not in map_parameters(Common):
                    raise UnknownNameError(key, key, known)
            return type(self).from_data(merge_data(drop_missing(known), sections), self.name)
        new: dict[str, Any] = {}
        for key, value in sections.items():
            old = getattr(self, key)
            if isinstance(value, Mapping) and not isinstance(old, Mapping):
                new[key] = schema.build(type(old), {**drop_missing(schema.plain(old)), **value}, key)
            else:
                new[key] = map_parameters(type(self))[key][1].check(key, value)
        made = dataclasses.replace(self, **new)
        made.check_stiffness_factors()
        return made


def _join_units(units: Sequence[str]) -> str:
    """Return the distinct units joined by "or", such as "rad or m"."""
    return " or ".join(sorted(set(units), reverse=True))
