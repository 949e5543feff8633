# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What measured poses do not determine of a machine's geometry, in a few plain sentences.

The directions that a fit leaves as they were span a space. Changes that mean something to whoever
builds the machine (a limb moved as a whole, a joint moved along its own axis) are looked for in it,
the particular ones before the general ones; what they leave is named by its greatest numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.identification.parameters import OBSERVED_RATIO
from pkm_twin.machine.graph import Graph, list_limbs
from pkm_twin.machine.places import split_path

MAX_SENTENCES: Final = 10
"""Largest number of sentences about undetermined numbers."""
MAX_LISTED_NAMES: Final = 6
"""Number of names that a message lists; further names are only counted."""
AXES: Final = "xyz"


class Pair(NamedTuple):
    """Places of two numbers of which a fit determines the sum (``sign`` 1) or the difference (-1).

    ``deviation``: standard deviation of this sum or difference.
    """

    first: int
    second: int
    sign: int
    deviation: float


def find_determined_pairs(
    unobserved: Sequence[int], units: Sequence[str], covariance: Array, scale: Array | None
) -> list[Pair]:
    """Find sums and differences of numbers that are determined though the numbers are not.

    The best known first; of numbers that hang together in pairs each new pair brings in another.

    :param unobserved: places of the numbers. ``covariance``: of all numbers, (p, p).
    :param scale: derivatives of a scale that is not determined, (p,): no pair may depend on it.
    """
    possible = []
    for number, first in enumerate(unobserved):
        for second in unobserved[number + 1 :]:
            for sign in (-1, 1) if units[first] == units[second] else ():
                row = np.zeros(len(units))
                row[[first, second]] = 1.0, sign
                variance = float(row @ covariance @ row)
                share = variance / float(covariance[first, first] + covariance[second, second])
                if scale is not None:
                    by_scale = float(row @ covariance @ scale) ** 2
                    if by_scale > OBSERVED_RATIO * variance * float(scale @ covariance @ scale):
                        continue
                if share < OBSERVED_RATIO**2:
                    possible.append((share, Pair(first, second, sign, max(variance, 0.0) ** 0.5)))
    group = {place: {place} for place in unobserved}
    found = []
    for _, pair in sorted(possible):
        if group[pair.first] is not group[pair.second]:
            found.append(pair)
            group[pair.first] |= group[pair.second]
            group |= dict.fromkeys(group[pair.second], group[pair.first])
    return found


class Change(NamedTuple):
    """A change of the numbers, (p,): what it is called, what it happens to, along which axis."""

    kind: str
    item: str
    vector: Array
    axis: str = ""


@dataclass(frozen=True, eq=False)
class _Numbers:
    """Indices of the numbers that are a point, an axis or the origin."""

    graph: Graph
    names: Sequence[str]
    scales: Array
    points: dict[tuple[str, int], NDArray[np.int64]]
    """Of a joint or rod (and its end): places of the point's three numbers, -1 where none."""
    axes: dict[tuple[str, int], NDArray[np.int64]]
    origin: NDArray[np.int64]

    @classmethod
    def from_names(cls, graph: Graph, names: Sequence[str], scales: Array) -> _Numbers:
        points: dict[tuple[str, int], NDArray[np.int64]] = {}
        axes: dict[tuple[str, int], NDArray[np.int64]] = {}
        origin = np.full(3, -1)
        for place, name in enumerate(names):
            keys = split_path(name)
            if not isinstance(keys[-1], int) or not 0 <= keys[-1] < 3:
                continue
            words, last = [str(k) for k in keys if isinstance(k, str)], keys[-1]
            number = keys[-2] if isinstance(keys[-2], int) else 0
            if words == ["origin"]:
                origin[last] = place
            elif len(words) != 3 or words[1] not in {**graph.joints, **graph.rods}:
                continue
            elif words[2] in ("at", "ends"):
                points.setdefault((words[1], int(number)), np.full(3, -1))[last] = place
            elif words[2] in ("axis", "axes"):
                axes.setdefault((words[1], int(number)), np.full(3, -1))[last] = place
        return cls(graph, names, scales, points, axes, origin)

    def vector(self, moves: Sequence[tuple[NDArray[np.int64], Array]]) -> Array:
        """Return changes (3,) of numbers over their scales; zero where one is missing."""
        found = np.zeros(len(self.names))
        for places, change in moves:
            for place, value in zip(places.tolist(), change.tolist(), strict=True):
                if place >= 0:
                    found[place] = value / self.scales[place]
        return found

    def bodies(self, point: tuple[str, int]) -> tuple[str, ...]:
        """List the bodies a point belongs to: both of a joint's, one of a rod's end."""
        name, end = point
        if name in self.graph.joints:
            joint = self.graph.joints[name]
            return joint.inner, joint.outer
        rod = self.graph.rods[name]
        return (rod.inner, rod.outer)[end], name

    def point(self, point: tuple[str, int]) -> Array:
        """Return a point's position at home, (3,)."""
        name, end = point
        joints, rods = self.graph.joints, self.graph.rods
        return joints[name].at if name in joints else np.asarray(rods[name].ends[end], np.float64)

    def list_points(self, *bodies: str) -> list[tuple[str, int]]:
        """List the points on bodies."""
        return [point for point in self.points if set(self.bodies(point)) & set(bodies)]


