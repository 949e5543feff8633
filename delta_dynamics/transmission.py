# SPDX-License-Identifier: Apache-2.0
"""What each joint can transmit: unit forces and couples, on the bodies that it joins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.kinematics.motion import reaction_directions
from pkm_twin.machine.graph import BASE, Graph, Joint, Rod


@dataclass(frozen=True)
class Transmitter:
    """One joint in every sample: what its inner body can transmit to the outer one.

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


def transmitters(graph: Graph, rods: Array, places: Array) -> list[Transmitter]:
    """All joints that transmit something, those of the graph first, then the rods' ends."""
    result = []
    for k, joint in enumerate(graph.joints.values()):
        if not joint.given:
            here = places[..., 15 * k : 15 * k + 15]
            result.append(_graph_joint(joint, here.reshape(*here.shape[:-1], 5, 3)))
    for k, rod in enumerate(graph.rods.values()):
        here = rods[..., 15 * k : 15 * k + 15]
        result += _rod_joints(rod, here.reshape(*here.shape[:-1], 5, 3))
    return result


def _graph_joint(joint: Joint, vectors: Array) -> Transmitter:
    """Directions across its slides hold forces, those across its turns hold moments.

    A screw's force along its axis comes with the moment that its thread makes of it.
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
        # The directions of two axes stand in their plane, whose normal is held.
        if not pair and not any(f.turns for f in own):
            moments[direction.name] = vector
        if joint.actuated and own:
            table, what = (moments, "moment") if own[0].turns else (forces, "force")
            table[direction.name] = vector * np.sign(own[0].axis @ direction.vector)
            effort = f"{name}: {what} along {direction.name}"
    if pair:
        normal = vectors[..., 4, :]
        moments[joint.normal] = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    return _joint(
        name, (joint.inner, joint.outer), vectors[..., 0, :], forces, moments, effort,
        threads=threads,
    )  # fmt: skip


def _rod_joints(rod: Rod, vectors: Array) -> list[Transmitter]:
    """Ball joints at both ends.

    A parallelogram's two equal thin rods, side by side along t: their end forces add up to one
    force at each end; the difference of the two axial forces is a couple along e = t x w that
    passes from the inner to the outer body, the same at both ends, whatever the distance of the
    rods. The rods' spin about themselves is idle.
    """
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
    return [
        _joint(inner, (rod.inner, rod.name), start, forces, {}, None, couple),
        _joint(outer, (rod.name, rod.outer), end, forces, {}, None, couple),
    ]


def _joint(
    name: str,
    bodies: tuple[str, str],
    point: Array,
    forces: Mapping[str, Array],
    moments: Mapping[str, Array],
    effort: str | None,
    passed: Mapping[str, Array] | None = None,
    threads: Mapping[str, Array] | None = None,
) -> Transmitter:
    """A joint from unit directions, shape (..., 3).

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


def needs(
    graph: Graph, names: Sequence[str], bodies: Array, rods: Array
) -> tuple[dict[str, Array], dict[str, Array]]:
    """A point of each body and rod, and the wrench about it that joints have to apply."""
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


def _columns(joint: Transmitter, names: tuple[str, ...], batch: tuple[int, ...]) -> Array:
    """The joint's wrench basis over all unknowns, shape (..., 6, unknowns)."""
    result = np.zeros((*batch, 6, len(names)))
    result[..., [names.index(name) for name in joint.components]] = joint.basis
    return result


def moments(joints: Sequence[Transmitter], names: tuple[str, ...]) -> Mask:
    """Which unknowns are moments, shape (unknowns,)."""
    result = np.zeros(len(names), bool)
    for joint in joints:
        pure = np.logical_not(np.any(joint.basis[..., :3, :], -2))
        for k, name in enumerate(joint.components):
            result[names.index(name)] = bool(np.all(pure[..., k]))
    return result


def transmission(
    joints: Sequence[Transmitter],
    names: tuple[str, ...],
    origin: dict[str, Array],
    batch: tuple[int, ...],
) -> Array:
    """Wrench on each body about its own point per unknown, shape (..., 6 bodies, unknowns)."""
    result = np.zeros((*batch, len(origin), 6, len(names)))
    order = list(origin)
    for joint in joints:
        columns = _columns(joint, names, batch)
        for body, sign in ((joint.inner, -1.0), (joint.outer, 1.0)):
            if body == BASE:
                continue
            lever = joint.point - origin[body]
            shifted = np.cross(lever[..., None, :], columns[..., :3, :].swapaxes(-1, -2))
            on_body = result[..., order.index(body), :, :]
            on_body += sign * columns
            on_body[..., 3:, :] += sign * shifted.swapaxes(-1, -2)
    return result.reshape(*batch, 6 * len(origin), len(names))
