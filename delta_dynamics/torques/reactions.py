# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Joint reactions by d'Alembert's principle: the force route in addition to the power route.

Every body's force and moment balance, A lambda = b, over what the joints can transmit; the
actuators' efforts come out as components of lambda, independently of virtual work.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from delta_dynamics.torques.virtual_work import Forces, body_effort_kernel
from pkm_twin.codegen.arrays import Array, Mask, require_finite
from pkm_twin.codegen.expressions import PARAMETERS, cross
from pkm_twin.codegen.kernels import Kernel
from pkm_twin.codegen.program import Program
from pkm_twin.errors import SingularityError
from pkm_twin.kinematics.motion import BaseMotion, reaction_directions
from pkm_twin.kinematics.traced import Traced
from pkm_twin.machine.graph import BASE, Graph, Joint
from pkm_twin.machine.inertia import Layout
from pkm_twin.robot.plausibility import why_no_torques
from pkm_twin.robot.rejection import SINGULARITY_BOUND
from pkm_twin.robot.robot import Robot


@dataclass(frozen=True)
class Transmitter:
    """A joint in every sample: the wrenches that its inner body can transmit to the outer one.

    ``components`` names the columns of ``basis``, shape (..., 6, components): unit forces and
    unit couples at ``point``, shape (..., 3), m. A component of the same name at two joints is
    one unknown: a couple that passes through a body without touching its balance. ``actuated`` is
    the component that the actuator applies, positive as q is.
    """

    name: str
    inner: str
    outer: str
    point: Array
    components: tuple[str, ...]
    basis: Array
    actuated: str | None = None


def list_transmitters(graph: Graph, rods: Array, places: Array) -> list[Transmitter]:
    """List all joints that transmit a wrench: the graph's joints, then the rods' ends."""
    result = []
    for k, joint in enumerate(graph.joints.values()):
        if not joint.virtual:
            here = places[..., 15 * k : 15 * k + 15]
            result.append(_make_joint_transmitter(joint, here.reshape(*here.shape[:-1], 5, 3)))
    for k, rod in enumerate(graph.rods.values()):
        here = rods[..., 15 * k : 15 * k + 15]
        # Ball joints at both ends of a rod.
        vectors = here.reshape(*here.shape[:-1], 5, 3)
        start, end, pair = vectors[..., 0, :], vectors[..., 1, :], vectors[..., 4, :]
        couple: dict[str, Array] = {}
        if rod.pair is None:
            forces = {c: np.broadcast_to(np.eye(3)[i], start.shape) for i, c in enumerate("xyz")}
        else:
            w = (end - start) / np.linalg.norm(end - start, axis=-1, keepdims=True)
            e = np.cross(pair, w)
            e /= np.linalg.norm(e, axis=-1, keepdims=True)
            forces = {"w": w, "e": e, "w x e": np.cross(w, e)}
            couple = {f"{rod.label or rod.name}: moment along e": e}
        inner, outer = rod.joint_names
        result += [
            _make_transmitter(inner, (rod.inner, rod.name), start, forces, {}, None, couple),
            _make_transmitter(outer, (rod.name, rod.outer), end, forces, {}, None, couple),
        ]
    return result


def _make_joint_transmitter(joint: Joint, vectors: Array) -> Transmitter:
    """Return a joint's wrenches: forces across its slides, moments across its rotations.

    A screw transmits a force along its axis together with the moment of its thread.
    """
    name = joint.label or joint.name
    freedoms = joint.freedoms
    pair = len(joint.axes) == 2
    forces: dict[str, Array] = {}
    moments: dict[str, Array] = {}
    threads: dict[str, Array] = {}
    effort: str | None = None
    for k, direction in enumerate(reaction_directions(joint)):
        vector = vectors[..., 1 + k, :]
        own = [f for f in freedoms if abs(float(f.axis @ direction.vector)) > 0.5]
        if all(f.turns for f in own):
            forces[direction.name] = vector
            if own and joint.pitch:
                threads[direction.name] = -vectors[..., 4, :1] * vector
        # The directions of two crossing axes span a plane; rotation about its normal is blocked.
        if not pair and not any(f.turns for f in own):
            moments[direction.name] = vector
        if joint.actuated and own:
            table, what = (moments, "moment") if own[0].turns else (forces, "force")
            table[direction.name] = vector * np.sign(own[0].axis @ direction.vector)
            effort = f"{name}: {what} along {direction.name}"
    if pair:
        normal = vectors[..., 4, :]
        moments[joint.normal] = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    return _make_transmitter(
        name,
        (joint.inner, joint.outer),
        vectors[..., 0, :],
        forces,
        moments,
        effort,
        threads=threads,
    )


