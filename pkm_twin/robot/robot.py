# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What every robot computes: kinematics by the engine of its graph, masses as run-time inputs."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.codegen.code import GOOD, NOT_FINITE, REFUSED
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.errors import ParameterError, SingularityError, UnreachableError
from pkm_twin.kinematics.drives import TIME
from pkm_twin.kinematics.engine import Engine, engine_of
from pkm_twin.kinematics.passive import (
    passive_names,
    passive_program,
    passive_rates_program,
)
from pkm_twin.kinematics.programs import projection_program
from pkm_twin.kinematics.singularity import singularity_kernel
from pkm_twin.machine import schema
from pkm_twin.machine.graph import Graph
from pkm_twin.machine.inertia import Layout
from pkm_twin.robot.mechanism import Mechanism

T = TypeVar("T")

FAR: Final = 10.0
"""Sizes of the machine from home beyond which a pose is taken for one in mm."""
SINGULARITY_BOUND: Final = 1e-9
"""Least singularity index (0 singular, 1 best) at which a Jacobian is inverted."""

JOINT_STATE: Final = ("q", "qd", "qdd")
"""Inputs of programs that are a joint state; others are named in errors."""

_NONE: Final = np.zeros(0)


class ControlLoop(Protocol):
    """Arrays that stay where they are, and a call that fills ``tau`` and returns a status."""

    q: Array
    qd: Array
    qdd: Array
    wrench: Array
    tau: Array

    def __call__(self) -> int:
        """0 all samples are good, 1 one has no assembly, 2 one is not finite."""


def _forward(robot: Robot) -> Kernel:
    return robot.engine.forward


def _quick_inverse(robot: Robot) -> Kernel:
    return robot.engine.quick_inverse


