# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Dynamics of a motion that is given by the platform's pose, without forward kinematics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from delta_dynamics.torques.virtual_work import (
    Forces,
    add_friction_and_rotors,
    efforts_for_acceleration,
    efforts_of_motion,
    mass_entries,
    solve_accelerations,
    solve_leading_accelerations,
)
from pkm_twin.codegen.arrays import Array, vectors
from pkm_twin.codegen.code import REJECTED, VALID
from pkm_twin.codegen.expressions import PARAMETERS, Numbers, Objects, cross, snapped_all
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.lu import SparseLU
from pkm_twin.codegen.program import Program
from pkm_twin.kinematics import programs
from pkm_twin.kinematics.motion import BaseMotion, Motion
from pkm_twin.kinematics.posed import PlatformFirstScheme
from pkm_twin.kinematics.programs import certify_assembly, iterate_pose, pose_factors, solve_pose
from pkm_twin.kinematics.traced import Traced
from pkm_twin.machine.graph import BASE
from pkm_twin.machine.inertia import ROTORS_PART, Layout, list_loaded_joints, lump_inertia, make_frame_change
from pkm_twin.machine.joints import UNIT_VECTORS
from pkm_twin.robot.rejection import make_pivot_error
from pkm_twin.robot.robot import Robot


@dataclass(frozen=True)
class PoseMotion:
    """Joint positions, rates, accelerations and efforts of a motion of the pose, (..., n) each.

    ``acceleration``: second derivatives of the pose coordinates in time, shape (..., m).
    """

    q: Array
    qd: Array
    qdd: Array
    tau: Array
    acceleration: Array


def inverse_dynamics_at_pose(
    robot: Robot,
    pose: ArrayLike,
    rate: ArrayLike,
    acceleration: ArrayLike,
    wrench: ArrayLike | None = None,
) -> PoseMotion:
    """Compute joint motion and actuator efforts for a motion of the platform.

    The efforts are those of :func:`inverse_dynamics`; nothing is iterated where all limbs have
    closed forms. The order is that of the 3-PRRU paper: generalised forces of all bodies on the
    pose coordinates, then F_d.

    :param pose: pose, shape (..., m), m and rad, by ``robot.pose_names``.
    :param rate: first derivatives of the pose coordinates in time, shape (..., m).
    :param acceleration: second derivatives of the pose coordinates in time, shape (..., m).
    :param wrench: external force and moment on the platform at its reference point, base axes,
        shape (..., 6), N and N m; None: no wrench.
    :raises UnreachableError: a pose that is not reached, by limb, sample and miss.
    :raises SingularityError: a pose beyond a singularity, or in one.
    :raises ValueError: a wrong last axis, or a value that is not finite.
    """
    load = np.zeros(6) if wrench is None else wrench
    given = pose, rate, acceleration, load
    q, qd, qdd, tau = evaluate_at_pose(robot, pose_torque_kernel, robot.inertial, *given)
    return PoseMotion(q, qd, qdd, tau, np.broadcast_to(acceleration, (*q.shape[:-1], len(robot.pose_names))))


def forward_dynamics_at_pose(
    robot: Robot,
    pose: ArrayLike,
    rate: ArrayLike,
    tau: ArrayLike,
    wrench: ArrayLike | None = None,
) -> PoseMotion:
    """Compute the accelerations of platform and joints that efforts cause at a pose.

    The inverse of :func:`inverse_dynamics_at_pose`, with the accelerations of
    :func:`forward_dynamics`. The equations are solved in the pose coordinates x, with joint rates
    B x': B' M B x'' = B' (tau - efforts at x'' = 0).

    :param tau: efforts of the actuators, shape (..., n), N m or N. Other parameters and errors as
        in :func:`inverse_dynamics_at_pose`.
    """
    load = np.zeros(6) if wrench is None else wrench
    efforts = vectors(tau, robot.joints_count, "efforts")
    q, qd, qdd, acceleration = evaluate_at_pose(
        robot, pose_acceleration_kernel, robot.inertial, pose, rate, efforts, load
    )
    return PoseMotion(q, qd, qdd, np.broadcast_to(efforts, q.shape), acceleration)


