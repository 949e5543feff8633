# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Bound a workspace by the limits of slides, the lengths of bodies and the ranges of passive joints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError
from pkm_twin.machine.graph import BASE, Graph


@dataclass(frozen=True, eq=False)
class PassiveLimit:
    """The range of one passive joint, from ``low`` to ``high``, rad or m; vectors at home.

    ``kind`` "swivel": the angle between two directions that are both along ``axis`` at home, one
    fixed in each body. "rod": the angle between ``axis`` in the inner body and the line from ``at``
    on the inner body to ``far`` on the outer one. "turn": the rotation about the axis. "slide": the
    travel of the point ``at`` along it. ``home``: the joint's value at home.
    """

    joint: str
    kind: str
    inner: str
    outer: str
    at: Array
    axis: Array
    low: float
    high: float
    home: float = 0.0
    far: Array | None = None


def position_box(
    graph: Graph, limits: Array | None, passive: Sequence[PassiveLimit] = (), paths: Sequence[str] = ()
) -> Array:
    """Return bounds that the platform's reference point cannot leave, shape (3, 2), m.

    Every joint on the base is the centre of a ball whose radius is the length of the shortest chain of
    bodies from there to the reference point, with slides at their limits. The box is the intersection
    of the balls' bounding boxes.

    :param limits: of the actuated joints, shape (n, 2), or None; ``passive``: of the others.
    :param paths: of the actuated joints' limits in the file, for the error.
    :raises ParameterError: a slide without limits in every chain.
    """
    ends = {one.joint: (one.low, one.high) for one in passive if one.kind == "slide"}
    if limits is not None:
        ends |= zip(graph.actuated, limits, strict=True)
    travel: dict[str, float] = {}
    for name, joint in graph.joints.items():
        slides = [abs(freedom.slide) for freedom in joint.freedoms if freedom.slide]
        known = len(slides) == 1 and name in ends
        far = float(np.abs(np.subtract(ends[name], joint.home)).max()) if known else math.inf
        if slides:
            travel[name] = max(slides) * far
    # Nodes are points of bodies: the reference point, joints and ends of rods. A joint connects its points
    # by its travel, a rod by its length, and a body those on it by their distance.
    nodes: list[tuple[str, Array]] = [(graph.platform, graph.origin)]
    hops: list[float] = []
    for joint in graph.joints.values():
        nodes += [(joint.inner, joint.at), (joint.outer, joint.at)]
        hops.append(travel.get(joint.name, 0.0))
    for rod in graph.rods.values():
        nodes += [(rod.inner, rod.ends[0]), (rod.outer, rod.ends[1])]
        hops.append(float(np.linalg.norm(rod.ends[1] - rod.ends[0])))
    points = np.array([point for _, point in nodes])
    lengths = np.linalg.norm(points[:, None] - points, axis=-1)
    lengths[[[a != b or a == BASE for b, _ in nodes] for a, _ in nodes]] = math.inf
    for k, length in enumerate(hops):
        lengths[2 * k + 1, 2 * k + 2] = lengths[2 * k + 2, 2 * k + 1] = length
    # Bellman and Ford: the shortest chains of up to 1, 2, 3, ... edges.
    radii = np.where(np.arange(len(nodes)) == 0, 0.0, math.inf)
    for _ in nodes:
        radii = np.minimum(radii, (radii[:, None] + lengths).min(0))
    box = np.array([[-math.inf, math.inf]] * 3)
    for (body, point), radius in zip(nodes, radii, strict=True):
        if body == BASE:
            box[:, 0] = np.maximum(box[:, 0], point - radius)
            box[:, 1] = np.minimum(box[:, 1], point + radius)
    if not np.isfinite(box).all():
        free = [graph.joints[name] for name, way in travel.items() if math.isinf(way)]
        # The travel of a screw is that of its slide.
        first = min(free, key=lambda joint: (len(joint.freedoms), joint.freedoms[0].turns))
        path = dict(zip(graph.actuated, paths, strict=False)).get(first.name, f"joints.{first.name}.limits.position")
        raise ParameterError(path, None, "limits of the slides; without them the workspace is unbounded")
    return box
