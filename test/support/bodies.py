# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Motion of every body of a robot, and Newton's and Euler's laws on numbers.

Masses and inertias are taken from the graph and handled here in numpy alone; where the bodies are
is the engine's word, which test_motion.py holds against finite differences of placements.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pkm_twin import Robot
from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.code import STEPS
from pkm_twin.codegen.plain import PlainCode
from pkm_twin.codegen.program import Program
from pkm_twin.kinematics.engine import Engine
from pkm_twin.kinematics.traced import Traced
from pkm_twin.machine.graph import BASE, Joint


class PlainKernel:
    """A program with the numbers of one machine's geometry, as plain Python.

    It has no other parameters.
    """

    def __init__(self, program: Program, geometry: Array | None = None) -> None:
        self._code = PlainCode(program)
        numbers = np.zeros(0) if geometry is None else geometry
        self._prepared = self._code.prepare(numbers[None])[0]

    def run(self, inputs: list[Array], steps: int = 1) -> tuple[list[Array], Array]:
        """Outputs (k, size) of inputs (k, size), and the status (k, 2)."""
        return self._code.run(self._prepared, inputs, len(inputs[0]), steps)


@dataclass(frozen=True)
class Bodies:
    """Bodies, rods and the payload, in the order of ``robot.body_names``.

    Of B bodies: ``mass`` (B,), kg; ``com`` (..., B, 3), m; ``acceleration`` of it, (..., B, 3);
    ``moment``: rate of the angular momentum about it, (..., B, 3), N m; ``linear``, ``angular``:
    velocity of the com and angular velocity per joint rate, (..., B, 3, n); ``inertia`` about the
    com, base axes, (..., B, 3, 3).
    """

    names: tuple[str, ...]
    mass: Array
    com: Array
    acceleration: Array
    moment: Array
    linear: Array
    angular: Array
    inertia: Array


def bodies(robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike) -> Bodies:
    """All bodies of a robot in motion."""
    graph, n = robot.graph, len(robot.joint_names)
    load = robot.payload
    points = [(b.name, b.com) for b in graph.bodies.values()]
    rods = list(graph.rods.values())
    points += [pair for r in rods for pair in zip((r.inner, r.outer), r.ends, strict=True)]
    points.append((graph.platform, graph.origin + load.com))
    flat = np.broadcast_arrays(*(np.asarray(value, float) for value in (q, qd, qdd)))
    batch = flat[0].shape[:-1]
    where = tuple((body, tuple(np.asarray(point).tolist())) for body, point in points)
    inputs = [value.reshape(-1, n) for value in flat]
    outputs = np.full((len(inputs[0]), len(points) * (21 + 6 * n)), np.nan)
    for steps in (1, *STEPS):
        left = np.flatnonzero(np.isnan(outputs[:, 0]))
        if len(left):
            picked = [value[left] for value in inputs]
            (outputs[left],), _ = _code(robot.engine, where).run(picked, steps)
    assert np.isfinite(outputs).all()
    rows = outputs.reshape(*batch, len(points), 21 + 6 * n)
    place, change, turned, omega, alpha = (rows[..., a:b] for a, b in ((0, 3), (3, 6), (6, 15), (15, 18), (18, 21)))
    turned = turned.reshape(*batch, -1, 3, 3)
    linear, angular = (rows[..., a : a + 3 * n].reshape(*batch, -1, 3, n) for a in (21, 21 + 3 * n))
    count = len(graph.bodies)
    own = [*range(count), len(points) - 1]
    home = np.array([*(b.inertia for b in graph.bodies.values()), load.inertia])
    matrix = turned[..., own, :, :] @ home @ turned[..., own, :, :].swapaxes(-1, -2)
    w, al = omega[..., own, :], alpha[..., own, :]
    moment = np.einsum("...ij,...j->...i", matrix, al)
    moment = moment + np.cross(w, np.einsum("...ij,...j->...i", matrix, w))

    a, b = slice(count, -1, 2), slice(count + 1, -1, 2)
    bar = place[..., b, :] - place[..., a, :]
    rod_mass = np.array([r.mass for r in rods])
    third = rod_mass[:, None] / 12
    # Of thin bars: angular momentum m / 12 l x dl/dt, and no spin.
    square = np.sum(bar * bar, -1, keepdims=True)
    rod_moment = third * np.cross(bar, change[..., b, :] - change[..., a, :])
    swing = np.cross(bar[..., None], linear[..., b, :, :] - linear[..., a, :, :], axis=-2)
    thin = square[..., None] * np.eye(3) - bar[..., :, None] * bar[..., None, :]

    axis = len(batch)

    def taken(values: Array, which: Any) -> Array:
        return values[(slice(None),) * axis + (which,)]

    def joined(of_bodies: Array, of_rods: Array) -> Array:
        parts = [taken(of_bodies, slice(count)), of_rods, taken(of_bodies, slice(count, None))]
        return np.concatenate(parts, axis)

    def middle(values: Array) -> Array:
        return joined(taken(values, own), (taken(values, a) + taken(values, b)) / 2)

    return Bodies(
        robot.body_names,
        np.array([*(x.mass for x in graph.bodies.values()), *rod_mass, load.mass]),
        middle(place),
        middle(change),
        joined(moment, rod_moment),
        middle(linear),
        joined(angular[..., own, :, :], swing / square[..., None]),
        joined(matrix, third[..., None] * thin),
    )


