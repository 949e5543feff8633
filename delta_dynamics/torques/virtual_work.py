# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Rigid-body dynamics by virtual work, for every machine with masses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array, vectors
from pkm_twin.codegen.cholesky import SparseCholesky
from pkm_twin.codegen.expressions import PARAMETERS, Numbers, Objects, cross
from pkm_twin.codegen.kernels import BoundCall, Kernel
from pkm_twin.codegen.operations import absolute, maximum, minimum, sign
from pkm_twin.codegen.program import Program
from pkm_twin.kinematics.motion import BaseMotion, Motion
from pkm_twin.kinematics.stream import start_from_last
from pkm_twin.kinematics.traced import Traced
from pkm_twin.machine import friction
from pkm_twin.machine.graph import BASE, Joint, Rod
from pkm_twin.machine.inertia import LAWS_PART, ROTORS_PART, Layout, list_loaded_joints
from pkm_twin.robot.robot import Robot

_NO_WRENCH: Final = np.zeros(6)
MASSLESS_RATIO: Final = 1e-12
"""Smallest pivot of the mass matrix over its diagonal entry for which accelerations are computed."""


def inverse_dynamics(
    robot: Robot,
    q: ArrayLike,
    qd: ArrayLike,
    qdd: ArrayLike,
    wrench: ArrayLike | None = None,
    base: ArrayLike | None = None,
) -> Array:
    """Compute the actuator efforts of a motion by exact rigid-body dynamics.

    tau = sum over bodies of Jv' m (a - g) + Jw' (I alpha + omega x I omega), less J' wrench, plus
    friction: the principle of virtual work (Delta-CU paper, step 4, equations 22 and 23).
    Without friction it is the 3-PRRU paper's F_d = -J^-T (J_M' Q_M + sum of J_Hij' Q_Hij) - Q_S
    (equation 41). A sample has no memory: Coulomb friction has the rate's sign, without
    ``presliding``.

    :param q: joint positions, shape (..., n), rad or m.
    :param qd: joint rates, shape (..., n).
    :param qdd: joint accelerations, shape (..., n).
    :param wrench: external force and moment on the platform at its reference point, base axes,
        shape (..., 6), N and N m; None: no wrench.
    :param base: motion of the base in base axes, shape (..., 9): angular velocity, rad/s, angular
        acceleration, rad/s2, and linear acceleration of its origin less gravity, m/s2, as an
        accelerometer there measures it. None: at rest, (0, 0, -gravity).
    :returns: efforts of the actuators, shape (..., n), N m or N.
    :raises UnreachableError: a joint state without an assembly, by limb, sample and miss.
    :raises SingularityError: a singularity on the way from home.
    :raises ValueError: a wrong last axis, or a value that is not finite.
    """
    load = _NO_WRENCH if wrench is None else wrench
    if base is not None:
        return robot.function(moving_base_torque_kernel, robot.inertial)(q, qd, qdd, load, base)
    return robot.function(torque_kernel, robot.inertial)(q, qd, qdd, load)


def torque_kernel(robot: Robot) -> Kernel:
    """Return the program of :func:`inverse_dynamics`: q, qd, qdd and wrench to efforts.

    :raises ParameterError: a robot whose file gives no masses.
    """
    return robot.massive().kernel("torques", torque_program)


def moving_base_torque_kernel(robot: Robot) -> Kernel:
    """Return the program of :func:`inverse_dynamics` with the motion of the base as last input.

    :raises ParameterError: a robot whose file gives no masses.
    """
    return robot.massive().kernel("moving torques", partial(torque_program, base=9))


def stream_torque_kernel(robot: Robot) -> Kernel:
    """Return the program of :func:`inverse_dynamics` that starts from a stream's last sample."""
    return robot.massive().kernel("stream torques", lambda t: start_from_last(t, torque_program(t)))


def mass_matrix(robot: Robot, q: ArrayLike) -> Array:
    """Compute the mass matrix on the actuated joints, payload included, shape (..., n, n)."""
    # The cached function is fast for one sample: a simulation evaluates it several thousand times a second.
    return _reshape_to_rows(robot, robot.function(mass_matrix_kernel, robot.inertial)(q))


def mass_matrix_kernel(robot: Robot) -> Kernel:
    """Return the program of :func:`mass_matrix`: q to its entries, row by row."""
    return robot.massive().kernel("mass matrix", _write_mass_matrix)


