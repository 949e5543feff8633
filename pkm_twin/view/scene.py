# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The shapes of a state: cylinders, balls and plates, with positions and colours as arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]

from pkm_twin.codegen.arrays import Array
from pkm_twin.machine.graph import BASE, Joint
from pkm_twin.machine.members import Place
from pkm_twin.robot.outline import (
    BAR_RADIUS_RATIO,
    Bar,
    Posture,
    base_face,
    is_telescope,
    platform_face,
    robot_bars,
    tube_start,
)
from pkm_twin.robot.robot import Robot

Colour = tuple[int, int, int]


BODY_COLOUR: Final = (128, 136, 146)
ROD_COLOUR: Final = (86, 180, 233)
PLATFORM_COLOUR: Final = (213, 94, 0)
DRIVE_COLOUR: Final = (0, 114, 178)
GROUND_COLOUR: Final = (70, 74, 80)
JOINT_COLOUR: Final = (98, 104, 112)
"""Colours of parts, 0 to 255; rods, platform and drives are distinct for colour-blind readers (Okabe and Ito 2008)."""
ENERGY_COLOURS: Final = np.array([[198, 206, 214], [240, 228, 66], [213, 94, 0]], np.float64)
"""Colours from no share of the strain energy to the greatest: grey, yellow, vermilion (Okabe and Ito 2008)."""


def colour_by_share(shares: Mapping[str, float]) -> dict[str, Colour]:
    """Return a colour for each element by its share of the strain energy; empty without energy."""
    most = max(shares.values(), default=0.0)
    if not most > 0.0:
        return {}
    result = {}
    for name, share in shares.items():
        at = np.clip(share / most, 0.0, 1.0) * (len(ENERGY_COLOURS) - 1)
        red, green, blue = (
            round(float(np.interp(at, range(len(ENERGY_COLOURS)), channel))) for channel in ENERGY_COLOURS.T
        )
        result[name] = (red, green, blue)
    return result


@dataclass(frozen=True, eq=False)
class Shapes:
    """The places of the drawn shapes: unit cylinders along z, balls, and the platform.

    ``*_at``: (k, 3) m; ``cylinder_turns``: (k, 4) quaternions, w first; ``*_sizes``: (k, 3)
    scales in own axes; ``*_colours``: (k, 3) of 0 to 255. ``platform_at``, ``platform_turn``: of
    the plate, deflected; ``places`` of elements and ``drives``: (3,) m by name, for labels.
    """

    cylinder_at: Array
    cylinder_turns: Array
    cylinder_sizes: Array
    cylinder_colours: NDArray[np.uint8]
    ball_at: Array
    ball_sizes: Array
    ball_colours: NDArray[np.uint8]
    platform_at: Array
    platform_turn: Array
    places: dict[str, Array]
    drives: dict[str, Array]

    @property
    def ends(self) -> Array:
        """The ends of the cylinders' axes, (k, 2, 3) m."""
        turns = Rotation.from_quat(np.roll(self.cylinder_turns, -1, axis=1))
        half = turns.apply([0.0, 0.0, 0.5]) * self.cylinder_sizes[:, 2:]
        return np.stack([self.cylinder_at - half, self.cylinder_at + half], axis=1)


@dataclass(frozen=True, eq=False)
class Deflection:
    """The deflection to draw, base axes.

    ``platform``: (6,), m and rad. ``members``: for each name points along the member at rest, from
    end to end, (k, 3) m, and their displacements, (k, 3) m.
    """

    platform: Array
    members: Mapping[str, tuple[Array, Array]]

    def times(self, factor: float) -> Deflection:
        """Return the deflection enlarged by a factor."""
        members = {name: (at, factor * moved) for name, (at, moved) in self.members.items()}
        return Deflection(factor * self.platform, members)


RIGID: Final = Deflection(np.zeros(6), {})
"""No deflection."""


