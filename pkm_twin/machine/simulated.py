# SPDX-License-Identifier: Apache-2.0
"""A tree of bodies for simulators, which have no links without mass and several joints a body.

Links between the axes of one joint are left out, so that a body has its joints in a row.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.machine.joints import TYPES
from pkm_twin.machine.urdf_write import GROUND, UrdfBody, UrdfClosure, UrdfJoint, UrdfTree

SPECK: Final = 1e-12
"""Inertia that is added about every axis, part of the body's."""
LEAST: Final = 3e-14
"""Or this, kg m2: MuJoCo takes 1e-14 for none."""
SPECK_MASS: Final = 1e-12
"""Of a body that has none, kg."""


@dataclass(frozen=True, eq=False)
class Hung:
    """A body on joints in a row from its parent outwards; without joints it is fixed to it.

    ``place``: of its frame at home, (3,) m, on its first joint's point, parallel to the base.
    """

    body: UrdfBody
    parent: str
    joints: tuple[UrdfJoint, ...]
    place: Array

    @property
    def name(self) -> str:
        """The body's."""
        return self.body.name


def hang(tree: UrdfTree) -> list[Hung]:
    """The bodies of a tree, parents first."""
    bodies = {body.name: body for body in tree.bodies}
    children: dict[str, list[UrdfJoint]] = {}
    for joint in tree.joints:
        children.setdefault(joint.parent, []).append(joint)
    held = {end for closure in tree.closures for end in (closure.parent, closure.child)}
    held |= {tree.platform}
    result = []
    rows: dict[str, tuple[UrdfJoint, ...]] = {}
    parents = {GROUND: GROUND}
    for joint in tree.joints:
        parent, body = parents[joint.parent], bodies[joint.child]
        row = (*rows.get(joint.parent, ()), joint)
        alone = len(children.get(body.name, ())) == 1 and body.name not in held
        if alone and not body.mass and not body.inertia.any():
            # Its only child has its joints too.
            parents[body.name], rows[body.name] = parent, row
            continue
        parents[body.name] = body.name
        row = tuple(one for one in row if one.type != "fixed")
        result.append(Hung(body, parent, row, row[0].point if row else joint.point))
    return result


def sound(body: UrdfBody) -> UrdfBody:
    """The body with some mass, and some inertia about every axis.

    What it adds is below the twelfth digit: a thin bar's inertia about itself is none.
    """
    inertia = body.inertia + np.eye(3) * max(SPECK * float(np.trace(body.inertia)), LEAST)
    return replace(body, mass=body.mass or SPECK_MASS, inertia=inertia)


def split(tree: UrdfTree) -> tuple[UrdfTree, list[tuple[str, str]]]:
    """The tree with its closures but balls and fixed joints as joints of the tree; what to weld.

    Such a joint leads to a part of the outer body, or of the inner one, that is welded to the rest
    of it: mass and inertia are shared out evenly, so that their sums stay.
    """
    bodies = {body.name: body for body in tree.bodies}
    kept = [c for c in tree.closures if c.type in ("spherical", "fixed")]
    cut = [(c, _shared(c, bodies)) for c in tree.closures if c not in kept]
    shares = dict.fromkeys(bodies, 1)
    for _, owner in cut:
        shares[owner] += 1
    parts = {
        name: replace(body, mass=body.mass / shares[name], inertia=body.inertia / shares[name])
        for name, body in bodies.items()
    }
    joints = list(tree.joints)
    welds = []
    for closure, owner in cut:
        part = f"{closure.name}_part"
        parts[part] = replace(parts[owner], name=part)
        row = row_of(closure, closure.parent, part)
        if owner == closure.parent:
            row = row_of(closure, closure.child, part, turned=True)
        joints += row
        for joint in row[:-1]:
            parts[joint.child] = UrdfBody(joint.child, 0.0, joint.point, np.zeros((3, 3)))
        welds.append((owner, part))
    return replace(
        tree, bodies=tuple(parts.values()), joints=tuple(joints), closures=tuple(kept)
    ), welds


def _shared(closure: UrdfClosure, bodies: dict[str, UrdfBody]) -> str:
    """The end that is split: the outer body, unless it has no mass and the other one has some."""
    ends = [end for end in (closure.child, closure.parent) if end in bodies]
    return max(ends, key=lambda end: bodies[end].mass > 0.0)


def row_of(closure: UrdfClosure, start: str, end: str, *, turned: bool = False) -> list[UrdfJoint]:
    """A closure's freedoms as single joints in a row; of a ball and of a fixed one none.

    :param turned: from the closure's outer body to its inner one.
    """
    kind = TYPES[closure.type]
    freedoms = () if kind.ball else kind.freedoms(closure.axes, 0.0)
    many = "xyz" if len(freedoms) == 3 else "12"
    names = [f"{closure.name}_{c}" for c in many] if len(freedoms) > 1 else [closure.name]
    pairs = list(zip(names, freedoms, strict=False))
    result: list[UrdfJoint] = []
    for name, freedom in pairs[::-1] if turned else pairs:
        last = len(result) == len(pairs) - 1
        axis = np.asarray(freedom.axis, np.float64)
        result.append(
            UrdfJoint(
                name,
                "revolute" if freedom.turns else "prismatic",
                result[-1].child if result else start,
                end if last else f"{name}_link",
                closure.point,
                -axis if turned else axis,
                closure.home if len(pairs) == 1 else 0.0,
                closure.drive,
            )
        )
    return result
