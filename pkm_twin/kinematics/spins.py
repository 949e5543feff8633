# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Parts that can turn about themselves while nothing else moves, and what holds them.

A bar between two ball joints, a pin between two hinges of one axis, small spheres that a drawing
program leaves in a closure: such a freedom moves neither the platform nor, to speak of, a mass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.kinematics.linkage import Linkage
from pkm_twin.kinematics.motion import Motion
from pkm_twin.machine.graph import BASE, Body, Graph, Joint, array, merged
from pkm_twin.machine.joints import across, unit
from pkm_twin.machine.tree import Tree

SPIN: Final = 0.05
"""A part whose centre of mass moves less than this share of the machine a radian only spins."""
RANK: Final = 1e-8
"""Part of the greatest singular value below which one counts as zero."""
_NONE: Final = 1e-6
"""Part of a spin below which a joint has none in it."""


def without_spins(graph: Graph) -> tuple[Graph, dict[str, float]]:
    """Hold every spin of a part; return the graph and the joints that hold them.

    Of each joint the greatest mass times distance of its centre from the spin's axis, kg m: where
    it is not zero, efforts depend on the angle at which the part is held.

    With the actuated joints at rest such a spin moves no platform and hardly a centre of mass. One
    of its hinges becomes fixed, or one of its ball joints a universal joint across its axis: as
    many freedoms as there are spins, so that no closure loses one that it needs.
    """
    linkage = Linkage(graph)
    motion, ju = linkage.regular_state()
    spins = null(ju, RANK)
    # What is in no loop hangs loose and is left to be found so.
    looped = _looped(linkage.tree)
    spins = spins @ null(spins[[o not in looped for o in linkage.tree.owners]], RANK, absolute=True)
    for body, point, rows, most in (
        (graph.platform, graph.origin, slice(6), RANK),
        *((body.name, body.com, slice(3), SPIN * graph.size) for body in graph.bodies.values() if body.mass > 0.0),
    ):
        spins = spins @ null(twist(motion, body, point)[rows] @ spins, most, absolute=True)
    joints, held = dict(graph.joints), dict[str, float]()
    while spins.shape[1]:
        found = _hinge(linkage, spins) or _ball(linkage, motion, spins)
        if found is None:
            break
        name, axes, spins, way = found
        joints[name] = _held(joints[name], axes)
        held[name] = max((_imbalance(motion, body, way) for body in graph.bodies.values()), default=0.0)
    return replace(graph, joints=joints), held


def _imbalance(motion: Motion, body: Body, way: Array) -> float:
    """Return mass times the distance of a body's centre from a motion's axis, kg m."""
    rates = twist(motion, body.name, body.com) @ way
    turn = float(np.linalg.norm(rates[3:]))
    return body.mass * float(np.linalg.norm(rates[:3])) / turn if turn > _NONE else 0.0


def _looped(tree: Tree) -> set[str]:
    """Return the tree's joints and free bodies in a loop, as owners of rates."""
    ways: dict[str, set[str]] = {BASE: set()}
    for link in tree.links.values():
        ways[link.body] = ways[link.parent] | {link.joint or f"free body {link.body}"}
    graph = tree.graph
    ends = [(graph.joints[name].inner, graph.joints[name].outer) for name in tree.cut]
    ends += [(rod.inner, rod.outer) for rod in graph.rods.values()]
    return set().union(*(ways[a] ^ ways[b] for a, b in ends))


def hold(graph: Graph, hinges: Sequence[str]) -> Graph:
    """Fix some hinges of a graph."""
    fixed = {name: _held(graph.joints[name], np.zeros((0, 3))) for name in hinges}
    return replace(graph, joints={**graph.joints, **fixed})


def _held(joint: Joint, axes: Array) -> Joint:
    """Return a hinge made fixed, without axes, or a ball joint made universal, on two."""
    return replace(
        joint,
        kind="universal" if len(axes) else "fixed",
        axes=array(axes),
        home=0.0,
        viscous=0.0,
        coulomb=0.0,
        rotor_inertia=0.0,
    )


def idle_bodies(graph: Graph, motion: Motion, free: Array) -> list[tuple[list[str], Array, Array]]:
    """Find bodies that can move alone, those united by fixed joints as one, and their motion.

    :param free: motions with the actuated joints at rest, shape (unknown rates, count).
    :returns: names of the bodies, the axis at home (unit vector), and the motion in ``free``.
    """
    groups: dict[str, list[str]] = {}
    for body, lead in merged(graph).items():
        groups.setdefault(lead, []).append(body)
    moved = {body: twist(motion, body, graph.bodies[body].com) @ free for body in graph.bodies}
    found = []
    for names in groups.values():
        others = [rows for body, rows in moved.items() if body not in names]
        own = [body for body in names if body in moved]
        alone = null(np.vstack(others), _NONE, absolute=True) if others else np.eye(free.shape[1])
        for way in alone.T if own else ():
            turning = moved[own[0]][3:] @ way
            if float(np.linalg.norm(turning)) > _NONE:
                turned = np.asarray(motion.turned(own[0]), float)
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


def null(matrix: Array, bound: float, absolute: bool = False) -> Array:
    """Return an orthonormal basis of the null space, shape (columns, free)."""
    if not matrix.size:
        return np.eye(matrix.shape[1])
    _, values, rows = np.linalg.svd(matrix)
    least = bound if absolute else bound * float(values.max(initial=0.0))
    rank = int(np.count_nonzero(values > max(least, 1e-300)))
    return np.asarray(rows[rank:].T, np.float64)


_Found = tuple[str, Array, Array, Array]
"""A joint, its new axes, the spins that are left, and the one that it held."""


def _hinge(linkage: Linkage, spins: Array) -> _Found | None:
    """Find the hinge that takes the largest part in a spin, to be fixed."""
    joints, owners = linkage.graph.joints, linkage.tree.owners
    parts = [
        float(np.linalg.norm(row)) if joint is not None and joint.kind == "revolute" else 0.0
        for row, joint in zip(spins, map(joints.get, owners), strict=True)
    ]
    # Rounded: of equal ones the first.
    at = int(np.argmax(np.round(parts, 6)))
    if not parts[at] > _NONE:
        return None
    left = spins @ null(spins[at][None], RANK)
    return owners[at], np.zeros((0, 3)), left, spins @ spins[at]


def _ball(linkage: Linkage, motion: Motion, spins: Array) -> _Found | None:
    """Find a ball joint of a part that spins alone, to be universal across the spin."""
    graph = linkage.graph
    for bodies, axis, way in idle_bodies(graph, motion, spins):
        for joint in graph.joints.values():
            if joint.kind == "spherical" and {joint.inner, joint.outer} & set(bodies):
                left = spins @ null(way[None], RANK)
                return joint.name, np.array(across(axis)), left, spins @ way
    return None
