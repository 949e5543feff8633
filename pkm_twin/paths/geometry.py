# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Build paths in pose or joint coordinates: lines, rounded corners, arcs, smooth curves.

A path is a chain of stretches, each from rest to rest; a stretch is a chain of pieces that meet
with the same direction. The coordinate s of a piece is a length: angles count by the platform's
radius, see :func:`coordinate_scales`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal, NamedTuple

import numpy as np
import scipy  # type: ignore[import-untyped]  # its parts come when they are asked for
from numpy.typing import ArrayLike

from pkm_twin.codegen.arrays import Array, Mask
from pkm_twin.errors import ParameterError
from pkm_twin.paths.pieces import Arc, Corner, Line, Piece, Smooth, arc_through
from pkm_twin.robot.robot import Robot

Space = Literal["pose", "joint"]

MIN_DISTANCE: Final = 1e-9
"""Distance below which two waypoints coincide, m."""
MAX_LENGTH: Final = 1e6
"""Largest coordinate, m, and rest, s, of a path: the largest of a robot file and of a recording."""
TANGENT_TOLERANCE: Final = 1e-6
"""Difference of two unit directions below which a path continues without a stop."""


@dataclass(frozen=True)
class Stretch:
    """Hold pieces that are passed without a stop, and the rest after them, s."""

    pieces: tuple[Piece, ...]
    dwell: float = 0.0

    @property
    def length(self) -> float:
        """Range of s."""
        return _total_length(self.pieces)


class Mark(NamedTuple):
    """Describe where a waypoint lies on a path.

    ``stretch``: its index; -1 is the rest before the first. ``distance``: length up to the waypoint on
    the stretch, m. ``rest``: time that the machine has rested there, s.
    """

    stretch: int
    distance: float
    rest: float = 0.0


@dataclass(frozen=True)
class Path:
    """Hold stretches in pose or joint coordinates; ``wait`` is the rest before the first, s.

    ``marks``: where each waypoint is; for a rounded corner, the middle of the rounding.
    """

    space: Space
    stretches: tuple[Stretch, ...]
    wait: float = 0.0
    kind: str = "path"
    marks: tuple[Mark, ...] = ()

    @property
    def length(self) -> float:
        """Length of the whole path, m."""
        return sum(stretch.length for stretch in self.stretches)


def coordinate_scales(robot: Robot, space: Space) -> Array:
    """Return lengths per coordinate: 1 for a length, the platform's radius for an angle."""
    if space == "pose":
        return robot.pose_scales
    return np.array([1.0 if unit == "m" else robot.size for unit in robot.joint_units])


def _check_waypoints(robot: Robot, points: ArrayLike, space: Space) -> tuple[Array, Array]:
    """Check waypoints (k, m); return them, and which differ from the one before.

    :raises ParameterError: a wrong shape, a value that is not finite, or all waypoints equal.
    """
    values = np.asarray(points, np.float64)
    names = robot.pose_names if space == "pose" else robot.joint_names
    if values.ndim != 2 or values.shape[1] != len(names) or len(values) < 2:
        raise ParameterError("waypoints", f"shape {values.shape}", f"2 or more rows of {', '.join(names)}")
    bad = ~(np.abs(values) <= MAX_LENGTH).all(1)
    if bad.any():
        row = int(bad.argmax())
        raise ParameterError(f"waypoint {row}", values[row].tolist(), f"numbers up to {MAX_LENGTH:g}")
    steps = np.linalg.norm(np.diff(values, axis=0) * coordinate_scales(robot, space), axis=1)
    if not (steps > MIN_DISTANCE).any():
        raise ParameterError("waypoints", "all equal", "two or more different waypoints")
    return values, np.concatenate([[True], steps > MIN_DISTANCE])


def through(robot: Robot, points: ArrayLike, *, space: Space = "pose") -> Path:
    """Return a smooth curve through waypoints: a cubic spline over the chords' lengths.

    :param points: shape (k, m), coordinates of the pose, or joint positions (k, n).
    :raises ParameterError: fewer than two different waypoints, or values that are not finite.
    """
    values, new = _check_waypoints(robot, points, space)
    values = values[new]
    steps = np.linalg.norm(np.diff(values, axis=0) * coordinate_scales(robot, space), axis=1)
    knots = np.concatenate([[0.0], np.cumsum(steps)])
    if len(values) == 2:
        piece: Piece = Line(values[0], (values[1] - values[0]) / knots[1], float(knots[1]))
    else:
        piece = Smooth(scipy.interpolate.CubicSpline(knots, values))
    marks = tuple(Mark(0 if k else -1, float(knots[k])) for k in np.cumsum(new) - 1)
    return Path(space, (Stretch((piece,)),), kind="smooth curve", marks=marks)


