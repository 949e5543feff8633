# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What a machine looks like: bars and faces between points of its bodies, all given at home.

The one source of every picture: drawings, URDF visuals, the page of ``pkm-twin view``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.machine.graph import BASE, Graph, Joint
from pkm_twin.machine.members import Place
from pkm_twin.robot.robot import Robot

BAR: Final = 0.01
"""Radius of the bars that stand for bodies, per size of the machine; of rods the half."""
_FLAT: Final = 1e-6


@dataclass(frozen=True, eq=False)
class Bar:
    """A straight round bar: ``part`` is the body or rod that it is of, ``radius`` in m.

    ``element``: its name among the elements of strain energy; empty where it is none of them.
    """

    part: str
    start: Place
    end: Place
    radius: float
    element: str = ""


class Posture:
    """Where points and directions of bodies are at joint positions, shape (..., n).

    ``rotations``: of bodies since home, shape (..., 3, 3). Errors as :meth:`Robot.forward`.
    """

    def __init__(self, robot: Robot, q: ArrayLike) -> None:
        rotations, origins = robot.placements(q)
        at, batch = robot.engine.tree.at, np.shape(q)[:-1]
        self.rotations = {BASE: np.broadcast_to(np.eye(3), (*batch, 3, 3))} | rotations
        self._shifts = {BASE: np.zeros((*batch, 3))} | {
            name: origins[name] - rotations[name] @ at[name] for name in rotations
        }

    def place(self, body: str, point: Array) -> Array:
        """Return where a point of a body, given at home, (3,) m, is now, (..., 3)."""
        return np.asarray(self.rotations[body] @ point + self._shifts[body], np.float64)

    def turn(self, body: str, vector: Array) -> Array:
        """Return where a direction of a body, given at home, (3,), points now, (..., 3)."""
        return np.asarray(self.rotations[body] @ vector, np.float64)


def telescope(joint: Joint) -> bool:
    """Whether a joint slides a ram in a tube that itself moves: their lengths are not known."""
    return joint.kind == "prismatic" and joint.inner != BASE and joint.home != 0.0


def tube_start(graph: Graph, joint: Joint) -> Array:
    """Where the tube of a telescope begins at home: at its other joint, on the axis, (3,) m."""
    axis = joint.axes[0]
    for other in graph.joints.values():
        if other is not joint and joint.inner in (other.inner, other.outer):
            return np.asarray(joint.at + axis * ((other.at - joint.at) @ axis), np.float64)
    return joint.at


def body_points(graph: Graph) -> dict[str, list[Array]]:
    """Points of each body's joints and rods at home, the base's too, shape (3,) each.

    The platform's first one is its reference point.
    """
    points: dict[str, list[Array]] = {name: [] for name in (BASE, *graph.bodies)}
    points[graph.platform].append(graph.origin)
    for joint in graph.joints.values():
        if joint.kind == "translation":  # it has no place
            continue
        inner = outer = joint.at
        if telescope(joint):
            # A tube of half the length at home; the ram begins amid it and stays in it.
            foot = tube_start(graph, joint)
            inner = foot + joint.home * joint.axes[0] / 2
            outer = foot + joint.home * joint.axes[0] / 4
            points[joint.inner].append(foot)
        points[joint.inner].append(inner)
        points[joint.outer].append(outer)
    for rod in graph.rods.values():
        for name, end in zip((rod.inner, rod.outer), rod.ends, strict=True):
            points[name].append(end)
    return points


def bars(graph: Graph) -> tuple[Bar, ...]:
    """Rods, both of a pair with what holds them; a body as bars from one point to the others."""
    radius = BAR * graph.size
    result = []
    for body, found in body_points(graph).items():
        if body == BASE:
            continue
        # A body with one joint reaches from there to its centre of mass: else nothing is seen.
        if not _apart(found, radius) and graph.bodies[body].mass > 0.0:
            found = [*found[:1], graph.bodies[body].com]
        result += [Bar(body, (body, found[0]), (body, point), radius) for point in _others(found, radius)]
    for rod in graph.rods.values():
        for shift in (0.0,) if rod.pair is None else (-rod.width / 2, rod.width / 2):
            ends = rod.ends if rod.pair is None else rod.ends + shift * rod.pair
            result.append(Bar(rod.name, (rod.inner, ends[0]), (rod.outer, ends[1]), radius / 2))
    return (*result, *crosspieces(graph))


