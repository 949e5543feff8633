# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compute the kinematics of a robot with the engine of its graph; masses are inputs at run time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, Protocol, TypeVar, TypeVarTuple

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.codegen.code import REJECTED, VALID
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.engine import Engine, find_engine
from pkm_twin.kinematics.passive import passive_names, passive_program, passive_rates_program
from pkm_twin.kinematics.programs import projection_program
from pkm_twin.kinematics.singularity import singularity_kernel
from pkm_twin.machine import schema
from pkm_twin.machine.graph import Graph
from pkm_twin.machine.inertia import Layout
from pkm_twin.robot.mechanism import Mechanism
from pkm_twin.robot.rejection import reject_joints, reject_poses, try_program

T = TypeVar("T")
Options = TypeVarTuple("Options")

_NONE: Final = np.zeros(0)


class ControlLoop(Protocol):
    """Preallocated arrays, and a call that fills ``tau`` and returns a status."""

    q: Array
    qd: Array
    qdd: Array
    wrench: Array
    tau: Array

    def __call__(self) -> int:
        """Evaluate the inputs and fill ``tau``.

        :returns: 0 if all samples are good, 1 if one has no assembly, 2 if one is not finite.
        """


@dataclass(frozen=True, eq=False, kw_only=True)
class Robot(Mechanism):
    """A parallel kinematic machine of n actuated joints and m pose coordinates.

    Frozen; :meth:`changed` gives a copy with other parameters.
    """

    @cached_property
    def engine(self) -> Engine:
        """The engine of the robot's geometry, shared by all robots that have the same."""
        return self._make_engine(self.graph)

    def _make_engine(self, graph: Graph) -> Engine:
        return find_engine(graph, self.coordinates, self.start)

    @cached_property
    def _engine_with_friction_laws(self) -> Engine:
        return self._make_engine(self.with_friction_laws(self.graph)) if self.laws else self.engine

    @cached_property
    def _cached(self) -> dict[object, Any]:
        return {}

    def cached(self, make: Callable[[Any, *Options], T], *options: *Options) -> T:
        """Return ``make(robot, *options)``, computed once per robot and options."""
        found: T | None = self._cached.get((make, *options))
        if found is None:
            found = self._cached[make, *options] = make(self, *options)
        return found

    def function(
        self, program: Callable[[Any], Kernel], p: Array = _NONE, otherwise: Callable[..., Array] | None = None
    ) -> Callable[..., Array]:
        """Return a program of the robot as a function from its inputs to its first output, made once.

        One good sample takes the fastest path, all other inputs that of :meth:`evaluate`.

        :param program: returns the compiled program of a robot.
        :param p: the program's parameters. ``otherwise``: replaces :meth:`evaluate`.
        """
        call: Callable[..., Array] | None = self._cached.get(program)
        if call is None:
            kernel = program(self)
            call = kernel.bound(p, otherwise or (lambda *inputs: self.evaluate(kernel, *inputs, p=p)[0]))
            self._cached[program] = call
        return call

    def evaluate(self, kernel: Kernel, q: ArrayLike, *inputs: ArrayLike, p: Array = _NONE) -> list[Array]:
        """Evaluate a program of joint positions and other inputs; return all its outputs.

        :param p: the program's parameters.

        :raises UnreachableError: a joint state without an assembly; limb, sample and gap are named.
        :raises SingularityError: a singularity on the way from home.
        :raises ValueError: a wrong last axis, or a value that is not finite.
        """
        outputs, status = kernel(p, q, *inputs)
        if status is not None:
            names = list(kernel.program.inputs)[1:]
            reject_joints(self, self.engine, status, q, dict(zip(names, inputs, strict=True)))
        return outputs

    @cached_property
    def inertial(self) -> Array:
        """Parameter vector of the dynamics with the payload, see ``machine.inertia``."""
        load = self.payload
        return schema.make_read_only(self.own_inertial + self._layout.payload(load.mass, load.com, load.inertia))

    @cached_property
    def own_inertial(self) -> Array:
        """Parameter vector of the dynamics without the payload."""
        return schema.make_read_only(self._layout.pack(self.graph, self.gravity, self.friction))

    @property
    def _layout(self) -> Layout:
        return Layout(self._engine_with_friction_laws.tree)

    def massive(self) -> Engine:
        """Return the engine of a robot with masses, whose programs include the friction laws.

        :raises ParameterError: the robot's file states no masses.
        """
        if getattr(self, "inertia", True) is None:
            raise ParameterError("inertia", None, "a section with the masses and inertias")
        return self._engine_with_friction_laws

    @property
    def has_masses(self) -> bool:
        """True if the robot's file states masses."""
        try:
            self.massive()
        except ParameterError:
            return False
        return True

    def inverse(self, pose: ArrayLike) -> Array:
        """Compute joint positions q (..., n) of poses (..., m); ``forward(q)`` is the pose.

        :raises UnreachableError: a pose out of reach; limb, sample and gap are named.
        :raises SingularityError: a pose at or beyond a singularity.
        """
        return self.function(_closed_form_inverse_kernel, otherwise=self._checked_inverse)(pose)

    def _checked_inverse(self, pose: ArrayLike) -> Array:
        q, status = self._invert(pose)
        if status is not None:
            reject_poses(self, self.engine, status, pose, self.try_inverse)
        return q

    def _invert(self, pose: ArrayLike) -> tuple[Array, Array | None]:
        """Return joint positions and the status, None if all poses are good."""
        (q,), status = self.engine.quick_inverse(_NONE, pose)
        if status is None:
            return q, None
        left = status[..., 0] == REJECTED
        places = np.broadcast_to(np.asarray(pose, np.float64), (*left.shape, len(self.pose_names)))
        (q[left],), again = self.engine.inverse(_NONE, places[left])
        status[left] = [VALID, 1.0] if again is None else again
        return q, status if status[..., 0].any() else None

    def try_inverse(self, pose: ArrayLike) -> tuple[Array, Mask]:
        """Return joint positions (..., n), NaN for an invalid pose, and which poses are valid, (...)."""
        q, status = self._invert(pose)
        good = np.ones(q.shape[:-1], bool) if status is None else status[..., 0] == VALID
        return q, np.asarray(good)

    def forward(self, q: ArrayLike) -> Array:
        """Compute the pose of joint positions q, shape (..., m), in the mechanism's documented assembly.

        :raises UnreachableError: a joint state without an assembly; limb, sample and gap are named.
        :raises SingularityError: a singularity on the way from home.
        """
        return self.function(_forward)(q)

    def try_forward(self, q: ArrayLike) -> tuple[Array, Mask]:
        """Return poses (..., m), NaN without an assembly, and which q are valid, (...)."""
        return try_program(self.engine.forward, q)

    def platform(self, q: ArrayLike) -> tuple[Array, Array]:
        """Compute position (..., 3) of the platform's reference point and rotation (..., 3, 3) from home.

        Both are in base axes. Errors as in :meth:`forward`.
        """
        return self.placed(q)[1:]

    def placed(self, q: ArrayLike) -> tuple[Array, Array, Array]:
        """Return the results of :meth:`forward` and :meth:`platform`, computed together."""
        pose, position, rotation = self.evaluate(self.engine.forward, q)
        return pose, position, rotation.reshape(*rotation.shape[:-1], 3, 3)

    def placements(self, q: ArrayLike) -> tuple[dict[str, Array], dict[str, Array]]:
        """Compute rotation from home (..., 3, 3) and position of the frame's origin (..., 3) of each body.

        ``engine.tree.at`` has the origins at home. Errors as in :meth:`forward`.
        """
        (flat,) = self.evaluate(self.engine.placement, q)
        rows = flat.reshape(*flat.shape[:-1], len(self.graph.bodies), 12)
        rotations, origins = {}, {}
        for k, name in enumerate(self.graph.bodies):
            rotations[name] = rows[..., k, :9].reshape(*flat.shape[:-1], 3, 3)
            origins[name] = rows[..., k, 9:]
        return rotations, origins

    def rotation(self, pose: ArrayLike) -> Array:
        """Return the platform's axes as columns in base axes, shape (..., 3, 3), for a pose.

        Errors as in :meth:`inverse`.
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
        (flat,) = self.evaluate(self.engine.body_jacobian, q)
        n = self.joints_count
        table = flat.reshape(*flat.shape[:-1], len(self.graph.bodies), 6, n)
        return {name: table[..., k, :, :] for k, name in enumerate(self.graph.bodies)}

    def _jacobians(self, q: ArrayLike) -> list[Array]:
        n = self.joints_count
        tables = self.evaluate(self.engine.jacobian, q)
        return [m.reshape(*m.shape[:-1], m.shape[-1] // n, n) for m in tables]

    def try_jacobian(self, q: ArrayLike) -> tuple[Array, Mask]:
        """Return pose rates per joint rate (..., m, n), NaN without an assembly, and which q are valid."""
        rates, good = try_program(self.engine.jacobian, q)
        n = self.joints_count
        return rates.reshape(*rates.shape[:-1], rates.shape[-1] // n, n), good

    def inverse_jacobian(self, q: ArrayLike) -> Array:
        """Return joint rates per pose rate, shape (..., n, m)."""
        jacobian = self.jacobian(q)
        if not self.redundant:
            return np.asarray(np.linalg.inv(jacobian), np.float64)
        # The Jacobian's transpose shares efforts by the squares of their limits.
        back = (jacobian / self.effort_scale**2).swapaxes(-1, -2)
        return np.asarray(back @ np.linalg.inv(jacobian @ back), np.float64)

    def drive_jacobian(self, q: ArrayLike) -> Array:
        """Return all drives' rates per rate of the leading drives, (..., n, m); the identity if all lead."""
        if not self.redundant:
            n = self.joints_count
            return np.broadcast_to(np.eye(n), (*np.shape(q)[:-1], n, n))
        back = self.inverse_jacobian(q)
        return np.asarray(back @ np.linalg.inv(back[..., self.graph.leading, :]))

    @cached_property
    def joint_scales(self) -> Array:
        """Scales that make joint positions dimensionless, shape (n,): the machine's size for slides."""
        return np.where(np.array(self.joint_units) == "m", self.engine.tree.size, 1.0)

    @property
    def effort_scale(self) -> Array:
        """Scales by which redundant drives share efforts, shape (n,)."""
        return np.asarray(self.graph.sharing[1 : 1 + self.joints_count])

    def project_redundant(
        self, q: ArrayLike, qd: ArrayLike | None = None, qdd: ArrayLike | None = None
    ) -> tuple[Array, Array, Array]:
        """Compute positions, rates and accelerations of all actuated joints from the leading ones.

        They are unchanged if all joints lead. Errors as in :meth:`forward`.

        :param q: joint positions, shape (..., n), with ``qd`` and ``qdd``; None: zero.
        :returns: shape (..., n) each.
        """
        still = np.zeros(self.joints_count)
        given = (q, still if qd is None else qd, still if qdd is None else qdd)
        if not self.redundant:
            arrays = np.broadcast_arrays(*(np.asarray(one, np.float64) for one in given))
            return arrays[0], arrays[1], arrays[2]
        first, second, third = self.evaluate(self.projection_kernel, *given)
        return first, second, third

    def try_project_redundant(self, q: Array) -> Array:
        """Project positions only; NaN without an assembly."""
        if not self.redundant:
            return q
        still = np.zeros(self.joints_count)
        return self.projection_kernel(_NONE, q, still, still)[0][0]

    @property
    def projection_kernel(self) -> Kernel:
        """The program of :meth:`project_redundant`."""
        return self.engine.kernel("project_redundant", projection_program)

    def pose_acceleration(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike) -> Array:
        """Compute the second time derivative of the pose, shape (..., m) (Delta-CU paper, equation 6)."""
        return self.evaluate(self.engine.acceleration, q, qd, qdd)[0]

    def singularity(self, q: ArrayLike) -> Array:
        """Return the singularity index of joint positions: 0 in a singularity, 1 at best, (...).

        It includes singularities of any kind: the platform or another body can move with locked
        actuators (constraint singularities included), or joints can move without the platform (the
        edge of the workspace); see ``kinematics.singularity``. It is dimensionless and independent
        of the machine's scale. Errors as :meth:`forward`.
        """
        return np.asarray(self.function(Robot.singularity_kernel)(q)[..., 0])

    def singularity_kernel(self) -> Kernel:
        """Compile the program from q to the singularity index (1)."""
        return singularity_kernel(self.engine)

    def try_singularity(self, q: ArrayLike) -> tuple[Array, Mask]:
        """Return the singularity index (...), 0 without an assembly; and which q are valid."""
        measure, good = try_program(self.singularity_kernel(), q)
        return np.where(good, measure[..., 0], 0.0), good

    def torque_loop(self, samples: int = 1) -> ControlLoop:
        """Prepare inverse dynamics for a control loop, with preallocated arrays.

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
        """Compute the passive joints' values, shape (..., k), rad or m, in a URDF's convention.

        Angles are within half a turn of their values at home.
        """
        return self.evaluate(self.engine.kernel("passive", passive_program), q)[0]

    def passive_rates(self, q: ArrayLike, qd: ArrayLike) -> Array:
        """Compute the rates of the passive joints of :meth:`passive`, shape (..., k), rad/s or m/s.

        :param qd: joint rates, shape (..., n), rad/s or m/s.
        """
        kernel = self.engine.kernel("passive rates", passive_rates_program)
        return self.evaluate(kernel, q, qd)[0]


def _forward(robot: Robot) -> Kernel:
    return robot.engine.forward


def _closed_form_inverse_kernel(robot: Robot) -> Kernel:
    return robot.engine.quick_inverse