@dataclass(frozen=True, eq=False, kw_only=True)
class Robot(Mechanism):
    """A parallel kinematic machine of n actuated joints and m pose coordinates.

    Frozen; :meth:`changed` gives a copy with other parameters.
    """

    @cached_property
    def engine(self) -> Engine:
        """The engine of the robot's geometry, shared by all robots that have the same."""
        return self._engine_on(self.graph)

    def _engine_on(self, graph: Graph) -> Engine:
        return engine_of(graph, self.coordinates, self.start)

    @cached_property
    def _massive(self) -> Engine:
        return self._engine_on(self.with_laws(self.graph)) if self.laws else self.engine

    @cached_property
    def calls(self) -> dict[Callable[[Any], Kernel], Callable[..., Array]]:
        """What :meth:`bound` made, by the function that gives the program of a robot."""
        return {}

    @cached_property
    def _cached(self) -> dict[tuple[object, ...], Any]:
        return {}

    def cached(self, make: Callable[..., T], *options: Hashable) -> T:
        """Return what a function makes of this robot and other arguments, made once."""
        found: T | None = self._cached.get((make, *options))
        if found is None:
            found = self._cached[make, *options] = make(self, *options)
        return found

    def bound(
        self,
        kernel: Callable[[Any], Kernel],
        p: Array = _NONE,
        otherwise: Callable[..., Array] | None = None,
    ) -> Callable[..., Array]:
        """Return a robot's program as a function of its inputs to its first output, made once.

        One sample takes the fastest way, any other input that of :meth:`evaluate`.

        :param kernel: gives the program of a robot.
        :param p: the program's parameters. ``otherwise``: in place of :meth:`evaluate`.
        """
        call = self.calls.get(kernel)
        if call is None:
            made = kernel(self)

            def whole(*inputs: ArrayLike) -> Array:
                return self.evaluate(made, p, *inputs)[0]

            call = self.calls[kernel] = made.bound(p, otherwise or whole)
        return call

    def evaluate(self, kernel: Kernel, p: Array, q: ArrayLike, *inputs: ArrayLike) -> list[Array]:
        """Evaluate a program of joint positions and other inputs.

        :raises UnreachableError: a joint state without an assembly, by limb, sample and miss.
        :raises SingularityError: a singularity on the way from home.
        :raises ValueError: a wrong last axis, or a value that is not finite.
        """
        outputs, status = kernel(p, q, *inputs)
        if status is not None:
            names = list(kernel.program.inputs)[1:]
            self.refuse_joints(status, q, dict(zip(names, inputs, strict=True)))
        return outputs

    @cached_property
    def inertial(self) -> Array:
        """Run-time inputs of the dynamics, payload included, see ``machine.inertia``."""
        load = self.payload
        return schema.frozen(self.own_inertial + self._layout.payload(load.mass, load.com, load.inertia))

    @cached_property
    def own_inertial(self) -> Array:
        """The same without the payload."""
        return schema.frozen(self._layout.pack(self.graph, self.gravity, self.friction))

    @property
    def _layout(self) -> Layout:
        return Layout(self._massive.tree)

    def massive(self) -> Engine:
        """Return the engine of a robot with masses; its programs have the friction laws.

        :raises ParameterError: the robot's file gives none: it leaves out a section ``inertia``.
        """
        if getattr(self, "inertia", True) is None:
            raise ParameterError("inertia", None, "a section with the masses and inertias")
        return self._massive

    @property
    def has_masses(self) -> bool:
        """Whether the robot's file gives masses."""
        try:
            self.massive()
        except ParameterError:
            return False
        return True

    def inverse(self, pose: ArrayLike) -> Array:
        """Joint positions q (..., n) of poses (..., m); ``forward(q)`` is the pose.

        :raises UnreachableError: naming limb, sample and miss.
        :raises SingularityError: a pose beyond a singularity, or in one.
        """
        return self.bound(_quick_inverse, otherwise=self._checked_inverse)(pose)

    def _checked_inverse(self, pose: ArrayLike) -> Array:
        q, status = self._invert(pose)
        if status is not None:
            self._refuse_pose(status, pose)
        return q

    def _invert(self, pose: ArrayLike) -> tuple[Array, Array | None]:
        """Return joint positions and the status, None if all poses are good."""
        (q,), status = self.engine.quick_inverse(_NONE, pose)
        if status is None:
            return q, None
        left = status[..., 0] == REFUSED
        places = np.broadcast_to(np.asarray(pose, np.float64), (*left.shape, len(self.pose_names)))
        (q[left],), again = self.engine.inverse(_NONE, places[left])
        status[left] = [GOOD, 1.0] if again is None else again
        return q, status if status[..., 0].any() else None

    def try_inverse(self, pose: ArrayLike) -> tuple[Array, Mask]:
        """Joint positions (..., n), NaN for an invalid pose; and which poses are valid, (...)."""
        q, status = self._invert(pose)
        good = np.ones(q.shape[:-1], bool) if status is None else status[..., 0] == GOOD
        return q, np.asarray(good)

    def _refuse_pose(self, status: Array, pose: ArrayLike) -> None:
        index = _first(status[..., 0])
        if index is None:
            return
        code, reached = status[index].tolist()
        place = np.asarray(pose, float)
        one = np.broadcast_to(place, (*status.shape[:-1], place.shape[-1]))[index]
        if code == NOT_FINITE or not np.isfinite(one).all():
            raise _not_finite("pose", index)
        part, miss, met = self.engine.shortest_pose(one)
        slip = self._slip(one)
        if not met:
            reached = self._reached_fraction(one)
            raise UnreachableError("pose", self.name_limb(part), index, miss, reached, slip)
        if reached < 1.0:
            raise SingularityError("pose", index, 0.0, SINGULARITY_BOUND, reached, question=slip)
        raise SingularityError("pose", index, 0.0, SINGULARITY_BOUND, None, True, slip)

    def _reached_fraction(self, pose: Array) -> float:
        """Return how much of the straight line from home to a rejected pose is reached."""
        home, low, high = self.home(), 0.0, 1.0
        for _ in range(3):
            way = np.linspace(low, high, 65)
            good = self.try_inverse(home + way[:, None] * (pose - home))[1]
            first = int(np.argmin(good)) or 1
            low, high = way[first - 1], way[first]
        return float(low)

    def _slip(self, pose: Array) -> str:
        """Return which coordinate of a pose (m,) is far beyond, with a question about its unit."""
        far = np.abs(pose - self.home())
        for unit, most, other in (("m", FAR * self.graph.size, "mm"), ("rad", 2.0 * np.pi, "deg")):
            own = np.where([one == unit for one in self.pose_units], far, 0.0)
            k = int(own.argmax())
            if own[k] > most:
                name, word = self.pose_names[k], {"mm": "mm", "deg": "degrees"}[other]
                return (
                    f": {name} {pose[k]:.6g} {unit} cannot be reached. Did you give {word}? A "
                    f"table's header is then `{name} [{other}]`"
                )
        return ""

    def forward(self, q: ArrayLike) -> Array:
        """Pose of joint positions q, shape (..., m), in the mechanism's documented assembly.

        :raises UnreachableError: naming limb, sample and miss.
        :raises SingularityError: a singularity on the way from home.
        """
        return self.bound(_forward)(q)

    def try_forward(self, q: ArrayLike) -> tuple[Array, Mask]:
        """Poses (..., m), NaN where there is no assembly; and which q are valid, (...)."""
        return _tried(self.engine.forward, q)

    def platform(self, q: ArrayLike) -> tuple[Array, Array]:
        """Position (..., 3) of the platform's reference point, and its rotation (..., 3, 3).

        Base axes; the rotation is relative to home. Errors as :meth:`forward`.
        """
        return self.placed(q)[1:]

    def placed(self, q: ArrayLike) -> tuple[Array, Array, Array]:
        """Pose as :meth:`forward`, then position and rotation as :meth:`platform`, solved once."""
        pose, position, rotation = self.evaluate(self.engine.forward, _NONE, q)
        return pose, position, rotation.reshape(*rotation.shape[:-1], 3, 3)

    def placements(self, q: ArrayLike) -> tuple[dict[str, Array], dict[str, Array]]:
        """Rotation from home (..., 3, 3) and position of the frame's origin (..., 3) of each body.

        ``engine.tree.at`` has the origins at home. Errors as :meth:`forward`.
        """
        (flat,) = self.evaluate(self.engine.placement, _NONE, q)
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
        """Return the pose (not joint positions) of the machine in its file, shape (m,)."""
        return self.engine.home_pose.copy()

    def jacobian(self, q: ArrayLike) -> Array:
        """Return pose rates per joint rate, shape (..., m, n).

        Delta-CU paper, equation 3; the inverse of the 3-PRRU paper's Jacobian J (equation 24).
        """
        return self._jacobians(q)[0]

    def platform_jacobian(self, q: ArrayLike) -> Array:
        """Return the platform's twist per joint rate, shape (..., 6, n).

        Velocity of its reference point and angular velocity, base axes. On pose rates: the 3-PRRU
        paper's J_M (equation 22).
        """
        return self._jacobians(q)[1]

    def body_jacobians(self, q: ArrayLike) -> dict[str, Array]:
        """Return the twist of each body's frame per joint rate, shape (..., 6, n), by body.

        Velocity of the origin that :meth:`placements` returns, and angular velocity; base axes. On
        pose rates, by :meth:`inverse_jacobian`: the link matrices J_Hij of the 3-PRRU paper
        (equation 30), whose frames are at the slider joints. Rods have no frame.
        """
        (flat,) = self.evaluate(self.engine.body_jacobian, _NONE, q)
        n = self.joints_count
        table = flat.reshape(*flat.shape[:-1], len(self.graph.bodies), 6, n)
        return {name: table[..., k, :, :] for k, name in enumerate(self.graph.bodies)}

    def _jacobians(self, q: ArrayLike) -> list[Array]:
        n = self.joints_count
        tables = self.evaluate(self.engine.jacobian, _NONE, q)
        return [m.reshape(*m.shape[:-1], m.shape[-1] // n, n) for m in tables]

    def try_jacobian(self, q: ArrayLike) -> tuple[Array, Mask]:
        """Pose rates per joint rate (..., m, n), NaN without an assembly; which q are valid."""
        rates, good = _tried(self.engine.jacobian, q)
        n = self.joints_count
        return rates.reshape(*rates.shape[:-1], rates.shape[-1] // n, n), good

    def inverse_jacobian(self, q: ArrayLike) -> Array:
        """Joint rates per pose rate, shape (..., n, m)."""
        jacobian = self.jacobian(q)
        if not self.redundant:
            return np.asarray(np.linalg.inv(jacobian), np.float64)
        # The Jacobian's transpose shares efforts by the squares of their limits.
        back = (jacobian / self.effort_scale**2).swapaxes(-1, -2)
        return np.asarray(back @ np.linalg.inv(jacobian @ back), np.float64)

    def following(self, q: ArrayLike) -> Array:
        """Rates of all drives by those that lead, shape (..., n, m); one where all lead."""
        if not self.redundant:
            n = self.joints_count
            return np.broadcast_to(np.eye(n), (*np.shape(q)[:-1], n, n))
        back = self.inverse_jacobian(q)
        return np.asarray(back @ np.linalg.inv(back[..., self.graph.leading, :]))

    @cached_property
    def joint_scales(self) -> Array:
        """What makes positions of unit one, shape (n,): the size for slides."""
        return np.where(np.array(self.joint_units) == "m", self.engine.tree.size, 1.0)

    @property
    def effort_scale(self) -> Array:
        """What efforts of drives that share are compared by, shape (n,)."""
        return np.asarray(self.graph.sharing[1 : 1 + self.joints_count])

    def project_redundant(
        self, q: ArrayLike, qd: ArrayLike | None = None, qdd: ArrayLike | None = None
    ) -> tuple[Array, Array, Array]:
        """Positions, rates and accelerations of all actuated joints, by the leading ones.

        Unchanged where all joints lead; errors as :meth:`forward`.

        :param q: joint positions, shape (..., n), with ``qd`` and ``qdd``; None: zero.
        :returns: shape (..., n) each.
        """
        still = np.zeros(self.joints_count)
        given = (q, still if qd is None else qd, still if qdd is None else qdd)
        if not self.redundant:
            arrays = np.broadcast_arrays(*(np.asarray(one, np.float64) for one in given))
            return arrays[0], arrays[1], arrays[2]
        first, second, third = self.evaluate(self.projection_kernel, _NONE, *given)
        return first, second, third

    def try_project_redundant(self, q: Array) -> Array:
        """Project positions alone; NaN where there is no assembly."""
        if not self.redundant:
            return q
        still = np.zeros(self.joints_count)
        return self.projection_kernel(_NONE, q, still, still)[0][0]

    @property
    def projection_kernel(self) -> Kernel:
        """The program of :meth:`project_redundant`."""
        return self.engine.kernel("project_redundant", projection_program)

    def pose_acceleration(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike) -> Array:
        """Second derivative of the pose in time, shape (..., m) (Delta-CU paper, equation 6)."""
        return self.evaluate(self.engine.acceleration, _NONE, q, qd, qdd)[0]

    def singularity(self, q: ArrayLike) -> Array:
        """Return the singularity index of joint positions: 0 in a singularity, 1 at best, (...).

        It includes singularities of any kind: the platform or another body can move with locked
        actuators (constraint singularities included), or joints can move without the platform (the
        edge of the workspace); see ``kinematics.singularity``. It is dimensionless and independent
        of the machine's scale. Errors as :meth:`forward`.
        """
        return np.asarray(self.bound(Robot.singularity_kernel)(q)[..., 0])

    def singularity_kernel(self) -> Kernel:
        """Compile the program from q to the singularity index (1)."""
        return singularity_kernel(self.engine)

    def try_singularity(self, q: ArrayLike) -> tuple[Array, Mask]:
        """Return the singularity index (...), 0 without an assembly; and which q are valid."""
        measure, good = _tried(self.singularity_kernel(), q)
        return np.where(good, measure[..., 0], 0.0), good

    def torque_loop(self, samples: int = 1) -> ControlLoop:
        """Inverse dynamics for a control loop, with preallocated arrays.

        Write ``q, qd, qdd, wrench``, call it, and read ``tau`` and the returned status; see
        :class:`delta_dynamics.torques.virtual_work.TorqueLoop`.
        """
        raise NotImplementedError

    @cached_property
    def passive_joints(self) -> tuple[str, ...]:
        """Names of the passive joints' values, one per revolute or prismatic axis, without spaces.

        ``elbow III`` of the robot file is ``elbow_3``, as in the exported URDF.
        """
        return passive_names(self.engine)

    def passive(self, q: ArrayLike) -> Array:
        """Values of the passive joints, shape (..., k), rad or m, in a URDF's convention.

        Angles are within half a turn of their value at home.
        """
        return self.evaluate(self.engine.kernel("passive", passive_program), _NONE, q)[0]

    def passive_rates(self, q: ArrayLike, qd: ArrayLike) -> Array:
        """Rates of the passive joints, shape (..., k), rad/s or m/s, as :meth:`passive` has them.

        :param qd: joint rates, shape (..., n), rad/s or m/s.
        """
        kernel = self.engine.kernel("passive rates", passive_rates_program)
        return self.evaluate(kernel, _NONE, q, qd)[0]

    def refuse_joints(self, status: Array, q: ArrayLike, inputs: Mapping[str, ArrayLike] | None = None) -> None:
        """Raise the typed error of the first rejected sample, if there is one.

        :param status: of a kernel, shape (..., 2).
        :param inputs: everything else that the kernel was given, by name.
        """
        index = _first(status[..., 0])
        if index is None:
            return
        batch = status.shape[:-1]
        given: dict[str, Array] = {}
        for name, value in {"q": q, **(inputs or {})}.items():
            array = np.asarray(value, float)
            given[name] = np.broadcast_to(array, (*batch, array.shape[-1]))[index]
            if not np.isfinite(given[name]).all():
                if name in JOINT_STATE:
                    raise _not_finite("joint state", index)
                field = f"{name}{_at_sample(index)}"
                raise ParameterError(field, given[name].tolist(), "finite numbers")
        code, reached = status[index].tolist()
        if code == NOT_FINITE:
            raise _not_finite("joint state", index)
        sample = given["q"]
        if self.redundant:
            self._refuse_contradiction(given, index)
            sample = sample[self.graph.leading]
        start = self.engine.start
        short = start.find_miss(self.engine.tree, sample) if start is not None else None
        if short is not None:
            raise UnreachableError("joint state", self.name_limb(short[0]), index, short[1])
        drive, change = self._find_correction(sample)
        if change < np.inf and self.graph.joints[drive].slides:
            raise UnreachableError("joint state", self.name_limb(drive), index, change)
        part, miss, measure = self.engine.ending(sample, reached)
        if measure is not None:
            question = ""
            if self.redundant:
                leads = ", ".join(self.graph.leads)
                question = f"; it is one of {leads} alone, others may lead (redundancy.leads)"
            raise SingularityError("joint state", index, measure, SINGULARITY_BOUND, reached, question=question)
        limb = self.name_limb(drive if change < np.inf else part)
        raise UnreachableError("joint state", limb, index, miss, reached)

    def _find_correction(self, q: Array) -> tuple[str, float]:
        """Return the drive that alone comes back by the least, and by how much.

        It is infinite if there is none, or if the limbs have no names.
        """
        if self.limb_names == self.joint_names:
            return "", np.inf
        size = self.joints_count
        span = 2.0 * float(np.abs(q - self.graph.home).max())
        low, high = np.zeros(2 * size), np.full(2 * size, span)
        ways = np.concatenate([np.eye(size), -np.eye(size)])
        for _ in range(4):
            changes = low + np.linspace(0.0, 1.0, 129)[:, None] * (high - low)
            good = self.try_forward(q + changes[..., None] * ways)[1]
            first, found = np.maximum(good.argmax(0), 1)[None], np.asarray(good.any(0))
            high = np.where(found, np.take_along_axis(changes, first, 0)[0], span)
            low = np.where(found, np.take_along_axis(changes, first - 1, 0)[0], span)
        best = int(np.argmin(high))
        return self.joint_names[best % size], float(high[best]) if found[best] else np.inf

    def _refuse_contradiction(self, given: Mapping[str, Array], index: tuple[int, ...]) -> None:
        """Raise the error of drives that do not follow those that lead: q, or else qd, or qdd."""
        graph, leads = self.graph, ", ".join(self.graph.leads)
        still = np.zeros(self.joints_count)
        state = [given.get(name, still) for name in ("q", "qd", "qdd")]
        scales = self.joint_scales
        ways = (
            ("is", "where {} put it", ""),
            ("has a velocity of {:.4g} {}, ", "what {} make it", "/s"),
            ("has an acceleration of {:.4g} {}, ", "what {} make it", "/s2"),
        )
        found = self.projection_kernel(_NONE, *state)[0]
        for k, (own, follows, (has, whence, per)) in enumerate(zip(state, found, ways, strict=True)):
            apart = np.abs(own - follows)
            worst = int(np.argmax(apart / scales))
            bound = float(graph.sharing[0] * scales[worst]) / TIME**k
            if not apart[worst] > bound:
                continue
            unit = self.joint_units[worst] + per
            how = f"{has.format(own[worst], unit).strip()} {apart[worst]:.3g} {unit} from "
            how += f"{whence.format(leads)}, allowed {bound:.3g} (redundancy.tolerance)"
            if k == 0:
                how += "; or these alone are past a singularity, where others may lead "
                how += "(redundancy.leads)"
            raise UnreachableError("joint state", self.joint_names[worst], index, 0.0, how=how)


def _tried(kernel: Kernel, given: ArrayLike) -> tuple[Array, Mask]:
    """First output of a program, NaN where a sample is rejected; and which are not, (...)."""
    (result, *_), status = kernel(_NONE, given)
    good = np.ones(result.shape[:-1], bool) if status is None else status[..., 0] == 0.0
    return result, np.asarray(good)


def _first(codes: Array) -> tuple[int, ...] | None:
    """Index of the first sample whose code is not zero."""
    if codes.ndim == 0:
        return () if codes != 0.0 else None
    bad = codes != 0.0
    return tuple(int(i) for i in np.argwhere(bad)[0]) if bad.any() else None


def _not_finite(what: str, index: tuple[int, ...]) -> ValueError:
    text = f"{what}{_at_sample(index)} is not finite, or leads to a result that is not"
    return ValueError(text)


def _at_sample(index: tuple[int, ...]) -> str:
    return f" at sample {index}" if index else ""
