# SPDX-License-Identifier: Apache-2.0
"""What people can measure of a platform: one quantity a kind, its derivative, its own unknowns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array, Indices
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.identification.calibration_fit import derivatives
from pkm_twin.identification.calibration_state import State
from pkm_twin.identification.noise import CLEAR, FINEST, huber
from pkm_twin.robot.robot import Robot

BELIEVED: Final = 4.0
"""Measurements that the usual noise of a kind counts for against the residuals."""
MEDIAN: Final = 0.6745
"""Median of the size of a normal variable of deviation one."""
TURNS: Final = 5
SPANS: Final = 24
"""Poses between which distances stand for the scale."""
SHORT: Final = 0.3
"""Part of the longest of them from which on a distance counts."""
COORDINATES: Final = ("x", "y", "z", "roll", "pitch", "yaw")


@dataclass(frozen=True)
class Kind:
    """A coordinate of the pose, in the instrument's frame: x y z, m; roll pitch yaw, rad.

    ``name``: of its column. ``noise``: usual standard deviation. ``length``: whether it measures a
    length across the workspace. ``own``: unit and standard deviation before of numbers that are
    fitted with it.
    """

    name: str
    unit: str
    noise: float
    axis: int = 2
    length: bool = False
    pair: bool = False
    own: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    lengths: Array = field(default_factory=lambda: np.zeros(0))
    """Of a scale: distances of the pairs now."""

    def value(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        """At positions (m, 3), of pairs their differences, and rotations (m, 3, 3): (m,)."""
        del own
        if self.axis < 3:
            return p[:, self.axis]
        if self.axis == 4:
            return np.asarray(-np.arcsin(np.clip(r[:, 2, 0], -1.0, 1.0)))
        rows = (r[:, 2, 1], r[:, 2, 2]) if self.axis == 3 else (r[:, 1, 0], r[:, 0, 0])
        return np.asarray(np.arctan2(*rows))

    def slopes(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        """Its derivatives by the linear and the angular velocity, (m, 6)."""
        out = np.zeros((len(p), 6))
        if self.axis < 3:
            out[:, self.axis] = 1.0
            return out
        yaw = np.arctan2(r[:, 1, 0], r[:, 0, 0])
        zero = np.zeros(len(p))
        axes = np.stack(
            [
                r[:, :, 0],
                np.stack([-np.sin(yaw), np.cos(yaw), zero], -1),
                np.broadcast_to([0.0, 0.0, 1.0], (len(p), 3)),
            ],
            -1,
        )
        out[:, 3:] = np.linalg.inv(axes)[:, self.axis - 3]
        return out

    def by_own(self, p: Array, own: Mapping[str, float]) -> dict[str, Array]:
        """Its derivatives by its own numbers, (m,) each."""
        del p, own
        return {}

    def begin(self, p: Array, values: Array) -> dict[str, float]:
        """A first guess of its own numbers by positions (m, 3)."""
        del p, values
        return {}

    def wrapped(self, difference: Array) -> Array:
        """Of two values."""
        if self.unit != "rad":
            return difference
        return np.asarray((difference + np.pi) % (2.0 * np.pi) - np.pi)


class _Plane(Kind):
    """Distance from a plane of unknown height and slopes, along its normal; at contact 0."""

    def _normal(self, own: Mapping[str, float]) -> Array:
        return np.array([-own["plane.slope_x"], -own["plane.slope_y"], 1.0])

    def value(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        del r
        normal = self._normal(own)
        return np.asarray((p @ normal - own["plane.z"]) / np.linalg.norm(normal))

    def slopes(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        del r
        normal = self._normal(own)
        row = np.concatenate([normal / np.linalg.norm(normal), np.zeros(3)])
        return np.broadcast_to(row, (len(p), 6))

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


def _along(ways: Array) -> Array:
    """Derivatives of lengths of ways (m, 3) by the velocities of their ends, (m, 6)."""
    unit = ways / np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12)
    return np.hstack([unit, np.zeros((len(ways), 3))])


class _Ball(Kind):
    """Distance from a fixed centre of unknown place: a ball bar's length."""

    def value(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        del r
        return np.asarray(np.linalg.norm(p - list(own.values()), axis=1))

    def slopes(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        del r
        return _along(p - list(own.values()))

    def by_own(self, p: Array, own: Mapping[str, float]) -> dict[str, Array]:
        unit = -self.slopes(p, p, own)
        return {name: unit[:, k] for k, name in enumerate(own)}

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
        return dict(zip(self.own, (middle + centre).tolist(), strict=True))


class _Distance(Kind):
    """Distance of the platform's reference point at two poses, whose difference ``p`` is."""

    def value(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        del r, own
        return np.asarray(np.linalg.norm(p, axis=1))

    def slopes(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        del r, own
        return _along(p)


class _Scale(_Distance):
    """Mean of the distances of pairs, each over what it is by the file."""

    def value(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        return np.atleast_1d(np.mean(super().value(p, r, own) / self.lengths))

    def slopes(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        return super().slopes(p, r, own) / self.lengths[:, None]


FAR: Final = 10.0
"""Standard deviation of a place, m, and a slope that nothing is known of."""
KINDS: Final = {
    kind.name: kind
    for kind in (
        *(
            Kind(name, "m", 5e-5, k, length=k < 2)
            for k, name in enumerate(COORDINATES[:3])
        ),
        *(Kind(name, "rad", 5e-4, 3 + k) for k, name in enumerate(COORDINATES[3:])),
        Kind("height", "m", 3e-5),
        _Plane(
            "plane", "m", 3e-5,
            own={f"plane.{name}": (unit, FAR) for name, unit in
                 (("z", "m"), ("slope_x", "rad"), ("slope_y", "rad"))},
        ),
        _Ball(
            "radius", "m", 1e-5, length=True,
            own={f"ball.{axis}": ("m", FAR) for axis in "xyz"},
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
    """What one kind of measurement read: values (m,) at poses ``first``, pairs with ``second``.

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


@dataclass(frozen=True, eq=False)
class Counted:
    """Noise of each kind, and square roots of the weights over it, (m,) a kind."""

    noise: tuple[float, ...]
    scales: tuple[Array, ...]

    def over(self, parts: Sequence[Array]) -> Array:
        """Rows (m, 1, ...) of each kind over the noise, one below the other."""
        rows = [
            part[:, 0] * scale.reshape(-1, *[1] * (part.ndim - 2))
            for part, scale in zip(parts, self.scales, strict=True)
        ]
        return np.asarray(np.concatenate(rows), np.float64)


@dataclass(frozen=True, eq=False)
class Partial:
    """Measurements of some quantities at joints (k, n) in the controller's numbers.

    ``noise``: standard deviations that are known, by kind.
    """

    joints: Array
    readings: tuple[Readings, ...]
    noise: Mapping[str, float] = field(default_factory=dict)
    whole: bool = False

    @property
    def own(self) -> dict[str, tuple[str, float]]:
        """Unit and standard deviation before of the kinds' own numbers."""
        return {name: number for one in self.readings for name, number in one.kind.own.items()}

    def parts(self, state: State) -> list[Array]:
        """Measured less computed, (m, 1) a kind."""
        found = []
        for one in self.readings:
            value = one.kind.value(*one.seen(state), one.own(state))
            found.append(one.kind.wrapped(one.values - value)[:, None])
        return found

    def slopes(self, robot: Robot, state: State, names: Sequence[str]) -> list[Array]:
        """Derivatives of what is computed by named parameters, (m, 1, p) a kind."""
        mine = [k for k, name in enumerate(names) if name not in state.instrument.own]
        columns = np.zeros((len(state.q), 6, len(names)))
        columns[..., mine] = derivatives(robot, state, [names[k] for k in mine])
        found = []
        for one in self.readings:
            (p, r), own = one.seen(state), one.own(state)
            moved = columns[one.first]
            if one.second is not None:
                moved = moved - columns[one.second]
            table = np.einsum("ma,map->mp", one.kind.slopes(p, r, own), moved)
            if len(one.kind.lengths):
                table = table.mean(0, keepdims=True)
            for name, column in one.kind.by_own(p, own).items():
                table[:, names.index(name)] = column
            found.append(table[:, None])
        return found

    def weighed(
        self, parts: list[Array], slopes: list[Array], prior: Array, drives: Array | None = None
    ) -> Counted:
        """Noise by what a fit leaves over and by what is usual; less weight beyond ``CLEAR``.

        Of few measurements a fit leaves little: each counts for the part that it does not decide.
        """
        del drives
        usual = [self.noise.get(one.kind.name, one.kind.noise) for one in self.readings]
        noise = [
            s if one.kind.name in self.noise else max(s, float(np.median(np.abs(part))) / MEDIAN)
            for one, s, part in zip(self.readings, usual, parts, strict=True)
        ]
        weights = [np.ones(len(part)) for part in parts]
        for _ in range(TURNS):
            away = [np.abs(part[:, 0]) / s for part, s in zip(parts, noise, strict=True)]
            weights = [huber(one, CLEAR) for one in away]
            left = left_over(slopes, noise, prior)
            for k, one in enumerate(self.readings):
                good = away[k] < CLEAR
                square = BELIEVED * usual[k] ** 2 + float(np.sum(parts[k][good] ** 2))
                count = BELIEVED + float(np.sum(left[k][good]))
                if one.kind.name not in self.noise:
                    noise[k] = max(float(np.sqrt(square / count)), FINEST)
        scales = [np.sqrt(w) / s for w, s in zip(weights, noise, strict=True)]
        return Counted(tuple(noise), tuple(scales))


def spans_of(state: State) -> Readings | None:
    """The scale: distances between poses as the machine has them now; None: it does not travel."""
    some = np.unique(np.linspace(0, len(state.q) - 1, SPANS).astype(int))
    first, second = np.array(list(combinations(some.tolist(), 2)), np.intp).reshape(-1, 2).T
    position = state.platform[0]
    lengths = np.linalg.norm(position[first] - position[second], axis=1)
    far = lengths > max(SHORT * float(lengths.max(initial=0.0)), 1e-6)
    if not far.any():
        return None
    kind = _Scale("scale", "", 1.0, length=True, pair=True, lengths=lengths[far])
    return Readings(kind, first[far], second[far], np.ones(1), np.zeros(1, np.intp))


def left_over(slopes: Sequence[Array], noise: Sequence[float], prior: Array) -> list[Array]:
    """Part of each measurement that the others and the priors decide, 0 to 1, (m,) a kind."""
    rows = [table[:, 0] * prior / s for table, s in zip(slopes, noise, strict=True)]
    whole = np.concatenate(rows)
    both = np.vstack([whole, np.eye(len(prior))])
    base = np.linalg.qr(both)[0][: len(whole)]
    left = np.maximum(1.0 - np.sum(base**2, 1), 1e-9)
    return np.split(left, np.cumsum([len(row) for row in rows])[:-1])


def partial_of(
    joints: Array, second: Array | None, values: Mapping[str, Array], lines: Indices,
    noise: Mapping[str, float],
) -> Partial:  # fmt: skip
    """Measurements of a table: a value that is NaN was not measured.

    :param joints: of the rows, (k, n); ``second``: of a pair's other pose, (k, n), NaN where none.
    :param values: (k,) by kind.
    :raises ParameterError: nothing was measured, or a distance has one pose alone.
    """
    count = len(joints)
    both = joints if second is None else np.vstack([joints, second])
    readings = []
    for name, column in values.items():
        rows = np.flatnonzero(np.isfinite(column))
        if not len(rows):
            raise ParameterError(name, "no value", "a measured value in at least one row")
        pair = KINDS[name].pair
        if pair and (second is None or not np.isfinite(second[rows]).all()):
            raise ParameterError(
                name, "one pose", "two in each row: JOINT.position and JOINT.position_2 columns"
            )
        readings.append(
            Readings(KINDS[name], rows, rows + count if pair else None, column[rows], lines[rows])
        )
    used = np.unique(
        np.concatenate([p for one in readings for p in (one.first, one.second) if p is not None])
    )
    place = np.full(len(both), -1)
    place[used] = np.arange(len(used))
    placed = tuple(
        Readings(
            one.kind, place[one.first], None if one.second is None else place[one.second],
            one.values, one.lines,
        )
        for one in readings
    )  # fmt: skip
    return Partial(both[used], placed, noise)
