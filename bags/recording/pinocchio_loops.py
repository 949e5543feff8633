# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Multibody engines on Pinocchio: an open tree of bodies and the loops that close it.

The bodies hang in a tree (every limb from the base, the platform from the base on its own free
joints) and each limb's end is tied to the platform by constraints. Kinematics come from Newton's
method on those constraints, inertia forces from Pinocchio's recursions on the tree, actuator
torques and loop reactions from one linear system. No formula is shared with the twin, which works
with closed vector loops and virtual work instead.

May import: pinocchio, numpy, the standard library.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

STANDARD_GRAVITY: Final = (0.0, 0.0, -9.81)
"""Gravity where the parameters name none, m/s2."""

_WORLD: Final = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


class AssemblyError(ValueError):
    """The loops cannot be closed at these actuator positions."""


class TreeState(NamedTuple):
    """Configuration, velocity and acceleration of the whole tree, in Pinocchio's own order."""

    q: Array
    v: Array
    a: Array


class PointLoop(NamedTuple):
    """Two frames whose origins coincide: three equations, m."""

    frame_a: int
    frame_b: int


class PerpendicularLoop(NamedTuple):
    """An axis of frame a stands at a right angle to an axis of frame b: one equation."""

    frame_a: int
    axis_a: Array
    frame_b: int
    axis_b: Array