def lines(
    robot: Robot,
    points: ArrayLike,
    *,
    blend: ArrayLike = 0.0,
    dwell: ArrayLike = 0.0,
    arc: ArrayLike = False,
    space: Space = "pose",
) -> Path:
    """Return lines and arcs between waypoints, with corners rounded or passed with a stop.

    :param points: shape (k, m), coordinates of the pose, or joint positions (k, n).
    :param blend: by waypoint (k,) or one for all: distance from the corner at which the path
        leaves the line, m (angles by the platform's radius); at most half of the shorter
        neighbouring line. 0 is a stop. It must be 0 where an arc begins or ends.
    :param dwell: rest in each waypoint, s, shape (k,) or one for all; above 0 it is a stop.
    :param arc: which waypoints (k,) are points in the middle of an arc, from the waypoint before
        to the one behind. An arc and a tangent line meet without a stop.
    :raises ParameterError: with the waypoint.
    """
    values, new = _check_waypoints(robot, points, space)
    count = len(values)
    blends, dwells = (np.broadcast_to(np.asarray(v, float), count).copy() for v in (blend, dwell))
    arcs = np.broadcast_to(np.asarray(arc, bool), count).copy()
    for name, numbers in (("blend", blends), ("dwell", dwells)):
        bad = ~((numbers >= 0.0) & (numbers <= MAX_LENGTH))
        if bad.any():
            row = int(bad.argmax())
            raise ParameterError(f"waypoint {row}: {name}", numbers[row], f"0 to {MAX_LENGTH:g}")
    # A repeated waypoint only adds its rest.
    rested = np.zeros(count)
    for k in np.flatnonzero(np.logical_not(new)):
        rested[k] = dwells[k - 1]
        dwells[k] += dwells[k - 1]
        keep = int(np.flatnonzero(new[:k])[-1])
        dwells[keep], arcs[keep] = dwells[k], arcs[keep] and arcs[k]
    values, blends, dwells, arcs = (v[new] for v in (values, blends, dwells, arcs))
    made = _join_waypoints(robot, space, values, blends, dwells, arcs)
    places = zip(np.cumsum(new) - 1, rested.tolist(), strict=True)
    return replace(made, marks=tuple(made.marks[k]._replace(rest=rest) for k, rest in places))


def _join_waypoints(robot: Robot, space: Space, points: Array, blends: Array, dwells: Array, arcs: Mask) -> Path:
    """Build the pieces between waypoints that differ."""
    scales, last = coordinate_scales(robot, space), len(points) - 1
    if arcs[0] or arcs[last]:
        raise ParameterError("waypoints: arc", "the first or last", "waypoints between two others")
    places = [i for i, name in enumerate(robot.pose_names if space == "pose" else ()) if name in ("x", "y", "z")]
    moves: list[tuple[Piece, int]] = []
    k = 0
    while k < last:
        if arcs[k + 1]:
            if arcs[k + 2]:
                raise ParameterError(f"waypoint {k + 2}: arc", 1, "only one point between the ends of an arc")
            if len(places) < 2:
                raise ParameterError(f"waypoint {k + 1}: arc", 1, "poses with two or more of x, y, z among them")
            arc = arc_through(*points[k : k + 3], places=places, where=f"waypoint {k + 1}")
            moves.append((arc, k + 2))
        else:
            chord = points[k + 1] - points[k]
            length = float(np.linalg.norm(chord * scales))
            moves.append((Line(points[k], chord / length, length), k + 1))
        k = moves[-1][1]
    pieces: list[Piece] = []
    stretches: list[Stretch] = []
    marks = [Mark(-1, 0.0)]
    cut = 0.0
    for (piece, end), following in zip(moves, [*(move for move, _ in moves[1:]), None], strict=True):
        out = np.asarray(piece.at(np.array([piece.length]))[1][0], np.float64)
        into = out if following is None else following.at(np.zeros(1))[1][0]
        radius, wanted = 0.0, float(blends[end])
        if following is not None and wanted > 0.0 and dwells[end] == 0.0:
            if not (isinstance(piece, Line) and isinstance(following, Line)):
                raise ParameterError(
                    f"waypoint {end}: blend", wanted, "0 where an arc begins or ends (make it tangent)"
                )
            turn = float(np.sum(out * into * scales**2))
            # A corner of 170 degrees or more cannot be rounded.
            if -0.985 < turn < 1.0 - TANGENT_TOLERANCE**2:
                radius = min(wanted, 0.5 * piece.length, 0.5 * following.length)
        if isinstance(piece, Arc):
            marks.append(Mark(len(stretches), _total_length(pieces) + piece.arc_length_at(points[end - 1])))
        length = piece.length - cut - radius
        if length > MIN_DISTANCE:
            # An arc is never shortened.
            pieces.append(
                Line(piece.begin + cut * piece.slope, piece.slope, length) if isinstance(piece, Line) else piece
            )
        marks.append(Mark(len(stretches), _total_length(pieces) + radius))
        cut = radius
        if radius > 0.0:
            pieces.append(Corner(points[end], out, into, radius))
            continue
        apart = float(np.linalg.norm((out - into) * scales))
        if following is None or apart > TANGENT_TOLERANCE or dwells[end] > 0.0:
            stretches.append(Stretch(tuple(pieces), float(dwells[end])))
            pieces = []
    return Path(space, tuple(stretches), float(dwells[0]), "lines", tuple(marks))