class Scene:
    """Compute the shapes of a robot in any state; their number is constant."""

    def __init__(self, robot: Robot) -> None:
        self.robot, graph = robot, robot.graph
        self.size = graph.size
        # A cylindrical joint slides on its pin.
        pins = [
            Bar(j.name, (j.inner, j.at), (j.outer, j.at), BAR_RADIUS_RATIO * graph.size / 2)
            for j in graph.joints.values()
            if j.kind == "cylindrical"
        ]
        self.bars = (*robot_bars(robot), *pins)
        members = np.arange(len(self.bars)) < len(robot.beams)
        self.pieces = np.where(members, 4, 1)
        """Number of straight pieces per bar: members are drawn bent."""
        self.base = base_face(graph)
        self.platform = platform_face(graph) - graph.origin
        self._thin = BAR_RADIUS_RATIO * graph.size
        self._elements = {bar.element for bar in self.bars if bar.element}
        self._joints = [j for j in graph.joints.values() if j.kind not in ("translation", "fixed")]
        self._drives = {j.name: self._make_motor(j) for j in self._joints if j.actuated}
        # Balls mark joints that rotate and the ends of rods; each has the label of its joint.
        self._balls: list[tuple[str, Place]] = [
            (j.label or j.name, (j.outer, j.at)) for j in self._joints if j.kind != "prismatic"
        ]
        for rod in graph.rods.values():
            shifts = (0.0,) if rod.pair is None else (-rod.width / 2, rod.width / 2)
            for shift in shifts:
                aside = np.zeros(3) if rod.pair is None else shift * rod.pair
                ends = zip(rod.joint_names, (rod.inner, rod.outer), rod.ends, strict=True)
                self._balls += [(name, (body, end + aside)) for name, body, end in ends]
        self._members: dict[tuple[str, bytes], str] = {}

    def _find_member(self, place: Place) -> str:
        """Return the member that ends at a point, else one that contains the point; empty if none does."""
        body, point = place
        key = body, point.tobytes()
        if key in self._members:
            return self._members[key]
        near = 1e-6 * self.size
        ends = [
            (owner == body, beam.name)
            for beam in self.robot.beams
            for owner, end in (beam.inner, beam.outer)
            if float(np.linalg.norm(end - point)) < near
        ]
        found = [name for own, name in ends if own]
        found += [beam.name for beam in self.robot.beams if body in beam.parts]
        self._members[key] = next(iter([*found, *(name for _, name in ends)]), "")
        return self._members[key]

    def _on_platform(self, place: Place) -> bool:
        """Return whether a point is on the platform or at one of its joints."""
        graph, (body, point) = self.robot.graph, place
        if body == graph.platform:
            return True
        near = 1e-6 * self.size
        return any(
            {j.inner, j.outer} == {body, graph.platform} and float(np.linalg.norm(j.at - point)) < near
            for j in self._joints
        )

    def _find_radius(self, place: Place) -> float:
        """Return the radius of the thickest bar that ends at a point, m; without one the default."""
        near = 1e-6 * self.size
        at_end = [
            bar.radius
            for bar in self.bars
            for _, point in (bar.start, bar.end)
            if float(np.linalg.norm(point - place[1])) < near and bar.part != BASE
        ]
        return max(at_end, default=self._thin)

    def shapes(self, q: Array, moved: Deflection = RIGID, shares: Mapping[str, float] | None = None) -> Shapes:
        """Return the shapes at joint positions, shape (n,).

        :param moved: the deflection as it is to be drawn, already enlarged.
        :param shares: of the strain energy by element, which colour members and joints.
        """
        posture, graph = Posture(self.robot, q), self.robot.graph
        colours = colour_by_share(shares or {})
        origin = posture.locate_point(graph.platform, graph.origin)
        shift, turn = moved.platform[:3], Rotation.from_rotvec(moved.platform[3:])

        def move_point(spot: Place) -> Array:
            point = posture.locate_point(*spot)
            if moved is RIGID:
                return point
            if self._on_platform(spot):
                return np.asarray(origin + shift + turn.apply(point - origin), np.float64)
            member = moved.members.get(self._find_member(spot))
            return point if member is None else point + _interpolate_along(*member, point[None])[0]

        def compute_bar_points(bar: Bar, pieces: int, name: str) -> Array:
            """Return points along a bar that follow the deflection of its member, (pieces + 1, 3)."""
            first, last = move_point(bar.start), move_point(bar.end)
            shares = np.linspace(0.0, 1.0, pieces + 1)[:, None]
            if (member := moved.members.get(name)) is None:
                return np.asarray(first + shares * (last - first), np.float64)
            start, end = posture.locate_point(*bar.start), posture.locate_point(*bar.end)
            displaced = _interpolate_along(*member, start + shares * (end - start))
            bow = displaced - displaced[0] - shares * (displaced[-1] - displaced[0])
            return np.asarray(first + shares * (last - first) + bow, np.float64)

        names = [beam.name for beam in self.robot.beams]
        names += [""] * (len(self.bars) - len(names))
        lines = list(map(compute_bar_points, self.bars, self.pieces, names))
        motors = [compute_bar_points(bar, 1, "") for bar in self._drives.values()]
        ends = np.concatenate([np.stack([a[:-1], a[1:]], axis=1) for a in (*lines, *motors)])
        thick = np.array([bar.radius for bar in self.bars])
        parts = dict.fromkeys(graph.rods, ROD_COLOUR) | {BASE: GROUND_COLOUR, graph.platform: PLATFORM_COLOUR}
        bar_colours = np.array([colours.get(bar.element, parts.get(bar.part, BODY_COLOUR)) for bar in self.bars])
        radii = np.array([*np.repeat(thick, self.pieces), *(bar.radius for bar in self._drives.values())])
        along = ends[:, 1] - ends[:, 0]
        length = np.linalg.norm(along, axis=1)
        z = along / np.maximum(length, 1e-12)[:, None]
        z[length < 1e-12] = (0.0, 0.0, 1.0)
        # Any x axis normal to z will do, as cylinders are round.
        least = np.eye(3)[np.argmin(np.abs(z), axis=1)]
        x = np.cross(least, z)
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        turns = Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=-1))
        at, turns, sizes = ends.mean(1), _convert_to_quaternions(turns), np.column_stack([radii, radii, length])
        balls = [move_point(spot) for _, spot in self._balls]
        ball_radii = np.array([1.25 * self._find_radius(spot) for _, spot in self._balls])
        # Balls at the ends close the gaps between bars of one body.
        tips = np.concatenate(lines)
        tip_radii = np.repeat(thick, self.pieces + 1)
        ball_colours = [colours.get(name, JOINT_COLOUR) for name, _ in self._balls]
        whole = Rotation.from_matrix(posture.rotations[graph.platform])
        labels = [graph.joints[name].label or name for name in self._drives]
        drive_colours = [colours.get(label, DRIVE_COLOUR) for label in labels]
        drives = [a.mean(0) for a in motors]
        places = (
            dict(zip(labels, drives, strict=True))
            | {bar.element: lines[k].mean(0) for k, bar in enumerate(self.bars) if bar.element}
            | {name: ball for (name, _), ball in zip(self._balls, balls, strict=True)}
        )
        return Shapes(
            at,
            turns,
            sizes,
            np.array([*np.repeat(bar_colours, self.pieces, axis=0), *drive_colours], np.uint8),
            np.concatenate([np.array(balls).reshape(-1, 3), tips]),
            np.repeat(np.concatenate([ball_radii, tip_radii])[:, None], 3, axis=1),
            np.array([*ball_colours, *np.repeat(bar_colours, self.pieces + 1, axis=0)], np.uint8),
            origin + shift,
            _convert_to_quaternions(turn * whole),
            places,
            dict(zip(self._drives, drives, strict=True)),
        )

    def frames(self, q: Array, moved: Deflection) -> dict[str, tuple[Array, Array]]:
        """Return the displacement of each body from home: position (3,), m, and quaternion (4,), w first.

        The platform's includes its deflection.
        """
        posture, graph = Posture(self.robot, q), self.robot.graph
        result = {}
        for body, rotation in posture.rotations.items():
            at, turn = posture.locate_point(body, np.zeros(3)), Rotation.from_matrix(rotation)
            if body == graph.platform:
                origin, more = posture.locate_point(body, graph.origin), moved.platform[3:]
                about = Rotation.from_rotvec(more)
                at = origin + moved.platform[:3] + about.apply(at - origin)
                turn = about * turn
            result[body] = at, _convert_to_quaternions(turn)
        return result

    def _make_motor(self, joint: Joint) -> Bar:
        """Return the cylinder that represents a drive, along the joint's axis."""
        axis, body, middle = joint.axes[0], joint.inner, joint.at
        radius = self._find_radius((joint.outer, joint.at))
        if is_telescope(joint):
            parts = {joint.inner, joint.outer}
            radius = max((bar.radius for bar in self.bars if bar.part in parts), default=radius)
            middle = tube_start(self.robot.graph, joint) + joint.home * axis / 2
            half, radius = 1.5 * radius, 1.5 * radius
        elif joint.kind == "prismatic":
            body, half, radius = joint.outer, 3.0 * self._thin, 2.5 * self._thin
        else:
            half, radius = 2.0 * radius, 1.6 * radius
        return Bar(joint.name, (body, middle - half * axis), (body, middle + half * axis), radius)

    def find_bounds(self) -> tuple[Array, Array]:
        """Return the smallest and largest coordinates of the machine at home, (3,) m each."""
        points = np.array([spot[1] for bar in self.bars for spot in (bar.start, bar.end)])
        return points.min(0), points.max(0)


