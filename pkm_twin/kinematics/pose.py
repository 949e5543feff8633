# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Pose coordinates of a platform from its position and rotation, with derivatives in time.

A coordinate is a component of the position, or an angle atan2(a, b) or asin(s) of signed entries of
the rotation matrix. Numbers and expressions have the same formulas.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from pkm_twin.codegen.expressions import Numbers, cross
from pkm_twin.codegen.operations import atan2, cos, sin, sqrt
from pkm_twin.errors import ParameterError
from pkm_twin.kinematics.motion import Columns, Motion

Entry = tuple[int, int, float]
"""Row, column and sign of an entry of the rotation matrix."""


@dataclass(frozen=True)
class Coordinate:
    """One pose coordinate: component ``axis`` of the position, or an angle from rotation entries.

    One entry is the angle's sine; of two entries the angle is atan2(first, second).
    """

    name: str
    axis: int | None = None
    entries: tuple[Entry, ...] = ()

    @property
    def unit(self) -> str:
        """``m`` or ``rad``."""
        return "rad" if self.entries else "m"


COORDINATES: Final = {
    "x": Coordinate("x", 0),
    "y": Coordinate("y", 1),
    "z": Coordinate("z", 2),
    # R = Rz(yaw) Ry(pitch) Rx(roll)
    "roll": Coordinate("roll", entries=((2, 1, 1.0), (2, 2, 1.0))),
    "pitch": Coordinate("pitch", entries=((2, 0, -1.0),)),
    "yaw": Coordinate("yaw", entries=((1, 0, 1.0), (0, 0, 1.0))),
}
"""Pose coordinates that are available for every machine, by name."""


ANGLE_AXES: Final = {
    "zyx": tuple(COORDINATES[name] for name in ("yaw", "pitch", "roll")),
    "xyz": (
        Coordinate("", entries=((1, 2, -1.0), (2, 2, 1.0))),
        Coordinate("", entries=((0, 2, 1.0),)),
        Coordinate("", entries=((0, 1, -1.0), (0, 0, 1.0))),
    ),
}
"""Angles of R = Rz Ry Rx and of R = Rx Ry Rz, from the base to the platform."""


def name_angles(angles: Any) -> tuple[Coordinate, ...]:
    """Return the pose coordinates of a rotation sequence, given as axes by name from the base on.

    ``{"alpha": "x", "beta": "y"}`` is R = Rx(alpha) Ry(beta) Rz.

    :raises ParameterError: other axes than those of R = Rx Ry Rz or R = Rz Ry Rx, or a single one.
    """
    if not isinstance(angles, Mapping):
        raise ParameterError("angles", angles, "a mapping of names to axes")
    axes = "".join(map(str, angles.values()))
    for sequence, turns in ANGLE_AXES.items():
        if len(axes) > 1 and sequence.startswith(axes):
            return tuple(replace(turn, name=str(name)) for name, turn in zip(angles, turns, strict=False))
    raise ParameterError("angles", dict(angles), "two or three names, about x, y, z or about z, y, x in this order")


def describe_angles(coordinates: Sequence[Coordinate]) -> dict[str, str]:
    """Return the argument with which :func:`name_angles` returns these coordinates."""
    names = {c.entries: c.name for c in coordinates if c.entries}
    for sequence, turns in ANGLE_AXES.items():
        if set(names) <= {turn.entries for turn in turns}:
            last = max(k for k, turn in enumerate(turns) if turn.entries in names)
            own = zip(sequence, turns[: max(last + 1, 2)], strict=False)
            return {names.get(turn.entries, f"about_{axis}"): axis for axis, turn in own}
    raise ValueError("the angles are of no one sequence")


def _entry(matrix: Any, entry: Entry) -> Any:
    row, column, sign = entry
    return matrix[row][column] if sign > 0.0 else -matrix[row][column]


def _root(matrix: Any, entry: Entry) -> Any:
    """Return the cosine of an angle whose sine is an entry, from the other entries of its column.

    sqrt(1 - sine^2) would lose digits.
    """
    row, column, _ = entry
    a, b = (matrix[i][column] for i in range(3) if i != row)
    return sqrt(a * a + b * b)