def _reshape_to_rows(robot: Robot, flat: Array) -> Array:
    """Reshape the last axis to (n, size / n): one row per joint."""
    return flat.reshape(*flat.shape[:-1], robot.joints_count, flat.shape[-1] // robot.joints_count)


def body_mass_matrix(robot: Robot, q: ArrayLike, body: str) -> Array:
    """Return one body's part of the mass matrix, (..., n, n); the platform's with payload."""
    p, where = np.zeros_like(robot.inertial), Layout(robot.massive().tree).body(body)
    p[where] = robot.inertial[where]
    return _reshape_to_rows(robot, robot.evaluate(mass_matrix_kernel(robot), q, p=p)[0])


def forward_dynamics(
    robot: Robot, q: ArrayLike, qd: ArrayLike, tau: ArrayLike, wrench: ArrayLike | None = None
) -> Array:
    """Compute the joint accelerations that efforts cause, shape (..., n).

    :param tau: efforts of the actuators, shape (..., n), N m or N. Other parameters and errors as
        in :func:`inverse_dynamics`.
    """
    load = _NO_WRENCH if wrench is None else wrench

    def evaluate_checked(q: ArrayLike, qd: ArrayLike, tau: ArrayLike, load: ArrayLike) -> Array:
        efforts = vectors(tau, robot.joints_count, "efforts")
        return robot.evaluate(acceleration_kernel(robot), q, qd, efforts, load, p=robot.inertial)[0]

    return robot.function(acceleration_kernel, robot.inertial, evaluate_checked)(q, qd, tau, load)


def acceleration_kernel(robot: Robot) -> Kernel:
    """Return the program of :func:`forward_dynamics`: q, qd, efforts and wrench to qdd."""
    return robot.massive().kernel("accelerations", _write_accelerations)


@dataclass(frozen=True)
class Energy:
    """Kinetic and potential energy, shape (...), J; the potential is zero at the base's origin."""

    kinetic: Array
    potential: Array

    @property
    def total(self) -> Array:
        """Sum of both, shape (...), J."""
        return self.kinetic + self.potential


def energy(robot: Robot, q: ArrayLike, qd: ArrayLike) -> Energy:
    """Compute the mechanical energy of all bodies and rotors, payload included."""
    kernel = robot.massive().kernel("energy", _write_energy)
    (both,) = robot.evaluate(kernel, q, qd, p=robot.inertial)
    return Energy(both[..., 0].copy(), both[..., 1].copy())


class Forces:
    """The force and moment that each body needs at its origin, base axes: minus Q of the papers.

    :meth:`generalised_forces` sums up their virtual work (Delta-CU paper, step 4, equation 22), and
    that of ``couple``: a further moment, in the body's axes.
    """

    def __init__(self, motion: Motion) -> None:
        self.motion = motion
        none: dict[str, Any] = dict.fromkeys((BASE, *motion.tree.links), np.zeros(3))
        self.force, self.moment, self.couple = none.copy(), none.copy(), none.copy()

    def add_force(self, body: str, point: Array, force: Any) -> None:
        """Add a needed force at a point of a body, given at home."""
        self.force[body] = self.force[body] + force
        self.moment[body] = self.moment[body] + cross(self.motion.arm(body, point), force)

    def add_inertia(self, bodies: Objects, rods: Objects) -> None:
        """Add Newton's and Euler's laws, for the motion's accelerations (less gravity).

        These are minus the 3-PRRU paper's Q_M, Q_S and Q_Hij (equations 32 to 37). Couples of
        bodies that share a rotation act on the first of them: generalised efforts are the same.
        For reactions take :meth:`add_body` of each.
        """
        for name, inertial in zip(self.motion.tree.links, bodies, strict=True):
            self._add_newton(name, inertial)
        for name, matrix in self._sum_inertias(bodies):
            self._add_euler(name, matrix)
        for mass, rod in zip(rods, self.motion.graph.rods.values(), strict=True):
            self.add_rod(rod, mass)

    def add_body(self, name: str, inertial: Objects) -> None:
        """Add the force and moment that one body's acceleration requires."""
        self._add_newton(name, inertial)
        self._add_euler(name, _inertia_matrix(inertial))

    def _add_newton(self, name: str, inertial: Objects) -> None:
        """Add the force m (a - g) + alpha x h + omega x (omega x h) and the moment h x (a - g)."""
        m, mass = self.motion, inertial[0]
        h = m.rotation[name] @ inertial[1:4]
        self.force[name] = self.force[name] + m.origin_acceleration[name] * mass + m.acceleration_matrix(name) @ h
        self.moment[name] = self.moment[name] + cross(h, m.origin_acceleration[name])

    def _add_euler(self, name: str, inertia: Objects) -> None:
        """Add I alpha + omega x I omega, computed in the body's axes."""
        omega = self.omega(name)
        self.add_couple(name, inertia @ self.alpha(name) + cross(omega, inertia @ omega))

    def omega(self, name: str) -> Any:
        """Return a body's angular velocity in its axes."""
        return self.motion.rotation[name].T @ self.motion.omega[name]

    def alpha(self, name: str) -> Any:
        """Return a body's angular acceleration in its axes."""
        return self.motion.rotation[name].T @ self.motion.alpha[name]

    def add_couple(self, name: str, couple: Objects) -> None:
        """Add a moment that is given in a body's axes."""
        self.moment[name] = self.moment[name] + self.motion.rotation[name] @ couple

    def _sum_inertias(self, bodies: Objects) -> list[tuple[str, Objects]]:
        """Return inertia matrices about the origins, summed over bodies with the same rotation."""
        first: dict[int, str] = {}
        found: dict[str, Objects] = {}
        for name, inertial in zip(self.motion.tree.links, bodies, strict=True):
            lead = first.setdefault(id(self.motion.rotation[name]), name)
            inertia = _inertia_matrix(inertial)
            found[lead] = found[lead] + inertia if lead in found else inertia
        return list(found.items())

    def add_rod(self, rod: Rod, mass: Any) -> None:
        """Add the inertial forces of a thin uniform rod of mass m at its two ends.

        m (2 a + b) / 6 at the end with acceleration a and m (a + 2 b) / 6 at the end with b; they
        include the rod's rotation (Delta-CU paper, equations 15 and 16).
        """
        self._share_ends(rod, mass, self.motion.acceleration)

    def _share_ends(self, rod: Rod, mass: Any, motion: Callable[[str, Array], Any]) -> None:
        a, b = motion(rod.inner, rod.ends[0]), motion(rod.outer, rod.ends[1])
        sixth = mass * (1.0 / 6.0)
        self.add_force(rod.inner, rod.ends[0], sixth * (2.0 * a + b))
        self.add_force(rod.outer, rod.ends[1], sixth * (a + 2.0 * b))

    def add_momenta(self, bodies: Objects, rods: Objects) -> None:
        """Add the momenta of the motion's velocities in place of forces."""
        m = self.motion
        for name, inertial in zip(m.tree.links, bodies, strict=True):
            first = m.rotation[name] @ inertial[1:4]
            w, v = m.omega[name], m.origin_velocity[name]
            self.force[name] = self.force[name] + v * inertial[0] + cross(w, first)
            self.moment[name] = self.moment[name] + cross(first, v)
        for name, matrix in self._sum_inertias(bodies):
            self.add_couple(name, matrix @ self.omega(name))
        for mass, rod in zip(rods, m.graph.rods.values(), strict=True):
            self._share_ends(rod, mass, m.velocity)

    def add_passive_joints(self, values: Objects) -> None:
        """Add friction and rotor inertia of passive joints, three numbers per joint."""
        for k, joint in enumerate(list_loaded_joints(self.motion.graph)):
            self.add_passive_joint(joint, values[3 * k : 3 * k + 3])

    def add_passive_joint(self, joint: Joint, three: Numbers) -> None:
        """Add viscous friction, Coulomb friction and rotor inertia of one joint."""
        viscous, coulomb, rotor = three
        rate, second = self.relative_motion(joint, accelerated=True)
        self.add_joint_effort(joint, viscous * rate + coulomb * sign(rate) + rotor * second)

    def add_passive_momenta(self, values: Objects) -> None:
        """Add the momenta of the passive joints' rotors."""
        for k, joint in enumerate(list_loaded_joints(self.motion.graph)):
            self.add_joint_effort(joint, values[3 * k + 2] * self.relative_motion(joint, accelerated=False)[0])

    def relative_motion(self, joint: Joint, *, accelerated: bool) -> tuple[Any, Any]:
        """Return the rate and acceleration of a passive joint of one freedom."""
        m, a, b = self.motion, joint.inner, joint.outer
        axis = m.direction(a, joint.axes[0])
        second: Any = 0.0
        if not joint.slides:
            if accelerated:
                second = axis @ (m.alpha[b] - m.alpha[a])
            return axis @ (m.omega[b] - m.omega[a]), second
        # Relative to the inner body's point that coincides with the joint.
        lever = m.point(b, joint.at) - m.origin[a]
        if accelerated:
            carried = m.origin_acceleration[a] + m.acceleration_matrix(a) @ lever
            second = axis @ (m.acceleration(b, joint.at) - carried)
        return axis @ (m.velocity(b, joint.at) - m.origin_velocity[a] - cross(m.omega[a], lever)), second

    def add_joint_effort(self, joint: Joint, amount: Any) -> None:
        """Add an effort along a joint's freedom to its outer body, and the reaction to the inner."""
        m, a, b = self.motion, joint.inner, joint.outer
        load = m.direction(a, joint.axes[0]) * amount
        if not joint.slides:
            self.moment[b] = self.moment[b] + load
            self.moment[a] = self.moment[a] - load
            return
        at = m.point(b, joint.at)
        for body, force in ((b, load), (a, -load)):
            self.force[body] = self.force[body] + force
            self.moment[body] = self.moment[body] + cross(at - m.origin[body], force)

    def subtract_wrench(self, six: Objects) -> None:
        """Subtract a wrench that acts on the platform at its reference point."""
        graph = self.motion.graph
        self.add_force(graph.platform, graph.origin, -six[:3])
        self.moment[graph.platform] = self.moment[graph.platform] - six[3:]

    def generalised_forces(self) -> tuple[Objects, Objects]:
        """Return the power of all required forces per unknown rate and per drive's rate.

        Minus the sum of J_M' Q_M, J' Q_S, J_Hij' Q_Hij (3-PRRU paper, equations 38 and 39; Delta-CU paper, 22).
        """
        m, tree = self.motion, self.motion.tree
        unknown, driven = (np.zeros(k, dtype=object) for k in (tree.unknown_rates, len(tree.graph.leads)))
        for link in reversed(list(tree.links.values())):
            force, moment, couple = self.force[link.body], self.moment[link.body], self.couple[link.body]
            absolute = free = False
            for step in reversed(link.steps):
                if not (step.ball or step.free):
                    axis = m.axis[id(step)]
                    along: Any = axis @ moment + couple[2] if step.turns else 0.0
                    couple = m.turn(step) @ couple if step.turns else couple
                    if step.slide:
                        along = along + step.slide * (axis @ force)
                    (driven if step.actuated else unknown)[step.rate] = step.sign * along
                    continue
                absolute, free = True, step.free
                unknown[step.rate : step.rate + 3] = moment + m.rotation[link.body] @ couple
                if free:
                    unknown[step.rate + 3 : step.rate + 6] = force
            if free:
                continue
            parent = link.parent
            self.force[parent] = self.force[parent] + force
            self.moment[parent] = self.moment[parent] + cross(m.lever[link.body], force)
            if not absolute:
                self.moment[parent] = self.moment[parent] + moment
                self.couple[parent] = self.couple[parent] + couple
        return unknown, driven


def _inertia_matrix(inertial: Objects) -> Objects:
    xx, yy, zz, xy, xz, yz = inertial[4:]
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], dtype=object)