def _list_changes(n: _Numbers) -> Iterator[Change]:
    """Yield the changes that are searched for, the particular ones first."""
    eye = np.eye(len(n.names))
    for k, name in enumerate(n.names):
        yield Change("{items} alone", name, eye[k])
    for (name, number), places in n.axes.items():
        joint = n.graph.joints.get(name)
        if joint is not None and number < len(joint.axes):
            longer = n.vector([(places, joint.axes[number])])
            yield Change("the length of the axes of {items}: only directions matter", name, longer)
            point = n.points.get((name, 0))
            if point is not None:
                along = n.vector([(point, joint.axes[number])])
                yield Change("{items} moved along their own axes", name, along)
    for limb in list_limbs(n.graph):
        # What hangs together without base and platform.
        points = n.list_points(*limb)
        label = " with ".join(dict.fromkeys(name for name, _ in points))
        for k, axis in enumerate(AXES if points else ""):
            moved = n.vector([(n.points[point], np.eye(3)[k]) for point in points])
            yield Change("limbs moved as a whole along {axes}: {items}", label, moved, axis)
    base, platform = n.list_points("base"), n.list_points(n.graph.platform)
    of_base, of_platform = "the base's joints", "the platform's joints"
    reference = "the reference point"
    groups = [
        ([*platform], True, f"{of_platform} and {reference}"),
        ([*platform], False, of_platform),
        ([*base], False, of_base),
        ([*platform, *base], False, f"{of_platform} and {of_base}"),
        ([*n.points], False, "all joints"),
        ([*n.points], True, f"all joints and {reference}"),
    ]
    for points, with_origin, label in groups:
        own = [n.points[point] for point in dict.fromkeys(points)]
        at = [n.point(point) for point in dict.fromkeys(points)]
        if with_origin:
            own, at = [*own, n.origin], [*at, n.graph.origin]
        directions = [
            (one, n.graph.joints[name].axes[number])
            for (name, number), one in n.axes.items()
            if (name, 0) in points and number < len(n.graph.joints[name].axes)
        ]
        for k, axis in enumerate(AXES):
            moved = n.vector([(one, np.eye(3)[k]) for one in own])
            yield Change("{items} moved together along {axes}", label, moved, axis)
        for k, axis in enumerate(AXES):
            about = np.eye(3)[k]
            turns = [(one, np.cross(about, p)) for one, p in zip(own, at, strict=True)]
            turns += [(one, np.cross(about, d)) for one, d in directions]
            yield Change("{items} turned together about {axes}", label, n.vector(turns), axis)
    lengths = [(n.points[point], n.point(point)) for point in n.points]
    whole = n.vector([*lengths, (n.origin, n.graph.origin)])
    yield Change("{items} in proportion", "all lengths", whole)


def undetermined(graph: Graph, names: Sequence[str], scales: Array, directions: Array) -> list[str]:
    """Describe the undetermined combinations in at most ten sentences.

    :param names: of the numbers, as paths. ``scales``: their prior deviations, (p,).
    :param directions: in units of these, orthonormal, (p, u).
    """
    n = _Numbers.from_names(graph, names, scales)
    left = directions
    found: dict[tuple[str, str], list[str]] = {}
    for change in _list_changes(n):
        size = float(np.linalg.norm(change.vector))
        unit = change.vector / max(size, 1e-300)
        inner = left.T @ unit
        if np.sum((directions.T @ unit) ** 2) < 0.8 or inner @ inner < 0.1:
            continue
        found.setdefault((change.kind, change.axis), []).append(change.item)
        # Keep the part of the remaining space that is orthogonal to the change.
        left = left @ np.linalg.svd(inner[None])[2][1:].T
    # Those that differ by the axis alone are one sentence.
    merged: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for (kind, axis), items in found.items():
        merged.setdefault((kind, tuple(dict.fromkeys(items))), []).append(axis)
    told = [
        kind.format(items=_write_list(names_of), axes=_join_words(sorted(set(axes))))
        for (kind, names_of), axes in merged.items()
    ]
    # Combinations that no named change explains.
    count, mostly = left.shape[1], _write_list(_find_greatest(names, np.sqrt(np.sum(left**2, 1))))
    each = [_find_greatest(names, np.abs(vector)) for vector in left.T]
    rest = [f"{_join_words(sorted(shown, key=names.index))} changed together" for shown in each]
    if any(len(shown) > 4 for shown in each):
        rest = [f"{count} further combination{'s' * (count > 1)}, mostly of {mostly}"]
    if len(told) + len(rest) > MAX_SENTENCES:
        more = count + sum(len(found[k]) for k in list(found)[MAX_SENTENCES - 1 :])
        return [*told[: MAX_SENTENCES - 1], f"{more} further combinations, mostly of {mostly}"]
    return [*told, *rest]


def _find_greatest(names: Sequence[str], weights: Array) -> list[str]:
    order = np.argsort(-weights, kind="stable")
    return [names[k] for k in order if weights[k] > 0.1 * weights.max()]


def _write_list(items: Sequence[str]) -> str:
    """Join names with commas; of many only the first."""
    if len(items) <= MAX_LISTED_NAMES:
        return ", ".join(items)
    return f"{', '.join(items[:MAX_LISTED_NAMES])} and {len(items) - MAX_LISTED_NAMES} more"


def _join_words(items: Sequence[str]) -> str:
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}"
