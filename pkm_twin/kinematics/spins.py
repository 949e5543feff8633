# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Find and lock passive spins: parts that can rotate while nothing else moves.

Examples: a bar between two ball joints, a pin between two collinear hinges, small spheres that a
drawing program puts into a closure. Such a freedom moves neither the platform nor much mass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.kinematics.linkage import Linkage
from pkm_twin.kinematics.motion import Motion
from pkm_twin.machine.graph import BASE, Graph, Joint, array, map_welded_bodies
from pkm_twin.machine.joints import perpendicular_axes, unit

MAX_SPIN_RADIUS: Final = 0.05
"""Largest motion of a spinning part's centre of mass per radian, relative to the machine's size."""
RELATIVE_RANK_TOLERANCE: Final = 1e-8
"""Singular values below this fraction of the largest count as zero."""
MIN_MOTION: Final = 1e-6
"""Smallest dimensionless motion of a joint or body that is not at rest."""


def lock_spins(graph: Graph) -> tuple[Graph, dict[str, float]]:
    """Lock every spin; return the graph, and the locked joints with their largest imbalance, kg m.

    With the actuated joints at rest a spin moves neither the platform nor, by more than
    MAX_SPIN_RADIUS, a centre of mass. For each spin one hinge becomes fixed, or one ball joint
    becomes a universal joint across the spin's axis, so that no other freedom is lost. The imbalance
    is mass times distance of the centre of mass from the spin's axis: if it is not zero, efforts
    depend on the angle at which the part is locked.
    """
    linkage = Linkage(graph)
    motion, ju = linkage.regular_state()
    tree, owners = linkage.tree, linkage.tree.owners
    # A body in no loop moves freely, which a later check reports: do not lock it.
    ways: dict[str, set[str]] = {BASE: set()}
    for link in tree.links.values():
        ways[link.body] = ways[link.parent] | {link.joint or f"free body {link.body}"}
    ends = [(graph.joints[name].inner, graph.joints[name].outer) for name in tree.cut]
    ends += [(rod.inner, rod.outer) for rod in graph.rods.values()]
    looped = set().union(*(ways[a] ^ ways[b] for a, b in ends))
    spins = null_space(ju, RELATIVE_RANK_TOLERANCE)
    spins = spins @ null_space(spins[[owner not in looped for owner in owners]], RELATIVE_RANK_TOLERANCE, absolute=True)
    heavy = [body for body in graph.bodies.values() if body.mass > 0.0]
    for body, point, rows, most in (
        (graph.platform, graph.origin, slice(6), RELATIVE_RANK_TOLERANCE),
        *((body.name, body.com, slice(3), MAX_SPIN_RADIUS * graph.size) for body in heavy),
    ):
        spins = spins @ null_space(twist(motion, body, point)[rows] @ spins, most, absolute=True)
    joints, held = dict(graph.joints), dict[str, float]()
    while spins.shape[1]:
        # Choose the hinge with the largest share of a spin, the first of shares equal up to rounding.
        shares = [
            float(np.linalg.norm(row)) if owner in joints and graph.joints[owner].kind == "revolute" else 0.0
            for row, owner in zip(spins, owners, strict=True)
        ]
        k = int(np.argmax(np.round(shares, 6)))
        name, axes, way, lost = owners[k], np.zeros((0, 3)), spins @ spins[k], spins[k]
        if not shares[k] > MIN_MOTION:
            balls = (
                (joint.name, np.array(perpendicular_axes(axis)), spins @ way, way)
                for bodies, axis, way in find_idle_bodies(graph, motion, spins)
                for joint in graph.joints.values()
                if joint.kind == "spherical" and {joint.inner, joint.outer} & set(bodies)
            )
            found = next(balls, None)
            if found is None:
                break
            name, axes, way, lost = found
        spins = spins @ null_space(lost[None], RELATIVE_RANK_TOLERANCE)
        joints[name] = _lock_joint(joints[name], axes)
        held[name] = 0.0
        for one in graph.bodies.values():
            rates = twist(motion, one.name, one.com) @ way
            turn = float(np.linalg.norm(rates[3:]))
            if turn > MIN_MOTION:
                held[name] = max(held[name], one.mass * float(np.linalg.norm(rates[:3])) / turn)
    return replace(graph, joints=joints), held


def lock_hinges(graph: Graph, hinges: Sequence[str]) -> Graph:
    """Return the graph with some hinges made fixed joints."""
    fixed = {name: _lock_joint(graph.joints[name], np.zeros((0, 3))) for name in hinges}
    return replace(graph, joints={**graph.joints, **fixed})


def _lock_joint(joint: Joint, axes: Array) -> Joint:
    """Return the joint as a fixed joint without axes, or as a universal joint with two axes."""
    return replace(
        joint,
        kind="universal" if len(axes) else "fixed",
        axes=array(axes),
        home=0.0,
        viscous=0.0,
        coulomb=0.0,
        rotor_inertia=0.0,
    )


def find_idle_bodies(graph: Graph, motion: Motion, free: Array) -> list[tuple[list[str], Array, Array]]:
    """Find bodies, or groups welded by fixed joints, that can rotate while all others are at rest.

    :param free: motions with the actuated joints at rest, shape (unknown rates, count).
    :returns: the bodies' names, the rotation axis at home (unit vector), and the motion as
        coefficients of the columns of ``free``.
    """
    groups: dict[str, list[str]] = {}
    for body, lead in map_welded_bodies(graph).items():
        groups.setdefault(lead, []).append(body)
    moved = {body: twist(motion, body, graph.bodies[body].com) @ free for body in graph.bodies}
    found = []
    for names in groups.values():
        others = [rows for body, rows in moved.items() if body not in names]
        own = [body for body in names if body in moved]
        alone = null_space(np.vstack(others), MIN_MOTION, absolute=True) if others else np.eye(free.shape[1])
        for way in alone.T if own else ():
            turning = moved[own[0]][3:] @ way
            if float(np.linalg.norm(turning)) > MIN_MOTION:
                turned = np.asarray(motion.rotation_from_home(own[0]), float)
                found.append((own, unit(turned.T @ turning), way))
    return found


def twist(motion: Motion, body: str, point: Array) -> Array:
    """Return the velocity of a point and the angular velocity per scaled rate, (6, rates)."""
    tree = motion.tree
    at = np.asarray(motion.point(body, point), float)
    table = np.zeros((6, tree.unknown_rates))
    for rows, columns in (
        (slice(3), motion.linear_jacobian(body, at)),
        (slice(3, 6), motion.angular_jacobian(body)),
    ):
        for (kind, k), vector in columns.items():
            if kind == "u":
                table[rows, k] = np.asarray(vector, float) / tree.scales[k]
    return table


def null_space(matrix: Array, bound: float, absolute: bool = False) -> Array:
    """Return an orthonormal basis of the null space, shape (columns, free)."""
    if not matrix.size:
        return np.eye(matrix.shape[1])
    _, values, rows = np.linalg.svd(matrix)
    least = bound if absolute else bound * float(values.max(initial=0.0))
    rank = int(np.count_nonzero(values > max(least, 1e-300)))
    return np.asarray(rows[rank:].T, np.float64)
