# SPDX-License-Identifier: Apache-2.0
"""Tables of measurements of the platform: whole poses, or any kinds of measurement."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from pkm_twin.codegen.arrays import Array
from pkm_twin.errors import ParameterError, UnknownNameError
from pkm_twin.identification.calibration_state import Poses, rotations
from pkm_twin.identification.measurements import COORDINATES, KINDS, Kind, Measured, measured_of
from pkm_twin.recordings.tables import PLAIN, Dialect, Table, read_table
from pkm_twin.robot.robot import Robot

POSITIONS: Final = COORDINATES[:3]
ANGLES: Final = COORDINATES[3:]
QUATERNION: Final = ("qx", "qy", "qz", "qw")
FARTHEST: Final = 1e4
"""No instrument stands farther from what it measures, m."""
_PLACE: Final = re.compile(r"(?:\w*_)?(?:pos|position|translation|point)_([xyz])")
_TURN: Final = re.compile(r"(?:\w*_)?(?:ori|orientation|quat|quaternion|rotation|rot)_([xyzw])")
_MEASURED: Final = re.compile(r"meas\w*_|actual_|mocap_")


def read_poses(path: Path, robot: Robot, dialect: Dialect = PLAIN) -> Poses:
    """Measured poses.

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
    _find(table, joints, dialect)
    q, position = table.stack(joints), table.stack(POSITIONS)
    for names, bound, its in ((POSITIONS, FARTHEST, "m"), (ANGLES, 2.0 * np.pi, "rad")):
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
    path: Path, robot: Robot, kinds: Sequence[Kind], noise: Mapping[str, float],
    dialect: Dialect = PLAIN,
) -> Measured:  # fmt: skip
    """Measurements of some quantities; cells may be empty.

    Columns: ``JOINT.position`` of every joint, and one by the name of each kind. ``z`` stands for a
    missing ``height``, ``height`` for a missing ``plane``, which is contact without both. Of a
    distance the other pose is in ``JOINT.position_2`` columns, or in the row whose number, from 1,
    is in a column ``to``.

    :raises ParameterError: a column is missing, or a value is no finite number.
    """
    joints = [f"{name}.position" for name in robot.controller.names]
    others = [f"{name}_2" for name in joints]
    table = _read(path, joints, (*others, "to"), dialect, blank=True)
    _find(table, joints, dialect)
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
    return measured_of(q, second, values, np.arange(len(q)) + 2, noise)


def _read(
    path: Path, joints: Sequence[str], others: Sequence[str], dialect: Dialect, *,
    blank: bool = False,
) -> Table:  # fmt: skip
    """Columns by name in SI units; joints in the controller's.

    :raises ParameterError: a joint that the robot has not.
    """
    kinds = dict.fromkeys((*joints, *others), "")
    kinds |= {name: "length" if kind.unit == "m" else "angle" for name, kind in KINDS.items()}
    table = read_table(path, kinds, dialect, blank=blank)
    for name in table:
        if name.endswith(".position") and name not in kinds:
            raise UnknownNameError(f"{path}: column", name, kinds)
    return table


def _find(table: Table, joints: Sequence[str], dialect: Dialect) -> None:
    """Add columns that are missing by what such columns are usually called."""
    if not any(name in table for name in POSITIONS):
        size = dialect.size("length")
        places, turns = _set(table, _PLACE, "xyz", ""), _set(table, _TURN, "xyzw", "q")
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