def _total_length(pieces: Sequence[Piece]) -> float:
    return sum(piece.length for piece in pieces)


def circle(robot: Robot, centre: ArrayLike, radius: float, *, turns: float = 1.0) -> Path:
    """Return a circle of the reference point about a pose, in the first two of x, y, z.

    For a pose without two of them, the circle is in its first two angles.

    :param centre: the pose in the middle, shape (m,).
    :param radius: m, of angles rad.
    :param turns: how often; negative turns the other way.
    :raises ParameterError: a pose without two coordinates of one kind, or an invalid radius.
    """
    middle, units = np.asarray(centre, float), robot.pose_units
    both = ([i for i, unit in enumerate(units) if unit == kind][:2] for kind in ("m", "rad"))
    places = next((found for found in both if len(found) == 2), None)
    if places is None:
        raise ParameterError("circle", robot.name, "a pose with two positions or two angles")
    if not (0.0 < radius <= MAX_LENGTH and 0.0 < abs(turns) <= MAX_LENGTH):
        raise ParameterError(
            "circle", [radius, turns], f"a radius above 0 and turns other than 0, up to {MAX_LENGTH:g}"
        )
    across, along = np.zeros(len(middle)), np.zeros(len(middle))
    scale = float(coordinate_scales(robot, "pose")[places[0]])
    across[places[0]], along[places[1]] = 1.0 / scale, float(np.sign(turns)) / scale
    angle = 2 * np.pi * abs(turns)
    piece = Arc(middle, across, along, np.zeros(len(middle)), scale * float(radius), angle)
    marks = (Mark(-1, 0.0), Mark(0, piece.length))
    return Path("pose", (Stretch((piece,)),), kind="circle", marks=marks)


def cycle(
    robot: Robot,
    height: float,
    width: float,
    lift: float | None = None,
    *,
    at: ArrayLike | None = None,
    direction: float | None = None,
    blend: float | None = None,
    dwell: float = 0.0,
    back: bool = True,
) -> Path:
    """Return a pick-and-place cycle: up, across, down, a stop, and the same way back.

    :param height: rise at the first place, m.
    :param width: between the two places, m.
    :param lift: fall at the second place, m; default ``height``.
    :param at: pose in the middle between the two places, shape (m,); default home.
    :param direction: of the way across in the x-y plane, rad; default along x, or along
        y of a robot that has no x.
    :param blend: rounding of the upper corners, m; default 0.8 of the smaller rise.
    :param dwell: rest in both places, s.
    :param back: whether the path goes back to the first place.
    :raises ParameterError: a robot that cannot move up and across, or lengths of zero.
    """
    fall = height if lift is None else lift
    for name, value in (("height", height), ("width", width), ("lift", fall)):
        if not (np.isfinite(value) and value > 0.0):
            raise ParameterError(f"cycle: {name}", value, "above 0, m")
    names = robot.pose_names
    if "z" not in names or not {"x", "y"} & set(names):
        raise ParameterError("cycle", f"pose {', '.join(names)}", "a pose with z and one of x, y")
    middle = robot.home() if at is None else np.asarray(at, float)
    if middle.shape != (len(names),):
        raise ParameterError("at", middle.tolist(), f"a pose: {', '.join(names)}")
    across, up = np.zeros(len(names)), np.zeros(len(names))
    up[names.index("z")] = 1.0
    if direction is None:
        direction = 0.0 if "x" in names else 0.5 * np.pi
    plane = {"x": np.cos(direction), "y": np.sin(direction)}
    for name, part in plane.items():
        if name in names:
            across[names.index(name)] = part
        elif abs(part) > 1e-9:
            ways = "90 or 270" if name == "x" else "0 or 180"
            bound = f"{ways} degrees: the pose has no {name}"
            raise ParameterError("direction", f"{np.degrees(direction):g} degrees", bound)
    first = middle - 0.5 * width * across
    second = middle + 0.5 * width * across + (height - fall) * up
    there = [first, first + height * up, second + fall * up, second]
    points = there + there[-2::-1] if back else there
    corner = 0.8 * min(height, fall) if blend is None else blend
    rounded = [0.0, corner, corner, 0.0] + ([corner, corner, 0.0] if back else [])
    rests = [0.0, 0.0, 0.0, dwell] + ([0.0, 0.0, dwell] if back else [])
    made = lines(robot, points, blend=rounded, dwell=rests)
    return replace(made, kind="pick-and-place cycle")