def _interpolate_along(points: Array, displacements: Array, at: Array) -> Array:
    """Interpolate displacements at equidistant points of a line at places, shape (n, 3)."""
    span = points[-1] - points[0]
    at = (at - points[0]) @ span / (span @ span) * (len(points) - 1)
    first = np.clip(at.astype(int), 0, len(points) - 2)
    part = np.clip(at - first, 0.0, 1.0)[:, None]
    return np.asarray((1.0 - part) * displacements[first] + part * displacements[first + 1])


def _convert_to_quaternions(turns: Rotation) -> Array:
    """Return quaternions with w first, shape (..., 4)."""
    return np.asarray(np.roll(turns.as_quat(), 1, axis=-1), np.float64)


ANCHORS: Final = {
    "bottom-center": (0, -1),
    "top-center": (0, 1),
    "center-left": (1, 0),
    "center-right": (-1, 0),
    "bottom-left": (1, -1),
    "bottom-right": (-1, -1),
    "top-left": (1, 1),
    "top-right": (-1, 1),
}
"""Offset of a label from its place, right and down, in halves of its size."""


def choose_anchors(spots: Array, sizes: Array, window: tuple[float, float]) -> list[str]:
    """Choose an anchor for each label so that no two labels overlap; empty if none is free.

    Each attempt places first the labels that the previous attempt could not place.

    :param spots: labelled points, (k, 2) pixels, right and down; ``sizes``: of labels, (k, 2).
    :param window: width and height; labels have to be inside.
    """
    order, best = list(range(len(spots))), [""] * len(spots)
    for _ in spots:
        taken: list[tuple[Array, Array]] = []
        result = [""] * len(spots)
        for k in order:
            spot, half = spots[k], sizes[k] / 2
            for name, aside in ANCHORS.items():
                middle = spot + half * aside
                within = (middle >= half).all() and (middle + half <= window).all()
                if within and all((np.abs(middle - m) >= half + h).any() for m, h in taken):
                    taken.append((middle, half))
                    result[k] = name
                    break
        if sum(map(bool, result)) > sum(map(bool, best)):
            best = result
        order.sort(key=lambda k: bool(result[k]))
        if all(result):
            break
    return best