@dataclass(frozen=True)
class Rub:
    """Friction of a passive joint in motion.

    ``axis`` and ``point`` of the joint, shape (..., 3); ``rate`` of the joint per actuated joint's,
    (..., n); ``effort`` that moves it along the axis, from its inner to its outer body, (...).
    """

    joint: Joint
    axis: Array
    point: Array
    rate: Array
    effort: Array

    @property
    def efforts(self) -> Array:
        """What the actuators spend on it, shape (..., n)."""
        return self.rate * self.effort[..., None]

    @property
    def turns(self) -> bool:
        """Whether it turns; else it slides."""
        return self.joint.kind == "revolute"


def rubs(robot: Robot, moved: Bodies, q: Array, qd: Array) -> list[Rub]:
    """Friction of all passive joints, of the bodies' motion and of where the axes are."""
    rotations, origins = robot.placements(q)
    at = robot.engine.tree.at
    result = []
    for joint in robot.graph.joints.values():
        if joint.actuated or not (joint.viscous or joint.coulomb or joint.rotor_inertia):
            continue
        assert joint.kind in ("revolute", "prismatic") and not joint.rotor_inertia, joint.name
        home = joint.axes[0]
        axis = home if joint.inner == BASE else rotations[joint.inner] @ home
        outer = joint.outer
        point = origins[outer] + rotations[outer] @ (joint.at - at[outer])
        apart = np.zeros((*q.shape[:-1], 3, q.shape[-1]))
        for body, side in ((joint.inner, -1.0), (outer, 1.0)):
            if body == BASE:
                continue
            k = moved.names.index(body)
            turn = moved.angular[..., k, :, :]
            if joint.kind == "revolute":
                apart += side * turn
                continue
            arm = (point - moved.com[..., k, :])[..., None]
            apart += side * (moved.linear[..., k, :, :] + np.cross(turn, arm, axis=-2))
        rate = np.einsum("...i,...ij->...j", np.broadcast_to(axis, point.shape), apart)
        speed = np.sum(rate * qd, -1)
        effort = joint.viscous * speed + joint.coulomb * np.sign(speed)
        result.append(Rub(joint, np.broadcast_to(axis, point.shape), point, rate, effort))
    return result


@lru_cache(maxsize=8)
def _code(engine: Engine, points: tuple[tuple[str, tuple[float, ...]], ...]) -> PlainKernel:
    """The plain back end: nothing to compile, and the back end that the laws do not use else."""
    program = _program(Traced(engine), [(body, np.array(p)) for body, p in points])
    return PlainKernel(program, engine.geometry)


def _program(t: Traced, points: list[tuple[str, Array]]) -> Program:
    t.solve()
    n = t.joints
    qd, qdd = t.tape.inputs("qd", n), t.tape.inputs("qdd", n)
    t.set_rates(qd)
    t.set_accelerations(qdd)
    motion = t.motion
    rates = t.rate_columns()
    rows: list[Any] = []
    for body, point in points:
        at = motion.point(body, point)
        rows += [*at, *motion.acceleration(body, point), *np.ravel(motion.rotation_from_home(body))]
        rows += [*motion.omega[body], *motion.alpha[body]]
        for columns in (motion.linear_jacobian(body, at), motion.angular_jacobian(body)):
            table: Any = np.zeros((3, n), dtype=object)
            for (kind, k), column in columns.items():
                for j in range(n):
                    part = rates[j][k] if kind == "u" else float(k == j)
                    table[:, j] = table[:, j] + np.asarray(column, dtype=object) * part
            rows += list(table.ravel())
    return Program({"q": n, "qd": n, "qdd": n}, 0, {"rows": t.lift(rows)}, t.equations())
