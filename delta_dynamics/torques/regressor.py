# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The efforts as a linear function of the inertial and friction parameters, exactly.

tau = Y(q, qd, qdd) pi: a column of Y is the efforts that a unit of one parameter needs, by the
principle of virtual work: its force on the body that has it, times how that body moves with each
actuated joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from delta_dynamics.torques.virtual_work import Forces
from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import PARAMETERS
from pkm_twin.codegen.program import Program
from pkm_twin.kinematics.motion import BaseMotion
from pkm_twin.kinematics.traced import Traced
from pkm_twin.machine.friction import evaluate_laws, list_linear_keys, read_friction_values
from pkm_twin.machine.inertia import (
    STANDARD_PARAMETERS,
    STANDARD_UNITS,
    drive_units,
    list_loaded_joints,
    make_frame_change,
    standard_parameters,
)
from pkm_twin.machine.schema import make_read_only
from pkm_twin.robot.mechanism import EFFORT_SHARING_NOTE
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import random_joints

DRIVE_PARAMETERS: Final = ("viscous", "coulomb", "offset", "rotor_inertia")
"""Parameters of an actuated joint; a passive joint with friction or a rotor has no ``offset``.

The linear parameters of other friction laws follow after those of all drives.
"""
PAYLOAD: Final = "payload"
WRENCH: Final = "wrench"
"""Name of the last column: efforts due to the external wrench; the value of its parameter is 1."""


def parameter_names(robot: Robot) -> tuple[str, ...]:
    """List the columns of :func:`regressor` by name, shape (p,): ``OWNER.WHAT``, and ``wrench``.

    Every body and the payload have ``mass``, first moments ``mx my mz`` and inertia ``ixx iyy izz
    ixy ixz iyz``, in base axes at home: a body about its frame's origin at home
    (``robot.engine.tree.at``), the payload about the platform's reference point. A rod has its
    ``mass``. An actuated joint has ``viscous``, ``coulomb``, ``offset`` and ``rotor_inertia``. A
    passive joint with friction or a rotor in the file has these without ``offset``.
    """
    return tuple(name for name, _ in _list_columns(robot))


def parameter_units(robot: Robot) -> tuple[str, ...]:
    """Return the units of the parameters, shape (p,)."""
    return tuple(unit for _, unit in _list_columns(robot))


def parameter_values(robot: Robot) -> Array:
    """Return the robot's own values of the parameters, pi, shape (p,)."""
    graph, tree = robot.graph, robot.massive().tree
    values: list[Any] = []
    for link in tree.links.values():
        body = graph.bodies[link.body]
        values += [*standard_parameters(body.mass, body.com - link.at, body.inertia)]
    values += [rod.mass for rod in graph.rods.values()]
    load, friction = robot.payload, robot.friction
    values += [*standard_parameters(load.mass, load.com, load.inertia)]
    for k, name in enumerate(graph.actuated):
        rub = [friction.viscous[k], friction.coulomb[k], friction.offset[k]]
        values += [*rub, graph.joints[name].rotor_inertia]
    for key in law_keys(robot):
        values += [*getattr(friction, key)]
    for joint in list_loaded_joints(graph):
        values += [joint.viscous, joint.coulomb, joint.rotor_inertia]
    return np.array([*values, 1.0])