def project_points(points: Array, camera: Any) -> tuple[Array, Array]:
    """Project points (k, 3) to pixels (k, 2), right and down, and distances (k,) along the view.

    :param camera: ``position``, ``wxyz`` (z ahead, y down), ``fov`` of the height in rad,
        ``image_width`` and ``image_height``.
    """
    turn = Rotation.from_quat(np.roll(camera.wxyz, -1))
    right, down, ahead = turn.inv().apply(points - camera.position).T
    size = np.array([camera.image_width, camera.image_height])
    pixels = np.column_stack([right, down]) / np.maximum(ahead, 1e-9)[:, None]
    return pixels * size[1] / 2 / np.tan(camera.fov / 2) + size / 2, ahead


def make_round_meshes(sides: int = 24, rings: int = 12) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return vertices and triangles of a cylinder (radius and length 1, along z) and of a ball."""
    angle = np.arange(sides) * 2 * np.pi / sides
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    k, n = np.arange(sides), np.roll(np.arange(sides), -1)
    low, high = np.full((sides, 1), -0.5), np.full((sides, 1), 0.5)
    # The lids have their own vertices, so that the edges are shaded sharp.
    rims = [np.hstack([ring, z]) for z in (low, high, low, high)]
    tips = np.array([[0.0, 0.0, -0.5], [0.0, 0.0, 0.5]])
    wall = [np.column_stack([k, n, sides + n]), np.column_stack([k, sides + n, sides + k])]
    lids = [
        np.column_stack([2 * sides + n, 2 * sides + k, np.full(sides, 4 * sides)]),
        np.column_stack([3 * sides + k, 3 * sides + n, np.full(sides, 4 * sides + 1)]),
    ]
    cylinder = np.concatenate([*rims, tips]), np.concatenate(wall + lids)
    tilt = np.linspace(0, np.pi, rings + 1)
    ball = np.array([[np.sin(t) * c, np.sin(t) * s, np.cos(t)] for t in tilt for c, s in ring])
    faces = []
    for row in range(rings):
        a, b = row * sides, (row + 1) * sides
        faces += [np.column_stack([a + k, b + k, b + n]), np.column_stack([a + k, b + n, a + n])]
    return cylinder, (ball, np.concatenate(faces))


def make_plate(corners: Array, thickness: float) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices and triangles of a plate with a convex outline, both faces and the rim."""
    count = len(corners)
    normal = np.linalg.svd(corners - corners.mean(0))[2][2]
    aside = normal * thickness / 2
    top, low = corners + aside, corners - aside
    vertices = np.concatenate([top, low, [top.mean(0), low.mean(0)]])
    k, n = np.arange(count), np.roll(np.arange(count), -1)
    faces = np.concatenate(
        [
            np.column_stack([k, n, np.full(count, 2 * count)]),
            np.column_stack([count + n, count + k, np.full(count, 2 * count + 1)]),
            np.column_stack([k, count + k, count + n]),
            np.column_stack([k, count + n, n]),
        ]
    )
    # Triangles of both orientations, as the order of the corners is unknown.
    return vertices, np.concatenate([faces, faces[:, ::-1]])
