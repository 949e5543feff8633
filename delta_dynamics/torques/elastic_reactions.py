# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Joint reactions of overconstrained machines: elasticity determines what statics does not.

Of all reactions that balance the bodies the true ones have the least complementary energy of
members and elastic joints (Menabrea), actuators locked. Along a member the section's load is taken
between those of its ends, which is exact where its own inertia does not bend it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from delta_dynamics.torques.reactions import Balance, Reactions, balance, hide_indeterminate
from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.motion import reaction_directions
from pkm_twin.machine.members import Beam, Section
from pkm_twin.robot.outline import Posture
from pkm_twin.robot.robot import Robot


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
        matrices = energy_forms(robot, q, found).values()
    except ParameterError:
        # Without elastic members no energy selects a solution.
        return hide_indeterminate(found.reactions(found.value, found.null))
    energy = np.asarray(sum(matrices, start=np.zeros_like(found.null)), np.float64)
    null_forces = found.null * found.unit[..., None]
    stiff = null_forces.swapaxes(-1, -2) @ energy @ null_forces
    values, modes = np.linalg.eigh(stiff)
    # Energies below 1e-9 of the largest are rounding: such a self-stress is not determined.
    sound = values > 1e-9 * np.maximum(values[..., -1:], 1e-300)
    inverse = np.where(sound, 1.0 / np.where(sound, values, 1.0), 0.0)
    gradient = null_forces.swapaxes(-1, -2) @ (energy @ found.value[..., None])
    amounts = -modes @ (inverse[..., None] * (modes.swapaxes(-1, -2) @ gradient))
    null = found.null @ (modes * ~sound[..., None, :])
    return hide_indeterminate(found.reactions(found.value + (null_forces @ amounts)[..., 0], null))


def energy_forms(robot: Robot, q: ArrayLike, found: Balance) -> dict[str, Array]:
    """Return twice the complementary energy by element, forms (..., unknowns, unknowns), J.

    :raises ParameterError: a robot without elastic members.
    """
    structure, batch = robot.elastic, found.value.shape[:-1]
    posture = Posture(robot, np.broadcast_to(np.asarray(q, np.float64), (*batch, robot.joints_count)))
    result: dict[str, Array] = {}
    for beam in structure.beams:
        if beam.parts[0] in robot.graph.rods or beam.parts[0] == robot.graph.platform:
            continue
        ends = [posture.locate_point(*place) for place in (beam.inner, beam.outer)]
        matrix = _beam_energy(robot, beam, structure.sections[beam.name], ends, found)
        result[beam.element] = result.get(beam.element, 0.0) + matrix
    for k, joint in enumerate(found.joints):
        known = [j for j in robot.graph.joints.values() if (j.label or j.name) == joint.name]
        values = structure.compliances.get(joint.name)
        if values is None or not known:
            continue
        # Compliances along the joint's axes as in a structural model, 0 where rigid or free.
        weights = np.array([float(v) if 0.0 < float(v) < math.inf else 0.0 for v in values])
        own, directions = known[0], reaction_directions(known[0])
        axes = [(d.body, d.vector) for d in directions]
        if len(own.axes) == 2:
            axes = [(own.inner, own.axes[0]), (own.outer, own.axes[1])]
            normal = np.cross(*own.axes)
            normal /= np.linalg.norm(normal)
            columns = np.stack([own.axes[0], np.cross(normal, own.axes[0]), normal], -1)
            order = np.abs(np.array([d.vector for d in directions]) @ columns).argmax(0)
            weights = np.concatenate([weights[order], weights[3 + order]])
            weights[3:5] = 0.0
        world = np.stack([posture.rotate_vector(*one) for one in axes], -1)
        if len(axes) == 2:
            normal = np.cross(world[..., 0], world[..., 1])
            normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
            world = np.stack([world[..., 0], np.cross(normal, world[..., 0]), normal], -1)
        halves = found.spread[..., k, :3, :], found.spread[..., k, 3:, :]
        amounts = np.concatenate([world.swapaxes(-1, -2) @ half for half in halves], -2)
        matrix = amounts.swapaxes(-1, -2) @ (weights[:, None] * amounts)
        result[joint.name] = result.get(joint.name, 0.0) + matrix
    return result


def _beam_energy(robot: Robot, beam: Beam, section: Section, ends: list[Array], found: Balance) -> Array:
    """Return twice a member's energy, (..., unknowns, unknowns)."""
    along = ends[1] - ends[0]
    length = np.linalg.norm(along, axis=-1)[..., None, None]
    first = along / length[..., 0]
    # Any two axes across the bar will do, because its section is round.
    seed = np.eye(3)[np.abs(first).argmin(-1)]
    second = np.cross(first, seed)
    second /= np.linalg.norm(second, axis=-1, keepdims=True)
    axes = np.stack([first, second, np.cross(first, second)], -1).swapaxes(-1, -2)
    stretch, twist, bend, across = section.rigidities
    shear = across / (12.0 * bend)
    weights = np.array([1 / stretch, shear, shear, 1 / twist, 1 / bend, 1 / bend])[:, None]
    # Joints that load the member: index, sign of the wrench on it, and whether at its outer end.
    at_home = {joint.label or joint.name: joint.at for joint in robot.graph.joints.values()}
    sides = []
    for k, joint in enumerate(found.joints):
        inside = [body in beam.parts for body in (joint.inner, joint.outer)]
        if inside[0] != inside[1]:
            place = at_home.get(joint.name, found.points[..., k, :].reshape(-1, 3)[0])
            apart = [float(np.linalg.norm(place - end)) for _, end in (beam.inner, beam.outer)]
            sides.append((k, 1.0 if inside[1] else -1.0, apart[1] < apart[0]))
    total = np.zeros_like(found.null)
    # Three points integrate the energy of a section's linear load exactly.
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
