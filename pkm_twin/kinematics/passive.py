# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Values of the passive joints in a URDF's convention: one number a revolute or prismatic axis.

A spherical joint and a free body's rotation are three revolutes in series (x, y and z at home), a
universal joint is two, a cylindrical joint a prismatic and a revolute, a translation three
prismatics, a screw a revolute and the prismatic that its thread couples (``NAME_slide``, also if
actuated). A rod is a link on two revolutes, which rotate it from its direction at home.
"""

from __future__ import annotations

from itertools import chain
from typing import Any

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import Expression, Numbers, Objects, cross
from pkm_twin.codegen.operations import atan2, sqrt
from pkm_twin.codegen.program import Program
from pkm_twin.kinematics.engine import Engine
from pkm_twin.kinematics.traced import Traced
from pkm_twin.machine.graph import Rod
from pkm_twin.machine.joints import name_single_freedoms, perpendicular_axes, unit
from pkm_twin.machine.names import FREE_BODY, FREE_ROD, joint_labels
from pkm_twin.machine.tree import Link


def rod_axes(rod: Rod) -> tuple[Array, Array]:
    """Return the axes of the two revolutes at a rod's inner end, at home."""
    return perpendicular_axes(unit(rod.ends[1] - rod.ends[0]))


def passive_names(engine: Engine) -> tuple[str, ...]:
    """Name all passive joint values: of the tree from the ground outwards, then of the rods."""
    names: list[str] = []
    labels = joint_labels(engine.tree)
    for link in engine.tree.links.values():
        if link.joint is None:
            names += name_single_freedoms(labels["bodies", link.body], FREE_BODY)
        else:
            joint = engine.graph.joints[link.joint]
            names += name_single_freedoms(labels["joints", joint.name], joint.freedoms)[joint.actuated :]
    rods = (name_single_freedoms(labels["rods", rod], FREE_ROD) for rod in engine.graph.rods)
    return (*names, *chain.from_iterable(rods))


def passive_program(t: Traced) -> Program:
    """Write the program from q to all passive joint values."""
    t.solve()
    return Program(t.inputs("q"), 0, {"passive": t.lift(_passive_values(t))}, t.equations())


def passive_rates_program(t: Traced) -> Program:
    """Write the program from q and qd to the rates of all passive joint values."""
    t.solve()
    qd = t.drives.leading_inputs("qd")
    rates = t.lift(_passive_rates(t, qd, t.set_rates(qd)))
    return Program(t.inputs("q", "qd"), 0, {"rates": rates}, t.equations())


def state_program(t: Traced) -> Program:
    """Write the program from q to the platform's position (3), rotation (9) and passive values."""
    t.solve()
    return Program(t.inputs("q"), 0, _state_outputs(t), t.equations())


def moving_state_program(t: Traced) -> Program:
    """Write :func:`state_program` with qd, rates of passive values and the platform's twist (6)."""
    t.solve()
    qd = t.drives.leading_inputs("qd")
    u, motion, graph = t.set_rates(qd), t.motion, t.graph
    twist = [*motion.velocity(graph.platform, graph.origin), *motion.omega[graph.platform]]
    outputs = {**_state_outputs(t), "rates": t.lift(_passive_rates(t, qd, u)), "twist": t.lift(twist)}
    return Program(t.inputs("q", "qd"), 0, outputs, t.equations())


def _state_outputs(t: Traced) -> dict[str, list[Expression]]:
    position, rotation = t.motion.platform()
    return {
        "position": t.lift(position),
        "rotation": t.lift(np.ravel(rotation)),
        "passive": t.lift(_passive_values(t)),
    }