def mass_matrix_at_pose(robot: Robot, pose: ArrayLike) -> Array:
    """Compute the mass matrix on the actuated joints, as :func:`mass_matrix`, shape (..., n, n).

    Parameters and errors as in :func:`inverse_dynamics_at_pose`.
    """
    n = robot.joints_count
    flat = evaluate_at_pose(robot, pose_mass_kernel, robot.inertial, pose)[0]
    return flat.reshape(*flat.shape[:-1], n, n)


class PoseKernel(Protocol):
    """A function that returns a robot's program whose first input is a pose."""

    def __call__(self, robot: Robot, *, certified: bool) -> Kernel:
        """Return the program.

        :param certified: reject poses that the quick inverse kinematics rejects; otherwise the
            caller must give poses that the inverse kinematics accepts.
        """


def evaluate_at_pose(robot: Robot, kernel: PoseKernel, p: Array, *given: ArrayLike) -> list[Array]:
    """Evaluate a program of poses and other inputs, for poses that the inverse kinematics accepts.

    :param p: the program's parameters. ``given``: poses, shape (..., m), and the other inputs.
    :raises UnreachableError: as the inverse kinematics; also SingularityError.
    :raises ValueError: an input that is not finite.
    """
    found, status = kernel(robot, certified=True)(p, *given)
    if status is not None:
        rows = [np.broadcast_to(a, (*status.shape[:-1], np.shape(a)[-1])) for a in given]
        robot.inverse(rows[0])
        left = status[..., 0] != VALID
        again, status = kernel(robot, certified=False)(p, *(row[left] for row in rows))
        if status is not None:
            lost = np.flatnonzero(status[:, 0] == REJECTED)
            if not len(lost):
                raise ValueError("an input in addition to the pose is not finite, or too large")
            index = tuple(int(k) for k in np.argwhere(left)[lost[0]])
            q = robot.inverse(rows[0][index])[robot.graph.leading]
            raise make_pivot_error("pose", index, robot.engine.follow_line(q)[2])
        for values, new in zip(found, again, strict=True):
            values[left] = new
    return found


def _compile_at_pose(robot: Robot, name: str, write: Callable[..., Program], *, certified: bool) -> Kernel:
    """Return the compiled program; without a closed form ``certified`` makes no difference.

    :raises ParameterError: a robot whose file gives no masses.
    """
    engine = robot.massive()
    certified = certified or engine.posed is None
    place = "pose" if certified else "accepted pose"
    return engine.posed_kernel(f"{name} at {place}", partial(write, certified=certified))


def pose_torque_kernel(robot: Robot, *, certified: bool) -> Kernel:
    """Return the program from pose, rate, acceleration and wrench to q, qd, qdd and efforts."""
    return _compile_at_pose(robot, "torques", _write_pose_torques, certified=certified)


def iterated_pose_torque_kernel(robot: Robot) -> Kernel:
    """Return :func:`pose_torque_kernel` by iteration on the machine's own tree, valid for other dimensions.

    Poses are accepted as by :attr:`.engine.Engine.generic_inverse`.
    """
    engine = robot.massive()
    write = partial(_write_pose_torques, scheme=None, certified=True)
    return engine.kernel("followed torques at pose", write, repr(engine.inverse_pivots))


def pose_mass_kernel(robot: Robot, *, certified: bool) -> Kernel:
    """Build the kernel that computes the mass matrices in joint and in pose coordinates from a pose.

    :param certified: see :meth:`PoseKernel.__call__`.
    """
    return _compile_at_pose(robot, "mass matrix", _write_pose_mass_matrix, certified=certified)


def pose_acceleration_kernel(robot: Robot, *, certified: bool) -> Kernel:
    """Build the kernel that computes q, qd, qdd and the pose's second derivative.

    Inputs: pose, pose rate, efforts and wrench. ``certified``: as for :func:`pose_mass_kernel`.
    """
    return _compile_at_pose(robot, "accelerations", _write_pose_accelerations, certified=certified)