class LoopEngine:
    """A tree with loop constraints and three actuators; the base of the two machines.

    A subclass fills the tree in `_build` and gives a first assembly in `_guess`.
    """

    def __init__(self, params: Mapping[str, Any]) -> None:
        self.params: Final = params
        self.model = pin.Model()
        gravity = np.array(params.get("gravity", STANDARD_GRAVITY), dtype=float)
        self.model.gravity.linear = gravity
        friction = params.get("friction") or {}
        self.viscous = _three(friction.get("viscous", 0.0))
        """Viscous friction of the actuated joints, N m s/rad or N s/m."""
        self.coulomb = _three(friction.get("coulomb", 0.0))
        """Coulomb friction of the actuated joints, N m or N."""
        self.friction_band = 0.0
        """Speed over which Coulomb friction turns over, rad/s or m/s; zero: a sharp sign."""
        self._points: list[PointLoop] = []
        self._perpendiculars: list[PerpendicularLoop] = []
        self._actuated_joints: list[int] = []
        self._pose_joints: list[int] = []
        self._platform_joint = 0
        self._build()
        self.data = self.model.createData()
        self.actuated: Final = np.array([self._place(joint) for joint in self._actuated_joints])
        """Places of the three actuators in the tree's vectors; every joint has one freedom."""
        self.pose_places: Final = np.array([self._place(joint) for joint in self._pose_joints])
        """Places of the platform's three independent coordinates in the tree's vectors."""
        self.constraint_count: Final = 3 * len(self._points) + len(self._perpendiculars)
        if self.model.nq != self.model.nv or self.model.nv != self.constraint_count + 3:
            raise AssertionError("tree and loops do not leave three freedoms")
        self.passive: Final = self._others(self.actuated)
        """Places of everything but the actuators in the tree's vectors."""

    def _place(self, joint: int) -> int:
        return int(self.model.joints[joint].idx_v)

    def _others(self, places: Array) -> Array:
        return np.setdiff1d(np.arange(self.model.nv), places)

    # What a machine has to say

    def _build(self) -> None:
        raise NotImplementedError

    def _guess(self, q: Array) -> Array:
        """Give a tree configuration near the wanted assembly at actuator positions ``q``."""
        raise NotImplementedError

    def _home(self, pose: Array) -> Array:
        """Give a tree configuration in the wanted assembly with the platform near ``pose``."""
        raise NotImplementedError

    def _check_assembly(self, configuration: Array) -> None:
        """Refuse an assembly mode that is not the wanted one."""

    # Loops

    def constraint_error(self, configuration: Array) -> Array:
        """Return how far the loops stand open, shape (constraints,), m and unitless."""
        pin.forwardKinematics(self.model, self.data, configuration)
        pin.updateFramePlacements(self.model, self.data)
        return self._error_from_placements()

    def _error_from_placements(self) -> Array:
        placements = self.data.oMf
        error = [placements[a].translation - placements[b].translation for a, b in self._points]
        error += [
            np.array([(placements[a].rotation @ x) @ (placements[b].rotation @ y)])
            for a, x, b, y in self._perpendiculars
        ]
        return np.concatenate(error)

    def constraint_jacobian(self, configuration: Array) -> Array:
        """Return the Jacobian of the loops from Pinocchio's frames, shape (constraints, nv)."""
        pin.computeJointJacobians(self.model, self.data, configuration)
        pin.updateFramePlacements(self.model, self.data)
        return self._jacobian_from_placements()

    def _jacobian_from_placements(self) -> Array:
        jacobian = np.empty((self.constraint_count, self.model.nv))
        row = 0
        for a, b in self._points:
            jacobian[row : row + 3] = self._frame_jacobian(a)[:3] - self._frame_jacobian(b)[:3]
            row += 3
        for a, x, b, y in self._perpendiculars:
            normal = cross(self.data.oMf[a].rotation @ x, self.data.oMf[b].rotation @ y)
            relative = self._frame_jacobian(a)[3:] - self._frame_jacobian(b)[3:]
            jacobian[row] = normal @ relative
            row += 1
        return jacobian

    def _frame_jacobian(self, frame: int) -> Array:
        jacobian: Array = pin.getFrameJacobian(self.model, self.data, frame, _WORLD)
        return jacobian

    def constraint_drift(self, configuration: Array, velocity: Array) -> Array:
        """Return the loops' second derivative at zero tree acceleration, shape (constraints,)."""
        pin.forwardKinematics(self.model, self.data, configuration, velocity, np.zeros(self.model.nv))
        pin.updateFramePlacements(self.model, self.data)
        drift = []
        for a, b in self._points:
            drift.append(self._point_acceleration(a) - self._point_acceleration(b))
        for a, x, b, y in self._perpendiculars:
            axis_a = self.data.oMf[a].rotation @ x
            axis_b = self.data.oMf[b].rotation @ y
            rate_a = pin.getFrameVelocity(self.model, self.data, a, _WORLD).angular
            rate_b = pin.getFrameVelocity(self.model, self.data, b, _WORLD).angular
            spin_a = pin.getFrameAcceleration(self.model, self.data, a, _WORLD).angular
            spin_b = pin.getFrameAcceleration(self.model, self.data, b, _WORLD).angular
            turning = cross(cross(rate_a, axis_a), axis_b) + cross(axis_a, cross(rate_b, axis_b))
            value = (spin_a - spin_b) @ cross(axis_a, axis_b) + (rate_a - rate_b) @ turning
            drift.append(np.array([value]))
        return np.concatenate(drift)

    def _point_acceleration(self, frame: int) -> Array:
        acceleration: Array = pin.getFrameClassicalAcceleration(self.model, self.data, frame, _WORLD).linear
        return acceleration

    # Kinematics

    def assemble(self, q: ArrayLike, near: Array | None = None) -> Array:
        """Close the loops at actuator positions ``q`` by Newton's method.

        :param q: actuator positions, shape (3,), rad or m.
        :param near: a tree configuration to start from; without it the machine's own guess.
        :returns: the tree's configuration, shape (nv,), loops closed to 1e-15 m or so.
        :raises AssemblyError: the loops do not close, or close in another assembly mode.
        """
        target = np.asarray(q, dtype=float)
        return self._close(self._guess(target) if near is None else near, self.actuated, target)

    def assemble_pose(self, pose: ArrayLike, near: Array | None = None) -> Array:
        """Close the loops with the platform held at ``pose``, shape (3,); else as `assemble`."""
        target = np.asarray(pose, dtype=float)
        start = self._home(target) if near is None else near
        return self._close(start, self.pose_places, target)

    def _close(self, start: Array, held: Array, target: Array) -> Array:
        free = self._others(held)
        configuration = start.copy()
        configuration[held] = target
        error = self.constraint_error(configuration)
        size = float(np.abs(error).max())
        for _ in range(60):
            jacobian = self.constraint_jacobian(configuration)
            try:
                step = np.linalg.solve(jacobian[:, free], -error)
            except np.linalg.LinAlgError:
                break
            largest = float(np.abs(step).max())
            fraction = min(1.0, 0.5 / largest) if largest > 0.0 else 1.0
            for _ in range(12):
                trial = configuration.copy()
                trial[free] += fraction * step
                trial_error = self.constraint_error(trial)
                trial_size = float(np.abs(trial_error).max())
                if trial_size < size:
                    break
                fraction /= 2.0
            else:
                break
            configuration, error, size = trial, trial_error, trial_size
            if size == 0.0:
                break
        if not size < 1e-12:
            raise AssemblyError(f"loops stay open by {size:.3g} with {target} held")
        self._check_assembly(configuration)
        return configuration

    def velocity(self, configuration: Array, qd: ArrayLike) -> Array:
        """Return the tree velocity that follows from actuator rates, shape (nv,)."""
        jacobian = self.constraint_jacobian(configuration)
        return self._complete(jacobian, self.actuated, qd, 0.0)

    def _complete(self, jacobian: Array, held: Array, values: ArrayLike, drift: Array | float) -> Array:
        free = self._others(held)
        full = np.empty(self.model.nv)
        full[held] = values
        full[free] = np.linalg.solve(jacobian[:, free], -(jacobian[:, held] @ full[held]) - drift)
        return full

    def state(self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, near: Array | None = None) -> TreeState:
        """Return the whole tree's motion for the actuators' motion, consistent with the loops.

        :param q: actuator positions, shape (3,), rad or m; ``qd``, ``qdd`` their derivatives.
        :param near: a tree configuration to start Newton's method from.
        """
        return self._motion(self.assemble(q, near), self.actuated, qd, qdd)

    def pose_state(self, pose: ArrayLike, rate: ArrayLike, second: ArrayLike, near: Array | None = None) -> TreeState:
        """Return the whole tree's motion for the platform's motion; else as `state`.

        :param pose: the platform's three coordinates; ``rate``, ``second`` their derivatives.
        """
        return self._motion(self.assemble_pose(pose, near), self.pose_places, rate, second)

    def _motion(self, configuration: Array, held: Array, rate: ArrayLike, second: ArrayLike) -> TreeState:
        jacobian = self.constraint_jacobian(configuration)
        velocity = self._complete(jacobian, held, rate, 0.0)
        drift = self.constraint_drift(configuration, velocity)
        return TreeState(configuration, velocity, self._complete(jacobian, held, second, drift))

    def platform_placement(self, configuration: Array) -> pin.SE3:
        """Return the platform frame in the world for a tree configuration."""
        pin.forwardKinematics(self.model, self.data, configuration)
        return self.data.oMi[self._platform_joint].copy()

    # Dynamics

    def friction(self, qd: ArrayLike) -> Array:
        """Return the actuator effort that friction costs, shape (3,)."""
        rates = np.asarray(qd, dtype=float)
        turn = np.tanh(rates / self.friction_band) if self.friction_band else np.sign(rates)
        effort: Array = self.viscous * rates + self.coulomb * turn
        return effort

    def _external(self, configuration: Array, wrench: ArrayLike | None) -> Any:
        forces = pin.StdVec_Force()
        forces.extend([pin.Force.Zero()] * self.model.njoints)
        if wrench is not None:
            world = np.asarray(wrench, dtype=float)
            rotation = self.platform_placement(configuration).rotation
            forces[self._platform_joint] = pin.Force(rotation.T @ world[:3], rotation.T @ world[3:])
        return forces

    def rnea_only(self, tree: TreeState, wrench: ArrayLike | None = None) -> Array:
        """Return the tree's generalised forces by the recursive Newton-Euler sweep, shape (nv,)."""
        forces = self._external(tree.q, wrench)
        effort: Array = pin.rnea(self.model, self.data, tree.q, tree.v, tree.a, forces)
        return effort.copy()

    def actuator_effort(self, tree: TreeState, wrench: ArrayLike | None = None) -> tuple[Array, Array]:
        """Split the tree's generalised forces into actuator efforts and loop multipliers.

        Solves ``rnea = B tau + Jc^T lambda``: as many equations as unknowns.

        :returns: efforts without friction, shape (3,), and multipliers, shape (constraints,).
        """
        generalised = self.rnea_only(tree, wrench)
        jacobian = self.constraint_jacobian(tree.q)
        multipliers = np.linalg.solve(jacobian[:, self.passive].T, generalised[self.passive])
        effort = generalised[self.actuated] - jacobian[:, self.actuated].T @ multipliers
        return effort, multipliers

    def transmitted(self, tree: TreeState, wrench: ArrayLike | None = None) -> tuple[dict[str, Array], list[Array]]:
        """What the joints transmit: the recursive sweep with the loops' multipliers as loads.

        :returns: for every tree joint, by name, the wrench that its parent applies to its body, at
            its origin, world axes, shape (6,), N and N m; for every point loop the wrench that its
            second body applies to its first at that point, with the couples of perpendicular loops
            between the same frames.
        """
        _, multipliers = self.actuator_effort(tree, wrench)
        forces = self._external(tree.q, wrench)
        pin.forwardKinematics(self.model, self.data, tree.q)
        pin.updateFramePlacements(self.model, self.data)
        count = len(self._points)
        ends = {pair: k for k, pair in enumerate(self._points)}
        loops = [np.concatenate((part, np.zeros(3))) for part in multipliers[: 3 * count].reshape(-1, 3)]
        for (a, x, b, y), couple in zip(self._perpendiculars, multipliers[3 * count :].tolist(), strict=True):
            normal = cross(self.data.oMf[a].rotation @ x, self.data.oMf[b].rotation @ y)
            loops[ends[PointLoop(a, b)]][3:] += couple * normal
        for (a, b), load in zip(self._points, loops, strict=True):
            for frame, sign in ((a, 1.0), (b, -1.0)):
                joint = self.model.frames[frame].parentJoint
                lever = self.data.oMf[frame].translation
                about_origin = pin.Force(sign * load[:3], sign * (load[3:] + cross(lever, load[:3])))
                forces[joint] = forces[joint] + self.data.oMi[joint].actInv(about_origin)
        pin.rnea(self.model, self.data, tree.q, tree.v, tree.a, forces)
        found = {}
        for joint in range(1, self.model.njoints):
            turn, force = self.data.oMi[joint].rotation, self.data.f[joint]
            found[self.model.names[joint]] = np.concatenate((turn @ force.linear, turn @ force.angular))
        return found, loops

    def inverse_dynamics(
        self,
        q: ArrayLike,
        qd: ArrayLike,
        qdd: ArrayLike,
        wrench: ArrayLike | None = None,
    ) -> Array:
        """Return what the actuators must apply, friction included, shape (3,), N m or N.

        :param wrench: force and moment that the surroundings apply to the platform at its origin,
            world axes, shape (6,), N and N m.
        """
        tree = self.state(q, qd, qdd)
        return self.actuator_effort(tree, wrench)[0] + self.friction(qd)

    def forward_dynamics(
        self,
        configuration: Array,
        velocity: Array,
        effort: ArrayLike,
        wrench: ArrayLike | None = None,
        stabilisation: float = 0.0,
    ) -> Array:
        """Return the tree's acceleration under actuator efforts, shape (nv,).

        Solves the KKT system of Pinocchio's mass matrix and the loops' Jacobian. The mass matrix
        may be singular in directions that the loops rule out.

        :param effort: what the actuators apply, shape (3,); friction is taken off here.
        :param stabilisation: Baumgarte's rate, 1/s; zero leaves the loops' errors alone.
        """
        nv, nc = self.model.nv, self.constraint_count
        drift = self.constraint_drift(configuration, velocity)
        error = self._error_from_placements() if stabilisation else 0.0
        forces = self._external(configuration, wrench)
        bias = pin.rnea(self.model, self.data, configuration, velocity, np.zeros(nv), forces).copy()
        jacobian = self.constraint_jacobian(configuration)
        upper = np.triu(pin.crba(self.model, self.data, configuration))
        system = np.zeros((nv + nc, nv + nc))
        system[:nv, :nv] = upper + np.triu(upper, 1).T
        system[:nv, nv:] = jacobian.T
        system[nv:, :nv] = jacobian
        right = np.empty(nv + nc)
        right[:nv] = -bias
        right[self.actuated] += np.asarray(effort, dtype=float) - self.friction(velocity[self.actuated])
        right[nv:] = -drift
        if stabilisation:
            right[nv:] -= 2.0 * stabilisation * (jacobian @ velocity) + stabilisation**2 * error
        acceleration: Array = np.linalg.solve(system, right)[:nv]
        return acceleration

    def step(
        self,
        configuration: Array,
        velocity: Array,
        effort: ArrayLike,
        wrench: ArrayLike | None,
        duration: float,
    ) -> tuple[Array, Array]:
        """Integrate over ``duration`` by one Runge-Kutta step, effort and wrench held.

        The loops are closed again afterwards, the actuated joints kept where they came out.

        :returns: configuration and velocity, shape (nv,) each.
        """
        half = duration / 2.0
        v1 = velocity
        a1 = self.forward_dynamics(configuration, v1, effort, wrench)
        v2 = velocity + half * a1
        a2 = self.forward_dynamics(configuration + half * v1, v2, effort, wrench)
        v3 = velocity + half * a2
        a3 = self.forward_dynamics(configuration + half * v2, v3, effort, wrench)
        v4 = velocity + duration * a3
        a4 = self.forward_dynamics(configuration + duration * v3, v4, effort, wrench)
        mean = (v1 + 2.0 * v2 + 2.0 * v3 + v4) / 6.0
        moved = configuration + duration * mean
        rates = velocity + duration * (a1 + 2.0 * a2 + 2.0 * a3 + a4) / 6.0
        closed = self._polish(moved)
        return closed, self.velocity(closed, rates[self.actuated])

    def _polish(self, configuration: Array) -> Array:
        """Close loops that stand open by an integration error: two Newton steps."""
        closed = configuration.copy()
        for _ in range(2):
            jacobian = self.constraint_jacobian(closed)
            error = self._error_from_placements()
            closed[self.passive] -= np.linalg.solve(jacobian[:, self.passive], error)
        return closed

    def energy(self, configuration: Array, velocity: Array) -> float:
        """Return kinetic and potential energy of all bodies, J."""
        kinetic = pin.computeKineticEnergy(self.model, self.data, configuration, velocity)
        return float(kinetic + pin.computePotentialEnergy(self.model, self.data, configuration))

    # Building blocks

    def _body(self, joint: int, mass: float, com: ArrayLike, inertia: ArrayLike) -> None:
        """Add a body to a joint; ``inertia`` about its own centre of mass, in joint axes."""
        self.model.appendBodyToJoint(
            joint,
            pin.Inertia(mass, np.asarray(com, dtype=float), np.asarray(inertia, dtype=float)),
            pin.SE3.Identity(),
        )

    def _frame(self, name: str, joint: int, point: ArrayLike) -> int:
        placement = pin.SE3(np.eye(3), np.asarray(point, dtype=float))
        frame = pin.Frame(name, joint, 0, placement, pin.FrameType.OP_FRAME)
        return int(self.model.addFrame(frame))

    def _set_armature(self, joint: int, inertia: float) -> None:
        armature = self.model.armature.copy()
        armature[self.model.joints[joint].idx_v] = inertia
        self.model.armature = armature

    def _payload(self, joint: int) -> None:
        payload = self.params.get("payload") or {}
        mass = float(payload.get("mass", 0.0))
        if mass:
            com = payload.get("com", (0.0, 0.0, 0.0))
            self._body(joint, mass, com, matrix3(payload.get("inertia", (0.0, 0.0, 0.0))))


def cross(one: Array, other: Array) -> Array:
    product: Array = pin.skew(one) @ other
    return product


def _three(value: Any) -> Array:
    three: Array = np.broadcast_to(np.asarray(value, dtype=float), (3,)).copy()
    return three


def matrix3(value: ArrayLike) -> Array:
    """Return an inertia matrix from nine numbers or from its diagonal, shape (3, 3), kg m2."""
    array = np.asarray(value, dtype=float)
    return np.diag(array) if array.shape == (3,) else array.reshape(3, 3)