def solve_and_split(t: Traced) -> tuple[Layout, list[Objects]]:
    """Solve the closures; return the layout of the parameter vector, and its parts as inputs."""
    t.solve()
    layout = Layout(t.tree)
    return layout, layout.split(t.tape.inputs(PARAMETERS, layout.size))


def efforts_of_motion(
    t: Traced, parts: list[Objects], qd: Objects, qdd: Objects, base: Objects | None = None
) -> tuple[list[Any], list[Any]]:
    """Write the leading drives' efforts for a motion under the input ``wrench``.

    :param base: motion of the base, shape (9,); None: at rest.
    :returns: efforts of the leading drives, and friction and rotor efforts of all drives, (n,).
    """
    f_d = driving_forces(t, parts, qd, qdd, base)
    rates, changes = t.tree.drive_rates(qd, t.u), t.tree.drive_rates(qdd, t.du)
    return add_friction_and_rotors(t, parts, f_d, t.drives.variables("q"), rates, changes)


def add_friction_and_rotors(
    t: Traced, parts: list[Objects], loads: Numbers, q: Numbers, rates: Numbers, changes: Numbers
) -> tuple[list[Any], list[Any]]:
    """Add friction and rotor efforts of the drives to the loads of the leading drives.

    :param q: positions of all drives, shape (n,), with ``rates`` and accelerations ``changes``.
    :returns: efforts of the leading drives, and friction and rotor efforts of all drives, (n,).
    """
    rotors = [rotor * change for rotor, change in zip(parts[ROTORS_PART], changes, strict=True)]
    basic = _basic_friction(parts, rates)
    for k, values in enumerate(_friction_law_parameters(t, parts)):
        # Drives of a redundant machine have no load-dependent friction law.
        load = 0.0 if t.drives.others else loads[k] + rotors[k]
        basic[k] = basic[k] + friction.evaluate_laws(t.graph.laws, values, q[k], rates[k], load)
    rows = loads, t.drives.leading_efforts(basic), t.drives.leading_efforts(rotors)
    efforts = [load + rubs + rotor for load, rubs, rotor in zip(*rows, strict=True)]
    return efforts, [rubs + rotor for rubs, rotor in zip(basic, rotors, strict=True)]