class _RecursiveForces(Forces):
    """Forces whose couples follow from the bodies' turning in their own axes, and go down the tree there.

    This takes fewer operations than base axes where most joints turn.
    """

    def __init__(self, motion: Motion, *, accelerated: bool) -> None:
        """Find angular velocities and, after accelerations are set, angular accelerations of all bodies."""
        super().__init__(motion)
        self._turning: dict[str, tuple[Any, Any]] = {}
        self._turning[BASE] = motion.omega[BASE], motion.alpha[BASE] if accelerated else np.zeros(3)
        for link in motion.tree.links.values():
            w, al = self._turning[link.parent]
            for step in link.steps:
                if step.ball or step.free:
                    own = motion.rotation[link.body].T
                    w, al = own @ motion.omega[link.body], own @ motion.alpha[link.body] if accelerated else al
                elif step.turns:
                    turn, rate = motion.turn(step).T, motion.rate[id(step)]
                    w = turn @ w
                    if accelerated:
                        al = turn @ al + UNIT_VECTORS[2] * motion.second[id(step)] + cross(w, UNIT_VECTORS[2]) * rate
                    w = w + UNIT_VECTORS[2] * rate
            self._turning[link.body] = w, al

    def omega(self, name: str) -> Any:
        return self._turning[name][0]

    def alpha(self, name: str) -> Any:
        return self._turning[name][1]

    def add_couple(self, name: str, couple: Objects) -> None:
        self.couple[name] = self.couple[name] + couple


class _PoseDrivenMachine:
    """Motion and forces as expressions, on a tree in which the pose coordinates are actuated.

    ``q``: positions of all drives; ``drives``: their rates per pose rate; ``lead``: factors of the
    leading drives' rows of these; ``parts``: the parts of the parameter vector.
    """

    def __init__(self, t: Traced, scheme: PlatformFirstScheme, *, certified: bool) -> None:
        self.t, self.scheme, self.certified = t, scheme, certified
        self.posed, self.q = solve_pose(t, scheme)
        self.layout = Layout(t.tree)
        self.parts = self.layout.split(t.tape.inputs(PARAMETERS, self.layout.size))
        self.drives = self.posed.fast_rates_of_joints(t.graph.actuated)
        self.lead = SparseLU(self.drives[t.drives.leading], scheme.drive_pivots)
        t.drives.set_null_rows([self.lead.solve_transposed(self.drives[k]) for k in t.drives.others])

    def program(self, outputs: dict[str, Numbers], **inputs: int) -> Program:
        """Return the program; ``inputs``: sizes of the inputs after the pose."""
        t, posed = self.t, self.posed
        branch = t.pivot_margins(self.lead, t.drive_scales, t.pose_scales)
        certain = certify_assembly(t, self.scheme, posed, self.q) if self.certified else []
        return Program(
            {"pose": len(posed.q)} | inputs,
            self.layout.size,
            {name: t.lift(values) for name, values in outputs.items()},
            posed.equations(branch=branch, certain=t.lift(certain)),
            single=self.certified,
        )

    @cached_property
    def _bodies(self) -> Objects:
        """Inertial parameters of all bodies in the frames of the pose-driven tree."""
        t, layout, tree = self.t, self.layout, self.posed.tree
        p = t.tape.inputs(PARAMETERS, layout.size)
        rows: list[Any] = []
        for name, link in tree.links.items():
            if name not in t.tree.links:
                rows.append(np.zeros(10))
                continue
            lever = snapped_all(t.tree.at[name] - link.at)
            rows.append(make_frame_change(link.axes, lever) @ p[layout.body(name)])
        return np.array(rows, dtype=object)

    def select_drives(self, values: Objects) -> list[Any]:
        """Select the rates or accelerations of all drives from those of all unknowns."""
        return [values[self.posed.tree.steps[name].rate] for name in self.t.graph.actuated]

    def add_inertia(self, add: Callable[[Forces, Objects, Objects], None], *, accelerated: bool) -> Forces:
        """Return the forces, or momenta, of all bodies and rods, by a method of :class:`Forces`."""
        forces = _RecursiveForces(self.posed.motion, accelerated=accelerated)
        add(forces, lump_inertia(self.posed.tree, self._bodies), self.parts[1])
        return forces

    def forces(self, rate: Numbers, acceleration: Numbers) -> Objects:
        """Set the motion; return J_M' Q_M + sum of J_Hij' Q_Hij on the pose (3-PRRU paper, equation 40)."""
        t, posed, passive = self.t, self.posed, self.parts[-1]
        posed.set_rates(rate)
        posed.set_accelerations(acceleration, BaseMotion.at_rest(self.parts[2]))
        forces = self.add_inertia(Forces.add_inertia, accelerated=True)
        for k, joint in enumerate(list_loaded_joints(t.graph)):
            forces.add_passive_joint(joint, passive[3 * k : 3 * k + 3])
        forces.subtract_wrench(t.tape.inputs("wrench", 6))
        unknown, on_pose = forces.generalised_forces()
        jq: Objects = posed.jq[self.scheme.independent]
        multipliers = posed.lu.solve_transposed(unknown[self.scheme.varying])
        return np.asarray(on_pose - jq.T @ multipliers, object)

    def pose_mass_matrix(self) -> Objects:
        """Return the mass matrix on the pose coordinates, rotors included.

        With the mass matrix H of the open tree by pose x and unknowns u, and u' = -Ju^-1 Jx x', it is
        Hxx - W Jx - (W Jx)' + Jx' Y Jx with W = Hxu Ju^-1, Y = Ju^-T Huu Ju^-1.
        """
        t, posed, passive = self.t, self.posed, self.parts[-1]
        free, m = posed.tree.unknown_rates, len(posed.q)
        table = np.zeros((m + free, m + free), dtype=object)
        for k, unit in enumerate(np.eye(m + free)):
            posed.motion.set_rates(unit[m:], unit[:m])
            forces = self.add_inertia(Forces.add_momenta, accelerated=False)
            for j, joint in enumerate(list_loaded_joints(t.graph)):
                forces.add_joint_effort(joint, passive[3 * j + 2] * forces.relative_motion(joint, accelerated=False)[0])
            unknown, driven = forces.generalised_forces()
            # Of both symmetric entries take that of the rate farther from the base: it moves fewer bodies.
            table[: k + 1, k] = table[k, : k + 1] = [*driven, *unknown][: k + 1]
        kept = [m + k for k in self.scheme.varying]
        jq, lu = posed.jq[self.scheme.independent], posed.lu
        left = np.array([lu.solve_transposed(table[kept, k]) for k in kept], dtype=object).T
        both = [lu.solve_transposed(row) for row in left]
        coupled = np.array([lu.solve_transposed(table[kept, k]) for k in range(m)], dtype=object) @ jq
        by_rates = _complete_symmetric(both) @ jq
        mass = table[:m, :m] - coupled - coupled.T + jq.T @ by_rates
        for rotor, row in zip(self.parts[ROTORS_PART], self.drives, strict=True):
            mass = mass + rotor * row[:, None] * row
        return _complete_symmetric(mass)


