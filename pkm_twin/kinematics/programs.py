# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The programs of kinematics: pose, Jacobians, placements, accelerations, inverse."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from pkm_twin.codegen.expressions import Expression, Numbers, Objects
from pkm_twin.codegen.lu import SparseLU
from pkm_twin.codegen.operations import absolute, cos, sin
from pkm_twin.codegen.program import (
    MIN_RELATIVE_DETERMINANT,
    STATE,
    STATE_INDEX,
    UNKNOWNS,
    Equations,
    Program,
    previous_input_name,
)
from pkm_twin.kinematics import pose as poses
from pkm_twin.kinematics.motion import Motion, Row, closure_jacobians
from pkm_twin.kinematics.posed import PlatformFirstScheme
from pkm_twin.kinematics.traced import POSED, Traced

POSE_WEIGHT: Final = 100.0
"""Weight of pose equations relative to closures in the search for a reason of rejection: if both
cannot be satisfied, the pose is met and the gap is in a closure."""
MAX_PREDICTED_POSE_ERROR: Final = 0.125
"""Largest dimensionless error of a pose that the derivatives at home and there predict, see
:func:`certify_assembly`."""
MIN_DETERMINANT_PER_ERROR: Final = 1.5
"""Smallest ratio of the closures' determinant to that error. Of 2.1 million far poses of many
machines none within twice the error and half the ratio has another pose as ``forward``."""
MIN_CERTAIN_DETERMINANT: Final = 1e-5
"""Smallest determinant of the closures, relative to home, for machines with a closed-form start:
``forward`` computes it from other pivots and rejects values below 1e-8; near a singularity the two
agree to few digits."""
MAX_POSE_ROUNDING: Final = 1e-7
"""Largest dimensionless difference of two solutions for the same pose, from rounding. The pose of
another assembly differs by more, unless a singularity is nearer than that."""


def newton_step_program(t: Traced) -> Program:
    """Write the program of one Newton step towards a pose; the unknowns include q."""
    scheme, tree, tape = t.scheme, t.tree, t.tape
    size, free = len(tree.home), tree.unknown_rates
    everything = tape.inputs(UNKNOWNS, size + t.joints)
    goal = tape.inputs("pose", len(scheme.coordinates))
    motion = Motion(tree, everything[:size], everything[size:])
    rows = motion.closures()
    equations = poses.rows(scheme.coordinates, motion, goal)
    table = np.vstack([np.hstack(closure_jacobians(tree, rows)), scheme.pose_rows(motion, goal)])
    scales = [row.scale for row in rows] + [POSE_WEIGHT * scale for scale in t.pose_scales]
    columns = [*tree.scales, *t.drive_scales]
    entries = [
        scale * entry / column
        for scale, line in zip(scales, table, strict=True)
        for entry, column in zip(line, columns, strict=True)
    ]
    values = [row.value for row in rows] + [value for value, _ in equations]
    move = tape.inputs("move", free + t.joints) / np.array(columns)
    moved = [*motion.retract(everything[:size], move[:free]), *(everything[size:] + move[free:])]
    outputs = {
        "values": t.lift([s * v for s, v in zip(scales, values, strict=True)]),
        "table": t.lift(entries),
        "moved": t.lift(moved),
    }
    sizes = {UNKNOWNS: size + t.joints, "pose": len(goal), "move": free + t.joints}
    return Program(sizes, 0, outputs)


def forward_program(t: Traced) -> Program:
    """Write the program of :attr:`.engine.Engine.forward`."""
    t.solve()
    position, rotation = t.motion.platform()
    values = poses.evaluate_coordinates(t.scheme.coordinates, position, rotation)
    outputs = {
        "pose": t.lift(values),
        "position": t.lift(position),
        "rotation": t.lift(np.ravel(rotation)),
    }
    return Program(t.inputs("q"), 0, outputs, t.equations())


def jacobian_program(t: Traced) -> Program:
    """Write the program of :attr:`.engine.Engine.jacobian`."""
    t.solve()
    position, rotation = t.motion.platform()
    twists = t.twists(t.graph.platform, position, t.rate_columns())
    rates = [poses.rates(t.scheme.coordinates, rotation, v, w) for v, w in twists]
    by_pose, by_twist = (zip(*r, strict=True) for r in (rates, [[*v, *w] for v, w in twists]))
    outputs = {
        "rates": t.lift([value for row in by_pose for value in t.drives.distribute(row)]),
        "twist": t.lift([value for row in by_twist for value in t.drives.distribute(row)]),
    }
    return Program(t.inputs("q"), 0, outputs, t.equations())


