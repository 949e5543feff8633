# SPDX-License-Identifier: Apache-2.0
"""Tables of measured poses: their columns by name, renamed, and in the units that they are in."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.identification.calibration_state import Poses, rotations
from pkm_twin.identification.measurements import KINDS, Kind, Measured, measured_of
from pkm_twin.recordings import read_table
from pkm_twin.robot.robot import Robot

Array = NDArray[np.float64]

POSITIONS: Final = ("x", "y", "z")
ANGLES: Final = ("roll", "pitch", "yaw")
QUATERNION: Final = ("qx", "qy", "qz", "qw")
FARTHEST: Final = 1e4
"""No instrument stands farther from what it measures, m."""
LENGTHS: Final = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "µm": 1e-6, "um": 1e-6}
TURNS: Final = {"rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180.0}
UNITS: Final = {**LENGTHS, **TURNS}
_UNIT: Final = re.compile(r"^(.*?)(?:\s*[\[(]\s*(\w+)\s*[\])]|_(mm|cm|[uµ]m|deg|mrad))$")
_PLACE: Final = re.compile(r"(?:\w*_)?(?:pos|position|translation|point)_([xyz])")
_TURN: Final = re.compile(r"(?:\w*_)?(?:ori|orientation|quat|quaternion|rotation|rot)_([xyzw])")
_MEASURED: Final = re.compile(r"meas\w*_|actual_|mocap_")


def parse_columns(texts: Sequence[str]) -> dict[str, str]:
    """Of ``NAME=HEADER`` separated by commas; ``*`` in both stands for the same text.

    :raises ParameterError: an entry without both.
    """
    found = {}
    for text in ",".join(texts).split(",") if texts else ():
        name, equals, header = (part.strip() for part in text.partition("="))
        if not (name and equals and header) or name.count("*") != header.count("*") > 1:
            raise ParameterError("--columns", text, "NAME=HEADER, as x=meas_pos_x")
        found[name] = header
    return found


def read_poses(
    path: Path, robot: Robot, renamed: Mapping[str, str] | None = None, unit: str = "m"
) -> Poses:
    """Measured poses of a CSV.

    Columns, in any order: ``JOINT.position`` of every joint, in the controller's names and numbers;
    ``x y z``; and, where measured, ``roll pitch yaw`` or ``qx qy qz qw``, of the platform relative
    to home. A header may end in its unit, ``x [mm]``, ``x (mm)`` or ``x_mm``.

    Without these names, headers as motion capture writes them are found: one set of ``pos_x``,
    ``position_x`` and the like, of several the measured one, and of ``ori_x``, ``quat_x``; and for
    the joints the only columns of one name that are numbered from 0 or 1 to as many as there are.

    :param renamed: headers by column name, as of :func:`parse_columns`.
    :param unit: of lengths whose header has none.
    :raises ParameterError: a column is missing, or a value is no finite number.
    """
    joints = [f"{name}.position" for name in robot.controller.names]
    columns = _columns_of(path, joints, (*POSITIONS, *ANGLES, *QUATERNION), renamed, unit)

    def stack(names: Sequence[str]) -> Array:
        return _stacked(path, columns, names)

    def stack_some(names: Sequence[str]) -> Array | None:
        return stack(names) if any(name in columns for name in names) else None

    q, position = stack(joints), stack(POSITIONS)
    for names, bound, its in ((POSITIONS, FARTHEST, "m"), (ANGLES, 2.0 * np.pi, "rad")):
        for name in names:
            values = columns.get(name, np.zeros(1))
            if np.abs(values).max() > bound:
                worst = int(np.abs(values).argmax())
                raise ParameterError(
                    f"{path}: line {worst + 2}: {name}",
                    float(values[worst]),
                    f"{its}, up to {bound:.3g} in size",
                )
    angles, quaternion = stack_some(ANGLES), stack_some(QUATERNION)
    rotation = None
    if quaternion is not None:
        if not (np.linalg.norm(quaternion, axis=1) > 1e-6).all():
            raise ParameterError(f"{path}: qx qy qz qw", 0.0, "quaternions of length one")
        rotation = rotations().from_quat(quaternion).as_matrix()
    elif angles is not None:
        rotation = rotations().from_euler("xyz", angles).as_matrix()
    return Poses(q, position, rotation)


def read_measured(
    path: Path, robot: Robot, kinds: Sequence[Kind], noise: Mapping[str, float],
    renamed: Mapping[str, str] | None = None, unit: str = "m",
) -> Measured:  # fmt: skip
    """Measurements of some quantities, of a CSV in which cells may be empty.

    Columns: ``JOINT.position`` of every joint, and one by the name of each kind. ``z`` stands for a
    missing ``height``, ``height`` for a missing ``plane``, which is contact without both. Of a
    distance the other pose is in ``JOINT.position_2`` columns, or in the row whose number, from 1,
    is in a column ``to``.

    :raises ParameterError: a column is missing, or a value is no finite number.
    """
    joints = [f"{name}.position" for name in robot.controller.names]
    others = [f"{name}_2" for name in joints]
    names = [kind.name for kind in kinds]
    columns = _columns_of(path, joints, (*others, *KINDS, "to"), renamed, unit, blank=True)
    q = _stacked(path, columns, joints)
    if "height" in names and "height" not in columns and "z" in columns:
        columns["height"] = columns["z"]
    if "plane" in names:
        columns.setdefault("plane", columns.get("height", np.zeros(len(q))))
    second = None
    if "to" in columns:
        given = np.isfinite(columns["to"])
        to = columns["to"][given].astype(int)
        if len(to) and not (to.min() > 0 and to.max() <= len(q)):
            raise ParameterError(f"{path}: to", int(to.max()), f"a row from 1 to {len(q)}")
        second = np.full_like(q, np.nan)
        second[given] = q[to - 1]
    elif any(name in columns for name in others):
        second = _stacked(path, columns, others)
    if not np.isfinite(q).all():
        line = int(np.flatnonzero(~np.isfinite(q).all(1))[0]) + 2
        raise ParameterError(f"{path}: line {line}", "an empty cell", "every joint's position")
    values = {name: _stacked(path, columns, [name])[:, 0] for name in names}
    return measured_of(q, second, values, np.arange(len(q)) + 2, noise)


def _columns_of(
    path: Path, joints: Sequence[str], others: Sequence[str], renamed: Mapping[str, str] | None,
    unit: str, *, blank: bool = False,
) -> dict[str, Array]:  # fmt: skip
    """Columns by name in SI units.

    :raises ParameterError: two columns of one name, or a joint that the robot has not.
    """
    known = [*joints, *others]
    table = read_table(path, blank=blank)
    headers = _named(table, known, renamed or {})
    columns: dict[str, Array] = {}
    for header, values in table.items():
        name, own = headers.get(header, (header, ""))
        if name in columns:
            raise ParameterError(f"{path}: header row", header, f"one column {name}")
        columns[name] = values * _factor(path, header, name, own, unit)
    columns = _found(columns, joints, unit)
    for name in columns:
        if name.endswith(".position") and name not in known:
            raise UnknownNameError(f"{path}: column", name, known)
    return columns


def _stacked(path: Path, columns: Mapping[str, Array], names: Sequence[str]) -> Array:
    missing = [name for name in names if name not in columns]
    if missing:
        raise ParameterError(
            str(path), ", ".join(columns),
            f"a column {missing[0]!r}; --columns {missing[0]}=HEADER names another",
        )  # fmt: skip
    return np.stack([columns[name] for name in names], -1)


def _named(
    table: Mapping[str, Array], known: Sequence[str], renamed: Mapping[str, str]
) -> dict[str, tuple[str, str]]:
    """Name and unit, empty where none is said, by header.

    :raises UnknownNameError: a name that no column has, or a header that the table has not.
    """
    found = {}
    for header in table:
        match = _UNIT.match(header)
        if match is not None and match[1] in known:
            found[header] = match[1], match[2] or match[3]
    for name, text in renamed.items():
        match = _UNIT.match(text) if text not in table else None
        header, unit = (match[1], match[2] or match[3]) if match else (text, "")
        pattern = re.compile(re.escape(header).replace(r"\*", "(.+)"))
        fit = [
            (one, m[1] if "*" in header else "") for one in table if (m := pattern.fullmatch(one))
        ]
        if not fit:
            raise UnknownNameError("--columns", header, list(table))
        for one, part in fit:
            whole = name.replace("*", part)
            if whole not in known:
                raise UnknownNameError("--columns", whole, known)
            found[one] = whole, unit
    return found


def _factor(path: Path, header: str, name: str, own: str, unit: str) -> float:
    """SI units of a column's.

    :raises ParameterError: a unit of another kind.
    """
    kinds = {name: LENGTHS if kind.unit == "m" else TURNS for name, kind in KINDS.items()}
    if name not in kinds:
        return 1.0
    if own and own not in kinds[name]:
        raise ParameterError(f"{path}: {header}", own, f"a unit of {', '.join(kinds[name])}")
    return UNITS[own or (unit if kinds[name] is LENGTHS else "rad")]


def _found(columns: dict[str, Array], joints: Sequence[str], unit: str) -> dict[str, Array]:
    """The same columns, with those that are missing by what such columns are usually called."""
    result = dict(columns)
    if not any(name in columns for name in POSITIONS):
        result |= {k: UNITS[unit] * columns[v] for k, v in _set(columns, _PLACE, "xyz", "").items()}
        if not any(name in columns for name in (*ANGLES, *QUATERNION)):
            result |= {k: columns[v] for k, v in _set(columns, _TURN, "xyzw", "q").items()}
    if not any(name in columns for name in joints):
        stems: dict[str, dict[int, str]] = {}
        for name in columns:
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
            result |= {joint: columns[v] for joint, v in zip(joints, whole[0], strict=True)}
    return result


def _set(
    columns: Mapping[str, Array], pattern: re.Pattern[str], letters: str, prefix: str
) -> dict[str, str]:
    """Columns by letter of the only whole set, of several the only measured one."""
    sets: dict[str, dict[str, str]] = {}
    for name in columns:
        match = pattern.fullmatch(name)
        if match is not None:
            sets.setdefault(name[: -len(match[1])], {})[prefix + match[1]] = name
    whole = {stem: own for stem, own in sets.items() if len(own) == len(letters)}
    measured = {stem: own for stem, own in whole.items() if _MEASURED.match(stem)}
    chosen = whole if len(whole) == 1 else measured
    return next(iter(chosen.values())) if len(chosen) == 1 else {}
