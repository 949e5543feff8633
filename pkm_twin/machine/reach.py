# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Bounds of a workspace: limits of slides and lengths of bodies, ranges of passive joints."""

from __future__ import annotations

import heapq
import itertools
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
    fixed in the inner body and one in the outer. "rod": the same of the way from ``at`` on the
    inner body to ``far`` on the outer one. "turn": about the axis. "slide": of the point ``at``
    along it.
    ``home``: the joint's value at home.
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
    """Bounds that the platform's reference point cannot leave, shape (3, 2), m.

    Every joint on the base is the centre of a ball: its radius is the length of the shortest chain
    of bodies from there to the reference point, slides at their limits. The box is where all
    the balls' boxes meet.

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
    # Points of bodies: where joints and rods' ends are, and the reference point.
    hops: list[tuple[tuple[str, Array], tuple[str, Array], float]] = []
    for joint in graph.joints.values():
        slack = travel.get(joint.name, 0.0)
        hops.append(((joint.inner, joint.at), (joint.outer, joint.at), slack))
    for rod in graph.rods.values():
        length = float(np.linalg.norm(rod.ends[1] - rod.ends[0]))
        hops.append(((rod.inner, rod.ends[0]), (rod.outer, rod.ends[1]), length))
    box = np.array([[-math.inf, math.inf]] * 3)
    for inner, outer, slack in hops:
        for start, after in ((inner, outer), (outer, inner)):
            if start[0] == BASE:
                radius = _shortest(graph, hops, after, slack)
                box[:, 0] = np.maximum(box[:, 0], start[1] - radius)
                box[:, 1] = np.minimum(box[:, 1], start[1] + radius)
    if not np.isfinite(box).all():
        free = [graph.joints[name] for name, way in travel.items() if math.isinf(way)]
        # A screw goes as far as its slide.
        first = min(free, key=lambda joint: (len(joint.freedoms), joint.freedoms[0].turns))
        path = dict(zip(graph.actuated, paths, strict=False)).get(first.name, f"joints.{first.name}.limits.position")
        raise ParameterError(path, None, "limits of the slides; without them the workspace is unbounded")
    return box


def _shortest(
    graph: Graph, hops: list[tuple[tuple[str, Array], tuple[str, Array], float]], start: tuple[str, Array], begun: float
) -> float:
    """Length of the shortest chain from a point of a body to the reference point."""
    order = itertools.count()
    queue = [(begun, next(order), start)]
    done: set[tuple[str, tuple[float, ...]]] = set()
    while queue:
        length, _, (body, point) = heapq.heappop(queue)
        key = body, tuple(point.tolist())
        if key in done or math.isinf(length):
            continue
        done.add(key)
        if body == graph.platform and np.array_equal(point, graph.origin):
            return length
        if body == graph.platform:
            far = length + float(np.linalg.norm(point - graph.origin))
            heapq.heappush(queue, (far, next(order), (body, graph.origin)))
        for inner, outer, slack in hops:
            for here, there in ((inner, outer), (outer, inner)):
                if here[0] == body and body != BASE:
                    far = length + float(np.linalg.norm(here[1] - point)) + slack
                    heapq.heappush(queue, (far, next(order), there))
    return math.inf
