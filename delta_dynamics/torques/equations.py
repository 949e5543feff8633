# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The equations of motion in the actuated joints, all terms of one state at once.

One program solves the closures once for all terms, because a simulation evaluates them several
thousand times a second.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from delta_dynamics.torques.virtual_work import Forces, mass_entries, potential, solve_and_split
from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.program import Program
from pkm_twin.kinematics.motion import BaseMotion
from pkm_twin.kinematics.traced import Traced
from pkm_twin.machine.inertia import list_loaded_joints
from pkm_twin.robot.robot import Robot


class Terms(NamedTuple):
    """Terms of M qdd + bias = effort + twists' wrench - friction at a state; k passive joints.

    ``mass`` (n, n) and ``bias`` (n,): velocity terms and weight, without friction and offset.
    ``kinetic`` and ``potential`` energy, J, the latter zero at the base's origin. ``twists``
    (6, n): of the platform at its reference point by joint rates, base axes. ``rows`` (k, n): rates
    of the passive joints that have friction or a rotor by joint rates; ``drift`` (k,): their
    accelerations at qdd = 0.
    """

    q: Array
    qd: Array
    mass: Array
    bias: Array
    kinetic: float
    potential: float
    twists: Array
    rows: Array
    drift: Array


class Equations:
    """The terms of a robot's equations of motion, by state."""

    def __init__(self, robot: Robot) -> None:
        n, k = robot.joints_count, len(list_loaded_joints(robot.graph))
        self.robot = robot
        self._shapes = ((n, n), (n,), (2,), (6, n), (k, n), (k,))
        ends = np.cumsum([0, *(int(np.prod(shape)) for shape in self._shapes)]).tolist()
        self._parts = [slice(a, b) for a, b in pairwise(ends)]

    def at(self, q: Array, qd: Array) -> Terms:
        """Compute the terms at joint positions and rates, shape (n,) each.

        :raises UnreachableError: a joint state without an assembly.
        :raises SingularityError: a singularity on the way from home.
        :raises ValueError: a value that is not finite.
        """
        robot = self.robot
        flat = robot.function(motion_kernel, robot.inertial)(q, qd)
        mass, bias, energies, twists, rows, drift = self._parts
        n, _ = self._shapes[0]
        kinetic, height = flat[energies].tolist()
        return Terms(
            q,
            qd,
            flat[mass].reshape(n, n),
            flat[bias],
            kinetic,
            height,
            flat[twists].reshape(6, n),
            flat[rows].reshape(-1, n),
            flat[drift],
        )


def motion_kernel(robot: Robot) -> Kernel:
    """Return the program of :class:`Terms` from q and qd, row by row."""
    return robot.massive().kernel("motion", _write_terms)


def _write_terms(t: Traced) -> Program:
    """Write the entries of :class:`Terms`: mass matrix, bias forces, energies, velocities per joint rate.

    Bias forces are those of gravity and velocities: the joint accelerations are zero, the base is at rest.
    """
    layout, parts = solve_and_split(t)
    bodies, rods, gravity, *_, passive = parts
    n, graph, motion = t.joints, t.graph, t.motion
    qd = t.tape.inputs("qd", n)
    t.set_rates(qd)
    t.set_accelerations(np.zeros(n), BaseMotion.at_rest(gravity))
    forces = Forces(motion)
    forces.add_inertia(bodies, rods)
    drift = []
    for k, joint in enumerate(list_loaded_joints(graph)):
        _, second = forces.relative_motion(joint, accelerated=True)
        forces.add_joint_effort(joint, passive[3 * k + 2] * second)
        drift.append(second)
    unknown, driven = forces.generalised_forces()
    bias = driven - t.jq[t.scheme.independent].T @ t.lu.solve_transposed(unknown)
    height = potential(t, bodies, rods, gravity)
    twists: list[Any] = []
    rows: list[Any] = []

    def add_motion(forces: Forces) -> None:
        twists.append([*motion.velocity(graph.platform, graph.origin), *motion.omega[graph.platform]])
        rows.append([forces.relative_motion(j, accelerated=False)[0] for j in list_loaded_joints(graph)])

    mass = mass_entries(t, parts, add_motion)
    # twists and rows have one entry per joint: transpose them below.
    kinetic = 0.5 * (qd @ (np.reshape(mass, (n, n)) @ qd))
    flat = [*mass, *bias, kinetic, height]
    flat += [column[i] for i in range(6) for column in twists]
    flat += [column[k] for k in range(len(drift)) for column in rows]
    outputs = {"terms": t.lift([*flat, *drift])}
    return Program({"q": n, "qd": n}, layout.size, outputs, t.equations())
