# SPDX-License-Identifier: Apache-2.0
"""What people can measure of a platform: one class a kind, with its derivative and own unknowns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array, Indices
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.identification.calibration_state import Poses, State, derivatives, rotations
from pkm_twin.identification.samples import CLEAR, FINEST, huber
from pkm_twin.robot.robot import Robot

BELIEVED: Final = 4.0
"""Measurements that the usual noise of a kind counts for against the residuals."""
MEDIANS: Final = {1: 0.6745, 3: 0.888}
"""Median, by the number of axes, of the root mean square of normal variables of deviation one."""
MAX_ITERATIONS: Final = 5
SPANS: Final = 24
"""Poses between which distances stand for the scale."""
SHORT: Final = 0.3
"""Part of the longest of them from which on a distance counts."""
COORDINATES: Final = ("x", "y", "z", "roll", "pitch", "yaw")
UNKNOWN_DEVIATION: Final = 10.0
"""Standard deviation of a place, m, and a slope that nothing is known of."""


@dataclass(frozen=True)
class Kind:
    """A quantity of a axes that people measure, by position and rotation in the instrument's frame.

    ``name``: of its column. ``noise``: usual standard deviation, which counts for ``believed``
    measurements. ``length``: whether it measures a length across the workspace. ``pair``: whether
    it measures two poses, by the difference of their positions. ``own``: unit and standard
    deviation before of numbers that are fitted with it.
    """

    name: str
    unit: str
    noise: float
    axes: tuple[int, ...] = ()
    length: bool = False
    pair: bool = False
    own: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    believed: float = BELIEVED

    def value(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        """At positions (m, 3) and rotations (m, 3, 3): (m, a); here coordinates of the position."""
        del r, own
        return p[:, self.axes]

    def slopes(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        """Its derivatives by the linear and the angular velocity, (m, a, 6)."""
        del r, own
        return np.broadcast_to(np.eye(6)[list(self.axes)], (len(p), len(self.axes), 6))

    def by_own(self, p: Array, own: Mapping[str, float]) -> dict[str, Array]:
        """Its derivatives by its own numbers, (m,) each."""
        del p, own
        return {}

    def begin(self, p: Array, values: Array) -> dict[str, float]:
        """A first guess of its own numbers by positions (m, 3) and values (m,)."""
        del p, values
        return {}

    def likely(self, p: Array) -> Array:
        """Values (m, 1) at positions (m, 3) that give its own numbers a likely place."""
        return np.zeros((len(p), 1))

    def residual(self, values: Array, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        """Measured less computed, (m, a)."""
        apart = values - self.value(p, r, own)
        turned = np.asarray((apart + np.pi) % (2.0 * np.pi) - np.pi)
        return turned if self.unit == "rad" else apart


class _Rotation(Kind):
    """A whole rotation, measured as (m, 3, 3)."""

    def residual(self, values: Array, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        del p, own
        apart = rotations().from_matrix(values @ np.swapaxes(r, -1, -2))
        return np.asarray(apart.as_rotvec(), np.float64)


class _Angle(Kind):
    """Roll, pitch or yaw."""

    def value(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        del p, own
        pitch = -np.arcsin(np.clip(r[:, 2, 0], -1.0, 1.0))
        roll, yaw = np.arctan2(r[:, 2, 1], r[:, 2, 2]), np.arctan2(r[:, 1, 0], r[:, 0, 0])
        return np.stack([roll, pitch, yaw], -1)[:, self.axes]

    def slopes(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        yaw, zero = np.arctan2(r[:, 1, 0], r[:, 0, 0]), np.zeros(len(p))
        about = [r[:, :, 0], np.stack([-np.sin(yaw), np.cos(yaw), zero], -1)]
        table = np.stack([*about, np.broadcast_to([0.0, 0.0, 1.0], (len(p), 3))], -1)
        rows = np.linalg.inv(table)[:, self.axes]
        return np.concatenate([np.zeros_like(rows), rows], -1)


class _Plane(Kind):
    """Distance from a plane of unknown height and slopes, along its normal; at contact 0."""

    def _normal(self, own: Mapping[str, float]) -> Array:
        return np.array([-own["plane.slope_x"], -own["plane.slope_y"], 1.0])

    def value(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        normal = self._normal(own)
        return np.asarray((p @ normal - own["plane.z"]) / np.linalg.norm(normal))[:, None]

    def slopes(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        normal = self._normal(own)
        row = np.concatenate([normal / np.linalg.norm(normal), np.zeros(3)])
        return np.broadcast_to(row, (len(p), 1, 6))

    def by_own(self, p: Array, own: Mapping[str, float]) -> dict[str, Array]:
        size = np.linalg.norm(self._normal(own))
        away = (p @ self._normal(own) - own["plane.z"]) / size**3
        found = {"plane.z": np.full(len(p), -1.0 / size)}
        for k, name in enumerate(("plane.slope_x", "plane.slope_y")):
            found[name] = -p[:, k] / size - away * own[name]
        return found

    def begin(self, p: Array, values: Array) -> dict[str, float]:
        rows = np.column_stack([np.ones(len(p)), p[:, :2]])
        found = np.linalg.lstsq(rows, p[:, 2] - values, rcond=1e-6)[0]
        return dict(zip(self.own, found.tolist(), strict=True))


class _Distance(Kind):
    """Length of ``p``: of the platform's reference point at two poses, or from a fixed centre."""

    def value(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        return np.asarray(np.linalg.norm(self._away(p, own), axis=1, keepdims=True))

    def slopes(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        away = self._away(p, own)
        unit = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
        return np.hstack([unit, np.zeros_like(unit)])[:, None]

    def _away(self, p: Array, own: Mapping[str, float]) -> Array:
        return p - list(own.values())[:3] if own else p


class _Ball(_Distance):
    """Distance from a fixed centre of unknown place: a ball bar's length."""

    def by_own(self, p: Array, own: Mapping[str, float]) -> dict[str, Array]:
        unit = -self.slopes(p, p, own)[:, 0]
        return {name: unit[:, k] for k, name in enumerate(list(own)[:3])}

    def begin(self, p: Array, values: Array) -> dict[str, float]:
        """The difference of |p - c|^2 = r^2 of every two is linear in c."""
        middle = p.mean(0)
        away = p - middle
        right = np.sum(away**2, 1) - values**2
        rows, right = 2.0 * away, right - right.mean()
        centre = np.linalg.lstsq(rows, right, rcond=1e-3)[0]
        if np.linalg.matrix_rank(rows, 1e-3) < 3:
            # On a plane: as far aside as the radius says, below.
            left = np.mean(values**2) - np.mean(np.sum((away - centre) ** 2, 1))
            aside = np.linalg.svd(rows)[2][-1]
            centre -= np.sqrt(max(left, 0.0)) * aside * np.sign(aside[2] or 1.0)
        return dict(zip(self.own, (middle + centre).tolist(), strict=False))

    def likely(self, p: Array) -> Array:
        """A ball below the positions."""
        below = p.mean(0) - [0.0, 0.0, float(np.ptp(p, axis=0).max())]
        return np.asarray(np.linalg.norm(p - below, axis=1, keepdims=True))


class _Range(_Ball):
    """Distance from a fixed place with an unknown zero: a laser tracker's or a wire's reading."""

    def value(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        return super().value(p, r, own) + own["range.zero"]

    def by_own(self, p: Array, own: Mapping[str, float]) -> dict[str, Array]:
        return super().by_own(p, own) | {"range.zero": np.ones(len(p))}

    def begin(self, p: Array, values: Array) -> dict[str, float]:
        """Of places at many distances from the middle the one that fits best."""
        away = np.ptp(p, axis=0).max() * 2.0 ** np.arange(-1, 6)
        zeros = [0.0, *(values.mean() - away).tolist()]
        found = [_Ball.begin(self, p, values - z) | {"range.zero": z} for z in zeros]
        return min(
            found, key=lambda own: float(np.sum((values - self.value(p, p, own)[:, 0]) ** 2))
        )


PLACE: Final = Kind("position", "m", FINEST, (0, 1, 2), length=True, believed=0.0)
TURN: Final = _Rotation("rotation", "rad", FINEST, (3, 4, 5), believed=0.0)
"""Of whole poses."""
KINDS: Final = {
    kind.name: kind
    for kind in (
        *(
            Kind(name, "m", 5e-5, (k,), length=k < 2)
            for k, name in enumerate(COORDINATES[:3])
        ),
        *(_Angle(name, "rad", 5e-4, (k,)) for k, name in enumerate(COORDINATES[3:])),
        Kind("height", "m", 3e-5, (2,)),
        _Plane(
            "plane", "m", 3e-5,
            own={f"plane.{name}": (unit, UNKNOWN_DEVIATION) for name, unit in
                 (("z", "m"), ("slope_x", "rad"), ("slope_y", "rad"))},
        ),
        _Ball(
            "radius", "m", 1e-5, length=True,
            own={f"ball.{axis}": ("m", UNKNOWN_DEVIATION) for axis in "xyz"},
        ),
        _Range(
            "range", "m", 1e-5, length=True,
            own={f"range.{name}": ("m", UNKNOWN_DEVIATION) for name in ("x", "y", "z", "zero")},
        ),
        _Distance("distance", "m", 6e-5, length=True, pair=True),
    )
}  # fmt: skip
GROUPS: Final = {"tilt": ("roll", "pitch"), "position": COORDINATES[:3], "pose": COORDINATES}


def kinds_of(texts: Sequence[str]) -> tuple[Kind, ...]:
    """Kinds by names, separated by commas.

    :raises UnknownNameError: no such kind.
    """
    names = [name.strip() for text in texts for name in text.split(",")]
    every = [one for name in names for one in GROUPS.get(name, (name,))]
    for name in every:
        if name not in KINDS:
            raise UnknownNameError("--measure", name, [*KINDS, *GROUPS])
    return tuple(KINDS[name] for name in dict.fromkeys(every))


@dataclass(frozen=True, eq=False)
class Readings:
    """What one kind of measurement read: values (m, a) at poses ``first``, pairs with ``second``.

    ``lines``: of the table, from 1.
    """

    kind: Kind
    first: Indices
    second: Indices | None
    values: Array
    lines: Indices

    def seen(self, state: State) -> tuple[Array, Array]:
        """Positions (m, 3), of pairs their differences, and rotations (m, 3, 3)."""
        position, rotation = state.instrument.seen(*state.platform)
        p = position[self.first]
        return (p if self.second is None else p - position[self.second]), rotation[self.first]

    def own(self, state: State) -> dict[str, float]:
        """The kind's own numbers as they are now."""
        return {name: state.instrument.own[name] for name in self.kind.own}

    def slopes(self, state: State, columns: Array, names: Sequence[str]) -> Array:
        """Derivatives of what is computed, (m, a, p), by those of the poses, (k, 6, p)."""
        (p, r), own = self.seen(state), self.own(state)
        moved = columns[self.first]
        if self.second is not None:
            moved = moved - columns[self.second]
        table = np.asarray(self.kind.slopes(p, r, own) @ moved, np.float64)
        for name, column in self.kind.by_own(p, own).items():
            table[:, 0, names.index(name)] = column
        return table


@dataclass(frozen=True, eq=False)
class Weights:
    """Noise of each kind, and square roots of the weights over it, (m,) a kind."""

    noise: tuple[float, ...]
    scales: tuple[Array, ...]

    def over(self, parts: Sequence[Array]) -> Array:
        """Rows (m, a, ...) of each kind over the noise, one below the other."""
        rows = [
            (part * scale.reshape(-1, *[1] * (part.ndim - 1))).reshape(-1, *part.shape[2:])
            for part, scale in zip(parts, self.scales, strict=True)
        ]
        return np.asarray(np.concatenate(rows), np.float64)


@dataclass(frozen=True, eq=False)
class Measured:
    """Measurements of some quantities at joints (k, n) in the controller's numbers.

    ``noise``: standard deviations that are known, by kind.
    """

    joints: Array
    readings: tuple[Readings, ...]
    noise: Mapping[str, float] = field(default_factory=dict)

    @property
    def own(self) -> dict[str, tuple[str, float]]:
        """Unit and standard deviation before of the kinds' own numbers."""
        return {name: number for one in self.readings for name, number in one.kind.own.items()}

    def parts(self, state: State) -> list[Array]:
        """Measured less computed, (m, a) a kind."""
        return [
            one.kind.residual(one.values, *one.seen(state), one.own(state)) for one in self.readings
        ]

    def slopes(self, robot: Robot, state: State, names: Sequence[str]) -> list[Array]:
        """Derivatives of what is computed by named parameters, (m, a, p) a kind."""
        columns = derivatives(robot, state, names)
        return [one.slopes(state, columns, names) for one in self.readings]

    def weighed(self, parts: list[Array], slopes: list[Array], prior: Array) -> Weights:
        """Noise by what a fit leaves over and by what is usual; robust weights.

        Of few measurements a fit leaves little: each counts for the part that it does not decide.
        """
        kinds = [one.kind for one in self.readings]
        usual = [self.noise.get(kind.name, kind.noise) for kind in kinds]
        sizes = [np.sqrt(np.mean(part**2, 1)) for part in parts]
        noise = [
            s
            if kind.name in self.noise
            else max(s, float(np.median(size)) / MEDIANS[part.shape[1]])
            for kind, s, size, part in zip(kinds, usual, sizes, parts, strict=True)
        ]
        weights = [np.ones(len(part)) for part in parts]
        for _ in range(MAX_ITERATIONS):
            away = [size / s for size, s in zip(sizes, noise, strict=True)]
            weights = [huber(one) for one in away]
            left = left_over(slopes, noise, prior)
            for k, kind in enumerate(kinds):
                good = away[k] < CLEAR
                square = kind.believed * usual[k] ** 2 + float(np.sum(parts[k][good] ** 2))
                count = kind.believed + float(np.sum(left[k][good])) * parts[k].shape[1]
                if kind.name not in self.noise:
                    noise[k] = max(float(np.sqrt(square / max(count, 1.0))), FINEST)
        scales = [np.sqrt(w) / s for w, s in zip(weights, noise, strict=True)]
        return Weights(tuple(noise), tuple(scales))


def left_over(slopes: Sequence[Array], noise: Sequence[float], prior: Array) -> list[Array]:
    """Part of each measurement that the others and the priors decide, 0 to 1, (m,) a kind."""
    rows = [
        (table * prior / s).reshape(-1, len(prior)) for table, s in zip(slopes, noise, strict=True)
    ]
    whole = np.concatenate(rows)
    both = np.vstack([whole, np.eye(len(prior))])
    base = np.linalg.qr(both)[0][: len(whole)]
    left = np.maximum(1.0 - np.sum(base**2, 1), 1e-9)
    each = np.split(left, np.cumsum([len(row) for row in rows])[:-1])
    return [part.reshape(len(table), -1).mean(1) for part, table in zip(each, slopes, strict=True)]


def scale_slopes(robot: Robot, state: State, names: Sequence[str]) -> Array | None:
    """Relative derivatives (p,) of the mean distance of poses; None: the platform stays there."""
    some = np.unique(np.linspace(0, len(state.q) - 1, SPANS).astype(int))
    first, second = np.array(list(combinations(some.tolist(), 2)), np.intp).reshape(-1, 2).T
    position = state.instrument.seen(*state.platform)[0]
    ways = position[first] - position[second]
    lengths = np.linalg.norm(ways, axis=1)
    far = lengths > max(SHORT * float(lengths.max(initial=0.0)), 1e-6)
    if not far.any():
        return None
    columns = derivatives(robot, state, names)[:, :3]
    moved = (columns[first] - columns[second])[far]
    relative = ways[far] / lengths[far, None] ** 2
    return np.asarray(np.einsum("ma,map->mp", relative, moved).mean(0), np.float64)


def whole_of(poses: Poses, rows: Indices) -> Measured:
    """Some of the whole poses, or of their positions, as measurements."""
    every, lines = np.arange(len(rows)), rows + 2
    readings = [Readings(PLACE, every, None, poses.position[rows], lines)]
    if poses.rotation is not None:
        readings.append(Readings(TURN, every, None, poses.rotation[rows], lines))
    return Measured(poses.joints[rows], tuple(readings))


def measured_of(
    joints: Array, second: Array | None, values: Mapping[str, Array], lines: Indices,
    noise: Mapping[str, float],
) -> Measured:  # fmt: skip
    """Measurements of a table: a value that is NaN was not measured.

    :param joints: of the rows, (k, n); ``second``: of a pair's other pose, (k, n), NaN where none.
    :param values: (k,) by kind.
    :raises ParameterError: nothing was measured, or a distance has one pose alone.
    """
    count = len(joints)
    both = joints if second is None else np.vstack([joints, second])
    found, used = [], np.zeros(len(both), bool)
    for name, column in values.items():
        rows = np.flatnonzero(np.isfinite(column))
        if not len(rows):
            raise ParameterError(name, "no value", "a measured value in at least one row")
        pair = KINDS[name].pair
        if pair and (second is None or not np.isfinite(second[rows]).all()):
            raise ParameterError(
                name, "one pose", "two in each row: JOINT.position and JOINT.position_2 columns"
            )
        used[rows] = True
        used[rows + count * pair] = True
        found.append((KINDS[name], rows, rows + count if pair else None))
    place = np.cumsum(used) - 1
    readings = (
        Readings(
            kind, place[first], None if other is None else place[other],
            values[kind.name][first, None], lines[first],
        )
        for kind, first, other in found
    )  # fmt: skip
    return Measured(both[used], tuple(readings), noise)
