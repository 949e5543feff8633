# SPDX-License-Identifier: Apache-2.0
"""Multibody engines on Pinocchio: an open tree of bodies and the loops that close it.

The bodies hang in a tree (every limb from the base, the platform from the base on its own free
joints) and each limb's end is tied to the platform by constraints. Kinematics come from Newton's
method on those constraints, inertia forces from Pinocchio's recursions on the tree, actuator
torques and loop reactions from one linear system. No formula is shared with the twin, which works
with closed vector loops and virtual work instead.

May import: pinocchio, numpy, the standard library.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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
            normal = _cross(self.data.oMf[a].rotation @ x, self.data.oMf[b].rotation @ y)
            relative = self._frame_jacobian(a)[3:] - self._frame_jacobian(b)[3:]
            jacobian[row] = normal @ relative
            row += 1
        return jacobian

    def _frame_jacobian(self, frame: int) -> Array:
        jacobian: Array = pin.getFrameJacobian(self.model, self.data, frame, _WORLD)
        return jacobian

    def constraint_drift(self, configuration: Array, velocity: Array) -> Array:
        """Return the loops' second derivative at zero tree acceleration, shape (constraints,)."""
        pin.forwardKinematics(
            self.model, self.data, configuration, velocity, np.zeros(self.model.nv)
        )
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
            turning = _cross(_cross(rate_a, axis_a), axis_b) + _cross(
                axis_a, _cross(rate_b, axis_b)
            )
            value = (spin_a - spin_b) @ _cross(axis_a, axis_b) + (rate_a - rate_b) @ turning
            drift.append(np.array([value]))
        return np.concatenate(drift)

    def _point_acceleration(self, frame: int) -> Array:
        acceleration: Array = pin.getFrameClassicalAcceleration(
            self.model, self.data, frame, _WORLD
        ).linear
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

    def _complete(
        self, jacobian: Array, held: Array, values: ArrayLike, drift: Array | float
    ) -> Array:
        free = self._others(held)
        full = np.empty(self.model.nv)
        full[held] = values
        full[free] = np.linalg.solve(jacobian[:, free], -(jacobian[:, held] @ full[held]) - drift)
        return full

    def state(
        self, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, near: Array | None = None
    ) -> TreeState:
        """Return the whole tree's motion for the actuators' motion, consistent with the loops.

        :param q: actuator positions, shape (3,), rad or m; ``qd``, ``qdd`` their derivatives.
        :param near: a tree configuration to start Newton's method from.
        """
        return self._motion(self.assemble(q, near), self.actuated, qd, qdd)

    def pose_state(
        self, pose: ArrayLike, rate: ArrayLike, second: ArrayLike, near: Array | None = None
    ) -> TreeState:
        """Return the whole tree's motion for the platform's motion; else as `state`.

        :param pose: the platform's three coordinates; ``rate``, ``second`` their derivatives.
        """
        return self._motion(self.assemble_pose(pose, near), self.pose_places, rate, second)

    def _motion(
        self, configuration: Array, held: Array, rate: ArrayLike, second: ArrayLike
    ) -> TreeState:
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

    def actuator_effort(
        self, tree: TreeState, wrench: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """Split the tree's generalised forces into actuator efforts and loop multipliers.

        Solves ``rnea = B tau + Jc^T lambda``: as many equations as unknowns.

        :returns: efforts without friction, shape (3,), and multipliers, shape (constraints,).
        """
        generalised = self.rnea_only(tree, wrench)
        jacobian = self.constraint_jacobian(tree.q)
        multipliers = np.linalg.solve(jacobian[:, self.passive].T, generalised[self.passive])
        effort = generalised[self.actuated] - jacobian[:, self.actuated].T @ multipliers
        return effort, multipliers

    def transmitted(
        self, tree: TreeState, wrench: ArrayLike | None = None
    ) -> tuple[dict[str, Array], list[Array]]:
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
        loops = [
            np.concatenate((part, np.zeros(3))) for part in multipliers[: 3 * count].reshape(-1, 3)
        ]
        for (a, x, b, y), couple in zip(
            self._perpendiculars, multipliers[3 * count :].tolist(), strict=True
        ):
            normal = _cross(self.data.oMf[a].rotation @ x, self.data.oMf[b].rotation @ y)
            loops[ends[PointLoop(a, b)]][3:] += couple * normal
        for (a, b), load in zip(self._points, loops, strict=True):
            for frame, sign in ((a, 1.0), (b, -1.0)):
                joint = self.model.frames[frame].parentJoint
                lever = self.data.oMf[frame].translation
                about_origin = pin.Force(
                    sign * load[:3], sign * (load[3:] + _cross(lever, load[:3]))
                )
                forces[joint] = forces[joint] + self.data.oMi[joint].actInv(about_origin)
        pin.rnea(self.model, self.data, tree.q, tree.v, tree.a, forces)
        found = {}
        for joint in range(1, self.model.njoints):
            turn, force = self.data.oMi[joint].rotation, self.data.f[joint]
            found[self.model.names[joint]] = np.concatenate(
                (turn @ force.linear, turn @ force.angular)
            )
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
        right[self.actuated] += np.asarray(effort, dtype=float) - self.friction(
            velocity[self.actuated]
        )
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


class DeltaEngine(LoopEngine):
    """A Delta: three prismatic joints carry the platform, three arms and forearms hold it.

    Closure ``rod``: two rotations between arm and forearm, the forearm's end on the platform's
    point. Closure ``rcu``: the forearm slides along the elbow's axis, turns about it and stays at
    a right angle to it. Both rods of a parallelogram move alike, so one thin rod of their mass in
    the middle stands for them; it has no inertia about itself, and its spin no meaning.
    """

    def _build(self) -> None:
        geometry = self.params["geometry"]
        inertia = self.params["inertia"]
        arm_length = float(geometry["arm_length"])
        forearm_length = float(geometry["forearm_length"])
        arm_mass = float(inertia["arm_mass"])
        arm_com = float(inertia.get("arm_com", 0.5))
        across = inertia.get("arm_inertia")
        arm_inertia = arm_mass * arm_length**2 / 12.0 if across is None else float(across)
        forearm_mass = float(inertia["forearm_mass"])
        forearm_inertia = forearm_mass * forearm_length**2 / 12.0
        closures: Sequence[str] = geometry.get("closures", ["rod"] * 3)

        joint = 0
        for name, kind in (
            ("x", pin.JointModelPX()),
            ("y", pin.JointModelPY()),
            ("z", pin.JointModelPZ()),
        ):
            joint = self.model.addJoint(joint, kind, pin.SE3.Identity(), f"platform_{name}")
            self._pose_joints.append(joint)
        self._platform_joint = joint
        self._body(joint, float(inertia["platform_mass"]), np.zeros(3), np.zeros((3, 3)))
        self._payload(joint)

        for limb, (azimuth, closure) in enumerate(
            zip(geometry["azimuths"], closures, strict=True), start=1
        ):
            turn = pin.utils.rpyToMatrix(0.0, 0.0, float(azimuth))
            base = pin.SE3(turn, turn @ np.array([float(geometry["base_radius"]), 0.0, 0.0]))
            arm = self.model.addJoint(0, pin.JointModelRY(), base, f"arm_{limb}")
            self._actuated_joints.append(arm)
            self._set_armature(arm, float(inertia.get("rotor_inertia", 0.0)))
            self._body(
                arm,
                arm_mass,
                (arm_com * arm_length, 0.0, 0.0),
                np.diag((0.0, arm_inertia, arm_inertia)),
            )
            elbow = pin.SE3(np.eye(3), np.array([arm_length, 0.0, 0.0]))
            if closure == "rod":
                first = self.model.addJoint(arm, pin.JointModelRY(), elbow, f"elbow_{limb}_swing")
                forearm = self.model.addJoint(
                    first, pin.JointModelRX(), pin.SE3.Identity(), f"elbow_{limb}_lean"
                )
            elif closure == "rcu":
                first = self.model.addJoint(arm, pin.JointModelPY(), elbow, f"elbow_{limb}_slide")
                forearm = self.model.addJoint(
                    first, pin.JointModelRY(), pin.SE3.Identity(), f"elbow_{limb}_swing"
                )
            else:
                raise ValueError(f"closure {closure!r} is neither 'rod' nor 'rcu'")
            self._body(
                forearm,
                forearm_mass,
                (0.0, 0.0, -forearm_length / 2.0),
                np.diag((forearm_inertia, forearm_inertia, 0.0)),
            )
            end = self._frame(f"forearm_{limb}_end", forearm, (0.0, 0.0, -forearm_length))
            hold = turn @ np.array([float(geometry["platform_radius"]), 0.0, 0.0])
            corner = self._frame(f"platform_{limb}", self._platform_joint, hold)
            self._points.append(PointLoop(end, corner))

    def _guess(self, q: Array) -> Array:
        """Put the platform where three spheres about the elbows meet, below them."""
        geometry = self.params["geometry"]
        azimuths = np.asarray(geometry["azimuths"], dtype=float)
        length = float(geometry["forearm_length"])
        reach = (
            float(geometry["base_radius"])
            - float(geometry["platform_radius"])
            + float(geometry["arm_length"]) * np.cos(q)
        )
        centres = np.column_stack(
            (
                reach * np.cos(azimuths),
                reach * np.sin(azimuths),
                -float(geometry["arm_length"]) * np.sin(q),
            )
        )
        side, other = centres[1] - centres[0], centres[2] - centres[0]
        normal = _cross(side, other)
        scale = normal @ normal
        offset = (
            (other @ other) * _cross(normal, -side) + (side @ side) * _cross(normal, other)
        ) / (-2.0 * scale)
        height = length**2 - offset @ offset
        if height <= 0.0:
            raise AssemblyError(f"the forearms do not reach each other at arm angles {q}")
        downward = -normal / math.sqrt(scale) if normal[2] > 0.0 else normal / math.sqrt(scale)
        position = centres[0] + offset + math.sqrt(height) * downward

        configuration: Array = pin.neutral(self.model)
        configuration[:3] = position
        for limb, azimuth in enumerate(azimuths):
            to_arm = pin.utils.rpyToMatrix(0.0, -q[limb], 0.0) @ pin.utils.rpyToMatrix(
                0.0, 0.0, -azimuth
            )
            local = to_arm @ (position - centres[limb]) / length
            swing = math.atan2(-local[0], -local[2])
            joint = self._actuated_joints[limb] + 1
            first, second = (self._place(joint + k) for k in (0, 1))
            if self.model.joints[joint].shortname() == "JointModelPY":
                configuration[first] = length * local[1]
                configuration[second] = swing
            else:
                configuration[first] = swing
                configuration[second] = math.asin(max(-1.0, min(1.0, float(local[1]))))
        return configuration

    def _home(self, pose: Array) -> Array:
        """Start from level arms, or the nearest common angle that lets the forearms meet."""
        for angle in np.linspace(0.0, 1.5, 16):
            try:
                return self._guess(np.full(3, angle))
            except AssemblyError:
                continue
        raise AssemblyError(f"no symmetric assembly to reach {pose} from")

    def _check_assembly(self, configuration: Array) -> None:
        heights = []
        pin.forwardKinematics(self.model, self.data, configuration)
        for joint in self._actuated_joints:
            heights.append(self.data.oMi[joint + 1].translation[2])
        if not configuration[2] < float(np.mean(heights)):
            raise AssemblyError("the loops closed with the platform above the elbows")

    def platform_position(self, q: ArrayLike) -> Array:
        """Return the platform's centre for arm angles ``q``, shape (3,), m."""
        position: Array = self.assemble(q)[:3].copy()
        return position


class PrruEngine(LoopEngine):
    """A 3-PRRU head: sliders along z, two links on one line in each limb, a tilting platform.

    The first link swings about the limb's tangent, the second turns on the limb's own axis, and a
    universal joint ties its end to the platform: their points coincide, and the joint's one axis,
    the second link's x axis, stays at a right angle to the other, the platform's tangent. The
    platform hangs on six joints whose third to fifth are its pose: z, alpha, beta.

    Beside the keys of the parameter file, ``inertia`` takes ``lower_link_inertia`` and
    ``upper_link_inertia``, each a pair: about the centre of mass across the limb and about the
    limb, kg m2; by default a thin rod as long as the limb.
    """

    def _build(self) -> None:
        geometry = self.params["geometry"]
        inertia = self.params["inertia"]
        self._base_radius = float(geometry["base_radius"])
        self._platform_radius = float(geometry["platform_radius"])
        self._limb_length = float(geometry["limb_length"])
        self._azimuths = np.asarray(geometry["azimuths"], dtype=float)
        branch = str(geometry.get("branch", "below"))
        if branch not in ("above", "below"):
            raise ValueError(f"branch {branch!r} is neither 'above' nor 'below'")
        self._rise = 1.0 if branch == "below" else -1.0

        joint = 0
        for name, kind in (
            ("x", pin.JointModelPX()),
            ("y", pin.JointModelPY()),
            ("z", pin.JointModelPZ()),
            ("alpha", pin.JointModelRX()),
            ("beta", pin.JointModelRY()),
            ("gamma", pin.JointModelRZ()),
        ):
            joint = self.model.addJoint(joint, kind, pin.SE3.Identity(), f"platform_{name}")
            if name in ("z", "alpha", "beta"):
                self._pose_joints.append(joint)
        self._platform_joint = joint
        self._body(
            joint,
            float(inertia["platform_mass"]),
            inertia.get("platform_com", (0.0, 0.0, 0.0)),
            matrix3(inertia["platform_inertia"]),
        )
        self._payload(joint)

        centre = np.array([0.0, 0.0, float(inertia.get("link_com", 0.5)) * self._limb_length])
        for limb, azimuth in enumerate(self._azimuths, start=1):
            turn = pin.utils.rpyToMatrix(0.0, 0.0, float(azimuth))
            inward = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
            rail = pin.SE3(turn, -self._base_radius * inward)
            slider = self.model.addJoint(0, pin.JointModelPZ(), rail, f"slider_{limb}")
            self._actuated_joints.append(slider)
            self._body(slider, float(inertia["slider_mass"]), np.zeros(3), np.zeros((3, 3)))
            joint = slider
            for link, kind in (("lower", pin.JointModelRY()), ("upper", pin.JointModelRZ())):
                joint = self.model.addJoint(joint, kind, pin.SE3.Identity(), f"{link}_link_{limb}")
                mass = float(inertia[f"{link}_link_mass"])
                rod = (mass * self._limb_length**2 / 12.0, 0.0)
                across, about = inertia.get(f"{link}_link_inertia") or rod
                self._body(joint, mass, centre, np.diag((across, across, about)))
            end = self._frame(f"limb_{limb}_end", joint, (0.0, 0.0, self._limb_length))
            corner = self._frame(
                f"platform_{limb}", self._platform_joint, -self._platform_radius * inward
            )
            tangent = np.array([-inward[1], inward[0], 0.0])
            self._points.append(PointLoop(end, corner))
            self._perpendiculars.append(
                PerpendicularLoop(end, np.array([1.0, 0.0, 0.0]), corner, tangent)
            )

    def _guess(self, q: Array) -> Array:
        """Lay a plane through the limbs' ends as if all limbs leaned as at rest."""
        reach = self._base_radius - self._platform_radius
        height = math.sqrt(max(self._limb_length**2 - reach**2, 0.0))
        ends = q + self._rise * height
        radius = self._platform_radius
        plane = np.column_stack(
            (np.ones(3), -radius * np.sin(self._azimuths), radius * np.cos(self._azimuths))
        )
        z, alpha, beta = np.linalg.solve(plane, ends)
        configuration = self._home(np.array([z, *np.clip((alpha, beta), -0.9, 0.9)]))
        configuration[self.actuated] = q
        return configuration

    def _home(self, pose: Array) -> Array:
        z, alpha, beta = pose
        configuration: Array = pin.neutral(self.model)
        configuration[2:5] = pose
        rotation = pin.utils.rpyToMatrix(alpha, 0.0, 0.0) @ pin.utils.rpyToMatrix(0.0, beta, 0.0)
        for limb, azimuth in enumerate(self._azimuths):
            inward = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
            corner = rotation @ (-self._platform_radius * inward) + np.array([0.0, 0.0, z])
            reach = float(corner @ inward) + self._base_radius
            rest = max(self._limb_length**2 - reach**2, 0.01 * self._limb_length**2)
            rise = self._rise * math.sqrt(rest)
            place = self.actuated[limb]
            configuration[place] = corner[2] - rise
            configuration[place + 1] = math.atan2(reach, rise)
        return configuration

    def _check_assembly(self, configuration: Array) -> None:
        pin.forwardKinematics(self.model, self.data, configuration)
        pin.updateFramePlacements(self.model, self.data)
        for place, loop in zip(self.actuated, self._points, strict=True):
            rise = self.data.oMf[loop.frame_a].translation[2] - configuration[place]
            if not rise * self._rise > 0.0:
                raise AssemblyError("a slider came out on the other side of its platform joint")
        if not np.all(np.cos(configuration[3:6]) > 0.0):
            raise AssemblyError("the loops closed with the platform turned over")

    def pose(self, q: ArrayLike) -> Array:
        """Return z, m, alpha and beta, rad, for slider heights ``q``, shape (3,)."""
        pose: Array = self.assemble(q)[self.pose_places].copy()
        return pose


def _cross(one: Array, other: Array) -> Array:
    product: Array = pin.skew(one) @ other
    return product


def _three(value: Any) -> Array:
    three: Array = np.broadcast_to(np.asarray(value, dtype=float), (3,)).copy()
    return three


def matrix3(value: ArrayLike) -> Array:
    """Return an inertia matrix from nine numbers or from its diagonal, shape (3, 3), kg m2."""
    array = np.asarray(value, dtype=float)
    return np.diag(array) if array.shape == (3,) else array.reshape(3, 3)
