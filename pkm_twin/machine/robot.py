# SPDX-License-Identifier: Apache-2.0
"""What every robot has: a parameter file, and kinematics by the engine.

A mechanism is a schema, a function from its parameters to a graph, and, where they exist, closed
forms of the start and of the inverse with the branch rules.

May import: numpy, pkm_twin's machine, kinematics and codegen, the standard library.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar, Final, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.codegen.expressions import Numbers, Objects
from pkm_twin.codegen.kernels import NOT_FINITE, Kernel
from pkm_twin.codegen.program import Program
from pkm_twin.errors import ParameterError, SingularityError, UnknownNameError, UnreachableError
from pkm_twin.kinematics.engine import Closed, Engine, Traced, engine_of
from pkm_twin.kinematics.motion import Motion
from pkm_twin.kinematics.passive import (
    passive_names,
    passive_program,
    passive_rates_program,
)
from pkm_twin.kinematics.pose import Coordinate
from pkm_twin.kinematics.singularity import singularity_kernel
from pkm_twin.machine import schema
from pkm_twin.machine.entries import check_number, full_keys, given, merged, number_in, placed
from pkm_twin.machine.graph import Graph
from pkm_twin.machine.inertia import Coefficients, Layout
from pkm_twin.machine.joint_map import JointMap, JointMapEntry
from pkm_twin.machine.members import Beam, Structure
from pkm_twin.machine.pose_grid import PoseGrid
from pkm_twin.machine.reach import position_box
from pkm_twin.machine.sections import DriveSpec, JointLimits, Payload, friction_of, limits_of
from pkm_twin.machine.shared import (
    Shared,
    behind_gear,
    drive_units,
    shared_number,
    shared_payload,
)
from pkm_twin.machine.uncertainty import (
    Factor,
    UncertaintyEntry,
    causes_of,
    check_uncertainty,
    factors_of,
)

if TYPE_CHECKING:
    from delta_dynamics.loop import TorqueLoop
    from pkm_twin.kinematics.passive_limits import PassiveLimit

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
R = TypeVar("R", bound="Robot")

SINGULARITY_BOUND: Final = 1e-9
"""Least singularity index (0 singular, 1 best) at which a Jacobian is inverted."""
SAME_POSE: Final = 1e-7
"""Largest difference of two poses that are one: rounding of the two solutions, of unit one. Another
assembly is farther away unless a singularity is nearer than that."""
BEYOND: Final = 3.0
"""Code of a pose beyond a singularity, after those of programs."""

_NONE: Final = np.zeros(0)

Run = Callable[..., tuple[list[Array], Array | None]]


def _alone(kernel: Kernel, *inputs: ArrayLike) -> tuple[list[Array], Array | None]:
    return kernel(_NONE, *inputs)


@dataclass(frozen=True)
class Inverse:
    """A mechanism's closed form of q by pose, as expressions.

    ``q``: shape (n,), finite for every finite pose. ``misses``: by how much each limb falls short,
    m, above zero where it does. ``measure``: the singularity's, above SINGULARITY_BOUND on the side
    of the home pose; None where every pose that is reached is good.
    """

    q: Sequence[Any]
    misses: Sequence[Any]
    measure: Any | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Robot:
    """A parallel kinematic machine of n actuated joints and m pose coordinates.

    Frozen; :meth:`changed` gives a copy with other parameters.
    """

    mechanism: str
    name: str = ""
    """The name that the robot was loaded by."""
    home_choice: str = ""
    """How the home was chosen, of a file that leaves it open."""
    payload: Payload = schema.section(Payload, default={})
    friction: Coefficients = schema.section(friction_of(3), default={})
    gravity: Array = schema.vector(3, unit="m/s2", default=[0, 0, -9.81])
    limits: JointLimits = schema.section(limits_of(3), default={})
    drive: DriveSpec | None = schema.section(DriveSpec, default=None)
    """Rotor and gear of every actuated joint, in place of ``inertia.rotor_inertia``."""
    joint_map: Mapping[str, JointMapEntry] = schema.mapping(JointMapEntry, default={})
    uncertainty: Mapping[str, UncertaintyEntry] = schema.mapping(UncertaintyEntry, default={})
    element_compliance: Mapping[str, float] = schema.numbers(at_least=1e-6, at_most=1e6, default={})
    """Factors on the compliance of elastic elements, by name; 1 where left out."""
    home_joint: float | None = None
    """Value of every actuated joint at home, where a mechanism chooses it: kept by copies, so that
    other limits do not move the home."""

    coordinates: ClassVar[tuple[Coordinate, ...]]
    changeable: ClassVar[tuple[str, ...]] = (
        "payload", "friction", "gravity", "limits", "element_compliance",
    )  # fmt: skip
    has_start: ClassVar[bool] = False
    has_inverse: ClassVar[bool] = False
    has_branch: ClassVar[bool] = False

    @classmethod
    def from_data(cls: type[R], data: Mapping[str, Any], name: str) -> R:
        """A robot of a parameter file's data.

        :raises ParameterError: by the field.
        """
        robot = schema.build(cls, data)
        robot = dataclasses.replace(robot, name=name, home_joint=robot.chosen_home())
        _ = robot.controller
        check_uncertainty(robot)
        robot.check_elements()
        return robot

    @classmethod
    def graph_of(cls, data: Mapping[str, Any]) -> Graph:
        """The graph of a parameter file's data, without the checks of a whole robot.

        :raises ParameterError: by the field.
        """
        return schema.build(cls, data).graph

    # What a mechanism gives.

    @property
    def description(self) -> str:
        """What machine it is, in words."""
        raise NotImplementedError

    @property
    def mobility(self) -> str:
        """Number and kind of the platform's freedoms, in words."""
        raise NotImplementedError

    @property
    def size(self) -> float:
        """The platform's radius, m: what makes a length of an angle of it."""
        raise NotImplementedError

    @property
    def limb_names(self) -> tuple[str, ...]:
        """Names of the limbs, one an actuated joint."""
        raise NotImplementedError

    def chosen_home(self) -> float | None:
        """Value of every actuated joint at home, of a mechanism whose file does not give it.

        The middle of the range that the limits of all joints share, where the mechanism can be
        assembled there; else the mechanism's own choice.
        """
        return None

    def make_graph(self) -> Graph:
        """Bodies, joints and rods at home."""
        raise NotImplementedError

    def start(self, q: Objects) -> Mapping[str, Sequence[Any]]:
        """Values of passive tree joints by q in closed form, where ``has_start``.

        By joint, from its inner to its outer body, beside those at home.
        """
        raise NotImplementedError

    def solved(self, pose: Objects) -> Inverse:
        """Closed form of the inverse, where ``has_inverse``."""
        raise NotImplementedError

    def branch(self, motion: Motion) -> Sequence[Any]:
        """Numbers that are above zero in the branch of ``forward``, where ``has_branch``."""
        raise NotImplementedError

    def unreachable_limb(self, q: Array, reached: float) -> tuple[int, float] | None:
        """Limb and miss (m) of joint positions without an assembly, shape (n,); None: unknown.

        :param reached: part of the straight way from home up to which there is one.
        """
        del q, reached
        return None

    @cached_property
    def beams(self) -> tuple[Beam, ...]:
        """The bars that limb interference and elasticity are about; none: not known."""
        return ()

    def limit_angles(self, pose: ArrayLike) -> Array | None:
        """Angles that ``limits.joint_angle`` bounds, shape (..., k), rad; None where it is none."""
        del pose
        return None

    @property
    def passive_limits(self) -> tuple[PassiveLimit, ...]:
        """Ranges of passive joints that bound the workspace; none: the file states none."""
        return ()

    def passive_entries(self) -> dict[str, dict[str, dict[str, Any]]]:
        """What its file tells of these at joints and rods: plain data, by kind and name."""
        return {}

    def structure(self) -> Structure:
        """Elastic beams and joints.

        :raises ParameterError: the robot's file lacks a section that elasticity needs.
        """
        raise ParameterError("members", None, "a section with the elastic members")

    def elastic_entries(self) -> dict[str, dict[str, dict[str, Any]]]:
        """What its file tells of elasticity at bodies, joints and rods: plain data, kind and name.

        Empty where the file has other words for it, which a file of those has not.
        """
        return {}

    def shared_inertia(self) -> tuple[Shared, ...]:
        """What the file says of masses, as linear parameters.

        :raises ParameterError: the robot's file gives no masses.
        """
        raise NotImplementedError

    # What follows for all.

    @property
    def without_home(self) -> frozenset[str]:
        """Joints of which the file should say where they count from, and does not."""
        return frozenset()

    def shared_drives(self) -> tuple[Shared, ...]:
        """Friction of each actuated joint and the rotors, as linear parameters of the file."""
        graph, friction = self.graph, self.friction
        result = []
        for k, joint in enumerate(graph.actuated):
            units = drive_units(graph, joint)
            for what in ("viscous", "coulomb", "offset"):
                value = float(getattr(friction, what)[k])
                name, path = f"{joint}.{what}", ("friction", what, k)
                result.append(
                    shared_number(
                        "friction", name, units[what], value, math.nan, path, others=[name],
                        signed=what == "offset",
                    )
                )  # fmt: skip
        first, rotors = graph.actuated[0], [f"{j}.rotor_inertia" for j in graph.actuated]
        drive = self.drive
        rotor = shared_number(
            "rotor", "rotor_inertia", drive_units(graph, first)["rotor_inertia"],
            graph.joints[first].rotor_inertia, math.nan,
            ("inertia", "rotor_inertia") if drive is None else ("drive", "inertia"), others=rotors,
        )  # fmt: skip
        if drive is not None:
            rotor = dataclasses.replace(rotor, keys=behind_gear(rotor, drive.turns))
        return (*result, rotor)

    @property
    def drives(self) -> tuple[DriveSpec | None, ...]:
        """Rotor and gear of each actuated joint, None where the file does not give them."""
        return (self.drive,) * self.joints_count

    def reflected_rotor(self, given: float, slides: bool) -> float:
        """Rotor inertia at the joints, kg m2 or kg: of the file's ``drive``, else as given.

        :raises ParameterError: both are given, or a gear for another type of joint.
        """
        if self.drive is None:
            return given
        if given:
            raise ParameterError(
                "inertia.rotor_inertia", given, "0, because the section drive has the rotor"
            )
        return self.drive.reflected(slides, "drive")

    def shared_parameters(self) -> tuple[Shared, ...]:
        """All that a fit of the robot's file may change: drives, payload, bodies and rods.

        :raises ParameterError: the robot's file gives no masses.
        """
        # The engine's own graph may be that of a machine with other masses.
        self.massive()
        graph, load = self.graph, self.payload
        masses = [body.mass for body in graph.bodies.values()]
        heavy = max(graph.bodies[graph.platform].mass, 0.1 * sum(masses))
        payload = shared_payload(graph, load.mass, load.com, load.inertia, heavy, 0.3 * graph.size)
        return (*self.shared_drives(), payload, *self.shared_inertia())

    @cached_property
    def graph(self) -> Graph:
        """Bodies, joints and rods at home."""
        return self.make_graph()

    @cached_property
    def engine(self) -> Engine:
        """The engine of the robot's geometry, shared by all robots that have the same."""
        start = (lambda numbers, q: self.on(numbers).start(q)) if self.has_start else None
        closed = Closed(np.array(self.closed_numbers, np.float64), start)
        branch = self.branch if self.has_branch else None
        mark = f"{self.mechanism} {self.closed_key}"
        return engine_of(self.graph, self.coordinates, closed, branch, mark)

    @cached_property
    def causes(self) -> Mapping[str, Mapping[str, float]]:
        """By cause of doubt: by path of a number, what one standard deviation adds to it."""
        return causes_of(self)

    @cached_property
    def factors(self) -> tuple[Factor, ...]:
        """The independent causes of doubt that ``uncertainty`` names.

        :raises ParameterError: a number that cannot vary.
        """
        return factors_of(self)

    @cached_property
    def calls(self) -> dict[str, Any]:
        """Functions for one sample, made once a robot, by name."""
        return {}

    def call_one(
        self, name: str, kernel: Callable[[], Kernel], p: Array, *inputs: Any
    ) -> Array | None:
        """First output of one good sample, as fast as can be; None where it takes a batch's way."""
        call = self.calls.get(name)
        if call is None:
            call = self.calls[name] = kernel().first_of_one(p)
        try:
            result: Array | None = call(*inputs)
        except (TypeError, ValueError):
            # A batch, a list, numbers of another kind, or a wrong length.
            return None
        return result

    @cached_property
    def inertial(self) -> Array:
        """Run-time inputs of the dynamics, payload included, see ``machine.inertia``."""
        load = self.payload
        return schema.frozen(
            self.own_inertial + self._layout.payload(load.mass, load.com, load.inertia)
        )

    @cached_property
    def own_inertial(self) -> Array:
        """The same without the payload."""
        return schema.frozen(self._layout.pack(self.graph, self.gravity, self.friction))

    @property
    def _layout(self) -> Layout:
        return Layout(self.engine.tree)

    def massive(self) -> Engine:
        """The engine of a robot with masses.

        :raises ParameterError: the robot's file gives none.
        """
        return self.engine

    def __getstate__(self) -> dict[str, Any]:
        """What a copy in another process is made from: all but what is derived and kept."""
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
        """Unit of q where the joints are of one kind, else ``rad or m``."""
        return _common(self.joint_units)

    @property
    def effort_unit(self) -> str:
        """Unit of the efforts where the joints are of one kind, else ``N m or N``."""
        return _common(self.effort_units)

    def parameter_sections(self) -> dict[str, Any]:
        """The parameters by section, as plain data."""
        fields = (f.name for f in dataclasses.fields(self) if "check" in f.metadata)
        return {name: schema.plain(getattr(self, name)) for name in fields}

    def parameter_units(self) -> dict[str, Any]:
        """Units of the same, by section; empty where a parameter has none."""
        words = {"joint": self.joint_unit, "effort": self.effort_unit}
        return schema.units(type(self), self.parameter_sections(), words)

    @cached_property
    def controller(self) -> JointMap:
        """Between the controller's joints and the model's.

        :raises ParameterError: a map of joints that there are not.
        """
        return JointMap.of(self.joint_names, self.joint_map)

    @cached_property
    def elastic(self) -> Structure:
        """Elastic beams and joints with the elements' factors; errors as :meth:`structure`."""
        return self.structure().scaled(self.element_compliance)

    @property
    def element_names(self) -> tuple[str, ...]:
        """Valid names in ``element_compliance``, bars first; errors as :meth:`structure`.

        Results of energies and factors have their own order, in their attribute ``elements``.
        """
        return self.structure().elements

    def check_elements(self) -> None:
        """Refuse factors of elements that there are not.

        :raises ParameterError: by the name, or nothing is elastic.
        """
        for name in self.element_compliance:
            if name not in self.element_names:
                raise UnknownNameError(f"element_compliance.{name}", name, self.element_names)

    @cached_property
    def joints_count(self) -> int:
        """How many joints are actuated, n."""
        return len(self.joint_names)

    @property
    def pose_names(self) -> tuple[str, ...]:
        """Names of the pose coordinates."""
        return tuple(c.name for c in self.coordinates)

    @property
    def pose_units(self) -> tuple[str, ...]:
        """Their units, ``m`` or ``rad``."""
        return tuple(c.unit for c in self.coordinates)

    @property
    def body_names(self) -> tuple[str, ...]:
        """Bodies and rods, and the payload last."""
        return (*self.graph.bodies, *self.graph.rods, "payload")

    def inverse(self, pose: ArrayLike) -> Array:
        """Joint positions q (..., n) of poses (..., m); ``forward(q)`` is the pose.

        :raises UnreachableError: naming limb, sample and miss.
        :raises SingularityError: a pose beyond a singularity, or in one.
        """
        q, codes = self.judged_inverse(pose, _alone)
        if codes is not None:
            self._refuse_pose(codes, pose)
        return q

    def try_inverse(self, pose: ArrayLike) -> tuple[Array, Mask]:
        """Joint positions (..., n), NaN for an invalid pose; and which poses are valid, (...)."""
        q, codes = self.judged_inverse(pose, _alone)
        good = np.ones(q.shape[:-1], bool) if codes is None else np.asarray(codes[..., 0] == 0.0)
        return np.where(good[..., None], q, np.nan), good

    @cached_property
    def inverse_kernel(self) -> Kernel:
        """Pose to joints of some assembly, in closed form where there is one."""
        if not self.has_inverse:
            return self.engine.inverse

        def write(t: Traced) -> Program:
            m = len(self.coordinates)
            result = self.on(t.closed).solved(t.tape.inputs("pose", m))
            measure = 1.0 if result.measure is None else result.measure
            outputs = {"q": t.lift(result.q), "faults": t.lift([*result.misses, measure])}
            return Program({"pose": m}, 0, outputs)

        return self.engine.kernel("closed inverse", write)

    @property
    def closed_key(self) -> str:
        """Text of what closed forms and branch rules hang on and no number tells."""
        return ""

    @property
    def closed_numbers(self) -> Sequence[float]:
        """Numbers of the geometry that closed forms hang on."""
        return ()

    def on(self: R, numbers: Numbers) -> R:
        """The robot for its closed forms alone, on other numbers or expressions of them.

        :param numbers: as :attr:`closed_numbers`.
        """
        del numbers
        return self

    def numbered(self: R, values: Mapping[str, Any]) -> R:
        """A copy with other numbers or expressions at dotted paths of its file; nothing is checked.

        :raises ParameterError: a path that there is not.
        """
        made = placed(self, {tuple(full_keys(path)): value for path, value in values.items()})
        return self._with(**{f.name: getattr(made, f.name) for f in dataclasses.fields(self)})

    def number(self, path: str) -> float:
        """The number of the robot's file at a dotted path, as :meth:`numbered` takes it.

        :raises ParameterError: a path that there is not.
        """
        keys = full_keys(path)
        sections = {f.name for f in dataclasses.fields(self) if "check" in f.metadata}
        known = keys and keys[0] in sections
        return number_in(
            schema.plain(getattr(self, str(keys[0]))) if known else None, keys[1:], path
        )

    def check_number(self, path: str) -> None:
        """Judge a number of :meth:`numbered` as a file's is.

        :raises ParameterError: by the path.
        """
        check_number(self, full_keys(path), path)

    def _with(self: R, **values: Any) -> R:
        """A copy with other fields, or other values that are derived; nothing is checked."""
        made = object.__new__(type(self))
        vars(made).update(self.__getstate__() | values)
        return made

    def judged_inverse(self, pose: ArrayLike, run: Run) -> tuple[Array, Array | None]:
        """Joints; and None or codes (1 unreachable, 2 not finite, BEYOND), limb, amount.

        The joints of a pose may belong to another assembly too: ``forward`` decides.

        :param run: evaluates a kernel on inputs, to outputs and status.
        """
        q, codes = self._candidates(pose, run)
        tried = q
        if codes is not None:
            tried = np.where(codes[..., :1] == 0.0, q, self.graph.home)
        (found, _, _), _ = run(self.engine.forward, tried)
        # What is infinite or NaN is no pose.
        with np.errstate(invalid="ignore"):
            apart = found - np.asarray(pose, np.float64)
            if self._turn_mask.any():
                turned = np.remainder(apart + math.pi, math.tau) - math.pi
                apart = np.where(self._turn_mask, turned, apart)
            same = (np.abs(apart) * self._pose_units <= SAME_POSE).all(-1)
        if codes is None:
            if same.all():
                return q, None
            codes = np.zeros((*q.shape[:-1], 3))
        other = (codes[..., 0] == 0.0) & ~same
        codes[other] = BEYOND, 0.0, 0.0
        return q, codes

    @cached_property
    def _turn_mask(self) -> Mask:
        """Which pose coordinates are turns, that a full one does not change, shape (m,)."""
        return np.array([len(c.entries) == 2 for c in self.coordinates])

    @cached_property
    def _pose_units(self) -> Array:
        """What makes pose coordinates of unit one, shape (m,)."""
        return np.array([1.0 if c.entries else 1.0 / self.graph.size for c in self.coordinates])

    def _candidates(self, pose: ArrayLike, run: Run) -> tuple[Array, Array | None]:
        """Joints that reach the pose in some assembly; and codes as :meth:`judged_inverse`."""
        outputs, status = run(self.inverse_kernel, pose)
        q = outputs[0]
        if len(outputs) == 1:
            if status is None:
                return q, None
            extra = np.zeros((*status.shape[:-1], 1))
            return q, np.concatenate([status[..., :1], extra, status[..., 1:]], -1)
        faults = outputs[1]
        with np.errstate(invalid="ignore"):
            missed = faults[..., :-1] > 0.0
            singular = ~(faults[..., -1] > SINGULARITY_BOUND)
        if status is None and not missed.any() and not singular.any():
            return q, None
        limb = missed.argmax(-1)
        amount = np.take_along_axis(faults[..., :-1], limb[..., None], -1)[..., 0]
        code = np.where(missed.any(-1), 1.0, np.where(singular, BEYOND, 0.0))
        amount = np.where(code == BEYOND, faults[..., -1], amount)
        if status is not None:
            code = np.where(status[..., 0] != 0.0, status[..., 0], code)
        return q, np.stack([code, limb.astype(float), amount], -1)

    def _refuse_pose(self, codes: Array, pose: ArrayLike) -> None:
        index = _first(codes[..., 0])
        if index is None:
            return
        code, limb, amount = codes[index].tolist()
        one = np.broadcast_to(np.asarray(pose, float), (*codes.shape[:-1], len(self.coordinates)))
        if code == NOT_FINITE or not np.isfinite(one[index]).all():
            raise _not_finite("pose", index)
        if code == BEYOND:
            raise SingularityError("pose", index, max(amount, 0.0), SINGULARITY_BOUND, beyond=True)
        if self.has_inverse:
            raise UnreachableError("pose", self.limb_names[int(limb)], index, amount)
        part, miss, met = self.engine.shortest_pose(one[index])
        if met:
            raise SingularityError("pose", index, 0.0, SINGULARITY_BOUND, amount)
        raise UnreachableError("pose", part, index, miss, amount)

    def forward(self, q: ArrayLike) -> Array:
        """Pose of joint positions q, shape (..., m), in the mechanism's documented assembly.

        :raises UnreachableError: naming limb, sample and miss.
        :raises SingularityError: a singularity on the way from home.
        """
        pose = self.call_one("forward", self._forward_kernel, _NONE, q)
        return self._placed(q)[0] if pose is None else pose

    def _forward_kernel(self) -> Kernel:
        return self.engine.forward

    def try_forward(self, q: ArrayLike) -> tuple[Array, Mask]:
        """Poses (..., m), NaN where there is no assembly; and which q are valid, (...)."""
        (pose, _, _), status = self.engine.forward(_NONE, q)
        good = np.ones(pose.shape[:-1], bool) if status is None else status[..., 0] == 0.0
        return pose, np.asarray(good)

    def platform(self, q: ArrayLike) -> tuple[Array, Array]:
        """Position (..., 3) of the platform's reference point, and its rotation (..., 3, 3).

        Base axes; the rotation is relative to home. Errors as :meth:`forward`.
        """
        _, position, rotation = self._placed(q)
        return position, rotation.reshape(*rotation.shape[:-1], 3, 3)

    def _placed(self, q: ArrayLike) -> list[Array]:
        outputs, status = self.engine.forward(_NONE, q)
        if status is not None:
            self.refuse_joints(status, q)
        return outputs

    def placements(self, q: ArrayLike) -> tuple[dict[str, Array], dict[str, Array]]:
        """Rotation from home (..., 3, 3) and position of the frame's origin (..., 3) of each body.

        ``engine.tree.at`` has the origins at home. Errors as :meth:`forward`.
        """
        (flat,), status = self.engine.placement(_NONE, q)
        if status is not None:
            self.refuse_joints(status, q)
        rows = flat.reshape(*flat.shape[:-1], len(self.graph.bodies), 12)
        rotations, origins = {}, {}
        for k, name in enumerate(self.graph.bodies):
            rotations[name] = rows[..., k, :9].reshape(*flat.shape[:-1], 3, 3)
            origins[name] = rows[..., k, 9:]
        return rotations, origins

    def rotation(self, pose: ArrayLike) -> Array:
        """Platform axes as columns in base axes, shape (..., 3, 3), of a pose.

        Errors as :meth:`inverse`.
        """
        return self.platform(self.inverse(pose))[1]

    def home(self) -> Array:
        """The home pose (not joint positions), shape (m,): the pose in which the graph is given."""
        return self.engine.home_pose.copy()

    def jacobian(self, q: ArrayLike) -> Array:
        """Pose rates per joint rate, shape (..., m, n)."""
        return self._jacobians(q)[0]

    def platform_jacobian(self, q: ArrayLike) -> Array:
        """Platform twist (v at its reference point, omega; base axes) per rate, (..., 6, n)."""
        return self._jacobians(q)[1]

    def _jacobians(self, q: ArrayLike) -> list[Array]:
        (rates, twist), status = self.engine.jacobian(_NONE, q)
        if status is not None:
            self.refuse_joints(status, q)
        n = self.joints_count
        return [m.reshape(*m.shape[:-1], m.shape[-1] // n, n) for m in (rates, twist)]

    def try_jacobian(self, q: ArrayLike) -> tuple[Array, Mask]:
        """Pose rates per joint rate (..., m, n), NaN where there is no assembly; which are good."""
        (rates, _), status = self.engine.jacobian(_NONE, q)
        good = np.ones(rates.shape[:-1], bool) if status is None else status[..., 0] == 0.0
        n = self.joints_count
        return rates.reshape(*rates.shape[:-1], rates.shape[-1] // n, n), np.asarray(good)

    def pose_acceleration(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike) -> Array:
        """Second derivative of the pose in time, shape (..., m)."""
        (second,), status = self.engine.acceleration(_NONE, q, qd, qdd)
        if status is not None:
            self.refuse_joints(status, q, (q, qd, qdd))
        return second

    @cached_property
    def pose_scales(self) -> Array:
        """What makes lengths of pose coordinates, shape (m,): 1, or the platform's radius."""
        return np.array([1.0 if unit == "m" else self.size for unit in self.pose_units])

    @cached_property
    def joint_scales(self) -> Array:
        """The same of q, shape (n,); all 1 where the joints are of one kind."""
        mixed = len(set(self.joint_units)) > 1
        return np.array([self.size if mixed and u == "rad" else 1.0 for u in self.joint_units])

    def singularity(self, q: ArrayLike) -> Array:
        """The singularity index of joint positions: 0 in a singularity, 1 at best, shape (...).

        It includes singularities of any kind: the platform or another body can move with locked
        actuators (constraint singularities included), or joints can move without the platform (the
        edge of the workspace); see ``kinematics.singularity``. It is dimensionless and independent
        of the machine's scale. Errors as :meth:`forward`.
        """
        one = self.call_one("singularity", self.singularity_kernel, _NONE, q)
        if one is not None:
            return np.asarray(one[0])
        (measure,), status = self.singularity_kernel()(_NONE, q)
        if status is not None:
            self.refuse_joints(status, q)
        return np.asarray(measure[..., 0], np.float64)

    def singularity_kernel(self) -> Kernel:
        """The same as a program, q to the measure (1)."""
        return singularity_kernel(self.engine)

    def try_singularity(self, q: ArrayLike) -> tuple[Array, Mask]:
        """The measure (...), 0 where there is no assembly; which joint states have one."""
        (measure,), status = self.singularity_kernel()(_NONE, q)
        good = np.ones(measure.shape[:-1], bool) if status is None else status[..., 0] == 0.0
        return np.where(good, measure[..., 0], 0.0), np.asarray(good)

    def torque_loop(self, samples: int = 1) -> TorqueLoop:
        """Inverse dynamics for a control loop, with preallocated arrays.

        Write ``q, qd, qdd, wrench``, call it, and read ``tau`` and the returned status; see
        :class:`delta_dynamics.loop.TorqueLoop`.
        """
        made: TorqueLoop = import_module("delta_dynamics.loop").TorqueLoop(self, samples)
        return made

    @cached_property
    def passive_joints(self) -> tuple[str, ...]:
        """Names of the passive joints' values, one per revolute or prismatic axis."""
        return passive_names(self.engine)

    def passive(self, q: ArrayLike) -> Array:
        """Values of the passive joints, shape (..., k), rad or m, in a URDF's convention."""
        (flat,), status = self.engine.kernel("passive", passive_program)(_NONE, q)
        if status is not None:
            self.refuse_joints(status, q)
        return flat

    def passive_rates(self, q: ArrayLike, qd: ArrayLike) -> Array:
        """Rates of the passive joints, shape (..., k), rad/s or m/s, as :meth:`passive` has them.

        :param qd: joint rates, shape (..., n), rad/s or m/s.
        """
        (flat,), status = self.engine.kernel("passive rates", passive_rates_program)(_NONE, q, qd)
        if status is not None:
            self.refuse_joints(status, q, (q, qd))
        return flat

    def grid(self) -> PoseGrid:
        """The grid of poses of a workspace map; a box for a machine without an axis."""
        return PoseGrid("box", self.pose_names)

    def search_box(self) -> Array:
        """A box that contains all poses of the workspace, shape (m, 2), m and rad.

        :raises ParameterError: a limit that would bound the workspace is missing.
        """
        place = position_box(self.graph, self.limits.position)
        rows = []
        for c in self.coordinates:
            if c.axis is not None:
                rows.append(place[c.axis])
            else:
                far = np.pi if len(c.entries) == 2 else np.pi / 2
                rows.append(np.array([-far, far]))
        return np.array(rows)

    def changed(self: R, **sections: Mapping[str, object] | object) -> R:
        """A copy with new values, e.g. ``payload={"mass": 0.2}, geometry={"arm_length": 0.3}``.

        All values are checked as in a file; one invalid value rejects all. A change of geometry,
        masses or members is like a new file: the home is chosen again.

        :raises ParameterError: a value out of range, or an impossible machine.
        """
        if not set(sections) <= set(self.changeable):
            known = self.parameter_sections()
            for key in sections:
                if key not in known:
                    raise UnknownNameError(key, key, known)
            return type(self).from_data(merged(given(known), sections), self.name)
        new: dict[str, Any] = {}
        for key, value in sections.items():
            if isinstance(value, Mapping) and not isinstance(getattr(self, key), Mapping):
                new[key] = schema.replace(getattr(self, key), value, key)
            else:
                fields = {f.name: f for f in dataclasses.fields(self)}
                new[key] = fields[key].metadata["check"](key, value)
        made = dataclasses.replace(self, **new)
        made.check_elements()
        return made

    def refuse_joints(self, status: Array, q: ArrayLike, inputs: Sequence[ArrayLike] = ()) -> None:
        """Raise the typed error of the first rejected sample, if there is one.

        :param status: of a kernel, shape (..., 2).
        :param inputs: everything that the kernel was given.
        """
        index = _first(status[..., 0])
        if index is None:
            return
        batch = status.shape[:-1]
        for value in (q, *inputs):
            array = np.asarray(value, float)
            if not np.isfinite(np.broadcast_to(array, (*batch, array.shape[-1]))[index]).all():
                raise _not_finite("joint state", index)
        code, reached = status[index].tolist()
        if code == NOT_FINITE:
            raise _not_finite("joint state", index)
        place = np.asarray(q, float)
        sample = np.broadcast_to(place, (*batch, place.shape[-1]))[index]
        limb = self.unreachable_limb(sample, reached)
        if limb is not None:
            raise UnreachableError("joint state", self.limb_names[limb[0]], index, limb[1])
        part, miss, measure = self.engine.ending(sample, reached)
        if measure is not None:
            raise SingularityError("joint state", index, measure, SINGULARITY_BOUND, reached)
        raise UnreachableError("joint state", part, index, miss, reached)


def _common(units: Sequence[str]) -> str:
    return " or ".join(sorted(set(units), reverse=True))


def _first(codes: Array) -> tuple[int, ...] | None:
    """Index of the first sample whose code is not zero."""
    if codes.ndim == 0:
        return () if codes != 0.0 else None
    bad = codes != 0.0
    return tuple(int(i) for i in np.argwhere(bad)[0]) if bad.any() else None


def _not_finite(what: str, index: tuple[int, ...]) -> ValueError:
    where = f" at sample {index}" if index else ""
    return ValueError(f"{what}{where} is not finite, or leads to a result that is not")