def _basic_friction(parts: list[Objects], qd: Numbers) -> list[Any]:
    """Return each drive's viscous friction, Coulomb friction and constant effort, added up."""
    rows = zip(*parts[3:6], qd, strict=True)
    return [viscous * v + coulomb * sign(v) + offset for viscous, coulomb, offset, v in rows]


def _friction_law_parameters(t: Traced, parts: list[Objects]) -> list[dict[str, Any]]:
    """Return the parameters of each drive's named friction laws; empty if there are no such laws."""
    laws = Layout(t.tree).laws(parts[LAWS_PART])
    return [{key: v[k] for key, v in laws.items()} for k in range(t.drives.count if laws else 0)]


def driving_forces(t: Traced, parts: list[Objects], qd: Objects, qdd: Objects, base: Objects | None = None) -> Objects:
    """Write F_d, the leading drives' efforts without friction and rotors of the drives, shape (m,).

    :param base: motion of the base, shape (9,); None: at rest.
    """
    bodies, rods, gravity, *_, passive = parts
    wrench = t.tape.inputs("wrench", 6)
    t.set_rates(qd)
    moving = BaseMotion.at_rest(gravity) if base is None else BaseMotion(*base.reshape(3, 3))
    t.set_accelerations(qdd, moving)
    forces = Forces(t.motion)
    forces.add_inertia(bodies, rods)
    forces.add_passive_joints(passive)
    forces.subtract_wrench(wrench)
    # Virtual work: F_d = -J^-T (J_M' Q_M + sum of J_Hij' Q_Hij) - Q_S (3-PRRU paper, equations 40 and 41;
    # equivalent to equation 23 of the Delta-CU paper). With constraints K u + J qd = 0 on the dependent
    # rates u, the map -J^-T to joint efforts is J' K^-T. generalised_forces() returns -Q, so the signs are reversed.
    minus_q, minus_q_s = forces.generalised_forces()
    f_d: Objects = minus_q_s - t.jq[t.scheme.independent].T @ t.lu.solve_transposed(minus_q)
    return f_d