def placement_program(t: Traced) -> Program:
    """Write the program of :attr:`.engine.Engine.placement`."""
    t.solve()
    rows: list[Any] = []
    for body in t.graph.bodies:
        rows += [*np.ravel(t.motion.rotation_from_home(body)), *t.motion.origin[body]]
    return Program(t.inputs("q"), 0, {"bodies": t.lift(rows)}, t.equations())


def body_jacobian_program(t: Traced) -> Program:
    """Write the program of :attr:`.engine.Engine.body_jacobian`."""
    t.solve()
    columns, values = t.rate_columns(), []
    for body in t.graph.bodies:
        twists = [[*v, *w] for v, w in t.twists(body, t.motion.origin[body], columns)]
        values += [value for row in zip(*twists, strict=True) for value in t.drives.distribute(row)]
    return Program(t.inputs("q"), 0, {"twists": t.lift(values)}, t.equations())


def acceleration_program(t: Traced) -> Program:
    """Write the program of :attr:`.engine.Engine.acceleration`."""
    t.solve()
    qd, qdd = t.drives.leading_inputs("qd"), t.drives.leading_inputs("qdd")
    t.set_rates(qd)
    t.set_accelerations(qdd)
    second = pose_accelerations(t)
    return Program(t.inputs("q", "qd", "qdd"), 0, {"acceleration": t.lift(second)}, t.equations())


def projection_program(t: Traced) -> Program:
    """Write the program from the leading drives' motion to the motion of all drives."""
    t.solve()
    q, qd, qdd = (t.tape.inputs(name, t.drives.count)[t.drives.leading] for name in ("q", "qd", "qdd"))
    t.set_rates(qd)
    t.set_accelerations(qdd)
    outputs = {
        "q": t.lift(t.tree.drive_positions(q, t.x)),
        "qd": t.lift(t.tree.drive_rates(qd, t.u)),
        "qdd": t.lift(t.tree.drive_rates(qdd, t.du)),
    }
    return Program(t.inputs("q", "qd", "qdd"), 0, outputs, t.equations(goal=t.lift(q)))


def inverse_program(t: Traced, scheme: PlatformFirstScheme | None) -> Program:
    """Write the inverse kinematics, confirmed by the forward kinematics (:func:`confirm_pose`).

    :param scheme: the machine driven by its pose; None: iterate on the machine's own tree.
    """
    pose = t.tape.inputs("pose", len(t.scheme.coordinates))
    if scheme is None:
        equations, leads = iterate_pose(t)
        q = t.tree.drive_positions(leads, t.x)
    else:
        posed, q = solve_pose(t, scheme)
        t = t.reduced
        equations = posed.equations() + confirm_pose(t, [q[k] for k in t.drives.leading])
    return Program({"pose": len(pose)}, 0, {"q": t.lift(q)}, equations)


def confirm_pose(t: Traced, leads: Numbers, *, rates: bool = False) -> tuple[Equations, ...]:
    """Return the equations of ``forward`` at the leading joints, valid only if it gives the pose.

    Joint positions found for a pose may belong to another assembly, whose ``forward`` differs.

    :param rates: whether results also depend on :func:`pose_factors`.
    """
    t.solve()
    pose = t.tape.inputs("pose", len(t.scheme.coordinates))
    there = poses.evaluate_coordinates(t.scheme.coordinates, *t.motion.platform())
    same: list[Any] = []
    for c, scale, a, b in zip(t.scheme.coordinates, t.pose_scales, there, pose, strict=True):
        apart = a - b
        if c.axis is None:
            # Angles are compared modulo a full turn.
            same.append(cos(apart))
            apart = sin(apart)
        same.append(MAX_POSE_ROUNDING - absolute(apart) * scale)
    if rates:
        same += t.pivot_margins(pose_factors(t), t.pose_scales, t.drive_scales)
    return t.equations(branch=t.lift(same), goal=t.lift(leads), stage=1)


