# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Joint reactions of overconstrained machines: what statics leaves open, elasticity decides.

Of all reactions that balance the bodies the true ones have the least complementary energy of
members and elastic joints (Menabrea), actuators locked. Along a member the section's load is taken
between those of its ends, which is exact where its own inertia does not bend it.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from delta_dynamics.torques.reactions import Balance, Reactions, balance, known_alone
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.motion import reaction_directions
from pkm_twin.machine.graph import Joint
from pkm_twin.machine.members import Beam, Section
from pkm_twin.robot.outline import Posture
from pkm_twin.robot.robot import Robot

SOFT: Final = 1e-9
"""Part of the largest energy of a self-stress below which another stores none."""


def elastic_reactions(
    robot: Robot, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, wrench: ArrayLike | None = None
) -> Reactions:
    """Compute :func:`~delta_dynamics.reactions`, with elasticity for indeterminate components.

    Components that store no energy in members or joints stay NaN; in a robot without elastic
    members these are all indeterminate ones. Rods that stand for a pair are not resolved.
    """
    found = balance(robot, q, qd, qdd, wrench)
    if not found.null.any():
        return found.reactions(found.value, found.null)
    try:
        energy = _energy(robot, np.asarray(q, np.float64), found)
    except ParameterError:
        # No members: nothing decides.
        return known_alone(found.reactions(found.value, found.null))
    own = found.null * found.unit[..., None]
    stiff = own.swapaxes(-1, -2) @ energy @ own
    values, ways = np.linalg.eigh(stiff)
    sound = values > SOFT * np.maximum(values[..., -1:], 1e-300)
    inverse = np.where(sound, 1.0 / np.where(sound, values, 1.0), 0.0)
    pull = own.swapaxes(-1, -2) @ (energy @ found.value[..., None])
    amounts = -ways @ (inverse[..., None] * (ways.swapaxes(-1, -2) @ pull))
    left = found.null @ (ways * ~sound[..., None, :])
    return known_alone(found.reactions(found.value + (own @ amounts)[..., 0], left))


def reaction_energies(robot: Robot, q: ArrayLike, found: Balance, value: Array) -> dict[str, Array]:
    """Complementary energy of each element, J, shape (...), of amounts (..., unknowns).

    :raises ParameterError: a robot without elastic members.
    """
    return {
        name: np.einsum("...k,...kl,...l->...", value, matrix, value) / 2.0
        for name, matrix in _matrices(robot, np.asarray(q, np.float64), found).items()
    }


def _energy(robot: Robot, q: Array, found: Balance) -> Array:
    parts = _matrices(robot, q, found).values()
    return np.asarray(sum(parts, start=np.zeros_like(found.null)), np.float64)


def _matrices(robot: Robot, q: Array, found: Balance) -> dict[str, Array]:
    """Twice the energy by element, a quadratic form (..., unknowns, unknowns)."""
    structure, batch = robot.elastic, found.value.shape[:-1]
    posture = Posture(robot, np.broadcast_to(q, (*batch, robot.joints_count)))
    result: dict[str, Array] = {}
    for beam in structure.beams:
        if beam.parts[0] in robot.graph.rods or beam.parts[0] == robot.graph.platform:
            continue
        ends = [posture.place(*place) for place in (beam.inner, beam.outer)]
        matrix = _of_beam(robot, beam, structure.sections[beam.name], ends, found)
        result[beam.element] = result.get(beam.element, 0.0) + matrix
    for k, joint in enumerate(found.joints):
        known = [j for j in robot.graph.joints.values() if (j.label or j.name) == joint.name]
        values = structure.compliances.get(joint.name)
        if values is None or not known:
            continue
        weights, axes = _along(known[0], [float(v) for v in values])
        world = np.stack([posture.turn(*one) for one in axes], -1)
        if len(axes) == 2:
            normal = np.cross(world[..., 0], world[..., 1])
            normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
            world = np.stack([world[..., 0], np.cross(normal, world[..., 0]), normal], -1)
        amounts = np.concatenate([world.swapaxes(-1, -2) @ found.spread[..., k, part, :] for part in (_F, _M)], -2)
        matrix = amounts.swapaxes(-1, -2) @ (weights[:, None] * amounts)
        result[joint.name] = result.get(joint.name, 0.0) + matrix
    return result


