# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What people measure of a platform: one class a kind, with its derivative; and its tables."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array, Indices
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.identification.calibration_state import Poses, State, differentiate_poses, rotations
from pkm_twin.identification.samples import MAX_SOUND_DISTANCE, MIN_NOISE, huber
from pkm_twin.recordings.tables import DEFAULT_DIALECT, Dialect, Table, read_table
from pkm_twin.robot.robot import Robot

COORDINATES: Final = ("x", "y", "z", "roll", "pitch", "yaw")
UNKNOWN_DEVIATION: Final = 10.0
"""Standard deviation of a place, m, and a slope that nothing is known of."""


@dataclass(frozen=True)
class Kind:
    """A quantity of a axes that people measure, by position and rotation in the instrument's frame.

    ``name``: of its column. ``noise``: usual standard deviation, which counts as ``believed``
    measurements against the residuals. ``length``: whether it measures a length across the
    workspace. ``pair``: whether it measures two poses, by the difference of their positions.
    ``own``: unit and standard deviation before of numbers that are fitted with it.
    """

    name: str
    unit: str
    noise: float
    axes: tuple[int, ...] = ()
    length: bool = False
    pair: bool = False
    own: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    believed: float = 4.0

    def value(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        """Compute the quantity at positions (m, 3) and rotations (m, 3, 3): here coordinates, (m, a)."""
        del r, own
        return p[:, self.axes]

    def slopes(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        """Differentiate the quantity by the linear and the angular velocity, (m, a, 6)."""
        del r, own
        return np.broadcast_to(np.eye(6)[list(self.axes)], (len(p), len(self.axes), 6))

    def by_own(self, p: Array, own: Mapping[str, float]) -> dict[str, Array]:
        """Differentiate the quantity by its own numbers, (m,) each."""
        del p, own
        return {}

    def begin(self, p: Array, values: Array) -> dict[str, float]:
        """Guess the quantity's own numbers from positions (m, 3) and values (m,)."""
        del p, values
        return {}

    def likely(self, p: Array) -> Array:
        """Return values (m, 1) at positions (m, 3) that give the quantity's own numbers a likely place."""
        return np.zeros((len(p), 1))

    def residual(self, values: Array, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        """Return measured minus computed values, (m, a)."""
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

    def _find_normal(self, own: Mapping[str, float]) -> tuple[Array, float]:
        normal = np.array([-own["plane.slope_x"], -own["plane.slope_y"], 1.0])
        return normal, float(np.linalg.norm(normal))

    def value(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        normal, size = self._find_normal(own)
        return np.asarray((p @ normal - own["plane.z"]) / size)[:, None]

    def slopes(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        normal, size = self._find_normal(own)
        return np.broadcast_to(np.concatenate([normal / size, np.zeros(3)]), (len(p), 1, 6))

    def by_own(self, p: Array, own: Mapping[str, float]) -> dict[str, Array]:
        normal, size = self._find_normal(own)
        away = (p @ normal - own["plane.z"]) / size**3
        found = {"plane.z": np.full(len(p), -1.0 / size)}
        for k, name in enumerate(("plane.slope_x", "plane.slope_y")):
            found[name] = -p[:, k] / size - away * own[name]
        return found

    def begin(self, p: Array, values: Array) -> dict[str, float]:
        rows = np.column_stack([np.ones(len(p)), p[:, :2]])
        found = np.linalg.lstsq(rows, p[:, 2] - values, rcond=1e-6)[0]
        return dict(zip(self.own, found.tolist(), strict=True))


class _Distance(Kind):
    """Distance of the platform's reference point between two poses, or from a fixed centre.

    ``p``: its displacement between the poses, or its positions, (k, 3).
    """

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
        """Guess the centre: the difference of |p - c|^2 = r^2 of every two is linear in c."""
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
        """Guess a ball below the positions."""
        below = p.mean(0) - [0.0, 0.0, float(np.ptp(p, axis=0).max())]
        return np.asarray(np.linalg.norm(p - below, axis=1, keepdims=True))


class _Range(_Ball):
    """Distance from a fixed place with an unknown zero: a laser tracker's or a wire's reading."""

    def value(self, p: Array, r: Array, own: Mapping[str, float]) -> Array:
        return super().value(p, r, own) + own["range.zero"]

    def by_own(self, p: Array, own: Mapping[str, float]) -> dict[str, Array]:
        return super().by_own(p, own) | {"range.zero": np.ones(len(p))}

    def begin(self, p: Array, values: Array) -> dict[str, float]:
        """Guess the place: of several at many distances from the middle the one that fits best."""
        away = np.ptp(p, axis=0).max() * 2.0 ** np.arange(-1, 6)
        zeros = [0.0, *(values.mean() - away).tolist()]
        found = [_Ball.begin(self, p, values - z) | {"range.zero": z} for z in zeros]
        return min(found, key=lambda own: float(np.sum((values - self.value(p, p, own)[:, 0]) ** 2)))


POSITION_KIND: Final = Kind("position", "m", MIN_NOISE, (0, 1, 2), length=True, believed=0.0)
ROTATION_KIND: Final = _Rotation("rotation", "rad", MIN_NOISE, (3, 4, 5), believed=0.0)
"""Of whole poses."""
MEASUREMENT_KINDS: Final = {
    kind.name: kind
    for kind in (
        *(Kind(name, "m", 5e-5, (k,), length=k < 2) for k, name in enumerate(COORDINATES[:3])),
        *(_Angle(name, "rad", 5e-4, (k,)) for k, name in enumerate(COORDINATES[3:])),
        Kind("height", "m", 3e-5, (2,)),
        _Plane(
            "plane",
            "m",
            3e-5,
            own={
                f"plane.{name}": (unit, UNKNOWN_DEVIATION)
                for name, unit in (("z", "m"), ("slope_x", "rad"), ("slope_y", "rad"))
            },
        ),
        _Ball("radius", "m", 1e-5, length=True, own={f"ball.{axis}": ("m", UNKNOWN_DEVIATION) for axis in "xyz"}),
        _Range(
            "range",
            "m",
            1e-5,
            length=True,
            own={f"range.{name}": ("m", UNKNOWN_DEVIATION) for name in ("x", "y", "z", "zero")},
        ),
        _Distance("distance", "m", 6e-5, length=True, pair=True),
    )
}
GROUPS: Final = {"tilt": ("roll", "pitch"), "position": COORDINATES[:3], "pose": COORDINATES}


def parse_kinds(texts: Sequence[str]) -> tuple[Kind, ...]:
    """Parse the names of kinds, separated by commas.

    :raises UnknownNameError: no such kind.
    """
    names = [name.strip() for text in texts for name in text.split(",")]
    every = [one for name in names for one in GROUPS.get(name, (name,))]
    for name in every:
        if name not in MEASUREMENT_KINDS:
            raise UnknownNameError("--measure", name, [*MEASUREMENT_KINDS, *GROUPS])
    return tuple(MEASUREMENT_KINDS[name] for name in dict.fromkeys(every))


def parse_named_numbers(option: str, text: str, right: str) -> dict[str, list[float]]:
    """Parse ``NAME=NUMBER[:NUMBER]``, several separated by commas.

    :raises ParameterError: anything else than what is ``right``.
    """
    found = {}
    for part in filter(None, map(str.strip, text.split(","))):
        name, _, ends = (one.strip() for one in part.partition("="))
        try:
            found[name] = [float(end) for end in ends.split(":")]
        except ValueError:
            found[name] = [np.nan]
        if not np.isfinite(found[name]).all():
            raise ParameterError(option, part, right)
    return found


def parse_noise(texts: Sequence[str]) -> dict[str, float]:
    """Parse ``KIND=VALUE`` separated by commas, m or rad.

    :raises ParameterError: no number above zero, or no such kind.
    """
    right = "KIND=VALUE, m or rad, as height=0.00002"
    found = parse_named_numbers("--noise", ",".join(texts), right)
    for name, values in found.items():
        if name not in MEASUREMENT_KINDS:
            raise UnknownNameError("--noise", name, list(MEASUREMENT_KINDS))
        if len(values) > 1 or not 0.0 < values[0] < 1.0:
            raise ParameterError("--noise", f"{name}={':'.join(map(str, values))}", right)
    return {name: values[0] for name, values in found.items()}


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

    def compute_poses(self, state: State) -> tuple[Array, Array]:
        """Compute positions (m, 3), of pairs their differences, and rotations (m, 3, 3)."""
        position, rotation = state.instrument.compute_reading(*state.platform)
        p = position[self.first]
        return (p if self.second is None else p - position[self.second]), rotation[self.first]

    def own(self, state: State) -> dict[str, float]:
        """Return the kind's own numbers as they are now."""
        return {name: state.instrument.own[name] for name in self.kind.own}

    def slopes(self, state: State, columns: Array, names: Sequence[str]) -> Array:
        """Differentiate what is computed, (m, a, p), from derivatives of the poses, (k, 6, p)."""
        (p, r), own = self.compute_poses(state), self.own(state)
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
        """Divide the rows (m, a, ...) of each kind by the noise, one below the other."""
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
        """Return measured minus computed values, (m, a) a kind."""
        return [one.kind.residual(one.values, *one.compute_poses(state), one.own(state)) for one in self.readings]

    def slopes(self, robot: Robot, state: State, names: Sequence[str]) -> list[Array]:
        """Differentiate what is computed by named parameters, (m, a, p) a kind."""
        columns = differentiate_poses(robot, state, names)
        return [one.slopes(state, columns, names) for one in self.readings]

    def weighed(self, parts: list[Array], slopes: list[Array], prior: Array) -> Weights:
        """Estimate the noise of each kind from residuals and from what is usual; return robust weights.

        Of few measurements a fit leaves little: each counts for the part that it does not decide.
        """
        kinds = [one.kind for one in self.readings]
        usual = [self.noise.get(kind.name, kind.noise) for kind in kinds]
        sizes = [np.sqrt(np.mean(part**2, 1)) for part in parts]
        # By the number of axes the median of the root mean square of normal variables.
        noise = [
            s if kind.name in self.noise else max(s, float(np.median(size)) / {1: 0.6745, 3: 0.888}[part.shape[1]])
            for kind, s, size, part in zip(kinds, usual, sizes, parts, strict=True)
        ]
        weights = [np.ones(len(part)) for part in parts]
        for _ in range(5):
            away = [size / s for size, s in zip(sizes, noise, strict=True)]
            weights = [huber(one) for one in away]
            left = find_redundancy(slopes, noise, prior)
            for k, kind in enumerate(kinds):
                good = away[k] < MAX_SOUND_DISTANCE
                square = kind.believed * usual[k] ** 2 + float(np.sum(parts[k][good] ** 2))
                count = kind.believed + float(np.sum(left[k][good])) * parts[k].shape[1]
                if kind.name not in self.noise:
                    noise[k] = max(float(np.sqrt(square / max(count, 1.0))), MIN_NOISE)
        scales = [np.sqrt(w) / s for w, s in zip(weights, noise, strict=True)]
        return Weights(tuple(noise), tuple(scales))


def find_redundancy(slopes: Sequence[Array], noise: Sequence[float], prior: Array) -> list[Array]:
    """Find the fraction of each measurement that the others and the priors decide, (m,) a kind."""
    rows = [(table * prior / s).reshape(-1, len(prior)) for table, s in zip(slopes, noise, strict=True)]
    whole = np.concatenate(rows)
    both = np.vstack([whole, np.eye(len(prior))])
    base = np.linalg.qr(both)[0][: len(whole)]
    left = np.maximum(1.0 - np.sum(base**2, 1), 1e-9)
    each = np.split(left, np.cumsum([len(row) for row in rows])[:-1])
    return [part.reshape(len(table), -1).mean(1) for part, table in zip(each, slopes, strict=True)]


def select_poses(poses: Poses, rows: Indices) -> Measured:
    """Return some of the whole poses, or of their positions, as measurements."""
    every, lines = np.arange(len(rows)), rows + 2
    readings = [Readings(POSITION_KIND, every, None, poses.position[rows], lines)]
    if poses.rotation is not None:
        readings.append(Readings(ROTATION_KIND, every, None, poses.rotation[rows], lines))
    return Measured(poses.joints[rows], tuple(readings))


def make_measured(
    joints: Array, second: Array | None, values: Mapping[str, Array], lines: Indices, noise: Mapping[str, float]
) -> Measured:
    """Return the measurements of a table; a value that is NaN was not measured.

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
        pair = MEASUREMENT_KINDS[name].pair
        if pair and (second is None or not np.isfinite(second[rows]).all()):
            raise ParameterError(name, "one pose", "two in each row: JOINT.position and JOINT.position_2 columns")
        used[rows] = True
        used[rows + count * pair] = True
        found.append((MEASUREMENT_KINDS[name], rows, rows + count if pair else None))
    place = np.cumsum(used) - 1
    readings = (
        Readings(
            kind, place[first], None if other is None else place[other], values[kind.name][first, None], lines[first]
        )
        for kind, first, other in found
    )
    return Measured(both[used], tuple(readings), noise)


POSITIONS: Final = COORDINATES[:3]
ANGLES: Final = COORDINATES[3:]
QUATERNION: Final = ("qx", "qy", "qz", "qw")
_PLACE: Final = re.compile(r"(?:\w*_)?(?:pos|position|translation|point)_([xyz])")
_TURN: Final = re.compile(r"(?:\w*_)?(?:ori|orientation|quat|quaternion|rotation|rot)_([xyzw])")
_MEASURED: Final = re.compile(r"meas\w*_|actual_|mocap_")


def read_poses(path: Path, robot: Robot, dialect: Dialect = DEFAULT_DIALECT) -> Poses:
    """Read measured poses.

    Columns, in any order: ``JOINT.position`` of every joint, in the controller's names and numbers;
    ``x y z``; and, where measured, ``roll pitch yaw`` or ``qx qy qz qw``, of the platform relative
    to home.

    Without these names, headers as motion capture writes them are found: one set of ``pos_x``,
    ``position_x`` and the like, of several the measured one, and of ``ori_x``, ``quat_x``; and for
    the joints the only columns of one name that are numbered from 0 or 1 to as many as there are.

    :raises ParameterError: a column is missing, or a value is no finite number.
    """
    joints = [f"{name}.position" for name in robot.controller.names]
    table = _read(path, joints, QUATERNION, dialect)
    _add_columns_by_usual_names(table, joints, dialect)
    q, position = table.stack(joints), table.stack(POSITIONS)
    # No instrument stands farther from what it measures, m.
    for names, bound, its in ((POSITIONS, 1e4, "m"), (ANGLES, 2.0 * np.pi, "rad")):
        for name in names:
            values = table.get(name, np.zeros(1))
            if np.abs(values).max() > bound:
                worst = int(np.abs(values).argmax())
                where, right = f"{table.line(worst)}: {name}", f"{its}, up to {bound:.3g} in size"
                raise ParameterError(where, float(values[worst]), right)
    angles, quaternion = table.stack_if(ANGLES), table.stack_if(QUATERNION)
    if quaternion is not None:
        if not (np.linalg.norm(quaternion, axis=1) > 1e-6).all():
            raise ParameterError(f"{path}: qx qy qz qw", 0.0, "quaternions of length one")
        return Poses(q, position, rotations().from_quat(quaternion).as_matrix())
    turned = None if angles is None else rotations().from_euler("xyz", angles).as_matrix()
    return Poses(q, position, turned)


def read_measured(
    path: Path, robot: Robot, kinds: Sequence[Kind], noise: Mapping[str, float], dialect: Dialect = DEFAULT_DIALECT
) -> Measured:
    """Read measurements of some quantities; cells may be empty.

    Columns: ``JOINT.position`` of every joint, and one by the name of each kind. ``z`` stands for a
    missing ``height``, ``height`` for a missing ``plane``, which is contact without both. Of a
    distance the other pose is in ``JOINT.position_2`` columns, or in the row whose number, from 1,
    is in a column ``to``.

    :raises ParameterError: a column is missing, or a value is no finite number.
    """
    joints = [f"{name}.position" for name in robot.controller.names]
    others = [f"{name}_2" for name in joints]
    table = _read(path, joints, (*others, "to"), dialect, blank=True)
    _add_columns_by_usual_names(table, joints, dialect)
    q = table.stack(joints)
    if "z" in table:
        table.setdefault("height", table["z"])
    table.setdefault("plane", table.get("height", np.zeros(len(q))))
    second = table.stack_if(others)
    if "to" in table:
        given = np.isfinite(table["to"])
        to = table["to"][given].astype(int)
        if len(to) and not (to.min() > 0 and to.max() <= len(q)):
            raise ParameterError(f"{path}: to", int(to.max()), f"a row from 1 to {len(q)}")
        second = np.full_like(q, np.nan)
        second[given] = q[to - 1]
    if not np.isfinite(q).all():
        row = int(np.flatnonzero(~np.isfinite(q).all(1))[0])
        raise ParameterError(table.line(row), "an empty cell", "every joint's position")
    names = [kind.name for kind in kinds]
    values = dict(zip(names, table.stack(names).T, strict=True))
    return make_measured(q, second, values, np.arange(len(q)) + 2, noise)


def _read(path: Path, joints: Sequence[str], others: Sequence[str], dialect: Dialect, *, blank: bool = False) -> Table:
    """Read columns by name in SI units; joints in the controller's.

    :raises ParameterError: a joint that the robot has not.
    """
    kinds = dict.fromkeys((*joints, *others), "")
    kinds |= {name: "length" if kind.unit == "m" else "angle" for name, kind in MEASUREMENT_KINDS.items()}
    table = read_table(path, kinds, dialect, blank=blank)
    for name in table:
        if name.endswith(".position") and name not in kinds:
            raise UnknownNameError(f"{path}: column", name, kinds)
    return table


def _add_columns_by_usual_names(table: Table, joints: Sequence[str], dialect: Dialect) -> None:
    """Add missing columns of pose and joints that the table has under a usual name."""
    if not any(name in table for name in POSITIONS):
        size = dialect.size("length")
        places, turns = _find_column_set(table, _PLACE, "xyz", ""), _find_column_set(table, _TURN, "xyzw", "q")
        turned = any(name in table for name in (*ANGLES, *QUATERNION))
        table |= {name: size * table[header] for name, header in places.items()}
        table |= {} if turned else {name: table[header] for name, header in turns.items()}
    if not any(name in table for name in joints):
        stems: dict[str, dict[int, str]] = {}
        for name in table:
            match = re.fullmatch(r"(.*?)(\d+)", name)
            if match is not None:
                stems.setdefault(match[1], {})[int(match[2])] = name
        count = len(joints)
        whole = [
            [own[k] for k in sorted(own)]
            for own in stems.values()
            if sorted(own) in (list(range(count)), list(range(1, count + 1)))
        ]
        if len(whole) == 1:
            table |= {joint: table[header] for joint, header in zip(joints, whole[0], strict=True)}


def _find_column_set(
    columns: Mapping[str, Array], pattern: re.Pattern[str], letters: str, prefix: str
) -> dict[str, str]:
    """Return the columns of the one complete set, by letter; among several, of the only measured one."""
    sets: dict[str, dict[str, str]] = {}
    for name in columns:
        match = pattern.fullmatch(name)
        if match is not None:
            sets.setdefault(name[: -len(match[1])], {})[prefix + match[1]] = name
    whole = {stem: own for stem, own in sets.items() if len(own) == len(letters)}
    measured = {stem: own for stem, own in whole.items() if _MEASURED.match(stem)}
    chosen = whole if len(whole) == 1 else measured
    return next(iter(chosen.values())) if len(chosen) == 1 else {}
