# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Explain why a machine's mobility is not the number of its actuated joints.

Too few degrees of freedom: the fewest axes and points are named whose change gives the machine its
freedoms in all positions (:func:`~pkm_twin.kinematics.rounding.repair_few`). Too many: the null
space of the constraint matrix tells what moves although the actuated joints are held, or which of
them cannot move.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import MobilityError, ParameterError
from pkm_twin.kinematics.linkage import Linkage
from pkm_twin.kinematics.rounding import repair_few
from pkm_twin.kinematics.spins import MIN_MOTION, find_idle_bodies, null_space
from pkm_twin.machine.graph import Graph

MAX_FLOAT_ROUNDING: Final = 1e-11
"""Largest deviation that is floating-point rounding, rad or relative to the machine's size."""
EVERYWHERE: Final = "where all loops close in every position"
MAX_CAUSES: Final = 5
"""Largest number of causes that an error names."""


class Deviation(NamedTuple):
    """A deviation of an axis or point that removes a degree of freedom.

    ``text``: a sentence. ``parts``: the joint or rod, and the joint that it is compared with.
    ``deviation``: rad or m; ``size``: rad or relative to the machine's size.
    """

    text: str
    parts: tuple[str, ...]
    deviation: float
    size: float


def mobility_error(linkage: Linkage, causes: Sequence[Deviation] = ()) -> MobilityError:
    """Return the error, with causes, for a machine that its actuated joints do not determine.

    :param causes: deviations that remove degrees of freedom; empty: search for them.
    """
    # A deviation only removes freedoms, so it cannot explain too many.
    lost = linkage.mobility.freedoms < linkage.joints
    causes = causes or (find_small_deviations(linkage.graph) if lost else [])
    texts = [c.text for c in causes[:MAX_CAUSES]]
    if len(causes) > MAX_CAUSES:
        texts.append(f"and {len(causes) - MAX_CAUSES} deviations more")
    if causes:
        return MobilityError(linkage.joints, linkage.mobility.freedoms, texts)
    graph = linkage.graph
    # List what can move while the actuated joints are locked: bodies that only spin, then the rest.
    motion, ju = linkage.regular_state()
    free = null_space(ju, MIN_MOTION)
    if free.shape[1]:
        spinning = [s for s in find_idle_bodies(graph, motion, free) if graph.platform not in s[0]]
        for bodies, _, _ in spinning:
            at = [j.name for j in graph.joints.values() if (j.inner in bodies) != (j.outer in bodies)]
            texts.append(f"{' with '.join(bodies)} can turn alone, at {' and '.join(at)}")
        ways = np.array([way for _, _, way in spinning]).reshape(-1, free.shape[1])
        if names := _owners(linkage, free @ null_space(ways, MIN_MOTION)):
            texts.append(f"with the actuated joints held, {', '.join(names)} can move")
    # List actuated joints that cannot move, or only together.
    ju, jq = linkage.scaled_at_home()
    moves = null_space(np.hstack([ju, jq]), MIN_MOTION)[ju.shape[1] :]
    rank = int(np.linalg.matrix_rank(moves, MIN_MOTION)) if moves.size else 0
    if rank < linkage.joints:
        sizes = np.linalg.norm(moves, axis=1) if moves.size else np.zeros(linkage.joints)
        still = np.array(graph.leads)[sizes < MIN_MOTION].tolist()
        tied = [name for name in graph.leads if name not in still]
        texts += [f"{', '.join(still)} cannot move"] if still else []
        texts += [f"{', '.join(tied)} have {rank} independent motions"] if len(tied) > rank else []
    return MobilityError(linkage.joints, linkage.mobility.freedoms, texts)


def singular_home_error(linkage: Linkage, rank: int, beside: int) -> ParameterError:
    """Return the error of a singular home, which names the joints that can move only there."""
    ju = linkage.regular_state()[1]
    here = null_space(linkage.scaled_at_home()[0], MIN_MOTION)
    there = null_space(ju, MIN_MOTION)
    # Motions that are free at home but not near it.
    extra = here - there @ (there.T @ here)
    names = _owners(linkage, extra) if here.shape[1] > there.shape[1] else list(linkage.graph.leads)
    return ParameterError(
        "joints",
        f"rank {rank} of the closures at home, {beside} near it",
        f"a home that is not a singularity; at this home {', '.join(names[:8])} can move without "
        "the others, so choose another pose",
    )


def find_small_deviations(graph: Graph, freedoms: int = 0) -> list[Deviation]:
    """Find the small deviations that keep a machine from having the required mobility.

    :param freedoms: required degrees of freedom; 0: one for each actuated joint.
    :returns: as few deviations as possible, the largest first; empty if none explains it.
    """
    repaired = repair_few(graph, freedoms or len(graph.leads))
    if repaired is None or not is_determined(repaired.graph, freedoms):
        return []
    found: list[Deviation] = []
    new = repaired.graph
    for name, joint in new.joints.items():
        # Compare with joints that have one axis, those on the same bodies first.
        others = [other for other in new.joints.values() if other is not joint and len(other.axes) == 1]
        others.sort(key=lambda other: not {joint.inner, joint.outer} & {other.inner, other.outer})
        for k, axis in enumerate(joint.axes):
            angle = float(np.linalg.norm(np.cross(axis, graph.joints[name].axes[k])))
            which = f"{name}'s axis" + (f" {k + 1}" if len(joint.axes) > 1 else "")
            parallel = [
                o.name for o in others if float(np.linalg.norm(np.cross(axis, o.axes[0]))) < MAX_FLOAT_ROUNDING
            ][:1]
            goal = f"parallel to {parallel[0]}'s axis" if parallel else EVERYWHERE
            found.append(Deviation(f"{which} is {angle:.2g} rad from {goal}", (name, *parallel), angle, angle))
    points = [(f"{n}", n, new.joints[n].at - j.at) for n, j in graph.joints.items()]
    points += [
        (f"the {side} of {n}", n, new.rods[n].ends[k] - rod.ends[k])
        for n, rod in graph.rods.items()
        for k, side in enumerate(("start", "end"))
    ]
    for which, name, change in points:
        gap = float(np.linalg.norm(change))
        text = f"{which} is {1e3 * gap:.3g} mm from {EVERYWHERE}"
        found.append(Deviation(text, (name,), gap, gap / graph.size))
    found = [one for one in found if one.size > MAX_FLOAT_ROUNDING]
    return sorted(found, key=lambda one: -one.size)


def is_determined(graph: Graph | None, freedoms: int = 0) -> bool:
    """Return whether at home the actuated joints determine the machine and can all move.

    :param freedoms: if given, return whether the machine has as many degrees of freedom instead.
    """
    if graph is None:
        return False
    linkage = Linkage(graph)
    if freedoms:
        return linkage.mobility.freedoms >= freedoms
    ju, _ = linkage.scaled_at_home()
    return null_space(ju, MIN_MOTION).shape[1] == 0 and linkage.mobility.freedoms == linkage.joints


def _owners(linkage: Linkage, motions: Array) -> list[str]:
    """List the joints, and bodies held by rods alone, that move in motions (unknown rates, count)."""
    parts = np.abs(motions).max(1, initial=0.0) > MIN_MOTION
    owners: Sequence[str] = linkage.tree.owners
    found = dict.fromkeys(o for o, part in zip(owners, parts, strict=True) if part)
    return [name.removeprefix("free body ") for name in found]