_F, _M = slice(0, 3), slice(3, 6)


def _along(joint: Joint, values: list[float]) -> tuple[Array, list[tuple[str, Array]]]:
    """Compliances (6,), 0 where rigid or free, and the axes that they are along, as structure's."""
    finite = np.array([value if 0.0 < value < math.inf else 0.0 for value in values])
    directions = reaction_directions(joint)
    if len(joint.axes) != 2:
        return finite, [(d.body, d.vector) for d in directions]
    axes = [(joint.inner, joint.axes[0]), (joint.outer, joint.axes[1])]
    normal = np.cross(joint.axes[0], joint.axes[1])
    normal /= np.linalg.norm(normal)
    columns = np.stack([joint.axes[0], np.cross(normal, joint.axes[0]), normal], -1)
    order = np.abs(np.array([d.vector for d in directions]) @ columns).argmax(0)
    weights = np.concatenate([finite[order], finite[3 + order]])
    weights[3:5] = 0.0
    return weights, axes


def _of_beam(robot: Robot, beam: Beam, section: Section, ends: list[Array], found: Balance) -> Array:
    """Twice a member's energy, (..., unknowns, unknowns)."""
    along = ends[1] - ends[0]
    length = np.linalg.norm(along, axis=-1)[..., None, None]
    first = along / length[..., 0]
    # Two axes across; a round section has no others.
    seed = np.eye(3)[np.abs(first).argmin(-1)]
    second = np.cross(first, seed)
    second /= np.linalg.norm(second, axis=-1, keepdims=True)
    axes = np.stack([first, second, np.cross(first, second)], -1).swapaxes(-1, -2)
    stretch, twist, bend, across = section.rigidities
    shear = across / (12.0 * bend)
    weights = np.array([1 / stretch, shear, shear, 1 / twist, 1 / bend, 1 / bend])[:, None]
    sides = _sides(robot, beam, found)
    total = np.zeros_like(found.null)
    # Exact for the energy of a section's load that is linear, in a part that is.
    for x, weight in zip(*np.polynomial.legendre.leggauss(3), strict=True):
        share = (x + 1.0) / 2.0
        place = ends[0] + share * along
        load = np.zeros((*found.value.shape[:-1], 6, found.value.shape[-1]))
        for k, sign, outer in sides:
            part = sign * (share if outer else share - 1.0)
            columns = found.spread[..., k, :, :]
            lever = (found.points[..., k, :] - place)[..., None, :]
            moved = np.cross(lever, columns[..., :3, :].swapaxes(-1, -2)).swapaxes(-1, -2)
            load[..., :3, :] += part * columns[..., :3, :]
            load[..., 3:, :] += part * (columns[..., 3:, :] + moved)
        own = np.concatenate([axes @ load[..., :3, :], axes @ load[..., 3:, :]], -2)
        total += weight / 2.0 * length * (own.swapaxes(-1, -2) @ (weights * own))
    return total


def _sides(robot: Robot, beam: Beam, found: Balance) -> list[tuple[int, float, bool]]:
    """Joints that load a member: index, sign of the wrench on it, and whether at its outer end."""
    at_home = {joint.label or joint.name: joint.at for joint in robot.graph.joints.values()}
    result = []
    for k, joint in enumerate(found.joints):
        inside = [body in beam.parts for body in (joint.inner, joint.outer)]
        if inside[0] == inside[1]:
            continue
        place = at_home.get(joint.name, found.points[..., k, :].reshape(-1, 3)[0])
        apart = [float(np.linalg.norm(place - end)) for _, end in (beam.inner, beam.outer)]
        result.append((k, 1.0 if inside[1] else -1.0, apart[1] < apart[0]))
    return result