def evaluate_coordinates(coordinates: Sequence[Coordinate], position: Any, rotation: Any) -> list[Any]:
    """Return the pose coordinates of a platform."""
    result = []
    for c in coordinates:
        if c.axis is not None:
            result.append(position[c.axis])
        elif len(c.entries) == 2:
            result.append(atan2(_entry(rotation, c.entries[0]), _entry(rotation, c.entries[1])))
        else:
            result.append(atan2(_entry(rotation, c.entries[0]), _root(rotation, c.entries[0])))
    return result


def _cross_columns(rotation: Any, by: Any) -> list[list[Any]]:
    """Return the vector product of ``by`` and each column of a matrix."""
    turned = [cross(by, [rotation[i][k] for i in range(3)]) for k in range(3)]
    return [[turned[k][i] for k in range(3)] for i in range(3)]


def rates(coordinates: Sequence[Coordinate], rotation: Any, velocity: Any, omega: Any) -> list[Any]:
    """Return pose rates from the platform's velocity and angular velocity."""
    turned = _cross_columns(rotation, omega)
    result = []
    for c in coordinates:
        if c.axis is not None:
            result.append(velocity[c.axis])
        elif len(c.entries) == 2:
            a, b = (_entry(rotation, e) for e in c.entries)
            ad, bd = (_entry(turned, e) for e in c.entries)
            result.append((b * ad - a * bd) / (a * a + b * b))
        else:
            result.append(_entry(turned, c.entries[0]) / _root(rotation, c.entries[0]))
    return result


def accelerations(
    coordinates: Sequence[Coordinate],
    rotation: Any,
    omega: Any,
    acceleration: Any,
    alpha: Any,
) -> list[Any]:
    """Return second derivatives of the pose in time."""
    once = _cross_columns(rotation, omega)
    again = _cross_columns(once, omega)
    bent = _cross_columns(rotation, alpha)
    twice = [[again[i][k] + bent[i][k] for k in range(3)] for i in range(3)]
    result = []
    for c in coordinates:
        if c.axis is not None:
            result.append(acceleration[c.axis])
        elif len(c.entries) == 2:
            a, b = (_entry(rotation, e) for e in c.entries)
            ad, bd = (_entry(once, e) for e in c.entries)
            add, bdd = (_entry(twice, e) for e in c.entries)
            square = a * a + b * b
            rate = (b * ad - a * bd) / square
            swell = 2.0 * (a * ad + b * bd)
            result.append((b * add - a * bdd - rate * swell) / square)
        else:
            entry = c.entries[0]
            root = _root(rotation, entry)
            rate = _entry(once, entry) / root
            result.append((_entry(twice, entry) + _entry(rotation, entry) * rate * rate) / root)
    return result


def rows(coordinates: Sequence[Coordinate], motion: Motion, pose: Numbers) -> list[tuple[Any, Columns]]:
    """Return the equations of a given pose, zero if the platform has it, and their derivatives."""
    body = motion.graph.platform
    position, rotation = motion.platform()
    linear = motion.linear_jacobian(body, position)
    angular = motion.angular_jacobian(body)
    result: list[tuple[Any, Columns]] = []
    for c, goal in zip(coordinates, pose, strict=True):
        if c.axis is not None:
            axis = c.axis
            result.append((position[axis] - goal, {k: v[axis] for k, v in linear.items()}))
            continue
        factors = (cos(goal), -sin(goal)) if len(c.entries) == 2 else (1.0,)
        value: Any = 0.0 if len(c.entries) == 2 else -sin(goal)
        columns: Columns = dict.fromkeys(angular, 0.0)
        for entry, factor in zip(c.entries, factors, strict=True):
            row, column, _ = entry
            value = value + _entry(rotation, entry) * factor
            vector = [rotation[i][column] for i in range(3)]
            for k, w in angular.items():
                change = cross(w, vector)[row]
                columns[k] = columns[k] + (change if entry[2] > 0.0 else -change) * factor
        result.append((value, columns))
    return result