def robot_bars(robot: Robot) -> tuple[Bar, ...]:
    """Return the bars of a robot, with the members' diameters and the rails' lengths."""
    known = {part for beam in robot.beams for part in (*beam.parts, *beam.carries)}
    members = [Bar(beam.parts[0], beam.inner, beam.outer, beam.radius, beam.element) for beam in robot.beams]
    rest = [bar for bar in bars(robot.graph) if bar.part not in known]
    hidden = [bar for bar in crosspieces(robot.graph) if bar.part in known]
    return (*members, *rest, *hidden, *_rails(robot))


def face(points: Sequence[Array]) -> Array:
    """Corners of the convex plate that covers points, in their order around it, shape (k, 3).

    Empty where fewer than three are given or they stand on one line.
    """
    corners = np.array(points).reshape(-1, 3)
    if len(corners) < 3:
        return np.zeros((0, 3))
    middle = corners.mean(0)
    spans, axes = np.linalg.svd(corners - middle)[1:]
    if not spans[1] > _FLAT * spans[0]:
        return np.zeros((0, 3))
    flat = (corners - middle) @ axes[:2].T
    order = np.lexsort(flat.T)
    return corners[_half_hull(flat, order) + _half_hull(flat, order[::-1])]


def _half_hull(flat: Array, order: NDArray[np.int64]) -> list[int]:
    """One side of the hull of points in a plane, without its last point (Andrew 1979)."""
    least = _FLAT * float(np.abs(flat).max()) ** 2
    found: list[int] = []
    for k in order:
        while len(found) > 1:
            (ax, ay), (bx, by) = flat[found[-1]] - flat[found[-2]], flat[k] - flat[found[-1]]
            if ax * by - ay * bx > least:
                break
            found.pop()
        found.append(int(k))
    return found[:-1]


def base_face(graph: Graph) -> Array:
    """Corners of the plate that the base's joints stand on; slides stand on rails instead."""
    return face(list(_fixed(graph, BASE)))


def base_line(graph: Graph) -> Array:
    """Return the farthest two of the points that the base's joints stand on, (2, 3) or (0, 3).

    The ground of a planar linkage, whose base has no face.
    """
    points = np.array(list(_fixed(graph, BASE))).reshape(-1, 3)
    far = np.linalg.norm(points[:, None] - points, axis=-1)
    if not far.any():
        return np.zeros((0, 3))
    return points[list(np.unravel_index(int(far.argmax()), far.shape))]


def platform_face(graph: Graph) -> Array:
    """Corners of the platform: its joints and rods' ends, without what it slides along."""
    return face(list(_fixed(graph, graph.platform)))


_STANDING: Final = ("revolute", "universal", "spherical", "cylindrical", "fixed")


def _fixed(graph: Graph, body: str) -> Iterable[Array]:
    """Points of a body that its joints do not move along it."""
    for joint in graph.joints.values():
        if joint.kind in _STANDING and body in (joint.inner, joint.outer):
            yield joint.at
    for rod in graph.rods.values():
        for name, end in zip((rod.inner, rod.outer), rod.ends, strict=True):
            if name == body:
                yield end


def _others(points: Sequence[Array], radius: float) -> list[Array]:
    return [p for p in points[1:] if float(np.linalg.norm(p - points[0])) > radius]


def _apart(points: Sequence[Array], radius: float) -> bool:
    return bool(points) and bool(_others(points, radius))


def crosspieces(graph: Graph) -> Iterable[Bar]:
    """Of a pair of rods: from one rod's end to the other's, on the bodies that they join."""
    for rod in graph.rods.values():
        if rod.pair is None or not rod.width > 0.0:
            continue
        aside = rod.width / 2 * rod.pair
        for body, end in zip((rod.inner, rod.outer), rod.ends, strict=True):
            radius = BAR * graph.size / 2
            yield Bar(body, (body, end - aside), (body, end + aside), radius)


def _rails(robot: Robot) -> Iterable[Bar]:
    """Yield the rails of slides on the base, from limit to limit."""
    graph, limits = robot.graph, robot.limits.position
    if limits is None:
        return
    for k, name in enumerate(graph.actuated):
        joint = graph.joints[name]
        if joint.kind == "prismatic" and joint.inner == BASE and np.isfinite(limits[k]).all():
            low, high = (joint.at + (q - joint.home) * joint.axes[0] for q in limits[k])
            yield Bar(BASE, (BASE, low), (BASE, high), BAR * graph.size / 2)
