# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Outline a machine by bars and faces between points of its bodies, given at home.

Drawings, visuals of URDF files and the page of ``pkm-twin view`` all use these shapes.
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

BAR_RADIUS_RATIO: Final = 0.01
"""Radius of the bars that represent bodies, relative to the machine's size; rods have half of it."""
_COLLINEAR_TOLERANCE: Final = 1e-6
"""Relative size below which points are on one line."""


@dataclass(frozen=True, eq=False)
class Bar:
    """A straight round bar of the body or rod ``part``; ``radius`` in m.

    ``element``: its name among the elements of strain energy; empty if it is not elastic.
    """

    part: str
    start: Place
    end: Place
    radius: float
    element: str = ""


class Posture:
    """The positions of points and the directions of vectors of bodies at joint positions, shape (..., n).

    ``rotations``: of bodies from home, shape (..., 3, 3). Errors as :meth:`Robot.forward`.
    """

    def __init__(self, robot: Robot, q: ArrayLike) -> None:
        rotations, origins = robot.placements(q)
        at, batch = robot.engine.tree.at, np.shape(q)[:-1]
        self.rotations = {BASE: np.broadcast_to(np.eye(3), (*batch, 3, 3))} | rotations
        self._shifts = {BASE: np.zeros((*batch, 3))} | {
            name: origins[name] - rotations[name] @ at[name] for name in rotations
        }

    def locate_point(self, body: str, point: Array) -> Array:
        """Return the position of a point of a body, given at home, (3,), m; shape (..., 3)."""
        return np.asarray(self.rotations[body] @ point + self._shifts[body], np.float64)

    def rotate_vector(self, body: str, vector: Array) -> Array:
        """Return the direction of a vector of a body, given at home, (3,); shape (..., 3)."""
        return np.asarray(self.rotations[body] @ vector, np.float64)


def is_telescope(joint: Joint) -> bool:
    """Return whether a joint slides a ram in a tube that also moves: their lengths are unknown."""
    return joint.kind == "prismatic" and joint.inner != BASE and joint.home != 0.0


def tube_start(graph: Graph, joint: Joint) -> Array:
    """Return the start of a telescope's tube at home, (3,), m: at its other joint, on the axis."""
    axis = joint.axes[0]
    for other in graph.joints.values():
        if other is not joint and joint.inner in (other.inner, other.outer):
            return np.asarray(joint.at + axis * ((other.at - joint.at) @ axis), np.float64)
    return joint.at


def body_points(graph: Graph) -> dict[str, list[Array]]:
    """Return the points of each body's joints and rods at home, shape (3,) each, with the base's.

    The platform's first point is its reference point.
    """
    points: dict[str, list[Array]] = {name: [] for name in (BASE, *graph.bodies)}
    points[graph.platform].append(graph.origin)
    for joint in graph.joints.values():
        if joint.kind == "translation":  # it has no point
            continue
        inner = outer = joint.at
        if is_telescope(joint):
            # A tube of half the length at home; the ram starts in its middle.
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


def list_bars(graph: Graph) -> tuple[Bar, ...]:
    """Return rods, both of a pair with their crosspieces, and bodies as bars from one point to the others."""
    radius = BAR_RADIUS_RATIO * graph.size
    result = []
    for body, found in body_points(graph).items():
        if body == BASE:
            continue
        # A body with one joint is drawn from there to its centre of mass.
        if not _drop_coincident(found, radius) and graph.bodies[body].mass > 0.0:
            found = [*found[:1], graph.bodies[body].com]
        result += [Bar(body, (body, found[0]), (body, point), radius) for point in _drop_coincident(found, radius)]
    for rod in graph.rods.values():
        for shift in (0.0,) if rod.pair is None else (-rod.width / 2, rod.width / 2):
            ends = rod.ends if rod.pair is None else rod.ends + shift * rod.pair
            result.append(Bar(rod.name, (rod.inner, ends[0]), (rod.outer, ends[1]), radius / 2))
    return (*result, *crosspieces(graph))