def _complete_symmetric(matrix: Any) -> Objects:
    """Return the whole symmetric matrix whose lower triangle is given."""
    return np.array([[matrix[max(i, k)][min(i, k)] for k in range(len(matrix))] for i in range(len(matrix))], object)


class _IteratedMachine:
    """Motion as expressions, with joints that Newton's method finds from the pose on the own tree.

    ``q``: positions of the leading drives; ``lead``: factors of the pose rates by their rates.
    """

    def __init__(self, t: Traced) -> None:
        self.t = t
        self.equations, self.q = iterate_pose(t, rates=True)
        self.layout = Layout(t.tree)
        self.parts = self.layout.split(t.tape.inputs(PARAMETERS, self.layout.size))
        self.lead = pose_factors(t)

    def program(self, outputs: dict[str, Numbers], **inputs: int) -> Program:
        """Return the program; ``inputs``: sizes of the inputs after the pose."""
        made = {name: self.t.lift(values) for name, values in outputs.items()}
        return Program({"pose": self.t.joints} | inputs, self.layout.size, made, self.equations)

    def drift(self, rate: Numbers) -> tuple[Objects, Objects]:
        """Return the leading drives' rates, and the pose's accelerations at constant rates."""
        t, qd = self.t, self.lead.solve(rate)
        t.set_rates(qd)
        t.set_accelerations(np.zeros(t.joints))
        return qd, np.array(programs.pose_accelerations(t), dtype=object)

    def motion(self, qd: Numbers, qdd: Numbers) -> dict[str, Numbers]:
        """Return positions, rates and accelerations of all drives from those of the leading drives."""
        t, tree = self.t, self.t.tree
        return {
            "q": tree.drive_positions(self.q, t.x),
            "qd": tree.drive_rates(qd, t.u),
            "qdd": tree.drive_rates(qdd, t.du),
        }