def quick_inverse_program(t: Traced, scheme: PlatformFirstScheme) -> Program:
    """Write an inverse kinematics without confirmation, for poses whose assembly is certain.

    It rejects the poses that :func:`certify_assembly` does not cover; :func:`inverse_program` may
    still solve them.
    """
    posed, q = solve_pose(t, scheme)
    equations = posed.equations(certain=t.lift(certify_assembly(t, scheme, posed, q)))
    return Program({"pose": len(posed.q)}, 0, {"q": t.lift(q)}, equations, single=True)


def solve_pose(t: Traced, scheme: PlatformFirstScheme) -> tuple[Traced, list[Any]]:
    """Return the solved machine that is driven by its pose, and the positions of all drives."""
    posed = t.platform_first(scheme)
    posed.solve()
    return posed, posed.tree.joint_positions(t.graph.actuated, posed.x)


def transmission_program(t: Traced, scheme: PlatformFirstScheme | None, *, certified: bool, curved: bool) -> Program:
    """Write the program from a pose to the drives' positions and their rates per pose rate.

    :param certified: reject the poses that :func:`quick_inverse_program` rejects.
    :param curved: add the input ``rate`` of the pose, and the output of the drives' second
        derivatives at that constant rate.
    """
    m = len(t.scheme.coordinates)
    rate = t.tape.inputs("rate", m) if curved else None
    if scheme is None:
        equations, leads = iterate_pose(t, rates=True)
        q = t.tree.drive_positions(leads, t.x)
        lu = pose_factors(t)
        follow = np.array(t.rate_columns(), dtype=object).T
        leading = [lu.solve(unit) for unit in np.eye(m)]
        by_pose = np.array([t.tree.drive_rates(own, follow @ own) for own in leading], object).T
        if rate is not None:
            t.set_rates(lu.solve(rate))
            t.set_accelerations(np.zeros(m))
            change = lu.solve(-np.array(pose_accelerations(t), dtype=object))
            t.set_accelerations(change)
            changes = t.tree.drive_rates(change, t.du)
    else:
        posed, q = solve_pose(t, scheme)
        certain = certify_assembly(t, scheme, posed, q) if certified else []
        equations = posed.equations(certain=t.lift(certain))
        by_pose = posed.rates_of_joints(t.graph.actuated)
        if rate is not None:
            posed.set_rates(rate)
            posed.set_accelerations(np.zeros(m))
            changes = [posed.du[posed.tree.steps[name].rate] for name in t.graph.actuated]
    outputs = {"q": t.lift(q), "ratio": t.lift(np.ravel(by_pose))}
    if rate is not None:
        outputs["change"] = t.lift(changes)
    inputs = {"pose": m} | ({} if rate is None else {"rate": m})
    return Program(inputs, 0, outputs, equations, single=certified and scheme is not None)


def actuator_program(t: Traced) -> Program:
    """Write the program from the drives' positions, rates and efforts to those of the pose."""
    t.solve()
    tau, qd = (t.tape.inputs(name, t.drives.count) for name in ("tau", "qd"))
    position, rotation = t.motion.platform()
    twists = t.twists(t.graph.platform, position, t.rate_columns())
    rows = zip(*[poses.rates(t.scheme.coordinates, rotation, v, w) for v, w in twists], strict=True)
    velocity = [np.array(t.drives.distribute(row), dtype=object) @ qd for row in rows]
    factors = pose_factors(t)
    effort = factors.solve_transposed(t.drives.leading_efforts([*tau]))
    outputs = {
        "pose": t.lift(poses.evaluate_coordinates(t.scheme.coordinates, position, rotation)),
        "velocity": t.lift(velocity),
        "effort": t.lift(effort),
    }
    sound = t.pivot_margins(factors, t.pose_scales, t.drive_scales)
    return Program(t.inputs("q", "qd", "tau"), 0, outputs, t.equations(branch=sound))


def pose_factors(t: Traced) -> SparseLU:
    """Factor the Jacobian from the leading drives' rates to the pose's rates, for a solved ``t``."""
    position, rotation = t.motion.platform()
    twists = t.twists(t.graph.platform, position, t.rate_columns())
    columns = [poses.rates(t.scheme.coordinates, rotation, v, w) for v, w in twists]
    return SparseLU(np.array(columns, dtype=object).T, t.scheme.jacobian_pivots)