def _passive_values(t: Traced) -> list[Any]:
    motion, tree = t.motion, t.tree
    values: list[Any] = []
    for link in t.tree.links.values():
        steps = link.steps
        if steps and (steps[0].ball or steps[0].free):
            if steps[0].free:
                k = steps[0].position
                values += list(t.x[k + 4 : k + 7])
            r = _relative_rotation(t, link)
            # The angles a, b, c of Rx(a) Ry(b) Rz(c).
            root = sqrt(r[0][0] * r[0][0] + r[0][1] * r[0][1])
            values += [atan2(-r[1][2], r[2][2]), atan2(r[0][2], root), atan2(-r[0][1], r[0][0])]
            continue
        # The value at home is given in the file for a joint of one freedom, and zero for others.
        home = tree.graph.joints[steps[0].joint].home if len(steps) == 1 else 0.0
        for step in steps:
            value = t.q[step.position] - home if step.actuated else t.x[step.position]
            if step.circle:
                value = atan2(t.x[step.position + 1], value)
            values += [] if tree.graph.joints[step.joint].actuated else [value + home]
            values += [step.slide * value] if step.turns and step.slide else []
    for rod in t.graph.rods.values():
        span = motion.rotation_from_home(rod.inner).T @ _rod_vector(t, rod)
        b, a, x = _resolve_along_rod(rod, span)
        values += [atan2(a, x), atan2(b, sqrt(x * x + a * a))]
    return values


def _passive_rates(t: Traced, qd: Numbers, u: Numbers) -> list[Any]:
    motion = t.motion
    rates: list[Any] = []
    for link in t.tree.links.values():
        steps = link.steps
        if steps and (steps[0].ball or steps[0].free):
            k = steps[0].rate
            if steps[0].free:
                rates += list(u[k + 3 : k + 6])
            inner, r = motion.rotation_from_home(link.parent), _relative_rotation(t, link)
            omega = inner.T @ (motion.omega[link.body] - motion.omega[link.parent])
            # omega = a' x + b' (0, cos a, sin a) + c' (sin b, -sin a cos b, cos a cos b): rates are
            # infinite at the angles' singularity, cos b = 0.
            root = sqrt(r[0][0] * r[0][0] + r[0][1] * r[0][1])
            sine, cosine = -r[1][2] / root, r[2][2] / root
            third = (cosine * omega[2] - sine * omega[1]) / root
            rates += [omega[0] - third * r[0][2], cosine * omega[1] + sine * omega[2], third]
            continue
        for step in steps:
            rate = (qd if step.actuated else u)[step.rate]
            rates += [] if t.graph.joints[step.joint].actuated else [rate]
            rates += [step.slide * rate] if step.turns and step.slide else []
    for rod in t.graph.rods.values():
        inner, apart = motion.rotation_from_home(rod.inner), _rod_vector(t, rod)
        ends = [motion.velocity(body, end) for body, end in zip((rod.inner, rod.outer), rod.ends, strict=True)]
        # Relative velocity of the ends in the inner body's axes.
        slip = inner.T @ (ends[1] - ends[0] - cross(motion.omega[rod.inner], apart))
        (b, a, x), (vb, va, vx) = _resolve_along_rod(rod, inner.T @ apart), _resolve_along_rod(rod, slip)
        square = x * x + a * a
        level = sqrt(square)
        change = (x * vx + a * va) / level
        rates += [(x * va - a * vx) / square, (level * vb - b * change) / (square + b * b)]
    return rates


def _relative_rotation(t: Traced, link: Link) -> Objects:
    """Return the rotation of a link relative to its parent, the identity at home."""
    turned: Objects = t.motion.rotation_from_home(link.parent).T @ t.motion.rotation_from_home(link.body)
    return turned


def _rod_vector(t: Traced, rod: Rod) -> Any:
    """Return the vector from a rod's inner end to its outer end, base axes."""
    start, end = rod.ends
    return t.motion.point(rod.outer, end) - t.motion.point(rod.inner, start)


def _resolve_along_rod(rod: Rod, vector: Any) -> tuple[Any, Any, Any]:
    """Return a vector's components along second x along, first x along, and the rod (along).

    Rotated by b about the second axis, then by a about the first, the rod is at
    (cos b) (cos a along + sin a (first x along)) + sin b (second x along).
    """
    along = unit(rod.ends[1] - rod.ends[0])
    first, second = rod_axes(rod)
    side, up = np.cross(second, along), np.cross(first, along)
    return vector @ side, vector @ up, vector @ along