def body_effort_kernel(robot: Robot) -> Kernel:
    """Return the program of the drives' efforts on the bodies, without their friction and rotors."""
    return robot.massive().kernel("body efforts", partial(torque_program, on_bodies=True))


def torque_program(t: Traced, *, on_bodies: bool = False, base: int = 0) -> Program:
    """Write the program of :func:`torque_kernel`.

    :param on_bodies: without friction and rotors of the drives.
    :param base: size of the input with the motion of the base.
    """
    layout, parts = solve_and_split(t)
    moving = t.tape.inputs("base", base) if base else None
    leads, own = efforts_of_motion(t, parts, t.drives.leading_inputs("qd"), t.drives.leading_inputs("qdd"), moving)
    efforts = t.drives.distribute(leads, preload=True)
    if on_bodies:
        efforts = [effort - part for effort, part in zip(efforts, own, strict=True)]
    sizes = t.inputs("q", "qd", "qdd", wrench=6, **({"base": base} if base else {}))
    return Program(sizes, layout.size, {"efforts": t.lift(efforts)}, t.equations())


def _write_accelerations(t: Traced) -> Program:
    layout, parts = solve_and_split(t)
    leads = solve_leading_accelerations(t, parts, t.drives.leading_inputs("qd"), t.tape.inputs("tau", t.drives.count))
    outputs = {"accelerations": t.lift(t.drives.drive_accelerations(leads, t.du))}
    sizes = t.inputs("q", "qd", "tau", wrench=6)
    return Program(sizes, layout.size, outputs, t.equations())