def pose_accelerations(t: Traced) -> list[Any]:
    """Return the second derivatives of the pose in time, after rates and accelerations are set."""
    motion, body = t.motion, t.graph.platform
    return poses.accelerations(
        t.scheme.coordinates,
        motion.rotation_from_home(body),
        motion.omega[body],
        motion.acceleration(body, t.graph.origin),
        motion.alpha[body],
    )


def certify_assembly(t: Traced, scheme: PlatformFirstScheme, posed: Traced, q: Sequence[Any]) -> list[Any]:
    """Return margins that are all positive only if ``forward`` of q is certainly the pose.

    With the pose x, A = dq/dx, and home x0, q0, A0: the mean of the linear predictions A0^-1 (q - q0)
    and A^-1 (q - q0) must be near x - x0, by the determinant there, so that no singularity lies between.
    For a machine with a closed-form start the signs at its singularities identify the assembly.
    """
    names, order = t.graph.leads, scheme.drive_pivots
    rates, rates_home = (posed.fast_rates_of_joints(names, home=home) for home in (False, True))
    here, at_home = SparseLU(rates, order), SparseLU(rates_home, order)
    drives = at_home.inverse_determinant / here.inverse_determinant
    closures = drives * posed.determinant
    if t.scheme.start is not None:
        return [closures - MIN_CERTAIN_DETERMINANT, *t.scheme.start.find_conditions(posed.motion)]
    move = posed.q - posed.graph.lead_home
    way = np.array([q[k] for k in t.drives.leading], dtype=object) - t.graph.lead_home
    apart = (0.5 * (at_home.solve(way) + here.solve(way)) - move) * np.array(t.pose_scales, dtype=object)
    distance = apart @ apart
    return [
        drives - MIN_RELATIVE_DETERMINANT,
        MAX_PREDICTED_POSE_ERROR * MAX_PREDICTED_POSE_ERROR - distance,
        closures * closures - MIN_DETERMINANT_PER_ERROR * MIN_DETERMINANT_PER_ERROR * distance,
    ]


def iterate_pose(t: Traced, *, rates: bool = False) -> tuple[tuple[Equations, ...], Objects]:
    """Solve the machine's own tree for a pose; return the equations and the leading joints.

    Newton's method solves for all unknowns and joints; :func:`confirm_pose` checks the solution.

    :param rates: as for :func:`confirm_pose`.
    """
    scheme, tree, tape = t.scheme, t.tree, t.tape
    goal = tape.inputs("pose", len(scheme.coordinates))
    size, split = len(tree.home), tree.unknown_rates
    home = [*tree.home, *t.graph.lead_home]
    everything = tape.inputs(POSED, len(home))
    origin = [0.0 if c.axis is None else t.graph.origin[c.axis] for c in scheme.coordinates]

    def system(state: Numbers, pose: Numbers) -> tuple[Motion, list[Row], list[Any], SparseLU]:
        """Return motion, closures, pose equations, and the LU factors of their Jacobian."""
        motion = Motion(tree, state[:size], state[size:])
        rows = motion.closures()
        table = np.hstack(closure_jacobians(tree, rows))[scheme.independent]
        matrix = np.vstack([table, scheme.pose_rows(motion, pose)])
        equations = [value for value, _ in poses.rows(scheme.coordinates, motion, pose)]
        return motion, rows, equations, SparseLU(matrix, scheme.inverse_pivots)

    motion, rows, equations, lu = system(everything, goal)
    step = -lu.solve([rows[k].value for k in scheme.independent] + equations)

    def retract(state: Objects, step: Objects) -> list[Expression]:
        retracted = motion.retract(state[:size], step[:split])
        return t.lift([*retracted, *(state[size:] + step[split:])])

    onward = tape.inputs(STATE, len(STATE_INDEX))[STATE_INDEX.onward]
    way = onward * (everything - tape.inputs(previous_input_name(POSED), len(home)))
    solved = Equations(
        "pose",
        t.lift(home),
        t.lift(origin),
        None,
        retract(everything + way, np.zeros(len(step))),
        retract(everything, step),
        t.square(step, [*tree.scales, *t.drive_scales]),
        tape.lift(system(home, origin)[3].inverse_determinant / lu.inverse_determinant),
        t.square([r.value for r in rows] + equations, [r.scale for r in rows] + t.pose_scales),
        unknowns=POSED,
    )
    leads = everything[size:]
    return (solved, *confirm_pose(t, leads, rates=rates)), leads