def _make_transmitter(
    name: str,
    bodies: tuple[str, str],
    point: Array,
    forces: Mapping[str, Array],
    moments: Mapping[str, Array],
    effort: str | None,
    passed: Mapping[str, Array] | None = None,
    threads: Mapping[str, Array] | None = None,
) -> Transmitter:
    """Build a joint's wrench basis from unit directions, shape (..., 3).

    ``passed``: couples shared with another; ``threads``: moments that come with a force.
    """
    names = [f"{name}: force along {key}" for key in forces]
    names += [f"{name}: moment along {key}" for key in moments]
    couples = [*moments.values(), *(passed or {}).values()]
    names += list(passed or {})
    count = len(forces)
    basis = np.zeros((*point.shape[:-1], 6, len(names)))
    for k, (key, direction) in enumerate(forces.items()):
        basis[..., :3, k] = direction
        basis[..., 3:, k] = (threads or {}).get(key, 0.0)
    for k, direction in enumerate(couples):
        basis[..., 3:, count + k] = direction
    return Transmitter(name, *bodies, point, tuple(names), basis, effort)


def compute_needed_wrenches(
    graph: Graph, names: Sequence[str], bodies: Array, rods: Array
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Return a point of each body and rod, and the wrench about it that its joints apply."""
    origin: dict[str, Array] = {}
    needed: dict[str, Array] = {}
    for k, name in enumerate(names):
        origin[name] = bodies[..., 9 * k : 9 * k + 3]
        needed[name] = bodies[..., 9 * k + 3 : 9 * k + 9].copy()
    for k, name in enumerate(graph.rods):
        start, end, first, second = (rods[..., 15 * k + 3 * i :][..., :3] for i in range(4))
        origin[name] = (start + end) / 2
        couple = np.cross((end - start) / 2, second - first)
        needed[name] = np.concatenate([first + second, couple], -1)
    return origin, needed


def _place_columns(joint: Transmitter, names: tuple[str, ...], batch: tuple[int, ...]) -> Array:
    """Place the joint's wrench basis in the columns of all unknowns, (..., 6, unknowns)."""
    result = np.zeros((*batch, 6, len(names)))
    result[..., [names.index(name) for name in joint.components]] = joint.basis
    return result


def mark_moments(joints: Sequence[Transmitter], names: tuple[str, ...]) -> Mask:
    """Return which unknowns are moments, shape (unknowns,)."""
    result = np.zeros(len(names), bool)
    for joint in joints:
        pure = np.logical_not(np.any(joint.basis[..., :3, :], -2))
        for k, name in enumerate(joint.components):
            result[names.index(name)] = bool(np.all(pure[..., k]))
    return result


def assemble_transmission(
    joints: Sequence[Transmitter],
    names: tuple[str, ...],
    origin: dict[str, Array],
    batch: tuple[int, ...],
) -> Array:
    """Return the wrench on each body about its point per unknown, (..., 6 bodies, unknowns)."""
    result = np.zeros((*batch, len(origin), 6, len(names)))
    order = list(origin)
    for joint in joints:
        columns = _place_columns(joint, names, batch)
        for body, sign in ((joint.inner, -1.0), (joint.outer, 1.0)):
            if body == BASE:
                continue
            lever = joint.point - origin[body]
            shifted = np.cross(lever[..., None, :], columns[..., :3, :].swapaxes(-1, -2))
            on_body = result[..., order.index(body), :, :]
            on_body += sign * columns
            on_body[..., 3:, :] += sign * shifted.swapaxes(-1, -2)
    return result.reshape(*batch, 6 * len(origin), len(names))


POINT_FRACTION: Final = 1e-6
"""Extent of all joints, relative to the machine's size, below which they count as one point."""
SINGULAR_VALUE_BOUND: Final = SINGULARITY_BOUND
"""Singular values of the balance below this fraction of the largest count as zero."""
MIN_FULL_RANK_CONDITION: Final = 1e-6
"""Reciprocal condition above which the rank is full without singular values."""
DETERMINATE_BOUND: Final = 1e-6
"""Largest entry of a determinate component in the unit vectors of the null space."""
BALANCE_BOUND: Final = 1e-6
"""Largest imbalance, relative to the loads, of an equilibrium."""


@dataclass(frozen=True)
class Reactions:
    """The wrench that each joint's inner body (on the base's side) applies to its outer body.

    The friction moment of a passive joint is not in its wrench.

    Arrays are read-only. Components that rigid-body statics does not determine are NaN, and False
    in the masks.
    """

    names: tuple[str, ...]
    """The joints."""
    bodies: tuple[tuple[str, str], ...]
    """Inner and outer body of each joint; the outer one receives the wrench."""
    points: Array
    """The joints' points, shape (..., joints, 3), m."""
    wrenches: Array
    """Force (N) and moment (N m) about the joint's point, world axes, (..., joints, 6)."""
    determinate: Mask
    """Which entries of ``wrenches`` rigid-body statics determines, (..., joints, 6)."""
    components: tuple[str, ...]
    """The unknowns along the joints' own directions, by name."""
    values: Array
    """Their amounts, shape (..., components), N or N m."""
    determinate_components: Mask
    """Which of ``values`` are determinate, shape (..., components)."""
    actuated: tuple[str, ...]
    """Names of the n components that the actuators apply."""
    residual: Array
    """Greatest imbalance of a body's force or moment over the greatest load, shape (...)."""

    @property
    def indeterminate(self) -> tuple[str, ...]:
        """Names of the components that are indeterminate in one sample or more."""
        known = self.determinate_components.reshape(-1, len(self.components))
        return tuple(n for k, n in enumerate(self.components) if not known[:, k].all())

    @property
    def efforts(self) -> Array:
        """The actuators' efforts that act on the bodies, shape (..., n), positive as in q.

        N m or N; the efforts minus friction and the rotors' inertial efforts.
        """
        return self.values[..., [self.components.index(name) for name in self.actuated]]

    def wrench(self, name: str) -> Array:
        """Wrench at the joint ``name``, shape (..., 6)."""
        return self.wrenches[..., self.names.index(name), :]


def reactions(robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, wrench: ArrayLike | None = None) -> Reactions:
    """Compute constraint forces and moments at every joint, for a motion.

    Force and moment balance of each body (d'Alembert's principle; Delta-CU paper, equations 17 to
    21, at A, B and C of each limb), the payload fixed to the platform. The actuated components are
    the efforts on the bodies: motor effort minus the joint's friction and its rotor's inertial
    effort.

    The rank of the balance decides which components the mechanism's statics determines; the others
    are NaN, see ``Reactions.determinate`` and ``Reactions.indeterminate``.

    Parameters and errors as in :func:`~delta_dynamics.inverse_dynamics`.

    :raises SingularityError: also where the joints cannot hold the loads (a constraint
        singularity).
    """
    return hide_indeterminate(least_norm_reactions(robot, q, qd, qdd, wrench))


def list_undetermined(robot: Robot) -> list[str]:
    """List the reactions at home that rigid-body statics does not determine; empty if none.

    Without masses in the file: the redundant closure equations.
    """
    if not why_no_torques(robot):
        zero = np.zeros(len(robot.joint_names))
        return list(reactions(robot, robot.inverse(robot.home()), zero, zero).indeterminate)
    mobility = robot.engine.mobility
    if not mobility.redundant:
        return []
    count = f"{mobility.redundant} of {mobility.closures} closure equations"
    return [f"{count} are redundant, among {', '.join(mobility.parts)}"]


def hide_indeterminate(full: Reactions) -> Reactions:
    """Return the reactions with NaN for indeterminate components."""
    return replace(
        full,
        wrenches=_read_only(np.where(full.determinate, full.wrenches, np.nan)),
        values=_read_only(np.where(full.determinate_components, full.values, np.nan)),
    )


@dataclass(frozen=True, eq=False)
class Balance:
    """Force and moment balances of all bodies in every sample, with their solutions.

    ``value``: the least-norm solution (..., unknowns). ``null``: columns that may be added to it,
    of no unit, shape (..., unknowns, unknowns), zero beyond their number; ``unit`` (..., unknowns)
    makes them forces (N) and moments (N m). ``spread``: wrenches of the joints about their points
    by the unknowns, shape (..., joints, 6, unknowns). ``size``: of the machine, m, (...).
    """

    joints: tuple[Transmitter, ...]
    components: tuple[str, ...]
    points: Array
    spread: Array
    value: Array
    null: Array
    unit: Array
    size: Array
    residual: Array

    def reactions(self, value: Array, null: Array) -> Reactions:
        """Return the reactions of a solution and its null space."""
        joints, reach = self.joints, np.zeros((*self.spread.shape[:-1], 1))
        if null.any():
            # Scale the null space's moments to forces, so that one bound applies to both.
            reach = self.spread @ (null * self.unit[..., None])[..., None, :, :]
            reach[..., 3:, :] /= self.size[..., None, None, None]
        return Reactions(
            names=tuple(joint.name for joint in joints),
            bodies=tuple((joint.inner, joint.outer) for joint in joints),
            points=_read_only(self.points),
            wrenches=_read_only((self.spread @ value[..., None, :, None])[..., 0]),
            determinate=_is_determinate(reach),
            components=self.components,
            values=_read_only(value),
            determinate_components=_is_determinate(null),
            actuated=tuple(joint.actuated for joint in joints if joint.actuated is not None),
            residual=_read_only(self.residual),
        )


def least_norm_reactions(
    robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, wrench: ArrayLike | None = None
) -> Reactions:
    """Compute :func:`reactions`, with the least-norm solution for indeterminate components.

    This is the solution of the balance with the smallest sum of squares, with moments divided by
    the mechanism's size (root mean square distance of the joints from their centre). In a real
    machine elasticity and tolerances determine these components; this is one of many solutions.
    """
    found = balance(robot, q, qd, qdd, wrench)
    return found.reactions(found.value, found.null)


def balance(robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, wrench: ArrayLike | None = None) -> Balance:
    """Solve the balances of a motion; arguments and errors as :func:`reactions`."""
    load = np.zeros(6) if wrench is None else wrench
    loads = robot.evaluate(needed_wrench_kernel(robot), q, qd, qdd, load, p=robot.inertial)
    found = solve_balances(robot, loads)
    if robot.redundant:
        efforts = robot.evaluate(body_effort_kernel(robot), q, qd, qdd, load, p=robot.inertial)[0]
        # Balances with the given efforts (..., n) of a redundant machine's drives.
        names = [joint.actuated for joint in found.joints if joint.actuated is not None]
        rows = [found.components.index(name) for name in names]
        unit = found.unit[..., rows]
        u, s, vt = np.linalg.svd(found.null[..., rows, :])
        used, turned = s > SINGULAR_VALUE_BOUND, found.null @ vt.swapaxes(-1, -2)
        apart = np.einsum("...ij,...i->...j", u, (efforts - found.value[..., rows]) / unit)
        along = np.where(used, apart / np.where(used, s, 1.0), 0.0)
        n = len(rows)
        moved = np.einsum("...kj,...j->...k", turned[..., :n], along)
        turned[..., :n] = np.where(used[..., None, :], 0.0, turned[..., :n])
        found = replace(found, value=found.value + moved * found.unit, null=turned)
    require_finite(found.value, "the motion or the wrench")
    return found


def solve_balances(robot: Robot, loads: Sequence[Array], *, strict: bool = True) -> Balance:
    """Solve the balances of the loads of :func:`needed_wrench_kernel`, also of variants of the robot.

    :param strict: raise if a sample has no equilibrium; without it ``residual`` exceeds
        ``BALANCE_BOUND`` there.
    """
    engine = robot.massive()
    bodies, rods, places = loads
    joints = list_transmitters(engine.graph, rods, places)
    names = tuple(dict.fromkeys(name for joint in joints for name in joint.components))
    points = np.stack([joint.point for joint in joints], -2)
    centred = points - points.mean(-2, keepdims=True)
    size = np.sqrt(np.mean(np.sum(centred**2, -1), -1))
    # If all joints are in one point their extent is zero: use the machine's size.
    size = np.where(size > POINT_FRACTION * engine.graph.size, size, engine.graph.size)

    origin, needed = compute_needed_wrenches(engine.graph, list(engine.tree.links), bodies, rods)
    batch = bodies.shape[:-1]
    a = assemble_transmission(joints, names, origin, batch)
    b = np.concatenate([needed[body] for body in origin], -1)
    moment = mark_moments(joints, names)
    with np.errstate(over="ignore", invalid="ignore"):
        value, null, residual = _solve_scaled(a, b, moment, size, strict=strict)

    spread = np.stack([_place_columns(joint, names, batch) for joint in joints], -3)
    return Balance(
        tuple(joints),
        names,
        points,
        spread,
        value,
        null,
        _scale_unknowns(moment, size),
        size,
        residual,
    )


def needed_wrench_kernel(robot: Robot) -> Kernel:
    """Return the program from a motion and a wrench to the bodies' required wrenches and positions.

    :raises ParameterError: a robot without masses.
    """
    return robot.massive().kernel("loads", _write_positions_and_wrenches)


def _write_positions_and_wrenches(t: Traced) -> Program:
    """Write the positions of bodies, rods and joints, and the wrench that each body's motion requires.

    Body: origin, force, moment about the origin. Rod: both ends, the force required at each, the
    direction to its parallel rod. Joint: its point and three directions; then the direction
    perpendicular to both axes of a universal joint, or a screw's pitch.
    """
    t.solve()
    layout = Layout(t.tree)
    bodies, rods, gravity, *_, passive = layout.split(t.tape.inputs(PARAMETERS, layout.size))
    t.set_rates(t.drives.leading_inputs("qd"))
    t.set_accelerations(t.drives.leading_inputs("qdd"), BaseMotion.at_rest(gravity))
    motion, graph = t.motion, t.graph
    forces = Forces(motion)
    # Rods are separate bodies here, so add only the other bodies.
    for name, inertial in zip(t.tree.links, bodies, strict=True):
        forces.add_body(name, inertial)
    forces.add_passive_joints(passive)
    forces.subtract_wrench(t.tape.inputs("wrench", 6))
    body_rows: list[Any] = []
    for name in t.tree.links:
        body_rows += [*motion.origin[name], *forces.force[name], *forces.moment[name]]
    rod_rows: list[Any] = []
    for mass, rod in zip(rods, graph.rods.values(), strict=True):
        start, end = motion.point(rod.inner, rod.ends[0]), motion.point(rod.outer, rod.ends[1])
        a, b = (
            motion.acceleration(body, point) for body, point in ((rod.inner, rod.ends[0]), (rod.outer, rod.ends[1]))
        )
        pair = np.zeros(3) if rod.pair is None else motion.direction(rod.outer, rod.pair)
        sixth = mass * (1.0 / 6.0)
        rod_rows += [*start, *end, *(sixth * (2.0 * a + b)), *(sixth * (a + 2.0 * b)), *pair]
    joint_rows: list[Any] = []
    for joint in graph.joints.values():
        joint_rows += motion.point(joint.outer, joint.at).tolist()
        for direction in reaction_directions(joint):
            joint_rows += motion.direction(direction.body, direction.vector).tolist()
        if len(joint.axes) == 2:
            first = motion.direction(joint.inner, joint.axes[0])
            joint_rows += cross(motion.direction(joint.outer, joint.axes[1]), first).tolist()
        else:
            joint_rows += [joint.pitch, 0.0, 0.0]
    outputs = {
        "bodies": t.lift(body_rows),
        "rods": t.lift(rod_rows),
        "joints": t.lift(joint_rows),
    }
    return Program(t.inputs("q", "qd", "qdd", wrench=6), layout.size, outputs, t.equations())


def _scale_unknowns(moment: Mask, size: Array) -> Array:
    """Return the machine's size for moments and one for forces, shape (..., unknowns)."""
    return np.where(moment, size[..., None], 1.0)


def _solve_scaled(a: Array, b: Array, moment: Mask, size: Array, *, strict: bool) -> tuple[Array, Array, Array]:
    """Return the least-norm solution, an orthonormal null space and the relative imbalance.

    Moments and lengths are divided by the mechanism's size, so that all numbers are forces. The
    columns of the null space, shape (..., unknowns, unknowns), are zero beyond its dimension.
    """
    equations, unknowns = a.shape[-2:]
    batch = b.shape[:-1]
    turning = np.tile(np.arange(6) >= 3, equations // 6)
    unit = _scale_unknowns(moment, size)
    rows = np.where(turning, 1.0 / size[..., None], 1.0)
    matrix = (a * rows[..., None] * unit[..., None, :]).reshape(-1, equations, unknowns)
    right = (b * rows).reshape(-1, equations)
    value, regular = _solve_full_rank(matrix, right)
    null = np.zeros((len(matrix), unknowns, unknowns))
    if not regular.all():
        value[~regular], null[~regular] = _solve_rank_deficient(matrix[~regular], right[~regular])
    left = right - (matrix @ value[..., None])[..., 0]
    scale = np.maximum(np.abs(right).max(-1), np.finfo(np.float64).tiny)
    residual = np.asarray(np.abs(left).max(-1) / scale, np.float64).reshape(batch)
    if strict and (residual > BALANCE_BOUND).any():
        index = tuple(int(i) for i in np.argwhere(residual > BALANCE_BOUND)[0])
        s = np.linalg.svd(matrix.reshape(*batch, equations, unknowns)[index], compute_uv=False)
        measure = float(s[-1] / s[0])
        raise SingularityError("constraint of the joint state", index, measure, SINGULAR_VALUE_BOUND)
    null = null.reshape(*batch, unknowns, unknowns)
    return value.reshape(*batch, unknowns) * unit, null, residual


def _solve_full_rank(matrix: Array, right: Array) -> tuple[Array, Mask]:
    """Solve the samples with clearly independent columns; return also the mask of these.

    By QR, or directly if the system is square: this takes a tenth of the time of the singular value
    decomposition that other samples need.
    """
    equations, unknowns = matrix.shape[-2:]
    if unknowns > equations:
        return np.zeros((len(matrix), unknowns)), np.zeros(len(matrix), bool)
    sound, inverse, r, along = np.ones(len(matrix), bool), None, matrix, right[..., None]
    if unknowns == equations:
        # QR finds which sample is exactly singular.
        with suppress(np.linalg.LinAlgError):
            inverse = np.linalg.inv(matrix)
    if inverse is None:
        q, r = np.linalg.qr(matrix)
        along = q.swapaxes(-1, -2) @ along
        diagonal = np.abs(np.diagonal(r, axis1=-2, axis2=-1))
        sound = diagonal.min(-1) > MIN_FULL_RANK_CONDITION * diagonal.max(-1)
        inverse = np.linalg.inv(np.where(sound[:, None, None], r, np.eye(unknowns)))
    condition = np.linalg.norm(r, axis=(-2, -1)) * np.linalg.norm(inverse, axis=(-2, -1))
    return (inverse @ along)[..., 0], sound & (condition * MIN_FULL_RANK_CONDITION < 1.0)


def _solve_rank_deficient(matrix: Array, right: Array) -> tuple[Array, Array]:
    """Return the least-norm solution and the null space by singular values."""
    equations, unknowns = matrix.shape[-2:]
    # Append empty equations, so that every unknown has a singular value.
    missing = max(0, unknowns - equations)
    full = np.pad(matrix, [(0, 0), (0, missing), (0, 0)])
    u, s, vt = np.linalg.svd(full, full_matrices=False)
    sound = s > SINGULAR_VALUE_BOUND * s[:, :1]
    inverse = np.where(sound, 1.0 / np.where(sound, s, 1.0), 0.0)
    along = inverse * (np.pad(right, [(0, 0), (0, missing)])[:, None] @ u)[:, 0]
    return (along[:, None] @ vt)[:, 0], np.where(sound[..., None], 0.0, vt).swapaxes(-1, -2)


def _is_determinate(reach: Array) -> Mask:
    """Return whether the null space leaves an entry unchanged, over the last axis."""
    result: Mask = np.linalg.norm(reach, axis=-1) < DETERMINATE_BOUND
    result.setflags(write=False)
    return result


def _read_only(values: Array) -> Array:
    values.setflags(write=False)
    return values