def _write_pose_torques(t: Traced, scheme: PlatformFirstScheme | None, *, certified: bool) -> Program:
    m = len(t.scheme.coordinates)
    sizes = {"rate": m, "acceleration": m, "wrench": 6}
    rate, acceleration = (t.tape.inputs(name, m) for name in ("rate", "acceleration"))
    if scheme is None:
        own = _IteratedMachine(t)
        qd, drift = own.drift(rate)
        qdd = own.lead.solve(acceleration - drift)
        efforts, _ = efforts_of_motion(t, own.parts, qd, qdd)
        return own.program(own.motion(qd, qdd) | {"tau": t.drives.distribute(efforts, preload=True)}, **sizes)
    made = _PoseDrivenMachine(t, scheme, certified=certified)
    # F_d = -J^-T (J_M' Q_M + sum of J_Hij' Q_Hij) - Q_S with J = dq/dX (equations 24 and 41); needed forces
    # are minus Q.
    f_d = made.lead.solve_transposed(made.forces(rate, acceleration))
    rates, changes = (made.select_drives(values) for values in (made.posed.u, made.posed.du))
    leads = add_friction_and_rotors(t, made.parts, f_d, made.q, rates, changes)[0]
    tau = t.drives.distribute(leads, preload=True)
    return made.program({"q": made.q, "qd": rates, "qdd": changes, "tau": tau}, **sizes)


def _write_pose_mass_matrix(t: Traced, scheme: PlatformFirstScheme | None, *, certified: bool) -> Program:
    """Write the program of the mass matrices by drive rates and by pose rates."""
    m = len(t.scheme.coordinates)
    if scheme is None:
        own: _IteratedMachine | _PoseDrivenMachine = _IteratedMachine(t)
        mass = np.reshape(mass_entries(t, own.parts), (m, m))
        rates = np.array([own.lead.solve(unit) for unit in np.eye(m)], dtype=object)
        on_pose = rates @ mass @ rates.T
    else:
        own = made = _PoseDrivenMachine(t, scheme, certified=certified)
        on_pose = made.pose_mass_matrix()
        half = np.array([made.lead.solve_transposed(row) for row in on_pose], dtype=object).T
        mass = _complete_symmetric([made.lead.solve_transposed(row) for row in half])
    return own.program({"matrix": t.drives.distribute_matrix(mass), "on pose": np.ravel(on_pose)})


def _write_pose_accelerations(t: Traced, scheme: PlatformFirstScheme | None, *, certified: bool) -> Program:
    m = len(t.scheme.coordinates)
    sizes = {"rate": m, "tau": t.drives.count, "wrench": 6}
    rate, tau = t.tape.inputs("rate", m), t.tape.inputs("tau", t.drives.count)
    if scheme is None:
        own = _IteratedMachine(t)
        qd, _ = own.drift(rate)
        leads = solve_leading_accelerations(t, own.parts, qd, tau)
        t.set_rates(qd)
        t.set_accelerations(leads)
        found: dict[str, Numbers] = {"acceleration": programs.pose_accelerations(t)}
        return own.program(own.motion(qd, leads) | found, **sizes)
    made = _PoseDrivenMachine(t, scheme, certified=certified)
    on_pose = made.forces(rate, np.zeros(m))
    rates, drift = (made.select_drives(values) for values in (made.posed.u, made.posed.du))
    # Only friction that grows with the load needs the drives' loads.
    by_load = bool(t.graph.laws) and not t.drives.others
    loads = made.lead.solve_transposed(on_pose) if by_load else np.zeros(m)
    rest = efforts_for_acceleration(t, made.parts, t.drives.leading_efforts([*tau]), loads, made.q, rates, drift)
    forces = made.drives[t.drives.leading].T @ rest - (0.0 if by_load else on_pose)
    acceleration = np.array(solve_accelerations(made.pose_mass_matrix(), forces), dtype=object)
    outputs = {"q": made.q, "qd": rates, "qdd": made.drives @ acceleration + drift, "acceleration": acceleration}
    return made.program(outputs, **sizes)