def robot_bars(robot: Robot) -> tuple[Bar, ...]:
    """Return the bars of a robot, with the members' diameters, and the rails of slides on the base."""
    known = {part for beam in robot.beams for part in (*beam.parts, *beam.carries)}
    members = [Bar(beam.parts[0], beam.inner, beam.outer, beam.radius, beam.element) for beam in robot.beams]
    rest = [bar for bar in list_bars(robot.graph) if bar.part not in known]
    hidden = [bar for bar in crosspieces(robot.graph) if bar.part in known]
    graph, limits, rails = robot.graph, robot.limits.position, list[Bar]()
    for k, name in enumerate(() if limits is None else graph.actuated):
        joint = graph.joints[name]
        if limits is not None and joint.kind == "prismatic" and joint.inner == BASE and np.isfinite(limits[k]).all():
            low, high = (joint.at + (q - joint.home) * joint.axes[0] for q in limits[k])
            rails.append(Bar(BASE, (BASE, low), (BASE, high), BAR_RADIUS_RATIO * graph.size / 2))
    return (*members, *rest, *hidden, *rails)


def find_plate_corners(points: Sequence[Array]) -> Array:
    """Return the corners of the convex plate that covers points, in their order around it, shape (k, 3).

    Empty for fewer than three points, or points on one line.
    """
    corners = np.array(points).reshape(-1, 3)
    if len(corners) < 3:
        return np.zeros((0, 3))
    middle = corners.mean(0)
    spans, axes = np.linalg.svd(corners - middle)[1:]
    if not spans[1] > _COLLINEAR_TOLERANCE * spans[0]:
        return np.zeros((0, 3))
    flat = (corners - middle) @ axes[:2].T
    order = np.lexsort(flat.T)
    return corners[_half_hull(flat, order) + _half_hull(flat, order[::-1])]


def _half_hull(flat: Array, order: NDArray[np.int64]) -> list[int]:
    """Return one side of the convex hull of points in a plane, without its last point (Andrew 1979)."""
    least = _COLLINEAR_TOLERANCE * float(np.abs(flat).max()) ** 2
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
    """Return the corners of the plate under the base's joints; slides, drawn as rails, are left out."""
    return find_plate_corners(list(_iterate_fixed_points(graph, BASE)))


def base_line(graph: Graph) -> Array:
    """Return the farthest two points of the base's joints, (2, 3) or (0, 3).

    They are the ground of a planar linkage, whose base has no face.
    """
    points = np.array(list(_iterate_fixed_points(graph, BASE))).reshape(-1, 3)
    far = np.linalg.norm(points[:, None] - points, axis=-1)
    if not far.any():
        return np.zeros((0, 3))
    return points[list(np.unravel_index(int(far.argmax()), far.shape))]


def platform_face(graph: Graph) -> Array:
    """Return the corners of the platform: its joints and ends of rods, without slides."""
    return find_plate_corners(list(_iterate_fixed_points(graph, graph.platform)))


def _iterate_fixed_points(graph: Graph, body: str) -> Iterable[Array]:
    """Yield the points of a body that its joints do not move along it."""
    standing = ("revolute", "universal", "spherical", "cylindrical", "fixed")
    for joint in graph.joints.values():
        if joint.kind in standing and body in (joint.inner, joint.outer):
            yield joint.at
    for rod in graph.rods.values():
        for name, end in zip((rod.inner, rod.outer), rod.ends, strict=True):
            if name == body:
                yield end


def _drop_coincident(points: Sequence[Array], radius: float) -> list[Array]:
    return [p for p in points[1:] if float(np.linalg.norm(p - points[0])) > radius]


def crosspieces(graph: Graph) -> Iterable[Bar]:
    """Yield the bars between the ends of the two rods of each pair, on the bodies that they connect."""
    for rod in graph.rods.values():
        if rod.pair is None or not rod.width > 0.0:
            continue
        aside = rod.width / 2 * rod.pair
        for body, end in zip((rod.inner, rod.outer), rod.ends, strict=True):
            radius = BAR_RADIUS_RATIO * graph.size / 2
            yield Bar(body, (body, end - aside), (body, end + aside), radius)