def regressor(robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, wrench: ArrayLike | None = None) -> Array:
    """Compute the regressor Y of a motion's efforts: Y pi = inverse_dynamics, exactly.

    It depends only on the robot's geometry, gravity and the set of loaded passive joints, and on
    the robot's own values where its drives' friction laws are not linear: a Stribeck speed, a
    cogging's period, and the load that friction grows with. pi is :func:`parameter_values`, or
    other values. The last column is the effort due to the wrench (zero without one); the value of
    its parameter is 1.

    :returns: Y, shape (..., n, p), N m or N per unit of the parameter; parameters and errors as of
        :func:`~delta_dynamics.inverse_dynamics`.
    """
    robot.check_independent("parameters of efforts", EFFORT_SHARING_NOTE)
    load = np.zeros(6) if wrench is None else wrench
    kernel, gravity = robot.massive().kernel("regressor", _write_regressor), robot.gravity
    bodies, others = robot.evaluate(kernel, q, qd, qdd, load, p=np.ascontiguousarray(gravity))
    n, batch, graph = robot.joints_count, bodies.shape[:-1], robot.graph
    links = robot.engine.tree.links
    ten = _body_columns(bodies.reshape(*batch, len(links), 3 + 2 * n, 3), n)
    other = others.reshape(*batch, n, others.shape[-1] // n)
    rods = len(graph.rods)
    platform = ten[..., list(links).index(graph.platform), :, :]
    lever = graph.origin - links[graph.platform].at
    rates, changes = (np.broadcast_to(np.asarray(v, np.float64), (*batch, n)) for v in (qd, qdd))
    drives = np.zeros((*batch, n, n, len(DRIVE_PARAMETERS)))
    for k in range(n):
        rate = rates[..., k]
        drives[..., k, k, :] = np.stack([rate, np.sign(rate), np.ones_like(rate), changes[..., k]], -1)
    parts = [
        np.moveaxis(ten, -3, -2).reshape(*batch, n, len(links) * ten.shape[-1]),
        other[..., :rods],
        platform @ make_frame_change(np.eye(3), lever),
        drives.reshape(*batch, n, n * len(DRIVE_PARAMETERS)),
    ]
    if not robot.laws:
        return np.concatenate([*parts, other[..., rods:]], -1)
    values = parameter_values(robot)
    passive = other[..., rods:]
    free = values.copy()
    basic = sum(part.shape[-1] for part in parts)
    free[basic - len(DRIVE_PARAMETERS) * n : basic].reshape(n, -1)[:, :3] = 0.0
    inner = passive @ free[-passive.shape[-1] :]
    load = np.concatenate(parts, -1) @ free[:basic] + inner
    laws = law_columns(robot, np.broadcast_to(np.asarray(q, np.float64), rates.shape), rates, load)
    return np.concatenate([*parts, laws, passive], -1)


def law_keys(robot: Robot) -> tuple[str, ...]:
    """List the parameters that efforts are linear in, of the drives' laws beyond the basic one."""
    return tuple(key for key in list_linear_keys(robot.laws) if key not in DRIVE_PARAMETERS)


def law_columns(robot: Robot, q: Array, qd: Array, load: Array) -> Array:
    """Return efforts by units of :func:`law_keys`, joint by joint for each, (..., n, keys n).

    :param load: efforts of the drives without friction, shape (..., n). All shape (..., n).
    """
    n, keys = robot.joints_count, law_keys(robot)
    values = read_friction_values(robot.laws, robot.friction)
    columns = np.zeros((*qd.shape, len(keys), n))
    for i, key in enumerate(keys):
        unit = values | {other: np.full(n, float(other == key)) for other in keys}
        own = evaluate_laws(robot.laws, unit, q, qd, load)
        columns[..., np.arange(n), i, np.arange(n)] = own
    return columns.reshape(*qd.shape, len(keys) * n)


def _body_columns(motion: Array, n: int) -> Array:
    """Return the joints' efforts per inertial parameter of a body, by Newton's and Euler's laws.

    :param motion: rows a (less gravity), omega, alpha of the body, then velocities v of its origin
        and angular velocities w per joint rate, in its own axes, shape (..., 3 + 2 n, 3).
    :returns: shape (..., n, 10): of mass v a; of first moments h, whose force is alpha x h +
        omega x (omega x h) and whose moment is h x a; of inertia J w (J alpha + omega x J omega).
    """
    a, omega, alpha = (motion[..., k, None, :] for k in range(3))
    v, w = motion[..., 3 : 3 + n, :], motion[..., 3 + n :, :]
    mass = np.sum(v * a, -1, keepdims=True)
    first = (
        np.cross(v, alpha)
        + np.sum(v * omega, -1, keepdims=True) * omega
        - np.sum(omega * omega, -1, keepdims=True) * v
        + np.cross(a, w)
    )
    # w . (omega x J omega) = (w x omega) . J omega.
    turning = np.cross(w, omega)
    diagonal = w * alpha + turning * omega
    pairs = [
        w[..., i] * alpha[..., j]
        + w[..., j] * alpha[..., i]
        + turning[..., i] * omega[..., j]
        + turning[..., j] * omega[..., i]
        for i, j in ((0, 1), (0, 2), (1, 2))
    ]
    return np.concatenate([mass, first, diagonal, np.stack(pairs, -1)], -1)


def _list_columns(robot: Robot) -> list[tuple[str, str]]:
    graph, tree = robot.graph, robot.massive().tree

    def body_columns(owner: str) -> list[tuple[str, str]]:
        return [(f"{owner}.{what}", unit) for what, unit in zip(STANDARD_PARAMETERS, STANDARD_UNITS, strict=True)]

    def joint_columns(name: str, whats: Sequence[str]) -> list[tuple[str, str]]:
        units = drive_units(graph, name)
        return [(f"{name}.{what}", units[what]) for what in whats]

    result = [column for body in tree.links for column in body_columns(body)]
    result += [(f"{name}.mass", "kg") for name in graph.rods]
    result += body_columns(PAYLOAD)
    result += [column for name in graph.actuated for column in joint_columns(name, DRIVE_PARAMETERS)]
    result += [column for key in law_keys(robot) for name in graph.actuated for column in joint_columns(name, [key])]
    passive = tuple(what for what in DRIVE_PARAMETERS if what != "offset")
    result += [column for j in list_loaded_joints(graph) for column in joint_columns(j.name, passive)]
    return [*result, (WRENCH, "1")]


def _write_regressor(t: Traced) -> Program:
    """Write the program of all bodies' motion, and of the columns of rods, joints and wrench."""
    t.solve()
    graph, motion, n = t.graph, t.motion, t.joints
    gravity = t.tape.inputs(PARAMETERS, 3)
    qd, qdd, wrench = t.tape.inputs("qd", n), t.tape.inputs("qdd", n), t.tape.inputs("wrench", 6)
    twists = []
    for j, column in enumerate(t.rate_columns()):
        motion.set_rates(column, np.eye(n)[j])
        twists.append((motion.origin_velocity, motion.omega))
    t.set_rates(qd)
    t.set_accelerations(qdd, BaseMotion.at_rest(gravity))
    bodies: list[Any] = []
    for body in t.tree.links:
        own = motion.rotation_from_home(body).T
        rows = [motion.origin_acceleration[body], motion.omega[body], motion.alpha[body]]
        rows += [speed[body] for speed, _ in twists] + [omega[body] for _, omega in twists]
        bodies += [entry for row in rows for entry in own @ row]

    columns: list[list[Any]] = []

    def add_powers(forces: Forces, *names: str) -> None:
        columns.append(
            [sum(speed[b] @ forces.force[b] + omega[b] @ forces.moment[b] for b in names) for speed, omega in twists]
        )

    for rod in graph.rods.values():
        forces = Forces(motion)
        forces.add_rod(rod, 1.0)
        add_powers(forces, rod.inner, rod.outer)
    for joint in list_loaded_joints(graph):
        for three in np.eye(3):
            forces = Forces(motion)
            forces.add_passive_joint(joint, three)
            add_powers(forces, joint.inner, joint.outer)
    forces = Forces(motion)
    forces.subtract_wrench(wrench)
    add_powers(forces, graph.platform)
    others = [column[j] for j in range(n) for column in columns]
    sizes = {"q": n, "qd": n, "qdd": n, "wrench": 6}
    return Program(sizes, 3, {"bodies": t.lift(bodies), "others": t.lift(others)}, t.equations())


MIN_PIVOT: Final = 1e-8
"""Smallest pivot of an independent column, for columns of unit norm."""
ROUNDING_COEFFICIENT: Final = 1e-7
"""Coefficients below it are rounding errors and count as zero."""


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """Combinations of parameters that the efforts determine: ``matrix`` times the parameters.

    ``names``: of the combinations, in words. ``parameters``: names of all parameters.
    ``columns``: index of the parameter that leads each combination. ``matrix``: shape (b, p), one
    at the leading parameter. ``values``: the robot's own, shape (b,). ``unseen``: names of
    parameters that no motion excites.
    """

    names: tuple[str, ...]
    parameters: tuple[str, ...]
    columns: tuple[int, ...]
    matrix: Array
    values: Array
    unseen: tuple[str, ...]

    @property
    def count(self) -> int:
        """Number of combinations, b."""
        return len(self.columns)


def base_parameters(robot: Robot, *, seed: int = 0) -> BaseParameters:
    """Find the identifiable combinations of the robot's parameters, without a wrench.

    With the columns of ``columns`` alone, Y[..., columns] (matrix pi) = inverse_dynamics.

    :param seed: of the random states; the number of combinations does not depend on it.
    """
    names, pi = parameter_names(robot), parameter_values(robot)
    states = random_states(robot, max(60, 3 * len(names) // robot.joints_count), seed)
    table = regressor(robot, *states).reshape(-1, len(names))
    # Units of kg by the machine's size: moments have a length in them, inertias its square. Drives lead
    # combinations before bodies, bodies before the payload, masses and moments before products of inertia.
    powers = dict(zip(STANDARD_PARAMETERS, (0, 1, 1, 1, 2, 2, 2, 2, 2, 2), strict=True))
    units, preference = np.ones(len(names)), np.ones(len(names))
    for k, name in enumerate(names[:-1]):
        owner, _, what = name.rpartition(".")
        units[k] = robot.engine.tree.size ** -powers.get(what, 0)
        preference[k] = (0.1 if owner == PAYLOAD else 1.0) * (0.3 if what in STANDARD_PARAMETERS[7:] else 1.0)
        if what in DRIVE_PARAMETERS:
            preference[k] = 10.0
    columns, matrix = choose_independent_columns(table / units, preference)
    matrix = matrix * units / units[list(columns)][:, None]
    led = [combination_name(row, k, names) for k, row in zip(columns, matrix, strict=True)]
    unseen = [name for k, name in enumerate(names[:-1]) if not matrix[:, k].any()]
    return BaseParameters(
        tuple(led), names, columns, make_read_only(matrix), make_read_only(matrix @ pi), tuple(unseen)
    )


def random_states(robot: Robot, count: int, seed: int) -> tuple[Array, Array, Array]:
    """Draw positions, rates and accelerations, shape (count, n) each, clear of singularities.

    Their size is one at which weight, accelerations and velocities cause similar efforts.
    """
    rng = np.random.default_rng(seed)
    size, slides = robot.engine.tree.size, np.array([u == "m" for u in robot.joint_units])
    q = random_joints(robot, rng, count)
    unit = np.where(slides, size, 1.0)
    g = 9.81 / size
    return q, unit * np.sqrt(g) * rng.normal(size=q.shape), unit * g * rng.normal(size=q.shape)


def choose_independent_columns(table: Array, preference: ArrayLike = 1.0) -> tuple[tuple[int, ...], Array]:
    """Choose columns that are independent of each other, and express all columns by them.

    :param table: shape (rows, p), columns of comparable units.
    :param preference: shape (p,): greater ones are taken first.
    :returns: indices, rising, and the matrix B, shape (b, p), with table = table[:, indices] B.
    """
    # Imported here to keep the start of nodes short, which do not need it.
    from scipy.linalg import qr  # type: ignore[import-untyped]

    norms = np.linalg.norm(table, axis=0)
    # Smaller columns are rounding errors of zero: all columns have the unit kg.
    seen = np.flatnonzero(norms > 1e-10 * norms.max())
    weights = np.broadcast_to(np.asarray(preference, np.float64), norms.shape)
    norms = norms / weights
    r, pivots = qr(table[:, seen] / norms[seen], mode="r", pivoting=True)
    diagonal = np.abs(np.diag(r))
    rank = int((diagonal > MIN_PIVOT * weights.max()).sum())
    rest = np.linalg.solve(r[:rank, :rank], r[:rank])
    matrix = np.zeros((rank, table.shape[1]))
    matrix[:, seen[pivots]] = rest / norms[seen[pivots[:rank]]][:, None] * norms[seen[pivots]]
    matrix[np.abs(matrix) < ROUNDING_COEFFICIENT] = 0.0
    leading = seen[pivots[:rank]]
    order = np.argsort(leading)
    return tuple(int(k) for k in leading[order]), matrix[order]


def combination_name(row: Sequence[float] | Array, leading: int, names: Sequence[str]) -> str:
    """Write a combination as text, the leading parameter first."""
    text = names[leading]
    for k, value in enumerate(row):
        if k == leading or value == 0.0:
            continue
        size = "" if abs(abs(value) - 1.0) < ROUNDING_COEFFICIENT else f"{abs(value):.4g} "
        text += f" {'-' if value < 0 else '+'} {size}{names[k]}"
    return text
