# SPDX-License-Identifier: Apache-2.0
"""Paths out of tables of waypoints."""

from __future__ import annotations

from pathlib import Path as File
from typing import Final

import numpy as np

from pkm_twin.errors import ParameterError, UnknownNameError, warn
from pkm_twin.paths.geometry import Path, Space, lines, through
from pkm_twin.recordings.payload import Load
from pkm_twin.recordings.tables import (
    EFFORTS,
    PAYLOAD,
    PLAIN,
    WRENCH,
    Dialect,
    kinds_of,
    read_table,
)
from pkm_twin.robot.robot import Robot

OPTIONS: Final = ("blend", "dwell", "arc")
"""Columns of waypoints beside their coordinates."""


def read_waypoints(
    file: File, robot: Robot, blend: float | None, carried: Load | None = None,
    dialect: Dialect = PLAIN,
) -> Path:  # fmt: skip
    """The path of a table of waypoints: the pose's coordinates, or JOINT.position of every joint.

    A smooth curve; with ``blend`` (m) or one of the columns :data:`OPTIONS`, lines and arcs.

    :param carried: the payload of the motion; that of the table is not used.
    :raises ParameterError: a column is missing, unknown, or a number is out of range.
    """
    kinds = kinds_of(robot)
    table = read_table(file, kinds, dialect)
    joints = [f"{name}.position" for name in robot.joint_names]
    space: Space = "pose" if any(name in table for name in robot.pose_names) else "joint"
    if space == "joint" and not any(name in table for name in joints):
        known = f"{', '.join(robot.pose_names)} or {', '.join(joints)}"
        raise ParameterError(f"{file}: columns", ", ".join(table), known)
    points = table.stack(list(robot.pose_names) if space == "pose" else joints)
    other = {*WRENCH, *(name for name in kinds if name.rpartition(".")[2] in EFFORTS[1:])}
    for name in table:
        if name not in kinds or name in other:
            raise UnknownNameError(f"{file}: column", name, kinds.keys() - other)
    planned = float(table.get(PAYLOAD[0], np.zeros(1)).max())
    if planned > 0.0 and carried is None:
        warn(file, f"its payload of {planned:g} kg is not used; give --payload")
    given = {name: table[name] for name in OPTIONS if name in table}
    if blend is None and not given:
        return through(robot, points, space=space)
    if "arc" in given and not np.isin(given["arc"], (0.0, 1.0)).all():
        raise ParameterError(f"{file}: arc", given["arc"].tolist(), "0 or 1")
    arc = given.get("arc", np.zeros(len(points))) == 1.0
    rounded = given.get("blend", np.full(len(points), blend or 0.0))
    if "blend" not in given:
        # An arc's ends and middle are no corners.
        near = arc | np.roll(arc, 1) | np.roll(arc, -1)
        rounded = np.where(near, 0.0, rounded)
    try:
        return lines(
            robot, points, blend=rounded, dwell=given.get("dwell", 0.0), arc=arc, space=space
        )
    except ParameterError as error:
        raise ParameterError(f"{file}: {error.field}", error.value, error.bound) from None
