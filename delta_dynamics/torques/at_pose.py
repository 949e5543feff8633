# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Inverse dynamics of a motion that is given by the platform's pose, without forward kinematics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from delta_dynamics.torques.virtual_work import Forces, add_friction_and_rotors, efforts_of_motion
from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.code import GOOD
from pkm_twin.codegen.expressions import PARAMETERS, snapped_all
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.lu import SparseLU
from pkm_twin.codegen.program import Program
from pkm_twin.kinematics.motion import BaseMotion
from pkm_twin.kinematics.posed import CarriedScheme
from pkm_twin.kinematics.programs import certify_assembly, follow_pose, pose_accelerations, pose_factors, solve_pose
from pkm_twin.kinematics.traced import Traced
from pkm_twin.machine.inertia import Layout, change_of_frame, loaded_joints
from pkm_twin.robot.robot import Robot


@dataclass(frozen=True)
class PoseMotion:
    """Joint positions, rates, accelerations and efforts of a motion of the pose, (..., n) each."""

    q: Array
    qd: Array
    qdd: Array
    tau: Array


def inverse_dynamics_at_pose(
    robot: Robot, pose: ArrayLike, rate: ArrayLike, acceleration: ArrayLike, wrench: ArrayLike | None = None
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
    found = evaluate_at_pose(robot, pose_torques, unjudged_pose_torques, robot.inertial, *given)
    return PoseMotion(*found)


def evaluate_at_pose(
    robot: Robot, certified: Callable[[Robot], Kernel], accepted: Callable[[Robot], Kernel], p: Array, *given: ArrayLike
) -> list[Array]:
    """Evaluate a program of poses and other inputs; which poses are reached is judged as always.

    :param certified: gives the program that accepts poses that are certainly right, and
        ``accepted`` that of poses which the inverse kinematics has accepted.
    :param p: the programs' parameters. ``given``: poses, shape (..., m), and the other inputs.
    :raises UnreachableError: as the inverse kinematics, and SingularityError.
    :raises ValueError: an input that is not finite.
    """
    found, status = certified(robot)(p, *given)
    if status is not None:
        rows = [np.broadcast_to(a, (*status.shape[:-1], np.shape(a)[-1])) for a in given]
        robot.inverse(rows[0])
        left = status[..., 0] != GOOD
        again, status = accepted(robot)(p, *(row[left] for row in rows))
        if status is not None:
            raise ValueError("an input in addition to the pose is not finite, or too large")
        for values, new in zip(found, again, strict=True):
            values[left] = new
    return found


def pose_torques(robot: Robot) -> Kernel:
    """Return the program from pose, rate, acceleration and wrench to q, qd, qdd and efforts.

    Poses are accepted as by the quick inverse kinematics.

    :raises ParameterError: a robot whose file gives no masses.
    """
    engine = robot.massive()
    write = partial(_pose_torques, certified=True) if engine.posed else _followed_pose_torques
    return engine.posed_kernel("torques at pose", write)


def unjudged_pose_torques(robot: Robot) -> Kernel:
    """Return the program of :func:`pose_torques` for poses that the inverse kinematics accepted."""
    if robot.massive().posed is None:
        return pose_torques(robot)
    write = partial(_pose_torques, certified=False)
    return robot.massive().posed_kernel("torques at accepted pose", write)


def followed_pose_torques(robot: Robot) -> Kernel:
    """Return the same program with the machine's own tree, which holds for other dimensions too.

    Poses are accepted as by :attr:`.engine.Engine.followed_inverse`.
    """
    engine = robot.massive()
    write = partial(_followed_pose_torques, scheme=None)
    return engine.kernel("followed torques at pose", write, repr(engine.inverse_pivots))


def _pose_torques(t: Traced, scheme: CarriedScheme, *, certified: bool) -> Program:
    posed, q = solve_pose(t, scheme)
    m = len(posed.q)
    layout = Layout(t.tree)
    parts = layout.split(t.tape.inputs(PARAMETERS, layout.size))
    rods, gravity, passive = parts[1], parts[2], parts[-1]
    rate, acceleration = (t.tape.inputs(name, m) for name in ("rate", "acceleration"))
    posed.set_rates(rate)
    posed.set_accelerations(acceleration, BaseMotion.at_rest(gravity))

    # Inertial parameters of all bodies, in frames of the tree that the pose drives.
    p, bodies = t.tape.inputs(PARAMETERS, layout.size), np.zeros((len(posed.tree.links), 10), dtype=object)
    for row, (name, link) in enumerate(posed.tree.links.items()):
        if name in t.tree.links:
            lever = snapped_all(t.tree.at[name] - link.at)
            bodies[row] = change_of_frame(link.axes, lever) @ p[layout.body(name)]

    # J_M' Q_M + sum of J_Hij' Q_Hij, on the pose coordinates (3-PRRU paper, equation 40).
    forces = Forces(posed.motion)
    forces.inertia(bodies, rods)
    for k, joint in enumerate(loaded_joints(t.graph)):
        forces.joint(joint, passive[3 * k : 3 * k + 3])
    forces.wrench(t.tape.inputs("wrench", 6))
    unknown, on_pose = forces.generalised()
    jq = posed.jq[scheme.independent]
    on_pose = on_pose - jq.T @ posed.lu.solve_transposed(unknown[scheme.varying])

    # F_d = -J^-T (J_M' Q_M + sum of J_Hij' Q_Hij) - Q_S with J = dq/dX (equations 24 and 41); needed forces
    # are minus Q.
    steps = [posed.tree.steps[name] for name in t.graph.actuated]
    rates, changes = ([values[step.rate] for step in steps] for values in (posed.u, posed.du))
    drives = posed.rates_of_joints(t.graph.actuated)
    jacobian = SparseLU(drives[t.drives.leading], scheme.drive_pivots)
    t.drives.set_null_rows([jacobian.solve_transposed(drives[k]) for k in t.drives.others])
    f_d = jacobian.solve_transposed(on_pose)
    leads = add_friction_and_rotors(t, parts, f_d, q, rates, changes)
    efforts = t.drives.shared(leads[0], preload=True)
    branch = certify_assembly(t, scheme, posed, q) if certified else []
    outputs = {"q": t.lift(q), "qd": t.lift(rates), "qdd": t.lift(changes), "tau": t.lift(efforts)}
    return Program(
        {"pose": m, "rate": m, "acceleration": m, "wrench": 6},
        layout.size,
        outputs,
        posed.equations(branch=t.lift(branch)),
        single=certified,
    )


def _followed_pose_torques(t: Traced, scheme: None) -> Program:
    """Write the program of a machine whose pose is followed with its own tree, as of a screw."""
    del scheme
    m = t.joints
    equations, q = follow_pose(t)
    layout = Layout(t.tree)
    parts = layout.split(t.tape.inputs(PARAMETERS, layout.size))
    rate, acceleration = (t.tape.inputs(name, m) for name in ("rate", "acceleration"))
    lu = pose_factors(t)
    qd = lu.solve(rate)
    t.set_rates(qd)
    t.set_accelerations(np.zeros(m))
    qdd = lu.solve(acceleration - np.array(pose_accelerations(t), dtype=object))
    efforts, _ = efforts_of_motion(t, parts, qd, qdd)
    outputs = {
        "q": t.lift(t.tree.values_of_drives(q, t.x)),
        "qd": t.lift(t.tree.of_drives(qd, t.u)),
        "qdd": t.lift(t.tree.of_drives(qdd, t.du)),
        "tau": t.lift(t.drives.shared(efforts, preload=True)),
    }
    inputs = {"pose": m, "rate": m, "acceleration": m, "wrench": 6}
    return Program(inputs, layout.size, outputs, equations)