def solve_leading_accelerations(t: Traced, parts: list[Objects], qd: Objects, tau: Objects) -> list[Any]:
    """Solve for the leading drives' accelerations under efforts of all drives and a wrench.

    Afterwards the dependent coordinates of ``t`` have the accelerations of drives at constant rates,
    not those of the result.
    """
    driving, still = t.drives.leading_efforts([*tau]), np.zeros(t.joints)
    loads = driving_forces(t, parts, qd, still)
    q, rates, changes = t.drives.variables("q"), t.tree.drive_rates(qd, t.u), t.tree.drive_rates(still, t.du)
    rest = efforts_for_acceleration(t, parts, driving, loads, q, rates, changes)
    return solve_accelerations(np.reshape(mass_entries(t, parts), (t.joints, t.joints)), rest)


def efforts_for_acceleration(
    t: Traced, parts: list[Objects], driving: Numbers, loads: Numbers, q: Numbers, rates: Numbers, changes: Numbers
) -> Objects:
    """Return the leading drives' efforts minus loads and friction, which accelerate the machine.

    :param driving: applied efforts of the leading drives. ``loads``: efforts that the bodies require
        at the accelerations ``changes`` of all drives, (n,).
    :param q: positions of all drives, with ``rates``.
    """
    rest: Objects = np.array(driving) - add_friction_and_rotors(t, parts, loads, q, rates, changes)[0]
    laws = _friction_law_parameters(t, parts)
    if laws and not t.drives.others:
        basic = _basic_friction(parts, rates)
        for k, values in enumerate(laws):
            position_friction, dry, share = friction.sum_laws(t.graph.laws, values, q[k], absolute(rates[k]))
            direction = sign(rates[k])
            free = driving[k] - basic[k] - position_friction - dry * direction
            rest[k] = friction.solve_load(free, share, direction) - (loads[k] + parts[ROTORS_PART][k] * changes[k])
    return rest


def solve_accelerations(mass: Objects, rest: Objects) -> list[Any]:
    """Solve M a = rest; infinite if M is singular to rounding, so that the sample is rejected."""
    n = len(mass)
    root = SparseCholesky({(i, j): mass[i, j] for i in range(n) for j in range(i + 1)}, list(np.diag(mass)))
    least: Any = 1.0
    for index, pivot in zip(root.order, root.pivots, strict=True):
        least = minimum(least, pivot / mass[index, index])
    sound = 1.0 / sign(maximum(least - MASSLESS_RATIO, 0.0))
    return [value * sound for value in root.solve(list(rest))]


def mass_entries(t: Traced, parts: list[Objects], visit: Callable[[Forces], None] | None = None) -> list[Any]:
    """Write the entries of the leading drives' mass matrix, row by row.

    :param visit: called for each leading joint while this joint alone moves, at rate one.
    """
    bodies, rods, *_, rotors, passive = parts
    columns = t.rate_columns()
    n = t.joints
    table: list[list[Any]] = [[0.0] * n for _ in range(n)]
    rates = [t.tree.drive_rates(own, column) for own, column in zip(np.eye(n), columns, strict=True)]
    for j in range(n):
        t.motion.set_rates(columns[j], np.eye(n)[j])
        forces = Forces(t.motion)
        if visit is not None:
            visit(forces)
        forces.add_momenta(bodies, rods)
        forces.add_passive_momenta(passive)
        unknown, driven = forces.generalised_forces()
        for k in range(j + 1):
            value = driven[k] + columns[k] @ unknown
            if j == k:
                value = value + rotors[t.drives.leading[j]]
            for i in t.drives.others:
                value = value + rotors[i] * rates[j][i] * rates[k][i]
            table[j][k] = table[k][j] = value
    return [value for row in table for value in row]


