# SPDX-License-Identifier: Apache-2.0
"""A machine as bars to look at: from one of a body's joints to the others, and its rods.

May import: numpy, this package.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from pkm_twin.machine.graph import Graph
from pkm_twin.machine.members import Beam, Place

BAR: Final = 0.01
"""Radius of the bars that stand for bodies, per size of the machine."""


@dataclass(frozen=True, eq=False)
class Bar:
    """A round bar of a body or a rod, between points that bodies carry, ``radius`` in m.

    ``element``: its name in the energy shares, empty where it has none.
    """

    part: str
    start: Place
    end: Place
    radius: float
    element: str = ""


def graph_bars(graph: Graph, beams: Iterable[Beam] = ()) -> list[Bar]:
    """Bars of all bodies and rods; those that are beams as their beams, with their radius."""
    beams = list(beams)
    shown = {part for beam in beams for part in beam.parts}
    bars = [Bar(beam.name, beam.inner, beam.outer, beam.radius, beam.element) for beam in beams]
    spots = _spots(graph)
    radius = BAR * graph.size
    for body, found in spots.items():
        if body in shown:
            continue
        for point in found[1:]:
            if float(np.linalg.norm(point - found[0])) > radius:
                bars.append(Bar(body, (body, found[0]), (body, point), radius))
    for rod in graph.rods.values():
        if rod.name not in shown:
            ends = (rod.inner, rod.ends[0]), (rod.outer, rod.ends[1])
            bars.append(Bar(rod.name, *ends, radius / 2.0))
    return bars


def _spots(graph: Graph) -> dict[str, list[np.ndarray]]:
    """Points of each body's joints and rods at home, the platform's reference point first."""
    spots: dict[str, list[np.ndarray]] = {body: [] for body in graph.bodies}
    spots[graph.platform].append(graph.origin)
    ends = [(body, j.at) for j in graph.joints.values() for body in (j.inner, j.outer)]
    for rod in graph.rods.values():
        ends += zip((rod.inner, rod.outer), rod.ends, strict=True)
    for body, point in ends:
        if body in spots:
            spots[body].append(point)
    return spots
