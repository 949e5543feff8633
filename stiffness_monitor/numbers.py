# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The numbers of a robot's elasticity in a row, and the same structure on expressions of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.codegen.expressions import SNAP, Numbers, references, snapped
from pkm_twin.codegen.operations import maximum, sign
from pkm_twin.machine.geometry import marks
from pkm_twin.machine.graph import Graph
from pkm_twin.machine.members import Place, Structure
from pkm_twin.machine.tree import Tree

Rigidities = Mapping[str, Sequence[Any]]
"""EA, GJ, EI, and 12 E I over the shear rigidity, by beam."""


def list_numbers(structure: Structure) -> list[Any]:
    """List ends and rigidities of every beam, then all joint compliances."""
    row: list[Any] = []
    for beam in structure.beams:
        row += [*beam.inner[1], *beam.outer[1], *structure.sections[beam.name].rigidities]
    for values in structure.compliances.values():
        row += values
    return row


def substitute_numbers(structure: Structure, graph: Graph, numbers: Numbers) -> tuple[Structure, Rigidities]:
    """Return beams and compliances with other numbers, in the order of :func:`list_numbers`.

    The programs assume that the same beams end at joints, and that the same compliances are zero,
    finite or infinite.
    """
    remaining = iter(numbers)
    points = list(_end_points(graph))

    def read_end(place: Place) -> Place:
        values = np.empty(3, dtype=object)
        values[:] = [next(remaining) for _ in range(3)]
        k = _find_point(points, values)
        # With a free tape each end is a separate input, so that derivatives by it exist.
        if k is not None and not values[0].tape.free:
            for known, value in zip(points[k], values, strict=True):
                snapped(value - known)
            values = points[k]
        return place[0], values

    beams, rigidities = [], {}
    for beam in structure.beams:
        beams.append(replace(beam, inner=read_end(beam.inner), outer=read_end(beam.outer)))
        rigidities[beam.name] = [next(remaining) for _ in range(4)]
    compliances = {name: [next(remaining) for _ in values] for name, values in structure.compliances.items()}
    for value in (v for values in compliances.values() for v in values):
        finite = _is_elastic(value)
        value.tape.assumed.append((finite, finite.value))
    return replace(structure, beams=tuple(beams), compliances=compliances), rigidities


def constant_pattern(structure: Structure, tree: Tree) -> str:
    """Return a text of the structure's properties that programs take as constant."""
    places, parts = list(_end_points(tree.graph)), []
    for beam in structure.beams:
        for body, at in (beam.inner, beam.outer):
            local = marks(tree.axes[body].T @ (at - tree.at[body]))
            parts.append((beam.name, beam.element, beam.parts, body, _find_point(places, at), local))
    flags = {n: [float(_is_elastic(v)) for v in row] for n, row in structure.compliances.items()}
    return repr((parts, flags, structure.order))


def _end_points(graph: Graph) -> Iterator[Array]:
    """Yield the points of a graph at which beams may end."""
    yield graph.origin
    yield from (joint.at for joint in graph.joints.values())
    for rod in graph.rods.values():
        yield from rod.ends


def _find_point(points: Sequence[Array], at: Any) -> int | None:
    """Return the index of the point that coincides with a position; None without one."""
    here = references(at)
    coinciding = (k for k, one in enumerate(points) if np.abs(references(one) - here).max() < SNAP)
    return next(coinciding, None)


def _is_elastic(compliance: Any) -> Any:
    """Return an expression: 1 for a compliance above 0 (rigid) and below 1e300 (free), else 0."""
    return sign(compliance) * sign(maximum(0.0, 1e300 - compliance))