def _write_mass_matrix(t: Traced) -> Program:
    layout, parts = solve_and_split(t)
    mass = np.reshape(mass_entries(t, parts), (t.joints, t.joints))
    outputs = {"matrix": t.lift(t.drives.distribute_matrix(mass))}
    return Program(t.inputs("q"), layout.size, outputs, t.equations())


def potential(t: Traced, bodies: Objects, rods: Objects, gravity: Objects) -> Any:
    """Write the potential energy, zero at the base's origin."""
    motion = t.motion
    weighted: Any = np.zeros(3)
    for name, inertial in zip(t.tree.links, bodies, strict=True):
        weighted = weighted + motion.origin[name] * inertial[0] + motion.rotation[name] @ inertial[1:4]
    for mass, rod in zip(rods, t.graph.rods.values(), strict=True):
        ends = motion.point(rod.inner, rod.ends[0]) + motion.point(rod.outer, rod.ends[1])
        weighted = weighted + ends * (mass * 0.5)
    return -(weighted @ gravity)


def _write_energy(t: Traced) -> Program:
    layout, (bodies, rods, gravity, *_, rotors, passive) = solve_and_split(t)
    qd = t.drives.leading_inputs("qd")
    u = t.set_rates(qd)
    forces = Forces(t.motion)
    forces.add_momenta(bodies, rods)
    forces.add_passive_momenta(passive)
    unknown, driven = forces.generalised_forces()
    rates = t.tree.drive_rates(qd, u)
    double = driven @ qd + u @ unknown
    double = double + sum((r * v * v for r, v in zip(rotors, rates, strict=True)), 0.0)
    outputs = {"energy": t.lift([double * 0.5, potential(t, bodies, rods, gravity)])}
    return Program(t.inputs("q", "qd"), layout.size, outputs, t.equations())


def null_efforts(robot: Robot, q: ArrayLike) -> Array:
    """Compute efforts that cause no motion, (..., n - m, n), of n actuated joints and m freedoms.

    They are the machine's internal forces: added to any efforts, they change no motion. Rows are
    of unit length and at right angles in efforts over their limits (``limits.effort``; without
    limits, in efforts). Errors as in :meth:`Robot.forward`.
    """
    if not robot.redundant:
        batch = vectors(robot.forward(q), len(robot.pose_names), "pose").shape[:-1]
        return np.zeros((*batch, 0, robot.joints_count))
    flat = robot.function(null_kernel)(q)
    return flat.reshape(*flat.shape[:-1], -1, robot.joints_count)


def null_kernel(robot: Robot) -> Kernel:
    """Return the program of :func:`null_efforts`: q to its entries, row by row."""

    def write(t: Traced) -> Program:
        t.solve()
        rows = t.lift([value for row in t.drives.null_efforts() for value in row])
        return Program(t.inputs("q"), 0, {"efforts": rows}, t.equations())

    return robot.engine.kernel("null efforts", write)


class TorqueLoop:
    """Inverse dynamics of one robot on arrays of its own, see :meth:`Robot.torque_loop`.

    ``q``, ``qd``, ``qdd``: joint positions, rates and accelerations, shape (n,), or (samples, n)
    for more samples than one. ``wrench``: on the platform at its reference point, base axes, (6,)
    or (samples, 6). ``tau``: efforts, as q; NaN in samples that are not good. They are written and
    read in place; assigning another array changes nothing. One thread at a time.
    """

    def __init__(self, robot: Robot, samples: int = 1) -> None:
        """Compile, and lay out the arrays.

        :raises ParameterError: a robot whose file gives no masses.
        :raises ValueError: fewer samples than one.
        """
        if samples < 1:
            raise ValueError(f"samples is {samples}; at least 1 is needed")
        self._bound = BoundCall(torque_kernel(robot), robot.inertial, samples)
        self.q, self.qd, self.qdd, self.wrench = self._bound.inputs
        (self.tau,) = self._bound.outputs
        self.q[:] = robot.graph.home

    def __call__(self) -> int:
        """Compute tau: 0 all samples are good, 1 one has no assembly, 2 one is not finite."""
        return self._bound()
